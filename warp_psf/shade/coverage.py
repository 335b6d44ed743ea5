"""Coverage: which part of the directions around a point an entity takes up, at the directions of a quadrature.

Where coverage has a closed form it is used: spheres (zonal), boxes and rectangles (spherical polygons). The others
are looked up in their shadow fields. All are the projection on `order` bands, evaluated at the directions.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from warp_psf.basis.directions import make_directions
from warp_psf.shade.slab import make_slab

NO_SHAPE, FIELD_SHAPE, SPHERE_SHAPE, SLAB_SHAPE = 0, 1, 2, 3
# A receiver closer to a slab than this share of its half-diagonal counts as lying on its surface: contact leaves
# receivers a little inside, where the slab would otherwise surround them.
SLAB_SKIN = 1.0e-5


@cache
def make_coverage(order: int) -> SimpleNamespace:
    """Device functions for `order` bands: those of `make_directions`, the closed forms, and the occluders' table."""
    kit = make_directions(order)
    values, half_values, profile = kit.values, kit.half_values, kit.profile
    silhouette_coverage = make_slab(order)

    @wp.struct
    class OccluderTable:
        """How each entity is looked up."""

        shape: wp.array(dtype=wp.int32)  # (entity): one of the *_SHAPE constants
        opacity: wp.array(dtype=wp.float32)  # (entity): share of light it stops; 0 for lights and what casts no shadow
        field: wp.array(dtype=wp.int32)  # (entity): index into the field table
        slab_center: wp.array(dtype=wp.vec3)  # (entity), in the entity's frame
        slab_rotation: wp.array(dtype=wp.mat33)  # (entity), entity_from_slab
        slab_half: wp.array(dtype=wp.vec3)  # (entity), half extents, metres

    @wp.func
    def cap_coverage(axis: wp.vec3, sine: float, quadrature: wp.array(dtype=half_values)) -> values:
        """The cap of directions about a unit axis whose half-angle, at most a right one, has this sine."""
        # The integral of P_l over the cap is sine^2 P_l'(x)/(l (l + 1)), x the cosine, which keeps its digits for small
        # caps; P_(l+1)' = P_(l-1)' + (2l + 1) P_l.
        x = wp.sqrt(wp.max(1.0 - sine * sine, 0.0))
        squared = sine * sine
        coefficients = profile()
        coefficients[0] = 0.5 * squared / (1.0 + x)
        before = float(1.0)
        now = x
        slope_before = float(0.0)
        slope = float(1.0)
        for band in range(1, wp.static(order)):
            n = float(band)
            coefficients[band] = 0.5 * (2.0 * n + 1.0) / (n * (n + 1.0)) * squared * slope
            slope_after = slope_before + (2.0 * n + 1.0) * now
            after = ((2.0 * n + 1.0) * x * now - n * before) / (n + 1.0)
            slope_before = slope
            slope = slope_after
            before = now
            now = after
        return kit.zonal_at_directions(coefficients, axis, quadrature)

    @wp.func
    def slab_coverage(
        p_slab: wp.vec3, half: wp.vec3, to_world: wp.mat33, quadrature: wp.array(dtype=half_values)
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
        return silhouette_coverage(p, half, pole, to_world, quadrature)

    return SimpleNamespace(
        **vars(kit),
        OccluderTable=OccluderTable,
        cap_coverage=cap_coverage,
        slab_coverage=slab_coverage,
    )
