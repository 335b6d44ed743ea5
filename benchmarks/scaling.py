"""How time and memory grow with bodies, receivers, order and cores: `python -m benchmarks.scaling [PART]`.

Boxes, balls and capsules fall scattered over a floor whose area is in proportion to their number, so that every body
always has as many neighbours; the camera sees the whole floor. In every measured frame all bodies have moved, so that
nothing is kept from the frame before. Every row is measured in a process of its own, after one that fills the caches of
kernels and fields.

Times: the median and the fastest frame, and the median of the processor time of all cores together; where that is
no longer than the frame on two cores, other work held one of them. Memory: by how much the process's resident set grew
past that of a small picture of three bodies, what Warp's arrays hold, and what the baked fields do. Below each table
stands the power of what is varied with which time and memory grow, fitted by least squares in logarithms to the larger
half of the range. It needs Linux, which restricts a process to some cores and tells what it holds.
"""

import argparse
import copy
import dataclasses
import gc
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import mujoco
import numpy as np
import warp as wp

import warp_psf as psf
from sims import add_material, new_stage, step_frames

PARTS = ("bodies", "receivers", "order", "cores")
BODIES = (1, 2, 5, 10, 20, 50, 100, 200)
SIZES = ("160x90", "320x180", "640x360", "960x540", "1280x720")
ORDERS = (2, 3, 4, 5, 6)
# How many bodies lie on the floor where something else is varied.
FEW = 10
# Metres: the floor has the square of this for each body.
SPACING = 0.5
# Metres: half edges of the boxes, radius of the balls, radius and half length of the capsules. Geoms of one shape and
# size share their fields, so that the rows differ in what is shaded and not in what is baked.
SHAPES = (
    (mujoco.mjtGeom.mjGEOM_BOX, (0.11, 0.08, 0.06), "box"),
    (mujoco.mjtGeom.mjGEOM_SPHERE, (0.09, 0.0, 0.0), "ball"),
    (mujoco.mjtGeom.mjGEOM_CAPSULE, (0.06, 0.08, 0.0), "capsule"),
)
# sRGB.
COLOURS = {"floor": (0.75, 0.73, 0.7), "box": (0.75, 0.3, 0.22), "ball": (0.25, 0.45, 0.7), "capsule": (0.85, 0.7, 0.3)}
# Metres and metres per second: the heights from which bodies fall, and how fast they do so at first.
HEIGHTS, SPEED = (0.2, 0.35), 0.3
# Radians per second.
SPIN = 3.0
# Seconds: the bodies are in the air, or have just met the floor.
MOMENT = 0.2
# Of the camera, degrees, and how far it is from the middle of the floor, in sides of the floor.
FIELD_OF_VIEW, DISTANCE = 30.0, (0.0, -1.5, 1.4)
HEADER = "bodies occluders      size receivers order cores   median  fastest processor resident   arrays   fields"
# The columns whose growth is fitted.
FITTED = ("median", "fastest", "processor", "resident", "arrays")


@dataclasses.dataclass(frozen=True)
class Run:
    """One row of a table."""

    bodies: int
    size: str
    order: int
    bounces: int
    cores: int


def build(bodies: int) -> mujoco.MjModel:
    """A floor and bodies scattered over it: one in each of as many cells, chosen by chance, as there are bodies."""
    random = np.random.default_rng(9)
    side = SPACING * np.sqrt(bodies)
    spec = new_stage(tuple(side * np.array(DISTANCE)), (0.0, 0.0, 0.0), FIELD_OF_VIEW)
    for name, colour in COLOURS.items():
        add_material(spec, name, colour)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[side / 2, side / 2, 0.1], material="floor")
    cells = int(np.ceil(np.sqrt(bodies)))
    for number, cell in enumerate(random.permutation(cells * cells)[:bodies]):
        kind, size, name = SHAPES[number % len(SHAPES)]
        # The middle half of the cell, so that few bodies meet in the air.
        place = side * ((np.array(divmod(cell, cells)) + random.uniform(0.25, 0.75, 2)) / cells - 0.5)
        body = spec.worldbody.add_body(pos=[*place, random.uniform(*HEIGHTS)], quat=random.normal(size=4))
        body.add_freejoint()
        body.add_geom(type=kind, size=size, material=name)
    return spec.compile()


def two_states(model: mujoco.MjModel) -> list[mujoco.MjData]:
    """Successive states of thirty in a second, between which every body moves."""
    random = np.random.default_rng(10)
    data = mujoco.MjData(model)
    scales = np.tile([SPEED] * 3 + [SPIN] * 3, model.nbody - 1)
    data.qvel[:] = scales * random.uniform(-1.0, 1.0, model.nv)
    # The simulation yields one object again and again.
    return [copy.copy(state) for state in step_frames(model, data, 30, MOMENT)][-2:]


def measure(run: Run, options: argparse.Namespace) -> dict:
    """Renders one configuration several times: seconds per frame and per stage, and memory, bytes."""
    model = build(run.bodies)
    states = two_states(model)
    # One body of each kind and the smallest picture: what stays when it is closed is Warp, its kernels and the caches.
    small = build(len(SHAPES))
    with open_renderer(small, dataclasses.replace(run, size=SIZES[0]), options) as renderer:
        render_frame(renderer, two_states(small)[0])
    gc.collect()
    before = resident_bytes()
    with open_renderer(model, run, options) as renderer:
        frames, processor, stages = [], [], []
        for frame in range(options.warmup + options.frames):
            start, start_processor = time.perf_counter(), time.process_time()
            render_frame(renderer, states[frame % 2])
            frames.append(time.perf_counter() - start)
            processor.append(time.process_time() - start_processor)
            stages.append(renderer.stage_seconds)
        resident, arrays = resident_bytes() - before, array_bytes()
        frames, processor, stages = (found[options.warmup :] for found in (frames, processor, stages))
        seen = int((renderer.layers()["segmentation"][..., 0] >= 0).sum())
        return dataclasses.asdict(run) | {
            "median": statistics.median(frames),
            "fastest": min(frames),
            "processor": statistics.median(processor),
            "stages": {stage: statistics.median(found[stage] for found in stages) for stage in stages[0]},
            "resident": resident,
            "arrays": arrays,
            "fields": sum(renderer.field_bytes.values()),
            "receivers": seen,
            "occluders": renderer.occluders,
        }


def open_renderer(model: mujoco.MjModel, run: Run, options: argparse.Namespace) -> psf.Renderer:
    """A renderer as the run wants it, in the light of the studio environment alone."""
    width, height = map(int, run.size.split("x"))
    settings = {"order": run.order, "bounces": run.bounces, "device": options.device}
    return psf.Renderer(model, height, width, model_lights=False, **settings)


def render_frame(renderer: psf.Renderer, state: mujoco.MjData) -> None:
    """One frame as a simulation script renders it."""
    renderer.update_scene(state, camera="front")
    renderer.render()


def resident_bytes() -> int:
    """The memory that this process holds now."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def array_bytes() -> int:
    """What Warp's arrays hold, on all devices; those that are views of others hold nothing of their own."""
    gc.collect()
    return sum(each.capacity for each in gc.get_objects() if isinstance(each, wp.array) and each.deleter is not None)


def plan(part: str, bounces: int, options: argparse.Namespace) -> list[Run]:
    """The rows of a part's table."""
    cores = len(os.sched_getaffinity(0))
    usual = Run(FEW, options.size, options.order, bounces, cores)
    if part == "bodies":
        return [dataclasses.replace(usual, bodies=bodies) for bodies in BODIES]
    if part == "receivers":
        return [dataclasses.replace(usual, size=size) for size in SIZES]
    if part == "order":
        return [dataclasses.replace(usual, order=order) for order in ORDERS]
    return [dataclasses.replace(usual, cores=2**power) for power in range(cores.bit_length())]


def measure_apart(run: Run, *more: str) -> dict:
    """Measures in a process of its own, on as many cores as the run says, with `more` options after this process's."""
    only = json.dumps(dataclasses.asdict(run))
    command = [sys.executable, "-m", "benchmarks.scaling", *sys.argv[1:], *more, "--only", only]
    with restricted_to(run.cores):
        output = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
    return json.loads(output.splitlines()[-1])


@contextmanager
def restricted_to(cores: int) -> Iterator[None]:
    """Processes that start meanwhile have this many cores: the renderer launches on those that its process may use."""
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(allowed)[:cores])
    try:
        yield
    finally:
        os.sched_setaffinity(0, allowed)


def exponent(varied: list[float], found: list[float]) -> float:
    """The power of `varied` with which `found` grows over the larger half of the range, at least two values."""
    half = max(2, (len(varied) + 1) // 2)
    if min(found[-half:]) <= 0:
        return float("nan")
    return float(np.polyfit(np.log(varied[-half:]), np.log(found[-half:]), 1)[0])


def print_table(part: str, bounces: int, options: argparse.Namespace) -> list[dict]:
    """Measures the rows of one table and prints them."""
    runs = plan(part, bounces, options)
    print(f"\n{part}, {f'{bounces} bounces' if bounces else 'direct light'}; times in ms, memory in MiB")
    print(HEADER, flush=True)
    rows = []
    for run in runs:
        # Unprinted: compiles kernels and bakes fields, which would show in the memory of the process that does it.
        measure_apart(dataclasses.replace(run, size=SIZES[0]), "--frames", "1", "--warmup", "0")
        rows.append(measure_apart(run))
        print_row(rows[-1])
    print_summary(part, rows)
    return rows


def print_row(found: dict) -> None:
    """One line of a table."""
    times = f"{1e3 * found['median']:9.1f}{1e3 * found['fastest']:9.1f}{1e3 * found['processor']:10.1f}"
    memory = "".join(f"{found[name] / 2**20:9.1f}" for name in ("resident", "arrays", "fields"))
    counts = f"{found['bodies']:6} {found['occluders']:9} {found['size']:>9} {found['receivers']:9}"
    print(f"{counts} {found['order']:5} {found['cores']:5}{times}{memory}", flush=True)


def print_summary(part: str, rows: list[dict]) -> None:
    """The fitted powers, and of bodies what two hundred cost and where."""
    varied = [row[part] for row in rows]
    if len(rows) > 1:
        powers = (f"{name} {exponent(varied, [row[name] for row in rows]):+.2f}" for name in FITTED)
        print(f"power of {part}:", *powers, sep="  ")
    if part == "bodies":
        many, few = rows[-1], rows[BODIES.index(20)]
        ratios = (f"{name} {many[name] / few[name]:.2f}" for name in FITTED)
        print(f"{many['bodies']} bodies to {few['bodies']}:", *ratios, sep="  ")
        whole = sum(many["stages"].values())
        shares = (f"{name} {seconds / whole:.1%}" for name, seconds in many["stages"].items())
        print(f"{many['bodies']} bodies, shares of the stages:", *shares, sep="  ", flush=True)


def main() -> None:
    """Prints the tables."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"what is varied: {', '.join(PARTS)}; all without")
    parser.add_argument("--size", default="320x180", metavar="WxH", help="of the pictures, where it is not varied")
    parser.add_argument("--order", type=int, default=4, help="where it is not varied")
    parser.add_argument("--bounces", type=int, nargs="+", default=[0, 3], help="a table of each part for each")
    parser.add_argument("--frames", type=int, default=7)
    parser.add_argument("--warmup", type=int, default=2)
    parser.add_argument("--device")
    parser.add_argument("--json", type=Path, help="file for the figures")
    parser.add_argument("--only", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.only:
        print(json.dumps(measure(Run(**json.loads(options.only)), options)))
        return
    if unknown := set(options.parts) - set(PARTS):
        parser.error(f"there is no part {', '.join(sorted(unknown))}; choose from {', '.join(PARTS)}")
    tables = {}
    for part in options.parts or PARTS:
        for bounces in options.bounces:
            tables[f"{part}, {bounces} bounces"] = print_table(part, bounces, options)
    if options.json:
        options.json.write_text(json.dumps(tables, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
