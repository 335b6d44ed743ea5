"""From shaded receivers to the layers of a frame."""

import math
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import warp as wp

from warp_psf.device import launch
from warp_psf.film.camera_rays import CameraTable, camera_origin, camera_ray
from warp_psf.film.primary import EXTRA_GROUPS, Surfaces
from warp_psf.scene.geometry import DeviceScene, GeometryTables, PoseTables, part_of
from warp_psf.scene.receiver import ReceiverTable
from warp_psf.scene.tint import TextureTable, tint_of

# A pixel covers at most so much of a surface that it sees edge-on, in bounding radii of the body.
LONGEST_FOOTPRINT = 0.5


@wp.struct
class LayerTable:
    """The layers of a frame, (world, pixel), radiance scene-linear."""

    color: wp.array2d(dtype=wp.vec3)
    direct: wp.array2d(dtype=wp.vec3)
    indirect: wp.array2d(dtype=wp.vec3)
    albedo: wp.array2d(dtype=wp.vec3)
    normal: wp.array2d(dtype=wp.vec3)
    depth: wp.array2d(dtype=wp.float32)
    segmentation: wp.array2d(dtype=wp.vec2i)


@dataclass(frozen=True)
class Film:
    """The layers and the background behind them."""

    layers: LayerTable
    background: wp.array  # latitude-longitude radiance, vec3 (row, column)
    height: int
    width: int


@wp.func
def look_up(image: wp.array2d(dtype=wp.vec3), direction: wp.vec3) -> wp.vec3:
    """Bilinear in a latitude-longitude image, periodic in azimuth."""
    rows = image.shape[0]
    columns = image.shape[1]
    d = wp.normalize(direction)
    y = wp.acos(wp.clamp(d[2], -1.0, 1.0)) * wp.static(1.0 / math.pi) * float(rows) - 0.5
    x = (wp.atan2(d[1], d[0]) * wp.static(0.5 / math.pi) + 1.0) * float(columns) - 0.5
    row = int(wp.floor(y))
    column = int(wp.floor(x))
    v = y - float(row)
    u = x - float(column)
    row_0 = wp.clamp(row, 0, rows - 1)
    row_1 = wp.clamp(row + 1, 0, rows - 1)
    column_0 = column % columns
    column_1 = (column + 1) % columns
    return (1.0 - v) * ((1.0 - u) * image[row_0, column_0] + u * image[row_0, column_1]) + v * (
        (1.0 - u) * image[row_1, column_0] + u * image[row_1, column_1]
    )


@wp.func
def shows_front(
    receivers: ReceiverTable,
    world: int,
    slot: int,
    geometry: GeometryTables,
    poses: PoseTables,
) -> bool:
    """Whether the viewer is on the outer side of the receiver's face: a receiver's normal is turned to the viewer."""
    entity = receivers.entity[world, slot]
    mesh = geometry[0].entity_mesh[entity]
    corners = geometry[0].faces[geometry[0].first_face[mesh] + receivers.face[world, slot]]
    uv = receivers.uv[world, slot]
    start = geometry[0].first_vertex[mesh]
    outward = (
        uv[0] * geometry[0].normals[start + corners[0]]
        + uv[1] * geometry[0].normals[start + corners[1]]
        + (1.0 - uv[0] - uv[1]) * geometry[0].normals[start + corners[2]]
    )
    return wp.dot(poses[0].rotation[world, entity] * outward, receivers.normal[world, slot]) > 0.0


@wp.func
def on_plane(camera: CameraTable, world: int, x: float, y: float, p: wp.vec3, n: wp.vec3, longest: float) -> wp.vec3:
    """From p to where the ray through the film at (x, y) meets the plane through p with normal n; at most `longest`."""
    origin = camera_origin(camera, world, x, y)
    ray = camera_ray(camera, world, x, y)
    along = wp.dot(ray, n)
    # A plane that is seen edge-on is met far away, or behind the viewer.
    steep = wp.where(wp.abs(along) > 1.0e-6, along, 1.0e-6)
    step = origin + (wp.dot(p - origin, n) / steep) * ray - p
    length = wp.length(step)
    return wp.where(length > longest, longest / wp.max(length, 1.0e-20), 1.0) * step


@wp.func
def seen_tint(
    world: int,
    pixel: int,
    slot: int,
    receivers: ReceiverTable,
    geometry: GeometryTables,
    poses: PoseTables,
    camera: CameraTable,
    textures: TextureTable,
    part: int,
) -> wp.vec3:
    """What the texture at a receiver multiplies its colour with, over what the pixel covers of its tangent plane."""
    entity = receivers.entity[world, slot]
    p = receivers.position[world, slot]
    n = receivers.normal[world, slot]
    x = float(pixel % camera.width) + 0.5
    y = float(pixel / camera.width) + 0.5
    longest = wp.static(LONGEST_FOOTPRINT) * geometry[0].radius[entity]
    to_entity = wp.transpose(poses[0].rotation[world, entity])
    return tint_of(
        textures,
        geometry,
        entity,
        part,
        receivers.face[world, slot],
        to_entity * (p - poses[0].position[world, entity]),
        to_entity * n,
        to_entity * on_plane(camera, world, x + 1.0, y, p, n, longest),
        to_entity * on_plane(camera, world, x, y + 1.0, p, n, longest),
    )


def make_film(worlds: int, width: int, height: int, device: wp.Device) -> Film:
    """Room for the layers of width x height pixels, before a black background."""
    table = LayerTable()
    shape = (worlds, width * height)
    for name in ("color", "direct", "indirect", "albedo", "normal"):
        setattr(table, name, wp.zeros(shape, dtype=wp.vec3, device=device))
    table.depth = wp.zeros(shape, dtype=wp.float32, device=device)
    table.segmentation = wp.zeros(shape, dtype=wp.vec2i, device=device)
    return Film(table, wp.zeros((1, 1), dtype=wp.vec3, device=device), height, width)


def with_background(film: Film, background: np.ndarray) -> Film:
    """The film before another background: radiance, float32 [rows, columns, 3]."""
    return replace(film, background=wp.array(background, dtype=wp.vec3, ndim=2, device=film.background.device))


@cache
def _make_resolve(textured: bool) -> wp.Kernel:
    """The kernel of `resolve_pixels`; scenes without textures pay nothing for them."""

    @wp.kernel(enable_backward=False, module="unique")
    def resolve_pixels(
        first: int,
        geometry: GeometryTables,
        poses: PoseTables,
        camera: CameraTable,
        receivers: ReceiverTable,
        extra: wp.array2d(dtype=wp.int32),  # (world, pixel)
        diffuse: wp.array2d(dtype=wp.vec3),  # (world, slot)
        glossy: wp.array2d(dtype=wp.vec3),  # (world, slot)
        indirect_diffuse: wp.array2d(dtype=wp.vec3),  # (world, slot)
        indirect_glossy: wp.array2d(dtype=wp.vec3),  # (world, slot)
        textures: TextureTable,
        background: wp.array2d(dtype=wp.vec3),
        layers: LayerTable,
    ):
        world, pixel = wp.tid()
        pixel += first
        x = float(pixel % camera.width) + 0.5
        y = float(pixel / camera.width) + 0.5
        start = extra[world, pixel]
        groups = wp.where(start >= 0, wp.static(EXTRA_GROUPS + 1), 1)
        light = wp.vec3()
        bounced = wp.vec3()
        shine = wp.vec3()
        albedo = wp.vec3()
        normal = wp.vec3()
        covered = float(0.0)
        for group in range(groups):
            slot = wp.where(group == 0, pixel, start + group - 1)
            entity = receivers.entity[world, slot]
            if entity >= 0:
                weight = receivers.weight[world, slot]
                part = part_of(geometry, entity, receivers.face[world, slot])
                reflectance = geometry[0].albedo[part]
                emission = geometry[0].emission[part]
                if wp.static(textured):
                    if textures.texture[part] >= 0:
                        tint = seen_tint(world, pixel, slot, receivers, geometry, poses, camera, textures, part)
                        reflectance = wp.cw_mul(tint, reflectance)
                        emission = wp.cw_mul(tint, emission)
                lobe = geometry[0].specular[entity]
                lambert = reflectance * wp.static(1.0 / math.pi)
                light += weight * (wp.cw_mul(lambert, diffuse[world, slot]) + wp.cw_mul(lobe, glossy[world, slot]))
                bounced += weight * (
                    wp.cw_mul(lambert, indirect_diffuse[world, slot]) + wp.cw_mul(lobe, indirect_glossy[world, slot])
                )
                if wp.max(emission) > 0.0:
                    # Surfaces shine from their fronts.
                    shine += wp.where(shows_front(receivers, world, slot, geometry, poses), weight, 0.0) * emission
                albedo += weight * reflectance
                normal += weight * receivers.normal[world, slot]
                covered += weight
        layers.direct[world, pixel] = light
        layers.indirect[world, pixel] = bounced
        color = light + bounced + shine
        if covered < 1.0:
            color += (1.0 - covered) * look_up(background, camera_ray(camera, world, x, y))
        layers.color[world, pixel] = color
        layers.albedo[world, pixel] = albedo
        layers.normal[world, pixel] = wp.normalize(normal)

        # Depth and segmentation are those of the pixel's centre: a mean of two bodies is neither.
        depth = float(wp.inf)
        objects = wp.vec2i(-1, -1)
        entity = receivers.entity[world, pixel]
        if entity >= 0:
            depth = receivers.depth[world, pixel]
            part = part_of(geometry, entity, receivers.face[world, pixel])
            objects = wp.vec2i(geometry[0].object_id[part], geometry[0].object_type[part])
        layers.depth[world, pixel] = depth
        layers.segmentation[world, pixel] = objects

    return resolve_pixels


def resolve_pixels(
    film: Film,
    surfaces: Surfaces,
    scene: DeviceScene,
    textures: TextureTable,
    direct: tuple[wp.array, wp.array],
    indirect: tuple[wp.array, wp.array],
    device: wp.Device,
) -> None:
    """Writes the film's layers from what the surfaces' receivers received directly and after bounces.

    direct, indirect: irradiance and radiance through the Phong lobe, vec3 (world, slot) each.
    """
    inputs = [scene.geometry, scene.poses, surfaces.camera, surfaces.receivers, surfaces.extra, *direct, *indirect]
    kernel = _make_resolve(textures.levels.shape[0] > 0)
    launch(kernel, surfaces.extra.shape, [*inputs, textures, film.background, film.layers], [], device)


LAYERS = ("color", "direct", "indirect", "albedo", "normal", "depth", "segmentation")


def read_layers(film: Film, names: tuple[str, ...] = LAYERS, world: int = 0) -> dict[str, np.ndarray]:
    """One world's layers on the host, [height, width, ...]."""
    size = (film.height, film.width)
    layers = {}
    for name in names:
        values = getattr(film.layers, name).numpy()[world]
        layers[name] = values.reshape(*size, *values.shape[1:]).copy()
    return layers
