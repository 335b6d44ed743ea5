"""What a camera ray meets: the surfaces in view, and those behind the see-through ones.

A ray sees what OpenGL's rasteriser would show of MuJoCo's scene: between the near and the far plane, and only faces
that are turned to the viewer, so that a camera within a head sees out of it. Flat bodies are seen from both sides; from
behind, planes are 30 % as opaque, and the shining rectangles of area lights just as opaque.

Of a see-through entity each front that a ray crosses stops the entity's opacity of the light, once: what is behind is
seen by the product of (1 - opacity) over the fronts before it. (MuJoCo's own picture blends every front twice, sorted
by the distances of whole geoms.)
"""

import numpy as np
import warp as wp

from warp_psf.film.camera_rays import CameraTable, TileTable
from warp_psf.scene.camera import Camera
from warp_psf.scene.geometry import GeometryTables, PoseTables, may_hit
from warp_psf.scene.light import area_light_entities
from warp_psf.scene.scene import Poses, Scene

# How opaque planes are from behind, as a share: MuJoCo's choice.
PLANE_FROM_BEHIND = 0.3
# See-through surfaces that a ray tells apart; the nearest ones count.
PANES = 4
# Behind a face that is passed, a ray goes on this share of its length and its coordinates further: a few units in the
# last place of float32. Too little only means that the same face is met and passed again.
STEP = 2.0e-6
# Faces that a ray passes of one entity before it gives up: a viewer within a machine of nested open shells has fewer.
MOST_PASSED = 64


@wp.struct
class Face:
    """Where a ray meets a face of an entity's mesh; -1 is no face."""

    face: wp.int32
    u: wp.float32
    v: wp.float32
    distance: wp.float32
    from_behind: wp.bool


@wp.struct
class Hit:
    """A surface point that a camera ray sees; entity -1 is nothing."""

    entity: wp.int32
    face: wp.int32
    u: wp.float32
    v: wp.float32
    distance: wp.float32
    opacity: wp.float32
    position: wp.vec3
    normal: wp.vec3


@wp.struct
class Sight:
    """What a camera ray meets: the solid surface at its end, if any, and the panes before it, the nearest first."""

    solid_entity: wp.int32  # -1: none
    solid: Face
    panes: wp.int32
    pane_entity: wp.types.vector(length=PANES, dtype=wp.int32)
    pane_face: wp.types.vector(length=PANES, dtype=wp.int32)
    pane_u: wp.types.vector(length=PANES, dtype=wp.float32)
    pane_v: wp.types.vector(length=PANES, dtype=wp.float32)
    pane_distance: wp.types.vector(length=PANES, dtype=wp.float32)
    pane_opacity: wp.types.vector(length=PANES, dtype=wp.float32)  # negative where it is seen from behind


@wp.func
def next_face(
    geometry: GeometryTables,
    entity: int,
    shows_back: bool,
    origin: wp.vec3,
    direction: wp.vec3,
    start: float,
    near: float,
    farthest: float,
) -> Face:
    """The first face from `start` to `farthest` that shows, along a ray in the entity's frame; in its units."""
    found = Face()
    found.face = -1
    begin = float(start)
    passed = int(0)
    while passed < wp.static(MOST_PASSED):
        query = wp.mesh_query_ray(
            geometry[0].mesh_id[geometry[0].entity_mesh[entity]],
            origin + begin * direction,
            direction,
            farthest - begin,
        )
        passed += 1
        if not query.result:
            passed = wp.static(MOST_PASSED)
        elif begin + query.t < near:
            begin = near
        elif query.sign < 0.0 and not shows_back:
            begin += query.t
            begin += wp.static(STEP) * (begin + wp.length(origin))
            if geometry[0].convex[entity]:
                passed = wp.static(MOST_PASSED)
        else:
            found.face = query.face
            found.u = query.u
            found.v = query.v
            found.distance = begin + query.t
            found.from_behind = query.sign < 0.0
            passed = wp.static(MOST_PASSED)
    return found


@wp.func
def add_pane(sight: Sight, entity: int, found: Face, opacity: float) -> Sight:
    """Puts a pane in its place among the nearest ones."""
    count = wp.min(sight.panes, wp.static(PANES - 1))
    if sight.panes == wp.static(PANES) and sight.pane_distance[wp.static(PANES - 1)] <= found.distance:
        return sight
    place = int(count)
    while place > 0 and sight.pane_distance[wp.max(place - 1, 0)] > found.distance:
        sight.pane_entity[place] = sight.pane_entity[place - 1]
        sight.pane_face[place] = sight.pane_face[place - 1]
        sight.pane_u[place] = sight.pane_u[place - 1]
        sight.pane_v[place] = sight.pane_v[place - 1]
        sight.pane_distance[place] = sight.pane_distance[place - 1]
        sight.pane_opacity[place] = sight.pane_opacity[place - 1]
        place -= 1
    sight.pane_entity[place] = entity
    sight.pane_face[place] = found.face
    sight.pane_u[place] = found.u
    sight.pane_v[place] = found.v
    sight.pane_distance[place] = found.distance
    sight.pane_opacity[place] = wp.where(found.from_behind, -opacity, opacity)
    sight.panes = count + 1
    return sight


@wp.func
def nothing_known() -> Sight:
    sight = Sight()
    sight.solid_entity = -1
    return sight


@wp.func
def sight_of_face(
    geometry: GeometryTables,
    poses: PoseTables,
    world: int,
    entity: int,
    face: int,
    origin: wp.vec3,
    direction: wp.vec3,
) -> Sight:
    """What a ray meets of which it is known that it is that face."""
    mesh = geometry[0].entity_mesh[entity]
    corners = geometry[0].faces[geometry[0].first_face[mesh] + face]
    start = geometry[0].first_vertex[mesh]
    a = geometry[0].vertices[start + corners[0]]
    b = geometry[0].vertices[start + corners[1]]
    c = geometry[0].vertices[start + corners[2]]
    inverse = wp.transpose(poses[0].rotation[world, entity])
    origin_entity = inverse * (origin - poses[0].position[world, entity])
    direction_entity = inverse * direction
    normal = wp.cross(b - a, c - a)
    sight = nothing_known()
    sight.solid_entity = entity
    sight.solid.face = face
    sight.solid.distance = wp.dot(a - origin_entity, normal) / wp.dot(direction_entity, normal)
    p = origin_entity + sight.solid.distance * direction_entity
    squared = wp.dot(normal, normal)
    u = wp.clamp(wp.dot(wp.cross(c - b, p - b), normal) / squared, 0.0, 1.0)
    sight.solid.u = u
    sight.solid.v = wp.clamp(wp.dot(wp.cross(a - c, p - c), normal) / squared, 0.0, 1.0 - u)
    return sight


@wp.func
def trace(
    geometry: GeometryTables,
    poses: PoseTables,
    camera: CameraTable,
    tiles: TileTable,
    back: wp.array(dtype=wp.float32),  # (entity)
    tile: int,
    world: int,
    origin: wp.vec3,
    direction: wp.vec3,
    known: Sight,
    is_known: wp.array(dtype=wp.int32),  # (entity)
) -> Sight:
    """What a camera ray of unit depth meets. `back`: how opaque an entity is from behind, as a share; 0: not at all.

    known: what it meets of the entities for which `is_known` is not below zero; see `nothing_known`.
    """
    sight = known
    near = camera.near[world]
    nearest = camera.far[world]
    if sight.solid_entity >= 0:
        nearest = sight.solid.distance
    length_squared = wp.dot(direction, direction)
    for place in range(tiles.count[world, tile]):
        entity = tiles.entity[world, tile, place]
        if is_known[entity] >= 0:
            continue
        position = poses[0].position[world, entity]
        rotation = poses[0].rotation[world, entity]
        to_center = position + rotation * geometry[0].center[entity] - origin
        along = wp.dot(to_center, direction)
        radius = geometry[0].radius[entity]
        # Discriminant of the ray against the bounding sphere, and whether the sphere lies ahead and near enough.
        beside = to_center - (along / length_squared) * direction
        reach = length_squared * (radius * radius - wp.dot(beside, beside))
        if reach >= 0.0:
            root = wp.sqrt(reach)
            if along + root > 0.0 and along - root < nearest * length_squared:
                inverse = wp.transpose(rotation)
                origin_entity = inverse * (origin - position)
                direction_entity = inverse * direction
                if may_hit(geometry, entity, origin_entity, direction_entity, nearest):
                    start = float(0.0)
                    crossed = int(0)
                    while crossed < wp.static(PANES):
                        found = next_face(
                            geometry, entity, back[entity] > 0.0, origin_entity, direction_entity, start, near, nearest
                        )
                        crossed += 1
                        if found.face < 0:
                            crossed = wp.static(PANES)
                        else:
                            opacity = geometry[0].opacity[entity]
                            if found.from_behind:
                                opacity *= back[entity]
                            if opacity < 1.0:
                                sight = add_pane(sight, entity, found, opacity)
                                start = found.distance
                                start += wp.static(STEP) * (start + wp.length(origin_entity))
                            else:
                                nearest = found.distance
                                sight.solid_entity = entity
                                sight.solid = found
                                crossed = wp.static(PANES)
    # The panes that the solid surface hides.
    panes = sight.panes
    for place in range(panes):
        if sight.solid_entity >= 0 and sight.pane_distance[place] > sight.solid.distance:
            sight.panes = wp.min(sight.panes, place)
    return sight


@wp.func
def surface_of(
    geometry: GeometryTables,
    poses: PoseTables,
    world: int,
    sight: Sight,
    place: int,
    origin: wp.vec3,
    direction: wp.vec3,
) -> Hit:
    """One of the surfaces that a ray meets: its pane `place`, or what is behind the panes for place = panes."""
    hit = Hit()
    from_behind = bool(False)
    if place < sight.panes:
        hit.entity = sight.pane_entity[place]
        hit.face = sight.pane_face[place]
        hit.u = sight.pane_u[place]
        hit.v = sight.pane_v[place]
        hit.distance = sight.pane_distance[place]
        hit.opacity = wp.abs(sight.pane_opacity[place])
        from_behind = sight.pane_opacity[place] < 0.0
    else:
        hit.entity = sight.solid_entity
        hit.face = sight.solid.face
        hit.u = sight.solid.u
        hit.v = sight.solid.v
        hit.distance = sight.solid.distance
        hit.opacity = 1.0
        from_behind = sight.solid.from_behind
    if hit.entity >= 0:
        hit.position = origin + hit.distance * direction
        mesh = geometry[0].entity_mesh[hit.entity]
        corners = geometry[0].faces[geometry[0].first_face[mesh] + hit.face]
        start = geometry[0].first_vertex[mesh]
        smooth = (
            hit.u * geometry[0].normals[start + corners[0]]
            + hit.v * geometry[0].normals[start + corners[1]]
            + (1.0 - hit.u - hit.v) * geometry[0].normals[start + corners[2]]
        )
        normal = wp.normalize(poses[0].rotation[world, hit.entity] * smooth)
        hit.normal = wp.where(from_behind, -normal, normal)
    return hit


def opacity_from_behind(scene: Scene) -> np.ndarray:
    """How opaque each entity is from behind, as a share of its opacity from the front, float32 (entity)."""
    shapes = [scene.meshes[entity.mesh] for entity in scene.entities]
    back = np.zeros(len(shapes), np.float32)
    for entity, mesh in enumerate(shapes):
        if mesh.slab is not None and mesh.slab[2].min() == 0.0:
            back[entity] = PLANE_FROM_BEHIND
    for _, entity in area_light_entities(scene):
        if back[entity] > 0.0:
            back[entity] = 1.0
    return back


def any_seen_from_behind(scene: Scene, poses: Poses, camera: Camera) -> bool:
    """Whether the camera is behind a plane, which then is see-through."""
    lights = {entity for _, entity in area_light_entities(scene)}
    for index, entity in enumerate(scene.entities):
        slab = scene.meshes[entity.mesh].slab
        if slab is not None and slab[2].min() == 0.0 and index not in lights:
            center, rotation, _ = slab
            world_from_entity = poses.rotation[0, index]
            offset = camera.position - poses.position[0, index] - world_from_entity @ center
            if offset @ (world_from_entity @ rotation[:, 2]) < 0.0:
                return True
    return False
