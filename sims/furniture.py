"""What furnishes a room: procedural bodies as those of `sims.bodies`, standing on z = 0 and facing -y."""

from __future__ import annotations

import numpy as np

from sims.bodies import rounded_box
from sims.surfaces import Body, join, resample, revolve, rounded_path, sheet, smooth, tube

# Parts of one body reach into each other by this much, metres, so that no two surfaces fall together.
OVERLAP = 0.015


def sofa(width: float = 2.0, seats: int = 3, cells: int = 11, depth: float = 0.9, height: float = 0.8) -> Body:
    """Base, arms, back, and two cushions per seat; seats = 1 makes an armchair: (3 + 2 seats) (6 cells^2 + 2) + 386."""
    arm, back, seat_height = 0.2, 0.2, 0.27
    inner = width - 2 * arm
    front, rear = -depth / 2, depth / 2
    parts = [
        _cushion((-inner / 2 - OVERLAP, front + 0.04, 0.0), (inner / 2 + OVERLAP, rear - 0.03, seat_height), 0.03, 8),
        _cushion((-inner / 2 - OVERLAP, rear - back, 0.0), (inner / 2 + OVERLAP, rear, height), 0.07, cells),
    ]
    for side in (-1, 1):
        low, high = sorted((side * inner / 2, side * width / 2))
        parts.append(_cushion((low, front, 0.0), (high, rear - 0.02, 0.72 * height), 0.08, cells))
    share = inner / seats
    for seat in range(seats):
        left = -inner / 2 + seat * share
        low = left, front, seat_height - OVERLAP
        parts.append(_cushion(low, (left + share, rear - back + OVERLAP, seat_height + 0.17), 0.07, cells))
        low = left + 0.01, rear - back - 0.17, seat_height + 0.16
        vertices, faces = _cushion(low, (left + share - 0.01, rear - back + OVERLAP, height + 0.04), 0.07, cells)
        parts.append((_lean(vertices, 0.16, (rear - back, seat_height + 0.16)), faces))
    return join(*parts)


def coffee_table(radius: float = 0.5, height: float = 0.4) -> Body:
    """A round top on four splayed legs: 4,010 vertices."""
    corners = np.array([[0, height - 0.045], [radius, height - 0.045], [radius, height], [0, height]])
    top = revolve(resample(rounded_path(corners, 0.018), 42, bend=0.4), 72)
    legs = []
    for angle in np.arange(4) * np.pi / 2 + np.pi / 4:
        out = np.array([np.cos(angle), np.sin(angle), 0.0])
        path = np.linspace([0.6 * radius, 0, height - 0.02], [0.82 * radius, 0, 0.0], 20)
        path = path[:, :1] * out + path[:, 2:] * [0, 0, 1]
        legs.append(tube(path, np.linspace(0.03, 0.018, 20), 14))
    # A tube ends across its axis: the feet are cut level instead.
    legs = [(np.maximum(vertices, [-np.inf, -np.inf, 0.0]), faces) for vertices, faces in legs]
    return join(top, *legs)


def floor_lamp(height: float = 1.6, rings: int = 90, segments: int = 40) -> Body:
    """A lamp whose shade is open below, one body of revolution: rings * segments + 2 vertices."""
    pole, wall, shade = 0.016, 0.012, height - 0.34
    outline = [
        [0, 0],
        [0.15, 0],
        [0.15, 0.03],
        [pole, 0.05],
        [pole, height - 0.06],
        [0.13, height - 0.03],
        [0.22, shade],
        [0.22 + wall, shade],
        [0.14, height],
        [0, height],
    ]
    return revolve(resample(rounded_path(np.array(outline), 0.01), rings + 2, bend=0.35), segments)


def potted_plant(leaves: int = 11, height: float = 1.0) -> Body:
    """Arching leaves in a round pot: 1,922 + 326 leaves vertices."""
    corners = [[0, 0], [0.13, 0], [0.18, 0.3], [0.155, 0.3], [0.15, 0.26], [0, 0.26]]
    parts = [revolve(resample(rounded_path(np.array(corners), 0.012), 42, bend=0.4), 48)]
    for leaf in range(leaves):
        # Successive leaves are a golden angle apart, the later ones steeper.
        share = leaf / (leaves - 1)
        parts.append(_leaf(leaf * 2.39996, height - 0.25, reach=0.44 - 0.3 * share, lift=0.62 + 0.38 * share))
    return join(*parts)


def _cushion(low: tuple, high: tuple, radius: float, cells: int) -> Body:
    """A rounded box between two corners."""
    half = np.subtract(high, low) / 2
    vertices, faces = rounded_box(tuple(half), radius, cells)
    return vertices + np.add(high, low) / 2, faces


def _lean(vertices: np.ndarray, angle: float, hinge: tuple[float, float]) -> np.ndarray:
    """Turns `vertices` about the line y, z = `hinge` by `angle` radians, the top backwards."""
    y, z = vertices[:, 1] - hinge[0], vertices[:, 2] - hinge[1]
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.stack([vertices[:, 0], hinge[0] + cosine * y + sine * z, hinge[1] + cosine * z - sine * y], axis=1)


def _leaf(turn: float, length: float, reach: float, lift: float, rings: int = 27, sides: int = 12) -> Body:
    """A blade that leaves the soil upright and arches over: rings * sides + 2 vertices."""
    path = np.array(
        [[0.02, 0.24], [0.25 * reach, 0.24 + 0.6 * lift * length], [0.7 * reach, 0.24 + 0.95 * lift * length]]
    )
    path = resample(smooth(np.concatenate([path, [[1.15 * reach, 0.24 + 0.85 * lift * length]]])), rings + 2)
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    along = np.linspace(0, 1, rings + 2)
    half_width = 0.012 + 0.05 * np.sin(np.pi * along**0.8) ** 0.8
    angle = np.arange(sides) * 2 * np.pi / sides
    across, thick = half_width[1:-1, None] * np.cos(angle), 0.006 * np.sin(angle)[None]
    normal = np.stack([-tangent[1:-1, 1], tangent[1:-1, 0]], axis=1)
    plane = path[1:-1, None] + thick[..., None] * normal[:, None]
    points = np.stack([plane[..., 0], across, plane[..., 1]], axis=-1)
    ends = [np.array([end[0], 0.0, end[1]]) for end in path[[0, -1]]]
    vertices, faces = sheet(points, tuple(ends))
    cosine, sine = np.cos(turn), np.sin(turn)
    return vertices @ np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]]), faces
