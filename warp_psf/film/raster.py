"""Which faces of opaque bodies pixels see, at their centres and on edges at several places, face by face and not ray by
ray.

Every face is set up once in a frame: where it may be on the film, and as linear functions of the pixel its edges, which
are positive outside, and its depth. A tile of the film then draws the faces of the bodies that reach into it, the
nearest surface in each pixel staying (Pineda 1988, "A parallel algorithm for polygon rasterization"; in homogeneous
coordinates, so that nothing is clipped, Olano and Greer 1997). No two tiles share a pixel, so the result does not
depend on their order.
"""

from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_psf.device import launch
from warp_psf.film.camera_rays import TILE, CameraTable, TileTable, on_film
from warp_psf.scene.geometry import DeviceScene, GeometryTables, PoseTables
from warp_psf.scene.scene import Scene

# Every tile looks at every face of the bodies that reach into it: bodies with more faces are met by rays, whose time
# grows with the logarithm of their number.
MOST_FACES = 20000
# An edge counts as this share of its length times its distance further out, so that rounding leaves no gap between two
# faces.
EDGE_MARGIN = 3.0e-7
# Depths are compared for faces that lie at least this share of the camera's near distance before its plane; the box of
# one that reaches behind it is the whole film.
AHEAD = 0.5


@wp.struct
class FaceTable:
    """The faces that are drawn, those of an entity behind one another.

    Linear functions of the pixel are a value at the first pixel of the face's box, and its steps to the right and down.
    """

    entity: wp.array(dtype=wp.int32)  # (face)
    face: wp.array(dtype=wp.int32)  # (face): of the entity's mesh
    first: wp.array(dtype=wp.int32)  # (entity): its first face, -1 for what rays are to meet
    count: wp.array(dtype=wp.int32)  # (entity)
    shows: wp.array2d(dtype=wp.int32)  # (world, face): 1 where it may be on the film, be it between pixels' centres
    rank: wp.array2d(dtype=wp.int32)  # (world, face): how many show before it, over all worlds
    shown: wp.array(dtype=wp.int32)  # (place): those that show, in order
    # (world, face): first and last column, first and last row of the pixels whose centres it may cover: of none, where
    # the last comes before the first. Other places of a pixel it may cover up to a pixel further out.
    box: wp.array2d(dtype=wp.vec4i)
    edge: wp.array3d(dtype=wp.vec3)  # (world, face, edge): positive outside
    slope: wp.array2d(dtype=wp.vec3)  # (world, face): the ray's advance through the face's plane per unit of depth
    offset: wp.array2d(dtype=wp.vec3)  # (world, face): from there to the plane; depth = offset / slope


@wp.struct
class DrawnTable:
    """What the tiles have drawn, (world, place): a pixel, or one of the places that are looked at on edges."""

    entity: wp.array2d(dtype=wp.int32)  # -1: nothing
    face: wp.array2d(dtype=wp.int32)
    depth: wp.array2d(dtype=wp.float32)  # metres along the optical axis


@dataclass(frozen=True)
class Raster:
    """The faces of a scene that are drawn, and room for a picture of them, at centres and at the places on edges."""

    faces: FaceTable
    drawn: DrawnTable
    drawn_edges: DrawnTable  # (world, SAMPLES * rank of the edge pixel + place)


@wp.func
def linear(value: float, right: float, up: float, place: wp.vec2, pixel: wp.vec2) -> wp.vec3:
    """A linear function of the place on the film, by its value in the middle and slopes: by pixels from `place` on."""
    return wp.vec3(value + right * place[0] + up * place[1], right * pixel[0], -up * pixel[1])


@wp.func
def edge_of(a: wp.vec3, b: wp.vec3, view: float, orthographic: bool, place: wp.vec2, pixel: wp.vec2) -> wp.vec3:
    """On which side of the edge from a to b, in the camera's frame, its rays pass: positive outside of a front face.

    view: how long the longest ray of unit depth is.
    """
    # The same as the cross product of a and b, with more digits.
    normal = wp.cross(a, b - a)
    margin = wp.static(EDGE_MARGIN) * wp.length(normal) * view
    if orthographic:
        # Rays go along -z from (x, y, 0).
        step = b - a
        return linear(-normal[2] - margin, step[1], -step[0], place, pixel)
    return linear(-normal[2] - margin, normal[0], normal[1], place, pixel)


@wp.kernel(enable_backward=False, module="unique")
def _set_up_faces(first: int, geometry: GeometryTables, poses: PoseTables, camera: CameraTable, faces: FaceTable):
    world, item = wp.tid()
    item += first
    entity = faces.entity[item]
    mesh = geometry[0].entity_mesh[entity]
    corners = geometry[0].faces[geometry[0].first_face[mesh] + faces.face[item]]
    start = geometry[0].first_vertex[mesh]
    to_camera = wp.transpose(camera.rotation[world])
    turn = to_camera * poses[0].rotation[world, entity]
    shift = to_camera * (poses[0].position[world, entity] - camera.position[world])
    a = turn * geometry[0].vertices[start + corners[0]] + shift
    b = turn * geometry[0].vertices[start + corners[1]] + shift
    c = turn * geometry[0].vertices[start + corners[2]] + shift
    faces.shows[world, item] = 0
    orthographic = camera.orthographic[world]
    normal = wp.cross(b - a, c - a)
    if orthographic:
        if normal[2] <= 0.0:
            return
    elif wp.dot(a, normal) >= 0.0:
        return
    nearest = -wp.max(a[2], wp.max(b[2], c[2]))
    farthest = -wp.min(a[2], wp.min(b[2], c[2]))
    near = camera.near[world]
    if farthest < near or nearest > camera.far[world]:
        return
    size = camera.pixel[world]
    middle = camera.center[world]
    low = wp.vec2(-1.0e9, -1.0e9)
    high = wp.vec2(1.0e9, 1.0e9)
    if orthographic or nearest > wp.static(AHEAD) * near:
        film_a = wp.vec2(a[0], a[1])
        film_b = wp.vec2(b[0], b[1])
        film_c = wp.vec2(c[0], c[1])
        if not orthographic:
            film_a = film_a / -a[2]
            film_b = film_b / -b[2]
            film_c = film_c / -c[2]
        low = wp.min(film_a, wp.min(film_b, film_c))
        high = wp.max(film_a, wp.max(film_b, film_c))
    # Columns and rows whose centres lie within, a hair further for rounding.
    half = 0.5 * wp.vec2(float(camera.width), float(camera.height))
    left = wp.ceil((low[0] - middle[0]) / size[0] + half[0] - 0.5 - 1.0e-3)
    right = wp.floor((high[0] - middle[0]) / size[0] + half[0] - 0.5 + 1.0e-3)
    above = wp.ceil((middle[1] - high[1]) / size[1] + half[1] - 0.5 - 1.0e-3)
    below = wp.floor((middle[1] - low[1]) / size[1] + half[1] - 0.5 + 1.0e-3)
    left = wp.max(left, 0.0)
    right = wp.min(right, float(camera.width - 1))
    above = wp.max(above, 0.0)
    below = wp.min(below, float(camera.height - 1))
    if left > right + 1.0 or above > below + 1.0:
        return
    faces.shows[world, item] = 1
    faces.box[world, item] = wp.vec4i(int(left), int(right), int(above), int(below))
    place = on_film(camera, world, left + 0.5, above + 0.5)
    # The longest ray of unit depth goes to a corner of the film.
    corner = wp.vec2(wp.abs(middle[0]) + half[0] * size[0], wp.abs(middle[1]) + half[1] * size[1])
    view = wp.sqrt(1.0 + wp.dot(corner, corner))
    if orthographic:
        view = 1.0
    faces.edge[world, item, 0] = edge_of(a, b, view, orthographic, place, size)
    faces.edge[world, item, 1] = edge_of(b, c, view, orthographic, place, size)
    faces.edge[world, item, 2] = edge_of(c, a, view, orthographic, place, size)
    if orthographic:
        faces.slope[world, item] = wp.vec3(-normal[2], 0.0, 0.0)
        faces.offset[world, item] = linear(wp.dot(a, normal), -normal[0], -normal[1], place, size)
    else:
        faces.slope[world, item] = linear(-normal[2], normal[0], normal[1], place, size)
        faces.offset[world, item] = wp.vec3(wp.dot(a, normal), 0.0, 0.0)


@wp.kernel(enable_backward=False, module="unique")
def _list_shown(first: int, faces: FaceTable):
    world, item = wp.tid()
    item += first
    if faces.shows[world, item] == 1:
        faces.shown[faces.rank[world, item]] = item


@wp.kernel(enable_backward=False, module="unique")
def _draw_tiles(first: int, camera: CameraTable, tiles: TileTable, faces: FaceTable, drawn: DrawnTable):
    world, tile = wp.tid()
    tile += first
    left = (tile % tiles.columns) * wp.static(TILE)
    above = (tile / tiles.columns) * wp.static(TILE)
    right = wp.min(left + wp.static(TILE), camera.width) - 1
    below = wp.min(above + wp.static(TILE), camera.height) - 1
    for row in range(above, below + 1):
        for column in range(left, right + 1):
            drawn.entity[world, row * camera.width + column] = -1
            drawn.depth[world, row * camera.width + column] = camera.far[world]
    near = camera.near[world]
    for place in range(tiles.count[world, tile]):
        entity = tiles.entity[world, tile, place]
        start = faces.first[entity]
        if start >= 0:
            last = start + faces.count[entity] - 1
            behind = faces.rank[world, last] + faces.shows[world, last]
            for number in range(faces.rank[world, start], behind):
                item = faces.shown[number]
                box = faces.box[world, item]
                if box[0] <= right and box[1] >= left and box[2] <= below and box[3] >= above:
                    edge_0 = faces.edge[world, item, 0]
                    edge_1 = faces.edge[world, item, 1]
                    edge_2 = faces.edge[world, item, 2]
                    slope = faces.slope[world, item]
                    offset = faces.offset[world, item]
                    for row in range(wp.max(above, box[2]), wp.min(below, box[3]) + 1):
                        down = float(row - box[2])
                        for column in range(wp.max(left, box[0]), wp.min(right, box[1]) + 1):
                            at = wp.vec3(1.0, float(column - box[0]), down)
                            if wp.dot(edge_0, at) <= 0.0 and wp.dot(edge_1, at) <= 0.0 and wp.dot(edge_2, at) <= 0.0:
                                depth = wp.dot(offset, at) / wp.dot(slope, at)
                                pixel = row * camera.width + column
                                if depth >= near and depth < drawn.depth[world, pixel]:
                                    drawn.depth[world, pixel] = depth
                                    drawn.entity[world, pixel] = entity
                                    drawn.face[world, pixel] = faces.face[item]


@wp.func
def sample_offset(sample: int, samples: int) -> wp.vec2:
    """Eight places in a pixel, one in each row and column of an 8 x 8 grid; of a single sample, the centre."""
    if samples == 1:
        return wp.vec2(0.5, 0.5)
    column = (sample * 5 + 2) % 8
    return wp.vec2((float(column) + 0.5) / 8.0, (float(sample) + 0.5) / 8.0)


@wp.kernel(enable_backward=False, module="unique")
def _draw_edges(
    first: int,
    camera: CameraTable,
    tiles: TileTable,
    faces: FaceTable,
    edge: wp.array2d(dtype=wp.int32),  # (world, pixel): 1 on edges
    edge_rank: wp.array2d(dtype=wp.int32),  # (world, pixel)
    capacity: int,
    samples: int,
    drawn: DrawnTable,
):
    world, tile = wp.tid()
    tile += first
    left = (tile % tiles.columns) * wp.static(TILE)
    above = (tile / tiles.columns) * wp.static(TILE)
    right = wp.min(left + wp.static(TILE), camera.width) - 1
    below = wp.min(above + wp.static(TILE), camera.height) - 1
    # A bit for each row and each column of the tile in which there are edges.
    edge_rows = int(0)
    edge_columns = int(0)
    for row in range(above, below + 1):
        for column in range(left, right + 1):
            pixel = row * camera.width + column
            rank = edge_rank[world, pixel] - edge_rank[world, 0]
            if edge[world, pixel] == 1 and rank < capacity:
                edge_rows = edge_rows | (1 << (row - above))
                edge_columns = edge_columns | (1 << (column - left))
                for sample in range(samples):
                    drawn.entity[world, samples * rank + sample] = -1
                    drawn.depth[world, samples * rank + sample] = camera.far[world]
    if edge_rows == 0:
        return
    near = camera.near[world]
    for place in range(tiles.count[world, tile]):
        entity = tiles.entity[world, tile, place]
        start = faces.first[entity]
        if start >= 0:
            last = start + faces.count[entity] - 1
            behind = faces.rank[world, last] + faces.shows[world, last]
            for number in range(faces.rank[world, start], behind):
                item = faces.shown[number]
                box = faces.box[world, item]
                first_column = wp.max(left, box[0] - 1)
                last_column = wp.min(right, box[1] + 1)
                first_row = wp.max(above, box[2] - 1)
                last_row = wp.min(below, box[3] + 1)
                near_edge = first_column <= last_column and first_row <= last_row
                if near_edge:
                    rows = (edge_rows >> (first_row - above)) & ((2 << (last_row - first_row)) - 1)
                    columns = (edge_columns >> (first_column - left)) & ((2 << (last_column - first_column)) - 1)
                    near_edge = rows != 0 and columns != 0
                if near_edge:
                    edge_0 = faces.edge[world, item, 0]
                    edge_1 = faces.edge[world, item, 1]
                    edge_2 = faces.edge[world, item, 2]
                    slope = faces.slope[world, item]
                    offset = faces.offset[world, item]
                    for row in range(first_row, last_row + 1):
                        for column in range(first_column, last_column + 1):
                            pixel = row * camera.width + column
                            rank = edge_rank[world, pixel] - edge_rank[world, 0]
                            if edge[world, pixel] == 1 and rank < capacity:
                                middle = wp.vec2(float(column - box[0]) - 0.5, float(row - box[2]) - 0.5)
                                for sample in range(samples):
                                    beside = middle + sample_offset(sample, samples)
                                    at = wp.vec3(1.0, beside[0], beside[1])
                                    if (
                                        wp.dot(edge_0, at) <= 0.0
                                        and wp.dot(edge_1, at) <= 0.0
                                        and wp.dot(edge_2, at) <= 0.0
                                    ):
                                        depth = wp.dot(offset, at) / wp.dot(slope, at)
                                        spot = samples * rank + sample
                                        if depth >= near and depth < drawn.depth[world, spot]:
                                            drawn.depth[world, spot] = depth
                                            drawn.entity[world, spot] = entity
                                            drawn.face[world, spot] = faces.face[item]


def make_raster(
    worlds: int, width: int, height: int, edge_places: int, scene: Scene, back: np.ndarray, device: wp.Device
) -> Raster:
    """Room for what is drawn of a scene on a film of width x height pixels, and at so many places on edges.

    back: how opaque each entity is from behind, as a share (see `opacity_from_behind`). What is see-through, or seen
    from behind, or has no lasting shape, is not drawn.
    """
    shapes = [scene.meshes[entity.mesh] for entity in scene.entities]
    lasting = [index != scene.loose and index not in scene.deforming for index in range(len(shapes))]
    counts = np.array([len(mesh.faces) for mesh in shapes], np.int64)
    chosen = np.array(lasting, bool) & (back == 0.0) & (counts > 0) & (counts <= MOST_FACES)
    chosen &= np.array([entity.opacity >= 1.0 for entity in scene.entities], bool)
    counts = np.where(chosen, counts, 0)
    total = int(counts.sum())
    faces = FaceTable()
    faces.entity = wp.array(np.repeat(np.arange(len(shapes)), counts), dtype=wp.int32, device=device)
    numbers = np.concatenate([np.zeros(0, np.int64), *(np.arange(count) for count in counts)])
    faces.face = wp.array(numbers, dtype=wp.int32, device=device)
    faces.first = wp.array(np.where(chosen, np.cumsum(counts) - counts, -1), dtype=wp.int32, device=device)
    faces.count = wp.array(counts, dtype=wp.int32, device=device)
    faces.shows, faces.rank = (wp.zeros((worlds, total), dtype=wp.int32, device=device) for _ in range(2))
    faces.shown = wp.zeros(worlds * total, dtype=wp.int32, device=device)
    faces.box = wp.zeros((worlds, total), dtype=wp.vec4i, device=device)
    faces.edge = wp.zeros((worlds, total, 3), dtype=wp.vec3, device=device)
    faces.slope = wp.zeros((worlds, total), dtype=wp.vec3, device=device)
    faces.offset = wp.zeros((worlds, total), dtype=wp.vec3, device=device)
    return Raster(faces, *(_make_drawn((worlds, count), device) for count in (width * height, edge_places)))


def _make_drawn(shape: tuple[int, int], device: wp.Device) -> DrawnTable:
    drawn = DrawnTable()
    drawn.entity, drawn.face = (wp.zeros(shape, dtype=wp.int32, device=device) for _ in range(2))
    drawn.depth = wp.zeros(shape, dtype=wp.float32, device=device)
    return drawn


def draw_faces(raster: Raster, scene: DeviceScene, camera: CameraTable, tiles: TileTable, device: wp.Device) -> None:
    """Draws a scene in its present poses; after `fill_tiles`."""
    faces = raster.faces
    launch(_set_up_faces, faces.box.shape, [scene.geometry, scene.poses, camera, faces], [], device)
    if faces.shown.shape[0] > 0:
        wp.utils.array_scan(faces.shows.flatten(), faces.rank.flatten(), inclusive=False)
    launch(_list_shown, faces.box.shape, [faces], [], device)
    launch(_draw_tiles, tiles.count.shape, [camera, tiles, faces, raster.drawn], [], device)


def draw_edges(
    raster: Raster,
    edge: wp.array,
    edge_rank: wp.array,
    capacity: int,
    samples: int,
    camera: CameraTable,
    tiles: TileTable,
    device: wp.Device,
) -> None:
    """Draws the same at `samples` places of the first `capacity` edge pixels; after `draw_faces`.

    edge: int32 (world, pixel), 1 on edges; edge_rank: how many come before, counted over all worlds.
    """
    inputs = [camera, tiles, raster.faces, edge, edge_rank, capacity, samples, raster.drawn_edges]
    launch(_draw_edges, tiles.count.shape, inputs, [], device)
