"""How far a frame is from ray-traced visibility: `python -m benchmarks.accuracy`.

Bowling, falling and statues, and cloth and figure, which deform: one frame each, direct light of an environment of
order 4, every pixel's centre against brute-force ray casting from the same point in the same environment. The reference
is scaled to a mean luminance of 0.5 and both are clamped to [0, 1].
"""

import argparse
import dataclasses
import importlib
import json
from collections import deque
from pathlib import Path

import numpy as np
from PIL import Image

import warp_psf as psf
from tests.oracles import loose_triangles, traced_irradiance, world_triangles

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
# Simulated seconds at which each scene is compared: bodies in the air, lying and standing.
MOMENTS = {"bowling": 2.0, "falling": 2.5, "statues": 1.0, "cloth": 2.0, "figure": 1.5}
# A vertex this close to the floor touches it, metres.
TOUCH = 0.002


@dataclasses.dataclass(frozen=True)
class Comparison:
    """RMSE over the whole picture, over the floor, and over the floor beside contacts; and the pictures."""

    whole: float
    floor: float
    contact: float
    maximum: float
    rendered: np.ndarray
    reference: np.ndarray


def settle(name: str):
    """A scene's model without highlights, and its state at the moment of comparison."""
    scene = importlib.import_module(f"sims.{name}")
    model = scene.build()
    model.mat_specular[:] = 0.0
    model.vis.quality.offsamples = 0
    # The last state; a deque of one forgets the others.
    return model, deque(scene.states(model, 30, MOMENTS[name]), maxlen=1).pop()


def render(model, data, environment: psf.Environment, size: tuple[int, int], **options) -> dict:
    """The layers of a frame in the environment's light alone, with the points that its pixels show."""
    with psf.Renderer(
        model, size[1], size[0], environment=environment, bounces=0, model_lights=False, **options
    ) as renderer:
        renderer.update_scene(data, camera="front")
        layers = renderer.layers() | {"loose": loose_triangles(renderer)}
        pose = renderer.world_from_camera
        fovy = model.cam_fovy[model.camera("front").id]
    return layers | {"points": pixel_points(layers["depth"], pose, np.deg2rad(fovy))}


def pixel_points(depth: np.ndarray, world_from_camera: np.ndarray, fovy: float) -> np.ndarray:
    """World positions [H, W, 3] of what the pixels' centres show."""
    height, width = depth.shape
    y, x = np.mgrid[:height, :width] + 0.5
    scale = 2 * np.tan(fovy / 2) / height
    rays = np.stack([(x - width / 2) * scale, (height / 2 - y) * scale, -np.ones_like(x)], axis=-1)
    # Where nothing is, depth is infinite and there is no point.
    return (np.where(np.isfinite(depth), depth, np.nan)[..., None] * rays) @ world_from_camera[
        :3, :3
    ].T + world_from_camera[:3, 3]


def near_contact(model, data, points: np.ndarray, floor: int) -> np.ndarray:
    """Which points of the floor lie within a third of a body's radius of where it touches the floor, bool [N]."""
    vertices, _, geoms = world_triangles(model, data)
    height = vertices[geoms == floor][:, 2].max()
    near = np.zeros(len(points), bool)
    for geom in np.unique(geoms[geoms != floor]):
        body = vertices[geoms == geom]
        touching = body[np.abs(body[:, 2] - height) < TOUCH]
        radius = np.linalg.norm(body - 0.5 * (body.min(axis=0) + body.max(axis=0)), axis=1).max()
        for start in range(0, len(touching), 64):
            gap = np.linalg.norm(points[:, None, :2] - touching[None, start : start + 64, :2], axis=-1)
            near |= gap.min(axis=1) < radius / 3
    return near


def compare(model, data, environment: psf.Environment, size: tuple[int, int], reference: dict, **options) -> Comparison:
    """Renders with the renderer's options and compares; `reference` keeps the reference for the next call."""
    layers = render(model, data, environment, size, **options)
    seen = layers["segmentation"][..., 0] >= 0
    points, normals = layers["points"][seen], layers["normal"][seen]
    if "irradiance" not in reference:
        light = environment.project(4)
        reference["irradiance"] = traced_irradiance(model, data, points, normals, light, loose=layers["loose"])
    expected = layers["albedo"][seen] / np.pi * reference["irradiance"]
    scale = 0.5 / (expected @ LUMINANCE).mean()
    ours = np.clip(layers["direct"][seen] * scale, 0, 1)
    expected = np.clip(expected * scale, 0, 1)
    floor = np.bincount(layers["segmentation"][..., 0][seen]).argmax()
    on_floor = layers["segmentation"][..., 0][seen] == floor
    contact = on_floor.copy()
    contact[on_floor] = near_contact(model, data, points[on_floor], floor)

    def rmse(chosen) -> float:
        return float(np.sqrt(np.mean((ours[chosen] - expected[chosen]) ** 2))) if np.any(chosen) else 0.0

    pictures = np.zeros((2, *seen.shape, 3))
    pictures[0][seen], pictures[1][seen] = ours, expected
    everything = np.ones(len(points), bool)
    maximum = float(np.abs(ours - expected).max())
    return Comparison(rmse(everything), rmse(on_floor), rmse(contact), maximum, *pictures)


def save_pictures(folder: Path, name: str, found: Comparison) -> None:
    """Rendered, reference and five times their difference, side by side."""
    difference = np.clip(0.5 + 5 * (found.rendered - found.reference), 0, 1)
    encoded = [psf.to_display(picture.astype(np.float32), view="srgb") for picture in (found.rendered, found.reference)]
    sheet = np.concatenate([*encoded, (255 * difference).astype(np.uint8)], axis=1)
    folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray(sheet).save(folder / f"{name}.png")


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--scenes", nargs="+", default=list(MOMENTS))
    parser.add_argument("--orders", nargs="+", type=int, default=[4, 6])
    parser.add_argument("--shading", default="pixel", choices=["pixel", "vertex"])
    parser.add_argument("--compose", default="product", choices=["product", "log"])
    parser.add_argument("--environment", default="studio")
    parser.add_argument("--size", nargs=2, type=int, default=[320, 180], metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--pictures", type=Path, help="folder for rendered, reference and difference")
    parser.add_argument("--json", type=Path, help="file for the figures")
    options = parser.parse_args()

    found_environment = psf.load_environment(options.environment)
    environment = psf.Environment.from_coefficients(found_environment.project(4))
    rows = []
    print(f"{'scene':10} {'order':>5} {'whole':>8} {'floor':>8} {'contact':>8} {'maximum':>8}")
    for name in options.scenes:
        model, data = settle(name)
        reference: dict = {}
        for order in options.orders:
            how = {"order": order, "shading": options.shading, "compose": options.compose}
            found = compare(model, data, environment, tuple(options.size), reference, **how)
            figures = (found.whole, found.floor, found.contact, found.maximum)
            print(f"{name:10} {order:5} " + " ".join(f"{figure:8.4f}" for figure in figures), flush=True)
            rows.append(
                {"scene": name, "order": order}
                | dict(zip(("whole", "floor", "contact", "maximum"), figures, strict=True))
            )
            if options.pictures:
                save_pictures(options.pictures, f"accuracy-{name}-order{order}", found)
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
