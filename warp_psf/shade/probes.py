"""Probes: the sparse pixels at which incident light is gathered, and which of them serve a pixel.

Probes stand on a lattice, closer where what pixels receive bends, and on pixels that have none near on their surface.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from warp_psf.scene.geometry import GeometryTables, PoseTables
from warp_psf.scene.receiver import ReceiverTable
from warp_psf.shade.incident import make_incident
from warp_psf.shade.lattice import AWAKE, INTERPOLATED, STRIDES

# Spacings of the probes, pixels. A cell of all but the last is halved where its probes are not close enough.
SPACINGS = (16, 8, 4, 2)
# Probes are close enough when what a pixel between them receives differs by no more than this share of the brightest,
# or by no more than this share of all light there.
SMOOTH_INDIRECT = 0.2
SMOOTH_ALL = 0.03
# ... and when what it receives of the sky differs by no more than this share of all light there.
SMOOTH_SKY = 0.08
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
    """The kernels that choose probes, and the functions that find those near a pixel; see `make_incident`."""
    kit = make_incident(order, functions)
    wide, LightingTables, response_of = kit.wide, kit.LightingTables, kit.response_of

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
        sky: wp.array2d(dtype=wide),
    ) -> bool:
        """Whether the probes of a pixel's cell serve it with at least the weight `least`, and agree."""
        corners, weights = cell_of(world, pixel, pixel, spacing, probes, receivers)
        if weights[0] + weights[1] + weights[2] + weights[3] < least:
            return False
        lowest = wp.vec3(1.0e30, 1.0e30, 1.0e30)
        highest = wp.vec3()
        lowest_sky = wp.vec3(1.0e30, 1.0e30, 1.0e30)
        highest_sky = wp.vec3()
        for corner in range(4):
            if corners[corner] >= 0:
                received = wp.max(irradiance_of(light, corners[corner], response), wp.vec3())
                lowest = wp.min(lowest, received)
                highest = wp.max(highest, received)
                if sky.shape[0] > 0:
                    received = wp.max(irradiance_of(sky, corners[corner], response), wp.vec3())
                    lowest_sky = wp.min(lowest_sky, received)
                    highest_sky = wp.max(highest_sky, received)
        everything = wp.max(highest + highest_sky + direct)
        allowed = wp.max(wp.static(SMOOTH_INDIRECT) * wp.max(highest), wp.static(SMOOTH_ALL) * everything)
        if wp.max(highest - lowest) > allowed:
            return False
        return sky.shape[0] == 0 or wp.max(highest_sky - lowest_sky) <= wp.static(SMOOTH_SKY) * everything

    @wp.kernel(enable_backward=False, module="unique")
    def refine_cells(
        first: int,
        turn: int,
        probes: ProbeTable,
        receivers: ReceiverTable,
        geometry: GeometryTables,
        poses: PoseTables,
        lighting: LightingTables,
        light: wp.array2d(dtype=wide),  # (probe, channel): bounced
        sky: wp.array2d(dtype=wide),  # (probe, channel): of the environment, empty where pixels receive that themselves
        direct: wp.array2d(dtype=wp.vec3),  # (world, slot): irradiance without the sky's
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
                    least = wp.where(
                        turn < wp.static(len(SPACINGS) - 2), wp.static(HALF_SERVED), wp.static(LEAST_WEIGHT)
                    )
                    smooth = has_smooth_cell(
                        world, pixel, spacing, response, least, direct[world, pixel], probes, receivers, light, sky
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
        is_sky: bool,
        turns: wp.array2d(dtype=wp.int32),  # (world, slot)
        chosen_out: wp.array2d(dtype=wp.int32),  # (world, slot)
    ):
        world, slot = wp.tid()
        slot += first
        if turns[world, slot] == wp.static(INTERPOLATED):
            if not is_sky or receivers.entity[world, slot] < 0:
                return
            if finest_spacing(world, slot, probes) >= wp.static(STRIDES[0]):
                return
            # What pixels receive of the sky bends here, although their other direct light does not.
            turns[world, slot] = wp.static(AWAKE)
        if receivers.entity[world, slot] >= 0 and pixel_of[world, slot] >= 0 and probes.probe[world, slot] < 0:
            if not is_served(world, slot, pixel_of[world, slot], probes, receivers):
                chosen_out[world, slot] = 1

    return SimpleNamespace(
        **vars(kit),
        cell_of=cell_of,
        finest_spacing=finest_spacing,
        irradiance_of=irradiance_of,
        refine_cells=refine_cells,
        choose_unserved=choose_unserved,
    )
