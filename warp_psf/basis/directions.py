"""Functions of direction as their values at the directions of a quadrature, and the inner loops over those.

Every function that shading multiplies (light, transfer, the occluders' visibility) is band-limited, so its values at a
quadrature's directions hold all of it, and a product of functions is a product of numbers. The product of light,
transfer and one occluder is then the SH triple product to rounding; with more occluders nothing is truncated between
one and the next, and their order does not matter.

The second half of the directions are the antipodes of the first. A function is therefore evaluated as its even and its
odd part at the first half, which is half the work.

The loops are C++: written over whole vectors in Python, each operation would be a pass over memory of its own.
"""

import math
from functools import cache
from types import SimpleNamespace

import numpy as np
import warp as wp

from warp_psf.basis import sh, sphere


@cache
def make_directions(order: int) -> SimpleNamespace:
    """Vector types and device functions for `order` bands.

    values: the values at all directions; half_values: at the first half; rgb_values: those of red, of green and of blue
    at all directions; vec: SH coefficients; profile: zonal ones.
    Directions come as `quadrature`, three rows of half_values, x, y and z.
    """
    points = sphere.QUADRATURE_POINTS[order]
    values = wp.types.vector(points, wp.float32)
    half_values = wp.types.vector(points // 2, wp.float32)
    rgb_values = wp.types.vector(3 * points, wp.float32)
    vec = sh.make_sh(order).vec
    # A zonal function may have a band more than the fields, whose vectors are stored.
    profile = wp.types.vector(order + 1, wp.float32)

    @wp.func_native(_sum_of_products_snippet(points))
    def sum_of_products(a: values, b: values) -> float:
        """The dot product."""

    @wp.func_native(_at_directions_snippet(order, points))
    def at_directions(v: vec, rows: wp.array(dtype=half_values)) -> values:
        """An SH vector -> its values, with the rows y_k at the first half of the directions."""

    @wp.func_native(_zonal_snippet(order, points))
    def zonal_at_directions(coefficients: profile, axis: wp.vec3, quadrature: wp.array(dtype=half_values)) -> values:
        """The values of sum_l c_l P_l(cosine to a unit axis)."""

    @wp.func_native(project_snippet(order * order, points))
    def project(weighted: values, rows: wp.array(dtype=half_values)) -> vec:
        """Values times the quadrature's weights -> the SH vector, with the rows y_k at the first half."""

    @wp.func_native(_sum_rgb_snippet(points))
    def sum_rgb(a: values, rgb: rgb_values) -> wp.vec3:
        """The dot products with the values of red, green and blue."""

    return SimpleNamespace(
        order=order,
        points=points,
        vec=vec,
        values=values,
        half_values=half_values,
        rgb_values=rgb_values,
        profile=profile,
        sum_of_products=sum_of_products,
        at_directions=at_directions,
        zonal_at_directions=zonal_at_directions,
        project=project,
        sum_rgb=sum_rgb,
    )


def quadrature_rows(order: int, device: wp.Device) -> wp.array:
    """The first half of the directions, as the rows x, y and z."""
    points = sphere.QUADRATURE_POINTS[order]
    directions = sphere.quadrature(points)[0][: points // 2]
    return wp.array(directions.T.astype(np.float32), dtype=make_directions(order).half_values, device=device)


def quadrature_weights(order: int) -> np.ndarray:
    """The weights of all directions, float64 [points]."""
    return sphere.quadrature(sphere.QUADRATURE_POINTS[order])[1]


def basis_at_directions(order: int) -> np.ndarray:
    """y_k at all directions, float64 [points, order^2]."""
    return sh.evaluate(sphere.quadrature(sphere.QUADRATURE_POINTS[order])[0], order)


def _sum_of_products_snippet(points: int) -> str:
    return f"{sum_in_lanes(points, 'a[i + lane] * b[i + lane]')} return sums[0];"


def sum_in_lanes(count: int, product: str) -> str:
    """C++ that leaves the sum over `i + lane` in sums[0].

    Sums side by side are added at once by a CPU; a single one would be a chain of additions.
    """
    lanes = 16 if count % 16 == 0 else 8
    return f"""
    float sums[{lanes}];
    for (int lane = 0; lane < {lanes}; ++lane) sums[lane] = 0.0f;
    for (int i = 0; i < {count}; i += {lanes})
        for (int lane = 0; lane < {lanes}; ++lane) sums[lane] += {product};
    for (int width = {lanes // 2}; width > 0; width /= 2)
        for (int lane = 0; lane < width; ++lane) sums[lane] += sums[width + lane];
    """


def _sum_rgb_snippet(points: int) -> str:
    summed = sum_in_lanes(points, f"a[i + lane] * rgb[channel * {points} + i + lane]")
    return f"""
    wp::vec_t<3, float> result;
    for (int channel = 0; channel < 3; ++channel) {{ {summed} result[channel] = sums[0]; }}
    return result;
    """


def project_snippet(coefficients: int, points: int) -> str:
    half = points // 2
    parts = {
        parity: sum_in_lanes(half, f"{parity}[i + lane] * rows.data[k][i + lane]") + "result[k] = sums[0];"
        for parity in ("even", "odd")
    }
    odd = ", ".join("true" if math.isqrt(k) % 2 else "false" for k in range(coefficients))
    return f"""
    const bool is_odd[{coefficients}] = {{{odd}}};
    float even[{half}], odd[{half}];
    for (int i = 0; i < {half}; ++i) {{
        even[i] = weighted[i] + weighted[{half} + i];
        odd[i] = weighted[i] - weighted[{half} + i];
    }}
    wp::vec_t<{coefficients}, float> result;
    for (int k = 0; k < {coefficients}; ++k) {{
        if (is_odd[k]) {{ {parts["odd"]} }} else {{ {parts["even"]} }}
    }}
    return result;
    """


def along_axis_snippet(points: int) -> str:
    """C++ that multiplies values with a coordinate of the direction."""
    half = points // 2
    return f"""
    wp::vec_t<{points}, float> result;
    for (int i = 0; i < {half}; ++i) {{
        const float along = quadrature.data[axis][i];
        result[i] = along * v[i];
        result[{half} + i] = -along * v[{half} + i];
    }}
    return result;
    """


def project_products_snippet(coefficients: int, points: int, products: tuple[tuple[int, ...], ...]) -> str:
    """C++ that projects values times products of coordinates (0: x, 1: y, 2: z), a row of coefficients for each."""
    half = points // 2
    sums = {parity: sum_in_lanes(half, f"{parity}[i + lane] * rows.data[k][i + lane]") for parity in ("even", "odd")}
    is_odd = ", ".join("true" if math.isqrt(k) % 2 else "false" for k in range(coefficients))
    parts = []
    for row, axes in enumerate(products):
        product = " * ".join(f"quadrature.data[{axis}][i]" for axis in axes)
        # An odd product makes odd of even.
        signs = "+-" if len(axes) % 2 == 0 else "-+"
        parts.append(f"""
    for (int i = 0; i < {half}; ++i) {{
        const float product = {product};
        even[i] = product * (weighted[i] {signs[0]} weighted[{half} + i]);
        odd[i] = product * (weighted[i] {signs[1]} weighted[{half} + i]);
    }}
    for (int k = 0; k < {coefficients}; ++k) {{
        if (is_odd[k]) {{ {sums["odd"]} result.data[{row}][k] = sums[0]; }}
        else {{ {sums["even"]} result.data[{row}][k] = sums[0]; }}
    }}""")
    return f"""
    const bool is_odd[{coefficients}] = {{{is_odd}}};
    float even[{half}], odd[{half}];
    wp::mat_t<{len(products)}, {coefficients}, float> result;
    {"".join(parts)}
    return result;
    """


def _at_directions_snippet(order: int, points: int) -> str:
    half = points // 2
    terms = {0: [], 1: []}
    for k in range(order * order):
        terms[math.isqrt(k) % 2].append(f"v[{k}] * rows.data[{k}][i]")
    return f"""
    wp::vec_t<{points}, float> all;
    for (int i = 0; i < {half}; ++i) {{
        const float even = {" + ".join(terms[0])};
        const float odd = {" + ".join(terms[1]) or "0.0f"};
        all[i] = even + odd;
        all[{half} + i] = even - odd;
    }}
    return all;
    """


def _zonal_snippet(order: int, points: int) -> str:
    half = points // 2
    lines = ["float even = coefficients[0], odd = coefficients[1] * t, before = 1.0f, now = t;"]
    for band in range(2, order + 1):
        up, down = (2 * band - 1) / band, (band - 1) / band
        lines.append(f"const float p{band} = {up:.9e}f * t * now - {down:.9e}f * before;")
        lines.append(f"before = now; now = p{band};")
        lines.append(f"{'odd' if band % 2 else 'even'} += coefficients[{band}] * now;")
    return f"""
    wp::vec_t<{points}, float> all;
    for (int i = 0; i < {half}; ++i) {{
        const float t =
            axis[0] * quadrature.data[0][i] + axis[1] * quadrature.data[1][i] + axis[2] * quadrature.data[2][i];
        {" ".join(lines)}
        all[i] = even + odd;
        all[{half} + i] = even - odd;
    }}
    return all;
    """
