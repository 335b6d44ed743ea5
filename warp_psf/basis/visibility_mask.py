"""The visibility mask: which directions above a point are blocked, as 32 x 32 bits over the disc onto which the
hemisphere is projected along its axis (Kautz 2004, section 3.1; Nusselt's analogue: area on the disc is solid angle
times cosine).

A spherical triangle is what lies above three planes through the point. What lies above each of many planes is kept in
a table, so that a triangle takes three fetches and two ANDs, and an OR joins it to others.

Basis functions are integrated over what is open. Blocks of 4 x 4 pixels that are wholly open or blocked count as one.
The paper averages the pixels of every block; next to the horizon, where a block spans 40 degrees of elevation, that
makes most of the error (3.0 % of the transfer in the folds of a sheet, on 25 coefficients), so that blocks which are
partly blocked count pixel by pixel here (0.7 %).
"""

from functools import cache
from types import SimpleNamespace

import numpy as np
import warp as wp

from warp_psf.basis import sh
from warp_psf.device import launch, upload_tables

# Pixels along the side of the square around the disc, and along that of a block.
SIDE = 32
BLOCK = 4
BLOCKS = (SIDE // BLOCK) ** 2
# The planes of the table have their normals through the cells of a cube map with so many along an edge: 12 MB.
CUBE_EDGE = 128
# The 16 bits of a block lie behind one another, four blocks in a word: counting them needs no shuffling.
WORD_BLOCKS = 4
WORDS = BLOCKS // WORD_BLOCKS
mask = wp.types.vector(WORDS, wp.uint64)
# Heights and azimuths of the quadrature by which basis functions are integrated over pixels, a hundred points to each.
# Of the whole hemisphere it is exact.
HEIGHTS, AZIMUTHS = 128, 1024


def pixel_places() -> tuple[np.ndarray, np.ndarray]:
    """Places of the pixels' centres in the square -1..1, float64 [1024, 2], in the order of their bits, and which of
    them lie in the disc, bool [1024]."""
    block, inner = np.divmod(np.arange(SIDE**2), BLOCK**2)
    row = block // (SIDE // BLOCK) * BLOCK + inner // BLOCK
    column = block % (SIDE // BLOCK) * BLOCK + inner % BLOCK
    places = (np.stack([column, row], axis=1) + 0.5) * 2.0 / SIDE - 1.0
    return places, (places**2).sum(axis=1) < 1.0


def pixel_directions() -> np.ndarray:
    """Unit directions of the pixels [1024, 3] about the axis +z; those outside of the disc lie on the horizon."""
    places, inside = pixel_places()
    squared = (places**2).sum(axis=1)
    flat = np.where(inside, 1.0, 1.0 / np.sqrt(squared))[:, None] * places
    return np.concatenate([flat, np.sqrt(np.maximum(1.0 - squared, 0.0))[:, None]], axis=1)


def plane_normals() -> np.ndarray:
    """Normals of the table's planes, float64 [6 * 128 * 128, 3], not of unit length.

    They go through the cells' centres on the cube's faces towards x, y and z; the second half are their opposites.
    """
    face, row, column = np.indices((3, CUBE_EDGE, CUBE_EDGE)).reshape(3, -1)
    normals, planes = np.ones((len(face), 3)), np.arange(len(face))
    normals[planes, (face + 1) % 3] = (column + 0.5) * 2.0 / CUBE_EDGE - 1.0
    normals[planes, (face + 2) % 3] = (row + 0.5) * 2.0 / CUBE_EDGE - 1.0
    return np.concatenate([normals, -normals])


@cache
def pixel_integrals(order: int) -> np.ndarray:
    """Integrals of the basis functions over each pixel's directions, float64 [1024, 2, order^2].

    First with the cosine to the axis, then without. Each direction belongs to the pixel in the disc that is nearest to
    where it projects to; pixels outside of the disc have none.
    """
    heights, weights = np.polynomial.legendre.leggauss(HEIGHTS)
    heights, weights = 0.5 * (heights + 1.0), np.pi / AZIMUTHS * weights
    # Half a step off the axes, on which pixels meet.
    azimuths = 2.0 * np.pi * (np.arange(AZIMUTHS) + 0.5) / AZIMUTHS
    level = np.sqrt(1.0 - heights**2)[:, None]
    parts = np.broadcast_arrays(level * np.cos(azimuths), level * np.sin(azimuths), heights[:, None])
    directions = np.stack(parts, axis=-1).reshape(-1, 3)
    functions = sh.evaluate(directions, order) * np.repeat(weights, AZIMUTHS)[:, None]
    both = np.concatenate([functions * directions[:, 2:], functions], axis=1)
    pixel = _pixel_of(directions[:, :2])
    integrals = np.stack([np.bincount(pixel, column, SIDE**2) for column in both.T], axis=1)
    return integrals.reshape(SIDE**2, 2, -1)


def _pixel_of(places: np.ndarray) -> np.ndarray:
    """The pixel in the disc nearest to each place [N, 2] in the disc, int [N]."""
    centers, inside = pixel_places()
    column, row = (np.minimum((places + 1.0) * (SIDE / 2), SIDE - 1).astype(int)).T
    pixel = (row // BLOCK * (SIDE // BLOCK) + column // BLOCK) * BLOCK**2 + row % BLOCK * BLOCK + column % BLOCK
    astray = np.flatnonzero(~inside[pixel])
    rim = np.flatnonzero(inside & ((centers**2).sum(axis=1) > 0.8))
    apart = ((places[astray, None] - centers[rim]) ** 2).sum(axis=2)
    pixel[astray] = rim[apart.argmin(axis=1)]
    return pixel


@wp.struct
class MaskTable:
    """What masks are made of, and integrated by."""

    planes: wp.array(dtype=mask)  # (1 + cell of the cube map): the pixels above the plane with this normal; 0: none
    inside: wp.array(dtype=wp.uint64)  # (word): the pixels in the disc
    # Integrals of the basis functions in the frame of the normal, a quarter turned; with the cosine, and without.
    pixels: wp.array(dtype=wp.float32)  # (pixel, 2, coefficient), flat
    blocks: wp.array(dtype=wp.float32)  # (block, 2, coefficient), flat
    turn: wp.array(dtype=wp.float32)  # rows of the matrix that turns functions back by that quarter, flat
    directions: wp.array(dtype=wp.vec3)  # (pixel)


MaskTables = wp.array(dtype=MaskTable)


@wp.func_native(f"""
    wp::vec_t<{WORDS}, uint64_t> above;
    for (int word = 0; word < {WORDS}; ++word) {{
        uint64_t bits = 0;
        for (int bit = 0; bit < 64; ++bit) {{
            const wp::vec3 place = pixels.data[64 * word + bit];
            bits |= (uint64_t)(normal[0] * place[0] + normal[1] * place[1] + normal[2] * place[2] > 0.0f) << bit;
        }}
        above[word] = bits & inside.data[word];
    }}
    return above;
""")
def find_above(normal: wp.vec3, pixels: wp.array(dtype=wp.vec3), inside: wp.array(dtype=wp.uint64)) -> mask: ...


@wp.func_native(f"""
    wp::vec_t<{WORDS}, uint64_t> rest;
    for (int word = 0; word < {WORDS}; ++word) rest[word] = inside.data[word] & ~covered[word];
    return rest;
""")
def find_rest(covered: mask, inside: wp.array(dtype=wp.uint64)) -> mask: ...


@wp.kernel(enable_backward=False, module="unique")
def _fill_planes(
    first: int,
    normals: wp.array(dtype=wp.vec3),
    pixels: wp.array(dtype=wp.vec3),
    inside: wp.array(dtype=wp.uint64),
    planes_out: wp.array(dtype=mask),
):
    _, plane = wp.tid()
    plane += first
    above = find_above(normals[plane], pixels, inside)
    planes_out[1 + plane] = above
    # What is not above a plane is above its opposite: triangles that share an edge leave no pixel between them.
    planes_out[1 + plane + normals.shape[0]] = find_rest(above, inside)


# Triangles are drawn in batches: their planes are found side by side, and fetched while others are drawn. The table is
# larger than a core's cache; waiting for one plane after the other would take two thirds of the time.
BATCH = 16
batch = wp.types.matrix((3, BATCH), wp.int32)


def plane_snippet(x: str, y: str, z: str, plane: str) -> str:
    """C++ that sets `plane` to where the table has the plane nearest to that with the normal x, y, z, of any length.

    Without branches, so that a compiler can do it for many normals side by side.
    """
    half, cells = f"{0.5 * CUBE_EDGE}f", CUBE_EDGE
    return f"""{{
        const float to_x = fabsf({x}), to_y = fabsf({y}), to_z = fabsf({z});
        const bool is_z = to_z > to_x && to_z > to_y, is_y = !is_z && to_y > to_x;
        const float along = is_z ? {z} : is_y ? {y} : {x};
        const float u = is_z ? {x} : is_y ? {z} : {y}, v = is_z ? {y} : is_y ? {x} : {z};
        // The same cell for a plane and its opposite.
        const float scale = {half} / (fabsf(along) > 1e-30f ? along : 1e-30f);
        int column = (int)(u * scale + {half}), row = (int)(v * scale + {half});
        column = column < 0 ? 0 : column > {cells - 1} ? {cells - 1} : column;
        row = row < 0 ? 0 : row > {cells - 1} ? {cells - 1} : row;
        const int face = (is_z ? 2 : is_y ? 1 : 0) + (along < 0.0f ? 3 : 0);
        {plane} = 1 + (face * {cells} + row) * {cells} + column;
    }}"""


@wp.func_native(f"""
    #if !defined(__CUDA_ARCH__)
    for (int place = 0; place < {3 * BATCH}; ++place) {{
        const char* plane = (const char*)&table.data[(&planes.data[0][0])[place]];
        __builtin_prefetch(plane);
        __builtin_prefetch(plane + 64);
    }}
    #endif
    wp::vec_t<{WORDS}, uint64_t> result = covered;
    for (int place = 0; place < {BATCH}; ++place) {{
        if (planes.data[0][place] == 0) continue;
        const uint64_t* a = &table.data[planes.data[0][place]][0];
        const uint64_t* b = &table.data[planes.data[1][place]][0];
        const uint64_t* c = &table.data[planes.data[2][place]][0];
        for (int word = 0; word < {WORDS}; ++word) result[word] |= a[word] & b[word] & c[word];
    }}
    return result;
""")
def cover(covered: mask, table: wp.array(dtype=mask), planes: batch) -> mask:
    """A mask together with a batch of triangles: what lies above three planes of the table each; 0 for none."""


@cache
def make_masks(order: int) -> SimpleNamespace:
    """Device functions that integrate masks against `order` bands: `open_transfer`, `open_lobe`, `blocked_vector`."""
    count = order * order
    pair = wp.types.matrix((2, count), wp.float32)
    vec = sh.make_sh(order).vec

    @wp.func_native(_transfer_snippet(order))
    def open_transfer(covered: mask, normal: wp.vec3, masks: MaskTables) -> pair:
        """Integrals over what is open of basis functions about the world's axes: with the cosine, and without."""

    @wp.func_native(_lobe_snippet(order))
    def open_lobe(covered: mask, normal: wp.vec3, mirrored: wp.vec3, exponent: float, masks: MaskTables) -> vec:
        """The same with the cosine and the normalised Phong lobe about a direction `mirrored`."""

    @wp.func_native(_blocked_snippet(order))
    def blocked_vector(covered: mask, normal: wp.vec3, masks: MaskTables) -> vec:
        """Integrals over what is blocked of basis functions about the world's axes: the coverage as an SH vector."""

    functions = {"open_transfer": open_transfer, "open_lobe": open_lobe, "blocked_vector": blocked_vector}
    return SimpleNamespace(vec=vec, pair=pair, **functions)


def upload_masks(order: int, device: wp.Device) -> wp.array:
    """The `MaskTable` of `order` bands on a device, as an array of one."""
    _, inside = pixel_places()
    directions = pixel_directions().astype(np.float32)
    planes = plane_normals()
    normals = wp.array(planes[: len(planes) // 2], dtype=wp.vec3, device=device)
    table = MaskTable()
    table.directions = wp.array(directions, dtype=wp.vec3, device=device)
    table.inside = wp.array(np.packbits(inside, bitorder="little").view("<u8"), dtype=wp.uint64, device=device)
    table.planes = wp.zeros(1 + len(planes), dtype=mask, device=device)
    inputs = [normals, table.directions, table.inside]
    launch(_fill_planes, (1, len(normals)), inputs, [table.planes], device)
    # Functions about a direction (theta, phi) are turned by theta about y, then by phi about z; a turn about y is one
    # about z between two quarters about x, the first of which is done here, once for all.
    quarter = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    turned = pixel_integrals(order) @ sh.rotation_matrix(quarter, order).T
    blocks = turned.reshape(BLOCKS, BLOCK**2, 2, -1).sum(axis=1)
    for name, values in (("pixels", turned), ("blocks", blocks), ("turn", sh.rotation_matrix(quarter.T, order))):
        setattr(table, name, wp.array(values.astype(np.float32).ravel(), dtype=wp.float32, device=device))
    return upload_tables([table], MaskTable, device)


def _sums_snippet(order: int, wanted: str, first: int, size: int) -> str:
    """C++: `sums` of integrals over the wanted pixels. Of each block those that are wanted, or all less the others,
    whichever are fewer.

    wanted: the word of their bits. first, size: which of the integrals of a pixel are summed, and how many.
    """
    stride = 2 * order * order
    return f"""
    const auto& table = masks.data[0];
    float sums[{size}] = {{}};
    for (int word = 0; word < {WORDS}; ++word) {{
        const uint64_t inside = table.inside.data[word], bits = {wanted};
        if (bits == 0) continue;
        for (int part = 0; part < {WORD_BLOCKS}; ++part) {{
            const uint64_t all = (inside >> (16 * part)) & 0xffff, chosen = (bits >> (16 * part)) & 0xffff;
            if (chosen == 0) continue;
            const int block = {WORD_BLOCKS} * word + part;
            const bool few = 2 * wp::bit_count(chosen) < wp::bit_count(all);
            const float sign = few ? 1.0f : -1.0f;
            if (!few) {{
                const float* values = table.blocks.data + {stride} * block + {first};
                for (int i = 0; i < {size}; ++i) sums[i] += values[i];
            }}
            for (uint64_t left = few ? chosen : all & ~chosen; left; left &= left - 1) {{
                const int pixel = 16 * block + wp::bit_count((left & -left) - 1);
                const float* values = table.pixels.data + {stride} * pixel + {first};
                for (int i = 0; i < {size}; ++i) sums[i] += sign * values[i];
            }}
        }}
    }}
    """


def _transfer_snippet(order: int) -> str:
    """C++: both integrals over the open pixels."""
    count = order * order
    return f"""
    {_sums_snippet(order, "inside & ~covered[word]", 0, 2 * count)}
    {_axes_snippet()}
    wp::mat_t<2, {count}, float> result;
    for (int row = 0; row < 2; ++row) {{
        float* v = sums + {count} * row;
        {_turn_snippet(order)}
        for (int i = 0; i < {count}; ++i) result.data[row][i] = v[i];
    }}
    return result;
    """


def _blocked_snippet(order: int) -> str:
    """C++: the integrals without the cosine over the blocked pixels."""
    count = order * order
    return f"""
    {_sums_snippet(order, "covered[word]", count, count)}
    {_axes_snippet()}
    float* v = sums;
    {_turn_snippet(order)}
    wp::vec_t<{count}, float> result;
    for (int i = 0; i < {count}; ++i) result[i] = v[i];
    return result;
    """


def _lobe_snippet(order: int) -> str:
    """C++: the open pixels, each times what the lobe is in its direction."""
    count = order * order
    return f"""
    const auto& table = masks.data[0];
    {_axes_snippet()}
    const float across = cos_phi * mirrored[0] + sin_phi * mirrored[1];
    const float x = cos_theta * across - sin_theta * mirrored[2], y = cos_phi * mirrored[1] - sin_phi * mirrored[0];
    const float z = sin_theta * across + cos_theta * mirrored[2];
    float v[{count}] = {{}};
    for (int word = 0; word < {WORDS}; ++word) {{
        for (uint64_t left = table.inside.data[word] & ~covered[word]; left; left &= left - 1) {{
            const int pixel = 64 * word + wp::bit_count((left & -left) - 1);
            const wp::vec3 along = table.directions.data[pixel];
            const float cosine = x * along[0] + y * along[1] + z * along[2];
            if (cosine <= 0.0f) continue;
            const float lobe = {0.5 / np.pi:.9e}f * (exponent + 2.0f) * powf(cosine, exponent);
            const float* values = table.pixels.data + {2 * count} * pixel;
            for (int i = 0; i < {count}; ++i) v[i] += lobe * values[i];
        }}
    }}
    {_turn_snippet(order)}
    wp::vec_t<{count}, float> result;
    for (int i = 0; i < {count}; ++i) result[i] = v[i];
    return result;
    """


def _axes_snippet() -> str:
    """C++: the angles of the normal. A frame's other axes lie along growing theta and phi."""
    return """
    const float sin_theta = sqrtf(normal[0] * normal[0] + normal[1] * normal[1]), cos_theta = normal[2];
    const float cos_phi = sin_theta > 1e-6f ? normal[0] / sin_theta : 1.0f;
    const float sin_phi = sin_theta > 1e-6f ? normal[1] / sin_theta : 0.0f;
    """


def _turn_snippet(order: int) -> str:
    """C++: a vector v, turned by theta about z, by a quarter about x, and by phi about z."""
    count = order * order
    return f"""
    for (int about = 0; about < 2; ++about) {{
        const float c_1 = about ? cos_phi : cos_theta, s_1 = about ? sin_phi : sin_theta;
        float c = 1.0f, s = 0.0f;
        for (int m = 1; m < {order}; ++m) {{
            const float c_before = c;
            c = c * c_1 - s * s_1;
            s = s * c_1 + c_before * s_1;
            for (int l = m; l < {order}; ++l) {{
                const float even = v[l * l + l + m], odd = v[l * l + l - m];
                v[l * l + l + m] = c * even - s * odd;
                v[l * l + l - m] = s * even + c * odd;
            }}
        }}
        if (about == 1) break;
        float u[{count}];
        for (int l = 0; l < {order}; ++l)
            for (int i = l * l; i < (l + 1) * (l + 1); ++i) {{
                u[i] = 0.0f;
                for (int j = l * l; j < (l + 1) * (l + 1); ++j) u[i] += table.turn.data[{count} * i + j] * v[j];
            }}
        for (int i = 0; i < {count}; ++i) v[i] = u[i];
    }}
    """
