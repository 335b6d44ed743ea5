"""Brute-force references for the shadows of area lights: rays from every point to every sample of a light."""

import numpy as np
import warp as wp

from warp_psf.scene.still import StillScene

# Rays start and end so far from surfaces, metres: float32 at coordinates of some metres.
OFFSET = 2e-5


@wp.kernel(enable_backward=False, module="unique")
def _look(
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),
    targets: wp.array(dtype=wp.vec3),
    seen: wp.array2d(dtype=wp.uint8),
):
    point, target = wp.tid()
    start = points[point]
    offset = targets[target] - start
    if not wp.mesh_query_ray_anyhit(mesh, start, offset, 1.0 - OFFSET / wp.length(offset)):
        seen[point, target] = wp.uint8(1)


def traced_sight(scene: StillScene, points: np.ndarray, normals: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Whether each point [N, 3], on a surface with normals [N, 3], sees each target [T, 3]: bool [N, T]."""
    mesh = wp.Mesh(
        points=wp.array(scene.vertices, dtype=wp.vec3, device="cpu"),
        indices=wp.array(scene.faces.reshape(-1), dtype=wp.int32, device="cpu"),
    )
    seen = wp.zeros((len(points), len(targets)), dtype=wp.uint8, device="cpu")
    starts = wp.array((points + OFFSET * normals).astype(np.float32), dtype=wp.vec3, device="cpu")
    ends = wp.array(np.asarray(targets, np.float32), dtype=wp.vec3, device="cpu")
    wp.launch(_look, dim=(len(points), len(targets)), inputs=[mesh.id, starts, ends, seen], device="cpu")
    return seen.numpy().astype(bool)


def sample_irradiance(
    points: np.ndarray, normals: np.ndarray, samples: np.ndarray, facing: np.ndarray, area: float
) -> np.ndarray:
    """Irradiance at points that each sample of radiance 1 causes unhindered, float64 [N, T].

    samples: [T, 3], all with the normal `facing` [3] and the area `area`, m^2.
    """
    offset = samples[None] - points[:, None]
    squared = (offset**2).sum(axis=2)
    arriving = np.maximum((offset * normals[:, None]).sum(axis=2), 0.0)
    leaving = np.maximum(-(offset @ facing), 0.0)
    return arriving * leaving * area / squared**2


def view_points(
    scene: StillScene, camera: int, width: int, height: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """What rays through pixels' centres meet: mask [height, width]; where it is true, points, normals of the triangles
    on the viewer's side, and smooth normals [N, 3]."""
    view = scene.cameras[camera]
    half_width, half_height = view.half_sizes(width, height)
    row, column = np.mgrid[:height, :width] + 0.5
    film = (2 * column / width - 1) * half_width, (1 - 2 * row / height) * half_height, -np.ones((height, width))
    directions = np.stack(film, axis=-1).reshape(-1, 3) @ view.rotation.T
    mesh = wp.Mesh(
        points=wp.array(scene.vertices, dtype=wp.vec3, device="cpu"),
        indices=wp.array(scene.faces.reshape(-1), dtype=wp.int32, device="cpu"),
    )
    found = wp.zeros(len(directions), dtype=wp.vec3, device="cpu")
    face = wp.zeros(len(directions), dtype=wp.int32, device="cpu")
    rays = wp.array(directions.astype(np.float32), dtype=wp.vec3, device="cpu")
    wp.launch(_meet, len(directions), [mesh.id, wp.vec3(*view.position), rays, found, face], device="cpu")
    there = face.numpy() >= 0
    share, triangle = found.numpy()[there].astype(np.float64), scene.faces[face.numpy()[there]]
    weights = np.stack([share[:, 0], share[:, 1], 1 - share[:, 0] - share[:, 1]], axis=1)[..., None]
    corners = scene.vertices[triangle].astype(np.float64)
    smooth = (weights * scene.normals[triangle]).sum(axis=1)
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = []
    for vectors in (flat, smooth):
        turned = np.where((vectors * directions[there]).sum(axis=1, keepdims=True) > 0, -vectors, vectors)
        normals.append(turned / np.linalg.norm(turned, axis=1, keepdims=True))
    return there.reshape(height, width), (weights * corners).sum(axis=1), *normals


@wp.kernel(enable_backward=False, module="unique")
def _meet(
    mesh: wp.uint64,
    origin: wp.vec3,
    directions: wp.array(dtype=wp.vec3),
    share: wp.array(dtype=wp.vec3),
    face: wp.array(dtype=wp.int32),
):
    ray = wp.tid()
    query = wp.mesh_query_ray(mesh, origin, directions[ray], 1.0e6)
    face[ray] = -1
    if query.result:
        face[ray] = query.face
        share[ray] = wp.vec3(query.u, query.v, 0.0)
