"""Direct light: the integral over directions of light, visibility and reflectance (Tamura 2006, Figure 3)."""

from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from warp_psf.basis import sh
from warp_psf.device import launch
from warp_psf.scene.geometry import DeviceScene, GeometryTable, PoseTable
from warp_psf.scene.mesh import Mesh
from warp_psf.scene.receiver import ReceiverTable
from warp_psf.scene.scene import Scene
from warp_psf.shade.area import make_area
from warp_psf.shade.directions import basis_at_directions, quadrature_weights
from warp_psf.shade.occlude import OcclusionState, make_occlude


@cache
def make_direct(order: int) -> SimpleNamespace:
    """The kernel and tables of direct light on `order` bands."""
    kit = make_occlude(order)
    vec, values, half_values = kit.vec, kit.values, kit.half_values
    Occlusion = kit.Occlusion
    area = make_area(order)
    profile = kit.profile
    # The closed forms of the transfer are not stored, so they may have a band more than the fields: the clamped
    # cosine's last large coefficient is that of l = 4. With one occluder the quadrature is exact up to order 5, and to
    # 1e-4 at order 6.
    cosine_profile = profile(*legendre_series(sh.clamped_cosine(order + 1)))

    @wp.struct
    class Lighting:
        """Lights and what receives them."""

        environment: wp.array2d(dtype=values)  # (world, channel): radiance times quadrature weight
        weights: wp.array(dtype=values)  # (1): of the quadrature
        light_entity: wp.array(dtype=wp.int32)  # (area light)
        light_radiance: wp.array2d(dtype=wp.vec3)  # (world, area light)
        light_facing: wp.array(dtype=wp.vec3)  # (area light): front of a flat one in its frame, else zero
        eye: wp.array(dtype=wp.vec3)  # (world), metres
        transfer: wp.array(dtype=vec)  # (transfer vertex), in the entity's frame
        self_visibility: wp.array(dtype=vec)  # (transfer vertex)
        first_transfer: wp.array(dtype=wp.int32)  # (entity): -1 for convex bodies
        lobe: wp.array(dtype=profile)  # (entity): Phong lobe, coefficients of Legendre polynomials

    @wp.func
    def mirror(eye: wp.vec3, p: wp.vec3, n: wp.vec3) -> wp.vec3:
        """The direction from which a mirror at p would send light to the eye."""
        view = wp.normalize(eye - p)
        return 2.0 * wp.dot(n, view) * n - view

    @wp.func
    def interpolate(
        stored: wp.array(dtype=vec), start: int, corners: wp.vec3i, uv: wp.vec2, rows: wp.array(dtype=half_values)
    ) -> values:
        return kit.at_directions(
            uv[0] * stored[start + corners[0]]
            + uv[1] * stored[start + corners[1]]
            + (1.0 - uv[0] - uv[1]) * stored[start + corners[2]],
            rows,
        )

    @wp.kernel(module="unique")
    def shade_receivers(
        first: int,
        receivers: ReceiverTable,
        turns: wp.array2d(dtype=wp.int32),  # (world, receiver)
        turn: int,
        geometry: GeometryTable,
        poses: PoseTable,
        o: Occlusion,
        lighting: Lighting,
        diffuse_out: wp.array2d(dtype=wp.vec3),  # (world, receiver): irradiance
        glossy_out: wp.array2d(dtype=wp.vec3),  # (world, receiver): radiance through the normalised Phong lobe
    ):
        world, receiver = wp.tid()
        receiver += first
        entity = receivers.entity[world, receiver]
        if entity < 0 or turns[world, receiver] != turn:
            return
        p = receivers.position[world, receiver]
        n = receivers.normal[world, receiver]
        rows = o.rows[world, entity]
        start = int(lighting.first_transfer[entity])
        mesh = geometry.entity_mesh[entity]
        corners = geometry.faces[geometry.first_face[mesh] + receivers.face[world, receiver]]
        uv = receivers.uv[world, receiver]
        transfer = values()
        if start >= 0:
            first_vertex = geometry.first_vertex[mesh]
            outward = poses.rotation[world, entity] * (
                uv[0] * geometry.normals[first_vertex + corners[0]]
                + uv[1] * geometry.normals[first_vertex + corners[1]]
                + (1.0 - uv[0] - uv[1]) * geometry.normals[first_vertex + corners[2]]
            )
            if wp.dot(outward, n) < 0.0:
                start = -1  # the back of an open surface: what is stored is of its front
        if start >= 0:
            transfer = interpolate(lighting.transfer, start, corners, uv, rows)
        else:
            transfer = kit.zonal_at_directions(wp.static(cosine_profile), n, o.quadrature)

        glossy = wp.max(geometry.specular[entity]) > 0.0
        lobe = values()
        if glossy:
            mirrored = mirror(lighting.eye[world], p, n)
            lobe = kit.zonal_at_directions(lighting.lobe[entity], mirrored, o.quadrature)
            # The transfer brings the cosine that the lobe is normalised for, and what the body hides from itself.
            lobe = wp.cw_mul(lobe, transfer)

        lights = lighting.light_entity.shape[0]
        first_light = int(-1)
        facing = wp.vec3()
        if lights > 0:
            first_light = lighting.light_entity[0]
            facing = poses.rotation[world, first_light] * lighting.light_facing[0]
        visible, before = kit.visibility_at(world, entity, first_light, facing, p, n, geometry, poses, o)
        received = wp.cw_mul(visible, transfer)
        diffuse = wp.vec3(
            kit.sum_of_products(lighting.environment[world, 0], received),
            kit.sum_of_products(lighting.environment[world, 1], received),
            kit.sum_of_products(lighting.environment[world, 2], received),
        )
        reflected = wp.vec3()
        if glossy:
            received = wp.cw_mul(visible, lobe)
            reflected = wp.vec3(
                kit.sum_of_products(lighting.environment[world, 0], received),
                kit.sum_of_products(lighting.environment[world, 1], received),
                kit.sum_of_products(lighting.environment[world, 2], received),
            )

        open_to_self = values(1.0)
        if start >= 0 and lights > 0:
            # 1 minus what the body itself blocks above the horizon.
            open_to_self += interpolate(lighting.self_visibility, start, corners, uv, rows)
            open_to_self -= kit.cap_coverage(n, 0.0, o.quadrature)
        for light in range(lights):
            shining = lighting.light_entity[light]
            rotation = poses.rotation[world, shining]
            position = poses.position[world, shining]
            radius = geometry.radius[shining]
            center = position + rotation * geometry.center[shining]
            facing = rotation * lighting.light_facing[light]
            lit = wp.dot(n, center - p) > -radius and shining != entity
            if wp.length_sq(facing) > 0.0:
                lit = lit and wp.dot(facing, p - center) > 0.0
            if lit:
                if light > 0:
                    _all, before = kit.visibility_at(world, entity, shining, facing, p, n, geometry, poses, o)
                seen = kit.coverage_of(
                    shining,
                    p,
                    position,
                    rotation,
                    geometry.center[shining],
                    radius,
                    o.occluders,
                    o.fields,
                    o.rows[world, shining],
                    o.quadrature,
                )
                weighted = wp.cw_mul(seen, lighting.weights[0])
                passed = kit.sum_of_products(weighted, wp.cw_mul(before, open_to_self))
                share = wp.clamp(passed / wp.max(kit.sum_of_products(weighted, values(1.0)), 1.0e-9), 0.0, 1.0)
                unhindered = area.area_irradiance(shining, p, n, position, rotation, center, radius, o.occluders)
                if unhindered < 0.0:
                    unhindered = wp.max(
                        kit.sum_of_products(
                            weighted, kit.zonal_at_directions(wp.static(cosine_profile), n, o.quadrature)
                        ),
                        0.0,
                    )
                radiance = share * lighting.light_radiance[world, light]
                diffuse += unhindered * radiance
                if glossy:
                    mirrored = mirror(lighting.eye[world], p, n)
                    exponent = geometry.exponent[entity]
                    shine = area.area_gloss(shining, p, n, mirrored, exponent, position, rotation, o.occluders)
                    if shine < 0.0:
                        shine = wp.max(kit.sum_of_products(weighted, lobe), 0.0)
                    reflected += shine * radiance

        zero = wp.vec3()
        diffuse_out[world, receiver] = wp.max(diffuse, zero)
        glossy_out[world, receiver] = wp.max(reflected, zero)

    return SimpleNamespace(**vars(kit), Lighting=Lighting, shade_receivers=shade_receivers)


def legendre_series(zonal: np.ndarray) -> np.ndarray:
    """A zonal function's coefficients f_l -> those of Legendre polynomials of the cosine to its axis, [order]."""
    return zonal * np.sqrt((2 * np.arange(len(zonal)) + 1) / (4 * np.pi))


@dataclass(frozen=True)
class DirectState:
    """The lighting tables of a scene."""

    order: int
    table: Any  # make_direct(order).Lighting


def upload_lighting(
    scene: Scene,
    transfers: list[tuple[np.ndarray, np.ndarray] | None],
    lights: list[tuple[int, np.ndarray]],
    order: int,
    worlds: int,
    device: wp.Device,
) -> DirectState:
    """The lighting tables of a scene.

    transfers: per mesh its (transfer, self-visibility), float32 [vertices, order^2] each, or None if it is convex.
    lights: (entity, radiance [3]) of each area light.
    """
    kit = make_direct(order)
    table = kit.Lighting()
    table.environment = wp.zeros((worlds, 3), dtype=kit.values, device=device)
    weights = quadrature_weights(order).astype(np.float32)
    table.weights = wp.array(weights[None], dtype=kit.values, device=device)
    table.light_entity = wp.array([entity for entity, _ in lights], dtype=wp.int32, device=device)
    radiance = np.array([radiance for _, radiance in lights], np.float32).reshape(1, -1, 3)
    table.light_radiance = wp.array(np.repeat(radiance, worlds, axis=0), dtype=wp.vec3, device=device)
    facing = [_facing_of(scene.meshes[scene.entities[entity].mesh]) for entity, _ in lights]
    table.light_facing = wp.array(np.array(facing, np.float32).reshape(-1, 3), dtype=wp.vec3, device=device)
    table.eye = wp.zeros(worlds, dtype=wp.vec3, device=device)

    stored = [pair for pair in transfers if pair is not None]
    empty = np.zeros((0, order * order), np.float32)
    table.transfer = wp.array(np.concatenate([empty, *(p[0] for p in stored)]), dtype=kit.vec, device=device)
    table.self_visibility = wp.array(np.concatenate([empty, *(p[1] for p in stored)]), dtype=kit.vec, device=device)
    starts, total = [], 0
    for pair in transfers:
        starts.append(-1 if pair is None else total)
        total += 0 if pair is None else len(pair[0])
    first = [starts[entity.mesh] for entity in scene.entities]
    table.first_transfer = wp.array(first, dtype=wp.int32, device=device)
    lobes = [legendre_series(sh.phong_lobe(entity.material.exponent, order + 1)) for entity in scene.entities]
    table.lobe = wp.array(np.array(lobes, np.float32).reshape(-1, order + 1), dtype=kit.profile, device=device)
    return DirectState(order, table)


def write_environment(state: DirectState, coefficients: np.ndarray) -> None:
    """Sets the environment of every world: radiance on SH, float64 [order^2, 3]."""
    order = state.order
    values = basis_at_directions(order) @ coefficients
    weighted = quadrature_weights(order)[:, None] * values
    worlds = state.table.environment.shape[0]
    state.table.environment.assign(np.repeat(weighted.T.astype(np.float32)[None], worlds, axis=0))


def shade_direct(
    receivers: ReceiverTable,
    turns: wp.array,
    turn: int,
    scene: DeviceScene,
    occlusion: OcclusionState,
    lighting: DirectState,
    diffuse: wp.array,
    glossy: wp.array,
    device: wp.Device,
) -> None:
    """Writes the irradiance of the receivers whose turn it is, and their radiance through the Phong lobe.

    turns: int32 (worlds, receivers). diffuse, glossy: vec3 (worlds, receivers); the others' values stay.
    """
    kit = make_direct(lighting.order)
    inputs = [receivers, turns, turn, scene.geometry, scene.poses, occlusion.table, lighting.table]
    launch(kit.shade_receivers, diffuse.shape, inputs, [diffuse, glossy], device)


def _facing_of(mesh: Mesh) -> np.ndarray:
    """The side to which a flat open mesh shines; zero for others."""
    if mesh.slab is None or mesh.slab[2].min() > 0:
        return np.zeros(3)
    return mesh.normals.mean(axis=0)
