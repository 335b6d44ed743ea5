"""The layered area light map on three scenes, beside table 2 of Jeng 2005: `python -m benchmarks.layered_map`.

Seconds to make the map and to render pictures of 512 x 512: projected forward, retrieved backward, and traced with a
ray from every pixel to every light sample. The thesis's are of a Pentium III with 866 MHz.

RMSE against the traced picture: of the share of the light that arrives, where any is sent, and of the picture, scaled
to a mean luminance of 0.5 over what is lit and clamped to [0, 1]; for a map of 512 x 512, and for smaller ones.
"""

import argparse
import json
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

import warp_psf as psf
from benchmarks.accuracy import LUMINANCE

# Triangles, and seconds of table 2: pre-processing, forward projection, backward retrieval, ray tracing.
THESIS = {
    "spiralling_boxes": (148, (256.0, 1.892, 0.425, 284.0)),
    "garden": (1273, (1675.0, 2.183, 1.405, 1446.0)),
    "bunny": (16301, (6386.0, 2.312, 0.611, 3364.0)),
}
COLUMNS = ("pre-processing", "forward", "backward", "ray traced")
PICTURE, MAP_SIZES, REPEATS = 512, (512, 256, 128), 5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help=f"of {', '.join(THESIS)}; all without")
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="write forward, traced and backward there")
    parser.add_argument("--json", type=Path, metavar="PATH", help="also write the numbers here")
    options = parser.parse_args()
    chosen = options.scenes or list(THESIS)
    if set(chosen) - set(THESIS):
        parser.error(f"choose scenes of {', '.join(THESIS)}")
    # Compiling kernels is no scene's own time.
    measure("spiralling_boxes", 32, 32)
    print(f"{'seconds':<18}{'triangles':>10}" + "".join(f"{name:>24}" for name in COLUMNS))
    rows, pictures = [], {}
    for name in chosen:
        triangles, pictures[name], seconds = measure(name, MAP_SIZES[0], PICTURE)
        cells = [
            f"{own:8.3f} ({theirs:g}, {theirs / own:.0f}x)"
            for own, theirs in zip(seconds, THESIS[name][1], strict=True)
        ]
        print(f"{name:<18}{triangles:>10,}" + "".join(f"{cell:>24}" for cell in cells))
        rows.append({"scene": name, "triangles": triangles} | dict(zip(COLUMNS, seconds, strict=True)))
    print(f"\n{'RMSE':<18}{'map':>6}{'share: forward':>17}{'backward':>11}{'picture: forward':>19}{'backward':>11}")
    errors = []
    for name in chosen:
        for size in MAP_SIZES:
            found = pictures[name] if size == MAP_SIZES[0] else measure(name, size, PICTURE, repeats=1)[1]
            errors.append({"scene": name, "map": size} | compare(found))
            print(f"{name:<18}{size:>6}" + "".join(f"{errors[-1][key]:>{w}.4f}" for key, w in KEYS.items()))
    if options.pictures:
        options.pictures.mkdir(parents=True, exist_ok=True)
        for name, found in pictures.items():
            shown = np.concatenate([found[key].color for key in ("forward", "ray traced", "backward")], axis=1)
            Image.fromarray(psf.to_display(shown)).save(options.pictures / f"layered-{name}.png")
    if options.json:
        options.json.write_text(json.dumps({"seconds": rows, "rmse": errors}, indent=1) + "\n")


KEYS = {"share forward": 17, "share backward": 11, "picture forward": 19, "picture backward": 11}


def measure(name: str, size: int, picture: int, repeats: int = REPEATS) -> tuple[int, dict[str, Any], list[float]]:
    """A scene's triangles, its pictures and the seconds that they took, in the order of `COLUMNS`."""
    simulation: Any = import_module(f"sims.{name}")
    scene = psf.freeze_scene(simulation.build(), cameras=("front",))
    (light,) = simulation.lights()
    begin = time.perf_counter()
    layers = psf.area_light.upload_layers(psf.area_light.bake_layered_map(scene, light, size), scene)
    seconds = [time.perf_counter() - begin]
    methods: dict[str, tuple[Callable, int]] = {
        "forward": (psf.area_light.project_forward, repeats),
        "backward": (psf.area_light.retrieve_backward, repeats),
        "ray traced": (psf.area_light.trace_view, 1),
    }
    pictures = {}
    for key, (method, times) in methods.items():
        taken = []
        for _ in range(times):
            begin = time.perf_counter()
            pictures[key] = method(layers, scene.cameras[0], picture, picture)
            taken.append(time.perf_counter() - begin)
        seconds.append(sorted(taken)[len(taken) // 2])
    return len(scene.faces), pictures, seconds


def compare(pictures: dict[str, Any]) -> dict[str, float]:
    """RMSE of shares and pictures."""
    traced = pictures["ray traced"]
    sent = traced.surface >= 0
    luminance = traced.color @ LUMINANCE
    scale = 0.5 / luminance[luminance > 0].mean()
    found = {}
    for key in ("forward", "backward"):
        share = pictures[key].visibility - traced.visibility
        shown = np.clip(scale * pictures[key].color, 0, 1) - np.clip(scale * traced.color, 0, 1)
        found[f"share {key}"] = float(np.sqrt(np.mean(share[sent] ** 2)))
        found[f"picture {key}"] = float(np.sqrt(np.mean(shown**2)))
    return found


if __name__ == "__main__":
    main()
