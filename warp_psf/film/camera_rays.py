"""Camera rays, and which entities the rays of each tile of the film can meet."""

import math

import numpy as np
import warp as wp

from warp_psf.device import launch
from warp_psf.scene.camera import Camera
from warp_psf.scene.geometry import DeviceScene, GeometryTables, PoseTables

# Angles are taken this much wider than they come out in float32, so that no body is lost at the rim of a tile.
TILE_MARGIN = 1.001
# Pixels along the side of a tile; rays only meet the entities whose bounding spheres reach into their tile's cone.
TILE = 16


@wp.struct
class CameraTable:
    """The film's camera in every world. Lengths on the film: at unit depth, or metres for an orthographic camera."""

    position: wp.array(dtype=wp.vec3)  # (world), metres
    rotation: wp.array(dtype=wp.mat33)  # (world), world_from_camera
    center: wp.array(dtype=wp.vec2)  # (world): the film's middle, right and up of the optical axis
    pixel: wp.array(dtype=wp.vec2)  # (world): width and height of a pixel
    near: wp.array(dtype=wp.float32)  # (world): nothing nearer is seen, metres along the optical axis
    far: wp.array(dtype=wp.float32)  # (world): nor anything farther
    orthographic: wp.array(dtype=wp.bool)  # (world)
    width: wp.int32
    height: wp.int32


@wp.struct
class TileTable:
    """Which entities each tile of the film can see, the nearest first."""

    count: wp.array2d(dtype=wp.int32)  # (world, tile)
    entity: wp.array3d(dtype=wp.int32)  # (world, tile, place)
    distance: wp.array3d(dtype=wp.float32)  # (world, tile, place): to the bounding sphere, metres
    columns: wp.int32


@wp.func
def on_film(camera: CameraTable, world: int, x: float, y: float) -> wp.vec2:
    """The place of pixel coordinates (x, y) on the film."""
    center = camera.center[world]
    pixel = camera.pixel[world]
    right = center[0] + (x - 0.5 * float(camera.width)) * pixel[0]
    up = center[1] + (0.5 * float(camera.height) - y) * pixel[1]
    return wp.vec2(right, up)


@wp.func
def camera_ray(camera: CameraTable, world: int, x: float, y: float) -> wp.vec3:
    """Direction through the film at pixel coordinates (x, y), of unit depth along the optical axis."""
    film = on_film(camera, world, x, y)
    if camera.orthographic[world]:
        film = wp.vec2()
    return camera.rotation[world] * wp.vec3(film[0], film[1], -1.0)


@wp.func
def camera_origin(camera: CameraTable, world: int, x: float, y: float) -> wp.vec3:
    """Where the ray through the film at pixel coordinates (x, y) starts, at depth 0."""
    origin = camera.position[world]
    if camera.orthographic[world]:
        film = on_film(camera, world, x, y)
        origin += camera.rotation[world] * wp.vec3(film[0], film[1], 0.0)
    return origin


@wp.func
def angle_between(a: wp.vec3, b: wp.vec3) -> float:
    """The angle between two vectors, which keeps its digits where acos has none left."""
    return wp.atan2(wp.length(wp.cross(a, b)), wp.dot(a, b))


@wp.kernel(enable_backward=False, module="unique")
def _fill_tiles(
    first: int,
    geometry: GeometryTables,
    poses: PoseTables,
    camera: CameraTable,
    tiles: TileTable,
):
    world, tile = wp.tid()
    tile += first
    size = float(wp.static(TILE))
    x = float(tile % tiles.columns) * size
    y = float(tile / tiles.columns) * size
    # The tile's rays lie in a cone around the middle one, or in a cylinder where they are parallel.
    origin = camera_origin(camera, world, x + 0.5 * size, y + 0.5 * size)
    axis = wp.normalize(camera_ray(camera, world, x + 0.5 * size, y + 0.5 * size))
    half_angle = float(0.0)
    half_width = float(0.0)
    for corner in range(4):
        corner_x = x + size * float(corner % 2)
        corner_y = y + size * float(corner / 2)
        half_angle = wp.max(half_angle, angle_between(axis, camera_ray(camera, world, corner_x, corner_y)))
        half_width = wp.max(half_width, wp.length(camera_origin(camera, world, corner_x, corner_y) - origin))
    half_angle = wp.static(TILE_MARGIN) * half_angle
    half_width = wp.static(TILE_MARGIN) * half_width
    count = int(0)
    for entity in range(geometry[0].entity_mesh.shape[0]):
        center = poses[0].position[world, entity] + poses[0].rotation[world, entity] * geometry[0].center[entity]
        offset = center - origin
        distance = wp.length(offset)
        radius = geometry[0].radius[entity]
        seen = distance <= radius
        if not seen:
            if camera.orthographic[world]:
                ahead = wp.dot(offset, axis)
                beside = wp.length(offset - ahead * axis)
                seen = ahead > -radius and beside < half_width + wp.static(TILE_MARGIN) * radius
            else:
                seen = angle_between(axis, offset) < half_angle + wp.static(TILE_MARGIN) * wp.asin(radius / distance)
        if seen:
            gap = distance - radius
            place = count
            # The later of two that lie in one place comes first, and so is what is seen: MuJoCo draws it last.
            while place > 0 and tiles.distance[world, tile, wp.max(place - 1, 0)] >= gap:
                tiles.entity[world, tile, place] = tiles.entity[world, tile, place - 1]
                tiles.distance[world, tile, place] = tiles.distance[world, tile, place - 1]
                place -= 1
            tiles.entity[world, tile, place] = entity
            tiles.distance[world, tile, place] = gap
            count += 1
    tiles.count[world, tile] = count


@wp.func
def tile_of(tiles: TileTable, pixel: int, width: int) -> int:
    """The tile that a pixel lies in."""
    return (pixel / width / wp.static(TILE)) * tiles.columns + (pixel % width) / wp.static(TILE)


def make_camera_table(worlds: int, width: int, height: int, device: wp.Device) -> CameraTable:
    """Room for the cameras of a film of width x height pixels."""
    table = CameraTable()
    table.position = wp.zeros(worlds, dtype=wp.vec3, device=device)
    table.rotation = wp.zeros(worlds, dtype=wp.mat33, device=device)
    table.center, table.pixel = (wp.zeros(worlds, dtype=wp.vec2, device=device) for _ in range(2))
    table.near, table.far = (wp.zeros(worlds, dtype=wp.float32, device=device) for _ in range(2))
    table.orthographic = wp.zeros(worlds, dtype=wp.bool, device=device)
    table.width, table.height = width, height
    return table


def make_tiles(worlds: int, width: int, height: int, entities: int, device: wp.Device) -> TileTable:
    """Room for the tiles of a film of width x height pixels."""
    tiles = TileTable()
    tiles.columns = math.ceil(width / TILE)
    shape = (worlds, tiles.columns * math.ceil(height / TILE))
    tiles.count = wp.zeros(shape, dtype=wp.int32, device=device)
    tiles.entity = wp.zeros((*shape, entities), dtype=wp.int32, device=device)
    tiles.distance = wp.zeros((*shape, entities), dtype=wp.float32, device=device)
    return tiles


def write_cameras(table: CameraTable, cameras: list[Camera]) -> None:
    """Brings the cameras of a frame to the device, one per world."""
    size = np.array((table.width, table.height), np.float32)
    halves = np.array([camera.half_sizes(table.width, table.height) for camera in cameras], np.float32)
    table.position.assign(np.array([camera.position for camera in cameras], np.float32))
    table.rotation.assign(np.array([camera.rotation for camera in cameras], np.float32))
    table.center.assign(np.array([camera.center for camera in cameras], np.float32))
    table.pixel.assign(2.0 * halves / size)
    table.near.assign(np.array([camera.near for camera in cameras], np.float32))
    table.far.assign(np.array([camera.far for camera in cameras], np.float32))
    table.orthographic.assign(np.array([camera.orthographic for camera in cameras], bool))


def fill_tiles(scene: DeviceScene, camera: CameraTable, tiles: TileTable, device: wp.Device) -> None:
    """Finds the entities that the rays of each tile can meet, in their present poses."""
    launch(_fill_tiles, tiles.count.shape, [scene.geometry, scene.poses, camera, tiles], [], device)
