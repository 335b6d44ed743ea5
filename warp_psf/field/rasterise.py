"""Rasterising triangles into visibility masks (Kautz 2004, section 3.1.1): the part that knows where they are."""

import numpy as np
import warp as wp

from warp_psf.basis.visibility_mask import BATCH, MaskTables, batch, cover, mask, plane_snippet
from warp_psf.device import launch
from warp_psf.field.blockers import BlockerSet

# A triangle with less than this volume between unit vectors to its corners is seen edge-on: it spans 1e-6 sr, a
# thousandth of a pixel, and its planes would be those of rounding.
EDGE_ON = 2.0e-6


@wp.struct
class BlockerTable:
    """The triangles of a deforming body that hide what lies behind them; see `BlockerSet`."""

    place: wp.array2d(dtype=wp.vec3)  # (world, vertex), metres, in the world
    faces: wp.array(dtype=wp.vec3i)  # (triangle)
    far: wp.array(dtype=wp.int32)  # (coarse triangle): all of them
    first_of_cluster: wp.array(dtype=wp.int32)  # (cluster + 1)
    lower: wp.array2d(dtype=wp.vec3)  # (world, cluster): corners of its box, metres
    upper: wp.array2d(dtype=wp.vec3)  # (world, cluster)
    two_sided: wp.bool


BlockerTables = wp.array(dtype=BlockerTable)


@wp.struct
class Horizon:
    """The frame in which a mask is drawn: its origin, and axes the last of which is the normal."""

    origin: wp.vec3
    tangent: wp.vec3
    bitangent: wp.vec3
    normal: wp.vec3


@wp.kernel(enable_backward=False, module="unique")
def _bound_clusters(first: int, which: int, blockers: BlockerTables):
    world, cluster = wp.tid()
    cluster += first
    lower = wp.vec3(1.0e30, 1.0e30, 1.0e30)
    upper = -lower
    for triangle in range(blockers[which].first_of_cluster[cluster], blockers[which].first_of_cluster[cluster + 1]):
        corners = blockers[which].faces[triangle]
        for corner in range(3):
            place = blockers[which].place[world, corners[corner]]
            lower = wp.min(lower, place)
            upper = wp.max(upper, place)
    blockers[which].lower[world, cluster] = lower
    blockers[which].upper[world, cluster] = upper


@wp.func
def make_horizon(origin: wp.vec3, normal: wp.vec3) -> Horizon:
    horizon = Horizon()
    level = wp.sqrt(normal[0] * normal[0] + normal[1] * normal[1])
    x = wp.where(level > 1.0e-6, normal[0] / level, 1.0)
    y = wp.where(level > 1.0e-6, normal[1] / level, 0.0)
    horizon.origin = origin
    horizon.tangent = wp.vec3(normal[2] * x, normal[2] * y, -level)
    horizon.bitangent = wp.vec3(-y, x, 0.0)
    horizon.normal = normal
    return horizon


def _planes_snippet() -> str:
    """C++: the corners of a batch fetched one by one, then all of the batch side by side."""
    edges = [("a", "b", 0), ("b", "c", 1), ("c", "a", 2)]
    crosses = "".join(
        f"""
        const float x_{k} = side * ({p}y * {q}z - {p}z * {q}y), y_{k} = side * ({p}z * {q}x - {p}x * {q}z);
        const float z_{k} = side * ({p}x * {q}y - {p}y * {q}x);
        int plane_{k};
        {plane_snippet(f"x_{k}", f"y_{k}", f"z_{k}", f"plane_{k}")}
        found.data[{k}][lane] = hides ? plane_{k} : 0;
        """
        for p, q, k in edges
    )
    corners = "".join(
        f"""
        const float {p}u = corners[{3 * k}][lane], {p}v = corners[{3 * k + 1}][lane], {p}w = corners[{3 * k + 2}][lane];
        const float {p}x = t[0] * {p}u + t[1] * {p}v + t[2] * {p}w, {p}y = s[0] * {p}u + s[1] * {p}v + s[2] * {p}w;
        const float {p}z = n[0] * {p}u + n[1] * {p}v + n[2] * {p}w;
        const float {p}{p} = {p}x * {p}x + {p}y * {p}y + {p}z * {p}z;
        """
        for k, p in enumerate("abc")
    )
    return f"""
    const auto& table = blockers.data[which];
    const wp::vec3* places = table.place.data + world * table.place.shape[1];
    const wp::vec3 o = horizon.origin, t = horizon.tangent, s = horizon.bitangent, n = horizon.normal;
    float corners[9][{BATCH}];
    bool drawn[{BATCH}];
    for (int lane = 0; lane < {BATCH}; ++lane) {{
        drawn[lane] = lane < count && !(skipped >> lane & 1u);
        const int triangle = list.data[lane < count ? first + lane : first];
        for (int corner = 0; corner < 3; ++corner)
            for (int axis = 0; axis < 3; ++axis)
                corners[3 * corner + axis][lane] = places[table.faces.data[triangle][corner]][axis] - o[axis];
    }}
    const bool two_sided = table.two_sided;
    wp::mat_t<3, {BATCH}, int> found;
    for (int lane = 0; lane < {BATCH}; ++lane) {{
        {corners}
        const float volume = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx);
        const float side = volume > 0.0f ? 1.0f : -1.0f;
        const bool faces = two_sided | (volume < 0.0f);
        const bool spans = volume * volume > {EDGE_ON**2:.9e}f * aa * bb * cc;
        const bool hides = drawn[lane] & ((az > 0.0f) | (bz > 0.0f) | (cz > 0.0f)) & faces & spans;
        {crosses}
    }}
    return found;
    """


@wp.func_native(_planes_snippet())
def find_planes(
    world: int,
    which: int,
    first: int,
    count: int,
    skipped: wp.uint32,
    list: wp.array(dtype=wp.int32),
    horizon: Horizon,
    blockers: BlockerTables,
) -> batch:
    """The planes above which triangles lie as they are seen from the origin; zeros for those that hide nothing.

    They are the `count` triangles from `first` on in a list, at most a batch of them, less those whose bits are set in
    `skipped`. Nothing is hidden by triangles below the horizon, by those seen edge-on, and by the backs of a closed
    surface, whose front hides as much. What lies above three planes is the image, wherever the horizon cuts it.
    """


@wp.func
def is_above(world: int, which: int, cluster: int, horizon: Horizon, blockers: BlockerTables) -> bool:
    """Whether any of a cluster's box rises above the horizon."""
    lower = blockers[which].lower[world, cluster]
    upper = blockers[which].upper[world, cluster]
    n = horizon.normal
    reach = wp.dot(wp.vec3(wp.abs(n[0]), wp.abs(n[1]), wp.abs(n[2])), upper - lower)
    return wp.dot(n, upper + lower - 2.0 * horizon.origin) + reach > 0.0


@wp.func
def draw_all(world: int, which: int, horizon: Horizon, blockers: BlockerTables, masks: MaskTables) -> mask:
    """What all coarse triangles of a body hide."""
    covered = mask()
    for cluster in range(blockers[which].first_of_cluster.shape[0] - 1):
        if is_above(world, which, cluster, horizon, blockers):
            end = blockers[which].first_of_cluster[cluster + 1]
            for index in range(blockers[which].first_of_cluster[cluster], end, wp.static(BATCH)):
                planes = find_planes(
                    world, which, index, end - index, wp.uint32(0), blockers[which].far, horizon, blockers
                )
                covered = cover(covered, masks[0].planes, planes)
    return covered


def make_blocker_table(blockers: BlockerSet, place: wp.array) -> BlockerTable:
    """The triangles of a body, and room for the boxes of their clusters. place: vec3 (worlds, vertices)."""
    table, device = BlockerTable(), place.device
    clusters = len(blockers.first_of_cluster) - 1
    table.place = place
    table.faces = wp.array(blockers.faces, dtype=wp.vec3i, device=device)
    table.far = wp.array(np.arange(blockers.first_of_cluster[-1]), dtype=wp.int32, device=device)
    table.first_of_cluster = wp.array(blockers.first_of_cluster, dtype=wp.int32, device=device)
    table.lower = wp.zeros((place.shape[0], clusters), dtype=wp.vec3, device=device)
    table.upper = wp.zeros((place.shape[0], clusters), dtype=wp.vec3, device=device)
    table.two_sided = blockers.two_sided
    return table


def bound_clusters(tables: wp.array, device: wp.Device) -> None:
    """Finds the boxes of the clusters of all bodies where their vertices are now."""
    for which, table in enumerate(tables.tables):
        launch(_bound_clusters, table.lower.shape, [which, tables], [], device)
