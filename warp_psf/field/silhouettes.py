"""Silhouette fields: all-frequency shadow fields in a few bytes per sample.

At sample points on shells around a body, as in a shadow field (Tamura 2006, section 3), a map tells how far each
direction lies from the body's silhouette: above zero within it, below zero outside. Such distances vary smoothly with
the direction and with the sample, where visibility jumps: a map of 32 x 32 tells an edge to a fraction of its cell, and
between two samples an edge moves from one place to the other in place of fading (Wang 2009 keeps visibility so).

A map's axis points to the body's centre, and outside the bounding sphere its radius is a little more than that of the
sphere's disc. In these coordinates a body looks much the same from one sample and the next, and from one shell and the
next, so that few principal components hold all of its maps: a sample is their coefficients, in 8 bits each. A lookup
blends the coefficients of eight samples, once per receiver, and then asks for the distance in any number of directions.
"""

import math
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_psf.device import find_device, launch, upload_tables
from warp_psf.field.shells import FIRST_OUTER_SHELL, SHELL_COUNT, SHELL_SPACING, angles_of

# Cells per axis of a map. Finer ones did not bring edges closer to those that rays find.
MAP_SIZE = 32
# A map reaches this much further than the bounding sphere's disc, so that edges on the disc's rim have both sides.
MAP_MARGIN = 1.08
# The first component is the mean map, whose coefficient is 1.
COMPONENTS = 64
# Maps of samples within the bounding sphere are of all directions, those of others of its disc. Both have their own
# components; the shell on the sphere belongs to both.
WITHIN, BEYOND = 0, 1
# Distances beyond this many map radii from an edge are cut off, so that the components show edges and not what is far
# from them; wider, statues lost their arms.
LARGEST_DISTANCE = 0.12
# Cells per axis of a vertex's map of the hemisphere above it, and its radius: the sine of half a right angle.
OWN_SIZE = 16
OWN_SPREAD = math.sqrt(0.5)
# What is shorter than this has no direction.
_TINY = 1.0e-9

code = wp.types.vector(COMPONENTS, wp.uint8)
mode = wp.types.vector(COMPONENTS, wp.int8)
coefficients = wp.types.vector(COMPONENTS, wp.float32)


@dataclass(frozen=True)
class SilhouetteField:
    """One body's silhouettes.

    center: centre of the shells in the body's frame, metres, float32 [3]. radius: of the bounding sphere, metres.
    shells: for WITHIN and for BEYOND, which shells have samples: rising numbers, int32 [S].
    rows, columns: samples of each shell by theta and phi, powers of two, int32 [S].
    first_beyond: how many of the shells are those of WITHIN.
    codes: coefficients, shell after shell, rows before columns, uint8 [samples, COMPONENTS].
    minimum, step: a sample's coefficient is minimum + step * code, float32 [2, COMPONENTS].
    modes: the components' maps, int8 [2, MAP_SIZE^2, COMPONENTS]; distance in map radii = modes . coefficients.
    own: what the body hides from its own vertices, int8 [vertices, OWN_SIZE^2]: maps of the hemispheres about their
        normals, in 127ths of LARGEST_DISTANCE; None for convex bodies.
    """

    center: np.ndarray
    radius: float
    shells: np.ndarray
    rows: np.ndarray
    columns: np.ndarray
    first_beyond: int
    codes: np.ndarray
    minimum: np.ndarray
    step: np.ndarray
    modes: np.ndarray
    own: np.ndarray | None

    @property
    def nbytes(self) -> int:
        """What samples, components, constants and vertices take, bytes."""
        own = 0 if self.own is None else self.own.nbytes
        return self.codes.nbytes + self.modes.nbytes + self.minimum.nbytes + self.step.nbytes + own

    def distances(self, points_body: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Angles from directions to the silhouette seen from points, float64 [N], radians, above 0 where covered.

        points_body: [N, 3], metres; directions: unit vectors [N, 3]; both in the body's frame. The twin of
        `silhouette_distance`.
        """
        return _distances(self, np.asarray(points_body, np.float64), np.asarray(directions, np.float64))

    def hidden_share(self, points_body: np.ndarray, directions: np.ndarray, device: str | None = None) -> np.ndarray:
        """Which share of unit vectors [D, 3] the body hides from points [N, 3], metres, float32 [N]."""
        on_device = find_device(device)
        points, toward = (
            wp.array(np.asarray(vectors, np.float32), dtype=wp.vec3, device=on_device)
            for vectors in (points_body, directions)
        )
        shares = wp.zeros(len(points_body), dtype=wp.float32, device=on_device)
        tables = upload_silhouettes([self], on_device)
        launch(_count_hidden, (1, len(points_body)), [tables, points, toward], [shares], on_device)
        return shares.numpy()


@wp.struct
class SilhouetteTable:
    """The fields of all bodies behind one another."""

    codes: wp.array(dtype=code)  # (sample)
    minimum: wp.array2d(dtype=coefficients)  # (field, WITHIN or BEYOND)
    step: wp.array2d(dtype=coefficients)  # (field, WITHIN or BEYOND)
    modes: wp.array(dtype=mode)  # (field, WITHIN or BEYOND, row, column), flat
    inner: wp.array2d(dtype=wp.int32)  # (field, shell): the place of the nearest stored shell that is not larger
    shell: wp.array(dtype=wp.int32)  # (place): its number; the places of a field's shells stand behind one another
    first: wp.array(dtype=wp.int32)  # (place): its first sample
    rows: wp.array(dtype=wp.int32)  # (place)
    columns: wp.array(dtype=wp.int32)  # (place)
    center: wp.array(dtype=wp.vec3)  # (field), in the body's frame
    radius: wp.array(dtype=wp.float32)  # (field)
    own: wp.array2d(dtype=wp.int8)  # (vertex of a body that is not convex, cell)
    first_own: wp.array(dtype=wp.int32)  # (field): of its first vertex, -1 for convex bodies


SilhouetteTables = wp.array(dtype=SilhouetteTable)


@wp.struct
class Silhouette:
    """A body as it looks from one point."""

    coefficients: coefficients
    first_mode: wp.int32  # of the components that they belong to
    spread: wp.float32  # the sine of half the angle that is the map's radius
    frame: wp.mat33  # rows: the map's two axes and the direction to the centre, in the body's frame


def _blend_snippet() -> str:
    near, far = (
        " + ".join(f"{shell}_shares[{k}] * (float)codes.data[{shell}[{k}]][i]" for k in range(4))
        for shell in ("near", "far")
    )
    return f"""
    wp::vec_t<{COMPONENTS}, float> sum;
    for (int i = 0; i < {COMPONENTS}; ++i)
        sum[i] = minimum[i] + step[i] * ({near} + {far});
    return sum;
    """


def _dot_snippet() -> str:
    corners = " + ".join(f"shares[{k}] * (float)modes.data[texels[{k}]][i + lane]" for k in range(4))
    return f"""
    float sums[16];
    for (int lane = 0; lane < 16; ++lane) sums[lane] = 0.0f;
    for (int i = 0; i < {COMPONENTS}; i += 16)
        for (int lane = 0; lane < 16; ++lane) sums[lane] += c[i + lane] * ({corners});
    for (int width = 8; width > 0; width /= 2)
        for (int lane = 0; lane < width; ++lane) sums[lane] += sums[width + lane];
    return sums[0];
    """


@wp.func_native(_blend_snippet())
def _blend(
    codes: wp.array(dtype=code),
    minimum: coefficients,
    step: coefficients,
    near: wp.vec4i,
    near_shares: wp.vec4,
    far: wp.vec4i,
    far_shares: wp.vec4,
) -> coefficients:
    """The coefficients of eight samples, whose shares add up to 1."""


@wp.func_native(_dot_snippet())
def _sum_modes(c: coefficients, modes: wp.array(dtype=mode), texels: wp.vec4i, shares: wp.vec4) -> float:
    """The map with coefficients c between four of its cells."""


@wp.func
def half_sine(cosine: float) -> float:
    """The sine of half an angle."""
    return wp.sqrt(wp.max(0.5 - 0.5 * cosine, 0.0))


@wp.func
def map_spread(ratio: float) -> float:
    """The sine of half the angle that is a map's radius; ratio: distance over bounding radius, at least 1."""
    sine = 1.0 / wp.max(ratio, 1.0)
    return wp.static(MAP_MARGIN) * half_sine(wp.sqrt(wp.max(1.0 - sine * sine, 0.0)))


@wp.func
def _four_samples(first: int, rows: int, columns: int, theta: float, phi: float):
    # As `nearest_four`, but a sample beyond a pole has a map that is turned by half a turn: it is not asked, and the
    # row next to the pole reaches up to it.
    row = wp.clamp(theta * float(rows) - 0.5, 0.0, float(rows - 1))
    column = phi * float(columns) - 0.5
    above = wp.min(int(row), rows - 2)
    left = int(wp.floor(column))
    u = row - float(above)
    v = column - float(left)
    mask = columns - 1
    base = first + above * columns
    a = left & mask
    b = (left + 1) & mask
    corners = wp.vec4i(base + a, base + b, base + columns + a, base + columns + b)
    return corners, wp.vec4((1.0 - u) * (1.0 - v), (1.0 - u) * v, u * (1.0 - v), u * v)


@wp.func
def find_silhouette(tables: SilhouetteTables, field: int, p_body: wp.vec3) -> Silhouette:
    """How a body looks from a point of its frame."""
    seen = Silhouette()
    offset = p_body - tables[0].center[field]
    distance = wp.length(offset)
    theta, phi = angles_of(offset, distance)
    ratio = distance / tables[0].radius[field]
    radius = ratio * wp.static(1.0 / SHELL_SPACING)
    slot = wp.clamp(int(radius) - 1, 0, wp.static(SHELL_COUNT - 1))
    group = wp.where(ratio >= 1.0, wp.static(BEYOND), wp.static(WITHIN))
    if group == wp.static(WITHIN):
        slot = wp.min(slot, wp.static(FIRST_OUTER_SHELL - 1))
    seen.spread = wp.where(group == wp.static(BEYOND), map_spread(ratio), 1.0)
    place = tables[0].inner[field, slot]
    # Beyond, linear in the map's radius: far away that is 1/r, as parallax goes; next to the bounding sphere its square
    # root.
    r_0 = float(tables[0].shell[place] + 1)
    r_1 = float(tables[0].shell[place + 1] + 1)
    weight = wp.clamp((radius - r_0) / (r_1 - r_0), 0.0, 1.0)
    if group == wp.static(BEYOND):
        s_0 = map_spread(r_0 * wp.static(SHELL_SPACING))
        s_1 = map_spread(r_1 * wp.static(SHELL_SPACING))
        weight = wp.clamp((s_0 - seen.spread) / (s_0 - s_1), 0.0, 1.0)
    near, near_shares = _four_samples(
        tables[0].first[place], tables[0].rows[place], tables[0].columns[place], theta, phi
    )
    far, far_shares = _four_samples(
        tables[0].first[place + 1], tables[0].rows[place + 1], tables[0].columns[place + 1], theta, phi
    )
    seen.coefficients = _blend(
        tables[0].codes,
        tables[0].minimum[field, group],
        tables[0].step[field, group],
        near,
        (1.0 - weight) * near_shares,
        far,
        weight * far_shares,
    )
    seen.first_mode = (2 * field + group) * wp.static(MAP_SIZE * MAP_SIZE)
    toward = offset * (-1.0 / wp.max(distance, wp.static(_TINY)))
    level = wp.sqrt(toward[0] * toward[0] + toward[1] * toward[1])
    cos_phi = wp.where(level > wp.static(_TINY), -toward[0] / wp.max(level, wp.static(_TINY)), 1.0)
    sin_phi = wp.where(level > wp.static(_TINY), -toward[1] / wp.max(level, wp.static(_TINY)), 0.0)
    # The frame of `map_frames`: along rising theta, along rising phi, to the centre.
    seen.frame = wp.matrix_from_rows(
        wp.vec3(-toward[2] * cos_phi, -toward[2] * sin_phi, -level), wp.vec3(-sin_phi, cos_phi, 0.0), toward
    )
    return seen


@wp.func
def silhouette_distance(tables: SilhouetteTables, seen: Silhouette, direction: wp.vec3) -> float:
    """The angle from a direction of the body's frame to the silhouette, radians, above zero within it."""
    local = seen.frame * direction
    # Lambert's equal-area map about the centre: its radius is the sine of half the angle.
    onto = 1.0 / (wp.sqrt(wp.max(2.0 + 2.0 * local[2], 1.0e-6)) * seen.spread)
    u = local[0] * onto
    v = local[1] * onto
    # From the angle: straight away from the centre u and v have no digits.
    beyond = wp.max(half_sine(local[2]) / seen.spread - 1.0, 0.0)
    column = wp.clamp((0.5 * u + 0.5) * float(MAP_SIZE) - 0.5, 0.0, float(MAP_SIZE - 1))
    row = wp.clamp((0.5 * v + 0.5) * float(MAP_SIZE) - 0.5, 0.0, float(MAP_SIZE - 1))
    left = wp.min(int(column), MAP_SIZE - 2)
    above = wp.min(int(row), MAP_SIZE - 2)
    a = column - float(left)
    b = row - float(above)
    texel = seen.first_mode + above * MAP_SIZE + left
    texels = wp.vec4i(texel, texel + 1, texel + MAP_SIZE, texel + MAP_SIZE + 1)
    shares = wp.vec4((1.0 - a) * (1.0 - b), a * (1.0 - b), (1.0 - a) * b, a * b)
    distance = _sum_modes(seen.coefficients, tables[0].modes, texels, shares)
    # Beyond the map nothing is covered, whatever the components' errors say.
    distance = wp.where(beyond > 0.0, wp.min(distance, 0.0) - beyond, distance)
    return 2.0 * seen.spread * distance


@wp.func
def own_frame(normal: wp.vec3) -> wp.mat33:
    """The frame of the map of a vertex with that unit normal: two axes and the normal, as rows."""
    level = wp.sqrt(normal[0] * normal[0] + normal[1] * normal[1])
    # The frame of `map_frames` for a vertex that looks along its normal.
    cos_phi = wp.where(level > wp.static(_TINY), -normal[0] / wp.max(level, wp.static(_TINY)), 1.0)
    sin_phi = wp.where(level > wp.static(_TINY), -normal[1] / wp.max(level, wp.static(_TINY)), 0.0)
    return wp.matrix_from_rows(
        wp.vec3(-normal[2] * cos_phi, -normal[2] * sin_phi, -level), wp.vec3(-sin_phi, cos_phi, 0.0), normal
    )


@wp.func
def own_distance(tables: SilhouetteTables, vertex: int, local: wp.vec3) -> float:
    """The angle from a direction to what the body itself hides from a vertex, radians, above zero where it does.

    vertex: of those of `own`; local: the direction in the vertex's `own_frame`, above its horizon.
    """
    onto = wp.static(0.5 * OWN_SIZE / OWN_SPREAD) / wp.sqrt(wp.max(2.0 + 2.0 * local[2], 1.0e-6))
    column = wp.clamp(local[0] * onto + wp.static(0.5 * OWN_SIZE - 0.5), 0.0, float(OWN_SIZE - 1))
    row = wp.clamp(local[1] * onto + wp.static(0.5 * OWN_SIZE - 0.5), 0.0, float(OWN_SIZE - 1))
    left = wp.min(int(column), OWN_SIZE - 2)
    above = wp.min(int(row), OWN_SIZE - 2)
    a = column - float(left)
    b = row - float(above)
    cell = above * OWN_SIZE + left
    upper = (1.0 - a) * float(tables[0].own[vertex, cell]) + a * float(tables[0].own[vertex, cell + 1])
    cell += OWN_SIZE
    lower = (1.0 - a) * float(tables[0].own[vertex, cell]) + a * float(tables[0].own[vertex, cell + 1])
    return wp.static(2.0 * OWN_SPREAD * LARGEST_DISTANCE / 127.0) * ((1.0 - b) * upper + b * lower)


@wp.kernel(enable_backward=False, module="unique")
def _count_hidden(
    first: int,
    tables: SilhouetteTables,
    points: wp.array(dtype=wp.vec3),  # (point), in the body's frame
    directions: wp.array(dtype=wp.vec3),  # (direction)
    share_out: wp.array(dtype=wp.float32),  # (point)
):
    world, point = wp.tid()
    point += first
    seen = find_silhouette(tables, 0, points[point])
    hidden = float(0.0)
    for direction in range(directions.shape[0]):
        hidden += wp.where(silhouette_distance(tables, seen, directions[direction]) > 0.0, 1.0, 0.0)
    share_out[point] = hidden / float(directions.shape[0])


def map_frames(outward: np.ndarray) -> np.ndarray:
    """Per direction from the centre [N, 3] the map's axes and the direction to the centre, as rows, [N, 3, 3]."""
    outward = np.asarray(outward, np.float64)
    level = np.hypot(outward[:, 0], outward[:, 1])
    on_axis = level <= _TINY
    divisor = np.where(on_axis, 1.0, level)
    cos_phi, sin_phi = np.where(on_axis, 1.0, outward[:, 0] / divisor), outward[:, 1] / divisor * ~on_axis
    zero = np.zeros_like(level)
    along_theta = np.stack([outward[:, 2] * cos_phi, outward[:, 2] * sin_phi, -level], axis=-1)
    return np.stack([along_theta, np.stack([-sin_phi, cos_phi, zero], axis=-1), -outward], axis=1)


def upload_silhouettes(fields: list[SilhouetteField], device: wp.Device) -> wp.array:
    """The `SilhouetteTable` of fields, in order, as an array of one."""
    table = SilhouetteTable()
    codes = np.concatenate([np.zeros((0, COMPONENTS), np.uint8), *(field.codes for field in fields)])
    table.codes = wp.array(codes, dtype=code, device=device)
    modes = np.array([field.modes for field in fields], np.int8).reshape(-1, COMPONENTS)
    table.modes = wp.array(modes, dtype=mode, device=device)
    for name in ("minimum", "step"):
        values = np.array([getattr(field, name) for field in fields], np.float32).reshape(-1, 2, COMPONENTS)
        setattr(table, name, wp.array(values, dtype=coefficients, ndim=2, device=device))
    places, starts, inner = 0, 0, []
    first = []
    for field in fields:
        counts = field.rows.astype(np.int64) * field.columns
        first.append(starts + np.cumsum(counts) - counts)
        starts += int(counts.sum())
        inner.append(places + _inner_places(field))
        places += len(field.shells)

    def merged(parts: list[np.ndarray]) -> wp.array:
        return wp.array(np.concatenate([np.zeros(0, np.int32), *parts]).astype(np.int32), dtype=wp.int32, device=device)

    table.shell = merged([field.shells for field in fields])
    table.rows, table.columns = merged([field.rows for field in fields]), merged([field.columns for field in fields])
    table.first = merged(first)
    table.inner = wp.array(np.array(inner, np.int32).reshape(-1, SHELL_COUNT), dtype=wp.int32, ndim=2, device=device)
    centers = np.array([field.center for field in fields], np.float32).reshape(-1, 3)
    table.center = wp.array(centers, dtype=wp.vec3, device=device)
    table.radius = wp.array([field.radius for field in fields], dtype=wp.float32, device=device)
    own = [np.zeros((0, OWN_SIZE**2), np.int8) if field.own is None else field.own for field in fields]
    starts = np.cumsum([0, *(len(each) for each in own)])[:-1]
    first_own = np.where([field.own is None for field in fields], -1, starts).astype(np.int32)
    table.first_own = wp.array(first_own, dtype=wp.int32, device=device)
    merged_own = np.concatenate([np.zeros((0, OWN_SIZE**2), np.int8), *own])
    table.own = wp.array(merged_own, dtype=wp.int8, ndim=2, device=device)
    return upload_tables([table], SilhouetteTable, device)


def _inner_places(field: SilhouetteField) -> np.ndarray:
    """Per shell number the place, among a field's shells, of the stored one that is not larger, int [SHELL_COUNT]."""
    within, beyond = field.shells[: field.first_beyond], field.shells[field.first_beyond :]
    numbers = np.arange(SHELL_COUNT)
    inner = np.clip(np.searchsorted(within, numbers, side="right") - 1, 0, len(within) - 2)
    outer = np.clip(np.searchsorted(beyond, numbers, side="right") - 1, 0, len(beyond) - 2)
    return np.where(numbers < FIRST_OUTER_SHELL, inner, field.first_beyond + outer)


def _distances(field: SilhouetteField, points: np.ndarray, directions: np.ndarray) -> np.ndarray:
    offset = points - field.center
    distance = np.linalg.norm(offset, axis=-1)
    outward = offset / np.maximum(distance, _TINY)[:, None]
    ratio = distance / field.radius
    beyond = ratio >= 1.0
    radius = ratio / SHELL_SPACING
    slot = np.clip(radius.astype(int) - 1, 0, np.where(beyond, SHELL_COUNT - 1, FIRST_OUTER_SHELL - 1))
    place = _inner_places(field)[slot]
    r_0, r_1 = field.shells[place] + 1.0, field.shells[place + 1] + 1.0
    spread, s_0, s_1 = (spread_at(each * SHELL_SPACING) for each in (radius, r_0, r_1))
    weight = np.where(beyond, (s_0 - spread) / np.where(beyond, s_0 - s_1, 1), (radius - r_0) / (r_1 - r_0))
    weight = np.clip(weight, 0, 1)[:, None]
    group = beyond.astype(int)
    codes = (1 - weight) * _bilinear(field, place, outward) + weight * _bilinear(field, place + 1, outward)
    coefficients = field.minimum[group] + field.step[group] * codes
    local = np.einsum("nij,nj->ni", map_frames(outward), directions)
    spread = np.where(beyond, spread, 1.0)
    uv = local[:, :2] / (np.sqrt(np.maximum(2 + 2 * local[:, 2], 1e-6)) * spread)[:, None]
    cell = np.clip((0.5 * uv + 0.5) * MAP_SIZE - 0.5, 0, MAP_SIZE - 1)
    low = np.minimum(cell.astype(int), MAP_SIZE - 2)
    part = cell - low
    found = np.zeros(len(points))
    for row in (0, 1):
        for column in (0, 1):
            share = np.abs(1 - row - part[:, 1]) * np.abs(1 - column - part[:, 0])
            modes = field.modes[group, (low[:, 1] + row) * MAP_SIZE + low[:, 0] + column]
            found += share * np.einsum("nk,nk->n", modes, coefficients)
    outside = np.maximum(np.sqrt(np.maximum(0.5 - 0.5 * local[:, 2], 0)) / spread - 1, 0)
    return 2 * spread * np.where(outside > 0, np.minimum(found, 0) - outside, found)


def spread_at(ratio: np.ndarray) -> np.ndarray:
    """The twin of `map_spread`."""
    return MAP_MARGIN * np.sqrt(0.5 - 0.5 * np.sqrt(1 - 1 / np.maximum(ratio, 1) ** 2))


def _bilinear(field: SilhouetteField, place: np.ndarray, outward: np.ndarray) -> np.ndarray:
    """The codes of one shell per direction, between its four samples, float64 [N, COMPONENTS]."""
    counts = field.rows.astype(np.int64) * field.columns
    first, rows, columns = (np.cumsum(counts) - counts)[place], field.rows[place], field.columns[place]
    theta = np.arctan2(np.hypot(outward[:, 0], outward[:, 1]), outward[:, 2]) / math.pi
    row = np.clip(theta * rows - 0.5, 0, rows - 1)
    column = np.arctan2(outward[:, 1], outward[:, 0]) / (2 * math.pi) * columns - 0.5
    above, left = np.minimum(row.astype(int), rows - 2), np.floor(column).astype(int)
    u, v = (row - above)[:, None], (column - left)[:, None]
    base = first + above * columns
    upper, lower = (
        (1 - v) * field.codes[start + left % columns] + v * field.codes[start + (left + 1) % columns]
        for start in (base, base + columns)
    )
    return (1 - u) * upper + u * lower
