"""The oracles of small suns and sharp environments against closed forms."""

import numpy as np
import pytest

from sims import sunlit
from tests.oracles import make_model, sphere_form_factor
from tests.oracles_sun import SUN_RAYS, sun_directions, traced_environment, traced_sun

UP = np.array([0.0, 0.0, 1.0])
DIAMETER = np.radians(2.0)
FLOOR = '<geom type="plane" size="9 9 1" material="white"/>'
# The sun stands so, for tests in which it stands aslant.
SLANTED = np.array([0.0, -0.6, 0.8])


def see_sun(model_and_data: tuple, points, toward, rays: int = 4096, normals=UP, diameter: float = DIAMETER):
    points = np.atleast_2d(np.asarray(points, np.float64))
    return traced_sun(*model_and_data, points, np.broadcast_to(normals, points.shape), toward, diameter, rays)


def half_plane_share(offset: np.ndarray) -> np.ndarray:
    """The share of a disc of radius 1 on one side of a line at `offset` from its middle."""
    t = np.clip(offset, -1.0, 1.0)
    return 0.5 + (np.arcsin(t) + t * np.sqrt(1 - t * t)) / np.pi


def width_between(places: np.ndarray, shares: np.ndarray, low: float = 0.1, high: float = 0.9) -> float:
    return float(np.diff(np.interp([low, high], shares, places))[0])


@pytest.mark.parametrize("diameter", [0.5, 2.0, 30.0])
@pytest.mark.parametrize("normal", [UP, SLANTED])
def test_an_unshadowed_disc_gives_its_projected_solid_angle(diameter: float, normal: np.ndarray):
    # A disc of half-angle a about the direction d, wholly above the horizon: pi sin(a)^2 (n . d).
    diameter = np.radians(diameter)
    visible, irradiance = see_sun(make_model(FLOOR), [1, 2, 0.5], SLANTED, SUN_RAYS, normal, diameter)
    expected = np.pi * np.sin(diameter / 2) ** 2 * (normal @ SLANTED)
    assert visible == pytest.approx(1.0)
    # The lattice's middle is off by 1 / rays of the disc's radius, at most.
    assert irradiance == pytest.approx(expected, rel=1e-3)


def test_a_disc_behind_the_horizon_is_not_seen():
    model = make_model(FLOOR)
    visible, irradiance = see_sun(model, [0, 0, 0], -UP)
    assert not visible.any() and not irradiance.any()
    visible, _ = see_sun(model, [0, 0, 1.0], [1.0, 0, 0])
    # The sun is rising: half of it is above the horizon.
    assert visible == pytest.approx(0.5, abs=3e-3)


@pytest.mark.parametrize("toward", [UP, SLANTED])
def test_the_shadow_of_an_edge_is_a_segment_of_the_disc(toward: np.ndarray):
    # A thin slab's edge lies along y at x = 0, at the height h; the sun stands in the plane x = 0.
    height = 2.0
    slab = f'<geom type="box" size="20 40 1e-4" pos="20 0 {height}" material="white"/>'
    x = np.linspace(-0.08, 0.08, 161)
    points = np.stack([x, 0 * x, 0 * x], axis=1)
    visible, irradiance = see_sun(make_model(FLOOR + slab), points, toward)
    # The plane through a point and the edge is inclined by atan(x / height); from that plane to the middle of the sun:
    along = np.stack([height / np.hypot(x, height), 0 * x, x / np.hypot(x, height)], axis=1)
    offset = np.arcsin(along @ toward) / (DIAMETER / 2)
    expected = half_plane_share(-offset)
    # 4096 directions of a lattice: a line cuts off a share that is right to about rays^(-3/4) = 0.002.
    assert visible == pytest.approx(expected, abs=4e-3)
    assert irradiance == pytest.approx(np.pi * np.sin(DIAMETER / 2) ** 2 * toward[2] * expected, abs=4e-3 * 1e-3)
    # From 10 % to 90 % of a disc of radius 1 it is 1.374.
    tilted = height / toward[2]
    assert width_between(-x[::-1], visible[::-1]) == pytest.approx(1.374 * tilted * np.tan(DIAMETER / 2), rel=0.01)


def test_a_sphere_over_a_plane_has_an_umbra_and_a_penumbra():
    # The sun at the zenith; at x the ball of radius R at the height H looks asin(R / d) wide, atan(x / H) off the sun.
    radius, height = 0.2, 3.0
    ball = f'<geom type="sphere" size="{radius}" pos="0 0 {height}" material="white"/>'
    x = np.linspace(0.0, 0.4, 401)
    visible, _ = see_sun(make_model(FLOOR + ball), np.stack([x, 0 * x, 0 * x], axis=1), UP)
    wide, off = np.arcsin(radius / np.hypot(x, height)), np.arctan(x / height)
    umbra = x[off + DIAMETER / 2 < wide].max()
    lit = x[off - DIAMETER / 2 > wide].min()
    # The ball is a polyhedron: its silhouette is smaller by up to 0.5 %, here 1 mm, which is one step of x.
    step = 1.1e-3
    assert not visible[x < umbra - step].any()
    assert (visible[x > lit] == 1.0).all()
    between = (x > umbra + 3 * step) & (x < lit - 3 * step)
    assert ((visible[between] > 0.0) & (visible[between] < 1.0)).all()
    # Closed form: umbra R - H tan(a), penumbra R + H tan(a), up to second order in R / H.
    assert [umbra, lit] == pytest.approx(radius + height * np.tan(DIAMETER / 2) * np.array([-1, 1]), abs=2 * step)


def test_directions_fill_the_disc_evenly():
    directions = sun_directions(SLANTED, DIAMETER, 1024)
    angle = np.arccos(directions @ SLANTED)
    assert angle.max() < DIAMETER / 2
    # Even in area: half of them within the radius of half the area.
    assert np.mean(angle < DIAMETER / 2 / np.sqrt(2)) == pytest.approx(0.5, abs=2e-3)
    assert directions.mean(axis=0) / np.linalg.norm(directions.mean(axis=0)) == pytest.approx(SLANTED, abs=1e-5)


def test_a_white_sky_past_a_sphere_is_its_form_factor():
    ball = '<geom type="sphere" size=".5" pos="0 0 1" material="white"/>'
    x = np.linspace(0.0, 2.0, 9)
    points = np.stack([x, 0 * x, 0 * x], axis=1)
    normals = np.broadcast_to(UP, points.shape)
    sky = np.ones((16, 32, 3)) * [1.0, 2.0, 0.5]
    found = traced_environment(*make_model(FLOOR + ball), points, normals, sky, rays=2**14)
    share = 1 - sphere_form_factor(points, UP, np.array([0, 0, 1.0]), 0.5)
    # The polyhedron's silhouette: 0.2 %; and noise of 2^14 stratified rays, less than that.
    assert found == pytest.approx(np.pi * share[:, None] * [1.0, 2.0, 0.5], rel=4e-3)


def test_a_cell_shines_from_where_it_lies():
    # One cell: row 3 of 16 (33.75 to 45 degrees from +z), column 5 of 32 (56.25 to 67.5 degrees from +x).
    sky = np.zeros((16, 32, 3))
    sky[3, 5] = 7.0, 1.0, 0.0
    normals = np.array([UP, [1.0, 0, 0], [0, 1.0, 0], -UP])
    points = np.broadcast_to([0, 0, 1.0], normals.shape)
    found = traced_environment(*make_model(FLOOR), points, normals, sky, rays=2**12)
    theta, phi = np.radians([33.75, 45.0]), np.radians([56.25, 67.5])
    # Integrals of the direction's z, x and y over the cell.
    level = 0.5 * (np.diff(theta) - 0.5 * np.diff(np.sin(2 * theta))).item()
    z = 0.5 * np.diff(np.sin(theta) ** 2).item() * np.diff(phi).item()
    expected = np.array([z, level * np.diff(np.sin(phi)).item(), -level * np.diff(np.cos(phi)).item(), 0.0])
    assert found == pytest.approx(expected[:, None] * [7.0, 1.0, 0.0], rel=1e-3, abs=1e-6)


def test_a_sun_in_an_environment_is_the_disc():
    # The simulation's sun as an image has stairs, smoothed, of a sixth of its diameter: its edges blur by that.
    toward = sunlit.sun_direction()
    slab = '<geom type="box" size="2 2 1e-4" pos="2 0 1" material="white"/>'
    model = make_model(FLOOR + slab)
    # Where the middle of the sun is at the slab's edge x = 0, and around it.
    x = -toward[0] / toward[2] + np.array([-1.0, *np.linspace(-0.015, 0.015, 61), 1.0])
    points, normals = np.stack([x, 0 * x, 0 * x], axis=1), np.tile(UP, (len(x), 1))
    expected = see_sun(model, points, toward, diameter=sunlit.SUN_DIAMETER)[1]
    found = traced_environment(model[0], model[1], points, normals, sunlit.sun(), rays=2**12)
    # As a share of what a surface that faces the sun receives.
    expected = np.repeat(expected[:, None] / (np.pi * np.sin(sunlit.SUN_DIAMETER / 2) ** 2), 3, axis=1)
    found = found / sunlit.SUN_IRRADIANCE
    assert found[0] == pytest.approx(expected[0], rel=2e-3) and not found[-1].any()
    assert ((expected > 0.0) & (expected < expected.max()))[:, 0].sum() > 20
    assert found == pytest.approx(expected, abs=0.03)


@pytest.mark.parametrize("diameter", np.radians([1.0, 2.0, 8.0]))
def test_the_sun_gives_the_same_whatever_its_size(diameter: float):
    model = make_model(FLOOR)
    found = traced_environment(*model, np.zeros((1, 3)), sunlit.sun_direction()[None], sunlit.sun(diameter), rays=2**12)
    # A surface that faces the sun.
    assert found[0] == pytest.approx(sunlit.SUN_IRRADIANCE, rel=1e-3)


def test_seeds_are_independent_and_repeatable():
    model = make_model(FLOOR + '<geom type="sphere" size=".3" pos="0 0 .3"/>')
    sky = sunlit.sky() + sunlit.sun()
    points, normals = np.array([[0.6, 0.2, 0.0]]), UP[None]
    runs = [traced_environment(*model, points, normals, sky, rays=64, seed=seed) for seed in (0, 0, 1)]
    assert np.array_equal(runs[0], runs[1])
    assert not np.array_equal(runs[0], runs[2])
    assert np.array_equal(*(see_sun(model, points, SLANTED)[1] for _ in range(2)))
