"""`warp-psf layered` and `warp-psf points`: pictures of scenes at rest."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from warp_psf.cli.console import one_sentence
from warp_psf.cli.options import LIGHT, OUTPUT, PICTURE, option, parse_size

MESHES = (".obj", ".stl", ".ply", ".glb")
# A mesh without a camera is seen from this side, in the middle of a film of 40 degrees, with this albedo.
SIDE, HALF_HEIGHT, GREY = (0.6, -0.75, 0.45), 0.364, 0.8

Out = Annotated[Path, option(OUTPUT, "Folder for the pictures.", "DIR")]
Overwrite = Annotated[
    bool, typer.Option("--overwrite", rich_help_panel=OUTPUT, help="Replace pictures that are there.")
]
Cameras = Annotated[
    list[str] | None, option(PICTURE, "A camera of the model, again for more; else all of them.", "NAME")
]
Size = Annotated[str, option(PICTURE, "Width and height in pixels.", "WxH")]
Exposure = Annotated[float, option(PICTURE, "Brightness of the PNG.", "STOPS")]
View = Annotated[str, option(PICTURE, "View transform of the PNG.", "neutral|srgb")]
Device = Annotated[str | None, option(None, "cpu, cuda:0, ...; default: the first GPU.", "D")]
Model = Annotated[Path, typer.Argument(metavar="MODEL", help="MJCF or URDF model, or a compiled one (.mjb).")]


def layered(
    source: Model,
    out: Out,
    position: Annotated[str, option(LIGHT, "Middle of the rectangular light, metres.", "X,Y,Z")],
    target: Annotated[str, option(LIGHT, "What it looks at, metres.", "X,Y,Z")],
    light_size: Annotated[str, option(LIGHT, "Its width and height, metres.", "W,H")] = "1,1",
    radiance: Annotated[str, option(LIGHT, "Its radiance, linear.", "R,G,B")] = "10,10,10",
    map_size: Annotated[int, option(LIGHT, "Cells along the side of the map.", "N")] = 512,
    camera: Cameras = None,
    size: Size = "640x360",
    exposure: Exposure = 0.0,
    view: View = "neutral",
    overwrite: Overwrite = False,
    device: Device = None,
) -> None:
    """Soft shadows of a rectangular light in a model at rest, for many viewpoints from one layered area light map.

    Writes a PNG and an EXR with the layers color and visibility per camera. (Jeng 2005, chapter 4.)
    """
    with one_sentence("stopped"):
        width, height = _check_picture(size, exposure, view)
        from warp_psf.area_light import bake_layered_map, project_forward, upload_layers
        from warp_psf.scene.light import rectangle_light

        sides = _numbers("--light-size", light_size, 2)
        light = rectangle_light(
            "light",
            *sides,
            radiance=_numbers("--radiance", radiance, 3),
            position=_numbers("--position", position, 3),
            target=_numbers("--target", target, 3),
        )
        names, scene = _freeze(source, camera)
        paths = _paths(out, names, overwrite)
        layers = upload_layers(bake_layered_map(scene, light, map_size, device=device), scene, device)

        def shoot(index: int) -> tuple[Any, dict[str, Any]]:
            picture = project_forward(layers, scene.cameras[index], width, height)
            return picture.color, {"color": picture.color, "visibility": picture.visibility}

        _write(paths, scene, shoot, exposure, view)
        typer.echo(f"{len(names)} pictures: {out}")


def points(
    source: Annotated[
        Path, typer.Argument(metavar="MODEL_OR_MESH", help="MJCF, URDF or .mjb model, or OBJ, STL, PLY, GLB mesh.")
    ],
    out: Out,
    smallest: Annotated[
        float | None, option(PICTURE, "Side of the smallest squares, metres; else a thousandth of the extent.", "M")
    ] = None,
    levels: Annotated[int, option(PICTURE, "Lists of points.", min=1, max=6)] = 4,
    camera: Cameras = None,
    size: Size = "640x360",
    exposure: Exposure = 0.0,
    view: View = "neutral",
    overwrite: Overwrite = False,
    device: Device = None,
) -> None:
    """A model at rest or a mesh as points of several sizes, splatted without holes.

    Writes a PNG and an EXR with the layers color and depth per camera. (Jeng 2005, chapter 5.)
    """
    with one_sentence("stopped"):
        width, height = _check_picture(size, exposure, view)
        from warp_psf.area_light import sample_points, splat_points, upload_points

        names, scene = _freeze(source, camera)
        paths = _paths(out, names, overwrite)
        lists = sample_points(scene, smallest=smallest, levels=levels)
        device_points = upload_points(lists, device)

        def shoot(index: int) -> tuple[Any, dict[str, Any]]:
            picture = splat_points(device_points, scene.cameras[index], width, height)
            typer.echo(f"{names[index]}: {picture.points:,} of {lists.counts.sum():,} points")
            return picture.color, {"color": picture.color, "depth": picture.depth}

        _write(paths, scene, shoot, exposure, view)
        typer.echo(f"{len(names)} pictures: {out}")


def _check_picture(size: str, exposure: float, view: str) -> tuple[int, int]:
    """Width and height; refuses a picture that cannot be, before much is done for it."""
    width, height = parse_size(size)
    import numpy as np

    from warp_psf.area_light.checks import check_picture
    from warp_psf.film.display import to_display

    to_display(np.zeros((1, 1, 3), np.float32), exposure=exposure, view=view)
    return check_picture(width, height)


def _freeze(source: Path, cameras: list[str] | None) -> tuple[list[str], Any]:
    """The names of the viewpoints and the scene that they see."""
    if source.suffix.lower() in MESHES:
        if cameras:
            raise ValueError(f"mesh {str(source)!r} has no cameras; leave --camera out, or give a model")
        return [source.stem], _freeze_mesh(source)
    from warp_psf.bridge import freeze_scene, load_model

    model = load_model(source)
    names = cameras or [model.camera(index).name for index in range(model.ncam)] or ["-1"]
    repeated = {name for name in names if names.count(name) > 1 or not name}
    chosen = range(model.ncam) if repeated and not cameras else [-1 if name == "-1" else name for name in names]
    labels = [str(each) for each in chosen] if repeated and not cameras else names
    return ["free" if label == "-1" else label for label in labels], freeze_scene(model, cameras=list(chosen))


def _freeze_mesh(source: Path) -> Any:
    """A mesh in the middle of the film of a camera at its side."""
    import numpy as np

    from warp_psf.scene.camera import Camera
    from warp_psf.scene.mesh import load_mesh
    from warp_psf.scene.still import Piece, join_pieces

    mesh = load_mesh(source)
    back = np.array(SIDE) / np.linalg.norm(SIDE)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    # The bounding sphere touches the film's upper and lower edge.
    position = mesh.center + mesh.radius * np.sqrt(1.0 + HALF_HEIGHT**-2) * back
    rotation = np.stack([right, np.cross(back, right), back], axis=1)
    grey = np.full(mesh.faces.shape, GREY, np.float32)
    piece = Piece(mesh.vertices, mesh.normals, mesh.faces, grey)
    return join_pieces([piece], [Camera(position, rotation, HALF_HEIGHT)])


def _paths(out: Path, names: list[str], overwrite: bool) -> list[Path]:
    """Where the pictures go, without suffix; refuses to replace any unasked, or one by another."""
    from warp_psf.film.writer import write_error

    labels = [name.replace("/", "_") for name in names]
    for label in labels:
        if labels.count(label) > 1:
            raise ValueError(f"{labels.count(label)} cameras would write {label}.png; choose one with --camera")
    paths = [out / label for label in labels]
    there = [path.with_name(path.name + suffix) for path in paths for suffix in (".png", ".exr")]
    present = [path for path in there if path.exists()]
    if present and not overwrite:
        raise ValueError(f"{present[0]} is there already; choose another folder, or replace it with --overwrite")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise write_error(out, error) from error
    return paths


def _write(
    paths: list[Path], scene: Any, shoot: Callable[[int], tuple[Any, dict[str, Any]]], exposure: float, view: str
) -> None:
    from warp_psf.film.display import to_display
    from warp_psf.film.writer import write_exr, write_png

    for index, path in enumerate(paths):
        color, layers = shoot(index)
        write_png(path.with_name(path.name + ".png"), to_display(color, exposure=exposure, view=view))
        pose = scene.cameras[index].world_from_camera
        write_exr(path.with_name(path.name + ".exr"), layers, world_from_camera=pose)


def _numbers(name: str, text: str, count: int) -> tuple[float, ...]:
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != count or not all(abs(value) < 1e9 for value in values):
        raise ValueError(f"{name} {text} must be {count} numbers with commas between, such as {','.join('1' * count)}")
    return values
