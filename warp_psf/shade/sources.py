"""Small bright sources as receivers see them: leaves of the environment, and pieces of area lights, in groups."""

import numpy as np
import warp as wp

from warp_psf.device import launch
from warp_psf.field.silhouette_lanes import LANES, directions, lanes
from warp_psf.field.silhouettes import SilhouetteTables
from warp_psf.scene.geometry import DeviceScene, GeometryTables, PoseTables, find_placed

# A light's piece is never taken for wider than this, radians, however near it is.
WIDEST = 1.0
pieces = wp.types.matrix(shape=(8, LANES), dtype=wp.float32)


@wp.struct
class SharpTable:
    """The small sources of a scene, and the silhouettes of its bodies."""

    direction: wp.array2d(dtype=wp.vec3)  # (world, leaf)
    sent: wp.array2d(dtype=wp.vec3)  # (world, leaf): radiance times solid angle
    radius: wp.array2d(dtype=wp.float32)  # (world, leaf), radians
    first_leaf: wp.array(dtype=wp.int32)  # (group of leaves), and the number of leaves at the end
    axis: wp.array2d(dtype=wp.vec3)  # (world, group of leaves): the middle of the cone that holds it
    spread: wp.array2d(dtype=wp.float32)  # (world, group of leaves): half the cone's angle, radians
    moment: wp.array2d(dtype=wp.mat33)  # (world, group of leaves): the sum of sent times direction, (channel, axis)
    light_entity: wp.array(dtype=wp.int32)  # (light)
    light_radiance: wp.array2d(dtype=wp.vec3)  # (world, light)
    light_facing: wp.array(dtype=wp.vec3)  # (light): front of a flat one in its frame, else zero
    first_piece: wp.array(dtype=wp.int32)  # (light), and the number of pieces at the end
    position: wp.array(dtype=wp.vec3)  # (piece), in the light's frame, metres
    normal: wp.array(dtype=wp.vec3)  # (piece), zero where light leaves to every side
    area: wp.array(dtype=wp.float32)  # (piece), m^2
    # (world, light): the pieces in columns: position and normal in the world, area, and 1 where no side is dark
    pieces: wp.array2d(dtype=pieces)
    silhouettes: SilhouetteTables
    field: wp.array(dtype=wp.int32)  # (entity): its silhouettes, -1 where it has none


SharpTables = wp.array(dtype=SharpTable)


@wp.struct
class Group:
    """Sources that are asked together, as a receiver sees them."""

    number: wp.int32  # of a group of leaves
    first: wp.int32
    count: wp.int32
    light: wp.int32  # -1 for leaves
    axis: wp.vec3
    spread: wp.float32  # half the angle of the cone that holds them, radians
    sine: wp.float32  # of that; of a right angle where it is wider
    cosine: wp.float32


@wp.struct
class Sources:
    """The sources of a group as a receiver sees them; those beyond its count send nothing."""

    toward: directions
    radius: lanes  # radians
    solid_angle: lanes  # of a light's pieces; of leaves, whose `sent` has it, nothing


@wp.func
def group_of(world: int, index: int, p: wp.vec3, geometry: GeometryTables, poses: PoseTables, s: SharpTables) -> Group:
    """The groups are those of leaves, then one per light."""
    group = Group()
    groups = s[0].axis.shape[1]
    if index < groups:
        group.number = index
        group.first = s[0].first_leaf[index]
        group.count = s[0].first_leaf[index + 1] - group.first
        group.light = -1
        group.axis = s[0].axis[world, index]
        group.spread = s[0].spread[world, index]
    else:
        group.light = index - groups
        group.first = s[0].first_piece[group.light]
        group.count = s[0].first_piece[group.light + 1] - group.first
        placed = find_placed(world, s[0].light_entity[group.light], geometry, poses)
        toward = placed.center - p
        distance = wp.max(wp.length(toward), 1.0e-9)
        group.axis = toward / distance
        group.spread = wp.asin(wp.min(placed.radius / distance, 1.0))
    group.sine = wp.sin(wp.min(group.spread, wp.static(0.5 * np.pi)))
    group.cosine = wp.cos(wp.min(group.spread, wp.static(0.5 * np.pi)))
    return group


def _toward_snippet() -> str:
    """C++: unit vectors from p to the pieces of a light."""
    return f"""
    wp::mat_t<3, {LANES}, float> toward;
    for (int k = 0; k < {LANES}; ++k) {{
        const float x = piece.data[0][k] - p[0], y = piece.data[1][k] - p[1], z = piece.data[2][k] - p[2];
        const float length = sqrtf(x * x + y * y + z * z);
        const float onto = 1.0f / (length > 1.0e-6f ? length : 1.0e-6f);
        toward.data[0][k] = x * onto;
        toward.data[1][k] = y * onto;
        toward.data[2][k] = z * onto;
    }}
    return toward;
    """


def _solid_angles_snippet() -> str:
    """C++: area times cosine over squared distance; where no side is dark the normal is zero, and the cosine 1."""
    return f"""
    wp::vec_t<{LANES}, float> solid_angle;
    for (int k = 0; k < {LANES}; ++k) {{
        const float x = piece.data[0][k] - p[0], y = piece.data[1][k] - p[1], z = piece.data[2][k] - p[2];
        const float squared = x * x + y * y + z * z;
        const float far_off = squared > 1.0e-12f ? squared : 1.0e-12f;
        const float facing = piece.data[3][k] * toward.data[0][k] + piece.data[4][k] * toward.data[1][k]
            + piece.data[5][k] * toward.data[2][k];
        solid_angle[k] = piece.data[6][k] * (piece.data[7][k] - (facing < 0.0f ? facing : 0.0f)) / far_off;
    }}
    return solid_angle;
    """


def _radii_snippet() -> str:
    """C++: of discs with those solid angles: a piece that is seen from the side is narrower one way."""
    return f"""
    wp::vec_t<{LANES}, float> radius;
    for (int k = 0; k < {LANES}; ++k) {{
        const float wide = sqrtf(solid_angle[k] * {1.0 / np.pi:.9g}f);
        radius[k] = wide < 1.0e-4f ? 1.0e-4f : (wide > {WIDEST}f ? {WIDEST}f : wide);
    }}
    return radius;
    """


@wp.func_native(_toward_snippet())
def _toward_pieces(piece: pieces, p: wp.vec3) -> directions: ...


@wp.func_native(_solid_angles_snippet())
def _solid_angles(piece: pieces, p: wp.vec3, toward: directions) -> lanes: ...


@wp.func_native(_radii_snippet())
def _radii(solid_angle: lanes) -> lanes: ...


@wp.func
def sources_of(world: int, group: Group, p: wp.vec3, s: SharpTables) -> Sources:
    sources = Sources()
    if group.light >= 0:
        piece = s[0].pieces[world, group.light]
        sources.toward = _toward_pieces(piece, p)
        sources.solid_angle = _solid_angles(piece, p, sources.toward)
        sources.radius = _radii(sources.solid_angle)
        return sources
    for k in range(group.count):
        direction = s[0].direction[world, group.first + k]
        for axis in range(3):
            sources.toward[axis, k] = direction[axis]
        sources.radius[k] = s[0].radius[world, group.first + k]
    return sources


@wp.func
def direction_to(sources: Sources, k: int) -> wp.vec3:
    return wp.vec3(sources.toward[0, k], sources.toward[1, k], sources.toward[2, k])


@wp.kernel(enable_backward=False, module="unique")
def _place_pieces(first: int, poses: PoseTables, s: SharpTables):
    world, light = wp.tid()
    light += first
    entity = s[0].light_entity[light]
    rotation = poses[0].rotation[world, entity]
    placed = pieces()
    for k in range(s[0].first_piece[light + 1] - s[0].first_piece[light]):
        piece = s[0].first_piece[light] + k
        position = poses[0].position[world, entity] + rotation * s[0].position[piece]
        normal = rotation * s[0].normal[piece]
        for axis in range(3):
            placed[axis, k] = position[axis]
            placed[3 + axis, k] = normal[axis]
        placed[6, k] = s[0].area[piece]
        placed[7, k] = wp.where(wp.length_sq(normal) > 0.0, 0.0, 1.0)
    s[0].pieces[world, light] = placed


def place_pieces(tables: wp.array, scene: DeviceScene, device: wp.Device) -> None:
    """Brings the pieces of area lights to where the lights are in a frame."""
    launch(_place_pieces, tables.tables[0].pieces.shape, [scene.poses, tables], [], device)
