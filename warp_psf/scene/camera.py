"""The pinhole camera of a frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Camera:
    """A pinhole camera that looks along its own -z with +y up, as MuJoCo's do.

    position: world position of the pinhole, metres, float64 [3].
    rotation: world_from_camera rotation matrix, float64 [3, 3].
    fovy: vertical field of view, radians.
    """

    position: np.ndarray
    rotation: np.ndarray
    fovy: float
