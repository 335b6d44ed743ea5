"""Spherical harmonics: the float64 functions against closed forms and quadrature, the Warp functions against them."""

from functools import cache

import numpy as np
import pytest
import warp as wp

from warp_psf import device
from warp_psf.basis import sh, sphere

ORDERS = (2, 3, 4, 5, 6)
# Float64 rounding over sums of a few thousand terms of order 1.
EXACT = 1e-12
# Float32 rounding, 6e-8 relative, over sums of up to a hundred terms of order 1.
FLOAT32 = 5e-6


def random_directions(count: int, seed: int = 1) -> np.ndarray:
    directions = np.random.default_rng(seed).normal(size=(count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def random_rotations(count: int, seed: int = 2) -> np.ndarray:
    rotations = np.linalg.qr(np.random.default_rng(seed).normal(size=(count, 3, 3)))[0]
    return rotations * np.linalg.det(rotations)[:, None, None]


def random_coefficients(count: int, order: int, seed: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, order * order))


def zonal_integral(function, order: int) -> np.ndarray:
    """The profile of a function of z over [0, 1], by Gauss-Legendre quadrature, exact for the powers tested."""
    nodes, weights = np.polynomial.legendre.leggauss(600)
    z, weights = 0.5 * (nodes + 1.0), 0.5 * weights
    legendre = np.polynomial.legendre.legvander(z, order - 1)
    return np.sqrt(np.pi * (2 * np.arange(order) + 1)) * ((weights * function(z)) @ legendre)


# The basis.


def test_first_functions_follow_the_convention():
    x, y, z = direction = np.array([0.48, -0.6, 0.64])
    values = sh.evaluate(direction, 3)
    linear = np.sqrt(3.0 / (4.0 * np.pi))
    square = np.sqrt(15.0 / (4.0 * np.pi))
    expected = [np.sqrt(1.0 / (4.0 * np.pi)), linear * y, linear * z, linear * x]
    expected += [square * x * y, square * y * z, np.sqrt(5.0 / (16.0 * np.pi)) * (3.0 * z * z - 1.0)]
    expected += [square * x * z, 0.5 * square * (x * x - y * y)]
    np.testing.assert_allclose(values, expected, atol=EXACT)


@pytest.mark.parametrize("order", [1, *ORDERS, 9])
def test_basis_is_orthonormal(order):
    directions, weights = sphere.gauss_quadrature(2 * (order - 1))
    values = sh.evaluate(directions, order)
    np.testing.assert_allclose(values.T @ (weights[:, None] * values), np.eye(order * order), atol=EXACT)


def test_addition_theorem():
    a, b = random_directions(50, 1), random_directions(50, 2)
    products = sh.evaluate(a, 6) * sh.evaluate(b, 6)
    legendre = np.polynomial.legendre.legvander((a * b).sum(axis=1), 5)
    for band in range(6):
        total = products[:, sh.bands(6) == band].sum(axis=1)
        np.testing.assert_allclose(total, (2 * band + 1) / (4.0 * np.pi) * legendre[:, band], atol=EXACT)


def test_project_inverts_evaluate():
    coefficients = random_coefficients(4, 5)
    directions, weights = sphere.quadrature(96)
    values = coefficients @ sh.evaluate(directions, 5).T
    # The rule itself is exact to 1e-12.
    np.testing.assert_allclose(sh.project(values, directions, weights, 5), coefficients, atol=1e-10)


def test_counts():
    assert [sh.coefficient_count(order) for order in ORDERS] == [4, 9, 16, 25, 36]
    assert [sh.order_of(count) for count in (1, 4, 9, 16, 25, 36)] == [1, 2, 3, 4, 5, 6]
    for count in (0, -4, 15, 17):
        with pytest.raises(ValueError, match=f"{count} is not a number of SH coefficients; an order n has n"):
            sh.order_of(count)


# Rotation.


@pytest.mark.parametrize("order", ORDERS)
def test_rotation_turns_the_function(order):
    rotations, directions = random_rotations(6), random_directions(6)
    coefficients = random_coefficients(6, order)
    back = np.einsum("nji,nj->ni", rotations, directions)
    expected = (coefficients * sh.evaluate(back, order)).sum(axis=1)
    turned = sh.rotate(coefficients, rotations)
    np.testing.assert_allclose((turned * sh.evaluate(directions, order)).sum(axis=1), expected, atol=EXACT)
    # As the docstring has it: f_world(d) = f_body(rotation^T d), coefficients_world = coefficients_body @ M^T.
    matrices = sh.rotation_matrix(rotations, order)
    np.testing.assert_allclose(turned[0], coefficients[0] @ matrices[0].T, atol=EXACT)


def test_rotations_compose_and_are_orthogonal_and_block_diagonal():
    first, second = random_rotations(2)
    a, b = sh.rotation_matrix(first, 6), sh.rotation_matrix(second, 6)
    np.testing.assert_allclose(sh.rotation_matrix(first @ second, 6), a @ b, atol=EXACT)
    np.testing.assert_allclose(a @ a.T, np.eye(36), atol=EXACT)
    np.testing.assert_allclose(sh.rotation_matrix(np.eye(3), 6), np.eye(36), atol=EXACT)
    band = sh.bands(6)
    assert not a[band[:, None] != band].any()


# Products.


def test_fourth_order_has_77_distinct_tripling_coefficients():
    indices, values = sh.tripling_coefficients(4)
    assert len(values) == 77
    assert (np.diff(indices, axis=1) >= 0).all()
    np.testing.assert_array_equal(values, sh.tripling_tensor(4)[tuple(indices.T)])
    assert np.count_nonzero(sh.tripling_tensor(4)) == 353


@pytest.mark.parametrize("order", ORDERS)
def test_triple_product_is_the_projected_pointwise_product(order):
    a, b = random_coefficients(5, order, 4), random_coefficients(5, order, 5)
    directions, weights = sphere.gauss_quadrature(3 * (order - 1))
    basis = sh.evaluate(directions, order)
    expected = sh.project((a @ basis.T) * (b @ basis.T), directions, weights, order)
    # Sums of some thousand terms of order 1.
    np.testing.assert_allclose(sh.triple_product(a, b), expected, atol=1e-11)
    np.testing.assert_allclose(np.einsum("nij,nj->ni", sh.product_matrix(a), b), expected, atol=1e-11)
    np.testing.assert_allclose(sh.double_product(a, b), expected[:, 0] * np.sqrt(4.0 * np.pi), atol=1e-11)


def test_the_function_one_is_the_unit_of_the_product():
    one = np.zeros(16)
    one[0] = np.sqrt(4.0 * np.pi)
    a = random_coefficients(1, 4)[0]
    np.testing.assert_allclose(sh.triple_product(one, a), a, atol=EXACT)
    np.testing.assert_allclose(sh.product_matrix(one), np.eye(16), atol=EXACT)


# Zonal functions.


def test_clamped_cosine_has_its_closed_form():
    # Ramamoorthi and Hanrahan 2001: the factors that turn radiance coefficients into irradiance coefficients.
    factors = np.sqrt(4.0 * np.pi / (2 * np.arange(5) + 1)) * sh.clamped_cosine(5)
    np.testing.assert_allclose(factors, np.pi * np.array([1.0, 2.0 / 3.0, 1.0 / 4.0, 0.0, -1.0 / 24.0]), atol=EXACT)


def test_white_light_gives_irradiance_pi():
    white = np.zeros(16)
    white[0] = np.sqrt(4.0 * np.pi)
    cosine = sh.zonal(sh.clamped_cosine(4), random_directions(10))
    np.testing.assert_allclose(sh.double_product(cosine, white), np.pi, atol=EXACT)


def test_zonal_function_depends_on_the_angle_to_its_axis():
    axes, directions = random_directions(20, 1), random_directions(20, 2)
    profile = sh.phong_lobe(7.0, 6)
    values = (sh.zonal(profile, axes) * sh.evaluate(directions, 6)).sum(axis=1)
    legendre = np.polynomial.legendre.legvander((axes * directions).sum(axis=1), 5)
    expected = legendre @ (profile * np.sqrt((2 * np.arange(6) + 1) / (4.0 * np.pi)))
    np.testing.assert_allclose(values, expected, atol=EXACT)


@pytest.mark.parametrize("exponent", [0.0, 1.0, 2.5, 30.0, 1000.0])
def test_phong_lobe_against_quadrature(exponent):
    expected = zonal_integral(lambda z: (exponent + 2.0) / (2.0 * np.pi) * z**exponent, 6)
    # 600 nodes are exact for whole powers up to 1194; z^2.5 has a singular derivative at 0, which costs some digits.
    np.testing.assert_allclose(sh.phong_lobe(exponent, 6), expected, atol=1e-10)


def test_phong_lobe_keeps_energy():
    # Under white light of radiance 1 the lobe (n+2)/(2 pi) cos^n integrates to (n+2)/(n+1).
    for exponent in (0.0, 5.0, 1000.0):
        lobe = sh.phong_lobe(exponent, 3)[0] * np.sqrt(4.0 * np.pi)
        assert abs(lobe - (exponent + 2.0) / (exponent + 1.0)) < EXACT


def test_cap_against_quadrature():
    nodes, weights = np.polynomial.legendre.leggauss(20)
    for half_angle in (1e-4, 0.3, 0.5 * np.pi, 2.5, np.pi):
        height = 2.0 * np.sin(0.5 * half_angle) ** 2
        z = 1.0 - 0.5 * height * (1.0 - nodes)
        integrals = (0.5 * height * weights) @ np.polynomial.legendre.legvander(z, 5)
        expected = np.sqrt(np.pi * (2 * np.arange(6) + 1)) * integrals
        # Relative to the cap's solid angle, so that small caps are held to as many digits as large ones.
        np.testing.assert_allclose(sh.cap(half_angle, 6), expected, rtol=0.0, atol=EXACT * height)


def test_caps_of_many_angles_at_once():
    angles = np.array([[0.0, 0.5, 1.0], [1.5, 2.0, np.pi]])
    profiles = sh.cap(angles, 4)
    assert profiles.shape == (2, 3, 4)
    assert not profiles[0, 0].any()
    np.testing.assert_allclose(profiles[1, 2], [np.sqrt(4.0 * np.pi), 0.0, 0.0, 0.0], atol=EXACT)
    np.testing.assert_array_equal(profiles[0, 1], sh.cap(0.5, 4))


# Warp.


@cache
def make_every_function(order: int):
    """A kernel that runs every Warp function of an order."""
    functions = sh.make_sh(order)
    vec, per_band = functions.vec, wp.types.vector(order, wp.float32)

    @wp.kernel(module="unique")
    def run_every_function(
        first: int,
        directions: wp.array(dtype=wp.vec3),
        rows: wp.array3d(dtype=vec),
        values_out: wp.array(dtype=vec),
        turned_out: wp.array(dtype=vec),
        zonal_out: wp.array(dtype=vec),
        integral_out: wp.array(dtype=wp.float32),
    ):
        world, item = wp.tid()
        item += first
        values = functions.evaluate(directions[item])
        turned = functions.rotate(values, rows[world, 1])
        values_out[item] = values
        turned_out[item] = turned
        zonal_out[item] = functions.zonal(wp.static(per_band(*range(1, order + 1))), directions[item])
        integral_out[item] = functions.double_product(values, turned)

    return run_every_function


@pytest.mark.parametrize("order", ORDERS)
def test_warp_agrees_with_numpy(order):
    target = device.find_device()
    vec = sh.make_sh(order).vec
    directions = np.concatenate([np.eye(3), -np.eye(3), random_directions(300)]).astype(np.float32)
    rotations = random_rotations(2)
    count = len(directions)
    inputs = [
        wp.array(directions, dtype=wp.vec3, device=target),
        wp.array(sh.rotation_rows(rotations, order)[None], dtype=vec, ndim=3, device=target),
    ]
    outputs = [wp.zeros(count, dtype=kind, device=target) for kind in (vec, vec, vec, wp.float32)]
    device.launch(make_every_function(order), (1, count), inputs, outputs, target)
    values = sh.evaluate(directions, order)
    turned = sh.rotate(values, rotations[1])
    zonal = (1 + sh.bands(order)) * values
    expected = (values, turned, zonal, sh.double_product(values, turned))
    for got, want in zip(outputs, expected, strict=True):
        np.testing.assert_allclose(got.numpy(), want, atol=FLOAT32)


def test_orders_are_made_once_and_checked():
    assert sh.make_sh(4) is sh.make_sh(4)
    assert (sh.make_sh(4).order, sh.make_sh(4).count) == (4, 16)
    with pytest.raises(ValueError, match="SH order 0 has no coefficients; choose an order of at least 1"):
        sh.make_sh(0)
