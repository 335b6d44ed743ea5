"""Silhouettes asked in sixteen directions at once, one in each lane of wide registers.

The same as `silhouette_distance` and the maps of a body's own vertices in each direction, but a compiler makes SIMD
code of it where the directions stand in rows behind one another.
"""

import warp as wp

from warp_psf.field.silhouettes import (
    COMPONENTS,
    LARGEST_DISTANCE,
    MAP_SIZE,
    OWN_SIZE,
    OWN_SPREAD,
    Silhouette,
    SilhouetteTables,
    coefficients,
    mode,
)

LANES = 16
lanes = wp.types.vector(LANES, wp.float32)
directions = wp.types.matrix(shape=(3, LANES), dtype=wp.float32)

# Lambert's equal-area map: local coordinates of a direction, times `onto`, lie in -1..1 within the map.
_LOCAL = f"""
    float column[{LANES}], row[{LANES}], depth[{LANES}];
    for (int k = 0; k < {LANES}; ++k) {{
        const float x = toward.data[0][k], y = toward.data[1][k], z = toward.data[2][k];
        const float u = frame.data[0][0] * x + frame.data[0][1] * y + frame.data[0][2] * z;
        const float v = frame.data[1][0] * x + frame.data[1][1] * y + frame.data[1][2] * z;
        depth[k] = frame.data[2][0] * x + frame.data[2][1] * y + frame.data[2][2] * z;
        const float wide = 2.0f + 2.0f * depth[k];
        const float onto = 1.0f / (sqrtf(wide > 1.0e-6f ? wide : 1.0e-6f) * spread);
        const float at_u = (0.5f * u * onto + 0.5f) * SIZE - 0.5f, at_v = (0.5f * v * onto + 0.5f) * SIZE - 0.5f;
        column[k] = at_u < 0.0f ? 0.0f : (at_u > SIZE - 1.0f ? SIZE - 1.0f : at_u);
        row[k] = at_v < 0.0f ? 0.0f : (at_v > SIZE - 1.0f ? SIZE - 1.0f : at_v);
    }}
"""

_CELL = """
        const int left = column[k] < SIZE - 2 ? (int)column[k] : SIZE - 2;
        const int above = row[k] < SIZE - 2 ? (int)row[k] : SIZE - 2;
        const float a = column[k] - (float)left, b = row[k] - (float)above;
        const float shares[4] = {(1.0f - a) * (1.0f - b), a * (1.0f - b), (1.0f - a) * b, a * b};
"""


def _distances_snippet() -> str:
    corners = " + ".join(
        f"shares[{2 * down + right}] * (float)modes.data[texel + {down * MAP_SIZE + right}][i + lane]"
        for down in (0, 1)
        for right in (0, 1)
    )
    body = f"""
    {_LOCAL}
    wp::vec_t<{LANES}, float> distance;
    for (int k = 0; k < {LANES}; ++k) {{
        {_CELL}
        const int texel = first_mode + above * {MAP_SIZE} + left;
        float sums[16];
        for (int lane = 0; lane < 16; ++lane) sums[lane] = 0.0f;
        for (int i = 0; i < {COMPONENTS}; i += 16)
            for (int lane = 0; lane < 16; ++lane) sums[lane] += c[i + lane] * ({corners});
        for (int width = 8; width > 0; width /= 2)
            for (int lane = 0; lane < width; ++lane) sums[lane] += sums[width + lane];
        distance[k] = sums[0];
    }}
    for (int k = 0; k < {LANES}; ++k) {{
        // Beyond the map nothing is covered, whatever the components' errors say.
        const float half = 0.5f - 0.5f * depth[k];
        const float beyond = sqrtf(half > 0.0f ? half : 0.0f) / spread - 1.0f;
        const float outside = (distance[k] < 0.0f ? distance[k] : 0.0f) - beyond;
        distance[k] = 2.0f * spread * (beyond > 0.0f ? outside : distance[k]);
    }}
    return distance;
    """
    return body.replace("SIZE", str(MAP_SIZE))


def _own_snippet() -> str:
    body = f"""
    const float spread = {OWN_SPREAD:.9g}f;
    {_LOCAL}
    wp::vec_t<{LANES}, float> distance;
    const signed char* map = (const signed char*)own.data + (long long)vertex * own.strides[0];
    for (int k = 0; k < {LANES}; ++k) {{
        {_CELL}
        const signed char* cell = map + above * {OWN_SIZE} + left;
        distance[k] = {2.0 * OWN_SPREAD * LARGEST_DISTANCE / 127.0:.9g}f *
            (shares[0] * (float)cell[0] + shares[1] * (float)cell[1]
            + shares[2] * (float)cell[{OWN_SIZE}] + shares[3] * (float)cell[{OWN_SIZE + 1}]);
    }}
    return distance;
    """
    return body.replace("SIZE", str(OWN_SIZE))


@wp.func_native(_distances_snippet())
def _distances(
    c: coefficients,
    frame: wp.mat33,
    spread: float,
    first_mode: int,
    modes: wp.array(dtype=mode),
    toward: directions,
) -> lanes: ...


@wp.func_native(_own_snippet())
def _own_distances(own: wp.array2d(dtype=wp.int8), vertex: int, frame: wp.mat33, toward: directions) -> lanes: ...


@wp.func
def silhouette_distances(tables: SilhouetteTables, seen: Silhouette, to_body: wp.mat33, toward: directions) -> lanes:
    """The angles from directions to a silhouette, radians, above zero within it. to_body: turns them into its frame."""
    frame = seen.frame * to_body
    return _distances(seen.coefficients, frame, seen.spread, seen.first_mode, tables[0].modes, toward)


@wp.func
def own_distances(tables: SilhouetteTables, vertex: int, frame: wp.mat33, toward: directions) -> lanes:
    """The angles from directions to what a body hides from one of its vertices, radians, above zero where it does.

    vertex: of those of `own`; frame: turns the directions, which are above its horizon, into that of its map.
    """
    return _own_distances(tables[0].own, vertex, frame, toward)
