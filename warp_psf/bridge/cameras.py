"""Cameras: the view that MuJoCo's own renderer would have."""

from __future__ import annotations

import operator
import warnings

import mujoco
import numpy as np

from warp_psf.bridge.model import check_data, label
from warp_psf.scene.camera import Camera

# A camera whose image is shifted by more than this part of its height is warned about.
CENTERED = 1e-4


def read_camera(model: mujoco.MjModel, data: mujoco.MjData, camera: int | str | mujoco.MjvCamera = -1) -> Camera:
    """The pinhole camera that `mujoco.Renderer` would use: an id, a name, -1 for the free camera, or an MjvCamera.

    Raises:
        ValueError: there is no such camera, it is orthographic, or `data` is of another model.
    """
    check_data(model, data)
    chosen = _find_camera(model, camera)
    # MuJoCo itself computes the view: this object holds no more than its two cameras, and needs no OpenGL.
    view = mujoco.MjvScene()
    mujoco.mjv_updateCamera(model, data, chosen, view)
    left, right = view.camera[0], view.camera[1]
    if left.orthographic:
        raise ValueError(f"camera {_camera_name(model, chosen)} is orthographic; only perspective cameras are drawn")
    height = left.frustum_top - left.frustum_bottom
    shift = max(abs(left.frustum_top + left.frustum_bottom), abs(2.0 * left.frustum_center))
    if shift > CENTERED * height:
        warnings.warn(f"camera {_camera_name(model, chosen)}: its shifted image is drawn centred", stacklevel=2)
    position = 0.5 * (np.array(left.pos, dtype=np.float64) + np.array(right.pos, dtype=np.float64))
    back = -np.array(left.forward, dtype=np.float64)
    back /= np.linalg.norm(back)
    across = np.cross(np.array(left.up, dtype=np.float64), back)
    across /= np.linalg.norm(across)
    rotation = np.stack((across, np.cross(back, across), back), axis=1)
    return Camera(position, rotation, float(2.0 * np.arctan(0.5 * height / left.frustum_near)))


def _find_camera(model: mujoco.MjModel, camera: int | str | mujoco.MjvCamera) -> mujoco.MjvCamera:
    """The MjvCamera that an id, a name or an MjvCamera means, checked against the model."""
    kinds = mujoco.mjtCamera
    chosen = camera
    if not isinstance(chosen, mujoco.MjvCamera):
        chosen = mujoco.MjvCamera()
        mujoco.mjv_defaultFreeCamera(model, chosen)
        named = isinstance(camera, str)
        index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, camera) if named else operator.index(camera)
        if named or index != -1:
            chosen.type, chosen.fixedcamid = kinds.mjCAMERA_FIXED, index
    if chosen.type == kinds.mjCAMERA_USER:
        raise ValueError("the MjvCamera is of type mjCAMERA_USER, which has no pose; choose free, tracking or fixed")
    if chosen.type == kinds.mjCAMERA_TRACKING and not 0 <= chosen.trackbodyid < model.nbody:
        raise ValueError(f"the MjvCamera tracks body {chosen.trackbodyid}; the model has 0 to {model.nbody - 1}")
    if chosen.type == kinds.mjCAMERA_FIXED and not 0 <= chosen.fixedcamid < model.ncam:
        asked = chosen.fixedcamid if isinstance(camera, mujoco.MjvCamera) else repr(camera)
        raise ValueError(f"camera {asked} does not exist; {_known_cameras(model)}")
    return chosen


def _known_cameras(model: mujoco.MjModel) -> str:
    names = ", ".join(label(model, "camera", index) for index in range(model.ncam))
    return f"the model has {names}, and -1 is the free camera" if names else "the model has only -1, the free one"


def _camera_name(model: mujoco.MjModel, camera: mujoco.MjvCamera) -> str:
    return label(model, "camera", camera.fixedcamid) if camera.type == mujoco.mjtCamera.mjCAMERA_FIXED else "free"
