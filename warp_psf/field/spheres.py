"""Blocker spheres that are carried by a deforming body, and the tree in which they stand for one another (Ren 2006).

A node of the tree is a sphere that stands for all leaves under it, with a weight that keeps the sum of their
logarithms: the sum of their projected areas over its own. Nodes are stored depth first, so that a tree with n leaves
has 2n - 1 of them and the node behind a subtree is found without a pointer.
"""

from dataclasses import dataclass

import numpy as np
import warp as wp


@dataclass(frozen=True, eq=False)
class SphereSet:
    """Blocker spheres of one body, in the order of the tree's leaves.

    radius: metres, float64 [n].
    weight: the share of its logarithm that each adds, float64 [n]; along a ray that meets several they add up to 1.
    vertices, shares: the body's vertices that carry each sphere, int32 [n, K], and how, float64 [n, K], sum 1.
    first, leaves: per node the first leaf under it and how many there are, int32 [2n - 1].
    """

    radius: np.ndarray
    weight: np.ndarray
    vertices: np.ndarray
    shares: np.ndarray
    first: np.ndarray
    leaves: np.ndarray

    def carried(self, vertices: np.ndarray) -> np.ndarray:
        """Centres [n, 3] of the spheres when the body's vertices are at [V, 3]."""
        return np.einsum("nk,nkx->nx", self.shares, np.asarray(vertices, np.float64)[self.vertices])


def build_tree(center: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A tree over points [n, 3], halved at the median along the longest side of their box.

    Returns the points in the order of the leaves, and `first` and `leaves` as in `SphereSet`.
    """
    order, first, leaves = np.arange(len(center)), [], []

    def halve(start: int, count: int) -> None:
        first.append(start)
        leaves.append(count)
        if count == 1:
            return
        part = order[start : start + count]
        axis = np.ptp(center[part], axis=0).argmax()
        order[start : start + count] = part[np.argsort(center[part, axis], kind="stable")]
        halve(start, count // 2)
        halve(start + count // 2, count - count // 2)

    halve(0, len(center))
    return order, np.array(first, np.int32), np.array(leaves, np.int32)


def place_nodes(spheres: SphereSet, center: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The nodes' centres [m, 3], radii [m] and weights [m], float32, when the leaves are at `center` [n, 3].

    A node's disc has the spread of its leaves' discs around their common centre, averaged over directions: a disc of
    radius R spreads by R^2 / 2, and of a distance d in space two thirds of d^2 are seen.
    """
    squared = spheres.radius**2
    area = spheres.weight * squared
    moments = np.column_stack([area, area[:, None] * center, area * (center**2).sum(axis=1), area * squared])
    sums = np.concatenate([np.zeros((1, 6)), np.cumsum(moments, axis=0)])
    total = sums[spheres.first + spheres.leaves] - sums[spheres.first]
    middle = total[:, 1:4] / total[:, :1]
    spread = np.maximum(total[:, 4] / total[:, 0] - (middle**2).sum(axis=1), 0.0)
    node_squared = 4.0 / 3.0 * spread + total[:, 5] / total[:, 0]
    # A leaf is itself, past the rounding of the sums.
    leaf = spheres.leaves == 1
    middle[leaf], node_squared[leaf] = center[spheres.first[leaf]], squared[spheres.first[leaf]]
    weight = total[:, 0] / node_squared
    weight[leaf] = spheres.weight[spheres.first[leaf]]
    return middle.astype(np.float32), np.sqrt(node_squared).astype(np.float32), weight.astype(np.float32)


@wp.struct
class SphereTable:
    """The nodes of all sphere sets, one tree behind the other."""

    center: wp.array2d(dtype=wp.vec3)  # (world, node), in the world, metres
    radius: wp.array2d(dtype=wp.float32)  # (world, node), metres
    weight: wp.array2d(dtype=wp.float32)  # (world, node): 0 while the body is not shown
    leaves: wp.array(dtype=wp.int32)  # (node)
    root: wp.array(dtype=wp.int32)  # (node): of its tree
    entity: wp.array(dtype=wp.int32)  # (node): whose body it is


SphereTables = wp.array(dtype=SphereTable)
