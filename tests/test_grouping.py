"""Geoms of one body as one shape: the same picture, with fewer occluders."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

import warp_psf as psf
from warp_psf import bridge
from warp_psf.bridge import entities, grouping
from warp_psf.bridge.shown import find_shown
from warp_psf.scene import primitives
from warp_psf.scene.join import join_meshes
from warp_psf.scene.mesh import make_mesh

STAR = "0 0 1  0 0 -1  1 0 0  -1 0 0  0 1 0  0 -1 0  .2 .2 .2"
LINK = f"""
<mujoco>
  <asset>
    <mesh name="gem" vertex="{STAR}" scale=".2 .2 .2"/>
    <mesh name="screw" vertex="{STAR}" scale=".05 .05 .05"/>
    <material name="steel" specular="1" shininess=".8" rgba=".6 .6 .6 1"/>
  </asset>
  <worldbody>
    <camera name="front" pos="0 -2 1" xyaxes="1 0 0 0 .3 1"/>
    <geom name="floor" type="plane" size="3 3 .1"/>
    <body name="link" pos="0 0 .5" euler="10 20 30">
      <freejoint/>
      <geom name="housing" type="mesh" mesh="gem" rgba="1 0 0 1"/>
      <geom name="cap" type="mesh" mesh="gem" pos=".1 0 .1" euler="40 0 0" rgba="0 1 0 1"/>
      <geom name="bolt" type="mesh" mesh="screw" pos="0 0 .2" rgba="0 0 1 1"/>
      <geom name="shiny" type="mesh" mesh="screw" pos="0 .1 .2" material="steel"/>
      <geom name="glass" type="mesh" mesh="screw" pos="0 -.1 .2" rgba="1 1 1 .4"/>
      <geom name="far" type="mesh" mesh="screw" pos="2 0 0"/>
      <geom name="knob" size=".05" pos="0 0 .3"/>
    </body>
    <body name="other" pos="1 1 .5"><geom name="alone" type="mesh" mesh="gem"/></body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(LINK)


@pytest.fixture(scope="module")
def data(model) -> mujoco.MjData:
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data


def test_opaque_meshes_of_one_body_and_lobe_that_lie_together_are_one(model):
    groups = grouping.group_geoms(model, find_shown(model, mujoco.MjvOption()))
    names = [tuple(model.geom(geom).name for geom in group) for group in groups]
    assert names == [
        ("floor",),
        ("housing", "cap", "bolt"),
        ("shiny",),
        ("glass",),
        ("far",),
        ("knob",),
        ("alone",),
    ]


def test_a_group_lies_where_its_geoms_do(model, data):
    scene = bridge.build_scene(model)
    poses = bridge.read_poses(model, data, scene)
    index = next(index for index, entity in enumerate(scene.entities) if len(entity.parts) == 3)
    entity, mesh = scene.entities[index], scene.meshes[scene.entities[index].mesh]
    assert entity.name == "link"
    assert entity.face_part is not None
    world = mesh.vertices @ poses.rotation[0, index].T + poses.position[0, index]
    for number, part in enumerate(entity.parts):
        geom = data.geom(part.object_id)
        which = model.geom_dataid[part.object_id]
        start, count = model.mesh_vertadr[which], model.mesh_vertnum[which]
        theirs = model.mesh_vert[start : start + count] @ geom.xmat.reshape(3, 3).T + geom.xpos
        ours = world[np.unique(mesh.faces[entity.face_part == number])]
        apart = np.linalg.norm(ours[:, None] - theirs[None], axis=2).min(axis=1)
        assert apart.max() < 1e-5
        np.testing.assert_allclose(part.material.albedo, np.eye(3)[number], atol=0.06)  # less the lobe


def render(model, data, monkeypatch=None) -> tuple[dict[str, np.ndarray], int]:
    if monkeypatch is not None:
        monkeypatch.setattr(entities, "group_geoms", lambda model, shown: [(geom,) for geom in shown.geoms])
    with psf.Renderer(model, 90, 120) as renderer:
        renderer.update_scene(data, "front")
        return renderer.layers(), renderer.occluders


def test_a_group_looks_like_its_geoms(model, data, monkeypatch):
    together, fewer = render(model, data)
    apart, more = render(model, data, monkeypatch)
    assert fewer == more - 2
    same = (together["segmentation"] == apart["segmentation"]).all(axis=2)
    assert same.mean() > 0.995
    np.testing.assert_allclose(together["albedo"][same], apart["albedo"][same], atol=0.1)
    # Its own shadows come from stored vectors instead of from fields: both are band-limited, and differ by per cents.
    difference = (together["color"] - apart["color"])[same]
    assert np.sqrt((difference**2).mean()) < 0.03 * apart["color"].mean()


def test_joined_meshes_keep_their_surface():
    box, ball = primitives.box((0.1, 0.2, 0.3)), primitives.sphere(0.2)
    turn = np.array(((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)))
    joint = join_meshes("pair", [(box, np.zeros(3), np.eye(3)), (ball, np.array((1.0, 0.0, 0.0)), turn)])
    assert len(joint.faces) == len(box.faces) + len(ball.faces)
    assert joint.closed and not joint.convex and joint.slab is None and joint.sphere is None
    again = make_mesh("pair", joint.vertices, joint.faces)
    assert joint.radius == pytest.approx(again.radius, rel=1e-5)
    np.testing.assert_allclose(joint.vertices[: len(box.vertices)], box.vertices, atol=1e-7)
    np.testing.assert_allclose(np.linalg.norm(joint.vertices[len(box.vertices) :] - [1, 0, 0], axis=1), 0.2, atol=1e-6)
