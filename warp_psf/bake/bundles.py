"""Rays in bundles: one of each is cast first, and the others only where an edge of what is seen may run.

What a solid hides from a point are few connected regions of directions. A bundle whose probe says the same as the
probes of the bundles around it lies within one of them or outside all. Where neighbours disagree an edge runs, and
there every ray is cast: edges are what limits the accuracy of a projection, which so stays that of all rays. A part
that is narrower than the distance of probes, twice that of the rays, can be missed: sheets are, solids hardly.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
import warp as wp

from warp_psf.basis import sphere

# Rays of a bundle. With eight, edges take as many rays as the smooth parts save.
BUNDLE_SIZE = 4
# Bundles that must agree with one: those around it (six on average) and at its corners.
NEIGHBOURS = 8


@wp.struct
class RayBundles:
    """Rays about +z, those of a bundle behind one another and its probe first."""

    rays: wp.array(dtype=wp.vec3)  # (ray)
    first: wp.array(dtype=wp.int32)  # (bundle + 1): index of the first ray
    beside: wp.array2d(dtype=wp.int32)  # (bundle, neighbour): the bundles around it


@dataclass(frozen=True)
class Bundles:
    """The same on the host: rays float64 [rays, 3], first int [bundles + 1], beside int [bundles, neighbours]."""

    rays: np.ndarray
    first: np.ndarray
    beside: np.ndarray

    def upload(self, device: wp.Device) -> RayBundles:
        """The bundles on the device."""
        bundles = RayBundles()
        bundles.rays = wp.array(self.rays, dtype=wp.vec3, device=device)
        bundles.first = wp.array(self.first, dtype=wp.int32, device=device)
        bundles.beside = wp.array(self.beside, dtype=wp.int32, ndim=2, device=device)
        return bundles


@cache
def cap_bundles(count: int, half_angle: float, solid: bool) -> Bundles:
    """The rays of `sphere.fibonacci_cap(count, half_angle)` in bundles of neighbouring directions.

    solid: whether they look at a body without sheets; if not, each ray is a bundle of its own, and all are cast.
    """
    rays = sphere.fibonacci_cap(count, half_angle)
    if not solid:
        return Bundles(rays, np.arange(count + 1), np.zeros((count, 0), np.int64))
    groups = [np.arange(count)]
    while len(groups[0]) > BUNDLE_SIZE:
        groups = [half for group in groups for half in _halve(rays, group)]
    for group in groups:
        probe = (rays[group] @ rays[group].mean(axis=0)).argmax()
        group[[0, probe]] = group[[probe, 0]]
    probes = rays[[group[0] for group in groups]]
    nearest = np.argsort(-(probes @ probes.T), axis=1, kind="stable")
    return Bundles(rays[np.concatenate(groups)], np.cumsum([0, *map(len, groups)]), nearest[:, 1 : 1 + NEIGHBOURS])


def _halve(rays: np.ndarray, group: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    ordered = group[np.argsort(rays[group, np.ptp(rays[group], axis=0).argmax()], kind="stable")]
    middle = (len(group) + 1) // 2
    return ordered[:middle].copy(), ordered[middle:].copy()


@wp.func
def agrees(bundles: RayBundles, probed: wp.array(dtype=wp.uint8), bundle: int) -> bool:
    """Whether the probes around a bundle say what its own does; `probed` (bundle): what they say."""
    own = probed[bundle]
    same = bool(True)
    for k in range(bundles.beside.shape[1]):
        if probed[bundles.beside[bundle, k]] != own:
            same = False
    return same
