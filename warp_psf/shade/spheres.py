"""Sphere sets as occluders: receivers that lie together share a cut through the trees of spheres (Ren 2006).

Far from a body a few spheres stand for all, near it each stands for itself. The logarithms of the cut's spheres are
added at each receiver, with what a log shadow field has left.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace

import numpy as np
import warp as wp

from warp_psf.basis.sh_exp import make_sh_exp
from warp_psf.device import launch, upload_tables
from warp_psf.field.spheres import SphereSet, SphereTable, SphereTables, place_nodes
from warp_psf.scene.deforming import Deformed
from warp_psf.scene.receiver import ReceiverTable
from warp_psf.scene.scene import Scene
from warp_psf.shade.fades import SMALLEST_SHARE, Light, horizon_fade, size_fade, sphere_nearness

# Receivers of a cluster, which share a cut: neighbours in a row of pixels, or on a body.
CLUSTER = 64
# A sphere stands for those under it where it spans no more than this sine. Neighbouring clusters then differ by less
# than 0.1 % of the light on the ground of a figure, which no picture of 8 bits shows; at 0.25 they differ by 0.3 %.
CUT_SINE = 0.15
# Spheres in a cut; where more would be, coarser ones stand for them.
MOST_IN_CUT = 256
COARSER = 1.5


@wp.struct
class CutTable:
    """The cut of each cluster of some receivers."""

    count: wp.array2d(dtype=wp.int32)  # (world, cluster)
    node: wp.array3d(dtype=wp.int32)  # (world, cluster, place)


CutTables = wp.array(dtype=CutTable)


@wp.kernel(enable_backward=False, module="unique")
def _choose_cuts(first: int, receivers: ReceiverTable, spheres: SphereTables, cuts: CutTables):
    world, cluster = wp.tid()
    cluster += first
    start = cluster * wp.static(CLUSTER)
    end = wp.min(start + wp.static(CLUSTER), receivers.entity.shape[1])
    lower = wp.vec3(1.0e30, 1.0e30, 1.0e30)
    upper = -lower
    own = int(-1)  # the entity of all receivers, -2 where they are of several
    for receiver in range(start, end):
        entity = receivers.entity[world, receiver]
        if entity >= 0:
            own = wp.where(own == -1 or own == entity, entity, -2)
            lower = wp.min(lower, receivers.position[world, receiver])
            upper = wp.max(upper, receivers.position[world, receiver])
    count = int(0)
    if lower[0] <= upper[0]:
        middle = 0.5 * (lower + upper)
        reach = 0.5 * wp.length(upper - lower)
        largest = float(wp.static(CUT_SINE))
        nodes = spheres[0].leaves.shape[0]
        fits = bool(False)
        while not fits:
            fits = bool(True)
            count = int(0)
            node = int(0)
            while node < nodes and fits:
                leaves = spheres[0].leaves[node]
                radius = spheres[0].radius[world, node]
                away = wp.max(wp.length(spheres[0].center[world, node] - middle) - reach, 0.0)
                small = spheres[0].root[node] == node and radius * radius < wp.static(SMALLEST_SHARE) * away * away
                if small or spheres[0].entity[node] == own or spheres[0].weight[world, node] <= 0.0:
                    node += 2 * leaves - 1
                elif leaves == 1 or radius <= largest * away:
                    # Where even the roots are too many, those behind are left out.
                    fits = count < wp.static(MOST_IN_CUT) or largest >= 1.0e3
                    if count < wp.static(MOST_IN_CUT):
                        cuts[0].node[world, cluster, count] = node
                        count += 1
                    node += 2 * leaves - 1
                else:
                    node += 1
            largest *= wp.static(COARSER)
    cuts[0].count[world, cluster] = count


@cache
def make_spheres(order: int) -> SimpleNamespace:
    """The device function `add_sphere(...)` for `order` bands, and the type `both_logarithms` of its sums."""
    logs = make_sh_exp(order)
    ExpTables = wp.array(dtype=logs.ExpTable)
    both_logarithms = wp.types.matrix((2, order * order), wp.float32)

    @wp.func
    def add_sphere(
        logarithms: both_logarithms,
        world: int,
        node: int,
        own: int,
        p: wp.vec3,
        n: wp.vec3,
        light: Light,
        spheres: SphereTables,
        exponential: ExpTables,
    ) -> both_logarithms:
        """Adds the logarithms of what a sphere leaves of the environment and of a light."""
        radius = spheres[0].radius[world, node]
        center = spheres[0].center[world, node]
        offset = center - p
        distance = wp.max(wp.length(offset), 1.0e-6)
        # It is the body that may be too small to matter: many small spheres are no small body.
        root = spheres[0].root[node]
        weight = size_fade(spheres[0].radius[world, root], wp.length_sq(spheres[0].center[world, root] - p))
        weight *= horizon_fade(wp.dot(n, offset), radius)
        # What hides a body from itself is found by other means.
        if weight <= 0.0 or spheres[0].entity[node] == own:
            return logarithms
        # Spheres behind one another share what they take. One that takes up much of the view hides those behind it
        # by itself.
        sine = wp.min(radius / distance, 1.0)
        shared = spheres[0].weight[world, node]
        weight *= shared + wp.max(1.0 - shared, 0.0) * sine * sine
        nearer = float(0.0)
        if light.radius >= 0.0:
            nearer = sphere_nearness(p, center, radius, light)
        left = logs.cap_logarithm(offset / distance, sine, exponential)
        return logarithms + wp.outer(wp.vec2(weight, weight * nearer), left)

    return SimpleNamespace(add_sphere=add_sphere, both_logarithms=both_logarithms)


@dataclass(frozen=True, eq=False)
class SphereState:
    """The sphere sets of a scene's deforming bodies.

    sets: of each, in the order of `Scene.deforming`; None for one that casts no shadows.
    opacity: of each, in (0, 1].
    """

    sets: tuple[SphereSet | None, ...]
    opacity: tuple[float, ...]
    tables: wp.array  # (1): of SphereTable

    @property
    def is_empty(self) -> bool:
        """Whether nothing has spheres."""
        return all(spheres is None for spheres in self.sets)


def upload_spheres(scene: Scene, sets: Sequence[SphereSet | None], worlds: int, device: wp.Device) -> SphereState:
    """Room for the nodes of the sphere sets of a scene's deforming bodies; `sets` as in `SphereState`."""
    present = [(entity, spheres) for entity, spheres in zip(scene.deforming, sets, strict=True) if spheres is not None]
    leaves = np.concatenate([np.zeros(0, np.int32), *(spheres.leaves for _, spheres in present)])
    nodes = np.array([len(spheres.leaves) for _, spheres in present], np.int64)
    table = SphereTable()
    table.center = wp.zeros((worlds, len(leaves)), dtype=wp.vec3, device=device)
    table.radius = wp.zeros((worlds, len(leaves)), dtype=wp.float32, device=device)
    table.weight = wp.zeros((worlds, len(leaves)), dtype=wp.float32, device=device)
    table.leaves = wp.array(leaves, dtype=wp.int32, device=device)
    table.root = wp.array(np.repeat(np.cumsum(nodes) - nodes, nodes), dtype=wp.int32, device=device)
    entities = np.array([entity for entity, _ in present], np.int32)
    table.entity = wp.array(np.repeat(entities, nodes), dtype=wp.int32, device=device)
    opacity = tuple(scene.entities[entity].opacity for entity in scene.deforming)
    return SphereState(tuple(sets), opacity, upload_tables([table], SphereTable, device))


def carry_spheres(state: SphereState, bodies: Sequence[Deformed | None]) -> None:
    """Brings the spheres to where the present shapes of the deforming bodies carry them; None has none."""
    if state.is_empty:
        return
    nodes = []
    for spheres, opacity, body in zip(state.sets, state.opacity, bodies, strict=True):
        if spheres is not None and body is None:
            hidden = np.zeros(len(spheres.leaves), np.float32)
            nodes.append((np.zeros((len(hidden), 3), np.float32), hidden, hidden))
        elif spheres is not None and body is not None:
            center, radius, weight = place_nodes(spheres, spheres.carried(body.vertices))
            nodes.append((center, radius, np.float32(opacity) * weight))
    (table,) = state.tables.tables
    for array, parts in zip((table.center, table.radius, table.weight), zip(*nodes, strict=True), strict=True):
        values = np.concatenate(parts)
        array.assign(np.repeat(values[None], array.shape[0], axis=0))


def make_cuts(worlds: int, receivers: int, has_spheres: bool, device: wp.Device) -> wp.array:
    """Room for the cuts of so many receivers; none where there are no spheres."""
    clusters = -(-receivers // CLUSTER) if has_spheres else 0
    table = CutTable()
    table.count = wp.zeros((worlds, clusters), dtype=wp.int32, device=device)
    table.node = wp.zeros((worlds, clusters, MOST_IN_CUT), dtype=wp.int32, device=device)
    return upload_tables([table], CutTable, device)


def choose_cuts(cuts: wp.array, receivers: ReceiverTable, spheres: SphereState, device: wp.Device) -> None:
    """Finds the cut of each cluster of receivers; once per frame and set of receivers."""
    launch(_choose_cuts, cuts.tables[0].count.shape, [receivers, spheres.tables], [cuts], device)
