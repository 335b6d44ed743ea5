"""The lattice of shaded pixels: what it interpolates is what shading every pixel gives."""

import numpy as np
import pytest
import warp as wp

import warp_psf as psf
from tests.oracles import make_renderer
from warp_psf.shade import lattice
from warp_psf.shade.direct import shade_direct
from warp_psf.stage import make_received

HEIGHT, WIDTH = 215, 381  # not multiples of the strides
SCENE = (
    '<geom name="floor" type="plane" size="20 20 .1" material="white"/>'
    '<geom type="sphere" size=".5" pos="-.7 0 .5" rgba=".2 .5 .8 1"/><geom type="box" size=".3 .3 .4" pos=".6 .3 .4"/>'
    '<camera name="front" pos="0 -5 2.5" xyaxes="1 0 0 0 .45 .9"/>'
)


def sky() -> psf.Environment:
    light = 0.2 * np.random.default_rng(5).normal(size=(16, 3))
    light[0] += 3.0
    light[2] += 1.0
    return psf.Environment.from_coefficients(light)


@pytest.fixture(scope="module")
def scene():
    renderer, data = make_renderer(SCENE, HEIGHT, WIDTH, environment=sky(), bounces=0)
    renderer.update_scene(data, "front")
    renderer.layers()
    return renderer


def shade_everything(renderer) -> tuple[np.ndarray, np.ndarray]:
    """Irradiance and Phong radiance [slots, 3] of the last picture, with every receiver shaded."""
    turns = wp.full((1, renderer._stage.surfaces.slots), 1, dtype=wp.int32, device=renderer._settings.device)
    received = make_received(renderer._stage.surfaces.slots, renderer._settings.device)
    lights = (renderer._stage.occlusion, renderer._stage.lighting)
    shade_direct(
        renderer._stage.surfaces.receivers,
        turns,
        1,
        renderer._stage.device_scene,
        *lights,
        renderer._stage.cuts.pixels,
        *received,
        renderer._settings.device,
    )
    return received[0].numpy()[0], received[1].numpy()[0]


def test_interpolated_light_is_nearly_that_of_every_pixel(scene):
    entity = scene._stage.surfaces.receivers.entity.numpy()[0]
    turns = scene._stage.lattice.turns.numpy()[0]
    # Cells that are interpolated bend by 0.5 % between their corners as far as the lattice can tell. A kink within a
    # cell, at the foot of the box, is straightened, which a row of some pixels shows.
    for found, full in zip(scene._stage.received, shade_everything(scene), strict=True):
        seen = entity >= 0
        error = np.abs(found.numpy()[0] - full)[seen] / full[seen].max()
        interpolated = turns[seen] == lattice.INTERPOLATED
        assert not error[~interpolated].any()
        assert np.quantile(error, 0.999) < 0.006
        assert error.max() < 0.016
    assert 0.2 < (turns[: HEIGHT * WIDTH] == lattice.INTERPOLATED).mean() < 0.9


def test_every_receiver_gets_its_turn(scene):
    receivers = scene._stage.surfaces.receivers
    entity = receivers.entity.numpy()[0]
    assert (entity[receivers.count :] == -1).all()
    entity = entity[: receivers.count]
    turns = scene._stage.lattice.turns.numpy()[0, : receivers.count]
    assert np.isin(turns, (1, 2, 3, lattice.INTERPOLATED)).all()
    assert (turns[entity < 0] == lattice.INTERPOLATED).all()
    # Edge pixels and their groups are shaded.
    extra = scene._stage.surfaces.extra.numpy()[0]
    edges = np.flatnonzero((extra >= 0) & (entity[: len(extra)] >= 0))
    assert len(edges) > 50
    assert (turns[edges] == 1).all()
    groups = np.flatnonzero(entity[len(extra) :] >= 0) + len(extra)
    assert (turns[groups] == 1).all()


def test_a_valley_between_equal_corners_is_seen(scene):
    # Light that is low along a line halfway between the lattice's columns 40 and 44, and equal on both.
    pixels, device = scene._stage.surfaces.receivers, scene._settings.device
    lattice.begin_lattice(scene._stage.lattice, pixels, scene._stage.surfaces.extra, device)
    x = np.arange(scene._stage.surfaces.slots) % WIDTH
    valley = (1 + 0.0105 * np.abs(x - 42.0))[:, None] * np.ones(3)
    received = make_received(scene._stage.surfaces.slots, scene._settings.device)
    received[0].assign(valley.astype(np.float32)[None])
    lattice.refine_lattice(scene._stage.lattice, 1, pixels, *received, device)
    turns = scene._stage.lattice.turns.numpy()[0, : HEIGHT * WIDTH].reshape(HEIGHT, WIDTH)
    floor = (pixels.entity.numpy()[0, : HEIGHT * WIDTH] == 0).reshape(HEIGHT, WIDTH)
    assert floor[-40:, 30:60].all()
    assert (turns[-40:, 41:44] != lattice.INTERPOLATED).all()
    assert (turns[-40:-8, 49:52] == lattice.INTERPOLATED).all()  # a slope


def test_noise_is_never_interpolated(scene):
    pixels = scene._stage.surfaces.receivers
    lattice.begin_lattice(scene._stage.lattice, pixels, scene._stage.surfaces.extra, scene._settings.device)
    noise = np.random.default_rng(1).uniform(1, 2, (1, scene._stage.surfaces.slots, 3)).astype(np.float32)
    received = make_received(scene._stage.surfaces.slots, scene._settings.device)
    for array in received:
        array.assign(noise)
    for turn in (1, 2):
        lattice.refine_lattice(scene._stage.lattice, turn, pixels, *received, scene._settings.device)
    turns = scene._stage.lattice.turns.numpy()[0, : HEIGHT * WIDTH].reshape(HEIGHT, WIDTH)
    entity = pixels.entity.numpy()[0, : HEIGHT * WIDTH].reshape(HEIGHT, WIDTH)
    assert (turns[entity >= 0] != lattice.INTERPOLATED).all()
    np.testing.assert_array_equal(received[0].numpy()[0], noise[0])


def test_linear_light_is_interpolated_exactly(scene):
    pixels, device = scene._stage.surfaces.receivers, scene._settings.device
    lattice.begin_lattice(scene._stage.lattice, pixels, scene._stage.surfaces.extra, device)
    y, x = np.divmod(np.arange(scene._stage.surfaces.slots), WIDTH)
    ramp = (10 + 0.02 * x + 0.01 * y)[:, None] * np.ones(3)
    first = scene._stage.lattice.turns.numpy()[0] == 1
    received = make_received(scene._stage.surfaces.slots, scene._settings.device)
    for array in received:
        array.assign((ramp * first[:, None]).astype(np.float32)[None])
    lattice.refine_lattice(scene._stage.lattice, 1, pixels, *received, device)
    done = scene._stage.lattice.turns.numpy()[0] == lattice.INTERPOLATED
    done &= pixels.entity.numpy()[0] >= 0
    assert done.sum() > 1000
    for array in received:
        np.testing.assert_allclose(array.numpy()[0][done], ramp[done], rtol=1e-6)


@pytest.mark.parametrize(("height", "width"), [(1, 1), (1, 7), (5, 1), (3, 4), (5, 6)])
def test_pictures_smaller_than_a_cell(height, width):
    renderer, data = make_renderer(SCENE, height, width, environment=sky(), bounces=0)
    renderer.update_scene(data, "front")
    layers = renderer.layers()
    entity = renderer._stage.surfaces.receivers.entity.numpy()[0] >= 0
    np.testing.assert_allclose(
        renderer._stage.received[0].numpy()[0][entity], shade_everything(renderer)[0][entity], rtol=5e-3
    )
    assert layers["color"].shape == (height, width, 3)
    assert (layers["color"] > 0).all()
