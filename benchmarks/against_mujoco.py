"""How far depth and segmentation agree with MuJoCo's own renderer: `MUJOCO_GL=egl python -m benchmarks.against_mujoco`.

Of each view: the share of pixels whose segmentation agrees, the share whose silhouette does (something or nothing
there), and the relative error of depth over the pixels whose segmentation agrees, median and 99th percentile. Views are
the free camera and the first cameras of each model, in its initial state. Models are XML files, by default those of
the simulations. MuJoCo cuts round bodies into 28 slices unless a model says otherwise, which shows in the depth of
bodies that fill the view; `--slices 200` leaves little of that. MuJoCo's renderer needs OpenGL; no picture is larger
than the offscreen buffer that a model asks for.
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
import time
import warnings
from pathlib import Path

import mujoco
import numpy as np

import warp_psf as psf

SIMULATIONS = ("bowling", "falling", "statues", "room")
# Of the objects about which the renderers disagree, so many are named.
MOST_NAMED = 4


def objects_and_depth(renderer, data: mujoco.MjData, camera: int) -> tuple[np.ndarray, np.ndarray]:
    """Segmentation [height, width, 2] and depth [height, width], metres, by either renderer."""
    renderer.update_scene(data, camera)
    renderer.enable_segmentation_rendering()
    objects = renderer.render().copy()
    renderer.enable_depth_rendering()
    depth = renderer.render().copy()
    renderer.disable_depth_rendering()
    return objects, depth


def compare(model: mujoco.MjModel, cameras: int, size: tuple[int, int], options: dict) -> list[dict]:
    """One row of figures per view of a model."""
    width, height = size
    width = min(width, model.vis.global_.offwidth)
    height = min(height, model.vis.global_.offheight)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    rows = []
    theirs = mujoco.Renderer(model, height, width)
    with psf.Renderer(model, height, width, **options) as ours:
        for camera in range(-1, min(model.ncam, cameras)):
            expected, expected_depth = objects_and_depth(theirs, data, camera)
            start = time.perf_counter()
            found, depth = objects_and_depth(ours, data, camera)
            agree = (found == expected).all(axis=2)
            there = agree & (expected[..., 0] >= 0)
            error = np.abs(depth[there] / expected_depth[there] - 1.0)
            rows.append(
                {
                    "camera": "free" if camera < 0 else model.camera(camera).name or str(camera),
                    "size": f"{width}x{height}",
                    "segmentation": float(agree.mean()),
                    "silhouette": float(((found[..., 0] >= 0) == (expected[..., 0] >= 0)).mean()),
                    "depth_median": float(np.median(error)) if len(error) else 0.0,
                    "depth_99": float(np.quantile(error, 0.99)) if len(error) else 0.0,
                    "seconds": time.perf_counter() - start,
                    "disagree_about": disagreements(model, expected, found),
                }
            )
    theirs.close()
    return rows


def disagreements(model: mujoco.MjModel, expected: np.ndarray, found: np.ndarray) -> list[str]:
    """What MuJoCo shows and we show instead, most pixels first."""
    differ = (found != expected).any(axis=2)
    pairs, counts = np.unique(np.concatenate([expected[differ], found[differ]], axis=1), axis=0, return_counts=True)
    most = np.argsort(counts)[::-1][:MOST_NAMED]
    return [f"{counts[i]}: {name(model, pairs[i, :2])} as {name(model, pairs[i, 2:])}" for i in most]


def name(model: mujoco.MjModel, thing: np.ndarray) -> str:
    """What an object id and type stand for."""
    index, kind = map(int, thing)
    if index < 0:
        return "nothing"
    kind_name = mujoco.mju_type2Str(kind) or f"type {kind}"
    return f"{kind_name} {mujoco.mj_id2name(model, kind, index) or index}"


def load_models(paths: list[Path]) -> dict[str, mujoco.MjModel]:
    """Models by name; those that MuJoCo does not load are told of on stderr and left out."""
    if not paths:
        return {scene: importlib.import_module(f"sims.{scene}").build() for scene in SIMULATIONS}
    models = {}
    for path in paths:
        try:
            models[str(path)] = mujoco.MjModel.from_xml_path(str(path))
        except ValueError as error:
            print(f"{path}: not loaded: {' '.join(str(error).split())[:120]}", file=sys.stderr)
    return models


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("models", nargs="*", type=Path, metavar="MODEL.xml")
    parser.add_argument("--size", default="320x240")
    parser.add_argument("--cameras", type=int, default=2, help="at most so many besides the free one")
    parser.add_argument("--slices", type=int, help="into how many MuJoCo is to cut round bodies")
    parser.add_argument("--device")
    parser.add_argument("--json", type=Path, help="file for the figures")
    options = parser.parse_args()
    width, height = map(int, options.size.split("x"))
    try:
        mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8).close()
    except Exception as error:  # every back end fails with errors of its own
        raise SystemExit(
            f"MuJoCo's renderer finds no OpenGL ({error}); set MUJOCO_GL=egl or MUJOCO_GL=osmesa"
        ) from error
    # Light is not looked at.
    cheap = {"environment": None, "order": 2, "bounces": 0, "device": options.device}
    rows = []
    print(
        f"{'segment.':>8} {'silhou.':>8} {'depth 50%':>10} {'depth 99%':>10}  view; pixels that MuJoCo shows as other"
    )
    for title, model in load_models(options.models).items():
        if options.slices:
            model.vis.quality.numslices, model.vis.quality.numstacks = options.slices, options.slices // 2
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                found = compare(model, options.cameras, (width, height), cheap)
        except (ValueError, RuntimeError, mujoco.FatalError) as error:
            print(f"{title}: {error}", flush=True)
            continue
        for row in found:
            rows.append({"model": title} | row)
            short = "/".join(Path(title).parts[-2:])
            print(
                f"{100 * row['segmentation']:7.2f}% {100 * row['silhouette']:7.2f}% {100 * row['depth_median']:9.4f}% "
                f"{100 * row['depth_99']:9.4f}%  {short}, {row['camera']}; {'; '.join(row['disagree_about'])}",
                flush=True,
            )
    if rows:
        good = sum(row["segmentation"] >= 0.995 for row in rows)
        close = sum(row["depth_median"] <= 1e-3 and row["depth_99"] <= 1e-2 for row in rows)
        print(f"{good} of {len(rows)} views agree on 99.5% of pixels, {close} in depth to 0.1% (median) and 1% (99%)")
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
