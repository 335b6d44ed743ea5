"""Self-shadowed transfer per vertex: what a body leaves of its own hemispheres."""

from __future__ import annotations

import numpy as np
import warp as wp

from warp_psf.bake import visibility
from warp_psf.basis import sh
from warp_psf.scene.mesh import Mesh

RAYS_PER_VERTEX = 1024
# The vertex leaves the surface by this share of the bounding radius, so that the faces around it, which a smooth
# normal does not match, do not count as occluders.
VERTEX_OFFSET = 1.0e-3


def bake_transfer(mesh: Mesh, warp_mesh: wp.Mesh, order: int, device: wp.Device) -> tuple[np.ndarray, np.ndarray]:
    """Self-visibility times the clamped cosine, and self-visibility alone, per vertex.

    Both float32 [vertices, order^2] in the body's frame. Visibility and cosine are projected together, which is one
    truncation fewer than the product of their vectors, and only what is blocked is sampled: an unblocked vertex gets
    the closed form, free of sampling error.
    """
    points = (mesh.vertices + VERTEX_OFFSET * mesh.radius * mesh.normals).astype(np.float32)
    blocked, blocked_cosine = visibility.project_blocked_hemisphere(
        warp_mesh, points, mesh.normals, RAYS_PER_VERTEX, order, device, solid=mesh.closed
    )
    cosine = sh.zonal(sh.clamped_cosine(order), mesh.normals)
    hemisphere = sh.zonal(sh.cap(np.pi / 2, order), mesh.normals)
    transfer, visibility_of_self = cosine - blocked_cosine, hemisphere - blocked
    _, buried = visibility.leave_solid(warp_mesh, mesh.center, mesh.radius, mesh.closed, points, device)
    both = np.concatenate([transfer, visibility_of_self], axis=1)
    both = fill_buried(mesh.faces, buried, both).astype(np.float32)
    return both[:, : order * order], both[:, order * order :]


def fill_buried(faces: np.ndarray, buried: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values [V, K] with those of buried vertices taken from the nearest vertices, along edges, that are not.

    A vertex inside another part of the body is seen by nobody, but the faces that reach out of there are: interpolated
    to its darkness, they would show a black seam.
    """
    values, known = values.copy(), ~buried
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    ends = np.concatenate([ends, ends[:, ::-1]])
    while True:
        from_known = ends[known[ends[:, 0]] & ~known[ends[:, 1]]]
        if len(from_known) == 0:
            return values
        total, count = np.zeros_like(values), np.zeros(len(values))
        np.add.at(total, from_known[:, 1], values[from_known[:, 0]])
        np.add.at(count, from_known[:, 1], 1.0)
        reached = count > 0.0
        values[reached] = total[reached] / count[reached, None]
        known |= reached
