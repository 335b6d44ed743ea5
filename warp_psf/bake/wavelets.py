"""All-frequency fields: coverage maps by ray casting, thinned out as all shells are, and cut to their largest wavelets.

The maps are those of the paper (Tamura 2006, section 6): 64 x 64 directions, one ray each. Only those in the cone of
the body's bounding sphere are cast, because no other ray can hit.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_psf.bake import visibility
from warp_psf.bake.adapt import ERROR_THRESHOLD, reduce_shell
from warp_psf.bake.body import SAME_POINT, Progress, can_be_read, cone_of_shell, upload_mesh
from warp_psf.basis import haar
from warp_psf.device import core_count, find_device, launch
from warp_psf.field.shells import (
    FINEST_RESOLUTION,
    FIRST_OUTER_SHELL,
    SHELL_COUNT,
    sample_directions,
    shell_radii,
)
from warp_psf.field.wavelets import CELLS, LEVELS, MAP_SIZE, WaveletField, coefficient_levels
from warp_psf.scene.mesh import Mesh

# Entries that a sample has at most, of 4,096 coefficients.
MOST_ENTRIES = round(haar.KEPT_SHARE * CELLS)
# Coefficients below this are what rounding leaves of zero: maps go up to 1, and the smallest wavelet of one cell that
# is covered to a thousandth has 3e-5.
SMALLEST = 1.0e-6
# Samples that are transformed at a time: small enough for the cache of a core.
BLOCK = 64
# Shells that are coded at a time, next to the one that is cast: each takes 400 MB.
MOST_CODERS = 4


@wp.func
def probes_agree(covered: wp.array(dtype=wp.uint8), row: int, column: int) -> bool:
    """Whether the probes of the blocks of 2 x 2 cells around a cell's own say the same as that of its own."""
    size = wp.static(MAP_SIZE)
    own = covered[row * size + column]
    same = bool(True)
    for step in range(9):
        beside_row = row + 2 * (step / 3 - 1)
        beside_column = column + 2 * (step % 3 - 1)
        # A row beyond a pole is the same row seen from the other side.
        if beside_row < 0 or beside_row >= size:
            beside_row = row
            beside_column += size / 2
        if covered[beside_row * size + (beside_column & (size - 1))] != own:
            same = False
    return same


@wp.kernel(enable_backward=False, module="unique")
def _cast_coverage(
    first: int,
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),  # (sample)
    axes: wp.array(dtype=wp.vec3),  # (sample): towards the centre
    least_cosine: float,  # of the cone about the axis that holds the body
    reach: float,
    directions: wp.array(dtype=wp.vec3),  # (cell)
    spacing: int,  # 1: every cell is cast; 2: one of 2 x 2 first, and others only next to an edge
    covered_out: wp.array2d(dtype=wp.uint8),  # (sample, cell), zero on entry
):
    world, sample = wp.tid()
    sample += first
    size = wp.static(MAP_SIZE)
    for cell in range(directions.shape[0]):
        row = cell / size
        column = cell % size
        if row % spacing == 0 and column % spacing == 0 and wp.dot(directions[cell], axes[sample]) >= least_cosine:
            if wp.mesh_query_ray_anyhit(mesh, points[sample], directions[cell], reach):
                covered_out[sample, cell] = wp.uint8(1)
    if spacing == 2:
        for block in range(directions.shape[0] / 4):
            row = 2 * (block / (size / 2))
            column = 2 * (block % (size / 2))
            hit = covered_out[sample, row * size + column] != wp.uint8(0)
            same = probes_agree(covered_out[sample], row, column)
            for k in range(1, 4):
                cell = (row + k / 2) * size + column + k % 2
                if not same:
                    hit = wp.mesh_query_ray_anyhit(mesh, points[sample], directions[cell], reach)
                covered_out[sample, cell] = wp.where(hit, wp.uint8(1), wp.uint8(0))


@wp.kernel(enable_backward=False, module="unique")
def _cast_radiance(
    first: int,
    mesh: wp.uint64,
    face_radiance: wp.array(dtype=wp.float32),  # (face): leaving the front of the face
    points: wp.array(dtype=wp.vec3),  # (sample)
    axes: wp.array(dtype=wp.vec3),  # (sample): towards the centre
    least_cosine: float,  # of the cone about the axis that holds the body
    reach: float,
    directions: wp.array(dtype=wp.vec3),  # (cell)
    radiance_out: wp.array2d(dtype=wp.float32),  # (sample, cell), zero on entry
):
    world, sample = wp.tid()
    sample += first
    for cell in range(directions.shape[0]):
        if wp.dot(directions[cell], axes[sample]) >= least_cosine:
            hit = wp.mesh_query_ray(mesh, points[sample], directions[cell], reach)
            if hit.result and hit.sign > 0.0:
                radiance_out[sample, cell] = face_radiance[hit.face]


def cast_maps(
    mesh: Mesh,
    warp_mesh: wp.Mesh,
    shell: int,
    points: np.ndarray,
    outward: np.ndarray,
    device: wp.Device,
    face_radiance: np.ndarray | None = None,
) -> np.ndarray:
    """The maps at points of a shell, [N, CELLS]: uint8, 1 where the body is hit, or float32, the radiance seen there.

    points: [N, 3] in the body's frame, metres; outward: their directions from the centre [N, 3]. face_radiance: as in
    `bake_wavelet_radiance_field`.
    """
    half_angle, _ = cone_of_shell(shell)
    reach = 4.0 * float(np.abs(points).max(initial=0.0) + np.abs(mesh.vertices).max())
    samples = [wp.array(points, dtype=wp.vec3, device=device), wp.array(-outward, dtype=wp.vec3, device=device)]
    directions = wp.array(haar.map_directions(MAP_SIZE).reshape(-1, 3), dtype=wp.vec3, device=device)
    # A map's own rounding must not cut a cone that is all directions.
    least_cosine = math.cos(half_angle) if half_angle < math.pi else -2.0
    if face_radiance is None:
        # As in `visibility.project_coverage`: outside the bounding sphere most cells would lie at an edge.
        spacing = 2 if mesh.closed and half_angle == math.pi else 1
        out = wp.zeros((len(points), CELLS), dtype=wp.uint8, device=device)
        inputs = [warp_mesh.id, *samples, least_cosine, reach, directions, spacing]
        launch(_cast_coverage, (1, len(points)), inputs, [out], device)
    else:
        radiance = wp.array(face_radiance, dtype=wp.float32, device=device)
        out = wp.zeros((len(points), CELLS), dtype=wp.float32, device=device)
        inputs = [warp_mesh.id, radiance, *samples, least_cosine, reach, directions]
        launch(_cast_radiance, (1, len(points)), inputs, [out], device)
    return out.numpy()


def bake_wavelet_field(
    mesh: Mesh,
    *,
    threshold: float | None = ERROR_THRESHOLD,
    device: str | None = None,
    progress: Progress | None = None,
) -> WaveletField:
    """Bakes a body's all-frequency occlusion field, of any mesh, also of those that have a closed form.

    threshold: of Tamura 2006, Equation 1; None keeps every sample. progress: called with the finished share, 0 to 1.

    Raises:
        ValueError: the threshold is negative or not a number.
    """
    return bake_wavelet_fields(mesh, [threshold], device=device, progress=progress)[0]


def bake_wavelet_radiance_field(
    mesh: Mesh,
    face_radiance: np.ndarray,
    *,
    threshold: float | None = ERROR_THRESHOLD,
    device: str | None = None,
    progress: Progress | None = None,
) -> WaveletField:
    """Bakes the all-frequency source radiance field of a luminous mesh.

    face_radiance: radiance that leaves the front of each face, relative to the light's own, float [faces].

    Raises:
        ValueError: the threshold is negative or not a number, or the radiance is not one finite number, at least 0,
            per face.
    """
    radiance = np.ascontiguousarray(face_radiance, np.float32)
    if radiance.shape != (len(mesh.faces),) or not (np.isfinite(radiance) & (radiance >= 0)).all():
        raise ValueError(
            f"mesh {mesh.name!r}: its radiance has the shape {list(radiance.shape)}; "
            f"give {len(mesh.faces)} finite numbers of at least 0, one per face"
        )
    return bake_wavelet_fields(mesh, [threshold], device=device, progress=progress, face_radiance=radiance)[0]


def bake_wavelet_fields(
    mesh: Mesh,
    thresholds: Sequence[float | None],
    *,
    device: str | None = None,
    progress: Progress | None = None,
    face_radiance: np.ndarray | None = None,
    shell_count: int = SHELL_COUNT,
    resolution: int = FINEST_RESOLUTION,
) -> list[WaveletField]:
    """Bakes a body's all-frequency occlusion field, on Haar wavelets, for several thresholds from the same rays.

    For study: no renderer uses it. Boxes and spheres are baked, too. Nothing is cached. Source: Tamura 2006, section 6.

    Args:
        mesh: the body's shape.
        thresholds: of Tamura 2006, Equation 1, one per field, at least 0; None keeps every sample.
        device: "cpu", "cuda:0", ...; None takes the first CUDA device, else the CPU.
        progress: called with the finished share, 0 to 1.
        face_radiance: radiance that leaves the front of each face, float [faces]: bakes source radiance instead.
        shell_count: at least FIRST_OUTER_SHELL + 1.
        resolution: samples per axis to begin with, a power of two.

    Raises:
        ValueError: a threshold is negative or not a number, or there is no such device.
    """
    for threshold in thresholds:
        if threshold is not None and not threshold >= 0:
            raise ValueError(f"mesh {mesh.name!r}: the threshold is {threshold}; give a number of at least 0, or None")
    on_device = find_device(device)
    warp_mesh = upload_mesh(mesh, on_device)

    def cast(shell: int, points: np.ndarray, outward: np.ndarray) -> np.ndarray:
        return cast_maps(mesh, warp_mesh, shell, points, outward, on_device, face_radiance)

    # What nobody can read is stored as the paper has it inside of solids: covered all around, or dark.
    unread = 1 if face_radiance is None else 0
    shells: list[Future[list[CodedShell]]] = []
    with ThreadPoolExecutor(min(core_count(), MOST_CODERS)) as pool:
        for maps, matters in walk_shells(mesh, warp_mesh, shell_count, resolution, cast, on_device):
            shells.append(pool.submit(code_shell, maps, thresholds, matters, unread))
            if len(shells) > MOST_CODERS:
                shells[-1 - MOST_CODERS].result()
            if progress:
                progress(len(shells) / (shell_count + 1))
        coded = [shell.result() for shell in reversed(shells)]
    if progress:
        progress(1.0)
    return [_join(mesh, [shell[which] for shell in coded]) for which in range(len(thresholds))]


def walk_shells(
    mesh: Mesh,
    warp_mesh: wp.Mesh,
    count: int,
    resolution: int,
    cast: Callable[[int, np.ndarray, np.ndarray], np.ndarray],
    device: wp.Device,
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """The maps of each shell [R, R, CELLS], and which samples can be read, bool [R, R]; from the outermost inwards.

    What `body.sample_shells` does for the SH fields, one shell at a time and without interpolation: samples inside the
    solid are moved to its surface, and where the next shell's went to the same point, its map is taken over.

    cast: gives the maps, [n, CELLS], of a shell at points [n, 3] whose directions from the centre are known, [n, 3].
    """
    grid = (resolution, resolution)
    outward = sample_directions(resolution).reshape(-1, 3)
    places = [(mesh.center + r * outward).astype(np.float32) for r in shell_radii(mesh.radius)[:count]]
    inside = [np.zeros(grid, bool) for _ in places]
    inner = FIRST_OUTER_SHELL + 1
    for shell in range(inner):
        moved = visibility.leave_solid(warp_mesh, mesh.center, mesh.radius, mesh.closed, places[shell], device)
        places[shell], inside[shell] = moved[0], moved[1].reshape(grid)
    maps = np.empty((0, CELLS), np.uint8)
    for shell in reversed(range(count)):
        readable = can_be_read(inside, shell)
        wanted = np.ones(len(outward), bool)
        if shell < inner - 1:
            apart = np.linalg.norm(places[shell] - places[shell + 1], axis=1)
            wanted = ~(inside[shell].ravel() & (apart < SAME_POINT * mesh.radius)) & readable.ravel()
        if wanted.all():
            maps = cast(shell, places[shell], outward)
        elif wanted.any():
            maps = maps.copy()
            maps[wanted] = cast(shell, places[shell][wanted], outward[wanted])
        yield maps.reshape(*grid, CELLS), readable


@dataclass(frozen=True)
class CodedShell:
    """A shell of a `WaveletField`: samples per axis, the samples' numbers of entries int [R_c^2], and as there."""

    resolution: int
    counts: np.ndarray
    index: np.ndarray
    codes: np.ndarray
    minimum: np.ndarray
    step: np.ndarray


def code_shell(
    maps: np.ndarray, thresholds: Sequence[float | None], matters: np.ndarray, unread: float
) -> list[CodedShell]:
    """A shell's samples, thinned out and cut to their largest wavelets, for each threshold.

    maps: [R, R, CELLS]; matters: which samples a receiver can read, bool [R, R]; unread: what all cells of the others
    are set to. Equation 1 is that of the whole vectors, and as the transform is linear, maps are averaged in their
    place. What is left is transformed and cut.
    """
    coded: dict[int, CodedShell] = {}
    sizes = [0] * len(thresholds)
    # Ascending: what a threshold allows, a larger one allows as well, and goes on from there.
    for which in sorted(range(len(thresholds)), key=lambda k: -1.0 if thresholds[k] is None else thresholds[k]):
        threshold = thresholds[which]
        if threshold is not None:
            finer = len(maps)
            maps = reduce_shell(maps.astype(np.float32, copy=False), threshold, matters, map_error)
            size, ratio = len(maps), finer // len(maps)
            matters = matters.reshape(size, ratio, size, ratio).any(axis=(1, 3))
        if len(maps) not in coded:
            coded[len(maps)] = sparsify(np.where(matters[..., None], maps, maps.dtype.type(unread)))
        sizes[which] = len(maps)
    return [coded[size] for size in sizes]


def map_error(difference: np.ndarray) -> np.ndarray:
    """Tamura 2006, Equation 1, of differences between maps [..., CELLS]: all cells have the same solid angle."""
    return np.abs(difference).mean(axis=-1)


def sparsify(maps: np.ndarray) -> CodedShell:
    """Transforms maps [R, R, CELLS] and quantises the largest coefficients of each, in 8 bits."""
    flat = maps.reshape(-1, CELLS)
    parts = [_find_largest(flat[k : k + BLOCK]) for k in range(0, len(flat), BLOCK)]
    index, values = (np.concatenate(column) for column in zip(*parts, strict=True))
    level = coefficient_levels()[index]
    kept = np.abs(values) > SMALLEST
    minimum, step = np.zeros(LEVELS, np.float32), np.zeros(LEVELS, np.float32)
    for k in np.unique(level[kept]):
        of_level = values[kept & (level == k)]
        minimum[k], step[k] = of_level.min(), np.ptp(of_level) / 255
    # A zero errs no more than the code would.
    kept &= np.abs(values) > 0.5 * step[level]
    codes = (values - minimum[level]) / np.where(step > 0, step, 1)[level]
    return CodedShell(
        resolution=len(maps),
        counts=np.count_nonzero(kept, axis=1),
        index=index[kept].astype(np.uint16),
        codes=np.rint(codes[kept]).clip(0, 255).astype(np.uint8),
        minimum=minimum,
        step=step,
    )


def _find_largest(maps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The places, rising, and the values of the largest coefficients of maps [n, CELLS], both [n, MOST_ENTRIES]."""
    vectors = haar.transform(maps.reshape(-1, MAP_SIZE, MAP_SIZE).astype(np.float32)).reshape(-1, CELLS)
    sizes = np.abs(vectors)
    # Maps of zeros and ones have many coefficients of one size. With the place in the last digits no two are alike:
    # the coarser comes first, and partitioning does not dwell on them.
    scaled = sizes * ((2**20 - 1) / np.maximum(sizes.max(axis=1, keepdims=True), SMALLEST))
    keys = scaled.astype(np.uint32) * np.uint32(CELLS) + np.arange(CELLS - 1, -1, -1, dtype=np.uint32)
    largest = np.partition(keys, CELLS - MOST_ENTRIES, axis=1)[:, CELLS - MOST_ENTRIES :]
    index = np.sort(CELLS - 1 - largest % CELLS, axis=1).astype(np.int64)
    return index, np.take_along_axis(vectors, index, axis=1)


def _join(mesh: Mesh, shells: list[CodedShell]) -> WaveletField:
    counts = np.concatenate([shell.counts for shell in shells])
    return WaveletField(
        center=mesh.center.astype(np.float32),
        radius=float(mesh.radius),
        resolutions=np.array([shell.resolution for shell in shells], np.int32),
        first=np.concatenate([[0], np.cumsum(counts)]).astype(np.int32),
        index=np.concatenate([shell.index for shell in shells]),
        codes=np.concatenate([shell.codes for shell in shells]),
        minimum=np.stack([shell.minimum for shell in shells]),
        step=np.stack([shell.step for shell in shells]),
    )
