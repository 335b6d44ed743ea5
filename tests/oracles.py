"""Brute-force references: what the shading approximates, by casting rays at everything."""

import warnings

import mujoco
import numpy as np
import warp as wp

from warp_psf.basis import sh, sphere
from warp_psf.bridge import build_scene, read_poses
from warp_psf.device import find_device, launch
from warp_psf.renderer import Renderer
from warp_psf.scene.light import area_light_entities
from warp_psf.scene.mesh import Mesh
from warp_psf.scene.receiver import make_receivers
from warp_psf.shade.direct import shade_direct
from warp_psf.shade.occluders import turn_occlusion
from warp_psf.shade.spheres import choose_cuts, make_cuts

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
        geoms.append(np.full(len(mesh.vertices), entity.parts[0].object_id))
        total += len(mesh.vertices)
    return np.concatenate(vertices), np.concatenate(faces), np.concatenate(geoms)


def loose_triangles(renderer: Renderer) -> tuple[np.ndarray, np.ndarray]:
    """What the last picture showed of things without a rigid shape, in the world: vertices [V, 3] and faces [F, 3]."""
    stage = renderer._stage
    (table,) = stage.device_scene.geometry.tables
    shown = table.radius.numpy() > 0.0
    vertices, faces, total = [np.zeros((0, 3), np.float32)], [np.zeros((0, 3), np.int32)], 0
    for entity in (*stage.scene.deforming, stage.scene.loose):
        if entity >= 0 and shown[entity]:
            mesh = stage.device_scene.meshes[stage.scene.entities[entity].mesh]
            vertices.append(mesh.points.numpy())
            faces.append(mesh.indices.numpy().reshape(-1, 3) + total)
            total += len(vertices[-1])
    return np.concatenate(vertices), np.concatenate(faces)


def traced_irradiance(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    points: np.ndarray,
    normals: np.ndarray,
    coefficients: np.ndarray,
    rays: int = 4096,
    loose: tuple[np.ndarray, np.ndarray] | None = None,
) -> np.ndarray:
    """Irradiance [N, 3] at points with normals [N, 3] from an environment on SH, past everything, by ray casting.

    coefficients: of the environment's radiance, [order^2, 3]. rays: directions over the whole sphere. loose: vertices
    and faces of what has no rigid shape, see `loose_triangles`.
    """
    device = find_device()
    vertices, faces, _ = world_triangles(model, data)
    if loose is not None:
        faces = np.concatenate([faces, loose[1] + len(vertices)])
        vertices = np.concatenate([vertices, loose[0]])
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


# Scenes for tests


def make_model(worldbody: str, header: str = "") -> tuple[mujoco.MjModel, mujoco.MjData]:
    """A model without lights, with the diffuse materials white and grey, in its initial state."""
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><visual><headlight active="0"/></visual><asset>'
        '<material name="white" rgba="1 1 1 1" specular="0"/><material name="grey" rgba=".4 .4 .4 1" specular="0"/>'
        f"</asset>{header}<worldbody>{worldbody}</worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def make_renderer(
    worldbody: str, height: int = 1, width: int = 1, *, header: str = "", **options
) -> tuple[Renderer, mujoco.MjData]:
    """A renderer of such a model, updated with its initial state and free camera; rgba counts as linear."""
    model, data = make_model(worldbody, header)
    renderer = Renderer(model, height, width, **({"material_space": "linear"} | options))
    renderer.update_scene(data)
    return renderer, data


def shade_points(renderer: Renderer, geom: str, points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, ...]:
    """What points [N, 3] on a geom with normals [N, 3] receive: irradiance and Phong radiance, float32 [N, 3] each.

    In the state of the last `update_scene`, without the delta lights. The geom must not shadow itself.
    """
    device, count = renderer._settings.device, len(points)
    names = [entity.name for entity in renderer._stage.scene.entities]
    receivers = make_receivers((1, count), device)
    receivers.entity.fill_(names.index(geom))
    receivers.position.assign(np.asarray(points, np.float32)[None])
    receivers.normal.assign(np.broadcast_to(normals, (1, count, 3)).astype(np.float32))
    received = [wp.zeros((1, count), dtype=wp.vec3, device=device) for _ in range(2)]
    turns = wp.full((1, count), 1, dtype=wp.int32, device=device)
    turn_occlusion(renderer._stage.occlusion, renderer._stage.device_scene, device)
    lights = (renderer._stage.occlusion, renderer._stage.lighting)
    spheres = renderer._stage.spheres
    cuts = make_cuts(1, count, not spheres.is_empty, device)
    choose_cuts(cuts, receivers, spheres, device)
    shade_direct(receivers, turns, 1, renderer._stage.device_scene, *lights, cuts, *received, device)
    return tuple(array.numpy()[0] for array in received)


# Closed forms


def sphere_form_factor(points: np.ndarray, normals: np.ndarray, center: np.ndarray, radius: float) -> np.ndarray:
    """The share [N] of the irradiance of a white sky that a sphere wholly above the horizon takes: (R/d)^2 cos."""
    offset = center - points
    distance = np.linalg.norm(offset, axis=1)
    return (radius / distance) ** 2 * np.sum(offset * normals, axis=1) / distance


def polygon_form_factor(points: np.ndarray, normals: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """The share [N] of the irradiance of a white sky that comes from a polygon [K, 3] wholly above the horizon.

    Lambert's formula: 1/(2 pi) of the sum, over its edges, of the angle they subtend times the cosine between the
    normal and that of the plane through the edge and the point. The polygon is clockwise seen from the point.
    """
    toward = corners[None] - points[:, None]
    toward = toward / np.linalg.norm(toward, axis=2, keepdims=True)
    after = np.roll(toward, -1, axis=1)
    across = np.cross(toward, after)
    sine = np.linalg.norm(across, axis=2)
    angle = np.arctan2(sine, np.sum(toward * after, axis=2))
    cosine = np.einsum("nkx,nx->nk", across, np.broadcast_to(normals, points.shape)) / sine
    return np.sum(angle * cosine, axis=1) / (2 * np.pi)


def sphere_coverage(points: np.ndarray, center: np.ndarray, radius: float, order: int) -> np.ndarray:
    """The SH vectors [N, order^2] of the directions that a sphere covers around points [N, 3]."""
    offset = center - points
    distance = np.linalg.norm(offset, axis=1)
    return sh.zonal(sh.cap(np.arcsin(radius / distance), order), offset / distance[:, None])


# NumPy twins, float64


def chained_irradiance(light: np.ndarray, coverage: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Irradiance [N, 3] past one occluder by the papers' products on SH.

    light: radiance [order^2, 3]. coverage: [N, order^2]. The cosine has one band more, and so have the products.
    """
    order = sh.order_of(len(light)) + 1
    more = order * order - len(light)
    visibility = -np.pad(coverage, ((0, 0), (0, more)))
    visibility[:, 0] += np.sqrt(4 * np.pi)
    cosine = sh.zonal(sh.clamped_cosine(order), np.broadcast_to(normals, (len(coverage), 3)))
    received = sh.triple_product(visibility, cosine)
    return received @ np.pad(light, ((0, more), (0, 0)))


def multiplied_irradiance(light: np.ndarray, coverages: list[np.ndarray], normals: np.ndarray) -> np.ndarray:
    """Irradiance [N, 3] past several occluders, each of coverage [N, order^2]: products at the quadrature's directions.

    light: radiance [order^2, 3].
    """
    order = sh.order_of(len(light))
    directions, weights = sphere.quadrature(sphere.QUADRATURE_POINTS[order])
    basis = sh.evaluate(directions, order)
    cosine = sh.zonal(sh.clamped_cosine(order + 1), normals) @ sh.evaluate(directions, order + 1).T
    visible = np.prod([1 - coverage @ basis.T for coverage in coverages], axis=0)
    return (weights * visible * cosine) @ (basis @ light)
