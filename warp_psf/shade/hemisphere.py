"""Deforming bodies shadow themselves: hemispherical rasterisation (Kautz 2004).

In every frame each vertex that is seen rasterises the triangles around it into its visibility mask, and integrates what
remains open against spherical harmonics and the cosine. The result, its transfer, is what other bodies keep from their
bake; from there on a deforming body is shaded as they are.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import warp as wp

from warp_psf.basis.visibility_mask import BATCH, MaskTable, MaskTables, cover, make_masks, mask, upload_masks
from warp_psf.device import launch, upload_tables
from warp_psf.field.blockers import BlockerSet
from warp_psf.field.rasterise import (
    BlockerTable,
    BlockerTables,
    Horizon,
    bound_clusters,
    find_planes,
    is_above,
    make_blocker_table,
    make_horizon,
)
from warp_psf.scene.deforming import Deformed, DeformingShape
from warp_psf.scene.geometry import DeviceScene, GeometryTables
from warp_psf.scene.receiver import ReceiverTable
from warp_psf.scene.scene import Scene
from warp_psf.shade.direct import DirectState

# The origin of a mask leaves the surface by this share of the body's radius, as in the bake of rigid bodies: faces that
# meet at a vertex then hide what they should of its valleys.
ORIGIN_OFFSET = 1.0e-3
# What has become of a vertex since the body moved: no pixel needs it, one does, and its transfer is known.
NOT_SEEN, SEEN, DONE = 0, 1, 2


@wp.struct
class HemisphereTable:
    """The vertices of a deforming body that are seen, and the triangles near them; see `BlockerSet`."""

    position: wp.array2d(dtype=wp.vec3)  # (world, vertex), metres, in the world
    normal: wp.array2d(dtype=wp.vec3)  # (world, vertex)
    progress: wp.array2d(dtype=wp.int32)  # (world, vertex): NOT_SEEN, SEEN or DONE
    masks: wp.array2d(dtype=mask)  # (world, vertex): what is blocked
    offset: wp.float32  # of a mask's origin from its vertex, metres
    blocker_of: wp.array(dtype=wp.int32)  # (vertex)
    first_near: wp.array(dtype=wp.int32)  # (blocker vertex + 1)
    near: wp.array(dtype=wp.int32)
    first_skip: wp.array(dtype=wp.int32)  # (blocker vertex + 1)
    skip: wp.array(dtype=wp.int32)


HemisphereTables = wp.array(dtype=HemisphereTable)


@wp.kernel(enable_backward=False, module="unique")
def _mark_seen(first: int, pixels: ReceiverTable, entity: int, geometry: GeometryTables, body: HemisphereTables):
    world, slot = wp.tid()
    slot += first
    if pixels.entity[world, slot] != entity:
        return
    corners = geometry[0].faces[geometry[0].first_face[geometry[0].entity_mesh[entity]] + pixels.face[world, slot]]
    for corner in range(3):
        # Several pixels may write the same.
        if body[0].progress[world, corners[corner]] == wp.static(NOT_SEEN):
            body[0].progress[world, corners[corner]] = wp.static(SEEN)


@wp.func
def horizon_of(world: int, vertex: int, body: HemisphereTables) -> Horizon:
    n = body[0].normal[world, vertex]
    return make_horizon(body[0].position[world, vertex] + body[0].offset * n, n)


@wp.kernel(enable_backward=False, module="unique")
def _rasterise(first: int, body: HemisphereTables, blockers: BlockerTables, masks: MaskTables):
    world, vertex = wp.tid()
    vertex += first
    if body[0].progress[world, vertex] != wp.static(SEEN):
        return
    horizon = horizon_of(world, vertex, body)
    place = body[0].blocker_of[vertex]
    covered = mask()
    for index in range(body[0].first_near[place], body[0].first_near[place + 1], wp.static(BATCH)):
        count = body[0].first_near[place + 1] - index
        planes = find_planes(world, 0, index, count, wp.uint32(0), body[0].near, horizon, blockers)
        covered = cover(covered, masks[0].planes, planes)
    skip = int(body[0].first_skip[place])
    last_skip = body[0].first_skip[place + 1]
    for cluster in range(blockers[0].first_of_cluster.shape[0] - 1):
        if is_above(world, 0, cluster, horizon, blockers):
            end = blockers[0].first_of_cluster[cluster + 1]
            for index in range(blockers[0].first_of_cluster[cluster], end, wp.static(BATCH)):
                # Those that are skipped are in ascending order, as triangles are.
                skipped = wp.uint32(0)
                while skip < last_skip and body[0].skip[skip] < wp.min(index + wp.static(BATCH), end):
                    if body[0].skip[skip] >= index:
                        skipped |= wp.uint32(1) << wp.uint32(body[0].skip[skip] - index)
                    skip += 1
                planes = find_planes(world, 0, index, end - index, skipped, blockers[0].far, horizon, blockers)
                covered = cover(covered, masks[0].planes, planes)
    body[0].masks[world, vertex] = covered


@cache
def make_hemisphere(order: int) -> SimpleNamespace:
    """The kernels that integrate masks against `order` bands."""
    kit = make_masks(order)
    vec = kit.vec

    @wp.kernel(enable_backward=False, module="unique")
    def integrate(
        first: int,
        body: HemisphereTables,
        masks: MaskTables,
        first_row: int,
        transfer_out: wp.array(dtype=vec),  # (row)
        visibility_out: wp.array(dtype=vec),  # (row)
    ):
        world, vertex = wp.tid()
        vertex += first
        if body[0].progress[world, vertex] != wp.static(SEEN):
            return
        body[0].progress[world, vertex] = wp.static(DONE)
        normal = body[0].normal[world, vertex]
        covered = body[0].masks[world, vertex]
        both = kit.open_transfer(covered, normal, masks)
        row = first_row + world * body[0].position.shape[1] + vertex
        transfer_out[row] = both[0]
        visibility_out[row] = both[1]

    @wp.kernel(enable_backward=False, module="unique")
    def integrate_lobe(
        first: int,
        body: HemisphereTables,
        masks: MaskTables,
        eye: wp.array(dtype=wp.vec3),  # (world), metres
        exponent: float,
        first_row: int,
        gloss_out: wp.array(dtype=vec),  # (row)
    ):
        world, vertex = wp.tid()
        vertex += first
        if body[0].progress[world, vertex] != wp.static(DONE):
            return
        normal = body[0].normal[world, vertex]
        view = wp.normalize(eye[world] - body[0].position[world, vertex])
        mirrored = 2.0 * wp.dot(normal, view) * normal - view
        row = first_row + world * body[0].position.shape[1] + vertex
        gloss_out[row] = kit.open_lobe(body[0].masks[world, vertex], normal, mirrored, exponent, masks)

    return SimpleNamespace(vec=vec, integrate=integrate, integrate_lobe=integrate_lobe)


@dataclass(frozen=True, eq=False)
class HemisphereState:
    """A deforming body on the device.

    radius: of the body at rest, metres.
    table, blockers: the tables that the arrays `tables` and `blocker_tables` hold.
    """

    radius: float
    table: HemisphereTable
    tables: wp.array
    blockers: BlockerTable
    blocker_tables: wp.array


@dataclass(frozen=True, eq=False)
class Hemispheres:
    """The deforming bodies of a scene.

    states, and per entity: triangles, all that its vertices may look at; exponents, of their Phong lobes; shapes, what
    was brought last.
    sheets: those that are open. sheet_tables: what hides others of each of these: fewer triangles of the same vertices.
    masks: what masks are drawn with; an array of none where nothing deforms.
    """

    states: dict[int, HemisphereState]
    triangles: dict[int, BlockerSet]
    exponents: dict[int, float]
    shapes: dict[int, Deformed]
    sheets: tuple[int, ...]
    sheet_tables: wp.array
    masks: wp.array


def upload_blockers(
    blockers: BlockerSet, blocker_of: np.ndarray, radius: float, worlds: int, device: wp.Device
) -> HemisphereState:
    """Room for the vertices and masks of a deforming body.

    blocker_of: the blocker vertex of each seen vertex, int32 [V]. radius: of the body at rest, metres.
    """
    table = HemisphereTable()
    shape = (worlds, len(blocker_of))
    table.position = wp.zeros(shape, dtype=wp.vec3, device=device)
    table.normal = wp.zeros(shape, dtype=wp.vec3, device=device)
    table.progress = wp.zeros(shape, dtype=wp.int32, device=device)
    table.masks = wp.zeros(shape, dtype=mask, device=device)
    table.offset = ORIGIN_OFFSET * radius
    table.blocker_of = wp.array(blocker_of, dtype=wp.int32, device=device)
    for name in ("first_near", "near", "first_skip"):
        setattr(table, name, wp.array(getattr(blockers, name), dtype=wp.int32, device=device))
    # A kernel may read, but not use, what stands behind the last one.
    table.skip = wp.array(np.append(blockers.skip, -1), dtype=wp.int32, device=device)
    of_body = make_blocker_table(
        blockers, wp.zeros((worlds, len(blockers.first_near) - 1), dtype=wp.vec3, device=device)
    )
    tables = upload_tables([table], HemisphereTable, device), upload_tables([of_body], BlockerTable, device)
    return HemisphereState(radius, table, tables[0], of_body, tables[1])


def bring_shape(
    state: HemisphereState, vertices: np.ndarray, normals: np.ndarray, blocker_vertices: np.ndarray, device: wp.Device
) -> None:
    """Brings another shape to the device, of which no transfer is known yet.

    vertices, normals: float32 [worlds, V, 3]. blocker_vertices: float32 [worlds, B, 3].
    """
    state.table.position.assign(vertices)
    state.table.normal.assign(normals)
    state.blockers.place.assign(blocker_vertices)
    state.table.progress.fill_(NOT_SEEN)
    bound_clusters(state.blocker_tables, device)


def mark_seen(
    state: HemisphereState, entity: int, pixels: ReceiverTable, scene: DeviceScene, device: wp.Device
) -> None:
    """Asks for the transfer of the vertices of an entity whose faces a pixel sees."""
    launch(_mark_seen, pixels.entity.shape, [pixels, entity, scene.geometry, state.tables], [], device)


def rasterise_masks(state: HemisphereState, masks: wp.array, device: wp.Device) -> None:
    """Finds the masks of the vertices that are seen."""
    launch(_rasterise, state.table.position.shape, [state.tables, state.blocker_tables, masks], [], device)


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
    blockers: Sequence[tuple[BlockerSet, BlockerSet]],
    order: int,
    worlds: int,
    device: wp.Device,
) -> Hemispheres:
    """Room for the transfer of a scene's deforming entities.

    shapes, blockers: in their order; of each body what hides it from itself, and the fewer triangles that hide others.
    """
    states, triangles, exponents, sheets = {}, {}, {}, {}
    for entity, shape, (own, fewer) in zip(scene.deforming, shapes, blockers, strict=True):
        radius = scene.meshes[scene.entities[entity].mesh].radius
        states[entity] = upload_blockers(own, shape.blocker_of, radius, worlds, device)
        triangles[entity] = own
        exponents[entity] = float(scene.entities[entity].lobe.exponent)
        if own.two_sided:
            sheets[entity] = make_blocker_table(fewer, states[entity].blockers.place)
    sheet_tables = upload_tables(list(sheets.values()), BlockerTable, device)
    masks = upload_masks(order, device) if states else wp.zeros(0, dtype=MaskTable, device=device)
    return Hemispheres(states, triangles, exponents, {}, tuple(sheets), sheet_tables, masks)


def look_at(hemispheres: Hemispheres, entity: int, triangles: BlockerSet, device: wp.Device) -> None:
    """From now on the vertices of an entity look at other triangles of the same body."""
    state = hemispheres.states[entity]
    worlds, blocker_of = state.table.position.shape[0], state.table.blocker_of.numpy()
    changed = upload_blockers(triangles, blocker_of, state.radius, worlds, device)
    changed.blockers.place = state.blockers.place  # which a sheet's other table shares
    blocker_tables = upload_tables([changed.blockers], BlockerTable, device)
    hemispheres.states[entity] = replace(changed, blocker_tables=blocker_tables)
    hemispheres.shapes.pop(entity, None)


def bring_shapes(hemispheres: Hemispheres, bodies: Sequence[Deformed | None], device: wp.Device) -> None:
    """Brings the present shapes to the device, in order; what is still keeps its transfer. None: not shown."""
    for (entity, state), body in zip(hemispheres.states.items(), bodies, strict=True):
        before = hemispheres.shapes.get(entity)
        if body is None or (before is not None and _is_same(body, before)):
            continue
        hemispheres.shapes[entity] = body
        shape = (np.broadcast_to(part, (state.table.position.shape[0], *part.shape)) for part in _parts(body))
        bring_shape(state, *shape, device)
    bound_clusters(hemispheres.sheet_tables, device)


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
