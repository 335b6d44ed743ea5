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
        warp_mesh, points, mesh.normals, RAYS_PER_VERTEX, order, device
    )
    cosine = sh.zonal(sh.clamped_cosine(order), mesh.normals)
    hemisphere = sh.zonal(sh.cap(np.pi / 2, order), mesh.normals)
    return (cosine - blocked_cosine).astype(np.float32), (hemisphere - blocked).astype(np.float32)
