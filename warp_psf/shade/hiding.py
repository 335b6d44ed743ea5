"""Which share of small sources bodies leave visible: by their silhouettes, spheres, closed forms or, near by, by rays.

A body that hides all of a group of sources or none of it is asked once; else each source is asked. What several bodies
leave is multiplied.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from warp_psf.basis import sh, sphere
from warp_psf.basis.visibility_mask import make_masks
from warp_psf.field.rasterise import draw_all, make_horizon
from warp_psf.field.silhouette_lanes import LANES, lanes, silhouette_distances
from warp_psf.field.silhouettes import Silhouette, SilhouetteTables, find_silhouette, silhouette_distance
from warp_psf.scene.geometry import GeometryTables, Placed, PoseTables, find_placed
from warp_psf.shade.coverage import FIELD_SHAPE, SLAB_SHAPE, SPHERE_SHAPE
from warp_psf.shade.delta import SHADOW_OFFSET, bulb_point
from warp_psf.shade.fades import Light, horizon_fade
from warp_psf.shade.occlude import SLAB_HORIZON, make_occlude
from warp_psf.shade.penumbra import (
    PART_RADIUS,
    PARTS,
    BoxOutline,
    box_outline,
    disc_share,
    disc_shares,
    outline_distance,
    part_direction,
    sphere_distance,
)
from warp_psf.shade.sources import Group, SharpTables, Sources, direction_to

# Nearer to a body's centre than so many bounding radii its surface may be so near that samples of its field are far
# apart: edges are then known to this many radians, and rays find them, where sources are few and none is a light.
NEAR, NEAR_ERROR = 1.25, 0.1
FEW_SOURCES = 4
# For the pieces of a light rays count fully up to the first of these, in bounding radii, and up to the second less and
# less. Where they shift an edge, it is bracketed to a piece, and the bracket is halved so many times.
NEAR_LIGHT, NEXT_LIGHT = 1.4, 1.6
HALVINGS = 2
# Rays to a source; when the first few agree, the rest are left out.
RAYS, FIRST_RAYS = 16, 4


@wp.func
def ray_share(mesh: wp.uint64, origin: wp.vec3, direction: wp.vec3, radius: float, size: float) -> float:
    """The share of a source that a mesh hides; all in the mesh's frame, `size` the radius of its bounding sphere."""
    disc = sphere.frame_of(direction)
    wide = wp.tan(wp.min(radius, 1.2))
    cast = int(0)
    hidden = int(0)
    rays = int(wp.static(RAYS))
    for ray in range(rays):
        if ray < wp.static(FIRST_RAYS) or (hidden > 0 and hidden < cast):
            # Steps of 7 through 16 visit every place once, and any four in a row are spread out.
            place = bulb_point((ray * 7) % wp.static(RAYS), wp.static(RAYS))
            aimed = direction + wide * (disc * wp.vec3(place[0], place[1], 0.0))
            cast += 1
            if wp.mesh_query_ray_anyhit(mesh, origin, wp.normalize(aimed), 4.0 * size):
                hidden += 1
    return float(hidden) / float(cast)


@wp.func
def shift_by_rays(
    mesh: wp.uint64,
    origin: wp.vec3,
    to_frame: wp.mat33,
    sources: Sources,
    distances: lanes,
    size: float,
    silhouettes: SilhouetteTables,
    seen: Silhouette,
) -> float:
    """What is to be added to the distances of a light's pieces from a mesh's silhouette for rays to agree, radians.

    Where a ray alone would decide which pieces are hidden, shadows would have as many steps as the light has pieces.
    The shift lies between `least`, above which a piece is found hidden, and `most`, below which one is found visible;
    the next ray goes to the piece that would tell most about zero. origin: in the mesh's frame; to_frame: from the
    world into that; size: the radius of its bounding sphere.
    """
    least = float(-wp.static(NEAR_ERROR))
    most = float(wp.static(NEAR_ERROR))
    hidden = wp.vec3()
    visible = wp.vec3()
    pieces = int(wp.static(LANES))
    for _ray in range(pieces):
        aim = wp.clamp(0.0, least, most)
        nearest = float(1.0e30)
        next = int(-1)
        for k in range(pieces):
            shift = -distances[k]
            if shift > least and shift < most and wp.abs(shift - aim) < nearest:
                nearest = wp.abs(shift - aim)
                next = k
        if next < 0:
            break
        direction = direction_to(sources, next)
        if wp.mesh_query_ray_anyhit(mesh, origin, to_frame * direction, 4.0 * size):
            least = -distances[next]
            hidden = direction
        else:
            most = -distances[next]
            visible = direction
    if wp.length_sq(hidden) > 0.0 and wp.length_sq(visible) > 0.0:
        for _ray in range(wp.static(HALVINGS)):
            if least > 0.0 or most < 0.0:
                between = wp.normalize(hidden + visible)
                shift = -silhouette_distance(silhouettes, seen, to_frame * between)
                if shift > least and shift < most:
                    if wp.mesh_query_ray_anyhit(mesh, origin, to_frame * between, 4.0 * size):
                        least = shift
                        hidden = between
                    else:
                        most = shift
                        visible = between
    return wp.clamp(0.0, least, most)


@cache
def make_hiding(order: int) -> SimpleNamespace:
    """The device function `visible_of` over the tables of `order` bands."""
    kit = make_occlude(order)
    OcclusionTables = kit.OcclusionTables
    evaluate, blocked_vector = sh.make_sh(order).evaluate, make_masks(order).blocked_vector

    @wp.func
    def is_in_way(entity: int, p: wp.vec3, n: wp.vec3, placed: Placed, group: Group, o: OcclusionTables) -> bool:
        """Whether an entity can reach into a cone above a receiver's horizon."""
        offset = placed.center - p
        height = wp.dot(n, offset)
        if height <= -placed.radius:
            return False
        squared = wp.length_sq(offset)
        if squared > placed.radius * placed.radius:
            distance = wp.sqrt(squared)
            # The cosine of the sum of both half angles.
            sine = placed.radius / distance
            apart = group.cosine * wp.sqrt(1.0 - sine * sine) - group.sine * sine
            if wp.dot(group.axis, offset) < apart * distance:
                return False
        if o[0].occluders.shape[entity] == wp.static(SLAB_SHAPE):
            half = o[0].occluders.slab_half[entity]
            n_slab = wp.transpose(placed.rotation * o[0].occluders.slab_rotation[entity]) * n
            rise = wp.abs(n_slab[0]) * half[0] + wp.abs(n_slab[1]) * half[1] + wp.abs(n_slab[2]) * half[2]
            middle = wp.dot(n, placed.position + placed.rotation * o[0].occluders.slab_center[entity] - p)
            return middle + rise > wp.static(SLAB_HORIZON) * placed.radius
        return True

    @wp.func
    def distance_to(
        toward: wp.vec3,
        shape: int,
        offset: wp.vec3,
        radius: float,
        to_frame: wp.mat33,
        outline: BoxOutline,
        seen: Silhouette,
        s: SharpTables,
    ) -> float:
        """The angle from a direction to an entity's silhouette, above zero within it."""
        if shape == wp.static(SPHERE_SHAPE):
            return sphere_distance(toward, offset, radius)
        if shape == wp.static(SLAB_SHAPE):
            return outline_distance(outline, to_frame * toward)
        return silhouette_distance(s[0].silhouettes, seen, to_frame * toward)

    @wp.func
    def hide_by(
        visible: lanes,
        entity: int,
        p: wp.vec3,
        placed: Placed,
        n: wp.vec3,
        weight: float,
        group: Group,
        sources: Sources,
        geometry: GeometryTables,
        o: OcclusionTables,
        s: SharpTables,
    ) -> lanes:
        """What an entity leaves visible of the sources of a group."""
        shape = o[0].occluders.shape[entity]
        offset = placed.center - p
        to_frame = wp.transpose(placed.rotation)
        at = to_frame * (p - placed.position)
        outline = BoxOutline()
        if shape == wp.static(SLAB_SHAPE):
            to_slab = wp.transpose(placed.rotation * o[0].occluders.slab_rotation[entity])
            at = to_slab * (p - placed.position - placed.rotation * o[0].occluders.slab_center[entity])
            to_frame = to_slab
            outline = box_outline(at, o[0].occluders.slab_half[entity])
        seen = Silhouette()
        if shape == wp.static(FIELD_SHAPE):
            seen = find_silhouette(s[0].silhouettes, s[0].field[entity], at)
        # What the distances may be off.
        error = float(0.0)
        apart = wp.length(offset) / placed.radius
        if shape == wp.static(FIELD_SHAPE) and (group.light >= 0 or group.count <= wp.static(FEW_SOURCES)):
            near = wp.where(group.light >= 0, wp.static(NEXT_LIGHT), wp.static(NEAR))
            error = wp.where(apart < near, wp.static(NEAR_ERROR), 0.0)
        # First the group as a whole, then each source.
        whole = distance_to(group.axis, shape, offset, placed.radius, to_frame, outline, seen, s)
        if whole <= -group.spread - error:
            return visible
        if whole >= group.spread + error:
            return (1.0 - weight) * visible
        origin = to_frame * (p + (wp.static(SHADOW_OFFSET) * placed.radius) * n - placed.position)
        mesh = geometry[0].mesh_id[geometry[0].entity_mesh[entity]]
        if shape == wp.static(FIELD_SHAPE) and group.light >= 0:
            # A light has pieces enough for what is thinner than it.
            distances = silhouette_distances(s[0].silhouettes, seen, to_frame, sources.toward)
            if error > 0.0:
                share = wp.clamp((wp.static(NEXT_LIGHT) - apart) * wp.static(1.0 / (NEXT_LIGHT - NEAR_LIGHT)), 0.0, 1.0)
                silhouettes = s[0].silhouettes
                shift = shift_by_rays(mesh, origin, to_frame, sources, distances, placed.radius, silhouettes, seen)
                distances += lanes(share * shift)
            return wp.cw_mul(visible, lanes(1.0) - weight * disc_shares(distances, sources.radius))
        result = visible
        for k in range(group.count):
            direction = direction_to(sources, k)
            radius = sources.radius[k]
            covered = float(0.0)
            if error > 0.0:
                covered = ray_share(mesh, origin, to_frame * direction, radius, placed.radius)
            else:
                distance = distance_to(direction, shape, offset, placed.radius, to_frame, outline, seen, s)
                if wp.abs(distance) >= radius:
                    # All of the source is on one side of the silhouette.
                    covered = wp.where(distance > 0.0, 1.0, 0.0)
                elif group.light >= 0:
                    covered = disc_share(distance, radius)
                else:
                    parts = int(wp.static(PARTS))
                    for part in range(parts):
                        toward = part_direction(direction, radius, part)
                        aside = distance_to(toward, shape, offset, placed.radius, to_frame, outline, seen, s)
                        covered += wp.static(1.0 / PARTS) * disc_share(aside, wp.static(PART_RADIUS) * radius)
            result[k] = result[k] * (1.0 - weight * covered)
        return result

    @wp.func
    def sphere_set_distance(world: int, root: int, p: wp.vec3, direction: wp.vec3, o: OcclusionTables) -> float:
        """The angle from a direction to the rim of the union of a sphere set, above zero within it."""
        largest = float(-wp.pi)
        for node in range(root, root + 2 * o[0].spheres[0].leaves[root] - 1):
            if o[0].spheres[0].leaves[node] == 1:
                offset = o[0].spheres[0].center[world, node] - p
                largest = wp.max(largest, sphere_distance(direction, offset, o[0].spheres[0].radius[world, node]))
        return largest

    @wp.func
    def hide_by_spheres(
        visible: lanes,
        world: int,
        root: int,
        p: wp.vec3,
        weight: float,
        group: Group,
        sources: Sources,
        o: OcclusionTables,
    ) -> lanes:
        """What the spheres of a deforming body leave visible of the sources of a group."""
        distance = sphere_set_distance(world, root, p, group.axis, o)
        if distance <= -group.spread:
            return visible
        if distance >= group.spread:
            return (1.0 - weight) * visible
        result = visible
        for k in range(group.count):
            covered = disc_share(sphere_set_distance(world, root, p, direction_to(sources, k), o), sources.radius[k])
            result[k] = result[k] * (1.0 - weight * covered)
        return result

    @wp.func
    def hide_by_sheet(
        visible: lanes,
        world: int,
        sheet: int,
        p: wp.vec3,
        n: wp.vec3,
        weight: float,
        group: Group,
        sources: Sources,
        poses: PoseTables,
        o: OcclusionTables,
    ) -> lanes:
        """What a deforming sheet leaves visible, as spherical harmonics show it."""
        hidden = draw_all(world, sheet, make_horizon(p, n), o[0].sheets, o[0].masks)
        blocked = blocked_vector(hidden, n, o[0].masks)
        to_entity = wp.transpose(poses[0].rotation[world, o[0].sheet_entity[sheet]])
        result = visible
        for k in range(group.count):
            covered = wp.clamp(wp.dot(blocked, evaluate(to_entity * direction_to(sources, k))), 0.0, 1.0)
            result[k] = result[k] * (1.0 - weight * covered)
        return result

    @wp.func
    def visible_of(
        world: int,
        own: int,
        p: wp.vec3,
        n: wp.vec3,
        group: Group,
        sources: Sources,
        geometry: GeometryTables,
        poses: PoseTables,
        o: OcclusionTables,
        s: SharpTables,
    ) -> lanes:
        """Which share of each source of a group is visible past every entity but `own`."""
        light = Light()
        light.radius = -1.0
        if group.light >= 0:
            placed = find_placed(world, s[0].light_entity[group.light], geometry, poses)
            light.center = placed.center
            light.radius = placed.radius
            light.facing = poses[0].rotation[world, s[0].light_entity[group.light]] * s[0].light_facing[group.light]
        visible = lanes(1.0)
        for entity in range(geometry[0].entity_mesh.shape[0]):
            weight = o[0].occluders.opacity[entity]
            if weight > 0.0 and entity != own:
                placed = find_placed(world, entity, geometry, poses)
                if is_in_way(entity, p, n, placed, group, o):
                    if group.light >= 0:
                        weight *= kit.nearness(entity, p, placed, light, o)
                    if weight > 0.0:
                        visible = hide_by(visible, entity, p, placed, n, weight, group, sources, geometry, o, s)
        node = int(0)
        while node < o[0].spheres[0].leaves.shape[0]:
            entity = o[0].spheres[0].entity[node]
            if entity != own and o[0].spheres[0].weight[world, node] > 0.0:
                placed = find_placed(world, entity, geometry, poses)
                if is_in_way(entity, p, n, placed, group, o):
                    weight = geometry[0].opacity[entity]
                    if group.light >= 0:
                        weight *= kit.nearness(entity, p, placed, light, o)
                    if weight > 0.0:
                        visible = hide_by_spheres(visible, world, node, p, weight, group, sources, o)
            node += 2 * o[0].spheres[0].leaves[node] - 1
        for sheet in range(o[0].sheet_entity.shape[0]):
            entity = o[0].sheet_entity[sheet]
            placed = find_placed(world, entity, geometry, poses)
            # One that is not shown has no radius.
            if entity != own and placed.radius > 0.0:
                if is_in_way(entity, p, n, placed, group, o):
                    weight = o[0].sheet_opacity[sheet] * horizon_fade(wp.dot(n, placed.center - p), placed.radius)
                    if group.light >= 0:
                        weight *= kit.nearness(entity, p, placed, light, o)
                    if weight > 0.0:
                        visible = hide_by_sheet(visible, world, sheet, p, n, weight, group, sources, poses, o)
        return visible

    @wp.func
    def is_open(
        world: int,
        own: int,
        p: wp.vec3,
        n: wp.vec3,
        group: Group,
        geometry: GeometryTables,
        poses: PoseTables,
        o: OcclusionTables,
    ) -> bool:
        """Whether no entity but `own` can hide anything of a group: most groups at most points."""
        if o[0].spheres[0].leaves.shape[0] + o[0].sheet_entity.shape[0] > 0:
            return False
        for entity in range(geometry[0].entity_mesh.shape[0]):
            if o[0].occluders.opacity[entity] > 0.0 and entity != own:
                placed = find_placed(world, entity, geometry, poses)
                if is_in_way(entity, p, n, placed, group, o):
                    return False
        return True

    return SimpleNamespace(visible_of=visible_of, is_open=is_open)
