"""Textures: images on surfaces, flat or on the six sides of a cube, and how they lie on a shape."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np


@dataclass(frozen=True, eq=False)
class Texture:
    """An image that multiplies the albedo and the emission of a surface.

    name: what messages call it.
    pixels: uint8 [sides, rows, columns, 3]; one side for a flat texture, six for a cube: +x, -x, +y, -y, +z, -z, each
        as OpenGL's cube maps have them. Row 0 of a flat one lies at t = 0.
    srgb: whether the bytes are sRGB; otherwise they are linear.
    """

    name: str
    pixels: np.ndarray
    srgb: bool


class Wrap(IntEnum):
    """How texture coordinates come from a point of a shape; all but GIVEN are formulas of its position."""

    FLAT = 0  # along x and y
    BALL = 1  # longitude and latitude
    CAPSULE = 2  # around the side and over either end
    CYLINDER = 3  # around the side, and flat on the ends
    BOX = 4  # flat on each side
    GIVEN = 5  # the coordinates that a mesh brings
    CUBE = 6  # the direction of the point from the middle of the shape
    CUBE_CAPSULE = 7  # the same, for what is a cylinder with two half balls


@dataclass(frozen=True, eq=False)
class Mapping:
    """How a texture lies on a part of an entity.

    wrap: which formula.
    scale, offset: what the coordinates (s, t) are multiplied with and moved by, [2] each; cubes use neither.
    size: half extents of the shape, metres, [3]; formulas but FLAT work on the shape scaled to 1.
    stretch: what the direction in a cube is multiplied with, [3].
    position, rotation: of the part's own frame in the entity's, [3] and [3, 3].
    """

    wrap: Wrap
    scale: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)
    size: tuple[float, float, float] = (1.0, 1.0, 1.0)
    stretch: tuple[float, float, float] = (1.0, 1.0, 1.0)
    position: np.ndarray = field(default_factory=lambda: np.zeros(3))
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))


# What of a colour is left of each byte: sRGB decoded (IEC 61966-2-1), and linear.
_LEVELS = np.arange(256) / 255.0
DECODED = np.where(_LEVELS <= 0.04045, _LEVELS / 12.92, ((_LEVELS + 0.055) / 1.055) ** 2.4).astype(np.float32)
LINEAR = _LEVELS.astype(np.float32)


def decode(texture: Texture) -> np.ndarray:
    """A texture's pixels as linear colours, float32 [sides, rows, columns, 3]."""
    return (DECODED if texture.srgb else LINEAR)[texture.pixels]


def encode(colors: np.ndarray, srgb: bool) -> np.ndarray:
    """Linear colours in [0, 1] as the nearest bytes, uint8."""
    if srgb:
        colors = np.where(colors <= 0.0031308, 12.92 * colors, 1.055 * np.maximum(colors, 1e-9) ** (1 / 2.4) - 0.055)
    return np.clip(np.round(255.0 * colors), 0, 255).astype(np.uint8)


def halve(colors: np.ndarray) -> np.ndarray:
    """Colours [sides, rows, columns, 3] at half the resolution: each the mean of the area that it covers."""
    for axis in (1, 2):
        size = colors.shape[axis]
        if size == 1:
            continue
        half = size // 2
        # Where the size is odd, a pixel covers a little more than two: parts of both of its neighbours.
        edges = np.linspace(0.0, size, half + 1)
        sums = np.concatenate([np.zeros_like(colors.take([0], axis)), np.cumsum(colors, axis, dtype=np.float64)], axis)
        low = np.minimum(np.floor(edges).astype(int), size - 1)
        share = (edges - low).reshape([-1 if k == axis else 1 for k in range(4)])
        at = sums.take(low, axis) + share * (sums.take(low + 1, axis) - sums.take(low, axis))
        colors = (np.diff(at, axis=axis) * (half / size)).astype(np.float32)
    return colors


def cube_to_panorama(cube: np.ndarray, rows: int) -> np.ndarray:
    """A cube of linear colours [6, n, n, 3] as a latitude-longitude image, float32 [rows, 2 rows, 3], bilinear.

    Direction (x, y, z) of the world is looked up at (x, z, -y): MuJoCo's skyboxes have y upwards.
    """
    theta = (np.pi * (np.arange(rows) + 0.5) / rows).astype(np.float32)
    phi = (np.pi * (np.arange(2 * rows) + 0.5) / rows).astype(np.float32)
    x = np.sin(theta)[:, None] * np.cos(phi)
    y = np.sin(theta)[:, None] * np.sin(phi)
    z = np.broadcast_to(np.cos(theta)[:, None], x.shape)
    side, s, t = cube_coordinates(np.stack([x, z, -y], axis=2))
    size = cube.shape[1]
    column, row = np.clip(s * size - 0.5, 0, size - 1), np.clip(t * size - 0.5, 0, size - 1)
    c, r = np.minimum(column.astype(int), size - 2 if size > 1 else 0), np.minimum(row.astype(int), max(size - 2, 0))
    u, v = (column - c)[..., None], (row - r)[..., None]
    c1, r1 = np.minimum(c + 1, size - 1), np.minimum(r + 1, size - 1)
    top = (1 - u) * cube[side, r, c] + u * cube[side, r, c1]
    low = (1 - u) * cube[side, r1, c] + u * cube[side, r1, c1]
    return ((1 - v) * top + v * low).astype(np.float32)


def cube_coordinates(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Side, s and t of directions [..., 3] in a cube map, by OpenGL's table (its specification, section 8.13)."""
    x, y, z = np.moveaxis(directions, -1, 0)
    magnitude = np.abs(directions)
    axis = magnitude.argmax(axis=-1)
    major = np.take_along_axis(directions, axis[..., None], -1)[..., 0]
    side = 2 * axis + (major < 0)
    across = np.choose(side, [-z, z, x, x, x, -x])
    down = np.choose(side, [-y, -y, z, -z, -y, -y])
    largest = np.maximum(np.abs(major), 1e-30)
    return side, 0.5 * (across / largest + 1.0), 0.5 * (down / largest + 1.0)
