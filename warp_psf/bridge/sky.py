"""What surrounds a model: its skybox, and the environments that its image lights stand for."""

from __future__ import annotations

import mujoco
import numpy as np

from warp_psf.bridge.look import read_texture
from warp_psf.bridge.model import label
from warp_psf.scene.environment import Environment
from warp_psf.scene.texture import cube_to_panorama, decode

# Rows of a panorama per pixel of a cube's side: the middle of a side is as finely resolved as the cube has it.
ROWS_PER_PIXEL = 2
MOST_ROWS = 768


def read_skybox(model: mujoco.MjModel, material_space: str) -> Environment | None:
    """The model's skybox as it stands behind everything, None where it has none. It lights nothing, as in MuJoCo."""
    boxes = [index for index in range(model.ntex) if model.tex_type[index] == mujoco.mjtTexture.mjTEXTURE_SKYBOX]
    if not boxes or model.tex_nchannel[boxes[0]] < 3:
        return None
    return _panorama(model, boxes[0], material_space, np.ones(3))


def read_image_lights(model: mujoco.MjModel, material_space: str) -> list[Environment]:
    """The environments of the active lights of type `image`: their textures, times their diffuse colours.

    An image light without a texture is even light of its colour.
    """
    if not hasattr(mujoco.mjtLightType, "mjLIGHT_IMAGE"):
        return []
    found = []
    for light in range(model.nlight):
        if model.light_type[light] == mujoco.mjtLightType.mjLIGHT_IMAGE and model.light_active[light]:
            color, texture = np.maximum(model.light_diffuse[light], 0.0), int(model.light_texid[light])
            if texture >= 0 and model.tex_nchannel[texture] >= 3:
                found.append(_panorama(model, texture, material_space, color))
            else:
                found.append(Environment(label(model, "light", light), np.full((1, 1, 3), color, np.float32)))
    return found


def _panorama(model: mujoco.MjModel, index: int, material_space: str, color: np.ndarray) -> Environment:
    texture = read_texture(model, index, material_space)
    sides = decode(texture)
    if len(sides) == 1:
        # A flat image is a panorama already, its first row above.
        return Environment(texture.name, sides[0] * color)
    rows = min(MOST_ROWS, ROWS_PER_PIXEL * sides.shape[1])
    return Environment(texture.name, cube_to_panorama(sides, rows) * color)
