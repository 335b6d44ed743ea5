"""Brute-force references for deforming bodies that shadow themselves, and what benchmarks drive the method by."""

import time
from fractions import Fraction

import numpy as np
import warp as wp

from warp_psf.bake.coarse import make_blockers
from warp_psf.bake.visible_sets import find_visible_sets
from warp_psf.basis import sh, sphere
from warp_psf.basis.visibility_mask import BATCH, upload_masks
from warp_psf.device import find_device, launch
from warp_psf.field.blockers import BlockerSet
from warp_psf.field.rasterise import BlockerTables, find_planes, is_above
from warp_psf.scene.deforming import Deformed
from warp_psf.scene.topology import area_vectors
from warp_psf.shade.hemisphere import (
    ORIGIN_OFFSET,
    SEEN,
    HemisphereTables,
    bring_shape,
    horizon_of,
    integrate_lobes,
    integrate_masks,
    make_hemisphere,
    rasterise_masks,
    upload_blockers,
)

# A ray goes on behind a face seen from its back by this share of the blockers' extent: enough for float32.
NUDGE = 1.0e-6
# Layers of back faces that a ray crosses before it gives up.
MOST_LAYERS = 32
# Of the largest of the expected vectors: a vertex with less sees next to nothing, and its relative error is the rays'.
VANISHING = 1.0e-2
# Heights and azimuths by which the lobe is integrated over an open hemisphere: errs by 1e-8 for exponents 4 to 100, and
# by 5e-5 for an exponent of 1.
HEIGHTS, AZIMUTHS = 32, 64
# Vertices that are integrated at once: their rays take some tens of megabytes.
CHUNK = 512
# A determinant of float64 numbers whose size is below this share of its terms' may have the wrong sign.
UNSURE = 16.0 * np.finfo(np.float64).eps


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit vertex normals [V, 3] of a welded mesh: of the faces' around, weighted by their area."""
    vectors = np.repeat(area_vectors(np.asarray(vertices, np.float64), faces), 3, axis=0)
    total = np.stack([np.bincount(faces.ravel(), vectors[:, axis], len(vertices)) for axis in range(3)], axis=1)
    return total / np.linalg.norm(total, axis=1, keepdims=True)


# Rays


@wp.kernel(enable_backward=False, module="unique")
def _find_blocked(
    first: int,
    mesh: wp.uint64,
    two_sided: wp.bool,
    reach: float,
    nudge: float,
    origins: wp.array(dtype=wp.vec3),  # (vertex)
    frames: wp.array(dtype=wp.mat33),  # (vertex)
    directions: wp.array(dtype=wp.vec3),  # (ray)
    blocked_out: wp.array2d(dtype=wp.uint8),  # (vertex, ray)
):
    world, vertex = wp.tid()
    vertex += first
    for ray in range(directions.shape[0]):
        direction = frames[vertex] * directions[ray]
        walk = origins[vertex]
        layer = int(0)
        while layer < MOST_LAYERS:
            hit = wp.mesh_query_ray(mesh, walk, direction, reach)
            if hit.result and hit.sign < 0.0 and not two_sided:
                walk += (hit.t + nudge) * direction
                layer += 1
            else:
                if hit.result:
                    blocked_out[vertex, ray] = wp.uint8(1)
                layer = MOST_LAYERS


def cosine_directions(count: int) -> np.ndarray:
    """Unit directions [count, 3] above the horizon of +z, distributed as the cosine: a Fibonacci spiral on the disc."""
    index = np.arange(count) + 0.5
    squared = index / count
    phi = np.pi * (3.0 - np.sqrt(5.0)) * index
    radius = np.sqrt(squared)
    return np.stack([radius * np.cos(phi), radius * np.sin(phi), np.sqrt(1.0 - squared)], axis=-1)


def turned_frames(normals: np.ndarray, seed: int = 0) -> np.ndarray:
    """Rotations [V, 3, 3] whose third columns are the unit normals [V, 3], turned about them by random angles."""
    angle = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, len(normals))
    frames = sphere.frame(normals)
    first = np.cos(angle)[:, None] * frames[..., 0] + np.sin(angle)[:, None] * frames[..., 1]
    return np.stack([first, np.cross(frames[..., 2], first), frames[..., 2]], axis=-1)


def find_blocked(
    origins: np.ndarray,
    frames: np.ndarray,
    directions: np.ndarray,
    blocker_vertices: np.ndarray,
    blocker_faces: np.ndarray,
    two_sided: bool,
) -> np.ndarray:
    """Which rays meet a blocker, uint8 [V, R], 1 or 0.

    origins: [V, 3], metres. frames: [V, 3, 3], in which the unit directions [R, 3] are given. two_sided: whether faces
    that are seen from their back block too.
    """
    device = find_device()
    mesh = wp.Mesh(
        points=wp.array(np.asarray(blocker_vertices, np.float32), dtype=wp.vec3, device=device),
        indices=wp.array(np.asarray(blocker_faces).ravel(), dtype=wp.int32, device=device),
    )
    extent = float(np.ptp(np.concatenate([blocker_vertices, origins]), axis=0).max())
    blocked = wp.zeros((len(origins), len(directions)), dtype=wp.uint8, device=device)
    inputs = [
        mesh.id,
        two_sided,
        4.0 * extent,
        NUDGE * extent,
        wp.array(origins.astype(np.float32), dtype=wp.vec3, device=device),
        wp.array(frames.astype(np.float32), dtype=wp.mat33, device=device),
        wp.array(directions.astype(np.float32), dtype=wp.vec3, device=device),
    ]
    launch(_find_blocked, (1, len(origins)), inputs, [blocked], device)
    return blocked.numpy()


# References


def traced_transfer(
    vertices: np.ndarray,
    normals: np.ndarray,
    blocker_vertices: np.ndarray,
    blocker_faces: np.ndarray,
    two_sided: bool,
    order: int,
    rays: int,
    offset: float,
    seed: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """Visibility times the clamped cosine, and visibility within the upper hemisphere, float64 [V, order^2] each.

    Only what is blocked is sampled: an open vertex gets the closed form. Vectors err by about 1.1
    and 2.6 / rays^(3/4).

    vertices, normals: [V, 3], metres and unit vectors. blocker_vertices, blocker_faces: [B, 3] and [G, 3]. two_sided:
    see `find_blocked`. rays: of each vertex, once as the cosine is distributed and once evenly. offset: of the rays'
    origins from the vertices along the normals, metres. seed: of the angles by which the rays are turned.
    """
    normals = np.asarray(normals, np.float64)
    origins, frames = vertices + offset * normals, turned_frames(normals, seed)
    open_vectors = sh.zonal(sh.clamped_cosine(order), normals), sh.zonal(sh.cap(np.pi / 2, order), normals)
    found = []
    for directions, total, whole in (
        (cosine_directions(rays), np.pi, open_vectors[0]),
        (sphere.fibonacci_cap(rays, np.pi / 2), 2.0 * np.pi, open_vectors[1]),
    ):
        blocked = find_blocked(origins, frames, directions, blocker_vertices, blocker_faces, two_sided)
        functions = sh.evaluate(directions, order) * (total / rays)
        found.append(whole - _turn(_sum_rays(blocked, functions), frames))
    return found[0], found[1]


def phong_transfer(
    vertices: np.ndarray,
    normals: np.ndarray,
    mirrored: np.ndarray,
    exponent: float,
    blocker_vertices: np.ndarray,
    blocker_faces: np.ndarray,
    two_sided: bool,
    order: int,
    rays: int,
    offset: float,
    seed: int = 0,
) -> np.ndarray:
    """Visibility times the clamped cosine to the normal times a Phong lobe, float64 [V, order^2].

    The lobe about the unit directions `mirrored` [V, 3] is (exponent + 2) / (2 pi) max(0, cos)^exponent, as in
    `sh.phong_lobe`. The other arguments are those of `traced_transfer`.
    """
    normals = np.asarray(normals, np.float64)
    origins, frames = vertices + offset * normals, turned_frames(normals, seed)
    axes = np.einsum("vij,vi->vj", frames, mirrored)
    directions = cosine_directions(rays)
    blocked = find_blocked(origins, frames, directions, blocker_vertices, blocker_faces, two_sided)
    functions = sh.evaluate(directions, order) * (np.pi / rays)
    places, weights = _hemisphere_quadrature()
    every_function = sh.evaluate(places, order) * (weights * places[:, 2])[:, None]
    local = []
    for start in range(0, len(normals), CHUNK):
        part = slice(start, start + CHUNK)
        whole = _lobe(axes[part], places, exponent) @ every_function
        local.append(whole - (blocked[part] * _lobe(axes[part], directions, exponent)) @ functions)
    return _turn(np.concatenate(local), frames)


def relative_error(found: np.ndarray, expected: np.ndarray) -> tuple[float, int]:
    """The mean over vertices of |found - expected| / |expected|, of vectors [V, K], and how many were left out.

    Left out are vertices whose expected vector vanishes, see `VANISHING`.
    """
    length = np.linalg.norm(expected, axis=1)
    counted = length > VANISHING * length.max(initial=0.0)
    errors = np.linalg.norm(found - expected, axis=1)[counted] / length[counted]
    return float(errors.mean()), int((~counted).sum())


def exact_coverage(corners: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Whether each of the directions [N, 3] meets the inside of a triangle, bool [N], without rounding.

    corners: relative to the origin of the directions, [3, 3]. Either side of the triangle counts; one that is seen
    edge-on covers nothing. What a direction sees is inside where its determinants with each two corners have the sign
    of that of all three.
    """
    corners, directions = np.asarray(corners, np.float64), np.asarray(directions, np.float64)
    side = _signs(corners[0], corners[1], corners[2:])[0]
    inside = np.full(len(directions), side != 0)
    for one in range(3):
        inside &= _signs(corners[one], corners[(one + 1) % 3], directions) == side
    return inside


def _signs(a: np.ndarray, b: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """The signs [N], -1, 0 or 1, of the determinants of a, b and each direction [N, 3]."""
    normal = np.cross(a, b)
    ends = np.abs(a[[1, 2, 0]] * b[[2, 0, 1]]) + np.abs(a[[2, 0, 1]] * b[[1, 2, 0]])
    values = directions @ normal
    signs = np.sign(values).astype(int)
    exact_a, exact_b = ([Fraction(float(x)) for x in vector] for vector in (a, b))
    exact_normal = [
        exact_a[(axis + 1) % 3] * exact_b[(axis + 2) % 3] - exact_a[(axis + 2) % 3] * exact_b[(axis + 1) % 3]
        for axis in range(3)
    ]
    for index in np.flatnonzero(np.abs(values) <= UNSURE * (np.abs(directions) @ ends)):
        value = sum(Fraction(float(x)) * n for x, n in zip(directions[index], exact_normal, strict=True))
        signs[index] = (value > 0) - (value < 0)
    return signs


def _sum_rays(blocked: np.ndarray, functions: np.ndarray) -> np.ndarray:
    """The sums [V, K] of the functions [R, K] over the blocked rays [V, R]."""
    starts = range(0, len(blocked), CHUNK)
    return np.concatenate([blocked[start : start + CHUNK].astype(np.float64) @ functions for start in starts])


def _turn(local: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """Vectors [V, K] about the axes of frames [V, 3, 3] -> about the world's."""
    order, starts = sh.order_of(local.shape[1]), range(0, len(local), CHUNK)
    parts = [sh.rotation_matrix(frames[start : start + CHUNK], order) for start in starts]
    turned = [
        np.einsum("vij,vj->vi", part, local[start : start + CHUNK]) for part, start in zip(parts, starts, strict=True)
    ]
    return np.concatenate(turned)


def _lobe(axes: np.ndarray, directions: np.ndarray, exponent: float) -> np.ndarray:
    """The normalised lobe about axes [V, 3] in directions [R, 3], [V, R]."""
    return (exponent + 2.0) / (2.0 * np.pi) * np.maximum(axes @ directions.T, 0.0) ** exponent


def _hemisphere_quadrature() -> tuple[np.ndarray, np.ndarray]:
    """Directions [Q, 3] above the horizon of +z and weights [Q], sum 2 pi."""
    heights, weights = np.polynomial.legendre.leggauss(HEIGHTS)
    heights, weights = 0.5 * (heights + 1.0), 0.5 * weights
    phi = 2.0 * np.pi * (np.arange(AZIMUTHS) + 0.5) / AZIMUTHS
    level = np.sqrt(1.0 - heights**2)[:, None]
    parts = np.broadcast_arrays(level * np.cos(phi), level * np.sin(phi), heights[:, None])
    return np.stack(parts, axis=-1).reshape(-1, 3), np.repeat(weights * 2.0 * np.pi / AZIMUTHS, AZIMUTHS)


# The method under test


class HemisphereRun:
    """One body whose masks are rasterised frame after frame. Build it by `prepare`.

    offset: of the masks' origins from the vertices along the normals, metres.
    two_sided: whether the body is open, so that its back hides too.
    coarse_triangles: in the coarse mesh, 0 without one.
    """

    def __init__(self, blockers: BlockerSet, vertices: np.ndarray, order: int, coarse_triangles: int):
        self.device, self.order, self.coarse_triangles = find_device(), order, coarse_triangles
        self.blockers, self.two_sided = blockers, blockers.two_sided
        self.radius = float(np.linalg.norm(vertices - vertices.mean(axis=0), axis=1).max())
        self.offset = ORIGIN_OFFSET * self.radius
        vec, self.itself = make_hemisphere(order).vec, np.arange(len(vertices), dtype=np.int32)
        self.masks = upload_masks(order, self.device)
        self.rows = [wp.zeros(len(vertices), dtype=vec, device=self.device) for _ in range(3)]
        light = np.random.default_rng(0).uniform(size=(3, order * order))
        self.light = wp.array(light.astype(np.float32), dtype=vec, device=self.device)
        self.shaded = wp.zeros(len(vertices), dtype=wp.vec3, device=self.device)
        self.shade = _make_shade(order)
        self._take(blockers)

    def _take(self, blockers: BlockerSet) -> None:
        self.blockers = blockers
        self.state = upload_blockers(blockers, self.itself, self.radius, 1, self.device)

    @classmethod
    def prepare(
        cls, vertices: np.ndarray, normals: np.ndarray, faces: np.ndarray, order: int, coarse: int | None
    ) -> "HemisphereRun":
        """A body at rest: [V, 3] twice, faces [F, 3]; `coarse` triangles afar, None for all of the fine ones."""
        blockers = make_blockers("body", vertices, faces, coarse=coarse or len(faces))
        return cls(blockers, vertices, order, int(blockers.first_of_cluster[-1]) if coarse else 0)

    def update(self, vertices: np.ndarray, normals: np.ndarray) -> None:
        """One frame, from the positions on the host to the shaded vertices, for all vertices."""
        points, directions = (np.asarray(values, np.float32)[None] for values in (vertices, normals))
        bring_shape(self.state, points, directions, points, self.device)
        self.state.table.progress.fill_(SEEN)
        rasterise_masks(self.state, self.masks, self.device)
        integrate_masks(self.state, self.masks, self.order, 0, *self.rows[:2], self.device)
        launch(self.shade, (1, len(self.itself)), [self.rows[0], self.light], [self.shaded], self.device)
        self.shaded.numpy()

    def transfer(self) -> np.ndarray:
        """Visibility times the clamped cosine in the last frame, [V, order^2]."""
        return self.rows[0].numpy().astype(np.float64)

    def visibility(self) -> np.ndarray:
        """Visibility within the upper hemisphere in the last frame, [V, order^2]."""
        return self.rows[1].numpy().astype(np.float64)

    def gloss(self, eye: np.ndarray, exponent: float) -> np.ndarray:
        """What `phong_transfer` is of, in the last frame, [V, order^2], about the mirrored directions of an eye [3]."""
        place = wp.array(np.asarray(eye, np.float32)[None], dtype=wp.vec3, device=self.device)
        integrate_lobes(self.state, self.masks, self.order, place, exponent, 0, self.rows[2], self.device)
        return self.rows[2].numpy().astype(np.float64)

    def triangles_per_vertex(self) -> float:
        """The mean over vertices of the triangles on their lists: near ones, and coarse ones that are not skipped."""
        blockers = self.blockers
        afar = blockers.first_of_cluster[-1] - np.diff(blockers.first_skip)
        return float((np.diff(blockers.first_near) + afar).mean())

    def learn(self, frames: list[np.ndarray], normals: list[np.ndarray]) -> None:
        """From now on only what some vertex position [V, 3] of a recorded motion shows is rasterised."""
        states = [
            Deformed(*(np.asarray(values, np.float32) for values in (vertices, normal, vertices)))
            for vertices, normal in zip(frames, normals, strict=True)
        ]
        self._take(find_visible_sets("body", self.blockers, self.itself, states, self.offset))

    def stage_shares(self, vertices: np.ndarray, normals: np.ndarray) -> dict[str, float]:
        """Shares of the time of a frame: `rasterisation`, `integration`, `transform` and `other`."""
        count = (1, len(self.itself))
        self.update(vertices, normals)

        def seconds(stage) -> float:
            times = []
            for _ in range(15):
                self.state.table.progress.fill_(SEEN)
                start = time.perf_counter()
                stage()
                times.append(time.perf_counter() - start)
            return min(times)

        found = wp.zeros(len(self.itself), dtype=wp.int32, device=self.device)
        frame = seconds(lambda: self.update(vertices, normals))
        draw = seconds(lambda: rasterise_masks(self.state, self.masks, self.device))
        place = seconds(
            lambda: launch(_find_planes, count, [self.state.tables, self.state.blocker_tables], [found], self.device)
        )
        sum_up = seconds(lambda: integrate_masks(self.state, self.masks, self.order, 0, *self.rows[:2], self.device))
        parts = {"rasterisation": draw - place, "integration": sum_up, "transform": place}
        return {name: part / frame for name, part in parts.items()} | {"other": 1.0 - (draw + sum_up) / frame}


def _make_shade(order: int):
    vec = make_hemisphere(order).vec

    @wp.kernel(enable_backward=False, module="unique")
    def shade(
        first: int,
        transfer: wp.array(dtype=vec),  # (vertex)
        light: wp.array(dtype=vec),  # (channel)
        shaded_out: wp.array(dtype=wp.vec3),  # (vertex)
    ):
        _, vertex = wp.tid()
        vertex += first
        row = transfer[vertex]
        shaded_out[vertex] = wp.vec3(wp.dot(row, light[0]), wp.dot(row, light[1]), wp.dot(row, light[2]))

    return shade


@wp.kernel(enable_backward=False, module="unique")
def _find_planes(first: int, body: HemisphereTables, blockers: BlockerTables, sums_out: wp.array(dtype=wp.int32)):
    """The rasteriser without its masks: what is left are the triangles' ways into the vertices' frames."""
    world, vertex = wp.tid()
    vertex += first
    horizon = horizon_of(world, vertex, body)
    place = body[0].blocker_of[vertex]
    total = int(0)
    for index in range(body[0].first_near[place], body[0].first_near[place + 1], wp.static(BATCH)):
        count = body[0].first_near[place + 1] - index
        planes = find_planes(world, 0, index, count, wp.uint32(0), body[0].near, horizon, blockers)
        for lane in range(wp.static(BATCH)):
            total += planes[0, lane] ^ planes[1, lane] ^ planes[2, lane]
    for cluster in range(blockers[0].first_of_cluster.shape[0] - 1):
        if is_above(world, 0, cluster, horizon, blockers):
            end = blockers[0].first_of_cluster[cluster + 1]
            for index in range(blockers[0].first_of_cluster[cluster], end, wp.static(BATCH)):
                planes = find_planes(world, 0, index, end - index, wp.uint32(0), blockers[0].far, horizon, blockers)
                for lane in range(wp.static(BATCH)):
                    total += planes[0, lane] ^ planes[1, lane] ^ planes[2, lane]
    sums_out[vertex] = total
