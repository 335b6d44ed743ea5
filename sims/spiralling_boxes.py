"""Twelve boxes that wind up around nothing: 148 triangles. `python -m sims.spiralling_boxes`.

The first scene of table 2 of Jeng 2005, with a floor and a wall of two triangles each.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import mujoco

from sims import add_material, dimmed, new_stage, rest

if TYPE_CHECKING:
    import warp_psf as psf

BOXES = 12
# Metres; a box is turned from the one below it by so many radians.
RADIUS, RISE, HALF_EXTENTS = 0.62, 0.13, (0.2, 0.11, 0.06)
TURN, FIRST_HEIGHT = math.radians(38), 0.06
ROOM = 3.0
COLORS = ((0.75, 0.3, 0.22), (0.85, 0.72, 0.45), (0.3, 0.45, 0.62))
states = rest


def build() -> mujoco.MjModel:
    """Floor, wall and the boxes."""
    spec = new_stage(position=(0.9, -4.4, 2.6), target=(0.0, 0.0, 0.62), fovy=30)
    add_material(spec, "floor", (0.86, 0.84, 0.8))
    add_material(spec, "wall", (0.7, 0.76, 0.8))
    for number, color in enumerate(COLORS):
        add_material(spec, f"box {number}", color)
    drawn = {"contype": 0, "conaffinity": 0, "mass": 0, "group": 0}
    flat = {"type": mujoco.mjtGeom.mjGEOM_PLANE, **drawn}
    spec.worldbody.add_geom(name="floor", size=[ROOM, ROOM, 0.1], material="floor", **flat)
    half = math.sqrt(0.5)
    spec.worldbody.add_geom(
        name="wall",
        size=[ROOM, ROOM / 2, 0.1],
        pos=[0, 1.5, ROOM / 2],
        quat=[half, half, 0, 0],
        material="wall",
        **flat,
    )
    for number in range(BOXES):
        angle = number * TURN
        spec.worldbody.add_geom(
            name=f"box {number}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=HALF_EXTENTS,
            pos=[RADIUS * math.cos(angle), RADIUS * math.sin(angle), FIRST_HEIGHT + RISE * number],
            quat=[math.cos(angle / 2), 0, 0, math.sin(angle / 2)],
            material=f"box {number % len(COLORS)}",
            **drawn,
        )
    return spec.compile()


def lights() -> tuple:
    """The lamp, above and to the left."""
    import warp_psf as psf

    return (psf.rectangle_light("lamp", 0.8, 0.8, (28, 26, 23), position=(-1.3, -1.4, 3.1), target=(0.0, 0.1, 0.3)),)


def environment() -> psf.Environment:
    """A dim blue sky, which fills the shadows and is the background."""
    return dimmed("sky", 0.15)


if __name__ == "__main__":
    from warp_psf.cli import run_simulation

    run_simulation(build, states, name="spiralling_boxes", camera="front", environment=environment(), lights=lights())
