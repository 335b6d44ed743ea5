"""The tables of Tamura 2006, section 6: samples per shell, sizes, and the image error against the threshold.

    python -m benchmarks.adaptive_sampling [MESH ...] [--order 4] [--json PATH]

Without a mesh: a teapot, a long statue and a thin box, made here. Bodies with a closed form (boxes, spheres) are baked
as if they had none. The paper's two codes: (L), spherical harmonics; (A), the largest twentieth of the Haar wavelets.
And (S), the silhouette fields that `basis="haar"` renders with.

The image is of the floor under the bodies, seen by a camera, in two lights: a white sky, and a sun of 2 degrees. A
pixel is the share of the light that reaches it. It is compared with that of the same code with all samples (Figure 8)
and with rays to the lights, `off` only where the floor is farther than 1.25 radii from every body: nearer, the renderer
itself uses rays for what silhouettes hide.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

import warp_psf as psf
from sims.bodies import statue_like, teapot_like
from tests.oracles_bake import trace
from tests.oracles_hemisphere import cosine_directions
from tests.oracles_sun import sun_directions

MEGABYTE = 2**20
THRESHOLDS = (0.020, 0.010, 0.005)
CHOSEN = 0.010
# Tamura 2006, Table 1: the 16 innermost of 32 shells are printed. Table 2: MB fixed and adaptive.
PAPER_SHELLS = {
    "Teapot (L)": [8] + [64] * 8 + [32] * 3 + [16] * 4,
    "Teapot (A)": [8] + [64] * 12 + [32] * 3,
    "Statue (L)": [64] * 8 + [32] + [16] * 4 + [8] * 3,
    "Statue (A)": [64] * 10 + [32] * 2 + [16] * 2 + [8] * 2,
    "Plane (L)": [64] * 11 + [32] + [16] * 4,
    "Plane (A)": [64] * 14 + [32] * 2,
}
PAPER_SIZES = {
    "Teapot (L)": (2.0, 0.59),
    "Teapot (A)": (21.9, 13.0),
    "Statue (L)": (2.0, 0.55),
    "Statue (A)": (21.3, 11.7),
    "Plane (L)": (2.0, 0.75),
    "Plane (A)": (19.5, 11.9),
}
WIDTH, HEIGHT = 160, 90
# In bounding radii: how far the bodies stand from each other, and float above the floor, so that no receiver is inside.
SPACING, HOVER = 2.2, 0.02
SUN, SUN_DIAMETER = (1.0, -0.7, 1.4), np.radians(2)
# Rays to a light for its map; and for the reference, of two lattices that are no multiples of each other.
MAP_RAYS, TRACED_RAYS = 2**18, (512, 309)
# Directions to a light at which silhouettes are asked.
SILHOUETTE_RAYS = 1024
# Within so many bounding radii the renderer asks rays in place of silhouettes.
NEAR = 1.25
# Points that are traced at a time.
TRACED_POINTS = 4096


@dataclass(frozen=True)
class Light:
    """A light as directions to it [rays, 3], each of the same share: `directions(rays)`."""

    name: str
    directions: Callable[[int], np.ndarray]


LIGHTS = (
    Light("white sky", cosine_directions),
    Light("sun", lambda rays: sun_directions(np.array(SUN), SUN_DIAMETER, rays)),
)


@dataclass(frozen=True)
class Code:
    """A way to keep fields.

    bake: a mesh's fields for thresholds (None keeps every sample), from a mesh and the SH order. hide: which share of
    each of LIGHTS a field hides from points of the body's frame [N, 3], [N, lights].
    """

    name: str
    bake: Callable[[psf.Mesh, int], dict[float | None, Any]]
    hide: Callable[[Any, np.ndarray], np.ndarray]


@dataclass
class Body:
    """A mesh, and its fields and the seconds that they took, by code."""

    mesh: psf.Mesh
    silhouettes: Any
    fields: dict[str, dict[float | None, Any]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)

    def megabytes(self, code: str, threshold: float | None) -> float:
        """The size of one of its fields."""
        return self.fields[code][threshold].nbytes / MEGABYTE


def bake_harmonics(mesh: psf.Mesh, order: int) -> dict[float | None, Any]:
    """(L), see `Code`."""
    return {
        threshold: psf.bake_mesh(mesh, order, threshold=threshold, use_cache=False).field
        for threshold in (None, *THRESHOLDS)
    }


def hide_by_harmonics(field: Any, points: np.ndarray) -> np.ndarray:
    """(L), see `Code`: coverage times the lights, which are projected as environments are."""
    rows, columns = 360, 720
    area = 2 * np.pi / columns * -np.diff(np.cos(np.linspace(0, np.pi, rows + 1)))
    vectors = []
    for light in LIGHTS:
        x, y, z = light.directions(MAP_RAYS).T
        row, column = np.arccos(z) / np.pi * rows, np.arctan2(y, x) / (2 * np.pi) % 1 * columns
        image = np.histogram2d(row, column, (rows, columns), ((0, rows), (0, columns)))[0] / MAP_RAYS / area[:, None]
        image = np.repeat(image[..., None], 3, axis=-1).astype(np.float32)
        vectors.append(psf.Environment(light.name, image).project(field.order)[:, 0])
    return field.lookup(points) @ np.array(vectors).T


def bake_wavelets(mesh: psf.Mesh, order: int) -> dict[float | None, Any]:
    """(A), see `Code`; the order has no part in it."""
    thresholds = (None, *THRESHOLDS)
    return dict(zip(thresholds, psf.bake_wavelet_fields(mesh, thresholds), strict=True))


def hide_by_wavelets(field: Any, points: np.ndarray) -> np.ndarray:
    """(A), see `Code`: coverage times the lights, on maps of as many cells as the paper's, all of one solid angle."""
    size = 64
    maps = []
    for light in LIGHTS:
        x, y, z = light.directions(MAP_RAYS).T
        row, column = (1 - z) / 2 * size, np.arctan2(y, x) / (2 * np.pi) % 1 * size
        share = np.histogram2d(row, column, (size, size), ((0, size), (0, size)))[0] / MAP_RAYS
        maps.append(share * size**2 / (4 * np.pi))
    return field.double_products(points, np.array(maps))


def hide_by_silhouettes(field: Any, points: np.ndarray) -> np.ndarray:
    """(S), see `Code`."""
    return np.stack([field.hidden_share(points, light.directions(SILHOUETTE_RAYS)) for light in LIGHTS], axis=-1)


# A code that is added here gets its rows in every table.
CODES = (Code("L", bake_harmonics, hide_by_harmonics), Code("A", bake_wavelets, hide_by_wavelets))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("meshes", nargs="*", metavar="MESH", help="OBJ, STL, PLY or GLB files")
    parser.add_argument("--order", type=int, default=4, choices=range(2, 7), help="spherical-harmonics bands of (L)")
    parser.add_argument("--json", type=Path, metavar="PATH", help="also write the numbers here")
    options = parser.parse_args()
    meshes = [psf.load_mesh(path) for path in options.meshes] or own_meshes()
    # A small body first: compiling the kernels is not a mesh's own time.
    psf.bake_mesh(replace(own_meshes()[2], slab=None), options.order, use_cache=False)
    bodies = [bake_body(replace(mesh, slab=None, sphere=None), options.order) for mesh in meshes]
    print_shells(bodies)
    print_sizes(bodies)
    errors, noise = image_errors(bodies)
    print_errors(errors, noise)
    if options.json:
        numbers = {"order": options.order, "bodies": [numbers_of(body) for body in bodies], "image": errors}
        options.json.write_text(json.dumps(numbers | {"noise": noise}, indent=1) + "\n")


def own_meshes() -> list[psf.Mesh]:
    """A nearly isotropic body, a long one and a thin rectangular solid, of about 3,000 vertices each or less."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * [0.2, 0.14, 0.01]
    sides = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    faces = np.array([triangle for a, b, c, d in sides for triangle in ((a, b, c), (a, c, d))])
    return [
        psf.make_mesh("teapot-like", *teapot_like(rings=26, segments=40)),
        psf.make_mesh("statue-like", *statue_like(cells=48)),
        psf.make_mesh("thin box", corners, faces),
    ]


def bake_body(mesh: psf.Mesh, order: int) -> Body:
    """The mesh's fields of all codes."""
    start = time.perf_counter()
    body = Body(mesh, psf.bake_silhouettes(mesh, use_cache=False))
    body.seconds["S"] = time.perf_counter() - start
    for code in CODES:
        start = time.perf_counter()
        body.fields[code.name] = code.bake(mesh, order)
        body.seconds[code.name] = time.perf_counter() - start
    return body


def numbers_of(body: Body) -> dict:
    """What the tables say about a body, for the JSON file."""
    numbers: dict[str, Any] = {"name": body.mesh.name, "vertices": len(body.mesh.vertices)}
    for code in CODES:
        numbers[code.name] = {
            "shells": body.fields[code.name][CHOSEN].resolutions.tolist(),
            "fixed_megabytes": body.megabytes(code.name, None),
            "adaptive_megabytes": {str(threshold): body.megabytes(code.name, threshold) for threshold in THRESHOLDS},
            "saving": 1 - body.megabytes(code.name, CHOSEN) / body.megabytes(code.name, None),
            "bake_seconds": body.seconds[code.name],
        }
    return numbers


def print_shells(bodies: list[Body]) -> None:
    """Table 1."""
    print(f"R_c per shell at threshold {CHOSEN:.3f}, from the centre outwards (the paper prints 16 of its 32)")
    rows = [
        (f"{body.mesh.name} ({code.name})", body.fields[code.name][CHOSEN].resolutions)
        for body in bodies
        for code in CODES
    ]
    for name, row in rows + [(f"paper: {name}", row) for name, row in PAPER_SHELLS.items()]:
        print(f"  {name:<18}" + "".join(f"{resolution:3d}" for resolution in row))


def print_sizes(bodies: list[Body]) -> None:
    """Table 2."""
    heads = ("vertices", "fixed MB", "adaptive MB", "saving", "bake s")
    print(f"\n  {'':<18}{heads[0]:>9}{heads[1]:>10}{heads[2]:>13}{heads[3]:>8}{heads[4]:>8} (of all four thresholds)")
    for body in bodies:
        for code in CODES:
            fixed, adaptive = body.megabytes(code.name, None), body.megabytes(code.name, CHOSEN)
            print(
                f"  {f'{body.mesh.name} ({code.name})':<18}{len(body.mesh.vertices):>9,}{fixed:>10.1f}{adaptive:>13.2f}"
                f"{1 - adaptive / fixed:>8.0%}{body.seconds[code.name]:>8.1f}"
            )
        fixed, compact = body.megabytes("A", None), body.silhouettes.nbytes / MEGABYTE
        print(f"  {f'{body.mesh.name} (S)':<18}{'':>9}{'':>10}{compact:>13.2f}{1 - compact / fixed:>8.0%}", end="")
        print(f"{body.seconds['S']:>8.1f} (saving over (A) fixed, one set of samples)")
    for name, (fixed, adaptive) in PAPER_SIZES.items():
        print(f"  {'paper: ' + name:<18}{'':>9}{fixed:>10.1f}{adaptive:>13.2f}{1 - adaptive / fixed:>8.0%}")


def image_errors(bodies: list[Body]) -> tuple[list[dict], dict[str, float]]:
    """Figure 8, and how far rays are: per light, code and threshold; and the reference's own error per light."""
    halves = [hidden(bodies, lambda body, points, rays=rays: trace_lights(body, points, rays)) for rays in TRACED_RAYS]
    noise = {light.name: rmse(halves[0][:, k] - halves[1][:, k]) / 2 for k, light in enumerate(LIGHTS)}
    traced = np.mean(halves, axis=0)
    off = hidden(bodies, is_near)[:, 0] == 0
    rows = []
    for code in CODES:
        images = {}
        for threshold in (None, *THRESHOLDS):

            def hide(body: Body, points: np.ndarray, code: Code = code, threshold: float | None = threshold):
                return code.hide(body.fields[code.name][threshold], points)

            images[threshold] = hidden(bodies, hide)
            for k, light in enumerate(LIGHTS):
                full, rays = (images[threshold][:, k] - other[:, k] for other in (images[None], traced))
                rows.append(
                    {"light": light.name, "code": code.name, "threshold": threshold}
                    | {"megabytes": sum(body.megabytes(code.name, threshold) for body in bodies)}
                    | {"rmse": rmse(full), "maximum": float(np.abs(full).max())}
                    | {"rmse_rays": rmse(rays), "maximum_rays": float(np.abs(rays).max())}
                    | {"rmse_off": rmse(rays[off])}
                )
    compact = hidden(bodies, lambda body, points: hide_by_silhouettes(body.silhouettes, points))
    for k, light in enumerate(LIGHTS):
        error = compact[:, k] - traced[:, k]
        rows.append(
            {"light": light.name, "code": "S", "threshold": None}
            | {"megabytes": sum(body.silhouettes.nbytes for body in bodies) / MEGABYTE}
            | {"rmse": 0.0, "maximum": 0.0, "rmse_rays": rmse(error), "maximum_rays": float(np.abs(error).max())}
            | {"rmse_off": rmse(error[off])}
        )
    return rows, noise


def rmse(error: np.ndarray) -> float:
    """The root of the mean square."""
    return float(np.sqrt(np.mean(error**2)))


def print_errors(rows: list[dict], noise: dict[str, float]) -> None:
    """Figure 8, as numbers."""
    print(f"\nThe floor, {WIDTH} x {HEIGHT}, as shares of the light that nothing hides (the noise is that of the rays)")
    print(f"  {'':<14}{'':<14}{'':>8}{'against all samples':>22}{'against rays':>22}{'off':>10}")
    print(f"  {'light':<14}{'code':<5}{'threshold':<9}{'MB':>8}{'RMSE':>12}{'maximum':>10}", end="")
    print(f"{'RMSE':>12}{'maximum':>10}{'RMSE':>10}")
    for light in LIGHTS:
        for row in rows:
            if row["light"] != light.name:
                continue
            threshold = "fixed" if row["threshold"] is None else f"{row['threshold']:.3f}"
            print(
                f"  {light.name:<14}{'(' + row['code'] + ')':<5}{threshold:<9}{row['megabytes']:>8.2f}"
                f"{row['rmse']:>12.5f}{row['maximum']:>10.5f}{row['rmse_rays']:>12.5f}{row['maximum_rays']:>10.5f}{row['rmse_off']:>10.5f}"
            )
        print(f"  {light.name:<14}{'noise':<30}{'':>14}{noise[light.name]:>12.5f}")


def hidden(bodies: list[Body], hide: Callable[[Body, np.ndarray], np.ndarray]) -> np.ndarray:
    """The share of each light that is hidden from every pixel that sees the floor [N, lights].

    What the bodies hide is summed: where two hide the same, both count, in each image that is compared.
    """
    points = floor_points(len(bodies))
    total = np.zeros((len(points), len(LIGHTS)))
    for index, body in enumerate(bodies):
        mesh = body.mesh
        # Every body in units of its own bounding sphere.
        shift = np.array([SPACING * (index - 0.5 * (len(bodies) - 1)), 0.0, 0.0])
        p_body = (points - shift) * mesh.radius + [*mesh.center[:2], mesh.vertices[:, 2].min()]
        p_body[:, 2] -= HOVER * mesh.radius
        total += hide(body, p_body)
    return np.clip(total, 0, 1)


def is_near(body: Body, points: np.ndarray) -> np.ndarray:
    """1 where points of the body's frame are within `NEAR` of its radii [N, lights], else 0."""
    near = np.linalg.norm(points - body.mesh.center, axis=1) < NEAR * body.mesh.radius
    return np.repeat(near[:, None].astype(float), len(LIGHTS), axis=1)


def trace_lights(body: Body, points: np.ndarray, rays: int) -> np.ndarray:
    """The share of each light that the body hides from points of its frame [N, lights]."""
    directions = np.concatenate([light.directions(rays) for light in LIGHTS])
    blocks = []
    for begin in range(0, len(points), TRACED_POINTS):
        hits = trace(body.mesh, points[begin : begin + TRACED_POINTS], directions) != 0
        blocks.append(hits.reshape(len(hits), len(LIGHTS), rays).mean(axis=2))
    return np.concatenate(blocks)


def floor_points(count: int) -> np.ndarray:
    """Where the camera's pixels see the floor z = 0 under `count` bodies, in bounding radii [N, 3]."""
    distance = 1.6 * SPACING * max(count, 2)
    eye = np.array([0.0, -distance, 0.75 * distance])
    forward = -eye / np.linalg.norm(eye)
    right = np.array([1.0, 0.0, 0.0])
    up = np.cross(right, forward)
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    # A field of view of 40 degrees from top to bottom.
    scale = 2 * np.tan(np.radians(20)) / HEIGHT
    rays = forward + scale * ((x - WIDTH / 2)[..., None] * right - (y - HEIGHT / 2)[..., None] * up)
    rays = rays.reshape(-1, 3)[rays[..., 2].ravel() < 0]
    return eye - (eye[2] / rays[:, 2:]) * rays


if __name__ == "__main__":
    main()
