"""compose="log": log shadow fields against the coverage behind them, and light against products and ray casting."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

import warp_psf as psf
from sims.bodies import torus
from tests.oracles import make_model, make_renderer, shade_points, traced_irradiance
from warp_psf.bake.logarithm import bake_logarithm, take_logarithm
from warp_psf.basis import sh_exp
from warp_psf.field.shells import SHELL_COUNT, shell_radii

ORDER = 4
FLOOR = '<geom name="floor" type="plane" size="9 9 .1" material="white"/>'
LIGHT = psf.Environment.from_coefficients(psf.load_environment("studio").project(ORDER))


@pytest.fixture(scope="module")
def ring():
    mesh = psf.make_mesh("ring", *torus(rings=24, segments=48))
    return mesh, psf.bake_mesh(mesh, ORDER).field


def grid(half: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    x = np.linspace(-half, half, count)
    points = np.stack([*np.meshgrid(x, x), np.zeros((count, count))], axis=-1).reshape(-1, 3)
    return points, np.array([0.0, 0.0, 1.0])


@pytest.mark.parametrize(("radii", "tolerance"), [(1.2, 0.01), (2.0, 0.004), (5.0, 0.001), (20.0, 0.0001)])
def test_a_log_fields_exponential_is_what_the_coverage_leaves(ring, radii, tolerance):
    mesh, field = ring
    directions = np.random.default_rng(1).normal(size=(500, 3))
    points = mesh.center + radii * mesh.radius * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    visible = sh_exp.one(ORDER) - field.lookup(points)
    found = sh_exp.exponential(take_logarithm(field).lookup(points))
    # As a share of full visibility: 8 bits of logarithms that fall with distance as coverage does.
    error = np.linalg.norm(found - visible, axis=1) / np.sqrt(4 * np.pi)
    assert np.sqrt(np.mean(error**2)) < tolerance


def test_a_log_field_is_kept_and_found_again(ring, monkeypatch, tmp_path):
    monkeypatch.setenv("WARP_PSF_CACHE", str(tmp_path))
    mesh, field = ring
    first, again = (bake_logarithm(mesh, field) for _ in range(2))
    assert first.logarithm and again.logarithm
    np.testing.assert_array_equal(first.codes, again.codes)
    assert len(list(tmp_path.iterdir())) == 1
    # Another field of the same mesh, here with other samples, is another logarithm.
    few = replace(field, resolutions=np.full(SHELL_COUNT, 8, np.int32), codes=field.codes[: 64 * SHELL_COUNT])
    assert len(bake_logarithm(mesh, few).codes) <= 64 * SHELL_COUNT
    assert len(shell_radii(1.0)) == SHELL_COUNT


@pytest.mark.parametrize("shape", ['type="sphere" size=".5"', 'type="ellipsoid" size=".5 .4 .3"'])
def test_one_occluder_is_as_near_to_ray_casting_as_four_bands_allow(shape):
    xml = FLOOR + f'<geom name="body" {shape} pos="0 0 .8" material="white"/>'
    renderer, data = make_renderer(xml, environment=LIGHT, compose="log", bounces=0)
    points, normal = grid(1.5, 20)
    found, _ = shade_points(renderer, "floor", points, normal)
    normals = np.broadcast_to(normal, points.shape)
    expected = traced_irradiance(renderer.model, data, points, normals, LIGHT.project(ORDER))
    # Truncation alone is an RMS of 0.011 under one sphere, and the logarithm's threshold lets 2 % through.
    assert np.sqrt(np.mean((found - expected) ** 2)) < 0.015 * expected.max()


def test_the_order_of_occluders_is_of_no_account():
    balls = [f'<geom name="{n}" type="ellipsoid" size=".4 .3 .2" pos="{x} 0 {z}" material="white"/>' for n, x, z in
             (("a", -0.2, 0.5), ("b", 0.2, 1.1), ("c", 0.0, 1.7))]  # fmt: skip
    points, normal = grid(1.0, 12)
    found = []
    for ordered in (balls, balls[::-1], [balls[1], balls[2], balls[0]]):
        renderer, _ = make_renderer(FLOOR + "".join(ordered), environment=LIGHT, compose="log", bounces=0)
        found.append(shade_points(renderer, "floor", points, normal)[0])
    # Float32 sums of three logarithms.
    np.testing.assert_allclose(found[1], found[0], rtol=2e-5)
    np.testing.assert_allclose(found[2], found[0], rtol=2e-5)


def test_half_a_shadow_is_half_of_the_shadow():
    points, normal = grid(0.6, 8)
    shadow = []
    for alpha in (1.0, 0.5):
        ball = f'<geom type="ellipsoid" size=".5 .4 .3" pos="0 0 .7" rgba="1 1 1 {alpha}"/>'
        renderer, _ = make_renderer(FLOOR + ball, environment=LIGHT, compose="log", bounces=0)
        shadow.append(shade_points(renderer, "floor", points, normal)[0])
    clear, _ = shade_points(make_renderer(FLOOR, environment=LIGHT, bounces=0)[0], "floor", points, normal)
    # A see-through body's visibility is multiplied; its opaque twin's shadow differs by what the logarithm leaves out.
    np.testing.assert_allclose(clear - shadow[1], 0.5 * (clear - shadow[0]), atol=0.03 * clear.max())


def test_both_ways_agree_under_an_area_light():
    xml = FLOOR + '<geom type="ellipsoid" size=".5 .4 .3" pos="0 0 .7" material="white"/>'
    lamp = psf.sphere_light("lamp", 0.5, (3.0, 3.0, 3.0), (0.8, 0.0, 3.0))
    points, normal = grid(1.2, 14)
    found = [
        shade_points(
            make_renderer(xml, environment=None, lights=[lamp], compose=compose, bounces=0)[0], "floor", points, normal
        )[0]
        for compose in ("product", "log")
    ]
    # The logarithm's threshold lets a fiftieth through, and clips what overshoots.
    assert np.sqrt(np.mean((found[1] - found[0]) ** 2)) < 0.03 * found[0].max()


def test_an_unknown_way_is_refused():
    model, _ = make_model(FLOOR)
    with pytest.raises(ValueError, match="compose is 'sum'; choose 'product' or 'log'"):
        psf.Renderer(model, 4, 4, compose="sum")


def test_log_renders_with_bounces_and_changes_of_the_model():
    model, data = make_model(FLOOR + '<geom name="g" type="ellipsoid" size=".5 .4 .3" pos="0 0 .5" material="white"/>')
    with psf.Renderer(model, 24, 32, environment=LIGHT, compose="log", bounces=1) as renderer:
        renderer.update_scene(data)
        before = renderer.layers()
        model.geom("g").rgba = (0.5, 0.5, 0.5, 0.4)
        model.geom("g").matid = -1
        mujoco.mj_forward(model, data)
        renderer.update_scene(data)
        after = renderer.layers()
    assert np.isfinite(before["color"]).all() and np.isfinite(after["color"]).all()
    assert after["direct"].mean() > before["direct"].mean()
