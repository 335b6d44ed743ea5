"""What a deforming body needs baked to cast shadows: spheres, their weights and tree, and what carries them."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np

from warp_psf.bake.binding import BINDING_SIZE, bind_spheres
from warp_psf.bake.kept import find_unlike
from warp_psf.bake.shape import is_same_shape, shape_key, surface_of, unit_shape
from warp_psf.bake.spheres import fit_spheres
from warp_psf.basis.sphere import fibonacci_cap, frame
from warp_psf.field.spheres import SphereSet, build_tree
from warp_psf.field.store import load_arrays, save_arrays
from warp_psf.scene.deforming import DeformingShape
from warp_psf.scene.mesh import Mesh, make_mesh

# Raised whenever the same mesh would give other spheres.
SPHERES_VERSION = 1
# Spheres per body: more follow its shape closer, and every receiver near it adds up more of them.
SPHERES = 96
# Directions and rays across the set per direction from which the weights are found: a hundred rays meet a sphere of a
# hundredth of the projected area from each direction.
WEIGHT_DIRECTIONS = 24
WEIGHT_RAYS = 96
# In bounding radii: no sphere that approximates a body is larger.
LARGEST_RADIUS = 2.0


def bake_spheres(mesh: Mesh, count: int = SPHERES, *, device: str | None = None, use_cache: bool = True) -> SphereSet:
    """Blocker spheres of a mesh, at most `count`, bound to its vertices; or what the cache has.

    Raises:
        ValueError: the count is less than 1.
    """
    unit = unit_shape(mesh)
    key = shape_key({"kind": "spheres", "version": SPHERES_VERSION, "count": count, "closed": mesh.closed}, unit)
    kept = _load(key, unit) if use_cache else None
    if kept is None:
        fit = fit_spheres(unit, count, device=device)
        vertices, shares = bind_spheres(unit, fit)
        kept = {"center": fit.center, "radius": fit.radius, "vertices": vertices, "shares": shares}
        if use_cache:
            save_arrays(key, kept | {"surface": surface_of(unit)})
    order, first, leaves = build_tree(kept["center"])
    radius = kept["radius"][order]
    weight = share_rays(kept["center"][order], radius)
    return SphereSet(radius * mesh.radius, weight, kept["vertices"][order], kept["shares"][order], first, leaves)


def bake_shape_spheres(shape: DeformingShape, *, device: str | None = None) -> SphereSet:
    """`bake_spheres` of a shape that deforms, bound to the shape's own vertices."""
    with warnings.catch_warnings():
        # What is mended for the fit is shown as it is all the same.
        warnings.simplefilter("ignore")
        mesh = make_mesh(shape.name, shape.vertices, shape.faces)
    spheres = bake_spheres(mesh, device=device)
    # Creases and seams give a mesh other vertices than the shape has, at the same places.
    # The sum makes -0 and 0 one place.
    places = {place.tobytes(): index for index, place in enumerate(shape.vertices + np.float32(0))}
    index = np.array([places[place.tobytes()] for place in mesh.vertices + np.float32(0)], np.int32)
    return replace(spheres, vertices=index[spheres.vertices])


def share_rays(center: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """What share of the rays through each sphere is its own, when spheres share a ray evenly; float64 [n].

    Band-limited logarithms of spheres behind one another would add up where their visibilities do not multiply: they
    cover the same directions. With these weights a ray through several is stopped once, as much as by one.
    """
    shares, met = np.zeros(len(center)), np.zeros(len(center))
    for turned in frame(fibonacci_cap(WEIGHT_DIRECTIONS, np.pi / 2)):
        across = center @ turned[:, :2]
        low, high = (across - radius[:, None]).min(axis=0), (across + radius[:, None]).max(axis=0)
        x, y = (low[k] + (high[k] - low[k]) * (np.arange(WEIGHT_RAYS) + 0.5) / WEIGHT_RAYS for k in range(2))
        squared = (x[:, None, None] - across[:, 0]) ** 2 + (y[None, :, None] - across[:, 1]) ** 2
        hit = squared < radius**2
        cell = np.prod(high - low)
        shares += cell * (hit / np.maximum(hit.sum(axis=-1, keepdims=True), 1)).sum(axis=(0, 1))
        met += cell * hit.sum(axis=(0, 1))
    # A sphere between the rays shares with nobody that could be seen.
    return np.where(met > 0.0, shares / np.maximum(met, 1e-300), 1.0)


def _load(key: str, unit: Mesh) -> dict[str, np.ndarray] | None:
    """What was kept of a unit shape under a key, or None when nothing was, or (which is said) nothing usable."""
    arrays = load_arrays(key)
    if arrays is None:
        return None
    spheres = arrays["radius"].size if "radius" in arrays else 0
    layout: dict[str, tuple[type, tuple[int, ...] | None]] = {
        "center": (np.float64, (spheres, 3)),
        "radius": (np.float64, (spheres,)),
        "vertices": (np.int32, (spheres, BINDING_SIZE)),
        "shares": (np.float64, (spheres, BINDING_SIZE)),
        "surface": (np.float32, (len(unit.vertices), 6)),
    }
    wrong = find_unlike(arrays, layout)
    if wrong is None and not (spheres and ((arrays["radius"] > 0) & (arrays["radius"] <= LARGEST_RADIUS)).all()):
        wrong = "radius"
    if wrong is None and not 0 <= arrays["vertices"].min() <= arrays["vertices"].max() < len(unit.vertices):
        wrong = "vertices"
    if wrong is not None:
        warnings.warn(
            f"the cached spheres of mesh {unit.name!r} have a wrong {wrong!r}; they are fitted again", stacklevel=4
        )
        return None
    # Another shape that happens to have the same key is no damage.
    return arrays if is_same_shape(arrays["surface"], unit) else None
