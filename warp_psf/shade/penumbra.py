"""Which share of a small source a body hides, from how far the source lies within its silhouette."""

import warp as wp

from warp_psf.field.silhouette_lanes import LANES, lanes

# A source is looked at in this many smaller discs, so that what is thinner than the source hides its part only.
PARTS = 4
# Their centres lie at this share of the source's radius from its middle, and they are half as wide: together they
# spread as the source does, (1/2)^2 / 4 + 0.612^2 / 2 = 1 / 4.
PART_PLACE, PART_RADIUS = 0.6124, 0.5
# A box seen from outside has no more edges in its silhouette.
six_normals = wp.types.matrix(shape=(6, 3), dtype=wp.float32)


@wp.func
def disc_share(distance: float, radius: float) -> float:
    """The share of a disc on one side of a straight edge; distance: of its centre from the edge, above zero there."""
    x = wp.clamp(distance / radius, -1.0, 1.0)
    return 0.5 + (x * wp.sqrt(1.0 - x * x) + wp.asin(x)) / wp.pi


def _disc_shares_snippet() -> str:
    # The arc sine is Abramowitz and Stegun's 4.4.45, which is off by 7e-5 at most.
    return f"""
    wp::vec_t<{LANES}, float> share;
    for (int k = 0; k < {LANES}; ++k) {{
        const float ratio = distance[k] / radius[k];
        const float x = ratio < -1.0f ? -1.0f : (ratio > 1.0f ? 1.0f : ratio), size = x < 0.0f ? -x : x;
        const float arc = 1.5707963f - sqrtf(1.0f - size)
            * (1.5707288f + size * (-0.2121144f + size * (0.0742610f - 0.0187293f * size)));
        const float part = size * sqrtf(1.0f - x * x) + arc;
        share[k] = 0.5f + (x < 0.0f ? -part : part) * 0.31830989f;
    }}
    return share;
    """


@wp.func_native(_disc_shares_snippet())
def disc_shares(distance: lanes, radius: lanes) -> lanes:
    """`disc_share` of several discs."""


@wp.func
def part_direction(direction: wp.vec3, radius: float, part: int) -> wp.vec3:
    """The direction to the middle of one of a source's parts."""
    helper = wp.where(wp.abs(direction[2]) < 0.7, wp.vec3(0.0, 0.0, 1.0), wp.vec3(1.0, 0.0, 0.0))
    a = wp.normalize(wp.cross(helper, direction))
    b = wp.cross(direction, a)
    along = wp.where(part < 2, a, b)
    side = wp.where(part % 2 == 0, 1.0, -1.0)
    return wp.normalize(direction + (side * wp.static(PART_PLACE) * wp.tan(wp.min(radius, 1.2))) * along)


@wp.func
def sphere_distance(direction: wp.vec3, offset: wp.vec3, radius: float) -> float:
    """The angle from a direction to the rim of a sphere at `offset`, above zero within it, radians."""
    distance = wp.max(wp.length(offset), 1.0e-9)
    # From the chord, which keeps its digits for small angles.
    apart = 2.0 * wp.asin(wp.min(0.5 * wp.length(direction - offset / distance), 1.0))
    return wp.asin(wp.min(radius / distance, 1.0)) - apart


@wp.struct
class BoxOutline:
    """The silhouette of a box from one point, in the box's frame: a convex cone between planes through that point."""

    inward: six_normals  # unit normals of the planes, to the box's side
    count: wp.int32  # of the planes; 0 from inside the box


@wp.func
def box_outline(p: wp.vec3, half: wp.vec3) -> BoxOutline:
    """The outline of a box about the origin seen from p, both in the box's frame."""
    outline = BoxOutline()
    edges = int(12)  # a variable keeps the loop from being unrolled
    for edge in range(edges):
        axis = edge / 4
        u = (axis + 1) % 3
        v = (axis + 2) % 3
        side_u = wp.where(edge % 2 == 0, -1.0, 1.0)
        side_v = wp.where(edge % 4 < 2, -1.0, 1.0)
        # Of the faces beside an edge of the silhouette one is seen.
        if (side_u * p[u] > half[u]) != (side_v * p[v] > half[v]):
            start = wp.vec3()
            start[u] = side_u * half[u] - p[u]
            start[v] = side_v * half[v] - p[v]
            start[axis] = -p[axis]
            along = wp.vec3()
            along[axis] = 1.0
            inward = wp.normalize(wp.cross(start, along))
            outline.inward[outline.count] = wp.where(wp.dot(inward, p) > 0.0, -inward, inward)
            outline.count += 1
    return outline


@wp.func
def outline_distance(outline: BoxOutline, direction: wp.vec3) -> float:
    """The angle from a direction of the box's frame to its silhouette, above zero within it.

    Within it the nearest of its edges counts, and outside it the one that is furthest before the direction.
    """
    nearest = float(1.0)
    for plane in range(outline.count):
        nearest = wp.min(nearest, wp.dot(outline.inward[plane], direction))
    # From inside everything is covered.
    return wp.where(outline.count == 0, 1.0, wp.asin(wp.clamp(nearest, -1.0, 1.0)))
