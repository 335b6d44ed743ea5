"""Meshes fine enough to carry light at their vertices."""

from __future__ import annotations

import dataclasses

import numpy as np

from warp_psf.scene.mesh import Mesh, cut_faces, tessellate
from warp_psf.scene.scene import Entity, Scene

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
    refined = [_refine(mesh, longest) for mesh in scene.meshes]
    entities = [_follow(entity, scene.meshes[entity.mesh], *refined[entity.mesh]) for entity in scene.entities]
    return dataclasses.replace(scene, meshes=tuple(mesh for mesh, _ in refined), entities=tuple(entities))


def refine_radiating(mesh: Mesh) -> Mesh:
    """The mesh finely enough cut for light that varies over it; boxes become meshes like any other.

    Bodies that shadow themselves stay as they are: what is stored of that belongs to their own vertices.
    """
    if mesh.slab is None and not mesh.convex:
        return mesh
    return tessellate(dataclasses.replace(mesh, slab=None), LIGHT_PER_RADIUS * mesh.radius)


def _refine(mesh: Mesh, longest: float) -> tuple[Mesh, np.ndarray | None]:
    """The mesh, finer if it is flat, and which face each of its faces is a piece of; None where it stays."""
    if mesh.slab is None:
        return mesh, None
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    # Halving edges until they fit leaves faces of about a quarter of the square of the longest edge.
    return cut_faces(mesh, max(longest, 2.0 * np.sqrt(area / MOST_FACES)))


def _follow(entity: Entity, mesh: Mesh, finer: Mesh, origin: np.ndarray | None) -> Entity:
    """The entity with the texture coordinates of its mesh's pieces: those of the faces that they lie in."""
    if entity.texture_coordinates is None or origin is None:
        return entity
    a, b, c = mesh.vertices[mesh.faces[origin]].astype(np.float64).transpose(1, 0, 2)[:, :, None]
    normal = np.cross(b - a, c - a)
    squared = (normal * normal).sum(axis=2)
    p = finer.vertices[finer.faces]
    u = (np.cross(p - a, c - a) * normal).sum(axis=2) / squared
    v = (np.cross(b - a, p - a) * normal).sum(axis=2) / squared
    share = np.stack([1.0 - u - v, u, v], axis=2)
    coordinates = (share @ entity.texture_coordinates[origin]).astype(np.float32)
    return dataclasses.replace(entity, texture_coordinates=coordinates)
