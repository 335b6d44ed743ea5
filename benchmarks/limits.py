"""Where the renderer is wrong, in pictures: `python -m benchmarks.limits` prints the table and writes docs/limits.png.

Four rows: the contact of hollow bodies with a floor, a statue in a sun of two degrees in each `basis`, and a chain
and bars in that sun. Each is ours, the same by casting rays from the same points, and five times their difference.
Direct light; RMSE over all points, the reference scaled to a mean luminance of 0.5 and both clamped to [0, 1].
`noise` is the reference's own error.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections import deque
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image, ImageDraw, ImageFont

import warp_psf as psf
from benchmarks.accuracy import LUMINANCE, render
from sims import add_material, add_mesh, draw_box, draw_mesh, new_stage, sunlit
from sims.bodies import chain_link, mug
from sims.surfaces import Body, join, tube
from tests.oracles_sun import traced_environment, traced_sun

# Pixels of a picture, and points that are compared per pixel and side, so that the edges of bodies look smooth.
SIZE, FINER = (320, 180), 2
# Rays per point of the two halves of a reference: of the sun two lattices that are no multiples of each other.
SUN_RAYS, SKY_RAYS = (256, 309), 256
# Simulated seconds at which the statue shows the sun its broad side.
MOMENT = 2.5
# Of a chain link, metres: straight sides, bows, wire; and how many hang.
LINK, LINKS = (0.06, 0.032, 0.009), 17
# Metres: the chain hangs between ends at this height, so far apart, and sags by so much.
HEIGHT, SPAN, SAG = 0.95, 1.5, 0.32
# Of the sheet, pixels.
MARGIN, GAP, TITLE, CAPTION = 12, 8, 28, 46
INK, GREY, PAPER = (30, 30, 30), (100, 100, 100), (255, 255, 255)


@dataclasses.dataclass(frozen=True)
class Row:
    """A row of the sheet: a model in its state, and what it is rendered in.

    sky: radiance of the light without the sun, [rows, columns, 3]; sun: whether the sun of `sims.sunlit` is added.
    options: what the renderer is told besides.
    """

    name: str
    caption: str
    model: mujoco.MjModel
    data: mujoco.MjData
    sky: np.ndarray
    sun: bool
    options: dict


def contact() -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Two mugs on a floor: one stands, one lies."""
    spec = new_stage(position=(0.15, -1.6, 0.5), target=(0.0, -0.03, 0.075), fovy=13)
    _add_floor(spec)
    add_material(spec, "mug", (0.5, 0.68, 0.75))
    add_mesh(spec, "mug", mug())
    draw_mesh(spec.worldbody.add_body(pos=(-0.17, 0.05, 0.0), quat=_turn(2, 200)), "mug", "mug")
    lying = spec.worldbody.add_body(pos=(0.0, -0.05, 0.09), quat=_turn(2, -35))
    draw_mesh(lying.add_body(quat=_turn(1, 90)).add_body(quat=_turn(2, 130)), "mug", "mug")
    return _rest(spec)


def statue() -> tuple[mujoco.MjModel, mujoco.MjData]:
    """The statue of `sims.sunlit` from a little nearer, all of it matt and grey."""
    model = sunlit.build()
    model.mat_specular[:] = 0.0
    # On a red floor the clamp would hide what is wrong with red.
    model.mat_rgba[:, :3] = 0.7
    model.cam_fovy[:] = 24.0
    model.vis.quality.offsamples = 0
    # The last state; a deque of one forgets the others.
    return model, deque(sunlit.states(model, 30, MOMENT), maxlen=1).pop()


def thin() -> tuple[mujoco.MjModel, mujoco.MjData]:
    """A chain that hangs between two posts, and a trellis of bars behind it, all of it thin."""
    spec = new_stage(position=(3.3, -2.6, 1.9), target=(0.38, 0.12, 0.37), fovy=23.5)
    _add_floor(spec)
    add_material(spec, "steel", (0.45, 0.5, 0.58))
    add_material(spec, "wood", (0.72, 0.47, 0.3))
    add_mesh(spec, "link", chain_link(*LINK, rings=60, sides=14))
    # Along a parabola, in steps of a link's pitch; each is turned about its length by a quarter against the last.
    dense = np.linspace(-0.5, 0.5, 2001)
    curve = np.stack([0 * dense, SPAN * dense, HEIGHT - SAG * (1 - 4 * dense**2)], axis=1)
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    for link, at in enumerate((np.arange(LINKS) + 0.5) / LINKS * along[-1]):
        place = np.array([np.interp(at, along, axis) for axis in curve.T])
        slope = np.arctan2(*np.gradient(curve, axis=0)[np.searchsorted(along, at)][[2, 1]])
        aimed = spec.worldbody.add_body(pos=place, quat=_turn(2, 90))
        tilted = aimed.add_body(quat=_turn(1, -np.degrees(slope)))
        draw_mesh(tilted.add_body(quat=_turn(0, 90 * (link % 2))), "link", "steel")
    for side in (-1, 1):
        end = side * SPAN / 2
        draw_box(spec.worldbody, f"post {side}", (-0.015, end - 0.015, 0), (0.015, end + 0.015, HEIGHT), "wood")
    add_mesh(spec, "trellis", _trellis())
    draw_mesh(spec.worldbody.add_body(pos=(-0.75, 0.35, 0.0)), "trellis", "wood")
    return _rest(spec)


def _trellis() -> Body:
    """Bars in the yz plane, standing on the floor, as one body; metres."""
    upright = [((0, y, 0.0), (0, y, 0.9)) for y in np.linspace(-0.6, 0.6, 9)]
    level = [((0.016, -0.68, z), (0.016, 0.68, z)) for z in (0.18, 0.5, 0.82)]
    return join(*(tube(np.linspace(*ends, 40), np.full(40, 0.01), 12) for ends in upright + level))


def _add_floor(spec: mujoco.MjSpec) -> None:
    add_material(spec, "floor", (0.8, 0.77, 0.72))
    draw_box(spec.worldbody, "floor", (-30.0, -30.0, -0.1), (30.0, 30.0, 0.0), "floor")


def _turn(axis: int, degrees: float) -> np.ndarray:
    """The quaternion of a turn about x, y or z."""
    half = np.radians(degrees) / 2
    return np.concatenate([[np.cos(half)], np.sin(half) * np.eye(3)[axis]])


def _rest(spec: mujoco.MjSpec) -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = spec.compile()
    model.vis.quality.offsamples = 0
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)
    return model, data


def rows() -> list[Row]:
    """What the sheet shows, from above."""
    sky = sunlit.sky()
    found = [
        Row(
            "contact",
            "Contact, in studio light: ours is too light where bodies touch; shells and bands are coarse there.",
            *contact(),
            psf.load_environment("studio").radiance,
            False,
            {},
        )
    ]
    for basis, caption in (
        ("sh", 'A small sun, basis="sh", the default: shadows are as soft as four bands allow.'),
        ("haar", 'The same sun, basis="haar": shadows have sharp edges, and err along them.'),
    ):
        found.append(Row(f"sun, {basis}", caption, *statue(), sky, True, {"basis": basis}))
    caption = 'Thin parts in that sun, basis="haar": far from them, shadows of bars and links blur, break up or vanish.'
    return [*found, Row("thin, haar", caption, *thin(), sky, True, {"basis": "haar"})]


def trace(row: Row, layers: dict) -> np.ndarray:
    """Radiance of the points that show something, in two halves with independent errors, [2, N, 3]."""
    seen = layers["segmentation"][..., 0] >= 0
    scene = row.model, row.data, layers["points"][seen], layers["normal"][seen]
    halves = np.stack([traced_environment(*scene, row.sky, SKY_RAYS, seed) for seed in (0, 1)])
    if row.sun:
        diameter = sunlit.SUN_DIAMETER
        radiance = np.array(sunlit.SUN_IRRADIANCE) / (np.pi * np.sin(diameter / 2) ** 2)
        for half, rays in zip(halves, SUN_RAYS, strict=True):
            half += traced_sun(*scene, sunlit.sun_direction(), diameter, rays)[1][:, None] * radiance
    return layers["albedo"][seen] / np.pi * halves


def compare(row: Row) -> tuple[dict[str, float], np.ndarray]:
    """The figures of a row, and what is shown of it: ours, reference and difference, uint8 [3, H, W, 3]."""
    radiance = row.sky + sunlit.sun() if row.sun else row.sky
    size = (SIZE[0] * FINER, SIZE[1] * FINER)
    layers = render(row.model, row.data, psf.Environment(row.name, radiance), size, **row.options)
    halves = trace(row, layers)
    seen = layers["segmentation"][..., 0] >= 0
    scale = 0.5 / (halves.mean(axis=0) @ LUMINANCE).mean()
    halves = np.clip(scale * halves, 0, 1)
    # What shows nothing is as light as a page.
    pictures = np.ones((2, *seen.shape, 3))
    pictures[:, seen] = np.clip(scale * layers["direct"][seen], 0, 1), halves.mean(axis=0)
    error = pictures[0] - pictures[1]
    rmse = float(np.sqrt(np.mean(error[seen] ** 2)))
    # The halves differ by twice the error of their mean.
    noise = 0.5 * float(np.sqrt(np.mean(np.diff(halves, axis=0) ** 2)))
    pictures = pictures.reshape(2, SIZE[1], FINER, SIZE[0], FINER, 3).mean(axis=(2, 4))
    difference = np.clip(0.5 + 5 * (pictures[0] - pictures[1]), 0, 1)
    shown = [psf.to_display(picture.astype(np.float32), view="srgb") for picture in pictures]
    return {"rmse": rmse, "noise": noise}, np.stack([*shown, (255 * difference).astype(np.uint8)])


def draw_sheet(found: list[tuple[Row, dict[str, float], np.ndarray]]) -> Image.Image:
    """The rows under one another, each with its caption and its RMSE above it."""
    width, height = SIZE
    size = (2 * MARGIN + 3 * width + 2 * GAP, TITLE + len(found) * (CAPTION + height) + MARGIN)
    sheet = Image.new("RGB", size, PAPER)
    draw = ImageDraw.Draw(sheet)
    places = [MARGIN + column * (width + GAP) for column in range(3)]
    for x, title in zip(places, ("ours", "ray-traced", "five times the difference"), strict=True):
        draw.text((x, MARGIN), title, INK, ImageFont.load_default(17))
    for line, (row, figures, pictures) in enumerate(found):
        y = TITLE + line * (CAPTION + height)
        baseline = y + CAPTION - 9
        draw.text((places[0], baseline), row.caption, INK, ImageFont.load_default(15), anchor="ls")
        end = sheet.width - MARGIN
        draw.text((end, baseline), f"RMSE {figures['rmse']:.3f}", GREY, ImageFont.load_default(15), anchor="rs")
        for x, picture in zip(places, pictures, strict=True):
            sheet.paste(Image.fromarray(picture), (x, y + CAPTION))
    return sheet


def main() -> None:
    """Prints the table and writes the sheet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/limits.png"), help="where the sheet is written")
    options = parser.parse_args()
    found = []
    print(f"{'':12} {'RMSE':>8} {'noise':>8}")
    for row in rows():
        figures, pictures = compare(row)
        print(f"{row.name:12} {figures['rmse']:8.4f} {figures['noise']:8.4f}", flush=True)
        found.append((row, figures, pictures))
    draw_sheet(found).save(options.out, optimize=True)


if __name__ == "__main__":
    main()
