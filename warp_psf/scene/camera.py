"""The camera of a frame."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

# The eye of an orthographic camera, whose rays are parallel, lies so many times as far back as the camera sees: its
# directions to what is seen are then within a thousandth of a degree or so of parallel, and float32 keeps their digits.
EYE_DISTANCE = 1.0e4


@dataclass(frozen=True)
class Camera:
    """A camera that looks along its own -z with +y up, as MuJoCo's do: a pinhole, or an orthographic one.

    The film's sizes are lengths at unit depth, that is, tangents; those of an orthographic camera are metres.

    Attributes:
        position: world position of the pinhole, or of the middle of an orthographic camera, metres, float64 [3].
        rotation: world_from_camera rotation matrix, float64 [3, 3].
        half_height: half the height of the film.
        half_width: half its width; None takes the width at which pixels are square.
        center: the film's middle (right, up), off the optical axis.
        near, far: depths between which things are seen, metres along the optical axis.
        orthographic: whether all rays are parallel to the optical axis.
    """

    position: np.ndarray
    rotation: np.ndarray
    half_height: float
    half_width: float | None = None
    center: tuple[float, float] = (0.0, 0.0)
    near: float = 0.0
    far: float = 1.0e6
    orthographic: bool = False

    @property
    def eye(self) -> np.ndarray:
        """Where the viewer is whom glossy surfaces reflect to, float64 [3]: far behind an orthographic camera."""
        back = EYE_DISTANCE * self.far if self.orthographic else 0.0
        return self.position + back * self.rotation[:, 2]

    @property
    def world_from_camera(self) -> np.ndarray:
        """The pose, float64 [4, 4]."""
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = self.rotation, self.position
        return pose

    def half_sizes(self, width: int, height: int) -> tuple[float, float]:
        """Half the width and half the height of the film under a picture of width x height pixels."""
        wide = self.half_height * width / height if self.half_width is None else self.half_width
        return wide, self.half_height

    def pixel_size(self, width: int, height: int) -> tuple[float, float]:
        """How wide a pixel of a width x height picture is at depth 0, metres, and how much wider it gets per metre."""
        size = 2.0 * self.half_sizes(width, height)[0] / width
        return (size, 0.0) if self.orthographic else (0.0, size)

    @property
    def fovy(self) -> float:
        """Vertical field of view of a pinhole, radians."""
        return math.atan(self.center[1] + self.half_height) - math.atan(self.center[1] - self.half_height)
