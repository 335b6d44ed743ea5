"""A furnished room under one square light: 17 drawn bodies, about 50,000 vertices. `python -m sims.room` renders it.

The scene of figure 6 of Iwasaki 2007: a glossy statue among diffuse furniture, a green and a red wall. The statue
turns, and a ball bounces across the room. x runs to the right, y away from the camera.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import mujoco
import numpy as np

from sims import HIDDEN_GROUP, add_material, add_mesh, draw_box, draw_mesh, draw_room, new_stage, step_frames
from sims.bodies import ball, pedestal, statue_like, teapot_like, vase
from sims.furniture import coffee_table, floor_lamp, potted_plant, sofa

# Metres.
LOW, HIGH = (-2.3, -3.6, 0.0), (2.3, 1.9, 2.6)
LIGHT_SIDE, LIGHT_GAP = 1.3, 0.02
# The ball passes in front of the rug, which has no collision geom.
RUG_LOW, RUG_HIGH = (-0.95, -0.62, 0.0), (1.15, 0.75, 0.012)
TABLE_HEIGHT, PEDESTAL_HEIGHT, STATUE_HEIGHT = 0.4, 0.55, 1.2
ARMCHAIR_WIDTH = 0.95
BALL_RADIUS, BALL_MASS = 0.15, 0.4
# The statue's grid cells over its height.
STATUE_CELLS = 74
# Radians per second: half a turn in the four seconds that are rendered by default.
STATUE_SPEED = math.pi / 4
# How the ball comes in: metres, m/s.
BALL_START, BALL_VELOCITY = (-1.6, -1.3, 1.2), (1.45, 0.3, 0.0)
# Time constant (s) and damping ratio of the ball's contacts: it keeps about half of its speed.
SOLREF = (0.01, 0.2)
# sRGB colours and the gloss of each.
PALETTE = {
    "plaster": ((0.9, 0.88, 0.84), 0.0),
    "floor": ((0.82, 0.77, 0.69), 0.0),
    "green": ((0.25, 0.55, 0.28), 0.0),
    "red": ((0.72, 0.25, 0.18), 0.0),
    "mustard": ((0.89, 0.64, 0.2), 0.0),
    "blue": ((0.28, 0.46, 0.66), 0.0),
    "wood": ((0.66, 0.47, 0.31), 0.0),
    "linen": ((0.9, 0.86, 0.78), 0.0),
    "leaf": ((0.36, 0.55, 0.27), 0.0),
    "china": ((0.88, 0.9, 0.92), 0.0),
    "coral": ((0.9, 0.45, 0.36), 0.0),
    "rug": ((0.6, 0.62, 0.66), 0.0),
    "marble": ((0.72, 0.71, 0.69), 0.5),
}
# Per piece: material, place (metres), and turn about z (radians).
PIECES = {
    "sofa": ("mustard", (0.2, 1.35, 0.0), 0.0),
    "armchair": ("blue", (1.55, 0.1, 0.0), -1.05),
    "table": ("wood", (0.1, 0.05, RUG_HIGH[2]), 0.2),
    "vase": ("coral", (0.3, 0.17, RUG_HIGH[2] + TABLE_HEIGHT), 0.0),
    "teapot": ("china", (-0.1, -0.02, RUG_HIGH[2] + TABLE_HEIGHT), 0.5),
    "lamp": ("linen", (1.65, 1.45, 0.0), 0.0),
    "plant": ("leaf", (-1.4, 1.3, 0.0), 0.3),
    "pedestal": ("plaster", (-1.45, 0.15, 0.0), 0.0),
}


def build() -> mujoco.MjModel:
    """The room, its furniture, the statue as a mocap body, and the ball, which alone is free."""
    spec = new_stage(position=(0.0, -3.5, 1.45), target=(0.0, 0.4, 1.1), fovy=47)
    for name, (rgb, gloss) in PALETTE.items():
        add_material(spec, name, rgb, gloss)
    sides = {"floor": "floor", "left": "green", "right": "red"}
    draw_room(spec, LOW, HIGH, {name: sides.get(name, "plaster") for name in (*sides, "ceiling", "front", "back")})
    draw_box(spec.worldbody, "rug", RUG_LOW, RUG_HIGH, "rug")
    _add_furniture(spec)
    _add_colliders(spec)
    _add_ball(spec)
    return spec.compile()


def states(model: mujoco.MjModel, frames_per_second: float = 30, duration: float = math.inf) -> Iterator[mujoco.MjData]:
    """The state at each frame, from the start: the same `MjData` every time, stepped on."""
    data = mujoco.MjData(model)
    first = model.joint("ball").dofadr[0]
    data.qvel[first : first + 3] = BALL_VELOCITY
    statue = model.body("statue").mocapid[0]
    for frame in step_frames(model, data, frames_per_second, duration):
        half = STATUE_SPEED * frame.time / 2
        frame.mocap_quat[statue] = math.cos(half), 0.0, 0.0, math.sin(half)
        mujoco.mj_kinematics(model, frame)
        yield frame


def lights() -> tuple:
    """A square panel under the middle of the ceiling."""
    import warp_psf as psf

    height = HIGH[2] - LIGHT_GAP
    return (
        psf.rectangle_light(
            "panel",
            LIGHT_SIDE,
            LIGHT_SIDE,
            radiance=(18.0, 16.8, 15.0),
            position=(0, -0.3, height),
            target=(0, -0.3, 0),
        ),
    )


def environment() -> None:
    """None: the room is closed."""
    return None


def _add_furniture(spec: mujoco.MjSpec) -> None:
    bodies = {
        "sofa": sofa(),
        "armchair": sofa(ARMCHAIR_WIDTH, seats=1),
        "table": coffee_table(0.5, TABLE_HEIGHT),
        "vase": vase(0.36, rings=50, segments=64),
        "teapot": teapot_like(0.13, rings=44, segments=44),
        "lamp": floor_lamp(),
        "plant": potted_plant(),
        "pedestal": pedestal(0.32, PEDESTAL_HEIGHT, rings=30, segments=56),
    }
    for name, surface in bodies.items():
        material, place, turn = PIECES[name]
        add_mesh(spec, name, surface)
        quaternion = [math.cos(turn / 2), 0.0, 0.0, math.sin(turn / 2)]
        draw_mesh(spec.worldbody.add_body(name=name, pos=place, quat=quaternion), name, material)
    add_mesh(spec, "statue", statue_like("raised", STATUE_HEIGHT, cells=STATUE_CELLS))
    x, y, _ = PIECES["pedestal"][1]
    statue = spec.worldbody.add_body(name="statue", mocap=True, pos=(x, y, PEDESTAL_HEIGHT))
    draw_mesh(statue, "statue", "marble")


def _add_colliders(spec: mujoco.MjSpec) -> None:
    """What the ball meets: the room's six sides, and boxes and cylinders in place of the furniture."""
    contact = {"group": HIDDEN_GROUP, "solref": SOLREF}
    box, cylinder = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CYLINDER
    for axis in range(3):
        for side, corner in ((1.0, LOW), (-1.0, HIGH)):
            # A plane is solid below its own z: `zaxis` points into the room.
            inward = side * np.eye(3)[axis]
            spec.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], pos=corner, zaxis=inward, **contact
            )
    spec.body("sofa").add_geom(type=box, size=[1.0, 0.45, 0.4], pos=[0, 0, 0.4], **contact)
    half = ARMCHAIR_WIDTH / 2
    spec.body("armchair").add_geom(type=box, size=[half, 0.45, 0.4], pos=[0, 0, 0.4], **contact)
    radii = {"table": (0.5, TABLE_HEIGHT), "lamp": (0.15, 1.6), "plant": (0.2, 0.5), "pedestal": (0.32, 1.6)}
    for name, (radius, height) in radii.items():
        spec.body(name).add_geom(type=cylinder, size=[radius, height / 2, 0], pos=[0, 0, height / 2], **contact)


def _add_ball(spec: mujoco.MjSpec) -> None:
    add_mesh(spec, "ball", ball(19, 2 * BALL_RADIUS))
    body = spec.worldbody.add_body(name="ball", pos=BALL_START)
    body.add_freejoint(name="ball")
    draw_mesh(body, "ball", "china")
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[BALL_RADIUS, 0, 0],
        mass=BALL_MASS,
        group=HIDDEN_GROUP,
        solref=SOLREF,
        condim=6,
        friction=[0.6, 0.01, 0.004],
    )


if __name__ == "__main__":
    from warp_psf.cli import run_simulation

    run_simulation(build, states, name="room", camera="front", environment=environment(), lights=lights())
