"""Bodies that deform: skins and flexes, whose vertices are where each frame has them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warp_psf.scene.fit import bounding_sphere
from warp_psf.scene.mesh import Mesh
from warp_psf.scene.scene import Entity, Part
from warp_psf.scene.topology import area_vectors


@dataclass(frozen=True, eq=False)
class DeformingShape:
    """A body that deforms, as it is in the model's initial state; its faces stay, its vertices move.

    name: what messages call it.
    part: its look, and MuJoCo's id and type.
    opacity: the share of light that it stops, in (0, 1].
    vertices, normals: of the surface that is seen, in the world, metres and unit, float32 [V, 3].
    faces: of that, int32 [F, 3].
    texture_coordinates: (s, t) of each face's corners, float32 [F, 3, 2], or None.
    blocker_vertices: of the surface that hides the body from itself, no two of which are one point, float32 [B, 3].
    blocker_faces: of that, int32 [G, 3]. An open surface hides on both sides.
    blocker_of: the blocker vertex that each seen vertex belongs to, int32 [V].
    """

    name: str
    part: Part
    opacity: float
    vertices: np.ndarray
    normals: np.ndarray
    faces: np.ndarray
    texture_coordinates: np.ndarray | None
    blocker_vertices: np.ndarray
    blocker_faces: np.ndarray
    blocker_of: np.ndarray

    @property
    def casts(self) -> bool:
        """Whether it has a surface that spheres can be fitted to."""
        return bool(np.isfinite(self.vertices).all() and area_vectors(self.vertices, self.faces).any())


@dataclass(frozen=True, eq=False)
class Deformed:
    """A deforming body in one state, in the world; the arrays as in its `DeformingShape`."""

    vertices: np.ndarray
    normals: np.ndarray
    blocker_vertices: np.ndarray


def make_entity(shape: DeformingShape, mesh: int, part: Part) -> tuple[Mesh, Entity]:
    """The mesh, and the entity that is seen of it. mesh: its index in the scene. part: with its texture there."""
    center, radius = bounding_sphere(shape.vertices.astype(np.float64))
    surface = Mesh(
        name=shape.name,
        vertices=shape.vertices,
        faces=shape.faces,
        normals=shape.normals,
        slab=None,
        sphere=None,
        convex=False,
        closed=False,
        center=center,
        radius=radius,
    )
    given = shape.texture_coordinates
    return surface, Entity(shape.name, mesh, (part,), None, given, shape.opacity, casts=False)
