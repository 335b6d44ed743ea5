"""Brute-force reference of light that bounces between surfaces: paths traced through everything.

What comes after one, two, three reflections is kept apart, so that a bounce can be checked by itself.
"""

import warnings
from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace

import mujoco
import numpy as np
import warp as wp

from tests.oracles import RAY_OFFSET
from warp_psf.basis import sh, sphere
from warp_psf.bridge import build_scene, read_poses
from warp_psf.device import find_device, launch
from warp_psf.scene.light import AreaLight, area_light_entities

# Farther than any scene under test is wide, metres.
FAR = 1.0e6
# A shadow ray ends this much short of the light, as a share of its length, so that float32 does not carry it past.
SHADOW_SHARE = 1.0 - 1.0e-5
DEFAULT_PATHS = 256
# Scrambling keys per receiver: two for every vertex of a path, so that a path has fewer vertices than half of it.
KEYS = 64


@dataclass(frozen=True)
class WorldMeshes:
    """Surfaces in the world, all of them one mesh.

    vertices, normals: metres and unit vectors, float32 [V, 3]. faces: int32 [F, 3]; entity: of each face, int32 [F].
    albedo, specular, emission: of each entity, float64 [E, 3]. exponent: of each Phong lobe, float64 [E].
    """

    vertices: np.ndarray
    normals: np.ndarray
    faces: np.ndarray
    entity: np.ndarray
    albedo: np.ndarray
    emission: np.ndarray
    specular: np.ndarray
    exponent: np.ndarray


def world_meshes(
    model: mujoco.MjModel, data: mujoco.MjData, lights: tuple[AreaLight, ...] = (), material_space: str = "srgb"
) -> tuple[WorldMeshes, WorldMeshes | None]:
    """What reflects and casts shadows, and the area lights (None without), in this state.

    A light's `emission` is its radiance.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scene = build_scene(model, lights=lights, material_space=material_space, model_lights=False)
    poses = read_poses(model, data, scene)
    first_light = len(scene.entities) - len(area_light_entities(scene))

    def merge(indices: range) -> WorldMeshes:
        vertices, normals, faces, entity, total = [], [], [], [], 0
        for number, index in enumerate(indices):
            mesh = scene.meshes[scene.entities[index].mesh]
            rotation, position = poses.rotation[0, index], poses.position[0, index]
            vertices.append(mesh.vertices @ rotation.T + position)
            normals.append(mesh.normals @ rotation.T)
            faces.append(mesh.faces + total)
            entity.append(np.full(len(mesh.faces), number, np.int32))
            total += len(mesh.vertices)
        materials = [scene.entities[index].lobe for index in indices]
        colors = [np.array([getattr(m, name) for m in materials]) for name in ("albedo", "emission", "specular")]
        colors.append(np.array([m.exponent for m in materials]))
        return WorldMeshes(*map(np.concatenate, (vertices, normals, faces, entity)), *colors)

    surfaces = merge(range(first_light))
    return surfaces, merge(range(first_light, len(scene.entities))) if lights else None


@wp.struct
class SurfaceTable:
    """The merged mesh on the device."""

    mesh: wp.uint64
    normals: wp.array(dtype=wp.vec3)  # (vertex)
    faces: wp.array(dtype=wp.vec3i)  # (face)
    entity: wp.array(dtype=wp.int32)  # (face)
    albedo: wp.array(dtype=wp.vec3)  # (entity)
    emission: wp.array(dtype=wp.vec3)  # (entity)
    specular: wp.array(dtype=wp.vec3)  # (entity), zero where Phong lobes are left out
    exponent: wp.array(dtype=wp.float32)  # (entity)


@wp.struct
class LightTable:
    """The triangles of the area lights."""

    corner: wp.array(dtype=wp.vec3)  # (triangle)
    edges: wp.array(dtype=wp.vec3, ndim=2)  # (triangle, 2), from the corner
    normal: wp.array(dtype=wp.vec3)  # (triangle)
    power: wp.array(dtype=wp.vec3)  # (triangle): radiance times area over the share of the samples it gets
    shares: wp.array(dtype=wp.float32)  # (triangle + 1): cumulative share of the samples, 0 to 1


@wp.func_native("""
    // Burley 2020: Sobol's first two dimensions, shuffled and Owen-scrambled by hashes. The second dimension's matrix
    // is Pascal's triangle modulo 2, which is five masked shifts (Ahmed 2024).
    auto reverse = [](unsigned x) {
        x = (x << 16) | (x >> 16);
        x = ((x & 0x00ff00ffu) << 8) | ((x >> 8) & 0x00ff00ffu);
        x = ((x & 0x0f0f0f0fu) << 4) | ((x >> 4) & 0x0f0f0f0fu);
        x = ((x & 0x33333333u) << 2) | ((x >> 2) & 0x33333333u);
        return ((x & 0x55555555u) << 1) | ((x >> 1) & 0x55555555u);
    };
    auto permute = [](unsigned x, unsigned key) {
        x += key;
        x ^= x * 0x6c50b47cu; x ^= x * 0xb82f1e52u; x ^= x * 0xc7afe638u; x ^= x * 0x8d22f6e6u;
        return x;
    };
    auto hash = [](unsigned x) {
        x ^= x >> 16; x *= 0x7feb352du; x ^= x >> 15; x *= 0x846ca68bu;
        return x ^ (x >> 16);
    };
    const unsigned shuffle = hash(key), first = hash(shuffle ^ 0x51633e2du), second = hash(shuffle ^ 0x68bc21ebu);
    const unsigned x = reverse(permute(reverse(index), shuffle));
    unsigned y = x;
    y ^= (y >> 16) & 0x0000ffffu;
    y ^= (y >> 8) & 0x00ff00ffu;
    y ^= (y >> 4) & 0x0f0f0f0fu;
    y ^= (y >> 2) & 0x33333333u;
    y ^= (y >> 1) & 0x55555555u;
    // 24 bits, the digits of a float32, so that 1 is never reached.
    const float unit = 1.0f / 16777216.0f;
    const unsigned u = reverse(permute(x, first)), v = reverse(permute(y, second));
    return wp::vec2((u >> 8) * unit, (v >> 8) * unit);
""")
def sobol_pair(index: wp.uint32, key: wp.uint32) -> wp.vec2:
    """Point `index` of a scrambled (0, 2)-sequence; every `key` has its own scrambling and order."""


@wp.func
def cosine_direction(normal: wp.vec3, sample: wp.vec2) -> wp.vec3:
    """A direction about the normal, its density the cosine over pi."""
    radius = wp.sqrt(sample[0])
    angle = 2.0 * wp.pi * sample[1]
    local = wp.vec3(radius * wp.cos(angle), radius * wp.sin(angle), wp.sqrt(1.0 - sample[0]))
    return sphere.frame_of(normal) * local


@wp.func
def reflectance(albedo: wp.vec3, specular: wp.vec3, exponent: float, mirrored: wp.vec3, incoming: wp.vec3) -> wp.vec3:
    """pi times the reflectance per solid angle; mirrored: where a mirror would send what is seen."""
    aligned = wp.dot(mirrored, incoming)
    if aligned <= 0.0:
        return albedo
    return albedo + (0.5 * (exponent + 2.0) * wp.pow(aligned, exponent)) * specular


@wp.func
def sample_lights(mesh: wp.uint64, lights: LightTable, origin: wp.vec3, normal: wp.vec3, sample: wp.vec2):
    """One sample of the irradiance that the area lights cause, and the direction that it comes from."""
    low = int(0)
    high = int(lights.corner.shape[0])
    while high - low > 1:
        middle = (low + high) / 2
        if lights.shares[middle] <= sample[0]:
            low = middle
        else:
            high = middle
    share = lights.shares[low + 1] - lights.shares[low]
    # What choosing the triangle left of the first number is uniform again.
    u = wp.sqrt((sample[0] - lights.shares[low]) / share)
    v = sample[1]
    point = lights.corner[low] + u * ((1.0 - v) * lights.edges[low, 0] + v * lights.edges[low, 1])
    toward = point - origin
    distance = wp.length(toward)
    toward = toward / distance
    cosine = wp.dot(normal, toward)
    cosine_light = -wp.dot(lights.normal[low], toward)
    received = wp.vec3()
    if cosine > 0.0 and cosine_light > 0.0:
        if not wp.mesh_query_ray_anyhit(mesh, origin, toward, distance * wp.static(SHADOW_SHARE)):
            received = cosine * cosine_light / (distance * distance) * lights.power[low]
    return received, toward


@cache
def make_tracer(order: int) -> SimpleNamespace:
    """The path tracer for an environment of `order` bands."""
    kit = sh.make_sh(order)
    vec = kit.vec

    @wp.kernel(enable_backward=False, module="unique")
    def trace_paths(
        first: int,
        surfaces: SurfaceTable,
        lights: LightTable,
        environment: wp.array(dtype=vec),  # (channel)
        points: wp.array(dtype=wp.vec3),  # (receiver)
        normals: wp.array(dtype=wp.vec3),  # (receiver)
        bounces: int,
        paths: int,
        seed: wp.uint32,
        irradiance_out: wp.array2d(dtype=wp.vec3),  # (bounce, receiver)
    ):
        _world, receiver = wp.tid()
        receiver += first
        share = 1.0 / float(paths)
        for path in range(paths):
            normal = normals[receiver]
            origin = points[receiver] + RAY_OFFSET * normal
            # What a reflection towards the receiver leaves of the light.
            throughput = wp.vec3(share, share, share)
            # The receiver itself only collects light.
            albedo = wp.vec3(1.0, 1.0, 1.0)
            specular = wp.vec3()
            exponent = float(1.0)
            mirrored = wp.vec3()
            bounce = int(0)
            while bounce <= bounces:
                key = seed + wp.uint32(receiver) * wp.uint32(wp.static(KEYS)) + wp.uint32(2 * bounce)
                if lights.corner.shape[0] > 0:
                    sample = sobol_pair(wp.uint32(path), key + wp.uint32(1))
                    received, toward = sample_lights(surfaces.mesh, lights, origin, normal, sample)
                    reflected = reflectance(albedo, specular, exponent, mirrored, toward)
                    irradiance_out[bounce, receiver] += wp.cw_mul(wp.cw_mul(throughput, reflected), received)
                direction = cosine_direction(normal, sobol_pair(wp.uint32(path), key))
                reflected = reflectance(albedo, specular, exponent, mirrored, direction)
                throughput = wp.cw_mul(throughput, reflected)
                hit = wp.mesh_query_ray(surfaces.mesh, origin, direction, FAR)
                if hit.result:
                    face = surfaces.faces[hit.face]
                    entity = surfaces.entity[hit.face]
                    side = wp.where(wp.dot(hit.normal, direction) < 0.0, 1.0, -1.0)
                    if bounce < bounces and hit.sign > 0.0:
                        emitted = wp.pi * surfaces.emission[entity]
                        irradiance_out[bounce + 1, receiver] += wp.cw_mul(throughput, emitted)
                    albedo = surfaces.albedo[entity]
                    specular = surfaces.specular[entity]
                    exponent = surfaces.exponent[entity]
                    origin = origin + hit.t * direction + (RAY_OFFSET * side) * hit.normal
                    smooth = (
                        hit.u * surfaces.normals[face[0]]
                        + hit.v * surfaces.normals[face[1]]
                        + (1.0 - hit.u - hit.v) * surfaces.normals[face[2]]
                    )
                    normal = side * wp.normalize(smooth)
                    mirrored = direction - 2.0 * wp.dot(direction, normal) * normal
                    bounce += 1
                else:
                    values = kit.evaluate(direction)
                    light = wp.vec3(
                        wp.dot(environment[0], values), wp.dot(environment[1], values), wp.dot(environment[2], values)
                    )
                    irradiance_out[bounce, receiver] += wp.pi * wp.cw_mul(throughput, light)
                    bounce = bounces + 1

    return SimpleNamespace(vec=vec, trace_paths=trace_paths)


def traced_bounces(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    points: np.ndarray,
    normals: np.ndarray,
    *,
    bounces: int,
    coefficients: np.ndarray | None = None,
    lights: tuple[AreaLight, ...] = (),
    paths: int = DEFAULT_PATHS,
    seed: int = 0,
    material_space: str = "srgb",
    phong: bool = False,
) -> np.ndarray:
    """Irradiance at points [N, 3] with normals [N, 3] after 0, 1, ... reflections, float32 [bounces + 1, N, 3].

    Entry 0 is direct light of the environment and the area lights, entry b what arrives after exactly b reflections.
    What surfaces emit (from their front, `Material.emission`) has left a surface once: it counts from entry 1 on.

    Every surface is Lambert with its `Material.albedo`, and with `phong` has its lobe about the mirror direction too,
    (n + 2)/(2 pi) cos^n times `Material.specular`. Both sides of a face reflect. The
    cosine is that of the interpolated vertex normal, turned to the side that the ray comes from, as the renderer
    shades; rays leave along the face's own normal, by `RAY_OFFSET`. (So a ray may start into the surface; it then ends
    at its back.) Area lights shine from their front, reflect nothing and cast no shadow.

    Paths follow the cosine; the ray that continues a path also collects the environment where it hits nothing, and one
    point on the area lights is sampled at every vertex. The error falls about as 1 / paths for smooth light.

    Args:
        bounces: at most 30.
        coefficients: SH coefficients of the environment's radiance, [order^2, 3]; negative radiance stays negative.
        lights: area lights, posed as in `data`.
        paths: per point; powers of two are spread best.
        seed: two seeds give independent errors.
        phong: with the surfaces' Phong lobes.
    """
    device = find_device()
    surfaces, shining = world_meshes(model, data, lights, material_space)
    mesh = wp.Mesh(
        points=wp.array(surfaces.vertices, dtype=wp.vec3, device=device),
        indices=wp.array(surfaces.faces.reshape(-1), dtype=wp.int32, device=device),
    )
    coefficients = np.zeros((1, 3)) if coefficients is None else coefficients
    tracer = make_tracer(sh.order_of(len(coefficients)))
    out = wp.zeros((bounces + 1, len(points)), dtype=wp.vec3, device=device)
    inputs = [
        _upload_surfaces(surfaces, mesh, phong, device),
        _upload_lights(shining, device),
        wp.array(coefficients.T.astype(np.float32), dtype=tracer.vec, device=device),
        wp.array(points, dtype=wp.vec3, device=device),
        wp.array(normals, dtype=wp.vec3, device=device),
        bounces,
        paths,
        # Far apart, so that one seed's keys are not another's.
        np.random.SeedSequence(seed).generate_state(1)[0],
    ]
    launch(tracer.trace_paths, (1, len(points)), inputs, [out], device)
    return out.numpy()


def _upload_surfaces(surfaces: WorldMeshes, mesh: wp.Mesh, phong: bool, device: wp.Device) -> SurfaceTable:
    table = SurfaceTable()
    table.mesh = mesh.id
    table.normals = wp.array(surfaces.normals, dtype=wp.vec3, device=device)
    table.faces = wp.array(surfaces.faces, dtype=wp.vec3i, device=device)
    table.entity = wp.array(surfaces.entity, dtype=wp.int32, device=device)
    table.albedo = wp.array(surfaces.albedo, dtype=wp.vec3, device=device)
    table.emission = wp.array(surfaces.emission, dtype=wp.vec3, device=device)
    table.specular = wp.array(surfaces.specular if phong else 0 * surfaces.specular, dtype=wp.vec3, device=device)
    table.exponent = wp.array(surfaces.exponent, dtype=wp.float32, device=device)
    return table


def _upload_lights(lights: WorldMeshes | None, device: wp.Device) -> LightTable:
    """Triangles are sampled in proportion to their power."""
    table = LightTable()
    if lights is None:
        return table
    corners = lights.vertices.astype(np.float64)[lights.faces]
    edges = corners[:, 1:] - corners[:, :1]
    across = np.cross(edges[:, 0], edges[:, 1])
    area = 0.5 * np.linalg.norm(across, axis=1)
    power = area[:, None] * lights.emission[lights.entity]
    shares = power.sum(axis=1) / power.sum()
    shining = shares > 0.0
    table.corner = wp.array(corners[shining, 0], dtype=wp.vec3, device=device)
    table.edges = wp.array(edges[shining], dtype=wp.vec3, device=device)
    table.normal = wp.array((across / (2.0 * area[:, None]))[shining], dtype=wp.vec3, device=device)
    table.power = wp.array((power / np.maximum(shares, 1e-30)[:, None])[shining], dtype=wp.vec3, device=device)
    cumulative = np.concatenate([[0.0], np.cumsum(shares[shining])])
    table.shares = wp.array(cumulative, dtype=wp.float32, device=device)
    return table
