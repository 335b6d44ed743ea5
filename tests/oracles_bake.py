"""Brute-force references for the bake, and the bake's own sampling of parts of single shells."""

import numpy as np
import warp as wp

from warp_psf.bake import body, visibility
from warp_psf.basis import sh, sphere
from warp_psf.device import find_device, launch
from warp_psf.field.shells import FIRST_OUTER_SHELL
from warp_psf.scene.mesh import Mesh


@wp.kernel(module="unique")
def _find_hits(
    first: int,
    mesh: wp.uint64,
    reach: float,
    points: wp.array(dtype=wp.vec3),  # (point)
    directions: wp.array(dtype=wp.vec3),  # (direction)
    hits_out: wp.array2d(dtype=wp.int32),  # (point, direction)
):
    world, point = wp.tid()
    point += first
    for index in range(directions.shape[0]):
        hit = wp.mesh_query_ray(mesh, points[point], directions[index], reach)
        if hit.result:
            hits_out[point, index] = wp.where(hit.sign > 0.0, hit.face + 1, -hit.face - 1)


def trace(mesh: Mesh, points: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """What rays from points [N, 3] meet first in directions [Q, 3], int [N, Q].

    0 is nothing, f + 1 the front of face f, -(f + 1) its back.
    """
    device = find_device()
    warp_mesh = body.upload_mesh(mesh, device)
    hits = wp.zeros((len(points), len(directions)), dtype=wp.int32, device=device)
    inputs = [
        warp_mesh.id,
        1e3 * mesh.radius,
        wp.array(np.asarray(points, np.float32), dtype=wp.vec3, device=device),
        wp.array(np.asarray(directions, np.float32), dtype=wp.vec3, device=device),
    ]
    launch(_find_hits, (1, len(points)), inputs, [hits], device)
    return hits.numpy()


def traced_coverage(mesh: Mesh, points: np.ndarray, order: int, rays: int = 20_000) -> np.ndarray:
    """Coverage vectors [N, order^2] at points [N, 3], by rays all over the sphere: good to about 3 / rays^(3/4)."""
    directions = sphere.fibonacci_cap(rays)
    covered = trace(mesh, points, directions) != 0
    return sh.project(covered, directions, np.full(rays, 4 * np.pi / rays), order)


def cone_coverage(mesh: Mesh, points: np.ndarray, order: int, rays: int) -> np.ndarray:
    """Coverage vectors [N, order^2] at points [N, 3], by rays in each point's own cone of the bounding sphere."""
    vectors = np.empty((len(points), sh.coefficient_count(order)))
    for index, point in enumerate(np.asarray(points, np.float64)):
        toward = mesh.center - point
        distance = np.linalg.norm(toward)
        half_angle = np.pi if distance < mesh.radius else np.arcsin(mesh.radius / distance)
        directions = sphere.fibonacci_cap(rays, half_angle) @ sphere.frame(toward / distance).T
        covered = trace(mesh, point[None], directions)[0] != 0
        solid_angle = 4 * np.pi * np.sin(0.5 * half_angle) ** 2 / rays
        vectors[index] = sh.project(covered, directions, np.full(rays, solid_angle), order)
    return vectors


def latlong_coverage(mesh: Mesh, points: np.ndarray, order: int, rows: int) -> np.ndarray:
    """Coverage vectors [N, order^2] at points [N, 3], by rows x rows rays of latitude and longitude, as the paper's."""
    directions = sphere.latlong_directions(rows, rows).reshape(-1, 3)
    covered = trace(mesh, points, directions) != 0
    return sh.project(covered, directions, sphere.latlong_solid_angles(rows, rows).ravel(), order)


def baked_samples(mesh: Mesh, shell: int, order: int, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """What the bake does for some samples of a shell: where it takes them [N, 3], vectors [N, order^2], and rays each.

    chosen: indices into the shell's samples, int [N]. Positions are those after samples have left the solid.
    """
    device = find_device()
    warp_mesh = body.upload_mesh(mesh, device)
    points, outward = body._sample_points(mesh, shell)
    points, outward = points[chosen], outward[chosen]
    if shell <= FIRST_OUTER_SHELL:
        points, _ = visibility.leave_solid(warp_mesh, mesh.center, mesh.radius, mesh.closed, points, device)
    vectors = body._project(mesh, warp_mesh, shell, points, outward, order, device, None)
    return points, vectors, visibility.rays_at(0.2 * (1 + shell))
