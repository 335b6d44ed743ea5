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
