"""What a frame costs: `python -m benchmarks.frame`.

Milliseconds per frame, for direct light, for bounced light and per stage, nanoseconds per receiver and occluder, and
the bytes of the baked fields, for bowling, falling, statues and room (and teapots, figure, cloth and chess, where
`--scenes` names them), at 640x360 and 1280x720, shaded at pixels and at vertices. The light is that of the studio
environment; `--lights` takes each scene's own environment and area lights, which closed rooms have in any case. Where
there are no area lights, the last gather of the bounces brings the environment's light along, and direct light is what
is left: the lattice and point lights. In
every measured frame the bodies have moved, so that nothing is kept from the frame before. Every configuration runs in a
process of its own, so that its peak memory is its own.
"""

import argparse
import copy
import importlib
import json
import resource
import statistics
import subprocess
import sys
import time
from collections import deque
from pathlib import Path

import warp_psf as psf

SCENES = ("bowling", "falling", "statues", "room")
SIZES = ("640x360", "1280x720")
SHADINGS = ("pixel", "vertex")
# The frame whose cost is printed, in simulated seconds: the bodies are in motion and close to one another.
MOMENTS = {"bowling": 1.2, "falling": 1.5, "statues": 1.0, "room": 1.0, "teapots": 1.0}
MOMENTS |= {"figure": 1.0, "cloth": 1.5, "chess": 1.0}
# What the Renderer's stages are for; the others (primary visibility, display, ...) belong to neither.
DIRECT = ("shadow fields", "sharp light", "lattice", "shadow rays")
BOUNCES = ("basis irradiances", "light on proxies", "bounces", "last gather")


def measure(scene_name: str, size: str, shading: str, options: argparse.Namespace) -> dict:
    """Renders one configuration several times and returns the medians, seconds."""
    scene = importlib.import_module(f"sims.{scene_name}")
    width, height = map(int, size.split("x"))
    model = scene.build()
    # The last two states, between which every frame moves the bodies; the simulation yields one object again and again.
    states = deque(map(copy.copy, scene.states(model, 30, MOMENTS[scene_name])), maxlen=2)
    own_lights = options.lights or scene.environment() is None
    lights = scene.lights() if own_lights else ()
    environment = scene.environment() if own_lights else "studio"
    with psf.Renderer(
        model,
        height,
        width,
        environment=environment,
        lights=lights,
        order=options.order,
        compose=options.compose,
        bounces=options.bounces,
        shading=shading,
        model_lights=False,
        device=options.device,
    ) as renderer:
        frames, stages = [], []
        for _ in range(options.warmup + options.frames):
            start = time.perf_counter()
            renderer.update_scene(states[0], camera="front")
            renderer.render()
            frames.append(time.perf_counter() - start)
            stages.append(renderer.stage_seconds)
            states.rotate()
        frames, stages = frames[options.warmup :], stages[options.warmup :]
        layers = renderer.layers()
        seen = int((layers["segmentation"][..., 0] >= 0).sum())
        receivers = seen if shading == "pixel" else renderer.vertices
        occluders, field_bytes = renderer.occluders, renderer.field_bytes
    per_stage = {stage: statistics.median(found[stage] for found in stages) for stage in stages[0]}
    direct, bounces = (sum(per_stage.get(stage, 0.0) for stage in group) for group in (DIRECT, BOUNCES))
    return {
        "scene": scene_name,
        "size": size,
        "shading": shading,
        "order": options.order,
        "bounce_count": options.bounces,
        "frame": statistics.median(frames),
        "direct": direct,
        "bounces": bounces,
        "ratio": bounces / max(direct, 1e-9),
        "stages": per_stage,
        "receivers": receivers,
        "occluders": occluders,
        "field_bytes": field_bytes,
        "ns_per_receiver_and_occluder": 1e9 * per_stage.get("shadow fields", 0.0) / max(receivers * occluders, 1),
        "peak_memory_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
    }


def measure_direct(scene_name: str, order: int, compose: str) -> float:
    """How long direct light of a frame of 640x360 takes, seconds."""
    defaults = {"bounces": 0, "lights": False, "frames": 7, "warmup": 2, "device": None}
    options = argparse.Namespace(order=order, compose=compose, **defaults)
    return measure(scene_name, "640x360", "pixel", options)["direct"]


def print_row(found: dict) -> None:
    """One line of the table."""
    stages = "  ".join(f"{name} {1e3 * seconds:.1f}" for name, seconds in found["stages"].items())
    print(
        f"{found['scene']:9} {found['size']:>8} {found['shading']:6} {1e3 * found['frame']:8.1f} ms/frame "
        f"{1e3 * found['direct']:7.1f} direct {1e3 * found['bounces']:7.1f} bounces {found['ratio']:5.2f} ratio "
        f"{found['ns_per_receiver_and_occluder']:7.1f} ns {found['receivers']:8} x {found['occluders']:2} "
        f"{found['peak_memory_bytes'] / 2**20:6.0f} MiB   {stages}",
        flush=True,
    )


def print_fields(found: dict) -> None:
    """What is baked for a scene, megabytes."""
    sizes = found["field_bytes"]
    parts = "  ".join(f"{name} {size / 1e6:.1f}" for name, size in sizes.items())
    print(f"{found['scene']:9} fields, MB: {parts}  together {sum(sizes.values()) / 1e6:.1f}", flush=True)


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=list(MOMENTS))
    parser.add_argument("--sizes", nargs="+", default=list(SIZES))
    parser.add_argument("--shadings", nargs="+", default=list(SHADINGS))
    parser.add_argument("--order", type=int, default=4)
    parser.add_argument("--compose", default="product", choices=["product", "log"])
    parser.add_argument("--bounces", type=int, default=3)
    parser.add_argument("--lights", action="store_true", help="with the scene's own environment and area lights")
    parser.add_argument("--frames", type=int, default=7)
    parser.add_argument("--warmup", type=int, default=2)
    parser.add_argument("--device")
    parser.add_argument("--json", type=Path, help="file for the figures")
    parser.add_argument("--only", nargs=3, metavar=("SCENE", "SIZE", "SHADING"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.only:
        print(json.dumps(measure(*options.only, options)))
        return
    rows = []
    print("ns: of the stage `shadow fields`, if any, on all cores together, per receiver and occluder; the rest in ms")
    print(f"direct: {' + '.join(DIRECT)}; bounces: {' + '.join(BOUNCES)}; ratio: of bounces to direct")
    for scene in options.scenes:
        for size in options.sizes:
            for shading in options.shadings:
                command = [sys.executable, "-m", "benchmarks.frame", *sys.argv[1:], "--only", scene, size, shading]
                output = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
                rows.append(json.loads(output.splitlines()[-1]))
                print_row(rows[-1])
        print_fields(rows[-1])
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
