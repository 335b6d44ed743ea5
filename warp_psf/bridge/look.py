"""Looks: colours and materials of MJCF as reflectances, lobes and textures."""

from __future__ import annotations

import mujoco
import numpy as np

from warp_psf.bridge.model import label
from warp_psf.scene.material import Material
from warp_psf.scene.texture import Texture

# What a geom without a material has (mjv_initGeom).
DEFAULT_SPECULAR, DEFAULT_SHININESS = 0.5, 0.5
# MuJoCo's classic renderer: exponent of its highlight around the half vector, per unit of shininess.
CLASSIC_EXPONENT = 128.0
# A lobe around the half vector is as wide as one around the mirror direction with a quarter of its exponent.
MIRROR_PER_HALF_VECTOR = 0.25
# What a dielectric reflects of light that falls straight on it (refractive index 1.5), as physically based shading has
# it for every surface that is not metal.
DIELECTRIC = 0.04
# No lobe is narrower than that of this roughness: MuJoCo's 0 would be a mirror.
SMOOTHEST = 0.1
SPACES = ("srgb", "linear")


def make_material(model: mujoco.MjModel, rgba: np.ndarray, material: int, material_space: str) -> Material:
    """The material that stands for the look of a geom of this colour with this material of the model's (-1: none).

    The classic renderer adds specular * cos^(128 shininess) of the angle at the half vector; here that is a Phong lobe
    about the mirror direction of a quarter of that exponent n, with the reflectance 2 specular / (n + 2), which gives
    the highlight of a light straight ahead the same height. Where the material says metallic or roughness, those hold
    instead: of a metal all that it reflects goes through the lobe, in its colour; the exponent at the half vector is
    2/roughness^4 - 2, the Phong lobe that is as wide as the microfacets' slopes. Where the sum of both reflectances
    exceeds 1 both are scaled down. MuJoCo's emission times the colour is the radiance sent out. A texture multiplies
    albedo and emission, not the lobe.

    Raises:
        ValueError: the colour is not finite.
    """
    if not np.isfinite(rgba).all():
        raise ValueError(f"a colour is {np.asarray(rgba).tolist()}; every number of an rgba must be finite")
    specular, shininess, emission, metallic, roughness = DEFAULT_SPECULAR, DEFAULT_SHININESS, 0.0, -1.0, -1.0
    if material >= 0:
        specular, shininess = float(model.mat_specular[material]), float(model.mat_shininess[material])
        emission = float(model.mat_emission[material])
        metallic = float(model.mat_metallic[material]) if hasattr(model, "mat_metallic") else -1.0
        roughness = float(model.mat_roughness[material]) if hasattr(model, "mat_roughness") else -1.0
    color = np.clip(rgba[:3].astype(np.float64), 0.0, 1.0)
    color = _linear(color) if material_space == "srgb" else color
    if metallic >= 0.0 or roughness >= 0.0:
        metal = float(np.clip(metallic, 0.0, 1.0))
        rough = float(np.clip(roughness, SMOOTHEST, 1.0)) if roughness >= 0.0 else 1.0
        exponent = MIRROR_PER_HALF_VECTOR * max(2.0 / rough**4 - 2.0, 0.0)
        lobe = (1.0 - metal) * DIELECTRIC + metal * color
        albedo = (1.0 - metal) * color
    else:
        exponent = MIRROR_PER_HALF_VECTOR * CLASSIC_EXPONENT * max(shininess, 0.0)
        lobe = np.full(3, 2.0 * np.clip(specular, 0.0, 1.0) / (exponent + 2.0))
        albedo = color
    scale = 1.0 / max(1.0, float((albedo + lobe).max()))
    return Material(scale * albedo, scale * lobe, exponent, max(emission, 0.0) * color)


def find_texture(model: mujoco.MjModel, material: int) -> int:
    """The model's texture that colours a material, -1 for none; layers of other roles are left out."""
    if material < 0:
        return -1
    texture = int(model.mat_texid[material, mujoco.mjtTextureRole.mjTEXROLE_RGB])
    if texture < 0:
        texture = int(model.mat_texid[material, mujoco.mjtTextureRole.mjTEXROLE_RGBA])
    return texture if texture >= 0 and model.tex_nchannel[texture] >= 3 else -1


def read_texture(model: mujoco.MjModel, texture: int, material_space: str) -> Texture:
    """A texture of the model's. A cube or skybox whose image is square has that image on all its sides.

    Its bytes are what the texture's `colorspace` says, or where that is left open what `material_space` is.
    """
    spaces = getattr(mujoco, "mjtColorSpace", None)
    srgb = material_space == "srgb"
    if spaces is not None and model.tex_colorspace[texture] != spaces.mjCOLORSPACE_AUTO:
        srgb = model.tex_colorspace[texture] == spaces.mjCOLORSPACE_SRGB
    rows, columns = int(model.tex_height[texture]), int(model.tex_width[texture])
    channels, start = int(model.tex_nchannel[texture]), int(model.tex_adr[texture])
    pixels = model.tex_data[start : start + rows * columns * channels].reshape(rows, columns, channels)[:, :, :3]
    if model.tex_type[texture] == mujoco.mjtTexture.mjTEXTURE_2D:
        sides = pixels[None]
    elif rows == columns:
        sides = np.repeat(pixels[None], 6, axis=0)
    else:
        sides = pixels.reshape(6, columns, columns, 3)
    return Texture(label(model, "texture", texture), np.ascontiguousarray(sides), bool(srgb))


def _linear(encoded: np.ndarray) -> np.ndarray:
    """sRGB values in [0, 1] decoded to linear (IEC 61966-2-1)."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
