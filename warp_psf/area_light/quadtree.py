"""Importance-based adaptive sampling of square maps, and the quad-trees that keep its samples (Jeng 2005, 3.2)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

# Corners of a cell, in the order in which everything here has them: (column, row) in cells.
CORNERS = np.array([[0, 0], [1, 0], [0, 1], [1, 1]])
# Maps that grow at a time, and how many places they may have together, a number each in a dense table: more maps of
# 513 x 513 than four take longer, and much memory where they are full.
MAPS_AT_A_TIME, PLACES_AT_A_TIME = 64, 4 * 513**2
# More samples than this are a mistaken size, not a wish: 6 GB.
MOST_SAMPLES = 200_000_000

Sample = Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, ...]]
Split = Callable[[np.ndarray, tuple[np.ndarray, ...]], np.ndarray]


@dataclass(frozen=True, eq=False)
class Quadtrees:
    """Square maps of (2^n + 1)^2 possible samples, with those that were taken.

    size: samples along a side of a map, 2^n + 1.
    preset: the level to which every cell is divided: a map's first nodes are its 2^preset x 2^preset cells, by rows.
    first_node: of each map, int64 [maps + 1].
    link: int32 [nodes]: the first of a node's four children, in the order of `CORNERS`, or -1 - leaf for a leaf.
    corners: samples at the corners of each leaf, in the order of `CORNERS`, int32 [leaves, 4].
    first_sample: of each map, int64 [maps + 1].
    samples: what was sampled, one array [samples, ...] per quantity.
    """

    size: int
    preset: int
    first_node: np.ndarray
    link: np.ndarray
    corners: np.ndarray
    first_sample: np.ndarray
    samples: tuple[np.ndarray, ...]

    @property
    def counts(self) -> np.ndarray:
        """Samples of each map, int64 [maps]."""
        return np.diff(self.first_sample)

    @property
    def nbytes(self) -> int:
        """What nodes, leaves and samples take, bytes."""
        return self.link.nbytes + self.corners.nbytes + sum(array.nbytes for array in self.samples)


def levels_of(size: int, what: str) -> int:
    """n of a size 2^n + 1.

    Raises:
        ValueError: the size is none of these, or beyond 4097.
    """
    levels = int(size - 1).bit_length() - 1 if isinstance(size, (int, np.integer)) and size > 1 else -1
    if not 1 <= levels <= 12 or size != 2**levels + 1:
        raise ValueError(f"{what} is {size!r}; give 2^n + 1 with n from 1 to 12, for example 257, 513 or 1025")
    return levels


def grow_quadtrees(maps: int, size: int, preset: int, sample: Sample, split: Split) -> Quadtrees:
    """Samples maps adaptively.

    sample(map, column, row), int64 [N] each: what is there, one array [N, ...] per quantity.
    split(cells, corners): whether to divide cells, bool [N]. cells: int64 [N, 4]: map, column, row and side, in
        samples; corners: what was sampled at their corners, one array [N, 4, ...] per quantity. Cells above the preset
        level and those of side 1 are not asked.

    Source: Jeng 2005, section 3.2.2.

    Raises:
        ValueError: there are more than `MOST_SAMPLES`.
    """
    at_a_time = min(MAPS_AT_A_TIME, max(1, PLACES_AT_A_TIME // size**2))
    _check_samples(maps * (2**preset + 1) ** 2)
    groups: list[Quadtrees] = []
    for begin in range(0, maps, at_a_time):
        groups.append(_grow(np.arange(begin, min(begin + at_a_time, maps)), size, preset, sample, split))
        _check_samples(sum(int(group.first_sample[-1]) for group in groups))
    return groups[0] if len(groups) == 1 else _join(groups)


def _check_samples(count: int) -> None:
    if count > MOST_SAMPLES:
        raise ValueError(f"the maps have more than {MOST_SAMPLES} samples; make them smaller, or fewer")


class _Samples:
    """The samples so far, and where on the maps they are."""

    def __init__(self, maps: np.ndarray, size: int, sample: Sample):
        self.maps, self.size, self.sample = maps, size, sample
        self.number = np.full(len(maps) * size * size, -1, np.int32)
        self.place: list[np.ndarray] = []
        self.taken: list[tuple[np.ndarray, ...]] = []
        self.count = 0

    def at(self, cells: np.ndarray, aside: np.ndarray) -> np.ndarray:
        """Numbers of the samples at places `aside` [K, 2] of cells' first corners, -1 where there is none, [N, K]."""
        return self.number[self._places(cells, aside[None])]

    def at_corners(self, cells: np.ndarray) -> np.ndarray:
        """The samples at cells' corners, taken where there are none yet, int64 [N, 4]."""
        place = self._places(cells, cells[:, 3, None, None] * CORNERS)
        new = np.unique(place[self.number[place] < 0])
        if len(new):
            self.number[new] = np.arange(self.count, self.count + len(new))
            self.count += len(new)
            self.place.append(new)
            in_map = new % self.size**2
            self.taken.append(self.sample(self.maps[new // self.size**2], in_map % self.size, in_map // self.size))
        return self.number[place].astype(np.int64)

    def quantities(self) -> tuple[np.ndarray, ...]:
        """All that was sampled."""
        self.taken = [tuple(np.concatenate(arrays) for arrays in zip(*self.taken, strict=True))]
        return self.taken[0]

    def values(self, numbers: np.ndarray) -> tuple[np.ndarray, ...]:
        """What was sampled at given numbers."""
        return tuple(array[numbers] for array in self.quantities())

    def _places(self, cells: np.ndarray, aside: np.ndarray) -> np.ndarray:
        column, row = cells[:, None, 1] + aside[..., 0], cells[:, None, 2] + aside[..., 1]
        return (cells[:, None, 0] * self.size + row) * self.size + column


class _Nodes:
    """The cells of all maps of a group, and the first child of each."""

    def __init__(self, cells: np.ndarray):
        self.cells, self.corners, self.child = cells, np.zeros((len(cells), 4), np.int64), np.full(len(cells), -1)

    def divide(self, chosen: np.ndarray) -> np.ndarray:
        """Gives the nodes of numbers `chosen` four children each, and returns those."""
        parents = self.cells[chosen]
        half = parents[:, 3:] // 2
        children = np.repeat(parents, 4, axis=0)
        children[:, 1:3] += (half[:, None] * CORNERS).reshape(-1, 2)
        children[:, 3] //= 2
        first = len(self.cells)
        self.child[chosen] = first + 4 * np.arange(len(chosen))
        self.cells = np.concatenate([self.cells, children])
        self.corners = np.concatenate([self.corners, np.zeros((len(children), 4), np.int64)])
        self.child = np.concatenate([self.child, np.full(len(children), -1)])
        return np.arange(first, len(self.cells))


def _grow(maps: np.ndarray, size: int, preset: int, sample: Sample, split: Split) -> Quadtrees:
    side = (size - 1) >> preset
    steps = np.arange(1 << preset) * side
    index, row, column = np.meshgrid(np.arange(len(maps)), steps, steps, indexing="ij")
    nodes = _Nodes(np.stack([array.ravel() for array in (index, column, row, np.full(index.shape, side))], axis=1))
    samples = _Samples(maps, size, sample)
    new = np.arange(len(nodes.cells))
    while len(new):
        while len(new):
            nodes.corners[new] = samples.at_corners(nodes.cells[new])
            wide = new[nodes.cells[new, 3] > 1]
            chosen = wide[split(nodes.cells[wide], samples.values(nodes.corners[wide]))] if len(wide) else wide
            new = nodes.divide(chosen)
        # What is narrower than a cell and missed by its corners may be met at its sides, by finer neighbours.
        new = nodes.divide(_find_met_aside(nodes, samples, split))
    leaf = nodes.child < 0
    link = np.where(leaf, -np.cumsum(leaf), nodes.child).astype(np.int32)
    order, first_sample, number = _by_map(np.concatenate(samples.place), size, len(maps))
    quantities = tuple(array[order] for array in samples.quantities())
    # Below the first level, the nodes of all maps lie behind one another.
    first_node = np.arange(len(maps) + 1, dtype=np.int64) << (2 * preset)
    corners = number[nodes.corners[leaf]].astype(np.int32)
    return Quadtrees(size, preset, first_node, link, corners, first_sample, quantities)


def _find_met_aside(nodes: _Nodes, samples: _Samples, split: Split) -> np.ndarray:
    """The numbers of leaves that would be divided if a sample on one of their sides were their last corner."""
    found = []
    leaves = np.flatnonzero((nodes.child < 0) & (nodes.cells[:, 3] > 1))
    for side in np.unique(nodes.cells[leaves, 3]):
        chosen = leaves[nodes.cells[leaves, 3] == side]
        along = np.arange(1, side)
        aside = np.concatenate([np.stack(np.broadcast_arrays(*each), axis=1) for each in _sides(along, side)])
        at = samples.at(nodes.cells[chosen], aside)
        which, place = np.nonzero(at >= 0)
        if len(which):
            corners = nodes.corners[chosen[which]].copy()
            corners[:, 3] = at[which, place]
            divided = split(nodes.cells[chosen[which]], samples.values(corners))
            found.append(np.unique(chosen[which[divided]]))
    return np.concatenate(found) if found else leaves[:0]


def _sides(along: np.ndarray, side: int) -> list[tuple]:
    """(column, row) of samples along the four sides of a cell."""
    return [(along, 0), (along, side), (0, along), (side, along)]


def _by_map(place: np.ndarray, size: int, maps: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Samples in the order of their maps, rows and columns: the order, each map's first, and the new numbers."""
    order = np.argsort(place, kind="stable")
    number = np.empty(len(place), np.int64)
    number[order] = np.arange(len(place))
    first = np.searchsorted(place[order], np.arange(maps + 1) * size**2)
    return order, first, number


def _join(groups: list[Quadtrees]) -> Quadtrees:
    """The maps of all groups behind one another."""
    nodes = np.cumsum([0, *(len(group.link) for group in groups)])
    leaves = np.cumsum([0, *(len(group.corners) for group in groups)])
    samples = np.cumsum([0, *(group.first_sample[-1] for group in groups)])
    first_node = [group.first_node[:-1] + nodes[k] for k, group in enumerate(groups)]
    link = [np.where(group.link >= 0, group.link + nodes[k], group.link - leaves[k]) for k, group in enumerate(groups)]
    first_sample = [group.first_sample[:-1] + samples[k] for k, group in enumerate(groups)]
    return Quadtrees(
        groups[0].size,
        groups[0].preset,
        np.append(np.concatenate(first_node), nodes[-1]),
        np.concatenate(link).astype(np.int32),
        np.concatenate([group.corners + samples[k] for k, group in enumerate(groups)]).astype(np.int32),
        np.append(np.concatenate(first_sample), samples[-1]),
        tuple(np.concatenate(arrays) for arrays in zip(*(group.samples for group in groups), strict=True)),
    )
