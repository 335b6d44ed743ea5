"""The scene map: what a viewpoint sees, adaptively sampled as shadow maps are (Jeng 2005, 3.3.2)."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_psf.area_light.checks import check_picture
from warp_psf.area_light.quadtree import Quadtrees, grow_quadtrees
from warp_psf.area_light.tracing import (
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

# Cells are divided at least until they are so many pixels wide: bodies wider than that are found.
COARSEST = 16
# Curved surfaces are divided where the depths of a cell's corners differ by more than this share of themselves, or
# their normals by more than this angle's cosine (8 degrees): between corners both are interpolated.
DEPTH_SPREAD, ALIKE = 0.01, 0.99
LARGEST_PICTURE = 4096
# What lies nearer than this, metres, as where a camera stands on a surface, counts as this near.
NEAREST = wp.constant(1.0e-9)


@dataclass(frozen=True, eq=False)
class SceneMap:
    """What a camera sees in a picture of width x height pixels, adaptively sampled. Built by `bake_scene_map`.

    Attributes:
        camera: the viewpoint.
        width, height: of the picture, pixels.
        flat: whether each surface of the scene is a plane, bool [surfaces].
        maps: a quad-tree whose samples lie at pixels' centres, of (inverse depth 1/m, or depth for an orthographic
            camera, float32; surface, int32, -1 where nothing is; smooth normal, float32 [3]; albedo, float32 [3]).
        scene: checksum of the scene.
    """

    camera: Camera
    width: int
    height: int
    flat: np.ndarray
    maps: Quadtrees
    scene: int

    @property
    def share(self) -> float:
        """Samples that were taken, as a share of the picture's pixels."""
        return float(self.maps.counts[0] / (self.width * self.height))


def bake_scene_map(
    scene: StillScene, camera: int = 0, width: int = 513, height: int = 513, *, device: str | None = None
) -> SceneMap:
    """Samples what one of the scene's cameras sees. Source: Jeng 2005, section 3.3.2.

    Args:
        scene: with at least one camera.
        camera: its place among the scene's cameras, counted from 0.
        width, height: of the picture, pixels, 2 to 4096.
        device: "cpu", "cuda:0", ...; None takes the first CUDA device, else the CPU.

    Raises:
        ValueError: there is no such camera, or the picture has no size.
        TypeError: `scene` is no still scene.
    """
    width, height = check_picture(width, height, 2, LARGEST_PICTURE)
    on_device = find_device(device)
    still = upload_still(scene, on_device)
    if not isinstance(camera, (int, np.integer)) or not 0 <= camera < len(scene.cameras):
        raise ValueError(f"camera is {camera!r}; the scene has {len(scene.cameras)} cameras, counted from 0")
    view = make_view(scene.cameras[camera], width, height)
    levels = max((max(width, height) - 2).bit_length(), 1)
    preset = max(levels - COARSEST.bit_length() + 1, 0)

    def sample(_maps: np.ndarray, column: np.ndarray, row: np.ndarray) -> tuple[np.ndarray, ...]:
        at = np.stack([(column + 0.5) / width, (row + 0.5) / height], axis=1)
        film = wp.array(at, dtype=wp.vec2, device=on_device)
        depth = wp.zeros(len(at), dtype=wp.float32, device=on_device)
        surface = wp.zeros(len(at), dtype=wp.int32, device=on_device)
        normal, albedo = (wp.zeros(len(at), dtype=wp.vec3, device=on_device) for _ in range(2))
        outputs = [depth, surface, normal, albedo]
        launch(_sample_view, (1, len(at)), [still.table, view, film], outputs, on_device)
        return tuple(array.numpy() for array in outputs)

    def split(cells: np.ndarray, corners: tuple[np.ndarray, ...]) -> np.ndarray:
        depth, surface, normal, albedo = corners
        one = (surface == surface[:, :1]).all(axis=1) & (albedo == albedo[:, :1]).all(axis=(1, 2))
        curved = (surface[:, 0] >= 0) & ~scene.flat[surface[:, 0]]
        bent = (normal[:, 1:] * normal[:, :1]).sum(axis=2).min(axis=1) < ALIKE
        steep = depth.max(axis=1) > (1.0 + DEPTH_SPREAD) * depth.min(axis=1)
        within = (cells[:, 1] < width) & (cells[:, 2] < height)
        return within & (~one | (curved & (bent | steep)))

    maps = grow_quadtrees(1, 2**levels + 1, preset, sample, split)
    return SceneMap(scene.cameras[camera], width, height, scene.flat, maps, scene.checksum)


@wp.kernel(enable_backward=False, module="unique")
def _sample_view(
    first: int,
    still: StillTable,
    view: ViewTable,
    film: wp.array(dtype=wp.vec2),  # (sample)
    depth_out: wp.array(dtype=wp.float32),  # (sample)
    surface_out: wp.array(dtype=wp.int32),  # (sample)
    normal_out: wp.array(dtype=wp.vec3),  # (sample)
    albedo_out: wp.array(dtype=wp.vec3),  # (sample)
):
    world, index = wp.tid()
    index += first
    at = film[index]
    hit = meet(still, view_origin(view, at[0], at[1]), view_direction(view, at[0], at[1]), view.far)
    surface_out[index] = hit.surface
    if hit.face >= 0:
        depth_out[index] = wp.where(view.orthographic, hit.distance, 1.0 / wp.max(hit.distance, NEAREST))
        normal_out[index] = smooth_normal(still, hit)
        albedo_out[index] = still.albedo[hit.face]


@wp.struct
class PixelTable:
    """What each pixel of the screen buffer shows."""

    position: wp.array2d(dtype=wp.vec3)  # (world, pixel), metres
    normal: wp.array2d(dtype=wp.vec3)  # (world, pixel)
    albedo: wp.array2d(dtype=wp.vec3)  # (world, pixel)
    surface: wp.array2d(dtype=wp.int32)  # (world, pixel), -1 where nothing is
    flat: wp.array2d(dtype=wp.bool)  # (world, pixel): whether the surface is


def retrieve_pixels(scene_map: SceneMap, device: wp.Device) -> PixelTable:
    """Every pixel's surface point, interpolated between the corners of its leaf. Source: Jeng 2005, section 3.2.3."""
    pixels, maps = scene_map.width * scene_map.height, scene_map.maps
    table = PixelTable()
    table.position, table.normal, table.albedo = (wp.zeros((1, pixels), dtype=wp.vec3, device=device) for _ in range(3))
    table.surface = wp.zeros((1, pixels), dtype=wp.int32, device=device)
    table.flat = wp.zeros((1, pixels), dtype=wp.bool, device=device)
    view = make_view(scene_map.camera, scene_map.width, scene_map.height)
    depth, surface, normal, albedo = maps.samples
    inputs = [
        view,
        scene_map.width,
        scene_map.height,
        1 << maps.preset,
        (maps.size - 1) >> maps.preset,
        wp.array(maps.link, dtype=wp.int32, device=device),
        wp.array(maps.corners, dtype=wp.vec4i, device=device),
        wp.array(depth, dtype=wp.float32, device=device),
        wp.array(surface, dtype=wp.int32, device=device),
        wp.array(normal, dtype=wp.vec3, device=device),
        wp.array(albedo, dtype=wp.vec3, device=device),
        wp.array(scene_map.flat, dtype=wp.bool, device=device),
    ]
    launch(_retrieve_pixels, (1, pixels), inputs, [table], device)
    return table


@wp.kernel(enable_backward=False, module="unique")
def _retrieve_pixels(
    first: int,
    view: ViewTable,
    width: int,
    height: int,
    grid: int,
    coarsest: int,
    link: wp.array(dtype=wp.int32),  # (node)
    corners: wp.array(dtype=wp.vec4i),  # (leaf)
    depth: wp.array(dtype=wp.float32),  # (sample)
    surface: wp.array(dtype=wp.int32),  # (sample)
    normal: wp.array(dtype=wp.vec3),  # (sample)
    albedo: wp.array(dtype=wp.vec3),  # (sample)
    flat: wp.array(dtype=wp.bool),  # (surface)
    pixels_out: PixelTable,
):
    world, pixel = wp.tid()
    pixel += first
    x = (float(pixel % width) + 0.5) / float(width)
    y = (float(pixel / width) + 0.5) / float(height)
    # The last pixel of a row lies at the far side of its cell.
    side = int(coarsest)
    cell = wp.vec2i(wp.min((pixel % width) / side, grid - 1), wp.min((pixel / width) / side, grid - 1))
    column = pixel % width - cell[0] * side
    row = pixel / width - cell[1] * side
    to = link[cell[1] * grid + cell[0]]
    while to >= 0:
        side /= 2
        child = int(0)
        if column >= side:
            column -= side
            child += 1
        if row >= side:
            row -= side
            child += 2
        to = link[to + child]
    ends = corners[-1 - to]
    u = float(column) / float(side)
    v = float(row) / float(side)
    # The pixel is a corner of a leaf whose corners differ, which is one pixel wide.
    nearest = wp.where(2 * column > side, 1, 0) + wp.where(2 * row > side, 2, 0)
    met = surface[ends[nearest]]
    pixels_out.surface[world, pixel] = met
    if met < 0:
        return
    weights = wp.vec4((1.0 - u) * (1.0 - v), u * (1.0 - v), (1.0 - u) * v, u * v)
    between = float(0.0)
    direction = wp.vec3()
    for k in range(4):
        between += weights[k] * depth[ends[k]]
        direction += weights[k] * normal[ends[k]]
    along = wp.where(view.orthographic, between, 1.0 / between)
    pixels_out.position[world, pixel] = view_origin(view, x, y) + along * view_direction(view, x, y)
    pixels_out.normal[world, pixel] = wp.normalize(direction)
    pixels_out.albedo[world, pixel] = albedo[ends[nearest]]
    pixels_out.flat[world, pixel] = flat[met]
