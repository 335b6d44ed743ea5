"""Directions, frames and quadrature on the sphere."""

import numpy as np
import pytest
import warp as wp

from warp_psf import device
from warp_psf.basis import sh, sphere

# Float64 rounding over sums of a few thousand terms of order 1.
EXACT = 1e-11


def random_directions(count: int) -> np.ndarray:
    directions = np.random.default_rng(1).normal(size=(count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def test_latlong_follows_the_convention():
    directions = sphere.latlong_directions(4, 8)
    assert directions.shape == (4, 8, 3)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1.0, atol=EXACT)
    theta, phi = np.pi / 8, np.pi / 8
    expected = [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)]
    np.testing.assert_allclose(directions[0, 0], expected, atol=EXACT)
    assert directions[-1, 0, 2] < -0.9
    assert directions[1, 1, 1] > directions[1, 1, 0] > 0.0  # the second column lies beyond 45 degrees, towards +y


def test_latlong_solid_angles_sum_to_the_sphere():
    angles = sphere.latlong_solid_angles(17, 40)
    assert angles.shape == (17, 40)
    assert abs(angles.sum() - 4.0 * np.pi) < EXACT
    np.testing.assert_allclose(angles[0], (1.0 - np.cos(np.pi / 17)) * 2.0 * np.pi / 40, rtol=1e-12)


@pytest.mark.parametrize("half_angle", [1e-3, 0.4, 2.0, np.pi])
def test_fibonacci_cap_is_uniform_in_its_cap(half_angle):
    count = 4000
    directions = sphere.fibonacci_cap(count, half_angle)
    assert directions.shape == (count, 3)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0, atol=EXACT)
    # The chord to +z measures the height above the rim without the rounding of 1 - z in a small cap.
    chord = np.hypot(directions[:, 0], directions[:, 1]) ** 2 + (1.0 - directions[:, 2]) ** 2
    share = chord / (4.0 * np.sin(0.5 * half_angle) ** 2)
    assert share.max() <= 1.0
    np.testing.assert_allclose(np.sort(share), (np.arange(count) + 0.5) / count, atol=1e-9)
    # Around the axis nothing is preferred: a lattice of N directions has a mean of the order 1 / N.
    assert np.abs(directions[:, :2].mean(axis=0)).max() < 5.0 / count


def poles_and_neighbours() -> np.ndarray:
    poles = [[0, 0, 1], [0, 0, -1], [1, 0, 0], [0, -1, 0], [1e-9, 0, 1], [1e-9, 1e-9, -1], [0.6, 0.8, -0.0]]
    return np.concatenate([np.array(poles, dtype=np.float64), random_directions(500)])


def test_frame_is_a_rotation_onto_the_direction():
    directions = poles_and_neighbours()
    frames = sphere.frame(directions)
    np.testing.assert_allclose(frames[..., 2], directions, atol=0.0)
    # Duff et al. 2017 state errors of a few units in the last place.
    products = np.swapaxes(frames, -1, -2) @ frames
    np.testing.assert_allclose(products, np.broadcast_to(np.eye(3), frames.shape), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(frames), 1.0, atol=1e-14)
    np.testing.assert_array_equal(frames[0], np.eye(3))
    np.testing.assert_array_equal(frames[1], np.diag([1.0, -1.0, -1.0]))


@wp.kernel(module="unique")
def _frame_directions(first: int, directions: wp.array(dtype=wp.vec3), frames_out: wp.array(dtype=wp.mat33)):
    _world, item = wp.tid()
    item += first
    frames_out[item] = sphere.frame_of(directions[item])


def test_frame_of_agrees_with_frame():
    directions = poles_and_neighbours().astype(np.float32)
    target = device.find_device()
    frames = wp.zeros(len(directions), dtype=wp.mat33, device=target)
    inputs = [wp.array(directions, dtype=wp.vec3, device=target)]
    device.launch(_frame_directions, (1, len(directions)), inputs, [frames], target)
    # Float32: a few units in the last place of 1.
    np.testing.assert_allclose(frames.numpy(), sphere.frame(directions), atol=1e-6)


@pytest.mark.parametrize("points", sphere.QUADRATURE_DEGREES)
def test_quadrature_reaches_its_degree(points):
    directions, weights = sphere.quadrature(points)
    degree = sphere.QUADRATURE_DEGREES[points]
    assert directions.shape == (points, 3) and weights.shape == (points,)
    assert weights.min() > 0.0
    assert weights.max() < 2.0 * weights.min()  # the points share the sphere about evenly
    assert abs(weights.sum() - 4.0 * np.pi) < EXACT
    np.testing.assert_array_equal(directions[points // 2 :], -directions[: points // 2])
    integrals = weights @ sh.evaluate(directions, degree + 1)
    integrals[0] -= np.sqrt(4.0 * np.pi)
    # The solver stops at 1e-13 of the mean weight, in a basis whose condition is about a thousand.
    assert np.abs(integrals).max() < 1e-10


@pytest.mark.parametrize(("order", "degree"), [(2, 3), (3, 6), (4, 10), (5, 12), (6, 15), (8, 21)])
def test_each_order_has_a_rule_for_its_triple_product(order, degree):
    assert degree >= 3 * (order - 1)
    assert sphere.QUADRATURE_DEGREES[sphere.QUADRATURE_POINTS[order]] >= degree
    directions, weights = sphere.quadrature(sphere.QUADRATURE_POINTS[order])
    values = sh.evaluate(directions, order)
    tensor = np.einsum("q,qi,qj,qk->ijk", weights, values, values, values, optimize=True)
    np.testing.assert_allclose(tensor, sh.tripling_tensor(order), atol=1e-10)


def test_quadrature_of_an_unknown_size_says_which_there_are():
    with pytest.raises(ValueError, match="no quadrature rule has 20 points; choose one of: 16, 32, 64, 96, 176"):
        sphere.quadrature(20)


@pytest.mark.parametrize("degree", [0, 1, 2, 7, 20])
def test_gauss_quadrature_is_exact(degree):
    directions, weights = sphere.gauss_quadrature(degree)
    integrals = weights @ sh.evaluate(directions, degree + 1)
    integrals[0] -= np.sqrt(4.0 * np.pi)
    assert np.abs(integrals).max() < EXACT
    assert weights.min() > 0.0
