"""What lies before or behind which plane: worked out once per frame for all pairs, whatever the receiver.

A face is hidden only by what lies before it, and of a body a slab hides only what lies behind a face of the slab that
looks at the receiver. Both are shares that change smoothly as the bodies move, so that nothing pops.
"""

import warp as wp

from warp_psf.device import launch
from warp_psf.scene.geometry import DeviceScene, Extent, GeometryTables, PoseTables, extent_of, reach_of
from warp_psf.shade.patches import Patches, PatchTables, axis_vector, slab_from_world, slab_origin

# The least half-extent over which a body passes through a plane, in units of its half-diagonal: a flat one is on one
# side or the other.
THINNEST = 1.0e-3


@wp.struct
class RelationTable:
    """Shares of bodies on the sides of the slabs' faces."""

    before: wp.array3d(dtype=wp.float32)  # (world, face, entity): how far what lies before the face hides it
    # (world, source, face): the part of a source behind the plane of a face. Sources are the faces, then the entities.
    behind: wp.array3d(dtype=wp.float32)


@wp.func
def extent_of_face(world: int, face: int, poses: PoseTables, patches: PatchTables) -> Extent:
    """The part of a face that sends out light."""
    entity = patches[0].entity[face]
    axis = patches[0].axis[face]
    part = patches[0].part[world, face]
    to_world = wp.transpose(slab_from_world(world, entity, poses, patches))
    u = axis_vector((axis + 1) % 3)
    v = axis_vector((axis + 2) % 3)
    middle = part[0] * u + part[2] * v + patches[0].side[face] * patches[0].half[face][2] * axis_vector(axis)
    extent = Extent()
    extent.center = slab_origin(world, entity, poses, patches) + to_world * middle
    extent.axes = to_world * wp.diag(part[1] * u + part[3] * v)
    return extent


@wp.func
def part_behind(extent: Extent, n: wp.vec3, height: float) -> float:
    """The part of an extent behind a plane with normal n over which its centre stands at `height`, metres."""
    size = wp.sqrt(wp.length_sq(extent.axes[0]) + wp.length_sq(extent.axes[1]) + wp.length_sq(extent.axes[2]))
    return wp.clamp(0.5 - 0.5 * height / wp.max(reach_of(extent, n), wp.static(THINNEST) * size), 0.0, 1.0)


@wp.func
def normal_of(world: int, face: int, poses: PoseTables, patches: PatchTables) -> wp.vec3:
    """The outward normal of a face, in the world."""
    to_slab = slab_from_world(world, patches[0].entity[face], poses, patches)
    return patches[0].side[face] * (wp.transpose(to_slab) * axis_vector(patches[0].axis[face]))


@wp.kernel(enable_backward=False, module="unique")
def _relate(first: int, geometry: GeometryTables, poses: PoseTables, patches: PatchTables, relations: RelationTable):
    world, source = wp.tid()
    source += first
    faces = patches[0].entity.shape[0]
    extent = Extent()
    if source < faces:
        extent = extent_of_face(world, source, poses, patches)
    else:
        extent = extent_of(world, source - faces, geometry, poses)
    for face in range(faces):
        n = normal_of(world, face, poses, patches)
        middle = extent_of_face(world, face, poses, patches).center
        part = part_behind(extent, n, wp.dot(n, extent.center - middle))
        relations.behind[world, source, face] = part
        if source >= faces:
            # What is half sunk into the face hides as much as its upper half does.
            relations.before[world, face, source - faces] = wp.min(2.0 - 2.0 * part, 1.0)


@wp.func
def faces_ahead(world: int, entity: int, p: wp.vec3, poses: PoseTables, patches: PatchTables) -> int:
    """Bit k is set when p lies before the slab's face k; 0 for what is no slab."""
    first = patches[0].first_face[entity]
    ahead = int(0)
    if first >= 0:
        p_slab = slab_from_world(world, entity, poses, patches) * (p - slab_origin(world, entity, poses, patches))
        half = patches[0].slab_half[entity]
        for axis in range(3):
            if p_slab[axis] >= half[axis]:
                ahead += 1 << (2 * axis)
            if -p_slab[axis] >= half[axis]:
                ahead += 2 << (2 * axis)
    return ahead


@wp.func
def hidden_part(world: int, source: int, first_face: int, ahead: int, relations: RelationTable) -> float:
    """The part of a source behind all those faces of a slab before which a point lies (see `faces_ahead`)."""
    part = float(1.0)
    for face in range(6):
        if (ahead >> face) % 2 == 1:
            part = wp.min(part, relations.behind[world, source, first_face + face])
    return part


@wp.func
def hides_face(world: int, entity: int, ahead: int, face: int, patches: PatchTables, relations: RelationTable) -> float:
    """How far an entity lies between a point and a face of another. ahead: the entity's faces before which p lies."""
    share = relations.before[world, face, entity]
    if share > 0.0 and ahead > 0:
        share = wp.min(share, hidden_part(world, face, patches[0].first_face[entity], ahead, relations))
    return share


@wp.func
def hides_body(
    world: int, entity: int, ahead: int, body: int, further: float, patches: PatchTables, relations: RelationTable
) -> float:
    """How far an entity in the same direction lies between a point and a body that is no slab.

    ahead: as for `hides_face`. further: how much farther away the body is, in units of both radii together.
    """
    if ahead > 0:
        source = patches[0].entity.shape[0] + body
        return hidden_part(world, source, patches[0].first_face[entity], ahead, relations)
    return wp.clamp(0.5 + further, 0.0, 1.0)


def make_relations(patches: Patches, entities: int, worlds: int, device: wp.Device) -> RelationTable:
    """Room for the relations of a scene's entities to the faces of its slabs."""
    faces = patches.table.entity.shape[0]
    relations = RelationTable()
    relations.before = wp.zeros((worlds, faces, entities), dtype=wp.float32, device=device)
    relations.behind = wp.zeros((worlds, faces + entities, faces), dtype=wp.float32, device=device)
    return relations


def relate(relations: RelationTable, patches: Patches, scene: DeviceScene, device: wp.Device) -> None:
    """Works out the relations of a frame, after `place_texels`."""
    inputs = [scene.geometry, scene.poses, patches.tables]
    launch(_relate, relations.behind.shape[:2], inputs, [relations], device)
