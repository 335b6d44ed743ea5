"""Glossy bodies as sources of bounced light: their lobes as four separable terms (see `separable`).

Receivers need the light of such a body times the coordinates of its direction, and the bodies themselves need the
moment of the light that they receive: irradiance times direction. Everything here is done for glossy bodies and for
what they light; others bounce as they do without it. Slabs send out all their light evenly.
"""

from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from warp_psf.basis.directions import along_axis_snippet, project_products_snippet
from warp_psf.device import launch
from warp_psf.field.moments import FIRST, SECOND
from warp_psf.field.radiance import SummedFields
from warp_psf.scene.geometry import DeviceScene, GeometryTables, PoseTables
from warp_psf.scene.receiver import ReceiverTable
from warp_psf.shade.delta import DeltaLightTable, DeltaState, delta_light
from warp_psf.shade.direct import DirectState
from warp_psf.shade.faces import make_faces
from warp_psf.shade.occluders import OcclusionState
from warp_psf.shade.patches import PatchTables, slab_from_world, slab_origin
from warp_psf.shade.spheres import CutTables
from warp_psf.shade.tables import make_tables


@cache
def make_gloss(order: int, functions: int) -> SimpleNamespace:
    """What glossy bodies add to bounces on `order` bands with `functions` basis functions per body."""
    kit = make_tables(order, functions)
    patch = make_faces(order)
    radiant, moments, values, half_values = kit.radiant, kit.moments, kit.values, kit.half_values
    OcclusionTables, LightingTables = kit.OcclusionTables, kit.LightingTables
    BodyTable, KeptTable, GlossTable = kit.BodyTable, kit.KeptTable, kit.GlossTable

    @wp.func_native(along_axis_snippet(kit.points))
    def along_axis(v: values, axis: int, quadrature: wp.array(dtype=half_values)) -> values:
        """The values times a coordinate of the direction."""

    @wp.func_native(project_products_snippet(order * order, kit.points, FIRST))
    def project_first(
        weighted: values, rows: wp.array(dtype=half_values), quadrature: wp.array(dtype=half_values)
    ) -> moments.first_received: ...

    @wp.func_native(project_products_snippet(order * order, kit.points, SECOND))
    def project_second(
        weighted: values, rows: wp.array(dtype=half_values), quadrature: wp.array(dtype=half_values)
    ) -> moments.second_received: ...

    @wp.func
    def keep_moments(
        world: int,
        station: int,
        count: int,
        proxy: int,
        source: int,
        light: values,
        rows: wp.array(dtype=half_values),
        quadrature: wp.array(dtype=half_values),
        fields: radiant.RadianceTable,
        where: radiant.Place,
        gloss: GlossTable,
    ):
        """Keeps what a station receives of a source times coordinates of the direction, where either is glossy."""
        receives = gloss.place[proxy] >= 0
        sends = gloss.row[source] >= 0
        if receives or sends:
            gloss.first[world, station, count] = moments.first_moments(
                fields, where, project_first(light, rows, quadrature)
            )
        if receives and sends:
            gloss.second[world, gloss.place[proxy], count] = moments.second_moments(
                fields, where, project_second(light, rows, quadrature)
            )

    @wp.func
    def leave_glossy(
        world: int,
        place: int,
        entity: int,
        n: wp.vec3,
        irradiance: wp.vec3,
        albedo: wp.vec3,
        geometry: GeometryTables,
        gloss: GlossTable,
    ) -> wp.vec3:
        """Notes the vector of the light that a glossy proxy reflects; returns the radiance as if it left evenly."""
        factors = gloss.factors[gloss.row[entity]]
        moment = gloss.moment[world, place]
        specular = geometry[0].specular[entity]
        even = wp.vec3()
        vector = wp.mat33()
        for channel in range(3):
            received = irradiance[channel]
            toward = wp.vec3(moment[channel, 0], moment[channel, 1], moment[channel, 2])
            # No light has a moment longer than its irradiance; band-limited light may.
            toward *= wp.min(1.0, received / wp.max(wp.length(toward), 1.0e-20))
            upright = wp.dot(n, toward)
            along = factors[1] * received + factors[2] * upright
            v = specular[channel] * (along * n - factors[3] * (toward - upright * n))
            steady = specular[channel] * (factors[0] * received + factors[1] * upright)
            # A cosine to the normal sends out two thirds of what an even light of its height does.
            even[channel] = wp.max(albedo[channel] * received / wp.pi + steady + 2.0 / 3.0 * wp.dot(v, n), 0.0)
            for axis in range(3):
                vector[channel, axis] = v[axis]
        gloss.vector[world, place] = vector
        gloss.total[world, place] = gloss.total[world, place] + vector
        return even

    @wp.kernel(enable_backward=False, module="unique")
    def shade_moments(
        first: int,
        proxies: ReceiverTable,
        geometry: GeometryTables,
        poses: PoseTables,
        o: OcclusionTables,
        lighting: LightingTables,
        cuts: CutTables,
        gloss: GlossTable,
        irradiance_out: wp.array2d(dtype=wp.vec3),  # (world, proxy)
    ):
        world, place = wp.tid()
        place += first
        proxy = gloss.proxy[place]
        entity = proxies.entity[world, proxy]
        surface = kit.surface_of(world, proxy, proxies, geometry, poses, lighting)
        p = surface.position
        n = surface.normal
        rows = o[0].rows[world, entity]
        transfer = kit.transfer_of(surface, rows, lighting, o)
        lights = lighting[0].light_entity.shape[0]
        shining = int(-1)
        if lights > 0:
            shining = lighting[0].light_entity[0]
        facing = kit.facing_of(world, 0, poses, lighting)
        visible, before = kit.visibility_at(world, proxy, entity, shining, facing, p, n, geometry, poses, o, cuts)
        received = wp.cw_mul(visible, transfer)
        irradiance = kit.environment_light(world, received, lighting)
        moment = wp.mat33()
        for axis in range(3):
            along = kit.environment_light(world, along_axis(received, axis, o[0].quadrature), lighting)
            for channel in range(3):
                moment[channel, axis] = along[channel]
        open_to_self = kit.open_to_self(surface, rows, lighting, o)
        for light in range(lights):
            source = lighting[0].light_entity[light]
            if light > 0:
                facing = kit.facing_of(world, light, poses, lighting)
                _visible, before = kit.visibility_at(
                    world, proxy, entity, source, facing, p, n, geometry, poses, o, cuts
                )
            passed = wp.cw_mul(before, open_to_self)
            strength, _gloss = kit.area_light(world, light, surface, passed, values(), geometry, poses, o, lighting)
            center = poses[0].position[world, source] + poses[0].rotation[world, source] * geometry[0].center[source]
            sent = strength * lighting[0].light_radiance[world, light]
            irradiance += sent
            moment += wp.outer(sent, wp.normalize(center - p))
        irradiance_out[world, proxy] = wp.max(irradiance, wp.vec3())
        gloss.moment[world, place] = moment

    @wp.kernel(enable_backward=False, module="unique")
    def add_delta_moments(
        first: int,
        proxies: ReceiverTable,
        geometry: GeometryTables,
        poses: PoseTables,
        opacity: wp.array(dtype=wp.float32),  # (entity)
        lights: DeltaLightTable,
        far: float,
        gloss: GlossTable,
    ):
        world, place = wp.tid()
        place += first
        proxy = gloss.proxy[place]
        entity = proxies.entity[world, proxy]
        n = proxies.normal[world, proxy]
        p = proxies.position[world, proxy]
        moment = gloss.moment[world, place]
        for light in range(lights.kind.shape[1]):
            # Light that comes evenly from everywhere: the moment is two thirds of the irradiance.
            moment += wp.outer(2.0 / 3.0 * wp.pi * lights.ambient[world, light], n)
            unit, strength, lit, cosine = delta_light(world, light, entity, p, n, geometry, poses, opacity, lights, far)
            moment += wp.outer((wp.pi * strength * lit * cosine) * lights.diffuse[world, light], unit)
        gloss.moment[world, place] = moment

    @wp.kernel(enable_backward=False, module="unique")
    def add_gloss(first: int, bodies: BodyTable, kept: KeptTable, gloss: GlossTable):
        world, station = wp.tid()
        station += first
        total = wp.vec3()
        for place in range(kept.count[world, station]):
            row = gloss.row[kept.entity[world, station, place]]
            if row >= 0:
                irradiance = kept.irradiance[world, station, place]
                along = gloss.first[world, station, place]
                for channel in range(3):
                    added = wp.dot(irradiance, gloss.weights[world, 4 * row, channel])
                    for axis in range(3):
                        # Light leaves against the direction in which it is seen.
                        added -= wp.dot(along[axis], gloss.weights[world, 4 * row + 1 + axis, channel])
                    total[channel] += added
        gloss.extra[world, station] = total

    @wp.kernel(enable_backward=False, module="unique")
    def gather_moments(
        first: int,
        proxies: ReceiverTable,
        geometry: GeometryTables,
        poses: PoseTables,
        o: OcclusionTables,
        patches: PatchTables,
        bodies: BodyTable,
        kept: KeptTable,
        gloss: GlossTable,
    ):
        world, item = wp.tid()
        item += first
        # Bodies' proxies are the first stations.
        proxy = gloss.proxy[item]
        own = proxies.entity[world, proxy]
        n = proxies.normal[world, proxy]
        moment = wp.mat33()
        for place in range(kept.count[world, proxy]):
            source = kept.entity[world, proxy, place]
            row = gloss.row[source]
            along = gloss.first[world, proxy, place]
            for channel in range(3):
                weights = bodies.weights[world, source, channel]
                if row >= 0:
                    weights = weights + gloss.weights[world, 4 * row, channel]
                found = along * weights
                if row >= 0:
                    twice = gloss.second[world, item, place]
                    x = twice * gloss.weights[world, 4 * row + 1, channel]
                    y = twice * gloss.weights[world, 4 * row + 2, channel]
                    z = twice * gloss.weights[world, 4 * row + 3, channel]
                    # The rows of `second`: xx, yy, zz, xy, xz, yz.
                    found -= wp.vec3(x[0] + y[3] + z[4], x[3] + y[1] + z[5], x[4] + y[5] + z[2])
                for axis in range(3):
                    moment[channel, axis] += found[axis]
        for place in range(kept.face_count[world, proxy]):
            seen = kept.face[world, proxy, place]
            slab = patches[0].entity[seen]
            to_slab = slab_from_world(world, slab, poses, patches)
            p_slab = to_slab * (proxies.position[world, proxy] - slab_origin(world, slab, poses, patches))
            shown = patch.face_radiance(world, seen, p_slab, n, to_slab, patches, o[0].quadrature)
            transport = kept.transport[world, proxy, place]
            for axis in range(3):
                found = kit.sum_rgb(along_axis(transport, axis, o[0].quadrature), shown)
                for channel in range(3):
                    moment[channel, axis] += found[channel]
        light = kit.light_of(world, own, bodies.own[proxy], bodies)
        # Of what a body sends to itself only the sum is known, not where it comes from.
        gloss.moment[world, item] = moment + wp.outer(2.0 / 3.0 * light, n)

    @wp.kernel(enable_backward=False, module="unique")
    def solve_gloss(
        first: int,
        bodies: BodyTable,
        proxies: ReceiverTable,
        gloss: GlossTable,
        vector: wp.array2d(dtype=wp.mat33),  # (world, glossy proxy)
        weights_out: wp.array4d(dtype=wp.float32),  # (world, 4 row + term, channel, function)
        along_out: wp.array3d(dtype=wp.vec3),  # (world, 3 row + axis, function): those of the vector
        even_out: wp.array3d(dtype=wp.vec3),  # (world, entity, function), added to: that of 1
    ):
        world, item = wp.tid()
        item += first
        row = item / wp.static(functions)
        function = item % wp.static(functions)
        entity = gloss.entity[row]
        start = bodies.first_proxy[entity]
        solver = bodies.first_solver[entity] + function * bodies.proxies[entity]
        constant = wp.vec3()
        total = wp.mat33()
        for proxy in range(bodies.proxies[entity]):
            v = bodies.solver[solver + proxy] * vector[world, gloss.first_place[row] + proxy]
            total += v
            constant -= 2.0 / 3.0 * (v * proxies.normal[world, start + proxy])
        even_out[world, entity, function] = even_out[world, entity, function] + constant
        for channel in range(3):
            weights_out[world, 4 * row, channel, function] = constant[channel]
        for axis in range(3):
            along_out[world, 3 * row + axis, function] = wp.vec3(total[0, axis], total[1, axis], total[2, axis])
            for channel in range(3):
                weights_out[world, 4 * row + 1 + axis, channel, function] = total[channel, axis]

    return SimpleNamespace(
        **vars(kit),
        patch=patch,
        along_axis=along_axis,
        keep_moments=keep_moments,
        leave_glossy=leave_glossy,
        shade_moments=shade_moments,
        add_delta_moments=add_delta_moments,
        add_gloss=add_gloss,
        gather_moments=gather_moments,
        solve_gloss=solve_gloss,
    )


@dataclass(frozen=True)
class GlossState:
    """The glossy bodies of a scene."""

    order: int
    functions: int
    table: Any  # make_gloss(order, functions).GlossTable
    weights: wp.array  # the memory behind table.weights, float32 (world, 4 row + term, channel, function)
    along: wp.array  # those of the vector, vec3 (world, 3 row + axis, function)
    summed: SummedFields  # (3 row + axis) in place of entities


def shade_gloss(
    state: GlossState,
    proxies: ReceiverTable,
    scene: DeviceScene,
    occlusion: OcclusionState,
    lighting: DirectState,
    cuts: wp.array,
    delta: DeltaState,
    irradiance: wp.array,
    device: wp.Device,
) -> None:
    """Direct light of the glossy proxies: its moment, and `irradiance`, vec3 (world, proxy), but for delta lights."""
    kit = make_gloss(state.order, state.functions)
    shape = state.table.moment.shape
    inputs = [proxies, scene.geometry, scene.poses, occlusion.tables, lighting.tables, cuts, state.table]
    launch(kit.shade_moments, shape, inputs, [irradiance], device)
    if delta.table.kind.shape[1] > 0:
        inputs = [proxies, scene.geometry, scene.poses, delta.opacity, delta.table, delta.far, state.table]
        launch(kit.add_delta_moments, shape, inputs, [], device)
