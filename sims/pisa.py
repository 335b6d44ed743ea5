"""A leaning tower of arcades, for point lists: small triangles beside large ones. `python -m sims.pisa`.

The tower of figure 40 of Jeng 2005, which is 2,239,674 points in three lists.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from sims import add_material, add_mesh, dimmed, draw_mesh, new_stage, rest
from sims.surfaces import Body, join, revolve, tube

if TYPE_CHECKING:
    import warp_psf as psf

# Metres, of a model a hundredth of the tower's size.
STOREYS, STOREY_HEIGHT, RADIUS, CORE_RADIUS = 6, 0.066, 0.077, 0.06
COLUMNS, COLUMN_RADIUS = 28, 0.0032
LEAN = math.radians(4.0)
SEGMENTS, SIDES = 112, 12
# Side of the smallest squares with which its points are as many as the paper's.
SMALLEST = 0.00092
states = rest


def build() -> mujoco.MjModel:
    """A lawn and the tower, of a body per storey, the ground floor and the bell chamber."""
    spec = new_stage(position=(0.5, -1.5, 0.55), target=(0.02, 0.0, 0.29), fovy=27)
    add_material(spec, "lawn", (0.42, 0.56, 0.3))
    add_material(spec, "marble", (0.87, 0.84, 0.78))
    spec.worldbody.add_geom(
        name="lawn",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0.5, 0.5, 0.1],
        material="lawn",
        contype=0,
        conaffinity=0,
        mass=0,
        group=0,
    )
    tower = spec.worldbody.add_body(name="tower", quat=[math.cos(LEAN / 2), 0, math.sin(LEAN / 2), 0])
    parts = {"ground floor": ground_floor(), "bell chamber": bell_chamber()}
    parts |= {f"storey {number}": storey(0.11 + number * STOREY_HEIGHT) for number in range(STOREYS)}
    for name, surface in parts.items():
        add_mesh(spec, name, surface)
        draw_mesh(tower, name, "marble")
    return spec.compile()


def storey(base: float) -> Body:
    """A gallery: core, floor, columns with capitals, arches and cornice, from the height `base` on."""
    top = base + STOREY_HEIGHT
    parts = [_ring(CORE_RADIUS - 0.01, CORE_RADIUS, base, top), _ring(CORE_RADIUS, RADIUS + 0.003, base, base + 0.006)]
    parts.append(_ring(CORE_RADIUS, RADIUS + 0.002, top - 0.008, top))
    parts += [_column(angle, RADIUS - 0.004, base + 0.006, top - 0.02, COLUMN_RADIUS) for angle in _angles(COLUMNS)]
    parts += [_arch(angle, RADIUS - 0.004, top - 0.02, 2 * math.pi / COLUMNS) for angle in _angles(COLUMNS)]
    return join(*parts)


def ground_floor() -> Body:
    """A wall with half columns and blind arches."""
    parts = [_ring(CORE_RADIUS, RADIUS - 0.004, 0.0, 0.104), _ring(CORE_RADIUS, RADIUS + 0.006, 0.0, 0.006)]
    parts.append(_ring(CORE_RADIUS, RADIUS + 0.004, 0.1, 0.11))
    parts += [_column(angle, RADIUS - 0.003, 0.006, 0.08, 0.0045) for angle in _angles(15)]
    parts += [_arch(angle, RADIUS - 0.003, 0.08, 2 * math.pi / 15) for angle in _angles(15)]
    return join(*parts)


def bell_chamber() -> Body:
    """The narrower top."""
    base = 0.11 + STOREYS * STOREY_HEIGHT
    parts = [_ring(0.042, 0.05, base, base + 0.06), _ring(0.035, 0.056, base + 0.06, base + 0.068)]
    parts += [_column(angle, 0.052, base, base + 0.06, 0.003) for angle in _angles(14)]
    return join(*parts)


def _angles(count: int) -> np.ndarray:
    return 2 * np.pi * np.arange(count) / count


def _ring(inner: float, outer: float, low: float, high: float) -> Body:
    """A ring of rectangular section."""
    profile = np.array([[outer, low], [outer, high], [inner, high], [inner, low]])
    return revolve(profile, SEGMENTS, closed=True)


def _column(angle: float, distance: float, low: float, high: float, radius: float) -> Body:
    """A shaft with a base and a capital."""
    height = np.array([0.0, 0.03, 0.05, 0.1, 0.5, 0.88, 0.94, 0.97, 1.0])
    width = np.array([1.5, 1.5, 1.15, 1.0, 0.95, 0.86, 1.2, 1.5, 1.5])
    middle = distance * np.array([math.cos(angle), math.sin(angle)])
    path = np.column_stack([np.broadcast_to(middle, (len(height), 2)), low + height * (high - low)])
    return tube(path, radius * width, SIDES)


def _arch(angle: float, distance: float, base: float, spread: float) -> Body:
    """A half circle from one column to the next."""
    turn = np.linspace(0, np.pi, 14)
    half = distance * math.sin(spread / 2)
    around = angle + spread / 2 - np.arcsin(np.clip(half * np.cos(turn) / distance, -1, 1))
    path = np.column_stack([distance * np.cos(around), distance * np.sin(around), base + 0.9 * half * np.sin(turn)])
    return tube(path, np.full(len(turn), 0.0026), 8)


def lights() -> tuple:
    """The evening sun, as a lamp."""
    import warp_psf as psf

    return (psf.rectangle_light("sun", 0.4, 0.4, (55, 48, 36), position=(-1.6, -1.4, 1.5), target=(0.0, 0.0, 0.25)),)


def environment() -> psf.Environment:
    """The sky."""
    return dimmed("sky", 0.6)


if __name__ == "__main__":
    from warp_psf.cli import run_simulation

    run_simulation(build, states, name="pisa", camera="front", environment=environment(), lights=lights())
