"""Which bodies send light to a receiver, and what stands between them and it.

Of two bodies in the same direction the nearer one is seen. The papers sort bodies by distance and let each hide all
behind it, which pops when two of them swap places. Here each pair has a share of its own instead, which is 1 where one
body lies before the other, 0 where it lies behind, and passes smoothly in between.
"""

import math
from functools import cache
from types import SimpleNamespace

import warp as wp

from warp_psf.basis import sh
from warp_psf.basis.directions import sum_in_lanes
from warp_psf.scene.geometry import GeometryTables, PoseTables, find_placed
from warp_psf.shade.area import make_area
from warp_psf.shade.direct import legendre_series
from warp_psf.shade.occlude import make_occlude
from warp_psf.shade.patches import PatchTables, slab_from_world, slab_origin
from warp_psf.shade.relations import faces_ahead

# As many bodies send light to a receiver at once; where there are more, those that take up least of its view fade out.
MOST_SOURCES = 24
# The gain at the horizon is bounded: right below it both irradiances are next to nothing.
MOST_GAIN = 1.5
# Two bounding spheres whose cones overlap by this share of the way from touching to standing behind one another hide
# one another as far as their distances say; towards touching that fades.
TOUCHING = 0.25


@wp.func
def overlap(toward: wp.vec3, sine: float, other_toward: wp.vec3, other_sine: float) -> float:
    """How far the cones of two bounding spheres overlap: 0 not at all, 1 enough to hide one another."""
    # What lies beside another hides nothing of it, although band-limited coverages overlap there.
    if sine >= 1.0 or other_sine >= 1.0:
        return 1.0
    apart = wp.sqrt((1.0 - sine * sine) * (1.0 - other_sine * other_sine)) - sine * other_sine
    together = wp.dot(toward, other_toward) - apart
    return wp.clamp(together / (wp.static(TOUCHING) * wp.max(1.0 - apart, 1.0e-9)), 0.0, 1.0)


@cache
def make_between(order: int) -> SimpleNamespace:
    """Device functions for `order` bands: `find_sources`, and the type `lists` of the sources' coverages."""
    kit = make_occlude(order)
    OcclusionTables = kit.OcclusionTables
    lists = wp.types.matrix((MOST_SOURCES, kit.points), wp.float32)
    values, half_values = kit.values, kit.half_values
    area = make_area(order)
    ids = wp.types.vector(MOST_SOURCES, wp.int32)
    numbers = wp.types.vector(MOST_SOURCES, wp.float32)
    ranks = wp.types.vector(MOST_SOURCES + 1, wp.float32)
    directions = wp.types.matrix((MOST_SOURCES, 3), wp.float32)

    @wp.func_native(_moments_snippet(kit.points))
    def moments(weighted: values, quadrature: wp.array(dtype=half_values)) -> wp.vec4:
        """The integrals of a function times the direction, and of the function, from its weighted values."""

    @wp.func_native(_disc_snippet(order))
    def disc_irradiance(x: float, squared: float, cosine: float) -> float:
        """The irradiance of a uniform disc on `order` bands: x, squared: cosine and squared sine of its half-angle."""

    @wp.struct
    class Sources:
        """The bodies around a receiver."""

        count: wp.int32
        entity: ids
        weight: numbers  # how far each matters: 0 not at all, 1 fully
        toward: directions  # unit, to the centre of each bounding sphere
        distance: numbers  # to there, metres
        radius: numbers  # of the bounding spheres, metres
        sine: numbers  # of the angle that each spans, 1 from within
        ahead: ids  # of a slab, the faces before which the receiver lies; see `faces_ahead`

    @wp.func
    def share_of(
        world: int, entity: int, p: wp.vec3, geometry: GeometryTables, poses: PoseTables, patches: PatchTables
    ) -> float:
        """About how much of the view a body takes up: (radius / distance)^2, for slabs to their nearest point."""
        radius = geometry[0].radius[entity]
        center = poses[0].position[world, entity] + poses[0].rotation[world, entity] * geometry[0].center[entity]
        squared = wp.length_sq(center - p)
        if patches[0].first_face[entity] >= 0:
            p_slab = slab_from_world(world, entity, poses, patches) * (p - slab_origin(world, entity, poses, patches))
            half = patches[0].slab_half[entity]
            outside = wp.max(wp.vec3(wp.abs(p_slab[0]), wp.abs(p_slab[1]), wp.abs(p_slab[2])) - half, wp.vec3())
            squared = wp.length_sq(outside)
        return radius * radius / wp.max(squared, 1.0e-12)

    @wp.func
    def weight_of(
        world: int,
        entity: int,
        own: int,
        p: wp.vec3,
        n: wp.vec3,
        threshold: float,
        geometry: GeometryTables,
        poses: PoseTables,
        patches: PatchTables,
        o: OcclusionTables,
    ) -> float:
        """How far a body matters to a receiver: those that take up less of its view than `threshold` do not."""
        placed = find_placed(world, entity, geometry, poses)
        weight = kit.matters(entity, own, p, n, placed, o)
        if weight > 0.0 and patches[0].first_face[entity] < 0:
            share = share_of(world, entity, p, geometry, poses, patches)
            weight *= wp.clamp(share / threshold - 1.0, 0.0, 1.0)
        return weight

    @wp.func
    def find_sources(
        world: int,
        own: int,
        p: wp.vec3,
        n: wp.vec3,
        threshold: float,
        geometry: GeometryTables,
        poses: PoseTables,
        patches: PatchTables,
        o: OcclusionTables,
    ) -> Sources:
        """The bodies that can send light to a receiver of the entity `own` at p with normal n."""
        sources = Sources()
        entities = geometry[0].entity_mesh.shape[0]
        smallest = float(0.0)
        if entities - 1 > wp.static(MOST_SOURCES):
            # The share of the first body for which there is no room; towards it the others fade.
            top = ranks()
            for entity in range(entities):
                if weight_of(world, entity, own, p, n, threshold, geometry, poses, patches, o) > 0.0:
                    share = share_of(world, entity, p, geometry, poses, patches)
                    place = int(wp.static(MOST_SOURCES))
                    if share > top[place]:
                        while place > 0 and share > top[wp.max(place - 1, 0)]:
                            top[place] = top[place - 1]
                            place -= 1
                        top[place] = share
            smallest = top[wp.static(MOST_SOURCES)]
        for entity in range(entities):
            weight = weight_of(world, entity, own, p, n, threshold, geometry, poses, patches, o)
            if weight > 0.0 and smallest > 0.0:
                share = share_of(world, entity, p, geometry, poses, patches)
                weight *= wp.clamp(share / smallest - 1.0, 0.0, 1.0)
            if weight > 0.0 and sources.count < wp.static(MOST_SOURCES):
                place = sources.count
                offset = (
                    poses[0].position[world, entity] + poses[0].rotation[world, entity] * geometry[0].center[entity] - p
                )
                distance = wp.max(wp.length(offset), 1.0e-9)
                sources.entity[place] = entity
                sources.weight[place] = weight
                sources.toward[place] = offset / distance
                sources.distance[place] = distance
                sources.radius[place] = geometry[0].radius[entity]
                sources.sine[place] = wp.min(geometry[0].radius[entity] / distance, 1.0)
                sources.ahead[place] = faces_ahead(world, entity, p, poses, patches)
                sources.count = place + 1
        return sources

    @wp.func
    def horizon_gain(covered: values, n: wp.vec3, weights: values, quadrature: wp.array(dtype=half_values)) -> float:
        """What the irradiance that a body causes is to be multiplied with: a band-limited cosine has a blurred horizon.

        The ratio between the irradiances of a uniform disc of the body's solid angle in its direction: in closed form
        over the same on SH. It matters to what stands on the same floor far away, or just rises above the horizon.
        """
        seen = moments(wp.cw_mul(covered, weights), quadrature)
        toward = wp.vec3(seen[0], seen[1], seen[2])
        length = wp.length(toward)
        if length <= 0.0 or seen[3] <= 0.0:
            return 0.0
        cosine = wp.dot(n, toward) / length
        # The solid angle is 2 pi (1 - x), x the cosine of the disc's half-angle.
        x = wp.clamp(1.0 - seen[3] / (2.0 * wp.pi), 0.0, 1.0)
        squared = wp.max(1.0 - x * x, 1.0e-9)
        exact = area.sphere_irradiance(cosine, 1.0 / squared)
        limited = disc_irradiance(x, squared, cosine)
        return wp.clamp(exact / wp.max(limited, 1.0e-9), 0.0, wp.static(MOST_GAIN))

    return SimpleNamespace(
        **vars(kit), lists=lists, numbers=numbers, Sources=Sources, find_sources=find_sources, horizon_gain=horizon_gain
    )


def _moments_snippet(points: int) -> str:
    half = points // 2
    odd = "(weighted[i + lane] - weighted[HALF + i + lane])".replace("HALF", str(half))
    even = odd.replace(" - ", " + ")
    terms = [f"{odd} * quadrature.data[{axis}][i + lane]" for axis in range(3)] + [even]
    sums = " ".join(f"{{ {sum_in_lanes(half, term)} result[{k}] = sums[0]; }}" for k, term in enumerate(terms))
    return f"wp::vec_t<4, float> result; {sums} return result;"


def _disc_snippet(order: int) -> str:
    """C++: the sum over bands of the disc's and the clamped cosine's coefficients, times P_l of the cosine."""
    receiving = legendre_series(sh.clamped_cosine(order))
    lines = [f"float total = {2 * math.pi * receiving[0]:.9e}f * squared / (1.0f + x);"]
    lines += ["float before = 1.0f, now = cosine, p_before = 1.0f, p = x, slope_before = 0.0f, slope = 1.0f;"]
    for band in range(1, order):
        # The integral of P_l over the disc is 2 pi squared P_l'(x) / (l (l + 1)).
        share = 2 * math.pi * receiving[band] / (band * (band + 1))
        lines += [f"total += {share:.9e}f * squared * slope * now;"]
        up, down = (2 * band + 1) / (band + 1), band / (band + 1)
        lines += [
            f"{{ const float next = {up:.9e}f * cosine * now - {down:.9e}f * before; before = now; now = next; }}",
            f"{{ const float next = slope_before + {2 * band + 1}.0f * p; slope_before = slope; slope = next; }}",
            f"{{ const float next = {up:.9e}f * x * p - {down:.9e}f * p_before; p_before = p; p = next; }}",
        ]
    return " ".join([*lines, "return total;"])
