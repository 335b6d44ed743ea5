"""A garden along a wall: 1,274 triangles. `python -m sims.garden`.

The second scene of table 2 of Jeng 2005, of about 1,273 triangles. The lamp looks along the wall, which it lights at a
grazing angle: seen from there, few samples lie on the wall.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from sims import add_material, add_mesh, dimmed, draw_box, draw_mesh, new_stage, rest
from sims.surfaces import Body, join, revolve, tube

if TYPE_CHECKING:
    import warp_psf as psf

# Metres: x and y of each, and a size; of hedges, two corners.
TREES = ((-1.5, 1.05, 1.0), (0.15, 1.2, 1.25), (1.75, 0.95, 0.9))
POTS = ((-0.75, 0.15, 0.3), (0.95, 0.3, 0.24), (1.4, 0.1, 0.2))
POSTS, POST_SPACING = 9, 0.42
STONES = ((-1.7, -0.5), (-1.1, -0.68), (-0.5, -0.6), (0.12, -0.74), (0.75, -0.62), (1.4, -0.7))
HEDGES = (((-2.9, 1.4), (-2.1, 1.7)), ((-0.9, 1.5), (-0.3, 1.75)), ((0.75, 1.5), (1.3, 1.75)))
WALL_Y = 1.9
MATERIALS = {
    "lawn": (0.42, 0.56, 0.3),
    "plaster": (0.86, 0.82, 0.74),
    "stone": (0.6, 0.58, 0.55),
    "wood": (0.55, 0.4, 0.27),
    "leaves": (0.3, 0.48, 0.22),
    "clay": (0.7, 0.38, 0.26),
}
states = rest


def build() -> mujoco.MjModel:
    """Lawn, wall, trees, pots, fence, bench, hedges, steps, stones and a lantern."""
    spec = new_stage(position=(0.6, -4.6, 2.3), target=(0.05, 0.6, 0.6), fovy=36)
    for name, color in MATERIALS.items():
        add_material(spec, name, color)
    world = spec.worldbody
    world.add_geom(
        name="lawn",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[4, 4, 0.1],
        material="lawn",
        contype=0,
        conaffinity=0,
        mass=0,
        group=0,
    )
    draw_box(world, "wall", (-3.0, WALL_Y, 0.0), (3.0, WALL_Y + 0.15, 1.6), "plaster")
    draw_box(world, "coping", (-3.0, WALL_Y - 0.05, 1.6), (3.0, WALL_Y + 0.2, 1.68), "stone")
    for number, (x, y, size) in enumerate(TREES):
        trunk, crown = tree(size)
        _place(spec, f"trunk {number}", trunk, "wood", x, y)
        _place(spec, f"crown {number}", crown, "leaves", x, y)
    for number, (x, y, size) in enumerate(POTS):
        vessel, plant = pot(size)
        _place(spec, f"pot {number}", vessel, "clay", x, y)
        _place(spec, f"plant {number}", plant, "leaves", x, y)
    _place(spec, "lantern", lantern(), "stone", -2.0, 0.2)
    for number in range(POSTS):
        x = -2.6 + number * POST_SPACING
        draw_box(world, f"post {number}", (x - 0.03, -1.23, 0.0), (x + 0.03, -1.17, 0.5), "wood")
    for name, z in (("lower rail", 0.15), ("upper rail", 0.38)):
        draw_box(world, name, (-2.7, -1.22, z), (-2.5 + (POSTS - 1) * POST_SPACING, -1.18, z + 0.05), "wood")
    _draw_bench(world)
    for number, (x, y) in enumerate(STONES):
        draw_box(world, f"stone {number}", (x - 0.2, y - 0.14, 0.0), (x + 0.2, y + 0.14, 0.03), "stone")
    for number, (low, high) in enumerate(HEDGES):
        draw_box(world, f"hedge {number}", (*low, 0.0), (*high, 0.55), "leaves")
    draw_box(world, "lower step", (2.1, 0.9, 0.0), (2.8, 1.8, 0.15), "stone")
    draw_box(world, "upper step", (2.1, 1.25, 0.15), (2.8, 1.8, 0.3), "stone")
    return spec.compile()


def tree(size: float) -> tuple[Body, Body]:
    """A trunk of five sides and two blobs of leaves: 20 and 128 triangles."""
    trunk = tube(size * np.array([[0, 0, 0], [0.03, 0, 0.6]]), size * np.array([0.06, 0.04]), 5)
    return trunk, join(blob((0.0, 0.0, 0.78), 0.34, size), blob((0.12, 0.05, 1.08), 0.24, size))


def blob(middle: tuple[float, float, float], radius: float, size: float) -> Body:
    """A rounded body of 64 triangles about a point, in shares of `size`."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, 6)
    profile = radius * np.stack([np.cos(angle), 0.85 * np.sin(angle)], axis=1)
    vertices, faces = revolve(np.maximum(profile, [0.0, -np.inf]), 8)
    return size * (vertices + middle), faces


def pot(size: float) -> tuple[Body, Body]:
    """A vessel of 80 triangles, and a plant of 64 in it."""
    profile = size * np.array([[0, 0], [0.5, 0], [0.72, 0.9], [0.8, 1.0], [0.62, 1.0], [0, 0.92]])
    return revolve(profile, 10), blob((0.0, 0.0, 1.35), 0.6, size)


def lantern() -> Body:
    """A stone lantern of 48 triangles."""
    return revolve(np.array([[0, 0], [0.14, 0.0], [0.07, 0.55], [0.2, 0.7], [0, 0.9]]), 8)


def _draw_bench(world: mujoco.MjsBody) -> None:
    draw_box(world, "seat", (-0.2, 0.35, 0.36), (0.7, 0.65, 0.4), "wood")
    draw_box(world, "back", (-0.2, 0.62, 0.5), (0.7, 0.65, 0.72), "wood")
    for name, x in (("left", -0.12), ("right", 0.58)):
        draw_box(world, f"{name} foot", (x, 0.38, 0.0), (x + 0.05, 0.6, 0.36), "wood")
    draw_box(world, "brace", (-0.12, 0.47, 0.12), (0.63, 0.51, 0.16), "wood")


def _place(spec: mujoco.MjSpec, name: str, surface: Body, material: str, x: float, y: float) -> None:
    vertices, faces = surface
    add_mesh(spec, name, (np.add(vertices, [x, y, 0.0]), faces))
    draw_mesh(spec.worldbody, name, material)


def lights() -> tuple:
    """The lamp, high up to the left and hardly before the wall."""
    import warp_psf as psf

    return (psf.rectangle_light("lamp", 0.9, 0.9, (75, 70, 58), position=(-3.4, 0.9, 4.0), target=(0.2, 0.6, 0.3)),)


def environment() -> psf.Environment:
    """A dim blue sky, which fills the shadows and is the background."""
    return dimmed("sky", 0.25)


if __name__ == "__main__":
    from warp_psf.cli import run_simulation

    run_simulation(build, states, name="garden", camera="front", environment=environment(), lights=lights())
