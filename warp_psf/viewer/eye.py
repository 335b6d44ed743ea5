"""Where a person looks from: the browser's camera, as this library and MuJoCo have it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from warp_psf.bridge import find_camera, read_camera
from warp_psf.bridge.model import label
from warp_psf.scene.camera import Camera

# Pictures are not drawn longer than this many times their other side: a window that is being closed has no height.
LONGEST = 4.0
# Radians: what looks steeper than this up or down, a 20,000th of a degree, shows its azimuth by its upper side.
STEEPEST = 0.5 * math.pi - 1e-6


@dataclass(frozen=True)
class Eye:
    """A pinhole camera with square pixels and a level horizon.

    position: metres, world. forward, up: unit vectors, world. fovy: vertical field of view, radians. aspect: width of
    the picture by its height.
    """

    position: tuple[float, float, float]
    forward: tuple[float, float, float]
    up: tuple[float, float, float]
    fovy: float
    aspect: float

    def camera(self) -> Camera:
        """The same as a `Camera`."""
        back, up = -np.array(self.forward), np.array(self.up)
        rotation = np.stack((np.cross(up, back), up, back), axis=1)
        return Camera(np.array(self.position), rotation, half_height=math.tan(0.5 * self.fovy))

    def size(self, pixels: int) -> tuple[int, int]:
        """(width, height) of a picture of about so many pixels."""
        height = max(round(math.sqrt(pixels / self.aspect)), 2)
        return max(round(height * self.aspect), 2), height


def eye_of_browser(camera: Any) -> Eye:
    """The eye of a camera of viser's, which looks along its +z with -y up."""
    return _eye(camera.position, _matrix(camera.wxyz), camera.fov, camera.image_width / max(camera.image_height, 1))


def eye_of_camera(camera: Camera, aspect: float) -> Eye:
    """The eye of a pinhole camera of a model; of another camera the nearest there is, at its position."""
    turned = camera.rotation * [1.0, -1.0, -1.0]
    return _eye(camera.position, turned, math.radians(45.0) if camera.orthographic else camera.fovy, aspect)


def free_camera(model: Any, eye: Eye) -> Any:
    """MuJoCo's free camera in an eye's place. Its field of view is the model's `vis.global_.fovy`.

    It has no roll: the eye's horizon is taken for level.
    """
    forward, up = np.array(eye.forward), np.array(eye.up)
    elevation = math.asin(float(np.clip(forward[2], -1.0, 1.0)))
    level = forward if abs(elevation) < STEEPEST else -math.copysign(1.0, elevation) * up
    camera = find_camera(model, -1)
    camera.orthographic = 0
    camera.distance = 1.0
    camera.lookat[:] = np.array(eye.position) + forward
    camera.elevation = math.degrees(elevation)
    camera.azimuth = math.degrees(math.atan2(level[1], level[0]))
    return camera


def _eye(position: Any, rotation: np.ndarray, fovy: float, aspect: float) -> Eye:
    return Eye(
        _three(position),
        _three(rotation[:, 2]),
        _three(-rotation[:, 1]),
        float(fovy),
        # Thousandths: a window that is dragged wider asks for few sizes of pictures.
        round(min(max(float(aspect), 1.0 / LONGEST), LONGEST), 3),
    )


def _three(values: Any) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _matrix(quaternion: Any) -> np.ndarray:
    """The rotation of a unit quaternion, w first, float64 [3, 3]."""
    w, x, y, z = (float(value) for value in quaternion)
    return np.array(
        (
            (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        )
    )


@dataclass(frozen=True, eq=False)
class Viewpoints:
    """Where a model is looked at from.

    cameras: names and cameras, at least one; the first is what people look from first. middle: of what the model has,
    metres, [3]. extent: half of its size, metres.
    """

    cameras: tuple[tuple[str, Camera], ...]
    middle: np.ndarray
    extent: float


def find_viewpoints(model: Any, data: Any, first: int | str | None = None) -> Viewpoints:
    """The viewpoints of a model in a state.

    first: the camera that comes first: its name, its number, -1 for the free camera; its first one without.

    Raises:
        ValueError: there is no such camera.
    """
    numbers = range(model.ncam)
    cameras = [(label(model, "camera", number), read_camera(model, data, number)) for number in numbers]
    cameras.append(("free", read_camera(model, data, -1)))
    if first is not None:
        asked = read_camera(model, data, first)
        cameras.sort(key=lambda pair: (pair[1].position != asked.position).any())
    return Viewpoints(tuple(cameras), np.array(model.stat.center), float(model.stat.extent))
