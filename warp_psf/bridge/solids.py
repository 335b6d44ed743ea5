"""Coarse shapes for cords and marks, a few pixels wide: vertices, normals [V, 3] and faces [F, 3] of each."""

from __future__ import annotations

from functools import cache

import numpy as np

Surface = tuple[np.ndarray, np.ndarray, np.ndarray]
# Sides of what is round, and rings from the equator of a round end to its pole.
SIDES, RINGS = 16, 4


def capsule(radius: float, half_length: float) -> Surface:
    """Along z; a sphere where the half length is 0."""
    vertices, normals, faces = _unit_capsule()
    ends = np.sign(vertices[:, 2]) * half_length
    return radius * vertices + np.stack([0.0 * ends, 0.0 * ends, ends], axis=1), normals, faces


def rod(radius: float, low: float, high: float) -> Surface:
    """A cylinder along z with flat ends."""
    still = np.zeros(2)
    side = _lathe([radius, radius], [low, high], [1.0, 1.0], still)
    return join(
        side,
        _lathe([0.0, radius], [low, low], still, [-1.0, -1.0]),
        _lathe([radius, 0.0], [high, high], still, [1.0, 1.0]),
    )


def cone(radius: float, base: float, tip: float) -> Surface:
    """Along z, open at its base."""
    slope = np.array([abs(tip - base), radius * np.sign(tip - base)]) / np.hypot(tip - base, radius)
    vertices, normals, faces = _lathe([radius, 0.0], [base, tip], [slope[0]] * 2, [slope[1]] * 2)
    return vertices, normals, faces if tip > base else faces[:, ::-1]


def tube(a: np.ndarray, b: np.ndarray, radius: float) -> Surface:
    """A capsule from one point to another."""
    along = b - a
    length = float(np.linalg.norm(along))
    z = along / length if length > 0.0 else np.array((0.0, 0.0, 1.0))
    across = np.cross(z, np.eye(3)[np.abs(z).argmin()])
    across /= np.linalg.norm(across)
    return place(capsule(radius, 0.5 * length), 0.5 * (a + b), np.stack([across, np.cross(z, across), z], axis=1))


def cube() -> Surface:
    """The cube [-1, 1]^3."""
    faces = []
    for axis in range(3):
        for side in (1.0, -1.0):
            z = np.roll((side, 0.0, 0.0), axis)
            x = np.roll((0.0, 1.0, 0.0), axis)
            y = np.cross(z, x)
            corners = np.array((z - x - y, z + x - y, z + x + y, z - x + y))
            faces.append((corners, np.repeat(z[None], 4, axis=0), np.array(((0, 1, 2), (0, 2, 3)))))
    return join(*faces)


def wires(half_extents: np.ndarray, radius: float) -> Surface:
    """The edges of a box."""
    edges = []
    for axis in range(3):
        for u in (-1.0, 1.0):
            for v in (-1.0, 1.0):
                ends = [half_extents * np.roll((side, u, v), axis) for side in (-1.0, 1.0)]
                edges.append(tube(*ends, radius))
    return join(*edges)


def two_sided(corners: np.ndarray) -> Surface:
    """A flat convex polygon in the plane z = 0, [N, 3], counter-clockwise, seen from both sides."""
    fan = np.stack([np.zeros(len(corners) - 2), np.arange(1, len(corners) - 1), np.arange(2, len(corners))], axis=1)
    up = np.repeat(np.array(((0.0, 0.0, 1.0),)), len(corners), axis=0)
    return join((corners, up, fan.astype(int)), (corners, -up, fan[:, ::-1].astype(int)))


def faceted(vertices: np.ndarray, faces: np.ndarray) -> Surface:
    """A mesh whose faces keep corners of their own."""
    corners = vertices[faces].reshape(-1, 3)
    normals = np.cross(corners[1::3] - corners[0::3], corners[2::3] - corners[0::3])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    return corners, np.repeat(normals, 3, axis=0), np.arange(len(corners)).reshape(-1, 3)


def scaled(surface: Surface, size: np.ndarray) -> Surface:
    """Stretched along its axes; normals stay at right angles."""
    vertices, normals, faces = surface
    turned = normals / np.maximum(np.abs(size), 1e-9)
    return vertices * size, turned / np.linalg.norm(turned, axis=1, keepdims=True), faces


def place(surface: Surface, position: np.ndarray, rotation: np.ndarray) -> Surface:
    """Brought from its own frame to the world's."""
    vertices, normals, faces = surface
    return vertices @ rotation.T + position, normals @ rotation.T, faces


def join(*surfaces: Surface) -> Surface:
    """Several as one."""
    counts = np.array([len(vertices) for vertices, _, _ in surfaces])
    starts = np.cumsum(counts) - counts
    return (
        np.concatenate([vertices for vertices, _, _ in surfaces]),
        np.concatenate([normals for _, normals, _ in surfaces]),
        np.concatenate([faces + start for (_, _, faces), start in zip(surfaces, starts, strict=True)]),
    )


@cache
def _unit_capsule() -> Surface:
    """Two half spheres of radius 1 and a band between them, all at z = 0."""
    latitude = np.linspace(0.0, np.pi / 2, RINGS + 1)
    # The smallest step from 0 tells the upper rim of the band from the lower.
    latitude[0] = 1e-6
    angles = np.concatenate([-latitude[::-1], latitude])
    out, up = np.cos(angles), np.sin(angles)
    return _lathe(out, up, out, up)


def _lathe(distance, height, out, up) -> Surface:
    """A profile turned around z, from below to above: its points and its normals."""
    turns = 2.0 * np.pi * np.arange(SIDES) / SIDES
    circle = np.stack([np.cos(turns), np.sin(turns)], axis=1)

    def spin(along, upward) -> np.ndarray:
        rings = np.asarray(along, float)[:, None, None] * circle
        return np.concatenate(
            [rings, np.broadcast_to(np.asarray(upward, float)[:, None, None], (*rings.shape[:2], 1))], 2
        )

    first = (np.arange(len(distance) - 1)[:, None] * SIDES + np.arange(SIDES)).ravel()
    after = (np.arange(len(distance) - 1)[:, None] * SIDES + (np.arange(SIDES) + 1) % SIDES).ravel()
    faces = np.concatenate(
        [np.stack([first, after, after + SIDES], 1), np.stack([first, after + SIDES, first + SIDES], 1)]
    )
    return spin(distance, height).reshape(-1, 3), spin(out, up).reshape(-1, 3), faces
