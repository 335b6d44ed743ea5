"""The triangles that hide a deforming body from itself: the surface at several levels (Kautz 2004, section 3.2).

Near a vertex its own surface counts, afar a coarse one. Between the two lie levels of sizes in between, so that what a
vertex looks at grows with the number of levels, not with the number of fine triangles that a coarse one stands for.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from warp_psf.bake.decimate import FEWEST_OF_PART, decimate, surviving, unit_vectors
from warp_psf.field.blockers import BlockerSet
from warp_psf.scene.topology import area_vectors, find_components

# Coarse triangles of a surface unless one asks otherwise: about what the paper has for its larger bodies.
COARSE = 400
# About how many times more triangles each level has than the one above. With three, more triangles of a cloth are near
# without hiding better; with six a hand errs more, and as many are near.
RATIO = 4
# By how many edge lengths vertices are moved along their normals before triangles become fewer, at most: at first, and
# from level to level. Flat sheets need some of it; more than that only adds to the error where surfaces are curved, and
# edges are long.
ROUGHNESS, ROUGHNESS_BETWEEN = 0.1, 0.02
# A triangle that stands for one that looks elsewhere is taken to be farther away, by a share of its own size.
TURNED_AWAY = 0.5
# Triangles with a corner at most so many edges away from a vertex are near it. With one less, coarser triangles come so
# close to vertices in the folds of a cloth that they hide quite the wrong part.
RINGS = 2
# Coarse triangles of a cluster: a group of more is cut in two.
LARGEST_CLUSTER = 32


@dataclass(frozen=True, eq=False)
class _Level:
    """Triangles [C, 3], the part of the surface that each belongs to, [C], and in terms of the next finer level: which
    one each is what is left of, [C], and to which vertex each vertex was moved, [V]."""

    faces: np.ndarray
    part: np.ndarray
    seed: np.ndarray
    corner: np.ndarray


def make_blockers(name: str, vertices: np.ndarray, faces: np.ndarray, *, coarse: int = COARSE) -> BlockerSet:
    """The triangles that may hide a surface from itself, near and far.

    name: of the body, for messages. vertices: at rest, metres, [V, 3], no two of which are one point. faces: corners
    among them, counter-clockwise from outside, [F, 3]. coarse: about how many triangles stand for all of the surface;
    there are more if the surface has many parts, and a surface that has fewer is its own coarse surface.

    The same input gives the same result. Raises ValueError for arrays of other shapes, vertices that are not finite,
    faces whose corners are not among them, and `coarse` below 1.
    """
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    _check(name, vertices, faces, coarse)
    if len(faces) == 0:
        ends, none = np.zeros(len(vertices) + 1, np.int32), np.zeros(0, np.int32)
        triangles, first = np.zeros((0, 3), np.int32), np.zeros(1, np.int32)
        return BlockerSet(triangles, first, ends, none, ends, none, False, none, np.zeros(3, np.int32))
    levels, first_of_cluster = _make_levels(vertices, faces, coarse)
    parents = [_stand_for(vertices, finer.faces, level, finer.part) for level, finer in pairwise(levels)]
    first_of_level = np.cumsum([0] + [len(level.faces) for level in levels])
    near, skip = _list_triangles(len(vertices), [level.faces for level in levels], parents, first_of_level)
    parent = [np.full(first_of_level[1], -1)]
    parent += [upper + first for upper, first in zip(parents, first_of_level, strict=False)]
    return BlockerSet(
        np.concatenate([level.faces for level in levels]).astype(np.int32),
        first_of_cluster.astype(np.int32),
        *(array.astype(np.int32) for array in (*near, *skip)),
        not _is_closed(faces),
        np.concatenate(parent).astype(np.int32),
        first_of_level.astype(np.int32),
    )


def _check(name: str, vertices: np.ndarray, faces: np.ndarray, coarse: int) -> None:
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
        raise ValueError(
            f"blockers of {name!r}: vertices are {vertices.shape} and faces {faces.shape}; give [V, 3] and [F, 3]"
        )
    if not np.isfinite(vertices).all():
        raise ValueError(f"blockers of {name!r}: some vertices are not finite; give positions in metres")
    if faces.size and not 0 <= faces.min() <= faces.max() < len(vertices):
        raise ValueError(
            f"blockers of {name!r}: faces name vertices {faces.min()} to {faces.max()}, but there are {len(vertices)}"
        )
    if coarse < 1:
        raise ValueError(f"blockers of {name!r}: the coarse surface cannot have {coarse} triangles; ask for at least 1")


def _part_of_vertex(count: int, faces: np.ndarray) -> np.ndarray:
    return find_components(count, faces[:, :2].ravel(), faces[:, 1:].ravel())


def _is_closed(faces: np.ndarray) -> bool:
    """Whether every edge is run through as often in one direction as in the other."""
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    return not np.bincount(_number_edges(faces), np.sign(end - start)).any()


def _number_edges(faces: np.ndarray) -> np.ndarray:
    """The edge of each side of the triangles, [3 F], whichever way they run through it."""
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    return np.unique(np.minimum(start, end) * (faces.max() + 1) + np.maximum(start, end), return_inverse=True)[1]


# Levels


def _make_levels(vertices: np.ndarray, faces: np.ndarray, coarse: int) -> tuple[list[_Level], np.ndarray]:
    """Levels from the coarsest, whose triangles lie cluster by cluster, to the fine one; the clusters' ends."""
    count = len(vertices)
    part = np.unique(_part_of_vertex(count, faces)[faces[:, 0]], return_inverse=True)[1]
    steps = max(1, round(np.log(max(len(faces) / coarse, 1.0)) / np.log(RATIO)))
    levels = [_Level(faces, part, np.arange(len(faces)), np.arange(count))]
    for step in range(1, steps + 1):
        target = round(coarse * (len(faces) / coarse) ** (1.0 - step / steps))
        levels.append(_coarsen(vertices, levels[-1], target, ROUGHNESS if step == 1 else ROUGHNESS_BETWEEN))
    last = levels[-1]
    order, first_of_cluster = _cluster(vertices[last.faces].mean(axis=1), last.part)
    levels[-1] = _Level(last.faces[order], last.part[order], last.seed[order], last.corner)
    return levels[::-1], first_of_cluster


def _coarsen(vertices: np.ndarray, level: _Level, target: int, roughness: float) -> _Level:
    """The next coarser level, of about so many triangles."""
    corner, whole = decimate(vertices, level.faces, level.part, target, roughness)
    moved = corner[level.faces]
    seed = surviving(moved, whole[level.part])
    return _Level(moved[seed], level.part[seed], seed, corner)


# What stands for what


def _stand_for(vertices: np.ndarray, faces: np.ndarray, level: _Level, part: np.ndarray) -> np.ndarray:
    """The triangle of a level that stands for each of the next finer one, whose faces are given with the part of each,
    [F]: the closest of those at the corners' corners."""
    fine, candidate = _candidates(level.corner[faces], level.faces, part, level.part)
    vector, coarse_vector = area_vectors(vertices, faces), area_vectors(vertices, level.faces)
    cosine = (unit_vectors(vector)[fine] * unit_vectors(coarse_vector)[candidate]).sum(axis=1)
    size = np.linalg.norm(coarse_vector, axis=1)[candidate] / 2
    middle = vertices[faces].mean(axis=1)
    away = _distance_squared(middle[fine], vertices[level.faces[candidate]]) + TURNED_AWAY * size * (1.0 - cosine)
    order = np.lexsort((away, fine))
    found = candidate[order[np.diff(fine[order], prepend=-1) > 0]]
    found[level.seed] = np.arange(len(level.seed))
    return found


def _candidates(
    moved: np.ndarray, coarse_faces: np.ndarray, part: np.ndarray, coarse_part: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of a fine triangle, whose corners moved to `moved` [F, 3], and a coarse one that shares a corner."""
    count = max(moved.max(), coarse_faces.max()) + 1
    first, around = _group(coarse_faces.ravel(), count)
    which, entry = _expand(first, moved.ravel())
    fine, candidate = _unique_pairs(which // 3, around[entry] // 3, len(coarse_faces))
    # Corners of which nothing is left leave all of the part.
    lone = np.setdiff1d(np.arange(len(moved)), fine)
    first, of_part = _group(coarse_part, part.max() + 1)
    which, entry = _expand(first, part[lone])
    return np.concatenate([fine, lone[which]]), np.concatenate([candidate, of_part[entry]])


def _distance_squared(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Of points [N, 3] from triangles [N, 3, 3], one each."""
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    square = (normal**2).sum(axis=1)
    above, nearest = square > 0.0, np.full(len(points), np.inf)
    for index in range(3):
        start = triangles[:, index]
        edge, away = triangles[:, (index + 1) % 3] - start, points - start
        above &= (np.cross(edge, away) * normal).sum(axis=1) >= 0.0
        along = (edge * away).sum(axis=1) / np.maximum((edge**2).sum(axis=1), np.finfo(float).tiny)
        nearest = np.minimum(nearest, ((away - np.clip(along, 0.0, 1.0)[:, None] * edge) ** 2).sum(axis=1))
    height = ((points - triangles[:, 0]) * normal).sum(axis=1)
    return np.where(above, height**2 / np.where(above, square, 1.0), nearest)


# Lists of each vertex

# Pairs without repetition, ascending: of a vertex and a triangle.
Pairs = tuple[np.ndarray, np.ndarray]


def _list_triangles(
    count: int, faces: list[np.ndarray], parents: list[np.ndarray], first_of_level: np.ndarray
) -> tuple[Pairs, Pairs]:
    """The near triangles of `count` vertices, and those of the coarsest level in whose place they stand: ends [V + 1]
    and triangles [...].

    faces: of each level, from the coarsest on. parents: of each level but that one, in the level above.
    """
    total = first_of_level[-1]
    replaced, near = _surroundings(count, faces[-1], parents[-1]), []
    finer = np.zeros(0, np.int64)
    for level in range(len(parents) - 1, -1, -1):
        first, member = _group(parents[level], len(faces[level]))
        which, entry = _expand(first, replaced[1])
        # All that stands at the finer level for what is replaced, less what is replaced there itself.
        children = replaced[0][which] * total + member[entry]
        near.append(np.setxor1d(children, finer, assume_unique=True) + first_of_level[level + 1])
        if level > 0:
            finer = replaced[0] * total + replaced[1]
            replaced = _stand_above(replaced, faces[level], parents[level - 1])
    key = np.sort(np.concatenate(near))
    return (_ends(key // total, count), key % total), (_ends(replaced[0], count), replaced[1])


def _surroundings(count: int, faces: np.ndarray, parent: np.ndarray) -> Pairs:
    """The triangles that stand for some of what lies around each of `count` vertices."""
    total = parent.max() + 1
    vertex, touched = _unique_pairs(faces.ravel(), np.repeat(parent, 3), total)
    one, other = _unique_pairs(np.repeat(faces, 3, axis=1).ravel(), np.tile(faces, 3).ravel(), count)
    for _ in range(RINGS):
        which, entry = _expand(_ends(vertex, count), other)
        vertex, touched = _unique_pairs(one[which], touched[entry], total)
    return vertex, touched


def _stand_above(replaced: Pairs, faces: np.ndarray, parent: np.ndarray) -> Pairs:
    """The triangles of the level above that stand for the replaced ones, and for those that share an edge with them."""
    edge, total = _number_edges(faces), parent.max() + 1
    first, along = _group(edge, edge.max() + 1)
    which, entry = _expand(first, edge)
    triangle, above = _unique_pairs(which // 3, parent[along[entry] // 3], total)
    which, entry = _expand(_ends(triangle, len(faces)), replaced[1])
    return _unique_pairs(replaced[0][which], above[entry], total)


# Clusters


def _cluster(places: np.ndarray, part: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """An order [C] in which triangles lie cluster by cluster, and the clusters' ends [clusters + 1].

    places: the triangles' middles, [C, 3]. part: of the surface, [C]: parts may move away from each other.
    """
    small = np.bincount(part)[part] < FEWEST_OF_PART
    parts = np.unique(np.where(small, -1, part), return_inverse=True)[1]
    done, waiting = [], np.split(np.argsort(parts, kind="stable"), np.cumsum(np.bincount(parts))[:-1])[::-1]
    while waiting:
        group = waiting.pop()
        if len(group) <= LARGEST_CLUSTER:
            done.append(group)
            continue
        axis = np.ptp(places[group], axis=0).argmax()
        group = group[np.argsort(places[group, axis], kind="stable")]
        waiting += [group[len(group) // 2 :], group[: len(group) // 2]]
    return np.concatenate(done), np.cumsum([0] + [len(group) for group in done])


# Lists of lists


def _ends(rows: np.ndarray, count: int) -> np.ndarray:
    """Where the entries of each of `count` rows begin among ascending `rows`, and where the last one's end."""
    return np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=count))])


def _group(rows: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The entries of each of `count` rows, ascending: ends [count + 1] and indices into `rows`."""
    return _ends(rows, count), np.argsort(rows, kind="stable")


def _expand(first: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """All entries of `rows`, one row after another: positions in `rows`, and entries."""
    length = first[rows + 1] - first[rows]
    skipped = first[rows] - (np.cumsum(length) - length)
    return np.repeat(np.arange(len(rows)), length), np.arange(length.sum()) + np.repeat(skipped, length)


def _unique_pairs(one: np.ndarray, other: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Pairs without repetition, ascending; `other` is below `count`."""
    key = np.sort(one * count + other)
    key = key[np.diff(key, prepend=-1) > 0]
    return key // count, key % count
