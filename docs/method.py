"""The figure of how it works, from the renderer's own data: `python docs/method.py` writes docs/method.png."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image, ImageDraw, ImageFilter, ImageFont

import warp_psf as psf
from sims import add_material, add_mesh, draw_box, draw_mesh, new_stage
from sims.bodies import knot, pin
from warp_psf.bake import bake_radiance
from warp_psf.basis import sh, sphere
from warp_psf.field.shells import sample_directions, shell_radii
from warp_psf.shade.proxies import MOST_PROXIES_PER_BODY

ORDER = 4
# The point whose light is followed, on the floor between the two bodies, metres.
POINT = np.array([0.02, -0.06, 0.0])
# Where the bodies stand, metres; the knot is turned upright about x.
PIN_PLACE, KNOT_PLACE = np.array([-0.15, 0.02, 0.0]), np.array([0.2, 0.03, 0.205])
UPRIGHT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
# Shapes are drawn so many times larger and scaled down, which smooths their edges.
FINER = 3
# Of the sheet, pixels.
WIDTH, MARGIN = 1200, 28
INK, GREY, LINE, ACCENT, PAPER = (30, 30, 34), (100, 100, 108), (222, 222, 228), (214, 51, 98), (255, 255, 255)
# Colours from none to all, and from less through nothing to more.
RISING = ((255, 255, 255), (186, 212, 236), (96, 150, 205), (40, 80, 150), (16, 30, 70))
BOTH_WAYS = ((30, 90, 170), (150, 185, 220), (246, 244, 240), (236, 165, 125), (190, 60, 40))


@dataclasses.dataclass(frozen=True)
class Tile:
    """A picture of the sheet with the lines under it, and the sign between it and the next."""

    picture: Image.Image
    lines: tuple[str, ...]
    sign: str = ""


# Data


def build() -> tuple[mujoco.MjModel, mujoco.MjData]:
    """A pin and a red knot on a floor."""
    spec = new_stage(position=(-0.05, -2.1, 0.95), target=(0.03, 0.0, 0.17), fovy=15.5)
    add_material(spec, "floor", (0.87, 0.85, 0.82))
    add_material(spec, "pin", (0.93, 0.92, 0.89))
    add_material(spec, "knot", (0.88, 0.24, 0.12))
    draw_box(spec.worldbody, "floor", (-30.0, -30.0, -0.1), (30.0, 30.0, 0.0), "floor")
    for name, surface, place, turn in (("pin", pin(), PIN_PLACE, np.eye(3)), ("knot", knot(), KNOT_PLACE, UPRIGHT)):
        add_mesh(spec, name, surface)
        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, turn.ravel())
        draw_mesh(spec.worldbody.add_body(name=name, pos=place, quat=quaternion), name, name)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)
    return model, data


def film(model: mujoco.MjModel, data: mujoco.MjData, environment: psf.Environment, size: tuple[int, int]) -> dict:
    """The layers of the picture, and where a point lies in it: `place`, a function of world points [N, 3]."""
    width, height = size
    with psf.Renderer(model, height, width, environment=environment, order=ORDER, model_lights=False) as renderer:
        renderer.update_scene(data, camera="front")
        layers = renderer.layers()
        pose = renderer.world_from_camera
    scale = height / (2 * np.tan(np.radians(model.cam_fovy[0]) / 2))

    def place(points: np.ndarray) -> np.ndarray:
        seen = (np.atleast_2d(points) - pose[:3, 3]) @ pose[:3, :3]
        return np.stack([width / 2 - scale * seen[:, 0] / seen[:, 2], height / 2 + scale * seen[:, 1] / seen[:, 2]], 1)

    return layers | {"place": place}


def visible(field, point: np.ndarray, place: np.ndarray, turn: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """What a body leaves of each direction [..., 3] at a point: the field, looked up in the body's frame."""
    coverage = field.lookup(((point - place) @ turn)[None])[0]
    return 1 - sh.evaluate((directions @ turn).reshape(-1, 3), ORDER).reshape(*directions.shape[:-1], -1) @ coverage


def irradiance(body: dict, other: dict, environment: psf.Environment) -> np.ndarray:
    """What a body's vertices receive past itself, one other and the floor, the mean of the colours [vertices].

    The product is formed at the directions of the quadrature at which the renderer forms it.
    """
    directions, weights = sphere.quadrature(sphere.QUADRATURE_POINTS[ORDER])
    basis = sh.evaluate(directions, ORDER)
    light = (basis @ environment.project(ORDER)).mean(axis=1)
    own = body["transfer"] @ sh.evaluate(directions @ body["turn"], ORDER).T
    coverage = other["field"].lookup((body["world"] - other["place"]) @ other["turn"])
    past = 1 - coverage @ sh.evaluate(directions @ other["turn"], ORDER).T
    above = 1 - basis @ sh.zonal(sh.cap(np.pi / 2, ORDER), np.array([[0.0, 0.0, -1.0]]))[0]
    return ((own * past) @ (weights * above * light)).clip(0)


# Drawing


def colours(values: np.ndarray, stops: Sequence[tuple[int, int, int]]) -> np.ndarray:
    """Values in [0, 1] as colours, uint8 [..., 3], evenly between the stops."""
    at = np.clip(values, 0, 1) * (len(stops) - 1)
    return np.stack([np.interp(at, range(len(stops)), channel) for channel in np.transpose(stops)], -1).astype(np.uint8)


def disc_directions(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions [size, size, 3] of an equal-area map of the upper half of the sphere, and which pixels it covers.

    The zenith is in the middle and the horizon at the rim; +x is to the right, +y up.
    """
    x, y = np.meshgrid((np.arange(size) + 0.5) / size * 2 - 1, 1 - (np.arange(size) + 0.5) / size * 2)
    square = x**2 + y**2
    z = 1 - np.minimum(square, 1.0)
    level = np.sqrt(1 + z)
    return np.stack([x * level, y * level, z], axis=-1), square <= 1


def disc_places(directions: np.ndarray, size: int) -> np.ndarray:
    """Where directions [..., 3] lie on such a map, pixels [..., 2]; what is below the horizon lies beyond its rim."""
    x, y, z = np.moveaxis(directions, -1, 0)
    level = 1 / np.sqrt(np.maximum(1 + z, 1e-6))
    return np.stack([1 + x * level, 1 - y * level], axis=-1) * size / 2


def draw_disc(picture: np.ndarray, outline: Image.Image | None = None) -> Image.Image:
    """A map uint8 [size, size, 3] cut to its disc, with the true outline of a body over it."""
    size = len(picture)
    image = Image.fromarray(picture)
    if outline is not None:
        image.paste(ACCENT, mask=outline)
    round_mask = Image.new("L", (size, size), 0)
    ImageDraw.Draw(round_mask).ellipse((FINER, FINER, size - 1 - FINER, size - 1 - FINER), fill=255)
    out = Image.new("RGB", (size, size), PAPER)
    out.paste(image, mask=round_mask)
    ImageDraw.Draw(out).ellipse((FINER, FINER, size - 1 - FINER, size - 1 - FINER), outline=GREY, width=FINER)
    return out.resize((size // FINER, size // FINER), Image.Resampling.LANCZOS)


def outline_of(vertices: np.ndarray, faces: np.ndarray, size: int, thick: int = 5) -> Image.Image:
    """The outline of a body on such a map, from vertices [V, 3] about the point, as a mask."""
    mask = silhouette_of(vertices, faces, size)
    inner = mask.filter(ImageFilter.MinFilter(thick))
    return Image.fromarray(np.asarray(mask) - np.asarray(inner))


def silhouette_of(vertices: np.ndarray, faces: np.ndarray, size: int) -> Image.Image:
    """What a body covers of such a map, as a mask."""
    mask = Image.new("L", (size, size), 0)
    draw = ImageDraw.Draw(mask)
    places = disc_places(vertices / np.linalg.norm(vertices, axis=1, keepdims=True), size)
    for corners in places[faces[(vertices[faces][..., 2] > -1e-3).all(axis=1)]]:
        draw.polygon([tuple(corner) for corner in corners], fill=255)
    return mask


def draw_surface(vertices, faces, values: np.ndarray, stops, size: int, dots: np.ndarray | None = None) -> Image.Image:
    """A body from the front (its own z towards the eye) with values in [0, 1] on its vertices, and dots on some."""
    large = size * FINER
    reach = 1.08 * np.abs(vertices[:, :2] - vertices[:, :2].mean(axis=0)).max()
    xy = (vertices[:, :2] - vertices[:, :2].mean(axis=0)) / reach * [1, -1] * large / 2 + large / 2
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facing = normals[:, 2] / np.maximum(np.linalg.norm(normals, axis=1), 1e-20)
    fill = colours(values[faces].mean(axis=1), stops) * (0.72 + 0.28 * np.clip(facing, 0, 1))[:, None]
    image = Image.new("RGB", (large, large), PAPER)
    draw = ImageDraw.Draw(image)
    order = np.argsort(corners[:, :, 2].mean(axis=1))
    for face in order[facing[order] > 0]:
        draw.polygon([tuple(corner) for corner in xy[faces[face]]], fill=tuple(int(c) for c in fill[face]))
    for x, y in xy[dots] if dots is not None else ():
        draw.ellipse((x - 4, y - 4, x + 4, y + 4), fill=INK)
    return image.resize((size, size), Image.Resampling.LANCZOS)


# Rows


def bake_row(pin_mesh: psf.Mesh, field, height: int) -> list[Tile]:
    """The shells around the pin, a slice through the field, and what it covers from one point."""
    large, radius = height * FINER, pin_mesh.radius
    reach = 1.9 * radius
    middle = pin_mesh.center

    def to_pixels(flat: np.ndarray) -> np.ndarray:
        return (flat * [1, -1] / reach + 1) * large / 2

    flat = (pin_mesh.vertices - middle)[:, [0, 2]]
    section = [tuple(corner) for corner in to_pixels(_hull(flat))]
    shells = Image.new("RGB", (large, large), PAPER)
    draw = ImageDraw.Draw(shells)
    for ring in shell_radii(radius)[1::2]:
        low, high = to_pixels(np.array([[-ring, ring], [ring, -ring]]))
        draw.ellipse((*low, *high), outline=(165, 190, 215), width=2)
        samples = ring * sample_directions(32)[:, 0][:, [0, 2]]
        for x, y in to_pixels(np.concatenate([samples, samples * [-1, 1]])):
            draw.ellipse((x - 4, y - 4, x + 4, y + 4), fill=(70, 120, 180))
    draw.polygon(section, fill=(225, 221, 212), outline=INK, width=FINER)

    grid = (np.arange(large) + 0.5) / large * 2 - 1
    x, z = np.meshgrid(reach * grid, -reach * grid)
    points = np.stack([x, 0 * x, z], axis=-1).reshape(-1, 3)
    share = field.lookup(points + middle)[:, 0].reshape(large, large) / np.sqrt(4 * np.pi)
    cut = Image.fromarray(colours(np.sqrt(share / 0.5), RISING))
    ImageDraw.Draw(cut).polygon(section, fill=(225, 221, 212), outline=INK, width=FINER)

    # What one point sees, facing the body, its vertical upwards.
    eye = np.array([1.15 * radius, 0.0, 0.0]) + middle
    toward = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])
    seen = silhouette_of((pin_mesh.vertices - eye) @ toward.T, pin_mesh.faces, large)
    by_rays = colours(np.asarray(seen) / 255, RISING)
    directions, _ = disc_directions(large)
    covered = 1 - visible(field, eye, np.zeros(3), np.eye(3), directions @ toward)
    mark = to_pixels((eye - middle)[None, [0, 2]])[0]
    for image in (shells, cut):
        draw = ImageDraw.Draw(image)
        draw.ellipse((*(mark - 11), *(mark + 11)), fill=ACCENT, outline=PAPER, width=3)
        draw.rectangle((0, 0, large - 1, large - 1), outline=LINE, width=FINER)
    small = [image.resize((height, height), Image.Resampling.LANCZOS) for image in (shells, cut)]
    return [
        Tile(small[0], ("Shells of points around a", "shape (every other shell)"), "arrow"),
        Tile(draw_disc(by_rays), ("Rays from a point (red) find", "what the shape covers"), "arrow"),
        Tile(draw_disc(colours(covered, RISING)), ("Kept of it: 16 numbers,", "smooth, 8 bits each"), "arrow"),
        Tile(small[1], ("The field: how much of the view", "the shape takes, everywhere")),
    ]


def look_up_row(bodies: dict, environment: psf.Environment, layers: dict, height: int) -> list[Tile]:
    """At one point: what each body leaves visible, the light, and their product."""
    large = height * FINER
    directions, _ = disc_directions(large)
    picture = psf.to_display(layers["direct"])
    image = Image.fromarray(picture).resize((picture.shape[1] * height // picture.shape[0], height), 1)
    x, y = layers["place"](POINT)[0] * image.height / picture.shape[0]
    draw_mark(image, x, y)
    left, maps = [], []
    for body in bodies.values():
        open_share = visible(body["field"], POINT, body["place"], body["turn"], directions)
        left.append(open_share)
        outline = outline_of(body["world"] - POINT, body["mesh"].faces, large)
        maps.append(draw_disc(colours(1 - open_share, RISING), outline))
    light = sh.evaluate(directions.reshape(-1, 3), ORDER) @ environment.project(ORDER)
    light = np.maximum(light.reshape(large, large, 3), 0).astype(np.float32)
    arriving = light * np.clip(left[0] * left[1], 0, None)[..., None].astype(np.float32)
    sky, rest = (draw_disc(psf.to_display(values, exposure=-1.3, view="srgb")) for values in (light, arriving))
    return [
        Tile(image, ("A point on the floor (red)", "of a frame"), "arrow"),
        Tile(maps[0], ("What the pin leaves", "of the sky above it"), "times"),
        Tile(maps[1], ("What the knot leaves", "(outlines: the true ones)"), "times"),
        Tile(sky, ("The light from", "all around"), "="),
        Tile(rest, ("What arrives; summed with", "the cosine: direct light")),
    ]


def bounce_row(bodies: dict, environment: psf.Environment, height: int) -> list[Tile]:
    """The knot's light as a sum of its functions, found at its proxies."""
    mesh, radiance = bodies["knot"]["mesh"], bodies["knot"]["radiance"]
    received = irradiance(bodies["knot"], bodies["pin"], environment)
    chosen = radiance.proxies[:MOST_PROXIES_PER_BODY]
    weights = radiance.solver(len(chosen)) @ received[chosen]
    rebuilt = radiance.basis @ weights
    top = np.percentile(received, 99)
    shapes = mesh.vertices, mesh.faces
    proxies = chosen[mesh.normals[chosen][:, 2] > 0.2]
    tiles = [
        Tile(
            draw_surface(*shapes, received / top, RISING[::-1], height, proxies),
            ("Light is followed at", f"proxies, {len(chosen)} per body"),
            "arrow",
        )
    ]
    # The mean, and the two that matter most here.
    sizes = np.abs(weights) * np.sqrt(np.average(radiance.basis**2, weights=radiance.areas, axis=0))
    for number, sign in zip((0, *(1 + np.argsort(-sizes[1:])[:2])), ("+", "+", "..."), strict=True):
        part = weights[number] * radiance.basis[:, number]
        most = np.percentile(np.abs(part), 99)
        lines = (f"{weights[number] / weights[0]:+.2f} of function {number + 1}",)
        lines += ("the mean light",) if number == 0 else ("red: more, blue: less",)
        tiles.append(Tile(draw_surface(*shapes, 0.5 + 0.5 * part / most, BOTH_WAYS, height), lines, sign))
    lines = ("The sum of all 16: what", "the knot sends on")
    return [*tiles, Tile(draw_surface(*shapes, rebuilt / top, RISING[::-1], height), lines)]


def film_row(layers: dict, width: int) -> list[Tile]:
    """Direct and indirect light, and the picture."""
    found = []
    for name, exposure, lines, sign in (
        ("direct", 0.0, ("Direct light: step 2 at every visible point",), "+"),
        (
            "indirect",
            1.0,
            ("Bounced light: step 3, looked up from fields", "like those of step 1 (shown twice as bright)"),
            "=",
        ),
        ("color", 0.0, ("The picture: the same bits every time, no noise",), ""),
    ):
        picture = Image.fromarray(psf.to_display(layers[name], exposure=exposure))
        height = width * picture.height // picture.width
        found.append(Tile(picture.resize((width, height), Image.Resampling.LANCZOS), lines, sign))
    return found


def draw_mark(image: Image.Image, x: float, y: float) -> None:
    """A red dot with a white rim."""
    large = Image.new("L", (20 * FINER, 20 * FINER), 0)
    for reach, colour in ((7, PAPER), (5, ACCENT)):
        ImageDraw.Draw(large).ellipse([(10 - reach) * FINER] * 2 + [(10 + reach) * FINER] * 2, fill=255)
        image.paste(colour, (round(x) - 10, round(y) - 10), large.resize((20, 20), Image.Resampling.LANCZOS))
        large.paste(0, (0, 0, *large.size))


def _hull(flat: np.ndarray) -> np.ndarray:
    """The outline of a body of revolution: its widest points, up one side and down the other, [N, 2]."""
    right = flat[flat[:, 0] >= 0]
    levels = np.unique(right[:, 1].round(5))
    widest = np.array([[right[np.abs(right[:, 1] - z) < 1e-5, 0].max(), z] for z in levels])
    return np.concatenate([widest, widest[::-1] * [-1, 1]])


# The sheet


def draw_sheet(rows: list[tuple[str, str, list[Tile]]]) -> Image.Image:
    """The rows under one another, each with its number, its title and when it happens."""
    head, under, gap = 46, 52, 18
    heights = [head + max(tile.picture.height for tile in tiles) + under + gap for _, _, tiles in rows]
    sheet = Image.new("RGB", (WIDTH, sum(heights) + 6), PAPER)
    draw = ImageDraw.Draw(sheet)
    y = 0
    for number, ((title, when, tiles), tall) in enumerate(zip(rows, heights, strict=True), start=1):
        if number > 1:
            draw.line((MARGIN, y + 2, WIDTH - MARGIN, y + 2), fill=LINE)
        draw_number(sheet, MARGIN + 13, y + 26, number)
        draw.text((MARGIN + 36, y + 26), title, INK, ImageFont.load_default(22), anchor="lm")
        end = MARGIN + 36 + draw.textlength(title, ImageFont.load_default(22))
        draw.text((end + 14, y + 28), when, GREY, ImageFont.load_default(16), anchor="lm")
        space = WIDTH - 2 * MARGIN - sum(tile.picture.width for tile in tiles)
        step = space / (len(tiles) - 1)
        x = float(MARGIN)
        for tile in tiles:
            sheet.paste(tile.picture, (round(x), y + head))
            for line, text in enumerate(tile.lines):
                place = (x + tile.picture.width / 2, y + head + tile.picture.height + 9 + 19 * line)
                draw.text(place, text, INK, ImageFont.load_default(15), anchor="ma")
            x += tile.picture.width
            middle = (x + step / 2, y + head + tile.picture.height / 2)
            draw_sign(draw, tile.sign, *middle)
            x += step
        y += tall
    return sheet


def draw_sign(draw: ImageDraw.ImageDraw, sign: str, x: float, y: float) -> None:
    """A sign between two pictures; the font that comes with Pillow has neither arrow nor cross."""
    if sign == "arrow":
        draw.line((x - 10, y, x + 9, y), fill=INK, width=2)
        draw.line((x + 3, y - 6, x + 9, y, x + 3, y + 6), fill=INK, width=2, joint="curve")
    elif sign == "times":
        draw.line((x - 6, y - 6, x + 6, y + 6), fill=INK, width=2)
        draw.line((x - 6, y + 6, x + 6, y - 6), fill=INK, width=2)
    else:
        draw.text((x, y), sign, INK, ImageFont.load_default(30), anchor="mm")


def draw_number(sheet: Image.Image, x: int, y: int, number: int) -> None:
    """A number in a filled circle."""
    large = Image.new("L", (27 * FINER, 27 * FINER), 0)
    ImageDraw.Draw(large).ellipse((0, 0, 27 * FINER - 1, 27 * FINER - 1), fill=255)
    sheet.paste(ACCENT, (x - 13, y - 13), large.resize((27, 27), Image.Resampling.LANCZOS))
    ImageDraw.Draw(sheet).text((x, y), str(number), PAPER, ImageFont.load_default(17), anchor="mm")


def main() -> None:
    """Writes the figure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/method.png"), help="where the figure is written")
    options = parser.parse_args()
    environment = psf.load_environment("studio")
    model, data = build()
    bodies = {}
    for name, surface, place, turn in (("pin", pin(), PIN_PLACE, np.eye(3)), ("knot", knot(), KNOT_PLACE, UPRIGHT)):
        mesh = psf.make_mesh(name, *surface)
        world = mesh.vertices @ turn.T + place
        bodies[name] = {"mesh": mesh, "place": place, "turn": turn, "world": world}
        baked = psf.bake_mesh(mesh, ORDER)
        bodies[name] |= {"field": baked.field, "transfer": baked.transfer}
    bodies["knot"]["radiance"] = bake_radiance(bodies["knot"]["mesh"], ORDER)
    layers = film(model, data, environment, (1056, 594))
    draw_sheet(
        [
            ("Bake", "once per shape, then kept on disk", bake_row(bodies["pin"]["mesh"], bodies["pin"]["field"], 210)),
            (
                "Look up and multiply",
                "every frame, at every visible point",
                look_up_row(bodies, environment, layers, 168),
            ),
            ("Bounce", "every frame, from body to body", bounce_row(bodies, environment, 168)),
            ("Film", "every frame", film_row(layers, 352)),
        ]
    ).save(options.out, optimize=True)


if __name__ == "__main__":
    main()
