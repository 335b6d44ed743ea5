"""Which share of a small source a body hides, from how far the source lies within its silhouette."""

import warp as wp

# A source is looked at in this many smaller discs, so that what is thinner than the source hides its part only.
PARTS = 4
# Their centres lie at this share of the source's radius from its middle, and they are half as wide: together they
# spread as the source does, (1/2)^2 / 4 + 0.612^2 / 2 = 1 / 4.
PART_PLACE, PART_RADIUS = 0.6124, 0.5


@wp.func
def disc_share(distance: float, radius: float) -> float:
    """The share of a disc on one side of a straight edge; distance: of its centre from the edge, above zero there."""
    x = wp.clamp(distance / radius, -1.0, 1.0)
    return 0.5 + (x * wp.sqrt(1.0 - x * x) + wp.asin(x)) / wp.pi


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


@wp.func
def slab_distance(direction: wp.vec3, p: wp.vec3, half: wp.vec3) -> float:
    """The angle from a direction to the silhouette of a box about the origin, seen from p, above zero within it.

    All in the box's frame. The silhouette is convex: within it the nearest of its edges counts, and outside it the one
    that is furthest before the direction.
    """
    nearest = float(1.0)
    found = bool(False)
    edges = int(12)  # a variable keeps the loop from being unrolled
    for edge in range(edges):
        axis = edge / 4
        u = (axis + 1) % 3
        v = (axis + 2) % 3
        side_u = wp.where(edge % 2 == 0, -1.0, 1.0)
        side_v = wp.where(edge % 4 < 2, -1.0, 1.0)
        if (side_u * p[u] > half[u]) != (side_v * p[v] > half[v]):
            start = wp.vec3()
            start[u] = side_u * half[u] - p[u]
            start[v] = side_v * half[v] - p[v]
            start[axis] = -p[axis]
            along = wp.vec3()
            along[axis] = 1.0
            across = wp.normalize(wp.cross(start, along))
            # Its sign so that the box lies on the positive side.
            if wp.dot(across, -p) < 0.0:
                across = -across
            nearest = wp.min(nearest, wp.dot(across, direction))
            found = True
    if not found:
        # From inside everything is covered.
        return wp.static(1.0)
    return wp.asin(wp.clamp(nearest, -1.0, 1.0))
