"""The coarse surface that hides a deforming body from itself afar (Kautz 2004, section 3.2).

A library's quadric decimation tells which vertices of the fine surface become one. Of each such group one vertex stays
as a corner of the coarse surface, so that the deformation carries it. What decimation cannot know is how the surface
will bend: a cloth is flat at rest, where a few giant triangles are as good as many. So the surface is roughened first,
and the error of a triangle grows with its size even where it is flat.
"""

from __future__ import annotations

import fast_simplification
import numpy as np

from warp_psf.field.blockers import BlockerSet
from warp_psf.scene.topology import area_vectors, edge_lengths, find_components

# Coarse triangles of a surface unless one asks otherwise: about what the paper has for its larger bodies.
COARSE = 400
# Every connected part keeps at least so many of its triangles, fewer of which enclose hardly any room.
FEWEST_OF_PART = 8
# By how many edge lengths vertices are moved along their normals, at most. Flat sheets need some of it; more than that
# only adds to the error where surfaces are curved.
ROUGHNESS = 0.1
# Corners lie on the fine surface, and chords between them within what it encloses: a coarse surface is too small, and
# hides too little. So corners are chosen off the places where decimation wants them, to where the area grows, by this
# share of its gradient (metres): outwards, deeper into a valley, to the rim of a sheet.
GROWTH = 0.5
# The library collapses edges whose error is below 1e-9 (sweep + 3)^steepness, up to sweep 100. Steps of that are small,
# and so the order of collapses right, if the last sweeps are about 50: where a coarse edge has a length of about 1.
STEEPNESS = 5.0
# Collapses that would turn a triangle from where it looked first are refused, and the thin triangles of sharp edges let
# few others pass. What is left is taken as a surface of its own then, at most so many times; two or three are enough.
ROUNDS = 6
# A triangle that stands for one that looks elsewhere is taken to be farther away, by a share of its own size.
TURNED_AWAY = 0.5
# Triangles with a corner at most so many edges away from a vertex are near it. With one less there are a third fewer of
# them, but in the folds of a cloth coarse triangles then come so close to vertices that they hide quite the wrong part.
RINGS = 2
# Coarse triangles of a cluster: a group of more is cut in two.
LARGEST_CLUSTER = 32


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
        return BlockerSet(np.zeros((0, 3), np.int32), np.zeros(1, np.int32), none, ends, none, ends, none, False)
    part = np.unique(_part_of_vertex(len(vertices), faces)[faces[:, 0]], return_inverse=True)[1]
    corner, whole = _decimate(vertices, faces, part, coarse)
    seed = _surviving(corner[faces], whole[part])
    order, first_of_cluster = _cluster(vertices[corner[faces[seed]]].mean(axis=1), part[seed])
    seed = seed[order]
    coarse_faces = corner[faces[seed]]
    coarse_of = _stand_for(vertices, faces, coarse_faces, corner, part, seed)
    first_skip, skip = _surroundings(len(vertices), faces, coarse_of)
    first_near, near = _members(first_skip, skip, coarse_of, len(seed))
    return BlockerSet(
        np.concatenate([coarse_faces, faces]).astype(np.int32),
        first_of_cluster.astype(np.int32),
        coarse_of.astype(np.int32),
        first_near.astype(np.int32),
        (near + len(seed)).astype(np.int32),
        first_skip.astype(np.int32),
        skip.astype(np.int32),
        not _is_closed(faces),
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
    edge = np.unique(np.minimum(start, end) * (faces.max() + 1) + np.maximum(start, end), return_inverse=True)[1]
    return not np.bincount(edge, np.sign(end - start)).any()


# Which vertices become one


def _decimate(vertices: np.ndarray, faces: np.ndarray, part: np.ndarray, coarse: int) -> tuple[np.ndarray, np.ndarray]:
    """The vertex that each vertex is moved to, [V], and which parts [P] stay as they are."""
    area = 0.5 * np.linalg.norm(area_vectors(vertices, faces), axis=1)
    count, area_of_part = np.bincount(part), np.bincount(part, area)
    share = _share_out(coarse, count, area_of_part)
    growth = GROWTH * _area_gradient(vertices, faces)
    corner, whole = np.arange(len(vertices)), share >= count
    order, ends = np.argsort(part, kind="stable"), np.cumsum(count)
    for index in np.flatnonzero(~whole):
        own = faces[order[ends[index] - count[index] : ends[index]]]
        used, local = np.unique(own, return_inverse=True)
        group, wanted = _collapse(vertices[used], local.reshape(-1, 3), share[index], area_of_part[index])
        found = used[_choose_corners(vertices[used], growth[used], group, wanted)]
        if len(_surviving(found[local.reshape(-1, 3)], np.zeros(len(own), bool))):
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


def _roughen(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Vertices moved along their normals by some of the length of their edges, [V, 3]."""
    normal = _unit(_sum_rows(np.repeat(area_vectors(vertices, faces), 3, axis=0), faces.ravel(), len(vertices)))
    edges = edge_lengths(vertices, faces)
    total = np.bincount(faces.ravel(), (edges + np.roll(edges, 1, axis=1)).ravel(), len(vertices))
    length = total / np.maximum(2 * np.bincount(faces.ravel(), minlength=len(vertices)), 1)
    height = np.random.default_rng(0).uniform(-ROUGHNESS, ROUGHNESS, len(vertices))
    return vertices + (height * length)[:, None] * normal


def _collapse(points: np.ndarray, faces: np.ndarray, target: int, area: float) -> tuple[np.ndarray, np.ndarray]:
    """A vertex of its group for each vertex of a part, [V], and where decimation wants groups, at those, [V, 3]."""
    middle, scale = points.mean(axis=0), np.sqrt(area / target) or 1.0
    places, left, group = (points - middle) / scale, faces[_has_three_corners(faces)], np.arange(len(points))
    for _ in range(ROUNDS):
        if len(left) <= target:
            break
        found, _, collapses = fast_simplification.simplify(
            _roughen(places, left),
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
    normal, corners = _unit(area_vectors(vertices, faces)), vertices[faces]
    opposite = np.roll(corners, 1, axis=1) - np.roll(corners, -1, axis=1)
    return _sum_rows(0.5 * np.cross(normal[:, None], opposite).reshape(-1, 3), faces.ravel(), len(vertices))


def _has_three_corners(faces: np.ndarray) -> np.ndarray:
    return (faces != np.roll(faces, 1, axis=1)).all(axis=1)


def _surviving(faces: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """The faces that did not collapse, or whose part did not, once each if they have the same corners, ascending."""
    left = np.flatnonzero(_has_three_corners(faces) | whole)
    turn = (faces[left].argmin(axis=1)[:, None] + np.arange(3)) % 3
    return left[np.sort(np.unique(np.take_along_axis(faces[left], turn, axis=1), axis=0, return_index=True)[1])]


def _sum_rows(vectors: np.ndarray, rows: np.ndarray, count: int) -> np.ndarray:
    """The sums of the vectors [N, 3] that belong to each of `count` rows."""
    return np.stack([np.bincount(rows, vectors[:, axis], count) for axis in range(3)], axis=1)


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors of length 1; those of length 0 as they are."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0.0, length, 1.0)


# What stands for what


def _stand_for(
    vertices: np.ndarray,
    faces: np.ndarray,
    coarse_faces: np.ndarray,
    corner: np.ndarray,
    part: np.ndarray,
    seed: np.ndarray,
) -> np.ndarray:
    """The coarse triangle that stands for each fine one, [F]: the closest of those at the corners' corners.

    seed: the fine triangle that each coarse one is what is left of, and stands for in any case.
    """
    fine, candidate = _candidates(corner[faces], coarse_faces, part, part[seed])
    vector, coarse_vector = area_vectors(vertices, faces), area_vectors(vertices, coarse_faces)
    cosine = (_unit(vector)[fine] * _unit(coarse_vector)[candidate]).sum(axis=1)
    size = np.linalg.norm(coarse_vector, axis=1)[candidate] / 2
    middle = vertices[faces].mean(axis=1)
    away = _distance_squared(middle[fine], vertices[coarse_faces[candidate]]) + TURNED_AWAY * size * (1.0 - cosine)
    order = np.lexsort((away, fine))
    coarse_of = candidate[order[np.diff(fine[order], prepend=-1) > 0]]
    coarse_of[seed] = np.arange(len(seed))
    return coarse_of


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


def _surroundings(count: int, faces: np.ndarray, coarse_of: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The coarse triangles that stand for some of what lies around each vertex: ends [V + 1], ascending [...]."""
    total = coarse_of.max() + 1
    vertex, touched = _unique_pairs(faces.ravel(), np.repeat(coarse_of, 3), total)
    one, other = _unique_pairs(np.repeat(faces, 3, axis=1).ravel(), np.tile(faces, 3).ravel(), count)
    for _ in range(RINGS):
        which, entry = _expand(_ends(vertex, count), other)
        vertex, touched = _unique_pairs(one[which], touched[entry], total)
    return _ends(vertex, count), touched


def _members(
    first_skip: np.ndarray, skip: np.ndarray, coarse_of: np.ndarray, total: int
) -> tuple[np.ndarray, np.ndarray]:
    """The fine triangles in whose place the skipped ones stand: ends [V + 1], indices [...]."""
    first, member = _group(coarse_of, total)
    _, entry = _expand(first, skip)
    return np.concatenate([[0], np.cumsum(np.diff(first)[skip])])[first_skip], member[entry]


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
    key = np.unique(one * count + other)
    return key // count, key % count
