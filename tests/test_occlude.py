"""Composing occluders: against float64 products, ray casting, and that nothing pops."""

import itertools

import mujoco
import numpy as np
import pytest

import warp_psf as psf
from tests.oracles import (
    chained_irradiance,
    make_renderer,
    multiplied_irradiance,
    shade_points,
    sphere_coverage,
    traced_irradiance,
)
from warp_psf.bake import body as bake_body
from warp_psf.basis import sh
from warp_psf.shade.fades import SMALLEST_SHARE

UP = np.array((0.0, 0.0, 1.0))
WHITE = np.ones((4, 8, 3))
FLOOR = '<geom name="floor" type="plane" size="20 20 .1" material="white"/>'
GRID = np.stack(np.meshgrid(np.linspace(-3, 3, 25), np.linspace(-2, 2, 9), 0.0), axis=-1).reshape(-1, 3)
BALLS = {"a": ((0.2, 0.1, 0.8), 0.7), "b": ((-1.2, 0.4, 0.6), 0.5), "c": ((0.9, -0.9, 1.6), 0.6), "d": ((0, 0, 3), 0.8)}


def ball(name: str) -> str:
    (x, y, z), radius = BALLS[name]
    return f'<geom name="{name}" type="sphere" size="{radius}" pos="{x} {y} {z}"/>'


def sky(order: int, seed: int = 3) -> np.ndarray:
    """Coloured light on SH, brighter from above, [order^2, 3]."""
    light = 0.15 * np.random.default_rng(seed).normal(size=(order * order, 3))
    light[0] += 3.0
    light[2] += 0.8
    return light


def floor_irradiance(others: str, light: np.ndarray, points: np.ndarray = GRID) -> np.ndarray:
    environment = psf.Environment.from_coefficients(light)
    renderer, _ = make_renderer(FLOOR + others, environment=environment, order=sh.order_of(len(light)))
    return shade_points(renderer, "floor", points, UP)[0]


@pytest.mark.parametrize("name", BALLS)
def test_one_occluder_is_the_triple_product(name):
    light = sky(4)
    coverage = sphere_coverage(GRID, np.array(BALLS[name][0]), BALLS[name][1], 4)
    expected = chained_irradiance(light, coverage, UP)
    # Float32 sums of 64 products of order one.
    np.testing.assert_allclose(floor_irradiance(ball(name), light), np.maximum(expected, 0), atol=2e-5)


def test_one_occluder_at_the_highest_order():
    # The rule for order 6 is exact to degree 15; light, body and cosine reach 16, which leaves 1e-4.
    light = sky(6)
    coverage = sphere_coverage(GRID, np.array(BALLS["a"][0]), BALLS["a"][1], 6)
    np.testing.assert_allclose(floor_irradiance(ball("a"), light), chained_irradiance(light, coverage, UP), atol=5e-4)


def test_several_occluders_are_the_product_at_the_quadrature():
    light = sky(4)
    coverages = [sphere_coverage(GRID, np.array(center), radius, 4) for center, radius in BALLS.values()]
    expected = multiplied_irradiance(light, coverages, UP)
    found = floor_irradiance("".join(map(ball, BALLS)), light)
    assert expected.min() < 0.3 * expected.max()
    np.testing.assert_allclose(found, np.maximum(expected, 0), atol=2e-5)


def test_order_of_entities_does_not_matter():
    light = sky(4)
    pictures = []
    for names in itertools.islice(itertools.permutations(BALLS), 0, 24, 7):
        bodies = "".join(map(ball, names))
        environment = psf.Environment.from_coefficients(light)
        renderer, _ = make_renderer(bodies + FLOOR, 54, 96, environment=environment)
        pictures.append(renderer.layers()["color"])
    for picture in pictures[1:]:
        # The factors of a product in another order: float32 rounding, and ties between lattice cells at the threshold.
        np.testing.assert_allclose(picture, pictures[0], atol=2e-4)


def test_a_body_does_not_shadow_itself_and_takes_light_from_others_alone():
    renderer, _ = make_renderer(ball("a") + ball("b"), environment=WHITE)
    alone, _ = make_renderer(ball("a"), environment=WHITE)
    center, radius = np.array(BALLS["a"][0]), BALLS["a"][1]
    toward = np.array(BALLS["b"][0]) - center
    toward /= np.linalg.norm(toward)
    for normal, shadowed in ((toward, True), (-toward, False)):
        point = (center + radius * normal)[None]
        free, found = (shade_points(r, "a", point, normal)[0][0, 0] for r in (alone, renderer))
        assert free == pytest.approx(np.pi, abs=1e-4)
        assert found < 0.8 * np.pi if shadowed else found == pytest.approx(np.pi, abs=1e-4)


def test_what_lies_below_the_horizon_takes_nothing():
    others = (
        '<geom name="below" type="box" size="5 5 1" pos="0 0 -1.01"/><geom type="sphere" size="1" pos="1 0 -1.02"/>'
        '<geom name="level" type="plane" size="5 5 .1" pos="0 0 0"/>'
    )
    np.testing.assert_allclose(floor_irradiance(others, sky(4)), floor_irradiance("", sky(4)), rtol=1e-6)


def test_occluders_fade_out_at_the_threshold():
    # Straight above, from twice the threshold's share of the light, which is taken in full, to the threshold.
    white = np.pad([[np.sqrt(4 * np.pi)] * 3], ((0, 15), (0, 0)))
    taken, shares = [], SMALLEST_SHARE * np.array((2.02, 1.8, 1.5, 1.2, 0.98))
    for share in shares:
        far = f'<geom type="sphere" size="1" pos="0 0 {1 / np.sqrt(share)}"/>'
        taken.append(1 - floor_irradiance(far, white, np.zeros((1, 3)))[0, 0] / np.pi)
    # 3e-6: what float32 leaves of a difference from 1. Truncation at order 4 changes no share by more than a tenth.
    assert taken[0] == pytest.approx(shares[0], rel=0.1)
    assert taken[-1] == pytest.approx(0.0, abs=3e-6)
    assert (np.diff(taken) < 0).all()


# Ray casting


@pytest.fixture(scope="module")
def still_life():
    """A capsule leaning over a box beside a ball, on a floor, and its model's data."""
    bodies = (
        '<geom name="capsule" type="capsule" size=".25 .45" pos="-.5 0 .75" euler="0 25 0" material="grey"/>'
        '<geom name="box" type="box" size=".3 .4 .25" pos=".4 .2 .25" euler="0 0 30" material="grey"/>'
        '<geom name="ball" type="sphere" size=".3" pos=".2 -.8 .3" material="grey"/>'
        '<camera name="front" pos="0 -4 2.2" xyaxes="1 0 0 0 .45 .9"/>'
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bake_body, "FINEST_RESOLUTION", 16)  # a fraction of the time to bake
        environment = psf.Environment.from_coefficients(sky(4))
        renderer, data = make_renderer(FLOOR + bodies, 54, 96, environment=environment)
    renderer.update_scene(data, "front")
    return renderer, data


def test_against_ray_casting(still_life):
    renderer, data = still_life
    renderer.layers()
    receivers = renderer._stage.surfaces.receivers
    pixels = 54 * 96
    entity, position, normal = (
        getattr(receivers, name).numpy()[0, :pixels] for name in ("entity", "position", "normal")
    )
    seen = entity >= 0
    assert len(np.unique(entity)) == 5
    found = renderer._stage.received[0].numpy()[0, :pixels][seen]
    expected = traced_irradiance(renderer.model, data, position[seen], normal[seen], sky(4))
    # As the accuracy benchmark measures: the reference at mean luminance 0.5, both clamped to [0, 1].
    scale = 0.5 / (expected @ (0.2126, 0.7152, 0.0722)).mean()
    error = np.clip(scale * found, 0, 1) - np.clip(scale * expected, 0, 1)
    assert np.sqrt(np.mean(error**2)) < 0.02


# Nothing pops: however short a step of a body, the light changes little.


def largest_pop(renderer, data, start, end, points: np.ndarray = GRID) -> float:
    """The largest change of the floor's light in the shortest step of a body along a path, as a share of the largest.

    The path is walked in steps of 1 to 2 cm, and the three steps that change most once more in steps of a millimetre.
    """

    def walk(path: np.ndarray) -> np.ndarray:
        frames = []
        for place in path:
            data.mocap_pos[0] = place
            mujoco.mj_forward(renderer.model, data)
            renderer.update_scene(data)
            frames.append(shade_points(renderer, "floor", points, UP)[0])
        return np.array(frames)

    path = np.linspace(start, end, 300)
    frames = walk(path)
    steps = np.abs(np.diff(frames, axis=0)).max(axis=(1, 2))
    worst = np.argsort(steps)[-3:]
    fine = [np.diff(walk(np.linspace(path[step], path[step + 1], 20)), axis=0) for step in worst]
    return float(np.abs(fine).max() / frames.max())


@pytest.mark.parametrize(
    ("shape", "start", "end"),
    [
        # Past the other bodies, by turns nearer and farther than they are, and across the shells of a field.
        ('type="sphere" size=".3"', (-3, 0.6, 0.4), (3, -0.6, 1.2)),
        ('type="box" size=".25 .3 .2"', (-3, 0.3, 0.3), (3, 0.3, 1.2)),
        ('type="capsule" size=".25 .45"', (-2, -0.5, 0.8), (2, -0.5, 2.4)),
        # Down through the floor: the horizon is crossed.
        ('type="box" size=".3 .3 .3"', (1.5, -1, 0.8), (1.5, -1, -0.8)),
        ('type="sphere" size=".3"', (1.5, -1, 0.8), (1.5, -1, -0.8)),
    ],
)
def test_nothing_pops(shape, start, end, monkeypatch):
    monkeypatch.setattr(bake_body, "FINEST_RESOLUTION", 16)
    moving = f'<body name="moving" mocap="true" pos="0 0 9"><geom {shape}/></body>'
    environment = psf.Environment.from_coefficients(sky(4))
    renderer, data = make_renderer(FLOOR + ball("a") + ball("c") + moving, environment=environment)
    # Receivers that the body swallows are no matter of shadows.
    outside = GRID[np.linalg.norm(GRID - (1.5, -1, 0), axis=1) > 0.5] if end[2] < 0 else GRID
    # What truncation leaves of a body that sinks below the horizon is half of this.
    assert largest_pop(renderer, data, start, end, outside) < 0.01


@pytest.mark.parametrize("shape", ['type="sphere" size=".3"', 'type="box" size=".25 .3 .2"'])
def test_nothing_pops_before_a_light(shape):
    light = psf.rectangle_light("panel", 1, 1, (1, 1, 1), (0, 0, 1.5), (0, 0, 0))
    moving = f'<body name="moving" mocap="true" pos="0 0 9"><geom {shape}/></body>'
    renderer, data = make_renderer(FLOOR + moving, environment=None, lights=[light])
    for start, end in [((0.9, 0, 0.4), (0.9, 0, 2.8)), ((-3, 0.1, 0.5), (0, 0.1, 0.5))]:
        assert largest_pop(renderer, data, start, end) < 0.03
