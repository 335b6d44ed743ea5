"""Everything that a body needs before it can cast and receive shadows."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_psf.bake import visibility
from warp_psf.bake.adapt import ERROR_THRESHOLD, reduce_shell
from warp_psf.bake.kept import BakedBody, load_body, save_body
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
from warp_psf.field.store import store_key
from warp_psf.scene.mesh import Mesh

# Raised whenever the same settings would give other numbers, so that older files on disk are not used.
BAKE_VERSION = 3
ORDERS = range(2, 7)
# Samples that left the solid at points this close, in bounding radii, left it at the same point.
SAME_POINT = 1.0e-5
Progress = Callable[[float], None]
Project = Callable[[np.ndarray, np.ndarray], np.ndarray]


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

    order: SH bands, 2 to 6. threshold: of Tamura 2006, Equation 1; None keeps every sample. progress: called with the
    finished share, 0 to 1. use_cache: False neither reads nor writes the cache.

    Raises:
        ValueError: the order or the threshold is out of range.
    """
    check_settings(mesh, order, threshold)
    report = progress or (lambda share: None)
    if mesh.slab is not None or mesh.sphere is not None:
        report(1.0)
        return BakedBody(None, None, None)
    settings = {"bake": BAKE_VERSION, "kind": "body", "order": order, "threshold": threshold}
    settings |= {"convex": mesh.convex, "closed": mesh.closed}
    key = store_key(settings, mesh.vertices, mesh.faces, mesh.normals)
    body = load_body(key, mesh, order, has_transfer=not mesh.convex) if use_cache else None
    if body is None:
        on_device = find_device(device)
        warp_mesh = upload_mesh(mesh, on_device)
        transfer, self_visibility = None, None
        if not mesh.convex:
            transfer, self_visibility = bake_transfer(mesh, warp_mesh, order, on_device)
        report(0.1)
        # The last step is reported once the result is kept.
        field = bake_field(mesh, warp_mesh, order, threshold, on_device, lambda share: report(0.1 + 0.89 * share))
        body = BakedBody(field, transfer, self_visibility)
        if use_cache:
            save_body(key, body)
    report(1.0)
    return body


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
    key = store_key(settings, mesh.vertices, mesh.faces, radiance)
    body = load_body(key, mesh, order, has_transfer=False) if use_cache else None
    if body is not None and body.field is not None:
        return body.field
    on_device = find_device(device)
    warp_mesh = upload_mesh(mesh, on_device)
    field = bake_field(mesh, warp_mesh, order, ERROR_THRESHOLD, on_device, lambda share: None, radiance)
    if use_cache:
        save_body(key, BakedBody(field, None, None))
    return field


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
    inner: list[InnerShell] = []
    for shell in reversed(range(FIRST_OUTER_SHELL + 1)):
        inner.insert(0, _bake_inner_shell(mesh, warp_mesh, shell, order, device, face_radiance, inner[:1]))
        report(len(inner) / SHELL_COUNT)
    shells, inside = [samples.vectors for samples in inner], [samples.inside for samples in inner]
    for shell in range(FIRST_OUTER_SHELL + 1, SHELL_COUNT):
        points, outward = _sample_points(mesh, shell)
        shells.append(_project(mesh, warp_mesh, shell, points, outward, order, device, face_radiance))
        inside.append(np.zeros(len(points), bool))
        report(len(shells) / SHELL_COUNT)
    grid = (FINEST_RESOLUTION, FINEST_RESOLUTION)
    shells = [vectors.reshape(*grid, -1) for vectors in shells]
    if threshold is not None:
        inside = [within.reshape(grid) for within in inside]
        shells = [reduce_shell(vectors, threshold, can_be_read(inside, shell)) for shell, vectors in enumerate(shells)]
    return quantise(mesh.center, mesh.radius, shells)


@dataclass(frozen=True)
class InnerShell:
    """A shell no larger than the bounding sphere.

    points: where each sample was taken, float32 [samples, 3]; inside: which ones had to leave the solid for that;
    vectors: float32 [samples, coefficients].
    """

    points: np.ndarray
    inside: np.ndarray
    vectors: np.ndarray


def _bake_inner_shell(
    mesh: Mesh,
    warp_mesh: wp.Mesh,
    shell: int,
    order: int,
    device: wp.Device,
    face_radiance: np.ndarray | None,
    next_shell: list[InnerShell],
) -> InnerShell:
    """Samples a shell of an occlusion or source radiance field (see `sample_inner_shell`)."""

    def project(points: np.ndarray, outward: np.ndarray) -> np.ndarray:
        return _project(mesh, warp_mesh, shell, points, outward, order, device, face_radiance)

    return sample_inner_shell(mesh, warp_mesh, shell, FINEST_RESOLUTION, project, device, next_shell)


def sample_inner_shell(
    mesh: Mesh,
    warp_mesh: wp.Mesh,
    shell: int,
    resolution: int,
    project: Project,
    device: wp.Device,
    next_shell: list[InnerShell],
) -> InnerShell:
    """Samples a shell whose samples may lie inside the solid; `next_shell` holds the one around it, if it has one.

    A sample inside the solid would be covered all around and darken receivers outside. It is moved along its radius
    to the surface instead, where it tells what the nearest receivers outside see. Where the next shell's sample went
    to the same point, its vector is taken over.

    project: gives the vectors, float32 [N, K], at points [N, 3] whose directions from the centre are known, [N, 3].
    """
    points, outward = _sample_points(mesh, shell, resolution)
    points, inside = visibility.leave_solid(warp_mesh, mesh.center, mesh.radius, mesh.closed, points, device)
    known = np.zeros(len(points), bool)
    if next_shell:
        apart = np.linalg.norm(points - next_shell[0].points, axis=1)
        known = inside & (apart < SAME_POINT * mesh.radius)
    projected = project(points[~known], outward[~known])
    vectors = np.empty((len(points), projected.shape[1]), np.float32)
    vectors[~known] = projected
    if next_shell:
        vectors[known] = next_shell[0].vectors[known]
    return InnerShell(points, inside, vectors)


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
    return visibility.project_coverage(warp_mesh, points, axes, half_angle, rays, order, device, face_radiance)


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
