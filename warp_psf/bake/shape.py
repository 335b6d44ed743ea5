"""Shapes apart from their size and place: what is baked of a mesh belongs to all of its scaled copies.

Shells, rays and thresholds go by the bounding sphere, and vectors are functions of direction. Meshes are therefore
baked as their copy with bounding radius 1 about the origin; only a field's centre and radius are put back afterwards.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from warp_psf.field.store import store_key
from warp_psf.scene.mesh import Mesh

# How far apart a coordinate of two meshes of one shape may be, in bounding radii, and a component of their normals:
# what float32 leaves of scaling and moving a mesh, and far less than a field can tell.
SAME_SHAPE = 1.0e-5
# Moments of a shape that are this far apart make another key. Rounding, a thousandth of it, parts two copies now and
# then, which costs a bake; two shapes that share a key are told apart by their vertices.
MOMENT_STEP = 2.0**-13


def unit_shape(mesh: Mesh) -> Mesh:
    """The mesh scaled and moved to bounding radius 1 about the origin."""
    vertices = ((mesh.vertices - mesh.center) / mesh.radius).astype(np.float32)
    sphere = None if mesh.sphere is None else mesh.sphere / mesh.radius
    return replace(mesh, vertices=vertices, center=np.zeros(3), radius=1.0, sphere=sphere)


def shape_key(settings: dict, unit: Mesh, *arrays: np.ndarray) -> str:
    """A name for the result of baking a unit shape with `settings` and `arrays`, the same for all copies of it."""
    vertices, normals = unit.vertices.astype(np.float64), unit.normals.astype(np.float64)
    # Weights that tell apart which vertex is where, so that a shape and its mirror image differ.
    turns = np.cos(np.arange(len(vertices)))
    moments = [vertices.T @ vertices, vertices.sum(axis=0), turns @ vertices, turns @ normals]
    rounded = np.rint(np.concatenate([np.ravel(moment) for moment in moments]) / (len(vertices) * MOMENT_STEP))
    return store_key(settings, unit.faces, rounded.astype(np.int64), *arrays)


def surface_of(unit: Mesh) -> np.ndarray:
    """What is kept of a shape beside what was baked of it: vertices and normals, float32 [vertices, 6]."""
    return np.concatenate([unit.vertices, unit.normals], axis=1)


def is_same_shape(surface: np.ndarray, unit: Mesh) -> bool:
    """Whether a kept surface, [vertices, 6], is that of the mesh."""
    return bool((np.abs(surface - surface_of(unit)) <= SAME_SHAPE).all())
