"""A bent pipe over a floor, under one rectangular lamp. `python -m sims.pipe`. The scene of figure 13 of Jeng 2005."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from sims import add_material, add_mesh, dimmed, draw_box, draw_mesh, new_stage, rest
from sims.surfaces import resample, rounded_path, tube

if TYPE_CHECKING:
    import warp_psf as psf

# Metres: the corners of the pipe's middle line in its plane (along x, upwards), its radius and that of its flanges.
CORNERS = np.array([[-0.9, 0.55], [-0.1, 0.55], [-0.1, 1.15], [0.75, 1.15], [0.75, 0.07]])
RADIUS, FLANGE_RADIUS, FLANGE_WIDTH, BEND = 0.11, 0.17, 0.05, 0.22
RINGS, SIDES = 120, 40
states = rest


def build() -> mujoco.MjModel:
    """Floor, pipe, its two flanges, and the block that holds one end."""
    spec = new_stage(position=(0.5, -4.3, 2.5), target=(0.0, 0.1, 0.5), fovy=32)
    add_material(spec, "floor", (0.84, 0.82, 0.78))
    add_material(spec, "copper", (0.74, 0.42, 0.28), gloss=0.2)
    add_material(spec, "iron", (0.34, 0.37, 0.4))
    draw_box(spec.worldbody, "floor", (-4.0, -4.0, -0.1), (4.0, 4.0, 0.0), "floor")
    draw_box(spec.worldbody, "block", (-1.25, -0.25, 0.0), (-0.95, 0.25, 0.85), "iron")
    flat = resample(rounded_path(CORNERS, BEND), RINGS)
    path = np.stack([flat[:, 0], np.zeros(RINGS), flat[:, 1]], axis=1)
    add_mesh(spec, "pipe", tube(path, np.full(RINGS, RADIUS), SIDES))
    draw_mesh(spec.worldbody, "pipe", "copper")
    for name, start, end in (
        ("wall flange", (-0.95, 0, 0.55), (-0.95 + FLANGE_WIDTH, 0, 0.55)),
        ("floor flange", (0.75, 0, 0.0), (0.75, 0, FLANGE_WIDTH)),
    ):
        add_mesh(spec, name, tube(np.array([start, end]), np.full(2, FLANGE_RADIUS), SIDES))
        draw_mesh(spec.worldbody, name, "iron")
    return spec.compile()


def lights() -> tuple:
    """The lamp, to the left above the pipe."""
    import warp_psf as psf

    return (psf.rectangle_light("lamp", 0.9, 0.6, (26, 24, 20), position=(-0.7, -0.9, 2.7), target=(0.05, 0.1, 0.3)),)


def environment() -> psf.Environment:
    """A dim blue sky, which fills the shadows and is the background."""
    return dimmed("sky", 0.15)


if __name__ == "__main__":
    from warp_psf.cli import run_simulation

    run_simulation(build, states, name="pipe", camera="front", environment=environment(), lights=lights())
