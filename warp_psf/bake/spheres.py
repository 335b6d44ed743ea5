"""Sphere sets that stand for a mesh (Ren et al. 2006).

The fit is that of Wang et al. 2006, Variational sphere set approximation for solid objects, with both errors in its
objective: the volume that the spheres cover outside the solid and the volume of the solid that they leave uncovered.
Each sphere in turn moves and grows to what serves best beside the others; the least useful go where most is missing.
"""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Integral

import numpy as np
import warp as wp

from warp_psf.bake.shape import unit_shape
from warp_psf.basis.sphere import fibonacci_cap
from warp_psf.device import find_device, launch
from warp_psf.scene.mesh import Mesh
from warp_psf.scene.topology import area_vectors

# More spheres than the samples can tell apart are not fitted.
MOST_SPHERES = 1000
# Samples inside the solid: per sphere, and how few and many in all. With fewer the fit learns the samples by heart.
SAMPLES_PER_SPHERE = 500
SAMPLES_INSIDE = (20_000, 100_000)
LARGEST_LATTICE = 400_000
# A solid so thin that fewer samples of the largest lattice are inside counts as a sheet.
LEAST_INSIDE = 500
PROBES = 8_000  # tell roughly how large a solid is and whether there is one
# Between these winding numbers it is doubtful whether a point of an open mesh is inside. A mesh is a solid when most
# of its inside is beyond doubt: the bunny with holes in its base is, an open bowl is not.
DOUBTFUL_WINDING = (0.25, 0.75)
LEAST_CERTAIN_SHARE = 0.8
# How far the lattice goes beyond the solid at most, in bounding radii; cells along a block that may be skipped at once.
WIDEST_MARGIN = 0.4
BLOCK = 4
# A sphere tries its own centre and a step along each of these directions, and radii up to this multiple of its own.
MOVES = np.concatenate([np.zeros((1, 3)), fibonacci_cap(14)])
LARGEST_GROWTH = 1.25
RADIUS_BINS = 64
RadiusBins = wp.types.vector(length=RADIUS_BINS, dtype=wp.float32)
SMALLEST_DEPTH = 1.0e-12  # bounding radii: what lies exactly on the surface is inside or outside too
# Sweeps over all spheres at first, and after each round of sending a share of them elsewhere.
FIRST_SWEEPS = 10
TELEPORT_ROUNDS = 12
TELEPORT_SWEEPS = 5
TELEPORTED_SHARE = 1.0 / 6.0
# A fit whose loss is a smaller share of the solid is as good as its samples; a sphere that gains a smaller share of
# what spheres have on average fits noise.
NOISE = 0.01
# k-means: points per cluster, and at least; steps; points whose distances are in memory at a time.
CLUSTER_SAMPLES = 100
FEWEST_CLUSTER_SAMPLES = 4000
CLUSTER_STEPS = 20
POINTS_AT_ONCE = 4096


@dataclass(frozen=True, eq=False)
class SphereFit:
    """Spheres that approximate a mesh.

    center: metres, in the mesh's frame, float64 [n, 3]; radius: metres, float64 [n].
    volume_error: the volume that they cover outside the solid and that of the solid which they leave uncovered, over
        the solid's volume; nan for a mesh without a volume, such as cloth. It is measured with samples of its own.
    """

    center: np.ndarray
    radius: np.ndarray
    volume_error: float


@wp.struct
class SampleLattice:
    """One sample at a random place of each cell of a block of cubic cells."""

    points: wp.array(dtype=wp.vec3)  # (cell)
    value: wp.array(dtype=wp.float32)  # (cell): what covering it is worth, negative outside the solid
    covers: wp.array(dtype=wp.int32)  # (cell): how many spheres cover it
    lower: wp.vec3
    cell: float
    shape: wp.vec3i


def fit_spheres(mesh: Mesh, count: int, *, device: str | None = None) -> SphereFit:
    """At most `count` spheres (and 1000) that approximate a mesh; the same ones for the same mesh.

    A solid's spheres make the volume error small (Wang et al. 2006; they may overlap). Where it is thinner than a
    sphere that keeps its share of the projected area, its inside weighs more: else the best approximation of a
    board would be next to nothing. Spheres that would improve nothing are left out. On a mesh without a volume each
    sphere has the projected area of its part of the surface.

    Raises:
        ValueError: the count is no whole number of at least 1, or there is no such device.
    """
    if not isinstance(count, Integral) or count < 1:
        raise ValueError(f"mesh {mesh.name!r}: cannot be approximated by {count} spheres; ask for at least 1")
    count = min(int(count), MOST_SPHERES)
    unit = unit_shape(mesh)
    # Cells along the principal axes fit a board or a rod however it is turned.
    axes = np.linalg.eigh(np.cov(unit.vertices.astype(np.float64).T))[1]
    axes *= np.linalg.det(axes)
    points = unit.vertices @ axes
    area = 0.5 * np.linalg.norm(area_vectors(points, unit.faces), axis=1)
    # The two sides of a closed surface hide each other.
    disc_radius = float(np.sqrt(area.sum() * (0.5 if mesh.closed else 1.0) / (np.pi * count)))
    solid = _Solid(points, unit.faces, mesh.closed, disc_radius, count, find_device(device))
    if solid.is_sheet:
        center, radius, error = *_cover_sheet(points[unit.faces], area, disc_radius, count), float("nan")
    else:
        center, radius = _fit_solid(solid, count)
        error = solid.volume_error(center, radius)
    return SphereFit(mesh.center + mesh.radius * (center @ axes.T), mesh.radius * radius, error)


@wp.kernel(enable_backward=False, module="unique")
def _probe_solid(
    first: int,
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),  # (sample)
    winding: float,
    thickness_out: wp.array(dtype=wp.float32),  # (sample): minus the distance outside
):
    world, sample = wp.tid()
    sample += first
    point = points[sample]
    # Anything of a unit shape lies within this distance of its lattice.
    far = 10.0
    near = wp.mesh_query_point_sign_winding_number(mesh, point, far, 2.0, winding)
    across = point - wp.mesh_eval_position(mesh, near.face, near.u, near.v)
    depth = wp.max(wp.length(across), SMALLEST_DEPTH)
    thickness_out[sample] = -depth
    if near.sign < 0.0:
        # Straight through the solid, from its nearest surface to the opposite one; a ray may leave by a hole.
        opposite = wp.mesh_query_ray(mesh, point, across / depth, far)
        thickness_out[sample] = depth + wp.where(opposite.result, opposite.t, 0.0)


class _Solid:
    """The inside of a mesh of bounding radius 1, as far as samples tell."""

    def __init__(self, points: np.ndarray, faces: np.ndarray, closed: bool, disc_radius: float, count: int, device):
        self.device, self.disc_radius = device, disc_radius
        corners = wp.array(points, dtype=wp.vec3, device=device)
        indices = wp.array(faces.reshape(-1), dtype=wp.int32, device=device)
        self.mesh = wp.Mesh(points=corners, indices=indices, support_winding_number=True)
        margin = min(disc_radius, WIDEST_MARGIN)
        self.lower, self.upper = points.min(axis=0) - margin, points.max(axis=0) + margin
        box = float(np.prod(self.upper - self.lower))
        probes = self._place_samples((box / PROBES) ** (1.0 / 3.0), seed=0)[0]
        possible, certain = ((self._thickness(probes, winding) > 0.0).sum() for winding in DOUBTFUL_WINDING)
        wanted = np.clip(SAMPLES_PER_SPHERE * count, *SAMPLES_INSIDE)
        total = min(wanted * len(probes) / max(certain, 1), LARGEST_LATTICE)
        self.cell = float((box / total) ** (1.0 / 3.0))
        doubtful = not closed and certain <= LEAST_CERTAIN_SHARE * possible
        self.is_sheet = bool(doubtful or certain * total < LEAST_INSIDE * len(probes))

    def lattice(self, seed: int) -> tuple[SampleLattice, np.ndarray, np.ndarray]:
        """Samples, their places [N, 3] and what covering each is worth [N]: -1 outside, at least 1 inside."""
        points, lower, shape = self._place_samples(self.cell, seed)
        middles = lower + BLOCK * self.cell * (np.moveaxis(np.indices(shape // BLOCK), 0, -1).reshape(-1, 3) + 0.5)
        near = self._thickness(middles) > -0.5 * np.sqrt(3.0) * BLOCK * self.cell
        near = np.kron(near.reshape(shape // BLOCK), np.ones((BLOCK, BLOCK, BLOCK), bool)).reshape(-1)
        thickness = np.full(len(points), -1.0)
        thickness[near] = self._thickness(points[near])
        # A sphere of radius a in the middle of a board of thickness t covers w times the inside at no loss up to
        # a = (w + 1) t / 2: with this weight, until it is as large as its share of the board.
        thick = 2.0 * self.disc_radius / np.maximum(thickness, 0.25 * self.cell) - 1.0
        value = np.where(thickness > 0.0, np.maximum(thick, 1.0), -1.0)
        lattice = SampleLattice()
        lattice.points = wp.array(points, dtype=wp.vec3, device=self.device)
        lattice.value = wp.array(value, dtype=wp.float32, device=self.device)
        lattice.covers = wp.zeros(len(points), dtype=wp.int32, device=self.device)
        lattice.lower, lattice.cell, lattice.shape = wp.vec3(*lower), self.cell, wp.vec3i(*map(int, shape))
        return lattice, points, value

    def volume_error(self, center: np.ndarray, radius: np.ndarray) -> float:
        """The volume error of spheres, from samples that no fit has seen."""
        lattice, _, value = self.lattice(seed=2)
        _Spheres(lattice, center, radius, np.zeros(len(center)))
        covered, inside = lattice.covers.numpy() > 0, value > 0.0
        return float((covered != inside).sum() / inside.sum())

    def _place_samples(self, cell: float, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Samples [N, 3] in the cells of a block around the solid, its lower corner and its cells along each axis."""
        shape = BLOCK * np.ceil((self.upper - self.lower) / (BLOCK * cell)).astype(np.int64)
        lower = 0.5 * (self.lower + self.upper - cell * shape)
        cells = np.moveaxis(np.indices(shape), 0, -1).reshape(-1, 3)
        return lower + cell * (cells + np.random.default_rng(seed).random(cells.shape)), lower, shape

    def _thickness(self, points: np.ndarray, winding: float = 0.5) -> np.ndarray:
        """How thick the solid is around points [N, 3], or minus their distance to it: [N]."""
        # The winding number counts the inside of overlapping pieces once and bridges holes, as rays do not.
        out = wp.empty(len(points), dtype=wp.float32, device=self.device)
        inputs = [self.mesh.id, wp.array(points, dtype=wp.vec3, device=self.device), winding]
        launch(_probe_solid, (1, len(points)), inputs, [out], self.device)
        return out.numpy()


def _fit_solid(solid: _Solid, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Centres [n, 3] and radii [n] of at most `count` spheres for a solid of bounding radius 1."""
    lattice, points, value = solid.lattice(seed=1)
    inside = value > 0.0
    center, samples = _cluster(points[inside], count)
    radius = (3.0 / (4.0 * np.pi) * samples) ** (1.0 / 3.0) * solid.cell
    spheres = _Spheres(lattice, center, radius, np.zeros(len(center)))
    spheres.sweep(FIRST_SWEEPS, 0.3)
    moving = int(np.ceil(TELEPORTED_SHARE * (count - 1)))
    loss = spheres.loss(value)
    for _ in range(TELEPORT_ROUNDS):
        missing = points[inside & (lattice.covers.numpy() == 0)]
        if moving == 0 or loss < NOISE * inside.sum() or len(missing) == 0:
            break
        others = spheres.teleported(missing, moving)
        others.sweep(TELEPORT_SWEEPS, 0.15)
        if others.loss(value) < loss:
            spheres, loss = others, others.loss(value)
        else:
            spheres = _Spheres(lattice, spheres.center, spheres.radius, spheres.gain)
            moving //= 2
    useful = spheres.gain >= min(NOISE * inside.sum() / count, spheres.gain.max())
    return spheres.center[useful], spheres.radius[useful]


@wp.func
def cell_of(lattice: SampleLattice, place: float, axis: int) -> int:
    """The cell in which a coordinate lies, or the nearest."""
    cell = int(wp.floor((place - lattice.lower[axis]) / lattice.cell))
    return wp.clamp(cell, 0, lattice.shape[axis] - 1)


@wp.func
def row_cells(lattice: SampleLattice, center: wp.vec3, radius: float, i: int, j: int) -> wp.vec2i:
    """The first cell of the row (i, j) that a ball may meet, and the one after the last."""
    half = 0.5 * lattice.cell
    x = wp.max(wp.abs(lattice.lower[0] + lattice.cell * float(i) + half - center[0]) - half, 0.0)
    y = wp.max(wp.abs(lattice.lower[1] + lattice.cell * float(j) + half - center[1]) - half, 0.0)
    left = radius * radius - x * x - y * y
    reach = wp.sqrt(wp.max(left, 0.0))
    start = (i * lattice.shape[1] + j) * lattice.shape[2]
    first = start + cell_of(lattice, center[2] - reach, 2)
    return wp.vec2i(first, wp.where(left > 0.0, start + cell_of(lattice, center[2] + reach, 2) + 1, first))


@wp.kernel(enable_backward=False, module="unique")
def _measure_gain(
    first: int,
    lattice: SampleLattice,
    centers: wp.array(dtype=wp.vec3),  # (sphere)
    reach: wp.array(dtype=wp.float32),  # (sphere): the largest radius
    gain_out: wp.array(dtype=wp.float32),  # (sphere)
    radius_out: wp.array(dtype=wp.float32),  # (sphere)
):
    world, sphere = wp.tid()
    sphere += first
    center, radius = centers[sphere], reach[sphere]
    bins = RadiusBins()
    bins_per_length = float(RADIUS_BINS) / radius
    for i in range(cell_of(lattice, center[0] - radius, 0), cell_of(lattice, center[0] + radius, 0) + 1):
        for j in range(cell_of(lattice, center[1] - radius, 1), cell_of(lattice, center[1] + radius, 1) + 1):
            row = row_cells(lattice, center, radius, i, j)
            for cell in range(row[0], row[1]):
                if lattice.covers[cell] == 0:
                    distance = wp.length(lattice.points[cell] - center)
                    if distance < radius:
                        bins[wp.min(int(distance * bins_per_length), RADIUS_BINS - 1)] += lattice.value[cell]
    total = float(0.0)
    gain_out[sphere] = 0.0
    radius_out[sphere] = 0.0
    for b in range(RADIUS_BINS):
        total += bins[b]
        if total > gain_out[sphere]:
            gain_out[sphere] = total
            radius_out[sphere] = float(b + 1) / bins_per_length


@wp.kernel(enable_backward=False, module="unique")
def _count_covers(
    first: int,
    lattice: SampleLattice,
    centers: wp.array(dtype=wp.vec3),  # (sphere)
    radii: wp.array(dtype=wp.float32),  # (sphere)
    change: int,
    covers: wp.array(dtype=wp.int32),  # (cell): the lattice's, changed in place
):
    world, sphere = wp.tid()
    sphere += first
    center, radius = centers[sphere], radii[sphere]
    for i in range(cell_of(lattice, center[0] - radius, 0), cell_of(lattice, center[0] + radius, 0) + 1):
        for j in range(cell_of(lattice, center[1] - radius, 1), cell_of(lattice, center[1] + radius, 1) + 1):
            row = row_cells(lattice, center, radius, i, j)
            for cell in range(row[0], row[1]):
                if wp.length(lattice.points[cell] - center) < radius:
                    covers[cell] = covers[cell] + change


class _Spheres:
    """Spheres that are being fitted, and the samples that they cover."""

    def __init__(self, lattice: SampleLattice, center: np.ndarray, radius: np.ndarray, gain: np.ndarray):
        self.lattice, self.cell, self.device = lattice, lattice.cell, lattice.points.device
        self.center, self.radius, self.gain = center, radius, gain
        self.lower = np.array(lattice.lower, np.float64)
        self.upper = self.lower + self.cell * np.array(lattice.shape)
        lattice.covers.zero_()
        for group in _groups_apart(center, radius + self.cell):
            self._count(group, 1)

    def sweep(self, sweeps: int, first_step: float) -> None:
        """Lets every sphere go where it gains most, `sweeps` times, at first by `first_step` radii."""
        step = np.maximum(first_step * self.radius, 0.5 * self.cell)
        for turn in range(sweeps):
            reach = np.maximum(LARGEST_GROWTH * self.radius, self.radius + 2.0 * self.cell)
            # What one sphere covers decides for another: only those move together that cannot meet.
            for group in _groups_apart(self.center, reach + step):
                places = self.center[group, None] + step[group, None, None] * (MOVES if turn % 2 else -MOVES)
                stays = self._improve(group, places, reach[group])
                longer = np.minimum(1.3 * step[group], np.maximum(0.5 * self.radius[group], self.cell))
                step[group] = np.where(stays, 0.5 * step[group], longer)

    def _improve(self, group: np.ndarray, places: np.ndarray, reach: np.ndarray) -> np.ndarray:
        """Gives spheres the best of their places [N, moves, 3] and radii; whether that is the first place [N]."""
        self._count(group, -1)
        # Within the lattice, which knows nothing of what is outside.
        center = np.clip(places, self.lower, self.upper)
        room = np.minimum(center - self.lower, self.upper - center).min(axis=2)
        largest = np.maximum(np.minimum(reach[:, None], room), 0.5 * self.cell)
        gains, radii = (wp.empty(largest.shape, dtype=wp.float32, device=self.device) for _ in range(2))
        centers = wp.array(center.reshape(-1, 3), dtype=wp.vec3, device=self.device)
        inputs = [self.lattice, centers, wp.array(largest.reshape(-1), dtype=wp.float32, device=self.device)]
        launch(_measure_gain, (1, largest.size), inputs, [gains.flatten(), radii.flatten()], self.device)
        best = gains.numpy().argmax(axis=1)
        chosen = np.arange(len(group)), best
        self.center[group], self.radius[group] = center[chosen], radii.numpy()[chosen]
        self.gain[group] = gains.numpy()[chosen]
        self._count(group, 1)
        return best == 0

    def teleported(self, missing: np.ndarray, moving: int) -> _Spheres:
        """The spheres with the `moving` ones that gain least where uncovered points [N, 3] have most room."""
        center, radius = self.center.copy(), self.radius.copy()
        room = np.full(len(missing), np.inf)
        for at, size in zip(center, radius, strict=True):
            room = np.minimum(room, np.linalg.norm(missing - at, axis=1) - size)
        for sphere in np.argsort(self.gain, kind="stable")[:moving]:
            at = int(room.argmax())
            center[sphere], radius[sphere] = missing[at], max(room[at], 0.5 * self.cell)
            room = np.minimum(room, np.linalg.norm(missing - missing[at], axis=1) - radius[sphere])
        return _Spheres(self.lattice, center, radius, self.gain.copy())

    def loss(self, value: np.ndarray) -> float:
        """The value of what is covered and should not be, or should and is not."""
        return float(np.abs(value[(self.lattice.covers.numpy() > 0) != (value > 0.0)]).sum())

    def _count(self, group: np.ndarray, change: int) -> None:
        """Counts spheres that share no sample in (change = 1) or out (-1)."""
        radius = wp.array(self.radius[group], dtype=wp.float32, device=self.device)
        inputs = [self.lattice, wp.array(self.center[group], dtype=wp.vec3, device=self.device), radius, change]
        launch(_count_covers, (1, len(group)), inputs, [self.lattice.covers], self.device)


def _groups_apart(center: np.ndarray, reach: np.ndarray) -> list[np.ndarray]:
    """Indices of spheres, in groups within which none meets another."""
    meets = np.linalg.norm(center[:, None] - center[None], axis=2) < reach[:, None] + reach[None]
    group = np.full(len(center), -1)
    for sphere in np.argsort(-reach, kind="stable"):
        taken = np.bincount(group[meets[sphere]] + 1, minlength=len(center) + 2)[1:]
        group[sphere] = int((taken == 0).argmax())
    return [np.flatnonzero(group == number) for number in range(group.max() + 1)]


def _cover_sheet(corners: np.ndarray, area: np.ndarray, disc_radius: float, count: int):
    """Centres and radii of spheres with the areas of parts of a surface: its faces' corners [F, 3, 3], areas [F]."""
    rng = np.random.default_rng(0)
    samples = max(CLUSTER_SAMPLES * count, FEWEST_CLUSTER_SAMPLES)
    # One sample in each of as many equal shares of the area as there are samples.
    share = (np.arange(samples) + rng.random(samples)) / samples
    face = np.searchsorted(np.cumsum(area) / area.sum(), share).clip(max=len(area) - 1)
    u, v = np.sqrt(rng.random(samples)), rng.random(samples)
    weights = np.stack([1.0 - u, u * (1.0 - v), u * v], axis=1)
    center, size = _cluster((weights[:, :, None] * corners[face]).sum(axis=1), count)
    return center, disc_radius * np.sqrt(size / samples * count)


def _cluster(points: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """k-means: the centres [n, 3] of at most `count` clusters of points [N, 3], and how many points each has [n]."""
    few = points[
        np.random.default_rng(0).permutation(len(points))[: max(CLUSTER_SAMPLES * count, FEWEST_CLUSTER_SAMPLES)]
    ]
    center = few[:count].copy()
    for _ in range(CLUSTER_STEPS):
        cluster = nearest(few, center)
        size = np.bincount(cluster, minlength=len(center))
        center = np.stack([np.bincount(cluster, few[:, axis], minlength=len(center)) for axis in range(3)], axis=1)
        center, size = center[size > 0] / size[size > 0, None], size[size > 0]
    return center, size * (len(points) / len(few))


def nearest(points: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Which of places [M, 3] is nearest to each of points [N, 3]."""
    squared = (places**2).sum(axis=1)
    parts = (points[start : start + POINTS_AT_ONCE] for start in range(0, len(points), POINTS_AT_ONCE))
    return np.concatenate([(squared - 2.0 * part @ places.T).argmin(axis=1) for part in parts])
