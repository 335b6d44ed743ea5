"""Rays for the basis radiance: lighting a body from points, and gathering functions on its surface elsewhere."""

from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace

import numpy as np
import warp as wp

from warp_psf.basis import sphere
from warp_psf.device import launch


@cache
def make_gathering(functions: int, count: int) -> SimpleNamespace:
    """Kernels that project `functions` functions on the surface, as rays meet them, on `count` functions of direction.

    gather_functions casts the rays, sum_hits knows what they meet.
    """

    @wp.func_native(_add_products_snippet(functions, count))
    def add_products(
        basis: wp.array(dtype=wp.float32),
        faces: wp.array(dtype=wp.int32),
        face: int,
        u: float,
        v: float,
        weighted_basis: wp.array(dtype=wp.float32),
        ray: int,
        sums: wp.array(dtype=wp.float32),
        sample: int,
    ):
        """Adds the functions where a ray meets the surface, times the ray's weighted basis, to a sample's sums."""

    @wp.kernel(enable_backward=False, module="unique")
    def gather_functions(
        first: int,
        mesh: wp.uint64,
        faces: wp.array(dtype=wp.int32),  # (face corner)
        basis: wp.array(dtype=wp.float32),  # (vertex * function)
        points: wp.array(dtype=wp.vec3),  # (sample)
        frames: wp.array(dtype=wp.mat33),  # (sample): the axis of the cone of rays is the third column
        reach: float,
        rays: wp.array(dtype=wp.vec3),  # (ray), about +z
        weighted_basis: wp.array(dtype=wp.float32),  # (ray * count): basis times solid angle of the ray
        sums_out: wp.array(dtype=wp.float32),  # (sample * function * count), about the axes of the frames
        hits_out: wp.array(dtype=wp.int32),  # (sample): rays that meet the body
    ):
        world, sample = wp.tid()
        sample += first
        hits = wp.int32(0)
        for ray in range(rays.shape[0]):
            hit = wp.mesh_query_ray(mesh, points[sample], frames[sample] * rays[ray], reach)
            if hit.result:
                hits += 1
                if hit.sign > 0.0:
                    add_products(basis, faces, hit.face, hit.u, hit.v, weighted_basis, ray, sums_out, sample)
        hits_out[sample] = hits

    @wp.kernel(enable_backward=False, module="unique")
    def sum_hits(
        first: int,
        faces: wp.array(dtype=wp.int32),  # (face corner)
        basis: wp.array(dtype=wp.float32),  # (vertex * function)
        hit_face: wp.array2d(dtype=wp.int32),  # (sample, ray)
        hit_place: wp.array2d(dtype=wp.vec2h),  # (sample, ray)
        weighted_basis: wp.array(dtype=wp.float32),  # (ray * count)
        sums_out: wp.array(dtype=wp.float32),  # (sample * function * count)
    ):
        world, sample = wp.tid()
        sample += first
        for ray in range(hit_face.shape[1]):
            face = hit_face[sample, ray]
            if face >= 0:
                place = hit_place[sample, ray]
                add_products(
                    basis, faces, face, float(place[0]), float(place[1]), weighted_basis, ray, sums_out, sample
                )

    return SimpleNamespace(gather_functions=gather_functions, sum_hits=sum_hits)


def _add_products_snippet(functions: int, count: int) -> str:
    return f"""
    const float* at_0 = basis.data + (size_t)faces.data[3 * face] * {functions};
    const float* at_1 = basis.data + (size_t)faces.data[3 * face + 1] * {functions};
    const float* at_2 = basis.data + (size_t)faces.data[3 * face + 2] * {functions};
    const float* directional = weighted_basis.data + (size_t)ray * {count};
    // Copies, so that a compiler sees that writing the sums changes none of them.
    float values[{functions}], factors[{count}];
    for (int i = 0; i < {functions}; ++i) values[i] = u * at_0[i] + v * at_1[i] + (1.0f - u - v) * at_2[i];
    for (int k = 0; k < {count}; ++k) factors[k] = directional[k];
    float* sum = sums.data + (size_t)sample * {functions * count};
    for (int i = 0; i < {functions}; ++i)
        for (int k = 0; k < {count}; ++k) sum[i * {count} + k] += values[i] * factors[k];
    """


@wp.kernel(enable_backward=False, module="unique")
def _find_hits(
    first: int,
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),  # (sample)
    frames: wp.array(dtype=wp.mat33),  # (sample)
    reach: float,
    rays: wp.array(dtype=wp.vec3),  # (ray), about +z
    face_out: wp.array2d(dtype=wp.int32),  # (sample, ray)
    place_out: wp.array2d(dtype=wp.vec2h),  # (sample, ray)
):
    world, sample = wp.tid()
    sample += first
    for ray in range(rays.shape[0]):
        hit = wp.mesh_query_ray(mesh, points[sample], frames[sample] * rays[ray], reach)
        face_out[sample, ray] = -1
        if hit.result and hit.sign > 0.0:
            face_out[sample, ray] = hit.face
            place_out[sample, ray] = wp.vec2h(wp.float16(hit.u), wp.float16(hit.v))


@wp.kernel(enable_backward=False, module="unique")
def _light_surface(
    first: int,
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),  # (vertex)
    normals: wp.array(dtype=wp.vec3),  # (vertex)
    lights: wp.array(dtype=wp.vec3),  # (light)
    softening: wp.array(dtype=wp.float32),  # (light): squared, m^2
    intensity: wp.array(dtype=wp.float32),  # (light)
    irradiance_out: wp.array2d(dtype=wp.float32),  # (vertex, light)
):
    world, vertex = wp.tid()
    vertex += first
    for light in range(lights.shape[0]):
        toward = lights[light] - points[vertex]
        distance = wp.length(toward)
        level = wp.dot(toward, normals[vertex])
        if level > 0.0:
            direction = toward / distance
            if not wp.mesh_query_ray_anyhit(mesh, points[vertex], direction, distance):
                squared = distance * distance + softening[light]
                irradiance_out[vertex, light] = intensity[light] * level / (distance * squared)


@wp.kernel(enable_backward=False, module="unique")
def _free_distance(
    first: int,
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),  # (point)
    directions: wp.array(dtype=wp.vec3),  # (point)
    reach: float,
    distance_out: wp.array(dtype=wp.float32),  # (point)
):
    world, point = wp.tid()
    point += first
    hit = wp.mesh_query_ray(mesh, points[point], directions[point], reach)
    distance_out[point] = wp.where(hit.result, hit.t, reach)


def gather_functions(
    mesh: wp.Mesh,
    basis: np.ndarray,
    points: np.ndarray,
    axes: np.ndarray,
    rays: np.ndarray,
    weighted_basis: np.ndarray,
    device: wp.Device,
) -> tuple[np.ndarray, np.ndarray]:
    """What points see of functions on the surface, summed over rays with weights for each direction.

    basis: the functions at the vertices, float32 [vertices, N], interpolated on the faces; only fronts have values.
    points: float32 [n, 3]; axes: unit vectors [n, 3] about which the `rays` [Q, 3], given about +z, are turned.
    weighted_basis: weights of the rays, float [Q, K].
    Returns float32 [n, N, K], about the axes of `sphere.frame(axes)`, and the share of rays that meet the body, [n].
    """
    functions, count = basis.shape[1], weighted_basis.shape[1]
    sums = wp.zeros(len(points) * functions * count, dtype=wp.float32, device=device)
    hits = wp.zeros(len(points), dtype=wp.int32, device=device)
    reach = 4.0 * float(np.abs(points).max(initial=0.0) + np.abs(mesh.points.numpy()).max())
    inputs = [
        mesh.id,
        mesh.indices,
        wp.array(basis.ravel(), dtype=wp.float32, device=device),
        wp.array(points, dtype=wp.vec3, device=device),
        wp.array(sphere.frame(axes), dtype=wp.mat33, device=device),
        reach,
        wp.array(rays, dtype=wp.vec3, device=device),
        wp.array(weighted_basis.ravel(), dtype=wp.float32, device=device),
    ]
    launch(make_gathering(functions, count).gather_functions, (1, len(points)), inputs, [sums, hits], device)
    return sums.numpy().reshape(-1, functions, count), hits.numpy().astype(np.float32) / len(rays)


@dataclass(frozen=True)
class Hits:
    """Which fronts of a mesh rays from points meet, on the device.

    mesh: the mesh; face: wp.array2d (point, ray) of int32, -1 where none is met; place: wp.array2d (point, ray) of
    vec2h, the first two barycentric coordinates.
    """

    mesh: wp.Mesh
    face: wp.array
    place: wp.array


def find_hits(mesh: wp.Mesh, points: np.ndarray, axes: np.ndarray, rays: np.ndarray, device: wp.Device) -> Hits:
    """What rays [Q, 3], given about +z, meet from points [n, 3] when they are turned about the axes [n, 3]."""
    shape = (len(points), len(rays))
    face = wp.empty(shape, dtype=wp.int32, device=device)
    place = wp.empty(shape, dtype=wp.vec2h, device=device)
    inputs = [
        mesh.id,
        wp.array(points, dtype=wp.vec3, device=device),
        wp.array(sphere.frame(axes), dtype=wp.mat33, device=device),
        4.0 * float(np.abs(points).max(initial=0.0) + np.abs(mesh.points.numpy()).max()),
        wp.array(rays, dtype=wp.vec3, device=device),
    ]
    launch(_find_hits, (1, len(points)), inputs, [face, place], device)
    return Hits(mesh, face, place)


def sum_hits(hits: Hits, basis: np.ndarray, device: wp.Device) -> np.ndarray:
    """The sum over a point's rays of the functions at what they meet; basis: float32 [vertices, N]; float32 [n, N]."""
    functions, (points, rays) = basis.shape[1], hits.face.shape
    sums = wp.zeros(points * functions, dtype=wp.float32, device=device)
    inputs = [
        hits.mesh.indices,
        wp.array(basis.ravel(), dtype=wp.float32, device=device),
        hits.face,
        hits.place,
        wp.array(np.ones(rays), dtype=wp.float32, device=device),
    ]
    launch(make_gathering(functions, 1).sum_hits, (1, points), inputs, [sums], device)
    return sums.numpy().reshape(points, functions)


def light_surface(
    mesh: wp.Mesh,
    points: np.ndarray,
    normals: np.ndarray,
    lights: np.ndarray,
    softening: np.ndarray,
    intensity: np.ndarray,
    device: wp.Device,
) -> np.ndarray:
    """Irradiance at points of the surface from point lights, past the body itself, float32 [vertices, lights].

    points, normals: [vertices, 3]; lights: positions [lights, 3]; intensity: of each light, W/sr.
    softening: a length per light, metres, that is added to the distance in squares.
    """
    out = wp.zeros((len(points), len(lights)), dtype=wp.float32, device=device)
    inputs = [
        mesh.id,
        wp.array(points, dtype=wp.vec3, device=device),
        wp.array(normals, dtype=wp.vec3, device=device),
        wp.array(lights, dtype=wp.vec3, device=device),
        wp.array(softening**2, dtype=wp.float32, device=device),
        wp.array(intensity, dtype=wp.float32, device=device),
    ]
    launch(_light_surface, (1, len(points)), inputs, [out], device)
    return out.numpy()


def free_distance(
    mesh: wp.Mesh, points: np.ndarray, directions: np.ndarray, reach: float, device: wp.Device
) -> np.ndarray:
    """How far rays from points [N, 3] go before they meet the mesh, at most `reach` metres, float32 [N]."""
    out = wp.zeros(len(points), dtype=wp.float32, device=device)
    inputs = [
        mesh.id,
        wp.array(points, dtype=wp.vec3, device=device),
        wp.array(directions, dtype=wp.vec3, device=device),
        reach,
    ]
    launch(_free_distance, (1, len(points)), inputs, [out], device)
    return out.numpy()
