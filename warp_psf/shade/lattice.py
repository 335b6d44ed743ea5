"""Which pixels are shaded, and which lie smoothly between shaded ones.

The light that shadow fields give is smooth. Pixels are shaded on a lattice of every fourth pixel first. A cell of the
lattice that shows one smooth surface, over which light runs straight, is interpolated; any other is shaded at every
second pixel, and where that is still not smooth, at every pixel. Pixels on edges are always shaded.
"""

from dataclasses import dataclass

import warp as wp

from warp_psf.device import launch
from warp_psf.scene.receiver import ReceiverTable, in_use

# Spacings of the lattice, pixels, coarse to fine; a receiver is shaded in the turn of its spacing.
STRIDES = (4, 2, 1)
# A cell is interpolated when the differences along its sides change from cell to cell by no more than this share of the
# brightest corner: the error of interpolation is an eighth of that change, 0.5 %.
BENT_LIGHT = wp.constant(0.04)
# ... and when no channel differs between its corners by more than this share: what changes faster may change otherwise
# between them.
UNLIKE_LIGHT = wp.constant(0.2)
# ... and when the normals in it lie within acos(0.93), 22 degrees.
SMOOTH_NORMAL = wp.constant(0.93)
# A receiver's turn: 0 waits, 1, 2, 3 are the strides' turns, and INTERPOLATED needs none. AWAKE is one whose light from
# probes is not to be interpolated, whatever else was.
INTERPOLATED, AWAKE = 4, 5


@dataclass(frozen=True)
class Lattice:
    """The turns of the receivers, int32 (world, slot), and the picture they belong to."""

    turns: wp.array
    width: int
    height: int


@wp.kernel(enable_backward=False, module="unique")
def _begin(
    first: int,
    receivers: ReceiverTable,
    extra: wp.array2d(dtype=wp.int32),  # (world, pixel): -1 off edges
    width: int,
    turns_out: wp.array2d(dtype=wp.int32),  # (world, slot)
):
    world, slot = wp.tid()
    slot += first
    turn = int(0)
    if receivers.entity[world, slot] < 0:
        turn = wp.static(INTERPOLATED)
    elif slot >= extra.shape[1] or extra[world, slot] >= 0:
        turn = 1
    elif slot % width % wp.static(STRIDES[0]) == 0 and slot / width % wp.static(STRIDES[0]) == 0:
        turn = 1
    turns_out[world, slot] = turn


@wp.func
def are_alike(a: wp.vec3, b: wp.vec3, c: wp.vec3, d: wp.vec3) -> bool:
    """Whether the light at a cell's corners is much the same."""
    highest = wp.max(wp.max(a, b), wp.max(c, d))
    lowest = wp.min(wp.min(a, b), wp.min(c, d))
    return wp.max(highest - lowest) <= UNLIKE_LIGHT * wp.max(highest)


@wp.func
def bends(
    receivers: ReceiverTable,
    light: wp.array2d(dtype=wp.vec3),
    world: int,
    start: int,
    step: int,
    has_before: bool,
    has_after: bool,
) -> bool:
    """Whether light bends along the side from `start` to `start + step`, by its next neighbours on the same surface."""
    entity = receivers.entity[world, start]
    a = light[world, start]
    b = light[world, start + step]
    # Either end by itself: where light bends one way and back again, the sum of both is none.
    bend = wp.vec3()
    known = bool(False)
    if has_before:
        if receivers.entity[world, start - step] == entity:
            bend = wp.abs(light[world, start - step] - 2.0 * a + b)
            known = True
    if has_after:
        if receivers.entity[world, start + 2 * step] == entity:
            bend = wp.max(bend, wp.abs(a - 2.0 * b + light[world, start + 2 * step]))
            known = True
    if not known:
        bend = wp.abs(a - b)
    return wp.max(bend) > BENT_LIGHT * wp.max(wp.max(a, b))


@wp.func
def has_bent_side(
    receivers: ReceiverTable,
    light: wp.array2d(dtype=wp.vec3),
    world: int,
    corner: int,
    width: int,
    height: int,
    stride: int,
) -> bool:
    """Whether light bends along any side of a cell."""
    down = stride * width
    x = corner % width
    y = corner / width
    left = x >= stride
    right = x + 2 * stride < width
    above = y >= stride
    below = y + 2 * stride < height
    return (
        bends(receivers, light, world, corner, stride, left, right)
        or bends(receivers, light, world, corner + down, stride, left, right)
        or bends(receivers, light, world, corner, down, above, below)
        or bends(receivers, light, world, corner + stride, down, above, below)
    )


@wp.func
def is_smooth(
    receivers: ReceiverTable,
    diffuse: wp.array2d(dtype=wp.vec3),
    glossy: wp.array2d(dtype=wp.vec3),
    world: int,
    corner: int,
    width: int,
    height: int,
    stride: int,
) -> bool:
    """Whether the cell whose first corner is the pixel `corner` can be interpolated."""
    right = corner + stride
    below = corner + stride * width
    across = below + stride
    entity = receivers.entity[world, corner]
    if entity < 0:
        return False
    normal = receivers.normal[world, corner]
    for y in range(stride + 1):
        for x in range(stride + 1):
            pixel = corner + y * width + x
            if receivers.entity[world, pixel] != entity:
                return False
            if wp.dot(receivers.normal[world, pixel], normal) < SMOOTH_NORMAL:
                return False
    if not are_alike(diffuse[world, corner], diffuse[world, right], diffuse[world, below], diffuse[world, across]):
        return False
    if not are_alike(glossy[world, corner], glossy[world, right], glossy[world, below], glossy[world, across]):
        return False
    return not (
        has_bent_side(receivers, diffuse, world, corner, width, height, stride)
        or has_bent_side(receivers, glossy, world, corner, width, height, stride)
    )


@wp.func
def blend_corners(
    light: wp.array2d(dtype=wp.vec3), world: int, corner: int, stride: int, width: int, x: int, y: int
) -> wp.vec3:
    """Light between the corners of the cell that begins at the pixel `corner`, x and y pixels into it."""
    u = float(x) / float(stride)
    v = float(y) / float(stride)
    right = corner + stride
    below = corner + stride * width
    across = below + stride
    return (1.0 - v) * ((1.0 - u) * light[world, corner] + u * light[world, right]) + v * (
        (1.0 - u) * light[world, below] + u * light[world, across]
    )


@wp.kernel(enable_backward=False, module="unique")
def _refine(
    first: int,
    receivers: ReceiverTable,
    width: int,
    height: int,
    turn: int,
    stride: int,
    turns: wp.array2d(dtype=wp.int32),  # (world, slot)
    diffuse: wp.array2d(dtype=wp.vec3),  # (world, slot)
    glossy: wp.array2d(dtype=wp.vec3),  # (world, slot)
):
    world, cell = wp.tid()
    cell += first
    columns = (width + stride - 1) / stride
    x_0 = (cell % columns) * stride
    y_0 = (cell / columns) * stride
    corner = y_0 * width + x_0
    smooth = x_0 + stride < width and y_0 + stride < height
    if smooth:
        smooth = is_smooth(receivers, diffuse, glossy, world, corner, width, height, stride)
    half = stride / 2
    for y in range(wp.min(stride, height - y_0)):
        for x in range(wp.min(stride, width - x_0)):
            pixel = corner + y * width + x
            if turns[world, pixel] == 0:
                if smooth:
                    diffuse[world, pixel] = blend_corners(diffuse, world, corner, stride, width, x, y)
                    glossy[world, pixel] = blend_corners(glossy, world, corner, stride, width, x, y)
                    turns[world, pixel] = wp.static(INTERPOLATED)
                elif x % half == 0 and y % half == 0:
                    turns[world, pixel] = turn + 1


@wp.kernel(enable_backward=False, module="unique")
def _interpolate(
    first: int,
    receivers: ReceiverTable,
    width: int,
    height: int,
    stride: int,
    turns: wp.array2d(dtype=wp.int32),  # (world, slot)
    diffuse: wp.array2d(dtype=wp.vec3),  # (world, slot)
    glossy: wp.array2d(dtype=wp.vec3),  # (world, slot)
    sky_diffuse: wp.array2d(dtype=wp.vec3),  # (world, slot), or empty
    sky_glossy: wp.array2d(dtype=wp.vec3),  # (world, slot), or empty
):
    world, pixel = wp.tid()
    pixel += first
    if turns[world, pixel] != wp.static(INTERPOLATED) or receivers.entity[world, pixel] < 0:
        return
    x = pixel % width
    y = pixel / width
    # In a wide cell that was refined the pixels half-way were shaded, unless it was smooth. Cells that the border cuts
    # are always refined.
    wide = wp.static(STRIDES[0])
    half = wp.static(STRIDES[1])
    left = x - x % wide
    above = y - y % wide
    is_wide = bool(False)
    if left + wide < width and above + wide < height:
        for place in range(3):
            halfway = left + wp.where(place == 1, 0, half) + (above + wp.where(place == 2, 0, half)) * width
            if turns[world, halfway] == wp.static(INTERPOLATED) and receivers.entity[world, halfway] >= 0:
                is_wide = True
    if is_wide != (stride == wide):
        return
    corner = x - x % stride + (y - y % stride) * width
    diffuse[world, pixel] = blend_corners(diffuse, world, corner, stride, width, x % stride, y % stride)
    glossy[world, pixel] = blend_corners(glossy, world, corner, stride, width, x % stride, y % stride)
    if sky_diffuse.shape[1] > 0:
        sky_diffuse[world, pixel] = blend_corners(sky_diffuse, world, corner, stride, width, x % stride, y % stride)
        sky_glossy[world, pixel] = blend_corners(sky_glossy, world, corner, stride, width, x % stride, y % stride)


def make_lattice(worlds: int, slots: int, width: int, height: int, device: wp.Device) -> Lattice:
    """Room for the turns of `slots` receivers per world, the first width x height of which are pixels."""
    return Lattice(wp.zeros((worlds, slots), dtype=wp.int32, device=device), width, height)


def begin_lattice(lattice: Lattice, receivers: ReceiverTable, extra: wp.array, device: wp.Device) -> None:
    """Gives the first turn to every fourth pixel and to edges. extra: int32 (world, pixel), not -1 on edge pixels."""
    launch(_begin, in_use(receivers), [receivers, extra, lattice.width], [lattice.turns], device)


def refine_lattice(
    lattice: Lattice, turn: int, receivers: ReceiverTable, diffuse: wp.array, glossy: wp.array, device: wp.Device
) -> None:
    """Interpolates the smooth cells of a turn's lattice in place, and gives the next turn to pixels of the others."""
    stride = STRIDES[turn - 1]
    cells = -(-lattice.width // stride) * -(-lattice.height // stride)
    inputs = [receivers, lattice.width, lattice.height, turn, stride, lattice.turns, diffuse, glossy]
    launch(_refine, (lattice.turns.shape[0], cells), inputs, [], device)


def interpolate_lattice(
    lattice: Lattice,
    receivers: ReceiverTable,
    bounced: tuple[wp.array, wp.array],
    sky: tuple[wp.array, wp.array],
    device: wp.Device,
) -> None:
    """Interpolates other light in the cells in which a refined lattice was interpolated; both vec3 (world, slot).

    sky: empty where probes do not bring it.
    """
    dim = (lattice.turns.shape[0], lattice.width * lattice.height)
    for stride in STRIDES[:-1]:
        inputs = [receivers, lattice.width, lattice.height, stride, lattice.turns, *bounced, *sky]
        launch(_interpolate, dim, inputs, [], device)
