"""A cloth falls over a ball and a block and drapes itself: 1,378 vertices. `python -m sims.cloth`."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

import mujoco

from sims import HIDDEN_GROUP, add_material, add_mesh, draw_box, draw_mesh, new_stage, step_frames
from sims.bodies import ball, rounded_box

if TYPE_CHECKING:
    import warp_psf as psf

# Vertices along the two sides of the cloth, and metres from one to the next.
COLUMNS, ROWS, SPACING = 53, 26, 0.032
# Metres: half of how far the cloth keeps from what it touches, itself included.
RADIUS = 0.005
MASS = 0.3  # kilograms: 0.22 kg/m^2, a light cotton
# Pascals and metres: stretched by its own weight the cloth gives way by a few per cent, and it folds as cotton does.
YOUNG, POISSON, THICKNESS = 2e5, 0.2, 5e-4
# Seconds, of the material's own damping: without it the cloth trembles where it hangs free.
DAMPING = 0.01
# Pascal seconds: so thick an air brakes the fall to what the contacts stop within a step.
AIR_VISCOSITY = 0.03
# Seconds, a fifth of a frame: elasticity is integrated implicitly, or the stiff threads would ask for a tenth of it.
TIMESTEP = 1 / 150
ITERATIONS, TOLERANCE = 50, 1e-6  # of the contact solver
FRICTION = (0.3, 0.01, 0.001)
# Time constant (s) and damping ratio of contacts.
SOLREF = (0.01, 1.0)
# Metres: where the middle of the cloth starts, and by what it rises per metre along both sides.
START, TILT, TURN = (0.0, 0.05, 0.66), (0.06, 0.04), 0.12
BALL_RADIUS, BALL_PLACE = 0.22, (-0.25, 0.0, 0.22)
BLOCK_HALF, BLOCK_PLACE, BLOCK_TURN = (0.13, 0.13, 0.16), (0.27, -0.03, 0.16), 0.5
BLOCK_EDGE = 0.035


def build() -> mujoco.MjModel:
    """The cloth, spread out flat above a ball and a block on a floor."""
    spec = new_stage(position=(0.45, -3.0, 1.75), target=(0.0, 0.0, 0.26), fovy=22.5)
    spec.option.timestep = TIMESTEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    # Newton's method would factorise a matrix of thousands of rows in every step.
    spec.option.solver = mujoco.mjtSolver.mjSOL_CG
    spec.option.iterations, spec.option.tolerance = ITERATIONS, TOLERANCE
    spec.option.viscosity = AIR_VISCOSITY
    add_material(spec, "floor", (0.82, 0.8, 0.76))
    add_material(spec, "cloth", (0.8, 0.47, 0.42))
    add_material(spec, "ball", (0.3, 0.42, 0.5), gloss=0.1)
    add_material(spec, "block", (0.84, 0.72, 0.48))
    draw_box(spec.worldbody, "floor", (-30.0, -8.0, -0.1), (30.0, 54.0, 0.0), "floor")
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], group=HIDDEN_GROUP, friction=FRICTION)
    _add_supports(spec)
    _add_cloth(spec)
    return spec.compile()


def states(model: mujoco.MjModel, frames_per_second: float = 30, duration: float = math.inf) -> Iterator[mujoco.MjData]:
    """The state at each frame, from the start: the same `MjData` every time, stepped on."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return step_frames(model, data, frames_per_second, duration)


def lights() -> tuple:
    """None: the studio is light enough."""
    return ()


def environment() -> psf.Environment:
    """A studio, whose lamps are large."""
    import warp_psf as psf

    return psf.load_environment("studio")


def _add_supports(spec: mujoco.MjSpec) -> None:
    contact = {"group": HIDDEN_GROUP, "friction": FRICTION, "solref": SOLREF}
    add_mesh(spec, "ball", ball(cells=24, diameter=2 * BALL_RADIUS))
    body = spec.worldbody.add_body(name="ball", pos=BALL_PLACE)
    draw_mesh(body, "ball", "ball")
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[BALL_RADIUS, 0, 0], **contact)
    add_mesh(spec, "block", rounded_box(BLOCK_HALF, BLOCK_EDGE, cells=16))
    turn = [math.cos(BLOCK_TURN / 2), 0.0, 0.0, math.sin(BLOCK_TURN / 2)]
    body = spec.worldbody.add_body(name="block", pos=BLOCK_PLACE, quat=turn)
    draw_mesh(body, "block", "block")
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=BLOCK_HALF, **contact)


def _add_cloth(spec: mujoco.MjSpec) -> None:
    cloth = spec.worldbody.make_flex(
        name="cloth",
        type="grid",
        dim=2,
        dof="full",
        count=[COLUMNS, ROWS, 1],
        spacing=[SPACING] * 3,
        scale=[1, 1, 1],
        radius=RADIUS,
        mass=MASS,
        elastic2d=3,
        pos=START,
        quat=[1.0, TILT[1] / 2, -TILT[0] / 2, TURN / 2],
        origin=[0, 0, 0],
    )
    cloth.material = "cloth"
    cloth.young, cloth.poisson, cloth.thickness, cloth.damping = YOUNG, POISSON, THICKNESS, DAMPING
    cloth.elastic2d = 3
    cloth.friction, cloth.solref = FRICTION, SOLREF
    cloth.solimp = [0.95, 0.99, 0.001, 0.5, 2]
    cloth.condim = 3


if __name__ == "__main__":
    from warp_psf.cli import run_simulation

    run_simulation(build, states, name="cloth", camera="front", environment=environment(), lights=lights())
