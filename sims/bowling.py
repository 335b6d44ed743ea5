"""Ten pins and a ball: 15 drawn bodies, about 41,340 vertices. `python -m sims.bowling` renders it.

The lane runs along +x; the head pin stands at the origin, the ball comes from -x.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from sims import HIDDEN_GROUP, add_material, add_mesh, dimmed, draw_box, draw_mesh, new_stage, step_frames
from sims.bodies import BALL_DIAMETER, INCH, ball, pin, pin_profile
from sims.surfaces import revolve

if TYPE_CHECKING:
    import warp_psf as psf

PIN_SPACING = 12 * INCH
# Kilograms: 3 pounds 6 ounces and 15 pounds.
PIN_MASS, BALL_MASS = 1.53, 6.8
# A pin is concave at the neck, so it collides as convex slices between these heights, inches.
PIN_SLICES = ((0.0, 8.2), (7.9, 10.3), (10.0, 15.0))
PIN_SLICE_SEGMENTS = 36
# Time constant (s) and damping ratio of contacts: hard, pins spring back, the curtain at the back swallows the ball.
LIVELY, DULL = (0.003, 0.25), (0.03, 1.6)
# Where the ball starts, metres, and how it moves, m/s; it aims at the pocket beside the head pin.
BALL_START = (-2.4, -0.25, BALL_DIAMETER / 2)
BALL_SPEED, BALL_ANGLE = 2.4, math.radians(4.6)
# Spin about the vertical, rad/s.
BALL_SIDE_SPIN = 3.0


def build() -> mujoco.MjModel:
    """Lane, side walls, curtain, rack and ball."""
    spec = new_stage(position=(-4.3, -1.5, 1.05), target=(0.2, -0.1, 0.17), fovy=12.8)
    add_material(spec, "lane", (0.86, 0.71, 0.53), gloss=0.04)
    add_material(spec, "wall", (0.88, 0.84, 0.78))
    add_material(spec, "curtain", (0.52, 0.64, 0.68))
    add_material(spec, "pin", (0.93, 0.92, 0.89), gloss=0.12)
    add_material(spec, "ball", (0.07, 0.16, 0.5), gloss=0.6)
    _add_lane(spec)
    add_mesh(spec, "pin", pin(rings=64, segments=54))
    for low, high in PIN_SLICES:
        add_mesh(spec, f"pin_{low:g}", _pin_slice(low, high))
    number = 0
    for row in range(4):
        for column in range(row + 1):
            number += 1
            place = (row * PIN_SPACING * math.sqrt(3) / 2, (column - row / 2) * PIN_SPACING, 0.0)
            _add_pin(spec, f"pin_{number}", place)
    _add_ball(spec)
    return spec.compile()


def states(model: mujoco.MjModel, frames_per_second: float = 30, duration: float = math.inf) -> Iterator[mujoco.MjData]:
    """The state at each frame, from the start: the same `MjData` every time, stepped on."""
    data = mujoco.MjData(model)
    radius = BALL_DIAMETER / 2
    velocity = BALL_SPEED * np.array([math.cos(BALL_ANGLE), math.sin(BALL_ANGLE), 0.0])
    spin = np.cross([0.0, 0.0, 1.0], velocity) / radius + [0.0, 0.0, BALL_SIDE_SPIN]
    first = model.joint("ball").dofadr[0]
    data.qvel[first : first + 6] = *velocity, *spin
    return step_frames(model, data, frames_per_second, duration)


def lights() -> tuple:
    """A soft box to the left of the pins, so that their shadows fall to the right."""
    import warp_psf as psf

    return (
        psf.rectangle_light(
            "soft box", 1.5, 1.5, radiance=(52.0, 49.0, 44.5), position=(-3.0, 2.7, 2.9), target=(0.3, 0.0, 0.1)
        ),
    )


def environment() -> psf.Environment:
    """Fills the shadows: on the lane, about half of what the soft box gives."""
    return dimmed("studio", 0.42, turn=-math.pi / 2)


def _add_lane(spec: mujoco.MjSpec) -> None:
    world = spec.worldbody
    draw_box(world, "lane", (-5.0, -3.5, -0.1), (2.0, 3.5, 0.0), "lane")
    world.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], group=HIDDEN_GROUP, friction=[0.25, 0.003, 0.0003])
    # Walls reach into the lane: two surfaces in one plane would fight over the same pixels.
    walls = {
        "wall_left": ((-0.1, 0.95, -0.03), (1.4, 1.02, 0.2), "wall", LIVELY),
        "wall_right": ((-0.1, -1.02, -0.03), (1.4, -0.95, 0.2), "wall", LIVELY),
        "curtain": ((1.45, -3.4, -0.03), (1.55, 3.4, 1.25), "curtain", DULL),
    }
    for name, (low, high, material, solref) in walls.items():
        draw_box(world, name, low, high, material)
        world.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=np.add(low, high) / 2,
            size=np.subtract(high, low) / 2,
            group=HIDDEN_GROUP,
            solref=solref,
            # The wall decides how a contact with it behaves.
            priority=1,
        )


def _add_pin(spec: mujoco.MjSpec, name: str, place: tuple[float, float, float]) -> None:
    body = spec.worldbody.add_body(name=name, pos=place)
    body.add_freejoint(name=name)
    draw_mesh(body, "pin", "pin")
    contact = {"group": HIDDEN_GROUP, "solref": LIVELY, "condim": 6, "friction": [0.3, 0.003, 0.0015]}
    for low, _ in PIN_SLICES:
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"pin_{low:g}", mass=PIN_MASS / len(PIN_SLICES), **contact
        )
    # The flat of the base, so that a pin stands on a circle and not on one point of its mesh.
    flat, height = 1.01 * INCH, 0.5 * INCH
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[flat, height / 2, 0], pos=[0, 0, height / 2], mass=0, **contact
    )


def _pin_slice(low: float, high: float):
    profile = pin_profile(80) / INCH
    profile = profile[(profile[:, 1] >= low) & (profile[:, 1] <= high)]
    # The base cylinder alone touches the lane when the pin stands.
    profile = profile[profile[:, 1] > 0.02] if low == 0 else profile
    ends = np.array([[0.0, profile[0, 1]]]), np.array([[0.0, profile[-1, 1]]])
    return revolve(np.concatenate([ends[0], profile[profile[:, 0] > 0.01], ends[1]]) * INCH, PIN_SLICE_SEGMENTS)


def _add_ball(spec: mujoco.MjSpec) -> None:
    add_mesh(spec, "ball", ball(cells=21))
    body = spec.worldbody.add_body(name="ball", pos=BALL_START)
    body.add_freejoint(name="ball")
    draw_mesh(body, "ball", "ball")
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[BALL_DIAMETER / 2, 0, 0],
        mass=BALL_MASS,
        group=HIDDEN_GROUP,
        solref=LIVELY,
        condim=6,
        friction=[0.12, 0.003, 0.0003],
    )


if __name__ == "__main__":
    from warp_psf.cli import run_simulation

    run_simulation(build, states, name="bowling", camera="front", environment=environment(), lights=lights())
