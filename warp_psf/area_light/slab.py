"""The shadow slab: a plane of light samples, and an adaptively sampled shadow map of each (Jeng 2005, 3.3.1).

All maps look along the plane's normal and cover one square of a focal plane, as the two planes of a light slab do. A
map keeps inverse depths: over a flat surface those are linear in the map's coordinates, so that four samples at a
leaf's corners hold a flat surface exactly, however steep it is, and only edges and curved surfaces need more of them.
"""

from dataclasses import dataclass
from reprlib import repr as brief

import numpy as np
import warp as wp

from warp_psf.area_light.checks import check_type, read_numbers
from warp_psf.area_light.quadtree import Quadtrees, grow_quadtrees, levels_of
from warp_psf.area_light.tracing import StillTable, meet, seen_points, upload_still
from warp_psf.device import find_device, launch
from warp_psf.scene.light import AreaLight
from warp_psf.scene.still import StillScene

# Cells are divided to this level at least, so that bodies wider than a 32nd of a map are found.
PRESET = 5
# Curved surfaces are divided where the depths of a cell's corners differ by more than this share of themselves.
DEPTH_SPREAD = 0.01
# Maps look no further aside than this, as a tangent: 76 degrees. What is beyond is lit by less than a 17th.
WIDEST = 4.0
# A surface hides a point when it is nearer to the light by more than this share of the depth: float32 keeps flat ones
# to 1e-6, a neighbouring sample lies off a curved one by about this. A curved surface hides itself beyond the spread
# that its leaves may have.
BIAS, OWN_BIAS = wp.constant(1.0e-3), wp.constant(DEPTH_SPREAD)
# Metres: no map looks farther, and what is nearer counts as this near.
FARTHEST, NEAREST = wp.constant(1.0e6), wp.constant(1.0e-4)
# Light samples along a side: 4,096 maps of 513 x 513 take about 3 GB.
MOST_SAMPLES = 64
# Rays per side with which a camera finds out what a slab must cover, and how much wider than that the maps are.
PROBES, MARGIN = 64, 1.02
# So few rays that meet something do not tell how wide it is: then the maps cover the whole scene.
FEWEST_SEEN = 64
# Half a map's side is this at least, as a tangent: what lies too far aside for any map may shrink to a point.
NARROWEST = 1e-6


@dataclass(frozen=True, eq=False)
class LightPlane:
    """A rectangle of light samples: cells of rows x columns, of which any may shine. See `make_light_plane`.

    Attributes:
        center: world, metres, float64 [3].
        right, up: from the centre to the middle of the right and of the upper side, at right angles, metres, float64
            [3]; the plane shines along right x up.
        rows, columns: of samples, 1 to 64; row 0 is the uppermost.

    Raises:
        ValueError: a value is not a number or of another shape, a side has no length, the sides are not at right
            angles, or there is no row or column.
    """

    center: np.ndarray
    right: np.ndarray
    up: np.ndarray
    rows: int
    columns: int

    def __post_init__(self) -> None:
        for name in ("center", "right", "up"):
            given = getattr(self, name)
            value = read_numbers(f"{name} of a light plane", given)
            if value.shape != (3,) or not (np.abs(value) <= FARTHEST).all():
                raise ValueError(
                    f"{name} of a light plane is {brief(given)}; give three numbers, metres, to {FARTHEST:g}"
                )
            object.__setattr__(self, name, value)
        lengths = np.linalg.norm(self.right), np.linalg.norm(self.up)
        if min(lengths) < 1e-9 or abs(self.right @ self.up) > 1e-4 * lengths[0] * lengths[1]:
            raise ValueError("right and up of a light plane must have a length and be at right angles; change one")
        for name in ("rows", "columns"):
            value = getattr(self, name)
            if not isinstance(value, (int, np.integer)) or not 1 <= value <= MOST_SAMPLES or isinstance(value, bool):
                raise ValueError(
                    f"{name} of a light plane is {brief(value)}; give a whole number from 1 to {MOST_SAMPLES}"
                )
            object.__setattr__(self, name, int(value))

    @property
    def axes(self) -> np.ndarray:
        """world_from_plane: columns are right, up and the direction that it shines in, float64 [3, 3]."""
        x, y = self.right / np.linalg.norm(self.right), self.up / np.linalg.norm(self.up)
        return np.stack([x, y, np.cross(x, y)], axis=1)

    @property
    def cell_area(self) -> float:
        """The area of a sample's cell, m^2."""
        return 4.0 * float(np.linalg.norm(self.right) * np.linalg.norm(self.up)) / (self.rows * self.columns)

    @property
    def positions(self) -> np.ndarray:
        """Centres of the samples' cells, world, metres, float64 [rows, columns, 3]."""
        across = 2.0 * (np.arange(self.columns) + 0.5) / self.columns - 1.0
        upwards = 1.0 - 2.0 * (np.arange(self.rows) + 0.5) / self.rows
        return self.center + across[None, :, None] * self.right + upwards[:, None, None] * self.up


def make_light_plane(light: AreaLight, rows: int, columns: int) -> LightPlane:
    """The plane of a rectangular light, whose place it takes: row 0 is at its +y. Its radiance is of no matter.

    Args:
        light: of `warp_psf.rectangle_light`, in the world.
        rows, columns: of samples, 1 to 64.

    Raises:
        ValueError: the light is no flat rectangle or hangs on a body, or there is no row or column.
        TypeError: it is no area light.
    """
    check_type("light", light, AreaLight, "rectangle_light")
    slab = light.mesh.slab
    if slab is None or slab[2][2] > 0.0 or light.body is not None:
        raise ValueError(f"light {light.name!r} is no flat rectangle in the world; make one with rectangle_light")
    center, rotation, half = slab
    axes = light.rotation @ rotation
    return LightPlane(
        light.position + light.rotation @ center, half[0] * axes[:, 0], half[1] * axes[:, 1], rows, columns
    )


@dataclass(frozen=True, eq=False)
class ShadowSlab:
    """The shadow maps of a light plane's samples, row after row. Built by `bake_shadow_slab`.

    Attributes:
        plane: the light samples.
        window: of each sample's map: the middle of its square (right, up), tangents, float32 [maps, 2].
        half: half the square's side, as a tangent.
        maps: quad-trees, whose samples are (inverse depth 1/m, float32; surface, int32; 0 and -1 where nothing is).
        scene: checksum of the scene.
    """

    plane: LightPlane
    window: np.ndarray
    half: float
    maps: Quadtrees
    scene: int

    @property
    def share(self) -> float:
        """Samples that were taken, as a share of those of full maps."""
        return float(self.maps.counts.sum() / (len(self.maps.counts) * self.maps.size**2))


def bake_shadow_slab(
    scene: StillScene,
    plane: LightPlane,
    size: int = 513,
    *,
    preset: int | None = None,
    device: str | None = None,
) -> ShadowSlab:
    """Samples the shadow map of every light sample adaptively. Source: Jeng 2005, section 3.3.1.

    What the scene's cameras see is what the maps cover; without cameras, all of the scene.

    Args:
        scene: what casts shadows, and takes them.
        plane: the light samples.
        size: samples along the side of a full map, 2^n + 1, at most 4097.
        preset: the level to which maps are divided everywhere, 0 to n; 5, or n where that is less, without. With n the
            maps are full.
        device: "cpu", "cuda:0", ...; None takes the first CUDA device, else the CPU.

    Raises:
        ValueError: a value is not usable, nothing of the scene is before the plane, or the maps are too many and large.
        TypeError: `scene` or `plane` is something else.
    """
    check_type("plane", plane, LightPlane, "make_light_plane")
    levels = levels_of(size, "size of a shadow map")
    preset = min(PRESET, levels) if preset is None else preset
    if not isinstance(preset, (int, np.integer)) or not 0 <= preset <= levels:
        raise ValueError(f"preset is {preset!r}; give a level from 0 to {levels}, which divides a map to the last")
    on_device = find_device(device)
    still = upload_still(scene, on_device)
    positions = plane.positions.reshape(-1, 3)
    window, half = _cover(scene, still.table, plane, positions, on_device)
    axes = wp.mat33(*map(float, plane.axes.ravel()))

    def sample(maps: np.ndarray, column: np.ndarray, row: np.ndarray) -> tuple[np.ndarray, ...]:
        place = (2.0 * np.stack([column, -row], axis=1) / (size - 1) + [-1.0, 1.0]) * half + window[maps]
        origins = wp.array(positions[maps], dtype=wp.vec3, device=on_device)
        tangents = wp.array(place, dtype=wp.vec2, device=on_device)
        inverse = wp.zeros(len(maps), dtype=wp.float32, device=on_device)
        surface = wp.zeros(len(maps), dtype=wp.int32, device=on_device)
        inputs = [still.table, axes, origins, tangents]
        launch(_sample_depths, (1, len(maps)), inputs, [inverse, surface], on_device)
        return inverse.numpy(), surface.numpy()

    def split(_cells: np.ndarray, corners: tuple[np.ndarray, ...]) -> np.ndarray:
        inverse, surface = corners
        one = (surface == surface[:, :1]).all(axis=1)
        curved = one & (surface[:, 0] >= 0) & ~scene.flat[surface[:, 0]]
        return ~one | (curved & (inverse.max(axis=1) > (1.0 + DEPTH_SPREAD) * inverse.min(axis=1)))

    maps = grow_quadtrees(len(positions), size, int(preset), sample, split)
    return ShadowSlab(plane, window.astype(np.float32), half, maps, scene.checksum)


@wp.kernel(enable_backward=False, module="unique")
def _sample_depths(
    first: int,
    still: StillTable,
    axes: wp.mat33,
    origins: wp.array(dtype=wp.vec3),  # (sample)
    tangents: wp.array(dtype=wp.vec2),  # (sample)
    inverse_out: wp.array(dtype=wp.float32),  # (sample)
    surface_out: wp.array(dtype=wp.int32),  # (sample)
):
    world, index = wp.tid()
    index += first
    place = tangents[index]
    # Of unit depth, so that distances along it are depths.
    hit = meet(still, origins[index], axes * wp.vec3(place[0], place[1], 1.0), FARTHEST)
    surface_out[index] = hit.surface
    inverse_out[index] = wp.where(hit.face >= 0, 1.0 / wp.max(hit.distance, NEAREST), 0.0)


def _cover(
    scene: StillScene, still: StillTable, plane: LightPlane, positions: np.ndarray, device: wp.Device
) -> tuple[np.ndarray, float]:
    """The middles of all maps' squares [maps, 2] and half their side, tangents: one square of the focal plane.

    The focal plane lies as deep as the farthest point that is covered.
    """
    points = scene.vertices.astype(np.float64)
    if scene.cameras:
        seen = np.concatenate([seen_points(still, camera, PROBES, device) for camera in scene.cameras])
        points = points if len(seen) < FEWEST_SEEN else seen
    local = (points - plane.center) @ plane.axes
    local = local[local[:, 2] > 0.0]
    if not len(local):
        raise ValueError("nothing that the cameras see is before the light plane; turn it, or swap right and up")
    samples = (positions - plane.center) @ plane.axes
    corners = np.array([samples.min(axis=0), samples.max(axis=0)])[:, :2]
    focus = float(local[:, 2].max())
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for corner in (corners[0], corners[1]):
        tangent = np.clip((local[:, :2] - corner) / local[:, 2:], -WIDEST, WIDEST)
        at = corner + focus * tangent
        low, high = np.minimum(low, at.min(axis=0)), np.maximum(high, at.max(axis=0))
    half = MARGIN * 0.5 * float((high - low).max())
    return (0.5 * (low + high) - samples[:, :2]) / focus, max(half / focus, NARROWEST)


@wp.struct
class SlabTable:
    """A shadow slab on the device."""

    axes: wp.mat33  # world_from_plane
    positions: wp.array(dtype=wp.vec3)  # (map), metres
    window: wp.array(dtype=wp.vec2)  # (map), tangents
    half: wp.float32  # of a map's square, as a tangent
    cells: wp.float32  # along the side of a full map
    grid: wp.int32  # cells along it on the preset level
    cell_area: wp.float32  # of a light sample, m^2
    first_node: wp.array(dtype=wp.int32)  # (map)
    link: wp.array(dtype=wp.int32)  # (node), as in `Quadtrees`
    corners: wp.array(dtype=wp.vec4i)  # (leaf)
    inverse: wp.array(dtype=wp.float32)  # (sample), 1/m
    surface: wp.array(dtype=wp.int32)  # (sample)


@wp.func
def visible_share(slab: SlabTable, sample: int, p: wp.vec3, n: wp.vec3, surface: int, flat: bool) -> float:
    """How far a light sample is visible from a point of a surface with normal n, by its map: 0 to 1 across an edge.

    Each of the four samples about the point tells whether what it met lies before the point's surface, which is taken
    for flat from the point to there; their answers are blended. Source: Jeng 2005, section 3.2.3.
    """
    x = wp.vec3(slab.axes[0, 0], slab.axes[1, 0], slab.axes[2, 0])
    y = wp.vec3(slab.axes[0, 1], slab.axes[1, 1], slab.axes[2, 1])
    z = wp.vec3(slab.axes[0, 2], slab.axes[1, 2], slab.axes[2, 2])
    offset = p - slab.positions[sample]
    inverse = 1.0 / wp.dot(offset, z)
    window = slab.window[sample]
    to_cells = 0.5 * slab.cells / slab.half
    u = (inverse * wp.dot(offset, x) - window[0] + slab.half) * to_cells
    v = (window[1] + slab.half - inverse * wp.dot(offset, y)) * to_cells
    if not (u >= 0.0 and v >= 0.0 and u <= slab.cells and v <= slab.cells):
        # Beyond the map nothing is known to be in the way. What is no number, by a point within the plane, is beyond.
        return 1.0
    side = slab.cells / float(slab.grid)
    column = wp.min(int(u / side), slab.grid - 1)
    row = wp.min(int(v / side), slab.grid - 1)
    u -= float(column) * side
    v -= float(row) * side
    link = slab.link[slab.first_node[sample] + row * slab.grid + column]
    while link >= 0:
        side *= 0.5
        child = int(0)
        if u >= side:
            u -= side
            child += 1
        if v >= side:
            v -= side
            child += 2
        link = slab.link[link + child]
    corners = slab.corners[-1 - link]
    u /= side
    v /= side
    met = wp.vec4i(
        slab.surface[corners[0]], slab.surface[corners[1]], slab.surface[corners[2]], slab.surface[corners[3]]
    )
    depths = wp.vec4(
        slab.inverse[corners[0]], slab.inverse[corners[1]], slab.inverse[corners[2]], slab.inverse[corners[3]]
    )
    weights = wp.vec4((1.0 - u) * (1.0 - v), u * (1.0 - v), (1.0 - u) * v, u * v)
    if met[0] == met[1] and met[0] == met[2] and met[0] == met[3]:
        if met[0] < 0 or (met[0] == surface and flat):
            return 1.0
        margin = wp.where(met[0] == surface, OWN_BIAS, BIAS)
        return wp.where(wp.dot(weights, depths) <= inverse * (1.0 + margin), 1.0, 0.0)
    # The inverse depth of the point's surface at the corners: n . ray / n . offset.
    facing = 1.0 / wp.dot(n, offset)
    along_u = facing * wp.dot(n, x) * side / to_cells
    along_v = -facing * wp.dot(n, y) * side / to_cells
    share = float(0.0)
    for k in range(4):
        here = inverse + (float(k % 2) - u) * along_u + (float(k / 2) - v) * along_v
        # A steep surface spans a range of depths within a sample; what lies in it beside the surface does not hide it.
        here = wp.max(here, inverse + wp.abs(along_u) + wp.abs(along_v))
        margin = wp.where(met[k] == surface, OWN_BIAS, BIAS)
        if depths[k] <= here * (1.0 + margin) or (met[k] == surface and flat):
            share += weights[k]
    return share


def upload_slab(slab: ShadowSlab, device: wp.Device) -> SlabTable:
    """Puts a slab on the device."""
    table = SlabTable()
    table.axes = wp.mat33(*map(float, slab.plane.axes.ravel()))
    table.positions = wp.array(slab.plane.positions.reshape(-1, 3), dtype=wp.vec3, device=device)
    table.window = wp.array(slab.window, dtype=wp.vec2, device=device)
    table.half, table.cells = slab.half, float(slab.maps.size - 1)
    table.grid, table.cell_area = 1 << slab.maps.preset, slab.plane.cell_area
    table.first_node = wp.array(slab.maps.first_node.astype(np.int32), dtype=wp.int32, device=device)
    table.link = wp.array(slab.maps.link, dtype=wp.int32, device=device)
    table.corners = wp.array(slab.maps.corners, dtype=wp.vec4i, device=device)
    inverse, surface = slab.maps.samples
    table.inverse = wp.array(inverse, dtype=wp.float32, device=device)
    table.surface = wp.array(surface, dtype=wp.int32, device=device)
    return table
