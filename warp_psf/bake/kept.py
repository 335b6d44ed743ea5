"""Baked bodies and the arrays that stand for them in the cache."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

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

_FIELD_ARRAYS = ("center", "resolutions", "codes", "minimum", "step", "covered")
RESOLUTIONS = [2**k for k in range(FINEST_RESOLUTION.bit_length()) if 2**k >= COARSEST_RESOLUTION]


@dataclass(frozen=True)
class BakedBody:
    """What is precomputed of a mesh.

    field: its object occlusion field, or None where visibility has a closed form (boxes, rectangles, spheres).
    transfer: self-visibility times cosine per vertex, on SH, float32 [vertices, coefficients], in the body's frame;
        None for convex bodies, which do not shadow themselves.
    visibility: self-visibility alone (zero below the horizon), likewise.
    """

    field: ShadowField | None
    transfer: np.ndarray | None
    visibility: np.ndarray | None


def save_body(key: str, body: BakedBody) -> None:
    """Keeps a body with a field under a key."""
    field = body.field
    arrays: dict[str, np.ndarray] = {}
    if field is not None:
        arrays |= {
            "center": field.center,
            "radius": np.array(field.radius),
            "resolutions": field.resolutions,
            "codes": field.codes,
            "minimum": field.minimum,
            "step": field.step,
        }
    if body.transfer is not None and body.visibility is not None:
        arrays |= {"transfer": body.transfer, "visibility": body.visibility}
    save_arrays(key, arrays)


def load_body(key: str, mesh: Mesh, order: int, has_transfer: bool) -> BakedBody | None:
    """The body kept under a key, or None when there is none, or (which is said) none that can be used."""
    arrays = load_arrays(key)
    if arrays is None:
        return None
    if wrong := _find_wrong(arrays, sh.coefficient_count(order), len(mesh.vertices) if has_transfer else None):
        warnings.warn(f"the cached field of mesh {mesh.name!r} has a wrong {wrong!r}; it is baked again", stacklevel=3)
        return None
    field = ShadowField(
        center=arrays["center"],
        radius=float(arrays["radius"]),
        resolutions=arrays["resolutions"],
        codes=arrays["codes"],
        minimum=arrays["minimum"],
        step=arrays["step"],
    )
    return BakedBody(field, arrays.get("transfer"), arrays.get("visibility"))


def _find_wrong(arrays: dict[str, np.ndarray], coefficients: int, vertices: int | None) -> str | None:
    """The name of an array that is not as `save_body` writes it, or None; `vertices` is None without a transfer."""
    layout: dict[str, tuple[type, tuple[int, ...]]] = {
        "resolutions": (np.int32, (SHELL_COUNT,)),
        "center": (np.float32, (3,)),
        "radius": (np.float64, ()),
        "minimum": (np.float32, (SHELL_COUNT, coefficients)),
        "step": (np.float32, (SHELL_COUNT, coefficients)),
    }
    if vertices is not None:
        layout |= dict.fromkeys(("transfer", "visibility"), (np.float32, (vertices, coefficients)))
    if wrong := _find_unlike(arrays, layout):
        return wrong
    if not np.isin(arrays["resolutions"], RESOLUTIONS).all():
        return "resolutions"
    if not arrays["radius"] > 0:
        return "radius"
    codes, samples = arrays.get("codes"), int((arrays["resolutions"].astype(np.int64) ** 2).sum())
    if codes is None or codes.dtype != np.uint8 or codes.shape != (samples, coefficients):
        return "codes"
    unexpected = arrays.keys() - layout.keys() - {"codes"}
    return min(unexpected) if unexpected else None


def save_radiance(
    key: str, basis: np.ndarray, proxies: np.ndarray, self_irradiance: np.ndarray | None, field: BasisRadianceField
) -> None:
    """Keeps what `bake_radiance` computes under a key."""
    arrays = {"basis": basis, "proxies": proxies, "radius": np.array(field.radius)}
    arrays |= {name: getattr(field, name) for name in _FIELD_ARRAYS}
    if self_irradiance is not None:
        arrays["self_irradiance"] = self_irradiance
    save_arrays(key, arrays)


def load_radiance(
    key: str, mesh: Mesh, order: int, functions: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, BasisRadianceField] | None:
    """What `save_radiance` kept under a key, or None when there is none, or (which is said) none that can be used."""
    arrays = load_arrays(key)
    if arrays is None:
        return None
    if wrong := _find_wrong_radiance(arrays, mesh, sh.coefficient_count(order), functions):
        message = f"the cached basis radiance of mesh {mesh.name!r} has a wrong {wrong!r}; it is baked again"
        warnings.warn(message, stacklevel=3)
        return None
    field = BasisRadianceField(radius=float(arrays["radius"]), **{name: arrays[name] for name in _FIELD_ARRAYS})
    return arrays["basis"], arrays["proxies"], arrays.get("self_irradiance"), field


def _find_wrong_radiance(arrays: dict[str, np.ndarray], mesh: Mesh, coefficients: int, functions: int) -> str | None:
    """The name of an array that is not as `save_radiance` writes it, or None."""
    vertices = len(mesh.vertices)
    layout: dict[str, tuple[type, tuple[int, ...]]] = {
        "resolutions": (np.int32, (RADIANCE_SHELLS,)),
        "center": (np.float32, (3,)),
        "radius": (np.float64, ()),
        "minimum": (np.float32, (RADIANCE_SHELLS, functions, coefficients)),
        "step": (np.float32, (RADIANCE_SHELLS, functions, coefficients)),
        "basis": (np.float32, (vertices, functions)),
        "proxies": (np.int32, (arrays["proxies"].size if "proxies" in arrays else 0,)),
    }
    if not mesh.convex:
        layout["self_irradiance"] = (np.float32, (vertices, functions))
    if wrong := _find_unlike(arrays, layout):
        return wrong
    if not np.isin(arrays["resolutions"], RESOLUTIONS).all():
        return "resolutions"
    if not arrays["radius"] > 0:
        return "radius"
    proxies, counts = arrays["proxies"], arrays["resolutions"].astype(np.int64) ** 2
    if not proxies.size or not ((proxies >= 0) & (proxies < vertices)).all():
        return "proxies"
    codes = {"codes": (np.uint8, (int(counts.sum()), functions, coefficients))}
    covered = {"covered": (np.float32, (int(counts[FIRST_OUTER_SHELL]),))}
    if wrong := _find_unlike(arrays, codes | covered):
        return wrong
    unexpected = arrays.keys() - layout.keys() - {"codes", "covered"}
    return min(unexpected) if unexpected else None


def _find_unlike(arrays: dict[str, np.ndarray], layout: dict[str, tuple[type, tuple[int, ...]]]) -> str | None:
    """The name of an array that is missing, not finite, or of another type or shape than laid out, or None."""
    for name, (dtype, shape) in layout.items():
        array = arrays.get(name)
        if array is None or array.dtype != dtype or array.shape != shape or not np.isfinite(array).all():
            return name
    return None
