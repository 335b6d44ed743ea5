"""The command line's light that changes, its viewer, and what still pictures and comparisons refuse."""

from __future__ import annotations

import json
import sys

import mujoco
import numpy as np
import pytest

import warp_psf.viewer
from tests.flat_renderer import MODEL, FlatRenderer, assert_refused, model_path, renderers, run
from tests.test_cli import three_states
from warp_psf import cli
from warp_psf.cli.viewing import read_simulation
from warp_psf.film.writer import write_exr
from warp_psf.scene.environment import load_environment

__all__ = ["model_path", "renderers"]

MESH = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
LIGHT = ("--position", "0,0,2", "--target", "0,0,0")


# Light that changes


def render_under(environment, out, monkeypatch) -> int:
    """Renders three frames of a simulation under an environment; returns the exit status."""
    small = ["--size", "32x18", "--frames", ":3", "--fps", "10", "--formats", "png"]
    monkeypatch.setattr(sys, "argv", ["sims.fall", *small, "--out", str(out)])
    with pytest.raises(SystemExit) as ending:
        cli.run_simulation(
            lambda: mujoco.MjModel.from_xml_string(MODEL),
            three_states,
            name="fall",
            camera="front",
            environment=environment,
        )
    return int(ending.value.code or 0)


def test_light_that_changes_is_that_of_each_frame_s_time(renderers, tmp_path, monkeypatch):
    lights = []

    class LitRenderer(FlatRenderer):
        """Remembers the light of each picture."""

        environment: np.ndarray

        def render(self) -> np.ndarray:
            lights.append(float(self.environment[0, 0, 0]))
            return super().render()

    monkeypatch.setattr(warp_psf, "Renderer", LitRenderer, raising=False)
    assert render_under(lambda time: np.full((1, 2, 3), 1.0 + time), tmp_path / "out", monkeypatch) == 0
    assert lights == pytest.approx([1.0, 1.1, 1.2])
    assert renderers[-1].options["environment"] is None  # each frame brings its own


def test_frames_of_lights_that_change_otherwise_are_not_mixed(renderers, tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    assert render_under(lambda time: np.full((1, 2, 3), 1.0 + time), out, monkeypatch) == 0
    assert render_under(lambda time: np.full((1, 2, 3), 1.0 + time), out, monkeypatch) == 0
    assert render_under(lambda time: np.full((1, 2, 3), 1.0 + 2 * time), out, monkeypatch) == 2
    assert "environment was" in capsys.readouterr().err


def test_frames_of_other_environments_are_not_mixed(renderers, tmp_path, monkeypatch, capsys):
    """An environment that is an object is told by its pixels, not by its name."""
    pixels = np.ones((2, 4, 3), np.float32)
    assert render_under(load_environment(pixels), tmp_path / "out", monkeypatch) == 0
    assert render_under(load_environment(pixels.copy()), tmp_path / "out", monkeypatch) == 0
    pixels[1, 3, 2] = 2.0
    assert render_under(load_environment(pixels), tmp_path / "out", monkeypatch) == 2
    assert "environment was" in capsys.readouterr().err


# The viewer


class FakeViewer:
    """Remembers how it was opened; nobody comes."""

    url = "http://127.0.0.1:9"
    opened: dict
    waited = closed = False

    def __enter__(self) -> FakeViewer:
        return self

    def __exit__(self, *_) -> None:
        self.closed = True

    def wait(self) -> None:
        self.waited = True


@pytest.fixture
def viewer(monkeypatch) -> FakeViewer:
    made = FakeViewer()

    def open_viewer(model, states, **options) -> FakeViewer:
        made.opened = {"model": model, "states": states} | options
        return made

    monkeypatch.setattr(warp_psf.viewer, "open_viewer", open_viewer)
    return made


def test_options_reach_the_viewer(viewer, model_path):
    flags = ("--environment", "none", "--order", 5, "--basis", "haar", "--bounces", 2, "--size", "40x30", "--slab")
    rest = ("--samples", 4, "--camera", "front", "--exposure", "1.5", "--fps", 25, "--port", 0, "--device", "cpu")
    result = run("view", model_path, *flags, *rest)
    assert result.exit_code == 0, result.output
    assert f"{model_path} is shown at {viewer.url} until Ctrl-C is pressed" in result.stdout
    assert viewer.waited and viewer.closed
    expected = {"environment": None, "lights": (), "basis": "haar", "bounces": 2, "camera": "front", "port": 0}
    expected |= {"frames_per_second": 25, "pixels": 1200, "slab": (4, 4), "host": "127.0.0.1", "device": "cpu"}
    assert viewer.opened.items() >= expected.items()
    assert (viewer.opened["look"].order, viewer.opened["look"].exposure) == (5, 1.5)
    assert viewer.opened["model"].camera("front").id == 0


def test_a_viewed_simulation_brings_its_own_light_unless_told_otherwise(viewer):
    assert run("view", "cubes", "--port", 0).exit_code == 0
    own = viewer.opened["environment"]
    assert [light.name for light in viewer.opened["lights"]] == ["lamp"]
    assert run("view", "cubes", "--port", 0, "--environment", "sky").exit_code == 0
    assert viewer.opened["environment"] == "sky" and own != "sky"


def test_a_viewed_model_starts_in_its_keyframe(tmp_path):
    path = tmp_path / "keyed.xml"
    key = '<keyframe><key name="high" qpos="0 0 5 1 0 0 0"/></keyframe>'
    path.write_text(MODEL.replace("</mujoco>", f"{key}</mujoco>"))
    for keyframe, height in (("high", 5.0), (None, 1.0)):
        seen = read_simulation(str(path), keyframe)
        assert next(seen.states(seen.model, 30)).qpos[2] == pytest.approx(height)
    assert_refused(run("view", path, "--keyframe", "low", "--port", 0), "low", "high")


def test_a_simulation_that_lacks_a_package_says_which(tmp_path, monkeypatch):
    (tmp_path / "lacking_sim.py").write_text("import a_package_that_nobody_has\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert_refused(
        run("view", "lacking_sim", "--port", 0), "lacking_sim cannot be imported", "a_package_that_nobody_has"
    )


# Still pictures and comparisons


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--camera", "front"), ("corner.obj", "has no cameras", "leave --camera out")),
        (("--size", "wide"), ("--size wide", "must be")),
    ],
)
def test_points_of_a_mesh_refuse_what_it_has_not(tmp_path, arguments, words):
    (tmp_path / "corner.obj").write_text(MESH)
    assert_refused(run("points", tmp_path / "corner.obj", "--out", tmp_path / "out", *arguments), *words)
    assert not (tmp_path / "out").exists()


def test_a_file_in_the_place_of_the_folder_is_named(tmp_path):
    (tmp_path / "corner.obj").write_text(MESH)
    (tmp_path / "out").write_text("mine")
    result = run("points", tmp_path / "corner.obj", "--out", tmp_path / "out")
    assert_refused(result, "out could not be written", "choose another folder")
    assert (tmp_path / "out").read_text() == "mine"


@pytest.mark.parametrize("place", ["0,0,high", "0,0,inf", "0,0,0,0", "", "0,0,1e9"])
def test_a_place_that_is_none_is_refused(model_path, tmp_path, place):
    light = ("--position", place, *LIGHT[2:])
    assert_refused(run("layered", model_path, "--out", tmp_path / "out", *light), "must be 3 numbers", "1,1,1")


def test_what_has_no_colour_is_not_compared(tmp_path):
    for name in ("near.exr", "far.exr"):
        write_exr(tmp_path / name, {"depth": np.ones((2, 3), np.float32)})
    (tmp_path / "a.txt").write_text("grey")
    (tmp_path / "b.txt").write_text("grey")
    exrs, notes = ((tmp_path / a, tmp_path / b) for a, b in (("near.exr", "far.exr"), ("a.txt", "b.txt")))
    assert_refused(run("compare", *exrs), "near.exr", "only colour is compared")
    assert_refused(run("compare", *notes), "a.txt", "neither an EXR nor a PNG")


def test_settings_of_a_moving_light_are_plain(renderers, tmp_path, monkeypatch):
    assert render_under(lambda time: np.full((1, 2, 3), time), tmp_path / "out", monkeypatch) == 0
    kept = json.loads((tmp_path / "out" / "settings.json").read_text())["settings"]["environment"]
    assert len(kept) == 12 and int(kept, 16) >= 0
