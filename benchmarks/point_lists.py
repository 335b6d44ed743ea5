"""Priority point lists, beside figures 38 to 40 of Jeng 2005: `python -m benchmarks.point_lists`.

1. Figure 38: how many of a head's points are rendered from ever farther away. The thesis's units of distance are not
   known: its smallest squares are left out beyond 2,000 and before 3,000, so ours are at 2,400.
2. Figure 39: a teapot of 1,024 triangles in few and in many points.
3. Figure 40: a tower in three lists; points per list, points rendered, milliseconds per picture.

Of every picture: holes (pixels without a point whose centre's ray meets the mesh) and pixels beyond the silhouette,
and how far beyond they are.
"""

import argparse
import json
import statistics
import time
from pathlib import Path
from typing import Any

import fast_simplification
import numpy as np
from PIL import Image

import warp_psf as psf
from sims import pisa
from sims.bodies import statue_like, teapot_like
from tests.oracles_area import view_points

WIDTH, HEIGHT = 640, 360
# The thesis's numbers.
HEAD, HEAD_USED = 91_496, {2000: 52_151, 3000: 10_519, 4000: 10_505, 5000: 2_919}
TEAPOT_TRIANGLES = 1_024
TEAPOT = (33_552, 384_828)
TOWER, TOWER_USED = (37_127, 467_183, 1_735_364), 1_215_345
REPEATS = 15
# Twice the smallest square is then 0.7 pixels wide.
LEFT_OUT = 2 / 0.7


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="write the pictures there")
    parser.add_argument("--json", type=Path, metavar="PATH", help="also write the numbers here")
    options = parser.parse_args()
    print(f"{'':<34}{'points':>11}{'thesis':>11}{'used':>11}{'thesis':>11}", end="")
    print(f"{'ms':>8}{'frames/s':>10}{'holes':>7}{'beyond':>8}{'pixels':>8}")
    rows = [*head_rows(options.pictures), *teapot_rows(options.pictures), tower_row(options.pictures)]
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n")


def head_rows(pictures: Path | None) -> list[dict]:
    """Figure 38, with the upper part of a statue for a head: triangles of a millimetre to a centimetre."""
    vertices, faces = statue_like("raised", 1.0, cells=60)
    scene, lists = find_points(vertices - [0, 0, 0.55], faces, HEAD, levels=4)
    points = psf.area_light.upload_points(lists)
    # Where the smallest square is as wide as a pixel; and so many times farther it is left to stand-ins.
    pixel_wide = lists.smallest * HEIGHT / (2 * np.tan(np.radians(20)))
    rows = []
    for distance, thesis in HEAD_USED.items():
        camera = camera_at(np.array([0.3, -1.0, 0.15]), LEFT_OUT * pixel_wide * distance / 2400)
        name = f"head at {distance}"
        rows.append(measure(name, scene, points, lists, camera, HEAD, thesis, pictures))
    return rows


def teapot_rows(pictures: Path | None) -> list[dict]:
    """Figure 39."""
    vertices, faces = teapot_like(rings=40, segments=40)
    vertices = (vertices - vertices.mean(axis=0)) / np.ptp(vertices, axis=0).max()
    vertices, faces = fast_simplification.simplify(vertices.astype(np.float32), faces, target_count=TEAPOT_TRIANGLES)
    rows = []
    for count in TEAPOT:
        scene, lists = find_points(vertices, faces, count, levels=3)
        points = psf.area_light.upload_points(lists)
        distance = lists.smallest * HEIGHT / (2 * np.tan(np.radians(20)))
        camera = camera_at(np.array([0.5, -1.0, 0.6]), max(distance, 1.5))
        name = f"teapot of {len(scene.faces):,} triangles"
        rows.append(measure(name, scene, points, lists, camera, count, None, pictures))
    return rows


def tower_row(pictures: Path | None) -> dict:
    """Figure 40: seen so near that a smallest square is a pixel wide."""
    scene = psf.freeze_scene(pisa.build(), cameras=("front",))
    begin = time.perf_counter()
    lists = psf.area_light.sample_points(scene, smallest=pisa.SMALLEST, levels=3)
    seconds = time.perf_counter() - begin
    points = psf.area_light.upload_points(lists)
    row = measure("tower", scene, points, lists, scene.cameras[0], sum(TOWER), TOWER_USED, pictures)
    counts = ", ".join(f"{own:,} ({thesis:,})" for own, thesis in zip(lists.counts, TOWER, strict=True))
    print(f"tower: lists of {counts}; sampled in {seconds:.1f} s from {len(scene.faces):,} triangles")
    return row | {"lists": lists.counts.tolist(), "sampling seconds": seconds}


def find_points(vertices: np.ndarray, faces: np.ndarray, count: int, levels: int) -> tuple[Any, Any]:
    """A body as a still scene, and lists of nearly `count` points: the side of the squares is searched for."""
    mesh = psf.make_mesh("body", vertices, faces)
    scene = psf.area_light.make_still(mesh.vertices, mesh.faces)
    low, high = 1e-4, 0.1
    for _ in range(18):
        smallest = float(np.sqrt(low * high))
        lists = psf.area_light.sample_points(scene, smallest=smallest, levels=levels)
        low, high = (smallest, high) if lists.counts.sum() > count else (low, smallest)
        if abs(lists.counts.sum() - count) < 0.002 * count:
            break
    return scene, lists


def camera_at(direction: np.ndarray, distance: float) -> Any:
    """A camera that looks at the origin from a distance, metres; 40 degrees from top to bottom."""
    back = direction / np.linalg.norm(direction)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(back, right), back], axis=1)
    return psf.area_light.Camera(distance * back, rotation, half_height=float(np.tan(np.radians(20))))


def measure(
    name: str,
    scene: Any,
    points: Any,
    lists: Any,
    camera: Any,
    thesis: int,
    thesis_used: int | None,
    pictures: Path | None,
) -> dict:
    """A row: counts, time, holes and what is beyond the silhouette."""
    picture = psf.area_light.splat_points(points, camera, WIDTH, HEIGHT)
    taken = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        picture = psf.area_light.splat_points(points, camera, WIDTH, HEIGHT)
        taken.append(time.perf_counter() - begin)
    seen = psf.area_light.make_still(scene.vertices, scene.faces, cameras=[camera])
    there, *_ = view_points(seen, 0, WIDTH, HEIGHT)
    shown = np.isfinite(picture.depth)
    beyond, reach = shown & ~there, 0
    grown = there
    while (beyond & ~grown).any():
        reach, padded = reach + 1, np.pad(grown, 1)
        grown = np.logical_or.reduce([padded[y : y + HEIGHT, x : x + WIDTH] for y in range(3) for x in range(3)])
    row = {
        "name": name,
        "points": int(lists.counts.sum()),
        "used": picture.points,
        "milliseconds": 1e3 * statistics.median(taken),
        "holes": int((there & ~shown).sum()),
        "beyond": int(beyond.sum()),
        "beyond pixels": reach,
    }
    print(
        f"{name:<34}{row['points']:>11,}{thesis:>11,}{row['used']:>11,}"
        f"{'' if thesis_used is None else format(thesis_used, ','):>11}{row['milliseconds']:>8.1f}"
        f"{1e3 / row['milliseconds']:>10.1f}{row['holes']:>7}{row['beyond']:>8}{reach:>8}"
    )
    if pictures:
        pictures.mkdir(parents=True, exist_ok=True)
        Image.fromarray(psf.to_display(picture.color)).save(pictures / f"points-{name.replace(' ', '-')}.png")
    return row


if __name__ == "__main__":
    main()
