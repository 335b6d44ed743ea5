"""A glossy statue turns over a red floor in the sun: 2 drawn bodies, about 14,000 vertices. `python -m sims.sunlit`.

The scene of figure 8 of Iwasaki 2007, in light that spherical harmonics cannot show: a sun of two degrees, which casts
shadows with sharp edges, a bright window, and a dim blue sky. The floor reddens the statue.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from sims import HIDDEN_GROUP, add_material, add_mesh, draw_box, draw_mesh, new_stage, step_frames
from sims.bodies import statue_like

if TYPE_CHECKING:
    import warp_psf as psf

# Metres, and grid cells over the statue's height: 14,068 vertices.
STATUE_HEIGHT, STATUE_CELLS = 1.3, 100
# What the motor turns: kilograms, and metres of radius.
STATUE_MASS, STATUE_RADIUS = 80.0, 0.3
# Radians per second, and newton metres per radian per second: the statue reaches its speed in a fifth of a second.
SPEED, MOTOR_GAIN = 0.6, 20.0
# Narrower than that of the other simulations: such a highlight shows the window's edges, not a glow.
SHININESS, GLOSS = 0.3, 0.9
# The largest image that a renderer takes as it is; the sun is 6 of its cells wide.
ROWS, COLUMNS = 512, 1024
# Finer points per cell, along each side, that tell how much of a cell the sun covers.
FINER = 8
# The sun: its diameter, how high and in which direction it stands (radians), and what it gives a surface that faces it.
SUN_DIAMETER = math.radians(2.0)
SUN_HEIGHT, SUN_AZIMUTH = math.radians(45.0), math.radians(168.0)
SUN_IRRADIANCE = (2.9, 2.7, 2.35)
# The window: first and last angle above the horizon and around it, degrees, and its radiance.
WINDOW_HEIGHTS, WINDOW_AZIMUTHS = (16.0, 40.0), (-32.0, -16.0)
WINDOW_RADIANCE = (11.0, 11.5, 12.0)
# Radiance of the sky above and at the horizon, and of the ground.
ZENITH, HORIZON, GROUND = (0.05, 0.08, 0.15), (0.13, 0.17, 0.23), (0.05, 0.04, 0.035)


def build() -> mujoco.MjModel:
    """A floor, and the statue on a hinge with a motor."""
    spec = new_stage(position=(0.5, -4.2, 2.3), target=(0.5, -0.05, 0.6), fovy=25)
    add_material(spec, "floor", (0.78, 0.13, 0.1))
    add_material(spec, "statue", (0.8, 0.77, 0.7), gloss=GLOSS)
    spec.material("statue").shininess = SHININESS
    draw_box(spec.worldbody, "floor", (-30.0, -8.0, -0.1), (30.0, 52.0, 0.0), "floor")
    add_mesh(spec, "statue", statue_like("raised", STATUE_HEIGHT, STATUE_CELLS))
    statue = spec.worldbody.add_body(name="statue")
    draw_mesh(statue, "statue", "statue")
    statue.add_joint(name="turntable", type=mujoco.mjtJoint.mjJNT_HINGE, axis=(0, 0, 1))
    half = STATUE_HEIGHT / 2
    statue.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        size=[STATUE_RADIUS, half, 0],
        pos=[0, 0, half],
        mass=STATUE_MASS,
        group=HIDDEN_GROUP,
        contype=0,
        conaffinity=0,
    )
    motor = spec.add_actuator(name="motor", target="turntable", trntype=mujoco.mjtTrn.mjTRN_JOINT)
    motor.set_to_velocity(kv=MOTOR_GAIN)
    return spec.compile()


def states(model: mujoco.MjModel, frames_per_second: float = 30, duration: float = math.inf) -> Iterator[mujoco.MjData]:
    """The state at each frame, from the start: the same `MjData` every time, stepped on."""
    data = mujoco.MjData(model)
    data.ctrl[0] = SPEED
    return step_frames(model, data, frames_per_second, duration)


def lights() -> tuple:
    """None: all light comes from the environment."""
    return ()


def environment() -> psf.Environment:
    """Sun, window and sky."""
    import warp_psf as psf

    return psf.Environment("sunlit", sky() + window() + sun())


def sun_direction() -> np.ndarray:
    """Where the middle of the sun stands, a unit vector [3]."""
    level = math.cos(SUN_HEIGHT)
    return np.array([level * math.cos(SUN_AZIMUTH), level * math.sin(SUN_AZIMUTH), math.sin(SUN_HEIGHT)])


def sun(diameter: float = SUN_DIAMETER) -> np.ndarray:
    """The sun alone as an image, radiance [ROWS, COLUMNS, 3]: a disc of `diameter`, radians, its edges antialiased.

    Whatever its diameter, a surface that faces it receives SUN_IRRADIANCE.
    """
    share = np.zeros((ROWS, COLUMNS))
    theta, phi = np.pi * (np.arange(ROWS) + 0.5) / ROWS, 2 * np.pi * (np.arange(COLUMNS) + 0.5) / COLUMNS
    near = _directions(theta[:, None], phi) @ sun_direction() > math.cos(diameter / 2 + 2 * np.pi / ROWS)
    rows, columns = np.nonzero(near)
    finer = (np.arange(FINER) + 0.5) / FINER - 0.5
    fine_theta = theta[rows, None, None] + np.pi / ROWS * finer[:, None]
    fine_phi = phi[columns, None, None] + 2 * np.pi / COLUMNS * finer
    share[rows, columns] = np.mean(
        _directions(fine_theta, fine_phi) @ sun_direction() > math.cos(diameter / 2), axis=(1, 2)
    )
    # What faces the sun receives the integral of radiance times cosine.
    edges = np.cos(np.pi * np.arange(ROWS + 1) / ROWS)
    cosine = _directions(theta[:, None], phi) @ sun_direction()
    received = np.sum(share * cosine * (edges[:-1] - edges[1:])[:, None]) * 2 * np.pi / COLUMNS
    return share[..., None] / received * np.array(SUN_IRRADIANCE)


def window(radiance: tuple[float, float, float] = WINDOW_RADIANCE) -> np.ndarray:
    """The window alone as an image, radiance [ROWS, COLUMNS, 3]."""
    height = 90.0 - 180.0 * (np.arange(ROWS) + 0.5) / ROWS
    azimuth = (360.0 * (np.arange(COLUMNS) + 0.5) / COLUMNS + 180.0) % 360.0 - 180.0
    inside = ((height > WINDOW_HEIGHTS[0]) & (height < WINDOW_HEIGHTS[1]))[:, None]
    inside = inside & (azimuth > WINDOW_AZIMUTHS[0]) & (azimuth < WINDOW_AZIMUTHS[1])
    return inside[..., None] * np.array(radiance)


def sky() -> np.ndarray:
    """Sky and ground alone as an image, radiance [ROWS, COLUMNS, 3]."""
    upward = np.cos(np.pi * (np.arange(ROWS) + 0.5) / ROWS)[:, None]
    share = np.sqrt(np.maximum(upward, 0.0))
    column = np.where(upward > 0.0, share * np.array(ZENITH) + (1 - share) * np.array(HORIZON), np.array(GROUND))
    return np.repeat(column[:, None], COLUMNS, axis=1)


def _directions(theta: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """Unit vectors [..., 3] at polar angles and azimuths that broadcast together."""
    theta, phi = np.broadcast_arrays(theta, phi)
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)


if __name__ == "__main__":
    from warp_psf.cli import run_simulation

    light = {"environment": environment(), "lights": lights(), "basis": "haar"}
    run_simulation(build, states, name="sunlit", camera="front", **light)
