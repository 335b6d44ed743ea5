"""Four figures turn and glide past each other: 6 drawn bodies, about 32,875 vertices. `python -m sims.statues`."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

import mujoco

from sims import add_material, add_mesh, dimmed, draw_box, draw_mesh, frame_numbers, new_stage
from sims.bodies import pedestal, statue_like

if TYPE_CHECKING:
    import warp_psf as psf

# Metres.
PEDESTAL_HEIGHT, STATUE_HEIGHT = 0.42, 1.25
# Grid cells over a statue's height: about 7,500 vertices each.
RAISED_CELLS, STAFF_CELLS = 73, 67
# Seconds in which the dancers go once around the pedestal: the motion repeats from there.
PERIOD = 12.0
ORBIT_X, ORBIT_Y = 1.25, 0.8
# Per statue: mesh, material, where on the orbit it starts (None stands on the pedestal), turns about itself per period.
STATUES = {
    "herald": ("raised", "bronze", None, 1),
    "pilgrim": ("staff", "marble", 0.0, -1),
    "runner": ("raised", "clay", 1 / 3, 2),
    "shepherd": ("staff", "slate", 2 / 3, 1),
}


def build() -> mujoco.MjModel:
    """Floor, pedestal and four statues; the statues are mocap bodies."""
    spec = new_stage(position=(0.25, -5.0, 1.45), target=(0.0, 0.0, 0.84), fovy=28)
    add_material(spec, "floor", (0.82, 0.79, 0.75))
    add_material(spec, "stone", (0.62, 0.6, 0.57))
    add_material(spec, "bronze", (0.66, 0.45, 0.28), gloss=0.2)
    add_material(spec, "marble", (0.9, 0.88, 0.84))
    add_material(spec, "clay", (0.75, 0.44, 0.34))
    add_material(spec, "slate", (0.27, 0.36, 0.43), gloss=0.15)
    draw_box(spec.worldbody, "floor", (-30.0, -6.0, -0.1), (30.0, 54.0, 0.0), "floor")
    add_mesh(spec, "pedestal", pedestal(0.4, PEDESTAL_HEIGHT, rings=28, segments=60))
    add_mesh(spec, "raised", statue_like("raised", STATUE_HEIGHT, cells=RAISED_CELLS))
    add_mesh(spec, "staff", statue_like("staff", STATUE_HEIGHT, cells=STAFF_CELLS))
    draw_mesh(spec.worldbody, "pedestal", "stone")
    for name, (mesh, material, _, _) in STATUES.items():
        body = spec.worldbody.add_body(name=name, mocap=True)
        draw_mesh(body, mesh, material)
    return spec.compile()


def states(model: mujoco.MjModel, frames_per_second: float = 30, duration: float = math.inf) -> Iterator[mujoco.MjData]:
    """The state at each frame, from the start: the same `MjData` every time, moved on."""
    data = mujoco.MjData(model)
    for frame in frame_numbers(frames_per_second, duration):
        data.time = frame / frames_per_second
        _place_statues(model, data)
        mujoco.mj_forward(model, data)
        yield data


def lights() -> tuple:
    """A tall window to the left."""
    import warp_psf as psf

    return (
        psf.rectangle_light(
            "window", 2.2, 2.2, radiance=(30.0, 26.5, 21.5), position=(-4.6, -3.6, 4.4), target=(0.0, 0.0, 0.5)
        ),
    )


def environment() -> psf.Environment:
    """A dim blue sky, which fills the shadows and is the background."""
    return dimmed("sky", 0.55)


def _place_statues(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    share = data.time / PERIOD
    for name, (_, _, start, turns) in STATUES.items():
        mocap = model.body(name).mocapid[0]
        if start is None:
            data.mocap_pos[mocap] = 0.0, 0.0, PEDESTAL_HEIGHT
        else:
            angle = 2 * math.pi * (share + start)
            data.mocap_pos[mocap] = ORBIT_X * math.cos(angle), ORBIT_Y * math.sin(angle), 0.0
        half = math.pi * turns * share
        data.mocap_quat[mocap] = math.cos(half), 0.0, 0.0, math.sin(half)


if __name__ == "__main__":
    from warp_psf.cli import run_simulation

    run_simulation(build, states, name="statues", camera="front", environment=environment(), lights=lights())
