"""What has no rigid shape: cords, skins, soft bodies and marks, as one mesh that is made anew in every frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warp_psf.scene.material import Material
from warp_psf.scene.mesh import Mesh
from warp_psf.scene.scene import Entity, Part
from warp_psf.scene.topology import area_vectors


@dataclass(frozen=True, eq=False)
class Loose:
    """Everything without a rigid shape in one state, in the world's frame.

    vertices: metres, float32 [V, 3]. normals: unit, float32 [V, 3]. faces: int32 [F, 3].
    face_part: which part each face belongs to, int32 [F].
    parts: what the viewer tells apart.
    first_vertex: where each part's vertices begin, and where the last one's end, int [parts + 1].
    deforming: per part whether it is a body that deforms and casts shadows (a skin or a flex), bool.
    """

    vertices: np.ndarray
    normals: np.ndarray
    faces: np.ndarray
    face_part: np.ndarray
    parts: tuple[Part, ...]
    first_vertex: np.ndarray
    deforming: np.ndarray

    def deforming_keys(self) -> list[tuple[str, int]]:
        """Of each deforming body its name and how many vertices it has: those of another number are another body."""
        counts = np.diff(self.first_vertex)
        return [(self.parts[index].name, int(counts[index])) for index in np.flatnonzero(self.deforming)]

    def vertices_of(self, shape: DeformingShape) -> np.ndarray | None:
        """Where the vertices of a deforming body are now, [V, 3]; None when it is not shown."""
        for index, key in zip(np.flatnonzero(self.deforming), self.deforming_keys(), strict=True):
            if key == (shape.name, len(shape.vertices)):
                return self.vertices[slice(*self.first_vertex[index : index + 2])]
        return None


@dataclass(frozen=True, eq=False)
class DeformingShape:
    """A body that deforms, as it was when its room was made: metres, float32 [V, 3], and faces, int32 [F, 3]."""

    name: str
    vertices: np.ndarray
    faces: np.ndarray

    @property
    def casts(self) -> bool:
        """Whether it has a surface that spheres can be fitted to."""
        return bool(np.isfinite(self.vertices).all() and area_vectors(self.vertices, self.faces).any())


@dataclass(frozen=True)
class LooseRoom:
    """How much of it there is room for, and the deforming bodies that were in it so far."""

    vertices: int
    faces: int
    parts: int
    shapes: tuple[DeformingShape, ...]

    def holds(self, loose: Loose) -> bool:
        """Whether there is room for all of this, and every deforming body is known."""
        known = {(shape.name, len(shape.vertices)) for shape in self.shapes}
        if not known.issuperset(loose.deforming_keys()):
            return False
        sizes = len(loose.vertices), len(loose.faces), len(loose.parts)
        return all(size <= room for size, room in zip(sizes, (self.vertices, self.faces, self.parts), strict=True))


def make_room(loose: Loose, before: LooseRoom | None = None) -> LooseRoom:
    """Room for this and half as much again: tendons wrap around more or fewer things from frame to frame.

    before: a room that has become too small. Bodies that were in it keep the shape that they had when it was made.
    """
    shapes = {} if before is None else {(shape.name, len(shape.vertices)): shape for shape in before.shapes}
    for index, key in zip(np.flatnonzero(loose.deforming), loose.deforming_keys(), strict=True):
        start, end = loose.first_vertex[index : index + 2]
        faces = loose.faces[loose.face_part == index] - start
        shapes.setdefault(key, DeformingShape(key[0], loose.vertices[start:end], faces))
    sizes = (max(16, size + size // 2) for size in (len(loose.vertices), len(loose.faces), len(loose.parts)))
    return LooseRoom(*sizes, shapes=tuple(shapes.values()))


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
