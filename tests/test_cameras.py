"""Cameras: projections in closed form, near and far planes, what faces away, and agreement with MuJoCo's renderer."""

import mujoco
import numpy as np
import pytest

from tests.gl_reference import reference_views
from tests.oracles import make_renderer
from warp_psf.renderer import Renderer
from warp_psf.scene.camera import Camera

HEIGHT, WIDTH = 90, 150
ALIASED = '<visual><quality offsamples="0"/></visual>'
# Looks along +y from (0, -4, 1); its film has 150 x 90 pixels of different width and height.
AXES = 'pos="0 -4 1" xyaxes="1 0 0 0 0 1"'
SENSOR = 'sensorsize=".03 .02" focal=".04 .03" principal=".004 -.003" resolution="150 90"'
CAMERAS = {
    "pinhole": f'<camera name="c" {AXES} fovy="50"/>',
    "sensor": f'<camera name="c" {AXES} {SENSOR}/>',
    "orthographic": f'<camera name="c" {AXES} projection="orthographic" fovy="3"/>',
}
MARKS = np.array(((0.0, 0.0, 1.0), (0.7, 1.0, 1.4), (-0.6, -0.5, 0.75), (0.3, 3.0, 0.4)))


def on_picture(kind: str, point: np.ndarray) -> tuple[float, float]:
    """Pixel coordinates of a world point, from the camera's data sheet."""
    right, depth, up = point - (0, -4, 1)
    if kind == "sensor":
        # The principal point shifts the film by so much, to the right and down.
        across, above = (0.04 * right / depth - 0.004) / 0.03, (0.03 * up / depth - 0.003) / 0.02
        return WIDTH * (0.5 + across), HEIGHT * (0.5 - above)
    scale = HEIGHT / 3 if kind == "orthographic" else HEIGHT / (2 * np.tan(np.radians(25))) / depth
    return 0.5 * WIDTH + scale * right, 0.5 * HEIGHT - scale * up


@pytest.mark.parametrize("kind", CAMERAS)
def test_points_are_seen_where_they_project_to(kind):
    balls = "".join(f'<geom size=".12" pos="{x} {y} {z}"/>' for x, y, z in MARKS)
    renderer, data = make_renderer(balls + CAMERAS[kind], HEIGHT, WIDTH, header=ALIASED, environment=None)
    renderer.update_scene(data, "c")
    layers = renderer.layers()
    for index, mark in enumerate(MARKS):
        rows, columns = np.nonzero(layers["segmentation"][..., 0] == index)
        assert len(rows) >= 4
        x, y = on_picture(kind, mark)
        # A ball of a few pixels: its pixels' mean lies within a third of one of its centre, perspective included.
        assert (columns.mean() + 0.5, rows.mean() + 0.5) == pytest.approx((x, y), abs=0.34)
        front = layers["depth"][rows, columns].min()
        assert front == pytest.approx(mark[1] + 4 - 0.12, abs=0.015)  # pixels of 3 to 7 cm miss the foremost point


def test_an_orthographic_ball_covers_its_disc():
    # 130 pixels per metre: no tile of the film may lose any of it, and none may end in the middle of a tile.
    camera = f'<camera name="c" {AXES} projection="orthographic" fovy=".7"/>'
    renderer, data = make_renderer(f'<geom size=".3" pos=".1 2 1.02"/>{camera}', HEIGHT, WIDTH, environment=None)
    renderer.update_scene(data, "c")
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    distance = np.hypot((x - WIDTH / 2) * 0.7 / HEIGHT - 0.1, (HEIGHT / 2 - y) * 0.7 / HEIGHT - 0.02)
    seen = renderer.layers()["segmentation"][..., 0] == 0
    # The ball is a polyhedron within 0.3 % of its radius.
    np.testing.assert_array_equal(seen[np.abs(distance - 0.3) > 1e-3], (distance < 0.3)[np.abs(distance - 0.3) > 1e-3])


def test_the_eye_of_parallel_rays_is_far_back():
    turned = np.array(((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
    pinhole = Camera(np.ones(3), turned, 0.5, far=20.0)
    np.testing.assert_array_equal(pinhole.eye, np.ones(3))
    parallel = Camera(np.ones(3), turned, 0.5, far=20.0, orthographic=True)
    back = parallel.eye - np.array((1.0, 8.0, -9.0))
    # Whatever is in view, the direction to the eye is the optical axis to a thousandth of a degree.
    np.testing.assert_allclose(back / np.linalg.norm(back), turned[:, 2], atol=np.radians(6e-3))


def test_near_and_far_planes_cut():
    # Between 1 m and 5 m from the camera: one ball is cut open and shows the next through, one is too far away.
    header = ALIASED + '<statistic extent="1" center="0 0 0"/><visual><map znear="1" zfar="5"/></visual>'
    balls = '<geom size=".3" pos="0 -2.9 1"/><geom size=".2" pos="0 -1 1"/><geom size=".5" pos="1.5 2 1"/>'
    renderer, data = make_renderer(balls + CAMERAS["pinhole"], HEIGHT, WIDTH, header=header, environment=None)
    renderer.update_scene(data, "c")
    layers = renderer.layers()
    objects, depth = layers["segmentation"][..., 0], layers["depth"]
    assert objects[HEIGHT // 2, WIDTH // 2] == 1
    assert set(np.unique(objects)) == {-1, 0, 1}
    assert depth[np.isfinite(depth)].min() >= 1
    np.testing.assert_array_equal(np.isinf(depth), objects < 0)
    renderer.enable_depth_rendering()
    picture = renderer.render()
    np.testing.assert_array_equal(picture[objects < 0], np.float32(5))
    np.testing.assert_array_equal(picture[objects >= 0], depth[objects >= 0])


@pytest.mark.parametrize(
    "head", ['type="sphere" size=".3"', 'type="box" size=".3 .3 .3"', 'type="capsule" size=".3 .2"']
)
@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
def test_a_camera_in_a_closed_body_sees_out_of_it(head, projection):
    camera = f'<camera name="c" pos="0 0 1" projection="{projection}" fovy="{45 if projection[0] == "p" else 0.2}"/>'
    worldbody = f'<geom type="plane" size="9 9 .1"/><geom {head} pos="0 0 1"/>{camera}'
    renderer, data = make_renderer(worldbody, 20, 30, environment=None)
    renderer.update_scene(data, "c")
    layers = renderer.layers()
    assert (layers["segmentation"][..., 0] == 0).all()
    np.testing.assert_allclose(layers["depth"], 1.0, rtol=1e-5)


def test_a_plane_from_behind_is_faint():
    # MuJoCo's choice: 30 % as opaque. What is beyond it, a white sky, shows through.
    below = '<camera name="c" pos="0 0 -2" xyaxes="1 0 0 0 -1 0"/>'
    renderer, data = make_renderer(
        f'<geom type="plane" size="9 9 .1" material="white"/>{below}', 20, 30, environment=np.ones((4, 8, 3))
    )
    renderer.update_scene(data, "c")
    layers = renderer.layers()
    assert (layers["segmentation"][..., 0] == 0).all()
    np.testing.assert_allclose(layers["albedo"], 0.3, rtol=1e-5)
    light = layers["direct"] + layers["indirect"]
    np.testing.assert_allclose(layers["color"] - light, 0.7, rtol=1e-4)


# Agreement with MuJoCo

TETRAHEDRON = '<mesh name="t" vertex="0 0 0 1 0 0 0 1 0 0 0 1" scale=".9 .9 .9"/>'
STILL_LIFE = (
    '<geom type="plane" size="0 0 .1"/><geom type="box" size=".3 .2 .4" pos="-.9 0 .4" euler="0 0 30"/>'
    '<geom type="capsule" size=".2 .4" pos="0 .6 .6" euler="0 40 0"/><geom type="cylinder" size=".3 .3" pos=".9 0 .3"/>'
    '<geom type="ellipsoid" size=".3 .2 .5" pos=".2 -.9 .5"/><geom type="mesh" mesh="t" pos="1.3 1.4 .3"/>'
)
VIEWS = {
    **{f"{kind} still life": ("", STILL_LIFE + camera) for kind, camera in CAMERAS.items()},
    "in a sphere": ("", STILL_LIFE + '<geom size=".6" pos="0 -4 1"/>' + CAMERAS["pinhole"]),
    "from below": ("", STILL_LIFE + '<camera name="c" pos="0 -3 -1" xyaxes="1 0 0 0 -.7 1" fovy="60"/>'),
    "see-through": ("", STILL_LIFE + '<geom size=".5" pos="0 -2 .9" rgba="1 0 0 .2"/>' + CAMERAS["pinhole"]),
    "cut": (
        '<statistic extent="1" center="0 0 0"/><visual><map znear="3.2" zfar="5"/></visual>',
        STILL_LIFE + '<camera name="c" pos="0 -4 1.3" xyaxes="1 0 0 0 .2 1"/>',
    ),
    "orthographic, cut": (
        '<statistic extent="1" center="0 0 0"/><visual><map znear="3.2" zfar="5"/></visual>',
        STILL_LIFE + CAMERAS["orthographic"],
    ),
}


@pytest.fixture(scope="module")
def references(tmp_path_factory):
    models = {
        name: f"<mujoco>{header}<asset>{TETRAHEDRON}</asset><worldbody>{worldbody}</worldbody></mujoco>"
        for name, (header, worldbody) in VIEWS.items()
    }
    views = [(xml, "c", 2 * WIDTH, 2 * HEIGHT) for xml in models.values()]
    found = reference_views(views, tmp_path_factory.mktemp("gl"))
    return {name: (xml, *pictures) for (name, xml), pictures in zip(models.items(), found, strict=True)}


@pytest.mark.parametrize("name", VIEWS)
def test_depth_and_segmentation_are_mujoco_s(references, name):
    xml, objects, depth = references[name]
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with Renderer(model, 2 * HEIGHT, 2 * WIDTH, environment=None, bounces=0, order=2) as renderer:
        renderer.update_scene(data, "c")
        renderer.enable_segmentation_rendering()
        agree = (renderer.render() == objects).all(axis=2)
        renderer.enable_depth_rendering()
        found = renderer.render()
    # Both renderers cut round bodies into facets, each in its own way; rims differ by some pixels.
    assert agree.mean() >= 0.995
    assert (objects[..., 0] >= 0).mean() > 0.05
    error = np.abs(found / depth - 1)[agree]
    assert np.median(error) <= 1e-3
    assert np.quantile(error, 0.99) <= 1e-2
