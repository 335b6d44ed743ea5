"""Ray-cast silhouettes: how far each direction around a sample lies from what the body covers there.

Samples are cast coarse to fine, on every shell separately, until those between others can be interpolated; the shells
likewise: one is cast where those around it do not tell what it holds. All maps of a body are then written as their
principal components (see `field/silhouettes.py`).
"""

from dataclasses import replace

import numpy as np
import warp as wp

from warp_psf.bake import visibility
from warp_psf.bake.body import Progress, upload_mesh
from warp_psf.bake.kept import find_unlike, say_wrong
from warp_psf.bake.shape import is_same_shape, shape_key, surface_of, unit_shape
from warp_psf.bake.transfer import VERTEX_OFFSET, fill_buried
from warp_psf.device import find_device, launch
from warp_psf.field.shells import FIRST_OUTER_SHELL, SHELL_SPACING, sample_directions, shell_radii
from warp_psf.field.silhouettes import (
    BEYOND,
    COMPONENTS,
    LARGEST_DISTANCE,
    MAP_SIZE,
    OWN_SIZE,
    OWN_SPREAD,
    WITHIN,
    SilhouetteField,
    map_frames,
    spread_at,
)
from warp_psf.field.store import load_arrays, save_arrays
from warp_psf.scene.mesh import Mesh

SILHOUETTES_VERSION = 2
# Rays per cell and axis: an edge is then known to a quarter of a cell.
RAYS_PER_CELL = 2
RAYS = MAP_SIZE * RAYS_PER_CELL
# How far an edge may be off where it is interpolated, as a share of the map's radius, RMS over the cells near an edge:
# beyond a few radii half a degree, what the components themselves leave.
EDGE_ERROR = 0.03
# Cells whose distance is below this are near an edge.
NEAR_EDGE = 0.1
# The share of a shell's samples at which the edges are no further off than that. No density serves the others, where
# a part of the body comes out from behind another.
WELL_INTERPOLATED = 0.9
# Rows of samples of a shell at least and at most; columns are twice as many.
COARSEST, FINEST = 8, 32
GRIDS = (8, 16, 32)
# Samples, at most, at which interpolation is tried.
TESTED = 128
# The shells that have samples. Beyond the bounding sphere a body changes as 1/r.
SHELLS = {WITHIN: (0, 1, 2, 3, 4), BEYOND: (4, 5, 6, 8, 11, 17, 31)}
_KEPT = ("rows", "columns", "codes", "minimum", "step", "modes")


@wp.kernel(enable_backward=False, module="unique")
def _cast_maps(
    first: int,
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),  # (sample)
    frames: wp.array(dtype=wp.mat33),  # (sample): rows are the map's axes
    rays: wp.array(dtype=wp.vec3),  # (ray), about +z; zero where the map has none
    reach: float,
    covered_out: wp.array2d(dtype=wp.uint8),  # (sample, ray)
):
    world, sample = wp.tid()
    sample += first
    to_body = wp.transpose(frames[sample])
    for ray in range(rays.shape[0]):
        hit = False
        if wp.length_sq(rays[ray]) > 0.0:
            hit = wp.mesh_query_ray_anyhit(mesh, points[sample], to_body * rays[ray], reach)
        covered_out[sample, ray] = wp.where(hit, wp.uint8(1), wp.uint8(0))


@wp.kernel(enable_backward=False, module="unique")
def _measure_distances(
    first: int,
    covered: wp.array3d(dtype=wp.uint8),  # (sample, row, column)
    along_columns: wp.array3d(
        dtype=wp.int32
    ),  # (sample, row, column): to the nearest cell of the other kind above or below
    distance_out: wp.array3d(dtype=wp.float32),  # (sample, row, column), cells
):
    world, sample = wp.tid()
    sample += first
    size = covered.shape[1]
    far = 2 * size
    for column in range(size):
        for kind in range(2):
            # How far the nearest cell of this kind is, from above and then from below.
            steps = int(far)
            for row in range(size):
                steps = wp.where(int(covered[sample, row, column]) == kind, 0, steps + 1)
                if int(covered[sample, row, column]) != kind:
                    along_columns[sample, row, column] = steps
            steps = int(far)
            for up in range(size):
                row = size - 1 - up
                steps = wp.where(int(covered[sample, row, column]) == kind, 0, steps + 1)
                if int(covered[sample, row, column]) != kind:
                    along_columns[sample, row, column] = wp.min(along_columns[sample, row, column], steps)
    for row in range(size):
        for column in range(size):
            own = covered[sample, row, column]
            nearest = along_columns[sample, row, column] * along_columns[sample, row, column]
            across = int(1)
            while across * across < nearest and across < size:
                for side in range(2):
                    other = column + wp.where(side == 0, -across, across)
                    if other >= 0 and other < size:
                        apart = int(0)
                        if covered[sample, row, other] == own:
                            apart = along_columns[sample, row, other]
                        nearest = wp.min(nearest, across * across + apart * apart)
                across += 1
            # The edge lies half a cell before the first one of the other kind.
            distance = wp.sqrt(float(nearest)) - 0.5
            distance_out[sample, row, column] = wp.where(own != wp.uint8(0), distance, -distance)


def map_rays(spread: float) -> np.ndarray:
    """The directions of a map's rays about +z, float32 [RAYS^2, 3], rows before columns; zero beyond the sphere.

    spread: the sine of half the angle that is the map's radius.
    """
    middle = (2 * np.arange(RAYS) + 1) / RAYS - 1
    v, u = np.meshgrid(middle, middle, indexing="ij")
    sine = spread * np.hypot(u, v)
    height = 1 - 2 * sine**2
    level = 2 * spread * np.sqrt(np.maximum(1 - sine**2, 0))
    rays = np.stack([level * u, level * v, height], axis=-1)
    rays[sine >= 1] = 0
    return rays.reshape(-1, 3).astype(np.float32)


def cast_silhouettes(
    warp_mesh: wp.Mesh, points: np.ndarray, outward: np.ndarray, spread: float, device: wp.Device
) -> np.ndarray:
    """The distance maps of samples, float32 [N, MAP_SIZE^2], map radii, cut off at LARGEST_DISTANCE.

    points: [N, 3] in the frame of a body with bounding radius 1; outward: their directions from its centre [N, 3].
    """
    count = len(points)
    frames = wp.array(map_frames(outward).astype(np.float32), dtype=wp.mat33, device=device)
    places = wp.array(points.astype(np.float32), dtype=wp.vec3, device=device)
    rays = wp.array(map_rays(spread), dtype=wp.vec3, device=device)
    covered = wp.zeros((count, RAYS * RAYS), dtype=wp.uint8, device=device)
    reach = 2.0 + float(np.abs(points).max(initial=0.0)) * 2.0
    launch(_cast_maps, (1, count), [warp_mesh.id, places, frames, rays, reach], [covered], device)
    square = (count, RAYS, RAYS)
    scratch = wp.zeros(square, dtype=wp.int32, device=device)
    distance = wp.zeros(square, dtype=wp.float32, device=device)
    launch(_measure_distances, (1, count), [covered.reshape(square), scratch], [distance], device)
    cells = distance.numpy().reshape(count, MAP_SIZE, RAYS_PER_CELL, MAP_SIZE, RAYS_PER_CELL).mean(axis=(2, 4))
    return np.clip(cells * (2 / RAYS), -LARGEST_DISTANCE, LARGEST_DISTANCE).reshape(count, -1).astype(np.float32)


def edge_error(difference: np.ndarray, of: np.ndarray) -> np.ndarray:
    """How far edges are off: the RMS difference of maps [..., cells] over the cells near an edge of the maps `of`."""
    near = np.abs(of) < NEAR_EDGE
    squares = np.where(near, difference, 0) ** 2
    return np.sqrt(squares.sum(axis=-1) / np.maximum(near.sum(axis=-1), 1))


def bake_silhouettes(
    mesh: Mesh, *, device: str | None = None, progress: Progress | None = None, use_cache: bool = True
) -> SilhouetteField:
    """Bakes a body's silhouette field, or reads it from the cache on disk.

    It holds how far each direction around the body lies within or outside of its outline, for `basis="haar"`.

    Args:
        mesh: the body's shape.
        device: "cpu", "cuda:0", ...; None takes the first CUDA device, else the CPU.
        progress: called with the finished share, 0 to 1.
        use_cache: False neither reads nor writes the cache.

    Raises:
        ValueError: there is no such device.
    """
    report = progress or (lambda share: None)
    unit = unit_shape(mesh)
    key = shape_key(
        {"bake": SILHOUETTES_VERSION, "kind": "silhouettes", "closed": mesh.closed, "convex": mesh.convex}, unit
    )
    field = load_silhouettes(key, unit) if use_cache else None
    if field is None:
        field = _bake(unit, find_device(device), report)
        if use_cache:
            save_silhouettes(key, unit, field)
    report(1.0)
    return replace(field, center=mesh.center.astype(np.float32), radius=float(mesh.radius))


def _bake(unit: Mesh, device: wp.Device, report: Progress) -> SilhouetteField:
    warp_mesh = upload_mesh(unit, device)
    numbers = [*((WITHIN, shell) for shell in SHELLS[WITHIN]), *((BEYOND, shell) for shell in SHELLS[BEYOND])]
    grids = []
    for done, (group, shell) in enumerate(numbers):
        report(0.95 * done / len(numbers))
        grids.append(_sample_shell(unit, warp_mesh, group, shell, device))
    split = len(SHELLS[WITHIN])
    groups = grids[:split], grids[split:]
    coded = [_encode(np.concatenate([grid.reshape(-1, MAP_SIZE**2) for grid in group])) for group in groups]
    codes, minimum, step, modes = zip(*coded, strict=True)
    return SilhouetteField(
        center=np.zeros(3, np.float32),
        radius=1.0,
        shells=np.array([shell for _, shell in numbers], np.int32),
        rows=np.array([grid.shape[0] for grid in grids], np.int32),
        columns=np.array([grid.shape[1] for grid in grids], np.int32),
        first_beyond=split,
        codes=np.concatenate(codes),
        minimum=np.stack(minimum),
        step=np.stack(step),
        modes=np.stack(modes),
        own=None if unit.convex else _cast_own(unit, warp_mesh, device),
    )


def _sample_shell(unit: Mesh, warp_mesh: wp.Mesh, group: int, shell: int, device: wp.Device) -> np.ndarray:
    """The maps of a shell, float32 [R, C, cells], as many as their interpolation needs."""
    spread = 1.0 if group == WITHIN else float(spread_at(np.array(SHELL_SPACING * (1 + shell))))

    def cast(rows: int, every: int) -> np.ndarray:
        outward = shell_directions(rows, 2 * rows).reshape(-1, 3)[::every]
        points = (shell_radii(1.0)[shell] * outward).astype(np.float32)
        if shell <= FIRST_OUTER_SHELL:
            points, _ = visibility.leave_solid(warp_mesh, unit.center, 1.0, unit.closed, points, device)
        return cast_silhouettes(warp_mesh, points, outward, spread, device)

    rows = COARSEST
    while True:
        coarse = cast(rows, 1).reshape(rows, 2 * rows, -1)
        if rows == FINEST:
            return coarse
        # A part of the finer samples tells whether the others are needed.
        every = 8 * rows**2 // TESTED + 1
        fine = cast(2 * rows, every)
        errors = edge_error(double(coarse).reshape(8 * rows**2, -1)[::every] - fine, fine)
        if np.quantile(errors, WELL_INTERPOLATED) <= EDGE_ERROR:
            return coarse
        rows *= 2


def _cast_own(unit: Mesh, warp_mesh: wp.Mesh, device: wp.Device) -> np.ndarray:
    """What the body hides of the hemispheres above its vertices; see `SilhouetteField.own`."""
    points = (unit.vertices + VERTEX_OFFSET * unit.normals).astype(np.float32)
    maps = cast_silhouettes(warp_mesh, points, -unit.normals.astype(np.float64), OWN_SPREAD, device)
    cells = MAP_SIZE // OWN_SIZE
    coarse = maps.reshape(-1, OWN_SIZE, cells, OWN_SIZE, cells).mean(axis=(2, 4)).reshape(len(points), -1)
    _, buried = visibility.leave_solid(warp_mesh, unit.center, unit.radius, unit.closed, points, device)
    filled = fill_buried(unit.faces, buried, coarse)
    return np.rint(filled * (127 / LARGEST_DISTANCE)).astype(np.int8)


def shell_directions(rows: int, columns: int) -> np.ndarray:
    """Directions from the centre to samples, float64 [rows, columns, 3]; see `shells.sample_directions`."""
    return sample_directions(max(rows, columns))[:: max(columns // rows, 1), :: max(rows // columns, 1)]


def double(maps: np.ndarray) -> np.ndarray:
    """Maps [R, C, cells] at twice the samples: interpolated along theta and around phi, the poles' rows held."""
    padded = np.concatenate([maps[:1], maps, maps[-1:]])
    rows = np.empty((2 * len(maps), *maps.shape[1:]), maps.dtype)
    rows[0::2] = 0.75 * maps + 0.25 * padded[:-2]
    rows[1::2] = 0.75 * maps + 0.25 * padded[2:]
    fine = np.empty((len(rows), 2 * maps.shape[1], maps.shape[2]), maps.dtype)
    fine[:, 0::2] = 0.75 * rows + 0.25 * np.roll(rows, 1, axis=1)
    fine[:, 1::2] = 0.75 * rows + 0.25 * np.roll(rows, -1, axis=1)
    return fine


def _encode(maps: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Maps [N, cells] as codes [N, COMPONENTS], their minimum and step, and the components [cells, COMPONENTS]."""
    mean = maps.mean(axis=0)
    centred = (maps - mean).astype(np.float64)
    _, vectors = np.linalg.eigh(centred.T @ centred)
    basis = np.concatenate([mean[:, None], vectors[:, ::-1][:, : COMPONENTS - 1]], axis=1)
    scale = np.abs(basis).max(axis=0) / 127
    scale = np.where(scale > 0, scale, 1)
    modes = np.rint(basis / scale).astype(np.int8)
    # Of the rounded components, by least squares: what rounding took from one the others give back.
    rounded = modes[:, 1:].astype(np.float64) * scale[1:]
    residual = maps - modes[:, 0] * scale[0]
    weights = residual @ rounded @ np.linalg.pinv(rounded.T @ rounded)
    coefficients = np.concatenate([np.ones((len(maps), 1)), weights], axis=1) * scale
    minimum, step = coefficients.min(axis=0), np.ptp(coefficients, axis=0) / 255
    codes = np.rint((coefficients - minimum) / np.where(step > 0, step, 1)).clip(0, 255).astype(np.uint8)
    return codes, minimum.astype(np.float32), step.astype(np.float32), modes


def save_silhouettes(key: str, unit: Mesh, field: SilhouetteField) -> None:
    """Keeps the field of a unit shape under a key."""
    arrays = {"surface": surface_of(unit)} | {name: getattr(field, name) for name in _KEPT}
    save_arrays(key, arrays if field.own is None else arrays | {"own": field.own})


def load_silhouettes(key: str, unit: Mesh) -> SilhouetteField | None:
    """The field kept of a unit shape under a key, or None when there is none, or (which is said) none usable."""
    arrays = load_arrays(key)
    if arrays is None:
        return None
    shells = np.array([*SHELLS[WITHIN], *SHELLS[BEYOND]], np.int32)
    grid = (np.int32, (len(shells),))
    layout = {"surface": (np.float32, (len(unit.vertices), 6)), "rows": grid, "columns": grid}
    layout |= dict.fromkeys(("minimum", "step"), (np.float32, (2, COMPONENTS)))
    layout |= {"modes": (np.int8, (2, MAP_SIZE**2, COMPONENTS))}
    if not unit.convex:
        layout["own"] = (np.int8, (len(unit.vertices), OWN_SIZE**2))
    wrong = find_unlike(arrays, layout)
    if wrong is None:
        if not (np.isin(arrays["rows"], GRIDS).all() and (arrays["columns"] == 2 * arrays["rows"]).all()):
            wrong = "rows"
        else:
            samples = int((arrays["rows"].astype(np.int64) * arrays["columns"]).sum())
            wrong = find_unlike(arrays, {"codes": (np.uint8, (samples, COMPONENTS))})
    if wrong is not None:
        say_wrong("silhouette field", unit, wrong)
        return None
    if not is_same_shape(arrays["surface"], unit):
        return None
    kept = {name: arrays[name] for name in _KEPT} | {"own": arrays.get("own")}
    return SilhouetteField(np.zeros(3, np.float32), 1.0, shells, first_beyond=len(SHELLS[WITHIN]), **kept)
