"""An office by night, with a ceiling light, a wall lamp, two desk lamps and the moon. `python -m sims.office`.

The scene of figure 17 of Jeng 2005: `lights()` are the five, in that order; cameras are "front" and "side".
"""

from __future__ import annotations

import mujoco
import numpy as np

from sims import add_camera, add_material, add_mesh, draw_box, draw_mesh, new_stage, rest
from sims.surfaces import Body, resample, revolve, rounded_path, tube

# Metres: the room's inner corners, the window in its right wall (y and z), and the wall's thickness.
LOW, HIGH = (-2.0, -1.8, 0.0), (2.0, 1.8, 2.6)
WINDOW, WALL = ((-0.5, 0.9), (0.95, 2.05)), 0.1
DESK_HEIGHT = 0.74
# Where the desk lamps stand, and towards where their heads reach.
LAMPS = {"left": ((-0.75, 1.25), (-0.45, 0.95)), "right": ((0.85, 1.25), (0.55, 0.95))}
LAMP_HEIGHT = 0.46
MATERIALS = {
    "parquet": (0.62, 0.48, 0.35),
    "wall": (0.84, 0.82, 0.77),
    "ceiling": (0.88, 0.88, 0.86),
    "wood": (0.6, 0.43, 0.28),
    "steel": (0.45, 0.47, 0.5),
    "cloth": (0.25, 0.33, 0.45),
    "red": (0.68, 0.24, 0.2),
    "green": (0.3, 0.5, 0.34),
    "cream": (0.85, 0.8, 0.66),
}
states = rest


def build() -> mujoco.MjModel:
    """The room, its furniture and what stands on it."""
    spec = new_stage(position=(-1.55, -1.65, 1.75), target=(0.25, 0.9, 0.85), fovy=58)
    add_camera(spec, "side", position=(1.75, -1.6, 1.95), target=(-0.35, 0.85, 0.75), fovy=58)
    for name, color in MATERIALS.items():
        add_material(spec, name, color)
    world = spec.worldbody
    _draw_walls(world)
    _draw_desk(world)
    _draw_chair(world)
    _draw_shelves(world)
    draw_box(world, "cabinet", (1.45, -1.3, 0.0), (2.0, -0.6, 1.1), "steel")
    draw_box(world, "bin", (0.95, 1.35, 0.0), (1.2, 1.6, 0.35), "green")
    draw_box(world, "sconce", (-2.0, 0.0, 1.62), (-1.9, 0.3, 1.66), "steel")
    for name, (foot, head) in LAMPS.items():
        stem, shade = desk_lamp(foot, head)
        for part, surface, material in (("stem", stem, "steel"), ("shade", shade, "red")):
            add_mesh(spec, f"{name} {part}", surface)
            draw_mesh(world, f"{name} {part}", material)
    add_mesh(spec, "mug", _standing(revolve(np.array([[0, 0], [0.04, 0], [0.045, 0.09], [0, 0.085]]), 24), (0.3, 0.85)))
    draw_mesh(world, "mug", "cream")
    return spec.compile()


def desk_lamp(foot: tuple[float, float], head: tuple[float, float]) -> tuple[Body, Body]:
    """A bent stem on a foot, and a cone that opens downwards above `head`; on the desk."""
    (x, y), (to_x, to_y) = foot, head
    reach = np.hypot(to_x - x, to_y - y)
    corners = np.array([[0.0, 0.0], [0.0, LAMP_HEIGHT], [reach, LAMP_HEIGHT]])
    flat = resample(rounded_path(corners, 0.12), 40)
    along = flat[:, :1] / reach * [to_x - x, to_y - y] + [x, y]
    stem = tube(np.column_stack([along, DESK_HEIGHT + flat[:, 1]]), np.full(40, 0.012), 12)
    # An open cone: thin, and closed over its rim.
    profile = np.array([[0, -0.005], [0.03, -0.005], [0.115, -0.1], [0.122, -0.1], [0.036, 0.01], [0, 0.01]])
    vertices, faces = revolve(profile, 28)
    return stem, (np.add(vertices, [to_x, to_y, DESK_HEIGHT + LAMP_HEIGHT]), faces)


def lights() -> tuple:
    """Ceiling light, wall lamp, left and right desk lamps, and the moon."""
    import warp_psf as psf

    below = DESK_HEIGHT + LAMP_HEIGHT - 0.06
    heads = [(x, y, below) for _, (x, y) in LAMPS.values()]
    return (
        psf.rectangle_light("ceiling", 1.2, 0.3, (7, 7, 6.5), (0.0, 0.2, 2.58), (0.0, 0.2, 0.0)),
        psf.rectangle_light("wall", 0.24, 0.12, (26, 20, 12), (-1.88, 0.15, 1.72), (-0.9, 0.3, 1.5)),
        psf.rectangle_light("left desk", 0.12, 0.12, (60, 50, 34), heads[0], (*heads[0][:2], 0.0)),
        psf.rectangle_light("right desk", 0.12, 0.12, (60, 50, 34), heads[1], (*heads[1][:2], 0.0)),
        psf.rectangle_light("moon", 0.9, 0.9, (26, 32, 46), (5.5, 1.6, 4.6), (0.6, 0.1, 0.6)),
    )


def environment() -> None:
    """None: it is night."""
    return None


def _draw_walls(world: mujoco.MjsBody) -> None:
    (x0, y0, z0), (x1, y1, z1), t = LOW, HIGH, WALL
    draw_box(world, "floor", (x0 - t, y0 - t, z0 - t), (x1 + t, y1 + t, z0), "parquet")
    draw_box(world, "ceiling", (x0 - t, y0 - t, z1), (x1 + t, y1 + t, z1 + t), "ceiling")
    draw_box(world, "left wall", (x0 - t, y0 - t, z0), (x0, y1 + t, z1), "wall")
    draw_box(world, "back wall", (x0, y1, z0), (x1 + t, y1 + t, z1), "wall")
    draw_box(world, "front wall", (x0, y0 - t, z0), (x1 + t, y0, z1), "wall")
    (a, b), (low, high) = WINDOW
    for name, corners in {
        "before the window": ((x1, y0, z0), (x1 + t, a, z1)),
        "behind the window": ((x1, b, z0), (x1 + t, y1, z1)),
        "under the window": ((x1, a, z0), (x1 + t, b, low)),
        "over the window": ((x1, a, high), (x1 + t, b, z1)),
    }.items():
        draw_box(world, name, *corners, "wall")
    middle = (a + b) / 2
    draw_box(world, "mullion", (x1 + 0.03, middle - 0.02, low), (x1 + 0.07, middle + 0.02, high), "wood")
    draw_box(world, "sill", (x1 - 0.12, a, low - 0.04), (x1, b, low), "wood")


def _draw_desk(world: mujoco.MjsBody) -> None:
    draw_box(world, "desk", (-1.0, 0.65, DESK_HEIGHT - 0.04), (1.1, 1.45, DESK_HEIGHT), "wood")
    draw_box(world, "drawers", (0.62, 0.7, 0.0), (1.05, 1.4, DESK_HEIGHT - 0.04), "wood")
    for number, y in enumerate((0.7, 1.34)):
        draw_box(world, f"leg {number}", (-0.95, y, 0.0), (-0.89, y + 0.06, DESK_HEIGHT - 0.04), "wood")
    draw_box(world, "screen", (-0.22, 1.22, DESK_HEIGHT + 0.1), (0.38, 1.25, DESK_HEIGHT + 0.45), "steel")
    draw_box(world, "stand", (0.0, 1.18, DESK_HEIGHT), (0.16, 1.3, DESK_HEIGHT + 0.1), "steel")
    draw_box(world, "keyboard", (-0.15, 0.8, DESK_HEIGHT), (0.27, 0.94, DESK_HEIGHT + 0.02), "steel")
    for number, (height, turn) in enumerate(((0.03, 0.0), (0.055, 0.02))):
        x, z = -0.6 + turn, DESK_HEIGHT + height - 0.03
        draw_box(world, f"lying book {number}", (x, 0.75, z), (x + 0.2, 1.02, z + 0.028), ("red", "green")[number])


def _draw_chair(world: mujoco.MjsBody) -> None:
    draw_box(world, "seat", (-0.15, 0.1, 0.44), (0.35, 0.58, 0.5), "cloth")
    draw_box(world, "back", (-0.15, 0.06, 0.6), (0.35, 0.11, 1.0), "cloth")
    for number, (x, y) in enumerate(((-0.13, 0.12), (0.29, 0.12), (-0.13, 0.52), (0.29, 0.52))):
        top = 0.7 if y < 0.3 else 0.44
        draw_box(world, f"chair leg {number}", (x, y, 0.0), (x + 0.04, y + 0.04, top), "steel")


def _draw_shelves(world: mujoco.MjsBody) -> None:
    for number, z in enumerate((0.3, 0.75, 1.2, 1.65, 2.05)):
        draw_box(world, f"shelf {number}", (-1.97, 0.9, z), (-1.68, 1.75, z + 0.03), "wood")
    for number, y in enumerate((0.87, 1.75)):
        draw_box(world, f"shelf side {number}", (-1.97, y, 0.0), (-1.68, y + 0.03, 2.15), "wood")
    rng = np.random.default_rng(17)
    for shelf, z in enumerate((0.33, 0.78, 1.23, 1.68)):
        y = 0.92
        for number in range(7):
            width, height = rng.uniform(0.03, 0.07), rng.uniform(0.2, 0.32)
            color = ("red", "green", "cream", "cloth")[rng.integers(4)]
            draw_box(world, f"book {shelf} {number}", (-1.93, y, z), (-1.74, y + width, z + height), color)
            y += width + 0.004 + (0.05 if rng.uniform() < 0.2 else 0.0)


def _standing(surface: Body, place: tuple[float, float]) -> Body:
    """A body at a place of the desk."""
    vertices, faces = surface
    return np.add(vertices, [*place, DESK_HEIGHT]), faces


if __name__ == "__main__":
    from warp_psf.cli import run_simulation

    run_simulation(build, states, name="office", camera="front", environment=environment(), lights=lights())
