"""Primary visibility: which surfaces each pixel sees, and with which shares.

Every pixel traces its centre. Where neighbouring pixels see different surfaces, the pixel is traced again at eight
places, its samples are grouped by surface, and each group becomes a receiver of its own with the group's share as its
weight: edges are antialiased and nothing is shaded twice.

The receivers of a world are numbered so that slot p < pixels is the centre of pixel p, with the share of the group
that is like it, and EXTRA_GROUPS further slots belong to each edge pixel, in the order of the pixels.
"""

import math
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_psf.device import launch
from warp_psf.scene.camera import Camera
from warp_psf.scene.geometry import DeviceScene, GeometryTable, PoseTable, may_hit
from warp_psf.scene.receiver import ReceiverTable, make_receivers

# Angles are taken this much wider than they come out in float32, so that no body is lost at the rim of a tile.
TILE_MARGIN = 1.001
# Pixels along the side of a tile; rays only meet the entities whose bounding spheres reach into their tile's cone.
TILE = 16
SAMPLES = 8
EXTRA_GROUPS = 3
# Neighbouring pixels lie on one smooth surface when their normals differ by less than acos(0.9), about 26 degrees,
# and one lies off the other's tangent plane by less than this share of the depth plus half their distance.
SAME_NORMAL = wp.constant(0.9)
SAME_DEPTH = wp.constant(0.02)
# Room for edge pixels, as a share of all; further edges of a picture that is nearly all edge stay aliased.
EDGE_SHARE = 1.0 / 3.0


@wp.struct
class CameraTable:
    """The film's camera in every world."""

    position: wp.array(dtype=wp.vec3)  # (world), metres
    rotation: wp.array(dtype=wp.mat33)  # (world), world_from_camera
    tangent: wp.array(dtype=wp.float32)  # (world): tan(fovy / 2)
    width: wp.int32
    height: wp.int32


@wp.struct
class TileTable:
    """Which entities each tile of the film can see, the nearest first."""

    count: wp.array2d(dtype=wp.int32)  # (world, tile)
    entity: wp.array3d(dtype=wp.int32)  # (world, tile, place)
    distance: wp.array3d(dtype=wp.float32)  # (world, tile, place): to the bounding sphere, metres
    columns: wp.int32


@wp.struct
class Hit:
    """What a camera ray meets; entity -1 is nothing."""

    entity: wp.int32
    face: wp.int32
    u: wp.float32
    v: wp.float32
    distance: wp.float32
    position: wp.vec3
    normal: wp.vec3


@dataclass(frozen=True)
class Surfaces:
    """What the camera sees: receivers, and per pixel its first extra slot (-1: none)."""

    receivers: ReceiverTable
    extra: wp.array  # (world, pixel) int32
    edge: wp.array  # (world, pixel) int32, 1 on edge pixels
    edge_rank: wp.array  # (world, pixel) int32, running count of edge pixels
    edge_capacity: int  # 0: no antialiasing
    camera: CameraTable
    tiles: TileTable

    @property
    def slots(self) -> int:
        """Receiver slots per world."""
        return self.receivers.entity.shape[1]


@wp.func
def sample_offset(sample: int) -> wp.vec2:
    """Eight places in a pixel, one in each row and column of an 8 x 8 grid."""
    column = (sample * 5 + 2) % 8
    return wp.vec2((float(column) + 0.5) / 8.0, (float(sample) + 0.5) / 8.0)


@wp.func
def camera_ray(camera: CameraTable, world: int, x: float, y: float) -> wp.vec3:
    """Direction through the film at pixel coordinates (x, y), of unit depth along the optical axis."""
    scale = 2.0 * camera.tangent[world] / float(camera.height)
    right = (x - 0.5 * float(camera.width)) * scale
    up = (0.5 * float(camera.height) - y) * scale
    return camera.rotation[world] * wp.vec3(right, up, -1.0)


@wp.func
def angle_between(a: wp.vec3, b: wp.vec3) -> float:
    """The angle between two vectors, which keeps its digits where acos has none left."""
    return wp.atan2(wp.length(wp.cross(a, b)), wp.dot(a, b))


@wp.kernel(enable_backward=False, module="unique")
def _fill_tiles(first: int, geometry: GeometryTable, poses: PoseTable, camera: CameraTable, tiles: TileTable):
    world, tile = wp.tid()
    tile += first
    size = float(wp.static(TILE))
    x = float(tile % tiles.columns) * size
    y = float(tile / tiles.columns) * size
    axis = wp.normalize(camera_ray(camera, world, x + 0.5 * size, y + 0.5 * size))
    half_angle = float(0.0)
    for corner in range(4):
        ray = camera_ray(camera, world, x + size * float(corner % 2), y + size * float(corner / 2))
        half_angle = wp.max(half_angle, angle_between(axis, ray))
    half_angle = wp.static(TILE_MARGIN) * half_angle
    count = int(0)
    for entity in range(geometry.entity_mesh.shape[0]):
        center = poses.position[world, entity] + poses.rotation[world, entity] * geometry.center[entity]
        offset = center - camera.position[world]
        distance = wp.length(offset)
        radius = geometry.radius[entity]
        seen = distance <= radius
        if not seen:
            seen = angle_between(axis, offset) < half_angle + wp.static(TILE_MARGIN) * wp.asin(radius / distance)
        if seen:
            gap = distance - radius
            place = count
            while place > 0 and tiles.distance[world, tile, wp.max(place - 1, 0)] > gap:
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


@wp.func
def trace(
    geometry: GeometryTable,
    poses: PoseTable,
    tiles: TileTable,
    tile: int,
    world: int,
    origin: wp.vec3,
    direction: wp.vec3,
) -> Hit:
    """The nearest surface along a camera ray; `distance` is in units of `direction`, entity -1 is nothing."""
    hit = Hit()
    hit.entity = -1
    nearest = float(1.0e30)
    length_squared = wp.dot(direction, direction)
    for place in range(tiles.count[world, tile]):
        entity = tiles.entity[world, tile, place]
        position = poses.position[world, entity]
        rotation = poses.rotation[world, entity]
        to_center = position + rotation * geometry.center[entity] - origin
        along = wp.dot(to_center, direction)
        radius = geometry.radius[entity]
        # Discriminant of the ray against the bounding sphere, and whether the sphere lies ahead and near enough.
        beside = to_center - (along / length_squared) * direction
        reach = length_squared * (radius * radius - wp.dot(beside, beside))
        if reach >= 0.0:
            root = wp.sqrt(reach)
            if along + root > 0.0 and along - root < nearest * length_squared:
                inverse = wp.transpose(rotation)
                origin_entity = inverse * (origin - position)
                direction_entity = inverse * direction
                if may_hit(geometry, entity, origin_entity, direction_entity, nearest):
                    query = wp.mesh_query_ray(
                        geometry.mesh_id[geometry.entity_mesh[entity]], origin_entity, direction_entity, nearest
                    )
                    if query.result:
                        nearest = query.t
                        hit.entity = entity
                        hit.face = query.face
                        hit.u = query.u
                        hit.v = query.v
                        hit.normal = query.normal
    if hit.entity >= 0:
        hit.distance = nearest
        hit.position = origin + nearest * direction
        rotation = poses.rotation[world, hit.entity]
        flat = rotation * hit.normal
        mesh = geometry.entity_mesh[hit.entity]
        corners = geometry.faces[geometry.first_face[mesh] + hit.face]
        start = geometry.first_vertex[mesh]
        smooth = (
            hit.u * geometry.normals[start + corners[0]]
            + hit.v * geometry.normals[start + corners[1]]
            + (1.0 - hit.u - hit.v) * geometry.normals[start + corners[2]]
        )
        normal = wp.normalize(rotation * smooth)
        if wp.dot(flat, direction) > 0.0:
            normal = -normal  # the back of an open surface
        hit.normal = normal
    return hit


@wp.func
def store_hit(receivers: ReceiverTable, world: int, slot: int, hit: Hit, weight: float):
    """Makes a hit the receiver of a slot, with its share of the pixel."""
    receivers.entity[world, slot] = hit.entity
    receivers.face[world, slot] = hit.face
    receivers.uv[world, slot] = wp.vec2(hit.u, hit.v)
    receivers.position[world, slot] = hit.position
    receivers.normal[world, slot] = hit.normal
    receivers.depth[world, slot] = hit.distance
    receivers.weight[world, slot] = weight


@wp.kernel(enable_backward=False, module="unique")
def _trace_centers(
    first: int,
    geometry: GeometryTable,
    poses: PoseTable,
    camera: CameraTable,
    tiles: TileTable,
    receivers: ReceiverTable,
):
    world, pixel = wp.tid()
    pixel += first
    x = float(pixel % camera.width) + 0.5
    y = float(pixel / camera.width) + 0.5
    tile = tile_of(tiles, pixel, camera.width)
    ray = camera_ray(camera, world, x, y)
    hit = trace(geometry, poses, tiles, tile, world, camera.position[world], ray)
    store_hit(receivers, world, pixel, hit, wp.where(hit.entity >= 0, 1.0, 0.0))


@wp.func
def same_surface(receivers: ReceiverTable, world: int, a: int, b: int) -> bool:
    """Whether two neighbouring pixels lie on one smooth surface."""
    if receivers.entity[world, a] != receivers.entity[world, b]:
        return False
    if receivers.entity[world, a] < 0:
        return True
    if wp.dot(receivers.normal[world, a], receivers.normal[world, b]) < SAME_NORMAL:
        return False
    # The neighbour may lie off the tangent plane by a share of the depth, or of the distance to it.
    offset = receivers.position[world, b] - receivers.position[world, a]
    away = wp.abs(wp.dot(offset, receivers.normal[world, a]))
    return away < SAME_DEPTH * receivers.depth[world, a] + 0.5 * wp.length(offset)


@wp.kernel(enable_backward=False, module="unique")
def _find_edges(first: int, camera: CameraTable, receivers: ReceiverTable, edge_out: wp.array2d(dtype=wp.int32)):
    world, pixel = wp.tid()
    pixel += first
    x = pixel % camera.width
    y = pixel / camera.width
    smooth = bool(True)
    if x > 0:
        smooth = smooth and same_surface(receivers, world, pixel, pixel - 1)
    if x + 1 < camera.width:
        smooth = smooth and same_surface(receivers, world, pixel, pixel + 1)
    if y > 0:
        smooth = smooth and same_surface(receivers, world, pixel, pixel - camera.width)
    if y + 1 < camera.height:
        smooth = smooth and same_surface(receivers, world, pixel, pixel + camera.width)
    edge_out[world, pixel] = wp.where(smooth, 0, 1)


@wp.kernel(enable_backward=False, module="unique")
def _trace_edges(
    first: int,
    geometry: GeometryTable,
    poses: PoseTable,
    camera: CameraTable,
    tiles: TileTable,
    edge: wp.array2d(dtype=wp.int32),
    edge_rank: wp.array2d(dtype=wp.int32),
    edge_capacity: int,
    receivers: ReceiverTable,
    extra_out: wp.array2d(dtype=wp.int32),
):
    world, pixel = wp.tid()
    pixel += first
    extra_out[world, pixel] = -1
    rank = edge_rank[world, pixel] - edge_rank[world, 0]
    if edge[world, pixel] == 1 and rank < edge_capacity:
        slot = camera.width * camera.height + wp.static(EXTRA_GROUPS) * rank
        extra_out[world, pixel] = slot
        tile = tile_of(tiles, pixel, camera.width)
        share = 1.0 / float(wp.static(SAMPLES))
        entities = wp.vec4i(receivers.entity[world, pixel], -1, -1, -1)
        normals = wp.matrix(shape=(4, 3), dtype=float)
        normals[0] = receivers.normal[world, pixel]
        weights = wp.vec4()
        # Group 0 is what the centre sees, be it nothing: depth and segmentation are the centre's.
        groups = int(1)
        x = float(pixel % camera.width)
        y = float(pixel / camera.width)
        samples = int(wp.static(SAMPLES))  # a variable keeps the loop from being unrolled
        for sample in range(samples):
            offset = sample_offset(sample)
            ray = camera_ray(camera, world, x + offset[0], y + offset[1])
            hit = trace(geometry, poses, tiles, tile, world, camera.position[world], ray)
            if hit.entity >= 0:
                found = int(-1)
                for group in range(groups):
                    if entities[group] == hit.entity and (
                        found < 0 or wp.dot(normals[group], hit.normal) > wp.dot(normals[found], hit.normal)
                    ):
                        found = group
                known = found >= 0
                if known:
                    known = wp.dot(normals[found], hit.normal) > SAME_NORMAL
                if not known and groups < wp.static(EXTRA_GROUPS + 1):
                    found = groups
                    entities[found] = hit.entity
                    normals[found] = hit.normal
                    store_hit(receivers, world, slot + found - 1, hit, 0.0)
                    groups += 1
                if found < 0:
                    # No room for another entity: a group that there is stands for it.
                    found = wp.where(entities[0] >= 0, 0, 1)
                weights[found] += share
        receivers.weight[world, pixel] = weights[0]
        for group in range(1, groups):
            receivers.weight[world, slot + group - 1] = weights[group]
        for group in range(groups, wp.static(EXTRA_GROUPS + 1)):
            receivers.entity[world, slot + group - 1] = -1


def make_surfaces(worlds: int, width: int, height: int, entities: int, antialias: bool, device: wp.Device) -> Surfaces:
    """Room for the surfaces of a film of width x height pixels; without `antialias` a pixel is its centre."""
    pixels = width * height
    capacity = math.ceil(EDGE_SHARE * pixels) if antialias else 0
    shape = (worlds, pixels + EXTRA_GROUPS * capacity)
    receivers = make_receivers(shape, device)
    receivers.entity.fill_(-1)
    camera = CameraTable()
    camera.position = wp.zeros(worlds, dtype=wp.vec3, device=device)
    camera.rotation = wp.zeros(worlds, dtype=wp.mat33, device=device)
    camera.tangent = wp.zeros(worlds, dtype=wp.float32, device=device)
    camera.width, camera.height = width, height
    extra, edge, rank = (wp.zeros((worlds, pixels), dtype=wp.int32, device=device) for _ in range(3))
    tiles = TileTable()
    tiles.columns = math.ceil(width / TILE)
    shape = (worlds, tiles.columns * math.ceil(height / TILE))
    tiles.count = wp.zeros(shape, dtype=wp.int32, device=device)
    tiles.entity = wp.zeros((*shape, entities), dtype=wp.int32, device=device)
    tiles.distance = wp.zeros((*shape, entities), dtype=wp.float32, device=device)
    return Surfaces(receivers, extra, edge, rank, capacity, camera, tiles)


def aim(surfaces: Surfaces, cameras: list[Camera]) -> None:
    """Points the film's camera, one per world."""
    table = surfaces.camera
    table.position.assign(np.array([camera.position for camera in cameras], np.float32))
    table.rotation.assign(np.array([camera.rotation for camera in cameras], np.float32))
    table.tangent.assign(np.array([math.tan(0.5 * camera.fovy) for camera in cameras], np.float32))


def find_surfaces(scene: DeviceScene, surfaces: Surfaces, device: wp.Device) -> None:
    """Fills `surfaces` with what the camera sees of the scene in its present poses."""
    camera, receivers = surfaces.camera, surfaces.receivers
    dim = surfaces.edge.shape
    tiles = surfaces.tiles
    launch(_fill_tiles, tiles.count.shape, [scene.geometry, scene.poses, camera, tiles], [], device)
    launch(_trace_centers, dim, [scene.geometry, scene.poses, camera, tiles, receivers], [], device)
    if surfaces.edge_capacity == 0:
        surfaces.extra.fill_(-1)
        return
    launch(_find_edges, dim, [camera, receivers], [surfaces.edge], device)
    wp.utils.array_scan(surfaces.edge.flatten(), surfaces.edge_rank.flatten(), inclusive=False)
    # What an earlier frame left in slots that this frame's edges do not reach.
    receivers.entity[:, dim[1] :].fill_(-1)
    inputs = [
        scene.geometry,
        scene.poses,
        camera,
        tiles,
        surfaces.edge,
        surfaces.edge_rank,
        surfaces.edge_capacity,
        receivers,
    ]
    launch(_trace_edges, dim, inputs, [surfaces.extra], device)
