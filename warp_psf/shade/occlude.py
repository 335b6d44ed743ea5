"""Composing occluders: the visibility that the bodies around a receiver leave, at the directions of a quadrature."""

from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from warp_psf.basis import sh, sphere
from warp_psf.basis.directions import quadrature_rows
from warp_psf.device import launch
from warp_psf.field.shells import ShadowField, upload_fields
from warp_psf.scene.geometry import DeviceScene, GeometryTable, PoseTable
from warp_psf.scene.mesh import Mesh
from warp_psf.scene.scene import Scene
from warp_psf.shade.coverage import FIELD_SHAPE, NO_SHAPE, SLAB_SHAPE, SPHERE_SHAPE, make_coverage

# An occluder whose bounding sphere could take less than this share of a diffuse receiver's light is left out: seen
# face-on a sphere of radius R at distance d takes (R/d)^2. It fades in up to twice the share, so that nothing pops.
SMALLEST_SHARE = 1.0e-3
# A body whose bounding sphere lies below the receiver's horizon is left out too: what band-limited functions let
# through there is not real. It fades in as it rises by this share of its radius; slabs have a horizon of their own.
HORIZON_FADE = 0.6
# A slab whose corners rise above the receiver's tangent plane by less than this share of its half-diagonal counts as
# below it: the floor beside a receiver on the same floor.
SLAB_HORIZON = 1.0e-5
# What can stand between a receiver and a light and what cannot is told by planes: of a slab's faces, when both lie
# before one, and of a flat light, when an occluder lies behind it. At a plane occluders fade over this share of the
# light's radius.
LIGHT_FADE = 0.25


@cache
def make_occlude(order: int) -> SimpleNamespace:
    """Device functions for `order` bands: `covered_by`, `visibility_at`, and their tables."""
    kit = make_coverage(order)
    values, half_values = kit.values, kit.half_values
    OccluderTable, FieldTable = kit.OccluderTable, kit.FieldTable
    evaluate = sh.make_sh(order).evaluate

    @wp.struct
    class Occlusion:
        """Everything that composing occluders reads, but the poses."""

        occluders: OccluderTable
        fields: FieldTable
        # (world, entity, coefficient): the entity's y_k at the first half of the world's directions
        rows: wp.array3d(dtype=half_values)
        quadrature: wp.array(dtype=half_values)  # x, y, z of the first half of the directions

    @wp.func
    def covered_by(
        world: int, entity: int, p: wp.vec3, geometry: GeometryTable, poses: PoseTable, o: Occlusion
    ) -> values:
        """The coverage of an entity, where it is in this frame, around a point of the world."""
        return kit.coverage_of(
            entity,
            p,
            poses.position[world, entity],
            poses.rotation[world, entity],
            geometry.center[entity],
            geometry.radius[entity],
            o.occluders,
            o.fields,
            o.rows[world, entity],
            o.quadrature,
        )

    @wp.func
    def matters(
        entity: int, own: int, p: wp.vec3, n: wp.vec3, center: wp.vec3, radius: float, rotation: wp.mat33, o: Occlusion
    ) -> float:
        """How far an entity can take light from a receiver at p with normal n: 0 not at all, its opacity fully."""
        opacity = o.occluders.opacity[entity]
        if entity == own or opacity <= 0.0:
            return 0.0
        offset = center - p
        height = wp.dot(n, offset)
        if height < -radius:
            return 0.0
        share = radius * radius / wp.max(wp.dot(offset, offset), 1.0e-12)
        size = opacity * wp.clamp(share / wp.static(SMALLEST_SHARE) - 1.0, 0.0, 1.0)
        if o.occluders.shape[entity] == wp.static(SLAB_SHAPE):
            half = o.occluders.slab_half[entity]
            n_slab = wp.transpose(rotation * o.occluders.slab_rotation[entity]) * n
            rise = wp.abs(n_slab[0]) * half[0] + wp.abs(n_slab[1]) * half[1] + wp.abs(n_slab[2]) * half[2]
            return size * wp.where(height + rise > wp.static(SLAB_HORIZON) * radius, 1.0, 0.0)
        risen = wp.min((height + radius) / (wp.static(HORIZON_FADE) * radius), 1.0)
        return size * risen * risen * (3.0 - 2.0 * risen)

    @wp.func
    def nearness(
        entity: int,
        p: wp.vec3,
        center: wp.vec3,
        radius: float,
        position: wp.vec3,
        rotation: wp.mat33,
        light_center: wp.vec3,
        light_radius: float,
        light_facing: wp.vec3,
        o: Occlusion,
    ) -> float:
        """How far an entity is nearer to p than a light: 1 in front of it, 0 behind it, smooth between."""
        # Nothing behind a flat light's plane stands in its way, however near it is: a ceiling above a lamp. What comes
        # out from behind fades in.
        ahead_of_light = wp.dot(light_facing, center - light_center)
        if o.occluders.shape[entity] == wp.static(SLAB_SHAPE):
            half = o.occluders.slab_half[entity]
            facing_slab = wp.transpose(rotation * o.occluders.slab_rotation[entity]) * light_facing
            ahead_of_light += (
                wp.abs(facing_slab[0]) * half[0] + wp.abs(facing_slab[1]) * half[1] + wp.abs(facing_slab[2]) * half[2]
            )
        else:
            ahead_of_light += radius
        fade = wp.max(wp.static(LIGHT_FADE) * light_radius, 1.0e-9)
        before = float(1.0)
        if wp.length_sq(light_facing) > 0.0:
            before = wp.clamp(ahead_of_light / fade, 0.0, 1.0)
        if o.occluders.shape[entity] == wp.static(SLAB_SHAPE):
            to_slab = wp.transpose(rotation * o.occluders.slab_rotation[entity])
            origin = position + rotation * o.occluders.slab_center[entity]
            p_slab = to_slab * (p - origin)
            light_slab = to_slab * (light_center - origin)
            half = o.occluders.slab_half[entity]
            apart = float(-1.0e30)
            for axis in range(3):
                side = wp.where(p_slab[axis] < 0.0, -1.0, 1.0)
                ahead = wp.min(side * p_slab[axis], side * light_slab[axis] - light_radius) - half[axis]
                apart = wp.max(apart, ahead)
            return before * (1.0 - wp.clamp(apart / fade, 0.0, 1.0))
        return before * wp.clamp(
            0.5 + (wp.length(light_center - p) - wp.length(center - p)) / wp.max(light_radius + radius, 1.0e-9),
            0.0,
            1.0,
        )

    @wp.func
    def visibility_at(
        world: int,
        own: int,
        light: int,
        light_facing: wp.vec3,
        p: wp.vec3,
        n: wp.vec3,
        geometry: GeometryTable,
        poses: PoseTable,
        o: Occlusion,
    ):
        """Visibility past every entity but `own`, and past those nearer than the entity `light` (-1: not asked for).

        light_facing: the side to which a flat light shines, in the world; zero for others. Each visibility is the
        product of what the entities leave (Zhou 2005; Tamura 2006, Figure 3).
        """
        visible = values(1.0)
        before = values(1.0)
        light_center = wp.vec3()
        light_radius = float(0.0)
        if light >= 0:
            light_center = poses.position[world, light] + poses.rotation[world, light] * geometry.center[light]
            light_radius = geometry.radius[light]
        for entity in range(geometry.entity_mesh.shape[0]):
            position = poses.position[world, entity]
            rotation = poses.rotation[world, entity]
            radius = geometry.radius[entity]
            center = position + rotation * geometry.center[entity]
            weight = matters(entity, own, p, n, center, radius, rotation, o)
            if weight > 0.0:
                covered = covered_by(world, entity, p, geometry, poses, o)
                visible = wp.cw_mul(visible, values(1.0) - weight * covered)
                if light >= 0:
                    weight *= nearness(
                        entity, p, center, radius, position, rotation, light_center, light_radius, light_facing, o
                    )
                    before = wp.cw_mul(before, values(1.0) - weight * covered)
        return visible, before

    @wp.kernel(enable_backward=False, module="unique")
    def turn_basis(
        first: int,
        poses: PoseTable,
        directions: wp.array(dtype=wp.vec3),  # (quadrature point)
        rows_out: wp.array4d(dtype=wp.float32),  # (world, entity, coefficient, quadrature point)
    ):
        world, entity = wp.tid()
        entity += first
        to_entity = wp.transpose(poses.rotation[world, entity])
        for q in range(directions.shape[0]):
            turned = evaluate(to_entity * directions[q])
            for k in range(wp.static(order * order)):
                rows_out[world, entity, k, q] = turned[k]

    return SimpleNamespace(
        **vars(kit),
        Occlusion=Occlusion,
        covered_by=covered_by,
        matters=matters,
        visibility_at=visibility_at,
        turn_basis=turn_basis,
    )


@dataclass(frozen=True)
class OcclusionState:
    """The occlusion tables of a scene, and what is needed to turn them with the poses of a frame."""

    order: int
    table: Any  # make_occlude(order).Occlusion
    directions: wp.array
    rows: wp.array  # (world, entity, coefficient, quadrature point): the memory behind table.rows


def upload_occlusion(
    scene: Scene,
    fields: list[ShadowField | None],
    order: int,
    worlds: int,
    device: wp.Device,
) -> OcclusionState:
    """The occlusion tables of a scene.

    fields: per entity its field, or None where its coverage has a closed form. Entities may share a field.
    """
    kit = make_occlude(order)
    distinct = list({id(field): field for field in fields if field is not None}.values())
    number = {id(field): index for index, field in enumerate(distinct)}
    shapes = [scene.meshes[entity.mesh] for entity in scene.entities]
    occluders = kit.OccluderTable()
    shape = [_shape_of(mesh, field) for mesh, field in zip(shapes, fields, strict=True)]
    occluders.shape = wp.array(shape, dtype=wp.int32, device=device)
    opacity = [entity.opacity if entity.casts else 0.0 for entity in scene.entities]
    occluders.opacity = wp.array(opacity, dtype=wp.float32, device=device)
    occluders.field = wp.array([number.get(id(field), -1) for field in fields], dtype=wp.int32, device=device)
    slabs = [mesh.slab or (np.zeros(3), np.eye(3), np.ones(3)) for mesh in shapes]
    occluders.slab_center = wp.array(np.array([slab[0] for slab in slabs]), dtype=wp.vec3, device=device)
    occluders.slab_rotation = wp.array(np.array([slab[1] for slab in slabs]), dtype=wp.mat33, device=device)
    occluders.slab_half = wp.array(np.array([slab[2] for slab in slabs]), dtype=wp.vec3, device=device)

    shape_of_rows = (worlds, len(shapes), order * order)
    rows = wp.zeros((*shape_of_rows, kit.points // 2), dtype=wp.float32, device=device)
    table = kit.Occlusion()
    table.occluders = occluders
    table.fields = upload_fields(distinct, order, device)
    table.rows = wp.array(ptr=rows.ptr, dtype=kit.half_values, shape=shape_of_rows, device=device, copy=False)
    table.quadrature = quadrature_rows(order, device)
    directions = sphere.quadrature(kit.points)[0][: kit.points // 2]
    return OcclusionState(order, table, wp.array(directions, dtype=wp.vec3, device=device), rows)


def turn_occlusion(state: OcclusionState, scene: DeviceScene, device: wp.Device) -> None:
    """Turns every entity's basis with its pose; once per frame."""
    kit = make_occlude(state.order)
    launch(kit.turn_basis, state.rows.shape[:2], [scene.poses, state.directions], [state.rows], device)


def _shape_of(mesh: Mesh, field: ShadowField | None) -> int:
    if mesh.slab is not None:
        return SLAB_SHAPE
    if mesh.sphere is not None:
        return SPHERE_SHAPE
    return NO_SHAPE if field is None else FIELD_SHAPE
