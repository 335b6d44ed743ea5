"""The samples of a shell, coarse to fine: rays are cast where neighbouring samples do not tell what they would find.

A field keeps up to 64 x 64 samples of a shell because somewhere on it the vectors change fast; elsewhere they hardly
do. Every fourth sample of every fourth row is cast first. In between, a sample is interpolated where the linear and
the cubic interpolation agree: that is about the error of the linear one, and the cubic one's is a fraction of it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np

from warp_psf.bake.adapt import vector_error

# Samples per axis that are cast in any case.
FIRST_SAMPLES = 16
# Next to the bounding sphere, on shells between so many radii, a thin part that reaches the sphere is as far away as it
# is wide. The spacing at the equator must not exceed that.
FIRST_SAMPLES_CLOSE = 32
CLOSE = (0.7, 1.7)
# How far apart linear and cubic interpolation may be, in units of Tamura's Equation 1 (a share of full coverage).
# Within the bounding sphere that is the noise of the rays; outside, where they are denser and coverage falls, less.
AGREEMENT_INSIDE = 0.005
AGREEMENT_OUTSIDE = 0.0025
# Bounding radii that tell shells on or within the bounding sphere from those outside.
AT_SPHERE = 1.1
Cast = Callable[[np.ndarray], np.ndarray]


def fill_shell(
    vectors: np.ndarray | None, known: np.ndarray, inside: np.ndarray, radii: float, cast: Cast
) -> np.ndarray:
    """The vectors of a shell, float32 [R, R, K], rows (theta) before columns (phi).

    vectors: those of the samples that are `known`, bool [R, R], or None when none is. inside: which samples were moved
    out of the solid, bool [R, R]: nothing is interpolated between those and others. radii: the shell's radius in
    bounding radii. cast: gives the vectors, float32 [n, K], of samples by their flat indices [n].
    """
    first = FIRST_SAMPLES_CLOSE if CLOSE[0] < radii < CLOSE[1] else FIRST_SAMPLES
    agreement = AGREEMENT_INSIDE if radii < AT_SPHERE else AGREEMENT_OUTSIDE
    resolution = len(known)
    known = known.copy()

    def cast_where(wanted: np.ndarray) -> None:
        nonlocal vectors
        chosen = np.flatnonzero(wanted & ~known)
        if not len(chosen):
            return
        found = cast(chosen)
        if vectors is None:
            vectors = np.empty((resolution, resolution, found.shape[1]), np.float32)
        vectors.reshape(resolution**2, -1)[chosen] = found
        known.ravel()[chosen] = True

    spacing = max(resolution // first, 1)
    wanted = np.zeros((resolution, resolution), bool)
    wanted[::spacing, ::spacing] = True
    cast_where(wanted)
    assert vectors is not None  # some samples were known, or are now
    while spacing > 1:
        linear, cubic = (_interpolate(vectors[::spacing, ::spacing], resolution, degree) for degree in (1, 3))
        alike = _of_one_kind(inside, spacing)
        spacing //= 2
        finer = np.s_[::spacing, ::spacing]
        taken = (vector_error(linear - cubic) <= agreement) & alike[finer] & ~known[finer]
        vectors[finer][taken] = cubic[taken]
        known[finer] |= taken
        wanted[finer] = True
        cast_where(wanted)
    return vectors


def _interpolate(coarse: np.ndarray, resolution: int, degree: int) -> np.ndarray:
    """Vectors at every sample and in the middle between two, of samples that stand apart: [n, n, k] to [2n, 2n, k]."""
    rows, columns = _row_weights(len(coarse), resolution, degree), _column_weights(len(coarse), degree)
    finer = np.einsum("ab,bck->ack", rows, _over_poles(coarse), optimize=True)
    return np.einsum("ab,cbk->cak", columns, finer, optimize=True)


def _over_poles(rows: np.ndarray) -> np.ndarray:
    """Rows [n, n, ...] with the two beyond either pole, which are the nearest rows seen from the other side."""
    across = np.roll(rows, rows.shape[1] // 2, axis=1)
    return np.concatenate([across[1::-1], rows, across[:-3:-1]])


def _of_one_kind(kind: np.ndarray, spacing: int) -> np.ndarray:
    """Where all samples from which one is interpolated, and those near it, are of its kind; bool [R, R]."""
    low, high = kind, kind
    for axis, reach in ((0, 2 * spacing), (1, 2 * spacing)):
        low, high = (_extreme(values, axis, reach, pick) for values, pick in ((low, np.minimum), (high, np.maximum)))
    return low == high


def _extreme(values: np.ndarray, axis: int, reach: int, pick: np.ufunc) -> np.ndarray:
    """The least or largest of the values at most `reach` samples away along an axis."""
    half = np.roll(values, values.shape[1] // 2, axis=1)
    if axis == 0:
        padded = np.concatenate([half[reach - 1 :: -1], values, half[: -reach - 1 : -1]])
        return pick.reduce([padded[k : k + len(values)] for k in range(2 * reach + 1)])
    return pick.reduce([np.roll(values, k, axis=1) for k in range(-reach, reach + 1)])


@cache
def _row_weights(count: int, resolution: int, degree: int) -> np.ndarray:
    """What the rows of `_over_poles` count in each of 2 `count` rows, float32."""
    spacing = resolution // count
    rows = np.arange(0, resolution, spacing)
    # A row r beyond the first is row -1 - r seen from the other side, and likewise beyond the last.
    positions = np.concatenate([-1 - rows[1::-1], rows, 2 * resolution - 1 - rows[:-3:-1]])
    return _lagrange(positions, np.arange(0, resolution, spacing / 2), degree)


@cache
def _column_weights(count: int, degree: int) -> np.ndarray:
    """What `count` columns around the axis count in each of twice as many, float32."""
    weights = _lagrange(np.arange(-2, count + 2), np.arange(0, count, 0.5), degree)
    weights[:, 2:4] += weights[:, -2:]
    weights[:, -4:-2] += weights[:, :2]
    return weights[:, 2:-2]


def _lagrange(positions: np.ndarray, targets: np.ndarray, degree: int) -> np.ndarray:
    """What values at rising `positions` count at the targets, float32 [targets, positions]."""
    weights = np.zeros((len(targets), len(positions)), np.float32)
    points = degree + 1
    for row, target in enumerate(targets):
        first = int(np.searchsorted(positions, target, side="right")) - points // 2
        chosen = positions[first : first + points]
        for k, position in enumerate(chosen):
            others = np.delete(chosen, k)
            weights[row, first + k] = np.prod((target - others) / (position - others))
    return weights
