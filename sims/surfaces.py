"""Surfaces that the bodies are made of: revolved, swept along a curve, or the zero set of a function."""

from __future__ import annotations

import numpy as np

# Vertices float64 [V, 3] in metres, faces int32 [F, 3].
Body = tuple[np.ndarray, np.ndarray]

# Points of a curve before it is resampled: dense enough that its chords stay within micrometres of the curve.
DENSE = 2000


def implicit_surface(distance, low: np.ndarray, high: np.ndarray, cell: float) -> Body:
    """Surface nets of `distance(points [N, 3]) -> [N]`, negative inside, relaxed along the surface.

    low, high: corners of a box that holds the whole surface; cell: edge of a grid cube, metres.
    """
    shape = np.ceil((high - low) / cell).astype(int) + 1
    lattice = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1)
    inside = _fill_checkerboards((distance(low + cell * lattice.reshape(-1, 3)) < 0).reshape(shape))
    corners = sum(inside[_shifted(x, y, z)].astype(int) for x in (0, 1) for y in (0, 1) for z in (0, 1))
    active = (corners > 0) & (corners < 8)
    index = np.full(active.shape, -1)
    index[active] = np.arange(active.sum())
    vertices = low + cell * (np.argwhere(active) + 0.5)
    quads = np.concatenate([_quads_across(inside, index, axis) for axis in range(3)])
    # Relaxing evens the triangles out; projecting puts the vertices back on the surface.
    for _ in range(6):
        vertices = _project(distance, vertices, 0.05 * cell)
        total, count = np.zeros_like(vertices), np.zeros(len(vertices))
        for side in range(4):
            np.add.at(total, quads[:, side], vertices[quads[:, side - 1]] + vertices[quads[:, side - 3]])
            np.add.at(count, quads[:, side], 2)
        vertices = vertices + 0.6 * (total / count[:, None] - vertices)
    vertices = _project(distance, vertices, 0.05 * cell)
    diagonal = np.linalg.norm(vertices[quads[:, 0]] - vertices[quads[:, 2]], axis=1)
    other = np.linalg.norm(vertices[quads[:, 1]] - vertices[quads[:, 3]], axis=1)
    quads = np.where((diagonal <= other)[:, None], quads, np.roll(quads, 1, axis=1))
    return vertices, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype(np.int32)


def _fill_checkerboards(inside: np.ndarray) -> np.ndarray:
    """Fills corners until insides that touch only across a diagonal are joined.

    Surface nets have one vertex per cell. Where two sheets cross a cell, that vertex would pinch them together; without
    checkerboards on a cell's sides or along its diagonals, no cell has two.
    """
    inside = inside.copy()
    filled = -1
    while filled != inside.sum():
        filled = inside.sum()
        for axis in range(3):
            # Views: writing to a corner writes to `inside`.
            side = np.moveaxis(inside, axis, 0)
            a, b, c, d = side[:, :-1, :-1], side[:, 1:, 1:], side[:, 1:, :-1], side[:, :-1, 1:]
            checkered = ((a & b) & ~(c | d)) | ((c & d) & ~(a | b))
            for corner in (a, b, c, d):
                corner |= checkered
        corners = [inside[_shifted(x, y, z)] for x in (0, 1) for y in (0, 1) for z in (0, 1)]
        count = sum(corner.astype(int) for corner in corners)
        # Corners k and 7 - k are ends of a diagonal of the cell.
        for k in range(4):
            ends = corners[k].astype(int) + corners[7 - k]
            lone = ((count == 2) & (ends == 2)) | ((count == 6) & (ends == 0))
            for corner in corners:
                corner |= lone
    return inside


def _shifted(*steps: int) -> tuple[slice, ...]:
    """The corners of every cell that lie `steps` from its first corner."""
    return tuple(slice(1, None) if step else slice(None, -1) for step in steps)


def _quads_across(inside: np.ndarray, index: np.ndarray, axis: int) -> np.ndarray:
    """One quad for every grid edge along `axis` that crosses the surface, [quads, 4]."""
    u, v = (axis + 1) % 3, (axis + 2) % 3
    first = np.moveaxis(inside, (axis, u, v), (0, 1, 2))
    cells = np.moveaxis(index, (axis, u, v), (0, 1, 2))
    leaving, entering = first[:-1] & ~first[1:], ~first[:-1] & first[1:]
    around = np.stack([cells[:, :-1, :-1], cells[:, 1:, :-1], cells[:, 1:, 1:], cells[:, :-1, 1:]], axis=-1)
    inner = (slice(None), slice(1, -1), slice(1, -1))
    return np.concatenate([around[leaving[inner]], around[entering[inner]][:, ::-1]])


def _project(distance, points: np.ndarray, step: float) -> np.ndarray:
    for _ in range(2):
        gradient = np.stack([distance(points + d) - distance(points - d) for d in step * np.eye(3)], axis=1) / (
            2 * step
        )
        slope = np.maximum((gradient**2).sum(axis=1, keepdims=True), 0.25)
        points = points - distance(points)[:, None] * gradient / slope
    return points


def revolve(profile: np.ndarray, segments: int, closed: bool = False) -> Body:
    """A body of revolution about z.

    profile: radius and height, metres [K, 2], with the body on its left: the outside goes up. Open profiles begin and
        end on the axis, where one vertex closes them; `closed` ones are loops.
    """
    angle = np.arange(segments) * 2 * np.pi / segments
    if closed:
        return sheet(around(profile[:, :1], profile[:, 1:], angle), wrap=True)
    return sheet(around(profile[1:-1, :1], profile[1:-1, 1:], angle), (profile[0, 1], profile[-1, 1]))


def tube(path: np.ndarray, radii: np.ndarray, sides: int, closed: bool = False) -> Body:
    """A round tube along `path` [K, 3] of radii [K], metres: K * sides vertices, and two caps unless it is closed."""
    tangent = np.roll(path, -1, axis=0) - np.roll(path, 1, axis=0) if closed else np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    normal = np.empty_like(path)
    normal[0] = np.cross(tangent[0], np.eye(3)[np.argmin(np.abs(tangent[0]))])
    # Parallel transport: each normal is the last one without its part along the new tangent.
    for point in range(len(path)):
        carried = normal[max(point - 1, 0)]
        carried = carried - (carried @ tangent[point]) * tangent[point]
        normal[point] = carried / np.linalg.norm(carried)
    side = np.cross(tangent, normal)
    twist = np.zeros(len(path))
    if closed:
        # What transport around the loop has turned the frame by is undone evenly along it.
        last = normal[-1] - (normal[-1] @ tangent[0]) * tangent[0]
        twist = np.linspace(0, -np.arctan2(last @ side[0], last @ normal[0]), len(path), endpoint=False)
    angle = np.arange(sides) * 2 * np.pi / sides + twist[:, None]
    ring = np.cos(angle)[..., None] * normal[:, None] + np.sin(angle)[..., None] * side[:, None]
    points = path[:, None] + radii[:, None, None] * ring
    return sheet(points, wrap=True) if closed else sheet(points, (path[0], path[-1]))


def join(*parts: Body) -> Body:
    """Several closed parts as one body."""
    starts = np.cumsum([0] + [len(vertices) for vertices, _ in parts[:-1]])
    faces = [faces + start for (_, faces), start in zip(parts, starts, strict=True)]
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate(faces).astype(np.int32)


def around(radius: np.ndarray, height: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Rows of points [K, S, 3] at `radius` [K, 1 or S] and `height` [K, 1] about the z axis."""
    return np.stack(np.broadcast_arrays(radius * np.cos(angle), radius * np.sin(angle), height), axis=-1)


def sheet(points: np.ndarray, ends: tuple | None = None, wrap: bool = False) -> Body:
    """Triangles over rows of rings [K, S, 3]; the last row joins the first, or `ends` are the two closing points.

    An end is a point, or a height on the z axis.
    """
    rows, columns = points.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    index = np.concatenate([index, index[:1]]) if wrap else index
    a, b = index[:-1], np.roll(index, -1, axis=1)[:-1]
    d, c = index[1:], np.roll(index, -1, axis=1)[1:]
    faces = [np.stack([a, b, c], axis=-1).reshape(-1, 3), np.stack([a, c, d], axis=-1).reshape(-1, 3)]
    vertices = points.reshape(-1, 3)
    if ends is not None:
        first, last = index[0], index[-1]
        pole = np.full(columns, rows * columns)
        faces += [np.stack([pole, np.roll(first, -1), first], axis=-1)]
        faces += [np.stack([pole + 1, last, np.roll(last, -1)], axis=-1)]
        poles = [end if np.ndim(end) else (0.0, 0.0, end) for end in ends]
        vertices = np.concatenate([vertices, poles])
    return vertices, np.concatenate(faces).astype(np.int32)


def cube_lattice(cells: int) -> Body:
    """The surface of the cube [-1, 1]^3 as a lattice with shared edges: 6 cells^2 + 2 vertices."""
    grid = 2 * np.arange(cells + 1) - cells
    u, v = (part.ravel() for part in np.meshgrid(grid, grid, indexing="ij"))
    points, quads = [], []
    corner = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
    quad = np.stack([corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]], axis=-1).reshape(-1, 4)
    for axis in range(3):
        for sign in (-1, 1):
            face = np.empty((len(u), 3), int)
            face[:, axis], face[:, (axis + 1) % 3], face[:, (axis + 2) % 3] = sign * cells, u, v
            quads.append((quad if sign > 0 else quad[:, ::-1]) + sum(map(len, points)))
            points.append(face)
    lattice, shared = np.unique(np.concatenate(points), axis=0, return_inverse=True)
    quads = shared.ravel()[np.concatenate(quads)]
    return lattice / cells, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype(np.int32)


def clamped_spline(x: np.ndarray, y: np.ndarray, first: float, last: float, at: np.ndarray) -> np.ndarray:
    """The cubic spline through (x, y) with the given end slopes."""
    h, count = np.diff(x), len(x)
    matrix, right = np.eye(count), np.zeros(count)
    right[0], right[-1] = first, last
    for k in range(1, count - 1):
        matrix[k, k - 1 : k + 2] = h[k], 2 * (h[k - 1] + h[k]), h[k - 1]
        right[k] = 3 * (h[k] * (y[k] - y[k - 1]) / h[k - 1] + h[k - 1] * (y[k + 1] - y[k]) / h[k])
    slope = np.linalg.solve(matrix, right)
    k = np.clip(np.searchsorted(x, at, side="right") - 1, 0, count - 2)
    t = (at - x[k]) / h[k]
    from_start = (1 + 2 * t) * (1 - t) ** 2 * y[k] + t * (1 - t) ** 2 * h[k] * slope[k]
    return from_start + t * t * (3 - 2 * t) * y[k + 1] + t * t * (t - 1) * h[k] * slope[k + 1]


def smooth(points: np.ndarray) -> np.ndarray:
    """A centripetal Catmull-Rom curve through `points` [K, D]: [DENSE or so, D]."""
    padded = np.concatenate([2 * points[:1] - points[1:2], points, 2 * points[-1:] - points[-2:-1]])
    knots = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(padded, axis=0), axis=1) ** 0.5)])
    pieces = []
    for k in range(1, len(padded) - 2):
        t = np.linspace(knots[k], knots[k + 1], DENSE // len(points), endpoint=k == len(padded) - 3)[:, None]

        def mix(i: int, j: int, p, q, t=t):
            return ((knots[j] - t) * p + (t - knots[i]) * q) / (knots[j] - knots[i])

        a = [mix(k - 1 + n, k + n, padded[k - 1 + n], padded[k + n]) for n in range(3)]
        b = [mix(k - 1, k + 1, a[0], a[1]), mix(k, k + 2, a[1], a[2])]
        pieces.append(mix(k, k + 1, b[0], b[1]))
    return np.concatenate(pieces)


def rounded_path(corners: np.ndarray, radius: float) -> np.ndarray:
    """The open polyline `corners` [K, 2] with its inner corners rounded."""
    arcs = [fillet(*corners[k - 1 : k + 2], radius) for k in range(1, len(corners) - 1)]
    return np.concatenate([corners[:1], *arcs, corners[-1:]])


def rounded_polygon(corners: np.ndarray, radius: float) -> np.ndarray:
    """The polygon `corners` [K, 2] with every corner rounded; its last point is its first."""
    arcs = [fillet(corners[k - 1], corners[k], corners[(k + 1) % len(corners)], radius) for k in range(len(corners))]
    return np.concatenate([*arcs, arcs[0][:1]])


def fillet(before: np.ndarray, corner: np.ndarray, after: np.ndarray, radius: float) -> np.ndarray:
    """Points of the arc that rounds `corner`, [65, 2]; the radius shrinks where a side is too short for it."""
    to_before, to_after = before - corner, after - corner
    lengths = np.linalg.norm(to_before), np.linalg.norm(to_after)
    to_before, to_after = to_before / lengths[0], to_after / lengths[1]
    half = np.arccos(np.clip(to_before @ to_after, -1, 1)) / 2
    back = min(radius / np.tan(half), 0.45 * min(lengths))
    start, bisector = corner + back * to_before, to_before + to_after
    if np.linalg.norm(bisector) < 1e-9:
        return np.linspace(start, corner + back * to_after, 65)
    centre = corner + back / np.cos(half) * bisector / np.linalg.norm(bisector)
    swept = np.linspace(0, np.pi - 2 * half, 65)[:, None]
    arm = start - centre
    across = to_before * -np.linalg.norm(arm)
    return centre + np.cos(swept) * arm + np.sin(swept) * across


def resample(curve: np.ndarray, count: int, bend: float = 0.0) -> np.ndarray:
    """`count` points along `curve` [K, D], from end to end; a share `bend` of them is spread by curvature."""
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    even = np.linspace(0, along[-1], DENSE)
    curve = np.stack([np.interp(even, along, axis) for axis in curve.T], axis=1)
    direction = np.diff(curve, axis=0)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    turn = np.linalg.norm(np.diff(direction, axis=0), axis=1)
    # A corner's turning is smeared over one spacing of the result, or its points would fall together.
    width = max(DENSE // count, 3)
    turn = np.convolve(np.concatenate([turn, turn[-1:]]), np.ones(width) / width, mode="same")
    weight = (1 - bend) / len(turn) + bend * turn / max(turn.sum(), 1e-12)
    share = np.concatenate([[0], np.cumsum(weight)])
    at = np.linspace(0, share[-1], count)
    return np.stack([np.interp(at, share, axis) for axis in curve.T], axis=1)
