"""Composing occluders: the visibility that the bodies around a receiver leave, at the directions of a quadrature.

Visibilities are multiplied at the directions (Zhou 2005; Tamura 2006), or their logarithms are added as SH vectors and
exponentiated once (Ren 2006). Each occluder has its way, and what both leave is multiplied; neither needs an order.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from warp_psf.basis.sh_exp import make_sh_exp
from warp_psf.scene.geometry import GeometryTables, Placed, PoseTables, find_placed
from warp_psf.shade.coverage import SLAB_SHAPE
from warp_psf.shade.fades import Light, before_plane, fade_length, horizon_fade, size_fade, sphere_nearness
from warp_psf.shade.occluders import make_occluders
from warp_psf.shade.spheres import CLUSTER, CutTables, make_spheres

# A slab whose corners rise above the receiver's tangent plane by less than this share of its half-diagonal counts as
# below it: the floor beside a receiver on the same floor.
SLAB_HORIZON = 1.0e-5


@cache
def make_occlude(order: int) -> SimpleNamespace:
    """Device functions for `order` bands: `matters` and `visibility_at`, beside those of `make_occluders`."""
    kit = make_occluders(order)
    values, OcclusionTables, logs = kit.values, kit.OcclusionTables, make_sh_exp(order)
    # Of the environment and of a light.
    both_values = wp.types.matrix((2, kit.points), wp.float32)
    both_logarithms, add_sphere = make_spheres(order).both_logarithms, make_spheres(order).add_sphere

    @wp.func_native(_multiply_snippet(kit.points))
    def multiply(visible: both_values, covered: values, weights: wp.vec2) -> both_values: ...

    @wp.func
    def matters(
        entity: int,
        own: int,
        p: wp.vec3,
        n: wp.vec3,
        placed: Placed,
        o: OcclusionTables,
    ) -> float:
        """How far an entity can take light from a receiver at p with normal n: 0 not at all, its opacity fully.

        Without a normal, a zero vector, there is no horizon.
        """
        opacity = o[0].occluders.opacity[entity]
        if entity == own or opacity <= 0.0:
            return 0.0
        offset = placed.center - p
        height = wp.dot(n, offset)
        if height < -placed.radius:
            return 0.0
        size = opacity * size_fade(placed.radius, wp.dot(offset, offset))
        if o[0].occluders.shape[entity] == wp.static(SLAB_SHAPE):
            half = o[0].occluders.slab_half[entity]
            n_slab = wp.transpose(placed.rotation * o[0].occluders.slab_rotation[entity]) * n
            rise = wp.abs(n_slab[0]) * half[0] + wp.abs(n_slab[1]) * half[1] + wp.abs(n_slab[2]) * half[2]
            above = height + rise > wp.static(SLAB_HORIZON) * placed.radius or wp.length_sq(n) == 0.0
            return size * wp.where(above, 1.0, 0.0)
        return size * horizon_fade(height, placed.radius)

    @wp.func
    def nearness(
        entity: int,
        p: wp.vec3,
        placed: Placed,
        light: Light,
        o: OcclusionTables,
    ) -> float:
        """How far an entity is nearer to p than a light: 1 in front of it, 0 behind it, smooth between."""
        if o[0].occluders.shape[entity] != wp.static(SLAB_SHAPE):
            return sphere_nearness(p, placed.center, placed.radius, light)
        half = o[0].occluders.slab_half[entity]
        to_slab = wp.transpose(placed.rotation * o[0].occluders.slab_rotation[entity])
        facing_slab = to_slab * light.facing
        reach = wp.abs(facing_slab[0]) * half[0] + wp.abs(facing_slab[1]) * half[1] + wp.abs(facing_slab[2]) * half[2]
        before = before_plane(wp.dot(light.facing, placed.center - light.center) + reach, light)
        origin = placed.position + placed.rotation * o[0].occluders.slab_center[entity]
        p_slab = to_slab * (p - origin)
        light_slab = to_slab * (light.center - origin)
        apart = float(-1.0e30)
        for axis in range(3):
            side = wp.where(p_slab[axis] < 0.0, -1.0, 1.0)
            ahead = wp.min(side * p_slab[axis], side * light_slab[axis] - light.radius) - half[axis]
            apart = wp.max(apart, ahead)
        return before * (1.0 - wp.clamp(apart / fade_length(light), 0.0, 1.0))

    @wp.func
    def weights_of(
        entity: int,
        own: int,
        p: wp.vec3,
        n: wp.vec3,
        placed: Placed,
        light: Light,
        o: OcclusionTables,
    ) -> wp.vec2:
        """How far an entity can take light from a receiver: from the environment, and from a light."""
        weight = matters(entity, own, p, n, placed, o)
        nearer = float(0.0)
        if weight > 0.0 and light.radius >= 0.0:
            nearer = weight * nearness(entity, p, placed, light, o)
        return wp.vec2(weight, nearer)

    # What is accumulated over entities goes in and out of a function. In place, under a condition, a compiler would
    # copy it at every branch.

    @wp.func
    def pass_entity(
        visible: both_values,
        world: int,
        entity: int,
        own: int,
        p: wp.vec3,
        n: wp.vec3,
        light: Light,
        geometry: GeometryTables,
        poses: PoseTables,
        o: OcclusionTables,
    ) -> both_values:
        """Multiplies visibilities with what an entity leaves, if it is not one whose logarithm is added."""
        if o[0].log_field[entity] >= 0:
            return visible
        placed = find_placed(world, entity, geometry, poses)
        weights = weights_of(entity, own, p, n, placed, light, o)
        if weights[0] <= 0.0:
            return visible
        return multiply(visible, kit.covered_by(world, entity, p, placed, o), weights)

    @wp.func
    def pass_sheet(
        visible: both_values,
        world: int,
        sheet: int,
        own: int,
        p: wp.vec3,
        n: wp.vec3,
        light: Light,
        geometry: GeometryTables,
        poses: PoseTables,
        o: OcclusionTables,
    ) -> both_values:
        """Multiplies visibilities with what a deforming sheet leaves."""
        entity = o[0].sheet_entity[sheet]
        placed = find_placed(world, entity, geometry, poses)
        # One that is not shown has no radius.
        if entity == own or placed.radius <= 0.0:
            return visible
        offset = placed.center - p
        weight = o[0].sheet_opacity[sheet] * size_fade(placed.radius, wp.dot(offset, offset))
        weight *= horizon_fade(wp.dot(n, offset), placed.radius)
        if weight <= 0.0:
            return visible
        nearer = float(0.0)
        if light.radius >= 0.0:
            nearer = sphere_nearness(p, placed.center, placed.radius, light)
        return multiply(visible, kit.covered_by_sheet(world, sheet, p, n, o), wp.vec2(weight, weight * nearer))

    @wp.func
    def add_entity(
        logarithms: both_logarithms,
        world: int,
        entity: int,
        own: int,
        p: wp.vec3,
        n: wp.vec3,
        light: Light,
        geometry: GeometryTables,
        poses: PoseTables,
        o: OcclusionTables,
    ) -> both_logarithms:
        """Adds the logarithm of what an entity leaves, if it is not one whose visibility is multiplied."""
        if o[0].log_field[entity] < 0:
            return logarithms
        placed = find_placed(world, entity, geometry, poses)
        weights = weights_of(entity, own, p, n, placed, light, o)
        if weights[0] <= 0.0:
            return logarithms
        return logarithms + wp.outer(weights, kit.logarithm_of(world, entity, p, placed, o))

    @wp.func
    def visibility_at(
        world: int,
        receiver: int,
        own: int,
        light_entity: int,
        light_facing: wp.vec3,
        p: wp.vec3,
        n: wp.vec3,
        geometry: GeometryTables,
        poses: PoseTables,
        o: OcclusionTables,
        cuts: CutTables,
    ):
        """Visibility past every entity but `own`, and past those nearer than a light, -1 for none.

        receiver: its number among those of `cuts`. light_facing: see `Light`.
        """
        light = Light()
        light.radius = -1.0
        if light_entity >= 0:
            placed = find_placed(world, light_entity, geometry, poses)
            light.center = placed.center
            light.radius = placed.radius
            light.facing = light_facing
        visible = both_values(1.0)
        entities = geometry[0].entity_mesh.shape[0]
        for entity in range(entities):
            visible = pass_entity(visible, world, entity, own, p, n, light, geometry, poses, o)
        for sheet in range(o[0].sheet_entity.shape[0]):
            visible = pass_sheet(visible, world, sheet, own, p, n, light, geometry, poses, o)
        logarithms = both_logarithms()
        if o[0].added > 0:
            for entity in range(entities):
                logarithms = add_entity(logarithms, world, entity, own, p, n, light, geometry, poses, o)
        if cuts[0].count.shape[1] > 0:
            cluster = receiver / wp.static(CLUSTER)
            for place in range(cuts[0].count[world, cluster]):
                node = cuts[0].node[world, cluster, place]
                logarithms = add_sphere(logarithms, world, node, own, p, n, light, o[0].spheres, o[0].exponential)
        if logarithms[0, 0] != 0.0:
            left = logs.exponential_at_directions(logarithms[0], o[0].exponential)
            visible[0] = wp.cw_mul(visible[0], left)
            if light_entity >= 0:
                left = logs.exponential_at_directions(logarithms[1], o[0].exponential)
                visible[1] = wp.cw_mul(visible[1], left)
        return visible[0], visible[1]

    return SimpleNamespace(
        **vars(kit),
        matters=matters,
        nearness=nearness,
        visibility_at=visibility_at,
    )


def _multiply_snippet(points: int) -> str:
    """C++: both visibilities, each times what is left of 1 by its share of the coverage."""
    return f"""
    wp::mat_t<2, {points}, float> result;
    for (int row = 0; row < 2; ++row)
        for (int i = 0; i < {points}; ++i)
            result.data[row][i] = visible.data[row][i] * (1.0f - weights[row] * covered[i]);
    return result;
    """
