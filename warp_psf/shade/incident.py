"""Incident light: what arrives at a point from the bodies around it, as SH vectors.

Here the basis radiance fields have been summed with the weights of the frame, so that one lookup per colour channel
brings a body's light; the radiance of slabs comes from their texels. What stands between is composed as for the
proxies. The result is not yet multiplied with what a surface makes of it: neighbours with other normals share it.
"""

import math
from functools import cache
from types import SimpleNamespace

import numpy as np
import warp as wp

from warp_psf.basis import sh, sphere
from warp_psf.basis.directions import make_directions, project_snippet
from warp_psf.scene.geometry import GeometryTables, PoseTables, find_placed
from warp_psf.scene.receiver import ReceiverTable
from warp_psf.shade.between import overlap
from warp_psf.shade.bounce import make_bounce
from warp_psf.shade.patches import PatchTables, slab_from_world, slab_origin
from warp_psf.shade.relations import RelationTable, hides_body, hides_face
from warp_psf.shade.spheres import CutTables


def wide_order(order: int) -> int:
    """Bands of the incident light: a product has more than its factors, and the clamped cosine one to receive them."""
    return min(order + 1, 6)


@cache
def make_incident(order: int, functions: int) -> SimpleNamespace:
    """The kernels of the last gather on `order` bands with `functions` basis functions per body."""
    kit = make_bounce(order, functions)
    between, patch, radiant = kit.between, kit.patch, kit.radiant
    vec, values, half_values = kit.vec, kit.values, kit.half_values
    OcclusionTables, LightingTables, Surface = kit.OcclusionTables, kit.LightingTables, kit.Surface
    bands = wide_order(order)
    wide = sh.make_sh(bands).vec
    evaluate_wide = sh.make_sh(bands).evaluate
    cosine = sh.clamped_cosine(bands) * np.sqrt(4 * np.pi / (2 * np.arange(bands) + 1))
    cosine = wide(*np.repeat(cosine, 2 * np.arange(bands) + 1))

    @wp.func_native(project_snippet(bands * bands, kit.points))
    def project_wide(weighted: values, rows: wp.array(dtype=half_values)) -> wide: ...

    @wp.func_native(_widen_snippet(order, bands))
    def widen(v: vec) -> wide: ...

    @wp.func_native(_add_products_snippet(kit.points))
    def add_products(sum: kit.rgb_values, rgb: kit.rgb_values, passed: values) -> kit.rgb_values: ...

    @wp.func_native(_weigh_channel_snippet(kit.points))
    def weigh_channel(rgb: kit.rgb_values, channel: int, weights: values) -> values: ...

    @wp.func_native(_add_vectors_snippet(order, kit.points))
    def add_vectors(
        sum: kit.rgb_values, rgb: radiant.rgb, rows: wp.array(dtype=half_values), passed: values
    ) -> kit.rgb_values:
        """Adds the SH vectors of three channels, at the directions, times what is passed on in each."""

    @wp.func
    def to_sh(
        world: int,
        entity: int,
        weighted: values,
        o: OcclusionTables,
        lighting: LightingTables,
        wide_rows: wp.array(dtype=half_values),
    ) -> wide:
        """Onto SH: about the axes of a body that shadows itself, as its stored transfer is; else about the world's."""
        if lighting[0].first_transfer[world, entity] >= 0:
            return widen(kit.project(weighted, o[0].rows[world, entity]))
        return project_wide(weighted, wide_rows)

    @wp.kernel(enable_backward=False, module="unique")
    def gather_incident(
        first: int,
        start: int,
        probe_slot: wp.array(dtype=wp.int32),  # (probe): world * slots + slot
        receivers: ReceiverTable,
        geometry: GeometryTables,
        poses: PoseTables,
        o: OcclusionTables,
        lighting: LightingTables,
        patches: PatchTables,
        relations: RelationTable,
        fields: radiant.RadianceTable,
        bodies: kit.BodyTable,
        summed: wp.array2d(dtype=radiant.rgb),  # (world, entity's sample)
        summed_first: wp.array(dtype=wp.int32),  # (entity)
        gloss: kit.GlossTable,
        along: wp.array2d(dtype=radiant.rgb),  # (world, sample of a glossy body's axis)
        along_first: wp.array(dtype=wp.int32),  # (3 row + axis)
        wide_rows: wp.array(dtype=half_values),
        threshold: float,
        light_out: wp.array2d(dtype=wide),  # (probe, channel)
    ):
        _world, item = wp.tid()
        probe = start + first + item
        slots = receivers.entity.shape[1]
        world = probe_slot[probe] / slots
        slot = probe_slot[probe] % slots
        own = receivers.entity[world, slot]
        p = receivers.position[world, slot]
        n = receivers.normal[world, slot]
        sources = between.find_sources(world, own, p, n, threshold, geometry, poses, patches, o)
        entity_at = sources.entity
        weight = sources.weight
        toward = sources.toward
        distance = sources.distance
        radius = sources.radius
        sine = sources.sine
        ahead = sources.ahead
        covers = between.lists()
        # All pixels around a probe on a flat face have its normal; on round bodies they do not.
        gain = between.numbers()
        for place in range(sources.count):
            placed = find_placed(world, entity_at[place], geometry, poses)
            covered = kit.covered_by(world, entity_at[place], p, placed, o)
            covers[place] = weight[place] * covered
            gain[place] = 1.0
            if patches[0].first_face[own] >= 0:
                gain[place] = between.horizon_gain(covered, n, lighting[0].weights[0], o[0].quadrature)
        incident = kit.rgb_values()
        # What is accumulated is not changed under a condition, where a compiler would copy it at every branch.
        for place in range(sources.count):
            source = entity_at[place]
            if bodies.field[source] < 0:
                continue
            passed = values(gain[place] * weight[place])
            for other in range(sources.count):
                share = float(0.0)
                if other != place:
                    share = overlap(toward[other], sine[other], toward[place], sine[place])
                if share > 0.0:
                    further = (distance[place] - distance[other]) / (radius[place] + radius[other])
                    share *= hides_body(world, entity_at[other], ahead[other], source, further, patches, relations)
                if share <= 0.0:
                    continue
                passed = wp.cw_mul(passed, values(1.0) - share * covers[other])
            p_body = wp.transpose(poses[0].rotation[world, source]) * (p - poses[0].position[world, source])
            where = radiant.locate(fields, bodies.field[source], p_body)
            rgb = radiant.lookup_summed(summed[world], summed_first[source], where)
            rows = o[0].rows[world, source]
            incident = add_vectors(incident, rgb, rows, passed)
            row = gloss.row[source]
            for axis in range(wp.where(row >= 0, 3, 0)):
                rgb = radiant.lookup_summed(along[world], along_first[3 * row + axis], where)
                # Light leaves against the direction in which it is seen.
                passed_along = kit.along_axis(passed, axis, o[0].quadrature)
                incident = add_vectors(incident, rgb, rows, -passed_along)
        for place in range(sources.count):
            source = entity_at[place]
            if patches[0].first_face[source] < 0:
                continue
            to_slab = slab_from_world(world, source, poses, patches)
            p_slab = to_slab * (p - slab_origin(world, source, poses, patches))
            for side in range(6):
                face = patches[0].first_face[source] + side
                if not patch.sees_face(world, face, p_slab, patches):
                    continue
                passed = patch.face_coverage(world, face, p_slab, to_slab, patches, o[0].quadrature)
                passed = weight[place] * passed
                for other in range(sources.count):
                    share = float(0.0)
                    if other != place:
                        share = hides_face(world, entity_at[other], ahead[other], face, patches, relations)
                    if share <= 0.0:
                        continue
                    passed = wp.cw_mul(passed, values(1.0) - share * covers[other])
                radiance = patch.face_radiance(world, face, p_slab, n, to_slab, patches, o[0].quadrature)
                incident = add_products(incident, radiance, passed)
        for channel in range(3):
            weighted = weigh_channel(incident, channel, lighting[0].weights[0])
            light_out[probe, channel] = to_sh(world, own, weighted, o, lighting, wide_rows)

    @wp.kernel(enable_backward=False, module="unique")
    def gather_environment(
        first: int,
        start: int,
        probe_slot: wp.array(dtype=wp.int32),  # (probe): world * slots + slot
        receivers: ReceiverTable,
        geometry: GeometryTables,
        poses: PoseTables,
        o: OcclusionTables,
        lighting: LightingTables,
        patches: PatchTables,
        cuts: CutTables,
        wide_rows: wp.array(dtype=half_values),
        sky_out: wp.array2d(dtype=wide),  # (probe, channel)
    ):
        _world, item = wp.tid()
        probe = start + first + item
        slots = receivers.entity.shape[1]
        world = probe_slot[probe] / slots
        slot = probe_slot[probe] % slots
        own = receivers.entity[world, slot]
        # On a round body the pixels around a probe have other horizons: there bodies below it hide their part, too.
        n = wp.where(patches[0].first_face[own] >= 0, receivers.normal[world, slot], wp.vec3())
        p = receivers.position[world, slot]
        visible, _before = kit.visibility_at(world, slot, own, -1, wp.vec3(), p, n, geometry, poses, o, cuts)
        for channel in range(3):
            weighted = wp.cw_mul(lighting[0].environment[world, channel], visible)
            sky_out[probe, channel] = to_sh(world, own, weighted, o, lighting, wide_rows)

    @wp.func
    def response_of(world: int, surface: Surface, poses: PoseTables, lighting: LightingTables) -> wide:
        """What incident light is to be multiplied with to give irradiance."""
        if surface.first_transfer >= 0:
            return widen(kit.stored_at(lighting[0].transfer, surface.first_transfer, surface))
        n = surface.normal
        if lighting[0].first_transfer[world, surface.entity] >= 0:
            n = wp.transpose(poses[0].rotation[world, surface.entity]) * n
        return wp.cw_mul(wp.static(cosine), evaluate_wide(n))

    return SimpleNamespace(
        **vars(kit),
        wide=wide,
        to_sh=to_sh,
        response_of=response_of,
        gather_incident=gather_incident,
        gather_environment=gather_environment,
    )


def wide_rows(order: int, device: wp.Device) -> wp.array:
    """The basis of the incident light at the first half of the directions, about the world's axes."""
    points = sphere.QUADRATURE_POINTS[order]
    basis = sh.evaluate(sphere.quadrature(points)[0][: points // 2], wide_order(order))
    return wp.array(basis.T.astype(np.float32), dtype=make_directions(order).half_values, device=device)


def _widen_snippet(order: int, bands: int) -> str:
    return f"""
    wp::vec_t<{bands * bands}, float> wide;
    for (int k = 0; k < {order * order}; ++k) wide[k] = v[k];
    return wide;
    """


def _add_products_snippet(points: int) -> str:
    return f"""
    wp::vec_t<{3 * points}, float> result;
    for (int channel = 0; channel < 3; ++channel)
        for (int i = 0; i < {points}; ++i)
            result[channel * {points} + i] =
                sum[channel * {points} + i] + rgb[channel * {points} + i] * passed[i];
    return result;
    """


def _weigh_channel_snippet(points: int) -> str:
    return f"""
    wp::vec_t<{points}, float> result;
    for (int i = 0; i < {points}; ++i) result[i] = rgb[channel * {points} + i] * weights[i];
    return result;
    """


def _add_vectors_snippet(order: int, points: int) -> str:
    half, count = points // 2, order * order
    terms: dict[int, list[str]] = {0: [], 1: []}
    for k in range(count):
        terms[math.isqrt(k) % 2].append(f"rgb[channel * {count} + {k}] * rows.data[{k}][i]")
    return f"""
    wp::vec_t<{3 * points}, float> result = sum;
    for (int channel = 0; channel < 3; ++channel)
        for (int i = 0; i < {half}; ++i) {{
            const float even = {" + ".join(terms[0])};
            const float odd = {" + ".join(terms[1]) or "0.0f"};
            result[channel * {points} + i] += (even + odd) * passed[i];
            result[channel * {points} + {half} + i] += (even - odd) * passed[{half} + i];
        }}
    return result;
    """
