"""Primary visibility: which surfaces each pixel sees, and with which shares.

What every pixel's centre sees is drawn (`film/raster.py`), or met by a ray where it cannot be drawn. Where neighbouring
pixels see different surfaces, or the centre meets a see-through one, eight places of the pixel are looked at so, their
hits are grouped by surface, and each group becomes a receiver of its own with the group's share as its weight: edges
are antialiased, what lies behind a pane is seen through it, and nothing is shaded twice.

The receivers of a world are numbered so that slot p < pixels is the centre of pixel p, with the share of the group
that is like it, and EXTRA_GROUPS further slots belong to each edge pixel, in the order of the pixels.
"""

import math
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_psf.device import launch
from warp_psf.film.camera_rays import (
    CameraTable,
    TileTable,
    camera_origin,
    camera_ray,
    fill_tiles,
    make_camera_table,
    make_tiles,
    tile_of,
    write_cameras,
)
from warp_psf.film.raster import DrawnTable, Raster, draw_edges, draw_faces, make_raster, sample_offset
from warp_psf.film.tracing import Hit, nothing_known, opacity_from_behind, sight_of_face, surface_of, trace
from warp_psf.scene.camera import Camera
from warp_psf.scene.geometry import DeviceScene, GeometryTables, PoseTables
from warp_psf.scene.receiver import ReceiverTable, make_receivers
from warp_psf.scene.scene import Scene

SAMPLES = 8
EXTRA_GROUPS = 3
# Neighbouring pixels lie on one smooth surface when their normals differ by less than acos(0.9), about 26 degrees,
# and one lies off the other's tangent plane by less than this share of the depth plus half their distance.
SAME_NORMAL = wp.constant(0.9)
SAME_DEPTH = wp.constant(0.02)
# Room for edge pixels, as a share of all; further edges of a picture that is nearly all edge stay aliased.
EDGE_SHARE = 1.0 / 3.0
four_normals = wp.types.matrix(shape=(EXTRA_GROUPS + 1, 3), dtype=wp.float32)


@dataclass(frozen=True)
class Surfaces:
    """What the camera sees: receivers, and per pixel its first extra slot (-1: none)."""

    receivers: ReceiverTable
    extra: wp.array  # (world, pixel) int32
    edge: wp.array  # (world, pixel) int32, 1 on edge pixels and where the centre meets a see-through surface
    edge_rank: wp.array  # (world, pixel) int32, running count of those
    edge_capacity: int  # how many of them have extra slots
    antialias: bool
    see_through: bool  # whether every pixel has them where it needs them
    camera: CameraTable
    tiles: TileTable
    back: wp.array  # (entity) float32, how opaque it is from behind, as a share
    raster: Raster

    @property
    def slots(self) -> int:
        """Receiver slots per world."""
        return self.receivers.entity.shape[1]


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
    geometry: GeometryTables,
    poses: PoseTables,
    camera: CameraTable,
    tiles: TileTable,
    back: wp.array(dtype=wp.float32),  # (entity)
    is_drawn: wp.array(dtype=wp.int32),  # (entity): below zero where it is not
    drawn: DrawnTable,
    receivers: ReceiverTable,
    edge_out: wp.array2d(dtype=wp.int32),
):
    world, pixel = wp.tid()
    pixel += first
    x = float(pixel % camera.width) + 0.5
    y = float(pixel / camera.width) + 0.5
    tile = tile_of(tiles, pixel, camera.width)
    origin = camera_origin(camera, world, x, y)
    ray = camera_ray(camera, world, x, y)
    known = nothing_known()
    if drawn.entity[world, pixel] >= 0:
        face = drawn.face[world, pixel]
        known = sight_of_face(geometry, poses, world, drawn.entity[world, pixel], face, origin, ray)
    sight = trace(geometry, poses, camera, tiles, back, tile, world, origin, ray, known, is_drawn)
    hit = surface_of(geometry, poses, world, sight, 0, origin, ray)
    store_hit(receivers, world, pixel, hit, wp.where(hit.entity >= 0, 1.0, 0.0))
    edge_out[world, pixel] = wp.where(sight.panes > 0, 1, 0)


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
def _add_edges(first: int, camera: CameraTable, receivers: ReceiverTable, edge: wp.array2d(dtype=wp.int32)):
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
    if not smooth:
        edge[world, pixel] = 1


@wp.func
def group_of(geometry: GeometryTables, entities: wp.vec4i, normals: four_normals, groups: int, hit: Hit) -> int:
    """The group of a pixel that a hit belongs to; `groups` where it opens another."""
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
        return groups
    if found < 0:
        # No room for another entity: the first group stands for it that is see-through if it is, else the first.
        clear = geometry[0].opacity[hit.entity] < 1.0
        alike = bool(False)
        for group in range(groups):
            if entities[group] >= 0 and not alike:
                alike = (geometry[0].opacity[entities[group]] < 1.0) == clear
                if alike or found < 0:
                    found = group
    return found


@wp.kernel(enable_backward=False, module="unique")
def _trace_edges(
    first: int,
    geometry: GeometryTables,
    poses: PoseTables,
    camera: CameraTable,
    tiles: TileTable,
    back: wp.array(dtype=wp.float32),  # (entity)
    edge: wp.array2d(dtype=wp.int32),
    edge_rank: wp.array2d(dtype=wp.int32),
    edge_capacity: int,
    is_drawn: wp.array(dtype=wp.int32),  # (entity): below zero where it is not
    drawn: DrawnTable,
    samples: int,
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
        share = 1.0 / float(samples)
        entities = wp.vec4i(receivers.entity[world, pixel], -1, -1, -1)
        normals = four_normals()
        normals[0] = receivers.normal[world, pixel]
        weights = wp.vec4()
        # Group 0 is what the centre sees, be it nothing: depth and segmentation are the centre's.
        groups = int(1)
        x = float(pixel % camera.width)
        y = float(pixel / camera.width)
        for sample in range(samples):
            offset = sample_offset(sample, samples)
            origin = camera_origin(camera, world, x + offset[0], y + offset[1])
            ray = camera_ray(camera, world, x + offset[0], y + offset[1])
            known = nothing_known()
            entity = drawn.entity[world, samples * rank + sample]
            if entity >= 0:
                face = drawn.face[world, samples * rank + sample]
                known = sight_of_face(geometry, poses, world, entity, face, origin, ray)
            sight = trace(geometry, poses, camera, tiles, back, tile, world, origin, ray, known, is_drawn)
            behind = float(share)
            for place in range(sight.panes):
                behind *= 1.0 - wp.abs(sight.pane_opacity[place])
            left = float(share)
            for turn in range(sight.panes + 1):
                # What is behind the panes comes first, so that it finds room however many they are.
                place = wp.where(turn == 0, sight.panes, turn - 1)
                hit = surface_of(geometry, poses, world, sight, place, origin, ray)
                weight = wp.where(turn == 0, behind, left * hit.opacity)
                if turn > 0:
                    left -= weight
                if hit.entity >= 0:
                    found = group_of(geometry, entities, normals, groups, hit)
                    if found == groups:
                        entities[found] = hit.entity
                        normals[found] = hit.normal
                        store_hit(receivers, world, slot + found - 1, hit, 0.0)
                        groups += 1
                    weights[found] += weight
        receivers.weight[world, pixel] = weights[0]
        for group in range(1, groups):
            receivers.weight[world, slot + group - 1] = weights[group]
        for group in range(groups, wp.static(EXTRA_GROUPS + 1)):
            receivers.entity[world, slot + group - 1] = -1


def make_surfaces(
    worlds: int, width: int, height: int, scene: Scene, antialias: bool, see_through: bool, device: wp.Device
) -> Surfaces:
    """Room for the surfaces of a film of width x height pixels.

    antialias: without it a pixel is its centre. see_through: whether there is to be room behind panes at every pixel; a
    pixel without sees its pane as if that were opaque.
    """
    pixels = width * height
    capacity = pixels if see_through else math.ceil(EDGE_SHARE * pixels) if antialias else 0
    receivers = make_receivers((worlds, pixels + EXTRA_GROUPS * capacity), device)
    receivers.entity.fill_(-1)
    extra, edge, rank = (wp.zeros((worlds, pixels), dtype=wp.int32, device=device) for _ in range(3))
    back = opacity_from_behind(scene)
    return Surfaces(
        receivers=receivers,
        extra=extra,
        edge=edge,
        edge_rank=rank,
        edge_capacity=capacity,
        antialias=antialias,
        see_through=see_through,
        camera=make_camera_table(worlds, width, height, device),
        tiles=make_tiles(worlds, width, height, len(scene.entities), device),
        back=wp.array(back, dtype=wp.float32, device=device),
        raster=make_raster(worlds, width, height, capacity * (SAMPLES if antialias else 1), scene, back, device),
    )


def aim(surfaces: Surfaces, cameras: list[Camera]) -> None:
    """Points the film's camera, one per world."""
    write_cameras(surfaces.camera, cameras)


def _most_edges(surfaces: Surfaces) -> int:
    """The edge pixels of the world that has most of them."""
    before = surfaces.edge_rank[:, :1].numpy().ravel()
    last = surfaces.edge_rank[-1:, -1:].numpy().ravel() + surfaces.edge[-1:, -1:].numpy().ravel()
    return int(np.diff(np.concatenate([before, last])).max())


def find_surfaces(scene: DeviceScene, surfaces: Surfaces, device: wp.Device) -> None:
    """Fills `surfaces` with what the camera sees of the scene in its present poses."""
    camera, receivers, tiles = surfaces.camera, surfaces.receivers, surfaces.tiles
    dim = surfaces.edge.shape
    fill_tiles(scene, camera, tiles, device)
    draw_faces(surfaces.raster, scene, camera, tiles, device)
    views = [scene.geometry, scene.poses, camera, tiles, surfaces.back]
    drawn = [surfaces.raster.faces.first, surfaces.raster.drawn]
    launch(_trace_centers, dim, [*views, *drawn, receivers], [surfaces.edge], device)
    pixels = dim[1]
    receivers.count = pixels
    if surfaces.edge_capacity == 0:
        surfaces.extra.fill_(-1)
        return
    if surfaces.antialias:
        launch(_add_edges, dim, [camera, receivers], [surfaces.edge], device)
    wp.utils.array_scan(surfaces.edge.flatten(), surfaces.edge_rank.flatten(), inclusive=False)
    receivers.count += EXTRA_GROUPS * min(_most_edges(surfaces), surfaces.edge_capacity)
    # What an earlier frame left there.
    receivers.entity[:, pixels:].fill_(-1)
    samples = SAMPLES if surfaces.antialias else 1
    edges = [surfaces.edge, surfaces.edge_rank, surfaces.edge_capacity]
    draw_edges(surfaces.raster, *edges, samples, camera, tiles, device)
    inputs = [*views, *edges, surfaces.raster.faces.first, surfaces.raster.drawn_edges, samples, receivers]
    launch(_trace_edges, dim, inputs, [surfaces.extra], device)
