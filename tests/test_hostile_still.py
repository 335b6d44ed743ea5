"""What no scene at rest can be made of: one sentence at the boundary, and no picture that is silently wrong."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import mujoco
import numpy as np
import pytest

import warp_psf as psf
from tests.flat_renderer import MODEL, assert_refused, model_path, run
from tests.test_slab import ball, box, camera_at
from warp_psf import area_light
from warp_psf.area_light import points, quadtree, script
from warp_psf.area_light.scene_map import retrieve_pixels
from warp_psf.device import find_device
from warp_psf.scene.light import DeltaLight, rectangle_light, sphere_light
from warp_psf.scene.still import StillScene, join_pieces, make_still

__all__ = ["model_path"]

NAN, INF = np.nan, np.inf
CORNERS, FACES = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), [[0, 1, 2]]
CAMERA = camera_at((0.3, -3, 3), (0.3, 0.3, 0))
LAMP = rectangle_light("lamp", 0.5, 0.5, (1, 1, 1), (0, 0, 2), (0, 0, 0))
PLANE = area_light.make_light_plane(LAMP, 3, 3)
ONES = np.ones((3, 3))
LIGHT = ("--position", "0,0,2", "--target", "0,0,0")
TINY = ("--size", "16x9", "--device", "cpu")

pytestmark = pytest.mark.filterwarnings("ignore:mesh 'still scene' is open")


@pytest.fixture(scope="module")
def scene() -> StillScene:
    return join_pieces([box((-3, -3, -0.1), (3, 3, 0)), ball((0, 0, 0.5), 0.5)], [camera_at((0, -3, 2), (0, 0, 0))])


@pytest.fixture(scope="module")
def other() -> StillScene:
    """As many surfaces as `scene`, one vertex elsewhere."""
    return join_pieces([box((-3, -3, -0.2), (3, 3, 0)), ball((0, 0, 0.5), 0.5)], [camera_at((0, -3, 2), (0, 0, 0))])


def bake_slab(still: StillScene, plane=PLANE, size: int = 17):
    return area_light.bake_shadow_slab(still, plane, size, device="cpu")


def bake_map(still: StillScene, width=17, height=17):
    return area_light.bake_scene_map(still, 0, width, height, device="cpu")


def make_view(still: StillScene, plane=PLANE) -> area_light.SlabView:
    return area_light.SlabView(bake_map(still), [bake_slab(still, plane)], device="cpu")


@contextmanager
def refused(error: type[Exception], words: str) -> Iterator[None]:
    """Raises one sentence that holds the words."""
    with pytest.raises(error, match=words) as caught:
        yield
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 400


# Scenes


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"model": "model.xml"}, "model is a str; give a mujoco.MjModel"),
        ({"scene_option": "all"}, "scene_option is a str; give a mujoco.MjvOption"),
        ({"cameras": "front"}, "cameras is 'front'; give a list"),
        ({"cameras": None}, "cameras is None; give a list"),
        ({"cameras": -1}, "cameras is -1; give a list"),
    ],
)
def test_what_is_no_state_is_not_frozen(arguments, words):
    with refused(TypeError, words):
        psf.freeze_scene(**{"model": mujoco.MjModel.from_xml_string(MODEL)} | arguments)


@pytest.mark.parametrize(
    "albedo", [(NAN, 1, 1), (1e300, 0, 0), (-1, 0, 0), (1, 1), "red", None, (1j, 0, 0), [[1], [1, 2]]]
)
def test_an_albedo_is_three_shares(albedo):
    with refused(ValueError, "albedo of the still scene is .*; give 3 numbers from 0 to 1"):
        make_still(CORNERS, FACES, albedo)


@pytest.mark.parametrize("cameras", [CAMERA, "front", ["front"], None])
def test_cameras_of_a_scene_are_cameras(cameras):
    with refused(TypeError, "cameras of a still scene must be a list of Camera"):
        make_still(CORNERS, FACES, cameras=cameras)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"position": np.full(3, NAN)}, "pose is none"),
        ({"rotation": np.zeros((3, 3))}, "pose is none"),
        ({"rotation": np.eye(2)}, "pose is none"),
        ({"half_height": 0.0}, "film is none"),
        ({"half_height": NAN}, "film is none"),
        ({"center": (NAN, 0.0)}, "film is none"),
        ({"near": 2.0, "far": 1.0}, "film is none"),
    ],
)
def test_a_camera_sees_from_somewhere(scene, change, words):
    """Its rays would have no direction; a film of no height made maps of no width, which were read out of bounds."""
    camera = replace(CAMERA, **change)
    blind = replace(scene, cameras=(camera,))
    for bake in (bake_slab, bake_map):
        with refused(ValueError, words):
            bake(blind)
    with refused(ValueError, words):
        area_light.splat_points(area_light.upload_points(points.sample_points(scene), "cpu"), camera, 8, 8)


@pytest.mark.parametrize(
    ("action", "words"),
    [
        (lambda: bake_slab("model.xml"), "scene is a str; give a StillScene"),
        (lambda: bake_map(None), "scene is a NoneType; give a StillScene"),
        (lambda: bake_slab(make_still(CORNERS, FACES), LAMP), "plane is a AreaLight; give a LightPlane"),
        (lambda: area_light.make_light_plane(PLANE, 3, 3), "light is a LightPlane; give a AreaLight"),
        (lambda: area_light.sample_points(MODEL), "scene is a str; give a StillScene"),
        (lambda: area_light.bake_layered_map(make_still(CORNERS, FACES), PLANE), "light is a LightPlane"),
        (lambda: area_light.upload_points(make_still(CORNERS, FACES)), "lists is a StillScene; give a PointLists"),
        (
            lambda: area_light.splat_points(points.sample_points(make_still(CORNERS, FACES)), CAMERA, 8, 8),
            "points is a PointLists; give a DevicePoints",
        ),
        (lambda: next(area_light.play_script("s.json", make_still(CORNERS, FACES))), "script is a str; give a Script"),
    ],
)
def test_what_is_taken_for_something_else_is_named(action, words):
    with refused(TypeError, words):
        action()


# Slabs


@pytest.mark.parametrize("name", ["center", "right", "up"])
@pytest.mark.parametrize("value", ["abc", [[1], [1, 2]], (0, 0, 1j), (1e7, 0, 0), (0, 1e300, 0)])
def test_a_light_plane_lies_within_what_maps_see(name, value):
    good = {"center": (0, 0, 2), "right": (1, 0, 0), "up": (0, 1, 0)}
    with refused(ValueError, f"{name} of a light plane is .*; give"):
        area_light.LightPlane(**good | {name: value}, rows=3, columns=3)


@pytest.mark.parametrize("rows", [True, 10**4000])
def test_rows_of_a_light_plane_are_few(rows):
    with refused(ValueError, "rows of a light plane is"):
        area_light.LightPlane(*np.array([[0, 0, 2], [1, 0, 0], [0, 1, 0]]), rows, 3)


@pytest.mark.parametrize("radius", [0.005, 0.02, 0.1])
def test_a_map_covers_what_few_rays_of_the_camera_meet(radius):
    """Rays are 42 mm apart there: they say too little of how wide a ball is, one of them nothing, and none less."""
    spacing = 2.0 * np.tan(np.radians(20)) * np.sqrt(13.0) / 63
    # Where one of the rays goes, but for the smallest ball, which lies between four.
    middle = 0.5 * spacing * np.array([1, 2 / np.sqrt(13), 3 / np.sqrt(13)]) * (radius > 0.01)
    still = join_pieces([ball(middle, radius)], [camera_at((0, -3, 2), (0, 0, 0))])
    plane = area_light.LightPlane(middle + np.array([0, 0, 2]), np.array([0.1, 0, 0]), np.array([0, -0.1, 0]), 1, 1)
    # The ball's middle is 2 m below the one sample.
    assert bake_slab(still, plane).half >= radius / 2.0
    # It is convex, and hides from the lamp only what turns away from it.
    view = make_view(still, plane)
    view.set_light(0, [[1.0]])
    assert np.isfinite(view.attenuation()).all()


def test_a_map_of_what_lies_far_aside_has_a_width():
    aside = area_light.LightPlane((100, 100, 0.5), (0.1, 0, 0), (0, -0.1, 0), 1, 1)
    assert bake_slab(join_pieces([ball((0, 0, 0), 0.01)], []), aside).half > 0.0


def test_large_maps_grow_one_by_one():
    """Each needs a table of all its 17 million places while it grows."""
    together = []

    def sample(maps, column, row):
        together.append(len(np.unique(maps)))
        return (np.zeros(len(maps), np.float32),)

    quadtree.grow_quadtrees(2, 4097, 0, sample, lambda cells, corners: np.zeros(len(cells), bool))
    assert together == [1, 1]


def test_samples_too_many_are_refused(scene, monkeypatch):
    plane = area_light.make_light_plane(LAMP, 64, 64)
    with refused(ValueError, "the maps have more than 200000000 samples"):
        area_light.bake_shadow_slab(scene, plane, 4097, preset=12, device="cpu")
    # Full maps would pass, but for what the scene's edges add.
    monkeypatch.setattr(quadtree, "MOST_SAMPLES", 9 * 5**2)
    with refused(ValueError, "the maps have more than 225 samples"):
        area_light.bake_shadow_slab(scene, PLANE, 65, preset=2, device="cpu")


@pytest.mark.parametrize("template", ["abc", [[1], [1, 2]], ONES * 1j, ONES * NAN, ONES * 1e300, ONES[:2], None])
def test_a_template_that_is_none_leaves_the_light_as_it_was(scene, template):
    view = make_view(scene)
    assert (view.set_light(0, ONES), view.set_light(0, ONES)) == (9, 0)
    before = view.picture()
    with refused(ValueError, "template"):
        view.set_light(0, template)
    np.testing.assert_array_equal(view.picture(), before)
    np.testing.assert_array_equal(view.template(0), np.ones((3, 3, 3)))


@pytest.mark.parametrize("light", [1, -1, "lamp", 0.0, None])
def test_lights_of_a_view_have_numbers(scene, light):
    view = make_view(scene)
    for ask in (lambda: view.set_light(light, ONES), lambda: view.template(light), lambda: view.states(light)):
        with refused(IndexError, f"there is no light {light!r}; the view has 1"):
            ask()


def test_maps_of_two_scenes_are_not_mixed(scene, other):
    with refused(ValueError, "slab 1 is of another scene than the scene map"):
        area_light.SlabView(bake_map(scene), [bake_slab(scene), bake_slab(other)], device="cpu")
    # Another viewpoint is no other scene.
    area_light.SlabView(bake_map(replace(scene, cameras=(CAMERA,))), [bake_slab(scene)], device="cpu")
    layers = area_light.bake_layered_map(scene, LAMP, 8, samples=4, device="cpu")
    with refused(ValueError, "the layered map is of another scene"):
        area_light.upload_layers(layers, other, "cpu")


@pytest.mark.parametrize("slabs", [(), None, "slab"])
def test_a_view_has_slabs(scene, slabs):
    with pytest.raises((ValueError, TypeError), match="bake_shadow_slab"):
        area_light.SlabView(bake_map(scene), slabs, device="cpu")
    with refused(ValueError, "slabs must be a list"):
        area_light.SlabView(bake_map(scene), bake_slab(scene), device="cpu")


def test_a_sample_as_large_as_a_country_sends_what_a_sky_does(scene):
    """A Lambert sky of radiance L causes the irradiance pi L, and albedo times L is reflected: the sum held no more."""
    sky = area_light.LightPlane((0, 0, 3), (1e6, 0, 0), (0, -1e6, 0), 1, 1)
    view = make_view(scene, sky)
    view.set_light(0, [[1e8]])
    # Half a unit of the fixed point is nothing here; float32 keeps 1e-7.
    assert view.shadowless().max() == pytest.approx(0.8e8, rel=1e-6)
    assert view.picture().min() >= 0.0


def test_a_point_on_a_sample_is_no_singularity(scene):
    """The middle sample lies on the ball's pole, where form factors of points have no bound."""
    touching = area_light.LightPlane((0, 0, 1.0), (0.5, 0, 0), (0, -0.5, 0), 3, 3)
    above = replace(scene, cameras=(replace(CAMERA, position=np.array([0.0, 0.0, 1.0 + 1e-4]), rotation=np.eye(3)),))
    view = make_view(above, touching)
    view.set_light(0, ONES * 1e8)
    assert np.isfinite(view.picture()).all() and view.picture().min() >= 0.0


def test_a_camera_on_a_surface_sees_it_there(scene):
    on_floor = replace(CAMERA, position=np.array([1.0, -1.0, 0.0]), rotation=np.eye(3))
    pixels = retrieve_pixels(bake_map(replace(scene, cameras=(on_floor,))), find_device("cpu"))
    np.testing.assert_allclose(pixels.position.numpy()[0], np.tile([1.0, -1.0, 0.0], (17 * 17, 1)), atol=1e-6)


# Pictures


def test_sizes_of_any_whole_type_will_do(scene):
    """Products of NumPy's 32-bit numbers have neither Python's methods nor its range."""
    width, height = np.int32(8), np.int32(6)
    assert area_light.splat_points(
        area_light.upload_points(points.sample_points(scene), "cpu"), CAMERA, width, height
    ).color.shape == (6, 8, 3)
    layers = area_light.upload_layers(
        area_light.bake_layered_map(scene, LAMP, 8, samples=4, device="cpu"), scene, "cpu"
    )
    for draw in (area_light.project_forward, area_light.retrieve_backward, area_light.trace_view):
        assert draw(layers, CAMERA, width, height).color.shape == (6, 8, 3)
        with refused(ValueError, "a picture of 16384 x 16384 pixels is too large"):
            draw(layers, CAMERA, 16384, 16384)
    assert bake_map(scene, width, height).share > 0.0


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"levels": 3.0}, "levels is 3.0; give 1 to 6"),
        ({"levels": np.array([1, 2])}, "levels is array"),
        ({"smallest": "0.1"}, "smallest is '0.1'; give the side"),
        ({"smallest": 1e300}, "smallest is 1e\\+300; give the side"),
        ({"smallest": 1e308}, "smallest is 1e\\+308; give the side"),
    ],
)
def test_squares_have_a_side(options, words):
    with refused(ValueError, words):
        points.sample_points(make_still(CORNERS, FACES), **options)


def test_a_layered_map_is_of_a_light_that_reaches_the_scene(scene):
    bright = rectangle_light("bright", 1, 1, (1e300, 1, 1), (0, 0, 2), (0, 0, 0))
    large = rectangle_light("large", 1e20, 1e20, (1, 1, 1), (0, 0, 2), (0, 0, 0))
    for light in (bright, large):
        with refused(ValueError, f"light '{light.name}' is too bright, large or far away"):
            area_light.bake_layered_map(scene, light, 8, samples=4, device="cpu")
    sun = DeltaLight("sun", "point", *np.eye(3)[[0, 1]], *np.ones((3, 3)))
    with refused(TypeError, "light is a DeltaLight; give a AreaLight"):
        area_light.bake_layered_map(scene, sun, 8, device="cpu")
    inside = make_still([[0, 0, 0.2], [1e-3, 0, 0.2], [0, 1e-3, 0.2]], FACES)
    with refused(ValueError, "nothing of the scene is before light 'lost'"):
        area_light.bake_layered_map(
            inside, sphere_light("lost", 0.1, (1, 1, 1), (9e5, 0, 0)), 8, samples=4, device="cpu"
        )


# Scripts

PLAIN = {
    "cameras": ["front"],
    "lights": {
        "lamp": {"position": [0, 0, 1.7], "target": [0, 0, 0], "width": 0.7, "height": 0.7, "rows": 3, "columns": 3}
    },
    "steps": [{"lamp": {"side": 0.4, "radiance": [90, 80, 70]}}],
}


def written(folder, text: str, encoding: str = "utf-8"):
    path = folder / "script.json"
    path.write_text(text, encoding=encoding)
    return path


def test_a_script_may_begin_with_a_byte_order_mark(tmp_path):
    assert area_light.read_script(written(tmp_path, json.dumps(PLAIN), "utf-8-sig")).frames == 1


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[" * 100_000, "is no JSON file"),
        ("[" * 900 + "]" * 900, "the script is .*; give an object"),
        (json.dumps({"z" * 1_000_000: 1}), "which is unknown; it may have cameras"),
        (json.dumps({f"key {place}": 1 for place in range(2000)}), "which is unknown"),
        (json.dumps(PLAIN).replace('"side": 0.4', '"shape": ["square"]'), "shape .* is unknown; choose square"),
        (json.dumps(PLAIN).replace('"side": 0.4', '"shape": {}'), "shape {} is unknown; choose square"),
        (json.dumps(PLAIN).replace('"side": 0.4', '"side": NaN'), "side is nan; give a number"),
        (json.dumps(PLAIN).replace("90", "1e999"), "radiance is .*; give 3 numbers"),
        (json.dumps(PLAIN).replace("[0, 0, 1.7]", json.dumps(list(range(100_000)))), "position is .*; give 3 numbers"),
        (json.dumps(PLAIN).replace('"rows": 3', '"rows": 1' + "0" * 4000), "rows of a light plane is"),
        (json.dumps(PLAIN).replace('"rows": 3', '"rows": true'), "rows of a light plane is True"),
        (json.dumps(PLAIN | {"steps": [{"frames": 10**4000}]}), "frames are more than 1000000"),
    ],
)
def test_a_script_that_is_none_is_told_so_in_short(tmp_path, text, words):
    with refused(ValueError, words):
        area_light.read_script(written(tmp_path, text))


def test_a_picture_that_cannot_be_is_refused_before_slabs_are_baked(tmp_path, scene, monkeypatch):
    monkeypatch.setattr(script, "bake_shadow_slab", lambda *_, **__: pytest.fail("slabs take minutes"))
    played = area_light.read_script(written(tmp_path, json.dumps(PLAIN)))
    with refused(ValueError, "width is 5000; give a whole number of pixels"):
        next(area_light.play_script(played, scene, 5000, 3, device="cpu"))


# The command line


def test_options_of_a_film_are_refused_before_slabs_are_baked(model_path, tmp_path, monkeypatch):
    monkeypatch.setattr(script, "bake_shadow_slab", lambda *_, **__: pytest.fail("slabs take minutes"))
    play = ("slab", model_path, written(tmp_path, json.dumps(PLAIN)), "--out", tmp_path / "out", *TINY)
    for option, value in (("--fps", 0), ("--formats", "gif"), ("--exposure", 1e9), ("--view", "film")):
        assert_refused(run(*play, option, value))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("command", ["layered", "points"])
@pytest.mark.parametrize("option", [("--view", "film"), ("--exposure", "nan"), ("--size", "16384x16384")])
def test_a_still_picture_that_cannot_be_leaves_nothing(model_path, tmp_path, command, option):
    light = LIGHT if command == "layered" else ()
    assert_refused(run(command, model_path, "--out", tmp_path / "out", *light, *TINY, *option))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("names", "chosen"), [(("a/b", "a_b"), ()), (("free",), ("--camera", "free", "--camera", "-1"))]
)
def test_no_picture_is_written_over_another(tmp_path, names, chosen):
    cameras = "".join(f'<camera name="{name}" pos="0 -3 1"/>' for name in names)
    (tmp_path / "model.xml").write_text(MODEL.replace("<worldbody>", f"<worldbody>{cameras}").replace('"front"', '"x"'))
    result = run("points", tmp_path / "model.xml", "--out", tmp_path / "out", *TINY, *chosen)
    assert_refused(result, "2 cameras would write", "choose one with --camera")
    assert not (tmp_path / "out").exists()


def test_an_open_mesh_is_told_of_once(tmp_path):
    (tmp_path / "leaf.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        result = run("points", tmp_path / "leaf.obj", "--out", tmp_path / "out", *TINY)
    assert result.exit_code == 0 and result.stderr.count("is open") == 1
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"leaf.png", "leaf.exr"}


@pytest.mark.parametrize("option", [("--exposure", "nan"), ("--exposure", "6"), ("--host", "")])
def test_a_viewer_that_cannot_be_is_refused(model_path, option):
    assert_refused(run("view", model_path, "--port", 0, "--device", "cpu", *option), option[0])


@pytest.mark.parametrize("option", [("--port", "-1"), ("--port", "65536"), ("--port", "web"), ("--samples", "0")])
def test_numbers_of_a_viewer_have_bounds(model_path, option):
    result = run("view", model_path, "--slab", *option)
    assert result.exit_code == 2 and "Traceback" not in result.output and option[0] in result.output


@pytest.mark.parametrize(
    ("program", "words"),
    [
        ("x = (", "is no Python program"),
        ("\0", "is no Python program"),
        ("def build(): return 3\ndef states(model, fps): yield None", "build() returned a int"),
        ("def build(): return 3\ndef states(model, fps): yield None\nlights = ()", "lights must be functions"),
    ],
)
def test_a_program_that_is_no_simulation_is_told_so(tmp_path, program, words):
    (tmp_path / "sim.py").write_text(program)
    assert_refused(run("view", tmp_path / "sim.py", "--port", 0, "--device", "cpu"), "sim.py", words)
