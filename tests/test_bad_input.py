"""Bad input gets one sentence that names the thing; unusual input is rendered."""

import pickle
import re

import mujoco
import numpy as np
import pytest

import warp_psf as psf
from tests.oracles import make_model, make_renderer
from warp_psf.bridge import load_model

FLOOR = '<geom name="floor" type="plane" size="9 9 .1" material="white"/>'
BALL = '<geom name="ball" type="sphere" size=".5" pos="0 0 .5"/>'
TRIANGLE = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0)], float)


@pytest.fixture(scope="module")
def model():
    return make_model(FLOOR + BALL)[0]


def assert_refused(action, error: type[Exception], *words: str) -> None:
    """`action` raises `error` with one sentence that holds the words."""
    with pytest.raises(error) as caught:
        action()
    message = str(caught.value)
    assert "\n" not in message
    assert len(message) < 300
    for word in words:
        assert word in message


# Options


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"height": 0}, ("height", "0", "at least 1")),
        ({"width": 0}, ("width", "0", "at least 1")),
        ({"width": -3}, ("width", "-3")),
        ({"height": 2.5}, ("height", "2.5", "whole number")),
        ({"height": float("nan")}, ("height", "nan")),
        ({"width": float("inf")}, ("width", "inf")),
        ({"width": 10**6, "height": 10**6}, ("1000000 x 1000000", "too large")),
        ({"order": 1}, ("order is 1", "2, 3, 4, 5, 6")),
        ({"order": 7}, ("order is 7", "2, 3, 4, 5, 6")),
        ({"shading": "face"}, ("'face'", "'pixel' or 'vertex'")),
        ({"view": "film"}, ("'film'", "'neutral' or 'srgb'")),
        ({"exposure": float("nan")}, ("exposure is nan",)),
        ({"exposure": 100}, ("exposure is 100", "64")),
        ({"bounces": -1}, ("bounces is -1", "0 to 16")),
        ({"bounces": 17}, ("bounces is 17", "0 to 16")),
        ({"bounces": 2.5}, ("bounces is 2.5", "whole number")),
        ({"bounces": float("nan")}, ("bounces is nan", "whole number")),
        ({"bounces": float("inf")}, ("bounces is inf", "whole number")),
        ({"bounces": None}, ("bounces is None", "whole number")),
        ({"bounces": "3"}, ("bounces is '3'", "whole number")),
        ({"bounce_threshold": None}, ("bounce_threshold is None", "between 0 and 1")),
        ({"bounce_threshold": 0.0}, ("bounce_threshold is 0.0", "between 0 and 1")),
        ({"bounce_threshold": 1}, ("bounce_threshold is 1", "between 0 and 1")),
        ({"bounce_threshold": float("nan")}, ("bounce_threshold is nan", "between 0 and 1")),
        ({"basis_functions": 12}, ("basis_functions is 12", "4, 8, 16, 32")),
        ({"basis_functions": 0}, ("basis_functions is 0", "4, 8, 16, 32")),
        ({"material_space": "rgb"}, ("'rgb'", "'srgb' or 'linear'")),
        ({"device": "cuda:97"}, ("cuda:97", "not on this machine", "cpu")),
        ({"device": "quantum"}, ("quantum", "not on this machine", "cpu")),
    ],
    ids=str,
)
def test_bad_options(model, options, words):
    assert_refused(lambda: psf.Renderer(model, **({"height": 4, "width": 4} | options)), ValueError, *words)


def test_whole_floats_are_whole_numbers(model):
    renderer = psf.Renderer(model, 4.0, 6.0, order=4.0, bounces=2.0, basis_functions=16.0)  # as 0.5 * size gives them
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    renderer.update_scene(data)
    assert renderer.render().shape == (4, 6, 3)


def test_model_that_is_a_path():
    assert_refused(lambda: psf.Renderer("scene.xml"), TypeError, "model is a str", "mujoco.MjModel")


# Environments


@pytest.mark.parametrize(
    ("value", "error", "words"),
    [
        (np.full((4, 8, 3), np.nan), ValueError, ("32 of 32 pixels are NaN",)),
        (np.full((4, 8, 3), -1.0), ValueError, ("32 of 32 pixels are negative", "-1")),
        (np.ones((4, 8)), ValueError, ("shape (4, 8)", "[rows, columns, 3]")),
        (np.ones((0, 8, 3)), ValueError, ("shape (0, 8, 3)",)),
        ("nowhere.exr", FileNotFoundError, ("nowhere.exr", "studio")),
        ("moonlight", FileNotFoundError, ("moonlight", "studio", "overcast")),
        (3, TypeError, ("environment is a int", "studio")),
    ],
)
def test_bad_environments(model, value, error, words):
    assert_refused(lambda: psf.Renderer(model, 4, 4, environment=value), error, *words)


def test_environment_on_no_bands():
    assert_refused(lambda: psf.load_environment("studio").project(0), ValueError, "0 bands", "at least 1")


# Models, meshes, lights, data, cameras


def test_missing_and_unreadable_models(tmp_path):
    assert_refused(lambda: load_model(tmp_path / "none.xml"), FileNotFoundError, "none.xml", "does not exist")
    for name, content in (("broken.xml", "<mujoco><worldbody>"), ("other.xml", "<html/>"), ("empty.mjb", "")):
        path = tmp_path / name
        path.write_text(content)
        with pytest.raises(ValueError, match=re.escape(name)):
            load_model(path)


@pytest.mark.parametrize(
    ("vertices", "faces", "words"),
    [
        (np.where(TRIANGLE == 1, np.nan, TRIANGLE), [[0, 1, 2]], ("'bad'", "finite")),
        (TRIANGLE, np.zeros((0, 3), int), ("'bad'", "face")),
        (TRIANGLE, [[0, 0, 1]], ("'bad'",)),
        (TRIANGLE, [[0, 1, 3]], ("'bad'", "3")),
    ],
)
def test_bad_meshes(vertices, faces, words):
    assert_refused(lambda: psf.make_mesh("bad", vertices, faces), ValueError, *words)


def test_light_on_a_body_that_is_not_there(model):
    light = psf.rectangle_light("lamp", 1, 1, (1, 1, 1), (0, 0, 1), body="arm")
    assert_refused(lambda: psf.Renderer(model, 4, 4, lights=[light]), ValueError, "'lamp'", "'arm'", "world")


@pytest.mark.parametrize(
    ("lights", "error", "words"),
    [
        (psf.rectangle_light("lamp", 1, 1, (1, 1, 1), (0, 0, 1)), TypeError, ("lights", "AreaLight", "list")),
        (None, TypeError, ("lights", "NoneType", "list")),
        (["lamp"], TypeError, ("lights", "str", "AreaLight")),
        ([psf.DeltaLight("lamp", "point", *np.ones((5, 3)), index=9)], ValueError, ("'lamp'", "light 9", "has 0")),
    ],
)
def test_lights_that_are_none(model, lights, error, words):
    assert_refused(lambda: psf.Renderer(model, 4, 4, lights=lights), error, *words)


def test_an_area_light_without_a_mesh():
    assert_refused(lambda: psf.AreaLight("lamp", None, (1, 1, 1)), TypeError, "'lamp'", "NoneType", "make_mesh")


@pytest.mark.parametrize("part", ["cutoff", "exponent", "radius"])
def test_delta_lights_without_bounds(part):
    assert_refused(
        lambda: psf.DeltaLight("lamp", "spot", *np.ones((5, 3)), **{part: np.inf}), ValueError, "'lamp'", part, "inf"
    )


def test_data_that_is_none(model):
    renderer = psf.Renderer(model, 4, 4)
    assert_refused(lambda: renderer.update_scene(None), TypeError, "data is a NoneType", "mujoco.MjData")


def test_renderers_are_not_pickled(model):
    assert_refused(lambda: pickle.dumps(psf.Renderer(model, 4, 4)), TypeError, "Renderer", "each process")


def test_data_of_another_model_leaves_the_state_alone():
    renderer, _ = make_renderer(FLOOR + BALL, 6, 8)
    before = renderer.layers()["color"]
    _, other = make_model(FLOOR)
    assert_refused(lambda: renderer.update_scene(other), ValueError, "data is of another model", "ngeom 1 instead of 2")
    np.testing.assert_array_equal(renderer.layers()["color"], before)


def test_cameras_that_do_not_exist():
    renderer, data = make_renderer(FLOOR + BALL + '<camera name="front" pos="0 -3 1"/>', 6, 8)
    before = renderer.layers()["color"]
    assert_refused(lambda: renderer.update_scene(data, "back"), ValueError, "'back'", "front")
    assert_refused(lambda: renderer.update_scene(data, 3), ValueError, "camera 3", "front")
    np.testing.assert_array_equal(renderer.layers()["color"], before)


def test_simulations_that_diverged():
    renderer, data = make_renderer(FLOOR + f"<body><freejoint/>{BALL}</body>", 6, 8)
    data.qpos[:] = np.nan
    mujoco.mj_kinematics(renderer.model, data)
    assert_refused(lambda: renderer.update_scene(data), ValueError, "ball", "not finite")


# Unusual, and fine


@pytest.mark.parametrize("shading", ["pixel", "vertex"])
def test_an_empty_scene_is_its_background(shading):
    environment = psf.load_environment("sky")
    light = '<light type="directional" dir="0 0 -1"/>'
    hidden = '<geom type="sphere" size="1" rgba="1 1 1 0"/><geom type="sphere" size="1" group="4"/>'
    for body in ("", light, hidden):
        renderer, _ = make_renderer(body, 6, 8, environment=environment, shading=shading)
        layers = renderer.layers()
        assert (layers["segmentation"] == -1).all()
        assert np.isinf(layers["depth"]).all()
        assert (layers["color"] > 0).all()
        assert not layers["direct"].any()
        assert renderer.occluders == renderer.vertices == 0


def test_an_empty_scene_with_a_light():
    light = psf.rectangle_light("lamp", 1, 1, (2, 2, 2), (0, 0, 0), rotation=np.eye(3))
    renderer, data = make_renderer(
        '<camera name="down" pos="0 0 1" xyaxes="1 0 0 0 1 0"/>', 5, 5, environment=None, lights=[light]
    )
    renderer.update_scene(data, "down")
    np.testing.assert_allclose(renderer.layers()["color"][2, 2], 2.0)


@pytest.mark.parametrize("shading", ["pixel", "vertex"])
def test_two_hundred_bodies(shading):
    random = np.random.default_rng(4)
    bodies = "".join(
        f'<geom type="{("sphere", "box")[k % 2]}" size=".1 .1 .1" pos="{x} {y} {z}"/>'
        for k, (x, y, z) in enumerate(random.uniform((-3, -3, 0.1), (3, 3, 1.5), (200, 3)))
    )
    renderer, _ = make_renderer(FLOOR + bodies, 54, 96, shading=shading)
    layers = renderer.layers()
    assert len(np.unique(layers["segmentation"][..., 0])) > 150
    assert np.isfinite(layers["color"]).all()
    assert renderer.occluders == 201


def test_nothing_in_view():
    away = '<camera name="away" pos="0 -3 1" xyaxes="-1 0 0 0 0 1"/>'
    renderer, data = make_renderer(BALL + away, 6, 8, environment=np.full((4, 8, 3), 0.5))
    renderer.update_scene(data, "away")
    np.testing.assert_allclose(renderer.layers()["color"], 0.5, rtol=1e-5)


@pytest.mark.parametrize("geom", ['"sphere" size="1"', '"box" size="1 1 1"', '"plane" size="1 1 1"'])
def test_camera_inside_a_body(geom):
    inside = '<camera name="inside" pos="0 0 0" xyaxes="1 0 0 0 .6 .8"/>'
    renderer, data = make_renderer(f"<geom type={geom}/>{inside}", 27, 48)
    renderer.update_scene(data, "inside")
    layers = renderer.layers()
    assert np.isfinite(layers["color"]).all()
    assert (layers["color"] >= 0).all()
    if "plane" not in geom:
        # Faces show their outer side alone, as in MuJoCo: a camera in a head sees out of it.
        assert (layers["segmentation"][..., 0] == -1).all()


@pytest.mark.parametrize("scale", [1e-4, 1e4])
def test_tiny_and_huge_scenes(scale):
    # The picture does not depend on the unit of length.
    pictures = []
    for unit in (1.0, scale):
        scene = (
            f'<geom type="plane" size="{9 * unit} {9 * unit} .1" material="white"/>'
            f'<geom type="sphere" size="{0.5 * unit}" pos="0 0 {0.5 * unit}"/>'
            f'<geom type="box" size="{0.3 * unit} {0.3 * unit} {0.3 * unit}" pos="{unit} 0 {0.3 * unit}"/>'
            f'<camera name="front" pos="0 {-4 * unit} {2 * unit}" xyaxes="1 0 0 0 .45 .9"/>'
        )
        # The clipping planes are as far off as this says; MuJoCo's own guess has a least value.
        renderer, data = make_renderer(scene, 27, 48, header=f'<statistic extent="{5 * unit}"/>')
        renderer.update_scene(data, "front")
        pictures.append(renderer.layers()["color"])
    difference = np.abs(pictures[1] - pictures[0]).max(axis=2)
    # Float32: a few samples at edges fall to the other side.
    assert np.quantile(difference, 0.98) < 1e-3


def test_bodies_in_one_place():
    # Two equal balls and a box around them: receivers on each lie inside another.
    renderer, _ = make_renderer(
        FLOOR + BALL + BALL.replace("ball", "twin") + '<geom type="box" size=".5 .5 .5" pos="0 0 .5"/>', 27, 48
    )
    layers = renderer.layers()
    assert np.isfinite(layers["color"]).all()
    assert layers["color"].min() >= 0
