"""Real spherical harmonics: evaluate, project, rotate, multiply.

The basis is orthonormal over the sphere, without the Condon-Shortley phase: y_00 = sqrt(1 / 4 pi), and y_1 is
sqrt(3 / 4 pi) (y, z, x). The function y_lm has the index l*l + l + m. "Order n" is the number of bands, l = 0..n-1:
n*n coefficients, which are always the last axis of an array.

The host functions are NumPy in float64 and work for every order; `make_sh` gives the Warp functions of an order.
"""

from dataclasses import dataclass
from functools import cache
from math import isqrt
from typing import Any

import numpy as np
import warp as wp

from warp_psf.basis import sphere

# Constants that vanish by symmetry come out below 1e-13; those that do not are above 1e-3 (orders up to 6).
ROUNDING = 1e-10


def coefficient_count(order: int) -> int:
    """The number of coefficients of `order` bands."""
    return order * order


def order_of(count: int) -> int:
    """The order whose vectors have `count` coefficients.

    Raises:
        ValueError: `count` is not the square of a positive integer.
    """
    order = isqrt(max(count, 0))
    if order < 1 or order * order != count:
        raise ValueError(f"{count} is not a number of SH coefficients; an order n has n*n of them: 4, 9, 16, 25, ...")
    return order


def bands(order: int) -> np.ndarray:
    """The band l of every coefficient, int [n*n]."""
    return np.repeat(np.arange(order), 2 * np.arange(order) + 1)


def evaluate(directions: np.ndarray, order: int) -> np.ndarray:
    """The basis functions [..., n*n] at unit `directions` [..., 3].

    y_lm is a polynomial in z times the real (m >= 0) or imaginary (m < 0) part of (x + iy)^|m|; the polynomials,
    normalised, follow the three-term recurrence of the associated Legendre functions.
    """
    directions = np.asarray(directions, dtype=np.float64)
    x, y, z = np.moveaxis(directions, -1, 0)
    values = np.empty((*directions.shape[:-1], coefficient_count(order)))
    azimuth = np.ones_like(x, dtype=np.complex128)
    diagonal = np.sqrt(0.25 / np.pi)
    for m in range(order):
        before, now = np.zeros_like(z), np.full_like(z, diagonal)
        for band in range(m, order):
            centre = band * band + band
            values[..., centre - m] = now * azimuth.imag
            values[..., centre + m] = now * azimuth.real
            before, now = now, _next_band(band, m, z, before, now)
        azimuth = azimuth * (x + 1j * y)
        # Both functions of a pair +m, -m share the norm of e^(i m phi): sqrt(2), which enters once, at m = 1.
        diagonal *= np.sqrt((2 * m + 3) / (2 * m + 2)) * (np.sqrt(2.0) if m == 0 else 1.0)
    return values


def _next_band(band: int, m: int, z: np.ndarray, before: np.ndarray, now: np.ndarray) -> np.ndarray:
    """The normalised polynomial of band + 1, from those of band - 1 and band."""
    up = band + 1
    scale = np.sqrt((4 * up * up - 1) / (up * up - m * m))
    return scale * (z * now - np.sqrt((band * band - m * m) / (4 * band * band - 1)) * before)


def project(values: np.ndarray, directions: np.ndarray, weights: np.ndarray, order: int) -> np.ndarray:
    """Coefficients [..., n*n] of a function whose `values` [..., Q] are known at quadrature `directions` [Q, 3].

    The `weights` [Q] are solid angles in steradians.
    """
    return np.asarray(values) @ (np.asarray(weights)[:, None] * evaluate(directions, order))


def rotation_matrix(rotation: np.ndarray, order: int) -> np.ndarray:
    """The matrices M [..., n*n, n*n], block-diagonal and orthogonal, that turn coefficients as `rotation` [..., 3, 3]
    turns vectors.

    With rotation = world_from_body: f_world(d) = f_body(rotation^T d), coefficients_world = M @ coefficients_body
    (for rows of coefficients: coefficients_body @ M^T), y(rotation d) = M @ y(d), and M(A B) = M(A) M(B).
    M_ij is the integral of y_i(rotation d) y_j(d), which quadrature gives to rounding.
    """
    rotation = np.asarray(rotation, dtype=np.float64)
    directions, weights = sphere.gauss_quadrature(2 * (order - 1))
    turned = evaluate(directions @ np.swapaxes(rotation, -1, -2), order)
    matrix = np.swapaxes(turned, -1, -2) @ (weights[:, None] * evaluate(directions, order))
    band = bands(order)
    return np.where(band[:, None] == band, matrix, 0.0)


def rotate(coefficients: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """The coefficients [..., n*n] of the function turned by `rotation` [..., 3, 3]: f(rotation^T d)."""
    coefficients = np.asarray(coefficients)
    matrix = rotation_matrix(rotation, order_of(coefficients.shape[-1]))
    return np.einsum("...ij,...j->...i", matrix, coefficients)


def rotation_rows(rotation: np.ndarray, order: int) -> np.ndarray:
    """What the Warp `rotate` takes: float32 [..., n*n, n*n], M^T of `rotation_matrix`; row k is the turned y_k."""
    return np.ascontiguousarray(np.swapaxes(rotation_matrix(rotation, order), -1, -2), dtype=np.float32)


def double_product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The integral [...] over the sphere of the product of two functions [..., n*n]."""
    return np.einsum("...i,...i->...", a, b)


@cache
def tripling_tensor(order: int) -> np.ndarray:
    """The integrals [n*n, n*n, n*n] of y_i y_j y_k; read-only."""
    directions, weights = sphere.gauss_quadrature(3 * (order - 1))
    values = evaluate(directions, order)
    tensor = np.einsum("q,qi,qj,qk->ijk", weights, values, values, values, optimize=True)
    tensor[np.abs(tensor) < ROUNDING] = 0.0
    tensor.setflags(write=False)
    return tensor


def tripling_coefficients(order: int) -> tuple[np.ndarray, np.ndarray]:
    """The non-zero integrals of y_i y_j y_k with i <= j <= k: indices int [T, 3] and values [T]."""
    tensor = tripling_tensor(order)
    indices = np.argwhere(tensor)
    indices = indices[(indices[:, 0] <= indices[:, 1]) & (indices[:, 1] <= indices[:, 2])]
    return indices, tensor[tuple(indices.T)]


def triple_product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The coefficients [..., n*n] of the product of two functions [..., n*n], truncated to their order."""
    return np.einsum("...ij,...j->...i", product_matrix(a), np.asarray(b))


def product_matrix(a: np.ndarray) -> np.ndarray:
    """The symmetric matrices [..., n*n, n*n] that multiply by the functions `a` [..., n*n]."""
    a = np.asarray(a)
    return np.tensordot(a, tripling_tensor(order_of(a.shape[-1])), axes=1)


# Zonal functions: f_l is the coefficient of y_l0 of the function about +z. About an axis d it is
# f_lm = sqrt(4 pi / (2l + 1)) f_l y_lm(d).


def zonal(profile: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Coefficients [..., n*n] of the zonal functions of `profile` [..., n] about unit `directions` [..., 3]."""
    profile = np.asarray(profile)
    order = profile.shape[-1]
    band = bands(order)
    return (np.sqrt(4.0 * np.pi / (2 * np.arange(order) + 1)) * profile)[..., band] * evaluate(directions, order)


def clamped_cosine(order: int) -> np.ndarray:
    """The profile [n] of max(cos, 0)."""
    return _cosine_power(1.0, order)


def phong_lobe(exponent: float, order: int) -> np.ndarray:
    """The profile [n] of the normalised lobe (exponent + 2) / (2 pi) max(cos, 0)^exponent, for an exponent >= 0."""
    return (exponent + 2.0) / (2.0 * np.pi) * _cosine_power(exponent, order)


def _cosine_power(exponent: float, order: int) -> np.ndarray:
    """The profile of max(cos, 0)^exponent, by the recurrence of I_l, the integral of z^exponent P_l(z) over 0..1.

    I_0 = 1 / (e + 1), I_1 = 1 / (e + 2), I_l = (e - l + 2) / (e + l + 1) I_(l-2): nothing cancels.
    """
    integrals = np.empty(max(order, 2))
    integrals[:2] = 1.0 / (exponent + 1.0), 1.0 / (exponent + 2.0)
    for band in range(2, order):
        integrals[band] = (exponent - band + 2.0) / (exponent + band + 1.0) * integrals[band - 2]
    return _profile(integrals[:order])


def cap(half_angle: np.ndarray | float, order: int) -> np.ndarray:
    """The profiles [..., n] of spherical caps: 1 within `half_angle` [...] radians of the axis, 0 outside.

    The integral of P_l(z) over cos(half_angle)..1 is sin(half_angle)^2 P_l'(cos(half_angle)) / (l (l + 1)), which
    keeps its digits for small caps.
    """
    half_angle = np.asarray(half_angle, dtype=np.float64)
    z, sine_squared = np.cos(half_angle), np.sin(half_angle) ** 2
    integrals = np.empty((*half_angle.shape, order))
    integrals[..., 0] = 2.0 * np.sin(0.5 * half_angle) ** 2
    legendre, before, slope, slope_before = z, np.ones_like(z), np.ones_like(z), np.zeros_like(z)
    for band in range(1, order):
        integrals[..., band] = sine_squared * slope / (band * (band + 1))
        slope, slope_before = slope_before + (2 * band + 1) * legendre, slope
        legendre, before = ((2 * band + 1) * z * legendre - band * before) / (band + 1), legendre
    return _profile(integrals)


def _profile(integrals: np.ndarray) -> np.ndarray:
    """f_l, from the integrals [..., n] of f P_l over z."""
    return np.sqrt(np.pi * (2 * np.arange(integrals.shape[-1]) + 1)) * integrals


# What Warp runs is generated as C++ text, one expression per coefficient. Written as loops over tables, most terms
# would be products with zero, which a compiler must not drop; in this form it finds the SIMD code by itself.


@dataclass(frozen=True)
class SH:
    """The Warp side of an order: its vector type and device functions.

    vec: the type of a coefficient vector, wp.types.vector(n*n, float32)
    evaluate(direction: wp.vec3) -> vec: the basis functions
    rotate(v: vec, rows: wp.array(dtype=vec)) -> vec: sum of v[k] rows[k], with `rows` from `rotation_rows`
    double_product(a: vec, b: vec) -> float: the integral of the product of two functions
    zonal(bands: vector of n floats, direction: wp.vec3) -> vec: the basis functions, each times the number of its band

    Products of functions are formed at the directions of a quadrature: see `sh_exp.make_sh_exp`.
    """

    order: int
    count: int
    vec: Any
    evaluate: wp.Function
    rotate: wp.Function
    double_product: wp.Function
    zonal: wp.Function


@cache
def make_sh(order: int) -> SH:
    """The Warp vector type and functions of `order` bands; kernels capture them from here.

    Raises:
        ValueError: `order` is less than 1.
    """
    if order < 1:
        raise ValueError(f"SH order {order} has no coefficients; choose an order of at least 1 (number of bands)")
    count = coefficient_count(order)
    vec = wp.types.vector(count, wp.float32)

    @wp.func_native(_evaluate_snippet(order))
    def evaluate(direction: wp.vec3) -> vec: ...

    @wp.func_native(_evaluate_snippet(order, "bands"))
    def zonal(bands: wp.types.vector(order, wp.float32), direction: wp.vec3) -> vec: ...

    @wp.func_native(_rotate_snippet(order))
    def rotate(v: vec, rows: wp.array(dtype=vec)) -> vec: ...

    @wp.func
    def double_product(a: vec, b: vec) -> float:
        return wp.dot(a, b)

    return SH(order, count, vec, evaluate, rotate, double_product, zonal)


def _evaluate_snippet(order: int, bands: str = "") -> str:
    """C++ for the basis functions: a polynomial in z by Horner's rule, times a part of (x + iy)^m.

    bands: the name of a vector whose numbers multiply the functions of each band.
    """
    lines = ["const float x = direction[0], y = direction[1], z = direction[2];"]
    lines += ["const float c0 = 1.0f, s0 = 0.0f;"]
    lines += [f"wp::vec_t<{order * order}, float> values;"]
    for m in range(order):
        if m:
            lines += [f"const float c{m} = c{m - 1} * x - s{m - 1} * y, s{m} = c{m - 1} * y + s{m - 1} * x;"]
        for band, polynomial in enumerate(_height_polynomials(m, order), start=m):
            centre = band * band + band
            height = _literal(polynomial[-1])
            for coefficient in polynomial[-2::-1]:
                height = f"({height} * z + {_literal(coefficient)})"
            lines += [f"const float h{centre + m} = {height}{f' * {bands}[{band}]' if bands else ''};"]
            lines += [f"values[{centre - m}] = h{centre + m} * s{m};"] if m else []
            lines += [f"values[{centre + m}] = h{centre + m} * c{m};"]
    return "\n".join([*lines, "return values;"])


def _height_polynomials(m: int, order: int) -> list[np.ndarray]:
    """For the bands m..n-1: the coefficients, by ascending power of z, of y_lm / Re (x + iy)^m."""
    # Interpolated along the meridian phi = 0, where (x + iy)^m is real.
    z = np.polynomial.legendre.leggauss(order)[0]
    radius = np.sqrt(1.0 - z * z)
    values = evaluate(np.stack([radius, np.zeros_like(z), z], axis=-1), order) / radius[:, None] ** m
    polynomials = np.linalg.solve(np.vander(z, increasing=True), values)
    # Every other coefficient vanishes by parity, up to rounding.
    polynomials[np.abs(polynomials) < ROUNDING] = 0.0
    return [polynomials[: band - m + 1, band * band + band + m] for band in range(m, order)]


def _rotate_snippet(order: int) -> str:
    """C++ for the product of a vector with a rotation's rows, band by band: other entries of the rows are zero."""
    lines = [f"float turned[{order * order}];", f"for (int j = 0; j < {order * order}; ++j) turned[j] = 0.0f;"]
    for band in range(order):
        # The numbers of a band lie side by side, as a compiler wants them.
        first, end = band * band, (band + 1) ** 2
        lines += [
            f"for (int k = {first}; k < {end}; ++k) {{ const float share = v[k]; const auto& row = wp::index(rows, k);"
        ]
        lines += [f"for (int j = {first}; j < {end}; ++j) turned[j] += share * row[j]; }}"]
    lines += [f"wp::vec_t<{order * order}, float> result;"]
    lines += [f"for (int j = 0; j < {order * order}; ++j) result[j] = turned[j];"]
    return "\n".join([*lines, "return result;"])


def _literal(value: float) -> str:
    return f"{value:.9e}f"
