"""What MuJoCo's visual options show, and what a script may change in a model while it is rendered."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

import warp_psf as psf
from warp_psf import bridge

GEOM, SITE = int(mujoco.mjtObj.mjOBJ_GEOM), int(mujoco.mjtObj.mjOBJ_SITE)
FLAG = mujoco.mjtVisFlag
MODEL = """
<mujoco>
  <visual><map alpha=".25"/></visual>
  <asset><material name="paint" rgba=".1 .2 .3 .5"/></asset>
  <worldbody>
    <camera name="front" pos="0 -3 1" xyaxes="1 0 0 0 .3 1"/>
    <geom name="floor" type="plane" size="5 5 .1"/>
    <geom name="post" type="cylinder" size=".1 .5" pos="1 0 .5" material="paint"/>
    <site name="mark" type="box" size=".1 .1 .1" pos="-1 0 .3" rgba="0 1 0 1"/>
    <site name="secret" type="box" size=".1 .1 .1" pos="-1 0 1" group="4"/>
    <body name="moving" pos="0 0 .5">
      <freejoint/>
      <geom name="ball" size=".3" rgba=".8 .2 .1 1"/>
      <geom name="hull" size=".32" group="3"/>
      <geom name="ghost" size=".5" rgba="1 1 1 0"/>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(MODEL)


@pytest.fixture
def data(model) -> mujoco.MjData:
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data


def make_option(**changes) -> mujoco.MjvOption:
    """geomgroup, sitegroup: group -> shown; flags: flag -> on."""
    option = mujoco.MjvOption()
    for name, values in changes.items():
        for index, on in values.items():
            getattr(option, name)[index] = on
    return option


OPTIONS = {
    "default": make_option(),
    "collision shapes": make_option(geomgroup={3: 1}),
    "no visual group": make_option(geomgroup={0: 0}),
    "every site": make_option(sitegroup={4: 1}),
    "no sites": make_option(sitegroup={0: 0}),
    "see-through": make_option(flags={FLAG.mjVIS_TRANSPARENT: 1}),
    "moving only": make_option(flags={FLAG.mjVIS_STATIC: 0}),
}


@pytest.mark.parametrize("name", OPTIONS)
def test_what_is_shown_is_what_mujoco_shows(model, data, name):
    view = mujoco.MjvScene(model, maxgeom=100)
    camera = mujoco.MjvCamera()
    everything = mujoco.mjtCatBit.mjCAT_ALL.value
    mujoco.mjv_updateScene(model, data, OPTIONS[name], None, camera, everything, view)
    theirs = {(geom.objtype, geom.objid): geom.rgba[3] for geom in view.geoms[: view.ngeom]}
    scene = bridge.build_scene(model, option=OPTIONS[name])
    ours = {(entity.parts[0].object_type, entity.parts[0].object_id): entity.opacity for entity in scene.entities}
    assert ours.keys() == theirs.keys()
    for key, opacity in ours.items():
        assert opacity == pytest.approx(theirs[key], rel=1e-6)


def shown(renderer: psf.Renderer) -> set[tuple[int, int]]:
    """Types and ids of what is in the picture."""
    found = renderer.layers()["segmentation"].reshape(-1, 2)
    return {(int(kind), int(index)) for index, kind in found if kind >= 0}


def test_options_are_chosen_frame_by_frame(model, data):
    ball, hull, mark = (GEOM, model.geom("ball").id), (GEOM, model.geom("hull").id), (SITE, model.site("mark").id)
    with psf.Renderer(model, 60, 100, bounces=0) as renderer:
        renderer.update_scene(data, "front")
        assert {ball, mark} <= shown(renderer)
        before = renderer.render()
        renderer.update_scene(data, "front", make_option(geomgroup={3: 1}, sitegroup={0: 0}))
        # The hull is around the ball.
        assert hull in shown(renderer)
        assert not {ball, mark} & shown(renderer)
        renderer.update_scene(data, "front")
        np.testing.assert_array_equal(renderer.render(), before)


def test_sites_take_no_light(model, data):
    without = make_option(sitegroup={0: 0})
    with psf.Renderer(model, 60, 100) as renderer:
        renderer.update_scene(data, "front")
        marked, seen = renderer.layers()["color"], renderer.layers()["segmentation"]
        renderer.update_scene(data, "front", without)
        bare = renderer.layers()["color"]
    mark = seen[..., 1] == SITE
    assert mark.sum() > 20
    # Pixels at the mark's rim show some of it.
    near = np.zeros_like(mark)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            near |= np.roll(mark, (dy, dx), axis=(0, 1))
    # Where no mark is seen, only the pixels that are shaded, and between which is interpolated, may differ.
    np.testing.assert_allclose(marked[~near], bare[~near], rtol=0.02)


def test_colours_and_sizes_may_change_while_rendering():
    model = mujoco.MjModel.from_xml_string(MODEL)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    ball = model.geom("ball").id
    with psf.Renderer(model, 60, 100, bounces=0) as renderer:
        renderer.update_scene(data, "front")
        pixels = renderer.layers()["segmentation"][..., 0] == ball
        model.geom_rgba[ball] = 0.0, 0.0, 1.0, 1.0
        renderer.update_scene(data, "front")
        blue = renderer.layers()["albedo"][pixels].mean(axis=0)
        assert blue[2] > 10 * blue[0]
        model.geom_size[ball, 0] = 0.15
        renderer.update_scene(data, "front")
        smaller = renderer.layers()["segmentation"][..., 0] == ball
        assert 0.15 < smaller.sum() / pixels.sum() < 0.35  # a quarter, at the rim a pixel more or less
        # Nothing has changed: nothing is set up anew.
        stage = renderer._stage
        renderer.update_scene(data, "front")
        assert renderer._stage is stage


def test_a_body_stops_light_in_proportion_to_its_opacity():
    """The floor under a ball gets, at half the opacity, the mean of what it gets with and without the ball."""
    xml = """
    <mujoco><worldbody><camera name="down" pos="0 0 6" xyaxes="1 0 0 0 1 0" fovy="35"/>
    <light type="directional" dir=".8 0 -1" diffuse="1 1 1" bulbradius="0"/>
    <geom name="floor" type="plane" size="5 5 .1"/><geom name="ball" size=".4" pos="0 0 1" rgba="1 1 1 {}"/>
    </worldbody></mujoco>"""
    direct = []
    for alpha in (1.0, 0.5, 0.0):
        model = mujoco.MjModel.from_xml_string(xml.format(alpha))
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        with psf.Renderer(model, 60, 60, bounces=0) as renderer:
            renderer.update_scene(data, "down")
            layers = renderer.layers()
        other = layers["segmentation"][..., 0] != 0
        for axis in (0, 1):  # pixels at the ball's rim show some of it
            other |= np.roll(other, 1, axis) | np.roll(other, -1, axis)
        direct.append((layers["direct"], ~other))
    seen = direct[0][1] & direct[1][1]
    whole, half, none = (values[seen] for values, _ in direct)
    assert (none - whole).max() > 0.2 * none.max()
    # Lattice pixels between shaded ones are interpolated to a hundredth.
    np.testing.assert_allclose(half, 0.5 * (whole + none), rtol=0.02, atol=0.01)


def test_wrong_options(model, data):
    with pytest.raises(ValueError, match="max_geom is 0"):
        psf.Renderer(model, 4, 4, 0)
    renderer = psf.Renderer(model, 4, 4, bounces=0)
    with pytest.raises(TypeError, match=r"scene_option is a str; give a mujoco\.MjvOption"):
        renderer.update_scene(data, "front", "all")
