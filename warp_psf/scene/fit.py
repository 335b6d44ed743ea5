"""Simple solids that a mesh lies in or is: the smallest sphere around it, a box or rectangle, a tessellated sphere."""

from __future__ import annotations

import numpy as np

from warp_psf.scene.topology import area_vectors, coordinate_step, edge_lengths, merge_positions, pair_edges

# How far a vertex may be from a box's or rectangle's surface, in bounding radii: float32 rounding.
SLAB_DISTANCE = 1e-6
# How far areas may differ for a surface to be called a box or a rectangle, as a fraction of its area.
SLAB_AREA = 1e-5
# Faces whose normals differ by no more than this cosine lie on one side of a box (0.8 degrees).
SAME_SIDE = 1.0 - 1e-4
# A tessellated sphere: spread of the vertices' distances and offset of the centre, as fractions of the radius, the
# fewest faces, and the longest edge in radii (an icosahedron subdivided once has 80 faces and edges of 0.62 radii).
SPHERE_SPREAD = 1e-4
SPHERE_OFFSET = 1e-5
SPHERE_FACES = 80
SPHERE_EDGE = 0.65


def bounding_sphere(points: np.ndarray) -> tuple[np.ndarray, float]:
    """The smallest sphere around points [N, 3], as center [3] and radius.

    The farthest point joins the few that hold the sphere, until none is outside (an LP-type problem: the radius only
    grows, so it ends; Gaertner 1999, "Fast and robust smallest enclosing balls").
    """
    center, radius, held = points[0], 0.0, points[:1]
    while True:
        farthest = points[((points - center) ** 2).sum(axis=1).argmax()]
        new_center, new_radius, held = _smallest_of_few(np.vstack([held, farthest]))
        # No growth beyond rounding: the farthest point was already on the sphere.
        if new_radius <= radius * (1.0 + 1e-12):
            break
        center, radius = new_center, new_radius
    return center, float(np.sqrt(((points - center) ** 2).sum(axis=1).max()))


def _smallest_of_few(points: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
    """The smallest sphere around at most five points, with those (at most four) that hold it."""
    best = (points[0], np.inf, points)
    count = len(points)
    for subset in range(1, 2**count):
        chosen = points[[i for i in range(count) if subset >> i & 1]]
        if len(chosen) > 4:
            continue
        # The circumcentre within the chosen points' own span: 2 (p_i - p_0) . x = |p_i - p_0|^2.
        edges = chosen[1:] - chosen[0]
        offset = np.linalg.lstsq(2.0 * edges, (edges**2).sum(axis=1), rcond=None)[0] if len(edges) else np.zeros(3)
        center = chosen[0] + offset
        reach = float(np.sqrt(((points - center) ** 2).sum(axis=1).max()))
        if reach < best[1]:
            best = (center, reach, chosen)
    return best


def find_sphere(points: np.ndarray, faces: np.ndarray, center: np.ndarray, closed: bool) -> float | None:
    """The radius if the mesh is a finely tessellated sphere about the origin."""
    distance = np.linalg.norm(points[np.unique(faces)] - center, axis=1)
    radius = float(distance.mean())
    round_enough = np.ptp(distance) <= SPHERE_SPREAD * radius and np.linalg.norm(center) <= SPHERE_OFFSET * radius
    fine_enough = len(faces) >= SPHERE_FACES and edge_lengths(points, faces).max() <= SPHERE_EDGE * radius
    return radius if closed and round_enough and fine_enough else None


def find_slab(points: np.ndarray, faces: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """(center, rotation, half_extents) if the surface is a box or a flat rectangle, else None."""
    vectors = 0.5 * area_vectors(points, faces)
    area = np.linalg.norm(vectors, axis=1)
    axes, weights = _main_directions(vectors)
    if sum(weights) < (1.0 - SLAB_AREA) * area.sum():
        return None
    # The largest side has the most exact normal. A flat surface has no second one: there the border shows the axes.
    order = np.argsort(weights)[::-1]
    third = axes[order[0]]
    if weights[order[0]] < (1.0 - SLAB_AREA) * area.sum():
        first = axes[order[1]]
    else:
        border = _border(points, faces)
        first = _main_directions(border)[0][0] if len(border) else third
    first = first - (first @ third) * third
    if np.linalg.norm(first) < 0.5:
        return None
    first = first / np.linalg.norm(first)
    rotation = np.stack([first, np.cross(third, first), third], axis=1)
    local = points @ rotation
    low, high = local[faces].min(axis=(0, 1)), local[faces].max(axis=(0, 1))
    half, middle = 0.5 * (high - low), 0.5 * (high + low)
    near = SLAB_DISTANCE * radius + 2.0 * coordinate_step(points)
    # Per side: the area of the faces that lie wholly on it. Vertices on a side suffice: three make the face lie there.
    corners = (local - middle)[faces]
    # Vertices that are `near` off change a side's area by `near` times its outline.
    slack = SLAB_AREA * area.sum() + 8.0 * near * half.sum()
    flat = half[2] <= near
    sides = [(2, 1.0)] if flat else [(axis, sign) for axis in range(3) for sign in (-1.0, 1.0)]
    for axis, sign in sides:
        inside = (np.abs(corners[:, :, axis] - sign * half[axis]) <= near).all(axis=1)
        inside &= np.abs(vectors @ rotation[:, axis]) >= SAME_SIDE * area
        expected = 4.0 * half[(axis + 1) % 3] * half[(axis + 2) % 3]
        if abs(area[inside].sum() - expected) > slack:
            return None
    whole = 4.0 * half[0] * half[1] if flat else 8.0 * (half[0] * half[1] + half[1] * half[2] + half[2] * half[0])
    if abs(area.sum() - whole) > slack:
        return None
    half[2] = 0.0 if flat else half[2]
    return rotation @ middle, rotation, half


def _main_directions(vectors: np.ndarray) -> tuple[list[np.ndarray], list[float]]:
    """At most three unit directions of vectors [N, 3], either way along each, and the length that runs along them.

    The area vectors of one flat side add up to what its outline alone decides, so small faces do not spoil it.
    """
    directions, weights = [], []
    while len(vectors) and len(directions) < 3:
        length = np.linalg.norm(vectors, axis=1)
        cosine = vectors @ vectors[length.argmax()] / (length * length.max())
        along = np.abs(cosine) >= SAME_SIDE
        total = (vectors[along] * np.sign(cosine[along])[:, None]).sum(axis=0)
        directions.append(total / np.linalg.norm(total))
        weights.append(float(length[along].sum()))
        vectors = vectors[~along]
    return directions, weights


def _border(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The edges that have a face on one side only, as vectors [N, 3]."""
    alone = np.ones(faces.size, dtype=bool)
    (one, other), _ = pair_edges(merge_positions(points)[0][faces])
    alone[one] = alone[other] = False
    return (points[np.roll(faces, -1, axis=1)] - points[faces]).reshape(-1, 3)[alone]
