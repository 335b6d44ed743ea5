"""Moving frames against Mitsuba 3 and its denoiser: `python -m benchmarks.vs_mitsuba bowling falling`.

Scenes in their own environment (of order 4) and area lights, every surface Lambert, direct light and three bounces,
antialiased, on all cores. For a frame in which the bodies have moved, in one process:

- ours: milliseconds to take the poses over and render, and the RMSE against Mitsuba with `--reference` samples, scaled
  to a mean luminance of 0.5 and clamped to [0, 1]; over all that is seen, and over the foreground (all but floors,
  walls and other flat bodies); and the mean FLIP (Andersson 2020) of the pictures as they are shown.
- Mitsuba, LLVM, multijitter: the same at several samples per pixel, moving the vertices included; and the time that it
  needs to reach our error, between these. Its noise falls with the root of its samples; where our error lies beyond
  what was rendered, it is extrapolated so.
- Mitsuba at 2 and 4 samples with Open Image Denoise, with albedo and normals.
- flicker: RMSE between two renderings of the same frame where only random numbers differ, as between frames of a still
  camera in which nothing changes.
- mujoco.Renderer with shadows, where MUJOCO_GL names a back end that works.

Needs the extra `validate`.
"""

import argparse
import copy
import importlib
import json
import statistics
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

import warp_psf as psf
from benchmarks.accuracy import LUMINANCE
from benchmarks.interreflection import (
    BOUNCES,
    ORDER,
    Case,
    find_case,
    import_mitsuba,
    mitsuba_environment,
    mitsuba_shapes,
)
from tests.oracles_bounce import world_meshes

SAMPLES, DENOISED = (1, 4, 9, 16, 36, 64), (2, 4)
BASES = ("sh", "haar")
REPEATS = 5
VARIANT = "llvm_ad_rgb"
# More than one: edges are antialiased, as Mitsuba's are.
EDGE_SAMPLES = 4


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", default=["bowling", "falling"], metavar="SCENE")
    parser.add_argument("--size", type=int, nargs=2, default=(640, 360), metavar=("W", "H"))
    parser.add_argument("--reference", type=int, default=1024, help="samples per pixel of the reference")
    parser.add_argument("--bunny", type=Path, help="as of benchmarks.interreflection")
    parser.add_argument("--json", type=Path, metavar="PATH", help="also write the numbers here")
    options = parser.parse_args()
    options.mitsuba = True
    mi = import_mitsuba()
    mi.set_variant(VARIANT)
    rows = []
    for name in options.scenes:
        case = find_case(name, options)
        if case is not None:
            rows += measure(mi, case, options.reference)
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n")


def measure(mi: Any, case: Case, reference_samples: int) -> list[dict]:
    """All rows of a scene, printed as they are found."""
    print(f"\n{case.name}, {case.size[0]}x{case.size[1]}")
    print(f"  {'':<22}{'ms':>9}{'RMSE':>9}{'foreground':>12}{'FLIP':>8}{'flicker':>9}")
    case.model.vis.quality.offsamples = EDGE_SAMPLES
    before, after = moving_states(case)
    ours = {basis: render_ours(case, before, after, basis) for basis in BASES}
    _, layers, milliseconds = ours[BASES[-1]]
    flip: Any = importlib.import_module("flip_evaluator")
    scene = MitsubaScene(mi, case, layers["pose"])
    scene.move(after)
    reference = scene.render(reference_samples, seed=9999, reference=True)
    scale = 0.5 / (reference[layers["seen"]] @ LUMINANCE).mean()

    def error(picture: np.ndarray, other: np.ndarray, chosen: np.ndarray) -> float:
        difference = np.clip(scale * picture, 0, 1) - np.clip(scale * other, 0, 1)
        return float(np.sqrt(np.mean(difference[chosen] ** 2)))

    def difference_seen(picture: np.ndarray) -> float:
        shown = [psf.to_display(scale * each, view="srgb").astype(np.float32) / 255 for each in (reference, picture)]
        return float(flip.evaluate(*shown, "LDR")[1])

    def row(name: str, took: float, picture: np.ndarray, again: np.ndarray) -> dict:
        found = {
            "scene": case.name,
            "renderer": name,
            "milliseconds": took,
            "rmse": error(picture, reference, layers["seen"]),
            "foreground": error(picture, reference, layers["foreground"]),
            "flip": difference_seen(picture),
            "flicker": error(picture, again, layers["seen"]),
        }
        print(
            f"  {name:<22}{took:>9.0f}{found['rmse']:>9.4f}{found['foreground']:>12.4f}{found['flip']:>8.4f}"
            f"{found['flicker']:>9.4f}",
            flush=True,
        )
        return found

    own = [row(f"ours, {basis}", took, picture, picture) for basis, (picture, _, took) in ours.items()]
    rows = []
    for samples in SAMPLES:
        took, pictures = timed(lambda seed, samples=samples: scene.frame(before, after, samples, seed))
        rows.append(row(f"Mitsuba, {samples} spp", took, *pictures[-2:]))
    for samples in DENOISED:
        took, pictures = timed(lambda seed, samples=samples: scene.frame(before, after, samples, seed, denoise=True))
        rows.append(row(f"{samples} spp and OIDN", took, *pictures[-2:]))
    for found in own:
        for share in ("rmse", "foreground"):
            needed = time_to_reach(rows[: len(SAMPLES)], share, found[share])
            found[f"Mitsuba's milliseconds at equal {share}"] = needed
            times = needed / found["milliseconds"]
            print(f"  Mitsuba needs {needed:,.0f} ms for the {share} of {found['renderer']}: {times:.1f} times as long")
    fastest = milliseconds_of_mujoco(case, before, after)
    if fastest is not None:
        own[-1]["mujoco's milliseconds"] = fastest
        print(f"  mujoco.Renderer takes {fastest:.0f} ms: ours are {milliseconds / fastest:.1f} times that")
    return own + rows


def moving_states(case: Case) -> tuple[mujoco.MjData, mujoco.MjData]:
    """The case's state a frame earlier, and its own."""
    simulation: Any = importlib.import_module(f"sims.{case.name}")
    duration = case.data.time + 0.5 / 30
    before, after = deque(map(copy.copy, simulation.states(case.model, 30, duration)), maxlen=2)
    return before, after


def render_ours(case: Case, before: mujoco.MjData, after: mujoco.MjData, basis: str) -> tuple[np.ndarray, dict, float]:
    """Our picture of the later state, its layers, and milliseconds of a frame in which everything has moved."""
    with psf.Renderer(
        case.model,
        case.size[1],
        case.size[0],
        environment=psf.Environment.from_coefficients(case.coefficients),
        lights=case.lights,
        model_lights=False,
        order=ORDER,
        basis=basis,
        bounces=BOUNCES,
    ) as renderer:
        taken = []
        for index in range(2 * REPEATS):
            begin = time.perf_counter()
            renderer.update_scene((before, after)[index % 2], camera="front")
            renderer.render()
            taken.append(time.perf_counter() - begin)
        layers = renderer.layers()
        found = {"pose": renderer.world_from_camera, "seen": layers["segmentation"][..., 0] >= 0}
    flat = [mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_PLANE]
    geoms = np.maximum(layers["segmentation"][..., 0], 0)
    found["foreground"] = found["seen"] & ~np.isin(case.model.geom_type[geoms], flat)
    return layers["direct"] + layers["indirect"], found, 1e3 * statistics.median(taken[2:])


class MitsubaScene:
    """The case in Mitsuba, whose vertices move with the simulation."""

    def __init__(self, mi: Any, case: Case, pose: np.ndarray):
        self.mi, self.case = mi, case
        surfaces, lamps = world_meshes(case.model, case.data, case.lights)
        camera = {
            "type": "perspective",
            "fov": float(case.model.cam_fovy[case.model.camera("front").id]),
            "fov_axis": "y",
            "to_world": mi.ScalarTransform4f().look_at(
                origin=pose[:3, 3].tolist(), target=(pose[:3, 3] - pose[:3, 2]).tolist(), up=pose[:3, 1].tolist()
            ),
            "film": {"type": "hdrfilm", "width": case.size[0], "height": case.size[1], "rfilter": {"type": "box"}},
            "sampler": {"type": "multijitter"},
        }
        shapes = mitsuba_shapes(mi, surfaces, shining=False)
        lighting = {"environment": mitsuba_environment(mi, case.coefficients)} if case.coefficients.any() else {}
        if lamps is not None:
            lighting |= mitsuba_shapes(mi, lamps, shining=True)
        self.scene = mi.load_dict({"type": "scene", "camera": camera} | shapes | lighting)
        self.parameters = mi.traverse(self.scene)
        depth = {"max_depth": BOUNCES + 2, "rr_depth": 99, "hide_emitters": True}
        # A lamp of ours is in no ray's way: where there is one, paths must pass it.
        kind = "path" if lamps is None else "volpath"
        self.integrator = mi.load_dict({"type": kind, **depth})
        features = {"type": "aov", "aovs": "albedo:albedo,normal:sh_normal", "image": {"type": kind, **depth}}
        self.with_features = mi.load_dict(features)
        self.order = [np.unique(surfaces.faces[surfaces.entity == entity]) for entity in range(len(surfaces.albedo))]

    def move(self, data: mujoco.MjData) -> None:
        """Takes a state over."""
        surfaces, _ = world_meshes(self.case.model, data, self.case.lights)
        for entity, used in enumerate(self.order):
            for name, values in (("positions", surfaces.vertices), ("normals", surfaces.normals)):
                key = f"entity{entity}.vertex_{name}"
                if key in self.parameters:
                    self.parameters[key] = self.mi.Float(values[used].ravel().astype(np.float32))
        self.parameters.update()

    def render(self, samples: int, seed: int, reference: bool = False) -> np.ndarray:
        """The picture [height, width, 3]; a reference in several passes, so that memory suffices."""
        passes = max(1, samples // 64) if reference else 1
        pictures = [
            np.array(self.mi.render(self.scene, integrator=self.integrator, spp=samples // passes, seed=seed + index))
            for index in range(passes)
        ]
        return np.mean([picture[..., :3] for picture in pictures], axis=0, dtype=np.float64)

    def frame(
        self, before: mujoco.MjData, after: mujoco.MjData, samples: int, seed: int, denoise: bool = False
    ) -> tuple[float, np.ndarray]:
        """Seconds of the later frame, after the earlier one, and its picture."""
        self.move(before)
        begin = time.perf_counter()
        self.move(after)
        if not denoise:
            picture = self.render(samples, seed)
            return time.perf_counter() - begin, picture
        denoiser: Any = importlib.import_module("mitsuba_oidn")
        layers = np.array(self.mi.render(self.scene, integrator=self.with_features, spp=samples, seed=seed))
        # Radiance, perhaps with alpha; then the features.
        color, features = np.ascontiguousarray(layers[..., :3]), layers[..., -6:]
        albedo, normal = np.ascontiguousarray(features[..., :3]), np.ascontiguousarray(features[..., 3:])
        picture = np.array(denoiser.denoise(color, albedo=albedo, normal=normal, hdr=True))
        return time.perf_counter() - begin, picture.astype(np.float64)


def timed(frame: Callable[[int], tuple[float, np.ndarray]]) -> tuple[float, list[np.ndarray]]:
    """Milliseconds of a frame, the first of them left out, and the pictures."""
    found = [frame(seed) for seed in range(REPEATS)]
    return 1e3 * statistics.median(seconds for seconds, _ in found[1:]), [picture for _, picture in found]


def time_to_reach(rows: list[dict], share: str, wanted: float) -> float:
    """Milliseconds at which Mitsuba's error is `wanted`, between rows; beyond them by the root of its samples."""
    times, errors = [row["milliseconds"] for row in rows], [row[share] for row in rows]
    if wanted <= errors[-1]:
        return times[-1] * (errors[-1] / wanted) ** 2
    return float(np.exp(np.interp(-np.log(wanted), -np.log(errors), np.log(times))))


def milliseconds_of_mujoco(case: Case, before: mujoco.MjData, after: mujoco.MjData) -> float | None:
    """Of mujoco.Renderer with shadows; None where OpenGL cannot be had."""
    try:
        renderer = mujoco.Renderer(case.model, case.size[1], case.size[0])
    except Exception as error:  # every back end fails in its own way
        print(f"  mujoco.Renderer: {error}")
        return None
    taken = []
    for index in range(2 * REPEATS):
        begin = time.perf_counter()
        renderer.update_scene((before, after)[index % 2], camera="front")
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = True
        renderer.render()
        taken.append(time.perf_counter() - begin)
    renderer.close()
    return 1e3 * statistics.median(taken[2:])


if __name__ == "__main__":
    main()
