"""Which models render, and how long they take: `python -m benchmarks.models [PATH ...] [--pictures DIR] [--json PATH]`.

Every MJCF and URDF file at the paths, files or folders; without any, those that the installed packages gymnasium and
mujoco_warp bring. Each model is rendered in a process of its own, `--frames` frames (3) of its passive simulation at
`--size` (640x360) with three bounces. Columns: shown geoms and occluders, seconds from the start of the process to the
first picture, how many of them the renderer took to be made (baking, where the cache is cold), seconds per later frame,
megabytes of fields. Models that MuJoCo itself does not load are listed with its reason, and do not count.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import subprocess
import sys
import time
import warnings
from pathlib import Path

PACKAGES = ("gymnasium", "mujoco_warp")
# From start to end of one model, seconds: whoever takes longer hangs.
LIMIT = 1800.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paths", nargs="*", type=Path, metavar="PATH", help="models, or folders of models")
    parser.add_argument("--frames", type=int, default=3, metavar="N", help="frames of each model")
    parser.add_argument("--size", default="640x360", metavar="WxH", help="of the pictures")
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="keep the last picture of each model here")
    parser.add_argument("--json", type=Path, metavar="PATH", help="also write the numbers here")
    parser.add_argument("--one", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        print(json.dumps(render(options.one, options)))
        return
    paths = [path for given in options.paths or find_packages() for path in find_models(given)]
    if not paths:
        parser.error("there are no models: give paths, or install gymnasium or mujoco_warp")
    rows = []
    print(f"{'model':60s}{'geoms':>7s}{'bodies':>7s}{'first':>8s}{'made':>8s}{'frame':>8s}{'MB':>7s}")
    for path in paths:
        rows.append(measure(path, options))
        print_row(rows[-1])
    loaded = [row for row in rows if row["status"] != "not loaded"]
    rendered = sum(row["status"] == "rendered" for row in loaded)
    print(f"{rendered} of the {len(loaded)} models that MuJoCo loads render; {len(rows) - len(loaded)} do not load")
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n")


def find_packages() -> list[Path]:
    """The folders of those packages that are installed."""
    specs = [importlib.util.find_spec(name) for name in PACKAGES]
    return [Path(spec.submodule_search_locations[0]) for spec in specs if spec and spec.submodule_search_locations]


def find_models(path: Path) -> list[Path]:
    """A file, or all models in a folder."""
    if path.is_file():
        return [path]
    return sorted(found for ending in ("*.xml", "*.urdf") for found in path.rglob(ending))


def measure(path: Path, options: argparse.Namespace) -> dict:
    """Renders a model in a process of its own."""
    command = [sys.executable, "-m", "benchmarks.models", "--one", str(path), "--frames", str(options.frames)]
    command += ["--size", options.size]
    if options.pictures:
        options.pictures.mkdir(parents=True, exist_ok=True)
        command += ["--pictures", str(options.pictures)]
    start = time.perf_counter()
    try:
        ended = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT)
    except subprocess.TimeoutExpired:
        return {"model": str(path), "status": "failed", "reason": f"took more than {LIMIT:g} s"}
    last = ended.stdout.strip().rpartition("\n")[2]
    if ended.returncode != 0 or not last.startswith("{"):
        reason = ended.stderr.strip().rpartition("\n")[2]
        return {"model": str(path), "status": "failed", "reason": reason or f"exit status {ended.returncode}"}
    row = json.loads(last)
    if row["status"] == "rendered":
        row["first"] = time.perf_counter() - start - row.pop("after_first")
    return row


def render(path: Path, options: argparse.Namespace) -> dict:
    """Renders a model; the seconds that follow the first picture are its `after_first`."""
    import mujoco

    import warp_psf as psf

    row: dict = {"model": str(path)}
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        return row | {"status": "not loaded", "reason": " ".join(str(error).split())}
    data = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    width, height = map(int, options.size.split("x"))
    start = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        renderer = psf.Renderer(model, height, width)
    made = time.perf_counter() - start
    seconds, picture, first = [], None, 0.0
    for frame in range(options.frames):
        if frame:
            mujoco.mj_step(model, data)
            mujoco.mj_forward(model, data)
        start = time.perf_counter()
        renderer.update_scene(data)
        picture = renderer.render()
        seconds.append(time.perf_counter() - start)
        first = first or time.perf_counter()
    if options.pictures and picture is not None:
        from PIL import Image

        Image.fromarray(picture).save(options.pictures / f"{path.parent.name}_{path.stem}.png")
    later = sorted(seconds[1:]) or seconds
    row |= {"geoms": model.ngeom, "occluders": renderer.occluders, "made": made, "frame": later[len(later) // 2]}
    row |= {"megabytes": sum(renderer.field_bytes.values()) / 1e6, "after_first": time.perf_counter() - first}
    return row | {"status": "rendered"}


def print_row(row: dict) -> None:
    """One line of the table."""
    name = "/".join(Path(row["model"]).parts[-3:])[-59:]
    if row["status"] == "rendered":
        numbers = f"{row['geoms']:7d}{row['occluders']:7d}{row['first']:8.2f}{row['made']:8.2f}{row['frame']:8.3f}"
        print(f"{name:60s}{numbers}{row['megabytes']:7.1f}", flush=True)
    else:
        print(f"{name:60s} {row['status']}: {row['reason'][:120]}", flush=True)


if __name__ == "__main__":
    main()
