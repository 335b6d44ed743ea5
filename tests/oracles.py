"""Brute-force references: what the shading approximates, by casting rays at everything."""

import warnings

import mujoco
import numpy as np
import warp as wp

from warp_psf.basis import sh, sphere
from warp_psf.bridge import build_scene, read_poses
from warp_psf.device import find_device, launch
from warp_psf.scene.light import area_light_entities
from warp_psf.scene.mesh import Mesh

# Rays start this far off the surface, metres: the models under test are centimetres to metres large.
RAY_OFFSET = 1e-4


@wp.kernel(module="unique")
def _gather_irradiance(
    first: int,
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),  # (receiver)
    normals: wp.array(dtype=wp.vec3),  # (receiver)
    directions: wp.array(dtype=wp.vec3),  # (direction)
    radiance: wp.array(dtype=wp.vec3),  # (direction), times solid angle
    irradiance_out: wp.array(dtype=wp.vec3),  # (receiver)
):
    _world, receiver = wp.tid()
    receiver += first
    n = normals[receiver]
    origin = points[receiver] + RAY_OFFSET * n
    total = wp.vec3()
    for index in range(directions.shape[0]):
        cosine = wp.dot(n, directions[index])
        if cosine > 0.0:
            if not wp.mesh_query_ray_anyhit(mesh, origin, directions[index], 1.0e6):
                total += cosine * radiance[index]
    irradiance_out[receiver] = total


def world_triangles(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Everything that casts shadows, in the world: vertices [V, 3], faces [F, 3], and the geom of each vertex [V]."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scene = build_scene(model, model_lights=False)
    poses = read_poses(model, data, scene)
    vertices, faces, geoms, total = [], [], [], 0
    for index, entity in enumerate(scene.entities[: len(scene.entities) - len(area_light_entities(scene))]):
        mesh: Mesh = scene.meshes[entity.mesh]
        vertices.append(mesh.vertices @ poses.rotation[0, index].T + poses.position[0, index])
        faces.append(mesh.faces + total)
        geoms.append(np.full(len(mesh.vertices), entity.object_id))
        total += len(mesh.vertices)
    return np.concatenate(vertices), np.concatenate(faces), np.concatenate(geoms)


def traced_irradiance(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    points: np.ndarray,
    normals: np.ndarray,
    coefficients: np.ndarray,
    rays: int = 4096,
) -> np.ndarray:
    """Irradiance [N, 3] at points with normals [N, 3] from an environment on SH, past everything, by ray casting.

    coefficients: of the environment's radiance, [order^2, 3]. rays: directions over the whole sphere.
    """
    device = find_device()
    vertices, faces, _ = world_triangles(model, data)
    mesh = wp.Mesh(
        points=wp.array(vertices, dtype=wp.vec3, device=device),
        indices=wp.array(faces.reshape(-1), dtype=wp.int32, device=device),
    )
    directions = sphere.fibonacci_cap(rays)
    radiance = sh.evaluate(directions, sh.order_of(len(coefficients))) @ coefficients * (4 * np.pi / rays)
    out = wp.zeros(len(points), dtype=wp.vec3, device=device)
    inputs = [
        mesh.id,
        wp.array(points, dtype=wp.vec3, device=device),
        wp.array(normals, dtype=wp.vec3, device=device),
        wp.array(directions, dtype=wp.vec3, device=device),
        wp.array(radiance, dtype=wp.vec3, device=device),
    ]
    launch(_gather_irradiance, (1, len(points)), inputs, [out], device)
    return out.numpy()
