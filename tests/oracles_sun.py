"""Brute-force references of light with sharp edges: a small sun, an environment with bright spots, by casting rays."""

import mujoco
import numpy as np
import warp as wp

from tests.oracles import RAY_OFFSET, world_triangles
from tests.oracles_bounce import FAR, sobol_pair
from warp_psf.basis import sphere
from warp_psf.device import find_device, launch

# Over the sun's disc, per point: what an edge hides of it is then right to half a per cent.
SUN_RAYS = 256
# Over an environment, per point: bright cells get most of them.
ENVIRONMENT_RAYS = 256


@wp.kernel(enable_backward=False, module="unique")
def _gather_sun(
    first: int,
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),  # (receiver)
    normals: wp.array(dtype=wp.vec3),  # (receiver)
    directions: wp.array(dtype=wp.vec3),  # (direction), each of the same solid angle
    visible_out: wp.array(dtype=wp.float32),  # (receiver)
    cosine_out: wp.array(dtype=wp.float32),  # (receiver)
):
    _world, receiver = wp.tid()
    receiver += first
    n = normals[receiver]
    origin = points[receiver] + RAY_OFFSET * n
    seen = int(0)
    total = float(0.0)
    for index in range(directions.shape[0]):
        cosine = wp.dot(n, directions[index])
        if cosine > 0.0:
            if not wp.mesh_query_ray_anyhit(mesh, origin, directions[index], FAR):
                seen += 1
                total += cosine
    visible_out[receiver] = float(seen) / float(directions.shape[0])
    cosine_out[receiver] = total / float(directions.shape[0])


def sun_directions(toward: np.ndarray, diameter: float, rays: int = SUN_RAYS) -> np.ndarray:
    """Unit directions [rays, 3] spread evenly over a disc of `diameter`, radians, about `toward` [3]."""
    toward = np.asarray(toward, np.float64)
    turn = sphere.frame(toward / np.linalg.norm(toward))
    return sphere.fibonacci_cap(rays, diameter / 2) @ turn.T


def traced_sun(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    points: np.ndarray,
    normals: np.ndarray,
    toward: np.ndarray,
    diameter: float,
    rays: int = SUN_RAYS,
) -> tuple[np.ndarray, np.ndarray]:
    """What points [N, 3] with normals [N, 3] see of a sun past everything, by casting rays at all of its disc.

    Returns two float32 [N]: the share of the disc that is visible, and the irradiance of a sun of radiance 1. What lies
    below a point's horizon is not visible. Skins and flexes hide nothing.

    toward: the direction of the disc's middle, [3]. diameter: in radians, below pi.
    """
    device = find_device()
    mesh = _world_mesh(model, data, device)
    outputs = [wp.zeros(len(points), dtype=wp.float32, device=device) for _ in range(2)]
    inputs = [mesh.id]
    for vectors in (points, normals, sun_directions(toward, diameter, rays)):
        inputs.append(wp.array(np.asarray(vectors, np.float32), dtype=wp.vec3, device=device))
    launch(_gather_sun, (1, len(points)), inputs, outputs, device)
    visible, cosine = (array.numpy() for array in outputs)
    return visible, 4 * np.pi * np.sin(diameter / 4) ** 2 * cosine


@wp.struct
class CellTable:
    """An environment's cells, and how they are drawn: a row by its light, then a column by its light in that row."""

    rows: wp.array(dtype=wp.float32)  # (row + 1): cumulative shares of the light, 0 to 1
    columns: wp.array2d(dtype=wp.float32)  # (row, column + 1): of the row's light, 0 to 1
    weight: wp.array2d(dtype=wp.vec3)  # (row, column): radiance times solid angle over the share of the samples


@wp.func
def find_stretch(shares: wp.array(dtype=wp.float32), sample: float) -> wp.vec2:
    """Which stretch of rising shares a number in [0, 1) lies in, and how far along it, [0, 1)."""
    low = int(0)
    high = int(shares.shape[0] - 1)
    while high - low > 1:
        middle = (low + high) / 2
        if shares[middle] <= sample:
            low = middle
        else:
            high = middle
    return wp.vec2(float(low), (sample - shares[low]) / wp.max(shares[low + 1] - shares[low], 1.0e-20))


@wp.kernel(enable_backward=False, module="unique")
def _gather_cells(
    first: int,
    mesh: wp.uint64,
    cells: CellTable,
    points: wp.array(dtype=wp.vec3),  # (receiver)
    normals: wp.array(dtype=wp.vec3),  # (receiver)
    rays: int,
    seed: wp.uint32,
    irradiance_out: wp.array(dtype=wp.vec3),  # (receiver)
):
    _world, receiver = wp.tid()
    receiver += first
    n = normals[receiver]
    origin = points[receiver] + RAY_OFFSET * n
    row_height = wp.pi / float(cells.weight.shape[0])
    column_width = 2.0 * wp.pi / float(cells.weight.shape[1])
    total = wp.vec3()
    for index in range(rays):
        sample = sobol_pair(wp.uint32(index), seed + wp.uint32(receiver))
        down = find_stretch(cells.rows, sample[0])
        row = int(down[0])
        along = find_stretch(cells.columns[row], sample[1])
        # Within a cell evenly over its solid angle, which is even in z.
        top = wp.cos(float(row) * row_height)
        z = top + down[1] * (wp.cos(float(row + 1) * row_height) - top)
        radius = wp.sqrt(wp.max(1.0 - z * z, 0.0))
        phi = (along[0] + along[1]) * column_width
        direction = wp.vec3(radius * wp.cos(phi), radius * wp.sin(phi), z)
        cosine = wp.dot(n, direction)
        if cosine > 0.0:
            if not wp.mesh_query_ray_anyhit(mesh, origin, direction, FAR):
                total += cosine * cells.weight[row, int(along[0])]
    irradiance_out[receiver] = total / float(rays)


def traced_environment(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    points: np.ndarray,
    normals: np.ndarray,
    radiance: np.ndarray,
    rays: int = ENVIRONMENT_RAYS,
    seed: int = 0,
) -> np.ndarray:
    """Irradiance [N, 3] at points [N, 3] with normals [N, 3] from an environment, past everything, by casting rays.

    Directions are drawn in proportion to radiance times solid angle, as a scrambled (0, 2)-sequence of its own at every
    point: the error is noise, which falls faster than 1 / sqrt(rays). Skins and flexes hide nothing.

    Args:
        radiance: [rows, columns, 3], rows from +z to -z; a cell has one radiance all over its solid angle.
        rays: per point; powers of two are spread best.
        seed: two seeds give independent errors.
    """
    device = find_device()
    mesh = _world_mesh(model, data, device)
    out = wp.zeros(len(points), dtype=wp.vec3, device=device)
    inputs = [mesh.id, _upload_cells(radiance, device)]
    for vectors in (points, normals):
        inputs.append(wp.array(np.asarray(vectors, np.float32), dtype=wp.vec3, device=device))
    # Far apart, so that one seed's keys are not another's.
    inputs += [rays, np.random.SeedSequence(seed).generate_state(1)[0]]
    launch(_gather_cells, (1, len(points)), inputs, [out], device)
    return out.numpy()


def _world_mesh(model: mujoco.MjModel, data: mujoco.MjData, device: wp.Device) -> wp.Mesh:
    vertices, faces, _ = world_triangles(model, data)
    return wp.Mesh(
        points=wp.array(vertices.astype(np.float32), dtype=wp.vec3, device=device),
        indices=wp.array(faces.reshape(-1).astype(np.int32), dtype=wp.int32, device=device),
    )


def _upload_cells(radiance: np.ndarray, device: wp.Device) -> CellTable:
    radiance = np.asarray(radiance, np.float64)
    solid_angles = sphere.latlong_solid_angles(*radiance.shape[:2])[..., None]
    light = (solid_angles * radiance).sum(axis=2)
    by_row = light.sum(axis=1)
    shares = light / by_row.sum()
    cumulative = np.pad(np.cumsum(by_row), (1, 0)) / by_row.sum()
    # A row without light is never drawn; its shares are those of an even one.
    within = np.where(by_row[:, None] > 0.0, light, 1.0)
    within = np.pad(np.cumsum(within, axis=1), ((0, 0), (1, 0))) / within.sum(axis=1)[:, None]
    weight = solid_angles * radiance / np.where(shares > 0.0, shares, 1.0)[..., None]
    table = CellTable()
    table.rows = wp.array(cumulative.astype(np.float32), dtype=wp.float32, device=device)
    table.columns = wp.array(within.astype(np.float32), dtype=wp.float32, ndim=2, device=device)
    table.weight = wp.array(weight.astype(np.float32), dtype=wp.vec3, ndim=2, device=device)
    return table
