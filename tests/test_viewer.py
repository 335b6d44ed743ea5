"""The web viewer: cameras, what is shown when, and a page in a headless Chromium."""

from __future__ import annotations

import io
import math
import shutil
import socket
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

import warp_psf as psf
from warp_psf.bridge import freeze_scene, read_camera
from warp_psf.cli import app
from warp_psf.cli.viewing import read_simulation
from warp_psf.motion import simulate
from warp_psf.viewer import Look, open_viewer
from warp_psf.viewer.develop import develop
from warp_psf.viewer.eye import Eye, eye_of_browser, eye_of_camera, find_viewpoints
from warp_psf.viewer.rendered import RenderedScene
from warp_psf.viewer.session import DRAFTS, STILL, Session, Shown
from warp_psf.viewer.slab_panel import OFF
from warp_psf.viewer.slab_scene import SlabScene, fit_light_plane
from warp_psf.viewer.web import check_free

MODEL = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <light pos="1 1 3" dir="-1 -1 -3"/>
    <camera name="front" pos="2 -3 2" xyaxes="3 2 0 -0.78 1.18 2.4" fovy="40"/>
    <camera name="top" pos="0.3 0.2 5" xyaxes="0.6 0.8 0 -0.8 0.6 0" fovy="50"/>
    <geom name="floor" type="box" size="2 2 0.1" pos="0 0 -0.1" rgba="0.8 0.7 0.6 1"/>
    <geom name="post" type="box" size="0.1 0.1 0.3" pos="-0.6 0 0.3" rgba="0.8 0.3 0.2 1"/>
    <body name="ball" pos="0 0 0.8">
      <freejoint/>
      <geom type="sphere" size="0.25" rgba="0.3 0.5 0.8 1"/>
    </body>
  </worldbody>
</mujoco>
"""
WIDTH, HEIGHT = 96, 64
FPS = 20.0
EYE = Eye((2.0, -3.0, 2.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), 0.7, 1.5)
LARGE = 4 * DRAFTS[-1]
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
# Chromium in a container, drawing without a graphics card.
BROWSER = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(MODEL)


@pytest.fixture(scope="module")
def data(model) -> mujoco.MjData:
    state = mujoco.MjData(model)
    mujoco.mj_forward(model, state)
    return state


class FakeScene:
    """Draws nothing, and remembers what it was asked to draw."""

    layers = ("color",)

    def __init__(self, quick: bool = False):
        self.asked: list[tuple[str, int, Eye, Look, int]] = []
        self.quick = quick

    def draft(self, data: Any, moment: int, eye: Eye, look: Look, pixels: int) -> dict[str, np.ndarray]:
        return self._draw("draft", moment, eye, look, pixels)

    def picture(self, data: Any, moment: int, eye: Eye, look: Look, pixels: int) -> dict[str, np.ndarray]:
        return self._draw("picture", moment, eye, look, pixels)

    def is_quick(self, moment: int, eye: Eye, look: Look, pixels: int) -> bool:
        return self.quick

    def close(self) -> None: ...

    def _draw(self, kind: str, moment: int, eye: Eye, look: Look, pixels: int) -> dict[str, np.ndarray]:
        self.asked.append((kind, moment, eye, look, pixels))
        width, height = eye.size(pixels)
        return {"color": np.zeros((height, width, 3), np.float32)}


def session_of(model: mujoco.MjModel, scene: Any, pixels: int = LARGE) -> Session:
    return Session(scene, lambda: simulate(model, FPS), FPS, pixels)


def settle(session: Session, now: float) -> float:
    """Works, waiting as long as the session asks for, until there is nothing more to do; returns what time it is."""
    for _ in range(100):
        pause = session.work(now)
        if pause is None:
            return now
        now += pause
    raise AssertionError("the session never comes to rest")


@pytest.mark.parametrize("camera", ["front", "top", -1])
def test_an_eye_sees_what_the_models_camera_sees(model, data, camera):
    scene = RenderedScene(model, bounces=1)
    eye = eye_of_camera(read_camera(model, data, camera), WIDTH / HEIGHT)
    depth = scene.picture(data, 0, eye, Look(), WIDTH * HEIGHT)["depth"]
    scene.close()
    with psf.Renderer(model, HEIGHT, WIDTH, bounces=0) as renderer:
        renderer.update_scene(data, camera=camera)
        expected = renderer.layers()["depth"]
    there = np.isfinite(expected)
    # The free camera's pose is rounded otherwise, by about 1e-6 of the distance: along edges, pixels may flip.
    same = there == np.isfinite(depth)
    assert same.mean() > 0.998
    both = there & np.isfinite(depth)
    close = np.abs(depth[both] - expected[both]) < 1e-3 * expected[both]
    assert close.mean() > 0.995


def test_a_browsers_camera_is_turned_about_its_own_x(model, data):
    camera = read_camera(model, data, "front")
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, (camera.rotation * [1.0, -1.0, -1.0]).ravel())
    browser = SimpleNamespace(
        position=camera.position, wxyz=quaternion, fov=camera.fovy, image_width=300, image_height=200
    )
    seen, expected = eye_of_browser(browser), eye_of_camera(camera, 1.5)
    assert np.allclose(seen.position, expected.position)
    # Rounding of a quaternion in float64.
    assert np.allclose(seen.forward, expected.forward, atol=1e-12)
    assert np.allclose(seen.up, expected.up, atol=1e-12)
    assert (seen.fovy, seen.aspect) == (camera.fovy, 1.5)
    assert np.allclose(seen.camera().rotation, camera.rotation, atol=1e-12)


def test_pictures_have_the_shape_of_the_window():
    for aspect in (0.25, 0.7, 16 / 9, 4.0):
        eye = Eye(EYE.position, EYE.forward, EYE.up, EYE.fovy, aspect)
        width, height = eye.size(57600)
        assert width * height == pytest.approx(57600, rel=0.02)
        assert width / height == pytest.approx(aspect, rel=0.02)
    # A window without a height, which is being closed, still has a shape.
    flat = SimpleNamespace(position=EYE.position, wxyz=(1, 0, 0, 0), fov=1.0, image_width=300, image_height=0)
    assert eye_of_browser(flat).aspect == 4.0


def test_who_moves_sees_drafts_and_who_holds_still_large_pictures(model):
    scene, shown = FakeScene(), list[Shown]()
    session = session_of(model, scene)
    now = 0.0
    for step in range(5):
        eye = Eye((float(step), 0.0, 0.0), EYE.forward, EYE.up, EYE.fovy, EYE.aspect)
        session.watch(1, eye, shown.append, now)
        while (pause := session.work(now)) == 0.0:
            pass
        assert pause is not None and 0.0 < pause <= STILL + 1e-9
        now += 0.5 * STILL
    assert [picture.is_draft for picture in shown] == [True] * 5
    settle(session, now)
    assert not shown[-1].is_draft
    kind, _, eye, _, pixels = scene.asked[-1]
    assert (kind, eye.position, pixels) == ("picture", (4.0, 0.0, 0.0), LARGE)
    sizes = [asked[4] for asked in scene.asked[4:]]
    assert sizes == sorted(sizes) and len(set(sizes)) == len(sizes)


def test_the_last_of_many_changes_is_what_stays(model):
    scene, shown = FakeScene(), list[Shown]()
    session = session_of(model, scene)
    session.watch(1, EYE, shown.append, 0.0)
    for turn in range(50):
        session.choose(now=0.0, turn=float(turn))
        session.step()
    settle(session, 0.0)
    assert scene.asked[-1][3].turn == 49.0
    assert session.data.time == pytest.approx(50 / FPS)
    assert shown[-1].time == session.data.time
    # One draft and the large pictures: what was superseded before it was begun was not drawn.
    assert sum(asked[0] == "draft" for asked in scene.asked) == 1


def test_what_takes_no_time_is_shown_large_at_once(model):
    scene, shown = FakeScene(quick=True), list[Shown]()
    session = session_of(model, scene)
    session.watch(1, EYE, shown.append, 0.0)
    assert settle(session, 0.0) == 0.0
    assert len(shown) == 1 and not shown[0].is_draft


def test_play_follows_the_clock_pause_halts_and_reset_goes_back(model):
    session = session_of(model, FakeScene())
    start = session.data.qpos.copy()
    session.watch(1, EYE, lambda shown: None, 0.0)
    session.play(now=10.0)
    for tick in range(21):
        session.work(10.0 + tick / FPS + 1e-6)
    assert session.data.time == pytest.approx(20 / FPS)
    session.pause()
    session.work(99.0)
    assert session.data.time == pytest.approx(20 / FPS)
    session.step()
    session.work(99.0)
    assert session.data.time == pytest.approx(21 / FPS)
    assert session.data.qpos[2] < start[2]
    session.reset()
    session.work(99.0)
    assert session.data.time == 0.0 and not session.is_playing
    assert (session.data.qpos == start).all()


def test_a_simulation_too_slow_for_the_clock_plays_slower(model):
    session = session_of(model, FakeScene())
    session.play(now=0.0)
    session.work(5.0)
    assert 0.0 < session.data.time < 5.0


def test_the_end_of_a_recording_halts_it(model):
    told = []
    states = iter(list(zip(range(3), simulate(model, FPS), strict=False)))
    session = Session(FakeScene(), lambda: (state for _, state in states), FPS, LARGE, report=told.append)
    session.play(now=0.0)
    for tick in range(6):
        session.work(tick / FPS + 1e-6)
    assert not session.is_playing
    assert "has ended" in told[-1]


def test_several_people_have_eyes_of_their_own(model):
    scene, shown = FakeScene(), {1: list[Shown](), 2: list[Shown]()}
    session = session_of(model, scene)
    other = Eye((0.0, 0.0, 9.0), EYE.forward, EYE.up, EYE.fovy, 0.5)
    session.watch(1, EYE, shown[1].append, 0.0)
    session.watch(2, other, shown[2].append, 0.0)
    settle(session, 0.0)
    for person, eye in ((1, EYE), (2, other)):
        height, width = shown[person][-1].image.shape[:2]
        assert (width, height) == eye.size(LARGE)
    session.leave(2)
    count = len(shown[2])
    session.step()
    settle(session, 0.0)
    assert len(shown[2]) == count and shown[1][-1].time > 0.0


def test_a_draft_stands_in_for_bounced_light_with_its_mean(model, data):
    scene = RenderedScene(model, bounces=2)
    scene._drafts_bounce = False  # as on a machine that is too slow for them
    eye = eye_of_camera(read_camera(model, data, "front"), 1.5)
    large = scene.picture(data, 0, eye, Look(), 24000)
    draft = scene.draft(data, 0, eye, Look(), 24000)
    dark = scene.picture(data, 0, eye, Look(bounces=False), 24000)
    scene.close()
    # Direct light is the same, but for what probes, which come with bounces, miss of the sky between them. The mean of
    # bounced light is the same, to rounding of the sums.
    difference = draft["direct"] - large["direct"]
    assert np.sqrt((difference**2).mean()) < 0.01 * large["direct"].max()
    assert draft["indirect"].mean() == pytest.approx(large["indirect"].mean(), rel=1e-3)
    assert dark["color"].mean() < draft["color"].mean()


def test_exposure_and_layer_need_no_new_frame_and_a_turned_environment_does(model, data):
    scene = RenderedScene(model, bounces=1)
    eye = eye_of_camera(read_camera(model, data, "front"), 1.5)
    first = scene.picture(data, 0, eye, Look(), 6000)
    assert scene.is_quick(0, eye, Look(exposure=1.0, layer="depth"), 6000)
    turned = Look(turn=90.0)
    assert not scene.is_quick(0, eye, turned, 6000)
    other = scene.picture(data, 0, eye, turned, 6000)
    back = scene.picture(data, 0, eye, Look(), 6000)
    assert not np.allclose(first["color"], other["color"], atol=1e-3)
    assert (first["color"] == back["color"]).all()
    fovy = float(model.vis.global_.fovy)
    scene.close()
    assert fovy != model.vis.global_.fovy == 45.0


def test_every_layer_becomes_a_picture(model, data):
    scene = RenderedScene(model, bounces=1)
    eye = eye_of_camera(read_camera(model, data, "front"), 1.5)
    layers = scene.picture(data, 0, eye, Look(), 6000)
    scene.close()
    for layer in scene.layers:
        image = develop(layers, layer, 0.0)
        assert image.dtype == np.uint8 and image.shape == (*layers["depth"].shape, 3)
        assert len(np.unique(image.reshape(-1, 3), axis=0)) > 2, layer


def test_a_sample_that_is_switched_twice_changes_nothing(model, data):
    still = freeze_scene(model, data)
    scene = SlabScene(still, fit_light_plane(still, (), 5, 5), size=129)
    eye = eye_of_camera(read_camera(model, data, "front"), 1.5)
    scene.template = np.ones((5, 5), np.float32)
    lit = scene.picture(data, 0, eye, Look(), 6000)
    fewer = scene.template.copy()
    fewer[2, 2] = 0.0
    scene.template = fewer
    assert scene.is_quick(1, eye, Look(), 6000)
    dimmer = scene.picture(data, 1, eye, Look(), 6000)
    assert (dimmer["color"] <= lit["color"]).all() and (dimmer["color"] < lit["color"]).any()
    scene.template = np.ones((5, 5), np.float32)
    assert (scene.picture(data, 2, eye, Look(), 6000)["color"] == lit["color"]).all()
    scene.template = np.zeros((5, 5), np.float32)
    assert not scene.is_quick(3, eye, Look(), 6000)


def test_the_light_plane_is_the_scenes_lamp_or_hangs_above_it(model, data):
    still = freeze_scene(model, data)
    above = fit_light_plane(still, (), 3, 4)
    assert (above.rows, above.columns) == (3, 4)
    assert above.center[2] > still.vertices[:, 2].max()
    assert above.axes[:, 2] == pytest.approx([0.0, 0.0, -1.0])
    ball = psf.sphere_light("ball", 0.1, radiance=(1, 1, 1), position=(0, 0, 3))
    lamp = psf.rectangle_light("lamp", 0.5, 0.5, radiance=(1, 1, 1), position=(1, 0, 3), target=(0, 0, 0))
    assert fit_light_plane(still, (ball, lamp), 3, 3).center == pytest.approx([1.0, 0.0, 3.0])


def test_the_camera_asked_for_comes_first(model, data):
    assert [name for name, _ in find_viewpoints(model, data).cameras] == ["front", "top", "free"]
    assert find_viewpoints(model, data, "top").cameras[0][0] == "top"
    assert find_viewpoints(model, data, -1).cameras[0][0] == "free"
    with pytest.raises(ValueError, match="does not exist"):
        find_viewpoints(model, data, "back")


def test_a_port_in_use_is_refused_in_a_sentence():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(OSError, match=f"cannot listen at 127.0.0.1:{port}.*choose another --port"):
            check_free("127.0.0.1", port)


SIMULATION = """
import mujoco

def build():
    return mujoco.MjModel.from_xml_string(MODEL)

def states(model, frames_per_second):
    data = mujoco.MjData(model)
    while True:
        mujoco.mj_step(model, data)
        yield data

def environment():
    return None
"""


def test_a_simulation_is_a_file_or_a_module_with_build_and_states(tmp_path):
    path = tmp_path / "falling_ball.py"
    path.write_text(SIMULATION.replace("MODEL", repr(MODEL)), encoding="utf-8")
    own = read_simulation(str(path), None)
    assert next(own.states(own.model, 30)).time > 0.0
    assert own.environment is None and own.lights == ()
    named, short = read_simulation("sims.cubes", None), read_simulation("cubes", None)
    assert named.model.ngeom == short.model.ngeom > 10
    assert [light.name for light in short.lights] == ["lamp"]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["nowhere.xml"], "model 'nowhere.xml' does not exist"),
        (["nowhere.py"], "simulation 'nowhere.py' does not exist"),
        (["nowhere"], "'nowhere' is neither a model nor a simulation"),
        (["sims.nowhere"], "'sims.nowhere' is neither a model nor a simulation"),
        (["sims.furniture"], "sims.furniture has no build and no states"),
        (["cubes", "--keyframe", "0"], "--keyframe 0: cubes is a simulation"),
        (["cubes", "--camera", "back"], "camera 'back' does not exist"),
        (["cubes", "--size", "big"], "--size big must be a width and a height"),
    ],
)
def test_what_cannot_be_shown_is_refused_in_a_sentence(arguments, sentence):
    result = CliRunner().invoke(app, ["view", *arguments, "--port", "0"])
    assert result.exit_code == 2
    assert sentence in result.output and "Traceback" not in result.output


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    if CHROMIUM is None:
        pytest.skip("there is no Chromium on the path")
    api = pytest.importorskip("playwright.sync_api", reason="Playwright is not installed")
    with api.sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=BROWSER)
        yield chromium
        chromium.close()


@pytest.fixture
def page(browser) -> Iterator[Any]:
    """A page that remembers what it complains of."""
    opened = browser.new_page(viewport={"width": 960, "height": 640})
    opened.complaints = []
    opened.on("console", lambda message: opened.complaints.append(message.text) if message.type == "error" else None)
    opened.on("pageerror", lambda error: opened.complaints.append(str(error)))
    yield opened
    opened.close()


def wait_until(page: Any, condition: Callable[[], bool], what: str) -> None:
    """Lets the page go on until a condition holds, at most a minute: a slow machine is no fault of the viewer's."""
    end = time.monotonic() + 60.0
    while not condition():
        assert time.monotonic() < end, f"waited in vain for {what}"
        page.wait_for_timeout(50)


def seen(page: Any) -> np.ndarray:
    """The picture in the page, left of the controls, float [height, width, 3]."""
    shot = page.screenshot(clip={"x": 0, "y": 200, "width": 600, "height": 440})
    return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB"), float)


def is_at_rest(session: Session) -> bool:
    """Whether everyone sees the large picture of the present state."""
    people = list(session._people.values())
    return bool(people) and not session._has_news() and all(each.pixels >= session.pixels for each in people)


def test_a_page_shows_the_simulation_and_plays_it(model, page):
    with open_viewer(model, simulate, port=0, pixels=20000, bounces=1) as viewer:
        session = viewer.session
        page.goto(viewer.url)
        wait_until(page, lambda: is_at_rest(session), "the first picture")
        page.wait_for_timeout(500)
        before = seen(page)
        assert before.std() > 5.0
        page.get_by_role("button", name="Play").click()
        wait_until(page, lambda: session.data.time > 0.2, "the simulation to play")
        page.get_by_role("button", name="Pause").click()
        wait_until(page, lambda: not session.is_playing and is_at_rest(session), "the simulation to halt")
        page.wait_for_timeout(500)
        assert np.abs(seen(page) - before).max() > 30.0
        page.get_by_role("button", name="Reset").click()
        wait_until(page, lambda: session.data.time == 0.0 and is_at_rest(session), "the simulation to go back")
        eye = next(iter(session._people.values())).eye
        page.mouse.move(300, 400)
        page.mouse.down()
        page.mouse.move(380, 420, steps=5)
        page.mouse.up()
        wait_until(page, lambda: next(iter(session._people.values())).eye != eye, "the camera to turn")
        wait_until(page, lambda: is_at_rest(session), "the picture to sharpen")
        assert page.complaints == []


def test_a_click_on_a_light_sample_changes_the_picture(model, page):
    with open_viewer(model, simulate, port=0, pixels=20000, slab=(5, 5)) as viewer:
        session = viewer.session
        scene = session.scene
        assert isinstance(scene, SlabScene)
        page.goto(viewer.url)
        wait_until(page, lambda: is_at_rest(session), "the first picture")
        page.get_by_role("button", name="none").click()
        wait_until(page, lambda: not scene.template.any() and is_at_rest(session), "the light to go out")
        page.wait_for_timeout(500)
        dark = seen(page)
        page.get_by_role("button").filter(has_text=OFF).nth(7).click()
        wait_until(page, lambda: scene.template.any() and is_at_rest(session), "the light to go on")
        page.wait_for_timeout(500)
        assert scene.template[1, 2] == 1.0 and scene.template.sum() == 1.0
        assert seen(page).mean() > dark.mean() + 1.0
        page.get_by_role("button", name="ring").click()
        wait_until(page, lambda: scene.template.sum() > 2.0 and is_at_rest(session), "the ring")
        assert page.get_by_role("img").count() + page.locator("img").count() >= 2
        assert page.complaints == []


def test_two_pages_see_the_same_state(model, browser, page):
    with open_viewer(model, simulate, port=0, pixels=12000, bounces=1) as viewer:
        other = browser.new_page(viewport={"width": 500, "height": 700})
        for each in (page, other):
            each.goto(viewer.url)
        people = viewer.session._people
        wait_until(page, lambda: len(people) == 2 and is_at_rest(viewer.session), "both pictures")
        assert len({person.eye.aspect for person in people.values()}) == 2
        other.close()
        wait_until(page, lambda: len(people) == 1, "one page to close")
        page.get_by_role("button", name="Step").click()
        wait_until(page, lambda: viewer.session.data.time > 0.0 and is_at_rest(viewer.session), "a step")
        assert page.complaints == [] and math.isfinite(viewer.session.data.time)


def test_a_simulation_without_states_is_refused(model):
    with pytest.raises(ValueError, match="no state to show"):
        open_viewer(model, lambda model, rate: iter(()), port=0)
