"""Everything that a body needs before it can cast and receive shadows."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import warp as wp

from warp_psf.bake import visibility
from warp_psf.bake.adapt import ERROR_THRESHOLD, fit_shell
from warp_psf.bake.kept import BakedBody, load_body, save_body
from warp_psf.bake.shape import shape_key, unit_shape
from warp_psf.bake.shell import fill_shell
from warp_psf.bake.transfer import bake_transfer
from warp_psf.device import find_device
from warp_psf.field.shells import (
    FINEST_RESOLUTION,
    FIRST_OUTER_SHELL,
    SHELL_COUNT,
    SHELL_SPACING,
    ShadowField,
    quantise,
    sample_directions,
    shell_radii,
)
from warp_psf.scene.mesh import Mesh

# Raised whenever the same settings would give other numbers, so that older files on disk are not used.
BAKE_VERSION = 5
ORDERS = range(2, 7)
# Samples that left the solid at points this close, in bounding radii, left it at the same point.
SAME_POINT = 1.0e-5
Progress = Callable[[float], None]
Project = Callable[[int, np.ndarray, np.ndarray], np.ndarray]


def bake_mesh(
    mesh: Mesh,
    order: int = 4,
    *,
    threshold: float | None = ERROR_THRESHOLD,
    device: str | None = None,
    progress: Progress | None = None,
    use_cache: bool = True,
) -> BakedBody:
    """Bakes a body's occlusion field and self-shadowed transfer, or reads them from the cache on disk.

    A `Renderer` does this by itself. Boxes, rectangles and spheres have closed forms, and need nothing.

    ```python
    baked = psf.bake_mesh(psf.load_mesh("mesh.obj"), order=2)
    size = baked.field.nbytes  # bytes
    ```

    Args:
        mesh: the body's shape.
        order: SH bands, 2 to 6.
        threshold: of Tamura 2006, Equation 1, at least 0; None keeps every sample.
        device: "cpu", "cuda:0", ...; None takes the first CUDA device, else the CPU.
        progress: called with the finished share, 0 to 1.
        use_cache: False neither reads nor writes the cache.

    Raises:
        ValueError: the order or the threshold is out of range, or there is no such device.
    """
    check_settings(mesh, order, threshold)
    report = progress or (lambda share: None)
    if mesh.slab is not None or mesh.sphere is not None:
        report(1.0)
        return BakedBody(None, None, None)
    settings = {"bake": BAKE_VERSION, "kind": "body", "order": order, "threshold": threshold}
    settings |= {"convex": mesh.convex, "closed": mesh.closed}
    unit = unit_shape(mesh)
    key = shape_key(settings, unit)
    body = load_body(key, unit, order, has_transfer=not mesh.convex) if use_cache else None
    if body is None:
        on_device = find_device(device)
        warp_mesh = upload_mesh(unit, on_device)
        transfer, self_visibility = None, None
        if not mesh.convex:
            transfer, self_visibility = bake_transfer(unit, warp_mesh, order, on_device)
        report(0.1)
        # The last step is reported once the result is kept.
        field = bake_field(unit, warp_mesh, order, threshold, on_device, lambda share: report(0.1 + 0.89 * share))
        body = BakedBody(field, transfer, self_visibility)
        if use_cache:
            save_body(key, unit, body)
    report(1.0)
    return BakedBody(_place(body.field, mesh), body.transfer, body.visibility)


def _place(field: ShadowField | None, mesh: Mesh) -> ShadowField | None:
    """The field of a unit shape where the mesh has it."""
    return field and replace(field, center=mesh.center.astype(np.float32), radius=float(mesh.radius))


def bake_radiance_field(
    mesh: Mesh, face_radiance: np.ndarray, order: int = 4, *, device: str | None = None, use_cache: bool = True
) -> ShadowField:
    """Bakes the source radiance field of a luminous mesh, or reads it from the cache.

    face_radiance: radiance that leaves the front of each face, relative to the light's own, float [faces].

    Raises:
        ValueError: the order is out of range, or the radiance is not one finite number, at least 0, per face.
    """
    check_settings(mesh, order, ERROR_THRESHOLD)
    settings = {"bake": BAKE_VERSION, "kind": "radiance", "order": order, "threshold": ERROR_THRESHOLD}
    settings["closed"] = mesh.closed
    radiance = np.ascontiguousarray(face_radiance, np.float32)
    if radiance.shape != (len(mesh.faces),) or not (np.isfinite(radiance) & (radiance >= 0)).all():
        raise ValueError(
            f"mesh {mesh.name!r}: its radiance has the shape {list(radiance.shape)}; "
            f"give {len(mesh.faces)} finite numbers of at least 0, one per face"
        )
    unit = unit_shape(mesh)
    key = shape_key(settings, unit, radiance)
    body = load_body(key, unit, order, has_transfer=False) if use_cache else None
    if body is None:
        on_device = find_device(device)
        warp_mesh = upload_mesh(unit, on_device)
        field = bake_field(unit, warp_mesh, order, ERROR_THRESHOLD, on_device, lambda share: None, radiance)
        body = BakedBody(field, None, None)
        if use_cache:
            save_body(key, unit, body)
    return _place(body.field, mesh)


def bake_field(
    mesh: Mesh,
    warp_mesh: wp.Mesh,
    order: int,
    threshold: float | None,
    device: wp.Device,
    report: Progress,
    face_radiance: np.ndarray | None = None,
) -> ShadowField:
    """Samples every shell, reduces each of them and quantises it."""

    def project(shell: int, points: np.ndarray, outward: np.ndarray) -> np.ndarray:
        return _project(mesh, warp_mesh, shell, points, outward, order, device, face_radiance)

    shells, inside = sample_shells(mesh, warp_mesh, SHELL_COUNT, FINEST_RESOLUTION, project, device, report)
    if threshold is not None:
        shells = [fit_shell(vectors, threshold, can_be_read(inside, shell)) for shell, vectors in enumerate(shells)]
    return quantise(mesh.center, mesh.radius, shells)


def sample_shells(
    mesh: Mesh,
    warp_mesh: wp.Mesh,
    count: int,
    resolution: int,
    project: Project,
    device: wp.Device,
    report: Progress,
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """The vectors of `count` shells, each float32 [R, R, K], and which samples lie inside the solid, each bool [R, R].

    A sample inside the solid would be covered all around and darken receivers outside. It is moved along its radius
    to the surface instead, where it tells what the nearest receivers outside see. Where the next shell's sample went
    to the same point, or nobody can read the sample, the next shell's vector is taken over.

    project: gives the vectors, float32 [N, K], of a shell at points [N, 3] whose directions from the centre are known,
    [N, 3]: called as project(shell, points, outward). report: called with the share of the shells that are done.
    """
    grid = (resolution, resolution)
    outward = sample_directions(resolution).reshape(-1, 3)
    places = [_sample_points(mesh, shell, resolution)[0] for shell in range(count)]
    inside = [np.zeros(grid, bool) for _ in places]
    inner = FIRST_OUTER_SHELL + 1
    for shell in range(inner):
        moved = visibility.leave_solid(warp_mesh, mesh.center, mesh.radius, mesh.closed, places[shell], device)
        places[shell], inside[shell] = moved[0], moved[1].reshape(grid)
    found: dict[int, np.ndarray] = {}
    for shell in [*reversed(range(inner)), *range(inner, count)]:
        known, vectors = np.zeros(grid, bool), None
        if shell < inner - 1:
            apart = np.linalg.norm(places[shell] - places[shell + 1], axis=1).reshape(grid)
            known = inside[shell] & (apart < SAME_POINT * mesh.radius) | ~can_be_read(inside, shell)
            vectors = found[shell + 1].copy()

        def cast(chosen: np.ndarray, shell: int = shell) -> np.ndarray:
            return project(shell, places[shell][chosen], outward[chosen])

        found[shell] = fill_shell(vectors, known, inside[shell], SHELL_SPACING * (1 + shell), cast)
        report(len(found) / count)
    return [found[shell] for shell in range(count)], inside


def _sample_points(mesh: Mesh, shell: int, resolution: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    """A shell's samples in the body's frame, float32 [samples, 3], and their directions from the centre, float64."""
    outward = sample_directions(resolution or FINEST_RESOLUTION).reshape(-1, 3)
    return (mesh.center + shell_radii(mesh.radius)[shell] * outward).astype(np.float32), outward


def _project(
    mesh: Mesh,
    warp_mesh: wp.Mesh,
    shell: int,
    points: np.ndarray,
    outward: np.ndarray,
    order: int,
    device: wp.Device,
    face_radiance: np.ndarray | None,
) -> np.ndarray:
    """The vectors at points of a shell, float32 [N, coefficients], with the rays that its distance asks for."""
    half_angle, rays = cone_of_shell(shell)
    axes = (-outward).astype(np.float32)
    # Outside the bounding sphere the body fills a part of the cone, and most bundles would lie at its edge.
    solid = mesh.closed and half_angle == math.pi
    return visibility.project_coverage(
        warp_mesh, points, axes, half_angle, rays, order, device, face_radiance, solid=solid
    )


def cone_of_shell(shell: int) -> tuple[float, int]:
    """The half angle, radians, of the cone that holds the bounding sphere, and the rays that the distance asks for."""
    radii = SHELL_SPACING * (1 + shell)
    half_angle = math.pi
    if radii >= 1.0:
        # A little wider than the bounding sphere, whose radius is exact to float32 only.
        half_angle = min(1.001 * math.asin(1 / radii), math.pi / 2)
    return half_angle, visibility.rays_at(radii)


def can_be_read(inside: list[np.ndarray], shell: int) -> np.ndarray:
    """Which samples of a shell a receiver outside the solid can read.

    A sample deep inside cannot: it, its neighbours and those on the next shells are all within the solid.
    """
    open_nearby = np.zeros_like(inside[shell])
    for neighbour in range(max(shell - 1, 0), min(shell + 2, len(inside))):
        outside = ~inside[neighbour]
        for step in (-1, 0, 1):
            rows = np.roll(outside, step, axis=1)
            open_nearby |= rows
            open_nearby[1:] |= rows[:-1]
            open_nearby[:-1] |= rows[1:]
    return open_nearby


def upload_mesh(mesh: Mesh, device: wp.Device) -> wp.Mesh:
    """The mesh with its ray-query tree on the device."""
    return wp.Mesh(
        points=wp.array(mesh.vertices, dtype=wp.vec3, device=device),
        indices=wp.array(mesh.faces.reshape(-1), dtype=wp.int32, device=device),
    )


def check_settings(mesh: Mesh, order: int, threshold: float | None) -> None:
    """Refuses an order or a threshold that nothing can be baked with."""
    if order not in ORDERS:
        raise ValueError(f"mesh {mesh.name!r}: cannot bake order {order}; choose 2 to 6 spherical-harmonics bands")
    if threshold is not None and not threshold >= 0:
        raise ValueError(f"mesh {mesh.name!r}: the threshold is {threshold}; give a number of at least 0, or None")
