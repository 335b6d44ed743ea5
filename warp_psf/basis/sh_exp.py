"""Exponentials and logarithms of SH vectors (Ren et al. 2006), for visibilities that are added instead of multiplied.

`*` is the product truncated to the vectors' order; exp_*(f) = 1 + f + f*f/2! + ... and log_* is its inverse. A sum of
logarithms has no order, so that occluders need none either, and is exponentiated once however many there are.

Two steps make the series short (section 4 there): DC isolation, exp_*(f) = exp(f_0 / sqrt(4 pi)) exp_*(f^) with f^ the
vector without its first coefficient; and scaling and squaring, exp_*(f^) = exp_*(f^ / 2^p)^(2^p), a power that takes p
squares.

The host functions are NumPy in float64, for vectors [..., n*n] of any order; `make_sh_exp` has their Warp twins.
"""

import math
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from warp_psf.basis import sh, sphere
from warp_psf.basis.directions import basis_at_directions, make_directions, quadrature_weights
from warp_psf.device import upload_tables

# What logarithms take the place of zero and of negative values with: Ren 2006, section 4.2.
LOG_THRESHOLD = 0.02
# The series is scaled until the first term that it leaves out, |f^|^(degree + 1) / (degree + 1)!, is below this.
SERIES_REMAINDER = 0.02
# Degree of the series that `exponential` forms at the directions of a quadrature.
SAMPLED_DEGREE = 4
# HYB is scaled until |f^| is below this. A circular blocker stands for all in the linear approximation, which leaves
# out the part of f^*f^ that lies across 1 and f^: at this norm its share of the error is below that of the logarithm.
LINEAR_NORM = 0.25
# Angles at which circular blockers are tabulated, and norms at which their linear approximations are.
TABLE_SIZE = 256
# Norms of the largest blocker's logarithm, in units of its own, up to which the linear approximation is tabulated: what
# lies beyond is as dark as it gets.
LARGEST_MULTIPLE = 4.0


def one(order: int) -> np.ndarray:
    """The vector [n*n] of the function 1."""
    vector = np.zeros(sh.coefficient_count(order))
    vector[0] = math.sqrt(4 * math.pi)
    return vector


# Logarithms


def logarithm(g: np.ndarray, threshold: float = LOG_THRESHOLD) -> np.ndarray:
    """log_*(g) by inversion: R^T log(max(D, threshold)) R 1, with R^T D R the matrix that multiplies by g.

    Source: Ren 2006, Eq. 30.
    """
    matrix = sh.product_matrix(g)
    return _log_of_matrix(matrix, one(sh.order_of(matrix.shape[-1])), threshold)


def logarithm_by_integration(g: np.ndarray, threshold: float = LOG_THRESHOLD) -> np.ndarray:
    """The projection of log(max(g(s), threshold)) (Ren 2006, Eq. 25): blurs more than `logarithm`."""
    g = np.asarray(g)
    order = sh.order_of(g.shape[-1])
    # The logarithm is not band-limited; eight times the product's degree integrates its kinks to 1e-3.
    directions, weights = sphere.gauss_quadrature(24 * order)
    values = np.maximum(g @ sh.evaluate(directions, order).T, threshold)
    return sh.project(np.log(values), directions, weights, order)


def cap_logarithm(half_angle: np.ndarray, order: int, threshold: float = LOG_THRESHOLD) -> np.ndarray:
    """Profiles [..., n] of log_*(1 - cap): what a sphere that spans `half_angle` [...] radians leaves (Ren 2006, 5.1).

    The product of zonal functions is zonal, so that the matrix is that of the n zonal functions.
    """
    visible = -sh.cap(half_angle, order)
    visible[..., 0] += math.sqrt(4 * math.pi)
    band = np.arange(order)
    zonal = band * (band + 1)
    tensor = sh.tripling_tensor(order)[np.ix_(zonal, zonal, zonal)]
    return _log_of_matrix(np.tensordot(visible, tensor, axes=1), one(order)[zonal], threshold)


def _log_of_matrix(matrix: np.ndarray, unit: np.ndarray, threshold: float) -> np.ndarray:
    values, vectors = np.linalg.eigh(matrix)
    logarithms = np.log(np.maximum(values, threshold)) * np.einsum("...ij,i->...j", vectors, unit)
    return np.einsum("...ij,...j->...i", vectors, logarithms)


# Exponentials


def power_series(f: np.ndarray, degree: int) -> np.ndarray:
    """PS-p: the series of exp_* up to `degree`, one product for each degree but the first."""
    unit = one(sh.order_of(np.shape(f)[-1]))
    total = unit + np.asarray(f) / degree
    for k in range(degree - 1, 0, -1):
        total = unit + sh.triple_product(f, total) / k
    return total


def scaled_power_series(f: np.ndarray, degree: int) -> np.ndarray:
    """PS*-p: PS-p with DC isolation, scaling and squaring."""
    constant, rest = isolate(f)
    squarings = count_squarings(rest, series_norm(degree))
    series = power_series(rest / 2.0 ** squarings[..., None], degree)
    return constant[..., None] * raise_to_power(series, squarings)


def optimal_linear(f: np.ndarray) -> np.ndarray:
    """OL: a(|f|) 1 + b(|f|) f, with a and b those of circular blockers."""
    f = np.asarray(f)
    order = sh.order_of(f.shape[-1])
    return _linear(f, linear_table(order), linear_norm(order))


def hybrid(f: np.ndarray) -> np.ndarray:
    """HYB: a(|f^|) 1 + b(|f^|) f^ with DC isolation, scaling and squaring."""
    constant, rest = isolate(f)
    squarings = count_squarings(rest, LINEAR_NORM)
    scaled = rest / 2.0 ** squarings[..., None]
    linear = _linear(scaled, isolated_linear_table(sh.order_of(rest.shape[-1])), LINEAR_NORM)
    return constant[..., None] * raise_to_power(linear, squarings)


def exponential(f: np.ndarray) -> np.ndarray:
    """exp_*(f) as the renderer takes it: PS*-4 whose products are formed at directions and truncated at once.

    One truncation in place of three: as near to the sorted triple product as PS*-9, for one transform there and back.
    """
    constant, rest = isolate(f)
    order = sh.order_of(rest.shape[-1])
    squarings = count_squarings(rest, series_norm(SAMPLED_DEGREE))
    directions, weights = sphere.quadrature(sphere.QUADRATURE_POINTS[order])
    values = rest / 2.0 ** squarings[..., None] @ sh.evaluate(directions, order).T
    series = np.ones_like(values)
    for k in range(SAMPLED_DEGREE, 0, -1):
        series = 1 + values * series / k
    return constant[..., None] * raise_to_power(sh.project(series, directions, weights, order), squarings)


def isolate(f: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """DC isolation: exp(f_0 / sqrt(4 pi)) [...], and f without its first coefficient [..., n*n]."""
    rest = np.array(f, dtype=np.float64)
    constant = np.exp(rest[..., 0] / math.sqrt(4 * math.pi))
    rest[..., 0] = 0.0
    return constant, rest


def series_norm(degree: int) -> float:
    """The norm up to which a series of `degree` needs no scaling."""
    return (math.factorial(degree + 1) * SERIES_REMAINDER) ** (1 / (degree + 1))


def count_squarings(rest: np.ndarray, largest: float) -> np.ndarray:
    """p, int [...], by which |f^| / 2^p is at most `largest`."""
    norm = np.linalg.norm(rest, axis=-1)
    return np.ceil(np.log2(np.maximum(norm / largest, 1.0))).astype(int)


def raise_to_power(g: np.ndarray, squarings: np.ndarray) -> np.ndarray:
    """g^(2^p), by p = `squarings` [...] squares."""
    g = np.array(g)
    for done in range(int(np.max(squarings, initial=0))):
        going_on = squarings > done
        g[going_on] = sh.triple_product(g[going_on], g[going_on])
    return g


# Tables


@cache
def cap_table(order: int) -> np.ndarray:
    """log_*(1 - cap) over 1 - cos(half-angle), in even steps from 0 to 1: float64 [TABLE_SIZE + 1, n].

    A row holds what each band of the basis functions at the cap's axis is multiplied with. In this variable the
    logarithm of a small blocker is linear, as its solid angle is.
    """
    half_angle = np.arccos(1 - np.linspace(0, 1, TABLE_SIZE + 1))
    return _frozen(cap_logarithm(half_angle, order) * np.sqrt(4 * np.pi / (2 * np.arange(order) + 1)))


@cache
def linear_norm(order: int) -> float:
    """The norm up to which `linear_table` goes."""
    return LARGEST_MULTIPLE * float(np.linalg.norm(_circles(order)[-1]))


@cache
def linear_table(order: int) -> np.ndarray:
    """a and b of OL over |f|, in even steps from 0 to `linear_norm`: float64 [TABLE_SIZE + 1, 2].

    Of circular blockers of every angle up to a right one, and beyond of multiples of the largest one's logarithm.
    """
    circles = _circles(order)
    multiples = np.linspace(1, LARGEST_MULTIPLE, TABLE_SIZE)[1:]
    return _fit_linear(np.concatenate([circles, multiples[:, None] * circles[-1]]), linear_norm(order))


@cache
def isolated_linear_table(order: int) -> np.ndarray:
    """a and b of HYB over |f^|, in even steps from 0 to `LINEAR_NORM`: float64 [TABLE_SIZE + 1, 2]."""
    return _fit_linear(isolate(_circles(order))[1], LINEAR_NORM)


def _circles(order: int) -> np.ndarray:
    """Logarithms [TABLE_SIZE, n*n] of circular blockers about +z, of half-angles up to a right one."""
    # More of the small ones, whose norms hardly differ.
    angle = 0.5 * math.pi * np.linspace(0, 1, TABLE_SIZE + 1)[1:] ** 2
    return sh.zonal(cap_logarithm(angle, order), np.broadcast_to((0.0, 0.0, 1.0), (len(angle), 3)))


def _fit_linear(f: np.ndarray, largest: float) -> np.ndarray:
    """a and b with a 1 + b f nearest to exp_*(f), over the norms of the f that are longer than all before."""
    norm = np.linalg.norm(f, axis=1)
    longer = norm > np.maximum.accumulate(np.concatenate([[0.0], norm[:-1]]))
    f, norm = f[longer], norm[longer]
    unit, exact = one(sh.order_of(f.shape[-1])), exponential(f)
    sides = np.stack([np.broadcast_to(unit, f.shape), f], axis=-1)
    fits = np.array([np.linalg.lstsq(side, target, rcond=None)[0] for side, target in zip(sides, exact, strict=True)])
    steps = np.linspace(0, largest, TABLE_SIZE + 1)
    # exp_*(0) = 1, with the slope 1.
    known, fits = np.concatenate([[0.0], norm]), np.concatenate([[[1.0, 1.0]], fits])
    return _frozen(np.stack([np.interp(steps, known, fits[:, k]) for k in range(2)], axis=-1))


def _linear(f: np.ndarray, table: np.ndarray, largest: float) -> np.ndarray:
    steps = np.linspace(0, largest, TABLE_SIZE + 1)
    norm = np.linalg.norm(f, axis=-1)
    a, b = (np.interp(norm, steps, table[:, k])[..., None] for k in range(2))
    return a * one(sh.order_of(f.shape[-1])) + b * f


def _frozen(array: np.ndarray) -> np.ndarray:
    # Cached arrays are shared between callers: nobody may write to them.
    array.setflags(write=False)
    return array


# The Warp side


@cache
def make_sh_exp(order: int) -> SimpleNamespace:
    """Device functions for `order` bands, each of which takes the `ExpTable` that `upload_exponential` fills.

    exponential(f, table), power_series(f, degree, table), scaled_power_series(f, degree, series_norm(degree), table),
    optimal_linear(f, table), hybrid(f, table): the twins of the host's; exponential_at_directions(f, table): the values
    of the first; product(f, g, table): the truncated product;
    cap_logarithm(axis, sine, table): log_*(1 - cap) about a unit axis, by the sine of the half-angle, from a table.
    """
    kit = make_directions(order)
    functions = sh.make_sh(order)
    vec, values, half_values = kit.vec, kit.values, kit.half_values
    unit = vec(*one(order))
    per_band = wp.types.vector(order, wp.float32)
    at_directions, project = kit.at_directions, kit.project
    steps = float(TABLE_SIZE)
    norm_of_linear = linear_norm(order)

    @wp.struct
    class ExpTable:
        rows: wp.array(dtype=half_values)  # (coefficient): the basis functions at the first half of the directions
        weights: wp.array(dtype=values)  # (1): of the quadrature
        caps: wp.array(dtype=per_band)  # (step): see `cap_table`
        linear: wp.array(dtype=wp.vec2)  # (step): see `linear_table`
        isolated_linear: wp.array(dtype=wp.vec2)  # (step): see `isolated_linear_table`

    @wp.func_native(_series_snippet(kit.points))
    def series_at_directions(at: values) -> values: ...

    @wp.func
    def product(f: vec, g: vec, table: wp.array(dtype=ExpTable)) -> vec:
        at = wp.cw_mul(at_directions(f, table[0].rows), at_directions(g, table[0].rows))
        return project(wp.cw_mul(at, table[0].weights[0]), table[0].rows)

    @wp.func
    def raise_to_power(g: vec, squarings: int, table: wp.array(dtype=ExpTable)) -> vec:
        power = vec(g)
        for _done in range(squarings):
            at = at_directions(power, table[0].rows)
            power = project(wp.cw_mul(wp.cw_mul(at, at), table[0].weights[0]), table[0].rows)
        return power

    @wp.func
    def constant_of(f: vec) -> float:
        return wp.exp(f[0] * wp.static(1.0 / math.sqrt(4.0 * math.pi)))

    @wp.func
    def rest_of(f: vec) -> vec:
        rest = vec(f)
        rest[0] = 0.0
        return rest

    @wp.func
    def squarings_of(norm: float, largest: float) -> int:
        return int(wp.ceil(wp.log2(wp.max(norm / largest, 1.0))))

    @wp.func
    def exponential(f: vec, table: wp.array(dtype=ExpTable)) -> vec:
        rest = rest_of(f)
        squarings = squarings_of(wp.length(rest), wp.static(series_norm(SAMPLED_DEGREE)))
        at = at_directions(rest * wp.pow(0.5, float(squarings)), table[0].rows)
        series = project(wp.cw_mul(series_at_directions(at), table[0].weights[0]), table[0].rows)
        return constant_of(f) * raise_to_power(series, squarings, table)

    @wp.func
    def exponential_at_directions(f: vec, table: wp.array(dtype=ExpTable)) -> values:
        return at_directions(exponential(f, table), table[0].rows)

    @wp.func
    def power_series(f: vec, degree: int, table: wp.array(dtype=ExpTable)) -> vec:
        total = wp.static(unit) + f / float(degree)
        for step in range(1, degree):
            total = wp.static(unit) + product(f, total, table) / float(degree - step)
        return total

    @wp.func
    def scaled_power_series(f: vec, degree: int, largest: float, table: wp.array(dtype=ExpTable)) -> vec:
        """largest: `series_norm(degree)`."""
        rest = rest_of(f)
        squarings = squarings_of(wp.length(rest), largest)
        series = power_series(rest * wp.pow(0.5, float(squarings)), degree, table)
        return constant_of(f) * raise_to_power(series, squarings, table)

    @wp.func
    def linear_of(f: vec, norm: float, largest: float, steps_of: wp.array(dtype=wp.vec2)) -> vec:
        place = wp.clamp(norm * (wp.static(steps) / largest), 0.0, wp.static(steps - 1.0e-3))
        below = int(place)
        share = place - float(below)
        fit = (1.0 - share) * steps_of[below] + share * steps_of[below + 1]
        return fit[0] * wp.static(unit) + fit[1] * f

    @wp.func
    def optimal_linear(f: vec, table: wp.array(dtype=ExpTable)) -> vec:
        return linear_of(f, wp.length(f), wp.static(norm_of_linear), table[0].linear)

    @wp.func
    def hybrid(f: vec, table: wp.array(dtype=ExpTable)) -> vec:
        rest = rest_of(f)
        norm = wp.length(rest)
        squarings = squarings_of(norm, wp.static(LINEAR_NORM))
        scale = wp.pow(0.5, float(squarings))
        linear = linear_of(scale * rest, scale * norm, wp.static(LINEAR_NORM), table[0].isolated_linear)
        return constant_of(f) * raise_to_power(linear, squarings, table)

    @wp.func
    def cap_logarithm(axis: wp.vec3, sine: float, table: wp.array(dtype=ExpTable)) -> vec:
        squared = wp.min(sine * sine, 1.0)
        # 1 - cos without the difference, which would lose the digits of small caps.
        place = wp.static(steps) * squared / (1.0 + wp.sqrt(1.0 - squared))
        below = wp.min(int(place), wp.static(TABLE_SIZE - 1))
        share = place - float(below)
        return functions.zonal((1.0 - share) * table[0].caps[below] + share * table[0].caps[below + 1], axis)

    return SimpleNamespace(
        vec=vec,
        ExpTable=ExpTable,
        product=product,
        exponential=exponential,
        exponential_at_directions=exponential_at_directions,
        power_series=power_series,
        scaled_power_series=scaled_power_series,
        optimal_linear=optimal_linear,
        hybrid=hybrid,
        cap_logarithm=cap_logarithm,
    )


def upload_exponential(order: int, device: wp.Device) -> wp.array:
    """The `ExpTable` of an order, as an array of one."""
    kit, directions = make_sh_exp(order), make_directions(order)
    table = kit.ExpTable()

    def upload(array: np.ndarray, dtype: Any) -> wp.array:
        return wp.array(array.astype(np.float32), dtype=dtype, device=device)

    half = directions.points // 2
    table.rows = upload(basis_at_directions(order)[:half].T, directions.half_values)
    table.weights = upload(quadrature_weights(order)[None], directions.values)
    table.caps = upload(cap_table(order), wp.types.vector(order, wp.float32))
    table.linear = upload(linear_table(order), wp.vec2)
    table.isolated_linear = upload(isolated_linear_table(order), wp.vec2)
    return upload_tables([table], kit.ExpTable, device)


def _series_snippet(points: int) -> str:
    """C++: the series of the exponential at every direction."""
    series = "1.0f"
    for k in range(SAMPLED_DEGREE, 0, -1):
        series = f"(1.0f + {1 / k:.9e}f * at[i] * {series})"
    return f"""
    wp::vec_t<{points}, float> result;
    for (int i = 0; i < {points}; ++i) result[i] = {series};
    return result;
    """
