"""What a point receives from the faces of slabs: coverage in closed form, and the radiance of texels by direction."""

import math
from functools import cache
from types import SimpleNamespace

import warp as wp

from warp_psf.shade.coverage import make_coverage
from warp_psf.shade.patches import PatchTables

# A point closer to a face than this share of the slab's half-diagonal sees it from this height: bodies that touch it
# sink in a little, and from the plane itself a face is not seen.
LOWEST_HEIGHT = 1.0e-4
# The radiance is filtered over this share of the solid angle that a direction stands for: all of it would wash out
# contact shadows, and with little of it, patches of shadow that a direction meets would show on walls as blotches.
SAMPLE_SHARE = 0.4
# How far within the rim of a face its light is looked up at least, as the tangent of an angle. Band-limited, the face
# reaches over its rim, and inside there is less than all of it: what counts there is the light of what lies within.
RIM = 0.1


@cache
def make_faces(order: int) -> SimpleNamespace:
    """Device functions of faces for the directions of `order` bands: who sees them, their coverage and radiance."""
    kit = make_coverage(order)
    values, half_values, rgb_values = kit.values, kit.half_values, kit.rgb_values

    @wp.func_native(_radiance_snippet(kit.points))
    def look_up_directions(
        p: wp.vec3,
        n: wp.vec3,
        to_face: wp.mat33,
        half: wp.vec3,
        size: wp.vec2i,
        focus: wp.vec4,
        first: int,
        levels: int,
        texels: wp.array(dtype=wp.vec4),
        quadrature: wp.array(dtype=half_values),
    ) -> rgb_values: ...

    @wp.func
    def sees_face(world: int, face: int, p_slab: wp.vec3, patches: PatchTables) -> bool:
        """Whether a point of the slab's frame lies before a face, or touches it, and the face sends out light."""
        half = patches[0].half[face]
        height = patches[0].side[face] * p_slab[patches[0].axis[face]] - half[2]
        return patches[0].seen[world, face] == 1 and height > -wp.static(LOWEST_HEIGHT) * wp.length(half)

    @wp.func
    def face_coverage(
        world: int,
        face: int,
        p_slab: wp.vec3,
        to_slab: wp.mat33,
        patches: PatchTables,
        quadrature: wp.array(dtype=half_values),
    ) -> values:
        """The directions that a face covers around a point of the slab's frame; to_slab: slab_from_world."""
        axis = patches[0].axis[face]
        side = patches[0].side[face]
        half = patches[0].half[face]
        height = side * p_slab[axis] - half[2]
        part = patches[0].part[world, face]
        u = (axis + 1) % 3
        v = (axis + 2) % 3
        p = wp.vec3()
        p[u] = p_slab[u] - part[0]
        p[v] = p_slab[v] - part[2]
        p[axis] = side * wp.max(height, wp.static(LOWEST_HEIGHT) * wp.length(half))
        flat = wp.vec3()
        flat[u] = part[1]
        flat[v] = part[3]
        return kit.slab_coverage(p, flat, wp.transpose(to_slab), quadrature)

    @wp.func
    def face_radiance(
        world: int,
        face: int,
        p_slab: wp.vec3,
        n: wp.vec3,
        to_slab: wp.mat33,
        patches: PatchTables,
        quadrature: wp.array(dtype=half_values),
    ) -> rgb_values:
        """The radiance of a face in every direction from a point of the slab's frame, with normal n in the world.

        to_slab: slab_from_world.
        """
        axis = patches[0].axis[face]
        side = patches[0].side[face]
        half = patches[0].half[face]
        u = (axis + 1) % 3
        v = (axis + 2) % 3
        to_face = wp.matrix_from_rows(to_slab[u], to_slab[v], side * to_slab[axis])
        lowest = wp.static(LOWEST_HEIGHT) * wp.length(half)
        part = patches[0].part[world, face]
        p = wp.vec3(p_slab[u] - part[0], p_slab[v] - part[2], wp.max(side * p_slab[axis] - half[2], lowest))
        focus = patches[0].focus[world, face]
        size = patches[0].size[face]
        return look_up_directions(
            p,
            n,
            to_face,
            wp.vec3(wp.max(part[1], 1.0e-9), wp.max(part[3], 1.0e-9), 0.0),
            size,
            focus,
            patches[0].first[face],
            patches[0].levels[face],
            patches[0].radiance[world],
            quadrature,
        )

    return SimpleNamespace(sees_face=sees_face, face_coverage=face_coverage, face_radiance=face_radiance)


def _radiance_snippet(points: int) -> str:
    """C++: where each direction meets the face, then what the pyramid holds there.

    Directions that do not meet the face's plane see none of it but for the ringing of its band-limited coverage, and
    get the mean of the others; those that pass by the face, or meet it near its rim, get what lies `RIM` within. From
    below the receiver's horizon nothing is received but for the ringing of its band-limited cosine, which is to ring
    with the radiance above the horizon: such directions are mirrored.
    """
    half = points // 2
    # From the height h, at the distance t, a solid angle covers t^3 / h times as much of the face.
    solid_angle = SAMPLE_SHARE * 4 * math.pi / points
    return f"""
    // From where to where light is looked up along a side: its ends are turned inwards by an angle, as seen from a
    // distance `away`, or meet in the middle of the angle between them.
    const auto within = [](float low, float high, float at, float away, float& least, float& most) {{
        const float tan_low = (low - at) / away, tan_high = (high - at) / away;
        const float low_cut = 1.0f - tan_low * {RIM}f, high_cut = 1.0f + tan_high * {RIM}f;
        least = at + away * (tan_low + {RIM}f) / low_cut;
        most = at + away * (tan_high - {RIM}f) / high_cut;
        if (low_cut <= 0.0f || high_cut <= 0.0f || least > most) {{
            const float cos_low = 1.0f / ::sqrtf(1.0f + tan_low * tan_low);
            const float cos_high = 1.0f / ::sqrtf(1.0f + tan_high * tan_high);
            least = most = at + away * (tan_low * cos_low + tan_high * cos_high) / (cos_low + cos_high);
        }}
    }};
    const float low_u = -(half[0] + focus[0]) / (focus[1] + ::fabsf(half[0] + focus[0]));
    const float low_v = -(half[1] + focus[2]) / (focus[3] + ::fabsf(half[1] + focus[2]));
    const float scale_u = 1.0f / ((half[0] - focus[0]) / (focus[1] + ::fabsf(half[0] - focus[0])) - low_u);
    const float scale_v = 1.0f / ((half[1] - focus[2]) / (focus[3] + ::fabsf(half[1] - focus[2])) - low_v);
    const float texels_per_area = focus[1] * scale_u * size[0] * focus[3] * scale_v * size[1];
    // The receiver's normal, about the axes of the face.
    const float nu = to_face.data[0][0] * n[0] + to_face.data[0][1] * n[1] + to_face.data[0][2] * n[2];
    const float nv = to_face.data[1][0] * n[0] + to_face.data[1][1] * n[1] + to_face.data[1][2] * n[2];
    const float nn = to_face.data[2][0] * n[0] + to_face.data[2][1] * n[1] + to_face.data[2][2] * n[2];
    const float beyond_u = p[0] < 0.0f ? -p[0] - half[0] : p[0] - half[0];
    const float beyond_v = p[1] < 0.0f ? -p[1] - half[1] : p[1] - half[1];
    const float aside_u = beyond_u > 0.0f ? beyond_u : 0.0f, aside_v = beyond_v > 0.0f ? beyond_v : 0.0f;
    float least_u, most_u, least_v, most_v;
    within(-half[0], half[0], p[0], ::sqrtf(p[2] * p[2] + aside_v * aside_v), least_u, most_u);
    within(-half[1], half[1], p[1], ::sqrtf(p[2] * p[2] + aside_u * aside_u), least_v, most_v);
    float place_u[{points}], place_v[{points}], level_at[{points}];
    for (int i = 0; i < {points}; ++i) {{
        const int j = i < {half} ? i : i - {half};
        const float sign = i < {half} ? 1.0f : -1.0f;
        const float x = sign * quadrature.data[0][j], y = sign * quadrature.data[1][j];
        const float z = sign * quadrature.data[2][j];
        float du = to_face.data[0][0] * x + to_face.data[0][1] * y + to_face.data[0][2] * z;
        float dv = to_face.data[1][0] * x + to_face.data[1][1] * y + to_face.data[1][2] * z;
        float dn = to_face.data[2][0] * x + to_face.data[2][1] * y + to_face.data[2][2] * z;
        const float ahead = du * nu + dv * nv + dn * nn, back = ahead < 0.0f ? 2.0f * ahead : 0.0f;
        du -= back * nu;
        dv -= back * nv;
        dn -= back * nn;
        const float steep = dn < 0.0f ? -dn : 0.0f;
        const float cosine = steep > 1.0e-3f ? steep : 1.0e-3f;
        const float t = p[2] / cosine;
        float u = p[0] + t * du, v = p[1] + t * dv;
        u = u < least_u ? least_u : (u > most_u ? most_u : u);
        v = v < least_v ? least_v : (v > most_v ? most_v : v);
        const float squared = (u - p[0]) * (u - p[0]) + (v - p[1]) * (v - p[1]) + p[2] * p[2];
        const float off_u = u - focus[0], off_v = v - focus[2];
        const float near_u = 1.0f / (focus[1] + (off_u < 0.0f ? -off_u : off_u));
        const float near_v = 1.0f / (focus[3] + (off_v < 0.0f ? -off_v : off_v));
        const float squeezed = texels_per_area * near_u * near_u * near_v * near_v;
        const float covered = {solid_angle:.9e}f * squared * ::sqrtf(squared) / p[2] * squeezed;
        place_u[i] = (off_u * near_u - low_u) * scale_u;
        place_v[i] = (off_v * near_v - low_v) * scale_v;
        // Half the binary logarithm of the texels covered, its fraction taken as linear.
        union {{ float number; int bits; }} both;
        both.number = covered < 1.0f ? 1.0f : covered;
        level_at[i] = dn < 0.0f ? 0.5f * ((float)(both.bits - 0x3f800000) * {2.0**-23:.9e}f) : -1.0f;
    }}
    int starts[16];
    starts[0] = first;
    for (int level = 1; level < levels; ++level) {{
        const int width = size[0] >> (level - 1), height = size[1] >> (level - 1);
        starts[level] = starts[level - 1] + (width > 1 ? width : 1) * (height > 1 ? height : 1);
    }}
    wp::vec_t<{3 * points}, float> all;
    float mean[3] = {{0.0f, 0.0f, 0.0f}}, met = 0.0f;
    for (int i = 0; i < {points}; ++i) {{
        if (level_at[i] < 0.0f) continue;
        const float last = (float)(levels - 1), wanted = level_at[i] < last ? level_at[i] : last;
        const int fine = (int)wanted;
        const float share = wanted - (float)fine;
        float sum[4] = {{0.0f, 0.0f, 0.0f, 0.0f}};
        for (int step = 0; step < 2; ++step) {{
            const float weight = step ? share : 1.0f - share;
            if (weight <= 0.0f) continue;
            const int level = fine + step;
            const int halved_width = size[0] >> level, halved_height = size[1] >> level;
            const int width = halved_width > 1 ? halved_width : 1, height = halved_height > 1 ? halved_height : 1;
            float column = place_u[i] * (float)width - 0.5f, row = place_v[i] * (float)height - 0.5f;
            column = column < 0.0f ? 0.0f : (column > (float)(width - 1) ? (float)(width - 1) : column);
            row = row < 0.0f ? 0.0f : (row > (float)(height - 1) ? (float)(height - 1) : row);
            const int left = (int)column, top = (int)row;
            const int right = left + 1 < width ? left + 1 : left, below = top + 1 < height ? top + 1 : top;
            const float a = column - (float)left, b = row - (float)top;
            const auto* texel = texels.data + starts[level];
            for (int c = 0; c < 4; ++c)
                sum[c] += weight * ((1.0f - b) * ((1.0f - a) * texel[top * width + left][c]
                    + a * texel[top * width + right][c]) + b * ((1.0f - a) * texel[below * width + left][c]
                    + a * texel[below * width + right][c]));
        }}
        for (int c = 0; c < 3; ++c) {{ all[c * {points} + i] = sum[c]; mean[c] += sum[c]; }}
        met += 1.0f;
    }}
    for (int c = 0; c < 3; ++c) {{
        const float rest = mean[c] / (met > 0.0f ? met : 1.0f);
        for (int i = 0; i < {points}; ++i) if (level_at[i] < 0.0f) all[c * {points} + i] = rest;
    }}
    return all;
    """
