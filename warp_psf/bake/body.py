"""Everything that a body needs before it can cast and receive shadows."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_psf.bake import visibility
from warp_psf.bake.adapt import ERROR_THRESHOLD, reduce_shell
from warp_psf.bake.transfer import bake_transfer
from warp_psf.device import find_device
from warp_psf.field.shells import (
    FINEST_RESOLUTION,
    SHELL_COUNT,
    SHELL_SPACING,
    ShadowField,
    quantise,
    sample_directions,
    shell_radii,
)
from warp_psf.field.store import load_arrays, save_arrays, store_key
from warp_psf.scene.mesh import Mesh

# Raised whenever the same settings would give other numbers, so that older files on disk are not used.
BAKE_VERSION = 1
Progress = Callable[[float], None]


@dataclass(frozen=True)
class BakedBody:
    """What is precomputed of a mesh.

    field: its object occlusion field, or None where visibility has a closed form (boxes, rectangles, spheres).
    transfer: self-visibility times cosine per vertex, on SH, float32 [vertices, coefficients], in the body's frame;
        None for convex bodies, which do not shadow themselves.
    visibility: self-visibility alone (zero below the horizon), likewise.
    """

    field: ShadowField | None
    transfer: np.ndarray | None
    visibility: np.ndarray | None


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
    """
    needs_field = mesh.slab is None and mesh.sphere is None
    if not needs_field and mesh.convex:
        return BakedBody(None, None, None)
    settings = {"bake": BAKE_VERSION, "kind": "body", "order": order, "threshold": threshold}
    key = store_key(settings, mesh.vertices, mesh.faces, mesh.normals)
    stored = load_arrays(key) if use_cache else None
    body = None if stored is None else _unpack(stored)
    if body is None:
        report = progress or (lambda share: None)
        on_device = find_device(device)
        warp_mesh = upload_mesh(mesh, on_device)
        transfer, self_visibility = None, None
        if not mesh.convex:
            transfer, self_visibility = bake_transfer(mesh, warp_mesh, order, on_device)
        report(0.1)
        field = None
        if needs_field:
            field = bake_field(mesh, warp_mesh, order, threshold, on_device, lambda share: report(0.1 + 0.9 * share))
        body = BakedBody(field, transfer, self_visibility)
        if use_cache:
            save_arrays(key, _pack(body))
    if progress is not None:
        progress(1.0)
    return body


def bake_radiance_field(
    mesh: Mesh, face_radiance: np.ndarray, order: int = 4, *, device: str | None = None, use_cache: bool = True
) -> ShadowField:
    """Bakes the source radiance field of a luminous mesh, or reads it from the cache.

    face_radiance: radiance that leaves the front of each face, relative to the light's own, float [faces].
    """
    settings = {"bake": BAKE_VERSION, "kind": "radiance", "order": order, "threshold": ERROR_THRESHOLD}
    radiance = np.ascontiguousarray(face_radiance, np.float32)
    key = store_key(settings, mesh.vertices, mesh.faces, radiance)
    stored = load_arrays(key) if use_cache else None
    body = None if stored is None else _unpack(stored)
    if body is not None and body.field is not None:
        return body.field
    on_device = find_device(device)
    warp_mesh = upload_mesh(mesh, on_device)
    field = bake_field(mesh, warp_mesh, order, ERROR_THRESHOLD, on_device, lambda share: None, radiance)
    if use_cache:
        save_arrays(key, _pack(BakedBody(field, None, None)))
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
    """Samples every shell, moves samples out of the solid, reduces each shell and quantises it."""
    shells, inside = [], []
    for shell in range(SHELL_COUNT):
        vectors, within = bake_shell(mesh, warp_mesh, shell, FINEST_RESOLUTION, order, device, face_radiance)
        shells.append(vectors)
        inside.append(within)
        report((shell + 1) / SHELL_COUNT)
    if threshold is not None:
        shells = [
            reduce_shell(vectors, threshold, can_be_read(inside, shell)) for shell, vectors in enumerate(shells)
        ]
    return quantise(mesh.center, mesh.radius, shells)


def bake_shell(
    mesh: Mesh,
    warp_mesh: wp.Mesh,
    shell: int,
    resolution: int,
    order: int,
    device: wp.Device,
    face_radiance: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """One shell's vectors, float32 [resolution, resolution, coefficients], and which samples lie inside the solid.

    A sample inside the solid would be covered all around and darken receivers outside. It is moved along its radius
    to the surface instead, where it tells what the nearest receivers outside see.
    """
    outward = sample_directions(resolution).reshape(-1, 3)
    distance = shell_radii(mesh.radius)[shell]
    points = (mesh.center + distance * outward).astype(np.float32)
    inside = np.zeros(len(points), bool)
    radii = SHELL_SPACING * (1 + shell)
    if radii <= 1.0 + 1e-6:
        points, inside = visibility.leave_solid(warp_mesh, mesh.center, mesh.radius, points, device)
        half_angle, rays = math.pi, visibility.RAYS_INSIDE
    else:
        # A little wider than the bounding sphere, whose radius is exact to float32 only.
        half_angle = min(math.asin(1 / radii) * 1.001, math.pi / 2)
        rays = visibility.RAYS_NEAR if radii < visibility.FAR_RADII else visibility.RAYS_FAR
    vectors = visibility.project_coverage(
        warp_mesh, points, (-outward).astype(np.float32), half_angle, rays, order, device, face_radiance
    )
    return vectors.reshape(resolution, resolution, -1), inside.reshape(resolution, resolution)


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


def _pack(body: BakedBody) -> dict[str, np.ndarray]:
    arrays: dict[str, np.ndarray] = {}
    if body.field is not None:
        field = body.field
        arrays |= {
            "center": field.center,
            "radius": np.array(field.radius),
            "resolutions": field.resolutions,
            "codes": field.codes,
            "minimum": field.minimum,
            "step": field.step,
        }
    if body.transfer is not None and body.visibility is not None:
        arrays |= {"transfer": body.transfer, "visibility": body.visibility}
    return arrays


def _unpack(arrays: dict[str, np.ndarray]) -> BakedBody | None:
    field = None
    if "codes" in arrays:
        field = ShadowField(
            arrays["center"],
            float(arrays["radius"]),
            arrays["resolutions"],
            arrays["codes"],
            arrays["minimum"],
            arrays["step"],
        )
    return BakedBody(field, arrays.get("transfer"), arrays.get("visibility"))
