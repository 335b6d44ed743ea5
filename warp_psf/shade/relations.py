"""What lies before or behind which plane: worked out once per frame for all pairs, whatever the receiver.

A face is hidden only by what lies before it, and of a body a slab hides only what lies behind a face of the slab that
looks at the receiver. Both are shares that change smoothly as the bodies move, so that nothing pops.
"""

import warp as wp

from warp_psf.device import launch
from warp_psf.scene.geometry import DeviceScene, GeometryTables, PoseTables, span_of
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
def middle_of_face(world: int, face: int, poses: PoseTables, patches: PatchTables) -> wp.vec3:
    """The middle of the part of a face that sends out light, in the world."""
    entity = patches[0].entity[face]
    axis = patches[0].axis[face]
    part = patches[0].part[world, face]
    middle = part[0] * axis_vector((axis + 1) % 3) + part[2] * axis_vector((axis + 2) % 3)
    middle += patches[0].side[face] * patches[0].half[face][2] * axis_vector(axis)
    to_world = wp.transpose(slab_from_world(world, entity, poses, patches))
    return slab_origin(world, entity, poses, patches) + to_world * middle


@wp.func
def span_of_face(world: int, face: int, n: wp.vec3, poses: PoseTables, patches: PatchTables) -> wp.vec2:
    """From where to where that part reaches along a direction of the world, metres."""
    axis = patches[0].axis[face]
    part = patches[0].part[world, face]
    turned = slab_from_world(world, patches[0].entity[face], poses, patches) * n
    reach = wp.abs(turned[(axis + 1) % 3]) * part[1] + wp.abs(turned[(axis + 2) % 3]) * part[3]
    middle = wp.dot(n, middle_of_face(world, face, poses, patches))
    return wp.vec2(middle - reach, middle + reach)


@wp.func
def part_behind(span: wp.vec2, height: float, thinnest: float) -> float:
    """The part of a span below a height; one thinner than `thinnest` counts as so thick. All in metres."""
    middle = 0.5 * (span[0] + span[1])
    reach = wp.max(0.5 * (span[1] - span[0]), thinnest)
    return wp.clamp(0.5 + 0.5 * (height - middle) / wp.max(reach, 1.0e-12), 0.0, 1.0)


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
    size = float(0.0)
    if source < faces:
        sides = patches[0].part[world, source]
        size = wp.length(wp.vec2(sides[1], sides[3]))
    else:
        size = geometry[0].radius[source - faces]
    for face in range(faces):
        n = normal_of(world, face, poses, patches)
        span = wp.vec2()
        if source < faces:
            span = span_of_face(world, source, n, poses, patches)
        else:
            span = span_of(world, source - faces, n, geometry, poses)
        height = wp.dot(n, middle_of_face(world, face, poses, patches))
        part = part_behind(span, height, wp.static(THINNEST) * size)
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
