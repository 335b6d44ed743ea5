"""Potentially visible sets: what the vertices of a deforming body see of it in a recorded motion (Kautz 2004, 3.2).

In every recorded state each vertex draws its triangles with their distances. Those that are nearest in some pixel of
its mask, in some state, are all that it needs to look at: in the recorded states its masks stay the same to the bit.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import warp as wp

from warp_psf.basis.visibility_mask import BATCH, WORDS, MaskTables, batch, upload_masks
from warp_psf.device import find_device, launch, upload_tables
from warp_psf.field.blockers import BlockerSet
from warp_psf.field.rasterise import (
    BlockerTable,
    BlockerTables,
    Horizon,
    find_planes,
    make_blocker_table,
    make_horizon,
)
from warp_psf.scene.deforming import Deformed

# Vertices whose triangles are looked through at a time: distances and triangles of their pixels take 32 MB.
VERTICES_AT_ONCE = 4096
PIXELS = 64 * WORDS


@wp.struct
class Sight:
    """What some vertices see, with room for one mask of distances each."""

    first: wp.array(dtype=wp.int32)  # (vertex + 1): where its triangles begin in `triangles`
    triangles: wp.array(dtype=wp.int32)
    distance: wp.array2d(dtype=wp.float32)  # (vertex, pixel): of the nearest triangle, in units of its direction
    nearest: wp.array2d(dtype=wp.int32)  # (vertex, pixel): that triangle's place in the vertex's list, -1 for none
    first_seen: wp.array(dtype=wp.int32)  # (vertex): where its triangles begin in `seen`
    seen: wp.array(dtype=wp.int32)  # 1 for a triangle that was nearest somewhere


Sights = wp.array(dtype=Sight)


@wp.func_native(f"""
    const auto& sight = sights.data[0];
    const auto& table = blockers.data[0];
    const auto& mask_table = masks.data[0];
    float* distance = sight.distance.data + {PIXELS} * vertex;
    int* nearest = sight.nearest.data + {PIXELS} * vertex;
    for (int lane = 0; lane < {BATCH}; ++lane) {{
        if (planes.data[0][lane] == 0) continue;
        const auto& corners = table.faces.data[sight.triangles.data[index + lane]];
        const wp::vec3 a = table.place.data[corners[0]] - horizon.origin;
        const wp::vec3 normal = wp::cross(
            table.place.data[corners[1]] - table.place.data[corners[0]],
            table.place.data[corners[2]] - table.place.data[corners[0]]);
        const float height = wp::dot(normal, a);
        for (int word = 0; word < {WORDS}; ++word) {{
            uint64_t bits = mask_table.planes.data[planes.data[0][lane]][word];
            bits &= mask_table.planes.data[planes.data[1][lane]][word];
            bits &= mask_table.planes.data[planes.data[2][lane]][word];
            for (; bits; bits &= bits - 1) {{
                const int pixel = 64 * word + wp::bit_count((bits & -bits) - 1);
                const wp::vec3 d = mask_table.directions.data[pixel];
                const wp::vec3 along = d[0] * horizon.tangent + d[1] * horizon.bitangent + d[2] * horizon.normal;
                // A plane that is off by its cell may lie beside the triangle; what is then behind counts as far away.
                const float found = height / wp::dot(normal, along);
                const float away = found > 0.0f ? found : 1e30f;
                if (nearest[pixel] >= 0 && away >= distance[pixel]) continue;
                distance[pixel] = away;
                nearest[pixel] = index + lane - sight.first.data[vertex];
            }}
        }}
    }}
    return 0;
""")
def draw_distances(
    vertex: int,
    index: int,
    planes: batch,
    horizon: Horizon,
    sights: Sights,
    blockers: BlockerTables,
    masks: MaskTables,
) -> int: ...


@wp.kernel(enable_backward=False, module="unique")
def _look_around(
    first: int,
    position: wp.array(dtype=wp.vec3),  # (vertex), metres
    normal: wp.array(dtype=wp.vec3),  # (vertex)
    offset: float,
    sights: Sights,
    blockers: BlockerTables,
    masks: MaskTables,
):
    world, vertex = wp.tid()
    vertex += first
    for pixel in range(wp.static(PIXELS)):
        sights[0].nearest[vertex, pixel] = -1
    horizon = make_horizon(position[vertex] + offset * normal[vertex], normal[vertex])
    end = sights[0].first[vertex + 1]
    for index in range(sights[0].first[vertex], end, wp.static(BATCH)):
        planes = find_planes(0, 0, index, end - index, wp.uint32(0), sights[0].triangles, horizon, blockers)
        draw_distances(vertex, index, planes, horizon, sights, blockers, masks)
    for pixel in range(wp.static(PIXELS)):
        nearest = sights[0].nearest[vertex, pixel]
        if nearest >= 0:
            # Several vertices of one blocker vertex may write the same 1.
            sights[0].seen[sights[0].first_seen[vertex] + nearest] = 1


def find_visible_sets(
    name: str,
    blockers: BlockerSet,
    blocker_of: np.ndarray,
    states: Sequence[Deformed],
    offset: float,
    *,
    device: str | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> BlockerSet:
    """The same triangles, with lists of those that each vertex sees in any of the states, and no others.

    name: of the body, for messages. blocker_of: the blocker vertex of each seen vertex, int32 [V]. states: of the
    motion. offset: of the masks' origins from the vertices along their normals, metres. progress: called as
    progress(what, share).

    Raises:
        ValueError: there are no states, they have other vertices, or there is no such device.
    """
    count = len(blockers.first_near) - 1
    if not states:
        raise ValueError(f"the recorded motion of {name!r} has no states; give at least one")
    for index, state in enumerate(states):
        sizes = len(state.vertices), len(state.blocker_vertices)
        if sizes != (len(blocker_of), count):
            raise ValueError(
                f"state {index} of {name!r} has {sizes[0]} vertices and {sizes[1]} that block; "
                f"the body has {len(blocker_of)} and {count}"
            )
    found, progress = find_device(device), progress or (lambda what, share: None)
    table = make_blocker_table(blockers, wp.zeros((1, count), dtype=wp.vec3, device=found))
    tables, masks = upload_tables([table], BlockerTable, found), upload_masks(1, found)
    first, triangles = _all_lists(blockers)
    seen = np.zeros(len(triangles), bool)
    # Vertices of one blocker vertex are looked through together, so that what they see stays together.
    order = np.argsort(blocker_of, kind="stable")
    for start in range(0, len(order), VERTICES_AT_ONCE):
        progress(f"recording what {name} sees of itself", start / len(order))
        chosen = order[start : start + VERTICES_AT_ONCE]
        places, of_place = np.unique(blocker_of[chosen], return_inverse=True)
        sight, used = _prepare(first, triangles, places, of_place.reshape(-1), found)
        for state in states:
            table.place.assign(state.blocker_vertices[None])
            points = wp.array(state.vertices[chosen], dtype=wp.vec3, device=found)
            normals = wp.array(state.normals[chosen], dtype=wp.vec3, device=found)
            inputs = [points, normals, offset, sight, tables, masks]
            launch(_look_around, (1, len(chosen)), inputs, [], found)
        seen[used] |= sight.tables[0].seen.numpy() > 0
    progress(f"recording what {name} sees of itself", 1.0)
    owner = np.repeat(np.arange(count), np.diff(first))[seen]
    first_near = np.concatenate([[0], np.cumsum(np.bincount(owner, minlength=count))]).astype(np.int32)
    return replace(
        blockers,
        first_of_cluster=np.zeros(1, np.int32),
        first_near=first_near,
        near=triangles[seen],
        first_skip=np.zeros(count + 1, np.int32),
        skip=np.zeros(0, np.int32),
    )


def _all_lists(blockers: BlockerSet) -> tuple[np.ndarray, np.ndarray]:
    """The triangles that each blocker vertex looks at, near and far: ends [B + 1] and int32 [...]."""
    count, coarse = len(blockers.first_near) - 1, int(blockers.first_of_cluster[-1])
    far = np.ones((count, coarse), bool)
    far[np.repeat(np.arange(count), np.diff(blockers.first_skip)), blockers.skip] = False
    near_of = np.repeat(np.arange(count), np.diff(blockers.first_near))
    far_of, far_triangles = np.nonzero(far)
    owner = np.concatenate([near_of, far_of])
    order = np.argsort(owner, kind="stable")
    first = np.concatenate([[0], np.cumsum(np.bincount(owner, minlength=count))])
    return first, np.concatenate([blockers.near, far_triangles])[order].astype(np.int32)


def _prepare(
    first: np.ndarray, triangles: np.ndarray, places: np.ndarray, of_place: np.ndarray, device: wp.Device
) -> tuple[wp.array, np.ndarray]:
    """The lists of some blocker vertices, ascending, for vertices that are of the places `of_place` among these; and
    where in all of the lists they are."""
    length = np.diff(first)[places]
    start = np.cumsum(length) - length
    used = np.arange(length.sum()) + np.repeat(first[places] - start, length)
    ends = np.concatenate([[0], np.cumsum(length[of_place])])
    copied = np.arange(ends[-1]) + np.repeat(start[of_place] - ends[:-1], length[of_place])
    sight, shape = Sight(), (len(of_place), PIXELS)
    sight.first = wp.array(ends, dtype=wp.int32, device=device)
    sight.triangles = wp.array(triangles[used][copied], dtype=wp.int32, device=device)
    sight.distance = wp.zeros(shape, dtype=wp.float32, device=device)
    sight.nearest = wp.zeros(shape, dtype=wp.int32, device=device)
    sight.first_seen = wp.array(start[of_place], dtype=wp.int32, device=device)
    sight.seen = wp.zeros(len(used), dtype=wp.int32, device=device)
    return upload_tables([sight], Sight, device), used
