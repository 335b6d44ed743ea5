"""Glossy bodies as senders of bounced light: the lobe's separable terms, and pictures against the path tracer."""

from collections.abc import Iterator
from functools import cache

import mujoco
import numpy as np
import pytest

import warp_psf as psf
from tests.oracles_bounce import traced_bounces
from tests.oracles_separable import cut_series, fitted, four_terms, hemisphere, phong_matrix, relative_error
from tests.test_bounce import BALL, HEIGHT, WIDTH, camera, gather_everywhere, geom, shown, start
from warp_psf.basis import sh
from warp_psf.shade import proxies
from warp_psf.shade.separable import factor_lobe


@pytest.fixture(scope="module", autouse=True)
def at_every_pixel() -> Iterator[None]:
    """What is tested is what bodies send: no pixel takes it from its neighbours."""
    with pytest.MonkeyPatch.context() as patch:
        gather_everywhere(patch)
        yield


# The lobe

EXPONENTS = (0.5, 1.0, 2.56, 10.0, 20.0)


@pytest.mark.parametrize("exponent", EXPONENTS)
def test_four_terms_are_the_least_squares_fit(exponent):
    directions, weights = hemisphere(20, 48)
    lobe = phong_matrix(exponent, directions)
    expected = fitted(lobe, directions, weights, 2)
    # Both sides are quadratures, of a lobe with a kink at its edge.
    assert np.abs(four_terms(exponent, directions) - expected).max() < 2e-3 * np.abs(expected).max()


@pytest.mark.parametrize("exponent", EXPONENTS)
def test_four_terms_keep_the_energy_of_the_lobe(exponent):
    directions, weights = hemisphere(20, 48)
    lobe, terms = phong_matrix(exponent, directions), four_terms(exponent, directions)
    assert weights @ terms @ weights == pytest.approx(weights @ lobe @ weights, rel=1e-3)
    # And of what comes from above and from aside.
    z = weights * directions[:, 2]
    assert z @ terms @ weights == pytest.approx(z @ lobe @ weights, rel=1e-3)
    series = cut_series(exponent, directions, 2)
    assert relative_error(terms, lobe, weights) < 0.96 * relative_error(series, lobe, weights)


def test_a_mirror_s_lobe_has_factors():
    # In the limit the lobe is a mirror, whose fit has the moments of the cosine squared.
    gram = np.array([[np.pi, 2 * np.pi / 3], [2 * np.pi / 3, np.pi / 2]])
    moments = np.array([[2 * np.pi / 3, np.pi / 2], [np.pi / 2, 2 * np.pi / 5]])
    upright = np.linalg.inv(gram) @ moments @ np.linalg.inv(gram)
    # The integral of x^2 cos^2 is 2 pi / 15.
    expected = [upright[0, 0], upright[0, 1], upright[1, 1], 2 * np.pi / 15 / (np.pi / 4) ** 2]
    assert factor_lobe(1e5) == pytest.approx(expected, rel=1e-3)


# Pictures

REFLECTANCE = 0.5
WALL = geom('type="box" size=".1 1 .8"', "1.1 0 .8", "pale")
# Between the ball and the wall, which fills the picture.
EYE = camera(".55 0 .8", "0 -1 0 0 0 1", 100)
# Every third of the wall's pixels tells as much as all.
STEP = 3


def shiny(exponent: float) -> str:
    """A dark material with a lobe of `REFLECTANCE`, as MJCF has it."""
    specular = REFLECTANCE * (exponent + 2) / 2
    return (
        f'<asset><material name="shiny" rgba=".1 .1 .1 1" specular="{specular}" shininess="{exponent / 32}"/></asset>'
    )


def beam() -> psf.Environment:
    """Light mostly from above and the right."""
    lobe = sh.zonal(sh.phong_lobe(4.0, 4), np.array([-0.3, -0.6, 0.742]))
    return psf.Environment.from_coefficients(np.repeat(2 * lobe[:, None], 3, axis=1))


def wall_light(body: str, exponent: float, bounces: int) -> tuple[np.ndarray, tuple]:
    """The irradiance [N] of bounced light at pixels of the wall, and what `traced_light` asks for."""
    renderer, data = start(body, header=shiny(exponent), environment=beam(), bounces=bounces)
    layers, receivers = renderer.layers(), renderer._stage.surfaces.receivers
    chosen = np.flatnonzero(shown(layers, 0))[::STEP]
    pixels = HEIGHT * WIDTH
    points, normals = (array.numpy()[0, :pixels][chosen] for array in (receivers.position, receivers.normal))
    return layers["indirect"].reshape(-1, 3)[chosen, 0] / 0.8 * np.pi, (renderer.model, data, points, normals)


def traced_light(scene: tuple, bounces: int, paths: int) -> np.ndarray:
    """The irradiance [bounces, N] that each bounce adds, by the path tracer."""
    options = {"coefficients": beam().project(4), "paths": paths, "material_space": "linear", "phong": True}
    return traced_bounces(*scene, bounces=bounces, **options)[1:, :, 0]


@cache
def beside_the_ball() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of the wall [N, 3], what they receive of a glossy ball [N], and what the path tracer finds [N]."""
    found, scene = wall_light(WALL + geom(BALL, ".2 0 .7", "shiny") + EYE, 2.56, 1)
    return scene[2], found, traced_light(scene, 1, 8192)[0]


def test_a_glossy_ball_sends_light_to_where_it_mirrors_the_sun():
    points, found, expected = beside_the_ball()
    # The limit set for each bounce is 3 %; the lobe is an approximation besides.
    assert found.mean() == pytest.approx(expected.mean(), rel=0.05)
    # What four terms leave of a lobe of this width, a third, blurred by the wall's cosine and the ball's curvature.
    assert np.sqrt(np.mean((found - expected) ** 2)) < 0.15 * expected.mean()
    # The brightest tenth; a path tracer's brightest point is one of noise.
    patch, expected_patch = (points[light > np.quantile(light, 0.9)].mean(axis=0) for light in (found, expected))
    assert patch == pytest.approx(expected_patch, abs=0.1)
    # Light comes from y < 0 and above, and the ball stands before y = 0, z = 0.7.
    assert patch[1] < -0.1 and patch[2] > 0.8


def test_four_terms_are_nearer_than_one(monkeypatch):
    _, four, expected = beside_the_ball()

    def evenly(exponent: float) -> np.ndarray:
        k00, k01, k11, _ = factor_lobe(exponent)
        # The lobe's energy, with the same radiance in all directions.
        return np.array([k00 + 4 / 3 * k01 + 4 / 9 * k11, 0.0, 0.0, 0.0])

    monkeypatch.setattr(proxies, "factor_lobe", evenly)
    one, _ = wall_light(WALL + geom(BALL, ".2 0 .7", "shiny") + EYE, 2.56, 1)
    errors = [np.sqrt(np.mean((light - expected) ** 2)) for light in (one, four)]
    assert errors[1] < 0.6 * errors[0]


def test_glossy_bodies_light_one_another():
    bodies = geom(BALL, ".1 -.45 .7", "shiny") + geom(BALL, ".1 .45 .7", "shiny")
    pictures = [wall_light(WALL + bodies + EYE, 2.56, bounces) for bounces in (1, 3)]
    expected = traced_light(pictures[0][1], 3, 8192)
    more = pictures[1][0] - pictures[0][0]
    # The second and third bounce pass between the balls and the wall.
    assert more.mean() == pytest.approx(expected[1:].sum(axis=0).mean(), rel=0.1)
    assert np.sqrt(np.mean((more - expected[1:].sum(axis=0)) ** 2)) < 0.2 * expected[1:].sum(axis=0).mean()


def test_a_glossy_body_in_a_furnace():
    # Under an even light what leaves is the lobe's energy times the light.
    coefficients = np.zeros((16, 3))
    coefficients[0] = np.sqrt(4 * np.pi)
    white = psf.Environment.from_coefficients(coefficients)
    body = WALL + geom(BALL, ".2 0 .7", "shiny") + EYE
    renderer, data = start(body, header=shiny(2.56), environment=white, bounces=1)
    receivers = renderer._stage.surfaces.receivers
    layers = renderer.layers()
    points, normals = (a.numpy()[0, : HEIGHT * WIDTH][::7] for a in (receivers.position, receivers.normal))
    options = {"bounces": 1, "coefficients": coefficients, "paths": 4096, "phong": True, "material_space": "linear"}
    expected = traced_bounces(renderer.model, data, points, normals, **options)[1, :, 0]
    found = layers["indirect"].reshape(-1, 3)[::7, 0] / 0.8 * np.pi
    assert found.mean() == pytest.approx(expected.mean(), rel=0.05)


def test_scenes_without_gloss_pay_nothing():
    renderer, _ = start(WALL + geom(BALL, ".2 0 .7", "red") + EYE, environment=beam())
    assert renderer._stage.bounces is not None
    table = renderer._stage.bounces.gloss.table
    for array in (table.first, table.second, table.extra, table.vector, table.entity):
        assert array.size == 0


def test_light_follows_the_body_that_sends_it():
    # Turning a ball about itself changes nothing of what it sends.
    ball = f'<body name="runner" mocap="true" pos=".2 0 .7"><geom {BALL} material="shiny"/></body>'
    renderer, data = start(WALL + ball + EYE, header=shiny(2.56), environment=beam())
    before = renderer.layers()["indirect"]
    data.mocap_quat[0] = np.array([0.5, -0.5, 0.5, 0.5])
    mujoco.mj_forward(renderer.model, data)
    renderer.update_scene(data, "eye")
    after = renderer.layers()["indirect"]
    # The basis functions turn with the ball and are not round themselves.
    assert np.abs(after - before).max() < 0.05 * before.max()
