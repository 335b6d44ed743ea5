"""Importance-based adaptive sampling of square maps, and the quad-trees that keep its samples (Jeng 2005, 3.2)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

# Corners of a cell, in the order in which everything here has them: (column, row) in cells.
CORNERS = np.array([[0, 0], [1, 0], [0, 1], [1, 1]])
# Maps that grow at a time: each has a dense table of its sample numbers while it grows.
MAPS_AT_A_TIME = 64

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
    """
    groups = [
        _grow(np.arange(begin, min(begin + MAPS_AT_A_TIME, maps)), size, preset, sample, split)
        for begin in range(0, maps, MAPS_AT_A_TIME)
    ]
    return groups[0] if len(groups) == 1 else _join(groups)


class _Samples:
    """The samples so far, and where on the maps they are."""

    def __init__(self, maps: np.ndarray, size: int, sample: Sample):
        self.maps, self.size, self.sample = maps, size, sample
        self.number = np.full(len(maps) * size * size, -1, np.int32)
        self.place: list[np.ndarray] = []
        self.taken: list[tuple[np.ndarray, ...]] = []
        self.count = 0

    def at_corners(self, cells: np.ndarray) -> np.ndarray:
        """The samples at cells' corners, taken where there are none yet, int64 [N, 4]."""
        column = cells[:, None, 1] + cells[:, None, 3] * CORNERS[:, 0]
        row = cells[:, None, 2] + cells[:, None, 3] * CORNERS[:, 1]
        place = (cells[:, None, 0] * self.size + row) * self.size + column
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


def _grow(maps: np.ndarray, size: int, preset: int, sample: Sample, split: Split) -> Quadtrees:
    side = (size - 1) >> preset
    steps = np.arange(1 << preset) * side
    index, row, column = np.meshgrid(np.arange(len(maps)), steps, steps, indexing="ij")
    cells = np.stack([array.ravel() for array in (index, column, row, np.full(index.shape, side))], axis=1)
    samples = _Samples(maps, size, sample)
    links, leaves, nodes_before, leaf_count = [], [], 0, 0
    while len(cells):
        corners = samples.at_corners(cells)
        divided = np.zeros(len(cells), bool)
        if cells[0, 3] > 1:
            divided = split(cells, tuple(array[corners] for array in samples.quantities()))
        link = np.empty(len(cells), np.int64)
        nodes_after = nodes_before + len(cells)
        link[divided] = nodes_after + 4 * np.arange(divided.sum())
        link[~divided] = -1 - (leaf_count + np.arange((~divided).sum()))
        leaf_count += int((~divided).sum())
        links.append(link)
        leaves.append(corners[~divided])
        half = cells[divided, 3:] // 2
        children = np.repeat(cells[divided], 4, axis=0)
        children[:, 1:3] += (half[:, None] * CORNERS).reshape(-1, 2)
        children[:, 3] //= 2
        cells, nodes_before = children, nodes_after
    order, first_sample, number = _by_map(np.concatenate(samples.place), size, len(maps))
    quantities = tuple(array[order] for array in samples.quantities())
    # Nodes of a level lie behind one another across maps: only the first level is found by its map.
    first_node = np.arange(len(maps) + 1, dtype=np.int64) << (2 * preset)
    corners = number[np.concatenate(leaves)].astype(np.int32)
    return Quadtrees(
        size, preset, first_node, np.concatenate(links).astype(np.int32), corners, first_sample, quantities
    )


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
