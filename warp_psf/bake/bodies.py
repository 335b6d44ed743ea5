"""Everything that the bodies of a scene need baked, each shape once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from queue import SimpleQueue
from threading import Event
from typing import TypeVar

import numpy as np

from warp_psf.bake.body import bake_mesh
from warp_psf.bake.coarse import make_blockers
from warp_psf.bake.kept import BakedBody
from warp_psf.bake.logarithm import bake_logarithm
from warp_psf.bake.radiance import BakedRadiance, bake_radiance
from warp_psf.bake.shape import shape_key, unit_shape
from warp_psf.bake.silhouettes import bake_silhouettes
from warp_psf.bake.sphere_set import bake_shape_spheres
from warp_psf.device import core_count, find_device
from warp_psf.field.blockers import BlockerSet
from warp_psf.field.shells import ShadowField
from warp_psf.field.silhouettes import SilhouetteField
from warp_psf.field.spheres import SphereSet
from warp_psf.scene.deforming import DeformingShape
from warp_psf.scene.detail import refine_radiating
from warp_psf.scene.mesh import Mesh
from warp_psf.scene.scene import Scene

# Boxes whose shortest side is less than this share of the longest are floors, walls and beams: shells around their
# centre would serve badly what lies on them, so that their light leaves through textured faces instead.
THICK = 0.25
# Of a deforming sheet as other bodies see it: every receiver looks at all of these triangles.
SHEET_TRIANGLES = 160
Progress = Callable[[str, float], None]
T = TypeVar("T")


def is_patch(mesh: Mesh) -> bool:
    """Whether light leaves a shape through textured faces: what is flat or long, unlike a die."""
    return mesh.slab is not None and mesh.slab[2].min() < THICK * mesh.slab[2].max()


def bake_bodies(scene: Scene, casts: list[bool], order: int, device: str, progress: Progress) -> list[BakedBody]:
    """The baked body of every mesh; one that no entity casts a shadow with needs nothing.

    casts: per entity whether it casts shadows: area lights do not. progress: called as progress(what, share), from the
    thread that calls this.
    """

    def bake(mesh: Mesh, progress: Progress) -> BakedBody:
        return bake_mesh(mesh, order, device=device, progress=_named(progress, f"baking {mesh.name}"))

    baked = _bake_shapes(scene, _casting(scene, casts), bake, device, progress)
    return [baked.get(index, BakedBody(None, None, None)) for index in range(len(scene.meshes))]


def bake_light(
    scene: Scene, casts: list[bool], order: int, functions: int, device: str, progress: Progress
) -> tuple[list[tuple[Mesh, BakedRadiance] | None], list[bool]]:
    """What is baked of the light that leaves each entity, with the mesh whose vertices carry it; and who is a patch.

    casts, progress: as in `bake_bodies`. functions: basis functions per body. Patches and lights have None.
    """

    def bake(shape: Mesh, progress: Progress) -> tuple[Mesh, BakedRadiance]:
        mesh = refine_radiating(shape)
        report = _named(progress, f"baking light of {mesh.name}")
        return mesh, bake_radiance(mesh, order, functions, device=device, progress=report)

    radiating = [index for index in _casting(scene, casts) if not is_patch(scene.meshes[index])]
    baked = _bake_shapes(scene, radiating, bake, device, progress)
    pairs = list(zip(scene.entities, casts, strict=True))
    return (
        [baked.get(entity.mesh) if casting else None for entity, casting in pairs],
        [casting and is_patch(scene.meshes[entity.mesh]) for entity, casting in pairs],
    )


def bake_logarithms(scene: Scene, bodies: list[BakedBody], progress: Progress) -> list[ShadowField | None]:
    """The log shadow field of every mesh whose baked body has a field; else None."""
    # Copies of a shape follow it, who will find it kept.
    logarithms: list[ShadowField | None] = []
    for mesh, body in zip(scene.meshes, bodies, strict=True):
        if body.field is not None:
            progress(f"taking logarithms of {mesh.name}", 0.0)
        logarithms.append(None if body.field is None else bake_logarithm(mesh, body.field))
        if body.field is not None:
            progress(f"taking logarithms of {mesh.name}", 1.0)
    return logarithms


def bake_outlines(
    scene: Scene, bodies: list[BakedBody], device: str, progress: Progress
) -> list[SilhouetteField | None]:
    """The silhouette field of every mesh whose baked body has a field; None for the others."""

    def bake(mesh: Mesh, progress: Progress) -> SilhouetteField:
        return bake_silhouettes(mesh, device=device, progress=_named(progress, f"baking silhouettes of {mesh.name}"))

    chosen = [index for index, body in enumerate(bodies) if body.field is not None]
    baked = _bake_shapes(scene, chosen, bake, device, progress)
    return [baked.get(index) for index in range(len(bodies))]


def bake_blockers(shape: DeformingShape) -> tuple[BlockerSet, BlockerSet]:
    """The triangles that hide a deforming body from itself, and those that hide others: of a sheet fewer."""
    # A body that is not in order at the start has nothing that could be told apart.
    faces = shape.blocker_faces if shape.casts else shape.blocker_faces[:0]
    vertices = shape.blocker_vertices if shape.casts else np.zeros_like(shape.blocker_vertices)
    own = make_blockers(shape.name, vertices, faces)
    return own, make_blockers(shape.name, vertices, faces, coarse=SHEET_TRIANGLES) if own.two_sided else own


def bake_sphere_sets(
    shapes: Sequence[DeformingShape], solid: Sequence[bool], device: str, progress: Progress
) -> tuple[SphereSet | None, ...]:
    """The blocker spheres of shapes that deform and are solid, bound to their vertices; None for the others."""

    def bake(shape: DeformingShape) -> SphereSet:
        progress(f"fitting spheres to {shape.name}", 0.0)
        spheres = bake_shape_spheres(shape, device=device)
        progress(f"fitting spheres to {shape.name}", 1.0)
        return spheres

    return tuple(bake(shape) if chosen else None for shape, chosen in zip(shapes, solid, strict=True))


def _casting(scene: Scene, casts: list[bool]) -> list[int]:
    """The meshes that some entity casts shadows with, in their order."""
    return sorted({entity.mesh for entity, casting in zip(scene.entities, casts, strict=True) if casting})


def _bake_shapes(
    scene: Scene, indices: list[int], bake: Callable[[Mesh, Progress], T], device: str, progress: Progress
) -> dict[int, T]:
    """What `bake` makes of the scene's meshes, by their indices; copies of a shape follow it, who will find it kept."""
    shapes: dict[str, list[int]] = {}
    for index in indices:
        shapes.setdefault(shape_key({}, unit_shape(scene.meshes[index])), []).append(index)

    def bake_copies(copies: list[int], progress: Progress) -> dict[int, T]:
        return {index: bake(scene.meshes[index], progress) for index in copies}

    # A kernel on the CPU leaves the interpreter to others: what one shape does in NumPy goes on beside another's rays.
    workers = 1 if find_device(device).is_cuda else core_count()
    jobs = [partial(bake_copies, copies) for copies in shapes.values()]
    return {index: baked for part in _run(jobs, workers, progress) for index, baked in part.items()}


def _run(jobs: list[Callable[[Progress], T]], workers: int, progress: Progress) -> list[T]:
    """The jobs' results. They run side by side, are stopped by the first error, and are heard in the calling thread."""
    if workers == 1 or len(jobs) < 2:
        return [job(progress) for job in jobs]
    said: SimpleQueue[tuple[str, float] | None] = SimpleQueue()
    stopped = Event()

    def say(what: str, share: float) -> None:
        if stopped.is_set():
            raise InterruptedError(f"{what} was stopped")
        said.put((what, share))

    def run(job: Callable[[Progress], T]) -> T:
        try:
            return job(say)
        finally:
            said.put(None)  # it has ended

    with ThreadPoolExecutor(workers, thread_name_prefix="bake") as pool:
        futures = [pool.submit(run, job) for job in jobs]
        try:
            running = len(futures)
            while running:
                heard = said.get()
                if heard is not None:
                    progress(*heard)
                    continue
                running -= 1
                for future in futures:
                    # An ended job has a result soon after it has said so; of the others none is asked.
                    if future.done():
                        future.result()
            return [future.result() for future in futures]
        except BaseException:
            stopped.set()
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _named(progress: Progress, what: str) -> Callable[[float], None]:
    return lambda share: progress(what, share)
