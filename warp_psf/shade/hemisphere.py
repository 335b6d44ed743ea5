"""Deforming bodies shadow themselves: hemispherical rasterisation (Kautz 2004).

In every frame each vertex that is seen rasterises the triangles around it into its visibility mask, and integrates what
remains open against spherical harmonics and the cosine. The result, its transfer, is what other bodies keep from their
bake; from there on a deforming body is shaded as they are.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace

import numpy as np
import warp as wp

from warp_psf.basis.visibility_mask import (
    BATCH,
    MaskTables,
    batch,
    cover,
    make_masks,
    mask,
    plane_snippet,
    upload_masks,
)
from warp_psf.device import launch, upload_tables
from warp_psf.field.blockers import BlockerSet
from warp_psf.scene.deforming import Deformed, DeformingShape
from warp_psf.scene.geometry import DeviceScene, GeometryTables
from warp_psf.scene.receiver import ReceiverTable
from warp_psf.scene.scene import Scene
from warp_psf.shade.direct import DirectState

# The origin of a mask leaves the surface by this share of the body's radius, as in the bake of rigid bodies: faces that
# meet at a vertex then hide what they should of its valleys.
ORIGIN_OFFSET = 1.0e-3
# A triangle with less than this volume between unit vectors to its corners is seen edge-on: it spans 1e-6 sr, a
# thousandth of a pixel, and its planes would be those of rounding.
EDGE_ON = 2.0e-6

# What has become of a vertex since the body moved: no pixel needs it, one does, and its transfer is known.
NOT_SEEN, SEEN, DONE = 0, 1, 2


@wp.struct
class BlockerTable:
    """A deforming body's vertices and what hides it from itself; see `BlockerSet`."""

    position: wp.array2d(dtype=wp.vec3)  # (world, vertex): of those seen, metres, in the world
    normal: wp.array2d(dtype=wp.vec3)  # (world, vertex)
    progress: wp.array2d(dtype=wp.int32)  # (world, vertex): NOT_SEEN, SEEN or DONE
    blocker_of: wp.array(dtype=wp.int32)  # (vertex)
    blocker: wp.array2d(dtype=wp.vec3)  # (world, blocker vertex), metres, in the world
    faces: wp.array(dtype=wp.vec3i)  # (triangle)
    far: wp.array(dtype=wp.int32)  # (coarse triangle): all of them
    first_of_cluster: wp.array(dtype=wp.int32)  # (cluster + 1)
    lower: wp.array2d(dtype=wp.vec3)  # (world, cluster): corners of its box, metres
    upper: wp.array2d(dtype=wp.vec3)  # (world, cluster)
    first_near: wp.array(dtype=wp.int32)  # (blocker vertex + 1)
    near: wp.array(dtype=wp.int32)
    first_skip: wp.array(dtype=wp.int32)  # (blocker vertex + 1)
    skip: wp.array(dtype=wp.int32)
    two_sided: wp.bool
    offset: wp.float32  # of a mask's origin from its vertex, metres
    masks: wp.array2d(dtype=mask)  # (world, vertex): what is blocked


BlockerTables = wp.array(dtype=BlockerTable)


@wp.struct
class Horizon:
    """The frame in which a mask is drawn: its origin, and axes the last of which is the normal."""

    origin: wp.vec3
    tangent: wp.vec3
    bitangent: wp.vec3
    normal: wp.vec3


@wp.kernel(enable_backward=False, module="unique")
def _mark_seen(first: int, pixels: ReceiverTable, entity: int, geometry: GeometryTables, blockers: BlockerTables):
    world, slot = wp.tid()
    slot += first
    if pixels.entity[world, slot] != entity:
        return
    corners = geometry[0].faces[geometry[0].first_face[geometry[0].entity_mesh[entity]] + pixels.face[world, slot]]
    for corner in range(3):
        # Several pixels may write the same.
        if blockers[0].progress[world, corners[corner]] == wp.static(NOT_SEEN):
            blockers[0].progress[world, corners[corner]] = wp.static(SEEN)


@wp.kernel(enable_backward=False, module="unique")
def _bound_clusters(first: int, blockers: BlockerTables):
    world, cluster = wp.tid()
    cluster += first
    lower = wp.vec3(1.0e30, 1.0e30, 1.0e30)
    upper = -lower
    for triangle in range(blockers[0].first_of_cluster[cluster], blockers[0].first_of_cluster[cluster + 1]):
        corners = blockers[0].faces[triangle]
        for corner in range(3):
            place = blockers[0].blocker[world, corners[corner]]
            lower = wp.min(lower, place)
            upper = wp.max(upper, place)
    blockers[0].lower[world, cluster] = lower
    blockers[0].upper[world, cluster] = upper


@wp.func
def horizon_of(world: int, vertex: int, blockers: BlockerTables) -> Horizon:
    horizon = Horizon()
    n = blockers[0].normal[world, vertex]
    level = wp.sqrt(n[0] * n[0] + n[1] * n[1])
    x = wp.where(level > 1.0e-6, n[0] / level, 1.0)
    y = wp.where(level > 1.0e-6, n[1] / level, 0.0)
    horizon.origin = blockers[0].position[world, vertex] + blockers[0].offset * n
    horizon.tangent = wp.vec3(n[2] * x, n[2] * y, -level)
    horizon.bitangent = wp.vec3(-y, x, 0.0)
    horizon.normal = n
    return horizon


def _planes_snippet() -> str:
    """C++: the corners of a batch fetched one by one, then all of the batch side by side."""
    edges = [("a", "b", 0), ("b", "c", 1), ("c", "a", 2)]
    crosses = "".join(
        f"""
        const float x_{k} = side * ({p}y * {q}z - {p}z * {q}y), y_{k} = side * ({p}z * {q}x - {p}x * {q}z);
        const float z_{k} = side * ({p}x * {q}y - {p}y * {q}x);
        int plane_{k};
        {plane_snippet(f"x_{k}", f"y_{k}", f"z_{k}", f"plane_{k}")}
        found.data[{k}][lane] = hides ? plane_{k} : 0;
        """
        for p, q, k in edges
    )
    corners = "".join(
        f"""
        const float {p}u = corners[{3 * k}][lane], {p}v = corners[{3 * k + 1}][lane], {p}w = corners[{3 * k + 2}][lane];
        const float {p}x = t[0] * {p}u + t[1] * {p}v + t[2] * {p}w, {p}y = s[0] * {p}u + s[1] * {p}v + s[2] * {p}w;
        const float {p}z = n[0] * {p}u + n[1] * {p}v + n[2] * {p}w;
        const float {p}{p} = {p}x * {p}x + {p}y * {p}y + {p}z * {p}z;
        """
        for k, p in enumerate("abc")
    )
    return f"""
    const auto& table = blockers.data[0];
    const wp::vec3* places = table.blocker.data + world * table.blocker.shape[1];
    const wp::vec3 o = horizon.origin, t = horizon.tangent, s = horizon.bitangent, n = horizon.normal;
    float corners[9][{BATCH}];
    bool drawn[{BATCH}];
    for (int lane = 0; lane < {BATCH}; ++lane) {{
        drawn[lane] = lane < count && !(skipped >> lane & 1u);
        const int triangle = list.data[lane < count ? first + lane : first];
        for (int corner = 0; corner < 3; ++corner)
            for (int axis = 0; axis < 3; ++axis)
                corners[3 * corner + axis][lane] = places[table.faces.data[triangle][corner]][axis] - o[axis];
    }}
    const bool two_sided = table.two_sided;
    wp::mat_t<3, {BATCH}, int> found;
    for (int lane = 0; lane < {BATCH}; ++lane) {{
        {corners}
        const float volume = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx);
        const float side = volume > 0.0f ? 1.0f : -1.0f;
        const bool faces = two_sided | (volume < 0.0f);
        const bool spans = volume * volume > {EDGE_ON**2:.9e}f * aa * bb * cc;
        const bool hides = drawn[lane] & ((az > 0.0f) | (bz > 0.0f) | (cz > 0.0f)) & faces & spans;
        {crosses}
    }}
    return found;
    """


@wp.func_native(_planes_snippet())
def find_planes(
    world: int,
    first: int,
    count: int,
    skipped: wp.uint32,
    list: wp.array(dtype=wp.int32),
    horizon: Horizon,
    blockers: BlockerTables,
) -> batch:
    """The planes above which triangles lie as they are seen from the origin; zeros for those that hide nothing.

    They are the `count` triangles from `first` on in a list, at most a batch of them, less those whose bits are set in
    `skipped`. Nothing is hidden by triangles below the horizon, by those seen edge-on, and by the backs of a closed
    surface, whose front hides as much. What lies above three planes is the image, wherever the horizon cuts it.
    """


@wp.func
def is_above(world: int, cluster: int, horizon: Horizon, blockers: BlockerTables) -> bool:
    """Whether any of a cluster's box rises above the horizon."""
    lower = blockers[0].lower[world, cluster]
    upper = blockers[0].upper[world, cluster]
    n = horizon.normal
    reach = wp.dot(wp.vec3(wp.abs(n[0]), wp.abs(n[1]), wp.abs(n[2])), upper - lower)
    return wp.dot(n, upper + lower - 2.0 * horizon.origin) + reach > 0.0


@wp.kernel(enable_backward=False, module="unique")
def _rasterise(first: int, blockers: BlockerTables, masks: MaskTables):
    world, vertex = wp.tid()
    vertex += first
    if blockers[0].progress[world, vertex] != wp.static(SEEN):
        return
    horizon = horizon_of(world, vertex, blockers)
    place = blockers[0].blocker_of[vertex]
    covered = mask()
    for index in range(blockers[0].first_near[place], blockers[0].first_near[place + 1], wp.static(BATCH)):
        count = blockers[0].first_near[place + 1] - index
        planes = find_planes(world, index, count, wp.uint32(0), blockers[0].near, horizon, blockers)
        covered = cover(covered, masks[0].planes, planes)
    skip = int(blockers[0].first_skip[place])
    last_skip = blockers[0].first_skip[place + 1]
    for cluster in range(blockers[0].first_of_cluster.shape[0] - 1):
        if is_above(world, cluster, horizon, blockers):
            end = blockers[0].first_of_cluster[cluster + 1]
            for index in range(blockers[0].first_of_cluster[cluster], end, wp.static(BATCH)):
                # Those that are skipped are in ascending order, as triangles are.
                skipped = wp.uint32(0)
                while skip < last_skip and blockers[0].skip[skip] < wp.min(index + wp.static(BATCH), end):
                    if blockers[0].skip[skip] >= index:
                        skipped |= wp.uint32(1) << wp.uint32(blockers[0].skip[skip] - index)
                    skip += 1
                planes = find_planes(world, index, end - index, skipped, blockers[0].far, horizon, blockers)
                covered = cover(covered, masks[0].planes, planes)
    blockers[0].masks[world, vertex] = covered


@cache
def make_hemisphere(order: int) -> SimpleNamespace:
    """The kernels that integrate masks against `order` bands."""
    kit = make_masks(order)
    vec = kit.vec

    @wp.kernel(enable_backward=False, module="unique")
    def integrate(
        first: int,
        blockers: BlockerTables,
        masks: MaskTables,
        first_row: int,
        transfer_out: wp.array(dtype=vec),  # (row)
        visibility_out: wp.array(dtype=vec),  # (row)
    ):
        world, vertex = wp.tid()
        vertex += first
        if blockers[0].progress[world, vertex] != wp.static(SEEN):
            return
        blockers[0].progress[world, vertex] = wp.static(DONE)
        normal = blockers[0].normal[world, vertex]
        covered = blockers[0].masks[world, vertex]
        both = kit.open_transfer(covered, normal, masks)
        row = first_row + world * blockers[0].position.shape[1] + vertex
        transfer_out[row] = both[0]
        visibility_out[row] = both[1]

    @wp.kernel(enable_backward=False, module="unique")
    def integrate_lobe(
        first: int,
        blockers: BlockerTables,
        masks: MaskTables,
        eye: wp.array(dtype=wp.vec3),  # (world), metres
        exponent: float,
        first_row: int,
        gloss_out: wp.array(dtype=vec),  # (row)
    ):
        world, vertex = wp.tid()
        vertex += first
        if blockers[0].progress[world, vertex] != wp.static(DONE):
            return
        normal = blockers[0].normal[world, vertex]
        view = wp.normalize(eye[world] - blockers[0].position[world, vertex])
        mirrored = 2.0 * wp.dot(normal, view) * normal - view
        row = first_row + world * blockers[0].position.shape[1] + vertex
        gloss_out[row] = kit.open_lobe(blockers[0].masks[world, vertex], normal, mirrored, exponent, masks)

    return SimpleNamespace(vec=vec, integrate=integrate, integrate_lobe=integrate_lobe)


@dataclass(frozen=True, eq=False)
class HemisphereState:
    """A deforming body on the device: `table` is the one that the array `tables` holds."""

    table: BlockerTable
    tables: wp.array


@dataclass(frozen=True, eq=False)
class Hemispheres:
    """The deforming bodies of a scene.

    states: per entity. exponents: of their Phong lobes, per entity. shapes: what was brought last, per entity.
    masks: what masks are drawn with, None where nothing deforms.
    """

    states: dict[int, HemisphereState]
    exponents: dict[int, float]
    shapes: dict[int, Deformed]
    masks: wp.array | None


def upload_blockers(
    blockers: BlockerSet, blocker_of: np.ndarray, radius: float, worlds: int, device: wp.Device
) -> HemisphereState:
    """Room for the vertices and masks of a deforming body.

    blocker_of: the blocker vertex of each seen vertex, int32 [V]. radius: of the body at rest, metres.
    """
    table = BlockerTable()
    shape = (worlds, len(blocker_of))
    table.position = wp.zeros(shape, dtype=wp.vec3, device=device)
    table.normal = wp.zeros(shape, dtype=wp.vec3, device=device)
    table.progress = wp.zeros(shape, dtype=wp.int32, device=device)
    table.blocker_of = wp.array(blocker_of, dtype=wp.int32, device=device)
    table.blocker = wp.zeros((worlds, len(blockers.first_near) - 1), dtype=wp.vec3, device=device)
    table.faces = wp.array(blockers.faces, dtype=wp.vec3i, device=device)
    clusters = len(blockers.first_of_cluster) - 1
    table.lower = wp.zeros((worlds, clusters), dtype=wp.vec3, device=device)
    table.upper = wp.zeros((worlds, clusters), dtype=wp.vec3, device=device)
    for name in ("first_of_cluster", "first_near", "near", "first_skip"):
        setattr(table, name, wp.array(getattr(blockers, name), dtype=wp.int32, device=device))
    table.far = wp.array(np.arange(blockers.first_of_cluster[-1]), dtype=wp.int32, device=device)
    # A kernel may read, but not use, what stands behind the last one.
    table.skip = wp.array(np.append(blockers.skip, -1), dtype=wp.int32, device=device)
    table.two_sided = blockers.two_sided
    table.offset = ORIGIN_OFFSET * radius
    table.masks = wp.zeros(shape, dtype=mask, device=device)
    return HemisphereState(table, upload_tables([table], BlockerTable, device))


def bring_shape(
    state: HemisphereState, vertices: np.ndarray, normals: np.ndarray, blocker_vertices: np.ndarray, device: wp.Device
) -> None:
    """Brings another shape to the device, of which no transfer is known yet.

    vertices, normals: float32 [worlds, V, 3]. blocker_vertices: float32 [worlds, B, 3].
    """
    state.table.position.assign(vertices)
    state.table.normal.assign(normals)
    state.table.blocker.assign(blocker_vertices)
    state.table.progress.fill_(NOT_SEEN)
    launch(_bound_clusters, state.table.lower.shape, [state.tables], [], device)


def mark_seen(
    state: HemisphereState, entity: int, pixels: ReceiverTable, scene: DeviceScene, device: wp.Device
) -> None:
    """Asks for the transfer of the vertices of an entity whose faces a pixel sees."""
    launch(_mark_seen, pixels.entity.shape, [pixels, entity, scene.geometry, state.tables], [], device)


def rasterise_masks(state: HemisphereState, masks: wp.array, device: wp.Device) -> None:
    """Finds the masks of the vertices that are seen."""
    launch(_rasterise, state.table.position.shape, [state.tables, masks], [], device)


def integrate_masks(
    state: HemisphereState,
    masks: wp.array,
    order: int,
    first_row: int,
    transfer: wp.array,
    visibility: wp.array,
    device: wp.Device,
) -> None:
    """Writes transfer (visibility times the clamped cosine) and visibility of the vertices that are seen, on `order`
    bands, into rows from `first_row` on, world by world. They are kept for as long as the body is still."""
    inputs = [state.tables, masks, first_row]
    outputs = [transfer, visibility]
    launch(make_hemisphere(order).integrate, state.table.position.shape, inputs, outputs, device)


def integrate_lobes(
    state: HemisphereState,
    masks: wp.array,
    order: int,
    eye: wp.array,
    exponent: float,
    first_row: int,
    gloss: wp.array,
    device: wp.Device,
) -> None:
    """Writes visibility times the clamped cosine times the Phong lobe in which the eyes, vec3 (worlds), are seen
    reflected, of all vertices whose masks are known, as `integrate_masks` does."""
    inputs = [state.tables, masks, eye, exponent, first_row]
    launch(make_hemisphere(order).integrate_lobe, state.table.position.shape, inputs, [gloss], device)


def upload_hemispheres(
    scene: Scene,
    shapes: Sequence[DeformingShape],
    blockers: Sequence[BlockerSet],
    order: int,
    worlds: int,
    device: wp.Device,
) -> Hemispheres:
    """Room for the transfer of a scene's deforming entities; shapes and blockers are given in their order."""
    entities = scene.deforming
    states, exponents = {}, {}
    for entity, shape, of_shape in zip(entities, shapes, blockers, strict=True):
        radius = scene.meshes[scene.entities[entity].mesh].radius
        states[entity] = upload_blockers(of_shape, shape.blocker_of, radius, worlds, device)
        exponents[entity] = float(scene.entities[entity].lobe.exponent)
    return Hemispheres(states, exponents, {}, upload_masks(order, device) if entities else None)


def bring_shapes(hemispheres: Hemispheres, bodies: Sequence[Deformed | None], device: wp.Device) -> None:
    """Brings the present shapes to the device, in order; what is still keeps its transfer. None: not shown."""
    for (entity, state), body in zip(hemispheres.states.items(), bodies, strict=True):
        before = hemispheres.shapes.get(entity)
        if body is None or (before is not None and _is_same(body, before)):
            continue
        hemispheres.shapes[entity] = body
        shape = (np.broadcast_to(part, (state.table.position.shape[0], *part.shape)) for part in _parts(body))
        bring_shape(state, *shape, device)


def find_transfer(
    hemispheres: Hemispheres, pixels: ReceiverTable, scene: DeviceScene, lighting: DirectState, device: wp.Device
) -> None:
    """Finds the transfer of the vertices that pixels see into the rows of the lighting's table."""
    for entity, state in hemispheres.states.items():
        first_row, first_gloss = lighting.rows[entity]
        table, order, masks = lighting.table, lighting.order, hemispheres.masks
        mark_seen(state, entity, pixels, scene, device)
        rasterise_masks(state, masks, device)
        integrate_masks(state, masks, order, first_row, table.transfer, table.self_visibility, device)
        if first_gloss >= 0:
            exponent = hemispheres.exponents[entity]
            integrate_lobes(state, masks, order, table.eye, exponent, first_gloss, table.gloss, device)


def _parts(body: Deformed) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return body.vertices, body.normals, body.blocker_vertices


def _is_same(a: Deformed, b: Deformed) -> bool:
    return all(np.array_equal(one, other) for one, other in zip(_parts(a), _parts(b), strict=True))
