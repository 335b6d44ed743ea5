"""What has no lasting shape: cords and marks, as one mesh that is made anew in every frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warp_psf.scene.material import Material
from warp_psf.scene.mesh import Mesh
from warp_psf.scene.scene import Entity, Part


@dataclass(frozen=True, eq=False)
class Loose:
    """Everything without a lasting shape in one state, in the world's frame.

    vertices: metres, float32 [V, 3]. normals: unit, float32 [V, 3]. faces: int32 [F, 3].
    face_part: which part each face belongs to, int32 [F].
    parts: what the viewer tells apart.
    """

    vertices: np.ndarray
    normals: np.ndarray
    faces: np.ndarray
    face_part: np.ndarray
    parts: tuple[Part, ...]


@dataclass(frozen=True)
class LooseRoom:
    """How much of it there is room for."""

    vertices: int
    faces: int
    parts: int

    def holds(self, loose: Loose) -> bool:
        """Whether there is room for all of this."""
        sizes = len(loose.vertices), len(loose.faces), len(loose.parts)
        return all(size <= room for size, room in zip(sizes, (self.vertices, self.faces, self.parts), strict=True))


def make_room(loose: Loose) -> LooseRoom:
    """Room for this and half as much again: tendons wrap around more or fewer things from frame to frame."""
    sizes = (max(16, size + size // 2) for size in (len(loose.vertices), len(loose.faces), len(loose.parts)))
    return LooseRoom(*sizes)


def reserve(room: LooseRoom, mesh: int) -> tuple[Mesh, Entity]:
    """The mesh, all of its faces empty, and the entity that keep room in a scene; `mesh`: its index there."""
    nothing = Part("loose", Material(np.zeros(3), np.zeros(3), 0.0, np.zeros(3)), -1, 0)
    face_part = np.zeros(room.faces, np.int32)
    entity = Entity("loose", mesh, (nothing,) * room.parts, face_part=face_part, casts=False)
    shape = Mesh(
        name="loose",
        vertices=np.zeros((room.vertices, 3), np.float32),
        faces=np.zeros((room.faces, 3), np.int32),
        normals=np.zeros((room.vertices, 3), np.float32),
        slab=None,
        sphere=None,
        convex=False,
        closed=False,
        center=np.zeros(3),
        radius=0.0,
    )
    return shape, entity
