"""Shadows with sharp edges, by spherical harmonics and by Haar wavelets: `python -m benchmarks.all_frequency`.

1. A statue on a floor under a small sun and nothing else (`--suns`, degrees): direct light at every pixel's centre,
   against rays to all of the sun's disc. RMSE over all surfaces and over the floor; the reference is scaled to a mean
   luminance of 0.5 over what it shows lit, and both are clamped to [0, 1]. `noise` is the reference's own error,
   `ratio` the RMSE over that of the basis named first.
2. The width of the penumbra on the floor, from 10 % to 90 % of the sun, across the edge of the same shadow at several
   places, against that of the reference; and how far the edge (50 %) is off, as a share of that width.
3. Several bodies in the light of a window, which is an area light or a bright patch in the environment: RMSE as above.
4. Milliseconds per frame of `sims.sunlit` with three bounces, and the factor over the paper's 0.1 frames per second
   (Iwasaki 2007, figure 8); the bodies move between frames.
"""

import argparse
import copy
import dataclasses
import json
import statistics
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image

import warp_psf as psf
from benchmarks.accuracy import LUMINANCE, pixel_points, render, settle
from sims import statues, sunlit
from tests.oracles import world_triangles
from tests.oracles_bounce import traced_bounces
from tests.oracles_sun import traced_environment, traced_sun

SH_ORDER = 6
# Simulated seconds at which the statue is looked at: it shows the sun its broad side.
MOMENT = 2.5
# Bodies in the light of a window: a scene, and what the window is.
WINDOWS = (("statues", "area light"), ("statues", "patch"), ("falling", "patch"))
# Rays per pixel of the two halves of a reference: of the sun two lattices that are no multiples of each other.
SUN_RAYS, WINDOW_RAYS = (256, 309), 128
# Frames per second of the paper's scene.
PAPER_FRAMES_PER_SECOND = 0.1
# A shadow is searched for edges at points so far apart, metres.
GRID = 0.01
# Edges are measured at so many places, on lines that reach so many widths of the widest penumbra to either side.
PLACES, REACH = 8, 1.5
# A line is used where the reference is dark at one end and light at the other, to these shares, and never turns back by
# more than so much.
DARK, LIGHT, TURN = 0.03, 0.97, 0.01
LOW, HIGH = 0.1, 0.9
# Of the pictures that look straight down at an edge: pixels, and metres above it.
STRIP, HOVER = (256, 17), 3.0
LINE_RAYS = 1024


@dataclasses.dataclass(frozen=True)
class Case:
    """A frame that is compared, without highlights and antialiasing.

    trace: irradiance of points [N, 3] with normals [N, 3], in two halves with independent errors, [2, N, 3].
    """

    name: str
    model: mujoco.MjModel
    data: mujoco.MjData
    environment: psf.Environment
    lights: tuple
    trace: Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclasses.dataclass(frozen=True)
class Edge:
    """A line on the floor across the edge of a shadow.

    place: where half of the sun is seen, [2]; onward: into the light, [2]; width: from 10 % to 90 %, metres.
    reach: of the line to either side, metres.
    """

    place: np.ndarray
    onward: np.ndarray
    width: float
    reach: float


def renderer_options(basis: str) -> dict:
    """What a renderer is told for one of the two."""
    return {"order": SH_ORDER} if basis == "sh" else {"basis": basis}


def sun_case(degrees: float) -> Case:
    """The statue of `sims.sunlit`, all of it grey, under the sun alone."""
    model = sunlit.build()
    model.mat_specular[:] = 0.0
    # On a red floor the clamp would hide what is wrong with red.
    model.mat_rgba[:, :3] = 0.7
    model.vis.quality.offsamples = 0
    # The last state; a deque of one forgets the others.
    data = deque(sunlit.states(model, 30, MOMENT), maxlen=1).pop()
    diameter = np.radians(degrees)
    radiance = np.array(sunlit.SUN_IRRADIANCE) / (np.pi * np.sin(diameter / 2) ** 2)

    def trace(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        toward = sunlit.sun_direction()
        halves = [traced_sun(model, data, points, normals, toward, diameter, rays)[1] for rays in SUN_RAYS]
        return np.stack(halves)[..., None] * radiance

    environment = psf.Environment("sun", sunlit.sun(diameter))
    return Case(f"sun of {degrees:g} degrees", model, data, environment, (), trace)


def window_case(scene: str, window: str) -> Case:
    """A simulation's moving bodies in the light of a window, and of a dim sky."""
    model, data = settle(scene)
    if window == "patch":
        environment, lights = psf.Environment("window", sunlit.sky() + sunlit.window()), ()
    else:
        environment, lights = statues.environment(), statues.lights()

    def trace(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        halves = [
            traced_environment(model, data, points, normals, environment.radiance, WINDOW_RAYS, seed) for seed in (0, 1)
        ]
        if lights:
            options = {"bounces": 0, "lights": lights, "paths": WINDOW_RAYS}
            for seed in (0, 1):
                halves[seed] += traced_bounces(model, data, points, normals, seed=seed, **options)[0]
        return np.stack(halves)

    return Case(f"{scene}, {window}", model, data, environment, lights, trace)


def trace_reference(case: Case, layers: dict) -> np.ndarray:
    """Radiance of the pixels that show something, in two halves, [2, N, 3]."""
    seen = layers["segmentation"][..., 0] >= 0
    return layers["albedo"][seen] / np.pi * case.trace(layers["points"][seen], layers["normal"][seen])


def compare(layers: dict, halves: np.ndarray) -> tuple[dict, np.ndarray]:
    """The figures of a rendered frame, and rendered and reference as they are compared, [2, H, W, 3]."""
    seen = layers["segmentation"][..., 0] >= 0
    geom = layers["segmentation"][..., 0][seen]
    floor = geom == np.bincount(geom).argmax()
    luminance = halves.mean(axis=0) @ LUMINANCE
    scale = 0.5 / luminance[luminance > 0.0].mean()
    pictures = np.zeros((2, *seen.shape, 3))
    pictures[:, seen] = np.clip(scale * np.stack([layers["direct"][seen], halves.mean(axis=0)]), 0, 1)
    error = pictures[0][seen] - pictures[1][seen]

    def rms(values: np.ndarray) -> float:
        return float(np.sqrt(np.mean(values**2)))

    # The halves differ by twice the error of their mean.
    noise = 0.5 * rms(np.diff(np.clip(scale * halves, 0, 1), axis=0))
    return {"whole": rms(error), "floor": rms(error[floor]), "noise": noise}, pictures


def measure_case(case: Case, size: tuple[int, int], options: argparse.Namespace) -> list[dict]:
    """Prints a line for every basis."""
    halves, rows = None, []
    for basis in options.bases:
        told = {"lights": case.lights} | renderer_options(basis)
        layers = render(case.model, case.data, case.environment, size, **told)
        halves = trace_reference(case, layers) if halves is None else halves
        figures, pictures = compare(layers, halves)
        figures["ratio"] = figures["whole"] / rows[0]["whole"] if rows else 1.0
        print(f"{case.name:22} {basis:5} " + " ".join(f"{figure:8.4f}" for figure in figures.values()), flush=True)
        rows.append({"case": case.name, "basis": basis} | figures)
        if options.out:
            save_sheet(
                options.out / f"all-frequency-{case.name.replace(', ', '-').replace(' ', '-')}-{basis}", pictures
            )
    return rows


def save_sheet(path: Path, pictures: np.ndarray) -> None:
    """Rendered, reference and five times their difference, side by side."""
    difference = np.clip(0.5 + 5 * (pictures[0] - pictures[1]), 0, 1)
    encoded = [psf.to_display(picture.astype(np.float32), view="srgb") for picture in pictures]
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.concatenate([*encoded, (255 * difference).astype(np.uint8)], axis=1)).save(f"{path}.png")


def find_edges(case: Case, degrees: float) -> list[Edge]:
    """Places around the statue's shadow, far from one another, where its edge is a plain one."""
    toward, diameter = sunlit.sun_direction(), np.radians(degrees)
    vertices, _, geoms = world_triangles(case.model, case.data)
    statue = vertices[geoms != case.model.geom("floor").id]
    shadow = statue[:, :2] - statue[:, 2:] * toward[:2] / toward[2]
    # The widest penumbra is that of the statue's top, along the sun.
    reach = REACH * diameter * np.ptp(statue[:, 2]) / toward[2] ** 2
    low, high = shadow.min(axis=0) - reach, shadow.max(axis=0) + reach
    axes = [np.arange(low[axis], high[axis], GRID) for axis in (0, 1)]
    floor = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    share = sun_share(case, floor.reshape(-1, 2), diameter, SUN_RAYS[0]).reshape(floor.shape[:2])
    places, onward = half_lit(floor, share)
    # A camera above a place must not have the statue in its way.
    clear = np.linalg.norm(places, axis=1) > np.linalg.norm(statue[:, :2], axis=1).max() + reach
    places, onward = places[clear], onward[clear]
    # The farthest from the statue, and then again and again the one that is farthest from those that were chosen.
    edges: list[Edge] = []
    distance = np.linalg.norm(places, axis=1)
    while len(edges) < PLACES and distance.max() > 2 * GRID:
        best = int(distance.argmax())
        edge = plain_edge(case, places[best], onward[best], reach, diameter)
        if edge is None:
            distance[best] = 0.0
            continue
        gap = np.linalg.norm(places - edge.place, axis=1)
        distance = np.minimum(distance, gap) if edges else gap
        edges.append(edge)
    return edges


def half_lit(floor: np.ndarray, share: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where shares [X, Y] of the sun at a grid [X, Y, 2] cross 50 %: places, and ways into the light, [N, 2] each."""
    gradient = np.stack(np.gradient(share, GRID), axis=-1)
    crossings = []
    for axis in (0, 1):
        values = np.moveaxis(np.concatenate([floor, gradient, share[..., None]], axis=-1), axis, 0)
        before, after = values[:-1], values[1:]
        crossed = (before[..., -1] < 0.5) != (after[..., -1] < 0.5)
        before, after = before[crossed], after[crossed]
        along = (0.5 - before[:, -1:]) / (after[:, -1:] - before[:, -1:])
        crossings.append(before + along * (after - before))
    found = np.concatenate(crossings)
    return found[:, :2], found[:, 2:4] / np.linalg.norm(found[:, 2:4], axis=1, keepdims=True)


def plain_edge(case: Case, place: np.ndarray, onward: np.ndarray, reach: float, diameter: float) -> Edge | None:
    """The edge through a place, if the reference goes from dark to light there and back nowhere in between."""
    along = np.linspace(-reach, reach, 4 * STRIP[0] + 1)
    share = sun_share(case, place + along[:, None] * onward, diameter, LINE_RAYS)
    middle = len(along) // 2
    dark, light = np.flatnonzero(share[:middle] < DARK), middle + np.flatnonzero(share[middle:] > LIGHT)
    if not len(dark) or not len(light):
        return None
    between = share[dark[-1] : light[0] + 1]
    if np.any(np.maximum.accumulate(between) - between > TURN):
        return None
    return Edge(place, onward, edge_width(along, share)[0], reach)


def sun_share(case: Case, floor: np.ndarray, diameter: float, rays: int) -> np.ndarray:
    """The share of the sun that points [N, 2] of the floor see, [N]."""
    points, up = np.pad(floor, ((0, 0), (0, 1))), np.tile([0.0, 0.0, 1.0], (len(floor), 1))
    return traced_sun(case.model, case.data, points, up, sunlit.sun_direction(), diameter, rays)[0]


def edge_width(along: np.ndarray, share: np.ndarray) -> tuple[float, float]:
    """From 10 % to 90 % around the crossing of 50 % nearest to 0, and where that is, metres.

    Where the line ends before, the width ends with it.
    """
    rising = np.flatnonzero((share[:-1] < 0.5) & (share[1:] >= 0.5))
    if not len(rising):
        return float(np.ptp(along)), float(along[-1])
    start = int(rising[np.abs(along[rising]).argmin()])

    def crossing(level: float, indices: np.ndarray) -> float:
        first, last = indices[0], indices[-1]
        between = (level - share[first]) / (share[last] - share[first])
        return float(along[first] + between * (along[last] - along[first]))

    below, above = np.flatnonzero(share[: start + 1] < LOW), np.flatnonzero(share[start + 1 :] > HIGH) + start + 1
    left = crossing(LOW, np.array([below[-1], below[-1] + 1])) if len(below) else float(along[0])
    right = crossing(HIGH, np.array([above[0] - 1, above[0]])) if len(above) else float(along[-1])
    return right - left, crossing(0.5, np.array([start, start + 1]))


def rendered_edges(case: Case, basis: str, edges: list[Edge]) -> list[tuple[float, float]]:
    """Widths and places of edges in pictures that look straight down at them, a row of pixels along each line."""
    model = copy.copy(case.model)
    width, height = STRIP
    # The picture's width is the line's length; the angle is that of its height.
    model.vis.global_.fovy = np.degrees(2 * np.arctan(edges[0].reach * height / width / HOVER))
    full = np.array(sunlit.SUN_IRRADIANCE) * sunlit.sun_direction()[2]
    camera, found = mujoco.MjvCamera(), []
    with psf.Renderer(
        model, height, width, environment=case.environment, bounces=0, model_lights=False, **renderer_options(basis)
    ) as renderer:
        for edge in edges:
            camera.lookat[:2] = edge.place
            camera.distance, camera.elevation = HOVER, -90.0
            # Looking down so, the camera's right is the direction (sin, -cos) of its azimuth.
            camera.azimuth = np.degrees(np.arctan2(edge.onward[0], -edge.onward[1]))
            renderer.update_scene(case.data, camera)
            layers = renderer.layers()
            points = pixel_points(layers["depth"], renderer.world_from_camera, np.deg2rad(model.vis.global_.fovy))
            row = height // 2
            along = (points[row, :, :2] - edge.place) @ edge.onward
            share = (layers["direct"][row] * np.pi / layers["albedo"][row] / full).mean(axis=1)
            found.append(edge_width(along, share))
    return found


def measure_edges(case: Case, degrees: float, options: argparse.Namespace) -> list[dict]:
    """Prints every place, and median and worst of every basis."""
    edges = find_edges(case, degrees)
    rows = []
    for basis in options.bases:
        measured = rendered_edges(case, basis, edges)
        ratios = [width / edge.width for (width, _), edge in zip(measured, edges, strict=True)]
        shifts = [place / edge.width for (_, place), edge in zip(measured, edges, strict=True)]
        for edge, (width, _), ratio, shift in zip(edges, measured, ratios, shifts, strict=True):
            print(
                f"  {basis:5} at ({edge.place[0]:5.2f}, {edge.place[1]:5.2f}): {1e3 * width:6.1f} mm, reference "
                f"{1e3 * edge.width:5.1f} mm, ratio {ratio:5.2f}, edge off by {shift:+5.2f} widths"
            )
        worst = max(ratios, key=lambda ratio: abs(np.log(ratio)))
        print(f"  {basis:5} ratio of widths: median {statistics.median(ratios):.2f}, worst {worst:.2f}", flush=True)
        widths = {"width": [width for width, _ in measured], "reference": [edge.width for edge in edges]}
        figures = {"median": statistics.median(ratios), "worst": worst, "ratios": ratios, "shifts": shifts} | widths
        rows.append({"case": case.name, "basis": basis} | figures)
    return rows


def measure_frames(basis: str, size: tuple[int, int], options: argparse.Namespace) -> dict:
    """Renders `sims.sunlit` several times, and prints and returns the medians, seconds."""
    model = sunlit.build()
    # The last two states, between which every frame moves the statue.
    states = deque(map(copy.copy, sunlit.states(model, 30, MOMENT)), maxlen=2)
    width, height = size
    frames, stages = [], []
    with psf.Renderer(
        model, height, width, environment=sunlit.environment(), bounces=3, model_lights=False, **renderer_options(basis)
    ) as renderer:
        for _ in range(options.warmup + options.frames):
            start = time.perf_counter()
            renderer.update_scene(states[0], camera="front")
            renderer.render()
            frames.append(time.perf_counter() - start)
            stages.append(renderer.stage_seconds)
            states.rotate()
        field_bytes = renderer.field_bytes
    frame = statistics.median(frames[options.warmup :])
    stages = stages[options.warmup :]
    per_stage = {stage: statistics.median(found[stage] for found in stages) for stage in stages[0]}
    factor = 1.0 / frame / PAPER_FRAMES_PER_SECOND
    print(
        f"  {basis:5} {width}x{height} {1e3 * frame:7.1f} ms/frame, {1 / frame:5.2f} frames/s, {factor:5.1f} times the "
        f"paper's   " + "  ".join(f"{name} {1e3 * seconds:.1f}" for name, seconds in per_stage.items()),
        flush=True,
    )
    return {"basis": basis, "frame": frame, "factor": factor, "stages": per_stage, "field_bytes": field_bytes}


def main() -> None:
    """Prints the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bases", nargs="+", default=["sh", "haar"], choices=["sh", "haar"])
    parser.add_argument("--suns", nargs="+", type=float, default=[2.0], help="diameters of the sun, degrees")
    parser.add_argument("--size", nargs=2, type=int, default=[640, 360], metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--window-size", nargs=2, type=int, default=[320, 180], metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--frames", type=int, default=7)
    parser.add_argument("--warmup", type=int, default=2)
    parser.add_argument("--out", type=Path, help="folder for rendered, reference and difference")
    parser.add_argument("--json", type=Path, help="file for the figures")
    options = parser.parse_args()
    size, window_size = tuple(options.size), tuple(options.window_size)

    header = " ".join(f"{title:>8}" for title in ("whole", "floor", "noise", "ratio"))
    print(f"{'RMSE of direct light':22} {'basis':5} {header}")
    figures: dict[str, list[dict]] = {"images": [], "edges": [], "frames": []}
    suns = {degrees: sun_case(degrees) for degrees in options.suns}
    windows = [window_case(*window) for window in WINDOWS]
    for case in suns.values():
        figures["images"] += measure_case(case, size, options)
    for case in windows:
        figures["images"] += measure_case(case, window_size, options)
    for degrees, case in suns.items():
        print(f"penumbra, {case.name}")
        figures["edges"] += measure_edges(case, degrees, options)
    print("sunlit, three bounces")
    figures["frames"] += [measure_frames(basis, size, options) for basis in options.bases]
    if options.json:
        options.json.write_text(json.dumps(figures, indent=1))


if __name__ == "__main__":
    main()
