"""Light cut in two: what is smooth enough for spherical harmonics, and the small bright rest as few leaves.

The rest is what the finest Haar wavelets of a 64 x 64 map hold where light is far above its surroundings: a sun, a
window, a lamp far away. A leaf keeps its cell's light, where in the cell that light comes from, and how wide it is, so
that a sun that is smaller than a cell stays as small as it is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from warp_psf.basis import sphere
from warp_psf.scene.environment import LUMINANCE, Environment
from warp_psf.scene.light import AreaLight

# Cells per axis of the map, as in Tamura 2006, section 6.
MAP_SIZE = 64
# An image is taken at least this fine, so that every cell has pixels of its own.
FEWEST_ROWS = 256
# Light counts as bright above this many times the median luminance. SH take up to a tenth of the peak of a cell in
# darkness as ringing elsewhere: below, that is less than half of what is there anyway.
BRIGHT = 5.0
# Leaves at most; the brightest are kept, and what the others hold stays with the smooth part.
MOST_LEAVES = 192
# What the leaves that are left out may hold together, as a share of all light.
NEGLIGIBLE = 1.0e-3
# Leaves that are asked together, in a block of so many cells per axis.
BLOCK = 4
GROUP = BLOCK * BLOCK


@dataclass(frozen=True)
class Leaves:
    """Small bright parts of an environment.

    direction: unit vectors, float64 [L, 3]. radius: of the disc that is as wide as the leaf, radians, [L].
    sent: radiance times solid angle, linear Rec.709, [L, 3].
    group: rising numbers of the groups that leaves belong to, at most GROUP leaves each, int [L].
    """

    direction: np.ndarray
    radius: np.ndarray
    sent: np.ndarray
    group: np.ndarray


def cut_environment(environment: Environment) -> tuple[Environment, Leaves]:
    """The smooth part of an environment, and its small bright parts; together they send what it sends.

    Band-limited light (`Environment.from_coefficients`) has no bright parts.
    """
    if environment.coefficients is not None:
        return environment, _no_leaves()
    radiance = environment.radiance.astype(np.float64)
    repeats = -(-FEWEST_ROWS // len(radiance))
    fine = radiance.repeat(repeats, axis=0).repeat(repeats, axis=1)
    rows, columns = fine.shape[:2]
    solid_angle = np.broadcast_to(sphere.latlong_solid_angles(rows, columns), (rows, columns))
    level = np.median(fine.reshape(-1, 3), axis=0)
    luminance = fine @ LUMINANCE
    bright = luminance > BRIGHT * float(level @ LUMINANCE)
    if not bright.any():
        return environment, _no_leaves()
    directions = sphere.latlong_directions(rows, columns)[bright]
    excess = np.maximum(fine[bright] - level, 0.0)
    sent = excess * solid_angle[bright][:, None]
    kept, leaves = _gather(directions, sent, solid_angle[bright], float((luminance * solid_angle).sum()))
    smooth = fine.copy()
    smooth[bright] = np.where(kept[:, None], fine[bright] - excess, fine[bright])
    return Environment(f"smooth part of {environment.name}", smooth.astype(np.float32)), leaves


def _gather(
    directions: np.ndarray, sent: np.ndarray, solid_angle: np.ndarray, total: float
) -> tuple[np.ndarray, Leaves]:
    """Pixels [N, 3] as leaves of the map's cells: which pixels are in a leaf, and the leaves."""
    row = np.minimum((0.5 * (1 - directions[:, 2]) * MAP_SIZE).astype(int), MAP_SIZE - 1)
    turn = np.arctan2(directions[:, 1], directions[:, 0]) / (2 * math.pi) % 1.0
    column = np.minimum((turn * MAP_SIZE).astype(int), MAP_SIZE - 1)
    cells, cell = np.unique(row * MAP_SIZE + column, return_inverse=True)
    light = sent @ LUMINANCE

    def summed(values: np.ndarray) -> np.ndarray:
        return np.bincount(cell, values, len(cells))

    strength = summed(light)
    order = np.argsort(-strength, kind="stable")
    enough = np.searchsorted(np.cumsum(strength[order]), strength.sum() - NEGLIGIBLE * total) + 1
    chosen = np.sort(order[: min(enough, MOST_LEAVES)])
    mean = np.stack([summed(light * directions[:, axis]) for axis in range(3)], axis=1) / strength[:, None]
    length = np.linalg.norm(mean, axis=1)
    # Of unit vectors that spread by s^2 about their mean direction the mean is 1 - s^2 / 2 long; a disc of radius r
    # spreads by r^2 / 2, and a pixel by a sixth of its solid angle (its sides squared over 12, along both).
    pixel = summed(light * solid_angle) / strength / 6
    radius = np.sqrt(2 * (2 * np.maximum(1 - length, 0.0) + pixel))
    leaves = Leaves(
        direction=(mean / length[:, None])[chosen],
        radius=radius[chosen],
        sent=np.stack([summed(sent[:, channel]) for channel in range(3)], axis=1)[chosen],
        group=(cells[chosen] // MAP_SIZE // BLOCK) * (MAP_SIZE // BLOCK) + cells[chosen] % MAP_SIZE // BLOCK,
    )
    return np.isin(cell, chosen), _by_group(leaves)


def _by_group(leaves: Leaves) -> Leaves:
    order = np.argsort(leaves.group, kind="stable")
    return Leaves(leaves.direction[order], leaves.radius[order], leaves.sent[order], leaves.group[order])


def _no_leaves() -> Leaves:
    return Leaves(np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)), np.zeros(0, int))


def merge_leaves(several: list[Leaves]) -> Leaves:
    """The leaves of several environments, none in a group with those of another."""
    parts, first = [_no_leaves()], 0
    for leaves in several:
        parts.append(Leaves(leaves.direction, leaves.radius, leaves.sent, leaves.group + first))
        first += (MAP_SIZE // BLOCK) ** 2
    names = ("direction", "radius", "sent", "group")
    return Leaves(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


@dataclass(frozen=True)
class LightPatches:
    """Pieces of an area light's surface, each small enough for a disc.

    position: in the light's frame, metres, [P, 3]; normal: [P, 3], zero where light leaves to every side alike;
    area: of the disc or of the piece, m^2, [P]. At most GROUP pieces.
    """

    position: np.ndarray
    normal: np.ndarray
    area: np.ndarray


def cut_light(light: AreaLight) -> LightPatches:
    """The pieces of an area light: a grid on a rectangle, one disc for a sphere, clusters of faces on other meshes."""
    mesh = light.mesh
    if mesh.sphere is not None and mesh.slab is None:
        return LightPatches(mesh.center[None].astype(float), np.zeros((1, 3)), np.array([math.pi * mesh.radius**2]))
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    crossed = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(crossed, axis=1)
    if mesh.slab is not None and mesh.slab[2].min() <= 0:
        return _cut_rectangle(mesh.slab, crossed.sum(axis=0) / area.sum(), area.sum())
    groups = _halve(corners.mean(axis=1), crossed, np.flatnonzero(area > 0), GROUP)
    total = np.array([area[group].sum() for group in groups])
    position = np.stack([area[group] @ corners[group].mean(axis=1) for group in groups]) / total[:, None]
    normal = np.stack([crossed[group].sum(axis=0) for group in groups])
    length = np.linalg.norm(normal, axis=1)
    return LightPatches(position, normal / np.maximum(length, 1e-30)[:, None], total)


def _cut_rectangle(slab: tuple, normal: np.ndarray, area: float) -> LightPatches:
    center, rotation, half = slab
    places = int(math.isqrt(GROUP))
    middle = (2 * np.arange(places) + 1) / places - 1
    across = [axis for axis in range(3) if half[axis] > 0]
    grid = np.zeros((places, places, 3))
    grid[..., across[0]], grid[..., across[1]] = (half[across[0]] * middle)[:, None], half[across[1]] * middle
    position = center + grid.reshape(-1, 3) @ np.asarray(rotation).T
    return LightPatches(position, np.tile(normal, (GROUP, 1)), np.full(GROUP, area / GROUP))


def _halve(middle: np.ndarray, crossed: np.ndarray, faces: np.ndarray, pieces: int) -> list[np.ndarray]:
    """Faces in `pieces` sets at most, alike in place and in normal, halved along what spreads the most."""
    if pieces == 1 or len(faces) <= 1:
        return [faces]
    area = np.linalg.norm(crossed[faces], axis=1)
    size = np.ptp(middle, axis=0).max()
    features = np.concatenate([middle[faces], size * crossed[faces] / area[:, None]], axis=1)
    axis = np.ptp(features, axis=0).argmax()
    order = faces[np.argsort(features[:, axis], kind="stable")]
    half = np.searchsorted(np.cumsum(np.linalg.norm(crossed[order], axis=1)), 0.5 * area.sum())
    half = int(np.clip(half, 1, len(order) - 1))
    return _halve(middle, crossed, order[:half], pieces // 2) + _halve(
        middle, crossed, order[half:], pieces - pieces // 2
    )
