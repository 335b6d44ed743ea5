"""Moments of what a basis radiance field sends: its radiance times products of the direction's coordinates.

A body that sends on light in proportion to x, y or z of the direction needs no fields of its own: its light is that of
the fields times the coordinate. So is what a glossy receiver must know of where light comes from.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from warp_psf.basis import sh
from warp_psf.field.radiance import make_radiance

# The products of coordinates (0: x, 1: y, 2: z) that there are moments of.
FIRST = ((0,), (1,), (2,))
SECOND = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


@cache
def make_moments(order: int, functions: int) -> SimpleNamespace:
    """Device functions like `basis_irradiance` of `make_radiance(order, functions)`, for several functions at once.

    first, second: matrices with a row of weights (one number per basis function) for each of `FIRST` and `SECOND`.
    first_received, second_received: matrices with a row of SH coefficients for each.
    first_moments(table, place, received: first_received) -> first, and second_moments likewise.
    """
    kit = make_radiance(order, functions)
    RadianceTable, Place = kit.RadianceTable, kit.Place
    coefficients = sh.coefficient_count(order)
    first, second = (wp.types.matrix((len(rows), functions), wp.float32) for rows in (FIRST, SECOND))
    first_received, second_received = (
        wp.types.matrix((len(rows), coefficients), wp.float32) for rows in (FIRST, SECOND)
    )

    @wp.func_native(_products_snippet(coefficients, functions, len(FIRST)))
    def first_products(
        codes: wp.array(dtype=wp.uint8),
        minimum: wp.array(dtype=wp.float32),
        step: wp.array(dtype=wp.float32),
        shell: int,
        near: wp.vec4i,
        near_shares: wp.vec4,
        far: wp.vec4i,
        far_shares: wp.vec4,
        received: first_received,
    ) -> first:
        """For each function, the products of its blended vector and the rows of `received`."""

    @wp.func_native(_products_snippet(coefficients, functions, len(SECOND)))
    def second_products(
        codes: wp.array(dtype=wp.uint8),
        minimum: wp.array(dtype=wp.float32),
        step: wp.array(dtype=wp.float32),
        shell: int,
        near: wp.vec4i,
        near_shares: wp.vec4,
        far: wp.vec4i,
        far_shares: wp.vec4,
        received: second_received,
    ) -> second:
        """For each function, the products of its blended vector and the rows of `received`."""

    @wp.func
    def first_moments(table: RadianceTable, at: Place, received: first_received) -> first:
        return first_products(
            table.codes,
            table.minimum,
            table.step,
            at.shell,
            at.near,
            at.near_shares,
            at.far,
            at.far_shares,
            received,
        )

    @wp.func
    def second_moments(table: RadianceTable, at: Place, received: second_received) -> second:
        return second_products(
            table.codes,
            table.minimum,
            table.step,
            at.shell,
            at.near,
            at.near_shares,
            at.far,
            at.far_shares,
            received,
        )

    return SimpleNamespace(
        first=first,
        second=second,
        first_received=first_received,
        second_received=second_received,
        first_moments=first_moments,
        second_moments=second_moments,
    )


def _products_snippet(coefficients: int, functions: int, rows: int) -> str:
    """C++ that reads the eight samples of all functions once and multiplies them by all rows of `received`."""
    stride = functions * coefficients
    pointers = "\n".join(
        f"    const auto* {name}{k} = codes.data + (size_t){name}[{k}] * {stride};"
        for name in ("near", "far")
        for k in range(4)
    )
    sums = {name: " + ".join(f"{name}_shares[{k}] * (float){name}{k}[j]" for k in range(4)) for name in ("near", "far")}
    return f"""
{pointers}
    const float near_total = near_shares[0] + near_shares[1] + near_shares[2] + near_shares[3];
    const float far_total = far_shares[0] + far_shares[1] + far_shares[2] + far_shares[3];
    const float* minimum0 = minimum.data + (size_t)shell * {stride};
    const float* step0 = step.data + (size_t)shell * {stride};
    const float* minimum1 = minimum0 + {stride};
    const float* step1 = step0 + {stride};
    wp::mat_t<{rows}, {functions}, float> totals;
    for (int i = 0; i < {functions}; ++i) {{
        float blended[{coefficients}];
        for (int k = 0; k < {coefficients}; ++k) {{
            const int j = i * {coefficients} + k;
            blended[k] = near_total * minimum0[j] + step0[j] * ({sums["near"]})
                + far_total * minimum1[j] + step1[j] * ({sums["far"]});
        }}
        for (int row = 0; row < {rows}; ++row) {{
            float total = 0.0f;
            for (int k = 0; k < {coefficients}; ++k) total += received.data[row][k] * blended[k];
            totals.data[row][i] = total;
        }}
    }}
    return totals;
    """
