"""The layered area light map: how much of a light each surface point receives, for any viewpoint (Jeng 2005, 4.2).

Reference views from points on and near the light find surface points. Seen from the light's middle each lies in a cell
of the map; a cell keeps one point for each surface that it meets, with the share of the light that reaches it. The map
of a flat light is the half space before it, that of any other shape two of them. Directions lie on its square so that
all cells are of one solid angle (Shirley 1997): a perspective map would spend most of them on what is right before the
light, and see nothing beside it.
"""

from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_psf.area_light.checks import MOST_RADIANCE
from warp_psf.area_light.light_samples import (
    PLASTIC,
    LightSamples,
    LightTable,
    sample_light,
    sample_unshadowed,
    upload_light,
    visible_ratio,
)
from warp_psf.area_light.tracing import StillTable, meet, smooth_normal, upload_still
from warp_psf.device import find_device, launch
from warp_psf.scene.light import AreaLight
from warp_psf.scene.still import StillScene

# Rays along a side with which the base point finds out what the map must cover, and how much wider than that it is.
PROBES, MARGIN = 128, 1.05
# A cell keeps one point of a surface in each of so many parts along its sides: points of views that see it from aside
# lie in between those of the first one.
PARTS = 4
# How far out on a light's diagonals, in half diagonals, reference points stand: at its corners, and outside it.
CORNERS, OUTSIDE = 1.0, 1.5
FARTHEST = wp.constant(1.0e6)
# A map of 2048 x 2048 cells takes about 3 GB while it is made.
LARGEST_SIZE, MOST_SAMPLES = 2048, 4096


@wp.struct
class FrameTable:
    """The square faces of a map: a part of a half space each."""

    origin: wp.vec3  # the base point, world, metres
    rotation: wp.array(dtype=wp.mat33)  # (face): world_from_face; the half space is about its third axis
    middle: wp.vec2  # of the part, on the square from -1 to 1 that is the half space
    half: wp.float32  # half the part's side
    size: wp.int32  # cells along it


@dataclass(frozen=True, eq=False)
class LayeredMap:
    """A layered area light map: points of surfaces, and how much of a light each receives. Built by `bake_layered_map`.

    Attributes:
        light: points on the light that shadows were asked of.
        unshadowed: points on the light over which its light is summed.
        radiance: of the light, float64 [3].
        origin: the base point, from which the map looks, world, metres, float64 [3].
        rotation: world_from_face, float64 [faces, 3, 3].
        middle, half: which part of the half space's square, from -1 to 1, the map is: its middle [2] and half its side.
        size: cells along it.
        first: where each cell's elements begin, int32 [cells + 1]; a face's cells lie by rows.
        surface: of each element, int32 [E].
        visibility: share of the light that arrives at each element, float32 [E].
        position, normal: of each element, world, metres, float32 [E, 3].
        scene: checksum of the scene.
    """

    light: LightSamples
    unshadowed: LightSamples
    radiance: np.ndarray
    origin: np.ndarray
    rotation: np.ndarray
    middle: np.ndarray
    half: float
    size: int
    first: np.ndarray
    surface: np.ndarray
    visibility: np.ndarray
    position: np.ndarray
    normal: np.ndarray
    scene: int

    @property
    def nbytes(self) -> int:
        """What cells and elements take, bytes."""
        arrays = (self.first, self.surface, self.visibility, self.position, self.normal)
        return sum(array.nbytes for array in arrays)


def bake_layered_map(
    scene: StillScene, light: AreaLight, size: int = 512, *, samples: int = 144, device: str | None = None
) -> LayeredMap:
    """Finds surface points from nine reference views, and how much of the light each receives.

    The reference points stand at the light's middle, at the corners of its bounding rectangle, and outside it on the
    diagonals. Source: Jeng 2005, sections 4.2.3 and 4.4.

    Args:
        scene: what the light shines on.
        light: of any shape, in the world.
        size: cells along a side of the map, and pixels of a reference view, 2 to 2048.
        samples: points on the light that each surface point is asked for, 1 to 4096.
        device: "cpu", "cuda:0", ...; None takes the first CUDA device, else the CPU.

    Raises:
        ValueError: a number is not usable, the light hangs on a body, or nothing of the scene is before it.
        TypeError: `scene` or `light` is something else.
    """
    if not isinstance(size, (int, np.integer)) or not 2 <= size <= LARGEST_SIZE:
        raise ValueError(f"size is {size!r}; give a whole number of cells from 2 to {LARGEST_SIZE}")
    if not isinstance(samples, (int, np.integer)) or not 1 <= samples <= MOST_SAMPLES:
        raise ValueError(f"samples is {samples!r}; give a whole number of points from 1 to {MOST_SAMPLES}")
    on_device = find_device(device)
    still = upload_still(scene, on_device)
    points = sample_light(light, samples)
    if light.radiance.max() > MOST_RADIANCE or np.abs(points.position).max() > FARTHEST:
        raise ValueError(
            f"light {light.name!r} is too bright, large or far away; give a radiance of at most {MOST_RADIANCE:g}, and "
            f"coordinates within {FARTHEST:g} m"
        )
    base, references = _reference_points(light)
    rotation, middle, half = _faces(still.table, light, base, on_device)
    frame = make_frame(base, rotation, middle, half, int(size), on_device)
    elements = _Elements(len(scene.flat))
    fine = make_frame(base, rotation, middle, half, PARTS * int(size), on_device)
    for view, reference in enumerate(references):
        # Each view's rays go through other places of the cells.
        aside = (0.5 + view * PLASTIC) % 1.0
        elements.add(*_look_from(still.table, frame, fine, reference, aside, on_device))
    if not len(elements.keys):
        raise ValueError(f"nothing of the scene is before light {light.name!r}; move it to the scene")
    cell, kept = elements.sorted(int(size))
    visibility = _ask(still.table, upload_light(points, on_device), kept, on_device)
    first = np.searchsorted(cell, np.arange(len(rotation) * size**2 + 1)).astype(np.int32)
    return LayeredMap(
        points,
        sample_unshadowed(light, samples),
        np.asarray(light.radiance, np.float64),
        base,
        rotation,
        middle,
        half,
        int(size),
        first,
        kept["surface"],
        visibility,
        kept["position"],
        kept["normal"],
        scene.checksum,
    )


def _reference_points(light: AreaLight) -> tuple[np.ndarray, np.ndarray]:
    """The base point and all reference points, world [9, 3]: it, and four corners twice."""
    vertices = light.mesh.vertices.astype(np.float64)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    # The light's rectangle spans its own x and y; of a body with depth, the corners lie at half its depth.
    signs = np.array([[x, y, 0.0] for x in (-1, 1) for y in (-1, 1)])
    offsets = np.concatenate([[[0.0, 0.0, 0.0]], CORNERS * signs * half, OUTSIDE * signs * half])
    world = light.position + (middle + offsets) @ light.rotation.T
    return world[0], world


def _faces(
    still: StillTable, light: AreaLight, base: np.ndarray, device: wp.Device
) -> tuple[np.ndarray, np.ndarray, float]:
    """Rotations of the map's faces, and which part of their squares meets the scene: its middle and half its side."""
    slab = light.mesh.slab
    if slab is None or slab[2][2] > 0.0:
        return np.stack([light.rotation, light.rotation @ np.diag([1.0, -1.0, -1.0])]), np.zeros(2), 1.0
    rotation = (light.rotation @ slab[1])[None]
    whole = make_frame(base, rotation, np.zeros(2), 1.0, PROBES, device)
    cell, _ = _look_from(still, whole, whole, base, np.full(2, 0.5), device)
    if not len(cell):
        raise ValueError(f"nothing of the scene is before light {light.name!r}; turn it")
    # A cell to each side, for what lies between rays.
    low = np.array([(cell % PROBES).min() - 1, (cell // PROBES).min() - 1])
    high = np.array([(cell % PROBES).max() + 2, (cell // PROBES).max() + 2])
    middle = (low + high) / PROBES - 1.0
    return rotation, middle * [1.0, -1.0], min(MARGIN * float((high - low).max()) / PROBES, 1.0)


def make_frame(
    origin: np.ndarray, rotation: np.ndarray, middle: np.ndarray, half: float, size: int, device: wp.Device
) -> FrameTable:
    """Puts a map's faces on the device."""
    frame = FrameTable()
    frame.origin = wp.vec3(*map(float, origin))
    frame.rotation = wp.array(rotation.astype(np.float32), dtype=wp.mat33, device=device)
    frame.middle = wp.vec2(*map(float, middle))
    frame.half, frame.size = half, size
    return frame


@wp.func
def direction_of(x: float, y: float) -> wp.vec3:
    """The direction at a point of the square from -1 to 1, in a face's frame. Equal areas have equal solid angles.

    Source: Shirley and Chiu, A Low Distortion Map Between Disk and Square, 1997.
    """
    r = float(0.0)
    angle = float(0.0)
    if wp.abs(x) > wp.abs(y):
        r = x
        angle = wp.static(0.25 * np.pi) * y / x
    elif y != 0.0:
        r = y
        angle = wp.static(0.5 * np.pi) - wp.static(0.25 * np.pi) * x / y
    level = r * wp.sqrt(wp.max(2.0 - r * r, 0.0))
    return wp.vec3(level * wp.cos(angle), level * wp.sin(angle), 1.0 - r * r)


@wp.func
def square_of(d: wp.vec3) -> wp.vec2:
    """Where a direction of a face's half space, of unit length, lies on its square: the inverse of `direction_of`."""
    r = wp.sqrt(wp.max(1.0 - d[2], 0.0))
    to_square = wp.static(4.0 / np.pi)
    if wp.abs(d[0]) > wp.abs(d[1]):
        x = wp.where(d[0] < 0.0, -r, r)
        return wp.vec2(x, to_square * x * wp.atan(d[1] / d[0]))
    # Along the axis itself r is 0, and any angle will do.
    y = wp.where(d[1] < 0.0, -r, r)
    return wp.vec2(to_square * y * wp.atan(d[0] / wp.where(d[1] == 0.0, 1.0, d[1])), y)


@wp.func
def cell_of(frame: FrameTable, p: wp.vec3) -> int:
    """The cell of the map in which the base point sees p, -1 where no face looks."""
    found = int(-1)
    for face in range(frame.rotation.shape[0]):
        local = wp.normalize(wp.transpose(frame.rotation[face]) * (p - frame.origin))
        # Two faces share their rim, which rounding must not lose.
        if found < 0 and local[2] > -1.0e-6:
            place = square_of(local)
            u = 0.5 + 0.5 * (place[0] - frame.middle[0]) / frame.half
            v = 0.5 - 0.5 * (place[1] - frame.middle[1]) / frame.half
            if wp.min(u, v) > -1.0e-5 and wp.max(u, v) < 1.0 + 1.0e-5:
                column = wp.clamp(int(u * float(frame.size)), 0, frame.size - 1)
                row = wp.clamp(int(v * float(frame.size)), 0, frame.size - 1)
                found = (face * frame.size + row) * frame.size + column
    return found


class _Elements:
    """The points so far, one for each surface in a part of a cell: that of the view which came first."""

    def __init__(self, surfaces: int):
        self.surfaces = surfaces
        self.keys = np.zeros(0, np.int64)
        self.kept: list[dict[str, np.ndarray]] = []

    def add(self, cell: np.ndarray, found: dict[str, np.ndarray]) -> None:
        """Adds the points of a view whose cell and surface have none yet."""
        keys, first = np.unique(cell * self.surfaces + found["surface"], return_index=True)
        new = ~np.isin(keys, self.keys, assume_unique=True)
        self.keys = np.concatenate([self.keys, keys[new]])
        self.kept.append({name: values[first[new]] for name, values in found.items()})

    def sorted(self, size: int) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """All points by the cells of a map of `size`, and those [E]."""
        face, place = np.divmod(self.keys // self.surfaces, (PARTS * size) ** 2)
        row, column = np.divmod(place, PARTS * size)
        cell = (face * size + row // PARTS) * size + column // PARTS
        order = np.lexsort((self.keys, cell))
        merged = {name: np.concatenate([each[name] for each in self.kept])[order] for name in self.kept[0]}
        return cell[order], merged


def _look_from(
    still: StillTable,
    frame: FrameTable,
    fine: FrameTable,
    reference: np.ndarray,
    aside: np.ndarray,
    device: wp.Device,
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """What a reference view sees: cells of `fine`, the points' surface, position, normal and that of their triangle.

    A ray goes through every cell of `frame`, at the place `aside` in it, from 0 to 1 [2].
    """
    rays = frame.rotation.shape[0] * frame.size**2
    cell, surface = (wp.zeros((1, rays), dtype=wp.int32, device=device) for _ in range(2))
    vectors = [wp.zeros((1, rays), dtype=wp.vec3, device=device) for _ in range(3)]
    inputs = [still, frame, fine, wp.vec3(*map(float, reference)), wp.vec2(*map(float, aside))]
    launch(_find_points, (1, rays), inputs, [cell, surface, *vectors], device)
    there = cell.numpy()[0] >= 0
    names = ("position", "normal", "facing")
    found = {name: array.numpy()[0][there] for name, array in zip(names, vectors, strict=True)}
    return cell.numpy()[0][there].astype(np.int64), found | {"surface": surface.numpy()[0][there]}


@wp.kernel(enable_backward=False, module="unique")
def _find_points(
    first: int,
    still: StillTable,
    frame: FrameTable,
    fine: FrameTable,
    reference: wp.vec3,
    aside: wp.vec2,
    cell_out: wp.array2d(dtype=wp.int32),  # (world, ray), -1: nothing that the map covers
    surface_out: wp.array2d(dtype=wp.int32),  # (world, ray)
    position_out: wp.array2d(dtype=wp.vec3),  # (world, ray)
    normal_out: wp.array2d(dtype=wp.vec3),  # (world, ray)
    facing_out: wp.array2d(dtype=wp.vec3),  # (world, ray): of the triangle
):
    world, ray = wp.tid()
    ray += first
    face = ray / (frame.size * frame.size)
    place = ray % (frame.size * frame.size)
    x = frame.middle[0] + frame.half * (2.0 * (float(place % frame.size) + aside[0]) / float(frame.size) - 1.0)
    y = frame.middle[1] + frame.half * (1.0 - 2.0 * (float(place / frame.size) + aside[1]) / float(frame.size))
    cell_out[world, ray] = -1
    if wp.max(wp.abs(x), wp.abs(y)) >= 1.0:
        return
    hit = meet(still, reference, frame.rotation[face] * direction_of(x, y), FARTHEST)
    if hit.face >= 0:
        cell_out[world, ray] = cell_of(fine, hit.position)
        surface_out[world, ray] = hit.surface
        position_out[world, ray] = hit.position
        normal_out[world, ray] = smooth_normal(still, hit)
        facing_out[world, ray] = hit.normal


def _ask(still: StillTable, light: LightTable, kept: dict[str, np.ndarray], device: wp.Device) -> np.ndarray:
    """The share of the light that reaches each point, float32 [E]."""
    count = len(kept["position"])
    visibility = wp.zeros((1, count), dtype=wp.float32, device=device)
    arrays = [wp.array(kept[name][None], dtype=wp.vec3, device=device) for name in ("position", "facing", "normal")]
    launch(_ask_points, (1, count), [still, light, *arrays], [visibility], device)
    return visibility.numpy()[0]


@wp.kernel(enable_backward=False, module="unique")
def _ask_points(
    first: int,
    still: StillTable,
    light: LightTable,
    position: wp.array2d(dtype=wp.vec3),  # (world, point)
    facing: wp.array2d(dtype=wp.vec3),  # (world, point)
    normal: wp.array2d(dtype=wp.vec3),  # (world, point)
    visibility_out: wp.array2d(dtype=wp.float32),  # (world, point)
):
    world, point = wp.tid()
    point += first
    p = position[world, point]
    visibility_out[world, point] = visible_ratio(
        still, light, world, p, facing[world, point], normal[world, point], False
    )
