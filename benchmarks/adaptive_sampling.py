"""The tables of Tamura 2006, section 6: samples per shell, sizes, and the image error against the threshold.

    python -m benchmarks.adaptive_sampling [MESH ...] [--order 4] [--json PATH]

Without a mesh: a teapot, a long statue and a thin box, made here. Bodies with a closed form (boxes, spheres) are baked
as if they had none. The image is of the floor under the bodies, seen by a camera, in the light of a white sky.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

import warp_psf as psf
from sims.bodies import statue_like, teapot_like

MEGABYTE = 2**20
THRESHOLDS = (0.020, 0.010, 0.005)
CHOSEN = 0.010
# Tamura 2006, Table 1, rows (L): the 16 innermost of 32 shells are printed. Table 2: MB fixed and adaptive.
PAPER_SHELLS = {
    "Teapot": [8] + [64] * 8 + [32] * 3 + [16] * 4,
    "Statue": [64] * 8 + [32] + [16] * 4 + [8] * 3,
    "Plane": [64] * 11 + [32] + [16] * 4,
}
PAPER_SIZES = {"Teapot": (2.0, 0.59), "Statue": (2.0, 0.55), "Plane": (2.0, 0.75)}
WIDTH, HEIGHT = 320, 180
# The clamped cosine about +z on the bands 0 to 5 (Ramamoorthi and Hanrahan 2001); only m = 0 is not zero.
COSINE = np.sqrt(np.pi) * np.array([1 / 2, 1 / np.sqrt(3), np.sqrt(5) / 8, 0.0, -1 / 16, 0.0])
# In bounding radii: how far the bodies stand from each other, and float above the floor, so that no receiver is inside.
SPACING, HOVER = 2.2, 0.02


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("meshes", nargs="*", metavar="MESH", help="OBJ, STL, PLY or GLB files")
    parser.add_argument("--order", type=int, default=4, choices=range(2, 7), help="spherical-harmonics bands")
    parser.add_argument("--json", type=Path, metavar="PATH", help="also write the numbers here")
    options = parser.parse_args()
    meshes = [psf.load_mesh(path) for path in options.meshes] or own_meshes()
    # A small body first: compiling the kernels is not a mesh's own time.
    bake_body(replace(own_meshes()[2], slab=None), options.order)
    bodies = [bake_body(replace(mesh, slab=None, sphere=None), options.order) for mesh in meshes]
    print_shells(bodies)
    print_sizes(bodies)
    errors = image_errors(bodies)
    print_errors(errors)
    if options.json:
        rows = [{key: value for key, value in body.items() if key not in {"mesh", "fields"}} for body in bodies]
        options.json.write_text(json.dumps({"order": options.order, "bodies": rows, "image": errors}, indent=1) + "\n")


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


def bake_body(mesh: psf.Mesh, order: int) -> dict:
    """The mesh, its fields by threshold (None keeps every sample), and what is printed of them."""
    fields, seconds = {}, {}
    for threshold in (None, *THRESHOLDS):
        start = time.perf_counter()
        fields[threshold] = psf.bake_mesh(mesh, order, threshold=threshold, use_cache=False).field
        seconds[threshold] = time.perf_counter() - start
    fixed, adaptive = fields[None].nbytes / MEGABYTE, fields[CHOSEN].nbytes / MEGABYTE
    return {
        "mesh": mesh,
        "fields": fields,
        "name": mesh.name,
        "vertices": len(mesh.vertices),
        "shells": fields[CHOSEN].resolutions.tolist(),
        "fixed_megabytes": fixed,
        "adaptive_megabytes": {str(threshold): fields[threshold].nbytes / MEGABYTE for threshold in THRESHOLDS},
        "saving": 1 - adaptive / fixed,
        "bake_seconds": seconds[CHOSEN],
    }


def print_shells(bodies: list[dict]) -> None:
    """Table 1."""
    print(f"R_c per shell at threshold {CHOSEN:.3f}, from the centre outwards (the paper prints 16 of its 32)")
    for name, row in [(body["name"], body["shells"]) for body in bodies] + [
        (f"paper: {name}", row) for name, row in PAPER_SHELLS.items()
    ]:
        print(f"  {name:<16}" + "".join(f"{resolution:3d}" for resolution in row))


def print_sizes(bodies: list[dict]) -> None:
    """Table 2."""
    print(f"\n  {'':<16}{'vertices':>9}{'fixed MB':>10}{'adaptive MB':>13}{'saving':>8}{'bake s':>8}")
    for body in bodies:
        adaptive = body["adaptive_megabytes"][str(CHOSEN)]
        print(
            f"  {body['name']:<16}{body['vertices']:>9,}{body['fixed_megabytes']:>10.1f}{adaptive:>13.2f}"
            f"{body['saving']:>8.0%}{body['bake_seconds']:>8.1f}"
        )
    for name, (fixed, adaptive) in PAPER_SIZES.items():
        print(f"  {'paper: ' + name:<16}{'':>9}{fixed:>10.1f}{adaptive:>13.2f}{1 - adaptive / fixed:>8.0%}")


def image_errors(bodies: list[dict]) -> list[dict]:
    """Figure 8: per threshold, the floor's irradiance against that of the full fields, as shares of the unshadowed."""
    full = floor_irradiance(bodies, None)
    rows = []
    for threshold in THRESHOLDS:
        error = np.abs(floor_irradiance(bodies, threshold) - full)
        megabytes = sum(body["adaptive_megabytes"][str(threshold)] for body in bodies)
        rmse, most = float(np.sqrt((error**2).mean())), float(error.max())
        rows.append({"threshold": threshold, "megabytes": megabytes, "rmse": rmse, "maximum": most})
    return rows


def print_errors(rows: list[dict]) -> None:
    """Figure 8, as numbers."""
    print(
        f"\nIrradiance of the floor, {WIDTH} x {HEIGHT}, against the full fields (shares of the unshadowed irradiance)"
    )
    print(f"  {'threshold':>9}{'MB':>8}{'RMSE':>10}{'maximum':>10}")
    for row in rows:
        print(f"  {row['threshold']:>9.3f}{row['megabytes']:>8.2f}{row['rmse']:>10.5f}{row['maximum']:>10.5f}")


def floor_irradiance(bodies: list[dict], threshold: float | None) -> np.ndarray:
    """Under a white sky, a share of the unshadowed, at every pixel that sees the floor [N].

    What the bodies hide is summed: where two hide the same, both count, in each image that is compared.
    """
    points = floor_points(len(bodies))
    order = bodies[0]["fields"][threshold].order
    zonal = np.arange(order) * (np.arange(order) + 1)
    irradiance = np.ones(len(points))
    for index, body in enumerate(bodies):
        mesh = body["mesh"]
        # Every body in units of its own bounding sphere.
        shift = np.array([SPACING * (index - 0.5 * (len(bodies) - 1)), 0.0, 0.0])
        p_body = (points - shift) * mesh.radius + [*mesh.center[:2], mesh.vertices[:, 2].min()]
        p_body[:, 2] -= HOVER * mesh.radius
        irradiance -= body["fields"][threshold].lookup(p_body)[:, zonal] @ COSINE[:order] / np.pi
    return irradiance


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
