"""Everything on the device for one scene, and the stages of a frame over it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace

import numpy as np
import warp as wp

from warp_psf.bake import bake_radiance_field
from warp_psf.bake.bodies import (
    bake_blockers,
    bake_bodies,
    bake_light,
    bake_logarithms,
    bake_outlines,
    bake_sphere_sets,
)
from warp_psf.bake.kept import BakedBody
from warp_psf.bake.visible_sets import find_visible_sets
from warp_psf.film.primary import EXTRA_GROUPS, Surfaces, aim, find_surfaces, make_surfaces
from warp_psf.film.resolve import Film, make_film, resolve_pixels, with_background
from warp_psf.film.tracing import any_seen_from_behind
from warp_psf.scene.camera import Camera
from warp_psf.scene.deforming import Deformed, DeformingShape
from warp_psf.scene.detail import refine_flat_bodies
from warp_psf.scene.environment import Environment
from warp_psf.scene.geometry import DeviceScene, upload_scene, write_deforming, write_loose, write_poses
from warp_psf.scene.leaves import cut_environment, merge_leaves
from warp_psf.scene.light import DeltaLight, area_light_entities
from warp_psf.scene.loose import Loose, LooseRoom
from warp_psf.scene.scene import Poses, Scene
from warp_psf.scene.tint import TextureTable, upload_textures
from warp_psf.settings import Settings
from warp_psf.shade.bounce import BounceState, bounce, gather_basis_irradiances
from warp_psf.shade.delta import DeltaState, add_delta_lights, make_delta_lights, write_delta_lights
from warp_psf.shade.direct import DirectState, shade_direct, upload_lighting, write_environment
from warp_psf.shade.gloss import shade_gloss
from warp_psf.shade.hemisphere import Hemispheres, bring_shapes, find_transfer, look_at, upload_hemispheres
from warp_psf.shade.last_gather import LastGather, gather_last_bounce, make_last_gather
from warp_psf.shade.lattice import STRIDES, Lattice, begin_lattice, make_lattice, refine_lattice
from warp_psf.shade.occluders import OcclusionState, turn_occlusion, upload_occlusion
from warp_psf.shade.proxies import upload_bounces
from warp_psf.shade.receivers import VertexReceivers, interpolate_vertices, place_vertices, upload_vertices
from warp_psf.shade.sharp import (
    SharpState,
    add_sharp_light,
    add_sharp_moments,
    place_sharp,
    upload_sharp,
    write_leaves,
)
from warp_psf.shade.spheres import SphereState, carry_spheres, choose_cuts, make_cuts, upload_spheres
from warp_psf.shade.texels import COARSE, FINE, refine_texels
from warp_psf.shade.tint import tint_proxies

Progress = Callable[[str, float], None]
Received = tuple[wp.array, wp.array]


@dataclass(frozen=True)
class Cuts:
    """Through the trees of blocker spheres, for what pixels see, for vertices and for proxies."""

    pixels: wp.array
    vertices: wp.array
    proxies: wp.array


@dataclass
class Stage:
    """A scene on the device, with room for a frame of it.

    received, bounced: irradiance and Phong radiance at the surfaces' receivers, direct and after bounces.
    field_bytes: what is baked and kept, bytes: `occlusion` fields, `transfer`, basis `radiance` fields.
    room: for the scene's loose entity, None where it has none.
    has_moved, is_lit_anew: whether bodies have moved, or lights have changed, since light was last sent on.
    seconds: how long each stage of the last frame took.
    """

    settings: Settings
    scene: Scene
    room: LooseRoom | None
    device_scene: DeviceScene
    textures: TextureTable
    occlusion: OcclusionState
    spheres: SphereState
    cuts: Cuts
    lighting: DirectState
    sharp: SharpState | None
    hemispheres: Hemispheres
    delta_lights: DeltaState
    surfaces: Surfaces
    film: Film
    lattice: Lattice
    received: Received
    bounced: Received
    vertices: VertexReceivers | None
    vertices_received: Received | None
    bounces: BounceState | None
    last_gather: LastGather | None
    field_bytes: dict[str, int]
    has_moved: bool = True
    is_lit_anew: bool = True
    poses: Poses | None = None
    seen: tuple[Camera, tuple[DeltaLight, ...]] | None = None
    seconds: dict[str, float] = field(default_factory=dict)


def set_stage(
    scene: Scene,
    environments: Sequence[Environment],
    background: Environment | None,
    settings: Settings,
    shapes: Sequence[DeformingShape],
    room: LooseRoom | None,
    progress: Progress,
) -> Stage:
    """Bakes what a scene needs, or reads it from the cache, and puts it on the device.

    environments: their light adds up. background: what is seen behind everything; None is black. shapes: of the scene's
    deforming entities. room: for its loose entity, None where it has none.
    progress: called as progress(what, share) while something is baked.
    """
    if settings.shading == "vertex":
        scene = refine_flat_bodies(scene)
    device, order = settings.device, settings.order
    casts = [entity.casts for entity in scene.entities]
    bodies = bake_bodies(scene, casts, order, str(device), progress)
    area_lights = area_light_entities(scene)
    fields = [bodies[entity.mesh].field for entity in scene.entities]
    log_fields = None
    if settings.compose == "log":
        logarithms = bake_logarithms(scene, bodies, progress)
        log_fields = [logarithms[entity.mesh] for entity in scene.entities]
    for light, entity in area_lights:
        fields[entity] = None
        if light.mesh.slab is None and light.mesh.sphere is None:
            radiance = np.ones(len(light.mesh.faces), np.float32)
            fields[entity] = bake_radiance_field(light.mesh, radiance, order, device=str(device))
    device_scene = upload_scene(scene, 1, device)
    blockers = [bake_blockers(shape) for shape in shapes]
    solid = [shape.casts and not own.two_sided for shape, (own, _) in zip(shapes, blockers, strict=True)]
    spheres = upload_spheres(scene, bake_sphere_sets(shapes, solid, str(device), progress), 1, device)
    hemispheres = upload_hemispheres(scene, shapes, blockers, order, 1, device)
    sheets = (hemispheres.sheets, hemispheres.sheet_tables, hemispheres.masks)
    occlusion = upload_occlusion(scene, fields, log_fields, spheres.tables, *sheets, order, 1, device)
    transfers = _transfers(bodies)
    sharp = None
    if settings.basis == "haar":
        outlines = bake_outlines(scene, bodies, str(device), progress)
        sharp = upload_sharp(
            scene, [outlines[entity.mesh] for entity in scene.entities], list(area_lights), order, 1, device
        )
    # What is shown at full frequency is not shown twice.
    shining = [(entity, light.radiance) for light, entity in area_lights if sharp is None]
    lighting = upload_lighting(scene, transfers, shining, order, 1, device)
    size = settings.width, settings.height
    see_through = any(entity.opacity < 1.0 for entity in scene.entities)
    surfaces = make_surfaces(1, *size, scene, settings.antialias, see_through, device)
    vertices = upload_vertices(scene, 1, device) if settings.shading == "vertex" else None
    stored = {id(baked): baked.nbytes for baked in [*fields, *(log_fields or [])] if baked is not None}
    field_bytes = {
        "occlusion": sum(stored.values()),
        "transfer": sum(pair[0].nbytes + pair[1].nbytes for pair in transfers if pair is not None),
        "radiance": 0,
    }
    bounces = last_gather = None
    if settings.bounces:
        functions = settings.basis_functions
        radiating, flat = bake_light(scene, casts, order, functions, str(device), progress)
        bounces = upload_bounces(scene, radiating, flat, occlusion, functions, 1, device)
        gathers_sky = settings.shading == "pixel" and not shining
        slots = surfaces.slots
        last_gather = make_last_gather(bounces, settings.bounce_threshold, *size, slots, gathers_sky, device)
        field_bytes["radiance"] = sum({id(b): b.field.nbytes for _, b in filter(None, radiating)}.values())
    stage = Stage(
        settings=settings,
        scene=scene,
        room=room,
        device_scene=device_scene,
        textures=upload_textures(scene, device),
        occlusion=occlusion,
        spheres=spheres,
        cuts=_make_cuts(spheres, surfaces, vertices, bounces, device),
        lighting=lighting,
        sharp=sharp,
        hemispheres=hemispheres,
        delta_lights=make_delta_lights(scene, 1, settings.reach, device),
        surfaces=surfaces,
        film=make_film(1, *size, device),
        lattice=make_lattice(1, surfaces.slots, *size, device),
        received=make_received(surfaces.slots, device),
        bounced=make_received(surfaces.slots, device),
        vertices=vertices,
        vertices_received=None if vertices is None else make_received(vertices.receivers.entity.shape[1], device),
        bounces=bounces,
        last_gather=last_gather,
        field_bytes=field_bytes,
    )
    relight(stage, environments, background)
    return stage


def relight(stage: Stage, environments: Sequence[Environment], background: Environment | None) -> None:
    """Puts a stage into other environments; see `set_stage`."""
    order, device = stage.settings.order, stage.settings.device
    if stage.sharp is not None:
        cut = [cut_environment(each) for each in environments]
        environments = [smooth for smooth, _ in cut]
        stage.sharp = write_leaves(stage.sharp, merge_leaves([leaves for _, leaves in cut]), 1, device)
    none = np.zeros((order * order, 3))
    stage.is_lit_anew = True
    write_environment(stage.lighting, sum((each.project(order) for each in environments), none))
    behind = np.zeros((1, 1, 3), np.float32) if background is None else background.radiance
    stage.film = with_background(stage.film, behind)


def place(stage: Stage, poses: Poses, view: Camera, lights: tuple[DeltaLight, ...]) -> None:
    """Brings the state of a frame to the device: poses go up, nothing else does."""
    stage.has_moved = stage.has_moved or not _same_poses(poses, stage.poses)
    stage.is_lit_anew = stage.is_lit_anew or stage.seen is None or not _same_lights(lights, stage.seen[1])
    stage.poses, stage.seen = poses, (view, lights)
    write_poses(stage.device_scene, poses)
    if not stage.surfaces.see_through and any_seen_from_behind(stage.scene, poses, view):
        _make_see_through(stage)
    aim(stage.surfaces, [view])
    stage.lighting.table.eye.assign(np.array([view.eye], np.float32))
    write_delta_lights(stage.delta_lights, [lights])


def place_deforming(stage: Stage, bodies: Sequence[Deformed | None]) -> None:
    """Brings the present shapes of the scene's deforming entities to the device, in order; None for one unseen."""
    write_deforming(stage.device_scene, stage.scene, bodies)
    carry_spheres(stage.spheres, bodies)
    bring_shapes(stage.hemispheres, bodies, stage.settings.device)


def place_loose(stage: Stage, loose: Loose | None) -> None:
    """Brings what has no lasting shape to the device; the stage has a room that holds it."""
    write_loose(stage.device_scene, stage.scene, loose)


def learn(stage: Stage, motion: Sequence[Sequence[Deformed | None]], progress: Progress) -> None:
    """Leaves to the vertices of deforming entities the triangles that they see in some state of a motion."""
    hemispheres = stage.hemispheres
    for index, (entity, state) in enumerate(hemispheres.states.items()):
        states = [shown for bodies in motion if (shown := bodies[index]) is not None]
        if states:
            name, device = stage.scene.entities[entity].name, stage.settings.device
            offset, blocker_of = float(state.table.offset), state.table.blocker_of.numpy()
            how = {"device": str(device), "progress": progress}
            sets = find_visible_sets(name, hemispheres.triangles[entity], blocker_of, states, offset, **how)
            look_at(hemispheres, entity, sets, device)


def take_over(stage: Stage, before: Stage) -> None:
    """Shows on a new stage the state that an older one of the same model shows, whose loose entity lacked room."""
    poses = before.poses
    if poses is None or before.seen is None:
        return
    if before.scene.loose < 0:
        position = np.insert(poses.position, stage.scene.loose, 0.0, axis=1)
        poses = Poses(position, np.insert(poses.rotation, stage.scene.loose, np.eye(3), axis=1))
    place(stage, poses, *before.seen)


def draw(stage: Stage) -> None:
    """Computes the layers of the frame whose state `place` has brought."""
    stage.seconds = {}
    scene, device, surfaces = stage.device_scene, stage.settings.device, stage.surfaces
    with _timed(stage, "primary visibility"):
        find_surfaces(scene, surfaces, device)
    if stage.scene.deforming:
        with _timed(stage, "self-shadows"):
            find_transfer(stage.hemispheres, surfaces.receivers, scene, stage.lighting, device)
    with _timed(stage, "turn fields"):
        turn_occlusion(stage.occlusion, scene, device)
        if stage.sharp is not None:
            place_sharp(stage.sharp, scene, device)
    if stage.vertices is None or stage.vertices_received is None:
        _shade_pixels(stage)
    else:
        _shade_vertices(stage, stage.vertices, stage.vertices_received)
    with _timed(stage, "shadow rays"):
        eye = stage.lighting.table.eye
        add_delta_lights(surfaces.receivers, scene, eye, stage.delta_lights, *stage.received, device)
    if stage.bounces is not None and stage.last_gather is not None:
        _bounce(stage, stage.bounces, stage.last_gather)
    with _timed(stage, "resolve pixels"):
        resolve_pixels(stage.film, surfaces, scene, stage.textures, stage.received, stage.bounced, device)


def _shade_pixels(stage: Stage) -> None:
    scene, device, pixels = stage.device_scene, stage.settings.device, stage.surfaces.receivers
    lattice, lights = stage.lattice, (stage.occlusion, stage.lighting)
    choose_cuts(stage.cuts.pixels, pixels, stage.spheres, device)
    begin_lattice(lattice, pixels, stage.surfaces.extra, device)
    # Where probes bring the environment's light, pixels start from darkness.
    by_probes = stage.last_gather is not None and stage.last_gather.gathers_sky
    if by_probes:
        for received in stage.received:
            received.zero_()
    for turn in range(1, len(STRIDES) + 1):
        if not by_probes:
            whose = (lattice.turns, turn, scene)
            with _timed(stage, "shadow fields"):
                shade_direct(pixels, *whose, *lights, stage.cuts.pixels, *stage.received, device)
        _add_sharp_light(stage, turn)
        with _timed(stage, "lattice"):
            if turn < len(STRIDES):
                refine_lattice(lattice, turn, pixels, *stage.received, device)


def _add_sharp_light(stage: Stage, turn: int) -> None:
    """Adds small sources to the light of the pixels' receivers whose turn it is."""
    if stage.sharp is None:
        return
    device, whose = stage.settings.device, (stage.surfaces.receivers, stage.lattice.turns, turn)
    with _timed(stage, "sharp light"):
        lights = (stage.occlusion, stage.lighting, stage.sharp)
        add_sharp_light(*whose, stage.device_scene, *lights, *stage.received, device)


def _shade_vertices(stage: Stage, vertices: VertexReceivers, received: Received) -> None:
    scene, device, pixels = stage.device_scene, stage.settings.device, stage.surfaces.receivers
    with _timed(stage, "place vertices"):
        place_vertices(vertices, pixels, scene, device)
    with _timed(stage, "shadow fields"):
        lights = (stage.occlusion, stage.lighting)
        choose_cuts(stage.cuts.vertices, vertices.receivers, stage.spheres, device)
        shade_direct(vertices.receivers, vertices.turns, 1, scene, *lights, stage.cuts.vertices, *received, device)
    with _timed(stage, "interpolate vertices"):
        interpolate_vertices(vertices, pixels, scene, received, *stage.received, device)
    # Every pixel receives sharp and bounced light by itself.
    stage.lattice.turns.fill_(1)
    _add_sharp_light(stage, 1)


def _bounce(stage: Stage, bounces: BounceState, last_gather: LastGather) -> None:
    settings, scene, lights = stage.settings, stage.device_scene, (stage.occlusion, stage.lighting)
    device = settings.device
    if stage.has_moved:
        with _timed(stage, "basis irradiances"):
            gather_basis_irradiances(bounces, scene, *lights, settings.bounce_threshold, device)
            tint_proxies(bounces, scene, stage.textures, device)
    # Where only the camera has moved, the light on the bodies is as it was. Those that deform do so without a word.
    if stage.has_moved or stage.is_lit_anew or stage.scene.deforming:
        _light_proxies(stage, bounces)
    stage.has_moved = stage.is_lit_anew = False
    with _timed(stage, "last gather"):
        size = (0.0, 0.0) if stage.seen is None else stage.seen[0].pixel_size(settings.width, settings.height)
        seen = (stage.surfaces.receivers, stage.surfaces.extra, EXTRA_GROUPS, wp.vec2(*size))
        shown = (stage.cuts.pixels, stage.lattice, stage.received, stage.bounced)
        gather_last_bounce(last_gather, *seen, scene, *lights, *shown, device)


def _light_proxies(stage: Stage, bounces: BounceState) -> None:
    """Direct light on the proxies, and all bounces but the last gather."""
    scene, device, lights = stage.device_scene, stage.settings.device, (stage.occlusion, stage.lighting)
    with _timed(stage, "light on proxies"):
        cuts, received = stage.cuts.proxies, bounces.received
        choose_cuts(cuts, bounces.proxies, stage.spheres, device)
        whose = bounces.proxies, bounces.turns
        for turn in (COARSE, FINE):
            if turn == FINE:
                refine_texels(bounces.patches, bounces.first_texel, *whose, *received, device)
            shade_direct(*whose, turn, scene, *lights, cuts, *received, device)
            if stage.sharp is not None:
                add_sharp_light(*whose, turn, scene, *lights, stage.sharp, *received, device)
        shade_gloss(bounces.gloss, bounces.proxies, scene, *lights, cuts, stage.delta_lights, received[0], device)
        if stage.sharp is not None:
            gloss = bounces.gloss.table
            add_sharp_moments(bounces.proxies, gloss.proxy, scene, *lights, stage.sharp, gloss.moment, device)
        eye = stage.lighting.table.eye
        add_delta_lights(bounces.proxies, scene, eye, stage.delta_lights, *bounces.received, device)
    with _timed(stage, "bounces"):
        bounce(bounces, scene, stage.occlusion, stage.settings.bounces, device)


def _make_see_through(stage: Stage) -> None:
    """Gives every pixel room for what lies behind the surface that it shows."""
    settings, device = stage.settings, stage.settings.device
    size = settings.width, settings.height
    stage.surfaces = make_surfaces(1, *size, stage.scene, settings.antialias, True, device)
    slots = stage.surfaces.slots
    stage.lattice = make_lattice(1, slots, *size, device)
    stage.received, stage.bounced = make_received(slots, device), make_received(slots, device)
    stage.cuts = replace(stage.cuts, pixels=make_cuts(1, slots, not stage.spheres.is_empty, device))
    if stage.bounces is not None and stage.last_gather is not None:
        threshold, gathers_sky = settings.bounce_threshold, stage.last_gather.gathers_sky
        stage.last_gather = make_last_gather(stage.bounces, threshold, *size, slots, gathers_sky, device)


@contextmanager
def _timed(stage: Stage, name: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    wp.synchronize_device(stage.settings.device)
    stage.seconds[name] = stage.seconds.get(name, 0.0) + time.perf_counter() - start


def _transfers(bodies: list[BakedBody]) -> list[tuple[np.ndarray, np.ndarray] | None]:
    """Of each mesh what its vertices see of the world past itself, and of themselves; None for convex ones."""
    return [
        None if body.transfer is None or body.visibility is None else (body.transfer, body.visibility)
        for body in bodies
    ]


def _make_cuts(
    spheres: SphereState,
    surfaces: Surfaces,
    vertices: VertexReceivers | None,
    bounces: BounceState | None,
    device: wp.Device,
) -> Cuts:
    of_vertices = 0 if vertices is None else vertices.receivers.entity.shape[1]
    of_proxies = 0 if bounces is None else bounces.proxies.entity.shape[1]
    counts = surfaces.slots, of_vertices, of_proxies
    return Cuts(*(make_cuts(1, count, not spheres.is_empty, device) for count in counts))


def make_received(count: int, device: wp.Device) -> Received:
    """Irradiance and Phong radiance of `count` receivers."""
    return (
        wp.zeros((1, count), dtype=wp.vec3, device=device),
        wp.zeros((1, count), dtype=wp.vec3, device=device),
    )


def _same_lights(lights: tuple[DeltaLight, ...], others: tuple[DeltaLight, ...]) -> bool:
    """Whether lights shine alike."""
    if len(lights) != len(others):
        return False
    names = [each.name for each in fields(DeltaLight)]
    return all(
        np.array_equal(getattr(light, name), getattr(other, name))
        for light, other in zip(lights, others, strict=True)
        for name in names
    )


def _same_poses(a: Poses, b: Poses | None) -> bool:
    return b is not None and np.array_equal(a.position, b.position) and np.array_equal(a.rotation, b.rotation)
