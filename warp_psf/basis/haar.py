"""Haar wavelets on the sphere: an equal-area map of it, transformed, truncated, multiplied and turned.

A map of n x n cells, n a power of two, is uniform in height and in azimuth, so that all cells have the same solid angle
and the flat two-dimensional Haar basis is orthonormal over the sphere. A vector has the map's shape. Its place [0, 0]
is the scaling coefficient; of the 2k x 2k places that begin there, those of the right, the lower and the diagonal
quarter are the three details of k x k squares: differences between left and right, upper and lower, and both.
"""

import math

import numpy as np

# What is kept of a vector: Tamura 2006, section 6.
KEPT_SHARE = 0.05
# Points per cell and axis that a turned map is sampled at.
TURN_POINTS = 3
# The signs of the three details on a square's quarters, by row and column: left minus right, upper minus lower, both.
_SIGNS = np.array([[[1, -1], [1, -1]], [[1, 1], [-1, -1]], [[1, -1], [-1, 1]]])


def map_directions(size: int) -> np.ndarray:
    """The middles of a map's cells, unit vectors, float64 [size, size, 3].

    Row s lies at the height 1 - 2 (s + 1/2)/size, column t at the azimuth 2 pi (t + 1/2)/size from +x towards +y.
    """
    return _directions_at(np.arange(size) + 0.5, np.arange(size) + 0.5, size)


def _directions_at(rows: np.ndarray, columns: np.ndarray, size: int) -> np.ndarray:
    height = 1 - 2 * rows / size
    azimuth = 2 * math.pi * columns / size
    level = np.sqrt(1 - height**2)[:, None]
    parts = np.broadcast_arrays(level * np.cos(azimuth), level * np.sin(azimuth), height[:, None])
    return np.stack(parts, axis=-1)


def transform(maps: np.ndarray) -> np.ndarray:
    """Maps [..., n, n] -> vectors [..., n, n] of the same type; the sum of squares is the integral of the square."""
    maps = np.asarray(maps)
    size = maps.shape[-1]
    vectors = np.empty_like(maps)
    means = maps * maps.dtype.type(math.sqrt(4 * math.pi) / size)
    while size > 1:
        half = size // 2
        upper = means[..., 0::2, 0::2] + means[..., 0::2, 1::2], means[..., 0::2, 0::2] - means[..., 0::2, 1::2]
        lower = means[..., 1::2, 0::2] + means[..., 1::2, 1::2], means[..., 1::2, 0::2] - means[..., 1::2, 1::2]
        vectors[..., :half, half:size] = 0.5 * (upper[1] + lower[1])
        vectors[..., half:size, :half] = 0.5 * (upper[0] - lower[0])
        vectors[..., half:size, half:size] = 0.5 * (upper[1] - lower[1])
        means = 0.5 * (upper[0] + lower[0])
        size = half
    vectors[..., :1, :1] = means
    return vectors


def inverse(vectors: np.ndarray) -> np.ndarray:
    """Vectors [..., n, n] -> maps [..., n, n]."""
    vectors = np.asarray(vectors)
    means = vectors[..., :1, :1]
    for details in _details(vectors):
        means = _split(means, details)
    return means * vectors.dtype.type(vectors.shape[-1] / math.sqrt(4 * math.pi))


def keep_largest(vectors: np.ndarray, share: float = KEPT_SHARE) -> np.ndarray:
    """Vectors [..., n, n] with all but the largest `share` of their coefficients set to zero.

    No other vector with as many coefficients is nearer. Of coefficients of one size the first ones stay.
    """
    flat = vectors.reshape(*vectors.shape[:-2], -1)
    count = max(round(share * flat.shape[-1]), 1)
    order = np.argsort(-np.abs(flat), axis=-1, kind="stable")[..., :count]
    kept = np.zeros_like(flat)
    np.put_along_axis(kept, order, np.take_along_axis(flat, order, axis=-1), axis=-1)
    return kept.reshape(vectors.shape)


def double_product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The integrals of the products of two functions each, from their vectors [..., n, n]."""
    return np.einsum("...ij,...ij->...", a, b)


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The vectors [..., n, n] of products of two functions; with a third one `double_product` is the triple product.

    Three Haar wavelets have a product that is not zero where all three details of one square meet, where two are the
    same and the third is coarser on the same place, or the scaling function (Ng, Ramamoorthi, Hanrahan 2004). Gathered
    by squares of area A: a detail of the product is what the functions' means over the square make of each other's
    details, the other two details' products, and how much the squares within its quarters agree, over sqrt(A). So one
    pass up the tree sums agreement, and one pass down has the means.
    """
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    details_a, details_b = _details(a), _details(b)
    # Agreement: the sum over a square and all within it of the products of details.
    agreement = []
    within = np.zeros(np.broadcast_shapes(a.shape, b.shape))
    for one, other in zip(reversed(details_a), reversed(details_b), strict=True):
        agreement.append(within)
        squares = np.einsum("...krc,...krc->...rc", one, other)
        within = squares + sum(within[..., i::2, j::2] for i in (0, 1) for j in (0, 1))
    agreement.reverse()
    result = np.empty(np.broadcast_shapes(a.shape, b.shape))
    means_a, means_b = a[..., :1, :1], b[..., :1, :1]
    result[..., :1, :1] = (means_a * means_b + within) / math.sqrt(4 * math.pi)
    for one, other, below in zip(details_a, details_b, agreement, strict=True):
        count = one.shape[-1]
        found = means_a[..., None, :, :] * other + means_b[..., None, :, :] * one
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            found[..., k, :, :] += one[..., i, :, :] * other[..., j, :, :] + one[..., j, :, :] * other[..., i, :, :]
            found[..., k, :, :] += sum(
                _SIGNS[k, row, column] * below[..., row::2, column::2] for row in (0, 1) for column in (0, 1)
            )
        found *= count / math.sqrt(4 * math.pi)
        result[..., :count, count : 2 * count] = found[..., 0, :, :]
        result[..., count : 2 * count, :count] = found[..., 1, :, :]
        result[..., count : 2 * count, count : 2 * count] = found[..., 2, :, :]
        means_a, means_b = _split(means_a, one), _split(means_b, other)
    return result


def rotate(vectors: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """The vectors [..., n, n] of turned functions: what they had in a direction d they have in `rotation` @ d.

    A turned wavelet has many coefficients: the map is turned, at TURN_POINTS^2 points of every cell, and transformed.
    """
    maps = inverse(vectors)
    size = maps.shape[-1]
    places = (np.arange(TURN_POINTS * size) + 0.5) / TURN_POINTS
    # rotation^T d, for directions as rows.
    before = _directions_at(places, places, size) @ np.asarray(rotation, np.float64)
    rows = np.clip((0.5 * (1 - before[..., 2]) * size).astype(int), 0, size - 1)
    turns = np.arctan2(before[..., 1], before[..., 0]) / (2 * math.pi) % 1.0
    columns = np.minimum((turns * size).astype(int), size - 1)
    sampled = maps[..., rows, columns]
    cells = sampled.reshape(*maps.shape[:-2], size, TURN_POINTS, size, TURN_POINTS).mean(axis=(-3, -1))
    return transform(cells.astype(maps.dtype))


def _details(vectors: np.ndarray) -> list[np.ndarray]:
    """The three details of 1, 2 x 2, 4 x 4, ... squares: [..., 3, k, k] each."""
    found, count = [], 1
    while count < vectors.shape[-1]:
        ahead = slice(count, 2 * count)
        quarters = vectors[..., :count, ahead], vectors[..., ahead, :count], vectors[..., ahead, ahead]
        found.append(np.stack(quarters, axis=-3))
        count *= 2
    return found


def _split(means: np.ndarray, details: np.ndarray) -> np.ndarray:
    """The scaling coefficients of the quarters of squares, [..., 2k, 2k]."""
    size = 2 * means.shape[-1]
    finer = np.empty((*details.shape[:-3], size, size), details.dtype)
    for row in (0, 1):
        for column in (0, 1):
            signed = sum(_SIGNS[k, row, column].astype(details.dtype) * details[..., k, :, :] for k in range(3))
            finer[..., row::2, column::2] = 0.5 * (means + signed)
    return finer
