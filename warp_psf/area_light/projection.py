"""Pictures from a layered area light map: forward projection, backward retrieval, and the traced reference.

Source: Jeng 2005, section 4.3. The screen buffer holds for each pixel what is there (surface, position, colour without
shadows), and the share of the light that arrives, in which a picture's methods differ.
"""

from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_psf.area_light.atomics import add_to
from warp_psf.area_light.checks import check_picture, check_type
from warp_psf.area_light.layered import FrameTable, LayeredMap, cell_of, make_frame
from warp_psf.area_light.light_samples import (
    BrightTable,
    LightTable,
    irradiance_of,
    upload_bright,
    upload_light,
    visible_ratio,
)
from warp_psf.area_light.tracing import (
    DeviceStill,
    StillTable,
    ViewTable,
    make_view,
    meet,
    smooth_normal,
    upload_still,
    view_direction,
    view_origin,
)
from warp_psf.device import find_device, launch
from warp_psf.scene.camera import Camera
from warp_psf.scene.still import StillScene

# The greatest kernel that fills a hole reaches this many pixels to each side, and the greatest that smooths.
WIDEST_SPLAT, WIDEST_FILTER = wp.constant(16), wp.constant(5)
# Points belong to a pixel of their surface within so many of its footprints, and pixels to each other, where they rise
# over each other's plane by less than this share of their distance: a surface that bends back upon itself is parted.
FOOTPRINTS, SLOPE = wp.constant(3.0), wp.constant(0.5)
# What is nearer to the light by more than this share lies before a point.
BEHIND = wp.constant(0.98)
# Visibility is summed in these parts, below a count in the highest 24 bits: 2^24 points in a pixel.
PARTS, COUNT_SHIFT = wp.constant(wp.float32(65536.0)), wp.constant(wp.uint64(40))


@wp.struct
class LayerTable:
    """A layered map's elements on the device."""

    first: wp.array(dtype=wp.int32)  # (cell), and the number of elements
    surface: wp.array(dtype=wp.int32)  # (element)
    point: wp.array(dtype=wp.vec4)  # (element): position and visibility, which are read together
    normal: wp.array(dtype=wp.vec3)  # (element)


@wp.struct
class ScreenTable:
    """What each pixel shows."""

    surface: wp.array2d(dtype=wp.int32)  # (world, pixel), -1 where nothing is
    position: wp.array2d(dtype=wp.vec3)  # (world, pixel)
    normal: wp.array2d(dtype=wp.vec3)  # (world, pixel), smooth
    facing: wp.array2d(dtype=wp.vec3)  # (world, pixel), of the triangle
    color: wp.array2d(dtype=wp.vec3)  # (world, pixel): radiance without shadows, for a light of radiance 1
    width: wp.int32
    height: wp.int32


@dataclass(frozen=True, eq=False)
class DeviceLayers:
    """A scene and its layered map on the device, for many pictures. Built by `upload_layers`.

    Its fields `still`, `frame`, `layers`, `light`, `unshadowed`, `radiance` and `device` are for the methods alone.
    """

    still: DeviceStill
    frame: FrameTable
    layers: LayerTable
    light: LightTable
    unshadowed: BrightTable
    radiance: np.ndarray
    device: wp.Device


@dataclass(frozen=True, eq=False)
class ShadowPicture:
    """What a camera sees of a scene under one light.

    Attributes:
        color: radiance, linear, float32 [height, width, 3].
        visibility: the share of the light that arrives, 0 where none is sent, float32 [height, width].
        surface: of the scene, -1 where nothing is, int32 [height, width].
    """

    color: np.ndarray
    visibility: np.ndarray
    surface: np.ndarray


def upload_layers(layered: LayeredMap, scene: StillScene, device: str | None = None) -> DeviceLayers:
    """Brings a layered map and its scene to a device: "cpu", "cuda:0", ...; None chooses as `Renderer` does.

    Raises:
        ValueError: the map is of another scene.
        TypeError: one of them is something else.
    """
    check_type("layered", layered, LayeredMap, "bake_layered_map")
    check_type("scene", scene, StillScene, "freeze_scene or make_still")
    if layered.scene != scene.checksum:
        raise ValueError("the layered map is of another scene; bake one of this scene")
    on_device = find_device(device)
    table = LayerTable()
    table.first = wp.array(layered.first, dtype=wp.int32, device=on_device)
    table.surface = wp.array(layered.surface, dtype=wp.int32, device=on_device)
    point = np.concatenate([layered.position, layered.visibility[:, None]], axis=1)
    table.point = wp.array(point, dtype=wp.vec4, device=on_device)
    table.normal = wp.array(layered.normal, dtype=wp.vec3, device=on_device)
    frame = make_frame(layered.origin, layered.rotation, layered.middle, layered.half, layered.size, on_device)
    light, bright = upload_light(layered.light, on_device), upload_bright(layered.unshadowed, on_device)
    return DeviceLayers(upload_still(scene, on_device), frame, table, light, bright, layered.radiance, on_device)


def project_forward(layers: DeviceLayers, camera: Camera, width: int, height: int) -> ShadowPicture:
    """Carries the map's points onto the screen, fills holes within surfaces, and smooths within surfaces.

    Source: Jeng 2005, sections 4.3.1 to 4.3.3.

    Args:
        layers: of `upload_layers`.
        camera: any, such as one of the scene's.
        width, height: of the picture, pixels.

    Raises:
        ValueError: the picture has no size, or the camera has no pose or film.
        TypeError: `layers` or `camera` is something else.
    """
    view, screen = _look(layers, camera, width, height)
    device, pixels = layers.device, screen.width * screen.height
    sums = wp.zeros(pixels, dtype=wp.uint64, device=device)
    inputs = [layers.layers, view, screen]
    launch(_project_points, (1, layers.layers.surface.shape[0]), inputs, [sums], device)
    filled, smooth = (wp.zeros((1, pixels), dtype=wp.float32, device=device) for _ in range(2))
    reach = wp.zeros((1, pixels), dtype=wp.int32, device=device)
    inputs = [screen, sums, layers.frame, layers.layers]
    launch(_fill_holes, (1, pixels), inputs, [filled, reach], device)
    launch(_smooth_surfaces, (1, pixels), [screen, filled, reach], [smooth], device)
    return _picture(layers, screen, smooth)


def retrieve_backward(layers: DeviceLayers, camera: Camera, width: int, height: int) -> ShadowPicture:
    """Looks each pixel's point up in the map: the element of its surface in its cell, or in one beside it.

    This is how a layered attenuation map is read (Agrawala 2000), for comparison; takes what `project_forward` takes.
    """
    _, screen = _look(layers, camera, width, height)
    shape = (1, screen.width * screen.height)
    visibility = wp.zeros(shape, dtype=wp.float32, device=layers.device)
    inputs = [screen, layers.frame, layers.layers]
    launch(_retrieve_pixels, shape, inputs, [visibility], layers.device)
    return _picture(layers, screen, visibility)


def trace_view(layers: DeviceLayers, camera: Camera, width: int, height: int) -> ShadowPicture:
    """Asks every sample of the light with a ray from every pixel: the reference; takes what `project_forward` takes."""
    _, screen = _look(layers, camera, width, height)
    shape = (1, screen.width * screen.height)
    visibility = wp.zeros(shape, dtype=wp.float32, device=layers.device)
    inputs = [layers.still.table, layers.light, screen]
    launch(_trace_pixels, shape, inputs, [visibility], layers.device)
    return _picture(layers, screen, visibility)


def _look(layers: DeviceLayers, camera: Camera, width: int, height: int) -> tuple[ViewTable, ScreenTable]:
    """The screen buffer without shadows."""
    check_type("layers", layers, DeviceLayers, "upload_layers")
    width, height = check_picture(width, height)
    view, screen = make_view(camera, width, height), ScreenTable()
    screen.width, screen.height = width, height
    shape = (1, width * height)
    screen.surface = wp.zeros(shape, dtype=wp.int32, device=layers.device)
    for name in ("position", "normal", "facing", "color"):
        setattr(screen, name, wp.zeros(shape, dtype=wp.vec3, device=layers.device))
    launch(_see_pixels, shape, [layers.still.table, layers.unshadowed, view], [screen], layers.device)
    return view, screen


def _picture(layers: DeviceLayers, screen: ScreenTable, visibility: wp.array) -> ShadowPicture:
    shape = (screen.height, screen.width)
    share = visibility.numpy().reshape(shape)
    color = screen.color.numpy().reshape(*shape, 3) * share[..., None]
    color *= layers.radiance.astype(np.float32)
    return ShadowPicture(color, share, screen.surface.numpy().reshape(shape))


@wp.kernel(enable_backward=False, module="unique")
def _see_pixels(first: int, still: StillTable, light: BrightTable, view: ViewTable, screen_out: ScreenTable):
    world, pixel = wp.tid()
    pixel += first
    x = (float(pixel % screen_out.width) + 0.5) / float(screen_out.width)
    y = (float(pixel / screen_out.width) + 0.5) / float(screen_out.height)
    hit = meet(still, view_origin(view, x, y), view_direction(view, x, y), view.far)
    screen_out.surface[world, pixel] = hit.surface
    if hit.face >= 0:
        normal = smooth_normal(still, hit)
        screen_out.position[world, pixel] = hit.position
        screen_out.normal[world, pixel] = normal
        screen_out.facing[world, pixel] = hit.normal
        irradiance = irradiance_of(light, world, hit.position, hit.normal, normal)
        screen_out.color[world, pixel] = irradiance * wp.static(1.0 / np.pi) * still.albedo[hit.face]


@wp.func
def position_of(point: wp.vec4) -> wp.vec3:
    # Of the element's own row: a table as a parameter would be copied, arrays and all, for every element.
    return wp.vec3(point[0], point[1], point[2])


@wp.func
def belong_together(p: wp.vec3, n: wp.vec3, q: wp.vec3) -> bool:
    """Whether q lies along the surface at p rather than over or under it."""
    offset = q - p
    return wp.abs(wp.dot(n, offset)) <= SLOPE * wp.length(offset)


@wp.kernel(enable_backward=False, module="unique")
def _project_points(
    first: int,
    layers: LayerTable,
    view: ViewTable,
    screen: ScreenTable,
    sums_out: wp.array(dtype=wp.uint64),  # (pixel): points' count above the sum of their visibility
):
    world, element = wp.tid()
    element += first
    p = position_of(layers.point[element])
    local = wp.transpose(view.rotation) * (p - view.position)
    depth = -local[2]
    scale = wp.where(view.orthographic, 1.0, 1.0 / wp.max(depth, 1.0e-6))
    backward = wp.vec3(view.rotation[0, 2], view.rotation[1, 2], view.rotation[2, 2])
    toward = wp.where(view.orthographic, backward, wp.normalize(view.position - p))
    cosine = wp.dot(layers.normal[element], toward)
    if depth <= view.near or depth >= view.far or cosine <= 0.0:
        return
    x = 0.5 + 0.5 * (local[0] * scale - view.center[0]) / view.half[0]
    y = 0.5 - 0.5 * (local[1] * scale - view.center[1]) / view.half[1]
    if wp.min(x, y) < 0.0 or wp.max(x, y) >= 1.0:
        return
    column = wp.min(int(x * float(screen.width)), screen.width - 1)
    row = wp.min(int(y * float(screen.height)), screen.height - 1)
    pixel = row * screen.width + column
    if screen.surface[world, pixel] != layers.surface[element]:
        return
    q = screen.position[world, pixel]
    footprint = 2.0 * view.half[1] / (scale * float(screen.height) * wp.max(cosine, 0.05))
    near = wp.length(p - q) <= FOOTPRINTS * footprint
    # Within half a pixel of its middle a point is the pixel's, whatever the rounding of its place says of slopes.
    if near and (wp.length(p - q) < 0.5 * footprint or belong_together(q, screen.normal[world, pixel], p)):
        share = wp.uint64(PARTS * layers.point[element][3] + 0.5)
        add_to(sums_out, pixel, (wp.uint64(1) << COUNT_SHIFT) + share)


@wp.func
def mean_of(sums: wp.uint64) -> float:
    """The mean visibility of a pixel's points; -1 where it has none."""
    count = float(sums >> COUNT_SHIFT)
    total = float(sums & ((wp.uint64(1) << COUNT_SHIFT) - wp.uint64(1)))
    return wp.where(count > 0.0, total / (PARTS * wp.max(count, 1.0)), -1.0)


@wp.kernel(enable_backward=False, module="unique")
def _fill_holes(
    first: int,
    screen: ScreenTable,
    sums: wp.array(dtype=wp.uint64),  # (pixel)
    frame: FrameTable,
    layers: LayerTable,
    filled_out: wp.array2d(dtype=wp.float32),  # (world, pixel)
    reach_out: wp.array2d(dtype=wp.int32),  # (world, pixel): of the kernel that was needed
):
    world, pixel = wp.tid()
    pixel += first
    surface = screen.surface[world, pixel]
    if wp.max(screen.color[world, pixel]) <= 0.0:
        # Nothing is there, or what turns away from the light.
        return
    value = mean_of(sums[pixel])
    reach = int(0)
    p = screen.position[world, pixel]
    n = screen.normal[world, pixel]
    column = pixel % screen.width
    row = pixel / screen.width
    if value < 0.0 and is_umbra(frame, layers, p, surface):
        # At its rim, what the map knows within a cell's width.
        known = look_up(frame, layers, p, surface)
        value = wp.where(known[1] < cell_width(frame, p), wp.max(known[0], 0.0), 0.0)
    while value < 0.0 and reach < WIDEST_SPLAT:
        reach += 1
        total = float(0.0)
        count = float(0.0)
        # Nothing was found within the smaller kernel: only the rim of this one is new.
        for step in range(8 * reach):
            side = step / (2 * reach)
            along = step % (2 * reach) - reach
            x = column + wp.where(side == 0, along, wp.where(side == 1, reach, wp.where(side == 2, -along, -reach)))
            y = row + wp.where(side == 0, -reach, wp.where(side == 1, along, wp.where(side == 2, reach, -along)))
            if x >= 0 and x < screen.width and y >= 0 and y < screen.height:
                other = y * screen.width + x
                if screen.surface[world, other] == surface:
                    share = mean_of(sums[other])
                    if share >= 0.0:
                        if belong_together(p, n, screen.position[world, other]):
                            total += share
                            count += 1.0
        if count > 0.0:
            value = total / count
    if value < 0.0:
        # What no reference view saw for many pixels around: what the map itself says, and dark where it says nothing.
        value = wp.max(look_up(frame, layers, p, surface)[0], 0.0)
    filled_out[world, pixel] = value
    reach_out[world, pixel] = reach


@wp.func
def look_up(frame: FrameTable, layers: LayerTable, p: wp.vec3, surface: int) -> wp.vec2:
    """The visibility of the map's nearest point of a surface in p's cell or, if there is none, one beside it.

    And its distance, metres. A visibility of -1 says that there is none.
    """
    cell = cell_of(frame, p)
    value = float(-1.0)
    if cell < 0:
        return wp.vec2(value, 1.0e30)
    faces = cell / (frame.size * frame.size)
    row = (cell / frame.size) % frame.size
    column = cell % frame.size
    nearest = float(1.0e30)
    step = int(0)
    # The cell itself comes first.
    while step < 9 and value < 0.0:
        place = (step + 4) % 9
        y = row + place / 3 - 1
        x = column + place % 3 - 1
        if y >= 0 and y < frame.size and x >= 0 and x < frame.size:
            at = (faces * frame.size + y) * frame.size + x
            for element in range(layers.first[at], layers.first[at + 1]):
                if layers.surface[element] == surface:
                    squared = wp.length_sq(position_of(layers.point[element]) - p)
                    if squared < nearest:
                        nearest = squared
                        value = layers.point[element][3]
        step += 1
    return wp.vec2(value, wp.sqrt(nearest))


@wp.func
def cell_width(frame: FrameTable, p: wp.vec3) -> float:
    """Of the map's cell at p, metres: the square of side 2 is a half space of 2 pi."""
    return wp.static(float(np.sqrt(2.0 * np.pi))) * frame.half / float(frame.size) * wp.length(p - frame.origin)


@wp.func
def is_umbra(frame: FrameTable, layers: LayerTable, p: wp.vec3, surface: int) -> bool:
    """Whether no reference view saw p's surface in its cell of the map because another one lies before it."""
    cell = cell_of(frame, p)
    behind = bool(False)
    if cell >= 0:
        distance = BEHIND * wp.length(p - frame.origin)
        for element in range(layers.first[cell], layers.first[cell + 1]):
            before = wp.length(position_of(layers.point[element]) - frame.origin) < distance
            if layers.surface[element] == surface and not before:
                return False
            behind = behind or before
    return behind


@wp.kernel(enable_backward=False, module="unique")
def _smooth_surfaces(
    first: int,
    screen: ScreenTable,
    filled: wp.array2d(dtype=wp.float32),  # (world, pixel)
    reach: wp.array2d(dtype=wp.int32),  # (world, pixel)
    visibility_out: wp.array2d(dtype=wp.float32),  # (world, pixel)
):
    world, pixel = wp.tid()
    pixel += first
    surface = screen.surface[world, pixel]
    if wp.max(screen.color[world, pixel]) <= 0.0:
        return
    p = screen.position[world, pixel]
    n = screen.normal[world, pixel]
    column = pixel % screen.width
    row = pixel / screen.width
    # As wide as the holes that were filled here, and a pixel at least.
    half = wp.clamp(reach[world, pixel], 1, WIDEST_FILTER)
    total = float(0.0)
    weights = float(0.0)
    for dy in range(-half, half + 1):
        for dx in range(-half, half + 1):
            x = column + dx
            y = row + dy
            if x >= 0 and x < screen.width and y >= 0 and y < screen.height:
                other = y * screen.width + x
                if screen.surface[world, other] == surface and wp.max(screen.color[world, other]) > 0.0:
                    if belong_together(p, n, screen.position[world, other]):
                        # A tent.
                        weight = float((half + 1 - wp.abs(dx)) * (half + 1 - wp.abs(dy)))
                        total += weight * filled[world, other]
                        weights += weight
    visibility_out[world, pixel] = total / wp.max(weights, 1.0e-6)


@wp.kernel(enable_backward=False, module="unique")
def _retrieve_pixels(
    first: int,
    screen: ScreenTable,
    frame: FrameTable,
    layers: LayerTable,
    visibility_out: wp.array2d(dtype=wp.float32),  # (world, pixel)
):
    world, pixel = wp.tid()
    pixel += first
    surface = screen.surface[world, pixel]
    if wp.max(screen.color[world, pixel]) > 0.0:
        visibility_out[world, pixel] = wp.max(look_up(frame, layers, screen.position[world, pixel], surface)[0], 0.0)


@wp.kernel(enable_backward=False, module="unique")
def _trace_pixels(
    first: int,
    still: StillTable,
    light: LightTable,
    screen: ScreenTable,
    visibility_out: wp.array2d(dtype=wp.float32),  # (world, pixel)
):
    world, pixel = wp.tid()
    pixel += first
    if wp.max(screen.color[world, pixel]) > 0.0:
        visibility_out[world, pixel] = visible_ratio(
            still,
            light,
            world,
            screen.position[world, pixel],
            screen.facing[world, pixel],
            screen.normal[world, pixel],
            True,
        )
