"""The last gather: light from the bodies around, and from the sky past them, at sparse pixels, for all pixels.

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
from warp_psf.scene.receiver import ReceiverTable, in_use
from warp_psf.shade.bounce import BounceState
from warp_psf.shade.contacts import BESIDE_KINK, BY_PROBES, ON_CONTACT, settle_contacts, touches
from warp_psf.shade.direct import DirectState, shade_direct
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

    @wp.func
    def receive(
        world: int,
        slot: int,
        pixel: int,
        probes: ProbeTable,
        receivers: ReceiverTable,
        geometry: GeometryTables,
        poses: PoseTables,
        o: OcclusionTables,
        lighting: LightingTables,
        wide_rows: wp.array(dtype=half_values),
        light: wp.array2d(dtype=wide),
        sky: wp.array2d(dtype=wide),
        own_first: wp.array(dtype=wp.int32),
        own_light: wp.array2d(dtype=wp.vec3),
    ):
        """Irradiance and radiance through the normalised Phong lobe of bounced light, and likewise of the sky."""
        surface = kit.surface_of(world, slot, receivers, geometry, poses, lighting)
        own = surface.entity
        response = kit.response_of(world, surface, poses, lighting)
        is_glossy = wp.max(geometry[0].specular[own]) > wp.static(LEAST_SHINE)
        shine = wide()
        if is_glossy:
            transfer = kit.transfer_of(surface, o[0].rows[world, own], lighting, o)
            lobe = kit.zonal_at_directions(lighting[0].lobe[own], surface.mirrored, o[0].quadrature)
            weighted = wp.cw_mul(wp.cw_mul(lobe, transfer), lighting[0].weights[0])
            shine = kit.to_sh(world, own, weighted, o, lighting, wide_rows)
        corners = wp.vec4i(-1, -1, -1, -1)
        weights = wp.vec4()
        total = float(1.0)
        if probes.probe[world, slot] >= 0:
            corners[0] = probes.probe[world, slot]
            weights[0] = 1.0
        else:
            total = float(0.0)
            spacing = kit.finest_spacing(world, pixel, probes)
            while total < wp.static(LEAST_WEIGHT) and spacing <= wp.static(SPACINGS[0]):
                corners, weights = cell_of(world, slot, pixel, spacing, probes, receivers)
                total = weights[0] + weights[1] + weights[2] + weights[3]
                spacing = 2 * spacing
        has_sky = sky.shape[0] > 0
        diffuse = wp.vec3()
        glossy = wp.vec3()
        from_sky = wp.vec3()
        glossy_from_sky = wp.vec3()
        for place in range(4):
            if corners[place] >= 0:
                share = weights[place] / total
                diffuse += share * irradiance_of(light, corners[place], response)
                if has_sky:
                    from_sky += share * irradiance_of(sky, corners[place], response)
                if is_glossy:
                    glossy += share * irradiance_of(light, corners[place], shine)
                    if has_sky:
                        glossy_from_sky += share * irradiance_of(sky, corners[place], shine)
        if own_first[own] >= 0:
            corner = surface.corners + wp.vec3i(own_first[own])
            u = surface.uv[0]
            v = surface.uv[1]
            from_itself = u * own_light[world, corner[0]] + v * own_light[world, corner[1]]
            from_itself += (1.0 - u - v) * own_light[world, corner[2]]
            diffuse += from_itself
            # Of what a body sends to itself only the sum is known, not where it comes from.
            glossy += from_itself / wp.pi
        if not is_glossy:
            glossy = diffuse / wp.pi
            glossy_from_sky = from_sky / wp.pi
        dark = wp.vec3()
        return wp.max(diffuse, dark), wp.max(glossy, dark), wp.max(from_sky, dark), wp.max(glossy_from_sky, dark)

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
        light: wp.array2d(dtype=wide),  # (probe, channel): bounced
        sky: wp.array2d(dtype=wide),  # (probe, channel): of the environment, or empty
        own_first: wp.array(dtype=wp.int32),  # (entity): first of `own_light`, -1 for convex bodies
        own_light: wp.array2d(dtype=wp.vec3),  # (world, vertex): irradiance from the body itself
        turns: wp.array2d(dtype=wp.int32),  # (world, slot)
        diffuse_out: wp.array2d(dtype=wp.vec3),  # (world, slot): irradiance
        glossy_out: wp.array2d(dtype=wp.vec3),  # (world, slot): radiance through the normalised Phong lobe
        sky_diffuse_out: wp.array2d(dtype=wp.vec3),  # (world, slot): likewise of the sky, where there is one
        sky_glossy_out: wp.array2d(dtype=wp.vec3),  # (world, slot)
    ):
        world, slot = wp.tid()
        slot += first
        if receivers.entity[world, slot] < 0 or turns[world, slot] == wp.static(INTERPOLATED):
            return
        pixel = pixel_of[world, slot]
        if pixel < 0:
            return
        # In a function of its own: a kernel sets all of its vectors to zero before it looks whose turn it is.
        diffuse, glossy, from_sky, glossy_from_sky = receive(
            world,
            slot,
            pixel,
            probes,
            receivers,
            geometry,
            poses,
            o,
            lighting,
            wide_rows,
            light,
            sky,
            own_first,
            own_light,
        )
        diffuse_out[world, slot] = diffuse
        glossy_out[world, slot] = glossy
        if sky.shape[0] > 0:
            sky_diffuse_out[world, slot] = from_sky
            sky_glossy_out[world, slot] = glossy_from_sky

    return SimpleNamespace(**vars(kit), receive_incident=receive_incident)


@wp.kernel(enable_backward=False, module="unique")
def _find_pixels(
    first: int,
    receivers: ReceiverTable,
    extra: wp.array2d(dtype=wp.int32),  # (world, pixel): its first extra slot, -1 for none
    extra_count: int,
    width: int,
    pixel_size: wp.vec2,
    pixel_of: wp.array2d(dtype=wp.int32),  # (world, slot)
    looks_up: wp.array2d(dtype=wp.int32),  # (world, slot): see `LastGather`
):
    world, pixel = wp.tid()
    pixel += first
    pixel_of[world, pixel] = pixel
    look = int(BY_PROBES)
    start = extra[world, pixel]
    if start >= 0:
        x = pixel % width
        contact = bool(False)
        if receivers.entity[world, pixel] >= 0:
            if x > 0:
                contact = contact or touches(receivers, world, pixel, pixel - 1, pixel_size)
            if x + 1 < width:
                contact = contact or touches(receivers, world, pixel, pixel + 1, pixel_size)
            if pixel >= width:
                contact = contact or touches(receivers, world, pixel, pixel - width, pixel_size)
            if pixel + width < extra.shape[1]:
                contact = contact or touches(receivers, world, pixel, pixel + width, pixel_size)
        if contact:
            look = wp.static(ON_CONTACT)
        for place in range(extra_count):
            pixel_of[world, start + place] = pixel
            looks_up[world, start + place] = look
    looks_up[world, pixel] = look


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


@wp.kernel(enable_backward=False, module="unique")
def _add_light(
    first: int,
    receivers: ReceiverTable,
    diffuse: wp.array2d(dtype=wp.vec3),  # (world, slot)
    glossy: wp.array2d(dtype=wp.vec3),  # (world, slot)
    diffuse_out: wp.array2d(dtype=wp.vec3),  # (world, slot), added to
    glossy_out: wp.array2d(dtype=wp.vec3),  # (world, slot), added to
):
    world, slot = wp.tid()
    slot += first
    if receivers.entity[world, slot] >= 0:
        diffuse_out[world, slot] = diffuse_out[world, slot] + diffuse[world, slot]
        glossy_out[world, slot] = glossy_out[world, slot] + glossy[world, slot]


@dataclass
class LastGather:
    """The probes of a picture. Their number differs from frame to frame; `light` and `sky` grow with it.

    light: SH vectors of incident radiance (probe, channel), about the axes that `make_incident` says, of bounced light.
    sky: likewise, of what the bodies leave of the environment; empty where pixels receive that themselves.
    sky_received: what the pixels' receivers receive of that: irradiance and Phong radiance, vec3 (world, slot).
    looks_up: which receivers look at the sky themselves, and why: BY_PROBES, ON_CONTACT or BESIDE_KINK (world, slot).
    own_sky: what those on contacts receive of it by themselves.
    """

    bounces: BounceState
    threshold: float
    table: ProbeTable
    chosen: wp.array
    rank: wp.array
    pixel_of: wp.array
    looks_up: wp.array
    wide_rows: wp.array
    light: wp.array
    sky: wp.array
    sky_received: tuple[wp.array, wp.array]
    own_sky: tuple[wp.array, wp.array]
    count: int = 0

    @property
    def gathers_sky(self) -> bool:
        """Whether probes bring the environment's light as well."""
        return self.sky.shape[0] > 0


def make_last_gather(
    bounces: BounceState,
    threshold: float,
    width: int,
    height: int,
    slots: int,
    gathers_sky: bool,
    device: wp.Device,
) -> LastGather:
    """Room for the probes of a picture of width x height pixels with `slots` receivers per world.

    threshold: bodies that take up a smaller share of a probe's view than this send it no light.
    gathers_sky: whether probes are to bring the environment's light as well.
    """
    worlds = bounces.turns.shape[0]
    table = ProbeTable()
    table.width, table.height = width, height
    table.probe = wp.zeros((worlds, slots), dtype=wp.int32, device=device)
    table.slot = wp.zeros(worlds * slots, dtype=wp.int32, device=device)
    table.refined = wp.zeros((worlds, width * height), dtype=wp.int32, device=device)
    chosen, rank, pixel_of, looks_up = (wp.zeros((worlds, slots), dtype=wp.int32, device=device) for _ in range(4))
    kit = make_last_bounce(bounces.order, bounces.functions)
    room = int(FIRST_ROOM * worlds * width * height) + 1
    light, sky = (wp.zeros((count, 3), dtype=kit.wide, device=device) for count in (room, room * gathers_sky))
    shape = (worlds, slots * gathers_sky)
    received, own = (
        (wp.zeros(shape, dtype=wp.vec3, device=device), wp.zeros(shape, dtype=wp.vec3, device=device)) for _ in range(2)
    )
    rows = wide_rows(bounces.order, device)
    return LastGather(bounces, threshold, table, chosen, rank, pixel_of, looks_up, rows, light, sky, received, own)


def gather_last_bounce(
    gather: LastGather,
    pixels: ReceiverTable,
    extra: wp.array,
    extra_count: int,
    pixel_size: wp.vec2,
    scene: DeviceScene,
    occlusion: OcclusionState,
    lighting: DirectState,
    cuts: wp.array,
    lattice: Lattice,
    direct: tuple[wp.array, wp.array],
    bounced: tuple[wp.array, wp.array],
    device: wp.Device,
) -> None:
    """Fills `bounced`, irradiance and Phong radiance of the pixels' receivers, vec3 (world, slot).

    extra: int32 (world, pixel), an edge pixel's first extra slot, else -1; extra_count: how many it has.
    pixel_size: how wide a pixel is at depth 0, metres, and how much wider it gets per metre.
    cuts: of the pixels' receivers, see `choose_cuts`. lattice: where direct light was interpolated between pixels, the
    bounced light is, too. direct: direct light likewise, to which the sky's is added where probes gather that.
    """
    state, table, kit = gather.bounces, gather.table, make_last_bounce(gather.bounces.order, gather.bounces.functions)
    worlds, around = extra.shape[0], (pixels, scene, occlusion, lighting, cuts)
    sum_fields(state.summed, state.fields, state.weights_rgb, device)
    sum_fields(state.gloss.summed, state.fields, state.gloss.along, device)
    for array, value in ((table.probe, -1), (table.refined, 0), (gather.pixel_of, -1), (gather.chosen, 0)):
        array.fill_(value)
    gather.count = 0
    inputs = [pixels, extra, extra_count, table.width, pixel_size]
    launch(_find_pixels, extra.shape, inputs, [gather.pixel_of, gather.looks_up], device)
    seen = [pixels, scene.geometry, scene.poses, lighting.tables]
    cells = [-(-table.width // spacing) * -(-table.height // spacing) for spacing in SPACINGS]
    launch(_choose_lattice, (worlds, cells[0]), [SPACINGS[0], table, pixels], [gather.chosen], device)
    _gather_chosen(gather, extra.shape[1], *around, device)
    for turn in range(len(SPACINGS) - 1):
        inputs = [turn, table, *seen, gather.light, gather.sky, direct[0]]
        launch(kit.refine_cells, (worlds, cells[turn]), inputs, [gather.chosen], device)
        _gather_chosen(gather, extra.shape[1], *around, device)
    launch(
        kit.choose_unserved,
        in_use(pixels),
        [table, pixels, gather.pixel_of, gather.gathers_sky, lattice.turns],
        [gather.chosen],
        device,
    )
    _gather_chosen(gather, pixels.count, *around, device)

    inputs = [table, pixels, gather.pixel_of, scene.geometry, scene.poses]
    inputs += [
        occlusion.tables,
        lighting.tables,
        gather.wide_rows,
        gather.light,
        gather.sky,
        state.own_first,
        state.own_light,
        lattice.turns,
    ]
    launch(kit.receive_incident, in_use(pixels), inputs, [*bounced, *gather.sky_received], device)
    if gather.gathers_sky:
        _settle_sky(gather, *around, device)
    interpolate_lattice(lattice, pixels, bounced, gather.sky_received, device)
    if gather.gathers_sky:
        # Last, as interpolation would spread what is seen beside kinks.
        shade_direct(pixels, gather.looks_up, BESIDE_KINK, *around[1:], *gather.sky_received, device)
        launch(_add_light, in_use(pixels), [pixels, *gather.sky_received], list(direct), device)


def _settle_sky(
    gather: LastGather,
    pixels: ReceiverTable,
    scene: DeviceScene,
    occlusion: OcclusionState,
    lighting: DirectState,
    cuts: wp.array,
    device: wp.Device,
) -> None:
    """Lets receivers on contacts look at the sky themselves, and finds those beside kinks."""
    turns, lights = gather.looks_up, (scene, occlusion, lighting, cuts)
    shade_direct(pixels, turns, ON_CONTACT, *lights, *gather.own_sky, device)
    inputs = [pixels, gather.pixel_of, gather.table.width, *gather.own_sky]
    launch(settle_contacts, in_use(pixels), inputs, [turns, *gather.sky_received], device)


def _gather_chosen(
    gather: LastGather,
    slots: int,
    pixels: ReceiverTable,
    scene: DeviceScene,
    occlusion: OcclusionState,
    lighting: DirectState,
    cuts: wp.array,
    device: wp.Device,
) -> None:
    """Makes probes of those of the first `slots` slots that are chosen, and gathers their light."""
    state = gather.bounces
    kit = make_last_bounce(state.order, state.functions)
    worlds, room = gather.chosen.shape
    # All that may be chosen, and what lies between two worlds.
    length = (worlds - 1) * room + slots
    chosen, rank = gather.chosen.flatten()[:length], gather.rank.flatten()[:length]
    wp.utils.array_scan(chosen, rank, inclusive=False)
    fresh = int(rank[-1:].numpy()[0] + chosen[-1:].numpy()[0])
    if fresh == 0:
        return
    launch(_number_probes, (worlds, slots), [gather.chosen, gather.rank, gather.count, gather.table], [], device)
    if gather.count + fresh > gather.light.shape[0]:
        gather.light = _enlarge(gather.light, 2 * (gather.count + fresh))
        if gather.gathers_sky:
            gather.sky = _enlarge(gather.sky, 2 * (gather.count + fresh))
    inputs = [gather.count, gather.table.slot, pixels, scene.geometry, scene.poses, occlusion.tables, lighting.tables]
    inputs.append(state.patches.tables)
    if gather.gathers_sky:
        launch(kit.gather_environment, (1, fresh), [*inputs, cuts, gather.wide_rows], [gather.sky], device)
    inputs += [
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


def _enlarge(light: wp.array, count: int) -> wp.array:
    """The vectors of the probes so far, with room for `count` probes."""
    larger = wp.zeros((count, 3), dtype=light.dtype, device=light.device)
    wp.copy(larger, light, count=light.size)
    return larger
