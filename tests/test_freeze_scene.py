"""A MuJoCo state as a still scene: cloths as they hang, boxes with few faces, and textures as their mean."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

import warp_psf as psf
from warp_psf.scene.still import StillScene

CLOTH = """
<mujoco>
  <option timestep="0.005"/>
  <asset>
    <texture name="checker" type="2d" builtin="checker" width="8" height="8" rgb1="1 1 1" rgb2="0 0 0"/>
    <material name="tiles" texture="checker" specular="0"/>
    <material name="plain" rgba="1 1 1 1" specular="0"/>
  </asset>
  <worldbody>
    <camera name="front" pos="0 -3 1" xyaxes="1 0 0 0 0 1"/>
    <geom name="block" type="box" size="1 2 .1" pos="0 0 -.1" material="MATERIAL"/>
    <body name="cloth" pos="0 0 1">
      <flexcomp name="cloth" type="grid" count="5 5 1" spacing=".1 .1 .1" mass="1" radius=".005" dim="2" rgba="0 1 0 1">
        <contact selfcollide="none"/>
      </flexcomp>
    </body>
  </worldbody>
</mujoco>
"""


def start(material: str = "plain") -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = mujoco.MjModel.from_xml_string(CLOTH.replace("MATERIAL", material))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def green_vertices(still: StillScene) -> np.ndarray:
    faces = still.faces[(still.albedo[:, 1] > 0.5) & (still.albedo[:, 0] < 0.1)]
    return still.vertices[np.unique(faces)]


# `meet_deforming` moves the flexes of the data that it is given, and `freeze_scene` gives it its caller's.


def test_a_cloth_is_frozen_where_it_has_fallen_to():
    model, data = start()
    for _ in range(20):
        mujoco.mj_step(model, data)
    mujoco.mj_forward(model, data)
    fallen = green_vertices(psf.freeze_scene(model, data))
    corners = np.array([joint.xpos for joint in map(data.body, range(2, model.nbody))])
    # All 25 points fall freely, as one sheet; its two faces and its rim are its radius off the points.
    assert np.ptp(corners[:, 2]) < 1e-6 and corners[0, 2] < 0.999
    np.testing.assert_allclose(fallen[:, 2], corners[0, 2], atol=0.005 + 1e-6)
    reach = 0.2 + 0.005 + 1e-6
    assert np.abs(fallen[:, :2]).max() == pytest.approx(0.2, abs=0.005 + 1e-6) and np.abs(fallen[:, :2]).max() <= reach


def test_freezing_leaves_the_state_alone():
    model, data = start()
    before = data.flexvert_xpos.copy()
    psf.freeze_scene(model, data)
    np.testing.assert_array_equal(data.flexvert_xpos, before)


def test_a_hidden_cloth_is_not_frozen():
    model, data = start()
    option = mujoco.MjvOption()
    option.flexgroup[:] = 0
    assert len(green_vertices(psf.freeze_scene(model, data))) > 0
    assert len(green_vertices(psf.freeze_scene(model, data, scene_option=option))) == 0


@pytest.mark.parametrize(("material", "albedo"), [("plain", 1.0), ("tiles", 0.5)])
def test_a_texture_counts_with_its_mean(material, albedo):
    still = psf.freeze_scene(*start(material))
    block = still.albedo[still.albedo[:, 0] > 0.1]
    # Half of the texture is white; the lobe of a material without specular takes nothing.
    np.testing.assert_allclose(block, albedo, atol=1e-6)
    # Boxes come with as many triangles as they need, however finely they are cut for shading.
    assert len(block) == 12


def test_the_initial_state_is_what_is_frozen_without_data():
    model, data = start()
    np.testing.assert_array_equal(psf.freeze_scene(model).vertices, psf.freeze_scene(model, data).vertices)
