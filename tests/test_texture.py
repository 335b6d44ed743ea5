"""Textures: how they lie, against MuJoCo's own picture, how they are filtered, and the light that they colour."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from PIL import Image

import warp_psf as psf
from tests.gl_reference import reference_pictures
from warp_psf.scene import texture

# Seen from above and from below; from there, MuJoCo's planes are hazy.
SOLIDS = {
    "box": 'type="box" size=".5 .7 .3"',
    "sphere": 'size=".7"',
    "ellipsoid": 'type="ellipsoid" size=".5 .8 .3"',
    "capsule": 'type="capsule" size=".4 .5"',
    "cylinder": 'type="cylinder" size=".5 .6"',
    "mesh": 'type="mesh" mesh="plain"',
    "mapped mesh": 'type="mesh" mesh="mapped"',
    "height field": 'type="hfield" hfield="hills"',
}
PLANES = {"plane": 'type="plane" size=".8 .6 .1"', "endless": 'type="plane" size="0 0 .1" pos="0 0 -.8"'}
TETRAHEDRON = 'vertex="0 0 .8 .7 0 -.3 -.4 .6 -.3 -.4 -.6 -.3"'
# MuJoCo's picture of a material under nothing but full ambient light is its texture.
UNLIT = """
<mujoco>
  <visual>
    <headlight ambient="1 1 1" diffuse="0 0 0" specular="0 0 0"/>
    <quality numslices="64" numstacks="32" numquads="8" offsamples="0"/>
  </visual>
  <asset>
    {textures}
    <mesh name="plain" {mesh}/>
    <mesh name="mapped" {mesh} texcoord=".5 .1 .9 .8 .1 .9 .3 .2" face="0 1 2 0 2 3 0 3 1 1 3 2"/>
    <hfield name="hills" nrow="4" ncol="4" size=".8 .6 .3 .1" elevation="0 1 0 1 1 0 1 0 0 1 0 1 1 0 1 0"/>
    <material name="cloth" texture="{texture}" texuniform="{uniform}" texrepeat="{repeat}" specular="0"/>
  </asset>
  <worldbody>
    <camera name="above" pos="3.6 -4.5 3.9" xyaxes=".78 .62 0 -.35 .44 .83" fovy="40"/>
    <camera name="below" pos="-3.6 4.5 -3.9" xyaxes="-.78 -.62 0 -.35 .44 .83" fovy="40"/>
    {geoms}
  </worldbody>
</mujoco>
"""
HEIGHT, WIDTH = 320, 480
# Texture, texuniform and texrepeat, which cubes have not.
LOOKS = [("flat", uniform, repeat) for uniform in ("false", "true") for repeat in ("1 1", "3 2")]
LOOKS += [("cube", uniform, "1 1") for uniform in ("false", "true")]


def write_textures(folder: Path) -> str:
    """The elements of a flat and a cube texture whose images look like none of their mirror images."""
    size = 64
    t, s = (np.indices((size, size)) + 0.5) / size
    images = {
        # Repeats without a seam.
        "flat": (
            0.5 + 0.4 * np.cos(2 * np.pi * s),
            0.5 + 0.4 * np.sin(2 * np.pi * s),
            0.5 + 0.3 * np.sin(2 * np.pi * t),
        )
    }
    sides = ("right", "left", "up", "down", "front", "back")
    images |= {side: (0.2 + 0.6 * s, 0.2 + 0.6 * t, np.full_like(s, 0.1 + 0.15 * k)) for k, side in enumerate(sides)}
    for name, channels in images.items():
        pixels = np.round(255 * np.stack(channels, axis=2)).astype(np.uint8)
        # Without a word on their colour space: MuJoCo takes the word for flat textures, and not for cubes.
        Image.fromarray(pixels).save(folder / f"{name}.png")
    cube = " ".join(f'file{side}="{folder / side}.png"' for side in sides)
    return f'''<texture name="flat" type="2d" file="{folder / "flat"}.png"/>
    <texture name="cube" type="cube" {cube}/>'''


def unlit_views(folder: Path) -> list[tuple[str, str, list[str]]]:
    """MJCF, camera and the names of the geoms to compare: side by side, in every look that MuJoCo shows sensibly.

    It shows nothing useful of a cube on an endless plane, which has no size to be uniform over, nor of one on a mesh
    with coordinates, which are none of a cube.
    """
    views = []
    textures = write_textures(folder)
    for kind, uniform, repeat in LOOKS:
        look = {"textures": textures, "texture": kind, "uniform": uniform, "repeat": repeat, "mesh": TETRAHEDRON}
        solids = [name for name in SOLIDS if (kind, name) != ("cube", "mapped mesh")]
        for names in (solids, ["plane"], ["endless"]):
            geoms = ""
            for place, name in enumerate(names):
                body = f'<body pos="{place % 4 * 1.8 - 2.7} {place // 4 * 2.2 - 1.1} 0">'
                spec = (SOLIDS | PLANES)[name]
                geoms += f'{body if names is solids else "<body>"}<geom name="{name}" {spec} material="cloth"/></body>'
            xml = UNLIT.format(**look, geoms=geoms)
            if (kind, uniform, names) != ("cube", "true", ["endless"]):
                views += [(xml, camera, names) for camera in ("above", "below")[: 2 if names is solids else 1]]
    return views


def test_textures_lie_as_in_mujoco_s_picture(tmp_path):
    views = unlit_views(tmp_path)
    references = reference_pictures([(xml, camera, WIDTH, HEIGHT) for xml, camera, _ in views], tmp_path)
    for (xml, camera, names), reference in zip(views, references, strict=True):
        model = mujoco.MjModel.from_xml_string(xml)
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        options = {"environment": None, "bounces": 0, "order": 2, "material_space": "linear"}
        with psf.Renderer(model, HEIGHT, WIDTH, **options) as renderer:
            renderer.update_scene(data, camera)
            layers = renderer.layers()
        for name in names:
            seen = layers["segmentation"][..., 0] == model.geom(name).id
            difference = np.abs(255.0 * layers["albedo"] - reference).max(axis=2)[seen]
            case = name, camera, xml[xml.index("<material") : xml.index("</asset>")]
            # A byte is rounding, on either side; MuJoCo blurs what is oblique, or repeats.
            assert np.median(difference) < 4.0, case
            assert np.percentile(difference, 90) < 12.0, case


def checker(size: int = 8) -> np.ndarray:
    """Black and white squares, uint8 [1, size, size, 3]."""
    y, x = np.indices((size, size))
    return np.repeat(((x + y) % 2 * 255).astype(np.uint8)[None, ..., None], 3, axis=3)


@pytest.mark.parametrize("size", [(8, 8), (5, 7), (1, 6), (9, 2)])
def test_a_pyramid_keeps_the_mean(size):
    colors = np.random.default_rng(1).uniform(0, 1, (1, *size, 3)).astype(np.float32)
    mean = colors.mean(axis=(0, 1, 2))
    while max(colors.shape[1:3]) > 1:
        colors = texture.halve(colors)
        np.testing.assert_allclose(colors.mean(axis=(0, 1, 2)), mean, atol=1e-6)
    np.testing.assert_allclose(colors[0, 0, 0], mean, atol=1e-6)


def test_bytes_survive_decoding():
    levels = np.arange(256, dtype=np.uint8).reshape(1, 16, 16, 1).repeat(3, axis=3)
    for srgb in (True, False):
        np.testing.assert_array_equal(texture.encode(texture.decode(texture.Texture("", levels, srgb)), srgb), levels)


def test_sides_of_a_cube_meet():
    """A smooth function of direction, put on a cube, comes back from it; so no side is turned or mirrored."""
    size = 32

    def smooth(d: np.ndarray) -> np.ndarray:
        return 0.5 + 0.3 * d + 0.1 * d[..., [1, 2, 0]] * d

    step = (np.arange(size) + 0.5) / size * 2.0 - 1.0
    across, down = np.meshgrid(step, step)
    one = np.ones_like(across)
    sides = [
        (one, -down, -across),
        (-one, -down, across),
        (across, one, down),
        (across, -one, -down),
        (across, -down, one),
        (-across, -down, -one),
    ]
    directions = np.stack([np.stack(side, axis=2) for side in sides])
    directions /= np.linalg.norm(directions, axis=3, keepdims=True)
    panorama = texture.cube_to_panorama(smooth(directions).astype(np.float32), 40)
    theta = np.pi * (np.arange(40) + 0.5) / 40
    phi = np.pi * (np.arange(80) + 0.5) / 40
    x, y = np.sin(theta)[:, None] * np.cos(phi), np.sin(theta)[:, None] * np.sin(phi)
    z = np.broadcast_to(np.cos(theta)[:, None], x.shape)
    expected = smooth(np.stack([x, z, -y], axis=2))
    # Half a pixel at the sides' ends, where nothing is beyond, is a hundredth of the function's range.
    np.testing.assert_allclose(panorama, expected, atol=0.03)


TILES = """
<mujoco>
  <statistic extent="20"/>
  <visual><headlight active="0"/></visual>
  <asset>
    <texture name="tiles" type="2d" builtin="checker" rgb1="1 1 1" rgb2="0 0 0" width="64" height="64"/>
    <material name="tiles" texture="tiles" texrepeat="4 4" specular="0"/>
  </asset>
  <worldbody>
    <geom type="plane" size="0 0 1" material="tiles"/>
    <camera name="down" pos=".01 .01 {height}" xyaxes="1 0 0 0 1 0"/>
    <camera name="along" pos="0 0 1" xyaxes="1 0 0 0 .05 1"/>
  </worldbody>
</mujoco>
"""


def albedo(xml: str, camera: str, height: int = 60, width: int = 90) -> np.ndarray:
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with psf.Renderer(model, height, width, bounces=0) as renderer:
        renderer.update_scene(data, camera)
        return renderer.layers()["albedo"]


def test_far_tiles_are_grey_and_near_ones_are_not():
    near = albedo(TILES.format(height=1), "down")[..., 0]
    assert (near < 0.01).mean() == pytest.approx(0.5, abs=0.1)
    assert (near > 0.99).mean() == pytest.approx(0.5, abs=0.1)
    far = albedo(TILES.format(height=400), "down")[..., 0]
    # A pixel covers hundreds of tiles: half of the light, whatever the bytes' encoding says is half.
    np.testing.assert_allclose(far, 0.5, atol=0.02)


def test_tiles_towards_the_horizon_neither_alias_nor_blur_early():
    seen = albedo(TILES.format(height=1), "along")
    rows = seen[..., 0]
    floor = rows[rows.shape[0] // 2 + 6 :]
    # Every row of the floor shows as much black as white.
    np.testing.assert_allclose(floor.mean(axis=1), 0.5, atol=0.12)
    # Most near rows have full contrast, but for those along an edge; a far one, of several tiles a pixel, has none.
    assert np.median(floor[-10:].std(axis=1)) > 0.4
    assert floor[0].std() < 0.2


def test_a_coloured_floor_sends_on_the_colour_of_each_place():
    """Over a floor whose halves are red and green, what bounces onto a ceiling is red over red, green over green."""
    pixels = np.zeros((2, 2, 3), np.uint8)
    pixels[:, 0, 0] = pixels[:, 1, 1] = 255
    xml = """
    <mujoco>
      <visual><headlight active="0"/></visual>
      <asset>
        <texture name="halves" type="2d" builtin="flat" rgb1="1 1 1" width="2" height="2"/>
        <material name="halves" texture="halves" specular="0"/><material name="white" rgba="1 1 1 1" specular="0"/>
      </asset>
      <worldbody>
        <geom type="plane" size="2 2 1" material="halves"/>
        <geom type="box" size="2 2 .05" pos="0 0 1.2" material="white"/>
        <camera name="up" pos="0 0 .2" xyaxes="1 0 0 0 -1 0" fovy="120"/>
        <light type="point" pos="0 0 .6" castshadow="false"/>
      </worldbody>
    </mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    model.tex_data[:12] = pixels.ravel()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with psf.Renderer(model, 60, 60, environment=None) as renderer:
        renderer.update_scene(data, "up")
        layers = renderer.layers()
    points = np.argwhere(layers["depth"] < np.inf)
    assert len(points) == 3600
    indirect = layers["indirect"]
    left, right = indirect[20:40, 5:15].mean(axis=(0, 1)), indirect[20:40, 45:55].mean(axis=(0, 1))
    assert left[0] > 2 * left[1]
    assert right[1] > 2 * right[0]
    assert max(left[2], right[2]) < 1e-3


def test_image_lights_and_skyboxes():
    xml = """
    <mujoco>
      <visual><headlight active="0"/></visual>
      <asset>
        <texture name="sky" type="skybox" builtin="flat" rgb1="1 0 0" rgb2="1 0 0" width="8" height="48"/>
        <texture name="glow" type="cube" builtin="flat" rgb1="0 1 0" rgb2="0 1 0" width="8" height="48"/>
        <material name="white" rgba="1 1 1 1" specular="0"/>
      </asset>
      <worldbody>
        <light type="image" texture="glow" diffuse=".5 .5 .5"/>
        <geom size=".5" material="white"/><camera name="c" pos="0 -3 0" xyaxes="1 0 0 0 0 1"/>
      </worldbody>
    </mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with psf.Renderer(model, 40, 40, environment=None, bounces=0) as renderer:
        renderer.update_scene(data, "c")
        color = renderer.layers()["color"]
    # A furnace of radiance 0.5 in green shows a white ball as green 0.5; behind is the skybox, which lights nothing.
    np.testing.assert_allclose(color[20, 20], [0.0, 0.5, 0.0], atol=5e-3)
    np.testing.assert_allclose(color[0, 0], [1.0, 0.0, 0.0], atol=1e-3)
