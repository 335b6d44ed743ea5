"""Small bright sources as receivers see them: leaves of the environment, and pieces of area lights, in groups."""

import numpy as np
import warp as wp

from warp_psf.field.silhouettes import SilhouetteTables
from warp_psf.scene.geometry import GeometryTables, PoseTables, find_placed

# A light's piece is never taken for wider than this, radians, however near it is.
WIDEST = 1.0


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
class Source:
    """A small source as a receiver sees it."""

    direction: wp.vec3
    radius: wp.float32  # radians
    solid_angle: wp.float32  # of a light's piece; 1 for leaves, whose `sent` has it


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


@wp.func
def source_of(world: int, group: Group, k: int, p: wp.vec3, poses: PoseTables, s: SharpTables) -> Source:
    source = Source()
    if group.light < 0:
        source.direction = s[0].direction[world, group.first + k]
        source.radius = s[0].radius[world, group.first + k]
        source.solid_angle = 1.0
        return source
    piece = group.first + k
    entity = s[0].light_entity[group.light]
    rotation = poses[0].rotation[world, entity]
    toward = poses[0].position[world, entity] + rotation * s[0].position[piece] - p
    distance = wp.max(wp.length(toward), 1.0e-6)
    source.direction = toward / distance
    normal = s[0].normal[piece]
    cosine = float(1.0)
    if wp.length_sq(normal) > 0.0:
        cosine = wp.max(-wp.dot(rotation * normal, source.direction), 0.0)
    source.solid_angle = s[0].area[piece] * cosine / (distance * distance)
    # Seen from the side a piece is narrower one way; the disc has its area.
    radius = wp.sqrt(source.solid_angle * wp.static(1.0 / np.pi))
    source.radius = wp.clamp(radius, 1.0e-4, wp.static(WIDEST))
    return source
