"""Point lists as a picture: culling, detail by distance, splats, and the alternative z-buffer (Jeng 2005, 5.3)."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import warp as wp

from warp_psf.area_light.atomics import add_to, lower_to
from warp_psf.area_light.checks import check_picture, check_type
from warp_psf.area_light.points import PointLists
from warp_psf.area_light.tracing import ViewTable, make_view
from warp_psf.device import find_device, launch
from warp_psf.scene.camera import Camera

# Points whose divided square is narrower than this many pixels are left to it, their stand-in: its diagonal is a pixel.
FINEST = wp.constant(0.7)
# A square is shown by a stand-in a little before its points vanish: both judge by their own distance.
OVERLAP = wp.constant(1.05)
# Squares reach over one another by this share: pixel centres on the line between two belong to one of them.
REACH = wp.constant(0.501)
# A list's splats hide those of larger lists unless they lie behind them by more than this many of their squares: as far
# as a splat reaches beyond its triangle. With more, what is close behind a surface shows through it.
THRESHOLD = wp.constant(0.5)
NOTHING = wp.constant(wp.uint64(0xFFFFFFFFFFFFFFFF))
# Splats reach beyond their triangle by half a pixel, and by half a smallest square at most: silhouettes are within a
# pixel however near the viewer is, and what is narrower than a pixel still meets the middle of one.
OVERHANG = wp.constant(0.5)
# A square whose nearest corner has less than this share of its middle's depth may be anywhere in the picture: so close
# to the camera's plane, bounds of its projection are no bounds.
SHALLOWEST = wp.constant(0.02)


@wp.struct
class PointTable:
    """Point lists on the device."""

    origin: wp.array(dtype=wp.vec3)  # (triangle), world, metres
    right: wp.array(dtype=wp.vec3)  # (triangle): first axis of its plane
    up: wp.array(dtype=wp.vec3)  # (triangle): second axis
    normal: wp.array(dtype=wp.vec3)  # (triangle)
    albedo: wp.array(dtype=wp.vec3)  # (triangle)
    sides: wp.array(dtype=wp.mat33)  # (triangle): (x, y, 1) times it, in its plane, is how far within, metres
    cell: wp.array(dtype=wp.vec2i)  # (point)
    first: wp.array(dtype=wp.int32)  # (group), and the number of points
    triangle: wp.array(dtype=wp.int32)  # (group)
    stands_in: wp.array(dtype=wp.bool)  # (group)
    alone: wp.array(dtype=wp.bool)  # (group)


@dataclass(frozen=True, eq=False)
class DevicePoints:
    """Point lists as `splat_points` takes them for many pictures. Built by `upload_points`.

    Attributes:
        table: the points, on the device.
        groups: of each list, from where to where.
        sizes: sides of the lists' squares, metres.
        device: where they are.
    """

    table: PointTable
    groups: tuple[tuple[int, int], ...]
    sizes: tuple[float, ...]
    device: wp.Device


@dataclass(frozen=True, eq=False)
class PointPicture:
    """What points show. Built by `splat_points`.

    Attributes:
        color: albedo under a lamp at the viewer, linear, float32 [height, width, 3].
        depth: metres along the optical axis, infinite where nothing is, float32 [height, width].
        level: the list of the splat that is seen, counted from 0, -1 where nothing is, int32 [height, width].
        points: how many were rendered, after culling and detail control.
    """

    color: np.ndarray
    depth: np.ndarray
    level: np.ndarray
    points: int


def upload_points(lists: PointLists, device: str | None = None) -> DevicePoints:
    """Brings point lists to the device.

    Args:
        lists: of `sample_points`.
        device: "cpu", "cuda:0", ...; None takes the first CUDA device, else the CPU.

    Raises:
        ValueError: there is no such device.
        TypeError: they are something else.
    """
    check_type("lists", lists, PointLists, "sample_points")
    on_device = find_device(device)
    order = np.argsort(lists.level, kind="stable")
    counts = np.diff(lists.first)[order]
    begin = np.cumsum(counts) - counts
    place = np.repeat(lists.first[:-1][order] - begin, counts) + np.arange(counts.sum())
    table = PointTable()
    vectors = {"origin": lists.origin, "right": lists.axes[:, 0], "up": lists.axes[:, 1]}
    for name, values in (vectors | {"normal": lists.normal, "albedo": lists.albedo}).items():
        setattr(table, name, wp.array(values.astype(np.float32), dtype=wp.vec3, device=on_device))
    table.sides = wp.array(lists.sides.astype(np.float32), dtype=wp.mat33, device=on_device)
    table.cell = wp.array(lists.cell[place], dtype=wp.vec2i, device=on_device)
    table.first = wp.array(np.append(begin, counts.sum()).astype(np.int32), dtype=wp.int32, device=on_device)
    table.triangle = wp.array(lists.triangle[order], dtype=wp.int32, device=on_device)
    table.stands_in = wp.array(lists.stands_in[order], dtype=wp.bool, device=on_device)
    table.alone = wp.array(lists.alone[order], dtype=wp.bool, device=on_device)
    ends = np.searchsorted(lists.level[order], np.arange(lists.levels + 1))
    groups = tuple((int(a), int(b)) for a, b in pairwise(ends))
    return DevicePoints(table, groups, tuple(lists.size(level) for level in range(lists.levels)), on_device)


def splat_points(points: DevicePoints, camera: Camera, width: int, height: int) -> PointPicture:
    """The picture of a camera.

    Source: Jeng 2005, section 5.3. Depths within a splat are those of its triangle's plane.

    Args:
        points: of `upload_points`.
        camera: any, such as one of the scene's.
        width, height: of the picture, pixels.

    Raises:
        ValueError: the picture has no size, or the camera has no pose or film.
        TypeError: `points` or `camera` is something else.
    """
    check_type("points", points, DevicePoints, "upload_points")
    width, height = check_picture(width, height)
    device, pixels = points.device, width * height
    view = make_view(camera, width, height)
    keys = wp.empty((1, pixels), dtype=wp.uint64, device=device)
    shown = wp.empty((1, pixels), dtype=wp.uint64, device=device)
    level = wp.empty((1, pixels), dtype=wp.int32, device=device)
    used = wp.zeros(1, dtype=wp.uint64, device=device)
    shown.fill_(NOTHING)
    level.fill_(-1)
    for number, ((begin, end), size) in enumerate(zip(points.groups, points.sizes, strict=True)):
        keys.fill_(NOTHING)
        inputs = [points.table, view, begin, size, points.sizes[-1], number == 0, width, height]
        launch(_splat_groups, (1, end - begin), inputs, [keys.flatten(), used], device)
        launch(_merge_list, (1, pixels), [keys, number, size], [shown, level], device)
    color = wp.empty((1, pixels), dtype=wp.vec3, device=device)
    depth = wp.empty((1, pixels), dtype=wp.float32, device=device)
    launch(_shade_points, (1, pixels), [points.table, view, shown, width, height], [color, depth], device)
    return PointPicture(
        color.numpy().reshape(height, width, 3),
        depth.numpy().reshape(height, width),
        level.numpy().reshape(height, width),
        int(used.numpy()[0]),
    )


@wp.func_native("wp::uint32 bits; memcpy(&bits, &value, 4); return bits;")
def bits_of(value: wp.float32) -> wp.uint32:
    """The bits of a float, which are in the order of the floats where those are not negative."""


@wp.func_native("float value; memcpy(&value, &bits, 4); return value;")
def float_of(bits: wp.uint32) -> wp.float32:
    """The float of some bits."""


@wp.func
def film_of(view: ViewTable, width: int, height: int) -> wp.mat33:
    """Takes a point of the camera's frame (x, y, depth) to pixel coordinates times its weight, and the weight."""
    across = 0.5 * float(width) / view.half[0]
    down = 0.5 * float(height) / view.half[1]
    middle = wp.vec2(0.5 * float(width) - across * view.center[0], 0.5 * float(height) + down * view.center[1])
    if view.orthographic:
        # The weight is 1, which the caller adds.
        return wp.mat33(across, 0.0, 0.0, 0.0, -down, 0.0, 0.0, 0.0, 0.0)
    return wp.mat33(across, 0.0, middle[0], 0.0, -down, middle[1], 0.0, 0.0, 1.0)


@wp.func
def splat_bounds(middle: wp.vec3, a: wp.vec3, b: wp.vec3, width: int, height: int) -> wp.vec4i:
    """Columns, then rows, from where to where, that hold a square's projection.

    middle: of the square, in homogeneous pixel coordinates; a, b: its two sides there.
    """
    across = 0.5 * (wp.abs(a[0]) + wp.abs(b[0]))
    down = 0.5 * (wp.abs(a[1]) + wp.abs(b[1]))
    deep = 0.5 * (wp.abs(a[2]) + wp.abs(b[2]))
    farthest = middle[2] + deep
    if middle[2] - deep < SHALLOWEST * wp.abs(middle[2]):
        # Before the camera's plane, what is in the picture has 0 <= x <= width times its weight.
        outside = middle[0] + across < 0.0 or middle[1] + down < 0.0
        aside_x = middle[0] - float(width) * middle[2]
        aside_y = middle[1] - float(height) * middle[2]
        outside = outside or aside_x > 0.5 * (wp.abs(a[0] - float(width) * a[2]) + wp.abs(b[0] - float(width) * b[2]))
        outside = outside or aside_y > 0.5 * (wp.abs(a[1] - float(height) * a[2]) + wp.abs(b[1] - float(height) * b[2]))
        if outside or farthest <= 0.0:
            return wp.vec4i(0, -1, 0, -1)
        return wp.vec4i(0, width - 1, 0, height - 1)
    weight = 1.0 / middle[2]
    x = middle[0] * weight
    y = middle[1] * weight
    # The nearest corner has the least weight, and lies so much farther from the middle than without perspective.
    reach = 0.5 / (middle[2] - deep)
    reach_x = reach * (wp.abs(a[0] - x * a[2]) + wp.abs(b[0] - x * b[2])) + 0.01
    reach_y = reach * (wp.abs(a[1] - y * a[2]) + wp.abs(b[1] - y * b[2])) + 0.01
    # Before they become whole numbers, which hold less.
    x_0 = wp.clamp(wp.ceil(x - reach_x - 0.5), 0.0, float(width))
    x_1 = wp.clamp(wp.floor(x + reach_x - 0.5), -1.0, float(width) - 1.0)
    y_0 = wp.clamp(wp.ceil(y - reach_y - 0.5), 0.0, float(height))
    y_1 = wp.clamp(wp.floor(y + reach_y - 0.5), -1.0, float(height) - 1.0)
    return wp.vec4i(int(x_0), int(x_1), int(y_0), int(y_1))


@wp.kernel(enable_backward=False, module="unique")
def _splat_groups(
    first: int,
    points: PointTable,
    view: ViewTable,
    begin: int,
    size: float,
    smallest: float,
    largest: bool,
    width: int,
    height: int,
    keys_out: wp.array(dtype=wp.uint64),  # (pixel): depth's bits above the triangle's number
    used_out: wp.array(dtype=wp.uint64),  # (1)
):
    world, group = wp.tid()
    group += first + begin
    triangle = points.triangle[group]
    origin = points.origin[triangle]
    normal = points.normal[triangle]
    backward = wp.vec3(view.rotation[0, 2], view.rotation[1, 2], view.rotation[2, 2])
    to_viewer = wp.where(view.orthographic, backward, view.position - origin)
    if wp.dot(normal, to_viewer) <= 0.0:
        return
    # The plane's coordinates in the camera's frame (x, y, depth), then on the film: all of it is linear in
    # (column, row, 1) and in homogeneous pixel coordinates.
    inverse = wp.transpose(view.rotation)
    place = inverse * (origin - view.position)
    right = size * (inverse * points.right[triangle])
    up = size * (inverse * points.up[triangle])
    film = film_of(view, width, height)
    a = film * wp.vec3(right[0], right[1], -right[2])
    b = film * wp.vec3(up[0], up[1], -up[2])
    c = film * wp.vec3(place[0], place[1], -place[2])
    if view.orthographic:
        across = 0.5 * float(width) / view.half[0]
        down = 0.5 * float(height) / view.half[1]
        c += wp.vec3(0.5 * float(width) - across * view.center[0], 0.5 * float(height) + down * view.center[1], 1.0)
    onto = wp.matrix_from_cols(a, b, c)
    back = wp.inverse(onto)
    depth_of = wp.vec3(-right[2], -up[2], -place[2])
    stands_in = points.stands_in[group]
    alone = points.alone[group]
    # Squares of the larger lists lie within their triangle: no side is near. Lengths are in squares from here on.
    sides = wp.mat33()
    if stands_in or size == smallest:
        sides = points.sides[triangle] * wp.diag(wp.vec3(1.0, 1.0, 1.0 / size))
    focal = 0.5 * float(height) / view.half[1]
    deep = 0.5 * (wp.abs(depth_of[0]) + wp.abs(depth_of[1]))
    used = int(0)
    for point in range(points.first[group], points.first[group + 1]):
        cell = points.cell[point]
        middle = wp.vec3(float(cell[0]) + 0.5, float(cell[1]) + 0.5, 1.0)
        depth = wp.dot(depth_of, middle)
        if depth + deep > view.near and depth - deep < view.far:
            weighted = onto * middle
            # Across the camera's plane a square is as wide as can be.
            pixels = focal * size / wp.max(weighted[2], 1.0e-6)
            # Points that are too small to be seen leave their place to a stand-in, and the other way round.
            shows = alone or largest or 2.0 * pixels > FINEST
            if stands_in:
                shows = pixels <= FINEST * OVERLAP and (largest or 2.0 * pixels > FINEST) and not alone
            if shows:
                used += 1
                within = -OVERHANG * wp.min(smallest / size, 1.0 / pixels)
                bounds = splat_bounds(weighted, a, b, width, height)
                for row in range(bounds[2], bounds[3] + 1):
                    for column in range(bounds[0], bounds[1] + 1):
                        at = back * wp.vec3(float(column) + 0.5, float(row) + 0.5, 1.0)
                        on_plane = wp.vec3(at[0] / at[2], at[1] / at[2], 1.0)
                        aside = wp.max(wp.abs(on_plane[0] - middle[0]), wp.abs(on_plane[1] - middle[1]))
                        if aside <= REACH and wp.min(sides * on_plane) >= within:
                            there = wp.dot(depth_of, on_plane)
                            key = (wp.uint64(bits_of(there)) << wp.uint64(32)) | wp.uint64(triangle)
                            if there > view.near and there < view.far:
                                lower_to(keys_out, row * width + column, key)
    add_to(used_out, 0, wp.uint64(used))


@wp.func
def depth_of_key(key: wp.uint64) -> float:
    return float_of(wp.uint32(key >> wp.uint64(32)))


@wp.kernel(enable_backward=False, module="unique")
def _merge_list(
    first: int,
    keys: wp.array2d(dtype=wp.uint64),  # (world, pixel)
    number: int,
    size: float,
    shown_out: wp.array2d(dtype=wp.uint64),  # (world, pixel)
    level_out: wp.array2d(dtype=wp.int32),  # (world, pixel)
):
    world, pixel = wp.tid()
    pixel += first
    key = keys[world, pixel]
    if key != NOTHING:
        before = shown_out[world, pixel]
        threshold = wp.where(number == 0, 0.0, THRESHOLD * size)
        if before == NOTHING or depth_of_key(key) < depth_of_key(before) + threshold:
            shown_out[world, pixel] = key
            level_out[world, pixel] = number


@wp.kernel(enable_backward=False, module="unique")
def _shade_points(
    first: int,
    points: PointTable,
    view: ViewTable,
    shown: wp.array2d(dtype=wp.uint64),  # (world, pixel)
    width: int,
    height: int,
    color_out: wp.array2d(dtype=wp.vec3),  # (world, pixel)
    depth_out: wp.array2d(dtype=wp.float32),  # (world, pixel)
):
    world, pixel = wp.tid()
    pixel += first
    key = shown[world, pixel]
    color = wp.vec3()
    depth = float(wp.inf)
    if key != NOTHING:
        triangle = int(key & wp.uint64(0xFFFFFFFF))
        depth = depth_of_key(key)
        x = 2.0 * (float(pixel % width) + 0.5) / float(width) - 1.0
        y = 1.0 - 2.0 * (float(pixel / width) + 0.5) / float(height)
        film = wp.vec3(view.center[0] + x * view.half[0], view.center[1] + y * view.half[1], -1.0)
        if view.orthographic:
            film = wp.vec3(0.0, 0.0, -1.0)
        toward = view.rotation * wp.normalize(film)
        color = wp.max(-wp.dot(points.normal[triangle], toward), 0.0) * points.albedo[triangle]
    color_out[world, pixel] = color
    depth_out[world, pixel] = depth
