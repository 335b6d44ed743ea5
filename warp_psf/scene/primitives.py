"""Tessellated primitives, centred and along z as MuJoCo's geoms, fine enough for shading at the vertices."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from warp_psf.scene.mesh import Mesh, make_mesh

# Segments around the axis of a capsule or cylinder; rings are spaced to give cells about as high as wide.
SEGMENTS = 48
# A long body gets longer cells rather than more rings than this along its side.
MOST_RINGS = 40
# Rings from the rim of a cylinder's cap to its centre, and from a capsule's equator to its pole.
CAP_RINGS = 10
POLE_RINGS = SEGMENTS // 4


def plane(half_x: float, half_y: float, cells: int = 64) -> Mesh:
    """A rectangle at z = 0 that faces +z, of 2 half_x by 2 half_y metres, with cells x cells squares.

    Raises:
        ValueError: a size is not positive.
    """
    _check_sizes("plane", (half_x, half_y), 2)
    _check_count("plane", "cells", cells)
    vertices, faces = _grid(cells)
    normals = np.broadcast_to([0.0, 0.0, 1.0], vertices.shape)
    return make_mesh("plane", vertices * [half_x, half_y, 0.0], faces, normals)


def box(half_extents: Sequence[float], cells: int = 12) -> Mesh:
    """A box of 2 half_extents [3] metres, each side with its own vertices and cells x cells rectangles.

    Raises:
        ValueError: a size is not positive.
    """
    half = _check_sizes("box", half_extents, 3)
    _check_count("box", "cells", cells)
    grid, grid_faces = _grid(cells)
    vertices, faces, normals = [], [], []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            # Cyclic axes keep the grid's winding; the far side swaps its first two to look the other way.
            side = np.empty_like(grid)
            u, v = ((axis + 1) % 3, (axis + 2) % 3) if sign > 0 else ((axis + 2) % 3, (axis + 1) % 3)
            side[:, u], side[:, v], side[:, axis] = grid[:, 0], grid[:, 1], sign
            faces.append(grid_faces + len(grid) * len(vertices))
            vertices.append(side * half)
            normals.append(np.broadcast_to(sign * np.eye(3)[axis], grid.shape))
    return make_mesh("box", np.concatenate(vertices), np.concatenate(faces), np.concatenate(normals))


def sphere(radius: float, subdivisions: int = 4) -> Mesh:
    """An icosahedron subdivided onto a sphere, metres: 10 * 4**subdivisions + 2 vertices.

    Raises:
        ValueError: the radius is not positive.
    """
    (size,) = _check_sizes("sphere", (radius,), 1)
    directions, faces = _icosphere(subdivisions)
    return make_mesh("sphere", size * directions, faces, directions)


def ellipsoid(radii: Sequence[float], subdivisions: int = 4) -> Mesh:
    """A stretched icosphere with the semi-axes `radii` [3], metres.

    Raises:
        ValueError: a radius is not positive.
    """
    size = _check_sizes("ellipsoid", radii, 3)
    directions, faces = _icosphere(subdivisions)
    return make_mesh("ellipsoid", size * directions, faces, directions / size)


def capsule(radius: float, half_length: float) -> Mesh:
    """A cylinder along z of 2 half_length metres with a half sphere on either end.

    Raises:
        ValueError: a size is not positive.
    """
    _check_sizes("capsule", (radius, half_length), 2)
    latitude = np.linspace(0.0, np.pi / 2, POLE_RINGS + 1)
    height = _side_heights(radius, half_length)
    out = np.concatenate([np.cos(latitude[:0:-1]), np.ones(len(height)), np.cos(latitude[1:])])
    up = np.concatenate([-np.sin(latitude[:0:-1]), np.zeros(len(height)), np.sin(latitude[1:])])
    middle = np.concatenate([np.full(POLE_RINGS, -half_length), height, np.full(POLE_RINGS, half_length)])
    return make_mesh("capsule", *_revolve(radius * out, middle + radius * up, out, up))


def cylinder(radius: float, half_length: float) -> Mesh:
    """A cylinder along z of 2 half_length metres with flat caps, whose rims have split vertices.

    Raises:
        ValueError: a size is not positive.
    """
    _check_sizes("cylinder", (radius, half_length), 2)
    height = _side_heights(radius, half_length)
    spread = np.linspace(0.0, radius, CAP_RINGS + 1)
    still, up = np.zeros(len(spread)), np.ones(len(spread))
    parts = [
        _revolve(spread, -half_length * up, still, -up),
        _revolve(np.full(len(height), radius), height, np.ones(len(height)), np.zeros(len(height))),
        _revolve(spread[::-1], half_length * up, still, up),
    ]
    before = np.cumsum([0, *(len(part[0]) for part in parts)])
    vertices, normals = (np.concatenate([part[i] for part in parts]) for i in (0, 2))
    faces = np.concatenate([part[1] + shift for part, shift in zip(parts, before[:-1], strict=True)])
    return make_mesh("cylinder", vertices, faces, normals)


def _check_sizes(name: str, sizes, count: int) -> np.ndarray:
    values = np.asarray(sizes, dtype=np.float64)
    if values.shape != (count,) or not np.isfinite(values).all() or (values <= 0.0).any():
        raise ValueError(f"{name}: the sizes are {np.asarray(sizes).tolist()}; give {count} positive lengths in metres")
    return values


def _check_count(name: str, what: str, count: int) -> None:
    if count < 1:
        raise ValueError(f"{name}: {what} is {count}; it must be at least 1")


def _grid(cells: int) -> tuple[np.ndarray, np.ndarray]:
    """The square [-1, 1]^2 at z = 0, seen from +z: vertices [(cells + 1)^2, 3] and faces [2 cells^2, 3]."""
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, cells + 1), np.linspace(-1.0, 1.0, cells + 1))
    first = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    right, above = first + 1, first + cells + 1
    faces = np.stack([first, right, above + 1, first, above + 1, above], axis=1).reshape(-1, 3)
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1), faces


def _icosphere(subdivisions: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit directions [V, 3] and faces [20 * 4**subdivisions, 3]."""
    if subdivisions < 0:
        raise ValueError(f"icosphere: subdivisions is {subdivisions}; it must be at least 0")
    golden = (1.0 + np.sqrt(5.0)) / 2.0
    corners = [(s, t * golden, 0.0) for t in (1, -1) for s in (-1, 1)]
    points = np.array([np.roll(corner, turn) for turn in range(3) for corner in corners])
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)
    # The faces are the triples of corners that are all one edge (2) apart.
    near = np.abs(apart - 2.0) < 1e-6
    faces = np.array(
        [
            (a, b, c) if np.linalg.det(points[[a, b, c]]) > 0.0 else (a, c, b)
            for a in range(12)
            for b in range(a + 1, 12)
            for c in range(b + 1, 12)
            if near[a, b] and near[b, c] and near[a, c]
        ]
    )
    points /= np.linalg.norm(points[0])
    for _ in range(subdivisions):
        ends = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2), axis=2).reshape(-1, 2)
        edges, edge = np.unique(ends, axis=0, return_inverse=True)
        middle = points[edges].sum(axis=1)
        p, q, r = (len(points) + edge.reshape(-1, 3)).T
        points = np.concatenate([points, middle / np.linalg.norm(middle, axis=1, keepdims=True)])
        a, b, c = faces.T
        faces = np.stack([a, p, r, p, b, q, r, q, c, p, q, r], axis=1).reshape(-1, 3)
    return points, faces


def _side_heights(radius: float, half_length: float) -> np.ndarray:
    cell = 2.0 * np.pi * radius / SEGMENTS
    rings = int(np.clip(np.ceil(2.0 * half_length / cell), 1, MOST_RINGS))
    return np.linspace(-half_length, half_length, rings + 1)


def _revolve(distance: np.ndarray, height: np.ndarray, normal_out: np.ndarray, normal_up: np.ndarray):
    """A profile [N], from bottom to top, turned about z: vertices, faces, normals.

    A first or last ring of no radius becomes one vertex.
    """
    angle = 2.0 * np.pi * np.arange(SEGMENTS) / SEGMENTS
    around = np.stack([np.cos(angle), np.sin(angle), np.zeros(SEGMENTS)], axis=1)
    axis = np.array([0.0, 0.0, 1.0])
    tiny = 1e-9 * distance.max()
    vertices, normals, rings = [], [], []
    count = 0
    for r, z, out, up in zip(distance, height, normal_out, normal_up, strict=True):
        points = around if r > tiny else around[:1]
        vertices.append(r * points + z * axis if r > tiny else (z * axis)[None])
        normals.append(out * points + up * axis if r > tiny else (np.sign(up) * axis)[None])
        rings.append(count + np.arange(SEGMENTS) % len(points))
        count += len(points)
    lower, upper = np.stack(rings[:-1]).ravel(), np.stack(rings[1:]).ravel()
    lower_next = np.stack([np.roll(ring, -1) for ring in rings[:-1]]).ravel()
    upper_next = np.stack([np.roll(ring, -1) for ring in rings[1:]]).ravel()
    faces = np.concatenate(
        [np.stack([lower, lower_next, upper_next], axis=1), np.stack([lower, upper_next, upper], axis=1)]
    )
    proper = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    return np.concatenate(vertices), faces[proper], np.concatenate(normals)
