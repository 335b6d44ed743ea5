"""What has no lasting shape: tendons and the geoms that a script adds, against MuJoCo's abstract scene."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

import warp_psf as psf
from warp_psf import bridge
from warp_psf.bridge import solids
from warp_psf.scene.loose import make_room

KIND = mujoco.mjtObj
TENDON = """
<mujoco>
  <worldbody>
    <camera name="front" pos="0 -3 .5" xyaxes="1 0 0 0 0 1"/>
    <geom name="floor" type="plane" size="5 5 .1" pos="0 0 -1"/>
    <site name="a" pos="-.5 0 1" size=".01"/>
    <body pos=".5 0 .2">
      <joint type="slide" axis="0 0 1"/><geom name="ball" size=".1"/><site name="b" size=".01"/>
    </body>
  </worldbody>
  <tendon><spatial name="cord" width=".02" rgba="0 1 0 1"><site site="a"/><site site="b"/></spatial></tendon>
</mujoco>
"""


def start(xml: str) -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def read(model, data):
    """What is loose in this state."""
    view = mujoco.MjvScene(model, maxgeom=1000)
    mujoco.mjv_updateScene(
        model, data, mujoco.MjvOption(), None, mujoco.MjvCamera(), mujoco.mjtCatBit.mjCAT_ALL.value, view
    )
    return bridge.read_loose(model, view, view.ngeom, "linear", 1e-3)


def pixels(layers: dict[str, np.ndarray], kind: int) -> np.ndarray:
    return layers["segmentation"][..., 1] == int(kind)


def is_closed_and_outward(surface: solids.Surface) -> bool:
    """Whether faces agree with their normals, and the volume that they enclose is positive."""
    vertices, normals, faces = surface
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    areas = np.cross(b - a, c - a)
    inward = (areas * normals[faces].mean(axis=1)).sum(axis=1) < -1e-12
    return not inward.any() and float((a * areas).sum()) > 0.0


@pytest.mark.parametrize(
    "surface",
    [
        solids.capsule(0.2, 0.5),
        solids.capsule(0.2, 0.0),
        solids.rod(0.1, -0.5, 0.5),
        solids.cube(),
        solids.cone(0.1, 0.0, 1.0),
        solids.cone(0.1, 0.0, -1.0),
        solids.tube(np.array((1.0, 2.0, 3.0)), np.array((2.0, 2.0, 3.5)), 0.1),
    ],
    ids=["capsule", "ball", "rod", "cube", "cone", "cone below", "tube"],
)
def test_solids_face_outwards(surface):
    assert is_closed_and_outward(surface)
    np.testing.assert_allclose(np.linalg.norm(surface[1], axis=1), 1.0, atol=1e-9)


def test_a_stretched_ball_keeps_right_angles():
    size = np.array((0.1, 0.2, 0.5))
    vertices, normals, _ = solids.scaled(solids.capsule(1.0, 0.0), size)
    gradient = vertices / size**2
    np.testing.assert_allclose(normals, gradient / np.linalg.norm(gradient, axis=1, keepdims=True), atol=1e-4)


def test_a_tendon_runs_from_site_to_site():
    model, data = start(TENDON)
    loose = read(model, data)
    assert loose is not None
    assert [part.name for part in loose.parts] == ["cord"]
    assert (loose.parts[0].object_type, loose.parts[0].object_id) == (int(KIND.mjOBJ_TENDON), 0)
    np.testing.assert_allclose(loose.parts[0].material.albedo, [0.0, 1.0, 0.0], atol=0.06)  # less its lobe
    a, b = data.site("a").xpos, data.site("b").xpos
    along = (b - a) / np.linalg.norm(b - a)
    offset = loose.vertices - a
    across = offset - (offset @ along)[:, None] * along
    assert np.linalg.norm(across, axis=1).max() == pytest.approx(0.02, rel=1e-3)
    reach = offset @ along
    assert reach.min() == pytest.approx(-0.02, abs=1e-4)
    assert reach.max() == pytest.approx(np.linalg.norm(b - a) + 0.02, abs=1e-4)


def test_a_tendon_follows_what_it_hangs_on():
    model, data = start(TENDON)
    with psf.Renderer(model, 90, 120, bounces=0) as renderer:
        heights = []
        for height in (0.0, 0.5):
            data.qpos[0] = height
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, "front")
            layers = renderer.layers()
            seen = pixels(layers, KIND.mjOBJ_TENDON)
            assert seen.sum() > 20
            assert (layers["albedo"][seen][:, 1] > layers["albedo"][seen][:, 0]).all()
            heights.append(np.nonzero(seen)[0].mean())
        assert heights[1] < heights[0]  # rows count from above
        hidden = mujoco.MjvOption()
        hidden.flags[mujoco.mjtVisFlag.mjVIS_TENDON] = 0
        renderer.update_scene(data, "front", hidden)
        assert not pixels(renderer.layers(), KIND.mjOBJ_TENDON).any()


def add_geom(scene: mujoco.MjvScene, kind: int, size, position) -> None:
    """As MuJoCo's tutorial does it."""
    geom = scene.geoms[scene.ngeom]
    color = np.array((0.0, 0.0, 1.0, 1.0), np.float32)
    mujoco.mjv_initGeom(geom, kind, np.array(size, float), np.array(position, float), np.eye(3).ravel(), color)
    scene.ngeom += 1


@pytest.mark.parametrize(
    ("kind", "size"),
    [
        (mujoco.mjtGeom.mjGEOM_SPHERE, (0.2, 0.0, 0.0)),
        (mujoco.mjtGeom.mjGEOM_CAPSULE, (0.1, 0.3, 0.0)),
        (mujoco.mjtGeom.mjGEOM_CYLINDER, (0.1, 0.3, 0.0)),
        (mujoco.mjtGeom.mjGEOM_BOX, (0.2, 0.2, 0.2)),
        (mujoco.mjtGeom.mjGEOM_ELLIPSOID, (0.1, 0.2, 0.3)),
        (mujoco.mjtGeom.mjGEOM_ARROW, (0.05, 0.05, 0.6)),
        (mujoco.mjtGeom.mjGEOM_ARROW2, (0.05, 0.05, 0.6)),
        (mujoco.mjtGeom.mjGEOM_LINE, (4.0, 0.0, 0.6)),
        (mujoco.mjtGeom.mjGEOM_LINEBOX, (0.2, 0.2, 0.2)),
    ],
    ids=lambda value: getattr(value, "name", ""),
)
def test_geoms_that_a_script_adds_are_drawn(kind, size):
    model, data = start(TENDON)
    with psf.Renderer(model, 60, 80, bounces=0) as renderer:
        renderer.update_scene(data, "front")
        bare = renderer.layers()["albedo"]
        add_geom(renderer.scene, kind, size, (0.0, 0.0, 0.5))
        marked = renderer.layers()["albedo"]
        blue = (marked[..., 2] > 2 * marked[..., 0]) & (bare[..., 2] < 0.3)
        assert blue.sum() > 5
        # The next state is without it again.
        renderer.update_scene(data, "front")
        np.testing.assert_array_equal(renderer.layers()["albedo"], bare)


def test_more_and_more_geoms_find_room():
    model, data = start(TENDON)
    with psf.Renderer(model, 30, 40, bounces=0) as renderer:
        for count in (1, 40, 2):
            renderer.update_scene(data, "front")
            for index in range(count):
                add_geom(renderer.scene, mujoco.mjtGeom.mjGEOM_SPHERE, (0.05, 0, 0), (0.05 * index - 1, 0, 0.5))
            assert np.isfinite(renderer.layers()["color"]).all()
            assert renderer.scene.ngeom > count


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"type": int(mujoco.mjtGeom.mjGEOM_MESH), "dataid": 8}, "dataid 8"),
        ({"type": int(mujoco.mjtGeom.mjGEOM_SKIN)}, "from the model alone"),
        ({"matid": 3}, "matid 3"),
        ({"rgba": (np.nan, 0, 0, 1)}, "finite"),
    ],
)
def test_added_geoms_that_name_nothing_are_refused(change, reason):
    model, data = start(TENDON)
    with psf.Renderer(model, 12, 16, bounces=0) as renderer:
        renderer.update_scene(data, "front")
        picture = renderer.render()
        add_geom(renderer.scene, mujoco.mjtGeom.mjGEOM_SPHERE, (0.1, 0, 0), (0, 0, 0.5))
        for name, value in change.items():
            setattr(renderer.scene.geoms[renderer.scene.ngeom - 1], name, value)
        with pytest.raises(ValueError, match=reason):
            renderer.render()
        # Nothing is lost: the next state is drawn as before.
        renderer.update_scene(data, "front")
        np.testing.assert_array_equal(renderer.render(), picture)


def test_a_room_holds_what_it_was_made_for_and_half_as_much_again():
    model, data = start(TENDON)
    loose = read(model, data)
    assert loose is not None
    room = make_room(loose)
    assert room.holds(loose)
    assert not replace(room, vertices=len(loose.vertices) - 1).holds(loose)
    assert room.faces == len(loose.faces) + len(loose.faces) // 2
