"""Thirty teapots in a room under one square light: 36 drawn bodies, about 122,000 vertices. `python -m sims.teapots`.

The scene of figure 7 of Iwasaki 2007: four glossy teapots among 26 coloured diffuse ones. They glide around the middle
of the room in three rings, neighbouring rings in opposite directions, and each turns about itself.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import mujoco

from sims import add_material, add_mesh, draw_mesh, draw_room, frame_numbers, new_stage
from sims.bodies import teapot_like

# Metres.
LOW, HIGH = (-2.3, -4.2, 0.0), (2.3, 2.2, 2.6)
LIGHT_SIDE, LIGHT_GAP = 1.3, 0.02
TEAPOT_RADIUS = 0.17
# Rings and segments of a teapot's pot: 3,862 vertices with its spout and handle.
TEAPOT_RINGS, TEAPOT_SEGMENTS = 44, 44
# Per ring: how many teapots, its radius (metres), its speed (radians per second), and a teapot's own turns per turn
# of the ring. A teapot reaches 1.66 of its radii from its axis; the axes are farther apart than two such reaches.
RINGS = ((4, 0.45, 0.3, -2.0), (10, 1.04, -0.2, -3.0), (16, 1.64, 0.12, -4.0))
# sRGB.
COLORS = {
    "cyan": (0.2, 0.72, 0.76),
    "yellow": (0.93, 0.78, 0.2),
    "purple": (0.53, 0.27, 0.66),
    "green": (0.3, 0.66, 0.3),
    "red": (0.82, 0.22, 0.2),
    "white": (0.9, 0.89, 0.87),
}
GLOSSY_COLOR, GLOSS = (0.5, 0.5, 0.5), 0.7


def build() -> mujoco.MjModel:
    """The room and the teapots, which are mocap bodies; the inner ring is glossy."""
    spec = new_stage(position=(0.0, -4.1, 2.0), target=(0.0, -0.5, 0.2), fovy=36)
    add_material(spec, "plaster", (0.88, 0.86, 0.83))
    add_material(spec, "floor", (0.84, 0.81, 0.76))
    add_material(spec, "glossy", GLOSSY_COLOR, gloss=GLOSS)
    for name, rgb in COLORS.items():
        add_material(spec, name, rgb)
    walls = ("ceiling", "left", "right", "front", "back")
    draw_room(spec, LOW, HIGH, {"floor": "floor"} | dict.fromkeys(walls, "plaster"))
    add_mesh(spec, "teapot", teapot_like(TEAPOT_RADIUS, TEAPOT_RINGS, TEAPOT_SEGMENTS))
    for number, (ring, _) in enumerate(_places()):
        body = spec.worldbody.add_body(name=f"teapot_{number}", mocap=True)
        draw_mesh(body, "teapot", "glossy" if ring == 0 else list(COLORS)[number % len(COLORS)])
    return spec.compile()


def states(model: mujoco.MjModel, frames_per_second: float = 30, duration: float = math.inf) -> Iterator[mujoco.MjData]:
    """The state at each frame, from the start: the same `MjData` every time, moved on."""
    data = mujoco.MjData(model)
    for frame in frame_numbers(frames_per_second, duration):
        data.time = frame / frames_per_second
        _place_teapots(data)
        mujoco.mj_forward(model, data)
        yield data


def lights() -> tuple:
    """A square panel under the middle of the ceiling."""
    import warp_psf as psf

    height = HIGH[2] - LIGHT_GAP
    return (
        psf.rectangle_light(
            "panel", LIGHT_SIDE, LIGHT_SIDE, radiance=(18.0, 16.8, 15.0), position=(0, 0, height), target=(0, 0, 0)
        ),
    )


def environment() -> None:
    """None: the room is closed."""
    return None


def _places() -> list[tuple[int, float]]:
    """Per teapot: its ring, and its share of the way around it."""
    return [(ring, place / count) for ring, (count, *_) in enumerate(RINGS) for place in range(count)]


def _place_teapots(data: mujoco.MjData) -> None:
    for number, (ring, share) in enumerate(_places()):
        _, radius, speed, turns = RINGS[ring]
        angle = 2 * math.pi * share + speed * data.time
        data.mocap_pos[number] = radius * math.cos(angle), radius * math.sin(angle), 0.0
        half = (2 * math.pi * share + turns * speed * data.time) / 2
        data.mocap_quat[number] = math.cos(half), 0.0, 0.0, math.sin(half)


if __name__ == "__main__":
    from warp_psf.cli import run_simulation

    run_simulation(build, states, name="teapots", camera="front", environment=environment(), lights=lights())
