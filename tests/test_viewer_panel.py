"""The controls beside the viewer's picture: what each of them changes, without a browser."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

from tests.test_viewer import EYE, FPS, LARGE, MODEL, FakeScene, session_of
from warp_psf.area_light import templates
from warp_psf.bridge import freeze_scene, read_camera
from warp_psf.motion import simulate
from warp_psf.viewer import Look
from warp_psf.viewer.eye import eye_of_camera, find_viewpoints
from warp_psf.viewer.panel import add_light_panel, add_picture_panel
from warp_psf.viewer.session import Session
from warp_psf.viewer.slab_panel import SlabPanel
from warp_psf.viewer.slab_scene import MOST_VIEWS, SlabScene, fit_light_plane
from warp_psf.viewer.web import Viewer


class FakeHandle:
    """A control that holds a value and tells it on."""

    def __init__(self, value: Any = None, options: tuple[str, ...] = ()):
        self.value, self.options = value, options

    def on_update(self, listener):
        self._listener = listener
        return listener

    on_click = on_update

    def set(self, value: Any, client: Any = None) -> None:
        """As a person sets it."""
        self.value = value
        asyncio.run(self._listener(SimpleNamespace(target=self, client=client)))

    def __enter__(self) -> FakeHandle:
        return self

    def __exit__(self, *_) -> None:
        pass


class FakeGui:
    """Makes controls, and finds them by their labels."""

    def __init__(self):
        self.controls: dict[str, FakeHandle] = {}

    def add_folder(self, label: str) -> FakeHandle:
        return FakeHandle()

    def add_html(self, content: str) -> None:
        pass

    def add_slider(self, label: str, low: float, high: float, step: float, initial_value: float, **_) -> FakeHandle:
        return self._keep(label, FakeHandle(initial_value))

    def add_checkbox(self, label: str, initial_value: bool, **_) -> FakeHandle:
        return self._keep(label, FakeHandle(initial_value))

    def add_text(self, label: str, initial_value: str) -> FakeHandle:
        return self._keep(label, FakeHandle(initial_value))

    def add_dropdown(self, label: str, options: tuple[str, ...], *, initial_value: str, **_) -> FakeHandle:
        return self._keep(label, FakeHandle(initial_value, options))

    def add_button_group(self, label: str, options: tuple[str, ...]) -> FakeHandle:
        return self._keep(label, FakeHandle(None, options))

    def _keep(self, label: str, handle: FakeHandle) -> FakeHandle:
        self.controls[label] = handle
        return handle


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(MODEL)


@pytest.fixture(scope="module")
def data(model) -> mujoco.MjData:
    state = mujoco.MjData(model)
    mujoco.mj_forward(model, state)
    return state


@pytest.fixture
def gui() -> FakeGui:
    return FakeGui()


def test_controls_start_at_the_look_and_change_it(model, data, gui):
    scene = FakeScene()
    scene.layers = ("color", "depth")
    session = session_of(model, scene)
    session.choose(turn=30.0, order=5, exposure=-1.0)
    server: Any = SimpleNamespace(gui=gui)
    add_light_panel(server, session)
    add_picture_panel(server, session, find_viewpoints(model, data))
    shown = {label: control.value for label, control in gui.controls.items()}
    expected = {"Turn": 30.0, "Bounces": session.look.bounces, "Order": "5", "Layer": "color", "Exposure": -1.0}
    assert shown.items() >= expected.items()
    for label, value in {"Turn": -45.0, "Bounces": False, "Order": "3", "Layer": "depth", "Exposure": 2.5}.items():
        gui.controls[label].set(value)
    assert session.look == Look(turn=-45.0, bounces=False, order=3, layer="depth", exposure=2.5)


def test_look_from_places_the_browser_where_the_model_s_camera_is(model, data, gui):
    server: Any = SimpleNamespace(gui=gui)
    add_picture_panel(server, session_of(model, FakeScene()), find_viewpoints(model, data))
    assert gui.controls["Look from"].options == ("front", "top", "free")
    browser = SimpleNamespace(position=None, look_at=None, fov=None)
    gui.controls["Look from"].set("front", client=SimpleNamespace(camera=browser))
    camera = read_camera(model, data, "front")
    np.testing.assert_allclose(browser.position, camera.position)
    forward = np.subtract(browser.look_at, browser.position)
    np.testing.assert_allclose(forward / np.linalg.norm(forward), -camera.rotation[:, 2], atol=1e-12)
    assert browser.fov == camera.fovy
    # A click that no browser sent has no camera to place.
    gui.controls["Look from"].set("top")
    np.testing.assert_allclose(browser.position, camera.position)


def test_letters_are_painted_when_there_are_any(model, gui):
    scene: Any = FakeScene()
    scene.template = np.zeros((7, 9), np.float32)
    server: Any = SimpleNamespace(gui=gui)
    SlabPanel(server, session_of(model, scene), scene)
    np.testing.assert_array_equal(scene.template, templates.square(7, 9).astype(np.float32))
    gui.controls["Letters"].set("mj")
    written = templates.letters(7, 9, "mj").astype(np.float32)
    np.testing.assert_array_equal(scene.template, written)
    gui.controls["Letters"].set("  ")
    np.testing.assert_array_equal(scene.template, written)


def test_a_simulation_that_fails_halts_and_says_why(model):
    told: list[str] = []

    def states():
        yield next(simulate(model, FPS))
        raise ValueError("the recording has a gap at 0.05 s; cut it there")

    session = Session(FakeScene(), states, FPS, LARGE, report=told.append)
    before = session.data
    session.play(now=0.0)
    for tick in range(4):
        session.work(tick / FPS + 1e-6)
    assert not session.is_playing
    assert session.data is before
    assert told[-1] == "the recording has a gap at 0.05 s; cut it there"


def test_waiting_for_a_viewer_tells_what_ended_it(model, data):
    class FailingScene(FakeScene):
        failing = False

        def _draw(self, *asked: Any) -> dict[str, np.ndarray]:
            if self.failing:
                raise RuntimeError("the device is gone")
            return super()._draw(*asked)

    scene = FailingScene()
    session = session_of(model, scene, pixels=2000)
    with Viewer(session, find_viewpoints(model, data), port=0) as viewer:
        scene.failing = True
        session.watch(1, EYE, lambda shown: None)
        with pytest.raises(RuntimeError, match="the device is gone"):
            viewer.wait()


def test_windows_of_many_sizes_are_forgotten_oldest_first(model, data):
    still = freeze_scene(model, data)
    scene = SlabScene(still, fit_light_plane(still, (), 3, 3), size=65)
    scene.template = np.ones((3, 3), np.float32)
    eye = eye_of_camera(read_camera(model, data, "front"), 1.5)
    sizes = [600 + 200 * index for index in range(MOST_VIEWS + 1)]
    first = scene.picture(data, 0, eye, Look(), sizes[0])["color"]
    for pixels in sizes[1:]:
        scene.picture(data, 0, eye, Look(), pixels)
    assert [scene.is_quick(0, eye, Look(), pixels) for pixels in sizes] == [False] + [True] * MOST_VIEWS
    # What was forgotten is drawn again as it was.
    np.testing.assert_array_equal(scene.picture(data, 0, eye, Look(), sizes[0])["color"], first)
