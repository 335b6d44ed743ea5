"""Meshes that several tests use, and what is measured of them."""

import numpy as np

from warp_psf.scene.mesh import make_mesh
from warp_psf.scene.primitives import box, capsule, cylinder, ellipsoid, plane, sphere

CUBE_VERTICES = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float32)
CUBE_FACES = np.array(
    [
        *([0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]),
        *([2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]),
    ]
)
PRIMITIVES = [
    plane(2.0, 3.0),
    box((0.1, 0.2, 0.3)),
    sphere(0.3),
    ellipsoid((0.1, 0.2, 0.4)),
    capsule(0.1, 0.4),
    cylinder(0.1, 0.4),
]


def triangles(mesh):
    return mesh.vertices.astype(np.float64)[mesh.faces]


def area_vectors(mesh):
    corner = triangles(mesh)
    return 0.5 * np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])


def area(mesh):
    return np.linalg.norm(area_vectors(mesh), axis=1).sum()


def volume(mesh):
    """The divergence theorem: a third of the flux of the position."""
    return (area_vectors(mesh) * triangles(mesh)[:, 0]).sum() / 3.0


def rotation():
    matrix = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    return matrix * np.linalg.det(matrix)


def moved(mesh, shift=(0.3, -0.2, 0.7)):
    return make_mesh(mesh.name, mesh.vertices @ rotation().T + shift, mesh.faces)


def welded(mesh):
    return np.unique(mesh.vertices, axis=0, return_inverse=True)[1].reshape(-1)[mesh.faces]


def has_closed_edges(mesh):
    corners = welded(mesh)
    ends = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 2)
    forward, backward = (sorted(map(tuple, pairs)) for pairs in (ends, ends[:, ::-1]))
    return forward == backward and len(set(forward)) == len(forward)
