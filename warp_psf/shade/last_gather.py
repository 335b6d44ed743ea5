"""The last gather: light from the bodies around, at sparse pixels, for all pixels.

The light that arrives at a point varies slowly from point to point, while what a surface makes of it varies with its
normal. So it is gathered at probes, pixels a few apart, as SH vectors of incident radiance past what stands between,
and every pixel takes the probes around it on the same surface, and receives their light with its own normal,
self-shadow and highlight.
"""

from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace

import warp as wp

from warp_psf.device import launch
from warp_psf.field.radiance import sum_fields
from warp_psf.scene.geometry import DeviceScene, GeometryTables, PoseTables
from warp_psf.scene.receiver import ReceiverTable
from warp_psf.shade.bounce import BounceState
from warp_psf.shade.direct import DirectState
from warp_psf.shade.incident import wide_rows
from warp_psf.shade.lattice import INTERPOLATED, Lattice, interpolate_lattice
from warp_psf.shade.occluders import OcclusionState
from warp_psf.shade.probes import LEAST_WEIGHT, SPACINGS, ProbeTable, make_probes

# A lobe that reflects no more than this mirrors the bodies around too faintly to be seen; it takes their mean.
LEAST_SHINE = 0.03
# Room for probes at first, as a share of the pixels; it grows when a picture needs more.
FIRST_ROOM = 1 / 8


@cache
def make_last_bounce(order: int, functions: int) -> SimpleNamespace:
    """The kernel with which pixels receive the light of probes; see `make_probes`."""
    kit = make_probes(order, functions)
    wide, half_values = kit.wide, kit.half_values
    OcclusionTables, LightingTables = kit.OcclusionTables, kit.LightingTables
    cell_of, irradiance_of = kit.cell_of, kit.irradiance_of

    @wp.kernel(enable_backward=False, module="unique")
    def receive_incident(
        first: int,
        probes: ProbeTable,
        receivers: ReceiverTable,
        pixel_of: wp.array2d(dtype=wp.int32),  # (world, slot)
        geometry: GeometryTables,
        poses: PoseTables,
        o: OcclusionTables,
        lighting: LightingTables,
        wide_rows: wp.array(dtype=half_values),
        light: wp.array2d(dtype=wide),  # (probe, channel)
        own_first: wp.array(dtype=wp.int32),  # (entity): first of `own_light`, -1 for convex bodies
        own_light: wp.array2d(dtype=wp.vec3),  # (world, vertex): irradiance from the body itself
        turns: wp.array2d(dtype=wp.int32),  # (world, slot)
        diffuse_out: wp.array2d(dtype=wp.vec3),  # (world, slot): irradiance
        glossy_out: wp.array2d(dtype=wp.vec3),  # (world, slot): radiance through the normalised Phong lobe
    ):
        world, slot = wp.tid()
        slot += first
        entity = receivers.entity[world, slot]
        if entity < 0 or turns[world, slot] == wp.static(INTERPOLATED):
            return
        pixel = pixel_of[world, slot]
        if pixel < 0:
            return
        surface = kit.surface_of(world, slot, receivers, geometry, poses, lighting)
        response = kit.response_of(world, surface, poses, lighting)
        is_glossy = wp.max(geometry[0].specular[entity]) > wp.static(LEAST_SHINE)
        shine = wide()
        if is_glossy:
            transfer = kit.transfer_of(surface, o[0].rows[world, entity], lighting, o)
            lobe = kit.zonal_at_directions(lighting[0].lobe[entity], surface.mirrored, o[0].quadrature)
            weighted = wp.cw_mul(wp.cw_mul(lobe, transfer), lighting[0].weights[0])
            shine = kit.to_sh(world, entity, weighted, o, lighting, wide_rows)
        diffuse = wp.vec3()
        glossy = wp.vec3()
        probe = probes.probe[world, slot]
        if probe >= 0:
            diffuse = irradiance_of(light, probe, response)
            if is_glossy:
                glossy = irradiance_of(light, probe, shine)
        else:
            total = float(0.0)
            spacing = kit.finest_spacing(world, pixel, probes)
            corners = wp.vec4i()
            weights = wp.vec4()
            while total < wp.static(LEAST_WEIGHT) and spacing <= wp.static(SPACINGS[0]):
                corners, weights = cell_of(world, slot, pixel, spacing, probes, receivers)
                total = weights[0] + weights[1] + weights[2] + weights[3]
                spacing = 2 * spacing
            for place in range(4):
                if corners[place] >= 0:
                    share = weights[place] / total
                    diffuse += share * irradiance_of(light, corners[place], response)
                    if is_glossy:
                        glossy += share * irradiance_of(light, corners[place], shine)
        if own_first[entity] >= 0:
            corner = surface.corners + wp.vec3i(own_first[entity])
            u = surface.uv[0]
            v = surface.uv[1]
            from_itself = u * own_light[world, corner[0]] + v * own_light[world, corner[1]]
            from_itself += (1.0 - u - v) * own_light[world, corner[2]]
            diffuse += from_itself
            # Of what a body sends to itself only the sum is known, not where it comes from.
            glossy += from_itself / wp.pi
        if not is_glossy:
            glossy = diffuse / wp.pi
        diffuse_out[world, slot] = wp.max(diffuse, wp.vec3())
        glossy_out[world, slot] = wp.max(glossy, wp.vec3())

    return SimpleNamespace(**vars(kit), receive_incident=receive_incident)


@wp.kernel(enable_backward=False, module="unique")
def _find_pixels(
    first: int,
    extra: wp.array2d(dtype=wp.int32),  # (world, pixel): its first extra slot, -1 for none
    extra_count: int,
    pixel_of: wp.array2d(dtype=wp.int32),  # (world, slot)
):
    world, pixel = wp.tid()
    pixel += first
    pixel_of[world, pixel] = pixel
    start = extra[world, pixel]
    if start >= 0:
        for place in range(extra_count):
            pixel_of[world, start + place] = pixel


@wp.kernel(enable_backward=False, module="unique")
def _choose_lattice(
    first: int, spacing: int, probes: ProbeTable, receivers: ReceiverTable, chosen_out: wp.array2d(dtype=wp.int32)
):
    world, cell = wp.tid()
    cell += first
    columns = (probes.width + spacing - 1) / spacing
    pixel = spacing * (cell % columns + cell / columns * probes.width)
    chosen_out[world, pixel] = wp.where(receivers.entity[world, pixel] >= 0, 1, 0)


@wp.kernel(enable_backward=False, module="unique")
def _number_probes(
    first: int,
    chosen: wp.array2d(dtype=wp.int32),  # (world, slot)
    rank: wp.array2d(dtype=wp.int32),  # (world, slot): how many were chosen before
    start: int,
    probes: ProbeTable,
):
    world, slot = wp.tid()
    slot += first
    if chosen[world, slot] == 1:
        # The next turn begins with nothing chosen.
        chosen[world, slot] = 0
        number = start + rank[world, slot]
        probes.probe[world, slot] = number
        probes.slot[number] = world * chosen.shape[1] + slot


@dataclass
class LastGather:
    """The probes of a picture. Their number differs from frame to frame; `light` grows with it.

    light: SH vectors of incident radiance (probe, channel), about the axes that `make_incident` says.
    """

    bounces: BounceState
    threshold: float
    table: ProbeTable
    chosen: wp.array
    rank: wp.array
    pixel_of: wp.array
    wide_rows: wp.array
    light: wp.array
    count: int = 0


def make_last_gather(
    bounces: BounceState, threshold: float, width: int, height: int, slots: int, device: wp.Device
) -> LastGather:
    """Room for the probes of a picture of width x height pixels with `slots` receivers per world.

    threshold: bodies that take up a smaller share of a probe's view than this are skipped.
    """
    worlds = bounces.turns.shape[0]
    table = ProbeTable()
    table.width, table.height = width, height
    table.probe = wp.zeros((worlds, slots), dtype=wp.int32, device=device)
    table.slot = wp.zeros(worlds * slots, dtype=wp.int32, device=device)
    table.refined = wp.zeros((worlds, width * height), dtype=wp.int32, device=device)
    chosen, rank, pixel_of = (wp.zeros((worlds, slots), dtype=wp.int32, device=device) for _ in range(3))
    kit = make_last_bounce(bounces.order, bounces.functions)
    light = wp.zeros((int(FIRST_ROOM * worlds * width * height) + 1, 3), dtype=kit.wide, device=device)
    rows = wide_rows(bounces.order, device)
    return LastGather(bounces, threshold, table, chosen, rank, pixel_of, rows, light)


def gather_last_bounce(
    gather: LastGather,
    pixels: ReceiverTable,
    extra: wp.array,
    extra_count: int,
    scene: DeviceScene,
    occlusion: OcclusionState,
    lighting: DirectState,
    lattice: Lattice,
    direct: wp.array,
    bounced: tuple[wp.array, wp.array],
    device: wp.Device,
) -> None:
    """Fills `bounced`, irradiance and Phong radiance of the pixels' receivers, vec3 (world, slot).

    extra: int32 (world, pixel), an edge pixel's first extra slot, else -1; extra_count: how many it has.
    lattice: where direct light was interpolated between pixels, the bounced light is, too. direct: its irradiance, vec3
    (world, slot).
    """
    state, table, kit = gather.bounces, gather.table, make_last_bounce(gather.bounces.order, gather.bounces.functions)
    worlds = extra.shape[0]
    sum_fields(state.summed, state.fields, state.weights_rgb, device)
    sum_fields(state.gloss.summed, state.fields, state.gloss.along, device)
    for array, value in ((table.probe, -1), (table.refined, 0), (gather.pixel_of, -1), (gather.chosen, 0)):
        array.fill_(value)
    gather.count = 0
    launch(_find_pixels, extra.shape, [extra, extra_count], [gather.pixel_of], device)
    seen = [pixels, scene.geometry, scene.poses, lighting.tables]
    cells = [-(-table.width // spacing) * -(-table.height // spacing) for spacing in SPACINGS]
    launch(_choose_lattice, (worlds, cells[0]), [SPACINGS[0], table, pixels], [gather.chosen], device)
    _gather_chosen(gather, extra.shape[1], pixels, scene, occlusion, lighting, device)
    for turn in range(len(SPACINGS) - 1):
        inputs = [turn, table, *seen, gather.light, direct]
        launch(kit.refine_cells, (worlds, cells[turn]), inputs, [gather.chosen], device)
        _gather_chosen(gather, extra.shape[1], pixels, scene, occlusion, lighting, device)
    launch(
        kit.choose_unserved,
        gather.chosen.shape,
        [table, pixels, gather.pixel_of, lattice.turns],
        [gather.chosen],
        device,
    )
    _gather_chosen(gather, gather.chosen.shape[1], pixels, scene, occlusion, lighting, device)

    inputs = [table, pixels, gather.pixel_of, scene.geometry, scene.poses, occlusion.tables, lighting.tables]
    inputs += [gather.wide_rows, gather.light, state.own_first, state.own_light, lattice.turns]
    launch(kit.receive_incident, gather.chosen.shape, inputs, list(bounced), device)
    interpolate_lattice(lattice, pixels, *bounced, device)


def _gather_chosen(
    gather: LastGather,
    slots: int,
    pixels: ReceiverTable,
    scene: DeviceScene,
    occlusion: OcclusionState,
    lighting: DirectState,
    device: wp.Device,
) -> None:
    """Makes probes of those of the first `slots` slots that are chosen, and gathers their light."""
    state = gather.bounces
    kit = make_last_bounce(state.order, state.functions)
    chosen, rank = gather.chosen.flatten(), gather.rank.flatten()
    wp.utils.array_scan(chosen, rank, inclusive=False)
    fresh = int(rank[-1:].numpy()[0] + chosen[-1:].numpy()[0])
    if fresh == 0:
        return
    dim = (gather.chosen.shape[0], slots)
    launch(_number_probes, dim, [gather.chosen, gather.rank, gather.count, gather.table], [], device)
    if gather.count + fresh > gather.light.shape[0]:
        larger = wp.zeros((2 * (gather.count + fresh), 3), dtype=kit.wide, device=device)
        wp.copy(larger, gather.light, count=gather.light.size)
        gather.light = larger
    inputs = [gather.count, gather.table.slot, pixels, scene.geometry, scene.poses, occlusion.tables, lighting.tables]
    inputs += [
        state.patches.tables,
        state.relations,
        state.fields,
        state.bodies,
        state.summed.summed,
        state.summed.first,
        state.gloss.table,
        state.gloss.summed.summed,
        state.gloss.summed.first,
    ]
    launch(kit.gather_incident, (1, fresh), [*inputs, gather.wide_rows, gather.threshold], [gather.light], device)
    gather.count += fresh
