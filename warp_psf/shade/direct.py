"""Direct light: the integral over directions of light, visibility and reflectance (Tamura 2006, Figure 3)."""

from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from warp_psf.basis import sh
from warp_psf.basis.directions import basis_at_directions, quadrature_weights
from warp_psf.device import launch, upload_tables
from warp_psf.scene.geometry import DeviceScene, GeometryTables, PoseTables, find_placed
from warp_psf.scene.mesh import Mesh
from warp_psf.scene.receiver import ReceiverTable, in_use
from warp_psf.scene.scene import Scene
from warp_psf.shade.area import make_area
from warp_psf.shade.occlude import make_occlude
from warp_psf.shade.occluders import OcclusionState
from warp_psf.shade.spheres import CutTables


@cache
def make_direct(order: int) -> SimpleNamespace:
    """The kernel and tables of direct light on `order` bands."""
    kit = make_occlude(order)
    vec, values, half_values = kit.vec, kit.values, kit.half_values
    OcclusionTables = kit.OcclusionTables
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
        first_transfer: wp.array2d(dtype=wp.int32)  # (world, entity): -1 for convex bodies
        gloss: wp.array(dtype=vec)  # (gloss vertex): transfer through the lobe in which the eye is seen
        first_gloss: wp.array2d(dtype=wp.int32)  # (world, entity): -1 where that is the product of both
        lobe: wp.array(dtype=profile)  # (entity): Phong lobe, coefficients of Legendre polynomials

    LightingTables = wp.array(dtype=Lighting)

    @wp.struct
    class Surface:
        """A receiver with what shading it needs to know of the surface it lies on."""

        entity: wp.int32
        position: wp.vec3
        normal: wp.vec3
        mirrored: wp.vec3  # where a mirror there would send the eye's rays
        first_transfer: wp.int32  # of the entity's stored transfer; -1 where the closed form holds
        first_gloss: wp.int32  # of the entity's stored gloss, -1 where there is none
        corners: wp.vec3i  # of the face
        uv: wp.vec2  # weights of the first two corners

    @wp.func
    def surface_of(
        world: int,
        receiver: int,
        receivers: ReceiverTable,
        geometry: GeometryTables,
        poses: PoseTables,
        lighting: LightingTables,
    ) -> Surface:
        surface = Surface()
        entity = receivers.entity[world, receiver]
        mesh = geometry[0].entity_mesh[entity]
        surface.entity = entity
        surface.position = receivers.position[world, receiver]
        surface.normal = receivers.normal[world, receiver]
        surface.corners = geometry[0].faces[geometry[0].first_face[mesh] + receivers.face[world, receiver]]
        surface.uv = receivers.uv[world, receiver]
        surface.first_transfer = lighting[0].first_transfer[world, entity]
        surface.first_gloss = lighting[0].first_gloss[world, entity]
        if surface.first_transfer >= 0:
            vertex = geometry[0].first_vertex[mesh]
            outward = poses[0].rotation[world, entity] * (
                surface.uv[0] * geometry[0].normals[vertex + surface.corners[0]]
                + surface.uv[1] * geometry[0].normals[vertex + surface.corners[1]]
                + (1.0 - surface.uv[0] - surface.uv[1]) * geometry[0].normals[vertex + surface.corners[2]]
            )
            if wp.dot(outward, surface.normal) < 0.0:
                # The back of an open surface: what is stored is of its front.
                surface.first_transfer = -1
                surface.first_gloss = -1
        view = wp.normalize(lighting[0].eye[world] - surface.position)
        surface.mirrored = 2.0 * wp.dot(surface.normal, view) * surface.normal - view
        return surface

    @wp.func
    def stored_at(stored: wp.array(dtype=vec), start: int, surface: Surface) -> vec:
        """A vector stored per vertex, those of the entity from `start` on, at the surface."""
        return (
            surface.uv[0] * stored[start + surface.corners[0]]
            + surface.uv[1] * stored[start + surface.corners[1]]
            + (1.0 - surface.uv[0] - surface.uv[1]) * stored[start + surface.corners[2]]
        )

    @wp.func
    def transfer_of(
        surface: Surface,
        rows: wp.array(dtype=half_values),
        lighting: LightingTables,
        o: OcclusionTables,
    ) -> values:
        """The clamped cosine, times what the body leaves of its own hemisphere."""
        if surface.first_transfer >= 0:
            return kit.at_directions(stored_at(lighting[0].transfer, surface.first_transfer, surface), rows)
        return kit.zonal_at_directions(wp.static(cosine_profile), surface.normal, o[0].quadrature)

    @wp.func
    def open_to_self(
        surface: Surface,
        rows: wp.array(dtype=half_values),
        lighting: LightingTables,
        o: OcclusionTables,
    ) -> values:
        """1 minus what the body itself blocks above the horizon."""
        open_share = values(1.0)
        if surface.first_transfer >= 0 and lighting[0].light_entity.shape[0] > 0:
            open_share += kit.at_directions(
                stored_at(lighting[0].self_visibility, surface.first_transfer, surface), rows
            )
            open_share -= kit.cap_coverage(surface.normal, 1.0, o[0].quadrature)
        return open_share

    @wp.func
    def environment_light(world: int, received: values, lighting: LightingTables) -> wp.vec3:
        return wp.vec3(
            kit.sum_of_products(lighting[0].environment[world, 0], received),
            kit.sum_of_products(lighting[0].environment[world, 1], received),
            kit.sum_of_products(lighting[0].environment[world, 2], received),
        )

    @wp.func
    def facing_of(world: int, light: int, poses: PoseTables, lighting: LightingTables) -> wp.vec3:
        """The side to which a flat light shines, in the world; zero for others, and for a light that is not there."""
        if light >= lighting[0].light_entity.shape[0]:
            return wp.vec3()
        return poses[0].rotation[world, lighting[0].light_entity[light]] * lighting[0].light_facing[light]

    @wp.func
    def area_light(
        world: int,
        light: int,
        surface: Surface,
        before: values,
        lobe: values,
        geometry: GeometryTables,
        poses: PoseTables,
        o: OcclusionTables,
        lighting: LightingTables,
    ):
        """Irradiance and radiance through the Phong lobe of one area light, past `before`: what stands before it.

        What the light sends unhindered, times the share of it that is visible.
        """
        entity = lighting[0].light_entity[light]
        p = surface.position
        n = surface.normal
        rotation = poses[0].rotation[world, entity]
        position = poses[0].position[world, entity]
        radius = geometry[0].radius[entity]
        center = position + rotation * geometry[0].center[entity]
        facing = facing_of(world, light, poses, lighting)
        diffuse = float(0.0)
        glossy = float(0.0)
        hidden = wp.dot(n, center - p) <= -radius or entity == surface.entity
        if wp.length_sq(facing) > 0.0:
            hidden = hidden or wp.dot(facing, p - center) <= 0.0
        if not hidden:
            seen = kit.covered_by(world, entity, p, find_placed(world, entity, geometry, poses), o)
            weighted = wp.cw_mul(seen, lighting[0].weights[0])
            whole = wp.max(kit.sum_of_products(weighted, values(1.0)), 1.0e-9)
            share = wp.clamp(kit.sum_of_products(weighted, before) / whole, 0.0, 1.0)
            diffuse = area.area_irradiance(entity, p, n, position, rotation, center, radius, o[0].occluders)
            if diffuse < 0.0:
                cosine = kit.zonal_at_directions(wp.static(cosine_profile), n, o[0].quadrature)
                diffuse = wp.max(kit.sum_of_products(weighted, cosine), 0.0)
            diffuse *= share
            if wp.max(geometry[0].specular[surface.entity]) > 0.0:
                exponent = geometry[0].exponent[surface.entity]
                glossy = area.area_gloss(entity, p, n, surface.mirrored, exponent, position, rotation, o[0].occluders)
                if glossy < 0.0:
                    glossy = wp.max(kit.sum_of_products(weighted, lobe), 0.0)
                glossy *= share
        return diffuse, glossy

    @wp.func
    def receive(
        world: int,
        receiver: int,
        receivers: ReceiverTable,
        geometry: GeometryTables,
        poses: PoseTables,
        o: OcclusionTables,
        lighting: LightingTables,
        cuts: CutTables,
    ):
        """Irradiance and radiance through the normalised Phong lobe of the environment and the area lights."""
        surface = surface_of(world, receiver, receivers, geometry, poses, lighting)
        p = surface.position
        n = surface.normal
        own = surface.entity
        rows = o[0].rows[world, own]
        transfer = transfer_of(surface, rows, lighting, o)

        lights = lighting[0].light_entity.shape[0]
        shining = int(-1)
        if lights > 0:
            shining = lighting[0].light_entity[0]
        facing = facing_of(world, 0, poses, lighting)
        visible, before = kit.visibility_at(world, receiver, own, shining, facing, p, n, geometry, poses, o, cuts)
        diffuse = environment_light(world, wp.cw_mul(visible, transfer), lighting)
        glossy = wp.vec3()
        lobe = values()
        if wp.max(geometry[0].specular[own]) > 0.0:
            # The transfer brings the cosine that the lobe is normalised for, and what the body hides from itself.
            if surface.first_gloss >= 0:
                lobe = kit.at_directions(stored_at(lighting[0].gloss, surface.first_gloss, surface), rows)
            else:
                lobe = kit.zonal_at_directions(lighting[0].lobe[own], surface.mirrored, o[0].quadrature)
                lobe = wp.cw_mul(lobe, transfer)
            glossy = environment_light(world, wp.cw_mul(visible, lobe), lighting)

        open_share = open_to_self(surface, rows, lighting, o)
        for light in range(lights):
            if light > 0:
                shining = lighting[0].light_entity[light]
                facing = facing_of(world, light, poses, lighting)
                _visible, before = kit.visibility_at(
                    world, receiver, own, shining, facing, p, n, geometry, poses, o, cuts
                )
            passed = wp.cw_mul(before, open_share)
            irradiance, gloss = area_light(world, light, surface, passed, lobe, geometry, poses, o, lighting)
            diffuse += irradiance * lighting[0].light_radiance[world, light]
            glossy += gloss * lighting[0].light_radiance[world, light]
        # Band-limited light has negative lobes; what adds up to less than nothing is nothing.
        return wp.max(diffuse, wp.vec3()), wp.max(glossy, wp.vec3())

    @wp.kernel(enable_backward=False, module="unique")
    def shade_receivers(
        first: int,
        receivers: ReceiverTable,
        turns: wp.array2d(dtype=wp.int32),  # (world, receiver)
        turn: int,
        geometry: GeometryTables,
        poses: PoseTables,
        o: OcclusionTables,
        lighting: LightingTables,
        cuts: CutTables,
        diffuse_out: wp.array2d(dtype=wp.vec3),  # (world, receiver): irradiance
        glossy_out: wp.array2d(dtype=wp.vec3),  # (world, receiver): radiance through the normalised Phong lobe
    ):
        world, receiver = wp.tid()
        receiver += first
        if receivers.entity[world, receiver] < 0 or turns[world, receiver] != turn:
            return
        # In a function of its own: a kernel sets all of its vectors to zero before it looks whose turn it is.
        diffuse, glossy = receive(world, receiver, receivers, geometry, poses, o, lighting, cuts)
        diffuse_out[world, receiver] = diffuse
        glossy_out[world, receiver] = glossy

    return SimpleNamespace(
        **vars(kit),
        Lighting=Lighting,
        LightingTables=LightingTables,
        Surface=Surface,
        surface_of=surface_of,
        stored_at=stored_at,
        transfer_of=transfer_of,
        open_to_self=open_to_self,
        environment_light=environment_light,
        facing_of=facing_of,
        area_light=area_light,
        shade_receivers=shade_receivers,
    )


def legendre_series(zonal: np.ndarray) -> np.ndarray:
    """A zonal function's coefficients f_l -> those of Legendre polynomials of the cosine to its axis, [order]."""
    return zonal * np.sqrt((2 * np.arange(len(zonal)) + 1) / (4 * np.pi))


@dataclass(frozen=True)
class DirectState:
    """The lighting tables of a scene.

    rows: of each deforming entity the first rows of its transfer and of its gloss, -1 where it has none; its vertices'
        rows follow, world by world.
    """

    order: int
    table: Any  # make_direct(order).Lighting
    tables: wp.array  # (1): the table, as kernels take it
    rows: dict[int, tuple[int, int]]


def upload_lighting(
    scene: Scene,
    transfers: list[tuple[np.ndarray, np.ndarray] | None],
    lights: list[tuple[int, np.ndarray]],
    order: int,
    worlds: int,
    device: wp.Device,
) -> DirectState:
    """The lighting tables of a scene, with room for the transfer of its deforming entities.

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
    facing = [facing_of(scene.meshes[scene.entities[entity].mesh]) for entity, _ in lights]
    table.light_facing = wp.array(np.array(facing, np.float32).reshape(-1, 3), dtype=wp.vec3, device=device)
    table.eye = wp.zeros(worlds, dtype=wp.vec3, device=device)

    stored = [pair for pair in transfers if pair is not None]
    starts, total = [], 0
    for pair in transfers:
        starts.append(-1 if pair is None else total)
        total += 0 if pair is None else len(pair[0])
    first = np.tile(np.array([starts[entity.mesh] for entity in scene.entities], np.int32), (worlds, 1))
    first_gloss, glossy, rows = np.full_like(first, -1), 0, {}
    for index in scene.deforming:
        entity = scene.entities[index]
        count = len(scene.meshes[entity.mesh].vertices)
        has_gloss = entity.lobe.specular.max() > 0.0
        rows[index] = total, glossy if has_gloss else -1
        first[:, index] = total + count * np.arange(worlds)
        total += count * worlds
        if has_gloss:
            first_gloss[:, index] = glossy + count * np.arange(worlds)
            glossy += count * worlds
    deforming = np.zeros((total - sum(len(pair[0]) for pair in stored), order * order), np.float32)
    table.transfer = wp.array(np.concatenate([*(p[0] for p in stored), deforming]), dtype=kit.vec, device=device)
    table.self_visibility = wp.array(np.concatenate([*(p[1] for p in stored), deforming]), dtype=kit.vec, device=device)
    table.gloss = wp.zeros(glossy, dtype=kit.vec, device=device)
    table.first_transfer = wp.array(first, dtype=wp.int32, device=device)
    table.first_gloss = wp.array(first_gloss, dtype=wp.int32, device=device)
    lobes = [legendre_series(sh.phong_lobe(entity.lobe.exponent, order + 1)) for entity in scene.entities]
    table.lobe = wp.array(np.array(lobes, np.float32).reshape(-1, order + 1), dtype=kit.profile, device=device)
    return DirectState(order, table, upload_tables([table], kit.Lighting, device), rows)


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
    cuts: wp.array,
    diffuse: wp.array,
    glossy: wp.array,
    device: wp.Device,
) -> None:
    """Writes the irradiance of the receivers whose turn it is, and their radiance through the Phong lobe.

    turns: int32 (worlds, receivers). cuts: of the receivers, see `choose_cuts`. diffuse, glossy: vec3 (worlds,
    receivers); the others' values stay.
    """
    kit = make_direct(lighting.order)
    inputs = [receivers, turns, turn, scene.geometry, scene.poses, occlusion.tables, lighting.tables, cuts]
    launch(kit.shade_receivers, in_use(receivers), inputs, [diffuse, glossy], device)


def facing_of(mesh: Mesh) -> np.ndarray:
    """The side to which a flat open mesh shines; zero for others."""
    if mesh.slab is None or mesh.slab[2].min() > 0:
        return np.zeros(3)
    return mesh.normals.mean(axis=0)
