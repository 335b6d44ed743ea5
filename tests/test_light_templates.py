"""Shapes of area lights on a plane of samples, and scripts that change them."""

import json

import numpy as np
import pytest

from tests.test_slab import camera_at
from warp_psf.area_light import templates
from warp_psf.area_light.script import play_script, read_script
from warp_psf.scene.still import StillScene, make_still

LAMP = {"position": [0, 0, 2], "target": [0, 0, 0], "width": 1.0, "height": 1.0, "rows": 8, "columns": 8}
SCRIPT = {
    "cameras": ["front", "side"],
    "lights": {"lamp": LAMP},
    "steps": [
        {"lamp": {"shape": "square", "side": 0.25, "at": [-0.5, 0.0], "radiance": [8, 8, 8]}},
        {"frames": 4, "lamp": {"at": [0.5, 0.0]}},
        {"frames": 2, "camera": "side", "lamp": {"radiance": [0, 4, 8]}},
        {"lamp": {"on": False}},
    ],
}


@pytest.fixture
def write(tmp_path):
    def write(content):
        path = tmp_path / "script.json"
        path.write_text(content if isinstance(content, str) else json.dumps(content))
        return path

    return write


@pytest.fixture(scope="module")
def scene() -> StillScene:
    corners, faces = [[-2, -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0]], [[0, 1, 2], [0, 2, 3]]
    return make_still(corners, faces, cameras=[camera_at((0, -4, 3), (0, 0, 0)), camera_at((4, 0, 3), (0, 0, 0))])


@pytest.mark.parametrize("at", [(0.0, 0.0), (0.13, -0.4), (-0.5, 0.31)])
def test_a_square_keeps_its_light_wherever_it_stands(at):
    """Cells are lit by the share that the square covers: their sum is its area, 0.3 x 9 samples squared."""
    assert templates.square(9, 13, 0.3, at).sum() == pytest.approx(2.7**2, rel=1e-6)


def test_shapes_lie_as_they_are_described():
    square = templates.square(8, 8, 0.25, (0.75, 0.75))
    # Right is to larger columns, up to smaller rows.
    assert square[:2, 6:].min() == 1.0 and square.sum() == 4.0
    line = templates.line(7, 7, np.pi / 2)
    assert (line[:, 3] == 1.0).all() and line.sum() == pytest.approx(7)
    ring = templates.ring(33, 33)
    y, x = np.mgrid[-16:17, -16:17] / 16.5
    np.testing.assert_allclose(np.hypot(x, y)[ring > 0].mean(), 0.7, atol=0.02)
    # A ring's light is its area, 2 pi r w, to what its rims' steps leave.
    assert ring.sum() == pytest.approx(2 * np.pi * 0.7 * 0.25 * 16.5**2, rel=0.02)
    letters = templates.letters(15, 31, "PSF")
    assert letters[:, :2].any() or letters[0].any()
    assert 0.1 < (letters > 0.5).mean() < 0.6


def test_empty_letters_are_refused():
    with pytest.raises(ValueError, match="empty"):
        templates.letters(9, 9, " ")


def test_a_script_moves_fades_and_looks_elsewhere(write, scene):
    frames = list(play_script(read_script(write(SCRIPT)), scene, 24, 24, size=17))
    assert [frame.camera for frame in frames] == [0, 0, 0, 0, 0, 1, 1, 1]
    # The floor is lit through nothing: the brightest place of the picture follows the light from left to right.
    columns = [np.average(np.arange(24), weights=frame.color.sum(axis=(0, 2)) ** 4) for frame in frames[:5]]
    assert (np.diff(columns) > 0.2).all()
    assert frames[2].attenuation.min() == 1.0
    # Halfway to (0, 4, 8), and there.
    np.testing.assert_allclose(frames[5].color.sum(axis=(0, 1)) / frames[5].color.sum() * 18, (4, 6, 8), rtol=1e-4)
    assert frames[6].color[..., 0].max() == 0.0 < frames[6].color[..., 1].max()
    assert not frames[7].color.any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"steps": []}, "steps must be a list"),
        ({"cameras": []}, "cameras must be a list"),
        ({"lights": {"camera": LAMP}}, "none of them called frames or camera"),
        ({"lights": {"lamp": {**LAMP, "rows": 0}}}, "light 'lamp': rows"),
        ({"lights": {"lamp": {**LAMP, "width": -1}}}, "light 'lamp'"),
        ({"lights": {"lamp": {"rows": 3}}}, "lacks columns, height, position, target, width"),
        ({"steps": [{"frames": 0}]}, "step 1: frames is 0"),
        ({"steps": [{}, {"camera": "back"}]}, "step 2: camera 'back' is not among front, side"),
        ({"steps": [{"lamp": {"shape": "star"}}]}, "step 1: lamp: shape 'star' is unknown; choose square"),
        ({"steps": [{"lamp": {"on": 1}}]}, "give true or false"),
        ({"steps": [{"lamp": {"text": ""}}]}, "give 1 to 64 letters"),
        ({"steps": [{"lamp": {"radiance": [1, 2]}}]}, "give 3 numbers"),
        ({"steps": [{"lamp": {"radiance": [1, 2, -3]}}]}, "below 0"),
        ({"steps": [{"lamp": {"side": True}}]}, "give a number"),
        ({"steps": [{"lamp": {"sides": 1}}]}, "'sides', which is unknown"),
        ({"steps": [{"lamp": 3}]}, "give an object"),
        ({"steps": [{"frames": 2000000}]}, "shorten the steps"),
        ({"speed": 1}, "'speed', which is unknown"),
    ],
)
def test_what_a_script_says_wrongly_is_said(write, change, message):
    with pytest.raises(ValueError, match=message):
        read_script(write(SCRIPT | change))


def test_files_that_are_no_scripts_are_refused(write, tmp_path):
    with pytest.raises(FileNotFoundError, match="does not exist"):
        read_script(tmp_path / "none.json")
    for content in ("{", "[" * 100_000, "[1]", '"a"'):
        with pytest.raises(ValueError, match=r"script\.json"):
            read_script(write(content))


def test_a_scene_with_other_cameras_is_refused(write, scene):
    floor = make_still(scene.vertices, scene.faces)
    with pytest.raises(ValueError, match="0 cameras, the script 2"):
        next(play_script(read_script(write(SCRIPT)), floor))
