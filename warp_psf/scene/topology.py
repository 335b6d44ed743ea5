"""How the faces of a triangle mesh hang together: shared positions, shared edges, pieces, sides."""

from __future__ import annotations

import numpy as np

# Positions closer than this fraction of the mesh's extent on every axis are one point: float32 rounding of a seam.
SAME_POSITION = 1e-7
# How far a face's neighbour may rise over its plane for the edge to count as convex, in extents: float32 rounding.
FLAT_EDGE = 2e-6


def area_vectors(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Face normals times twice the area [F, 3]."""
    a, b, c = points[faces[:, 0]], points[faces[:, 1]], points[faces[:, 2]]
    return np.cross(b - a, c - a)


def edge_lengths(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The lengths [F, 3] of the edges 0-1, 1-2 and 2-0."""
    return np.linalg.norm(points[faces] - points[np.roll(faces, -1, axis=1)], axis=2)


def coordinate_step(points: np.ndarray) -> float:
    """The distance between float32 numbers at the largest coordinate, which counts for meshes far from their origin."""
    return float(np.spacing(np.abs(points).max().astype(np.float32)))


def merge_positions(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Numbers equal positions alike: the point of every vertex [V], and a vertex of every point [P].

    Coordinates are grouped axis by axis wherever neighbours in sorted order touch, so that no grid line can part two.
    """
    near = SAME_POSITION * np.ptp(points, axis=0).max()
    key = np.zeros(len(points), dtype=np.int64)
    for axis in range(3):
        order = np.argsort(points[:, axis])
        group = np.empty(len(points), dtype=np.int64)
        group[order] = np.cumsum(np.diff(points[order, axis], prepend=points[order[0], axis]) > near)
        key = np.unique(key * (group.max() + 1) + group, return_inverse=True)[1]
    return key, np.unique(key, return_index=True)[1]


def pair_edges(faces: np.ndarray) -> tuple[tuple[np.ndarray, np.ndarray], bool]:
    """Pairs of half-edges that share an edge which has exactly two, and whether the surface is closed.

    Half-edge 3 f + k runs from corner k of face f to its next. A surface is closed when every edge has an even number.
    """
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    key = np.minimum(start, end) * (faces.max(initial=0) + 1) + np.maximum(start, end)
    order = np.argsort(key, kind="stable")
    begin = np.flatnonzero(np.diff(key[order], prepend=-1))
    count = np.diff(begin, append=len(key))
    double = begin[count == 2]
    return (order[double], order[double + 1]), bool((count % 2 == 0).all())


def find_components(count: int, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The smallest node that each of `count` nodes is connected to by the links one[i] - other[i]."""
    root = np.arange(count)
    while True:
        low, high = np.minimum(root[one], root[other]), np.maximum(root[one], root[other])
        apart = low != high
        if not apart.any():
            return root
        one, other = one[apart], other[apart]
        np.minimum.at(root, high[apart], low[apart])
        while True:
            above = root[root]
            if (above == root).all():
                break
            root = above


def find_flips(points: np.ndarray, faces: np.ndarray, pairs: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Which faces [F] must be turned round so that neighbours agree and closed pieces look outwards.

    A closed piece looks outwards when its signed volume is positive; one that consistently looks inwards within the
    bounds of another is a cavity and stays. An open piece keeps the side of most of its area.
    """
    count = len(faces)
    one, other = pairs[0] // 3, pairs[1] // 3
    agree = faces.ravel()[pairs[0]] != faces.ravel()[pairs[1]]
    # Two nodes per face, as it is and turned: a link joins the states in which two neighbours agree.
    across = np.where(agree, other, other + count), np.where(agree, other + count, other)
    root = find_components(2 * count, np.concatenate([one, one + count]), np.concatenate(across))
    state = np.where(root[:count] <= root[count:], 1.0, -1.0)
    piece = np.unique(np.minimum(root[:count], root[count:]), return_inverse=True)[1]
    corner = (points - points.mean(axis=0))[faces]
    vectors = area_vectors(points, faces)
    area = np.bincount(piece, state * np.linalg.norm(vectors, axis=1))
    volume = np.bincount(piece, state * (vectors * corner[:, 0]).sum(axis=1))
    paired = np.bincount(piece[np.concatenate([one, other])], minlength=len(area))
    whole = paired == 3 * np.bincount(piece)
    mixed = np.bincount(piece, state < 0.0) > 0
    side = np.where(np.where(whole & (volume != 0.0), volume, area) < 0.0, -1.0, 1.0)
    low, high = np.full((len(area), 3), np.inf), np.full((len(area), 3), -np.inf)
    np.minimum.at(low, piece, corner.min(axis=1))
    np.maximum.at(high, piece, corner.max(axis=1))
    outer = whole & (volume > 0.0)
    for cavity in np.flatnonzero(whole & (volume < 0.0) & ~mixed):
        if (outer & (low < low[cavity]).all(axis=1) & (high > high[cavity]).all(axis=1)).any():
            side[cavity] = 1.0
    return state * side[piece] < 0.0


def has_convex_edges(points: np.ndarray, faces: np.ndarray, pairs: tuple[np.ndarray, np.ndarray]) -> bool:
    """Whether a closed, outward surface is of one piece and bends inwards at none of its edges."""
    one, other = pairs
    # Euler's count is 2 for a convex piece; an edge of four faces is no pair and breaks it. Pieces that touch at points
    # can add up to 2 as well: they have no edge in common.
    if len(np.unique(faces)) - len(one) + len(faces) != 2 or 2 * len(one) != faces.size:
        return False
    if np.unique(find_components(len(faces), one // 3, other // 3)).size != 1:
        return False
    corner = points[faces]
    vectors = area_vectors(points, faces)
    twice_area = np.linalg.norm(vectors, axis=1)
    opposite = points[faces[other // 3, (other % 3 + 2) % 3]]
    rise = ((opposite - corner[one // 3, 0]) * vectors[one // 3]).sum(axis=1)
    # Over the plane of the larger face: a sliver's plane is noise.
    larger = np.maximum(twice_area[one // 3], twice_area[other // 3])
    near = FLAT_EDGE * np.ptp(points, axis=0).max() + 2.0 * coordinate_step(points)
    return bool((rise <= near * larger).all())
