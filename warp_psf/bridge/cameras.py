"""Cameras: the view that MuJoCo's own renderer would have."""

from __future__ import annotations

import operator
from typing import SupportsIndex

import mujoco
import numpy as np

from warp_psf.bridge.model import check_data, label
from warp_psf.scene.camera import Camera


def read_camera(model: mujoco.MjModel, data: mujoco.MjData, camera: int | str | mujoco.MjvCamera = -1) -> Camera:
    """The camera that `mujoco.Renderer` would use: an id, a name, -1 for the free camera, or an MjvCamera.

    Raises:
        ValueError: there is no such camera, or `data` is of another model.
        TypeError: `camera` is none of these.
    """
    check_data(model, data)
    chosen = find_camera(model, camera)
    # MuJoCo itself computes the view: this object holds no more than its two cameras, and needs no OpenGL.
    view = mujoco.MjvScene()
    mujoco.mjv_updateCamera(model, data, chosen, view)
    left, right = view.camera[0], view.camera[1]
    position = 0.5 * (np.array(left.pos, dtype=np.float64) + np.array(right.pos, dtype=np.float64))
    back = -np.array(left.forward, dtype=np.float64)
    back /= np.linalg.norm(back)
    across = np.cross(np.array(left.up, dtype=np.float64), back)
    across /= np.linalg.norm(across)
    rotation = np.stack((across, np.cross(back, across), back), axis=1)
    # The frustum of a pinhole is given on the near plane, that of an orthographic camera in metres.
    depth = 1.0 if left.orthographic else left.frustum_near
    return Camera(
        position,
        rotation,
        half_height=0.5 * (left.frustum_top - left.frustum_bottom) / depth,
        # Half the width, whatever its name says, and 0 where the picture's shape decides.
        half_width=left.frustum_width / depth if left.frustum_width else None,
        center=(left.frustum_center / depth, 0.5 * (left.frustum_top + left.frustum_bottom) / depth),
        near=float(left.frustum_near),
        far=float(left.frustum_far),
        orthographic=bool(left.orthographic),
    )


def find_camera(model: mujoco.MjModel, camera: int | str | mujoco.MjvCamera) -> mujoco.MjvCamera:
    """The MjvCamera that an id, a name or an MjvCamera means, checked against the model."""
    kinds = mujoco.mjtCamera
    chosen = camera
    if not isinstance(chosen, mujoco.MjvCamera):
        chosen = mujoco.MjvCamera()
        mujoco.mjv_defaultFreeCamera(model, chosen)
        named = isinstance(camera, str)
        if not named and not isinstance(camera, SupportsIndex):
            raise TypeError(f"camera {camera!r} is neither an id nor a name nor an MjvCamera; {_known_cameras(model)}")
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
