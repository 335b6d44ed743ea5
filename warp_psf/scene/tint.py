"""What textures multiply colours with, at points of surfaces: filtered over a footprint, on the device."""

import math

import numpy as np
import warp as wp

from warp_psf.scene.geometry import GeometryTables
from warp_psf.scene.scene import Scene
from warp_psf.scene.texture import DECODED, LINEAR, Texture, Wrap, decode, encode, halve

# A footprint longer than wide is filtered by several lookups along it, at most so many.
MOST_LOOKUPS = 12
# Coordinates beyond so many images tell no pixels apart in float32; files may hold such numbers, and NaN.
FARTHEST = 1.0e6
# A point this near the ends of a cylinder's unit height, with a normal along its axis, lies on an end.
END_NORMAL = 0.7


@wp.struct
class TextureTable:
    """Textures as pyramids of images, each half as large as the one before, and how they lie on the parts."""

    texture: wp.array(dtype=wp.int32)  # (part): -1 for none
    wrap: wp.array(dtype=wp.int32)  # (part)
    scale: wp.array(dtype=wp.vec2)  # (part)
    offset: wp.array(dtype=wp.vec2)  # (part)
    size: wp.array(dtype=wp.vec3)  # (part)
    stretch: wp.array(dtype=wp.vec3)  # (part)
    position: wp.array(dtype=wp.vec3)  # (part): of its frame in the entity's
    rotation: wp.array(dtype=wp.mat33)  # (part): entity_from_part
    first_coordinate: wp.array(dtype=wp.int32)  # (entity): its first face in `coordinates`, -1 for none
    coordinates: wp.array2d(dtype=wp.vec2)  # (face of an entity with coordinates of its own, corner)
    first_level: wp.array(dtype=wp.int32)  # (texture)
    levels: wp.array(dtype=wp.int32)  # (texture)
    srgb: wp.array(dtype=wp.int32)  # (texture): 1 where bytes are sRGB
    first_texel: wp.array(dtype=wp.int32)  # (level)
    extent: wp.array(dtype=wp.vec2i)  # (level): columns and rows of a side
    texels: wp.array(dtype=wp.uint32)  # red, green and blue from the lowest byte on
    decoded: wp.array2d(dtype=wp.float32)  # (srgb, byte): linear colour


@wp.func
def cube_side(d: wp.vec3) -> int:
    """The side of a cube map that a direction falls on."""
    x = wp.abs(d[0])
    y = wp.abs(d[1])
    z = wp.abs(d[2])
    if x >= y and x >= z:
        return wp.where(d[0] < 0.0, 1, 0)
    if y >= z:
        return wp.where(d[1] < 0.0, 3, 2)
    return wp.where(d[2] < 0.0, 5, 4)


@wp.func
def on_side(d: wp.vec3, side: int) -> wp.vec2:
    """Where a direction meets the plane of a side, in the side's coordinates."""
    across = d[0]
    down = -d[1]
    major = wp.abs(d[2])
    if side == 0:
        across = -d[2]
        major = wp.abs(d[0])
    elif side == 1:
        across = d[2]
        major = wp.abs(d[0])
    elif side == 2:
        down = d[2]
        major = wp.abs(d[1])
    elif side == 3:
        down = -d[2]
        major = wp.abs(d[1])
    elif side == 5:
        across = -d[0]
    major = wp.max(major, 1.0e-12)
    return wp.vec2(0.5 * (across / major + 1.0), 0.5 * (down / major + 1.0))


@wp.func
def off_side(side: int, s: float, t: float) -> wp.vec3:
    """The direction of a place on the plane of a side, which may lie beyond the side."""
    across = 2.0 * s - 1.0
    down = 2.0 * t - 1.0
    if side == 0:
        return wp.vec3(1.0, -down, -across)
    if side == 1:
        return wp.vec3(-1.0, -down, across)
    if side == 2:
        return wp.vec3(across, 1.0, down)
    if side == 3:
        return wp.vec3(across, -1.0, -down)
    if side == 4:
        return wp.vec3(across, -down, 1.0)
    return wp.vec3(-across, -down, -1.0)


@wp.func
def texel(table: TextureTable, at: int, srgb: int) -> wp.vec3:
    """One linear colour."""
    packed = table.texels[at]
    return wp.vec3(
        table.decoded[srgb, int(packed & wp.uint32(255))],
        table.decoded[srgb, int((packed >> wp.uint32(8)) & wp.uint32(255))],
        table.decoded[srgb, int((packed >> wp.uint32(16)) & wp.uint32(255))],
    )


@wp.func
def beyond_side(first: int, extent: wp.vec2i, side: int, column: int, row: int) -> int:
    """The texel of a cube at a place of a side's grid that may lie beyond it, on its neighbour."""
    s = (float(column) + 0.5) / float(extent[0])
    t = (float(row) + 0.5) / float(extent[1])
    d = off_side(side, s, t)
    on = cube_side(d)
    place = on_side(d, on)
    x = wp.clamp(int(place[0] * float(extent[0])), 0, extent[0] - 1)
    y = wp.clamp(int(place[1] * float(extent[1])), 0, extent[1] - 1)
    return first + (on * extent[1] + y) * extent[0] + x


@wp.func
def bilinear(table: TextureTable, level: int, srgb: int, cube: bool, side: int, s: float, t: float) -> wp.vec3:
    """A colour of one level; flat textures repeat, beyond a side of a cube follows its neighbour."""
    extent = table.extent[level]
    first = table.first_texel[level]
    x = s * float(extent[0]) - 0.5
    y = t * float(extent[1]) - 0.5
    if not cube:
        x = (s - wp.floor(s)) * float(extent[0]) - 0.5
        y = (t - wp.floor(t)) * float(extent[1]) - 0.5
    column = int(wp.floor(x))
    row = int(wp.floor(y))
    u = x - float(column)
    v = y - float(row)
    a = int(0)
    b = int(0)
    c = int(0)
    d = int(0)
    if cube and (column < 0 or row < 0 or column >= extent[0] - 1 or row >= extent[1] - 1):
        a = beyond_side(first, extent, side, column, row)
        b = beyond_side(first, extent, side, column + 1, row)
        c = beyond_side(first, extent, side, column, row + 1)
        d = beyond_side(first, extent, side, column + 1, row + 1)
    else:
        # Rounding may take a flat place up to its far end.
        left = wp.where(column < 0, extent[0] - 1, wp.min(column, extent[0] - 1))
        right = wp.where(left + 1 < extent[0], left + 1, 0)
        upper = wp.where(row < 0, extent[1] - 1, wp.min(row, extent[1] - 1))
        lower = wp.where(upper + 1 < extent[1], upper + 1, 0)
        upper = first + (side * extent[1] + upper) * extent[0]
        lower = first + (side * extent[1] + lower) * extent[0]
        a = upper + left
        b = upper + right
        c = lower + left
        d = lower + right
    top = (1.0 - u) * texel(table, a, srgb) + u * texel(table, b, srgb)
    bottom = (1.0 - u) * texel(table, c, srgb) + u * texel(table, d, srgb)
    return (1.0 - v) * top + v * bottom


@wp.func
def filtered(
    table: TextureTable, texture: int, cube: bool, side: int, place: wp.vec2, along_x: wp.vec2, along_y: wp.vec2
) -> wp.vec3:
    """A colour filtered over the parallelogram that two steps of the coordinates span."""
    first = table.first_level[texture]
    finest = table.extent[first]
    span = wp.vec2(float(finest[0]), float(finest[1]))
    reach = wp.max(wp.abs(place)) + wp.max(wp.abs(along_x)) + wp.max(wp.abs(along_y))
    # NaN is not below either. The mean of the image is in its last level.
    if not (reach < wp.static(FARTHEST)):
        return bilinear(table, first + table.levels[texture] - 1, table.srgb[texture], cube, side, 0.5, 0.5)
    longer = along_x
    shorter = along_y
    if wp.length(wp.cw_mul(along_x, span)) < wp.length(wp.cw_mul(along_y, span)):
        longer = along_y
        shorter = along_x
    length = wp.length(wp.cw_mul(longer, span))
    # The height of the parallelogram over its longer side.
    a = wp.cw_mul(longer, span)
    b = wp.cw_mul(shorter, span)
    width = wp.abs(a[0] * b[1] - a[1] * b[0]) / wp.max(length, 1.0e-12)
    lookups = int(wp.clamp(wp.round(length / wp.max(width, 1.0)), 1.0, float(wp.static(MOST_LOOKUPS))))
    blur = wp.log2(wp.max(wp.max(width, length / float(lookups)), 1.0))
    blur = wp.min(blur, float(table.levels[texture] - 1))
    low = int(wp.floor(blur))
    high = wp.min(low + 1, table.levels[texture] - 1)
    share = blur - float(low)
    srgb = table.srgb[texture]
    total = wp.vec3()
    for lookup in range(lookups):
        step = (float(lookup) + 0.5) / float(lookups) - 0.5
        at = place + step * longer
        color = (1.0 - share) * bilinear(table, first + low, srgb, cube, side, at[0], at[1])
        if share > 0.0:
            color += share * bilinear(table, first + high, srgb, cube, side, at[0], at[1])
        total += color
    return total / float(lookups)


@wp.func
def longitude(q: wp.vec3) -> float:
    """The share of a full turn around z, from x, in [0, 1)."""
    turn = wp.atan2(q[1], q[0]) * wp.static(0.5 / math.pi)
    return wp.where(turn < 0.0, turn + 1.0, turn)


@wp.func
def place_on_shape(wrap: int, p: wp.vec3, near: wp.vec3, n: wp.vec3, size: wp.vec3) -> wp.vec2:
    """The coordinates of a point p of a shape, before scale and offset (MuJoCo's own mapping).

    near, n: a point of the shape beside p and the normal there; they choose the piece of the shape whose formula holds,
    so that steps of coordinates end at no seam between pieces.
    """
    if wrap == wp.static(int(Wrap.FLAT)):
        return wp.vec2(p[0], p[1])
    q = wp.cw_div(p, size)
    if wrap == wp.static(int(Wrap.BALL)):
        height = wp.clamp(q[2] / wp.max(wp.length(q), 1.0e-12), -1.0, 1.0)
        return wp.vec2(longitude(q), 0.5 - wp.asin(height) * wp.static(1.0 / math.pi))
    if wrap == wp.static(int(Wrap.BOX)):
        along = wp.vec3(wp.abs(n[0]), wp.abs(n[1]), wp.abs(n[2]))
        s = 0.5 * (q[0] + 1.0)
        t = 0.5 * (1.0 - q[2])
        if along[2] >= along[0] and along[2] >= along[1]:
            t = 0.5 * (1.0 - q[1])
        elif along[0] >= along[1]:
            s = 0.5 * (q[1] + 1.0)
        return wp.vec2(s, t)
    if wrap == wp.static(int(Wrap.CAPSULE)) and wp.abs(near[2]) > size[2]:
        over = wp.where(near[2] > 0.0, p[2], -p[2]) - size[2]
        latitude = wp.asin(wp.clamp(over / size[0], -1.0, 1.0)) * wp.static(2.0 / math.pi)
        return wp.vec2(longitude(q), wp.where(near[2] > 0.0, 1.0 - latitude, latitude))
    if wrap == wp.static(int(Wrap.CYLINDER)) and wp.abs(n[2]) > wp.static(END_NORMAL):
        return wp.vec2(0.5 * (q[0] + 1.0), 0.5 * (q[1] + 1.0))
    return wp.vec2(longitude(q), 0.5 * (1.0 - q[2]))


@wp.func
def direction_in_cube(wrap: int, p: wp.vec3, size: wp.vec3, stretch: wp.vec3) -> wp.vec3:
    """Where a point of a shape lies in a cube map around it."""
    q = wp.cw_div(p, size)
    if wrap == wp.static(int(Wrap.CUBE_CAPSULE)) and wp.abs(q[2]) > 1.0:
        over = 1.0 + (wp.abs(p[2]) - size[2]) / size[0]
        q = wp.vec3(q[0], q[1], wp.where(q[2] > 0.0, over, -over))
    return wp.cw_mul(q, stretch)


@wp.func
def nearest_turn(step: wp.vec2) -> wp.vec2:
    """A step of coordinates that went around a seam, taken the short way."""
    return wp.vec2(step[0] - wp.round(step[0]), step[1])


@wp.func
def given_place(table: TextureTable, geometry: GeometryTables, entity: int, face: int, p: wp.vec3) -> wp.vec2:
    """The coordinates that a mesh brings, at a point of the plane of a face, which may lie beyond it."""
    mesh = geometry[0].entity_mesh[entity]
    corners = geometry[0].faces[geometry[0].first_face[mesh] + face]
    start = geometry[0].first_vertex[mesh]
    a = geometry[0].vertices[start + corners[0]]
    ab = geometry[0].vertices[start + corners[1]] - a
    ac = geometry[0].vertices[start + corners[2]] - a
    normal = wp.cross(ab, ac)
    squared = wp.max(wp.length_sq(normal), 1.0e-30)
    u = wp.dot(wp.cross(p - a, ac), normal) / squared
    v = wp.dot(wp.cross(ab, p - a), normal) / squared
    row = table.first_coordinate[entity] + face
    return (1.0 - u - v) * table.coordinates[row, 0] + u * table.coordinates[row, 1] + v * table.coordinates[row, 2]


@wp.func
def tint_of(
    table: TextureTable,
    geometry: GeometryTables,
    entity: int,
    part: int,
    face: int,
    p_entity: wp.vec3,
    n_entity: wp.vec3,
    along_x: wp.vec3,
    along_y: wp.vec3,
) -> wp.vec3:
    """What the texture of a part multiplies colours with, over the parallelogram of two steps along the surface.

    p_entity, n_entity, along_x, along_y: a point of the surface, its normal and the steps, in the entity's frame.
    face: of the entity's mesh, for coordinates that the mesh brings.
    """
    texture = table.texture[part]
    if texture < 0:
        return wp.vec3(1.0, 1.0, 1.0)
    wrap = table.wrap[part]
    scale = table.scale[part]
    if wrap == wp.static(int(Wrap.GIVEN)):
        start = given_place(table, geometry, entity, face, p_entity)
        across = wp.cw_mul(scale, given_place(table, geometry, entity, face, p_entity + along_x) - start)
        down = wp.cw_mul(scale, given_place(table, geometry, entity, face, p_entity + along_y) - start)
        place = wp.cw_mul(scale, start) + table.offset[part]
        return filtered(table, texture, False, 0, place, across, down)
    to_part = wp.transpose(table.rotation[part])
    p = to_part * (p_entity - table.position[part])
    n = to_part * n_entity
    x = to_part * along_x
    y = to_part * along_y
    size = table.size[part]
    if wrap >= wp.static(int(Wrap.CUBE)):
        stretch = table.stretch[part]
        d = direction_in_cube(wrap, p, size, stretch)
        side = cube_side(d)
        place = on_side(d, side)
        across = on_side(direction_in_cube(wrap, p + x, size, stretch), side) - place
        down = on_side(direction_in_cube(wrap, p + y, size, stretch), side) - place
        return filtered(table, texture, True, side, place, across, down)
    place = place_on_shape(wrap, p, p, n, size)
    across = place_on_shape(wrap, p + x, p, n, size) - place
    down = place_on_shape(wrap, p + y, p, n, size) - place
    if (
        wrap == wp.static(int(Wrap.BALL))
        or wrap == wp.static(int(Wrap.CAPSULE))
        or wrap == wp.static(int(Wrap.CYLINDER))
    ):
        across = nearest_turn(across)
        down = nearest_turn(down)
    place = wp.cw_mul(scale, place) + table.offset[part]
    return filtered(table, texture, False, 0, place, wp.cw_mul(scale, across), wp.cw_mul(scale, down))


def upload_textures(scene: Scene, device: wp.Device) -> TextureTable:
    """The textures of a scene as pyramids, and how they lie on its parts."""
    parts = [part for entity in scene.entities for part in entity.parts]
    table = TextureTable()
    table.texture = wp.array([part.texture for part in parts], dtype=wp.int32, device=device)
    maps = [part.mapping for part in parts]
    table.wrap = wp.array([int(each.wrap) for each in maps], dtype=wp.int32, device=device)
    for name, dtype in (("scale", wp.vec2), ("offset", wp.vec2), ("size", wp.vec3), ("stretch", wp.vec3)):
        columns = 2 if dtype is wp.vec2 else 3
        values = np.array([getattr(each, name) for each in maps], np.float32).reshape(-1, columns)
        setattr(table, name, wp.array(values, dtype=dtype, device=device))
    positions = np.array([each.position for each in maps], np.float32).reshape(-1, 3)
    rotations = np.array([each.rotation for each in maps], np.float32).reshape(-1, 3, 3)
    table.position = wp.array(positions, dtype=wp.vec3, device=device)
    table.rotation = wp.array(rotations, dtype=wp.mat33, device=device)

    given = [entity.texture_coordinates for entity in scene.entities]
    counts = np.array([0 if each is None else len(each) for each in given], np.int64)
    first = np.where(counts > 0, np.cumsum(counts) - counts, -1)
    table.first_coordinate = wp.array(first, dtype=wp.int32, device=device)
    stacked = np.concatenate([np.zeros((0, 3, 2), np.float32), *(each for each in given if each is not None)])
    table.coordinates = wp.array(stacked, dtype=wp.vec2, device=device)

    pyramids = [_pyramid(texture) for texture in scene.textures]
    levels = [len(pyramid) for pyramid in pyramids]
    images = [level for pyramid in pyramids for level in pyramid]
    sizes = [image.size for image in images]
    table.levels = wp.array(levels, dtype=wp.int32, device=device)
    table.first_level = wp.array(np.cumsum([0, *levels])[:-1], dtype=wp.int32, device=device)
    table.srgb = wp.array([int(texture.srgb) for texture in scene.textures], dtype=wp.int32, device=device)
    table.first_texel = wp.array(np.cumsum([0, *sizes])[:-1], dtype=wp.int32, device=device)
    extents = np.array([(image.shape[2], image.shape[1]) for image in images], np.int32).reshape(-1, 2)
    table.extent = wp.array(extents, dtype=wp.vec2i, device=device)
    packed = np.concatenate([np.zeros(0, np.uint32), *(image.ravel() for image in images)])
    table.texels = wp.array(packed, dtype=wp.uint32, device=device)
    table.decoded = wp.array(np.stack([LINEAR, DECODED]), dtype=wp.float32, device=device)
    return table


def _pyramid(texture: Texture) -> list[np.ndarray]:
    """Packed images [sides, rows, columns], the finest first, down to one pixel; filtered in linear light."""
    levels = [texture.pixels]
    colors = decode(texture)
    while max(colors.shape[1:3]) > 1:
        colors = halve(colors)
        levels.append(encode(colors, texture.srgb))
    return [_pack(level) for level in levels]


def _pack(pixels: np.ndarray) -> np.ndarray:
    red, green, blue = (pixels[..., channel].astype(np.uint32) for channel in range(3))
    return red | (green << np.uint32(8)) | (blue << np.uint32(16))
