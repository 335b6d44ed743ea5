"""The shadow slab on the scene of cubes: samples, quality and updates, beside figure 7 of Jeng 2005.

    python -m benchmarks.shadow_slab [--scene cubes] [--light 0] [--json PATH]

1. Adaptive shadow maps of 7 x 7 light samples at the thesis's sizes: samples per map, their share of a full map of
   513 x 513, and the RMSE of the attenuation map (where light arrives at all) against full maps of 513 x 513, for the
   middle light sample alone (hard shadows) and for all (soft ones); and of both against rays.
2. Milliseconds of an update of a 513 x 513 picture against how many light samples changed, and the slope.
"""

import argparse
import json
import statistics
import time
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

import warp_psf as psf
from tests.oracles_area import sample_irradiance, traced_sight, view_points

SIZES, PICTURE, SAMPLES = (65, 129, 257, 513), 513, 7
# Samples of figure 7, per size.
THESIS = {65: 1453, 129: 3837, 257: 8187, 513: 17655}
CHANGED, REPEATS = (1, 2, 4, 8, 16, 32, 49), 9


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="cubes", help="a module of sims")
    parser.add_argument("--light", type=int, default=0, help="which of its lights")
    parser.add_argument("--json", type=Path, metavar="PATH", help="also write the numbers here")
    options = parser.parse_args()
    simulation: Any = import_module(f"sims.{options.scene}")
    scene = psf.freeze_scene(simulation.build(), cameras=("front",))
    plane = psf.area_light.make_light_plane(simulation.lights()[options.light], SAMPLES, SAMPLES)
    begin = time.perf_counter()
    scene_map = psf.area_light.bake_scene_map(scene, 0, PICTURE, PICTURE)
    print(
        f"{options.scene}, picture {PICTURE} x {PICTURE}: scene map of {scene_map.maps.counts[0]:,} samples "
        f"({scene_map.share:.1%}) in {time.perf_counter() - begin:.2f} s"
    )
    rows = list(quality(scene, plane, scene_map))
    updates = update_times(scene, plane, scene_map)
    if options.json:
        options.json.write_text(json.dumps({"quality": rows, "updates": updates}, indent=1) + "\n")


def quality(scene: Any, plane: Any, scene_map: Any) -> Iterator[dict]:
    """Figure 7, a row at a time, full maps last."""
    levels = int(np.log2(SIZES[-1] - 1))
    begin = time.perf_counter()
    full = psf.area_light.bake_shadow_slab(scene, plane, SIZES[-1], preset=levels)
    full_seconds = time.perf_counter() - begin
    reference = attenuations(scene_map, full)
    traced = traced_attenuations(scene, plane, scene_map)
    print(f"\n{'':<10}{'samples':>10}{'share':>8}{'thesis':>8}{'bake s':>8}{'MB':>7}", end="")
    print(f"{'hard':>9}{'soft':>9}  {'against rays: hard':>18}{'soft':>9}")
    for size in (*SIZES, None):
        begin = time.perf_counter()
        slab = full if size is None else psf.area_light.bake_shadow_slab(scene, plane, size)
        seconds = full_seconds if size is None else time.perf_counter() - begin
        images = attenuations(scene_map, slab)
        row = {
            "size": size or "full",
            "samples": float(slab.maps.counts.mean()),
            "share": float(slab.maps.counts.mean() / SIZES[-1] ** 2),
            "thesis": THESIS[size] / SIZES[-1] ** 2 if size else 1.0,
            "seconds": seconds,
            "megabytes": slab.maps.nbytes / 2**20,
            "hard": rmse(images[0], reference[0]),
            "soft": rmse(images[1], reference[1]),
            "hard_rays": rmse(images[0], traced[0]),
            "soft_rays": rmse(images[1], traced[1]),
        }
        print(
            f"{row['size']!s:<10}{row['samples']:>10,.0f}{row['share']:>8.1%}{row['thesis']:>8.1%}{row['seconds']:>8.2f}"
            f"{row['megabytes']:>7.1f}{row['hard']:>9.4f}{row['soft']:>9.4f}  {row['hard_rays']:>18.4f}"
            f"{row['soft_rays']:>9.4f}"
        )
        yield row


def lights() -> tuple[np.ndarray, np.ndarray]:
    """Templates of the middle sample alone and of all."""
    middle = np.zeros((SAMPLES, SAMPLES))
    middle[SAMPLES // 2, SAMPLES // 2] = 1.0
    return middle, np.ones((SAMPLES, SAMPLES))


def attenuations(scene_map: Any, slab: Any) -> list[np.ndarray]:
    """Attenuation maps for the templates of `lights` [height, width]."""
    view = psf.area_light.SlabView(scene_map, [slab])
    images = []
    for template in lights():
        view.set_light(0, template)
        images.append(view.attenuation()[..., 0])
    return images


def traced_attenuations(scene: Any, plane: Any, scene_map: Any) -> list[np.ndarray]:
    """The same by rays from every pixel's point to every light sample."""
    there, points, flat, normals = view_points(scene, 0, scene_map.width, scene_map.height)
    targets = plane.positions.reshape(-1, 3)
    sight = traced_sight(scene, points, flat, targets)
    sent = sample_irradiance(points, normals, targets, plane.axes[:, 2], plane.cell_area)
    images = []
    for template in lights():
        weight = sent * template.ravel()
        total = weight.sum(axis=1)
        image = np.ones(there.shape)
        image[there] = np.divide((weight * sight).sum(axis=1), total, out=np.ones_like(total), where=total > 0)
        images.append(image)
    return images


def rmse(image: np.ndarray, reference: np.ndarray) -> float:
    """Over all pixels."""
    return float(np.sqrt(np.mean((image - reference) ** 2)))


def update_times(scene: Any, plane: Any, scene_map: Any) -> dict:
    """Milliseconds against changed samples, and the straight line through them."""
    view = psf.area_light.SlabView(scene_map, [psf.area_light.bake_shadow_slab(scene, plane, SIZES[-1])])
    template = np.zeros(SAMPLES * SAMPLES)
    view.set_light(0, template.reshape(SAMPLES, SAMPLES))
    print("\nchanged samples   ms per update")
    times = {}
    for count in CHANGED:
        seconds = []
        for _ in range(REPEATS):
            # Other samples each time: what one update read is not what the next one reads.
            template = np.roll(template, count)
            template[:count] = 1.0 - template[:count]
            begin = time.perf_counter()
            asked = view.set_light(0, template.reshape(SAMPLES, SAMPLES))
            seconds.append((time.perf_counter() - begin) / max(asked, 1) * count)
        times[count] = 1e3 * statistics.median(seconds)
        print(f"{count:>15}{times[count]:>16.1f}")
    slope, start = np.polyfit(CHANGED, [times[count] for count in CHANGED], 1)
    print(f"{slope:.2f} ms per changed sample, and {start:.2f} ms for any update")
    return {"milliseconds": times, "slope": slope, "start": start}


if __name__ == "__main__":
    main()
