"""A still scene on the device, and rays through it."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_psf.area_light.checks import check_type
from warp_psf.device import launch
from warp_psf.scene.camera import Camera
from warp_psf.scene.still import StillScene

# Shadow rays begin and end this share of the coordinates' size off the surfaces that they join: float32 keeps seven
# digits, and a hit's position loses one of them.
OFFSET = 4.0e-6
# R R^T of a rotation may differ from the identity by this much: float32 matrices and printed decimals pass.
ORTHONORMAL = 1.0e-4


@wp.struct
class StillTable:
    """The triangles of a still scene."""

    mesh: wp.uint64  # id of the wp.Mesh
    vertices: wp.array(dtype=wp.vec3)  # (vertex), world, metres
    normals: wp.array(dtype=wp.vec3)  # (vertex)
    faces: wp.array(dtype=wp.vec3i)  # (face)
    surface: wp.array(dtype=wp.int32)  # (face)
    albedo: wp.array(dtype=wp.vec3)  # (face)


@wp.struct
class ViewTable:
    """A camera's film. Lengths at unit depth, or metres for an orthographic camera."""

    position: wp.vec3
    rotation: wp.mat33  # world_from_camera
    center: wp.vec2
    half: wp.vec2  # half its width and height
    near: wp.float32
    far: wp.float32
    orthographic: wp.bool


@wp.struct
class StillHit:
    """Where a ray meets the scene; face -1 is nothing."""

    face: wp.int32
    surface: wp.int32
    distance: wp.float32  # in lengths of the ray's direction
    u: wp.float32
    v: wp.float32
    position: wp.vec3
    normal: wp.vec3  # of the triangle, turned to where the ray came from


@dataclass(frozen=True, eq=False)
class DeviceStill:
    """A still scene's table, and the Warp mesh that must live as long as the table names it."""

    table: StillTable
    mesh: wp.Mesh
    surfaces: int


@wp.func
def meet(still: StillTable, origin: wp.vec3, direction: wp.vec3, farthest: float) -> StillHit:
    """The first triangle along a ray, from either side."""
    hit = StillHit()
    hit.face = -1
    hit.surface = -1
    query = wp.mesh_query_ray(still.mesh, origin, direction, farthest)
    if query.result:
        hit.face = query.face
        hit.surface = still.surface[query.face]
        hit.distance = query.t
        hit.u = query.u
        hit.v = query.v
        hit.position = origin + query.t * direction
        normal = wp.normalize(query.normal)
        hit.normal = wp.where(wp.dot(normal, direction) > 0.0, -normal, normal)
    return hit


@wp.func
def smooth_normal(still: StillTable, hit: StillHit) -> wp.vec3:
    """The smooth normal at a hit, on the side of its triangle's normal."""
    corners = still.faces[hit.face]
    smooth = wp.normalize(
        hit.u * still.normals[corners[0]]
        + hit.v * still.normals[corners[1]]
        + (1.0 - hit.u - hit.v) * still.normals[corners[2]]
    )
    return wp.where(wp.dot(smooth, hit.normal) < 0.0, -smooth, smooth)


@wp.func
def sees(still: StillTable, point: wp.vec3, normal: wp.vec3, target: wp.vec3) -> bool:
    """Whether nothing lies between a point of a surface, with its normal towards the target's side, and a target."""
    to_target = target - point
    size = wp.max(wp.max(wp.abs(point)), wp.max(wp.abs(target))) + wp.length(to_target)
    step = wp.static(OFFSET) * size
    start = point + step * normal
    return not wp.mesh_query_ray_anyhit(still.mesh, start, target - start, 1.0 - step / wp.length(to_target))


@wp.func
def view_direction(view: ViewTable, x: float, y: float) -> wp.vec3:
    """Of the ray through the film at (x, y), each from 0 to 1 from the top left; of unit depth."""
    film = wp.vec2(view.center[0] + (2.0 * x - 1.0) * view.half[0], view.center[1] + (1.0 - 2.0 * y) * view.half[1])
    if view.orthographic:
        film = wp.vec2()
    return view.rotation * wp.vec3(film[0], film[1], -1.0)


@wp.func
def view_origin(view: ViewTable, x: float, y: float) -> wp.vec3:
    """Where the ray through the film at (x, y) starts."""
    origin = view.position
    if view.orthographic:
        right = view.center[0] + (2.0 * x - 1.0) * view.half[0]
        up = view.center[1] + (1.0 - 2.0 * y) * view.half[1]
        origin += view.rotation * wp.vec3(right, up, 0.0)
    return origin


def upload_still(scene: StillScene, device: wp.Device) -> DeviceStill:
    """Puts a still scene on the device.

    Raises:
        TypeError: it is no still scene.
    """
    check_type("scene", scene, StillScene, "freeze_scene or make_still")
    table = StillTable()
    table.vertices = wp.array(scene.vertices, dtype=wp.vec3, device=device)
    table.normals = wp.array(scene.normals, dtype=wp.vec3, device=device)
    table.faces = wp.array(scene.faces, dtype=wp.vec3i, device=device)
    table.surface = wp.array(scene.surface, dtype=wp.int32, device=device)
    table.albedo = wp.array(scene.albedo, dtype=wp.vec3, device=device)
    indices = wp.array(scene.faces.reshape(-1), dtype=wp.int32, device=device)
    mesh = wp.Mesh(points=table.vertices, indices=indices)
    table.mesh = mesh.id
    return DeviceStill(table, mesh, len(scene.flat))


def seen_points(still: StillTable, camera: Camera, side: int, device: wp.Device) -> np.ndarray:
    """What side x side rays of a camera meet, world, metres, float64 [N, 3]; N is smaller where some meet nothing."""
    points = wp.zeros(side * side, dtype=wp.vec3, device=device)
    found = wp.zeros(side * side, dtype=wp.bool, device=device)
    view = make_view(camera, side, side)
    launch(_find_points, (1, side * side), [still, view, side], [points, found], device)
    return points.numpy()[found.numpy()].astype(np.float64)


@wp.kernel(enable_backward=False, module="unique")
def _find_points(
    first: int,
    still: StillTable,
    view: ViewTable,
    side: int,
    points_out: wp.array(dtype=wp.vec3),  # (ray)
    found_out: wp.array(dtype=wp.bool),  # (ray)
):
    world, ray = wp.tid()
    ray += first
    # Through the film's very corners.
    x = float(ray % side) / float(side - 1)
    y = float(ray / side) / float(side - 1)
    hit = meet(still, view_origin(view, x, y), view_direction(view, x, y), view.far)
    points_out[ray] = hit.position
    found_out[ray] = hit.face >= 0


def make_view(camera: Camera, width: int, height: int) -> ViewTable:
    """A camera for a picture of width x height pixels.

    Raises:
        TypeError: it is no camera.
        ValueError: a pose or a film that is none: rays without a direction would be looked up where no map is.
    """
    check_type("camera", camera, Camera, "a StillScene's cameras")
    rotation, half = np.asarray(camera.rotation), camera.half_sizes(width, height)
    turned = rotation.shape == (3, 3) and np.abs(rotation @ rotation.T - np.eye(3)).max() < ORTHONORMAL
    if not turned or np.shape(camera.position) != (3,) or not np.isfinite(camera.position).all():
        raise ValueError("the camera's pose is none; give a position of 3 finite numbers and a rotation matrix")
    if not (0.0 < min(half) <= max(half) < np.inf and np.isfinite(camera.center).all() and camera.near < camera.far):
        raise ValueError("the camera's film is none; give sizes above 0, a finite center, and near below far")
    view = ViewTable()
    view.position = wp.vec3(*map(float, camera.position))
    view.rotation = wp.mat33(*map(float, np.asarray(camera.rotation).ravel()))
    view.center = wp.vec2(*map(float, camera.center))
    view.half = wp.vec2(*map(float, half))
    view.near, view.far = float(camera.near), float(camera.far)
    view.orthographic = camera.orthographic
    return view
