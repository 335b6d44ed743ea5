"""Layers as pictures that a screen shows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from warp_psf.film.display import to_display

# What of the golden ratio's fraction is between the hues of neighbouring ids: no few of them look alike.
GOLDEN = 0.618034


def develop(layers: dict[str, np.ndarray], layer: str, exposure: float) -> np.ndarray:
    """The picture of one of the layers of a frame, uint8 [height, width, 3].

    exposure: stops; holds for layers of light. Depth is bright where it is near, normals are colours about grey, and
    each object of the segmentation has a colour of its own.
    """
    values = layers[layer]
    show = _SPECIAL.get(layer)
    return to_display(values, exposure=exposure) if show is None else show(values)


def _show_shares(values: np.ndarray) -> np.ndarray:
    return to_display(values, view="srgb")


def _show_normals(normal: np.ndarray) -> np.ndarray:
    there = (normal != 0.0).any(axis=2, keepdims=True)
    return _to_bytes(np.where(there, 0.5 + 0.5 * normal, 0.0))


def _show_depth(depth: np.ndarray) -> np.ndarray:
    there = np.isfinite(depth)
    near = float(depth[there].min()) if there.any() else 1.0
    with np.errstate(divide="ignore", invalid="ignore"):
        bright = np.where(there, near / depth, 0.0)
    return _to_bytes(np.repeat(bright[..., None], 3, axis=2))


def _show_objects(segmentation: np.ndarray) -> np.ndarray:
    there = segmentation[..., 0] >= 0
    hue = (segmentation[..., 0] + 0.5 * segmentation[..., 1]) * GOLDEN % 1.0
    color = 0.5 + 0.4 * np.cos(2.0 * np.pi * (hue[..., None] - np.array([0.0, 1.0, 2.0]) / 3.0))
    return _to_bytes(np.where(there[..., None], color, 0.0))


def _to_bytes(shares: np.ndarray) -> np.ndarray:
    return np.round(255.0 * np.clip(shares, 0.0, 1.0)).astype(np.uint8)


_SPECIAL: dict[str, Callable[[Any], np.ndarray]] = {
    "albedo": _show_shares,
    "attenuation": _show_shares,
    "normal": _show_normals,
    "depth": _show_depth,
    "segmentation": _show_objects,
}
