"""Basis radiance fields: what a body whose surface shines as a basis function sends to the points around it.

A body that others light is a source of light itself. Its radiance is a sum of N basis functions on its surface with
the weights of the frame; a basis radiance field holds, for each function, the radiance that arrives at sample points
on concentric shells, projected on SH (Iwasaki 2007, sections 3.1 and 4.3). It is laid out, quantised and interpolated
as a shadow field (`field/shells.py`); the N functions of a shell share their samples, so that the place of a receiver
is found once for all of them.
"""

from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from warp_psf.basis import sh
from warp_psf.device import launch
from warp_psf.field.shells import (
    CONTACT_POWER,
    FIRST_OUTER_SHELL,
    SHELL_SPACING,
    angles_of,
    between_shells,
    find_corners,
    nearest_four,
)

# Iwasaki 2007, section 6: 16 shells. The last stands 3.2 radii from the centre; beyond, light falls as 1/r^2.
RADIANCE_SHELLS = 16
# Samples per axis of a shell before it is reduced. With 16, a body of 16 functions takes at most 1.1 MB and lights
# receivers at 1.3 to 3.2 radii to 1 or 2 % (RMS; tenpin, teapot, ball) without a bias; 32 take 4.2 MB for the same.
FINEST_RADIANCE_RESOLUTION = 16
# How many basis functions a field may have: those of the paper's figure 10.
FUNCTION_COUNTS = (4, 8, 16, 32)


@dataclass(frozen=True)
class BasisRadianceField:
    """The radiance around a body for each of its basis functions, quantised to 8 bits per coefficient.

    center: centre of the shells in the body's frame, metres, float32 [3].
    radius: radius of the body's bounding sphere, metres.
    resolutions: samples per axis of each shell, R_c, int32 [RADIANCE_SHELLS].
    codes: quantised vectors, shell after shell, rows (theta) before columns (phi), uint8 [samples, N, coefficients].
    minimum, step: coefficient = minimum + step * code, float32 [RADIANCE_SHELLS, N, coefficients].
    covered: share of the hemisphere towards the body that it covers, 0 to 1, at the samples of the shell
        `FIRST_OUTER_SHELL`, float32 [R_c * R_c]: it tells how fast light falls right outside the bounding sphere
        (see `CONTACT_POWER`).
    """

    center: np.ndarray
    radius: float
    resolutions: np.ndarray
    codes: np.ndarray
    minimum: np.ndarray
    step: np.ndarray
    covered: np.ndarray

    @property
    def functions(self) -> int:
        """The number of basis functions, N."""
        return self.codes.shape[1]

    @property
    def order(self) -> int:
        """The number of SH bands."""
        return sh.order_of(self.codes.shape[2])

    @property
    def nbytes(self) -> int:
        """What the samples and their quantisation constants take, bytes."""
        return self.codes.nbytes + self.minimum.nbytes + self.step.nbytes + self.covered.nbytes

    @property
    def shell_first(self) -> np.ndarray:
        """The index of each shell's first sample, int64 [RADIANCE_SHELLS]."""
        counts = self.resolutions.astype(np.int64) ** 2
        return np.cumsum(counts) - counts

    @property
    def shell_of_sample(self) -> np.ndarray:
        """The shell of each sample, int64 [samples]."""
        return np.repeat(np.arange(RADIANCE_SHELLS), self.resolutions.astype(np.int64) ** 2)

    def dequantised(self) -> np.ndarray:
        """The vectors as float32 [samples, N, coefficients]."""
        return self.minimum[self.shell_of_sample] + self.step[self.shell_of_sample] * self.codes

    def lookup(self, points_body: np.ndarray) -> np.ndarray:
        """The vectors at points of the body's frame [n, 3], metres, float64 [n, N, coefficients].

        The twin of what the device interpolates.
        """
        corners = find_corners(self.center, self.radius, self.resolutions, points_body)
        nearer, farther = corners.blend(self.dequantised().astype(np.float64))
        # Shells other than the first outer one have no covered shares, and `contact_weight` asks for none.
        index = np.clip(corners.samples[0] - self.shell_first[FIRST_OUTER_SHELL], 0, len(self.covered) - 1)
        weight = corners.contact_weight((corners.shares[0] * self.covered[index]).sum(axis=-1))[:, None, None]
        return corners.scale[:, None, None] * ((1 - weight) * nearer + weight * farther)


@cache
def make_radiance(order: int, functions: int) -> SimpleNamespace:
    """The device side of fields with `functions` basis functions on `order` bands.

    vec: an SH vector; weights: one number per function; rgb: three SH vectors, red before green before blue.
    RadianceTable: the fields of all bodies behind one another.
    Place: where a point stands in a field: eight samples and what each of them counts.
    locate(table, field, p_body) -> Place
    basis_irradiance(table, place, received: vec) -> weights: the integral of each function's radiance times `received`
    lookup_summed(summed: wp.array(dtype=rgb), first, place) -> rgb: the radiance of fields summed by `sum_fields`

    Raises:
        ValueError: `functions` is not one of `FUNCTION_COUNTS`.
    """
    if functions not in FUNCTION_COUNTS:
        known = ", ".join(map(str, FUNCTION_COUNTS))
        raise ValueError(f"there are no fields of {functions} basis functions; choose one of: {known}")
    vec = sh.make_sh(order).vec
    weights = wp.types.vector(functions, wp.float32)
    rgb = wp.types.vector(3 * order * order, wp.float32)

    @wp.struct
    class RadianceTable:
        codes: wp.array(dtype=wp.uint8)  # (sample * function * coefficient)
        minimum: wp.array(dtype=wp.float32)  # (field * shell * function * coefficient)
        step: wp.array(dtype=wp.float32)  # (field * shell * function * coefficient)
        shell_first: wp.array2d(dtype=wp.int32)  # (field, shell): index of the shell's first sample
        shell_resolution: wp.array2d(dtype=wp.int32)  # (field, shell)
        covered: wp.array(dtype=wp.float32)  # (sample of a first outer shell): covered share of its hemisphere
        covered_first: wp.array(dtype=wp.int32)  # (field): index of the field's first covered share
        center: wp.array(dtype=wp.vec3)  # (field), in the body's frame
        radius: wp.array(dtype=wp.float32)  # (field)

    @wp.struct
    class Place:
        near: wp.vec4i  # samples on the inner shell
        near_shares: wp.vec4  # all eight shares come to 1, or to the fall-off beyond the last shell
        far: wp.vec4i  # samples on the next shell
        far_shares: wp.vec4
        shell: wp.int32  # row of `minimum` and `step` for the inner shell: RADIANCE_SHELLS * field + shell

    @wp.func
    def locate(table: RadianceTable, field: int, p_body: wp.vec3) -> Place:
        """Where a point of the body's frame stands: bilinear on the two nearest shells, then between them."""
        offset = p_body - table.center[field]
        distance = wp.length(offset)
        theta, phi = angles_of(offset, distance)
        radius = distance / (table.radius[field] * wp.static(SHELL_SPACING))
        inner, weight = between_shells(radius, wp.static(RADIANCE_SHELLS))
        first = table.shell_first[field, inner]
        near, near_shares = nearest_four(first, table.shell_resolution[field, inner], theta, phi)
        far, far_shares = nearest_four(
            table.shell_first[field, inner + 1], table.shell_resolution[field, inner + 1], theta, phi
        )
        if inner == wp.static(FIRST_OUTER_SHELL):
            shift = table.covered_first[field] - first
            share = (
                near_shares[0] * table.covered[near[0] + shift]
                + near_shares[1] * table.covered[near[1] + shift]
                + near_shares[2] * table.covered[near[2] + shift]
                + near_shares[3] * table.covered[near[3] + shift]
            )
            weight = wp.pow(weight, 1.0 - wp.static(CONTACT_POWER) * share)
        last = float(wp.static(RADIANCE_SHELLS))
        beyond = last / wp.max(radius, last)
        scale = beyond * beyond
        place = Place()
        place.near = near
        place.near_shares = (scale * (1.0 - weight)) * near_shares
        place.far = far
        place.far_shares = (scale * weight) * far_shares
        place.shell = field * wp.static(RADIANCE_SHELLS) + inner
        return place

    @wp.func_native(_irradiance_snippet(order, functions))
    def blend_products(
        codes: wp.array(dtype=wp.uint8),
        minimum: wp.array(dtype=wp.float32),
        step: wp.array(dtype=wp.float32),
        shell: int,
        near: wp.vec4i,
        near_shares: wp.vec4,
        far: wp.vec4i,
        far_shares: wp.vec4,
        received: vec,
    ) -> weights:
        """For each function, the product of its blended vector and `received`."""

    @wp.func
    def basis_irradiance(table: RadianceTable, place: Place, received: vec) -> weights:
        """For each function, the integral over directions of its radiance at a place times the function `received`."""
        return blend_products(
            table.codes,
            table.minimum,
            table.step,
            place.shell,
            place.near,
            place.near_shares,
            place.far,
            place.far_shares,
            received,
        )

    @wp.func_native(_sum_snippet(order, functions))
    def sum_at_sample(
        codes: wp.array(dtype=wp.uint8),
        minimum: wp.array(dtype=wp.float32),
        step: wp.array(dtype=wp.float32),
        sample: int,
        shell: int,
        weight: wp.array3d(dtype=wp.vec3),
        world: int,
        entity: int,
    ) -> rgb:
        """The vectors of a sample, summed with an entity's weights for each colour channel."""

    @wp.kernel(enable_backward=False, module="unique")
    def sum_functions(
        first: int,
        table: RadianceTable,
        entity: wp.array(dtype=wp.int32),  # (entity sample)
        sample: wp.array(dtype=wp.int32),  # (entity sample): index into the table
        shell: wp.array(dtype=wp.int32),  # (entity sample): row of `minimum` and `step`
        weight: wp.array3d(dtype=wp.vec3),  # (world, entity, function)
        summed_out: wp.array2d(dtype=rgb),  # (world, entity sample)
    ):
        world, item = wp.tid()
        item += first
        summed_out[world, item] = sum_at_sample(
            table.codes, table.minimum, table.step, sample[item], shell[item], weight, world, entity[item]
        )

    @wp.func
    def lookup_summed(summed: wp.array(dtype=rgb), first: int, place: Place) -> rgb:
        """The summed radiance at a place; `first` turns indices of the table into those of `summed`."""
        total = place.near_shares[0] * summed[place.near[0] + first]
        total += place.near_shares[1] * summed[place.near[1] + first]
        total += place.near_shares[2] * summed[place.near[2] + first]
        total += place.near_shares[3] * summed[place.near[3] + first]
        total += place.far_shares[0] * summed[place.far[0] + first]
        total += place.far_shares[1] * summed[place.far[1] + first]
        total += place.far_shares[2] * summed[place.far[2] + first]
        total += place.far_shares[3] * summed[place.far[3] + first]
        return total

    return SimpleNamespace(
        order=order,
        functions=functions,
        vec=vec,
        weights=weights,
        rgb=rgb,
        RadianceTable=RadianceTable,
        Place=Place,
        locate=locate,
        basis_irradiance=basis_irradiance,
        sum_functions=sum_functions,
        lookup_summed=lookup_summed,
    )


def _irradiance_snippet(order: int, functions: int) -> str:
    """C++ that reads the eight samples of all functions once and multiplies them by `received`."""
    count = order * order
    # The products of a function are summed in pairs, which a CPU does side by side.
    width = 1 << (count - 1).bit_length()
    pointers = "\n".join(
        f"    const auto* {name}{k} = codes.data + (size_t){name}[{k}] * {functions * count};"
        for name in ("near", "far")
        for k in range(4)
    )
    sums = {name: " + ".join(f"{name}_shares[{k}] * (float){name}{k}[j]" for k in range(4)) for name in ("near", "far")}
    return f"""
{pointers}
    const float near_total = near_shares[0] + near_shares[1] + near_shares[2] + near_shares[3];
    const float far_total = far_shares[0] + far_shares[1] + far_shares[2] + far_shares[3];
    const float* minimum0 = minimum.data + (size_t)shell * {functions * count};
    const float* step0 = step.data + (size_t)shell * {functions * count};
    const float* minimum1 = minimum0 + {functions * count};
    const float* step1 = step0 + {functions * count};
    wp::vec_t<{functions}, float> totals;
    for (int i = 0; i < {functions}; ++i) {{
        float terms[{width}];
        for (int k = 0; k < {count}; ++k) {{
            const int j = i * {count} + k;
            terms[k] = received[k] * (near_total * minimum0[j] + step0[j] * ({sums["near"]})
                + far_total * minimum1[j] + step1[j] * ({sums["far"]}));
        }}
        for (int k = {count}; k < {width}; ++k) terms[k] = 0.0f;
        for (int half = {width // 2}; half > 0; half /= 2)
            for (int k = 0; k < half; ++k) terms[k] += terms[half + k];
        totals[i] = terms[0];
    }}
    return totals;
    """


def _sum_snippet(order: int, functions: int) -> str:
    """C++ that sums the vectors of one sample with the weights of the three colour channels."""
    count = order * order
    return f"""
    const auto* code = codes.data + (size_t)sample * {functions * count};
    const float* low = minimum.data + (size_t)shell * {functions * count};
    const float* unit = step.data + (size_t)shell * {functions * count};
    wp::vec_t<{3 * count}, float> sums;
    for (int i = 0; i < {functions}; ++i) {{
        const auto& w = wp::index(weight, world, entity, i);
        const float red = w[0], green = w[1], blue = w[2];
        for (int k = 0; k < {count}; ++k) {{
            const int j = i * {count} + k;
            const float value = low[j] + unit[j] * (float)code[j];
            sums[k] += red * value;
            sums[{count} + k] += green * value;
            sums[{2 * count} + k] += blue * value;
        }}
    }}
    return sums;
    """


def upload_radiance(fields: list[BasisRadianceField], order: int, functions: int, device: wp.Device):
    """A `RadianceTable` of `make_radiance(order, functions)` with the given fields, in order."""
    table = make_radiance(order, functions).RadianceTable()
    # Empty arrays first, so that no fields make an empty table.
    codes = [np.zeros(0, np.uint8), *(field.codes.ravel() for field in fields)]
    table.codes = wp.array(np.concatenate(codes), dtype=wp.uint8, device=device)
    for name in ("minimum", "step", "covered"):
        parts = [np.zeros(0, np.float32), *(getattr(field, name).ravel() for field in fields)]
        setattr(table, name, wp.array(np.concatenate(parts), dtype=wp.float32, device=device))
    firsts = [field.shell_first + start for field, start in zip(fields, _starts(fields), strict=True)]
    shell_first = np.array(firsts, np.int32).reshape(-1, RADIANCE_SHELLS)
    table.shell_first = wp.array(shell_first, dtype=wp.int32, ndim=2, device=device)
    resolutions = np.array([field.resolutions for field in fields], np.int32).reshape(-1, RADIANCE_SHELLS)
    table.shell_resolution = wp.array(resolutions, dtype=wp.int32, ndim=2, device=device)
    covered_first = np.cumsum([0, *(len(field.covered) for field in fields)])[:-1]
    table.covered_first = wp.array(covered_first.astype(np.int32), dtype=wp.int32, device=device)
    centers = np.array([field.center for field in fields], np.float32).reshape(-1, 3)
    table.center = wp.array(centers, dtype=wp.vec3, device=device)
    table.radius = wp.array([field.radius for field in fields], dtype=wp.float32, device=device)
    return table


@dataclass(frozen=True)
class SummedFields:
    """Fields summed with the weights of a frame, one per entity and world, and what it takes to sum them.

    kit: the `make_radiance` whose kernel sums and whose `lookup_summed` reads.
    summed: wp.array (world, entity sample) of kit.rgb, radiance.
    first: wp.array (entity) of int32: what `lookup_summed` adds to a sample's index in the table.
    entity, sample, shell: wp.array (entity sample) of int32, whose each sample is and where it lies in the table.
    """

    kit: SimpleNamespace
    summed: Any
    first: Any
    entity: Any
    sample: Any
    shell: Any


def make_summed(
    field_of_entity: list[int],
    fields: list[BasisRadianceField],
    order: int,
    functions: int,
    worlds: int,
    device: wp.Device,
) -> SummedFields:
    """Room for the summed fields of entities; those whose field is -1 take none."""
    kit = make_radiance(order, functions)
    starts = _starts(fields)
    none = np.zeros(0, np.int64)
    entities, samples, shells, first = [none], [none], [none], []
    total = 0
    for entity, field in enumerate(field_of_entity):
        first.append(total - starts[field] if field >= 0 else 0)
        if field >= 0:
            count = len(fields[field].codes)
            entities.append(np.full(count, entity))
            samples.append(starts[field] + np.arange(count))
            shells.append(field * RADIANCE_SHELLS + fields[field].shell_of_sample)
            total += count

    def upload(values) -> wp.array:
        return wp.array(np.asarray(values, np.int32), dtype=wp.int32, device=device)

    return SummedFields(
        kit=kit,
        summed=wp.zeros((worlds, total), dtype=kit.rgb, device=device),
        first=upload(first),
        entity=upload(np.concatenate(entities)),
        sample=upload(np.concatenate(samples)),
        shell=upload(np.concatenate(shells)),
    )


def sum_fields(summed: SummedFields, table, weights: wp.array, device: wp.Device) -> None:
    """Sums the functions of every entity with its weights, wp.array (world, entity, function) of vec3, radiance."""
    inputs = [table, summed.entity, summed.sample, summed.shell, weights]
    launch(summed.kit.sum_functions, summed.summed.shape, inputs, [summed.summed], device)


def _starts(fields: list[BasisRadianceField]) -> np.ndarray:
    """The index of each field's first sample in a table, int64 [fields]."""
    return np.cumsum([0, *(len(field.codes) for field in fields)])[:-1]
