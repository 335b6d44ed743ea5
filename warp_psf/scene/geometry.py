"""The scene on the device: merged meshes with their ray-query trees, materials, and the poses of a frame."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_psf.basis import sphere
from warp_psf.device import upload_tables
from warp_psf.scene.deforming import Deformed
from warp_psf.scene.loose import Loose
from warp_psf.scene.mesh import Mesh
from warp_psf.scene.scene import Poses, Scene

# In so many directions, spread evenly, the vertex of a mesh that reaches farthest is kept: how far a round body reaches
# in any other direction is then known to one or two per cent.
SPAN_DIRECTIONS = 128


@wp.struct
class GeometryTable:
    """What does not change from frame to frame. The meshes' arrays stand behind one another."""

    mesh_id: wp.array(dtype=wp.uint64)  # (mesh), for wp.mesh_query_ray
    first_vertex: wp.array(dtype=wp.int32)  # (mesh)
    first_face: wp.array(dtype=wp.int32)  # (mesh)
    normals: wp.array(dtype=wp.vec3)  # (vertex), in the mesh's frame
    vertices: wp.array(dtype=wp.vec3)  # (vertex), metres, in the mesh's frame
    faces: wp.array(dtype=wp.vec3i)  # (face), counted from the mesh's first vertex
    entity_mesh: wp.array(dtype=wp.int32)  # (entity)
    center: wp.array(dtype=wp.vec3)  # (entity): centre of the bounding sphere, in the entity's frame
    radius: wp.array(dtype=wp.float32)  # (entity): of the bounding sphere, metres
    lower: wp.array(dtype=wp.vec3)  # (entity): corners of the bounding box, in the entity's frame
    upper: wp.array(dtype=wp.vec3)  # (entity)
    first_outermost: wp.array(dtype=wp.int32)  # (entity): of its `outermost`
    outermost_count: wp.array(dtype=wp.int32)  # (entity): 0 for those that change their shape
    outermost: wp.array(dtype=wp.vec3)  # vertices that reach farthest in some direction, in the mesh's frame
    convex: wp.array(dtype=wp.bool)  # (entity)
    opacity: wp.array(dtype=wp.float32)  # (entity), in (0, 1]
    specular: wp.array(dtype=wp.vec3)  # (entity)
    exponent: wp.array(dtype=wp.float32)  # (entity)
    first_part: wp.array(dtype=wp.int32)  # (entity)
    first_face_part: wp.array(dtype=wp.int32)  # (entity): its first place in face_part, -1 when it has one part
    face_part: wp.array(dtype=wp.int32)  # (face of an entity with several parts): counted from the first part
    albedo: wp.array(dtype=wp.vec3)  # (part)
    emission: wp.array(dtype=wp.vec3)  # (part)
    object_id: wp.array(dtype=wp.int32)  # (part)
    object_type: wp.array(dtype=wp.int32)  # (part)


@wp.struct
class PoseTable:
    """Where the entities are."""

    position: wp.array2d(dtype=wp.vec3)  # (world, entity), metres
    rotation: wp.array2d(dtype=wp.mat33)  # (world, entity), world_from_entity


# What kernels and device functions take: arrays of one table (see `device.upload_tables`).
GeometryTables = wp.array(dtype=GeometryTable)
PoseTables = wp.array(dtype=PoseTable)


@wp.struct
class Placed:
    """Where an entity is in a frame."""

    position: wp.vec3  # of its frame, in the world, metres
    rotation: wp.mat33  # world_from_entity
    center: wp.vec3  # of its bounding sphere, in the world
    radius: wp.float32  # of that, metres


@wp.func
def find_placed(world: int, entity: int, geometry: GeometryTables, poses: PoseTables) -> Placed:
    placed = Placed()
    placed.position = poses[0].position[world, entity]
    placed.rotation = poses[0].rotation[world, entity]
    placed.center = placed.position + placed.rotation * geometry[0].center[entity]
    placed.radius = geometry[0].radius[entity]
    return placed


@wp.func
def span_of(world: int, entity: int, n: wp.vec3, geometry: GeometryTables, poses: PoseTables) -> wp.vec2:
    """From where to where an entity reaches along a direction of the world, metres.

    By its outermost vertices: its sphere, and its box when it is turned, would reach below the floor it stands on.
    """
    turned = wp.transpose(poses[0].rotation[world, entity]) * n
    lower = geometry[0].lower[entity]
    upper = geometry[0].upper[entity]
    least = wp.dot(wp.min(wp.cw_mul(lower, turned), wp.cw_mul(upper, turned)), wp.vec3(1.0))
    most = wp.dot(wp.max(wp.cw_mul(lower, turned), wp.cw_mul(upper, turned)), wp.vec3(1.0))
    count = geometry[0].outermost_count[entity]
    if count > 0:
        least = float(1.0e30)
        most = float(-1.0e30)
    for place in range(count):
        along = wp.dot(turned, geometry[0].outermost[geometry[0].first_outermost[entity] + place])
        least = wp.min(least, along)
        most = wp.max(most, along)
    start = wp.dot(n, poses[0].position[world, entity])
    return wp.vec2(start + least, start + most)


@wp.func
def may_hit(geometry: GeometryTables, entity: int, origin: wp.vec3, direction: wp.vec3, farthest: float) -> bool:
    """Whether a ray in the entity's frame meets its bounding box before `farthest`, in units of `direction`."""
    # Division by zero gives infinities of the right sign. The box counts as a millionth deeper than it is, so that
    # rounding loses no hit on its faces.
    near = wp.cw_div(geometry[0].lower[entity] - origin, direction)
    far = wp.cw_div(geometry[0].upper[entity] - origin, direction)
    enter = wp.max(wp.min(near, far))
    leave = wp.min(wp.max(near, far)) * 1.000001
    return not (leave < wp.max(enter, 0.0) or enter > farthest)


@wp.func
def part_of(geometry: GeometryTables, entity: int, face: int) -> int:
    """The part that a face of an entity's mesh belongs to."""
    part = geometry[0].first_part[entity]
    if geometry[0].first_face_part[entity] >= 0:
        part += geometry[0].face_part[geometry[0].first_face_part[entity] + face]
    return part


@dataclass(frozen=True)
class DeviceScene:
    """The scene's tables, as arrays of one, and the Warp meshes that must live as long as `geometry` names them."""

    geometry: wp.array  # of GeometryTable
    poses: wp.array  # of PoseTable
    meshes: list[wp.Mesh]


def upload_scene(scene: Scene, worlds: int, device: wp.Device) -> DeviceScene:
    """Puts a scene's meshes and materials on the device, with room for the poses of `worlds` simulations."""
    meshes = [
        wp.Mesh(
            points=wp.array(mesh.vertices, dtype=wp.vec3, device=device),
            indices=wp.array(mesh.faces.reshape(-1), dtype=wp.int32, device=device),
        )
        for mesh in scene.meshes
    ]
    table = GeometryTable()
    table.mesh_id = wp.array([mesh.id for mesh in meshes], dtype=wp.uint64, device=device)
    table.first_vertex = wp.array(_starts(mesh.vertices for mesh in scene.meshes), dtype=wp.int32, device=device)
    table.first_face = wp.array(_starts(mesh.faces for mesh in scene.meshes), dtype=wp.int32, device=device)
    table.vertices = wp.array(_merged(mesh.vertices for mesh in scene.meshes), dtype=wp.vec3, device=device)
    table.normals = wp.array(_merged(mesh.normals for mesh in scene.meshes), dtype=wp.vec3, device=device)
    faces = _merged((mesh.faces for mesh in scene.meshes), np.int32)
    table.faces = wp.array(faces, dtype=wp.vec3i, device=device)

    shapes: list[Mesh] = [scene.meshes[entity.mesh] for entity in scene.entities]
    lobes = [entity.lobe for entity in scene.entities]

    def per_entity(values: list, dtype: type) -> wp.array:
        return wp.array(values, dtype=dtype, device=device)

    table.entity_mesh = per_entity([entity.mesh for entity in scene.entities], wp.int32)
    table.center = per_entity([wp.vec3(*map(float, mesh.center)) for mesh in shapes], wp.vec3)
    table.radius = per_entity([mesh.radius for mesh in shapes], wp.float32)
    table.lower = per_entity([wp.vec3(*map(float, mesh.vertices.min(axis=0))) for mesh in shapes], wp.vec3)
    table.upper = per_entity([wp.vec3(*map(float, mesh.vertices.max(axis=0))) for mesh in shapes], wp.vec3)
    _upload_outermost(table, scene, device)
    table.convex = per_entity([mesh.convex for mesh in shapes], wp.bool)
    table.opacity = per_entity([entity.opacity for entity in scene.entities], wp.float32)
    table.specular = per_entity([wp.vec3(*map(float, lobe.specular)) for lobe in lobes], wp.vec3)
    table.exponent = per_entity([float(lobe.exponent) for lobe in lobes], wp.float32)
    _upload_parts(table, scene, device)

    poses = PoseTable()
    poses.position = wp.zeros((worlds, len(scene.entities)), dtype=wp.vec3, device=device)
    poses.rotation = wp.zeros((worlds, len(scene.entities)), dtype=wp.mat33, device=device)
    return DeviceScene(upload_tables([table], GeometryTable, device), upload_tables([poses], PoseTable, device), meshes)


def _upload_outermost(table: GeometryTable, scene: Scene, device: wp.Device) -> None:
    """Fills the table's arrays over outermost vertices."""
    directions = sphere.fibonacci_cap(SPAN_DIRECTIONS)
    found = [mesh.vertices[np.unique((mesh.vertices @ directions.T).argmax(axis=0))] for mesh in scene.meshes]
    starts = _starts(found)
    lasting = [entity not in (*scene.deforming, scene.loose) for entity in range(len(scene.entities))]
    meshes = [entity.mesh for entity in scene.entities]
    counts = [len(found[mesh]) * kept for mesh, kept in zip(meshes, lasting, strict=True)]
    table.first_outermost = wp.array([starts[mesh] for mesh in meshes], dtype=wp.int32, device=device)
    table.outermost_count = wp.array(counts, dtype=wp.int32, device=device)
    table.outermost = wp.array(_merged(found), dtype=wp.vec3, device=device)


def _upload_parts(table: GeometryTable, scene: Scene, device: wp.Device) -> None:
    """Fills the table's arrays over parts."""
    parts = [part for entity in scene.entities for part in entity.parts]
    maps = [entity.face_part for entity in scene.entities]
    counts = np.array([0 if faces is None else len(faces) for faces in maps], np.int64)
    first = np.where(counts > 0, np.cumsum(counts) - counts, -1)
    table.first_part = wp.array(_starts(entity.parts for entity in scene.entities), dtype=wp.int32, device=device)
    table.first_face_part = wp.array(first, dtype=wp.int32, device=device)
    given = [np.zeros(0, np.int32), *(faces for faces in maps if faces is not None)]
    table.face_part = wp.array(np.concatenate(given), dtype=wp.int32, device=device)
    albedo = np.array([part.material.albedo for part in parts], np.float32).reshape(-1, 3)
    emission = np.array([part.material.emission for part in parts], np.float32).reshape(-1, 3)
    table.albedo = wp.array(albedo, dtype=wp.vec3, device=device)
    table.emission = wp.array(emission, dtype=wp.vec3, device=device)
    table.object_id = wp.array([part.object_id for part in parts], dtype=wp.int32, device=device)
    table.object_type = wp.array([part.object_type for part in parts], dtype=wp.int32, device=device)


def write_poses(device_scene: DeviceScene, poses: Poses) -> None:
    """Brings the poses of a frame to the device."""
    (table,) = device_scene.poses.tables
    table.position.assign(poses.position)
    table.rotation.assign(poses.rotation)


def write_deforming(device_scene: DeviceScene, scene: Scene, bodies: Sequence[Deformed | None]) -> None:
    """Brings the present shapes of the scene's deforming entities to the device; None leaves nothing of one.

    bodies: as `Scene.deforming`.
    """
    (table,) = device_scene.geometry.tables
    for entity, body in zip(scene.deforming, bodies, strict=True):
        if body is not None:
            mesh = scene.entities[entity].mesh
            first, _ = _before(scene, mesh)
            _write(table.vertices, first, body.vertices)
            _write(table.normals, first, body.normals)
            # Fitting the old tree to the new boxes would take a tenth of the time, and the further the body gets from
            # the shape for which that was built, the more of its boxes overlap: rays then take longer than is won.
            points = table.vertices[first : first + len(body.vertices)]
            _replace_mesh(device_scene, mesh, wp.Mesh(points=points, indices=device_scene.meshes[mesh].indices))
        _write_bounds(device_scene, entity, None if body is None else body.vertices)


def write_loose(device_scene: DeviceScene, scene: Scene, loose: Loose | None) -> None:
    """Brings the present shape of the scene's loose entity to the device; None leaves nothing of it."""
    (table,), entity = device_scene.geometry.tables, scene.loose
    mesh = scene.entities[entity].mesh
    if loose is not None:
        device = table.vertices.device
        first_vertex, first_face = _before(scene, mesh)
        _write(table.vertices, first_vertex, loose.vertices)
        _write(table.normals, first_vertex, loose.normals)
        _write(table.faces, first_face, loose.faces)
        first_part = sum(len(other.parts) for other in scene.entities[:entity])
        _write(table.face_part, len(table.face_part) - len(scene.entities[entity].face_part), loose.face_part)
        _write(table.albedo, first_part, np.array([part.material.albedo for part in loose.parts], np.float32))
        _write(table.emission, first_part, np.array([part.material.emission for part in loose.parts], np.float32))
        _write(table.object_id, first_part, np.array([part.object_id for part in loose.parts], np.int32))
        _write(table.object_type, first_part, np.array([part.object_type for part in loose.parts], np.int32))
        points = wp.array(loose.vertices, dtype=wp.vec3, device=device)
        indices = wp.array(loose.faces.reshape(-1), dtype=wp.int32, device=device)
        _replace_mesh(device_scene, mesh, wp.Mesh(points=points, indices=indices))
    _write_bounds(device_scene, entity, None if loose is None else loose.vertices)


def _before(scene: Scene, mesh: int) -> tuple[int, int]:
    """How many vertices and faces there are before a mesh's."""
    before = scene.meshes[:mesh]
    return sum(len(shape.vertices) for shape in before), sum(len(shape.faces) for shape in before)


def _replace_mesh(device_scene: DeviceScene, mesh: int, new: wp.Mesh) -> None:
    device_scene.meshes[mesh] = new
    _write(device_scene.geometry.tables[0].mesh_id, mesh, np.array([new.id], np.uint64))


def _write_bounds(device_scene: DeviceScene, entity: int, vertices: np.ndarray | None) -> None:
    """Brings the bounds of an entity that lies in the world's frame to the device."""
    (table,) = device_scene.geometry.tables
    # A box that is inside out is hit by nothing.
    lower, upper, center, radius = np.full(3, 1e30), np.full(3, -1e30), np.zeros(3), 0.0
    if vertices is not None:
        lower, upper = vertices.min(axis=0), vertices.max(axis=0)
        center = 0.5 * (lower + upper)
        radius = float(np.linalg.norm(vertices - center, axis=1).max())
    _write(table.lower, entity, lower[None].astype(np.float32))
    _write(table.upper, entity, upper[None].astype(np.float32))
    _write(table.center, entity, center[None].astype(np.float32))
    _write(table.radius, entity, np.array([radius], np.float32))


def _write(array: wp.array, first: int, values: np.ndarray) -> None:
    array[first : first + len(values)].assign(values)


def _starts(arrays) -> np.ndarray:
    counts = np.array([len(array) for array in arrays], np.int64)
    return np.cumsum(counts) - counts


def _merged(arrays, dtype: type = np.float32) -> np.ndarray:
    return np.concatenate([np.zeros((0, 3), dtype), *arrays]).astype(dtype)
