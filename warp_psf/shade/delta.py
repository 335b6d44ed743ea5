"""Lights without an extent, as MJCF has them: directional, spot and point, with traced shadow rays."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_psf.basis import sphere
from warp_psf.device import launch
from warp_psf.scene.geometry import DeviceScene, GeometryTables, PoseTables, may_hit
from warp_psf.scene.light import DeltaLight
from warp_psf.scene.receiver import ReceiverTable, in_use
from warp_psf.scene.scene import Scene

# Shadow rays towards a bulb with a radius. When the first few, spread over the bulb, agree, the rest are left out.
BULB_RAYS = 48
FIRST_BULB_RAYS = 12
# Entities in the way of a light that are kept in a list; where there are more, every ray asks all of the scene's.
MOST_LISTED = 16
listed_entities = wp.types.vector(MOST_LISTED, wp.int32)
# A shadow ray starts this share of the bounding radius off a body that can shadow itself: its smooth normals lift
# receivers off the flat faces that the ray would meet.
SHADOW_OFFSET = 2.0e-3
KINDS = {"directional": 0, "spot": 1, "point": 2}


@wp.struct
class DeltaLightTable:
    """Arrays (world, light)."""

    kind: wp.array2d(dtype=wp.int32)
    position: wp.array2d(dtype=wp.vec3)  # metres
    direction: wp.array2d(dtype=wp.vec3)  # away from the light
    diffuse: wp.array2d(dtype=wp.vec3)
    specular: wp.array2d(dtype=wp.vec3)
    ambient: wp.array2d(dtype=wp.vec3)
    attenuation: wp.array2d(dtype=wp.vec3)
    spot: wp.array2d(dtype=wp.vec2)  # cos(cutoff), exponent
    reach: wp.array2d(dtype=wp.float32)  # metres
    radius: wp.array2d(dtype=wp.float32)  # of the bulb, metres
    casts: wp.array2d(dtype=wp.bool)
    shadows_itself: wp.array(dtype=wp.bool)  # (entity): False for convex and for flat bodies


@wp.struct
class InTheWay:
    """The entities that can stand between a receiver and a light; `listed` is False where they are too many."""

    count: wp.int32
    listed: wp.bool
    entity: listed_entities


@wp.func
def find_in_the_way(
    world: int,
    own: int,
    p: wp.vec3,
    toward: wp.vec3,
    spread: float,
    geometry: GeometryTables,
    poses: PoseTables,
    opacity: wp.array(dtype=wp.float32),  # (entity)
    shadows_itself: wp.array(dtype=wp.bool),  # (entity)
) -> InTheWay:
    """Which entities reach into the cone from p, on the entity `own`, to a disc of radius `spread` at p + toward."""
    found = InTheWay()
    found.listed = True
    length_squared = wp.dot(toward, toward)
    length = wp.sqrt(length_squared)
    for entity in range(geometry[0].entity_mesh.shape[0]):
        if opacity[entity] > 0.0 and (entity != own or shadows_itself[entity]):
            radius = geometry[0].radius[entity]
            to_center = (
                poses[0].position[world, entity] + poses[0].rotation[world, entity] * geometry[0].center[entity] - p
            )
            nearest = wp.clamp(wp.dot(to_center, toward) / length_squared, 0.0, 1.0)
            # The cone where it leaves the entity's sphere is as wide as it gets there.
            reach = radius + spread * wp.min(nearest + radius / length, 1.0)
            if wp.length_sq(to_center - nearest * toward) < reach * reach:
                if found.count < wp.static(MOST_LISTED):
                    found.entity[found.count] = entity
                    found.count += 1
                else:
                    found.listed = False
    if not found.listed:
        found.count = geometry[0].entity_mesh.shape[0]
    return found


@wp.func
def share_passed(
    world: int,
    own: int,
    p: wp.vec3,
    toward: wp.vec3,
    found: InTheWay,
    geometry: GeometryTables,
    poses: PoseTables,
    opacity: wp.array(dtype=wp.float32),  # (entity)
    shadows_itself: wp.array(dtype=wp.bool),  # (entity)
) -> float:
    """The share of light that what stands on the segment from p to p + toward, which starts on `own`, lets through."""
    passed = float(1.0)
    length_squared = wp.dot(toward, toward)
    for place in range(found.count):
        entity = place
        if found.listed:
            entity = found.entity[place]
        if found.listed or (opacity[entity] > 0.0 and (entity != own or shadows_itself[entity])):
            position = poses[0].position[world, entity]
            rotation = poses[0].rotation[world, entity]
            radius = geometry[0].radius[entity]
            to_center = position + rotation * geometry[0].center[entity] - p
            # The point of the segment that is nearest to the centre.
            nearest = wp.clamp(wp.dot(to_center, toward) / length_squared, 0.0, 1.0)
            if wp.length_sq(to_center - nearest * toward) < radius * radius:
                inverse = wp.transpose(rotation)
                start = inverse * (p - position)
                way = inverse * toward
                if may_hit(geometry, entity, start, way, 1.0):
                    mesh = geometry[0].mesh_id[geometry[0].entity_mesh[entity]]
                    if wp.mesh_query_ray_anyhit(mesh, start, way, 1.0):
                        passed *= 1.0 - opacity[entity]
                        if passed <= 0.0:
                            return 0.0
    return passed


@wp.func
def bulb_point(ray: int, count: int) -> wp.vec2:
    """Places on the unit disc, spread evenly and in an order in which any first few are spread too."""
    turned = wp.frac(float(ray) * 0.61803399)
    radius = wp.sqrt((float(ray) + 0.5) / float(count))
    return wp.vec2(radius * wp.cos(6.2831853 * turned), radius * wp.sin(6.2831853 * turned))


@wp.func
def delta_light(
    world: int,
    light: int,
    entity: int,
    p: wp.vec3,
    n: wp.vec3,
    geometry: GeometryTables,
    poses: PoseTables,
    opacity: wp.array(dtype=wp.float32),  # (entity)
    lights: DeltaLightTable,
    far: float,
):
    """The unit vector to a light, its strength at p, the share of it that is not blocked, and its cosine to n.

    Of a light that sends nothing to p the share is 0.
    """
    origin = p
    if lights.shadows_itself[entity]:
        origin = p + (wp.static(SHADOW_OFFSET) * geometry[0].radius[entity]) * n
    kind = lights.kind[world, light]
    toward = -far * lights.direction[world, light]
    strength = float(1.0)
    if kind != wp.static(KINDS["directional"]):
        toward = lights.position[world, light] - p
        distance = wp.length(toward)
        a = lights.attenuation[world, light]
        strength = wp.where(distance < lights.reach[world, light], 1.0, 0.0)
        strength /= wp.max(a[0] + a[1] * distance + a[2] * distance * distance, 1.0e-6)
        if kind == wp.static(KINDS["spot"]):
            along = -wp.dot(toward, lights.direction[world, light]) / wp.max(distance, 1.0e-9)
            cone = lights.spot[world, light]
            strength *= wp.where(along > cone[0], wp.pow(wp.max(along, 0.0), cone[1]), 0.0)
    unit = wp.normalize(toward)
    cosine = wp.dot(n, unit)
    lit = float(0.0)
    if cosine > 0.0 and strength > 0.0:
        lit = 1.0
        radius = wp.where(kind == wp.static(KINDS["directional"]), 0.0, lights.radius[world, light])
        found = InTheWay()
        if lights.casts[world, light]:
            found = find_in_the_way(
                world, entity, origin, toward, radius, geometry, poses, opacity, lights.shadows_itself
            )
        if found.count > 0:
            if radius > 0.0:
                # A disc that faces the receiver stands for the bulb.
                disc = sphere.frame_of(unit)
                open_rays = float(0.0)
                cast = int(0)
                rays = int(wp.static(BULB_RAYS))
                for ray in range(rays):
                    # Steps of 29 through 48 visit every place once, and any twelve in a row are spread out.
                    place = bulb_point((ray * 29) % wp.static(BULB_RAYS), wp.static(BULB_RAYS))
                    decided = ray >= wp.static(FIRST_BULB_RAYS) and (open_rays == 0.0 or open_rays == float(cast))
                    if not decided:
                        aimed = toward + radius * (disc * wp.vec3(place[0], place[1], 0.0))
                        cast += 1
                        open_rays += share_passed(
                            world, entity, origin, aimed, found, geometry, poses, opacity, lights.shadows_itself
                        )
                lit = open_rays / float(cast)
            else:
                lit = share_passed(
                    world, entity, origin, toward, found, geometry, poses, opacity, lights.shadows_itself
                )
    return unit, strength, lit, cosine


@wp.kernel(enable_backward=False, module="unique")
def _add_delta_lights(
    first: int,
    receivers: ReceiverTable,
    geometry: GeometryTables,
    poses: PoseTables,
    opacity: wp.array(dtype=wp.float32),  # (entity)
    eye: wp.array(dtype=wp.vec3),  # (world)
    lights: DeltaLightTable,
    far: float,
    diffuse_out: wp.array2d(dtype=wp.vec3),  # (world, receiver), added to
    glossy_out: wp.array2d(dtype=wp.vec3),  # (world, receiver), added to
):
    world, receiver = wp.tid()
    receiver += first
    entity = receivers.entity[world, receiver]
    if entity < 0:
        return
    n = receivers.normal[world, receiver]
    p = receivers.position[world, receiver]
    exponent = geometry[0].exponent[entity]
    view = wp.normalize(eye[world] - p)
    mirrored = 2.0 * wp.dot(n, view) * n - view
    diffuse = wp.vec3()
    glossy = wp.vec3()
    for light in range(lights.kind.shape[1]):
        diffuse += wp.static(math.pi) * lights.ambient[world, light]
        unit, strength, lit, cosine = delta_light(world, light, entity, p, n, geometry, poses, opacity, lights, far)
        if lit > 0.0:
            diffuse += (wp.static(math.pi) * strength * lit * cosine) * lights.diffuse[world, light]
            aligned = wp.dot(mirrored, unit)
            # Behind the mirror direction there is nothing, though 0^0 is 1.
            if aligned > 0.0:
                lobe = 0.5 * (exponent + 2.0) * wp.pow(aligned, exponent)
                glossy += (strength * lit * cosine * lobe) * lights.specular[world, light]
    diffuse_out[world, receiver] = diffuse_out[world, receiver] + diffuse
    glossy_out[world, receiver] = glossy_out[world, receiver] + glossy


@dataclass(frozen=True)
class DeltaState:
    """Room on the device for the delta lights of a scene."""

    table: DeltaLightTable
    far: float  # metres: how far a directional light's shadow rays reach
    opacity: wp.array  # (entity): share of light that each stops, 0 for what casts no shadow


def make_delta_lights(scene: Scene, worlds: int, far: float, device: wp.Device) -> DeltaState:
    """Room for the delta lights of a scene in each of `worlds` worlds. far: as in `DeltaState`."""
    table = DeltaLightTable()
    shape = (worlds, sum(isinstance(light, DeltaLight) for light in scene.lights))
    shapes = [scene.meshes[entity.mesh] for entity in scene.entities]
    shadows_itself = [not mesh.convex and mesh.slab is None for mesh in shapes]
    table.shadows_itself = wp.array(shadows_itself, dtype=wp.bool, device=device)
    table.kind = wp.zeros(shape, dtype=wp.int32, device=device)
    for name in ("position", "direction", "diffuse", "specular", "ambient", "attenuation"):
        setattr(table, name, wp.zeros(shape, dtype=wp.vec3, device=device))
    table.spot = wp.zeros(shape, dtype=wp.vec2, device=device)
    table.reach = wp.zeros(shape, dtype=wp.float32, device=device)
    table.radius = wp.zeros(shape, dtype=wp.float32, device=device)
    table.casts = wp.zeros(shape, dtype=wp.bool, device=device)
    opacity = [
        entity.opacity if entity.casts or index in scene.deforming else 0.0
        for index, entity in enumerate(scene.entities)
    ]
    return DeltaState(table, far, wp.array(opacity, dtype=wp.float32, device=device))


def write_delta_lights(state: DeltaState, worlds: Sequence[Sequence[DeltaLight]]) -> None:
    """Brings this frame's lights to the device; places beyond a world's last light stay dark."""
    table = state.table
    count = table.kind.shape[1]

    def collect(value, filler) -> np.ndarray:
        return np.array([[value(light) for light in lights] + [filler] * (count - len(lights)) for lights in worlds])

    dark = np.zeros(3)
    table.kind.assign(collect(lambda light: KINDS[light.kind], 0).astype(np.int32))
    table.position.assign(collect(lambda light: light.position, dark).astype(np.float32))
    table.direction.assign(collect(lambda light: light.direction, np.array([0, 0, -1.0])).astype(np.float32))
    table.diffuse.assign(collect(lambda light: light.diffuse, dark).astype(np.float32))
    table.specular.assign(collect(lambda light: light.specular, dark).astype(np.float32))
    table.ambient.assign(collect(lambda light: light.ambient, dark).astype(np.float32))
    table.attenuation.assign(collect(lambda light: light.attenuation, np.array([1.0, 0, 0])).astype(np.float32))
    table.spot.assign(collect(lambda light: (math.cos(light.cutoff), light.exponent), (1.0, 0.0)).astype(np.float32))
    # float32 has no room for every float64 range.
    table.reach.assign(np.minimum(collect(lambda light: light.range, 0.0), 1e30).astype(np.float32))
    table.radius.assign(collect(lambda light: light.radius, 0.0).astype(np.float32))
    table.casts.assign(collect(lambda light: light.castshadow, False).astype(bool))


def add_delta_lights(
    receivers: ReceiverTable,
    scene: DeviceScene,
    eye: wp.array,
    lights: DeltaState,
    diffuse: wp.array,
    glossy: wp.array,
    device: wp.Device,
) -> None:
    """Adds the delta lights to the receivers' irradiance `diffuse` and Phong radiance `glossy`, vec3 (world, slot)."""
    if lights.table.kind.shape[1] == 0:
        return
    inputs = [receivers, scene.geometry, scene.poses, lights.opacity, eye, lights.table, lights.far]
    launch(_add_delta_lights, in_use(receivers), inputs, [diffuse, glossy], device)
