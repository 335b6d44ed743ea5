"""Exponentials and logarithms of SH vectors: their laws, one circular blocker, and the Warp twins."""

from functools import cache

import numpy as np
import pytest
import warp as wp

from warp_psf.basis import sh, sh_exp, sphere
from warp_psf.device import find_device, launch

ORDERS = (3, 4, 5, 6, 8)
# Float64 after a few products of vectors whose norm is about ten.
EXACT = 1e-10
UP = np.array([0.0, 0.0, 1.0])


def caps_visible(half_angle, order: int, axis=UP) -> np.ndarray:
    """What circular blockers leave visible, on SH."""
    blocked = sh.zonal(sh.cap(half_angle, order), np.broadcast_to(axis, (*np.shape(half_angle), 3)))
    return sh_exp.one(order) - blocked


def converged(f: np.ndarray) -> np.ndarray:
    """exp_*(f) to rounding: with so many squares the series is exact."""
    constant, rest = sh_exp.isolate(f)
    squarings = sh_exp.count_squarings(rest, 1e-2)
    return constant[..., None] * sh_exp.raise_to_power(
        sh_exp.power_series(rest / 2.0 ** squarings[..., None], 6), squarings
    )


def random_logarithms(order: int, norm: float, count: int = 50) -> np.ndarray:
    vectors = np.random.default_rng(3).normal(size=(count, order * order))
    return norm * vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


METHODS = {
    "PS*-9": lambda f: sh_exp.scaled_power_series(f, 9),
    "PS*-2": lambda f: sh_exp.scaled_power_series(f, 2),
    "HYB": sh_exp.hybrid,
    "renderer's": sh_exp.exponential,
}


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_the_exponential_of_a_constant_is_the_constants(method, order):
    f = -2.5 * sh_exp.one(order)
    np.testing.assert_allclose(method(f), np.exp(-2.5) * sh_exp.one(order), atol=EXACT)


@pytest.mark.parametrize("order", ORDERS)
def test_of_a_short_vector_the_exponential_is_its_series(order):
    f = random_logarithms(order, 0.05)
    expected = sh_exp.one(order) + f + sh.triple_product(f, f) / 2
    # The cubic term is at most |f|^3 / 6 times the largest value of a basis function of these orders, about 2.
    assert np.abs(sh_exp.exponential(f) - expected).max() < 0.05**3 / 6 * 2


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize(
    ("name", "tolerance"),
    # The series scale until the first term that they leave out is 2 %; squaring adds up what is left. The linear
    # approximation leaves out about a tenth of |f^| / 2^p in each of the 2^p powers, a tenth of 0.25 |f^| = 0.25 * 6.6.
    [("PS*-9", 0.03), ("PS*-2", 0.05), ("renderer's", 0.05), ("HYB", 0.17)],
)
def test_every_method_comes_near_the_exponential(order, name, tolerance):
    f = sh_exp.logarithm(caps_visible(np.linspace(0.05, 1.5, 40), order))
    exact = converged(f)
    error = np.linalg.norm(METHODS[name](f) - exact, axis=-1) / np.linalg.norm(exact, axis=-1)
    assert error.max() < tolerance


@pytest.mark.parametrize("order", ORDERS)
def test_the_logarithm_is_the_inverse_where_visibility_is_above_the_threshold(order):
    # A blocker so small that every value, even where band-limiting overshoots, stays above the threshold.
    g = caps_visible(np.array([0.02, 0.06, 0.12]), order)
    assert np.linalg.eigvalsh(sh.product_matrix(g)).min() > sh_exp.LOG_THRESHOLD
    np.testing.assert_allclose(converged(sh_exp.logarithm(g)), g, atol=1e-6)


@pytest.mark.parametrize("order", ORDERS)
def test_inversion_is_nearer_than_integration_for_a_circular_blocker(order):
    # Ren 2006, figure 1 of the supplement.
    g = caps_visible(np.linspace(0.1, 1.5, 29), order)

    def error(logarithm) -> float:
        return np.sqrt(((converged(logarithm(g)) - g) ** 2).sum() / (g**2).sum())

    assert error(sh_exp.logarithm) < error(sh_exp.logarithm_by_integration)


def test_two_small_blockers_are_the_product_of_their_visibilities():
    order = 4
    axes = np.array([[0.6, 0.0, 0.8], [-0.6, 0.0, 0.8]])
    first, second = (caps_visible(0.3, order, axis) for axis in axes)
    logarithms = sh_exp.logarithm(np.stack([first, second])).sum(axis=0)
    # log_* and exp_* are exact for one function; of two the truncated products do not commute, to second order in the
    # blockers' size: 0.3^4 / 2.
    np.testing.assert_allclose(sh_exp.exponential(logarithms), sh.triple_product(first, second), atol=4e-3)


@pytest.mark.parametrize("order", ORDERS)
def test_a_blockers_logarithm_is_zonal(order):
    half_angle = np.array([0.2, 0.8, 1.3])
    expected = sh_exp.logarithm(caps_visible(half_angle, order))
    profile = sh_exp.cap_logarithm(half_angle, order)
    np.testing.assert_allclose(sh.zonal(profile, np.broadcast_to(UP, (3, 3))), expected, atol=EXACT)


def test_a_circular_blockers_linear_approximation_is_its_best():
    order = 4
    f = sh_exp.logarithm(caps_visible(np.array([0.2, 0.6, 1.2, 1.5]), order))
    exact = converged(f)
    sides = np.stack([np.broadcast_to(sh_exp.one(order), f.shape), f], axis=-1)
    best = np.array([side @ np.linalg.lstsq(side, g, rcond=None)[0] for side, g in zip(sides, exact, strict=True)])
    # What the table's steps and the exponentials behind it leave.
    np.testing.assert_allclose(sh_exp.optimal_linear(f), best, atol=0.03)


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_turning_commutes_with_the_exponential(method):
    f = sh_exp.logarithm(caps_visible(0.7, 4)) + sh_exp.logarithm(caps_visible(0.4, 4, np.array([0.6, 0.0, 0.8])))
    rotation = sphere.frame(np.array([0.36, 0.48, 0.8]))
    # The quadratures are exact for products of band-limited functions, and cut the series' high powers alike only to
    # the share that those have.
    np.testing.assert_allclose(method(sh.rotate(f, rotation)), sh.rotate(method(f), rotation), atol=2e-3)


@cache
def make_every_method(order: int):
    kit = sh_exp.make_sh_exp(order)
    vec, ExpTable = kit.vec, kit.ExpTable

    @wp.kernel(enable_backward=False, module="unique")
    def run_every_method(
        first: int,
        logarithms: wp.array(dtype=vec),
        sines: wp.array(dtype=wp.float32),
        axes: wp.array(dtype=wp.vec3),
        norm_of_nine: float,
        table: wp.array(dtype=ExpTable),
        out: wp.array2d(dtype=vec),
    ):
        world, item = wp.tid()
        item += first
        f = logarithms[item]
        out[0, item] = kit.exponential(f, table)
        out[1, item] = kit.hybrid(f, table)
        out[2, item] = kit.optimal_linear(f, table)
        out[3, item] = kit.power_series(f, 3, table)
        out[4, item] = kit.scaled_power_series(f, 9, norm_of_nine, table)
        out[5, item] = kit.product(f, logarithms[0], table)
        out[6, item] = kit.cap_logarithm(axes[item], sines[item], table)

    return run_every_method


@pytest.mark.parametrize("order", ORDERS)
def test_warp_agrees_with_numpy(order):
    device = find_device()
    vec = sh_exp.make_sh_exp(order).vec
    count = 70
    f = np.concatenate([np.zeros((1, order * order)), random_logarithms(order, 0.4), random_logarithms(order, 3.0, 19)])
    f = f.astype(np.float32)
    f[:, 0] -= 1.0
    half_angle = np.linspace(0.0, np.pi / 2, count)
    axes = np.random.default_rng(4).normal(size=(count, 3))
    axes = (axes / np.linalg.norm(axes, axis=1, keepdims=True)).astype(np.float32)
    out = wp.zeros((7, count), dtype=vec, device=device)
    inputs = [
        wp.array(f, dtype=vec, device=device),
        wp.array(np.sin(half_angle), dtype=wp.float32, device=device),
        wp.array(axes, dtype=wp.vec3, device=device),
        sh_exp.series_norm(9),
        sh_exp.upload_exponential(order, device),
    ]
    launch(make_every_method(order), (1, count), inputs, [out], device)
    expected = [
        sh_exp.exponential(f),
        sh_exp.hybrid(f),
        sh_exp.optimal_linear(f),
        sh_exp.power_series(f, 3),
        sh_exp.scaled_power_series(f, 9),
        sh.triple_product(f, f[0]),
    ]
    for got, want in zip(out.numpy(), expected, strict=False):
        # Float32 through at most five squares of vectors of this size.
        np.testing.assert_allclose(got, want, atol=2e-5 * np.abs(want).max())
    logarithm = sh.zonal(sh_exp.cap_logarithm(half_angle, order), axes)
    # Between the table's steps, where an eigenvalue reaches the threshold, the profiles have kinks: half a per cent of
    # the largest logarithm, whose norm is 6.6.
    np.testing.assert_allclose(out.numpy()[6], logarithm, atol=0.033)
