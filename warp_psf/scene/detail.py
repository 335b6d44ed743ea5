"""Meshes fine enough to carry light at their vertices."""

from __future__ import annotations

import dataclasses

import numpy as np

from warp_psf.scene.mesh import Mesh, tessellate
from warp_psf.scene.scene import Scene

# Light on a large flat body changes over lengths like the bodies that stand on it. Its edges are cut to this share of
# their median radius: a contact shadow then falls on several vertices.
EDGE_PER_RADIUS = 1.0 / 4.0
# What leaves a convex body is followed at vertices this far apart at most, in bounding radii.
LIGHT_PER_RADIUS = 1.0 / 4.0
# A mesh gets at most about this many faces, whatever its size: an endless floor stays coarse.
MOST_FACES = 60_000


def refine_flat_bodies(scene: Scene) -> Scene:
    """The scene with its boxes and rectangles cut finely enough for shadows of the other bodies.

    Bodies with a shape of their own are left as they are: whoever made their mesh decided what it shows.
    """
    radii = [scene.meshes[entity.mesh].radius for entity in scene.entities if scene.meshes[entity.mesh].slab is None]
    if not radii:
        radii = [scene.meshes[entity.mesh].radius for entity in scene.entities]
    if not radii:
        return scene
    longest = EDGE_PER_RADIUS * float(np.median(radii))
    return dataclasses.replace(scene, meshes=tuple(_refine(mesh, longest) for mesh in scene.meshes))


def refine_radiating(mesh: Mesh) -> Mesh:
    """The mesh finely enough cut for light that varies over it; boxes become meshes like any other.

    Bodies that shadow themselves stay as they are: what is stored of that belongs to their own vertices.
    """
    if mesh.slab is None and not mesh.convex:
        return mesh
    return tessellate(dataclasses.replace(mesh, slab=None), LIGHT_PER_RADIUS * mesh.radius)


def _refine(mesh: Mesh, longest: float) -> Mesh:
    if mesh.slab is None:
        return mesh
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    # Halving edges until they fit leaves faces of about a quarter of the square of the longest edge.
    return tessellate(mesh, max(longest, 2.0 * np.sqrt(area / MOST_FACES)))
