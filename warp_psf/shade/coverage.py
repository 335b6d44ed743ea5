"""Coverage: which part of the directions around a point an entity takes up, at the directions of a quadrature.

Every function of direction that shading multiplies (light, transfer, the occluders' visibility) is band-limited, so
its values at a quadrature's directions hold all of it, and a product of functions is a product of numbers. The product
of light, transfer and one occluder is then the SH triple product to rounding; with more occluders nothing is truncated
between one and the next, and their order does not matter.

Where coverage has a closed form it is used: spheres (zonal), boxes and rectangles (spherical polygons). The others
are looked up in their shadow fields. All three give the exact projection on `order` bands, evaluated at the directions.
"""

import math
from functools import cache
from types import SimpleNamespace

import numpy as np
import warp as wp

from warp_psf.basis import sh, sphere
from warp_psf.field.shells import make_fields

NO_SHAPE, FIELD_SHAPE, SPHERE_SHAPE, SLAB_SHAPE = 0, 1, 2, 3
# A receiver closer to a slab than this share of its half-diagonal counts as lying on its surface: contact leaves
# receivers a little inside, where the slab would otherwise surround them.
SLAB_SKIN = 1.0e-5


@cache
def make_coverage(order: int) -> SimpleNamespace:
    """Device functions for `order` bands: types, tables and `coverage_of`."""
    fields = make_fields(order)
    points = sphere.QUADRATURE_POINTS[order]
    vec, values = fields.vec, wp.types.vector(points, wp.float32)
    FieldTable = fields.FieldTable
    # d/dt of the zonal kernel sum_l (2l + 1)/(4 pi l (l + 1)) P_l(t): what Stokes' theorem leaves on a polygon's edges.
    edge_kernel = [float(c) for c in _edge_kernel(order)]
    top = len(edge_kernel) - 1
    bands = order

    @wp.struct
    class OccluderTable:
        """How each entity is looked up."""

        shape: wp.array(dtype=wp.int32)  # (entity): one of the *_SHAPE constants
        casts: wp.array(dtype=wp.bool)  # (entity): False for lights and for what casts no shadow
        field: wp.array(dtype=wp.int32)  # (entity): index into the field table
        slab_center: wp.array(dtype=wp.vec3)  # (entity), in the entity's frame
        slab_rotation: wp.array(dtype=wp.mat33)  # (entity), entity_from_slab
        slab_half: wp.array(dtype=wp.vec3)  # (entity), half extents, metres

    @wp.func
    def cosine_to(direction: wp.vec3, quadrature: wp.array(dtype=values)) -> values:
        return direction[0] * quadrature[0] + direction[1] * quadrature[1] + direction[2] * quadrature[2]

    @wp.func
    def at_directions(v: vec, rows: wp.array(dtype=values)) -> values:
        """An SH vector in an entity's frame -> its values at the world's directions."""
        total = v[0] * rows[0]
        for k in range(1, wp.static(order * order)):
            total += v[k] * rows[k]
        return total

    @wp.func
    def cap_coverage(cosine: values, x: float) -> values:
        """The cap of directions whose cosine exceeds x = cos(half-angle), on `order` bands (zonal)."""
        # sum_l (P_(l-1)(x) - P_(l+1)(x))/2 P_l(t), by Legendre's recurrence in x and t at once.
        total = values(0.5 * (1.0 - x))
        p_before = float(1.0)
        p = x
        p_after = 1.5 * x * x - 0.5
        t_before = values(1.0)
        t = cosine
        total += (0.5 * (p_before - p_after)) * t
        for l in range(2, wp.static(bands)):
            n = float(l)
            p_before = p
            p = p_after
            p_after = ((2.0 * n + 1.0) * x * p - n * p_before) / (n + 1.0)
            t_next = ((2.0 * n - 1.0) / n) * wp.cw_mul(cosine, t) - ((n - 1.0) / n) * t_before
            t_before = t
            t = t_next
            total += (0.5 * (p_before - p_after)) * t
        return total

    @wp.func
    def edge_coverage(a: wp.vec3, b: wp.vec3, to_world: wp.mat33, quadrature: wp.array(dtype=values)) -> values:
        """What the great arc from a to b adds to the coverage of the polygon on its left, without l = 0."""
        normal = wp.cross(a, b)
        sine = wp.length(normal)
        cosine = wp.dot(a, b)
        angle = wp.atan2(sine, cosine)
        m = normal / wp.max(sine, 1.0e-12)
        along_a = cosine_to(to_world * a, quadrature)
        along_e = cosine_to(to_world * wp.cross(m, a), quadrature)
        along_m = cosine_to(to_world * m, quadrature)
        # The kernel is a polynomial in t(s) = A cos s + B sin s; t'' = -t gives the recurrence of its moments
        # k I_k = (k - 1)(A^2 + B^2) I_(k-2) - [t^(k-1) t'].
        total = values(wp.static(edge_kernel[0]) * angle)
        if wp.static(top >= 1):
            end = cosine * along_a + sine * along_e
            end_slope = cosine * along_e - sine * along_a
            squared = wp.cw_mul(along_a, along_a) + wp.cw_mul(along_e, along_e)
            even = values(angle)
            odd = along_e - end_slope
            total += wp.static(edge_kernel[1] if top >= 1 else 0.0) * odd
            if wp.static(top >= 2):
                power_start = along_a
                power_end = end
                even = 0.5 * (
                    wp.cw_mul(squared, even) - wp.cw_mul(power_end, end_slope) + wp.cw_mul(power_start, along_e)
                )
                total += wp.static(edge_kernel[2] if top >= 2 else 0.0) * even
                if wp.static(top >= 3):
                    power_start = wp.cw_mul(power_start, along_a)
                    power_end = wp.cw_mul(power_end, end)
                    odd = (1.0 / 3.0) * (
                        2.0 * wp.cw_mul(squared, odd)
                        - wp.cw_mul(power_end, end_slope)
                        + wp.cw_mul(power_start, along_e)
                    )
                    total += wp.static(edge_kernel[3] if top >= 3 else 0.0) * odd
                    if wp.static(top >= 4):
                        power_start = wp.cw_mul(power_start, along_a)
                        power_end = wp.cw_mul(power_end, end)
                        even = 0.25 * (
                            3.0 * wp.cw_mul(squared, even)
                            - wp.cw_mul(power_end, end_slope)
                            + wp.cw_mul(power_start, along_e)
                        )
                        total += wp.static(edge_kernel[4] if top >= 4 else 0.0) * even
        return wp.cw_mul(total, along_m)

    @wp.func
    def slab_coverage(
        p_slab: wp.vec3, half: wp.vec3, to_world: wp.mat33, quadrature: wp.array(dtype=values)
    ) -> values:
        """A box or rectangle, axis-aligned in the frame of `p_slab`: the spherical polygon of its silhouette."""
        # A point inside is put on the nearest face.
        inside = half - wp.vec3(wp.abs(p_slab[0]), wp.abs(p_slab[1]), wp.abs(p_slab[2]))
        skin = wp.static(SLAB_SKIN) * wp.length(half)
        p = wp.vec3(p_slab[0], p_slab[1], p_slab[2])
        if wp.min(inside) > -skin:
            axis = int(0)
            if inside[1] < inside[axis]:
                axis = 1
            if inside[2] < inside[axis]:
                axis = 2
            p[axis] = wp.where(p[axis] < 0.0, -1.0, 1.0) * (half[axis] + skin)
        nearest = wp.vec3(
            wp.clamp(p[0], -half[0], half[0]), wp.clamp(p[1], -half[1], half[1]), wp.clamp(p[2], -half[2], half[2])
        )
        pole = wp.normalize(nearest - p)
        total = values(0.0)
        solid_angle = float(0.0)
        edges = int(12)  # a variable keeps the loop from being unrolled
        for edge in range(edges):
            # Four edges along each axis, at the corners of the other two.
            axis = edge / 4
            u = (axis + 1) % 3
            v = (axis + 2) % 3
            side_u = wp.where(edge % 2 == 0, -1.0, 1.0)
            side_v = wp.where(edge % 4 < 2, -1.0, 1.0)
            sees_u = side_u * p[u] > half[u]
            sees_v = side_v * p[v] > half[v]
            if sees_u != sees_v and half[axis] > 0.0:
                # On the silhouette: turned so that the box lies to the left, seen from p.
                turn = wp.where(sees_u, -1.0, 1.0) * side_u * side_v
                a = wp.vec3()
                a[u] = side_u * half[u] - p[u]
                a[v] = side_v * half[v] - p[v]
                b = wp.vec3(a[0], a[1], a[2])
                a[axis] = -turn * half[axis] - p[axis]
                b[axis] = turn * half[axis] - p[axis]
                a = wp.normalize(a)
                b = wp.normalize(b)
                total += edge_coverage(a, b, to_world, quadrature)
                # The fan of triangles about `pole` (van Oosterom and Strackee 1983).
                solid_angle += 2.0 * wp.atan2(
                    wp.dot(pole, wp.cross(a, b)), 1.0 + wp.dot(a, b) + wp.dot(pole, a) + wp.dot(pole, b)
                )
        return total + values(solid_angle * wp.static(0.25 / math.pi))

    @wp.func
    def coverage_of(
        entity: int,
        p_world: wp.vec3,
        position: wp.vec3,
        rotation: wp.mat33,
        center: wp.vec3,
        radius: float,
        occluders: OccluderTable,
        table: FieldTable,
        rows: wp.array(dtype=values),
        quadrature: wp.array(dtype=values),
    ) -> values:
        """The part of the directions around p_world that `entity` covers: 1 where it does, 0 elsewhere."""
        shape = occluders.shape[entity]
        covered = values(0.0)
        if shape == wp.static(FIELD_SHAPE):
            p_body = wp.transpose(rotation) * (p_world - position)
            covered = at_directions(fields.lookup_coverage(table, occluders.field[entity], p_body), rows)
        elif shape == wp.static(SPHERE_SHAPE):
            offset = position + rotation * center - p_world
            distance = wp.length(offset)
            # Inside, by contact, counts as on the surface.
            sine = wp.min(radius / wp.max(distance, 1.0e-9), 1.0)
            covered = cap_coverage(
                cosine_to(offset / wp.max(distance, 1.0e-9), quadrature), wp.sqrt(1.0 - sine * sine)
            )
        elif shape == wp.static(SLAB_SHAPE):
            to_world = rotation * occluders.slab_rotation[entity]
            p_slab = wp.transpose(to_world) * (p_world - position - rotation * occluders.slab_center[entity])
            covered = slab_coverage(p_slab, occluders.slab_half[entity], to_world, quadrature)
        return covered

    return SimpleNamespace(
        order=order,
        points=points,
        vec=vec,
        values=values,
        FieldTable=FieldTable,
        OccluderTable=OccluderTable,
        cosine_to=cosine_to,
        at_directions=at_directions,
        cap_coverage=cap_coverage,
        slab_coverage=slab_coverage,
        coverage_of=coverage_of,
    )


def _edge_kernel(order: int) -> np.ndarray:
    """Ascending coefficients of sum_{l=1}^{order-1} (2l + 1)/(4 pi l (l + 1)) P_l'(t)."""
    series = np.zeros(order)
    for band in range(1, order):
        series[band] = (2 * band + 1) / (4 * math.pi * band * (band + 1))
    return np.polynomial.polynomial.polyder(np.polynomial.legendre.leg2poly(series))


def quadrature_rows(order: int, device: wp.Device) -> wp.array:
    """The directions' x, y and z and their weights, as four rows for the functions of `make_coverage(order)`."""
    directions, weights = sphere.quadrature(sphere.QUADRATURE_POINTS[order])
    rows = np.concatenate([directions.T, weights[None]])
    return wp.array(rows.astype(np.float32), dtype=make_coverage(order).values, device=device)


def basis_at_directions(order: int) -> np.ndarray:
    """y_k at the quadrature's directions, float64 [points, order^2]."""
    return sh.evaluate(sphere.quadrature(sphere.QUADRATURE_POINTS[order])[0], order)
