"""Baked bodies and the arrays that stand for them in the cache."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

from warp_psf.bake.shape import is_same_shape, surface_of
from warp_psf.basis import sh
from warp_psf.field.radiance import RADIANCE_SHELLS, BasisRadianceField
from warp_psf.field.shells import (
    COARSEST_RESOLUTION,
    FINEST_RESOLUTION,
    FIRST_OUTER_SHELL,
    SHELL_COUNT,
    ShadowField,
)
from warp_psf.field.store import load_arrays, save_arrays
from warp_psf.scene.mesh import Mesh

_FIELD_ARRAYS = ("resolutions", "codes", "minimum", "step")
RESOLUTIONS = [2**k for k in range(FINEST_RESOLUTION.bit_length()) if 2**k >= COARSEST_RESOLUTION]


@dataclass(frozen=True)
class BakedBody:
    """What is precomputed of a mesh. Built by `bake_mesh`.

    Attributes:
        field: its object occlusion field, or None where visibility has a closed form (boxes, rectangles, spheres).
        transfer: self-visibility times cosine per vertex, on SH, float32 [vertices, coefficients], in the body's frame;
            None for convex bodies, which do not shadow themselves.
        visibility: self-visibility alone (zero below the horizon), likewise.
    """

    field: ShadowField | None
    transfer: np.ndarray | None
    visibility: np.ndarray | None


def save_body(key: str, unit: Mesh, body: BakedBody) -> None:
    """Keeps what was baked of a unit shape under a key."""
    arrays = {"surface": surface_of(unit)}
    if body.field is not None:
        arrays |= {name: getattr(body.field, name) for name in _FIELD_ARRAYS}
    if body.transfer is not None and body.visibility is not None:
        arrays |= {"transfer": body.transfer, "visibility": body.visibility}
    save_arrays(key, arrays)


def load_body(key: str, unit: Mesh, order: int, has_transfer: bool) -> BakedBody | None:
    """What was kept of a unit shape under a key, or None when nothing was, or (which is said) nothing usable."""
    coefficients = sh.coefficient_count(order)
    layout = dict.fromkeys(("minimum", "step"), (np.float32, (SHELL_COUNT, coefficients)))
    if has_transfer:
        layout |= dict.fromkeys(("transfer", "visibility"), (np.float32, (len(unit.vertices), coefficients)))
    arrays = _load(key, unit, "field", layout, SHELL_COUNT, (coefficients,))
    if arrays is None:
        return None
    field = ShadowField(center=np.zeros(3, np.float32), radius=1.0, **{name: arrays[name] for name in _FIELD_ARRAYS})
    return BakedBody(field, arrays.get("transfer"), arrays.get("visibility"))


def save_radiance(
    key: str,
    unit: Mesh,
    basis: np.ndarray,
    proxies: np.ndarray,
    self_irradiance: np.ndarray | None,
    field: BasisRadianceField,
) -> None:
    """Keeps what `bake_radiance` computes of a unit shape under a key."""
    arrays = {"surface": surface_of(unit), "basis": basis, "proxies": proxies, "covered": field.covered}
    arrays |= {name: getattr(field, name) for name in _FIELD_ARRAYS}
    if self_irradiance is not None:
        arrays["self_irradiance"] = self_irradiance
    save_arrays(key, arrays)


def load_radiance(
    key: str, unit: Mesh, order: int, functions: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, BasisRadianceField] | None:
    """What `save_radiance` kept under a key, or None when there is none, or (which is said) none that can be used."""
    vertices, coefficients = len(unit.vertices), sh.coefficient_count(order)
    layout = dict.fromkeys(("minimum", "step"), (np.float32, (RADIANCE_SHELLS, functions, coefficients)))
    layout |= {"basis": (np.float32, (vertices, functions)), "proxies": (np.int32, None), "covered": (np.float32, None)}
    if not unit.convex:
        layout["self_irradiance"] = (np.float32, (vertices, functions))
    arrays = _load(key, unit, "basis radiance", layout, RADIANCE_SHELLS, (functions, coefficients))
    if arrays is None:
        return None
    proxies, wrong = arrays["proxies"], None
    if proxies.ndim != 1 or not proxies.size or not ((proxies >= 0) & (proxies < vertices)).all():
        wrong = "proxies"
    elif arrays["covered"].shape != (int(arrays["resolutions"][FIRST_OUTER_SHELL]) ** 2,):
        wrong = "covered"
    if wrong:
        say_wrong("basis radiance", unit, wrong)
        return None
    field = BasisRadianceField(
        center=np.zeros(3, np.float32),
        radius=1.0,
        covered=arrays["covered"],
        **{name: arrays[name] for name in _FIELD_ARRAYS},
    )
    return arrays["basis"], proxies, arrays.get("self_irradiance"), field


def _load(
    key: str, unit: Mesh, what: str, layout: dict, shells: int, vector: tuple[int, ...]
) -> dict[str, np.ndarray] | None:
    """The arrays under a key if they are laid out so, with a field of so many shells, and of this shape."""
    arrays = load_arrays(key)
    if arrays is None:
        return None
    layout = layout | {"resolutions": (np.int32, (shells,)), "surface": (np.float32, (len(unit.vertices), 6))}
    wrong = find_unlike(arrays, layout)
    if wrong is None:
        samples = int((arrays["resolutions"].astype(np.int64) ** 2).sum())
        if not np.isin(arrays["resolutions"], RESOLUTIONS).all():
            wrong = "resolutions"
        else:
            wrong = find_unlike(arrays, {"codes": (np.uint8, (samples, *vector))})
    if wrong is None:
        wrong = min(arrays.keys() - layout.keys() - {"codes"}, default=None)
    if wrong is not None:
        say_wrong(what, unit, wrong)
        return None
    # Another shape that happens to have the same key is no damage.
    return arrays if is_same_shape(arrays["surface"], unit) else None


def say_wrong(what: str, mesh: Mesh, name: str) -> None:
    message = f"the cached {what} of mesh {mesh.name!r} has a wrong {name!r}; it is baked again"
    warnings.warn(message, stacklevel=5)


def find_unlike(arrays: dict[str, np.ndarray], layout: dict[str, tuple[type, tuple[int, ...] | None]]) -> str | None:
    """The name of an array that is missing, not finite, or of another type or shape than laid out, or None.

    An array whose shape is laid out as None may have any.
    """
    for name, (dtype, shape) in layout.items():
        array = arrays.get(name)
        if array is None or array.dtype != dtype or shape not in (None, array.shape):
            return name
        if np.issubdtype(dtype, np.floating) and not np.isfinite(array).all():
            return name
    return None
