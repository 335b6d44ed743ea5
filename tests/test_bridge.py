"""MuJoCo to scene: shapes, colours, poses, lights and cameras, against MuJoCo's own abstract visualiser."""

from __future__ import annotations

import warnings

import mujoco
import numpy as np
import pytest

from warp_psf import bridge
from warp_psf.bridge.shapes import INFINITE_PLANE
from warp_psf.scene import primitives
from warp_psf.scene.light import AreaLight, DeltaLight, area_light_entities, rectangle_light

TETRAHEDRON = "0 0 0  1 0 0  0 1 0  0 0 1"
ALL_GEOMS = f"""
<mujoco>
  <visual>
    <headlight ambient=".1 .2 .3"/>
  </visual>
  <asset>
    <mesh name="tetra" vertex="{TETRAHEDRON}"/>
    <texture name="checker" type="2d" builtin="checker" width="32" height="32" rgb1="1 1 1" rgb2="0 0 0"/>
    <material name="steel" rgba=".2 .4 .6 1" specular=".8" shininess="1" emission=".5"/>
    <material name="tiles" texture="checker"/>
    <hfield name="hills" nrow="3" ncol="3" size="1 1 1 1"/>
  </asset>
  <worldbody>
    <light name="sun" type="directional" pos="0 0 5" dir="1 0 -1" diffuse=".9 .8 .7"/>
    <light name="off" pos="0 0 3" active="false"/>
    <light name="bulb" type="point" pos="1 1 1" attenuation="1 2 3" bulbradius=".3" castshadow="false" range="7"/>
    <geom name="floor" type="plane" size="0 3 .1" material="tiles"/>
    <geom name="hidden" type="sphere" size=".1" group="3"/>
    <geom name="clear" type="sphere" size=".1" rgba="1 1 1 0"/>
    <geom name="hills" type="hfield" hfield="hills"/>
    <body name="moving" pos="0 0 1" euler="0 0 90">
      <freejoint/>
      <light name="torch" pos="0 0 .5" dir="1 0 0" cutoff="30" exponent="4"/>
      <camera name="eye" pos="1 2 3" xyaxes="0 -1 0 1 0 2" fovy="33"/>
      <geom name="box" type="box" size=".1 .2 .3" rgba=".9 0 0 1"/>
      <geom name="ball" type="sphere" size=".25" pos="0 0 1" rgba="0 .5 0 1" material="steel"/>
      <geom name="ball2" type="sphere" size=".25" pos="0 1 1" material="steel"/>
      <geom name="pill" type="capsule" size=".1 .4" pos="1 0 0"/>
      <geom name="can" type="cylinder" size=".1 .4" pos="1 1 0"/>
      <geom name="egg" type="ellipsoid" size=".1 .2 .4" pos="1 1 1"/>
      <geom name="first" type="mesh" mesh="tetra" pos="2 0 0"/>
      <geom name="second" type="mesh" mesh="tetra" pos="6 0 0"/>
    </body>
  </worldbody>
</mujoco>
"""
SIMPLE = """
<mujoco><worldbody>{}<geom name="ball" type="sphere" size="1"/></worldbody></mujoco>
"""


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(ALL_GEOMS)


@pytest.fixture
def data(model) -> mujoco.MjData:
    data = mujoco.MjData(model)
    data.qpos[:7] = 0.3, -0.2, 1.5, 0.8, 0.1, 0.5, 0.3
    mujoco.mj_forward(model, data)
    return data


@pytest.fixture(scope="module")
def scene(model):
    return bridge.build_scene(model)


def simple(lights: str = "") -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = mujoco.MjModel.from_xml_string(SIMPLE.format(lights))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def visualised(model, data, camera) -> mujoco.MjvScene:
    """What MuJoCo's own renderer would draw, without OpenGL."""
    view = mujoco.MjvScene(model, maxgeom=100)
    mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, camera, mujoco.mjtCatBit.mjCAT_ALL, view)
    return view


def free_camera(model) -> mujoco.MjvCamera:
    camera = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(model, camera)
    return camera


# Scene


def test_entities_are_the_visible_geoms(model, scene):
    names = [entity.name for entity in scene.entities]
    assert names == ["floor", "hills", "box", "ball", "ball2", "pill", "can", "egg", "first", "second"]
    assert all(model.geom(entity.parts[0].object_id).name == entity.name for entity in scene.entities)
    assert {entity.parts[0].object_type for entity in scene.entities} == {int(mujoco.mjtObj.mjOBJ_GEOM)}


def test_equal_shapes_share_a_mesh(scene):
    mesh = {entity.name: entity.mesh for entity in scene.entities}
    assert mesh["ball"] == mesh["ball2"]
    assert mesh["first"] == mesh["second"]
    assert len(scene.meshes) == 8
    assert scene.meshes[mesh["first"]].name == "tetra"


def test_shapes_have_the_model_s_sizes(model, scene):
    endless = INFINITE_PLANE * model.stat.extent
    half_extents = {
        "floor": (endless, 3.0, 0.0),
        "box": (0.1, 0.2, 0.3),
        "ball": (0.25, 0.25, 0.25),
        "pill": (0.1, 0.1, 0.5),
        "can": (0.1, 0.1, 0.4),
        "egg": (0.1, 0.2, 0.4),
    }
    for entity in scene.entities:
        vertices = scene.meshes[entity.mesh].vertices
        if entity.name in half_extents:
            np.testing.assert_allclose(vertices.max(axis=0), half_extents[entity.name], rtol=1e-5)
            np.testing.assert_allclose(vertices.min(axis=0), np.negative(half_extents[entity.name]), rtol=1e-5)


def test_meshes_lie_where_mujoco_puts_them(model, data, scene):
    poses = bridge.read_poses(model, data, scene)
    index = [entity.name for entity in scene.entities].index("second")
    vertices = scene.meshes[scene.entities[index].mesh].vertices
    world = vertices @ poses.rotation[0, index].T + poses.position[0, index]
    body = data.body("moving")
    local = (world - body.xpos) @ body.xmat.reshape(3, 3) - [6.0, 0.0, 0.0]
    corners = np.unique(np.round(local, 5) + 0.0, axis=0)
    np.testing.assert_allclose(
        corners, np.unique(np.array(TETRAHEDRON.split(), float).reshape(-1, 3), axis=0), atol=2e-5
    )


def test_poses_are_mujoco_s(model, data, scene):
    poses = bridge.read_poses(model, data, scene)
    assert poses.position.dtype == poses.rotation.dtype == np.float32
    assert poses.position.shape == (1, 10, 3)
    for entity, position, rotation in zip(scene.entities, poses.position[0], poses.rotation[0], strict=True):
        np.testing.assert_allclose(position, data.geom(entity.parts[0].object_id).xpos, atol=1e-6)
        np.testing.assert_allclose(rotation.ravel(), data.geom(entity.parts[0].object_id).xmat, atol=1e-6)


def test_colours_follow_mujoco_s_rule(model, data, scene):
    view = visualised(model, data, free_camera(model))
    shown = {geom.objid: geom for geom in view.geoms[: view.ngeom] if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        linear = bridge.build_scene(model, material_space="linear")
    for entity in linear.entities:
        geom = shown[entity.parts[0].object_id]
        if entity.name != "floor":
            np.testing.assert_allclose(entity.lobe.albedo, geom.rgba[:3], rtol=1e-6)
            np.testing.assert_allclose(entity.lobe.specular, 2.0 * geom.specular / (32.0 * geom.shininess + 2.0))
        np.testing.assert_allclose(entity.lobe.emission, geom.emission * geom.rgba[:3], rtol=1e-6)
        np.testing.assert_allclose(entity.lobe.exponent, 32.0 * geom.shininess, rtol=1e-6)
    by_name = {entity.name: entity.lobe for entity in scene.entities}
    np.testing.assert_allclose(by_name["ball"].albedo, [0.0, 0.21404114, 0.0], atol=1e-6)


def test_textures_are_read_once_and_stay_out_of_the_albedo(scene):
    floor = next(entity for entity in scene.entities if entity.name == "floor")
    np.testing.assert_allclose(floor.lobe.albedo, 1.0 - floor.lobe.specular, atol=1e-6)
    assert [texture.name for texture in scene.textures] == ["checker"]
    assert floor.parts[0].texture == 0
    np.testing.assert_allclose(scene.textures[0].pixels.mean(), 127.5)
    assert {entity.parts[0].texture for entity in scene.entities if entity is not floor} == {-1}


def test_reflectances_never_exceed_one():
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><asset><material name="m" rgba="1 .5 0 1" specular="1" shininess="0"/></asset>'
        '<worldbody><geom size="1" material="m"/></worldbody></mujoco>'
    )
    material = bridge.build_scene(model, material_space="linear").entities[0].lobe
    np.testing.assert_allclose(material.albedo, [0.5, 0.25, 0.0])
    np.testing.assert_allclose(material.specular, [0.5, 0.5, 0.5])


def test_area_lights_are_the_last_entities(model, data):
    shape = primitives.sphere(0.1, subdivisions=2)
    lamps = [
        rectangle_light("panel", 1.0, 0.5, [4.0, 3.0, 2.0], [0.0, 0.0, 2.0], target=[0.0, 0.0, 0.0]),
        AreaLight("glow", shape, [1.0, 1.0, 1.0], [0.0, 0.1, 0.2], body="moving"),
        AreaLight("glow 2", shape, [1.0, 1.0, 1.0]),
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scene = bridge.build_scene(model, lights=lamps, model_lights=False)
    assert [lamp for lamp, _ in area_light_entities(scene)] == lamps
    assert [scene.entities[entity].name for _, entity in area_light_entities(scene)] == ["panel", "glow", "glow 2"]
    assert len(scene.lights) == 3
    panel, glow, glow2 = scene.entities[-3:]
    assert panel.parts[0].object_id == -1
    assert glow.mesh == glow2.mesh
    np.testing.assert_array_equal(panel.lobe.emission, [4.0, 3.0, 2.0])

    poses = bridge.read_poses(model, data, scene)
    np.testing.assert_allclose(poses.position[0, -3], [0.0, 0.0, 2.0])
    np.testing.assert_allclose(poses.rotation[0, -3] @ [0.0, 0.0, 1.0], [0.0, 0.0, -1.0], atol=1e-6)
    body = data.body("moving")
    np.testing.assert_allclose(poses.position[0, -2], body.xpos + body.xmat.reshape(3, 3) @ [0.0, 0.1, 0.2], atol=1e-6)
    np.testing.assert_allclose(poses.rotation[0, -2].ravel(), body.xmat, atol=1e-6)


def test_infinite_planes_follow_the_camera():
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><statistic extent="1"/><asset><texture name="t" type="2d" builtin="checker" width="8" height="8"/>'
        '<material name="m" texture="t" texrepeat="3 3"/></asset><worldbody><geom size="1"/>'
        '<geom name="endless" type="plane" size="0 2 1" euler="0 0 90" material="m"/></worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    scene = bridge.build_scene(model)
    for distance in (0.0, 3.0, 70.0, -1000.0, 12345.0):
        eye = np.array((50.0, distance, 1.0))  # the plane's own x axis is the world's y
        plane = bridge.read_poses(model, data, scene, eye).position[0, 1]
        half = INFINITE_PLANE * model.stat.extent
        assert abs(plane[1] - distance) < 0.25 * half
        assert (plane[0], plane[2]) == pytest.approx((0.0, 0.0), abs=1e-3)
        # Whole repetitions of the texture; far out float32 has centimetres left.
        assert abs(plane[1] / (4 / 3) - round(plane[1] / (4 / 3))) < 1e-3
    np.testing.assert_array_equal(bridge.read_poses(model, data, scene).position[0, 1], 0.0)


# Lights


def test_lights_are_those_that_mujoco_shows(model, data, scene):
    camera = bridge.read_camera(model, data)
    lights = bridge.read_delta_lights(model, data, scene, camera)
    assert [light.name for light in lights] == ["sun", "bulb", "torch", "headlight"]
    view = visualised(model, data, free_camera(model))
    # MuJoCo puts the headlight first.
    for light, theirs in zip((lights[-1], *lights[:-1]), view.lights[: view.nlight], strict=True):
        np.testing.assert_allclose(light.position, theirs.pos, atol=1e-6)
        np.testing.assert_allclose(light.direction, theirs.dir, atol=1e-6)
        np.testing.assert_allclose(light.diffuse, theirs.diffuse, rtol=1e-6)
        np.testing.assert_allclose(light.ambient, theirs.ambient, rtol=1e-6)
        np.testing.assert_allclose(light.specular, theirs.specular, rtol=1e-6)
        assert light.castshadow == bool(theirs.castshadow)


def test_light_settings(scene):
    lights = {light.name: light for light in scene.lights if isinstance(light, DeltaLight)}
    assert {name: light.kind for name, light in lights.items()} == {
        "sun": "directional",
        "off": "spot",
        "bulb": "point",
        "torch": "spot",
        "headlight": "directional",
    }
    np.testing.assert_allclose(lights["bulb"].attenuation, [1.0, 2.0, 3.0])
    assert (lights["bulb"].radius, lights["bulb"].range) == (pytest.approx(0.3), 7.0)
    assert lights["torch"].cutoff == pytest.approx(np.pi / 6.0)
    assert (lights["torch"].exponent, lights["torch"].range) == (4.0, np.inf)
    # In the initial state the body is turned by 90 degrees about z.
    np.testing.assert_allclose(lights["torch"].direction, [0.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(lights["torch"].position, [0.0, 0.0, 1.5], atol=1e-12)


def test_lights_can_be_switched_while_running():
    model, data = simple('<light name="lamp"/>')
    scene = bridge.build_scene(model)
    camera = bridge.read_camera(model, data)
    assert [light.name for light in bridge.read_delta_lights(model, data, scene, camera)] == ["lamp", "headlight"]
    model.light_active[0] = 0
    assert [light.name for light in bridge.read_delta_lights(model, data, scene, camera)] == ["headlight"]
    assert bridge.build_scene(model, model_lights=False).lights == ()


def test_a_light_of_one_s_own_stays_in_place():
    model, data = simple()
    black = np.zeros(3)
    own = DeltaLight("own", "point", np.ones(3), [0.0, 0.0, -1.0], np.ones(3), black, black)
    scene = bridge.build_scene(model, lights=[own], model_lights=False)
    assert bridge.read_delta_lights(model, data, scene, bridge.read_camera(model, data)) == (own,)


def test_no_headlight():
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><visual><headlight active="0"/></visual><worldbody><geom size="1"/></worldbody></mujoco>'
    )
    assert bridge.build_scene(model).lights == ()


# Cameras


def check_camera(model, data, camera, theirs: mujoco.MjvCamera):
    ours = bridge.read_camera(model, data, camera)
    view = visualised(model, data, theirs).camera
    pinhole = 0.5 * (view[0].pos + view[1].pos)
    np.testing.assert_allclose(ours.position, pinhole, atol=1e-6)
    np.testing.assert_allclose(-ours.rotation[:, 2], view[0].forward, atol=1e-6)
    np.testing.assert_allclose(ours.rotation[:, 1], view[0].up, atol=1e-6)
    np.testing.assert_allclose(ours.rotation @ ours.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(ours.rotation) == pytest.approx(1.0)
    assert np.tan(0.5 * ours.fovy) == pytest.approx(view[0].frustum_top / view[0].frustum_near, rel=1e-6)


def test_free_camera(model, data):
    check_camera(model, data, -1, free_camera(model))
    assert bridge.read_camera(model, data).fovy == pytest.approx(np.radians(model.vis.global_.fovy), rel=1e-6)


def test_fixed_camera_by_name_and_id(model, data):
    fixed = mujoco.MjvCamera()
    fixed.type, fixed.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, 0
    for camera in ("eye", 0, np.int64(0), fixed):
        check_camera(model, data, camera, fixed)
    ours = bridge.read_camera(model, data, "eye")
    np.testing.assert_allclose(ours.position, data.camera("eye").xpos, atol=1e-6)
    np.testing.assert_allclose(ours.rotation.ravel(), data.camera("eye").xmat, atol=1e-6)
    assert ours.fovy == pytest.approx(np.radians(33.0), rel=1e-6)


def test_tracking_and_moved_free_camera(model, data):
    tracking = free_camera(model)
    tracking.type, tracking.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, model.body("moving").id
    check_camera(model, data, tracking, tracking)
    moved = free_camera(model)
    moved.azimuth, moved.elevation, moved.distance = 20.0, -70.0, 4.0
    check_camera(model, data, moved, moved)


def test_camera_with_a_sensor():
    model, data = simple('<camera name="c" sensorsize=".02 .01" focal=".03 .03" resolution="200 100"/>')
    assert bridge.read_camera(model, data, "c").fovy == pytest.approx(2.0 * np.arctan(0.5 * 0.01 / 0.03), rel=1e-6)


def test_cameras_that_are_not_there(model, data):
    for camera in ("aye", 1, -2):
        with pytest.raises(ValueError, match="does not exist; the model has eye, and -1 is the free camera"):
            bridge.read_camera(model, data, camera)
    with pytest.raises(TypeError, match="neither an id nor a name nor an MjvCamera; the model has eye"):
        bridge.read_camera(model, data, 0.5)
    with pytest.raises(ValueError, match="the model has only -1"):
        bridge.read_camera(*simple(), "eye")
    user, tracking, fixed = mujoco.MjvCamera(), mujoco.MjvCamera(), mujoco.MjvCamera()
    user.type = mujoco.mjtCamera.mjCAMERA_USER
    tracking.type, tracking.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, 99
    fixed.type, fixed.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, 99
    for camera, message in ((user, "mjCAMERA_USER"), (tracking, "tracks body 99"), (fixed, "camera 99 does not")):
        with pytest.raises(ValueError, match=message):
            bridge.read_camera(model, data, camera)


# Errors


def test_data_of_another_model(model, scene):
    other_model, other = simple()
    with pytest.raises(ValueError, match=r"data is of another model \(nq 0 instead of 7, .*mujoco.MjData"):
        bridge.read_poses(model, other, scene)
    with pytest.raises(ValueError, match="data is of another model"):
        bridge.read_camera(model, other)
    with pytest.raises(ValueError, match="data is of another model"):
        bridge.read_delta_lights(model, other, scene, bridge.read_camera(other_model, other))


def test_data_without_poses(model, scene):
    with pytest.raises(ValueError, match=r"call mujoco\.mj_forward"):
        bridge.read_poses(model, mujoco.MjData(model), scene)


def test_data_that_diverged(model, data, scene):
    data.geom("egg").xpos[1] = np.nan
    with pytest.raises(ValueError, match="the pose of egg is not finite"):
        bridge.read_poses(model, data, scene)


def test_bad_arguments():
    model, _ = simple()
    with pytest.raises(ValueError, match="material_space is 'sRGB'"):
        bridge.build_scene(model, material_space="sRGB")
    lamp = rectangle_light("lamp", 1.0, 1.0, np.ones(3), np.zeros(3), body="nobody")
    with pytest.raises(ValueError, match="light 'lamp' hangs on body 'nobody', which the model lacks; it has world"):
        bridge.build_scene(model, lights=[lamp])


def test_load_model(tmp_path):
    good = tmp_path / "good.xml"
    good.write_text(SIMPLE.format(""))
    model = bridge.load_model(str(good))
    compiled = tmp_path / "good.mjb"
    mujoco.mj_saveModel(model, str(compiled), None)
    assert bridge.load_model(compiled).ngeom == 1
    with pytest.raises(FileNotFoundError, match=r"missing\.xml' does not exist"):
        bridge.load_model(tmp_path / "missing.xml")
    with pytest.raises(FileNotFoundError, match="does not exist"):
        bridge.load_model(tmp_path)


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("bad.xml", "<mujoco><worldbody><geom type='cone'/></worldbody></mujoco>", "cone"),
        ("bad.xml", "this is not XML", "cannot be loaded: "),
        ("bad.xml", "", "cannot be loaded: "),
        ("bad.mjb", "this is not a model", "cannot be loaded: "),
    ],
)
def test_unreadable_model(tmp_path, name, content, reason):
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(ValueError, match=reason) as caught:
        bridge.load_model(path)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)
