"""Basis radiance: a body as a source of the light that it reflects (Iwasaki 2007, sections 4.2, 4.3 and 5.2).

The radiance of a Lambert body is a function on its surface. Whatever lights it, that function is nearly a sum of a few
basis functions, found by principal component analysis of the body lit by many point lights. What each basis function
sends to the points around the body, and to the body itself, is cast once. Reflectance has no part in it: the same bake
serves every colour.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import warp as wp

from warp_psf.bake import gather, visibility
from warp_psf.bake.adapt import reduce_shell
from warp_psf.bake.body import (
    Progress,
    can_be_read,
    check_settings,
    cone_of_shell,
    sample_shells,
    upload_mesh,
)
from warp_psf.bake.kept import load_radiance, save_radiance
from warp_psf.bake.shape import shape_key, unit_shape
from warp_psf.bake.transfer import VERTEX_OFFSET
from warp_psf.basis import sh, sphere
from warp_psf.device import find_device
from warp_psf.field.radiance import (
    FINEST_RADIANCE_RESOLUTION,
    FUNCTION_COUNTS,
    RADIANCE_SHELLS,
    BasisRadianceField,
)
from warp_psf.field.shells import FIRST_OUTER_SHELL, quantise
from warp_psf.scene.mesh import Mesh
from warp_psf.scene.topology import area_vectors

# Raised whenever the same settings would give other numbers, so that older files on disk are not used.
RADIANCE_VERSION = 6
# Of Equation 1, for the worst function of a shell. Twice that saves a quarter of the bytes and makes the light of a
# tenpin or a teapot beyond 2 radii 1 to 2 % too weak.
RADIANCE_THRESHOLD = 0.01
# Iwasaki 2007, section 4.2.
LIGHTS = 256
# How far the lights stand from the centre, in bounding radii. On the bounding sphere itself, where the paper puts them,
# a surface that reaches it is lit without end, and a ball's own surface not at all. From twice as far, 16 functions of
# a tenpin, a teapot and a ball leave less of the light of others unrepresented: 9, 15 and 23 % under lights at 1.6 to 3
# radii in place of 29, 29 and 28 % (RMS), 12, 19 and 7 % at 10 radii in place of 31, 28 and 14 %.
LIGHT_DISTANCE = 2.0
# A vertex is dark that gets less than this share of the mean irradiance from the lights outside.
DARK_LEVEL = 0.01
# Where more than this share of the area is dark (the inside of a hollow body), lights are placed there as well.
DARK_SHARE = 0.01
# Reflections of a body onto itself that its functions are to represent: the default number of bounces, less one.
ECHOES = 2
# How much more an echo counts than light from outside: it is weaker, and passed on by every further bounce. The third
# bounce within a mug has 0.67 of its energy when the gain is 4, and 0.94 when it is 10.
ECHO_GAIN = 10.0
# At least so many: a small cavity has several sides, too.
FEWEST_INNER_LIGHTS = 16
# They stand off the surface by this many bounding radii, but no farther than the middle of what is free.
INNER_LIGHT_HEIGHT = 0.25
# A singular value below this share of the first is float32's rounding of the irradiance; its function is left zero.
LEAST_SINGULAR_VALUE = 1.0e-4
# Points whose light is followed: more than the 32 functions ask for, few enough to shade in every frame.
MOST_PROXIES = 256
# How far apart opposite normals keep two points of the same place, in bounding radii: the sides of a thin body are
# lit by different things.
NORMAL_DISTANCE = 1.0
# Added to the diagonal of the least squares, as a share of its mean. It keeps functions that vanish at the proxies (or
# everywhere) at weight zero and leaves the others' weights as they are.
RIDGE = 1.0e-4
# Rays for a vertex' irradiance by its own body, spread as the cosine: each carries the same share.
SELF_RAYS = 512


@dataclass(frozen=True)
class BakedRadiance:
    """A body as a source of reflected light.

    basis: the functions at the vertices, float32 [vertices, N]: the mean, then the singular vectors. The mean's mean
        over the area is 1; the others are scaled to the weights that they have in the light they were found from.
    areas: a third of the faces around each vertex, m^2, float32 [vertices].
    proxies: vertices in the order of a farthest-point search over surface and normals, int32 [at most 256].
    field: what the functions send to the points around the body.
    self_irradiance: the irradiance at each vertex that each function on the body itself causes, float32 [vertices, N];
        None for convex bodies.
    """

    basis: np.ndarray
    areas: np.ndarray
    proxies: np.ndarray
    field: BasisRadianceField
    self_irradiance: np.ndarray | None
    _features: np.ndarray

    def solver(self, count: int) -> np.ndarray:
        """The weights of the functions from values at the first `count` proxies: a matrix float32 [N, count].

        The weights minimise the squared difference to the values, each of which stands for the area of the vertices
        nearest to its proxy (Iwasaki 2007, Equation 14).

        Raises:
            ValueError: there are fewer proxies, or `count` is not positive.
        """
        if not 0 < count <= len(self.proxies):
            raise ValueError(f"there are {len(self.proxies)} proxies, not {count}; ask for 1 to {len(self.proxies)}")
        chosen = self.proxies[:count]
        nearest = _nearest(self._features, self._features[chosen])
        share = np.bincount(nearest, self.areas * self.basis.any(axis=1), minlength=count) / self.areas.sum()
        basis = self.basis[chosen].astype(np.float64)
        normal = basis.T @ (share[:, None] * basis)
        # The trace is zero only where every function vanishes at every proxy: any ridge then gives zero weights.
        ridge = RIDGE * np.trace(normal) / len(normal) or 1.0
        inverse = np.linalg.inv(normal + ridge * np.eye(len(normal)))
        return (inverse @ (basis * share[:, None]).T).astype(np.float32)


def bake_radiance(
    mesh: Mesh,
    order: int = 4,
    functions: int = 16,
    *,
    threshold: float | None = RADIANCE_THRESHOLD,
    device: str | None = None,
    progress: Progress | None = None,
    use_cache: bool = True,
) -> BakedRadiance:
    """Bakes a body's basis functions and their radiance field, or reads them from the cache on disk.

    order: SH bands, 2 to 6. functions: N, one of `FUNCTION_COUNTS`. threshold: of Tamura 2006, Equation 1, for the
    worst function of a shell; None keeps every sample. progress: called with the finished share, 0 to 1. use_cache:
    False neither reads nor writes the cache.

    Raises:
        ValueError: the order, the threshold or the number of functions is out of range, or the mesh is a slab.
    """
    check_settings(mesh, order, threshold)
    if functions not in FUNCTION_COUNTS:
        known = ", ".join(map(str, FUNCTION_COUNTS))
        raise ValueError(f"mesh {mesh.name!r}: cannot bake {functions} basis functions; choose one of: {known}")
    if mesh.slab is not None:
        raise ValueError(f"mesh {mesh.name!r} is a box or a rectangle, which needs no field; bake other bodies only")
    report = progress or (lambda share: None)
    settings = {"bake": RADIANCE_VERSION, "kind": "basis radiance", "order": order, "functions": functions}
    settings |= {"threshold": threshold, "convex": mesh.convex, "closed": mesh.closed}
    unit = unit_shape(mesh)
    key = shape_key(settings, unit)
    areas, features = _vertex_areas(unit), _features(unit)
    kept = load_radiance(key, unit, order, functions) if use_cache else None
    if kept is None:
        on_device = find_device(device)
        warp_mesh = upload_mesh(unit, on_device)
        sight = _look_at_itself(unit, warp_mesh, on_device)
        basis, buried = _find_functions(unit, warp_mesh, areas, features, functions, sight, on_device)
        open_vertices = np.flatnonzero(~buried)
        proxies = open_vertices[_farthest_points(features[open_vertices], MOST_PROXIES)].astype(np.int32)
        report(0.1)
        self_irradiance = sight and _gather_on_itself(sight, basis, on_device)
        report(0.2)
        # The last step is reported once the result is kept.
        shells = _bake_field(
            unit, warp_mesh, basis, order, threshold, on_device, lambda share: report(0.2 + 0.79 * share)
        )
        kept = basis, proxies, self_irradiance, shells
        if use_cache:
            save_radiance(key, unit, *kept)
    basis, proxies, self_irradiance, shells = kept
    report(1.0)
    field = replace(shells, center=mesh.center.astype(np.float32), radius=float(mesh.radius))
    areas = (areas * mesh.radius**2).astype(np.float32)
    return BakedRadiance(basis, areas, proxies, field, self_irradiance, features)


def _find_functions(
    mesh: Mesh,
    warp_mesh: wp.Mesh,
    areas: np.ndarray,
    features: np.ndarray,
    functions: int,
    sight: gather.Hits | None,
    device: wp.Device,
) -> tuple[np.ndarray, np.ndarray]:
    """The basis functions [vertices, N], and which vertices lie buried in the solid, bool [vertices]."""
    points = _off_surface(mesh)
    lights = mesh.center + LIGHT_DISTANCE * mesh.radius * sphere.fibonacci_cap(LIGHTS)
    strength = np.full(LIGHTS, mesh.radius**2)
    light = gather.light_surface(warp_mesh, points, mesh.normals, lights, np.zeros(LIGHTS), strength, device)
    mean = light.mean(axis=1, dtype=np.float64)
    dark = mean <= DARK_LEVEL * np.average(mean, weights=areas)
    buried = np.zeros(len(points), bool)
    if dark.any():
        _, inside = visibility.leave_solid(warp_mesh, mesh.center, mesh.radius, mesh.closed, points[dark], device)
        buried[dark] = inside
        if buried.all():  # an open mesh seen from its back everywhere has no inside to be buried in
            buried[:] = False
    dark &= ~buried
    share = areas[dark].sum() / areas[~buried].sum()
    if share > DARK_SHARE:
        # As many lights per area as outside.
        count = int(np.clip(LIGHTS * share / max(1 - share, 0.5), FEWEST_INNER_LIGHTS, LIGHTS))
        chosen = np.flatnonzero(dark)[_farthest_points(features[dark], count)]
        normals, most = mesh.normals[chosen], 2 * INNER_LIGHT_HEIGHT * mesh.radius
        height = 0.5 * gather.free_distance(warp_mesh, points[chosen], normals, most, device)
        # Walls beside such a light can be nearer to it than what it hangs over, and should not outshine everything.
        lights, strength = points[chosen] + height[:, None] * normals, height**2
        inner = gather.light_surface(warp_mesh, points, mesh.normals, lights, height, strength, device)
        # The components represent squares: those of the dark part count as much per area as those of the lit one.
        squares = [
            np.average((part**2).sum(axis=1)[which], weights=areas[which]) if which.any() else 0.0
            for part, which in ((light, ~(dark | buried)), (inner, dark))
        ]
        if min(squares) > 0.0:
            inner *= math.sqrt(squares[0] / squares[1])
        light = np.concatenate([light, inner], axis=1)
    basis = _principal_components(light, areas, functions)
    if sight is not None:
        level = np.average(light.mean(axis=1), weights=areas)
        echoes = level * _echoes(sight, basis, device)
        basis = _principal_components(light, areas, functions, echoes)
    return basis, buried


def _echoes(sight: gather.Hits, basis: np.ndarray, device: wp.Device) -> np.ndarray:
    """What a white body makes of the light of its functions by reflecting it to itself, once, twice, ... [vertices, k].

    The light in a cavity after some bounces is unlike any that comes from outside. It is represented only when the
    components know of it; weighted so that all columns together count as `ECHO_GAIN` times the lights.
    """
    columns, function = [], basis
    for _ in range(ECHOES):
        function = _gather_on_itself(sight, function, device) / math.pi
        columns.append(function)
    return ECHO_GAIN * math.sqrt(LIGHTS / basis.shape[1]) * np.concatenate(columns, axis=1)


def _principal_components(
    light: np.ndarray, areas: np.ndarray, functions: int, echoes: np.ndarray | None = None
) -> np.ndarray:
    """The mean of `light` [vertices, lights] and its principal components, float32 [vertices, functions].

    echoes: [vertices, k], which the components represent as well.

    Under the inner product that weights a vertex with its area, so that a surface that is cut more finely gives the
    same functions. From each light its share of the mean function is taken first, not the mean itself as in the paper:
    the least squares choose the mean's weight freely, so that this leaves less to represent, and all functions are
    orthogonal.
    """
    share = areas.astype(np.float64) / areas.sum(dtype=np.float64)
    light = light.astype(np.float64)
    mean = light.mean(axis=1)
    if echoes is not None:
        light = np.concatenate([light, echoes.astype(np.float64)], axis=1)
    basis = np.zeros((len(light), functions))
    level = share @ mean
    if level <= 0.0:
        basis[:, 0] = 1.0  # nothing lights anything: at least an even glow can be represented
        return basis.astype(np.float32)
    mean, light = mean / level, light / level
    rest = light - np.outer(mean, (share * mean) @ light / ((share * mean) @ mean))
    squared, vectors = np.linalg.eigh(rest.T @ (share[:, None] * rest))
    strongest = np.argsort(-squared)[: functions - 1]
    strongest = strongest[squared[strongest] > LEAST_SINGULAR_VALUE**2 * squared.max()]
    # A left singular vector times its singular value; over the root of the number of lights, its weights' RMS is 1.
    found = rest @ vectors[:, strongest] / math.sqrt(light.shape[1])
    # A singular vector's sign is free: the value farthest from zero is positive.
    farthest = np.abs(found).argmax(axis=0)
    basis[:, 0] = mean
    basis[:, 1 : 1 + len(strongest)] = found * np.sign(found[farthest, np.arange(len(strongest))])
    return basis.astype(np.float32)


def _look_at_itself(mesh: Mesh, warp_mesh: wp.Mesh, device: wp.Device) -> gather.Hits | None:
    """What each vertex sees of the body itself; None of a convex body, which sees nothing."""
    if mesh.convex:
        return None
    # Equal areas of the disc below the hemisphere, raised to it: a density in proportion to the cosine.
    sine_squared = (np.arange(SELF_RAYS) + 0.5) / SELF_RAYS
    phi = math.pi * (3 - math.sqrt(5)) * np.arange(SELF_RAYS)
    sine = np.sqrt(sine_squared)
    rays = np.stack([sine * np.cos(phi), sine * np.sin(phi), np.sqrt(1 - sine_squared)], axis=1)
    return gather.find_hits(warp_mesh, _off_surface(mesh), mesh.normals, rays, device)


def _gather_on_itself(sight: gather.Hits, basis: np.ndarray, device: wp.Device) -> np.ndarray:
    """The irradiance at each vertex from the functions on the body itself, float32 [vertices, N]."""
    return gather.sum_hits(sight, basis, device) * np.float32(math.pi / SELF_RAYS)


def _bake_field(
    mesh: Mesh,
    warp_mesh: wp.Mesh,
    basis: np.ndarray,
    order: int,
    threshold: float | None,
    device: wp.Device,
    report: Progress,
) -> BasisRadianceField:
    """Samples every shell, reduces each of them for all functions together, and quantises it."""
    resolution, functions = FINEST_RADIANCE_RESOLUTION, basis.shape[1]

    def project(shell: int, points: np.ndarray, outward: np.ndarray) -> np.ndarray:
        return _project(warp_mesh, basis, shell, points, outward, order, device)

    vectors, inside = sample_shells(mesh, warp_mesh, RADIANCE_SHELLS, resolution, project, device, report)
    shells = [values[:, :, :-1].reshape(resolution, resolution, functions, -1) for values in vectors]
    if threshold is not None:
        shells = [reduce_shell(values, threshold, can_be_read(inside, shell)) for shell, values in enumerate(shells)]
    shells[FIRST_OUTER_SHELL:] = [_sharpen(values) for values in shells[FIRST_OUTER_SHELL:]]
    kept = quantise(mesh.center, mesh.radius, [values.reshape(*values.shape[:2], -1) for values in shells])
    left = kept.resolutions[FIRST_OUTER_SHELL]
    covered = vectors[FIRST_OUTER_SHELL][:, :, -1].reshape(left, resolution // left, left, -1).mean(axis=(1, 3))
    return BasisRadianceField(
        center=kept.center,
        radius=kept.radius,
        resolutions=kept.resolutions,
        codes=kept.codes.reshape(len(kept.codes), functions, -1),
        minimum=kept.minimum.reshape(RADIANCE_SHELLS, functions, -1),
        step=kept.step.reshape(RADIANCE_SHELLS, functions, -1),
        covered=covered.ravel(),
    )


def _project(
    warp_mesh: wp.Mesh,
    basis: np.ndarray,
    shell: int,
    points: np.ndarray,
    outward: np.ndarray,
    order: int,
    device: wp.Device,
) -> np.ndarray:
    """The functions' vectors at points of a shell, and last the share of the cone that is covered, [n, N * K + 1]."""
    half_angle, count = cone_of_shell(shell)
    rays = sphere.fibonacci_cap(count, half_angle)
    weighted = sh.evaluate(rays, order) * (4 * math.pi * math.sin(0.5 * half_angle) ** 2 / count)
    local, covered = gather.gather_functions(warp_mesh, basis, points, -outward, rays, weighted, device)
    turned = local @ sh.rotation_rows(sphere.frame(-outward), order)
    return np.concatenate([turned.reshape(len(points), basis.shape[1] * order * order), covered[:, None]], axis=1)


def _sharpen(vectors: np.ndarray) -> np.ndarray:
    """A shell's samples [R, R, ...] changed so that what is interpolated between them is right in the mean.

    The vectors turn with the direction to the body, and a mean of two that are turned apart is too small: linear
    interpolation between samples h apart errs by h^2/12 f'' in the mean over a cell, and the mean over a cell of finer
    samples, of which a coarser one is made, by (1 - (finer / h)^2) h^2/24 f''. Both are taken off beforehand. Without
    it the light of a body is 2 % too weak where shells have 16 x 16 samples, and 10 % where they have 8 x 8.
    """
    resolution = len(vectors)
    finer = resolution / FINEST_RADIANCE_RESOLUTION
    share = 1 / 12 + (1 - finer**2) / 24
    # A row beyond a pole is the same row seen from the other side, as in the lookup.
    across = [np.roll(vectors[row], resolution // 2, axis=0)[None] for row in (0, -1)]
    rows = np.concatenate([across[0], vectors, across[1]])
    bend = np.roll(vectors, 1, axis=1) + np.roll(vectors, -1, axis=1) + rows[:-2] + rows[2:] - 4 * vectors
    return vectors - np.float32(share) * bend


def _off_surface(mesh: Mesh) -> np.ndarray:
    """The vertices a little outside, so that the faces around them do not shade them, float32 [vertices, 3]."""
    return (mesh.vertices + VERTEX_OFFSET * mesh.radius * mesh.normals).astype(np.float32)


def _vertex_areas(mesh: Mesh) -> np.ndarray:
    areas = 0.5 * np.linalg.norm(area_vectors(mesh.vertices.astype(np.float64), mesh.faces), axis=1)
    return np.bincount(mesh.faces.ravel(), np.repeat(areas / 3, 3), minlength=len(mesh.vertices)).astype(np.float32)


def _features(mesh: Mesh) -> np.ndarray:
    """Where vertices stand and how they are turned, float32 [vertices, 6]: what is near is lit alike."""
    return np.concatenate(
        [(mesh.vertices - mesh.center) / mesh.radius, 0.5 * NORMAL_DISTANCE * mesh.normals], axis=1
    ).astype(np.float32)


def _farthest_points(features: np.ndarray, most: int) -> np.ndarray:
    """Rows of `features` [n, k], int [min(n, most)]: each is the farthest from those before it."""
    chosen = [int(((features - features.mean(axis=0)) ** 2).sum(axis=1).argmax())]
    apart = np.full(len(features), np.inf, np.float32)
    while len(chosen) < min(len(features), most):
        apart = np.minimum(apart, ((features - features[chosen[-1]]) ** 2).sum(axis=1))
        chosen.append(int(apart.argmax()))
    return np.array(chosen, np.int32)


def _nearest(features: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """The nearest of `targets` [m, k] to each of `features` [n, k], int [n]."""
    return ((targets**2).sum(axis=1) - 2 * features @ targets.T).argmin(axis=1)
