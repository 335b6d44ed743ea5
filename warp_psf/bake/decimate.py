"""Fewer triangles for the same surface, with their corners at vertices of the fine one (Kautz 2004, section 3.2).

A library's quadric decimation tells which vertices of the fine surface become one. Of each such group one vertex stays
as a corner of the coarse surface, so that the deformation carries it. What decimation cannot know is how the surface
will bend: a cloth is flat at rest, where a few giant triangles are as good as many. So the surface is roughened first,
and the error of a triangle grows with its size even where it is flat.
"""

from __future__ import annotations

import fast_simplification
import numpy as np

from warp_psf.scene.topology import area_vectors, edge_lengths

# Every connected part keeps at least so many of its triangles, fewer of which enclose hardly any room.
FEWEST_OF_PART = 8
# Corners lie on the fine surface, and chords between them within what it encloses: a coarse surface is too small, and
# hides too little. So corners are chosen off the places where decimation wants them, to where the area grows, by this
# share of its gradient (metres): outwards, deeper into a valley, to the rim of a sheet.
GROWTH = 0.5
# The library collapses edges whose error is below 1e-9 (sweep + 3)^steepness, up to sweep 100. Steps of that are small,
# and so the order of collapses right, if the last sweeps are about 50: where a coarse edge has a length of about 1.
STEEPNESS = 5.0
# Collapses that would turn a triangle from where it looked first are refused, and the thin triangles of sharp edges let
# few others pass. What is left is taken as a surface of its own then, at most so many times. Two or three are enough
# for most surfaces, but not for those that are all rim.
ROUNDS = 12


def decimate(
    vertices: np.ndarray, faces: np.ndarray, part: np.ndarray, coarse: int, roughness: float
) -> tuple[np.ndarray, np.ndarray]:
    """The vertex that each vertex is moved to, [V], and which parts [P] stay as they are.

    vertices: metres, [V, 3]. faces: corners among them, [F, 3]. part: the connected part of each face, [F]: each of P
    has some. coarse: about how many triangles are to be left; there are more where many parts keep their least.
    roughness: by how many edge lengths vertices are moved along their normals first, at most.
    """
    area = 0.5 * np.linalg.norm(area_vectors(vertices, faces), axis=1)
    count, area_of_part = np.bincount(part), np.bincount(part, area)
    share = _share_out(coarse, count, area_of_part)
    growth = GROWTH * _area_gradient(vertices, faces)
    corner, whole = np.arange(len(vertices)), share >= count
    order, ends = np.argsort(part, kind="stable"), np.cumsum(count)
    for index in np.flatnonzero(~whole):
        own = faces[order[ends[index] - count[index] : ends[index]]]
        used, local = np.unique(own, return_inverse=True)
        group, wanted = _collapse(vertices[used], local.reshape(-1, 3), share[index], area_of_part[index], roughness)
        found = used[_choose_corners(vertices[used], growth[used], group, wanted)]
        if len(surviving(found[local.reshape(-1, 3)], np.zeros(len(own), bool))):
            corner[used] = found
        else:
            whole[index] = True
    return corner, whole


def _share_out(coarse: int, count: np.ndarray, area: np.ndarray) -> np.ndarray:
    """How many of the coarse triangles each part gets, of its `count` triangles, [P].

    As the root of area times triangles: what decimation of all parts at once comes to on flat surfaces.
    """
    if coarse >= count.sum():
        return count
    weight = np.sqrt(area * count)
    weight /= weight.max() or 1.0
    low, high = 0.0, float(count.max() / np.min(weight, where=weight > 0.0, initial=1.0))
    for _ in range(64):
        middle = 0.5 * (low + high)
        share = np.clip(np.floor(middle * weight), np.minimum(FEWEST_OF_PART, count), count)
        low, high = (middle, high) if share.sum() <= coarse else (low, middle)
    return np.clip(np.floor(low * weight), np.minimum(FEWEST_OF_PART, count), count).astype(int)


def _roughen(vertices: np.ndarray, faces: np.ndarray, roughness: float) -> np.ndarray:
    """Vertices moved along their normals by up to a share of the length of their edges, [V, 3]."""
    normal = unit_vectors(_sum_rows(np.repeat(area_vectors(vertices, faces), 3, axis=0), faces.ravel(), len(vertices)))
    edges = edge_lengths(vertices, faces)
    total = np.bincount(faces.ravel(), (edges + np.roll(edges, 1, axis=1)).ravel(), len(vertices))
    length = total / np.maximum(2 * np.bincount(faces.ravel(), minlength=len(vertices)), 1)
    height = np.random.default_rng(0).uniform(-roughness, roughness, len(vertices))
    return vertices + (height * length)[:, None] * normal


def _collapse(
    points: np.ndarray, faces: np.ndarray, target: int, area: float, roughness: float
) -> tuple[np.ndarray, np.ndarray]:
    """A vertex of its group for each vertex of a part, [V], and where decimation wants groups, at those, [V, 3]."""
    middle, scale = points.mean(axis=0), np.sqrt(area / target) or 1.0
    places, left, group = (points - middle) / scale, faces[_has_three_corners(faces)], np.arange(len(points))
    for _ in range(ROUNDS):
        if len(left) <= target:
            break
        found, _, collapses = fast_simplification.simplify(
            _roughen(places, left, roughness),
            left.astype(np.int32),
            target_count=int(target),
            agg=STEEPNESS,
            return_collapses=True,
        )
        if len(collapses) == 0:
            break
        moved = np.arange(len(points))
        moved[collapses[:, 1]] = collapses[:, 0]
        while (moved[moved] != moved).any():
            moved = moved[moved]
        group, left = moved[group], moved[left]
        left = left[_has_three_corners(left)]
        # The library keeps the vertices of the triangles that are left, in order.
        places[np.unique(left)] = found
    return group, places * scale + middle


def _choose_corners(points: np.ndarray, growth: np.ndarray, group: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """The member of its group that each vertex is moved to, [V]: closest to the wanted place and its group's growth."""
    count = len(points)
    goal = wanted + _sum_rows(growth, group, count)
    order = np.lexsort((((points - goal[group]) ** 2).sum(axis=1), group))
    first = order[np.diff(group[order], prepend=-1) > 0]
    chosen = np.arange(count)
    chosen[group[first]] = first
    return chosen[group]


def _area_gradient(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """How the surface's area grows with each vertex's position, metres, [V, 3]."""
    normal, corners = unit_vectors(area_vectors(vertices, faces)), vertices[faces]
    opposite = np.roll(corners, 1, axis=1) - np.roll(corners, -1, axis=1)
    return _sum_rows(0.5 * np.cross(normal[:, None], opposite).reshape(-1, 3), faces.ravel(), len(vertices))


def _has_three_corners(faces: np.ndarray) -> np.ndarray:
    return (faces != np.roll(faces, 1, axis=1)).all(axis=1)


def surviving(faces: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """The faces that did not collapse, or whose part did not, once each if they have the same corners, ascending."""
    left = np.flatnonzero(_has_three_corners(faces) | whole)
    turn = (faces[left].argmin(axis=1)[:, None] + np.arange(3)) % 3
    return left[np.sort(np.unique(np.take_along_axis(faces[left], turn, axis=1), axis=0, return_index=True)[1])]


def _sum_rows(vectors: np.ndarray, rows: np.ndarray, count: int) -> np.ndarray:
    """The sums of the vectors [N, 3] that belong to each of `count` rows."""
    return np.stack([np.bincount(rows, vectors[:, axis], count) for axis in range(3)], axis=1)


def unit_vectors(vectors: np.ndarray) -> np.ndarray:
    """Vectors of length 1; those of length 0 as they are."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0.0, length, 1.0)
