"""Interreflection: light that bodies send to one another, several times (Iwasaki 2007, sections 3 and 5).

The light that leaves the bodies is followed at proxies: chosen vertices of bodies, and the texels of slabs. Per frame:

1. Basis irradiances: what each proxy receives of every basis function of every body around it, past what stands
   between, and of every face of a slab as the values that its radiance is to be multiplied with. They depend on poses
   alone and are kept for as long as nothing moves.
2. The light that leaves the proxies after direct light, as weights of the basis functions and as texels.
3. Bounces: the proxies' new light is a sum of products of what is kept with the weights, and gives new weights.
4. The sum over all bounces but the last, as weights and texels, is what a last gather at pixels shows.
"""

from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from warp_psf.device import launch
from warp_psf.field.radiance import SummedFields
from warp_psf.scene.geometry import DeviceScene, GeometryTables, PoseTables, find_placed, part_of
from warp_psf.scene.receiver import ReceiverTable
from warp_psf.shade.between import make_between, overlap
from warp_psf.shade.direct import DirectState
from warp_psf.shade.gloss import GlossState, make_gloss
from warp_psf.shade.occluders import OcclusionState
from warp_psf.shade.patches import (
    Patches,
    PatchTables,
    place_texels,
    slab_from_world,
    slab_origin,
)
from warp_psf.shade.pyramids import build_pyramids
from warp_psf.shade.relations import RelationTable, hides_body, hides_face, relate
from warp_psf.shade.stations import spread_light, spread_openness


@cache
def make_bounce(order: int, functions: int) -> SimpleNamespace:
    """The kernels and tables of the bounces on `order` bands with `functions` basis functions per body."""
    kit = make_gloss(order, functions)
    between = make_between(order)
    patch, radiant, values = kit.patch, kit.radiant, kit.values
    per_function = radiant.weights
    OcclusionTables, LightingTables = kit.OcclusionTables, kit.LightingTables
    RadianceTable = radiant.RadianceTable
    BodyTable, KeptTable, GlossTable = kit.BodyTable, kit.KeptTable, kit.GlossTable

    @wp.kernel(enable_backward=False, module="unique")
    def gather_basis(
        first: int,
        proxies: ReceiverTable,
        geometry: GeometryTables,
        poses: PoseTables,
        o: OcclusionTables,
        lighting: LightingTables,
        patches: PatchTables,
        relations: RelationTable,
        fields: RadianceTable,
        bodies: BodyTable,
        gloss: GlossTable,
        threshold: float,
        first_texel: int,
        kept: KeptTable,
    ):
        world, station = wp.tid()
        station += first
        proxy = kept.proxy[station]
        own = proxies.entity[world, proxy]
        if own < 0:
            return
        surface = kit.surface_of(world, proxy, proxies, geometry, poses, lighting)
        p = surface.position
        transfer = kit.transfer_of(surface, o[0].rows[world, own], lighting, o)
        transfer = wp.cw_mul(transfer, lighting[0].weights[0])
        sources = between.find_sources(world, own, p, surface.normal, threshold, geometry, poses, patches, o)
        entity_at = sources.entity
        weight = sources.weight
        toward = sources.toward
        distance = sources.distance
        radius = sources.radius
        sine = sources.sine
        ahead = sources.ahead
        open_to = values(1.0)
        shut = float(0.0)
        covers = between.lists()
        gain = between.numbers()
        for place in range(sources.count):
            placed = find_placed(world, entity_at[place], geometry, poses)
            covered = kit.covered_by(world, entity_at[place], p, placed, o)
            covers[place] = weight[place] * covered
            # Bodies together hide what they stand on. Walls take up all of each other's view, and hide nothing of it.
            flat = wp.where(patches[0].first_face[entity_at[place]] >= 0, 1.0, 0.0)
            open_to = wp.cw_mul(open_to, values(1.0) - (1.0 - flat) * covers[place])
            shut = wp.max(shut, flat * kit.sum_of_products(covers[place], transfer))
            gain[place] = between.horizon_gain(covered, surface.normal, lighting[0].weights[0], o[0].quadrature)
        count = int(0)
        faces = int(0)
        # What is accumulated is not changed under a condition, where a compiler would copy it at every branch.
        for place in range(sources.count):
            source = entity_at[place]
            if bodies.field[source] < 0:
                continue
            passed = values(1.0)
            for other in range(sources.count):
                share = float(0.0)
                if other != place:
                    share = overlap(toward[other], sine[other], toward[place], sine[place])
                if share > 0.0:
                    further = (distance[place] - distance[other]) / (radius[place] + radius[other])
                    share *= hides_body(world, entity_at[other], ahead[other], source, further, patches, relations)
                if share <= 0.0:
                    continue
                passed = wp.cw_mul(passed, values(1.0) - share * covers[other])
            p_body = wp.transpose(poses[0].rotation[world, source]) * (p - poses[0].position[world, source])
            where = radiant.locate(fields, bodies.field[source], p_body)
            light = (gain[place] * weight[place]) * wp.cw_mul(passed, transfer)
            rows = o[0].rows[world, source]
            kept.entity[world, station, count] = source
            kept.irradiance[world, station, count] = radiant.basis_irradiance(fields, where, kit.project(light, rows))
            kit.keep_moments(world, station, count, proxy, source, light, rows, o[0].quadrature, fields, where, gloss)
            count += 1
        for place in range(sources.count):
            source = entity_at[place]
            if patches[0].first_face[source] < 0:
                continue
            to_slab = slab_from_world(world, source, poses, patches)
            p_slab = to_slab * (p - slab_origin(world, source, poses, patches))
            for side in range(6):
                face = patches[0].first_face[source] + side
                if faces == kept.face.shape[2]:
                    continue
                if not patch.sees_face(world, face, p_slab, patches):
                    continue
                passed = patch.face_coverage(world, face, p_slab, to_slab, patches, o[0].quadrature)
                for other in range(sources.count):
                    share = float(0.0)
                    if other != place:
                        share = hides_face(world, entity_at[other], ahead[other], face, patches, relations)
                    if share <= 0.0:
                        continue
                    passed = wp.cw_mul(passed, values(1.0) - share * covers[other])
                kept.face[world, station, faces] = face
                kept.transport[world, station, faces] = weight[place] * wp.cw_mul(passed, transfer)
                faces += 1
        if proxy >= first_texel:
            openness = wp.min(kit.sum_of_products(open_to, transfer) / wp.pi, 1.0 - shut / wp.pi)
            # The bodies' proxies are the first stations.
            patches[0].station_openness[world, station - first_texel] = openness
        kept.count[world, station] = count
        kept.face_count[world, station] = faces

    @wp.kernel(enable_backward=False, module="unique")
    def leave_surface(
        first: int,
        proxies: ReceiverTable,
        geometry: GeometryTables,
        irradiance: wp.array2d(dtype=wp.vec3),  # (world, proxy)
        tint: wp.array2d(dtype=wp.vec3),  # (world, proxy)
        gloss: GlossTable,
        radiance_out: wp.array2d(dtype=wp.vec3),  # (world, proxy)
        total_out: wp.array2d(dtype=wp.vec3),  # (world, proxy)
    ):
        world, proxy = wp.tid()
        proxy += first
        entity = proxies.entity[world, proxy]
        radiance = wp.vec3()
        if entity >= 0:
            part = part_of(geometry, entity, proxies.face[world, proxy])
            albedo = wp.cw_mul(tint[world, proxy], geometry[0].albedo[part])
            shine = wp.cw_mul(tint[world, proxy], geometry[0].emission[part])
            reflectance = albedo + geometry[0].specular[entity]
            radiance = shine + wp.cw_mul(reflectance, irradiance[world, proxy]) / wp.pi
            if gloss.place[proxy] >= 0:
                radiance = shine + kit.leave_glossy(
                    world,
                    gloss.place[proxy],
                    entity,
                    proxies.normal[world, proxy],
                    irradiance[world, proxy],
                    albedo,
                    geometry,
                    gloss,
                )
        radiance_out[world, proxy] = radiance
        total_out[world, proxy] = radiance

    @wp.kernel(enable_backward=False, module="unique")
    def bounce_light(
        first: int,
        proxies: ReceiverTable,
        geometry: GeometryTables,
        poses: PoseTables,
        o: OcclusionTables,
        patches: PatchTables,
        bodies: BodyTable,
        kept: KeptTable,
        tint: wp.array2d(dtype=wp.vec3),  # (world, proxy)
        gloss: GlossTable,
        first_texel: int,
        radiance_out: wp.array2d(dtype=wp.vec3),  # (world, proxy)
        total_out: wp.array2d(dtype=wp.vec3),  # (world, proxy), added to
    ):
        world, station = wp.tid()
        station += first
        proxy = kept.proxy[station]
        own = proxies.entity[world, proxy]
        if own < 0:
            return
        irradiance = wp.vec3()
        if gloss.extra.shape[1] > 0:
            irradiance = gloss.extra[world, station]
        normal = proxies.normal[world, proxy]
        for place in range(kept.count[world, station]):
            source = kept.entity[world, station, place]
            irradiance += kit.light_of(world, source, kept.irradiance[world, station, place], bodies)
        for place in range(kept.face_count[world, station]):
            seen = kept.face[world, station, place]
            slab = patches[0].entity[seen]
            to_slab = slab_from_world(world, slab, poses, patches)
            p_slab = to_slab * (proxies.position[world, proxy] - slab_origin(world, slab, poses, patches))
            shown = patch.face_radiance(world, seen, p_slab, normal, to_slab, patches, o[0].quadrature)
            irradiance += kit.sum_rgb(kept.transport[world, station, place], shown)
        if bodies.field[own] >= 0:
            irradiance += kit.light_of(world, own, bodies.own[proxy], bodies)
        plain = geometry[0].albedo[part_of(geometry, own, proxies.face[world, proxy])]
        irradiance = wp.max(irradiance, wp.vec3())
        if proxy >= first_texel:
            patches[0].gathered[world, station - first_texel] = irradiance
            return
        albedo = wp.cw_mul(tint[world, proxy], plain)
        radiance = wp.cw_mul(albedo + geometry[0].specular[own], irradiance) / wp.pi
        if gloss.place[proxy] >= 0:
            radiance = kit.leave_glossy(world, gloss.place[proxy], own, normal, irradiance, albedo, geometry, gloss)
        radiance_out[world, proxy] = radiance
        total_out[world, proxy] = total_out[world, proxy] + radiance

    @wp.kernel(enable_backward=False, module="unique")
    def solve_weights(
        first: int,
        bodies: BodyTable,
        radiance: wp.array2d(dtype=wp.vec3),  # (world, proxy)
        weights_out: wp.array4d(dtype=wp.float32),  # (world, entity, channel, function)
        weights_rgb_out: wp.array3d(dtype=wp.vec3),  # (world, entity, function): the same
    ):
        world, item = wp.tid()
        item += first
        entity = item / wp.static(functions)
        function = item % wp.static(functions)
        if bodies.field[entity] < 0:
            return
        count = bodies.proxies[entity]
        start = bodies.first_proxy[entity]
        row = bodies.first_solver[entity] + function * count
        total = wp.vec3()
        for proxy in range(count):
            total += bodies.solver[row + proxy] * radiance[world, start + proxy]
        for channel in range(3):
            weights_out[world, entity, channel, function] = total[channel]
        weights_rgb_out[world, entity, function] = total

    @wp.kernel(enable_backward=False, module="unique")
    def light_itself(
        first: int,
        bodies: BodyTable,
        entities: wp.array(dtype=wp.int32),  # (own vertex): entity
        rows: wp.array(dtype=wp.int32),  # (own vertex): row of `functions`
        own_functions: wp.array(dtype=per_function),
        light_out: wp.array2d(dtype=wp.vec3),  # (world, own vertex)
    ):
        world, vertex = wp.tid()
        vertex += first
        light_out[world, vertex] = kit.light_of(world, entities[vertex], own_functions[rows[vertex]], bodies)

    return SimpleNamespace(
        **vars(kit),
        between=between,
        gather_basis=gather_basis,
        leave_surface=leave_surface,
        bounce_light=bounce_light,
        solve_weights=solve_weights,
        light_itself=light_itself,
    )


@wp.kernel(enable_backward=False, module="unique")
def _place_proxies(
    first: int,
    poses: PoseTables,
    entities: wp.array(dtype=wp.int32),  # (body proxy)
    points: wp.array(dtype=wp.vec3),  # (body proxy), in the entity's frame
    normals: wp.array(dtype=wp.vec3),  # (body proxy)
    proxies: ReceiverTable,
):
    world, proxy = wp.tid()
    proxy += first
    entity = entities[proxy]
    rotation = poses[0].rotation[world, entity]
    proxies.entity[world, proxy] = entity
    proxies.position[world, proxy] = poses[0].position[world, entity] + rotation * points[proxy]
    proxies.normal[world, proxy] = rotation * normals[proxy]


@dataclass(frozen=True)
class BounceState:
    """The proxies of a scene with all that their light needs; the bodies' proxies come first, then the texels."""

    order: int
    functions: int
    proxies: ReceiverTable
    body_entities: wp.array
    body_points: wp.array
    body_normals: wp.array
    bodies: Any  # make_bounce(order, functions).BodyTable
    kept: Any  # make_bounce(order, functions).KeptTable
    gloss: GlossState
    fields: Any  # make_radiance(order, functions).RadianceTable
    patches: Patches
    relations: RelationTable
    weights: wp.array  # the memory behind bodies.weights, float32 (world, entity, channel, function)
    weights_rgb: wp.array  # the same, vec3 (world, entity, function)
    summed: SummedFields
    own_first: wp.array  # (entity): its first own vertex, -1 for bodies that send nothing to themselves
    own_entities: wp.array  # (own vertex)
    own_rows: wp.array  # (own vertex): row of own_functions, which entities of one mesh share
    own_functions: wp.array
    own_light: wp.array  # vec3 (world, own vertex): irradiance there from the body itself
    turns: wp.array  # int32 (world, proxy): when it is lit, see `texels.py`
    tint: wp.array  # vec3 (world, proxy): what a texture multiplies its albedo with
    spacing: wp.array  # (body proxy): about how far apart a body's proxies lie, metres
    received: tuple[wp.array, wp.array]  # irradiance and Phong radiance of direct light
    radiance: wp.array  # vec3 (world, proxy): the light that leaves after the last bounce
    total: wp.array  # vec3 (world, proxy): and after all bounces so far

    @property
    def first_texel(self) -> int:
        """The proxy that is the first texel."""
        return self.body_entities.shape[0]


def gather_basis_irradiances(
    state: BounceState,
    scene: DeviceScene,
    occlusion: OcclusionState,
    lighting: DirectState,
    threshold: float,
    device: wp.Device,
) -> None:
    """Places the proxies and gathers what each receives of every function and face; once per change of poses.

    threshold: bodies that take up a smaller share of a proxy's view than this are skipped (section 5.4).
    """
    kit = make_bounce(state.order, state.functions)
    worlds = state.turns.shape[0]
    inputs = [scene.poses, state.body_entities, state.body_points, state.body_normals, state.proxies]
    launch(_place_proxies, (worlds, state.first_texel), inputs, [], device)
    place_texels(state.patches, scene, state.proxies, state.first_texel, device)
    relate(state.relations, state.patches, scene, device)
    tables = [scene.geometry, scene.poses, occlusion.tables, lighting.tables, state.patches.tables, state.relations]
    inputs = [state.proxies, *tables, state.fields, state.bodies, state.gloss.table, threshold, state.first_texel]
    launch(kit.gather_basis, state.kept.count.shape, inputs, [state.kept], device)
    spread_openness(state.patches, device)


def bounce(state: BounceState, scene: DeviceScene, occlusion: OcclusionState, times: int, device: wp.Device) -> None:
    """Lets the direct light of the proxies, `state.received`, bounce, for what a last gather brings in bounce `times`.

    Leaves the sum over all bounces in the weights and the texels.
    """
    kit = make_bounce(state.order, state.functions)
    shape, patches = state.turns.shape, state.patches
    outputs, gloss = [state.radiance, state.total], state.gloss
    gloss.table.total.zero_()
    inputs = [state.proxies, scene.geometry, state.received[0], state.tint, gloss.table]
    launch(kit.leave_surface, shape, inputs, outputs, device)
    for _ in range(times - 1):
        _represent(state, state.radiance, gloss.table.vector, device)
        inputs = [
            state.proxies,
            scene.geometry,
            scene.poses,
            occlusion.tables,
            patches.tables,
            state.bodies,
            state.kept,
        ]
        launch(kit.add_gloss, gloss.table.extra.shape, [state.bodies, state.kept, gloss.table], [], device)
        launch(kit.gather_moments, gloss.table.vector.shape, [*inputs, gloss.table], [], device)
        inputs += [state.tint, gloss.table, state.first_texel]
        launch(kit.bounce_light, state.kept.count.shape, inputs, outputs, device)
        spread_light(patches, scene, state.tint, state.first_texel, *outputs, device)
    _represent(state, state.total, gloss.table.total, device)
    inputs = [state.bodies, state.own_entities, state.own_rows, state.own_functions]
    launch(kit.light_itself, state.own_light.shape, inputs, [state.own_light], device)


def _represent(state: BounceState, radiance: wp.array, vector: wp.array, device: wp.Device) -> None:
    """Turns the proxies' light into weights and texels. vector: mat33 (world, glossy proxy), see `GlossTable`."""
    kit = make_bounce(state.order, state.functions)
    worlds, entities = state.weights.shape[:2]
    dim = (worlds, entities * state.functions)
    launch(kit.solve_weights, dim, [state.bodies, radiance], [state.weights, state.weights_rgb], device)
    inputs = [state.bodies, state.proxies, state.gloss.table, vector]
    dim = (worlds, state.gloss.table.entity.shape[0] * state.functions)
    outputs = [state.gloss.weights, state.gloss.along, state.weights_rgb]
    launch(kit.solve_gloss, dim, inputs, outputs, device)
    build_pyramids(state.patches, radiance, state.first_texel, device)
