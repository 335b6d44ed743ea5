"""A rabbit on a floor: 16,302 triangles. `python -m sims.bunny`.

The third scene of table 2 of Jeng 2005, whose bunny has 16,301.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import fast_simplification
import mujoco
import numpy as np

from sims import add_material, add_mesh, dimmed, draw_mesh, new_stage, rest
from sims.bodies import blended_limbs
from sims.surfaces import Body, implicit_surface

if TYPE_CHECKING:
    import warp_psf as psf

TRIANGLES = 16_300
HEIGHT, CELLS = 1.0, 76
# Tapered capsules, as those of `sims.bodies`, of a rabbit of height 1 that looks towards -x.
LIMBS = (
    ((0.16, 0.0, 0.3), (-0.06, 0.0, 0.36), 0.27, 0.22),  # body
    ((-0.1, 0.0, 0.42), (-0.2, 0.0, 0.56), 0.17, 0.14),  # chest and neck
    ((-0.24, 0.0, 0.66), (-0.34, 0.0, 0.62), 0.135, 0.085),  # head
    ((-0.2, 0.06, 0.76), (-0.08, 0.13, 1.0), 0.045, 0.035),  # ears
    ((-0.2, -0.06, 0.76), (-0.12, -0.12, 1.0), 0.045, 0.035),
    ((0.2, 0.2, 0.14), (-0.02, 0.22, 0.08), 0.13, 0.08),  # hind legs
    ((0.2, -0.2, 0.14), (-0.02, -0.22, 0.08), 0.13, 0.08),
    ((-0.16, 0.1, 0.3), (-0.26, 0.11, 0.06), 0.075, 0.06),  # fore legs
    ((-0.16, -0.1, 0.3), (-0.26, -0.11, 0.06), 0.075, 0.06),
    ((0.44, 0.0, 0.3), (0.47, 0.0, 0.32), 0.1, 0.09),  # tail
)
BLEND = 0.05
states = rest


def build() -> mujoco.MjModel:
    """Floor and rabbit."""
    spec = new_stage(position=(-1.1, -3.6, 1.9), target=(0.05, 0.0, 0.38), fovy=28)
    add_material(spec, "floor", (0.8, 0.78, 0.74))
    add_material(spec, "fur", (0.78, 0.68, 0.56))
    spec.worldbody.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[4, 4, 0.1],
        material="floor",
        contype=0,
        conaffinity=0,
        mass=0,
        group=0,
    )
    add_mesh(spec, "bunny", bunny_like())
    draw_mesh(spec.worldbody, "bunny", "fur")
    return spec.compile()


def bunny_like() -> Body:
    """A sitting rabbit of `TRIANGLES` triangles on z = 0."""
    low, high = np.array([-0.5, -0.42, -0.06]), np.array([0.64, 0.42, 1.1])
    vertices, faces = implicit_surface(lambda points: blended_limbs(points, LIMBS, BLEND), low, high, 1 / CELLS)
    vertices, faces = fast_simplification.simplify(vertices.astype(np.float32), faces, target_count=TRIANGLES)
    return HEIGHT * (vertices.astype(np.float64) - [0, 0, vertices[:, 2].min()]), faces.astype(np.int32)


def lights() -> tuple:
    """The lamp, above and to the right."""
    import warp_psf as psf

    return (psf.rectangle_light("lamp", 0.7, 0.7, (24, 22, 19), position=(1.3, -1.2, 2.5), target=(0.0, 0.0, 0.2)),)


def environment() -> psf.Environment:
    """A dim blue sky, which fills the shadows and is the background."""
    return dimmed("sky", 0.15)


if __name__ == "__main__":
    from warp_psf.cli import run_simulation

    run_simulation(build, states, name="bunny", camera="front", environment=environment(), lights=lights())
