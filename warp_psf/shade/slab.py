"""Boxes and rectangles: the coverage of a spherical polygon in closed form, at the directions of a quadrature.

The silhouette of a box is a polygon of up to six great arcs. The coverage in a direction d is the integral over it of
the zonal kernel sum_l (2l + 1)/(4 pi) P_l(d.w). P_l is its own Laplacian but for the factor -l (l + 1), so Gauss'
theorem leaves of each band but l = 0 an integral along the arcs: of

    G(t) = sum_l (2l + 1)/(4 pi l (l + 1)) P_l'(t),

t = d.w along the arc, times the cosine M between d and the arc's normal. The band l = 0 is the solid angle. Along an
arc a cos s + e sin s, s = 0..angle, t is A cos s + E sin s with A = d.a and E = d.e. As t'' = -t, the moments I_k, the
integrals of t^k, follow k I_k = (k - 1)(A^2 + E^2) I_(k-2) - [t^(k-1) t'].
"""

import itertools
import math
from functools import cache

import numpy as np
import warp as wp

from warp_psf.basis import sphere
from warp_psf.basis.directions import make_directions

# The twelve edges, and room for the sixteen lanes of a vector.
LANES = 16


@cache
def make_slab(order: int):
    """The device function `silhouette_coverage(p, half, pole, to_world, quadrature) -> values` for `order` bands.

    p: the point, in the frame of a box with half extents `half`, outside of it; pole: unit vector from p to the box's
    nearest point; to_world: world_from_slab; quadrature: see `make_directions`.
    """
    kit = make_directions(order)
    half_values = kit.half_values

    @wp.func_native(_silhouette_snippet(order, kit.points))
    def silhouette_coverage(
        p: wp.vec3, half: wp.vec3, pole: wp.vec3, to_world: wp.mat33, quadrature: wp.array(dtype=half_values)
    ) -> kit.values: ...

    return silhouette_coverage


def edge_kernel(order: int) -> np.ndarray:
    """Ascending coefficients of G(t)."""
    series = np.zeros(order)
    for band in range(1, order):
        series[band] = (2 * band + 1) / (4 * math.pi * band * (band + 1))
    return np.polynomial.polynomial.polyder(np.polynomial.legendre.leg2poly(series))


def _edge_tables() -> dict[str, np.ndarray]:
    """Signs of the edges, [3, LANES] each: both ends' corners, and the outward normals of the two faces that meet."""
    tables = {name: np.zeros((3, LANES)) for name in ("from_corner", "to_corner", "face_u", "face_v")}
    for lane, (axis, side_u, side_v) in enumerate(itertools.product(range(3), (-1, 1), (-1, 1))):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for name, end in (("from_corner", -1), ("to_corner", 1)):
            tables[name][[axis, u, v], lane] = end, side_u, side_v
        tables["face_u"][u, lane] = side_u
        tables["face_v"][v, lane] = side_v
    return tables


def _silhouette_snippet(order: int, points: int) -> str:
    """C++: first all edges side by side, then for those on the silhouette all directions side by side."""
    half = points // 2
    tables = ""
    for name, table in _edge_tables().items():
        rows = ", ".join("{" + ", ".join(f"{sign:.1f}f" for sign in row) + "}" for row in table)
        tables += f"const float {name}[3][{LANES}] = {{{rows}}};\n"
    arc_tangent = f"{sphere.ARC_TANGENT[-1]:.9e}f"
    for coefficient in sphere.ARC_TANGENT[-2::-1]:
        arc_tangent = f"({arc_tangent} * u * u + {coefficient:.9e}f)"
    arrays = ", ".join(
        f"{name}[{LANES}]"
        for name in (
            *("turn", "cosine", "sine", "angle", "fan_x", "fan_y"),
            *(f"{vector}_{axis}" for vector in ("start", "along", "normal") for axis in "xyz"),
        )
    )
    turned = "\n        ".join(
        f"{name}_{axis}[i] = to_world.data[{row}][0] * {vector}x + to_world.data[{row}][1] * {vector}y"
        f" + to_world.data[{row}][2] * {vector}z;"
        for name, vector in (("start", "a"), ("along", "e"), ("normal", "m"))
        for row, axis in enumerate("xyz")
    )
    return f"""
    {tables}
    float {arrays};
    for (int i = 0; i < {LANES}; ++i) {{
        // A face is seen when the point lies before it. On the silhouette one face of the two is seen, and the arc is
        // turned so that the box lies to its left.
        const float ahead_u = face_u[0][i] * p[0] + face_u[1][i] * p[1] + face_u[2][i] * p[2];
        const float ahead_v = face_v[0][i] * p[0] + face_v[1][i] * p[1] + face_v[2][i] * p[2];
        const float reach_u = face_u[0][i] * face_u[0][i] * half[0]
            + face_u[1][i] * face_u[1][i] * half[1] + face_u[2][i] * face_u[2][i] * half[2];
        const float reach_v = face_v[0][i] * face_v[0][i] * half[0]
            + face_v[1][i] * face_v[1][i] * half[1] + face_v[2][i] * face_v[2][i] * half[2];
        const float side_u = face_u[0][i] + face_u[1][i] + face_u[2][i];
        const float side_v = face_v[0][i] + face_v[1][i] + face_v[2][i];
        const float sees_u = ahead_u > reach_u ? 1.0f : 0.0f, sees_v = ahead_v > reach_v ? 1.0f : 0.0f;
        // An edge of no length, of a rectangle, has no arc.
        const float length = (to_corner[0][i] - from_corner[0][i]) * half[0]
            + (to_corner[1][i] - from_corner[1][i]) * half[1] + (to_corner[2][i] - from_corner[2][i]) * half[2];
        const float side = length > 0.0f ? (sees_v - sees_u) * side_u * side_v : 0.0f;
        float ax = from_corner[0][i] * half[0] - p[0], ay = from_corner[1][i] * half[1] - p[1];
        float az = from_corner[2][i] * half[2] - p[2];
        float bx = to_corner[0][i] * half[0] - p[0], by = to_corner[1][i] * half[1] - p[1];
        float bz = to_corner[2][i] * half[2] - p[2];
        const float a_scale = 1.0f / ::sqrtf(ax * ax + ay * ay + az * az + 1.0e-30f);
        const float b_scale = 1.0f / ::sqrtf(bx * bx + by * by + bz * bz + 1.0e-30f);
        ax *= a_scale; ay *= a_scale; az *= a_scale;
        bx *= b_scale; by *= b_scale; bz *= b_scale;
        float mx = ay * bz - az * by, my = az * bx - ax * bz, mz = ax * by - ay * bx;
        const float across = ::sqrtf(mx * mx + my * my + mz * mz);
        const float between = ax * bx + ay * by + az * bz;
        fan_y[i] = side * (pole[0] * mx + pole[1] * my + pole[2] * mz);
        fan_x[i] = 1.0f + between + pole[0] * (ax + bx) + pole[1] * (ay + by) + pole[2] * (az + bz);
        const float scale = 1.0f / (across + 1.0e-12f);
        mx *= scale; my *= scale; mz *= scale;
        const float ex = my * az - mz * ay, ey = mz * ax - mx * az, ez = mx * ay - my * ax;
        const float u = across / (1.0f + (between < 0.0f ? -between : between));
        const float acute = 2.0f * u * {arc_tangent};
        angle[i] = between < 0.0f ? {math.pi:.9e}f - acute : acute;
        turn[i] = side; cosine[i] = between; sine[i] = across;
        {turned}
    }}
    float even_part[{half}], odd_part[{half}];
    for (int i = 0; i < {half}; ++i) {{ even_part[i] = 0.0f; odd_part[i] = 0.0f; }}
    // Half the solid angle is the argument of the product of complex numbers, one for each triangle of the fan about
    // the pole (van Oosterom and Strackee 1983).
    float real = 1.0f, imaginary = 0.0f;
    for (int edge = 0; edge < 12; ++edge) {{
        if (turn[edge] == 0.0f) continue;
        const float next = real * fan_x[edge] - imaginary * fan_y[edge];
        imaginary = real * fan_y[edge] + imaginary * fan_x[edge];
        real = next;
        const float c = cosine[edge], s = sine[edge], phi = angle[edge], side = turn[edge];
        for (int i = 0; i < {half}; ++i) {{
            const float x = quadrature.data[0][i], y = quadrature.data[1][i], z = quadrature.data[2][i];
            const float A = start_x[edge] * x + start_y[edge] * y + start_z[edge] * z;
            const float E = along_x[edge] * x + along_y[edge] * y + along_z[edge] * z;
            const float M = side * (normal_x[edge] * x + normal_y[edge] * y + normal_z[edge] * z);
            const float last = c * A + s * E, slope = c * E - s * A, squared = A * A + E * E;
            {_moments(order)}
            even_part[i] += M * from_odd;
            odd_part[i] += M * from_even;
        }}
    }}
    // A convex body covers at most half of the sphere, so the half solid angle lies in 0..pi.
    const float half_angle = ::atan2f(imaginary, real);
    const float constant = {0.5 / math.pi:.9e}f * (half_angle < 0.0f ? -half_angle : half_angle);
    wp::vec_t<{points}, float> all;
    for (int i = 0; i < {half}; ++i) {{
        all[i] = constant + even_part[i] + odd_part[i];
        all[{half} + i] = constant + even_part[i] - odd_part[i];
    }}
    return all;
    """


def _moments(order: int) -> str:
    """C++ that sums the kernel's even and odd moments along an arc. t and M are odd functions of the direction."""
    kernel = edge_kernel(order)
    lines = [f"float even = phi, odd = E - slope, from_even = {kernel[0]:.9e}f * phi, from_odd = 0.0f;"]
    if len(kernel) > 1:
        lines.append(f"from_odd += {kernel[1]:.9e}f * odd;")
    if len(kernel) > 2:
        lines.append("float first_power = 1.0f, last_power = 1.0f;")
    for k in range(2, len(kernel)):
        moment = "odd" if k % 2 else "even"
        lines.append("first_power *= A; last_power *= last;")
        lines.append(
            f"{moment} = {1 / k:.9e}f * ({k - 1}.0f * squared * {moment} - last_power * slope + first_power * E);"
        )
        lines.append(f"from_{moment} += {kernel[k]:.9e}f * {moment};")
    return " ".join(lines)
