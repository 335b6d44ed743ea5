"""What an area light would send to a receiver if nothing stood between them.

Flat rectangles, boxes and spheres have closed forms for the irradiance, so that shaded sides fade as they should, and
the band-limited functions only have to tell which share of the light is visible.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from warp_psf.shade.coverage import SLAB_SHAPE, SPHERE_SHAPE, make_coverage

# Places per side of a flat light at which the Phong lobe is evaluated; the lobe is far wider than their distance
# unless the light is both large and near.
LOBE_PLACES = 5


@cache
def make_area(order: int) -> SimpleNamespace:
    """Device functions `area_irradiance` and `area_gloss`, over the occluder table of `order` bands."""
    OccluderTable = make_coverage(order).OccluderTable

    @wp.func
    def edge_irradiance(a: wp.vec3, b: wp.vec3, n: wp.vec3) -> float:
        """What the great arc from a to b adds to the integral of the cosine to n over the polygon on its left."""
        across = wp.cross(a, b)
        sine = wp.length(across)
        return 0.5 * wp.atan2(sine, wp.dot(a, b)) * wp.dot(n, across) / wp.max(sine, 1.0e-12)

    @wp.func
    def slab_irradiance(p: wp.vec3, n: wp.vec3, half: wp.vec3) -> float:
        """The integral of the clamped cosine to n over a box's silhouette, all in the box's frame (Lambert 1760)."""
        total = float(0.0)
        leaving = wp.vec3()
        returning = wp.vec3()
        crossings = int(0)
        edges = int(12)  # a variable keeps the loop from being unrolled
        for edge in range(edges):
            axis = edge / 4
            u = (axis + 1) % 3
            v = (axis + 2) % 3
            side_u = wp.where(edge % 2 == 0, -1.0, 1.0)
            side_v = wp.where(edge % 4 < 2, -1.0, 1.0)
            sees_u = side_u * p[u] > half[u]
            sees_v = side_v * p[v] > half[v]
            if sees_u != sees_v and half[axis] > 0.0:
                turn = wp.where(sees_u, -1.0, 1.0) * side_u * side_v
                a = wp.vec3()
                a[u] = side_u * half[u] - p[u]
                a[v] = side_v * half[v] - p[v]
                b = wp.vec3(a[0], a[1], a[2])
                a[axis] = -turn * half[axis] - p[axis]
                b[axis] = turn * half[axis] - p[axis]
                height_a = wp.dot(n, a)
                height_b = wp.dot(n, b)
                # The part below the horizon is cut off; the arc along the horizon closes the rest.
                if height_a > 0.0 or height_b > 0.0:
                    if height_a <= 0.0:
                        a = a + (height_a / (height_a - height_b)) * (b - a)
                        returning = wp.normalize(a)
                        crossings += 1
                    elif height_b <= 0.0:
                        b = a + (height_a / (height_a - height_b)) * (b - a)
                        leaving = wp.normalize(b)
                        crossings += 1
                    total += edge_irradiance(wp.normalize(a), wp.normalize(b), n)
        if crossings == 2:
            total += edge_irradiance(leaving, returning, n)
        return wp.max(total, 0.0)

    @wp.func
    def sphere_irradiance(cosine: float, squared: float) -> float:
        """The integral of the clamped cosine over a sphere's disc; squared: (distance/radius)^2, at least 1.

        A sphere that the horizon cuts: Snyder 1996, Area light sources for real-time graphics.
        """
        beyond = wp.max(squared, 1.0 + 1.0e-6)
        cut = 1.0 - beyond * cosine * cosine
        if cut <= 0.0:
            return wp.pi * wp.max(cosine, 0.0) / beyond
        level = wp.sqrt(wp.max(1.0 - cosine * cosine, 1.0e-12))
        edge = wp.clamp(-cosine * wp.sqrt(beyond - 1.0) / level, -1.0, 1.0)
        return wp.max(
            (cosine * wp.acos(edge) - wp.sqrt(cut * (beyond - 1.0))) / beyond + wp.atan(wp.sqrt(cut / (beyond - 1.0))),
            0.0,
        )

    @wp.func
    def area_irradiance(
        light: int,
        p: wp.vec3,
        n: wp.vec3,
        position: wp.vec3,
        rotation: wp.mat33,
        center: wp.vec3,
        radius: float,
        occluders: OccluderTable,
    ) -> float:
        """Irradiance per unit of radiance of an unhindered light; -1 where there is no closed form."""
        shape = occluders.shape[light]
        if shape == wp.static(SLAB_SHAPE):
            to_slab = wp.transpose(rotation * occluders.slab_rotation[light])
            p_slab = to_slab * (p - position - rotation * occluders.slab_center[light])
            return slab_irradiance(p_slab, to_slab * n, occluders.slab_half[light])
        if shape == wp.static(SPHERE_SHAPE):
            offset = center - p
            distance = wp.max(wp.length(offset), 1.0e-9)
            return sphere_irradiance(wp.dot(n, offset) / distance, (distance / radius) * (distance / radius))
        return -1.0

    @wp.func
    def area_gloss(
        light: int,
        p: wp.vec3,
        n: wp.vec3,
        mirrored: wp.vec3,
        exponent: float,
        position: wp.vec3,
        rotation: wp.mat33,
        occluders: OccluderTable,
    ) -> float:
        """Radiance through the normalised Phong lobe per unit of radiance of an unhindered flat light; else -1."""
        if occluders.shape[light] != wp.static(SLAB_SHAPE) or occluders.slab_half[light][2] > 0.0:
            return -1.0
        to_world = rotation * occluders.slab_rotation[light]
        half = occluders.slab_half[light]
        middle = position + rotation * occluders.slab_center[light]
        facing = wp.vec3(to_world[0, 2], to_world[1, 2], to_world[2, 2])
        patch = 4.0 * half[0] * half[1] * wp.static(1.0 / LOBE_PLACES**2)
        total = float(0.0)
        places = int(wp.static(LOBE_PLACES))  # a variable keeps the loop from being unrolled
        for row in range(places):
            for column in range(places):
                x = (2.0 * float(column) + 1.0) * wp.static(1.0 / LOBE_PLACES) - 1.0
                y = (2.0 * float(row) + 1.0) * wp.static(1.0 / LOBE_PLACES) - 1.0
                toward = middle + to_world * wp.vec3(x * half[0], y * half[1], 0.0) - p
                squared = wp.max(wp.length_sq(toward), 1.0e-12)
                toward = toward / wp.sqrt(squared)
                cosine = wp.dot(n, toward)
                aligned = wp.dot(mirrored, toward)
                if cosine > 0.0 and aligned > 0.0:
                    solid_angle = patch * wp.abs(wp.dot(facing, toward)) / squared
                    total += cosine * wp.pow(aligned, exponent) * solid_angle
        return 0.5 * (exponent + 2.0) / wp.pi * total

    return SimpleNamespace(sphere_irradiance=sphere_irradiance, area_irradiance=area_irradiance, area_gloss=area_gloss)
