"""What MuJoCo's materials and textures look like: metals, image lights, boxes of one picture, parts and marks."""

from __future__ import annotations

import io

import mujoco
import numpy as np
import pytest
from PIL import Image

import warp_psf as psf
from tests.oracles import make_model
from warp_psf import bridge
from warp_psf.bridge import entities
from warp_psf.bridge.look import make_material

BALL = '<geom size=".5" material="white"/><camera name="front" pos="0 -3 0" xyaxes="1 0 0 0 0 1"/>'
# A tetrahedron whose corners say where they lie on a texture, and one whose corners do not.
GIVEN = (
    '<mesh name="given" vertex="0 0 0  1 0 0  0 1 0  0 0 1" texcoord="0 0  1 0  0 1  1 1" '
    'face="0 2 1  0 1 3  0 3 2  1 2 3"/>'
)
BARE = '<mesh name="bare" vertex="0 0 0  -1 0 0  0 -1 0  0 0 -1" scale=".9 .9 .9"/>'
CHECKER = '<texture name="checker" type="2d" builtin="checker" width="8" height="8" rgb1="1 0 0" rgb2="0 1 0"/>'


def png(pixels: np.ndarray) -> bytes:
    encoded = io.BytesIO()
    Image.fromarray(pixels).save(encoded, "PNG")
    return encoded.getvalue()


def start(xml: str, assets: dict[str, bytes] | None = None) -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = mujoco.MjModel.from_xml_string(xml, assets)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def layers_of(model: mujoco.MjModel, data: mujoco.MjData, camera: str = "front", **options) -> dict[str, np.ndarray]:
    with psf.Renderer(model, 48, 48, **({"environment": None, "bounces": 0} | options)) as renderer:
        renderer.update_scene(data, camera)
        return renderer.layers()


def material_of(attributes: str) -> tuple[mujoco.MjModel, int]:
    model, _ = start(
        f'<mujoco><asset><material name="m" {attributes}/></asset>'
        '<worldbody><geom size="1" material="m"/></worldbody></mujoco>'
    )
    return model, model.material("m").id


# Metals


def test_a_metal_s_light_all_goes_through_its_lobe_in_its_colour():
    model, index = material_of('metallic="1" roughness="0.5"')
    color = np.array([0.9, 0.6, 0.2, 1.0])
    metal = make_material(model, color, index, "linear")
    np.testing.assert_array_equal(metal.albedo, 0.0)
    np.testing.assert_allclose(metal.specular, color[:3])
    # A quarter of 2 / 0.5^4 - 2 at the half vector.
    assert metal.exponent == pytest.approx(7.5)


def test_what_is_no_metal_reflects_four_hundredths_without_colour():
    model, index = material_of('metallic="0"')
    plastic = make_material(model, np.array([0.9, 0.6, 0.2, 1.0]), index, "linear")
    np.testing.assert_allclose(plastic.albedo, [0.9, 0.6, 0.2])
    np.testing.assert_allclose(plastic.specular, 0.04)
    assert plastic.exponent == 0.0  # without a roughness it is as rough as can be
    # White would send out 1.04 of what comes in.
    white = make_material(model, np.ones(4), index, "linear")
    np.testing.assert_allclose(white.albedo + white.specular, 1.0)


def test_smoother_is_sharper_down_to_a_bound():
    exponents = []
    for roughness in (1.0, 0.6, 0.3, 0.0):
        model, index = material_of(f'metallic="1" roughness="{roughness}"')
        exponents.append(make_material(model, np.ones(4), index, "linear").exponent)
    assert exponents[0] == 0.0
    assert exponents == sorted(exponents) and np.isfinite(exponents).all()


def test_gold_in_even_light_has_its_own_colour():
    """A furnace: where radiance is 1 all around, a reflectance is the radiance that is seen."""
    header = '<asset><material name="gold" rgba="1 .8 .3 1" metallic="1" roughness=".6"/></asset>'
    model, data = make_model(BALL.replace("white", "gold"), header)
    color = layers_of(model, data, environment=np.ones((4, 8, 3)), material_space="linear")["color"]
    # Seen head on, the lobe lies above the surface but for 0.003 of it; even light is one coefficient, held exactly.
    np.testing.assert_allclose(color[24, 24], [1.0, 0.8, 0.3], atol=5e-3)


# Image lights and boxes


def test_an_image_light_without_a_picture_is_even_light():
    model, data = make_model('<light type="image" diffuse=".2 .4 .6"/>' + BALL)
    # A furnace again, and the environment stays behind the ball.
    color = layers_of(model, data)["color"]
    np.testing.assert_allclose(color[24, 24], [0.2, 0.4, 0.6], atol=2e-3)


def test_a_flat_picture_is_a_panorama_whose_first_row_is_above():
    pixels = np.zeros((8, 16, 3), np.uint8)
    pixels[:4, :, 0] = 255
    pixels[4:, :, 1] = 255
    xml = """
    <mujoco>
      <visual><headlight active="0"/></visual>
      <asset>
        <texture name="halves" type="2d" file="halves.png"/>
        <material name="white" rgba="1 1 1 1" specular="0"/>
      </asset>
      <worldbody>
        <light type="image" texture="halves" diffuse=".5 .5 .5"/>
        <geom type="box" size=".5 .5 .01" material="white"/>
        <camera name="above" pos="0 0 2" xyaxes="1 0 0 0 1 0"/>
        <camera name="below" pos="0 0 -2" xyaxes="1 0 0 0 -1 0"/>
      </worldbody>
    </mujoco>"""
    model, data = start(xml, {"halves.png": png(pixels)})
    for camera, expected in (("above", (0.5, 0.0, 0.0)), ("below", (0.0, 0.5, 0.0))):
        # A half space of radiance 0.5: an even one is odd bands and a constant, which four orders hold to 0.01.
        np.testing.assert_allclose(layers_of(model, data, camera)["color"][24, 24], expected, atol=0.02)


def test_a_box_of_one_square_picture_has_it_on_every_side():
    pixels = np.zeros((16, 16, 3), np.uint8)
    pixels[4:12, 4:12] = (255, 0, 0)
    pixels[:2, :] = (0, 0, 255)
    axes = {
        "east": "0 -1 0 0 0 1",
        "west": "0 1 0 0 0 1",
        "north": "1 0 0 0 0 1",
        "south": "-1 0 0 0 0 1",
        "up": "1 0 0 0 -1 0",
        "down": "1 0 0 0 1 0",
    }
    cameras = "".join(f'<camera name="{name}" xyaxes="{xyaxes}" fovy="40"/>' for name, xyaxes in axes.items())
    model, data = start(
        '<mujoco><asset><texture name="sky" type="skybox" file="sky.png"/></asset>'
        f'<worldbody>{cameras}<geom size=".1" pos="9 9 9"/></worldbody></mujoco>',
        {"sky.png": png(pixels)},
    )
    assert model.tex_height[0] == model.tex_width[0] == 16  # MuJoCo keeps one side, not six
    # 20 degrees around the middle of a side are half of it: red, and no side has anything else there.
    for camera in axes:
        middle = layers_of(model, data, camera)["color"][16:32, 16:32]
        np.testing.assert_allclose(middle, np.broadcast_to([1.0, 0.0, 0.0], middle.shape), atol=1e-3)


# Textured parts and marks


def test_a_body_of_textured_and_plain_meshes_looks_like_them_apart(monkeypatch):
    model, data = start(
        f'<mujoco><asset>{GIVEN}{BARE}{CHECKER}<material name="tiles" texture="checker"/>'
        '<material name="plain" rgba="0 0 1 1"/></asset><worldbody>'
        '<body><geom name="first" type="mesh" mesh="given" material="tiles"/>'
        '<geom name="second" type="mesh" mesh="bare" material="plain"/></body>'
        '<camera name="front" pos="2 -3 2" xyaxes="3 2 0 -2 3 5"/></worldbody></mujoco>'
    )
    together = layers_of(model, data)
    scene = bridge.build_scene(model)
    assert [len(entity.parts) for entity in scene.entities] == [2]
    monkeypatch.setattr(entities, "group_geoms", lambda model, shown: [(geom,) for geom in shown.geoms])
    assert [len(entity.parts) for entity in bridge.build_scene(model).entities] == [1, 1]
    apart = layers_of(model, data)
    same = (together["segmentation"] == apart["segmentation"]).all(axis=2)
    assert same.mean() > 0.995
    shown = same & (apart["segmentation"][..., 0] == model.geom("first").id)
    red, green = (apart["albedo"][shown][:, channel] > 0.5 for channel in (0, 1))
    assert min(red.sum(), green.sum()) > 20
    # Texture coordinates rounded in the one frame or in the other: tiles' edges move by less than a pixel.
    assert (np.abs(together["albedo"] - apart["albedo"])[same].max(axis=1) > 0.02).mean() < 0.01


def test_a_texture_lies_on_a_mark_as_on_a_geom():
    albedos = []
    for kind in ("geom", "site"):
        model, data = start(
            f'<mujoco><asset>{CHECKER}<material name="tiles" texture="checker" specular="0"/></asset><worldbody>'
            f'<{kind} type="box" size=".5 .5 .5" euler="20 0 30" material="tiles"/>'
            '<camera name="front" pos="0 -3 0" xyaxes="1 0 0 0 0 1"/></worldbody></mujoco>'
        )
        albedos.append(layers_of(model, data)["albedo"])
    of_geom, of_site = albedos
    assert (of_geom[..., 0] > 0.5).sum() > 50 and (of_geom[..., 1] > 0.5).sum() > 50
    np.testing.assert_allclose(of_site, of_geom, atol=1e-5)
