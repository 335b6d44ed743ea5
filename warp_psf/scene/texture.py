"""Textures: images on surfaces, flat or on the six sides of a cube."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Texture:
    """An image that multiplies the albedo of a surface.

    name: what messages call it.
    pixels: uint8 [sides, rows, columns, 3]; one side for a flat texture, six for a cube: +x, -x, +y, -y, +z, -z, each
        as OpenGL's cube maps have them. Row 0 of a flat one lies at t = 0.
    srgb: whether the bytes are sRGB; otherwise they are linear.
    """

    name: str
    pixels: np.ndarray
    srgb: bool
