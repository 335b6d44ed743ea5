"""Ray-cast coverage: which part of the sphere of directions a body hides from a point, projected on SH.

Rays are uniform in solid angle inside the cone of the body's bounding sphere, because no other ray can hit. Far from
the body the paper's 64 x 64 directions over the whole sphere would leave a couple of dozen rays on it; the cone keeps
hundreds there (`benchmarks/directions.py` compares them).
"""

import math
from functools import cache
from types import SimpleNamespace

import numpy as np
import warp as wp

from warp_psf.bake.bundles import RayBundles, agrees, cap_bundles
from warp_psf.basis import sh, sphere
from warp_psf.device import launch

# Rays per sample: (from how many bounding radii on, rays). Within the bounding sphere they cover all directions;
# beyond, only its cone. The error of a coefficient goes as (solid angle of the cone) / (rays)^(3/4): it falls outwards.
RAYS = ((0.0, 2048), (1.0, 768), (2.0, 384), (3.0, 192))
# Rays that decide whether a point is inside the solid: those that leave more layers than they enter say so.
RAYS_INSIDE_TEST = 24
# The share of them that must say so. In a closed mesh all or none do, except that two flush faces count as one: then
# up to half of the rays say so outside, and fewer than all inside. An open mesh has no inside, yet who is all but
# walled in by back faces is as good as inside; a receiver under a dome or in a cup must not be.
LEAST_SHARE_CLOSED = 0.55
LEAST_SHARE_OPEN = 0.9
# How far a ray's origin leaves the surface, in bounding radii: enough for float32, too little to be seen.
SURFACE_OFFSET = 1.0e-4
# Layers of surface that a ray out of the solid crosses before it gives up.
MOST_LAYERS = 32
# A vector is rotated through its values at a quadrature's directions: exact for twice the highest degree.
ROTATION_POINTS = {2: 16, 3: 16, 4: 32, 5: 32, 6: 64}


@wp.func
def cast_probes(
    mesh: wp.uint64,
    point: wp.vec3,
    frame: wp.mat33,
    reach: float,
    bundles: RayBundles,
    probed: wp.array(dtype=wp.uint8),  # (bundle), written
):
    """Casts the probe of each bundle."""
    for bundle in range(probed.shape[0]):
        hit = wp.mesh_query_ray_anyhit(mesh, point, frame * bundles.rays[bundles.first[bundle]], reach)
        probed[bundle] = wp.where(hit, wp.uint8(1), wp.uint8(0))


@cache
def make_visibility(order: int) -> SimpleNamespace:
    """Kernels that cast rays and project what they hit on `order` SH bands."""
    kit = sh.make_sh(order)
    vec = kit.vec

    @wp.func
    def turn(
        local: vec,
        frame: wp.mat33,
        directions: wp.array(dtype=wp.vec3),
        weighted_basis: wp.array(dtype=vec),
    ) -> vec:
        """Coefficients about the axes of `frame` -> about the body's axes, by evaluating and projecting again."""
        turned = vec()
        to_local = wp.transpose(frame)
        for q in range(directions.shape[0]):
            turned += wp.dot(local, kit.evaluate(to_local * directions[q])) * weighted_basis[q]
        return turned

    @wp.kernel(enable_backward=False, module="unique")
    def project_coverage(
        first: int,
        mesh: wp.uint64,
        points: wp.array(dtype=wp.vec3),  # (sample)
        axes: wp.array(dtype=wp.vec3),  # (sample)
        reach: float,
        bundles: RayBundles,
        weighted_basis: wp.array(dtype=vec),  # (ray)
        bundle_basis: wp.array(dtype=vec),  # (bundle): its rays' sum of that
        directions: wp.array(dtype=wp.vec3),  # (quadrature)
        direction_basis: wp.array(dtype=vec),  # (quadrature)
        probed_out: wp.array2d(dtype=wp.uint8),  # (sample, bundle): whether its probe hits
        coverage_out: wp.array(dtype=vec),  # (sample)
    ):
        world, sample = wp.tid()
        sample += first
        point = points[sample]
        frame = sphere.frame_of(axes[sample])
        cast_probes(mesh, point, frame, reach, bundles, probed_out[sample])
        covered = vec()
        for bundle in range(bundle_basis.shape[0]):
            hit = probed_out[sample, bundle] != wp.uint8(0)
            if agrees(bundles, probed_out[sample], bundle):
                if hit:
                    covered += bundle_basis[bundle]
            else:
                if hit:
                    covered += weighted_basis[bundles.first[bundle]]
                for ray in range(bundles.first[bundle] + 1, bundles.first[bundle + 1]):
                    if wp.mesh_query_ray_anyhit(mesh, point, frame * bundles.rays[ray], reach):
                        covered += weighted_basis[ray]
        coverage_out[sample] = turn(covered, frame, directions, direction_basis)

    @wp.kernel(enable_backward=False, module="unique")
    def project_radiance(
        first: int,
        mesh: wp.uint64,
        face_radiance: wp.array(dtype=wp.float32),  # (face): leaving the front of the face
        points: wp.array(dtype=wp.vec3),  # (sample)
        axes: wp.array(dtype=wp.vec3),  # (sample)
        reach: float,
        rays: wp.array(dtype=wp.vec3),  # (ray)
        weighted_basis: wp.array(dtype=vec),  # (ray)
        directions: wp.array(dtype=wp.vec3),  # (quadrature)
        direction_basis: wp.array(dtype=vec),  # (quadrature)
        radiance_out: wp.array(dtype=vec),  # (sample)
    ):
        world, sample = wp.tid()
        sample += first
        frame = sphere.frame_of(axes[sample])
        gathered = vec()
        for ray in range(rays.shape[0]):
            hit = wp.mesh_query_ray(mesh, points[sample], frame * rays[ray], reach)
            if hit.result and hit.sign > 0.0:
                gathered += face_radiance[hit.face] * weighted_basis[ray]
        radiance_out[sample] = turn(gathered, frame, directions, direction_basis)

    @wp.kernel(enable_backward=False, module="unique")
    def project_blocked_hemisphere(
        first: int,
        mesh: wp.uint64,
        points: wp.array(dtype=wp.vec3),  # (vertex)
        normals: wp.array(dtype=wp.vec3),  # (vertex)
        reach: float,
        bundles: RayBundles,  # the hemisphere about +z
        weighted_basis: wp.array(dtype=vec),  # (ray)
        directions: wp.array(dtype=wp.vec3),  # (quadrature)
        direction_basis: wp.array(dtype=vec),  # (quadrature)
        probed_out: wp.array2d(dtype=wp.uint8),  # (vertex, bundle)
        blocked_out: wp.array(dtype=vec),  # (vertex)
        blocked_cosine_out: wp.array(dtype=vec),  # (vertex)
    ):
        world, vertex = wp.tid()
        vertex += first
        point = points[vertex]
        frame = sphere.frame_of(normals[vertex])
        cast_probes(mesh, point, frame, reach, bundles, probed_out[vertex])
        blocked = vec()
        blocked_cosine = vec()
        for bundle in range(probed_out.shape[1]):
            hit = probed_out[vertex, bundle] != wp.uint8(0)
            same = agrees(bundles, probed_out[vertex], bundle)
            if hit or not same:
                for ray in range(bundles.first[bundle], bundles.first[bundle + 1]):
                    if ray > bundles.first[bundle] and not same:
                        hit = wp.mesh_query_ray_anyhit(mesh, point, frame * bundles.rays[ray], reach)
                    if hit:
                        blocked += weighted_basis[ray]
                        blocked_cosine += bundles.rays[ray][2] * weighted_basis[ray]
        blocked_out[vertex] = turn(blocked, frame, directions, direction_basis)
        blocked_cosine_out[vertex] = turn(blocked_cosine, frame, directions, direction_basis)

    return SimpleNamespace(
        vec=vec,
        project_coverage=project_coverage,
        project_radiance=project_radiance,
        project_blocked_hemisphere=project_blocked_hemisphere,
    )


@wp.func
def is_inside(
    mesh: wp.uint64, point: wp.vec3, rays: wp.array(dtype=wp.vec3), least_share: float, reach: float, nudge: float
) -> bool:
    """Whether at least `least_share` of the rays from a point leave more layers of solid than they enter."""
    leaving = wp.int32(0)
    needed = least_share * float(rays.shape[0])
    ray = wp.int32(0)
    # No further than until enough leave, or too few are left for that.
    while ray < rays.shape[0] and float(leaving) < needed and float(leaving + rays.shape[0] - ray) >= needed:
        walk = point
        left = wp.int32(0)
        crossed = wp.int32(0)
        while crossed < MOST_LAYERS:
            hit = wp.mesh_query_ray(mesh, walk, rays[ray], reach)
            if hit.result:
                left += wp.where(hit.sign < 0.0, 1, -1)
                walk += (hit.t + nudge) * rays[ray]
                crossed += 1
            else:
                crossed = MOST_LAYERS
        leaving += wp.where(left > 0, 1, 0)
        ray += 1
    return float(leaving) >= needed


@wp.kernel(enable_backward=False, module="unique")
def _leave_solid(
    first: int,
    mesh: wp.uint64,
    center: wp.vec3,
    reach: float,
    nudge: float,
    least_share: float,
    rays: wp.array(dtype=wp.vec3),  # (ray)
    points: wp.array(dtype=wp.vec3),  # (sample), moved out of the solid in place
    inside_out: wp.array(dtype=wp.int32),  # (sample)
):
    world, sample = wp.tid()
    sample += first
    point = points[sample]
    inside = is_inside(mesh, point, rays, least_share, reach, nudge)
    inside_out[sample] = wp.where(inside, 1, 0)
    outward = wp.normalize(point - center)
    crossed = wp.int32(0)
    # Behind a face there may be the inside of another part.
    while inside and crossed < MOST_LAYERS:
        hit = wp.mesh_query_ray(mesh, point, outward, reach)
        if hit.result:
            point += (hit.t + nudge) * outward
            crossed += 1
            inside = is_inside(mesh, point, rays, least_share, reach, nudge)
        else:
            crossed = MOST_LAYERS
    points[sample] = point


def leave_solid(
    mesh: wp.Mesh, center: np.ndarray, radius: float, closed: bool, points: np.ndarray, device: wp.Device
) -> tuple[np.ndarray, np.ndarray]:
    """Moves the points that lie inside the solid along their radius to just outside its surface.

    center, radius: the bounding sphere; closed: whether the mesh has an inside (see `LEAST_SHARE_OPEN`).
    Returns the moved points, float32 [N, 3], and which ones were inside, bool [N].
    """
    rays = wp.array(sphere.fibonacci_cap(RAYS_INSIDE_TEST, math.pi), dtype=wp.vec3, device=device)
    moved = wp.array(points, dtype=wp.vec3, device=device)
    inside = wp.zeros(len(points), dtype=wp.int32, device=device)
    nudge = SURFACE_OFFSET * radius
    least_share = LEAST_SHARE_CLOSED if closed else LEAST_SHARE_OPEN
    inputs = [mesh.id, wp.vec3(*map(float, center)), 4.0 * radius, nudge, least_share, rays, moved]
    launch(_leave_solid, (1, len(points)), inputs, [inside], device)
    return moved.numpy(), inside.numpy().astype(bool)


def rays_at(radii: float) -> int:
    """Rays per sample at a distance of `radii` bounding radii from the centre."""
    return [rays for start, rays in RAYS if radii >= start][-1]


def project_coverage(
    mesh: wp.Mesh,
    points: np.ndarray,
    axes: np.ndarray,
    half_angle: float,
    ray_count: int,
    order: int,
    device: wp.Device,
    face_radiance: np.ndarray | None = None,
    *,
    solid: bool = False,
) -> np.ndarray:
    """Coverage of the directions around points, projected on SH; float32 [N, order^2].

    points: float32 [N, 3] in the body's frame, metres; axes: unit vectors [N, 3], the axes of the cones of rays;
    half_angle: of the cones, radians; face_radiance: float [faces], if given, weights each covered direction with the
    radiance of the face seen there (front faces only). solid: whether the body has no sheets, so that rays may be left
    out between those that agree (see `bundles`).
    """
    kit = make_visibility(order)
    bundles = cap_bundles(ray_count, half_angle, solid)
    weighted = sh.evaluate(bundles.rays, order) * (2 * math.pi * (1 - math.cos(half_angle)) / ray_count)
    out = wp.zeros(len(points), dtype=kit.vec, device=device)
    reach = 4.0 * float(np.abs(points).max(initial=0.0) + np.abs(mesh.points.numpy()).max())
    samples = [wp.array(points, dtype=wp.vec3, device=device), wp.array(axes, dtype=wp.vec3, device=device), reach]
    rays, weights = bundles.upload(device), wp.array(weighted, dtype=kit.vec, device=device)
    tables = _rotation_tables(order, device)
    if face_radiance is None:
        bundle_basis = wp.array(np.add.reduceat(weighted, bundles.first[:-1]), dtype=kit.vec, device=device)
        probed = wp.empty((len(points), len(bundle_basis)), dtype=wp.uint8, device=device)
        inputs = [mesh.id, *samples, rays, weights, bundle_basis, *tables]
        launch(kit.project_coverage, (1, len(points)), inputs, [probed, out], device)
    else:
        radiance = wp.array(face_radiance, dtype=wp.float32, device=device)
        inputs = [mesh.id, radiance, *samples, rays.rays, weights, *tables]
        launch(kit.project_radiance, (1, len(points)), inputs, [out], device)
    return out.numpy()


def project_blocked_hemisphere(
    mesh: wp.Mesh,
    points: np.ndarray,
    normals: np.ndarray,
    ray_count: int,
    order: int,
    device: wp.Device,
    *,
    solid: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """What the body hides of the hemispheres about `normals` at `points` [N, 3] of its surface.

    solid: as in `project_coverage`.
    Returns two float32 [N, order^2]: the blocked part projected alone, and projected together with the cosine.
    """
    kit = make_visibility(order)
    bundles = cap_bundles(ray_count, math.pi / 2, solid)
    outs = [wp.zeros(len(points), dtype=kit.vec, device=device) for _ in range(2)]
    inputs = [
        mesh.id,
        wp.array(points, dtype=wp.vec3, device=device),
        wp.array(normals, dtype=wp.vec3, device=device),
        4.0 * float(np.abs(points).max()),
        bundles.upload(device),
        wp.array(sh.evaluate(bundles.rays, order) * (2 * math.pi / ray_count), dtype=kit.vec, device=device),
        *_rotation_tables(order, device),
    ]
    probed = wp.empty((len(points), len(bundles.beside)), dtype=wp.uint8, device=device)
    launch(kit.project_blocked_hemisphere, (1, len(points)), inputs, [probed, *outs], device)
    return outs[0].numpy(), outs[1].numpy()


def _rotation_tables(order: int, device: wp.Device) -> list[wp.array]:
    directions, weights = sphere.quadrature(ROTATION_POINTS[order])
    weighted = sh.evaluate(directions, order) * weights[:, None]
    vec = make_visibility(order).vec
    return [wp.array(directions, dtype=wp.vec3, device=device), wp.array(weighted, dtype=vec, device=device)]
