"""What hides a deforming body from itself: levels of triangles, and which of them each vertex has to look at.

Near a vertex the triangles of its own surface count, elsewhere those of coarser ones, the coarser the farther (Kautz
2004, section 3.2, has two levels). Coarse triangles have their corners at vertices of the fine surface, which carry
them along. Every triangle belongs to one of the level above that stands for it, so that near and far together cover the
surface once.
"""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class BlockerSet:
    """The triangles that may hide a surface of V vertices from itself.

    faces: corners among the surface's vertices, int32 [T, 3], level by level: C coarse triangles, cluster by cluster,
        then those of levels in between, and last the F fine ones in the order of the surface.
    first_of_cluster: where each cluster's coarse triangles begin, and where the last one's end, int32 [clusters + 1].
    first_near, near: of vertex v the triangles near[first_near[v] : first_near[v + 1]], ascending indices into `faces`
        of those below the coarsest level: fine ones next to the vertex, and coarser ones farther away. They stand for
        the same part of the surface as the coarse triangles that touch the vertex's surroundings, once. int32 [V + 1]
        and [...].
    first_skip, skip: likewise the coarse triangles, ascending, in whose place those stand.
    two_sided: whether the surface is open, so that its back hides too.
    parent: the triangle of the level above that stands for each one, an index into `faces`; -1 for the C coarse ones.
        Each triangle above the finest level stands for at least one. int32 [T].
    first_of_level: where each level's triangles begin, from the coarsest to the finest, and where the last one's end:
        0, C, ..., T - F, T. int32 [levels + 1]; there are at least two levels.
    """

    faces: np.ndarray
    first_of_cluster: np.ndarray
    first_near: np.ndarray
    near: np.ndarray
    first_skip: np.ndarray
    skip: np.ndarray
    two_sided: bool
    parent: np.ndarray
    first_of_level: np.ndarray
