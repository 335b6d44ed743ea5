"""The occluders' tables: what a body covers around a point, or the logarithm of what it leaves visible.

Deforming sheets are rasterised into a visibility mask at every receiver: spheres could not fill them.
An object occlusion field of a body is turned with it by evaluating its basis functions at directions of the body, and
a log shadow field by turning its vectors.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from warp_psf.basis import sh, sphere
from warp_psf.basis.directions import quadrature_rows, quadrature_weights
from warp_psf.basis.sh_exp import make_sh_exp, upload_exponential
from warp_psf.basis.visibility_mask import MaskTables, make_masks
from warp_psf.device import launch, upload_tables
from warp_psf.field.rasterise import BlockerTables, draw_all, make_horizon
from warp_psf.field.shells import ShadowField, make_fields, upload_fields
from warp_psf.field.spheres import SphereTables
from warp_psf.scene.geometry import DeviceScene, Placed, PoseTables
from warp_psf.scene.mesh import Mesh
from warp_psf.scene.scene import Scene
from warp_psf.shade.coverage import FIELD_SHAPE, NO_SHAPE, SLAB_SHAPE, SPHERE_SHAPE, make_coverage

# Which of the tables of fields holds what.
COVERAGE, LOGARITHM = 0, 1


@cache
def make_occluders(order: int) -> SimpleNamespace:
    """Device functions for `order` bands: `covered_by`, `covered_by_sheet`, `logarithm_of`, and their table."""
    kit = make_coverage(order)
    values, half_values = kit.values, kit.half_values
    OccluderTable, FieldTable = kit.OccluderTable, make_fields(order).FieldTable
    evaluate, rotate = sh.make_sh(order).evaluate, sh.make_sh(order).rotate
    logs, vec = make_sh_exp(order), kit.vec
    ExpTable = logs.ExpTable
    lookup, blocked_vector = make_fields(order).lookup_coverage, make_masks(order).blocked_vector

    @wp.struct
    class Occlusion:
        """Everything that composing occluders reads, but the poses."""

        occluders: OccluderTable
        fields: wp.array(dtype=FieldTable)  # (2): those of COVERAGE and those of LOGARITHM
        # (world, entity, coefficient): the entity's y_k at the first half of the world's directions
        rows: wp.array3d(dtype=half_values)
        quadrature: wp.array(dtype=half_values)  # x, y, z of the first half of the directions
        log_field: wp.array(dtype=wp.int32)  # (entity): whose logarithm is added, any for spheres; -1 is multiplied
        # (world, entity, coefficient): the entity's y_k as SH vectors of the world
        turns: wp.array3d(dtype=vec)
        exponential: wp.array(dtype=ExpTable)  # (1)
        added: wp.int32  # entities whose logarithms are added
        spheres: SphereTables
        sheets: BlockerTables  # (sheet)
        sheet_entity: wp.array(dtype=wp.int32)  # (sheet)
        sheet_opacity: wp.array(dtype=wp.float32)  # (sheet)
        masks: MaskTables  # (1), or none where there are no sheets

    OcclusionTables = wp.array(dtype=Occlusion)

    @wp.func
    def covered_by(
        world: int,
        entity: int,
        p: wp.vec3,
        placed: Placed,
        o: OcclusionTables,
    ) -> values:
        """The part of the directions around a point of the world that an entity covers: 1 where it does, else 0."""
        shape = o[0].occluders.shape[entity]
        if shape == wp.static(FIELD_SHAPE):
            p_body = wp.transpose(placed.rotation) * (p - placed.position)
            return kit.at_directions(
                lookup(o[0].fields, wp.static(COVERAGE), o[0].occluders.field[entity], p_body), o[0].rows[world, entity]
            )
        if shape == wp.static(SPHERE_SHAPE):
            offset = placed.center - p
            distance = wp.length(offset)
            # Inside, by contact, counts as on the surface.
            sine = wp.min(placed.radius / wp.max(distance, 1.0e-9), 1.0)
            return kit.cap_coverage(offset / wp.max(distance, 1.0e-9), sine, o[0].quadrature)
        if shape == wp.static(SLAB_SHAPE):
            to_world = placed.rotation * o[0].occluders.slab_rotation[entity]
            origin = placed.position + placed.rotation * o[0].occluders.slab_center[entity]
            p_slab = wp.transpose(to_world) * (p - origin)
            return kit.slab_coverage(p_slab, o[0].occluders.slab_half[entity], to_world, o[0].quadrature)
        return values()

    @wp.func
    def covered_by_sheet(world: int, sheet: int, p: wp.vec3, n: wp.vec3, o: OcclusionTables) -> values:
        """The part of the directions above a receiver's horizon that a deforming sheet covers."""
        hidden = draw_all(world, sheet, make_horizon(p, n), o[0].sheets, o[0].masks)
        return kit.at_directions(blocked_vector(hidden, n, o[0].masks), o[0].rows[world, o[0].sheet_entity[sheet]])

    @wp.func
    def logarithm_of(
        world: int,
        entity: int,
        p: wp.vec3,
        placed: Placed,
        o: OcclusionTables,
    ) -> vec:
        """The logarithm of what an entity leaves visible around a point of the world."""
        if o[0].occluders.shape[entity] == wp.static(SPHERE_SHAPE):
            offset = placed.center - p
            distance = wp.max(wp.length(offset), 1.0e-9)
            return logs.cap_logarithm(offset / distance, wp.min(placed.radius / distance, 1.0), o[0].exponential)
        p_body = wp.transpose(placed.rotation) * (p - placed.position)
        return rotate(
            lookup(o[0].fields, wp.static(LOGARITHM), o[0].log_field[entity], p_body), o[0].turns[world, entity]
        )

    @wp.kernel(enable_backward=False, module="unique")
    def turn_basis(
        first: int,
        poses: PoseTables,
        directions: wp.array(dtype=wp.vec3),  # (quadrature point)
        weighted: wp.array(dtype=vec),  # (quadrature point): the world's basis functions, times twice the weight
        rows_out: wp.array4d(dtype=wp.float32),  # (world, entity, coefficient, quadrature point)
        turns_out: wp.array3d(dtype=vec),  # (world, entity, coefficient)
    ):
        world, entity = wp.tid()
        entity += first
        to_entity = wp.transpose(poses[0].rotation[world, entity])
        for k in range(wp.static(order * order)):
            turns_out[world, entity, k] = vec()
        for q in range(directions.shape[0]):
            turned = evaluate(to_entity * directions[q])
            for k in range(wp.static(order * order)):
                rows_out[world, entity, k, q] = turned[k]
                # Products of two functions of one band are even, so that half of the directions have all of them.
                turns_out[world, entity, k] += turned[k] * weighted[q]

    return SimpleNamespace(
        **vars(kit),
        Occlusion=Occlusion,
        OcclusionTables=OcclusionTables,
        covered_by=covered_by,
        covered_by_sheet=covered_by_sheet,
        logarithm_of=logarithm_of,
        turn_basis=turn_basis,
    )


@dataclass(frozen=True)
class OcclusionState:
    """The occlusion tables of a scene, and what is needed to turn them with the poses of a frame."""

    order: int
    table: Any  # make_occluders(order).Occlusion
    tables: wp.array  # (1): the table, as kernels take it
    directions: wp.array
    weighted: wp.array  # (quadrature point): the basis functions there, times twice the weight
    rows: wp.array  # (world, entity, coefficient, quadrature point): the memory behind table.rows


def upload_occlusion(
    scene: Scene,
    fields: list[ShadowField | None],
    log_fields: list[ShadowField | None] | None,
    spheres: wp.array,
    sheets: Sequence[int],
    sheet_tables: wp.array,
    masks: wp.array,
    order: int,
    worlds: int,
    device: wp.Device,
) -> OcclusionState:
    """The occlusion tables of a scene.

    fields: per entity its field, or None where its coverage has a closed form. Entities may share a field.
    log_fields: per entity its log shadow field likewise, for composing by logarithms; None for composing by products.
        Boxes are multiplied even so, because their coverage has a closed form and its logarithm has none, and bodies
        that light passes through, whose visibility is 1 minus a share of the coverage.
    spheres: the `SphereTable` of its sphere sets, as an array of one.
    sheets: the entities that are rasterised. sheet_tables: the `BlockerTable` of each. masks: the `MaskTable` for that,
        as an array of one.
    """
    kit = make_occluders(order)
    shape_of_rows = (worlds, len(scene.entities), order * order)
    rows = wp.zeros((*shape_of_rows, kit.points // 2), dtype=wp.float32, device=device)
    table = kit.Occlusion()
    table.occluders, coverage = _upload_occluders(scene, fields, order, device)
    table.sheets, table.masks = sheet_tables, masks
    table.sheet_entity = wp.array(list(sheets), dtype=wp.int32, device=device)
    sheet_opacity = [scene.entities[entity].opacity for entity in sheets]
    table.sheet_opacity = wp.array(sheet_opacity, dtype=wp.float32, device=device)
    table.rows = wp.array(ptr=rows.ptr, dtype=kit.half_values, shape=shape_of_rows, device=device, copy=False)
    table.quadrature = quadrature_rows(order, device)
    log_field, distinct = _number_logarithms(scene, log_fields)
    table.log_field = wp.array(log_field, dtype=wp.int32, device=device)
    table.added = sum(number >= 0 for number in log_field)
    tables = [coverage, upload_fields(distinct, order, device)]
    table.fields = upload_tables(tables, make_fields(order).FieldTable, device)
    table.turns = wp.zeros(shape_of_rows, dtype=kit.vec, device=device)
    table.exponential, table.spheres = upload_exponential(order, device), spheres
    tables = upload_tables([table], kit.Occlusion, device)
    half = slice(0, kit.points // 2)
    directions = sphere.quadrature(kit.points)[0][half]
    weighted = (2 * quadrature_weights(order)[half, None] * sh.evaluate(directions, order)).astype(np.float32)
    arrays = wp.array(directions, dtype=wp.vec3, device=device), wp.array(weighted, dtype=kit.vec, device=device)
    return OcclusionState(order, table, tables, *arrays, rows)


def _upload_occluders(scene: Scene, fields: list[ShadowField | None], order: int, device: wp.Device) -> tuple[Any, Any]:
    """How each entity is looked up, and in which fields."""
    distinct, number = _distinct(fields)
    shapes = [scene.meshes[entity.mesh] for entity in scene.entities]
    occluders = make_occluders(order).OccluderTable()
    shape = [_shape_of(mesh, field) for mesh, field in zip(shapes, fields, strict=True)]
    occluders.shape = wp.array(shape, dtype=wp.int32, device=device)
    opacity = [entity.opacity if entity.casts else 0.0 for entity in scene.entities]
    occluders.opacity = wp.array(opacity, dtype=wp.float32, device=device)
    occluders.field = wp.array(number, dtype=wp.int32, device=device)
    slabs = [mesh.slab or (np.zeros(3), np.eye(3), np.ones(3)) for mesh in shapes]
    occluders.slab_center = wp.array(np.array([slab[0] for slab in slabs]), dtype=wp.vec3, device=device)
    occluders.slab_rotation = wp.array(np.array([slab[1] for slab in slabs]), dtype=wp.mat33, device=device)
    occluders.slab_half = wp.array(np.array([slab[2] for slab in slabs]), dtype=wp.vec3, device=device)
    return occluders, upload_fields(distinct, order, device)


def _number_logarithms(
    scene: Scene, log_fields: list[ShadowField | None] | None
) -> tuple[list[int], list[ShadowField]]:
    """Per entity the log shadow field that is added, -1 where its visibility is multiplied; and the fields."""
    if log_fields is None:
        return [-1] * len(scene.entities), []
    distinct, number = _distinct(log_fields)
    for index, entity in enumerate(scene.entities):
        mesh = scene.meshes[entity.mesh]
        if mesh.sphere is not None and mesh.slab is None:
            number[index] = 0
        if entity.opacity < 1.0:
            number[index] = -1
    return number, distinct


def _distinct(fields: list[ShadowField | None]) -> tuple[list[ShadowField], list[int]]:
    """The fields, each once, and per entity which of them it has, -1 for none."""
    distinct = list({id(field): field for field in fields if field is not None}.values())
    number = {id(field): index for index, field in enumerate(distinct)}
    return distinct, [number.get(id(field), -1) for field in fields]


def turn_occlusion(state: OcclusionState, scene: DeviceScene, device: wp.Device) -> None:
    """Turns every entity's basis with its pose; once per frame."""
    kit = make_occluders(state.order)
    inputs = [scene.poses, state.directions, state.weighted]
    launch(kit.turn_basis, state.rows.shape[:2], inputs, [state.rows, state.table.turns], device)


def _shape_of(mesh: Mesh, field: ShadowField | None) -> int:
    if mesh.slab is not None:
        return SLAB_SHAPE
    if mesh.sphere is not None:
        return SPHERE_SHAPE
    return NO_SHAPE if field is None else FIELD_SHAPE
