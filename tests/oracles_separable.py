"""The Phong lobe as a matrix over pairs of directions, and the approximations of it that have K separable terms."""

import numpy as np

from warp_psf.basis import sh
from warp_psf.shade.direct import legendre_series
from warp_psf.shade.separable import factor_lobe


def hemisphere(rings: int, angles: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions [Q, 3] of the upper hemisphere, and weights [Q]: solid angles times the cosine."""
    nodes, weights = np.polynomial.legendre.leggauss(rings)
    z = np.repeat(0.5 * (nodes + 1), angles)
    phi = np.tile(2 * np.pi * (np.arange(angles) + 0.5) / angles, rings)
    level = np.sqrt(1 - z * z)
    directions = np.stack([level * np.cos(phi), level * np.sin(phi), z], axis=1)
    return directions, np.repeat(np.pi / angles * weights, angles) * z


def mirrored(directions: np.ndarray) -> np.ndarray:
    """Where a mirror with the normal +z sends what comes from `directions` [Q, 3]."""
    return directions * np.array([-1.0, -1.0, 1.0])


def phong_matrix(exponent: float, directions: np.ndarray) -> np.ndarray:
    """(n + 2)/(2 pi) max(cos, 0)^n of all pairs of directions in and out, [Q, Q]."""
    cosine = np.clip(mirrored(directions) @ directions.T, 0.0, 1.0)
    return (exponent + 2) / (2 * np.pi) * cosine**exponent * (cosine > 0)


def cut_series(exponent: float, directions: np.ndarray, bands: int) -> np.ndarray:
    """The lobe's first bands about the mirror direction, bands^2 terms, [Q, Q]."""
    cosine = mirrored(directions) @ directions.T
    return np.polynomial.legendre.legval(cosine, legendre_series(sh.phong_lobe(exponent, bands)))


def fitted(matrix: np.ndarray, directions: np.ndarray, weights: np.ndarray, bands: int) -> np.ndarray:
    """The least-squares fit by products of the first bands of in and of out, bands^2 terms, [Q, Q]."""
    functions = np.sqrt(weights)[:, None] * sh.evaluate(directions, bands)
    span, _ = np.linalg.qr(functions)
    root = np.sqrt(weights)
    scaled = root[:, None] * matrix * root
    return (span @ (span.T @ scaled @ span) @ span.T) / root[:, None] / root


def four_terms(exponent: float, directions: np.ndarray) -> np.ndarray:
    """What the renderer uses, [Q, Q]."""
    k00, k01, k11, along = factor_lobe(exponent)
    z_in, z_out = directions[:, None, 2], directions[None, :, 2]
    level = directions[:, :2] @ directions[:, :2].T
    return k00 + k01 * (z_in + z_out) + k11 * z_in * z_out - along * level


def best(matrix: np.ndarray, weights: np.ndarray, terms: int) -> np.ndarray:
    """The best approximation with so many terms, functions of in and out free: by singular values, [Q, Q]."""
    root = np.sqrt(weights)
    left, values, right = np.linalg.svd(root[:, None] * matrix * root)
    return (left[:, :terms] * values[:terms]) @ right[:terms] / root[:, None] / root


def relative_error(approximation: np.ndarray, matrix: np.ndarray, weights: np.ndarray) -> float:
    """Root mean square over pairs of directions, weighted with both cosines, relative to that of the lobe."""
    pairs = np.outer(weights, weights)
    return float(np.sqrt((pairs * (approximation - matrix) ** 2).sum() / (pairs * matrix**2).sum()))
