"""Vertices as receivers: shaded once each, then interpolated over the pixels that see their faces."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_psf.device import launch
from warp_psf.scene.geometry import DeviceScene, GeometryTables, PoseTables
from warp_psf.scene.receiver import ReceiverTable, make_receivers
from warp_psf.scene.scene import Scene


@wp.struct
class VertexTable:
    """The vertices of all entities behind one another."""

    first: wp.array(dtype=wp.int32)  # (entity): its first vertex
    entity: wp.array(dtype=wp.int32)  # (vertex)
    face: wp.array(dtype=wp.int32)  # (vertex): one face that has it as a corner
    corner: wp.array(dtype=wp.int32)  # (vertex): which corner of that face
    needed: wp.array2d(dtype=wp.int32)  # (world, vertex): 1 when a pixel sees one of its faces


@dataclass(frozen=True)
class VertexReceivers:
    """The vertices and their receivers, which have one slot per vertex."""

    table: VertexTable
    receivers: ReceiverTable
    turns: wp.array  # int32 (world, vertex): 1, as all vertices are shaded in one turn


@wp.kernel(enable_backward=False, module="unique")
def _mark_needed(first: int, pixels: ReceiverTable, geometry: GeometryTables, vertices: VertexTable):
    world, slot = wp.tid()
    slot += first
    entity = pixels.entity[world, slot]
    if entity >= 0:
        mesh = geometry[0].entity_mesh[entity]
        corners = geometry[0].faces[geometry[0].first_face[mesh] + pixels.face[world, slot]]
        start = vertices.first[entity]
        # Several pixels may write the same 1.
        vertices.needed[world, start + corners[0]] = 1
        vertices.needed[world, start + corners[1]] = 1
        vertices.needed[world, start + corners[2]] = 1


@wp.kernel(enable_backward=False, module="unique")
def _place_vertices(
    first: int,
    geometry: GeometryTables,
    poses: PoseTables,
    vertices: VertexTable,
    receivers: ReceiverTable,
):
    world, vertex = wp.tid()
    vertex += first
    if vertices.needed[world, vertex] == 0:
        receivers.entity[world, vertex] = -1
        return
    entity = vertices.entity[vertex]
    start = geometry[0].first_vertex[geometry[0].entity_mesh[entity]] + vertex - vertices.first[entity]
    rotation = poses[0].rotation[world, entity]
    corner = vertices.corner[vertex]
    receivers.entity[world, vertex] = entity
    receivers.face[world, vertex] = vertices.face[vertex]
    receivers.uv[world, vertex] = wp.vec2(wp.where(corner == 0, 1.0, 0.0), wp.where(corner == 1, 1.0, 0.0))
    receivers.position[world, vertex] = poses[0].position[world, entity] + rotation * geometry[0].vertices[start]
    receivers.normal[world, vertex] = rotation * geometry[0].normals[start]


@wp.kernel(enable_backward=False, module="unique")
def _interpolate_vertices(
    first: int,
    pixels: ReceiverTable,
    geometry: GeometryTables,
    vertices: VertexTable,
    diffuse: wp.array2d(dtype=wp.vec3),  # (world, vertex)
    glossy: wp.array2d(dtype=wp.vec3),  # (world, vertex)
    diffuse_out: wp.array2d(dtype=wp.vec3),  # (world, slot)
    glossy_out: wp.array2d(dtype=wp.vec3),  # (world, slot)
):
    world, slot = wp.tid()
    slot += first
    entity = pixels.entity[world, slot]
    if entity >= 0:
        mesh = geometry[0].entity_mesh[entity]
        corners = geometry[0].faces[geometry[0].first_face[mesh] + pixels.face[world, slot]]
        start = vertices.first[entity]
        uv = pixels.uv[world, slot]
        a = start + corners[0]
        b = start + corners[1]
        c = start + corners[2]
        w = 1.0 - uv[0] - uv[1]
        diffuse_out[world, slot] = uv[0] * diffuse[world, a] + uv[1] * diffuse[world, b] + w * diffuse[world, c]
        glossy_out[world, slot] = uv[0] * glossy[world, a] + uv[1] * glossy[world, b] + w * glossy[world, c]


def upload_vertices(scene: Scene, worlds: int, device: wp.Device) -> VertexReceivers:
    """The vertices of every entity as receivers in `worlds` worlds."""
    shapes = [scene.meshes[entity.mesh] for entity in scene.entities]
    counts = np.array([len(mesh.vertices) for mesh in shapes], np.int64)
    total = int(counts.sum())
    faces, corners = [], []
    for mesh in shapes:
        # The last face written wins; any will do. A vertex without a face is never needed.
        face_of, corner_of = np.zeros((2, len(mesh.vertices)), np.int32)
        numbers = np.arange(len(mesh.faces), dtype=np.int32)
        for corner in range(3):
            face_of[mesh.faces[:, corner]] = numbers
            corner_of[mesh.faces[:, corner]] = corner
        faces.append(face_of)
        corners.append(corner_of)
    table = VertexTable()
    table.first = wp.array(np.cumsum(counts) - counts, dtype=wp.int32, device=device)
    table.entity = wp.array(np.repeat(np.arange(len(shapes)), counts), dtype=wp.int32, device=device)
    table.face = wp.array(np.concatenate([*faces, np.zeros(0, np.int32)]), dtype=wp.int32, device=device)
    table.corner = wp.array(np.concatenate([*corners, np.zeros(0, np.int32)]), dtype=wp.int32, device=device)
    table.needed = wp.zeros((worlds, total), dtype=wp.int32, device=device)
    turns = wp.full((worlds, total), 1, dtype=wp.int32, device=device)
    return VertexReceivers(table, make_receivers((worlds, total), device), turns)


def place_vertices(vertices: VertexReceivers, pixels: ReceiverTable, scene: DeviceScene, device: wp.Device) -> None:
    """Makes receivers of the vertices whose faces a pixel sees; the others are culled (Tamura 2006, section 5.3)."""
    vertices.table.needed.zero_()
    launch(_mark_needed, pixels.entity.shape, [pixels, scene.geometry, vertices.table], [], device)
    inputs = [scene.geometry, scene.poses, vertices.table, vertices.receivers]
    launch(_place_vertices, vertices.receivers.entity.shape, inputs, [], device)


def interpolate_vertices(
    vertices: VertexReceivers,
    pixels: ReceiverTable,
    scene: DeviceScene,
    shaded: tuple[wp.array, wp.array],
    diffuse: wp.array,
    glossy: wp.array,
    device: wp.Device,
) -> None:
    """Interpolates what the vertices received, `shaded` = (diffuse, glossy), over the pixels' receivers."""
    inputs = [pixels, scene.geometry, vertices.table, *shaded]
    launch(_interpolate_vertices, diffuse.shape, inputs, [diffuse, glossy], device)
