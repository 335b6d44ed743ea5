"""Materials: how a surface reflects and emits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Material:
    """A Lambert surface with an optional Phong lobe, which may also shine by itself.

    albedo: diffuse reflectance, linear Rec.709, 3 values in [0, 1].
    specular: reflectance of the normalised Phong lobe (n + 2)/(2 pi) cos^n, linear Rec.709, 3 values in [0, 1].
    exponent: the lobe's n, at least 0.
    emission: radiance that the surface sends out, linear Rec.709, 3 values.
    """

    albedo: np.ndarray
    specular: np.ndarray
    exponent: float
    emission: np.ndarray
