"""Chess pieces of the common pattern, turned on a lathe and carved; each stands on z = 0 about the z axis.

Every function returns closed surfaces as those of `sims.bodies` do. Lengths inside are in sides of a field.
"""

from __future__ import annotations

import numpy as np

from sims.bodies import rounded_box
from sims.surfaces import Body, around, join, resample, rounded_path, sheet, smooth

# Metres: the side of a field. A set for the garden, whose pieces fall slowly enough to watch.
FIELD = 0.2
# Radii of the feet, fields.
FOOT = {"king": 0.37, "queen": 0.36, "bishop": 0.31, "knight": 0.33, "rook": 0.33, "pawn": 0.28}
# The knight from its foot to its nose: back x and z, front x and z, and half its width, fields. It faces +x.
_HORSE = (
    (-0.2, 0.25, 0.22, 0.25, 0.2),
    (-0.24, 0.36, 0.24, 0.38, 0.19),
    (-0.28, 0.5, 0.2, 0.5, 0.165),
    (-0.29, 0.64, 0.11, 0.61, 0.14),
    (-0.27, 0.78, 0.06, 0.68, 0.125),
    (-0.22, 0.92, 0.075, 0.69, 0.12),
    (-0.13, 1.04, 0.11, 0.67, 0.125),
    (-0.02, 1.1, 0.16, 0.645, 0.125),
    (0.08, 1.06, 0.21, 0.62, 0.11),
    (0.17, 0.96, 0.26, 0.595, 0.095),
    (0.26, 0.86, 0.31, 0.575, 0.08),
    (0.34, 0.76, 0.355, 0.56, 0.07),
    (0.395, 0.68, 0.39, 0.57, 0.05),
)
_NOSE = (0.41, 0.62)
# The benchmark's scene: 1,897 vertices and 3,704 triangles, those of the chess scene of Kautz 2004, Table 1.
_BENCHMARK_CELLS, _BENCHMARK_RINGS, _BENCHMARK_SEGMENTS = 16, 19, 14
_BENCHMARK_PLACES = {
    "king": (4.5, 4.5),
    "queen": (3.5, 3.5),
    "bishop": (5.5, 3.5),
    "knight": (2.5, 4.5),
    "rook": (4.5, 2.5),
    "pawn": (3.5, 5.5),
}


def king(rings: int = 64, segments: int = 48) -> Body:
    """A king with a cross: rings * segments + 390 vertices."""
    upright = rounded_box((0.022, 0.036, 0.095), 0.012, 4)
    beam = rounded_box((0.022, 0.08, 0.03), 0.012, 4)
    parts = [_stuck_on(upright, (0.0, 0.0, 1.6)), _stuck_on(beam, (0.0, 0.0, 1.615))]
    return join(turned("king", rings, segments), *parts)


def queen(rings: int = 64, segments: int = 48) -> Body:
    """A queen with a coronet: rings * segments + 2 vertices."""
    return turned("queen", rings, segments)


def bishop(rings: int = 64, segments: int = 48) -> Body:
    """A bishop with a cleft mitre: rings * segments + 2 vertices."""
    return turned("bishop", rings, segments)


def rook(rings: int = 64, segments: int = 48) -> Body:
    """A rook with battlements: rings * segments + 2 vertices."""
    return turned("rook", rings, segments)


def pawn(rings: int = 48, segments: int = 40) -> Body:
    """A pawn: rings * segments + 2 vertices."""
    return turned("pawn", rings, segments)


def knight(rings: int = 64, segments: int = 40) -> Body:
    """A knight with ears: rings * segments + 198 vertices."""
    vertices, faces = rounded_box((0.05, 0.036, 0.12), 0.034, 4)
    # Pointed, and leaning back a little.
    vertices = vertices * (1 - 5 * np.maximum(vertices[:, 2:], 0)) ** [1, 1, 0]
    vertices[:, 0] -= 0.15 * vertices[:, 2]
    ears = [_stuck_on((vertices, faces), (-0.07, side * 0.06, 1.06)) for side in (-1, 1)]
    return join(carved_horse(rings, segments), *ears)


def turned(kind: str, rings: int, segments: int) -> Body:
    """A piece without parts stuck on: rings * segments + 2 vertices. kind: of `FOOT`, but for the knight."""
    profile = resample(_OUTLINES[kind](), rings + 2, bend=0.45)
    angle = np.arange(segments) * 2 * np.pi / segments
    points = around(profile[1:-1, :1], profile[1:-1, 1:], angle)
    if kind in _CARVINGS:
        points = _CARVINGS[kind](points, angle)
    return sheet(FIELD * points, (FIELD * profile[0, 1], FIELD * profile[-1, 1]))


def carved_horse(rings: int, segments: int) -> Body:
    """A knight without its ears: rings * segments + 2 vertices."""
    foot = _foot(FOOT["knight"])
    round_rows = np.stack([-foot[:, 0], foot[:, 1], foot[:, 0], foot[:, 1], foot[:, 0]], axis=1)
    rows = resample(np.concatenate([round_rows, smooth(np.array(_HORSE))]), rings + 1, bend=0.3)[1:]
    back, front, half_width = rows[:, None, 0:2], rows[:, None, 2:4], rows[:, None, 4]
    angle = np.arange(segments) * 2 * np.pi / segments
    along = (1 + np.cos(angle)) / 2
    plane = back + along[:, None] * (front - back)
    # Narrower towards the back: the mane. The foot stays round.
    carved = np.clip((rows[:, None, 1] - 0.3) / 0.2, 0, 1)
    y = half_width * np.sin(angle) * (1 - 0.4 * carved * (1 - along) ** 2)
    points = np.stack([plane[..., 0], y, plane[..., 1]], axis=-1)
    return sheet(FIELD * points, ((0, 0, 0), (FIELD * _NOSE[0], 0, FIELD * _NOSE[1])))


def benchmark_set() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A coarse board with six pieces as one mesh: vertices [1897, 3] in metres, faces [3704, 3], part of vertex [1897].

    Part 0 is the board, an open sheet at z = 0; parts 1 to 6 are closed, and stand on it.
    """
    line = np.linspace(0, 8 * FIELD, _BENCHMARK_CELLS + 1)
    x, y = np.meshgrid(line, line, indexing="ij")
    corner = np.arange(x.size).reshape(x.shape)
    a, b, c, d = (part.ravel() for part in (corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]))
    board = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3)
    parts = [(board, np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]).astype(np.int32))]
    for kind, place in _BENCHMARK_PLACES.items():
        size = _BENCHMARK_RINGS, _BENCHMARK_SEGMENTS
        vertices, faces = carved_horse(*size) if kind == "knight" else turned(kind, *size)
        parts.append((vertices + FIELD * np.array([*place, 0.0]), faces))
    vertices, faces = join(*parts)
    return vertices, faces, np.repeat(np.arange(len(parts)), [len(part) for part, _ in parts]).astype(np.int32)


def _stuck_on(part: Body, place: tuple[float, float, float]) -> Body:
    return FIELD * np.add(part[0], place), part[1]


def _foot(radius: float) -> np.ndarray:
    """The outline that all pieces begin with: a disc, a groove and the start of the stem."""
    corners = [[0, 0], [1, 0], [1, 0.07], [0.93, 0.1], [0.95, 0.15], [0.75, 0.2], [0.66, 0.25]]
    return rounded_path(np.array(corners) * [radius, 1], 0.02)


def _collar(radius: float, height: float) -> np.ndarray:
    corners = [[0.55, -0.05], [1, -0.01], [1, 0.035], [0.62, 0.07]]
    return rounded_path(np.array(corners) * [radius, 1] + [0, height], 0.015)


def _stem(*points: tuple[float, float]) -> np.ndarray:
    return smooth(np.array(points))


def _cap(radius: float, height: float, start: float) -> np.ndarray:
    """A ball on the axis, from the angle `start` above its equator to its top."""
    turn = np.linspace(start, np.pi / 2, 40)
    return np.stack([radius * np.cos(turn), height + radius * np.sin(turn)], axis=1)


def _pawn_outline() -> np.ndarray:
    stem = _stem((0.17, 0.28), (0.12, 0.38), (0.1, 0.5))
    return np.concatenate([_foot(FOOT["pawn"]), stem, _collar(0.18, 0.56), _cap(0.15, 0.735, -0.85)])


def _rook_outline() -> np.ndarray:
    stem = _stem((0.21, 0.29), (0.18, 0.4), (0.17, 0.6))
    tower = [[0.2, 0.63], [0.26, 0.68], [0.26, 0.94], [0.18, 0.94], [0.18, 0.83], [0.0, 0.83]]
    return np.concatenate([_foot(FOOT["rook"]), stem, rounded_path(np.array(tower), 0.015)])


def _bishop_outline() -> np.ndarray:
    stem = _stem((0.19, 0.28), (0.125, 0.42), (0.1, 0.66))
    mitre = _stem((0.12, 0.77), (0.165, 0.85), (0.17, 0.93), (0.12, 1.05), (0.045, 1.14))
    return np.concatenate([_foot(FOOT["bishop"]), stem, _collar(0.2, 0.71), mitre, _cap(0.05, 1.17, -0.5)])


def _queen_outline() -> np.ndarray:
    stem = _stem((0.22, 0.28), (0.15, 0.45), (0.115, 0.85))
    crown = _stem((0.135, 0.98), (0.145, 1.08), (0.18, 1.22), (0.245, 1.36))
    inside = rounded_path(np.array([[0.245, 1.36], [0.205, 1.375], [0.16, 1.34], [0.05, 1.4]]), 0.015)
    return np.concatenate([_foot(FOOT["queen"]), stem, _collar(0.22, 0.91), crown, inside, _cap(0.055, 1.44, -0.6)])


def _king_outline() -> np.ndarray:
    stem = _stem((0.23, 0.28), (0.155, 0.46), (0.12, 0.93))
    crown = _stem((0.14, 1.06), (0.15, 1.16), (0.18, 1.3), (0.225, 1.42))
    lid = rounded_path(np.array([[0.225, 1.42], [0.2, 1.46], [0.09, 1.5], [0.05, 1.53], [0, 1.54]]), 0.02)
    return np.concatenate([_foot(FOOT["king"]), stem, _collar(0.23, 0.99), crown, lid])


def _wave(angle: np.ndarray, count: int) -> np.ndarray:
    """A soft square wave from 0.06 to 1 that rises `count` times in a turn: what it scales never becomes flat."""
    return 0.53 + 0.47 * np.tanh(4 * np.cos(count * angle)) / np.tanh(4)


def _battlements(points: np.ndarray, angle: np.ndarray) -> np.ndarray:
    ground = 0.845
    height = points[..., 2]
    return np.dstack([points[..., :2], np.where(height > ground, ground + (height - ground) * _wave(angle, 6), height)])


def _coronet(points: np.ndarray, angle: np.ndarray) -> np.ndarray:
    # Only the rim is cut, the ball inside it is not.
    radius, height = np.hypot(points[..., 0], points[..., 1]), points[..., 2]
    rim = np.clip((height - 1.28) / 0.08, 0, 1) * np.clip((radius - 0.15) / 0.05, 0, 1)
    return np.dstack([points[..., :2], height - 0.05 * rim * (0.5 - 0.5 * np.cos(9 * angle))])


def _cleft(points: np.ndarray, angle: np.ndarray) -> np.ndarray:
    # A groove along a slanted plane, on the side that faces +x.
    x, height = points[..., 0], points[..., 2]
    beside = (height - 0.96 - 0.9 * (x - 0.1)) / 0.045
    depth = 0.4 * np.exp(-(beside**2)) * np.clip(x / 0.06, 0, 1) * (height < 1.13)
    return np.dstack([points[..., :2] * (1 - depth[..., None]), height])


_OUTLINES = {
    "king": _king_outline,
    "queen": _queen_outline,
    "bishop": _bishop_outline,
    "rook": _rook_outline,
    "pawn": _pawn_outline,
}
_CARVINGS = {"queen": _coronet, "bishop": _cleft, "rook": _battlements}
