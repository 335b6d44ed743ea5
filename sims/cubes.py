"""Boxes of many heights under one square lamp: 13 drawn bodies. `python -m sims.cubes`.

The scene of figures 7 and 11 of Jeng 2005, whose lamp hangs a little above the highest box.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco

from sims import add_material, dimmed, draw_box, new_stage, rest

if TYPE_CHECKING:
    import warp_psf as psf

# Metres: middle, side and height of each box, and its material.
BOXES = (
    (-1.05, -0.55, 0.34, 0.30, "red"),
    (-0.62, 0.30, 0.40, 0.95, "sand"),
    (-0.25, -0.80, 0.26, 0.55, "green"),
    (-0.10, -0.15, 0.36, 0.42, "sand"),
    (0.05, 0.72, 0.44, 0.62, "blue"),
    (0.38, -0.52, 0.30, 0.80, "sand"),
    (0.55, 0.18, 0.38, 0.28, "red"),
    (0.92, -0.86, 0.28, 0.36, "blue"),
    (0.98, 0.62, 0.32, 0.50, "green"),
    (1.15, -0.20, 0.26, 0.66, "sand"),
    (-1.15, 0.85, 0.30, 0.46, "blue"),
    (-0.62, 1.10, 0.28, 0.24, "green"),
)
LAMP_HEIGHT, LAMP_SIDE = 1.75, 0.7
states = rest


def build() -> mujoco.MjModel:
    """A floor and the boxes, which rest."""
    spec = new_stage(position=(0.4, -4.4, 3.6), target=(0.02, -0.02, 0.2), fovy=34)
    add_material(spec, "floor", (0.86, 0.85, 0.83))
    add_material(spec, "sand", (0.85, 0.77, 0.63))
    add_material(spec, "red", (0.72, 0.26, 0.2))
    add_material(spec, "green", (0.36, 0.55, 0.34))
    add_material(spec, "blue", (0.27, 0.42, 0.62))
    draw_box(spec.worldbody, "floor", (-4.0, -4.0, -0.1), (4.0, 4.0, 0.0), "floor")
    for number, (x, y, side, height, material) in enumerate(BOXES):
        half = side / 2
        draw_box(spec.worldbody, f"box {number}", (x - half, y - half, 0.0), (x + half, y + half, height), material)
    return spec.compile()


def lights() -> tuple:
    """The lamp, which looks straight down."""
    import warp_psf as psf

    return (
        psf.rectangle_light(
            "lamp", LAMP_SIDE, LAMP_SIDE, radiance=(14, 13, 11), position=(0, 0, LAMP_HEIGHT), target=(0, 0, 0)
        ),
    )


def environment() -> psf.Environment:
    """A dim blue sky, which fills the shadows and is the background."""
    return dimmed("sky", 0.15)


if __name__ == "__main__":
    from warp_psf.cli import run_simulation

    run_simulation(build, states, name="cubes", camera="front", environment=environment(), lights=lights())
