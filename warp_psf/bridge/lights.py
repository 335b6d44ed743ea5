"""Lights: the model's own and its headlight, in their state of a frame."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import mujoco
import numpy as np

from warp_psf.bridge.model import check_data, label
from warp_psf.scene.camera import Camera
from warp_psf.scene.light import AreaLight, DeltaLight
from warp_psf.scene.scene import Scene

# A message lists at most this many bodies: a large model has thousands.
MOST_NAMES = 20
# The index of the light at the camera.
HEADLIGHT = -1
# MJCF's default range, metres. As the classic renderer has no range, only one that somebody chose ends a light.
UNSET_RANGE = 10.0


def read_delta_lights(
    model: mujoco.MjModel, data: mujoco.MjData, scene: Scene, camera: Camera
) -> tuple[DeltaLight, ...]:
    """The scene's delta lights as they are in this state: moved with their bodies, without those that are switched off.

    The headlight sits at `camera` and shines along its view.

    Raises:
        ValueError: `data` is of another model.
    """
    check_data(model, data)
    now = []
    for light in scene.lights:
        if not isinstance(light, DeltaLight):
            continue
        if light.index is None:
            now.append(light)
        elif light.index == HEADLIGHT:
            now.append(replace(light, position=camera.position, direction=-camera.rotation[:, 2]))
        elif model.light_active[light.index]:
            position, direction = data.light_xpos[light.index], data.light_xdir[light.index]
            now.append(replace(light, position=position, direction=direction))
    return tuple(now)


def model_lights_of(model: mujoco.MjModel) -> list[DeltaLight]:
    """The model's lights, in its initial state, and its headlight."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_camlight(model, data)
    lights = []
    for index in range(model.nlight):
        kind = _light_kind(model, index)
        if kind is None:
            continue
        place = {"position": data.light_xpos[index], "direction": data.light_xdir[index]}
        colors = _light_colors(model.light_diffuse[index], model.light_specular[index], model.light_ambient[index])
        limits = {}
        if kind != "directional":
            limits = {"attenuation": model.light_attenuation[index], "range": _light_range(model, index)}
        if kind == "spot":
            limits |= {"cutoff": np.radians(model.light_cutoff[index]), "exponent": model.light_exponent[index]}
        bulb = {"radius": model.light_bulbradius[index], "castshadow": bool(model.light_castshadow[index])}
        lights.append(DeltaLight(label(model, "light", index), kind, **place, **colors, **limits, **bulb, index=index))
    head = model.vis.headlight
    # 2 is "auto", which MuJoCo's own renderer takes for on.
    if head.active:
        colors = _light_colors(head.diffuse, head.specular, head.ambient)
        place = {"position": np.zeros(3), "direction": np.array((0.0, 0.0, -1.0))}
        lights.append(DeltaLight("headlight", "directional", **place, **colors, castshadow=False, index=HEADLIGHT))
    return lights


def body_of_light(model: mujoco.MjModel, light: AreaLight) -> int:
    """The body that a light hangs on, 0 for the world; raises ValueError if the model lacks it."""
    if light.body is None:
        return 0
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, light.body)
    if body < 0:
        names = ", ".join(label(model, "body", index) for index in range(min(model.nbody, MOST_NAMES)))
        raise ValueError(f"light {light.name!r} hangs on body {light.body!r}, which the model lacks; it has {names}")
    return body


def _light_colors(diffuse, specular, ambient) -> dict[str, np.ndarray]:
    # MuJoCo accepts negative colours, and its picture clamps them.
    return {"diffuse": np.maximum(diffuse, 0), "specular": np.maximum(specular, 0), "ambient": np.maximum(ambient, 0)}


def _light_kind(model: mujoco.MjModel, index: int) -> Literal["directional", "spot", "point"] | None:
    """The kind of delta light; None for an image light, which is an environment."""
    if not hasattr(model, "light_type"):
        # The first MuJoCo 3.3 tells two kinds apart.
        return "directional" if model.light_directional[index] else "spot"
    kinds = mujoco.mjtLightType
    known = {kinds.mjLIGHT_DIRECTIONAL: "directional", kinds.mjLIGHT_SPOT: "spot", kinds.mjLIGHT_POINT: "point"}
    return known.get(kinds(model.light_type[index]))


def _light_range(model: mujoco.MjModel, index: int) -> float:
    limit = float(model.light_range[index]) if hasattr(model, "light_range") else UNSET_RANGE
    return np.inf if limit == UNSET_RANGE else max(limit, 0.0)
