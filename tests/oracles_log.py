"""A plane under a set of spheres, as in the supplement to Ren 2006: visibility by products and by every exponential."""

import math
import time
from dataclasses import dataclass
from functools import cache

import numpy as np
import warp as wp

from warp_psf.bake.spheres import fit_spheres
from warp_psf.basis import sh, sh_exp
from warp_psf.device import find_device, launch
from warp_psf.scene.mesh import Mesh, make_mesh

# name: (kind, degree); see `_make_methods`
METHODS = {
    "TRIP": (0, 0),
    "PS*-9": (1, 9),
    "PS*-2": (1, 2),
    "HYB": (2, 0),
    "OL": (3, 0),
    "ours": (4, 0),
    # After DC isolation, which the supplement's figures speak for; PS-2 of the bare vectors is off by 1 and more.
    "PS-2": (5, 2),
    "PS-3": (5, 3),
    "PS-4": (5, 4),
    "PS-21": (5, 21),
    "PS-30": (5, 30),
}


@dataclass(frozen=True, eq=False)
class Plane:
    """Receivers [R, 3] on a plane z = 0 under spheres: centres [n, 3] and radii [n].

    order_of: per receiver the spheres from the nearest to the farthest, int32 [R, n].
    """

    receivers: np.ndarray
    center: np.ndarray
    radius: np.ndarray
    order_of: np.ndarray


def stand_spheres(mesh: Mesh, count: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Spheres of a mesh whose y points up, turned to z up over the origin, on z = 0, and the mesh's longest side."""
    turned = make_mesh(mesh.name, mesh.vertices @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]], np.float32), mesh.faces)
    fit = fit_spheres(turned, count)
    low, high = turned.vertices.min(axis=0), turned.vertices.max(axis=0)
    foot = np.array([*(low + high)[:2] / 2, low[2]])
    return fit.center - foot, fit.radius, float((high - low).max())


def make_plane(center: np.ndarray, radius: np.ndarray, side: float, resolution: int) -> Plane:
    """resolution x resolution receivers on a square of `side` metres about the origin."""
    at = side * ((np.arange(resolution) + 0.5) / resolution - 0.5)
    receivers = np.stack([*np.meshgrid(at, at), np.zeros((resolution, resolution))], axis=-1).reshape(-1, 3)
    distance = np.linalg.norm(center[None] - receivers[:, None], axis=-1)
    return Plane(receivers, center, radius, np.argsort(distance, axis=1, kind="stable").astype(np.int32))


@cache
def _make_methods(order: int):
    kit = sh_exp.make_sh_exp(order)
    functions = sh.make_sh(order)
    vec, ExpTable = kit.vec, kit.ExpTable
    profile = wp.types.vector(order, wp.float32)
    unit = vec(*sh_exp.one(order))
    nine, two = sh_exp.series_norm(9), sh_exp.series_norm(2)

    @wp.func
    def cap(sine: float, axis: wp.vec3) -> vec:
        # The recurrence of sh.cap.
        z = wp.sqrt(wp.max(1.0 - sine * sine, 0.0))
        bands = profile()
        bands[0] = wp.static(2.0 * math.pi) * sine * sine / (1.0 + z) * wp.static(math.sqrt(1.0 / (4.0 * math.pi)))
        before = float(1.0)
        now = z
        slope_before = float(0.0)
        slope = float(1.0)
        for band in range(1, wp.static(order)):
            n = float(band)
            bands[band] = wp.static(2.0 * math.pi) * sine * sine * slope / (n * (n + 1.0))
            bands[band] *= wp.sqrt((2.0 * n + 1.0) / wp.static(4.0 * math.pi))
            slope_after = slope_before + (2.0 * n + 1.0) * now
            after = ((2.0 * n + 1.0) * z * now - n * before) / (n + 1.0)
            slope_before = slope
            slope = slope_after
            before = now
            now = after
        for band in range(wp.static(order)):
            bands[band] *= wp.sqrt(wp.static(4.0 * math.pi) / (2.0 * float(band) + 1.0))
        return functions.zonal(bands, axis)

    @wp.kernel(enable_backward=False, module="unique")
    def compose(
        first: int,
        kind: int,
        degree: int,
        receivers: wp.array(dtype=wp.vec3),
        center: wp.array(dtype=wp.vec3),
        radius: wp.array(dtype=wp.float32),
        order_of: wp.array2d(dtype=wp.int32),
        table: wp.array(dtype=ExpTable),
        logarithm_out: wp.array(dtype=vec),
        visible_out: wp.array(dtype=vec),
    ):
        world, item = wp.tid()
        item += first
        p = receivers[item]
        visible = vec(wp.static(unit))
        f = vec()
        for place in range(center.shape[0]):
            sphere = place
            if kind == 0:
                sphere = order_of[item, place]
            offset = center[sphere] - p
            distance = wp.max(wp.length(offset), 1.0e-9)
            sine = wp.min(radius[sphere] / distance, 1.0)
            if offset[2] > -radius[sphere]:
                if kind == 0:
                    visible = kit.product(visible, wp.static(unit) - cap(sine, offset / distance), table)
                else:
                    f += kit.cap_logarithm(offset / distance, sine, table)
        if kind == 1:
            largest = wp.where(degree == 9, wp.static(nine), wp.static(two))
            visible = kit.scaled_power_series(f, degree, largest, table)
        elif kind == 2:
            visible = kit.hybrid(f, table)
        elif kind == 3:
            visible = kit.optimal_linear(f, table)
        elif kind == 4:
            visible = kit.exponential(f, table)
        elif kind == 5:
            rest = vec(f)
            rest[0] = 0.0
            scale = wp.exp(f[0] * wp.static(1.0 / math.sqrt(4.0 * math.pi)))
            visible = scale * kit.power_series(rest, degree, table)
        logarithm_out[item] = f
        visible_out[item] = visible

    return compose


def run_method(plane: Plane, method: str, order: int, repeats: int = 3) -> tuple[np.ndarray, np.ndarray, float]:
    """Visibility vectors [R, n*n] of the plane's receivers, the sums of logarithms, and the best of the times, s."""
    device = find_device()
    vec = sh_exp.make_sh_exp(order).vec
    kind, degree = METHODS[method]
    outs = [wp.zeros(len(plane.receivers), dtype=vec, device=device) for _ in range(2)]
    inputs = [
        kind,
        degree,
        wp.array(plane.receivers, dtype=wp.vec3, device=device),
        wp.array(plane.center, dtype=wp.vec3, device=device),
        wp.array(plane.radius, dtype=wp.float32, device=device),
        wp.array(plane.order_of, dtype=wp.int32, device=device),
        sh_exp.upload_exponential(order, device),
    ]
    seconds = []
    for _ in range(repeats + 1):  # the first one compiles
        start = time.perf_counter()
        launch(_make_methods(order), (1, len(plane.receivers)), inputs, outs, device)
        seconds.append(time.perf_counter() - start)
    return outs[1].numpy(), outs[0].numpy(), min(seconds[1:])


def count_products(plane: Plane, method: str, logarithms: np.ndarray) -> tuple[int, int]:
    """How many squares and how many other products a method forms on the plane."""
    kind, degree = METHODS[method]
    receivers = len(logarithms)
    rest = sh_exp.isolate(logarithms)[1]
    if kind == 0:
        return 0, int((plane.center[:, 2] > -plane.radius).sum()) * receivers
    if kind == 1:
        return int(sh_exp.count_squarings(rest, sh_exp.series_norm(degree)).sum()), (degree - 1) * receivers
    if kind == 2:
        return int(sh_exp.count_squarings(rest, sh_exp.LINEAR_NORM).sum()), 0
    if kind == 4:
        return int(sh_exp.count_squarings(rest, sh_exp.series_norm(sh_exp.SAMPLED_DEGREE)).sum()), 0
    return 0, (degree - 1) * receivers if kind == 5 else 0


def log_sum(plane: Plane, order: int, inversion: bool) -> np.ndarray:
    """The receivers' sums of logarithms [R, n*n], by inversion or by integration (supplement, figures 1 and 2)."""
    offset = plane.center[None] - plane.receivers[:, None]
    distance = np.linalg.norm(offset, axis=-1)
    angle = np.arcsin(np.clip(plane.radius / distance, 0, 1))
    table_angle = np.linspace(1e-3, np.pi / 2, 400)
    if inversion:
        profiles = sh_exp.cap_logarithm(table_angle, order)
    else:
        up = np.broadcast_to((0.0, 0.0, 1.0), (400, 3))
        visible = sh_exp.one(order) - sh.zonal(sh.cap(table_angle, order), up)
        band = np.arange(order)
        profiles = sh_exp.logarithm_by_integration(visible)[:, band * (band + 1)]
    profile = np.stack([np.interp(angle, table_angle, profiles[:, band]) for band in range(order)], axis=-1)
    logarithms = sh.zonal(profile, offset / distance[..., None])
    return np.where((offset[..., 2] > -plane.radius)[..., None], logarithms, 0.0).sum(axis=1)


def light_times_cosine(environment: np.ndarray, order: int) -> np.ndarray:
    """L * H(N) for N = +z, [3, n*n], from radiance [n*n, 3]: what shading multiplies visibility with."""
    directions, weights = sh.sphere.gauss_quadrature(12 * order)
    basis = sh.evaluate(directions, order)
    received = (basis @ environment[: order * order]) * np.maximum(directions[:, 2:], 0.0)
    return received.T @ (weights[:, None] * basis)
