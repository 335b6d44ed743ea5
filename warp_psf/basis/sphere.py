"""Directions on the unit sphere: maps, frames and quadrature.

Everything here is NumPy float64 on the host, except `frame_of`, the Warp twin of `frame`.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import warp as wp

# The rules of `quadrature`: points -> degree. Every spherical harmonic of that degree or less is integrated exactly.
QUADRATURE_DEGREES = {16: 5, 32: 9, 64: 13, 96: 15, 176: 21}
# SH order (bands) -> points of the rule that is exact for the product of three functions of the order, degree
# 3 (order - 1), and at least for one degree more up to order 5.
QUADRATURE_POINTS = {2: 16, 3: 32, 4: 64, 5: 96, 6: 96, 8: 176}


def latlong_directions(rows: int, columns: int) -> np.ndarray:
    """Unit directions [rows, columns, 3] through the centres of a latitude-longitude image's cells.

    Row 0 is next to +z, the last row next to -z; column c lies at azimuth 2 pi (c + 1/2) / columns from +x towards +y.
    """
    theta = np.pi * (np.arange(rows) + 0.5)[:, None] / rows
    phi = 2.0 * np.pi * (np.arange(columns) + 0.5)[None, :] / columns
    return np.stack(
        np.broadcast_arrays(np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)), axis=-1
    )


def latlong_solid_angles(rows: int, columns: int) -> np.ndarray:
    """Solid angles [rows, columns] in steradians of a latitude-longitude image's cells; they sum to 4 pi."""
    edges = np.pi * np.arange(rows + 1) / rows
    # cos(a) - cos(b) as a product: the difference itself would lose digits at the poles.
    bands = 2.0 * np.sin(0.5 * (edges[1:] + edges[:-1])) * np.sin(0.5 * np.diff(edges))
    return np.repeat((2.0 * np.pi / columns * bands)[:, None], columns, axis=1)


def fibonacci_cap(count: int, half_angle: float = np.pi) -> np.ndarray:
    """Unit directions [count, 3] spread evenly in solid angle over the cap of `half_angle` radians around +z.

    The spherical Fibonacci lattice: each direction stands for the same solid angle, 4 pi sin(half_angle / 2)^2 / count.
    """
    index = np.arange(count) + 0.5
    one_minus_z = 2.0 * np.sin(0.5 * half_angle) ** 2 * index / count
    radius = np.sqrt(one_minus_z * (2.0 - one_minus_z))
    phi = np.pi * (3.0 - np.sqrt(5.0)) * index
    return np.stack([radius * np.cos(phi), radius * np.sin(phi), 1.0 - one_minus_z], axis=-1)


def frame(directions: np.ndarray) -> np.ndarray:
    """Rotations [..., 3, 3] whose third columns are the unit `directions` [..., 3].

    Exact at both poles, continuous on each of the half-spaces z >= 0 and z < 0 (no frame is continuous everywhere).

    Source: Duff et al. 2017, Building an Orthonormal Basis, Revisited.
    """
    x, y, z = np.moveaxis(np.asarray(directions, dtype=np.float64), -1, 0)
    sign = np.where(z < 0.0, -1.0, 1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    first = np.stack([1.0 + sign * x * x * a, sign * b, -sign * x], axis=-1)
    second = np.stack([b, sign + y * y * a, -y], axis=-1)
    return np.stack([first, second, np.stack([x, y, z], axis=-1)], axis=-1)


@wp.func
def frame_of(direction: wp.vec3) -> wp.mat33:
    """The rotation whose third column is the unit `direction`: `frame`, in Warp."""
    x, y, z = direction[0], direction[1], direction[2]
    sign = wp.where(z < 0.0, -1.0, 1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    first = wp.vec3(1.0 + sign * x * x * a, sign * b, -sign * x)
    second = wp.vec3(b, sign + y * y * a, -y)
    return wp.matrix_from_cols(first, second, direction)


@cache
def quadrature(points: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions [points, 3] and positive weights [points] (steradians, sum 4 pi); both are read-only.

    The second half of the directions are the antipodes of the first, with the same weights. The rules are the
    solutions that benchmarks/solve_quadrature.py finds for the degrees of `QUADRATURE_DEGREES`, kept in quadrature.txt.

    Raises:
        ValueError: there is no rule of so many points.
    """
    if points not in QUADRATURE_DEGREES:
        sizes = ", ".join(str(size) for size in QUADRATURE_DEGREES)
        raise ValueError(f"no quadrature rule has {points} points; choose one of: {sizes}")
    table = np.loadtxt(Path(__file__).with_name("quadrature.txt"))
    half = table[table[:, 0] == points]
    directions, weights = half[:, 1:4], half[:, 4]
    return _frozen(np.concatenate([directions, -directions])), _frozen(np.concatenate([weights, weights]))


# atan(u)/u over 0..1 as a polynomial in u^2: interpolated at Chebyshev's nodes, it errs by 4e-8.
ARC_TANGENT = [
    float(c)
    for c in np.polynomial.chebyshev.Chebyshev.interpolate(
        lambda squared: np.arctan(np.sqrt(squared)) / np.sqrt(squared), 7, domain=[0.0, 1.0]
    ).convert(kind=np.polynomial.Polynomial)
]


@wp.func
def angle_of(opposite: float, adjacent: float, length: float) -> float:
    """The angle in 0..pi whose sine is opposite/length and cosine adjacent/length, all at least 0 but `adjacent`.

    What atan2(opposite, adjacent) gives to 1e-7, several times faster: the tangent of half the angle lies in 0..1.
    """
    u = opposite / wp.max(length + wp.abs(adjacent), 1.0e-30)
    squared = u * u
    series = float(wp.static(ARC_TANGENT[7]))
    for k in range(7):
        series = series * squared + wp.static(ARC_TANGENT[6 - k])
    angle = 2.0 * u * series
    return wp.where(adjacent < 0.0, wp.static(float(np.pi)) - angle, angle)


@cache
def gauss_quadrature(degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions [Q, 3] and positive weights [Q] (sum 4 pi), exact for spherical harmonics up to any `degree`.

    Gauss-Legendre in z times evenly spaced azimuths: more points than `quadrature` needs, but for every degree.
    """
    heights, height_weights = np.polynomial.legendre.leggauss(degree // 2 + 1)
    phi = 2.0 * np.pi * np.arange(degree + 1) / (degree + 1)
    radius = np.sqrt(1.0 - heights**2)[:, None]
    parts = np.broadcast_arrays(radius * np.cos(phi), radius * np.sin(phi), heights[:, None])
    weights = np.repeat(height_weights * 2.0 * np.pi / (degree + 1), degree + 1)
    return _frozen(np.stack(parts, axis=-1).reshape(-1, 3)), _frozen(weights)


def _frozen(array: np.ndarray) -> np.ndarray:
    # Cached arrays are shared between callers: nobody may write to them.
    array.setflags(write=False)
    return array
