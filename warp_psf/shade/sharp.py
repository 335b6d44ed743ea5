"""Light from small bright sources at full frequency: leaves of the environment, and pieces of area lights.

What spherical harmonics can show is left to them (`shade/direct.py`). Of the rest, few sources are asked one by one
which share of each is visible: how far it lies within or outside of every body's silhouette (`field/silhouettes.py`)
tells that.
"""

from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import warp as wp

from warp_psf.basis import sh
from warp_psf.device import launch, upload_tables
from warp_psf.field.silhouette_lanes import LANES, directions, lanes, own_distances
from warp_psf.field.silhouettes import SilhouetteField, own_distance, own_frame, upload_silhouettes
from warp_psf.scene.geometry import DeviceScene, GeometryTables, PoseTables, find_placed
from warp_psf.scene.leaves import Leaves, cut_light, merge_leaves
from warp_psf.scene.light import AreaLight
from warp_psf.scene.receiver import ReceiverTable, in_use
from warp_psf.scene.scene import Scene
from warp_psf.shade.area import make_area
from warp_psf.shade.direct import DirectState, facing_of, make_direct
from warp_psf.shade.hiding import make_hiding
from warp_psf.shade.occluders import OcclusionState
from warp_psf.shade.penumbra import disc_shares
from warp_psf.shade.sources import (
    Group,
    SharpTable,
    SharpTables,
    Sources,
    direction_to,
    group_of,
    pieces,
    place_pieces,
    sources_of,
)

# A piece of a light that the horizon cuts counts by this cosine, so that a light that sets has shares to the end.
LEAST_COSINE = 1.0e-4


def _sum_pieces_snippet() -> str:
    """C++: what a light's pieces send to a receiver, and what of that arrives."""
    return f"""
    float sent[{LANES}], arrived[{LANES}];
    for (int k = 0; k < {LANES}; ++k) {{
        const float cosine = n[0] * toward.data[0][k] + n[1] * toward.data[1][k] + n[2] * toward.data[2][k];
        sent[k] = (cosine > {LEAST_COSINE}f ? cosine : {LEAST_COSINE}f) * solid_angle[k];
        arrived[k] = sent[k] * visible[k];
    }}
    for (int width = {LANES // 2}; width > 0; width /= 2)
        for (int k = 0; k < width; ++k) {{
            sent[k] += sent[width + k];
            arrived[k] += arrived[width + k];
        }}
    return wp::vec_t<2, float>(sent[0], arrived[0]);
    """


@wp.func_native(_sum_pieces_snippet())
def sum_pieces(n: wp.vec3, toward: directions, solid_angle: lanes, visible: lanes) -> wp.vec2: ...


@cache
def make_sharp(order: int) -> SimpleNamespace:
    """The kernels over the tables of `order` bands."""
    kit, hiding = make_direct(order), make_hiding(order)
    visible_of, is_open = hiding.visible_of, hiding.is_open
    OcclusionTables, LightingTables, Surface = kit.OcclusionTables, kit.LightingTables, kit.Surface
    area, evaluate = make_area(order), sh.make_sh(order).evaluate

    @wp.func
    def has_map(surface: Surface, s: SharpTables) -> bool:
        """Whether it is kept what the receiver's body hides from itself."""
        field = s[0].field[surface.entity]
        return surface.first_transfer >= 0 and field >= 0 and s[0].silhouettes[0].first_own[wp.max(field, 0)] >= 0

    @wp.struct
    class OwnMaps:
        """What a receiver's body hides from the three vertices around it."""

        vertex: wp.vec3i  # of the silhouettes' `own`
        share: wp.vec3  # of each vertex in the receiver
        frame_0: wp.mat33  # from the world into each vertex's frame
        frame_1: wp.mat33
        frame_2: wp.mat33

    @wp.func
    def own_maps(world: int, surface: Surface, geometry: GeometryTables, poses: PoseTables, s: SharpTables) -> OwnMaps:
        """The maps of a receiver for which `has_map` holds."""
        to_body = wp.transpose(poses[0].rotation[world, surface.entity])
        first_own = s[0].silhouettes[0].first_own[s[0].field[surface.entity]]
        first_vertex = geometry[0].first_vertex[geometry[0].entity_mesh[surface.entity]]
        maps = OwnMaps()
        maps.vertex = surface.corners + wp.vec3i(first_own, first_own, first_own)
        maps.share = wp.vec3(surface.uv[0], surface.uv[1], 1.0 - surface.uv[0] - surface.uv[1])
        maps.frame_0 = own_frame(geometry[0].normals[first_vertex + surface.corners[0]]) * to_body
        maps.frame_1 = own_frame(geometry[0].normals[first_vertex + surface.corners[1]]) * to_body
        maps.frame_2 = own_frame(geometry[0].normals[first_vertex + surface.corners[2]]) * to_body
        return maps

    @wp.func
    def distance_to_self(maps: OwnMaps, direction: wp.vec3, s: SharpTables) -> float:
        """The angle from a direction to what the receiver's own body hides, radians, above zero where it does."""
        silhouettes = s[0].silhouettes
        distance = maps.share[0] * own_distance(silhouettes, maps.vertex[0], maps.frame_0 * direction)
        distance += maps.share[1] * own_distance(silhouettes, maps.vertex[1], maps.frame_1 * direction)
        return distance + maps.share[2] * own_distance(silhouettes, maps.vertex[2], maps.frame_2 * direction)

    @wp.func
    def open_to_self(
        world: int,
        surface: Surface,
        mapped: bool,
        maps: OwnMaps,
        group: Group,
        sources: Sources,
        poses: PoseTables,
        lighting: LightingTables,
        s: SharpTables,
    ) -> lanes:
        """Which share of each source the receiver's own body, which is not convex, leaves visible."""
        if mapped:
            silhouettes = s[0].silhouettes
            distance = maps.share[0] * own_distances(silhouettes, maps.vertex[0], maps.frame_0, sources.toward)
            distance += maps.share[1] * own_distances(silhouettes, maps.vertex[1], maps.frame_1, sources.toward)
            distance += maps.share[2] * own_distances(silhouettes, maps.vertex[2], maps.frame_2, sources.toward)
            return lanes(1.0) - disc_shares(distance, sources.radius)
        # A body that deforms has no such maps.
        to_body = wp.transpose(poses[0].rotation[world, surface.entity])
        own = kit.stored_at(lighting[0].self_visibility, surface.first_transfer, surface)
        left = lanes(1.0)
        for k in range(group.count):
            left[k] = wp.clamp(wp.dot(own, evaluate(to_body * direction_to(sources, k))), 0.0, 1.0)
        return left

    @wp.struct
    class Received:
        """What small sources send to a receiver."""

        diffuse: wp.vec3  # irradiance
        glossy: wp.vec3  # radiance through the normalised Phong lobe
        moment: wp.mat33  # (channel, axis): irradiance times the direction it comes from

    @wp.func
    def receive_group(
        received: Received,
        world: int,
        group: Group,
        surface: Surface,
        geometry: GeometryTables,
        poses: PoseTables,
        o: OcclusionTables,
        lighting: LightingTables,
        s: SharpTables,
        with_moments: bool,
    ) -> Received:
        """Adds the light of a group of sources."""
        p = surface.position
        n = surface.normal
        alone = bool(False)  # whether the body hides none of the group from itself
        maps = OwnMaps()
        mapped = has_map(surface, s)
        if mapped:
            maps = own_maps(world, surface, geometry, poses, s)
            distance = distance_to_self(maps, group.axis, s)
            if distance >= group.spread:
                return received
            alone = distance <= -group.spread
        sources = sources_of(world, group, p, s)
        visible = visible_of(world, surface.entity, p, n, group, sources, geometry, poses, o, s)
        shines = wp.max(geometry[0].specular[surface.entity]) > 0.0
        alone = alone or surface.first_transfer < 0
        if group.light < 0 and alone and not shines and wp.min(visible) == wp.max(visible):
            if wp.dot(n, group.axis) > group.sine:
                # All leaves are above the horizon and alike.
                received.diffuse += visible[0] * (s[0].moment[world, group.number] * n)
                return received
        if not alone:
            visible = wp.cw_mul(visible, open_to_self(world, surface, mapped, maps, group, sources, poses, lighting, s))
        exponent = geometry[0].exponent[surface.entity]
        result = received
        # Of a light: what its pieces send to here, and what of that arrives.
        sent = float(0.0)
        arrived = float(0.0)
        mirrored_sent = float(0.0)
        mirrored_arrived = float(0.0)
        toward = wp.vec3()
        if group.light >= 0 and not shines and not with_moments:
            both = sum_pieces(n, sources.toward, sources.solid_angle, visible)
            sent = both[0]
            arrived = both[1]
        else:
            for k in range(group.count):
                direction = direction_to(sources, k)
                cosine = wp.max(wp.dot(n, direction), 0.0)
                share = visible[k]
                lobe = float(0.0)
                if shines:
                    aligned = wp.dot(surface.mirrored, direction)
                    if aligned > 0.0:
                        lobe = 0.5 * (exponent + 2.0) / wp.pi * wp.pow(aligned, exponent) * cosine
                if group.light < 0:
                    light = s[0].sent[world, group.first + k]
                    result.diffuse += (cosine * share) * light
                    result.glossy += (lobe * share) * light
                    result.moment += wp.outer((cosine * share) * light, direction)
                else:
                    weight = wp.max(cosine, wp.static(LEAST_COSINE)) * sources.solid_angle[k]
                    sent += weight
                    arrived += weight * share
                    mirrored_sent += lobe * sources.solid_angle[k]
                    mirrored_arrived += lobe * share * sources.solid_angle[k]
                    toward += (weight * share) * direction
        if group.light >= 0 and arrived > 0.0:
            entity = s[0].light_entity[group.light]
            placed = find_placed(world, entity, geometry, poses)
            light = s[0].light_radiance[world, group.light]
            whole = area.area_irradiance(
                entity, p, n, placed.position, placed.rotation, placed.center, placed.radius, o[0].occluders
            )
            whole = wp.where(whole < 0.0, sent, whole)
            irradiance = (whole * arrived / sent) * light
            result.diffuse += irradiance
            result.moment += wp.outer(irradiance, wp.normalize(toward + 1.0e-9 * group.axis))
            if shines and mirrored_sent > 0.0:
                gloss = area.area_gloss(
                    entity, p, n, surface.mirrored, exponent, placed.position, placed.rotation, o[0].occluders
                )
                gloss = wp.where(gloss < 0.0, mirrored_sent, gloss)
                result.glossy += (gloss * mirrored_arrived / mirrored_sent) * light
        return result

    @wp.func
    def receive(
        world: int,
        receiver: int,
        receivers: ReceiverTable,
        geometry: GeometryTables,
        poses: PoseTables,
        o: OcclusionTables,
        lighting: LightingTables,
        s: SharpTables,
        with_moments: bool,
    ) -> Received:
        """The light of all small sources at a receiver; its moments only where they are asked for."""
        surface = kit.surface_of(world, receiver, receivers, geometry, poses, lighting)
        received = Received()
        # A matt surface with nothing before it receives a group's light as one vector.
        plain = surface.first_transfer < 0 and wp.max(geometry[0].specular[surface.entity]) == 0.0
        for index in range(s[0].axis.shape[1] + s[0].light_entity.shape[0]):
            group = group_of(world, index, surface.position, geometry, poses, s)
            if plain and group.light < 0:
                if wp.dot(surface.normal, group.axis) > group.sine:
                    if is_open(world, surface.entity, surface.position, surface.normal, group, geometry, poses, o):
                        received.diffuse += s[0].moment[world, group.number] * surface.normal
                        continue
            # Below the horizon as a whole, or the receiver's own body.
            above = wp.dot(surface.normal, group.axis) > -group.sine
            if group.light >= 0:
                entity = s[0].light_entity[group.light]
                facing = poses[0].rotation[world, entity] * s[0].light_facing[group.light]
                above = above and entity != surface.entity
                if wp.length_sq(facing) > 0.0:
                    above = above and wp.dot(facing, group.axis) < 0.0
            if above:
                received = receive_group(received, world, group, surface, geometry, poses, o, lighting, s, with_moments)
        return received

    @wp.kernel(enable_backward=False, module="unique")
    def add_sharp(
        first: int,
        receivers: ReceiverTable,
        turns: wp.array2d(dtype=wp.int32),  # (world, receiver)
        turn: int,
        geometry: GeometryTables,
        poses: PoseTables,
        o: OcclusionTables,
        lighting: LightingTables,
        s: SharpTables,
        diffuse_out: wp.array2d(dtype=wp.vec3),  # (world, receiver), added to
        glossy_out: wp.array2d(dtype=wp.vec3),  # (world, receiver), added to
    ):
        world, receiver = wp.tid()
        receiver += first
        if turns[world, receiver] != turn or receivers.entity[world, receiver] < 0:
            return
        received = receive(world, receiver, receivers, geometry, poses, o, lighting, s, False)
        diffuse_out[world, receiver] = diffuse_out[world, receiver] + received.diffuse
        glossy_out[world, receiver] = glossy_out[world, receiver] + received.glossy

    @wp.kernel(enable_backward=False, module="unique")
    def add_sharp_moments(
        first: int,
        proxies: ReceiverTable,
        glossy_proxy: wp.array(dtype=wp.int32),  # (place): the glossy proxies' numbers
        geometry: GeometryTables,
        poses: PoseTables,
        o: OcclusionTables,
        lighting: LightingTables,
        s: SharpTables,
        moment_out: wp.array2d(dtype=wp.mat33),  # (world, place), added to
    ):
        world, place = wp.tid()
        place += first
        received = receive(world, glossy_proxy[place], proxies, geometry, poses, o, lighting, s, True)
        moment_out[world, place] = moment_out[world, place] + received.moment

    return SimpleNamespace(add_sharp=add_sharp, add_sharp_moments=add_sharp_moments)


@dataclass(frozen=True)
class SharpState:
    """The small sources of a scene on the device."""

    order: int
    table: SharpTable
    tables: wp.array  # (1): the table, as kernels take it

    @property
    def is_empty(self) -> bool:
        """Whether nothing shines."""
        return self.table.axis.shape[1] + self.table.light_entity.shape[0] == 0


def upload_sharp(
    scene: Scene,
    silhouettes: list[SilhouetteField | None],
    lights: list[tuple[AreaLight, int]],
    order: int,
    worlds: int,
    device: wp.Device,
) -> SharpState:
    """The small sources of a scene without the environment's, which `write_leaves` brings.

    silhouettes: per entity its field, or None where its silhouette has a closed form. lights: with their entities.
    """
    table = SharpTable()
    distinct = list({id(field): field for field in silhouettes if field is not None}.values())
    number = {id(field): index for index, field in enumerate(distinct)}
    table.silhouettes = upload_silhouettes(distinct, device)
    table.field = wp.array([number.get(id(field), -1) for field in silhouettes], dtype=wp.int32, device=device)
    table.light_entity = wp.array([entity for _, entity in lights], dtype=wp.int32, device=device)
    radiance = np.array([light.radiance for light, _ in lights], np.float32).reshape(1, -1, 3)
    table.light_radiance = wp.array(np.repeat(radiance, worlds, axis=0), dtype=wp.vec3, device=device)
    facing = np.array([facing_of(light.mesh) for light, _ in lights], np.float32).reshape(-1, 3)
    table.light_facing = wp.array(facing, dtype=wp.vec3, device=device)
    cut = [cut_light(light) for light, _ in lights]
    counts = np.cumsum([0, *(len(each.area) for each in cut)])
    table.pieces = wp.zeros((worlds, len(lights)), dtype=pieces, device=device)
    table.first_piece = wp.array(counts.astype(np.int32), dtype=wp.int32, device=device)
    for name, dtype, shape in (("position", wp.vec3, (0, 3)), ("normal", wp.vec3, (0, 3)), ("area", wp.float32, (0,))):
        values = np.concatenate([np.zeros(shape), *(getattr(each, name) for each in cut)])
        setattr(table, name, wp.array(values.astype(np.float32), dtype=dtype, device=device))
    state = SharpState(order, table, upload_tables([table], SharpTable, device))
    return write_leaves(state, merge_leaves([]), worlds, device)


def write_leaves(state: SharpState, leaves: Leaves, worlds: int, device: wp.Device) -> SharpState:
    """The same sources with other leaves, the same in every world."""
    table = state.table
    _, first = np.unique(leaves.group, return_index=True)
    bounds = np.append(first, len(leaves.group))
    spans = list(pairwise(bounds))
    cones = [_cone_of(leaves.direction[a:b], leaves.radius[a:b]) for a, b in spans]

    def upload(values: np.ndarray, dtype: type) -> wp.array:
        repeated = np.repeat(values.astype(np.float32)[None], worlds, axis=0)
        return wp.array(repeated, dtype=dtype, ndim=2, device=device)

    table.direction, table.sent = upload(leaves.direction, wp.vec3), upload(leaves.sent, wp.vec3)
    table.radius = upload(leaves.radius, wp.float32)
    table.first_leaf = wp.array(bounds.astype(np.int32), dtype=wp.int32, device=device)
    moments = [leaves.sent[a:b].T @ leaves.direction[a:b] for a, b in spans]
    table.moment = upload(np.array(moments).reshape(-1, 3, 3), wp.mat33)
    table.axis = upload(np.array([axis for axis, _ in cones]).reshape(-1, 3), wp.vec3)
    table.spread = upload(np.array([spread for _, spread in cones]), wp.float32)
    return SharpState(state.order, table, upload_tables([table], SharpTable, device))


def _cone_of(direction: np.ndarray, radius: np.ndarray) -> tuple[np.ndarray, float]:
    """The axis and half angle, radians, of a cone that holds discs."""
    axis = direction.sum(axis=0)
    axis /= max(np.linalg.norm(axis), 1e-9)
    return axis, float((np.arccos(np.clip(direction @ axis, -1, 1)) + radius).max())


def place_sharp(state: SharpState, scene: DeviceScene, device: wp.Device) -> None:
    """Brings the sources to where they are in a frame."""
    place_pieces(state.tables, scene, device)


def add_sharp_light(
    receivers: ReceiverTable,
    turns: wp.array,
    turn: int,
    scene: DeviceScene,
    occlusion: OcclusionState,
    lighting: DirectState,
    state: SharpState,
    diffuse: wp.array,
    glossy: wp.array,
    device: wp.Device,
) -> None:
    """Adds small sources to irradiance `diffuse` and Phong radiance `glossy`, vec3 (world, receiver).

    turns: int32 (world, receiver); of those whose turn it is.
    """
    if state.is_empty:
        return
    inputs = [receivers, turns, turn, scene.geometry, scene.poses, occlusion.tables, lighting.tables, state.tables]
    launch(make_sharp(state.order).add_sharp, in_use(receivers), inputs, [diffuse, glossy], device)


def add_sharp_moments(
    proxies: ReceiverTable,
    glossy_proxy: wp.array,
    scene: DeviceScene,
    occlusion: OcclusionState,
    lighting: DirectState,
    state: SharpState,
    moment: wp.array,
    device: wp.Device,
) -> None:
    """Adds what small sources send to glossy proxies, with its direction, to `moment`, mat33 (world, place)."""
    if state.is_empty:
        return
    inputs = [proxies, glossy_proxy, scene.geometry, scene.poses, occlusion.tables, lighting.tables, state.tables]
    launch(make_sharp(state.order).add_sharp_moments, moment.shape, inputs, [moment], device)
