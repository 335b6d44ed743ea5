"""Priority point lists: a mesh as points, few within its triangles and many along their edges (Jeng 2005, 5.2).

Every triangle lies on a grid of squares in its plane. A square inside the triangle becomes a point; one that its edges
cross is divided, down to the smallest ones, which become points too. Points of one size make a list, the largest first.
A divided square also leaves a stand-in, which is shown in place of all its points where they are too small to be seen.
"""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Real

import numpy as np

from warp_psf.area_light.checks import check_type
from warp_psf.scene.still import StillScene

# The smallest squares of a scene that says nothing else are this share of its extent.
SMALLEST_SHARE = 1.0 / 1000.0
# Metres; float32 holds the places of larger ones, too, but no scene has any.
LARGEST_SQUARE = 1.0e9
# Points of a triangle that are culled, and carried to the device's cores, together.
POINTS_PER_GROUP = 256
# More squares than this are a mistaken size, not a wish: 6 GB while they are told apart.
MOST_POINTS = 100_000_000
# Squares that are tested at a time.
SQUARES_AT_A_TIME = 1 << 21


@dataclass(frozen=True, eq=False)
class PointLists:
    """Points of triangles, list after list, in groups of one list and one triangle. Built by `sample_points`.

    Attributes:
        smallest: side of the last list's squares, metres; each list's are twice as wide as the next one's.
        levels: how many lists there are.
        origin, axes, normal: of each triangle's plane, world, metres: float64 [T, 3], [T, 2, 3] and [T, 3].
        albedo: of each triangle, linear, float32 [T, 3].
        sides: of each triangle's sides, inward unit normal and offset in its plane, metres, float64 [T, 3, 3]:
            (x, y, 1) times them is how far a point lies within the sides.
        cell: column and row of each point's square on its triangle's grid, in squares of its list, int32 [points, 2].
        first: where each group's points begin, int64 [groups + 1].
        triangle, level: of each group, int32 [groups]; lists are counted from 0.
        stands_in: whether a group's points stand for smaller ones, bool [groups].
        alone: whether a group's point is its triangle's only one, bool [groups].
    """

    smallest: float
    levels: int
    origin: np.ndarray
    axes: np.ndarray
    normal: np.ndarray
    albedo: np.ndarray
    sides: np.ndarray
    cell: np.ndarray
    first: np.ndarray
    triangle: np.ndarray
    level: np.ndarray
    stands_in: np.ndarray
    alone: np.ndarray

    @property
    def counts(self) -> np.ndarray:
        """Points of each list, without stand-ins, int64 [levels]."""
        sizes = np.where(self.stands_in, 0, np.diff(self.first))
        return np.bincount(self.level, sizes, self.levels).astype(np.int64)

    def size(self, level: int) -> float:
        """Side of a list's squares, metres; level 0 is the list of the largest ones."""
        return self.smallest * 2.0 ** (self.levels - 1 - level)


def sample_points(scene: StillScene, *, smallest: float | None = None, levels: int = 4) -> PointLists:
    """Samples every triangle of a scene into lists.

    A triangle smaller than the smallest square is one point. Source: Jeng 2005, section 5.2.2.

    Args:
        scene: the triangles.
        smallest: side of the smallest squares, metres; a thousandth of the scene's extent without.
        levels: how many lists, 1 to 6; each list's squares are twice as wide as the next one's.

    Raises:
        ValueError: a value is not usable, or there would be more than 100 million points.
        TypeError: `scene` is no still scene.
    """
    check_type("scene", scene, StillScene, "freeze_scene or make_still")
    if not isinstance(levels, (int, np.integer)) or not 1 <= levels <= 6:
        raise ValueError(f"levels is {levels!r}; give 1 to 6 lists, of which 3 or 4 suit most meshes")
    corners = scene.vertices[scene.faces].astype(np.float64)
    extent = float(np.ptp(scene.vertices, axis=0).max())
    smallest = SMALLEST_SHARE * extent if smallest is None else smallest
    if not isinstance(smallest, Real) or not 0.0 < smallest <= LARGEST_SQUARE:
        raise ValueError(
            f"smallest is {smallest!r}; give the side of the smallest squares in metres, above 0 and at most "
            f"{LARGEST_SQUARE:g}"
        )
    smallest, levels = float(smallest), int(levels)
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    largest = smallest * 2.0 ** (levels - 1)
    if area.sum() / largest**2 > MOST_POINTS:
        raise ValueError(f"squares of {smallest:g} m make more than {MOST_POINTS} points; give a larger `smallest`")
    origin, axes, normal, flat = _planes(corners)
    sides = _sides(flat)
    lists = []
    triangle, cell = _covering(flat, largest)
    for level in range(levels):
        size = smallest * 2.0 ** (levels - 1 - level)
        inside, met = _classify(flat, sides, triangle, cell, size)
        last = level == levels - 1
        leaf = met if last else inside
        divided = met & ~leaf
        lists.append((level, False, triangle[leaf], cell[leaf]))
        lists.append((level, True, triangle[divided], cell[divided]))
        triangle = np.repeat(triangle[divided], 4)
        cell = (2 * cell[divided][:, None] + [[0, 0], [1, 0], [0, 1], [1, 1]]).reshape(-1, 2)
        if len(triangle) > MOST_POINTS:
            raise ValueError(f"squares of {smallest:g} m make more than {MOST_POINTS} points; give a larger `smallest`")
    points = sum(np.bincount(each[2], minlength=len(flat)) for each in lists if not each[1])
    return _grouped(lists, points == 1, smallest, levels, origin, axes, normal, scene.albedo, sides)


def _planes(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Origins, axes and normals of the triangles' planes, and their corners there, float64 [T, 3, 2].

    The first axis lies along the longest side, so that squares lie along it.
    """
    sides = np.roll(corners, -1, axis=1) - corners
    longest = np.linalg.norm(sides, axis=2).argmax(axis=1)
    turned = np.take_along_axis(corners, ((longest[:, None] + np.arange(3)) % 3)[..., None], axis=1)
    x = turned[:, 1] - turned[:, 0]
    x /= np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-30)
    normal = np.cross(turned[:, 1] - turned[:, 0], turned[:, 2] - turned[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    axes = np.stack([x, np.cross(normal, x)], axis=1)
    offset = turned - turned[:, :1]
    return turned[:, 0], axes, normal, np.einsum("tcd,tad->tca", offset, axes)


def _sides(flat: np.ndarray) -> np.ndarray:
    """The inward unit normal and the offset of each side, float64 [T, 3, 3]. Corners run counter-clockwise."""
    along = np.roll(flat, -1, axis=1) - flat
    inward = np.stack([-along[..., 1], along[..., 0]], axis=-1)
    inward /= np.maximum(np.linalg.norm(inward, axis=2, keepdims=True), 1e-30)
    return np.concatenate([inward, -(inward * flat).sum(axis=2, keepdims=True)], axis=2)


def _covering(flat: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray]:
    """The squares of the coarsest grids that bound the triangles: triangle and cell of each."""
    low = np.floor(flat.min(axis=1) / size).astype(np.int64)
    count = np.floor(flat.max(axis=1) / size).astype(np.int64) - low + 1
    total = count.prod(axis=1)
    if total.sum() > MOST_POINTS:
        raise ValueError(f"squares of {size:g} m are too many on these triangles; give a larger `smallest`")
    triangle = np.repeat(np.arange(len(flat)), total)
    place = np.arange(len(triangle)) - np.repeat(np.cumsum(total) - total, total)
    column, row = place % count[triangle, 0], place // count[triangle, 0]
    return triangle, low[triangle] + np.stack([column, row], axis=1)


def _classify(
    flat: np.ndarray, sides: np.ndarray, triangle: np.ndarray, cell: np.ndarray, size: float
) -> tuple[np.ndarray, np.ndarray]:
    """Whether each square lies inside its triangle, and whether it meets it at all."""
    inward, offset = sides[..., :2], sides[..., 2]
    low, high = flat.min(axis=1), flat.max(axis=1)
    inside, met = np.empty(len(cell), bool), np.empty(len(cell), bool)
    for begin in range(0, len(cell), SQUARES_AT_A_TIME):
        part = slice(begin, begin + SQUARES_AT_A_TIME)
        of, middle = triangle[part], (cell[part] + 0.5) * size
        at = np.einsum("nsd,nd->ns", inward[of], middle) + offset[of]
        reach = 0.5 * size * np.abs(inward[of]).sum(axis=2)
        inside[part] = (at >= reach).all(axis=1)
        bounds = (middle + 0.5 * size >= low[of]) & (middle - 0.5 * size <= high[of])
        met[part] = (at >= -reach).all(axis=1) & bounds.all(axis=1)
    return inside, met


def _grouped(
    lists: list[tuple[int, bool, np.ndarray, np.ndarray]],
    alone: np.ndarray,
    smallest: float,
    levels: int,
    origin: np.ndarray,
    axes: np.ndarray,
    normal: np.ndarray,
    albedo: np.ndarray,
    sides: np.ndarray,
) -> PointLists:
    """Points in groups: of each list and triangle, at most POINTS_PER_GROUP neighbours."""
    cells, sizes, triangles, level_of, stand_ins = [], [], [], [], []
    for level, stands_in, triangle, cell in lists:
        # The squares of a triangle come by rows, or by the squares that were divided: neighbours follow one another.
        order = np.argsort(triangle, kind="stable")
        triangle = triangle[order]
        start = np.flatnonzero(np.diff(triangle, prepend=-1))
        count = np.diff(start, append=len(triangle))
        pieces = -(-count // POINTS_PER_GROUP)
        whole = np.repeat(count, pieces)
        piece = np.arange(pieces.sum()) - np.repeat(np.cumsum(pieces) - pieces, pieces)
        cells.append(cell[order])
        sizes.append(np.minimum(whole - piece * POINTS_PER_GROUP, POINTS_PER_GROUP))
        triangles.append(np.repeat(triangle[start], pieces))
        level_of.append(np.full(len(whole), level))
        stand_ins.append(np.full(len(whole), stands_in))
    triangle = np.concatenate(triangles).astype(np.int32)
    return PointLists(
        smallest,
        levels,
        origin,
        axes,
        normal,
        albedo,
        sides,
        np.concatenate(cells).astype(np.int32),
        np.concatenate([[0], np.cumsum(np.concatenate(sizes))]).astype(np.int64),
        triangle,
        np.concatenate(level_of).astype(np.int32),
        np.concatenate(stand_ins),
        alone[triangle],
    )
