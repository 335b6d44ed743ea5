"""The proxies of a scene: the points at which the light that leaves its bodies is followed, and room for that light."""

from types import SimpleNamespace
from typing import Protocol

import numpy as np
import warp as wp

from warp_psf.field.radiance import BasisRadianceField, make_summed, upload_radiance
from warp_psf.scene.mesh import Mesh
from warp_psf.scene.receiver import make_receivers
from warp_psf.scene.scene import Scene
from warp_psf.scene.topology import area_vectors
from warp_psf.shade.between import MOST_SOURCES
from warp_psf.shade.bounce import BounceState, make_bounce
from warp_psf.shade.gloss import GlossState
from warp_psf.shade.occluders import OcclusionState
from warp_psf.shade.patches import Patches, upload_patches
from warp_psf.shade.relations import make_relations
from warp_psf.shade.separable import factor_lobe
from warp_psf.shade.texels import COARSE, GLOSSY, first_turns

# A lobe that reflects no more than this is sent on evenly, as if it were Lambert: MuJoCo's default material's reflects
# 0.055 of the light, too little for its shape to be seen on other bodies, and the terms double the cost of a bounce.
LEAST_LOBE = 0.1
# Proxies of one body, and of all bodies together: where there are many bodies, each gets fewer.
MOST_PROXIES_PER_BODY = 96
FEWEST_PROXIES_PER_BODY = 48
MOST_PROXIES = 6144
# Faces of slabs that a proxy keeps values of: three sides of a box can be seen at once.
MOST_FACES = 24


class Radiating(Protocol):
    """What is baked of a body that sends out light; see `warp_psf.bake.radiance`."""

    field: BasisRadianceField
    proxies: np.ndarray
    self_irradiance: np.ndarray | None

    def solver(self, count: int) -> np.ndarray: ...


def upload_bounces(
    scene: Scene,
    radiating: list[tuple[Mesh, Radiating] | None],
    is_patch: list[bool],
    occlusion: OcclusionState,
    functions: int,
    worlds: int,
    device: wp.Device,
) -> BounceState:
    """Everything about bounces that does not change from frame to frame, with room for what does.

    radiating: per entity the mesh whose vertices carry its basis functions, and what was baked of it; None for slabs
    that are patches, and for lights. is_patch: per entity.
    """
    order = occlusion.order
    kit = make_bounce(order, functions)
    chosen = [entity for entity, pair in enumerate(radiating) if pair is not None]
    fields = list({id(pair[1].field): pair[1].field for pair in radiating if pair is not None}.values())
    number = {id(field): index for index, field in enumerate(fields)}
    share = int(np.clip(MOST_PROXIES // max(len(chosen), 1), FEWEST_PROXIES_PER_BODY, MOST_PROXIES_PER_BODY))

    field_of, counts, starts, solver_starts = (np.full(len(radiating), -1, np.int64) for _ in range(4))
    points, normals, faces, corners, spacings, solvers, own, total, solved = [], [], [], [], [], [], [], 0, 0
    for entity in chosen:
        mesh, baked = radiating[entity]
        vertices = baked.proxies[:share]
        field_of[entity], counts[entity] = number[id(baked.field)], len(vertices)
        starts[entity], solver_starts[entity] = total, solved
        total, solved = total + len(vertices), solved + functions * len(vertices)
        points.append(mesh.vertices[vertices])
        normals.append(mesh.normals[vertices])
        face_of, corner_of = _faces_of(mesh)
        faces.append(face_of[vertices])
        corners.append(corner_of[vertices])
        area = 0.5 * np.linalg.norm(area_vectors(mesh.vertices, mesh.faces), axis=1).sum()
        spacings.append(np.full(len(vertices), np.sqrt(area / max(len(vertices), 1))))
        solvers.append(baked.solver(len(vertices)).ravel())
        from_itself = baked.self_irradiance
        own.append(np.zeros((len(vertices), functions)) if from_itself is None else from_itself[vertices])

    def upload(values, dtype: type) -> wp.array:
        return wp.array(values, dtype=dtype, device=device)

    def stack(parts: list, columns: int) -> np.ndarray:
        return np.concatenate([np.zeros((0, columns), np.float32), *parts]).astype(np.float32)

    bodies = kit.BodyTable()
    bodies.field, bodies.proxies = upload(field_of, wp.int32), upload(counts, wp.int32)
    bodies.first_proxy, bodies.first_solver = upload(starts, wp.int32), upload(solver_starts, wp.int32)
    bodies.solver = upload(np.concatenate([np.zeros(1, np.float32)[:0], *solvers]), wp.float32)
    bodies.own = upload(stack(own, functions), kit.radiant.weights)
    shape = (worlds, len(radiating), 3)
    weights = wp.zeros((*shape, functions), dtype=wp.float32, device=device)
    bodies.weights = wp.array(ptr=weights.ptr, dtype=kit.radiant.weights, shape=shape, device=device, copy=False)

    patches = upload_patches(scene, is_patch, occlusion, worlds, device)
    slots = total + patches.texels
    kept = _make_kept(kit, worlds, total, patches, len(chosen), sum(is_patch), device)
    glossy = [entity for entity in chosen if scene.entities[entity].lobe.specular.max() > LEAST_LOBE]
    gloss = _make_gloss(scene, glossy, kept, slots, starts, counts, field_of, fields, (order, functions), device)
    turns = np.concatenate([np.full(total, COARSE, np.int32), first_turns(patches)])
    turns[gloss.table.proxy.numpy()] = GLOSSY
    proxies = make_receivers((worlds, slots), device)
    proxies.entity.fill_(-1)
    face = np.concatenate([np.zeros(0, np.int32), *faces, np.zeros(patches.texels, np.int32)])
    corner = np.concatenate([np.zeros(0, np.int32), *corners, np.zeros(patches.texels, np.int32)])
    proxies.face.assign(np.repeat(face[None], worlds, axis=0).astype(np.int32))
    uv = np.stack([corner == 0, corner == 1], axis=1).astype(np.float32)
    proxies.uv.assign(np.repeat(uv[None], worlds, axis=0))
    return BounceState(
        order,
        functions,
        proxies,
        upload(np.repeat(chosen, counts[chosen]) if chosen else np.zeros(0), wp.int32),
        upload(stack(points, 3), wp.vec3),
        upload(stack(normals, 3), wp.vec3),
        bodies,
        kept,
        gloss,
        upload_radiance(fields, order, functions, device),
        patches,
        make_relations(patches, len(radiating), worlds, device),
        weights,
        wp.zeros((worlds, len(radiating), functions), dtype=wp.vec3, device=device),
        make_summed([int(field) for field in field_of], fields, order, functions, worlds, device),
        *_upload_own(radiating, functions, worlds, device),
        upload(np.repeat(turns[None], worlds, axis=0), wp.int32),
        wp.full((worlds, slots), wp.vec3(1.0), dtype=wp.vec3, device=device),
        upload(np.concatenate([np.zeros(0), *spacings]), wp.float32),
        tuple(wp.zeros((worlds, slots), dtype=wp.vec3, device=device) for _ in range(2)),
        wp.zeros((worlds, slots), dtype=wp.vec3, device=device),
        wp.zeros((worlds, slots), dtype=wp.vec3, device=device),
    )


def _upload_own(radiating: list, functions: int, worlds: int, device: wp.Device) -> tuple[wp.array, ...]:
    """The vertices of bodies that send light to themselves: own_first, _entities, _rows, _functions and _light."""
    first, entities, rows, tables = [], [], [], []
    start_of: dict[int, int] = {}
    total = stored = 0
    for entity, pair in enumerate(radiating):
        own = None if pair is None else pair[1].self_irradiance
        first.append(-1 if own is None else total)
        if own is None:
            continue
        if id(own) not in start_of:
            start_of[id(own)] = stored
            tables.append(own)
            stored += len(own)
        entities.append(np.full(len(own), entity))
        rows.append(start_of[id(own)] + np.arange(len(own)))
        total += len(own)
    empty = np.zeros(0, np.int32)
    weights = wp.types.vector(functions, wp.float32)
    table = np.concatenate([np.zeros((0, functions), np.float32), *tables])
    return (
        wp.array(first, dtype=wp.int32, device=device),
        wp.array(np.concatenate([empty, *entities]), dtype=wp.int32, device=device),
        wp.array(np.concatenate([empty, *rows]), dtype=wp.int32, device=device),
        wp.array(table, dtype=weights, device=device),
        wp.zeros((worlds, total), dtype=wp.vec3, device=device),
    )


def _make_kept(
    kit: SimpleNamespace, worlds: int, first_texel: int, patches: Patches, bodies: int, slabs: int, device: wp.Device
):
    places, faces = min(MOST_SOURCES, bodies), min(MOST_FACES, 3 * slabs)
    stations = np.concatenate([np.arange(first_texel), first_texel + patches.stations])
    shape = (worlds, len(stations))
    kept = kit.KeptTable()
    kept.proxy = wp.array(stations, dtype=wp.int32, device=device)
    kept.count = wp.zeros(shape, dtype=wp.int32, device=device)
    kept.entity = wp.zeros((*shape, places), dtype=wp.int32, device=device)
    kept.irradiance = wp.zeros((*shape, places), dtype=kit.radiant.weights, device=device)
    kept.face_count = wp.zeros(shape, dtype=wp.int32, device=device)
    kept.face = wp.zeros((*shape, faces), dtype=wp.int32, device=device)
    kept.transport = wp.zeros((*shape, faces), dtype=kit.values, device=device)
    return kept


def _make_gloss(
    scene: Scene,
    glossy: list[int],
    kept,
    slots: int,
    starts: np.ndarray,
    counts: np.ndarray,
    field_of: np.ndarray,
    fields: list[BasisRadianceField],
    size: tuple[int, int],
    device: wp.Device,
) -> GlossState:
    """glossy: entities. starts, counts, field_of: of each entity's proxies and field. size: order and functions."""
    kit = make_bounce(*size)
    functions = size[1]
    worlds, stations, places = kept.entity.shape
    row = np.full(len(scene.entities), -1)
    row[glossy] = np.arange(len(glossy))
    proxy = np.concatenate([np.zeros(0, np.int64), *(starts[entity] + np.arange(counts[entity]) for entity in glossy)])
    place = np.full(slots, -1)
    place[proxy] = np.arange(len(proxy))

    def upload(values) -> wp.array:
        return wp.array(np.asarray(values, np.int32), dtype=wp.int32, device=device)

    def room(dtype: type, *shape: int) -> wp.array:
        return wp.zeros((worlds, *shape), dtype=dtype, device=device)

    table = kit.GlossTable()
    table.row, table.entity, table.proxy, table.place = upload(row), upload(glossy), upload(proxy), upload(place)
    table.first_place = upload(place[starts[glossy]])
    factors = [factor_lobe(scene.entities[entity].lobe.exponent) for entity in glossy]
    table.factors = wp.array(np.array(factors, np.float32).reshape(-1, 4), dtype=wp.vec4, device=device)
    lit = stations if glossy else 0
    table.first, table.extra = room(kit.moments.first, lit, places), room(wp.vec3, lit)
    table.second = room(kit.moments.second, len(proxy), places)
    table.moment, table.vector, table.total = (room(wp.mat33, len(proxy)) for _ in range(3))
    shape = (worlds, 4 * len(glossy), 3)
    weights = wp.zeros((*shape, functions), dtype=wp.float32, device=device)
    table.weights = wp.array(ptr=weights.ptr, dtype=kit.radiant.weights, shape=shape, device=device, copy=False)
    along = room(wp.vec3, 3 * len(glossy), functions)
    summed = make_summed([int(field_of[entity]) for entity in glossy for _ in range(3)], fields, *size, worlds, device)
    return GlossState(*size, table, weights, along, summed)


def _faces_of(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """For every vertex one face that has it, and as which corner. The last face written wins; any will do."""
    face_of, corner_of = np.zeros((2, len(mesh.vertices)), np.int32)
    for corner in range(3):
        face_of[mesh.faces[:, corner]] = np.arange(len(mesh.faces))
        corner_of[mesh.faces[:, corner]] = corner
    return face_of, corner_of
