"""How many samples each shell needs (Tamura 2006, section 4)."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache

import numpy as np

from warp_psf.basis import sh, sphere
from warp_psf.field.shells import COARSEST_RESOLUTION

# Tamura 2006, section 6.1: the largest threshold whose images cannot be told from those of the full field.
ERROR_THRESHOLD = 0.010
# Rounds of fitting new samples; more brought no shell below the threshold.
FIT_ROUNDS = 3
# Directions at which Equation 1's absolute value is integrated.
_ERROR_POINTS = 96


def vector_error(difference: np.ndarray) -> np.ndarray:
    """Equation 1: the mean over directions of the absolute value of SH functions [..., coefficients]."""
    basis = _error_basis(sh.order_of(difference.shape[-1]))
    values = np.abs(difference.reshape(-1, difference.shape[-1]).astype(np.float32) @ basis[0])
    return (values @ basis[1]).reshape(difference.shape[:-1])


def reduce_shell(
    vectors: np.ndarray,
    threshold: float,
    matters: np.ndarray | None = None,
    error: Callable[[np.ndarray], np.ndarray] = vector_error,
) -> np.ndarray:
    """Halves a shell's resolution for as long as interpolation reproduces its samples within `threshold`.

    vectors: [R, R, coefficients], R a power of two; matters: bool [R, R], False where no receiver can ever read the
    sample (deep inside the solid), so that its error does not count. error: Equation 1 for differences of vectors
    [..., coefficients] of another basis than SH. Returns [R_c, R_c, coefficients].
    Steps 3 to 7 of Tamura 2006, section 4; the difference is its Equation 1.
    """
    if matters is None:
        matters = np.ones(vectors.shape[:2], bool)
    while vectors.shape[0] > COARSEST_RESOLUTION:
        halved = _mean_of_four(vectors)
        difference = interpolate_double(halved) - vectors
        if np.any(error(difference)[matters] > threshold):
            break
        vectors, matters = halved, _any_of_four(matters)
    return vectors


def fit_shell(vectors: np.ndarray, threshold: float, matters: np.ndarray) -> np.ndarray:
    """Halves a shell's resolution as `reduce_shell` does, to fewer samples within the same threshold.

    Samples are interpolated as lookups do it, around the axis and across the poles, and the new samples are not means
    but those from which interpolation comes closest to the old ones: what it misses is added to them, FIT_ROUNDS times.
    """
    while vectors.shape[0] > COARSEST_RESOLUTION:
        halved = _mean_of_four(vectors)
        for _ in range(FIT_ROUNDS):
            missed = np.where(matters[..., None], vectors - interpolate_around(halved), 0)
            halved = halved + _mean_of_four(missed)
        if np.any(vector_error(interpolate_around(halved) - vectors)[matters] > threshold):
            break
        vectors, matters = halved, _any_of_four(matters)
    return vectors


def interpolate_around(vectors: np.ndarray) -> np.ndarray:
    """Vectors [R, R, ...] at twice the resolution as lookups find them: periodic in azimuth, and across the poles."""
    across = np.roll(vectors, len(vectors) // 2, axis=1)
    padded = np.concatenate([across[:1], vectors, across[-1:]])
    padded = np.concatenate([padded[:, -1:], padded, padded[:, :1]], axis=1)
    return interpolate_double(padded)[2:-2, 2:-2]


def interpolate_double(vectors: np.ndarray) -> np.ndarray:
    """Vectors at twice the resolution: four nearest samples inside, two on the boundary, one in the corners."""
    return _interpolate_rows(_interpolate_rows(vectors).swapaxes(0, 1)).swapaxes(0, 1)


def _interpolate_rows(vectors: np.ndarray) -> np.ndarray:
    # A fine sample lies a quarter of a coarse cell from one coarse sample and three quarters from the next.
    before = np.concatenate([vectors[:1], vectors[:-1]])
    after = np.concatenate([vectors[1:], vectors[-1:]])
    fine = np.empty((2 * len(vectors), *vectors.shape[1:]), vectors.dtype)
    fine[0::2] = 0.75 * vectors + 0.25 * before
    fine[1::2] = 0.75 * vectors + 0.25 * after
    return fine


def _mean_of_four(vectors: np.ndarray) -> np.ndarray:
    return 0.25 * (vectors[0::2, 0::2] + vectors[1::2, 0::2] + vectors[0::2, 1::2] + vectors[1::2, 1::2])


def _any_of_four(flags: np.ndarray) -> np.ndarray:
    return flags[0::2, 0::2] | flags[1::2, 0::2] | flags[0::2, 1::2] | flags[1::2, 1::2]


@cache
def _error_basis(order: int) -> tuple[np.ndarray, np.ndarray]:
    directions, weights = sphere.quadrature(_ERROR_POINTS)
    return sh.evaluate(directions, order).T.astype(np.float32), (weights / (4 * math.pi)).astype(np.float32)
