"""How shells are filled coarse to fine and thinned out: Equation 1, interpolation, and what both promise."""

import numpy as np
import pytest

from warp_psf.bake import adapt
from warp_psf.bake.adapt import (
    ERROR_THRESHOLD,
    fit_shell,
    interpolate_around,
    interpolate_double,
    reduce_shell,
    vector_error,
)
from warp_psf.bake.shell import AGREEMENT_INSIDE, fill_shell
from warp_psf.basis import sh, sphere
from warp_psf.field.shells import sample_directions


def smooth_shell(frequency: float, strength: float, order: int = 4) -> np.ndarray:
    """A shell [64, 64, coefficients] that varies with the direction as waves of a given frequency."""
    random = np.random.default_rng(2)
    waves = frequency * random.normal(size=(3, order * order))
    return (strength * np.sin(sample_directions(64) @ waves)).astype(np.float32)


@pytest.mark.parametrize("order", [2, 4, 6])
def test_equation_1_is_the_mean_absolute_difference(order):
    vectors = np.random.default_rng(1).normal(size=(3, 5, order * order))
    rows, columns = 200, 400
    values = sh.evaluate(sphere.latlong_directions(rows, columns), order) @ vectors[..., None, :, None]
    weights = sphere.latlong_solid_angles(rows, columns) / (4 * np.pi)
    expected = (np.abs(values[..., 0].reshape(3, 5, rows, columns)) * weights).sum(axis=(2, 3))
    # The kinks of |f| cost the 96-point rule up to 3 % of a random vector's mean; the threshold is not that exact.
    np.testing.assert_allclose(vector_error(vectors), expected, rtol=0.04)


def test_equation_1_of_a_constant_is_its_value():
    # f = c everywhere has the vector (c sqrt(4 pi), 0, ...).
    vector = np.zeros((1, 1, 16))
    vector[..., 0] = -0.3 * np.sqrt(4 * np.pi)
    np.testing.assert_allclose(vector_error(vector), 0.3, rtol=1e-6)


def test_interpolation_weighs_the_nearest_new_samples():
    coarse = np.array([[1.0, 10.0], [100.0, 1000.0]])[..., None]
    fine = interpolate_double(coarse)[..., 0]
    assert fine.shape == (4, 4)
    # Corners: the nearest.
    np.testing.assert_allclose(fine[[0, 0, 3, 3], [0, 3, 0, 3]], [1, 10, 100, 1000])
    # Boundary: the two nearest, by distance.
    np.testing.assert_allclose(fine[0, 1], 0.75 * 1 + 0.25 * 10)
    np.testing.assert_allclose(fine[0, 2], 0.25 * 1 + 0.75 * 10)
    np.testing.assert_allclose(fine[2, 0], 0.25 * 1 + 0.75 * 100)
    np.testing.assert_allclose(fine[3, 2], 0.25 * 100 + 0.75 * 1000)
    # Inside: four.
    np.testing.assert_allclose(fine[1, 1], (9 * 1 + 3 * 10 + 3 * 100 + 1000) / 16)
    np.testing.assert_allclose(fine[1, 2], (3 * 1 + 9 * 10 + 100 + 3 * 1000) / 16)
    np.testing.assert_allclose(fine[2, 2], (1 + 3 * 10 + 3 * 100 + 9 * 1000) / 16)


def test_a_new_sample_is_the_mean_of_the_four_initial_ones_around_it():
    shell = np.random.default_rng(3).normal(size=(16, 16, 4)) * 1e-4
    reduced = reduce_shell(shell, threshold=1.0)
    assert reduced.shape == (8, 8, 4)
    np.testing.assert_allclose(reduced[2, 5], shell[4:6, 10:12].mean(axis=(0, 1)), rtol=1e-12)


def test_a_constant_shell_needs_the_fewest_samples():
    shell = np.broadcast_to(np.linspace(-1, 2, 16, dtype=np.float32), (64, 64, 16))
    reduced = reduce_shell(shell, 0.001)
    assert reduced.shape == (8, 8, 16)
    np.testing.assert_allclose(reduced, shell[:8, :8], rtol=1e-6)


def test_noise_keeps_every_sample():
    shell = np.random.default_rng(4).normal(size=(64, 64, 16)).astype(np.float32)
    assert reduce_shell(shell, ERROR_THRESHOLD) is shell


def test_resolution_grows_with_what_varies_and_falls_with_the_threshold():
    sizes = [len(reduce_shell(smooth_shell(frequency, 1.0), 0.02)) for frequency in (0.05, 0.5, 1.0, 4.0)]
    assert sizes == sorted(sizes)
    assert sizes[0] == 8
    assert sizes[-1] == 64
    sizes = [len(reduce_shell(smooth_shell(1.0, 0.3), threshold)) for threshold in (0.0, 0.005, 0.02, 0.1, 1.0)]
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[0] == 64
    assert sizes[-1] == 8


@pytest.mark.parametrize("frequency", [0.3, 1.0, 2.0])
def test_every_accepted_halving_is_within_the_threshold_and_the_next_is_not(monkeypatch, frequency):
    halvings = []
    mean = adapt._mean_of_four

    def recorded_mean(vectors):
        halvings.append((vectors, mean(vectors)))
        return halvings[-1][1]

    monkeypatch.setattr(adapt, "_mean_of_four", recorded_mean)
    reduced = reduce_shell(smooth_shell(frequency, 0.2), ERROR_THRESHOLD)
    errors = [vector_error(interpolate_double(halved) - vectors).max() for vectors, halved in halvings]
    accepted = int(np.log2(64 // len(reduced)))
    assert all(error <= ERROR_THRESHOLD for error in errors[:accepted])
    assert all(error > ERROR_THRESHOLD for error in errors[accepted:])
    assert len(errors) == accepted + (len(reduced) > 8)


def test_samples_that_nobody_reads_do_not_count():
    shell = np.zeros((64, 64, 16), np.float32)
    shell[20, 30] = 5.0
    matters = np.ones((64, 64), bool)
    assert len(reduce_shell(shell, ERROR_THRESHOLD, matters)) == 64
    # The spike spreads to the samples between which it is interpolated: those do not matter either.
    matters[10:40, 20:50] = False
    assert len(reduce_shell(shell, ERROR_THRESHOLD, matters)) < 64
    assert len(reduce_shell(shell, ERROR_THRESHOLD, np.zeros((64, 64), bool))) == 8


def filled(shell, inside=None, known=None, radii=0.5):
    """A shell filled from its true vectors, and which samples were cast, bool [R, R]."""
    cast = np.zeros(shell.shape[0] * shell.shape[1], bool)

    def give(chosen):
        assert not cast[chosen].any()
        cast[chosen] = True
        return shell.reshape(len(cast), -1)[chosen]

    none = np.zeros(shell.shape[:2], bool)
    given = None if known is None else np.where(known[..., None], np.float32(7.0), np.float32(0.0)) + 0 * shell
    found = fill_shell(given, none if known is None else known, none if inside is None else inside, radii, give)
    return found, cast.reshape(shell.shape[:2])


@pytest.mark.parametrize(("frequency", "most"), [(0.1, 0.07), (0.5, 0.3), (4.0, 1.0)])
def test_samples_are_cast_where_the_shell_varies(frequency, most):
    shell = smooth_shell(frequency, 0.2)
    found, cast = filled(shell)
    assert 16 * 16 <= cast.sum() <= most * cast.size
    np.testing.assert_array_equal(found[cast], shell[cast])
    # Linear and cubic interpolation agree to the limit, and the cubic one errs by less than their difference.
    assert vector_error(found - shell).max() < AGREEMENT_INSIDE


def test_smooth_shells_are_filled_across_seam_and_poles():
    # Linear in the position: smooth everywhere, also where rows and columns end.
    shell = (0.02 * sample_directions(64) @ np.random.default_rng(3).normal(size=(3, 16))).astype(np.float32)
    found, cast = filled(shell)
    assert cast.sum() == 16 * 16
    np.testing.assert_allclose(found, shell, atol=2e-4)  # cubic, over four samples of 22 degrees of azimuth


def test_nothing_is_interpolated_between_inside_and_outside():
    inside = np.zeros((64, 64), bool)
    inside[:20] = True
    shell = np.where(inside[..., None], 0.004, 0.0).astype(np.float32) * np.ones(16, np.float32)
    found, cast = filled(shell, inside)
    # Nothing at all outside; inside the weights add up to one but for the last bit, which processors round apart.
    np.testing.assert_allclose(found, shell, rtol=1e-6, atol=0.0)
    assert cast[17:23].all()
    assert not cast[40:].all()


def test_known_samples_are_kept_and_not_cast():
    known = np.zeros((64, 64), bool)
    known[10:30, 5:50] = True
    found, cast = filled(np.zeros((64, 64, 16), np.float32), known=known)
    assert (found[known] == 7.0).all()
    assert not cast[known].any()


def test_small_shells_are_cast_whole():
    shell = smooth_shell(0.1, 0.2)[::4, ::4]
    found, cast = filled(shell)
    assert cast.all()
    np.testing.assert_array_equal(found, shell)


def test_fitted_samples_are_fewer_and_as_near():
    vectors = smooth_shell(1.2, 0.05)
    everywhere = np.ones(vectors.shape[:2], bool)
    halved, fitted = (reduce_shell(vectors, 0.01), fit_shell(vectors, 0.01, everywhere))
    assert len(fitted) < len(halved) < 64
    finer = fitted
    while len(finer) < 64:
        finer = interpolate_around(finer)
    # The threshold is kept at each halving, to the samples of the one before: three of them add up.
    assert vector_error(finer - vectors).max() < 0.03


def test_what_is_even_needs_the_fewest_samples_and_keeps_its_value():
    vectors = np.full((64, 64, 16), 0.3, np.float32)
    fitted = fit_shell(vectors, 0.01, np.ones((64, 64), bool))
    assert fitted.shape == (8, 8, 16)
    np.testing.assert_allclose(fitted, 0.3, rtol=1e-6)


def test_interpolation_goes_around_the_axis_and_across_the_poles():
    coarse = np.random.default_rng(4).normal(size=(8, 8, 3))
    fine = interpolate_around(coarse)
    assert fine.shape == (16, 16, 3)
    turned = interpolate_around(np.roll(coarse, 3, axis=1))
    np.testing.assert_allclose(turned, np.roll(fine, 6, axis=1), rtol=1e-12)
    # Beyond a pole is the other side: the mirrored shell is interpolated to the mirrored one.
    np.testing.assert_allclose(interpolate_around(coarse[::-1]), fine[::-1], rtol=1e-12)
    np.testing.assert_allclose(
        fine[0, 1],
        0.75 * (0.75 * coarse[0, 0] + 0.25 * coarse[0, 1]) + 0.25 * (0.75 * coarse[0, 4] + 0.25 * coarse[0, 5]),
    )
