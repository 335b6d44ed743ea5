"""The tables that the kernels of the bounces share, and how their weights are read."""

from functools import cache
from types import SimpleNamespace

import warp as wp

from warp_psf.field.moments import make_moments
from warp_psf.field.radiance import make_radiance
from warp_psf.shade.direct import make_direct


@cache
def make_tables(order: int, functions: int) -> SimpleNamespace:
    """The tables of bounces on `order` bands with `functions` basis functions per body, and what they are made of."""
    kit = make_direct(order)
    radiant = make_radiance(order, functions)
    moments = make_moments(order, functions)
    values = kit.values
    per_function, first_moments, second_moments = radiant.weights, moments.first, moments.second

    @wp.struct
    class BodyTable:
        """The bodies that send out light through basis functions."""

        field: wp.array(dtype=wp.int32)  # (entity): its basis radiance field, -1 for slabs and lights
        first_proxy: wp.array(dtype=wp.int32)  # (entity)
        proxies: wp.array(dtype=wp.int32)  # (entity): how many
        first_solver: wp.array(dtype=wp.int32)  # (entity): its first number in `solver`
        solver: wp.array(dtype=wp.float32)  # per body (function, proxy), Iwasaki 2007, section 5.2
        own: wp.array(dtype=per_function)  # (body proxy): irradiance there that the body's own functions cause
        weights: wp.array3d(dtype=per_function)  # (world, entity, channel)

    @wp.struct
    class KeptTable:
        """What the proxies receive per unit of light, kept for as long as nothing moves."""

        proxy: wp.array(dtype=wp.int32)  # (station): the proxies at which bounced light is gathered
        count: wp.array2d(dtype=wp.int32)  # (world, station)
        entity: wp.array3d(dtype=wp.int32)  # (world, station, place)
        irradiance: wp.array3d(dtype=per_function)  # (world, station, place): basis irradiances
        face_count: wp.array2d(dtype=wp.int32)  # (world, station)
        face: wp.array3d(dtype=wp.int32)  # (world, station, place)
        # (world, station, place): what the radiance of the face at the directions is to be multiplied with
        transport: wp.array3d(dtype=values)

    @wp.struct
    class GlossTable:
        """The bodies whose reflected light depends on its direction, as `row`s, and their proxies.

        Their radiance is what the other tables hold, as if all light left evenly, and a deviation from that of four
        terms: c + x v_x + y v_y + z v_z, of the direction in which it leaves. The vector v is kept at the proxies; c
        makes up for what v adds to the energy.
        """

        row: wp.array(dtype=wp.int32)  # (entity): -1 for those that reflect evenly
        entity: wp.array(dtype=wp.int32)  # (row)
        factors: wp.array(dtype=wp.vec4)  # (row): of the lobe, see `factor_lobe`
        first_place: wp.array(dtype=wp.int32)  # (row): its first proxy among those of glossy bodies
        proxy: wp.array(dtype=wp.int32)  # (glossy proxy)
        place: wp.array(dtype=wp.int32)  # (proxy): which of the glossy proxies it is, -1 for others
        first: wp.array3d(dtype=first_moments)  # (world, station, place): basis irradiances times a coordinate
        second: wp.array3d(dtype=second_moments)  # (world, glossy proxy, place): times two coordinates
        weights: wp.array3d(dtype=per_function)  # (world, 4 row + term, channel): of the deviation
        extra: wp.array2d(dtype=wp.vec3)  # (world, station): irradiance that the deviations cause
        moment: wp.array2d(dtype=wp.mat33)  # (world, glossy proxy): irradiance times direction, a row per channel
        vector: wp.array2d(dtype=wp.mat33)  # (world, glossy proxy): v after the last bounce, a row per channel
        total: wp.array2d(dtype=wp.mat33)  # (world, glossy proxy): v after all bounces so far

    @wp.func
    def light_of(world: int, entity: int, received: per_function, bodies: BodyTable) -> wp.vec3:
        """What is received of an entity, of each of whose functions `received` is."""
        return wp.vec3(
            wp.dot(received, bodies.weights[world, entity, 0]),
            wp.dot(received, bodies.weights[world, entity, 1]),
            wp.dot(received, bodies.weights[world, entity, 2]),
        )

    return SimpleNamespace(
        **vars(kit),
        light_of=light_of,
        radiant=radiant,
        moments=moments,
        BodyTable=BodyTable,
        KeptTable=KeptTable,
        GlossTable=GlossTable,
    )
