"""Everything that the bodies of a scene need baked, each shape once."""

from __future__ import annotations

from collections.abc import Callable

from warp_psf.bake.body import bake_mesh
from warp_psf.bake.kept import BakedBody
from warp_psf.bake.radiance import BakedRadiance, bake_radiance
from warp_psf.scene.detail import refine_radiating
from warp_psf.scene.mesh import Mesh
from warp_psf.scene.scene import Scene

# Boxes whose shortest side is less than this share of the longest are floors, walls and beams: shells around their
# centre would serve badly what lies on them, so that their light leaves through textured faces instead.
THICK = 0.25
Progress = Callable[[str, float], None]


def is_patch(mesh: Mesh) -> bool:
    """Whether light leaves a shape through textured faces: what is flat or long, unlike a die."""
    return mesh.slab is not None and mesh.slab[2].min() < THICK * mesh.slab[2].max()


def bake_bodies(scene: Scene, casts: list[bool], order: int, device: str, progress: Progress) -> list[BakedBody]:
    """The baked body of every mesh; one that no entity casts a shadow with needs nothing.

    casts: per entity whether it casts shadows: area lights do not. progress: called as progress(what, share).
    """
    casters = {entity.mesh for entity, casting in zip(scene.entities, casts, strict=True) if casting}
    return [
        bake_mesh(mesh, order, device=device, progress=_named(progress, f"baking {mesh.name}"))
        if index in casters
        else BakedBody(None, None, None)
        for index, mesh in enumerate(scene.meshes)
    ]


def bake_light(
    scene: Scene, casts: list[bool], order: int, functions: int, device: str, progress: Progress
) -> tuple[list[tuple[Mesh, BakedRadiance] | None], list[bool]]:
    """What is baked of the light that leaves each entity, with the mesh whose vertices carry it; and who is a patch.

    casts, progress: as in `bake_bodies`. functions: basis functions per body. Patches and lights have None.
    """
    radiating: dict[int, tuple[Mesh, BakedRadiance]] = {}
    for index, shape in enumerate(scene.meshes):
        used = any(entity.mesh == index and casting for entity, casting in zip(scene.entities, casts, strict=True))
        if used and not is_patch(shape):
            mesh = refine_radiating(shape)
            report = _named(progress, f"baking light of {mesh.name}")
            radiating[index] = mesh, bake_radiance(mesh, order, functions, device=device, progress=report)
    pairs = list(zip(scene.entities, casts, strict=True))
    return (
        [radiating.get(entity.mesh) if casting else None for entity, casting in pairs],
        [casting and is_patch(scene.meshes[entity.mesh]) for entity, casting in pairs],
    )


def _named(progress: Progress, what: str) -> Callable[[float], None]:
    return lambda share: progress(what, share)
