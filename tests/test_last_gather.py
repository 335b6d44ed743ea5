"""The last gather: what sparse probes make of the light, and what is kept from frame to frame."""

from functools import cache

import mujoco
import numpy as np
import pytest

import warp_psf as psf
from tests.oracles import make_renderer
from tests.oracles_bounce import traced_bounces
from tests.test_bounce import gather_everywhere

PAINTS = (
    '<asset><material name="pale" rgba=".8 .8 .8 1" specular="0"/><material name="red" rgba=".8 .1 .1 1" specular="0"/>'
    '<material name="green" rgba=".1 .7 .2 1" specular="0"/>'
    '<material name="shiny" rgba=".3 .3 .3 1" specular=".5" shininess=".2"/></asset>'
)
SHARP = '<visual><quality offsamples="0"/></visual>'
# A bright sky from one side.
SKY = psf.Environment.from_coefficients(np.array([[3.0, 3.2, 3.5], [0.5] * 3, [1.0] * 3, [0.7] * 3]))
# Shapes of `test_bounce.py`, so that they are baked once in a session.
WALLS = (
    '<geom type="plane" size="2 2 .1" material="pale"/><geom type="box" size=".1 1 .8" pos="-1.1 0 .8" material="red"/>'
    '<geom type="box" size=".1 1 .8" pos="1.1 0 .8" material="green"/>'
)
BALL = '<body name="ball" mocap="true" pos="0 .1 .31"><geom type="sphere" size=".3" material="pale"/></body>'
PILL = '<geom type="capsule" size=".12 .2" pos=".55 -.3 .35" euler="0 30 0" material="{}"/>'
CAMERAS = (
    '<camera name="eye" pos="0 -2.6 1.3" xyaxes="1 0 0 0 .35 .94" fovy="55"/>'
    '<camera name="left" pos="-.9 -2.4 1.5" xyaxes=".94 -.34 0 .12 .33 .94" fovy="55"/>'
)
# A lamp without a body: moving it moves no surface.
LAMP = (
    '<body name="lamp" mocap="true" pos="0 0 3"><light type="spot" pos="0 0 0" dir="0 0 -1" cutoff="60" '
    'diffuse="2 2 2" specular="0 0 0"/></body>'
)
HEIGHT, WIDTH = 90, 160
# The world's geoms come before those of bodies: the first after `WALLS`.
ROD = 3
GATHERING, SENDING = "basis irradiances", "light on proxies"


def start(body: str, height: int = HEIGHT, width: int = WIDTH, *, header: str = "", **options):
    renderer, data = make_renderer(body, height, width, header=PAINTS + header, environment=SKY, **options)
    renderer.update_scene(data, "eye")
    return renderer, data


# Probes


@pytest.mark.parametrize("material", ["pale", "shiny"])
def test_sparse_probes_show_what_a_probe_at_every_pixel_does(monkeypatch, material):
    scene = WALLS + BALL + PILL.format(material) + CAMERAS
    with monkeypatch.context() as patch:
        gather_everywhere(patch)
        expected = start(scene, header=SHARP)[0].layers()
    renderer, _ = start(scene, header=SHARP)
    found = renderer.layers()
    body = found["segmentation"][..., 0] >= 0
    assert renderer._stage.last_gather is not None
    assert renderer._stage.last_gather.count < 0.25 * body.sum()
    np.testing.assert_array_equal(found["segmentation"], expected["segmentation"])
    # Cells are halved until probes agree within 10 % of the indirect light or 2 % of all light, so that pixels between
    # them err by less than half of that, except in seams that lie between probes 2 pixels apart.
    scale = 0.5 / expected["color"][body].mean()
    error = scale * (found["indirect"] - expected["indirect"])[body]
    assert abs(error.mean()) < 0.001
    assert np.sqrt(np.mean(error**2)) < 0.006
    assert np.quantile(np.abs(error), 0.99) < 0.02
    for number in range(5):
        part = found["segmentation"][..., 0] == number
        assert found["indirect"][part].mean() == pytest.approx(expected["indirect"][part].mean(), rel=0.01)


def test_antialiased_pictures_have_as_much_light():
    scene = WALLS + BALL + PILL.format("pale") + CAMERAS
    layers = {header: start(scene, header=header)[0].layers() for header in ("", SHARP)}
    # The same but for the pixels at edges.
    means = [layers[header]["indirect"].mean() for header in ("", SHARP)]
    assert means[0] == pytest.approx(means[1], rel=0.005)
    difference = np.abs(layers[""]["indirect"] - layers[SHARP]["indirect"]).max(axis=2)
    assert np.median(difference) < 1e-3


def test_thin_bodies_are_lit_on_all_their_pixels(monkeypatch):
    # A rod across the picture, one to two pixels wide: most of its pixels lie on no lattice.
    rod = '<geom type="capsule" size=".02" fromto="-.7 -.3 .15 .75 .1 1.2" material="pale"/>'
    scene = WALLS + BALL + rod + CAMERAS
    renderer, data = start(scene, header=SHARP, bounces=1)
    layers = renderer.layers()
    on_rod = layers["segmentation"][..., 0] == ROD
    assert on_rod.sum() > 40
    receivers, pixels = renderer._stage.surfaces.receivers, HEIGHT * WIDTH
    points, normals = receivers.position.numpy()[0, :pixels], receivers.normal.numpy()[0, :pixels]
    traced = traced_bounces(
        renderer.model,
        data,
        points[on_rod.ravel()],
        normals[on_rod.ravel()],
        bounces=1,
        coefficients=SKY.project(4),
        material_space="linear",
    )[1]
    expected, found = 0.8 / np.pi * traced, layers["indirect"][on_rod]
    assert (expected.max(axis=1) > 0).all()
    assert (found.max(axis=1) > 0.3 * expected.max(axis=1)).all()
    # On round bodies the band-limited cosine lets in light from below the horizon: 13 % here, also at every pixel.
    assert found.mean() == pytest.approx(expected.mean(), rel=0.2)
    assert np.sqrt(np.mean((found - expected) ** 2)) < 0.12 * expected.max()
    with monkeypatch.context() as patch:
        gather_everywhere(patch)
        everywhere = start(scene, header=SHARP, bounces=1)[0].layers()["indirect"][on_rod]
    # A pixel beside the lattice takes a probe whose light is that of another place on the rod.
    assert found.mean() == pytest.approx(everywhere.mean(), rel=0.04)


def test_half_a_picture_is_the_same_picture():
    # A small picture looks at the same surfaces with a quarter of the pixels, and as sharply with other probes.
    scene = WALLS + BALL + CAMERAS
    large, small = start(scene)[0].layers(), start(scene, HEIGHT // 2, WIDTH // 2)[0].layers()
    reduced = large["indirect"].reshape(HEIGHT // 2, 2, WIDTH // 2, 2, 3).mean(axis=(1, 3))
    difference = np.abs(reduced - small["indirect"])
    # Edges are sampled elsewhere; the rest differs by what probes leave.
    assert reduced.mean() == pytest.approx(small["indirect"].mean(), rel=0.01)
    assert np.quantile(difference, 0.9) < 0.02 * reduced.max()
    assert np.sqrt(np.mean(difference**2)) < 0.02 * reduced.max()


def test_pictures_smaller_than_a_cell():
    for height, width in ((1, 1), (3, 2), (1, 17)):
        layers = start(WALLS + BALL + CAMERAS, height, width)[0].layers()
        body = layers["segmentation"][..., 0] >= 0
        assert body.any()
        assert (layers["indirect"][body].max(axis=1) > 0).all()


# What is kept


@cache
def lamp_scene() -> str:
    return WALLS + BALL + LAMP + CAMERAS


def drawn(renderer: psf.Renderer, data: mujoco.MjData, camera: str = "eye") -> tuple[dict, bool]:
    """The layers of a state, and whether the basis irradiances were gathered for them."""
    mujoco.mj_forward(renderer.model, data)
    renderer.update_scene(data, camera)
    return renderer.layers(), GATHERING in renderer.stage_seconds


def fresh(ball, lamp, camera: str = "eye") -> dict[str, np.ndarray]:
    """The layers as a renderer of its own draws them."""
    renderer, data = start(lamp_scene(), 45, 80)
    data.mocap_pos[:] = ball, lamp
    return drawn(renderer, data, camera)[0]


def assert_same(found: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> None:
    for name, layer in expected.items():
        np.testing.assert_array_equal(found[name], layer, err_msg=name)


def test_relighting_keeps_what_was_gathered():
    ball, lamp = (0, 0.1, 0.31), (0, 0, 3)
    renderer, data = start(lamp_scene(), 45, 80)
    first, gathered = drawn(renderer, data)
    assert gathered
    assert_same(first, fresh(ball, lamp))
    # Another camera.
    found, gathered = drawn(renderer, data, "left")
    assert not gathered and SENDING not in renderer.stage_seconds
    assert_same(found, fresh(ball, lamp, "left"))
    # Another light.
    data.mocap_pos[1] = (0.5, -0.2, 2.5)
    found, gathered = drawn(renderer, data)
    assert not gathered and SENDING in renderer.stage_seconds
    assert np.abs(found["indirect"] - first["indirect"]).max() > 0.01
    assert_same(found, fresh(ball, (0.5, -0.2, 2.5)))
    # Another place of a body, and back.
    data.mocap_pos[:] = (0.2, 0, 0.4), lamp
    found, gathered = drawn(renderer, data)
    assert gathered
    assert_same(found, fresh((0.2, 0, 0.4), lamp))
    data.mocap_pos[0] = ball
    found, gathered = drawn(renderer, data)
    assert gathered
    assert_same(found, first)


def test_a_new_environment_is_sent_on():
    renderer, data = start(WALLS + BALL + CAMERAS, 45, 80)
    first, _ = drawn(renderer, data)
    renderer.environment = np.full((4, 8, 3), 0.3)
    other, _ = drawn(renderer, data)
    assert np.abs(other["indirect"] - first["indirect"]).max() > 0.01
    renderer.environment = SKY
    assert_same(drawn(renderer, data)[0], first)


def test_poses_that_were_skipped_are_not_taken_for_the_last():
    renderer, data = start(lamp_scene(), 45, 80)
    first, _ = drawn(renderer, data)
    # Shown by no picture, then back, then away for good.
    for place in ((0.3, 0, 0.5), (0, 0.1, 0.31), (0.3, 0, 0.5)):
        data.mocap_pos[0] = place
        mujoco.mj_forward(renderer.model, data)
        renderer.update_scene(data, "eye")
    assert_same(renderer.layers(), fresh((0.3, 0, 0.5), (0, 0, 3)))
    data.mocap_pos[0] = (0, 0.1, 0.31)
    assert_same(drawn(renderer, data)[0], first)
