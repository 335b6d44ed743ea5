"""`warp-psf bake`."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer

from warp_psf.cli.console import one_sentence, print_table, progress_bar, show_on

MODELS = (".xml", ".urdf", ".mjb")
# The number of basis functions of a body that `Renderer` has by default.
BASIS_FUNCTIONS = 16
# Stands in the table where there is nothing to keep: closed forms, convex bodies, light that textures carry.
NOTHING = "-"


def bake(
    source: Annotated[
        Path, typer.Argument(metavar="MODEL_OR_MESH", help="MJCF, URDF or .mjb model, or OBJ, STL, PLY, GLB mesh.")
    ],
    order: Annotated[int, typer.Option(min=2, max=6, help="Bands of spherical harmonics.")] = 4,
    device: Annotated[str | None, typer.Option(metavar="D", help="cpu, cuda:0, ...; default: the first GPU.")] = None,
) -> None:
    """Bakes into the cache all that rendering a model or a mesh needs, and says what it costs.

    The table has a line per mesh: its faces, how many bodies use it, how long it took, and the kilobytes of its
    occlusion field, of its self-shadowed transfer, and of the fields of the light that it sends on.
    """
    with one_sentence("stopped; run again to resume"):
        from warp_psf.device import find_device

        where = str(find_device(device))
        costs = _bake_scene(_with_names_apart(_load_scene(source)), order, where)
        rows = [
            (cost.name, f"{cost.faces:,}", f"{cost.bodies:,}", _duration(cost), *map(_kilobytes, cost[4:]))
            for cost in costs
        ]
        totals = [sum(column) for column in list(zip(*costs, strict=True))[1:]] if costs else [0] * 6
        if len(rows) > 1:
            rows.append(("all", f"{totals[0]:,}", f"{totals[1]:,}", f"{totals[2]:.1f}", *map(_kilobytes, totals[3:])))
        print_table(("mesh", "faces", "bodies", "seconds", "occlusion\nkB", "transfer\nkB", "light\nkB"), rows)
        typer.echo(f"{sum(totals[3:]) / 1e6:.2f} MB of fields")


class Cost(NamedTuple):
    """What a mesh costs: the time that it took now, 0 where nothing was left to bake, and bytes that are kept of it."""

    name: str
    faces: int
    bodies: int
    seconds: float
    occlusion: int
    transfer: int
    light: int


def _bake_scene(scene: Any, order: int, device: str) -> list[Cost]:
    from warp_psf.bake.bodies import bake_bodies, bake_light, is_patch

    casts = [entity.casts for entity in scene.entities]
    casting = {entity.mesh for entity in scene.entities if entity.casts}
    senders = [index for index in casting if not is_patch(scene.meshes[index])]
    seconds = {mesh.name: 0.0 for mesh in scene.meshes}
    with progress_bar() as bar:
        bodies = bake_bodies(scene, casts, order, device, _watch(bar, "Occlusion", len(casting), seconds))
        report = _watch(bar, "Light", len(senders), seconds)
        radiating, _ = bake_light(scene, casts, order, BASIS_FUNCTIONS, device, report)
    light = {entity.mesh: pair[1] for entity, pair in zip(scene.entities, radiating, strict=True) if pair}
    users = Counter(entity.mesh for entity in scene.entities)
    return [
        Cost(
            name=mesh.name,
            faces=len(mesh.faces),
            bodies=users[index],
            seconds=seconds[mesh.name],
            occlusion=body.field.nbytes if body.field is not None else 0,
            transfer=sum(part.nbytes for part in (body.transfer, body.visibility) if part is not None),
            light=light[index].field.nbytes if index in light else 0,
        )
        for index, (mesh, body) in enumerate(zip(scene.meshes, bodies, strict=True))
    ]


def _watch(bar: Any, title: str, count: int, seconds: dict[str, float]) -> Callable[[str, float], None]:
    """`progress(what, share)` that counts the meshes on a bar and adds to each one's seconds what it took.

    What is read from the cache is finished when it is first reported, and adds nothing.
    """
    show, whole = show_on(bar), bar.add_task(title, total=count, rate="meshes")
    began: dict[str, float] = {}
    last = time.perf_counter()

    def progress(what: str, share: float) -> None:
        nonlocal last
        show(what, share)
        if share < 1.0:
            # A mesh has been begun when the one before it was finished, and is first reported some way in.
            began.setdefault(what, last)
            return
        last = time.perf_counter()
        bar.advance(whole)
        name = max((name for name in seconds if what.endswith(f" {name}")), key=len, default=None)
        if name is not None and what in began:
            seconds[name] += last - began[what]

    return progress


def _duration(cost: Cost) -> str:
    if cost.occlusion + cost.transfer + cost.light == 0:
        return NOTHING
    return f"{cost.seconds:.1f}" if cost.seconds else "cached"


def _kilobytes(size: int) -> str:
    return f"{size / 1e3:,.1f}" if size else NOTHING


def _load_scene(source: Path) -> Any:
    """The scene that a model is rendered as, or a mesh alone."""
    if source.suffix.lower() in MODELS:
        from warp_psf.bridge import build_scene, load_model

        return build_scene(load_model(source))
    import numpy as np

    from warp_psf.scene.material import Material
    from warp_psf.scene.mesh import load_mesh
    from warp_psf.scene.scene import Entity, Part, Scene

    mesh = load_mesh(source)
    matt = Material(np.ones(3), np.zeros(3), 0.0, np.zeros(3))
    return Scene((mesh,), (Entity(mesh.name, 0, (Part(mesh.name, matt, -1, -1),)),), ())


def _with_names_apart(scene: Any) -> Any:
    """The same scene; of meshes that share a name, all but the first are numbered, so that reports tell them apart."""
    met: Counter[str] = Counter()
    meshes = []
    for mesh in scene.meshes:
        met[mesh.name] += 1
        meshes.append(mesh if met[mesh.name] == 1 else replace(mesh, name=f"{mesh.name} #{met[mesh.name]}"))
    return replace(scene, meshes=tuple(meshes))
