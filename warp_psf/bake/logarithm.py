"""Log shadow fields: the logarithm of the visibility that a body leaves, so that occluders are added."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from warp_psf.bake.adapt import ERROR_THRESHOLD, reduce_shell
from warp_psf.bake.body import BAKE_VERSION
from warp_psf.bake.kept import BakedBody, load_body, save_body
from warp_psf.bake.shape import shape_key, unit_shape
from warp_psf.basis import sh, sh_exp
from warp_psf.field.shells import ShadowField, quantise
from warp_psf.scene.mesh import Mesh

# Raised whenever the same field would give other logarithms.
LOGARITHM_VERSION = 1
# Vectors whose matrices are decomposed at once: they take up to 20 MB.
CHUNK = 512


def bake_logarithm(mesh: Mesh, field: ShadowField, *, use_cache: bool = True) -> ShadowField:
    """The log shadow field of a mesh, from its occlusion field or from the cache on disk.

    It has the samples of the occlusion field, but for shells whose logarithms vary less and need fewer.
    """
    unit = unit_shape(mesh)
    settings = {"bake": BAKE_VERSION, "logarithm": LOGARITHM_VERSION, "kind": "logarithm", "order": field.order}
    key = shape_key(settings | {"closed": mesh.closed, "samples": len(field.codes)}, unit)
    kept = load_body(key, unit, field.order, has_transfer=False) if use_cache else None
    if kept is not None and kept.field is not None:
        return replace(kept.field, center=field.center, radius=field.radius, logarithm=True)
    found = take_logarithm(field)
    if use_cache:
        save_body(key, unit, BakedBody(found, None, None))
    return found


def take_logarithm(field: ShadowField) -> ShadowField:
    """log_*(1 - coverage) at every sample (Ren 2006, Eq. 30), reduced (Tamura 2006, section 4) and quantised again."""
    visible = sh_exp.one(field.order) - field.dequantised().astype(np.float64)
    # One chunk after the other: decompositions side by side contend for the linear algebra's own threads.
    chunks = np.array_split(visible, -(-len(visible) // CHUNK))
    logarithms = np.concatenate([sh_exp.logarithm(chunk) for chunk in chunks]).astype(np.float32)
    ends = np.cumsum(field.resolutions.astype(np.int64) ** 2)
    shells = [
        shell.reshape(resolution, resolution, sh.coefficient_count(field.order))
        for shell, resolution in zip(np.split(logarithms, ends[:-1]), field.resolutions, strict=True)
    ]
    # The error of a visibility g is that of its logarithm times g, which is at most 1.
    reduced = [reduce_shell(shell, ERROR_THRESHOLD) for shell in shells]
    return replace(quantise(field.center, field.radius, reduced), logarithm=True)
