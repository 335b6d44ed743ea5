"""Triangle meshes: checked, repaired, with normals, a bounding sphere and the closed forms that they may have."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from warp_psf.scene.fit import bounding_sphere, find_slab, find_sphere
from warp_psf.scene.topology import (
    area_vectors,
    edge_lengths,
    find_components,
    find_flips,
    has_convex_edges,
    merge_positions,
    pair_edges,
)

# Edges sharper than this (radians) are creases: a 10-sided prism looks faceted, a 9-degree lathe smooth.
CREASE_ANGLE = np.radians(40.0)
# A triangle thinner than this fraction of the mesh's extent has no more height than float32 rounding gives it.
THINNEST_FACE = 1e-7
# Tessellation beyond this many faces is a mistaken edge length, not a wish.
MOST_FACES = 4_000_000
SUFFIXES = (".glb", ".obj", ".ply", ".stl")


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh in its own frame. Built by `make_mesh` and `load_mesh`; its arrays are read-only.

    Attributes:
        name: what messages call it.
        vertices: positions, metres, float32 [V, 3].
        faces: vertex indices, counter-clockwise seen from outside, int32 [F, 3].
        normals: unit vertex normals, float32 [V, 3]; at creases a position has one vertex per smooth side.
        slab: (center [3], rotation [3, 3], half_extents [3]), float64 in the mesh's frame, when the surface is exactly
            a box or a flat rectangle, else None. The rotation's columns are the box's axes; column 2 is the normal of a
            largest side. A rectangle has half_extents[2] = 0 and column 2 on the side that its faces show.
        sphere: radius, metres, when the surface is a tessellated sphere about the mesh's origin, else None.
        convex: the surface is closed, of one piece, and bulges nowhere inwards.
        closed: every edge has a face on both sides, so that there is an inside.
        center, radius: the smallest sphere around the vertices, float64 [3] and metres.
    """

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    slab: tuple[np.ndarray, np.ndarray, np.ndarray] | None
    sphere: float | None
    convex: bool
    closed: bool
    center: np.ndarray
    radius: float


def make_mesh(name: str, vertices, faces, normals=None, smooth_angle: float = CREASE_ANGLE) -> Mesh:
    """A mesh from arrays.

    Faces that are wound unlike their neighbours, or inwards, are turned, and those without area dropped: a warning says
    so, as of an open surface. Vertices are split at creases, so that the mesh may have more of them than came.

    ```python
    corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
    wedge = psf.make_mesh("wedge", corners, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    ```

    Args:
        name: what messages call it.
        vertices: positions, metres, numbers [V, 3]. Equal positions (texture seams) count as one point; those that no
            face uses are left out.
        faces: vertex indices, integers [F, 3].
        normals: vertex normals [V, 3]; the vertices then stay as they are, and a normal on the back of its faces is
            turned. By default the mean of the faces' normals, weighted by their angle at the vertex, with vertices
            split at creases.
        smooth_angle: edges whose faces' normals differ by more than this, radians, are creases.

    Raises:
        ValueError: shapes, types, indices or numbers are wrong, or no face has an area.
    """
    points, faces, normals = _check_arrays(name, vertices, faces, normals, smooth_angle)
    point_of_vertex, first = merge_positions(points)
    points = points[first][point_of_vertex]
    faces, corners, closed, convex = _mend_faces(name, points[first], faces, point_of_vertex)
    if normals is None:
        points, faces, normals = _split_creases(points[first], corners, smooth_angle)
    else:
        normals = _turn_outwards(points, faces, normals)
    used = points[np.unique(faces)]
    center, radius = bounding_sphere(used)
    slab = find_slab(points, faces, radius)
    if not closed and slab is None:
        warnings.warn(f"mesh {name!r} is open: it is rendered as it is, but has no inside", stacklevel=2)
    return Mesh(
        name=name,
        vertices=_freeze(points, np.float32),
        faces=_freeze(faces, np.int32),
        normals=_freeze(normals, np.float32),
        slab=slab and tuple(_freeze(value, np.float64) for value in slab),
        sphere=find_sphere(points, faces, center, closed),
        convex=bool(convex),
        closed=bool(closed),
        center=_freeze(center, np.float64),
        radius=radius,
    )


def load_mesh(path: str | Path, scale: float = 1.0) -> Mesh:
    """Reads an OBJ, STL, PLY or GLB file as one mesh, in the axes of the file.

    Scene graphs are flattened, quads are cut into triangles, materials left out, and what is broken is mended, and
    normals computed, by `make_mesh`.

    ```python
    mesh = psf.load_mesh("mesh.obj", scale=0.001)  # a file in millimetres
    ```

    Args:
        path: the file.
        scale: metres per unit of the file.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is of another format, cannot be read or holds no usable mesh, or the scale is not positive.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"mesh file {str(path)!r} does not exist; check the path")
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(
            f"mesh file {str(path)!r} is not of a known format; convert it to one of {', '.join(SUFFIXES)}"
        )
    if not (np.isfinite(scale) and scale > 0.0):
        raise ValueError(f"mesh file {str(path)!r}: the scale is {scale}; it must be a positive number")
    # Half a second to import, which scenes of primitives need not pay.
    import trimesh

    try:
        # process=False leaves merging to make_mesh and asks for no optional package; materials are MuJoCo's.
        loaded = trimesh.load_scene(path, process=False, skip_materials=True).to_mesh()
        vertices, faces = np.asarray(loaded.vertices), np.asarray(loaded.faces)
    except Exception as error:  # a parser meets a broken file with any type of error
        reason = str(error) or type(error).__name__
        raise ValueError(f"mesh file {str(path)!r} cannot be read ({reason}); export it again") from error
    if len(faces) == 0:
        raise ValueError(f"mesh file {str(path)!r} holds no faces; export it as a triangle mesh")
    return make_mesh(path.name, vertices * scale, faces)


def tessellate(mesh: Mesh, longest_edge: float) -> Mesh:
    """The same surface with edges halved until none is longer than `longest_edge`, metres; see `cut_faces`."""
    return cut_faces(mesh, longest_edge)[0]


def cut_faces(mesh: Mesh, longest_edge: float) -> tuple[Mesh, np.ndarray]:
    """The same surface with edges halved until none is longer than `longest_edge`, metres; normals are interpolated.

    A closed mesh stays closed: an edge is cut at one midpoint for all of its faces.

    Returns:
        The finer mesh, and which face of `mesh` each of its faces is a piece of, integers [F].

    Raises:
        ValueError: the length is not positive, or so short that more than `MOST_FACES` faces would result.
    """
    if not (np.isfinite(longest_edge) and longest_edge > 0.0):
        raise ValueError(f"mesh {mesh.name!r}: longest_edge is {longest_edge}; it must be a positive length in metres")
    points, faces = mesh.vertices.astype(np.float64), mesh.faces.astype(np.int64)
    normals = mesh.normals.astype(np.float64)
    # No triangle with such edges is larger than the equilateral one.
    fewest = 0.5 * np.linalg.norm(area_vectors(points, faces), axis=1).sum() / (np.sqrt(3.0) / 4.0 * longest_edge**2)
    if fewest > MOST_FACES:
        raise ValueError(
            f"mesh {mesh.name!r}: edges of at most {longest_edge} m need more than {MOST_FACES} faces; "
            "choose a longer longest_edge"
        )
    origin = np.arange(len(faces))
    while True:
        ends = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2), axis=2).reshape(-1, 2)
        key, edge = np.unique(ends[:, 0] * len(points) + ends[:, 1], return_inverse=True)
        a, b = key // len(points), key % len(points)
        cut = np.linalg.norm(points[a] - points[b], axis=1) > longest_edge
        if not cut.any():
            break
        middle = np.where(cut, len(points) + np.cumsum(cut) - 1, -1)[edge].reshape(-1, 3)
        a, b = a[cut], b[cut]
        points = np.concatenate([points, 0.5 * (points[a] + points[b])])
        # Opposite normals have no mean: the first end's then serves as well as any.
        mean = normals[a] + normals[b]
        length = np.linalg.norm(mean, axis=1, keepdims=True)
        normals = np.concatenate([normals, np.where(length > 1e-6, mean / np.maximum(length, 1e-6), normals[a])])
        faces, whole = _split_faces(points, faces, middle)
        origin = origin[whole]
    finer = replace(
        mesh,
        vertices=_freeze(points, np.float32),
        faces=_freeze(faces, np.int32),
        normals=_freeze(normals, np.float32),
        sphere=find_sphere(points, faces, mesh.center, mesh.closed),
    )
    return finer, origin


def _mend_faces(name: str, points: np.ndarray, faces: np.ndarray, point_of_vertex: np.ndarray):
    """Faces and their points [F, 3], turned outwards and without empty ones; whether they are closed, and convex."""
    given = len(faces)
    corners = point_of_vertex[faces]
    proper = (corners != np.roll(corners, 1, axis=1)).all(axis=1)
    faces, corners = faces[proper], corners[proper]
    pairs, closed = pair_edges(corners)
    flips = find_flips(points, corners, pairs)
    if flips.any():
        message = (
            f"mesh {name!r}: turned {flips.sum()} of {given} faces that were wound inwards or unlike their neighbours"
        )
        warnings.warn(message, stacklevel=3)
        faces[flips] = faces[flips, ::-1]
        corners[flips] = corners[flips, ::-1]
        pairs, closed = pair_edges(corners)
    convex = closed and has_convex_edges(points, corners, pairs)
    # A thin face closes the edges beside it although it covers nothing: it leaves only now.
    solid = _has_area(points, corners)
    faces, corners = faces[solid], corners[solid]
    if len(faces) == 0:
        raise ValueError(f"mesh {name!r}: none of its {given} faces has an area; check the vertices and the scale")
    if len(faces) < given:
        warnings.warn(f"mesh {name!r}: dropped {given - len(faces)} of {given} faces without area", stacklevel=3)
    return faces, corners, closed, convex


def _check_arrays(name, vertices, faces, normals, smooth_angle):
    """The arrays as float64 [V, 3] (rounded to float32), int64 [F, 3] and float64 [V, 3] or None."""
    if not 0.0 <= smooth_angle <= np.pi:
        raise ValueError(f"mesh {name!r}: smooth_angle is {smooth_angle}; it must be between 0 and pi radians")
    points = _check_vectors(name, "vertices", vertices)
    try:
        faces = np.asarray(faces)
    except ValueError as error:
        raise ValueError(f"mesh {name!r}: faces have different lengths; cut them into triangles [F, 3]") from error
    if faces.size == 0:
        raise ValueError(f"mesh {name!r} has no faces; give int [F, 3] vertex indices with F at least 1")
    if faces.ndim != 2 or faces.shape[1] != 3 or not np.issubdtype(faces.dtype, np.integer):
        raise ValueError(f"mesh {name!r}: faces are {faces.dtype} {list(faces.shape)}; give integers [F, 3]")
    faces = faces.astype(np.int64)
    if faces.min() < 0 or faces.max() >= len(points):
        wrong = faces.min() if faces.min() < 0 else faces.max()
        raise ValueError(f"mesh {name!r}: a face uses vertex {wrong}; there are only vertices 0 to {len(points) - 1}")
    used, faces = np.unique(faces, return_inverse=True)
    faces = faces.reshape(-1, 3)
    if normals is None:
        return points[used], faces, None
    normals = _check_vectors(name, "normals", normals)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    if normals.shape != points.shape:
        raise ValueError(
            f"mesh {name!r}: {len(normals)} normals for {len(points)} vertices; give one normal per vertex"
        )
    if (length == 0.0).any():
        raise ValueError(
            f"mesh {name!r}: normal {int(length.argmin())} has no length; leave normals out to compute them"
        )
    return points[used], faces, (normals / length)[used]


def _check_vectors(name: str, what: str, values) -> np.ndarray:
    try:
        with np.errstate(over="ignore"):
            vectors = np.asarray(values).astype(np.float32, casting="same_kind" if np.size(values) else "unsafe")
    except (TypeError, ValueError) as error:
        raise ValueError(f"mesh {name!r}: {what} are not real numbers; give float [V, 3]") from error
    if vectors.ndim != 2 or vectors.shape[1] != 3 or len(vectors) == 0:
        raise ValueError(f"mesh {name!r}: {what} have the shape {list(vectors.shape)}; give float [V, 3]")
    broken = ~np.isfinite(vectors).all(axis=1)
    if broken.any():
        raise ValueError(
            f"mesh {name!r}: {broken.sum()} of {len(vectors)} {what} are not finite (the first is number "
            f"{int(broken.argmax())}); remove or correct them"
        )
    return vectors.astype(np.float64)


def _has_area(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    twice_area = np.linalg.norm(area_vectors(points, faces), axis=1)
    longest = edge_lengths(points, faces).max(axis=1, initial=0.0)
    return twice_area > THINNEST_FACE * np.ptp(points, axis=0).max() * longest


def _split_creases(points: np.ndarray, faces: np.ndarray, smooth_angle: float):
    """Vertices, faces and normals of a welded mesh, with one vertex per position and smooth side of it."""
    vectors = area_vectors(points, faces)
    unit = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    flat = faces.ravel()
    (one, other), _ = pair_edges(faces)
    following = np.arange(len(flat)).reshape(-1, 3)[:, [1, 2, 0]].ravel()
    # The last term leaves out the seam of a one-sided surface, where the two faces run along the edge the same way.
    cosine = (unit[one // 3] * unit[other // 3]).sum(axis=1)
    smooth = (cosine >= np.cos(smooth_angle) - 1e-6) & (flat[one] != flat[other])
    one, other = one[smooth], other[smooth]
    ends = np.concatenate([one, following[one]]), np.concatenate([following[other], other])
    _, first, vertex = np.unique(find_components(len(flat), *ends), return_index=True, return_inverse=True)
    legs = points[np.roll(faces, -1, axis=1)] - points[faces], points[np.roll(faces, 1, axis=1)] - points[faces]
    across = np.linalg.norm(np.cross(*legs), axis=2)
    angle = np.arctan2(across, (legs[0] * legs[1]).sum(axis=2)).ravel()
    weighted = angle[:, None] * np.repeat(unit, 3, axis=0)
    total = np.stack([np.bincount(vertex, weighted[:, axis]) for axis in range(3)], axis=1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    normals = np.where(length > 1e-6, total / np.maximum(length, 1e-6), unit[first // 3])
    return points[flat[first]], vertex.reshape(-1, 3), normals


def _turn_outwards(points: np.ndarray, faces: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Given normals, turned to the side to which their faces look (after repair)."""
    vectors = np.repeat(area_vectors(points, faces), 3, axis=0)
    total = [np.bincount(faces.ravel(), vectors[:, axis], minlength=len(points)) for axis in range(3)]
    against = (np.stack(total, axis=1) * normals).sum(axis=1) < 0.0
    return np.where(against[:, None], -normals, normals)


def _split_faces(points: np.ndarray, faces: np.ndarray, middle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Faces cut at the midpoints `middle` [F, 3] of their edges (0-1, 1-2, 2-0), -1 where an edge stays whole.

    Returns the pieces and which of `faces` each was.
    """
    cuts = (middle >= 0).sum(axis=1)
    pieces = [faces[cuts == 0]]
    # Turned so that the one cut edge comes first: from its midpoint to the opposite corner.
    (a, b, c), (p, _, _) = _turn(faces, middle, cuts == 1, (middle >= 0).argmax(axis=1))
    pieces += [np.stack([a, p, c], axis=1), np.stack([p, b, c], axis=1)]
    # Turned so that the one whole edge comes last: a corner, and a quad cut along its shorter diagonal.
    (a, b, c), (p, q, _) = _turn(faces, middle, cuts == 2, (middle >= 0).argmin(axis=1) + 1)
    shorter = np.linalg.norm(points[a] - points[q], axis=1) <= np.linalg.norm(points[p] - points[c], axis=1)
    pieces += [np.stack([p, b, q], axis=1)]
    pieces += [np.stack([a, p, np.where(shorter, q, c)], axis=1), np.stack([np.where(shorter, a, p), q, c], axis=1)]
    (a, b, c), (p, q, r) = _turn(faces, middle, cuts == 3, np.zeros(len(faces), dtype=np.int64))
    pieces += [np.stack(corners, axis=1) for corners in ((a, p, r), (p, b, q), (r, q, c), (p, q, r))]
    # A face with k cuts has become k + 1.
    return np.concatenate(pieces), np.concatenate([np.tile(np.flatnonzero(cuts == k), k + 1) for k in range(4)])


def _turn(faces: np.ndarray, middle: np.ndarray, chosen: np.ndarray, start: np.ndarray):
    """Corners and midpoints [3, N] of the chosen faces, turned so that corner `start` comes first."""
    order = (start[chosen, None] + np.arange(3)) % 3
    return np.take_along_axis(faces[chosen], order, 1).T, np.take_along_axis(middle[chosen], order, 1).T


def _freeze(values: np.ndarray, dtype) -> np.ndarray:
    frozen = np.array(values, dtype=dtype, order="C")
    frozen.setflags(write=False)
    return frozen
