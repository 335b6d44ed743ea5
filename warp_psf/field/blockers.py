"""What hides a deforming body from itself: two levels of triangles, and which of them each vertex has to look at.

Near a vertex the triangles of its own surface count, elsewhere those of a coarse one (Kautz 2004, section 3.2). Coarse
triangles have their corners at vertices of the fine surface, which carry them along. Every fine triangle belongs to
the coarse one that stands for it, so that near and far together cover the surface once.
"""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class BlockerSet:
    """The triangles that may hide a surface of V vertices from itself.

    faces: corners among the surface's vertices, int32 [C + F, 3]: C coarse triangles, cluster by cluster, then the F
        fine ones in the order of the surface.
    first_of_cluster: where each cluster's coarse triangles begin, and where the last one's end, int32 [clusters + 1].
    coarse_of: the coarse triangle that stands for each fine one, int32 [F].
    first_near, near: of vertex v the triangles near[first_near[v] : first_near[v + 1]], indices into `faces`: fine
        ones, all that a coarse triangle which touches the vertex's surroundings stands for. int32 [V + 1] and [...].
    first_skip, skip: likewise the coarse triangles, ascending, in whose place those stand.
    two_sided: whether the surface is open, so that its back hides too.
    """

    faces: np.ndarray
    first_of_cluster: np.ndarray
    coarse_of: np.ndarray
    first_near: np.ndarray
    near: np.ndarray
    first_skip: np.ndarray
    skip: np.ndarray
    two_sided: bool
