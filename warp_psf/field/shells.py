"""Shadow fields: SH vectors at sample points on concentric shells around a body (Tamura 2006, sections 3 and 4).

A field holds one vector per sample. In an object occlusion field (OOF) it is the occlusion coefficient vector (OCV):
the part of the sphere of directions that the body covers, projected on SH. In a source radiance field (SRF) it is the
radiance coefficient vector (RCV): the same with each covered direction weighted by the radiance that leaves the body
towards the sample. The papers store visibility, 1 minus coverage; coverage holds the same numbers, falls to zero with
distance and so needs no special care beyond the last shell. So does the logarithm of visibility, which a log shadow
field holds.
"""

import math
from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace

import numpy as np
import warp as wp

from warp_psf.basis import sh, sh_exp, sphere

SHELL_COUNT = 32
# The radius of shell c is SHELL_SPACING * (1 + c) * (radius of the bounding sphere): Tamura 2006, section 6.
SHELL_SPACING = 0.2
FINEST_RESOLUTION = 64
# The smallest resolution of the paper's Table 1; below it the interpolation across the poles has too few azimuths.
COARSEST_RESOLUTION = 8
# From this shell on, samples lie outside the bounding sphere, and coverage falls with distance as 1/r^2.
FIRST_OUTER_SHELL = 4
# Right outside the bounding sphere, coverage falls faster where the body reaches the sphere: above the surface of a
# sphere it goes as the square root of the height, the power 1/2 of the weight, above empty space as the weight itself.
# In between, the power is 1 - CONTACT_POWER * (covered share of the hemisphere towards the body). Compared with ray
# casting between shells 4 and 5 of six bodies, the RMS error fell most for the roundest, and grew by a tenth nowhere.
CONTACT_POWER = 0.5
# The covered share of a hemisphere, from the first coefficient of its coverage.
HEMISPHERE_SHARE = math.sqrt(4 * math.pi) / (2 * math.pi)


def contact_share(order: int, logarithm: bool) -> float:
    """What the first coefficient of a coverage or of a logarithm is multiplied with for the share of a hemisphere."""
    return 1.0 / float(sh_exp.cap_logarithm(math.pi / 2, order)[0]) if logarithm else HEMISPHERE_SHARE


@dataclass(frozen=True)
class ShadowField:
    """One body's field, quantised to 8 bits per coefficient.

    center: centre of the shells in the body's frame, metres, float32 [3].
    radius: radius of the body's bounding sphere, metres.
    resolutions: samples per axis of each shell, R_c, int32 [SHELL_COUNT]; shell c has R_c x R_c samples.
    codes: quantised vectors, shell after shell, rows (theta) before columns (phi), uint8 [samples, coefficients].
    minimum, step: coefficient = minimum + step * code, float32 [SHELL_COUNT, coefficients].
    logarithm: whether the vectors are those of log_*(visibility) in place of coverage.
    """

    center: np.ndarray
    radius: float
    resolutions: np.ndarray
    codes: np.ndarray
    minimum: np.ndarray
    step: np.ndarray
    logarithm: bool = False

    @property
    def order(self) -> int:
        """The number of SH bands."""
        return sh.order_of(self.codes.shape[1])

    @property
    def nbytes(self) -> int:
        """What the samples and their quantisation constants take, bytes."""
        return self.codes.nbytes + self.minimum.nbytes + self.step.nbytes

    def dequantised(self) -> np.ndarray:
        """The vectors as float32 [samples, coefficients]."""
        shell = np.repeat(np.arange(SHELL_COUNT), self.resolutions.astype(np.int64) ** 2)
        return self.minimum[shell] + self.step[shell] * self.codes

    def lookup(self, points_body: np.ndarray) -> np.ndarray:
        """The vectors at points of the body's frame [N, 3], metres, float64 [N, coefficients]."""
        return lookup(self, points_body)


def shell_radii(radius: float) -> np.ndarray:
    """Radii of the shells around a body whose bounding sphere has `radius`, float64 [SHELL_COUNT]."""
    return SHELL_SPACING * radius * (1 + np.arange(SHELL_COUNT))


def sample_directions(resolution: int) -> np.ndarray:
    """Directions from the centre to the samples of a shell, float64 [resolution, resolution, 3].

    Row s lies at theta = pi (s + 1/2)/R from +z, column t at phi = 2 pi (t + 1/2)/R from +x.
    """
    theta = math.pi * (np.arange(resolution) + 0.5) / resolution
    phi = 2 * math.pi * (np.arange(resolution) + 0.5) / resolution
    sin_theta = np.sin(theta)[:, None]
    return np.stack(
        np.broadcast_arrays(sin_theta * np.cos(phi), sin_theta * np.sin(phi), np.cos(theta)[:, None]), axis=-1
    )


def quantise(center: np.ndarray, radius: float, shells: list[np.ndarray]) -> ShadowField:
    """Quantises shells [R_c, R_c, coefficients] to 8 bits, with a minimum and a step per shell and coefficient."""
    minimum = np.stack([shell.min(axis=(0, 1)) for shell in shells]).astype(np.float32)
    maximum = np.stack([shell.max(axis=(0, 1)) for shell in shells]).astype(np.float32)
    step = (maximum - minimum) / 255
    divisor = np.where(step > 0, step, 1)
    codes = [
        np.clip(np.rint((shell - minimum[c]) / divisor[c]), 0, 255).astype(np.uint8).reshape(-1, shell.shape[-1])
        for c, shell in enumerate(shells)
    ]
    return ShadowField(
        center=np.asarray(center, np.float32),
        radius=float(radius),
        resolutions=np.array([shell.shape[0] for shell in shells], np.int32),
        codes=np.concatenate(codes),
        minimum=minimum,
        step=step,
    )


@wp.func
def angles_of(offset: wp.vec3, distance: float):
    """The direction from the centre as theta, in half turns from +z, and phi, in turns from +x (-1/2 to 1/2)."""
    # From both legs of the angle, because acos has no digits left near the poles; the centre itself has no
    # direction, and any will do.
    level = wp.sqrt(offset[0] * offset[0] + offset[1] * offset[1])
    theta = sphere.angle_of(level, offset[2], distance) * wp.static(1.0 / math.pi)
    phi = sphere.angle_of(wp.abs(offset[1]), offset[0], level) * wp.static(0.5 / math.pi)
    return theta, wp.where(offset[1] < 0.0, -phi, phi)


@wp.func
def nearest_four(first: int, resolution: int, theta: float, phi: float):
    """The samples around a direction on a shell, and their bilinear shares."""
    # Continuous sample coordinates: sample (s, t) stands at s + 1/2, t + 1/2.
    row = theta * float(resolution) - 0.5
    column = phi * float(resolution) - 0.5
    row_below = int(wp.floor(row))
    column_below = int(wp.floor(column))
    u = row - float(row_below)
    v = column - float(column_below)
    mask = resolution - 1  # resolutions are powers of two: `& mask` wraps the azimuth, also of -1
    half = resolution / 2
    # A row beyond a pole is the same row seen from the other side: half a turn away in azimuth.
    base_0 = first + wp.max(row_below, 0) * resolution
    base_1 = first + wp.min(row_below + 1, mask) * resolution
    column_0 = column_below + wp.where(row_below < 0, half, 0)
    column_1 = column_below + wp.where(row_below + 1 > mask, half, 0)
    corners = wp.vec4i(
        base_0 + (column_0 & mask),
        base_0 + ((column_0 + 1) & mask),
        base_1 + (column_1 & mask),
        base_1 + ((column_1 + 1) & mask),
    )
    return corners, wp.vec4((1.0 - u) * (1.0 - v), (1.0 - u) * v, u * (1.0 - v), u * v)


@wp.func
def between_shells(radius: float, count: int):
    """The inner of the two shells around a radius, and the share of the outer one; `radius` in units of the spacing.

    In these units shell c has radius c + 1; `count` is the number of shells. What lies within the first shell or
    beyond the last is on it.
    """
    clamped = wp.clamp(radius, 1.0, float(count))
    inner = wp.min(int(clamped) - 1, count - 2)
    r_0 = float(inner + 1)
    weight = clamped - r_0
    if inner >= wp.static(FIRST_OUTER_SHELL):
        # Linear in 1/r^2, as solid angle falls: exact for what is far away.
        r_1 = r_0 + 1.0
        weight = (1.0 - (r_0 * r_0) / (clamped * clamped)) / (1.0 - (r_0 * r_0) / (r_1 * r_1))
    return inner, weight


@cache
def make_fields(order: int) -> SimpleNamespace:
    """The device side of fields with `order` bands: the struct `FieldTable` and the function `lookup_coverage`.

    `FieldTable` holds the fields of all bodies behind one another, in 8 bits as they are stored: eight samples of a
    body that is looked up then lie closer to a core than floats would.
    """
    vec = sh.make_sh(order).vec
    code = wp.types.vector(order * order, wp.uint8)

    @wp.struct
    class FieldTable:
        codes: wp.array(dtype=code)  # (sample)
        minimum: wp.array2d(dtype=vec)  # (field, shell): coefficient = minimum + step * code
        step: wp.array2d(dtype=vec)  # (field, shell)
        shell_first: wp.array2d(dtype=wp.int32)  # (field, shell): index of the shell's first sample
        shell_resolution: wp.array2d(dtype=wp.int32)  # (field, shell)
        center: wp.array(dtype=wp.vec3)  # (field), in the body's frame
        radius: wp.array(dtype=wp.float32)  # (field)
        contact_share: wp.float32  # see the function of that name

    @wp.func_native(_blend_snippet(order))
    def blend(
        codes: wp.array(dtype=code),
        minimum: wp.array(dtype=vec),
        step: wp.array(dtype=vec),
        shell: int,
        near: wp.vec4i,
        near_shares: wp.vec4,
        far: wp.vec4i,
        far_shares: wp.vec4,
    ) -> vec:
        """The sum of four samples of a shell and four of the next; `minimum` and `step` are those of the field."""

    @wp.func
    def lookup_coverage(tables: wp.array(dtype=FieldTable), which: int, field: int, p_body: wp.vec3) -> vec:
        """The vector at a point of the body's frame: bilinear on the two nearest shells, then between them.

        which: of the tables.
        """
        offset = p_body - tables[which].center[field]
        distance = wp.length(offset)
        theta, phi = angles_of(offset, distance)
        radius = distance / (tables[which].radius[field] * wp.static(SHELL_SPACING))
        last = float(wp.static(SHELL_COUNT))
        inner, weight = between_shells(radius, wp.static(SHELL_COUNT))
        near, near_shares = nearest_four(
            tables[which].shell_first[field, inner], tables[which].shell_resolution[field, inner], theta, phi
        )
        far, far_shares = nearest_four(
            tables[which].shell_first[field, inner + 1], tables[which].shell_resolution[field, inner + 1], theta, phi
        )
        if inner == wp.static(FIRST_OUTER_SHELL):
            constant = tables[which].minimum[field, inner][0] + tables[which].step[field, inner][0] * (
                near_shares[0] * float(tables[which].codes[near[0]][0])
                + near_shares[1] * float(tables[which].codes[near[1]][0])
                + near_shares[2] * float(tables[which].codes[near[2]][0])
                + near_shares[3] * float(tables[which].codes[near[3]][0])
            )
            share = wp.clamp(tables[which].contact_share * constant, 0.0, 1.0)
            weight = wp.pow(weight, 1.0 - wp.static(CONTACT_POWER) * share)
        beyond = last / wp.max(radius, last)
        scale = beyond * beyond
        return blend(
            tables[which].codes,
            tables[which].minimum[field],
            tables[which].step[field],
            inner,
            near,
            (scale * (1.0 - weight)) * near_shares,
            far,
            (scale * weight) * far_shares,
        )

    return SimpleNamespace(FieldTable=FieldTable, lookup_coverage=lookup_coverage, vec=vec, code=code)


def _blend_snippet(order: int) -> str:
    """C++ that reads the eight samples and sums them in one pass."""
    sums = {
        shell: " + ".join(f"{shell}_shares[{k}] * (float)codes.data[{shell}[{k}]][i]" for k in range(4))
        for shell in ("near", "far")
    }
    return f"""
    const float near_total = near_shares[0] + near_shares[1] + near_shares[2] + near_shares[3];
    const float far_total = far_shares[0] + far_shares[1] + far_shares[2] + far_shares[3];
    wp::vec_t<{order * order}, float> sum;
    for (int i = 0; i < {order * order}; ++i)
        sum[i] = near_total * minimum.data[shell][i] + step.data[shell][i] * ({sums["near"]})
            + far_total * minimum.data[shell + 1][i] + step.data[shell + 1][i] * ({sums["far"]});
    return sum;
    """


def upload_fields(fields: list[ShadowField], order: int, device: wp.Device):
    """A `FieldTable` of `make_fields(order)` with the given fields, in order: all of coverage, or all of logarithms."""
    kit = make_fields(order)
    table = kit.FieldTable()
    counts = [field.resolutions.astype(np.int64) ** 2 for field in fields]
    first = np.cumsum([0, *(count.sum() for count in counts)])[:-1]
    shell_first = np.array(
        [start + np.cumsum(count) - count for start, count in zip(first, counts, strict=True)], np.int32
    ).reshape(-1, SHELL_COUNT)
    coefficients = sh.coefficient_count(order)
    codes = np.concatenate([np.zeros((0, coefficients), np.uint8), *(field.codes for field in fields)])
    table.codes = wp.array(codes, dtype=kit.code, device=device)
    minimum = np.array([field.minimum for field in fields], np.float32).reshape(-1, SHELL_COUNT, coefficients)
    table.minimum = wp.array(minimum, dtype=kit.vec, ndim=2, device=device)
    steps = np.array([field.step for field in fields], np.float32).reshape(-1, SHELL_COUNT, coefficients)
    table.step = wp.array(steps, dtype=kit.vec, ndim=2, device=device)
    table.shell_first = wp.array(shell_first, dtype=wp.int32, ndim=2, device=device)
    resolutions = np.array([field.resolutions for field in fields], np.int32).reshape(-1, SHELL_COUNT)
    table.shell_resolution = wp.array(resolutions, dtype=wp.int32, ndim=2, device=device)
    centers = np.array([field.center for field in fields], np.float32).reshape(-1, 3)
    table.center = wp.array(centers, dtype=wp.vec3, device=device)
    table.radius = wp.array([field.radius for field in fields], dtype=wp.float32, device=device)
    table.contact_share = contact_share(order, any(field.logarithm for field in fields))
    return table


def lookup(field: ShadowField, points_body: np.ndarray) -> np.ndarray:
    """The vectors at points of the body's frame [N, 3], float64 [N, coefficients]: the twin of `lookup_coverage`."""
    corners = find_corners(field.center, field.radius, field.resolutions, points_body)
    samples = field.dequantised().astype(np.float64)
    nearer, farther = corners.blend(samples)
    weight = corners.contact_weight(contact_share(field.order, field.logarithm) * nearer[:, 0])[:, None]
    return corners.scale[:, None] * ((1 - weight) * nearer + weight * farther)


@dataclass(frozen=True)
class Corners:
    """The samples around points, for the lookups on the host.

    inner: the inner of the two shells around each point, int [N]; weight: the share of the outer one, before contact,
        float64 [N]; scale: the fall-off beyond the last shell, float64 [N].
    samples: four on the inner shell, four on the outer, int [2, N, 4]; shares: bilinear ones, float64 [2, N, 4].
    """

    inner: np.ndarray
    weight: np.ndarray
    scale: np.ndarray
    samples: np.ndarray
    shares: np.ndarray

    def blend(self, values: np.ndarray) -> np.ndarray:
        """Values of all samples [samples, ...] on the inner and on the outer shell, [2, N, ...]."""
        return np.einsum("snk,snk...->sn...", self.shares, values[self.samples])

    def contact_weight(self, share: np.ndarray) -> np.ndarray:
        """The share of the outer shell [N], with the power that `CONTACT_POWER` makes of the covered `share` [N]."""
        power = 1 - CONTACT_POWER * np.clip(share, 0, 1)
        return np.where(self.inner == FIRST_OUTER_SHELL, self.weight.clip(0) ** power, self.weight)


def find_corners(center: np.ndarray, radius: float, resolutions: np.ndarray, points_body: np.ndarray) -> Corners:
    """The samples around points of the body's frame [N, 3] in a field of `len(resolutions)` shells."""
    offset = np.asarray(points_body, np.float64) - center
    theta = np.arctan2(np.hypot(offset[:, 0], offset[:, 1]), offset[:, 2]) / math.pi
    phi = np.arctan2(offset[:, 1], offset[:, 0]) / (2 * math.pi)
    last = len(resolutions)
    radii = np.linalg.norm(offset, axis=-1) / (SHELL_SPACING * radius)
    clamped = np.clip(radii, 1, last)
    inner = np.minimum(clamped.astype(int) - 1, last - 2)
    r_0, r_1 = inner + 1.0, inner + 2.0
    outer_weight = (1 - (r_0 / clamped) ** 2) / (1 - (r_0 / r_1) ** 2)
    weight = np.where(inner >= FIRST_OUTER_SHELL, outer_weight, clamped - r_0)
    scale = (last / np.maximum(radii, last)) ** 2
    counts = resolutions.astype(np.int64) ** 2
    first = np.cumsum(counts) - counts

    def on_shell(shell: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        resolution = resolutions[shell].astype(np.int64)
        row, column = theta * resolution - 0.5, phi * resolution - 0.5
        row_below, column_below = np.floor(row).astype(int), np.floor(column).astype(int)
        samples, shares = [], []
        for step_row, step_column in ((0, 0), (0, 1), (1, 0), (1, 1)):
            s, t = row_below + step_row, column_below + step_column
            beyond_pole = (s < 0) | (s >= resolution)
            t = (t + np.where(beyond_pole, resolution // 2, 0)) % resolution
            samples.append(first[shell] + np.clip(s, 0, resolution - 1) * resolution + t)
            shares.append(np.abs(1 - step_row - (row - row_below)) * np.abs(1 - step_column - (column - column_below)))
        return np.stack(samples, axis=-1), np.stack(shares, axis=-1)

    (near, near_shares), (far, far_shares) = on_shell(inner), on_shell(inner + 1)
    return Corners(inner, weight, scale, np.stack([near, far]), np.stack([near_shares, far_shares]))
