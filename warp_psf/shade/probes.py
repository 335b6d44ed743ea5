"""The last gather: light from the bodies around, at sparse pixels, for all pixels.

The light that arrives at a point varies slowly from point to point, while what a surface makes of it varies with its
normal. So it is gathered at probes, pixels a few apart, as SH vectors of incident radiance past what stands between,
and every pixel takes the probes around it on the same surface, and receives their light with its own normal,
self-shadow and highlight. Probes stand on a lattice, closer where the light bends, and on pixels that have none near.
"""

from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace

import warp as wp

from warp_psf.device import launch
from warp_psf.field.radiance import sum_fields
from warp_psf.scene.geometry import DeviceScene, GeometryTable, PoseTable
from warp_psf.scene.receiver import ReceiverTable
from warp_psf.shade.bounce import BounceState
from warp_psf.shade.direct import DirectState
from warp_psf.shade.incident import make_incident, wide_rows
from warp_psf.shade.lattice import STRIDES, Lattice, begin_lattice, make_lattice, refine_lattice
from warp_psf.shade.occlude import OcclusionState

# Spacings of the probes, pixels. A cell of the first two is halved where its probes are not close enough.
SPACINGS = (8, 4, 2)
# Probes are close enough when what a pixel between them receives differs by no more than this share of the brightest,
# or by no more than this share of all light there.
SMOOTH_INDIRECT = 0.1
SMOOTH_ALL = 0.02
# A pixel takes over a probe on the same body whose normal is near its own (cosines: full at the first, not at all at
# the second), and which lies near its tangent plane (sines likewise): not one from the other side of a handle.
ALIGNED, NOT_ALIGNED = 0.7, 0.2
LEVEL, NOT_LEVEL = 0.25, 0.5
# The least sum of weights with which a pixel counts as served.
LEAST_WEIGHT = 2.0e-4
# In the widest cells so much of the weight must be there, or half of a cell would look like its other half.
HALF_SERVED = 0.6
# A probe at the far end of a cell counts so much: where it is the only one it is better than none.
FAR_WEIGHT = 1.0e-3
# Room for probes at first, as a share of the pixels; it grows when a picture needs more.
FIRST_ROOM = 1 / 8


@wp.struct
class ProbeTable:
    """Which pixels are probes."""

    probe: wp.array2d(dtype=wp.int32)  # (world, slot): its number, -1 for none
    slot: wp.array(dtype=wp.int32)  # (probe): world * slots + slot
    refined: wp.array2d(dtype=wp.int32)  # (world, pixel): bit k at a cell's first pixel: that of SPACINGS[k] is halved
    width: wp.int32
    height: wp.int32


@cache
def make_probes(order: int, functions: int) -> SimpleNamespace:
    """The kernels that choose probes and receive their light; see `make_incident`."""
    kit = make_incident(order, functions)
    wide, half_values = kit.wide, kit.half_values
    Occlusion, Lighting = kit.Occlusion, kit.Lighting
    response_of, to_sh = kit.response_of, kit.to_sh

    @wp.func
    def affinity(receivers: ReceiverTable, world: int, slot: int, other: int) -> float:
        """How well the light at one pixel stands for that at another: 0 not at all, 1 as well as its own."""
        if receivers.entity[world, slot] != receivers.entity[world, other]:
            return 0.0
        n = receivers.normal[world, slot]
        m = receivers.normal[world, other]
        aligned = wp.clamp((wp.dot(n, m) - wp.static(NOT_ALIGNED)) * wp.static(1.0 / (ALIGNED - NOT_ALIGNED)), 0.0, 1.0)
        offset = receivers.position[world, other] - receivers.position[world, slot]
        lift = wp.max(wp.abs(wp.dot(offset, n)), wp.abs(wp.dot(offset, m))) / wp.max(wp.length(offset), 1.0e-12)
        return aligned * wp.clamp((wp.static(NOT_LEVEL) - lift) * wp.static(1.0 / (NOT_LEVEL - LEVEL)), 0.0, 1.0)

    @wp.func
    def cell_of(world: int, slot: int, pixel: int, spacing: int, probes: ProbeTable, receivers: ReceiverTable):
        """The probes at the corners of a pixel's cell, -1 where there is none that serves it, and their weights."""
        x = pixel % probes.width
        y = pixel / probes.width
        left = x - x % spacing
        above = y - y % spacing
        u = float(x - left) / float(spacing)
        v = float(y - above) / float(spacing)
        corners = wp.vec4i(-1, -1, -1, -1)
        weights = wp.vec4()
        for corner in range(4):
            column = left + (corner % 2) * spacing
            row = above + (corner / 2) * spacing
            if column < probes.width and row < probes.height:
                other = row * probes.width + column
                if probes.probe[world, other] >= 0:
                    near = wp.where(corner % 2 == 0, 1.0 - u, u) * wp.where(corner / 2 == 0, 1.0 - v, v)
                    weight = (near + wp.static(FAR_WEIGHT)) * affinity(receivers, world, slot, other)
                    if weight > 0.0:
                        corners[corner] = probes.probe[world, other]
                        weights[corner] = weight
        return corners, weights

    @wp.func
    def finest_spacing(world: int, pixel: int, probes: ProbeTable) -> int:
        """The spacing of the smallest cell around a pixel."""
        x = pixel % probes.width
        y = pixel / probes.width
        spacing = int(wp.static(SPACINGS[0]))
        for turn in range(wp.static(len(SPACINGS) - 1)):
            if spacing == wp.static(SPACINGS[0]) >> turn:
                corner = x - x % spacing + (y - y % spacing) * probes.width
                if (probes.refined[world, corner] >> turn) % 2 == 1:
                    spacing = spacing / 2
        return spacing

    @wp.func
    def is_served(world: int, slot: int, pixel: int, probes: ProbeTable, receivers: ReceiverTable) -> bool:
        """Whether there is a probe at the corners of the smallest cell around a pixel, or of those around that."""
        spacing = finest_spacing(world, pixel, probes)
        while spacing <= wp.static(SPACINGS[0]):
            _corners, weights = cell_of(world, slot, pixel, spacing, probes, receivers)
            if weights[0] + weights[1] + weights[2] + weights[3] >= wp.static(LEAST_WEIGHT):
                return True
            spacing = 2 * spacing
        return False

    @wp.func
    def irradiance_of(light: wp.array2d(dtype=wide), probe: int, response: wide) -> wp.vec3:
        return wp.vec3(
            wp.dot(light[probe, 0], response), wp.dot(light[probe, 1], response), wp.dot(light[probe, 2], response)
        )

    @wp.func
    def has_smooth_cell(
        world: int,
        pixel: int,
        spacing: int,
        response: wide,
        least: float,
        direct: wp.vec3,
        probes: ProbeTable,
        receivers: ReceiverTable,
        light: wp.array2d(dtype=wide),
    ) -> bool:
        """Whether the probes of a pixel's cell serve it with at least the weight `least`, and agree."""
        corners, weights = cell_of(world, pixel, pixel, spacing, probes, receivers)
        if weights[0] + weights[1] + weights[2] + weights[3] < least:
            return False
        lowest = wp.vec3(1.0e30, 1.0e30, 1.0e30)
        highest = wp.vec3()
        for corner in range(4):
            if corners[corner] >= 0:
                received = wp.max(irradiance_of(light, corners[corner], response), wp.vec3())
                lowest = wp.min(lowest, received)
                highest = wp.max(highest, received)
        allowed = wp.max(wp.static(SMOOTH_INDIRECT) * wp.max(highest), wp.static(SMOOTH_ALL) * wp.max(highest + direct))
        return wp.max(highest - lowest) <= allowed

    @wp.kernel(enable_backward=False, module="unique")
    def refine_cells(
        first: int,
        turn: int,
        probes: ProbeTable,
        receivers: ReceiverTable,
        geometry: GeometryTable,
        poses: PoseTable,
        lighting: Lighting,
        light: wp.array2d(dtype=wide),  # (probe, channel)
        direct: wp.array2d(dtype=wp.vec3),  # (world, slot): irradiance
        chosen_out: wp.array2d(dtype=wp.int32),  # (world, slot), set to 1
    ):
        world, cell = wp.tid()
        cell += first
        spacing = wp.static(SPACINGS[0]) >> turn
        columns = (probes.width + spacing - 1) / spacing
        left = (cell % columns) * spacing
        above = (cell / columns) * spacing
        if turn > 0:
            # Cells within one that was smooth are smooth.
            outer = left - left % (2 * spacing) + (above - above % (2 * spacing)) * probes.width
            if (probes.refined[world, outer] >> (turn - 1)) % 2 == 0:
                return
        half = spacing / 2
        smooth = bool(True)
        for place in range(3):
            x = left + wp.where(place == 1, 0, half)
            y = above + wp.where(place == 2, 0, half)
            if smooth and x < probes.width and y < probes.height:
                pixel = y * probes.width + x
                if receivers.entity[world, pixel] >= 0:
                    surface = kit.surface_of(world, pixel, receivers, geometry, poses, lighting)
                    response = response_of(world, surface, poses, lighting)
                    least = wp.where(turn == 0, wp.static(HALF_SERVED), wp.static(LEAST_WEIGHT))
                    smooth = has_smooth_cell(
                        world, pixel, spacing, response, least, direct[world, pixel], probes, receivers, light
                    )
        if not smooth:
            corner = above * probes.width + left
            probes.refined[world, corner] = probes.refined[world, corner] + (1 << turn)
            for place in range(5):
                x = left + wp.where(place == 1, 0, wp.where(place == 3, spacing, half))
                y = above + wp.where(place == 2, 0, wp.where(place == 4, spacing, half))
                if x < probes.width and y < probes.height:
                    pixel = y * probes.width + x
                    # Neighbouring cells may both choose the probe between them.
                    if receivers.entity[world, pixel] >= 0 and probes.probe[world, pixel] < 0:
                        chosen_out[world, pixel] = 1

    @wp.kernel(enable_backward=False, module="unique")
    def choose_unserved(
        first: int,
        probes: ProbeTable,
        receivers: ReceiverTable,
        pixel_of: wp.array2d(dtype=wp.int32),  # (world, slot): -1 where a slot is empty
        chosen_out: wp.array2d(dtype=wp.int32),  # (world, slot)
    ):
        world, slot = wp.tid()
        slot += first
        if receivers.entity[world, slot] >= 0 and pixel_of[world, slot] >= 0 and probes.probe[world, slot] < 0:
            if not is_served(world, slot, pixel_of[world, slot], probes, receivers):
                chosen_out[world, slot] = 1

    @wp.kernel(enable_backward=False, module="unique")
    def receive_incident(
        first: int,
        probes: ProbeTable,
        receivers: ReceiverTable,
        pixel_of: wp.array2d(dtype=wp.int32),  # (world, slot)
        geometry: GeometryTable,
        poses: PoseTable,
        o: Occlusion,
        lighting: Lighting,
        wide_rows: wp.array(dtype=half_values),
        light: wp.array2d(dtype=wide),  # (probe, channel)
        own_first: wp.array(dtype=wp.int32),  # (entity): first of `own_light`, -1 for convex bodies
        own_light: wp.array2d(dtype=wp.vec3),  # (world, vertex): irradiance from the body itself
        turns: wp.array2d(dtype=wp.int32),  # (world, slot)
        turn: int,
        diffuse_out: wp.array2d(dtype=wp.vec3),  # (world, slot): irradiance
        glossy_out: wp.array2d(dtype=wp.vec3),  # (world, slot): radiance through the normalised Phong lobe
    ):
        world, slot = wp.tid()
        slot += first
        entity = receivers.entity[world, slot]
        if entity < 0 or turns[world, slot] != turn:
            return
        pixel = pixel_of[world, slot]
        if pixel < 0:
            return
        surface = kit.surface_of(world, slot, receivers, geometry, poses, lighting)
        response = response_of(world, surface, poses, lighting)
        is_glossy = wp.max(geometry.specular[entity]) > 0.0
        shine = wide()
        if is_glossy:
            transfer = kit.transfer_of(surface, o.rows[world, entity], lighting, o)
            lobe = kit.zonal_at_directions(lighting.lobe[entity], surface.mirrored, o.quadrature)
            weighted = wp.cw_mul(wp.cw_mul(lobe, transfer), lighting.weights[0])
            shine = to_sh(world, entity, weighted, o, lighting, wide_rows)
        diffuse = wp.vec3()
        glossy = wp.vec3()
        probe = probes.probe[world, slot]
        if probe >= 0:
            diffuse = irradiance_of(light, probe, response)
            if is_glossy:
                glossy = irradiance_of(light, probe, shine)
        else:
            total = float(0.0)
            spacing = finest_spacing(world, pixel, probes)
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
        diffuse_out[world, slot] = wp.max(diffuse, wp.vec3())
        glossy_out[world, slot] = wp.max(glossy, wp.vec3())

    return SimpleNamespace(
        **vars(kit),
        refine_cells=refine_cells,
        choose_unserved=choose_unserved,
        receive_incident=receive_incident,
    )


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
    lattice: Lattice
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
    kit = make_probes(bounces.order, bounces.functions)
    light = wp.zeros((int(FIRST_ROOM * worlds * width * height) + 1, 3), dtype=kit.wide, device=device)
    rows = wide_rows(bounces.order, device)
    lattice = make_lattice(worlds, slots, width, height, device)
    return LastGather(bounces, threshold, table, lattice, chosen, rank, pixel_of, rows, light)


def gather_last_bounce(
    gather: LastGather,
    pixels: ReceiverTable,
    extra: wp.array,
    extra_count: int,
    scene: DeviceScene,
    occlusion: OcclusionState,
    lighting: DirectState,
    direct: wp.array,
    bounced: tuple[wp.array, wp.array],
    device: wp.Device,
) -> None:
    """Fills `bounced`, irradiance and Phong radiance of the pixels' receivers, vec3 (world, slot).

    extra: int32 (world, pixel), an edge pixel's first extra slot, else -1; extra_count: how many it has.
    direct: irradiance of direct light, vec3 (world, slot).
    """
    state, table, kit = gather.bounces, gather.table, make_probes(gather.bounces.order, gather.bounces.functions)
    worlds = extra.shape[0]
    sum_fields(state.summed, state.fields, state.weights_rgb, device)
    for array, value in ((table.probe, -1), (table.refined, 0), (gather.pixel_of, -1), (gather.chosen, 0)):
        array.fill_(value)
    gather.count = 0
    launch(_find_pixels, extra.shape, [extra, extra_count], [gather.pixel_of], device)
    seen = [pixels, scene.geometry, scene.poses, lighting.table]
    cells = [-(-table.width // spacing) * -(-table.height // spacing) for spacing in SPACINGS]
    launch(_choose_lattice, (worlds, cells[0]), [SPACINGS[0], table, pixels], [gather.chosen], device)
    _gather_chosen(gather, pixels, scene, occlusion, lighting, device)
    for turn in range(len(SPACINGS) - 1):
        inputs = [turn, table, *seen, gather.light, direct]
        launch(kit.refine_cells, (worlds, cells[turn]), inputs, [gather.chosen], device)
        _gather_chosen(gather, pixels, scene, occlusion, lighting, device)
    launch(kit.choose_unserved, gather.chosen.shape, [table, pixels, gather.pixel_of], [gather.chosen], device)
    _gather_chosen(gather, pixels, scene, occlusion, lighting, device)

    inputs = [table, pixels, gather.pixel_of, scene.geometry, scene.poses, occlusion.table, lighting.table]
    inputs += [gather.wide_rows, gather.light, state.own_first, state.own_light, gather.lattice.turns]
    begin_lattice(gather.lattice, pixels, extra, device)
    for turn in range(1, len(STRIDES) + 1):
        launch(kit.receive_incident, gather.chosen.shape, [*inputs, turn], list(bounced), device)
        if turn < len(STRIDES):
            refine_lattice(gather.lattice, turn, pixels, *bounced, device)


def _gather_chosen(
    gather: LastGather,
    pixels: ReceiverTable,
    scene: DeviceScene,
    occlusion: OcclusionState,
    lighting: DirectState,
    device: wp.Device,
) -> None:
    """Makes probes of the chosen slots and gathers their light."""
    state = gather.bounces
    kit = make_probes(state.order, state.functions)
    chosen, rank = gather.chosen.flatten(), gather.rank.flatten()
    wp.utils.array_scan(chosen, rank, inclusive=False)
    fresh = int(rank[-1:].numpy()[0] + chosen[-1:].numpy()[0])
    if fresh == 0:
        return
    launch(_number_probes, gather.chosen.shape, [gather.chosen, gather.rank, gather.count, gather.table], [], device)
    if gather.count + fresh > gather.light.shape[0]:
        larger = wp.zeros((2 * (gather.count + fresh), 3), dtype=kit.wide, device=device)
        wp.copy(larger, gather.light, count=gather.light.size)
        gather.light = larger
    inputs = [gather.count, gather.table.slot, pixels, scene.geometry, scene.poses, occlusion.table, lighting.table]
    inputs += [
        state.patches.table,
        state.relations,
        state.fields,
        state.bodies,
        state.summed.summed,
        state.summed.first,
    ]
    launch(kit.gather_incident, (1, fresh), [*inputs, gather.wide_rows, gather.threshold], [gather.light], device)
    gather.count += fresh
