"""How a fit's spheres follow the vertices of a mesh that deforms."""

from __future__ import annotations

import numpy as np

from warp_psf.bake.spheres import SphereFit, nearest
from warp_psf.basis.sphere import fibonacci_cap
from warp_psf.scene.mesh import Mesh
from warp_psf.scene.topology import merge_positions

# Vertices that a sphere is bound to. It looks for others further away while its weights' magnitudes add up to more
# than this (1 is a mean). Directions in which the vertices spread less than this share of the most count as none.
BINDING_SIZE = 16
LARGEST_WEIGHT_SUM = 1.5
FLAT_BINDING = 1.0e-6


def bind_spheres(mesh: Mesh, fit: SphereFit) -> tuple[np.ndarray, np.ndarray]:
    """Vertices that carry a fit's spheres when the mesh deforms: center = sum of weight times vertex.

    Exact for the mesh as it is and after any affine motion of its vertices. Every sphere gets the vertices nearest to
    points that are spread over its surface, further out where those do not surround it, and the weights of
    least squares among those that sum to 1 and reproduce the centre. The centre of a sphere that lies off the plane
    of a flat mesh is bound to its foot in the plane.

    Returns:
        Vertices, int32 [n, 16], and weights, float64 [n, 16]; a mesh of fewer positions fills up with weights 0.
    """
    first = merge_positions(mesh.vertices.astype(np.float64))[1]
    points = mesh.vertices[first].astype(np.float64)
    vertices = np.zeros((len(fit.center), BINDING_SIZE), np.int32)
    weights = np.zeros((len(fit.center), BINDING_SIZE))
    for sphere, (center, radius) in enumerate(zip(fit.center, fit.radius, strict=True)):
        best, carriers, shares = (np.inf, np.inf), first[:1], np.ones(1)
        # Twice as far each time, until the outermost vertices in all directions are met.
        for reach in radius * 2.0 ** np.arange(max(np.ceil(np.log2(8.0 * mesh.radius / radius)), 1.0)):
            chosen = np.unique(
                nearest((center - mesh.center) + reach * fibonacci_cap(BINDING_SIZE), points - mesh.center)
            )
            found, miss = _affine_weights(points[chosen] - center)
            # A miss counts before large weights.
            quality = (round(miss, 6), float(np.abs(found).sum()))
            if quality < best:
                best, carriers, shares = quality, first[chosen], found
            if best[0] == 0.0 and best[1] <= LARGEST_WEIGHT_SUM:
                break
        vertices[sphere] = carriers[0]
        vertices[sphere, : len(carriers)], weights[sphere, : len(carriers)] = carriers, shares
    return vertices, weights


def _affine_weights(offsets: np.ndarray) -> tuple[np.ndarray, float]:
    """The smallest weights [N] of sum 1 whose mean of offsets [N, 3] is 0, and how far off it is, in their size."""
    size = max(np.linalg.norm(offsets, axis=1).max(), np.finfo(np.float64).tiny)
    system = np.vstack([np.ones(len(offsets)), offsets.T / size])
    weights = np.linalg.pinv(system, rcond=FLAT_BINDING)[:, 0]
    weights /= weights.sum()
    return weights, float(np.linalg.norm(weights @ offsets) / size)
