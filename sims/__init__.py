"""Simulations to render: bowling, falling, statues, room, teapots, figure, cloth, chess and sunlit.

`python -m sims.bowling` renders one. Pipe, cubes, office, spiralling_boxes, garden, bunny and pisa are scenes at rest,
for the methods of `warp_psf.area_light`.

Each of these modules has `build() -> MjModel`, `states(model, frames_per_second, duration) -> Iterator[MjData]`,
`lights()` and `environment()`. What they share is here. In every model, drawn geoms neither collide nor weigh, and the
geoms that do are in group 3, which is not drawn.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from sims.surfaces import Body

if TYPE_CHECKING:
    import warp_psf as psf

# Collision geoms are in this group, which MuJoCo does not draw by default.
HIDDEN_GROUP = 3
# Seconds: two steps are the shortest time constant that MuJoCo's contacts keep stable.
TIMESTEP = 0.001
# Metres: the walls of rooms.
WALL_THICKNESS = 0.1
# A satin highlight, as broad as four bands of spherical harmonics can show.
SHININESS = 0.08


def new_stage(position: tuple[float, float, float], target: tuple[float, float, float], fovy: float) -> mujoco.MjSpec:
    """An empty model with a camera "front" at `position` (metres) that looks at `target`; fovy in degrees."""
    spec = mujoco.MjSpec()
    spec.option.timestep = TIMESTEP
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    # Lit by environment and area lights: a lamp at the camera would flatten the shapes.
    spec.visual.headlight.active = 0
    add_camera(spec, "front", position, target, fovy)
    return spec


def add_camera(
    spec: mujoco.MjSpec,
    name: str,
    position: tuple[float, float, float],
    target: tuple[float, float, float],
    fovy: float,
) -> None:
    """A camera at `position` (metres) that looks at `target`, its horizon level; fovy in degrees."""
    back = np.subtract(position, target)
    right = np.cross([0.0, 0.0, 1.0], back)
    up = np.cross(back, right)
    rotation = np.stack([axis / np.linalg.norm(axis) for axis in (right, up, back)], axis=1)
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, rotation.ravel())
    spec.worldbody.add_camera(name=name, pos=position, quat=quaternion, fovy=fovy)


def add_material(spec: mujoco.MjSpec, name: str, rgb: tuple[float, float, float], gloss: float = 0.0) -> None:
    """A material of sRGB colour `rgb`; `gloss` in [0, 1] is the strength of its highlight."""
    spec.add_material(name=name, rgba=[*rgb, 1.0], specular=gloss, shininess=SHININESS)


def add_mesh(spec: mujoco.MjSpec, name: str, surface: Body) -> None:
    """Makes a body of `sims.bodies` known to the model."""
    vertices, faces = surface
    spec.add_mesh(name=name, uservert=vertices.ravel(), userface=faces.ravel())


def draw_mesh(body: mujoco.MjsBody, mesh: str, material: str) -> None:
    """Draws a mesh of the model in the body's frame."""
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh, material=material, contype=0, conaffinity=0, mass=0, group=0
    )


def draw_box(body: mujoco.MjsBody, name: str, low: tuple, high: tuple, material: str) -> None:
    """Draws the box between two corners of the body's frame, metres."""
    position, size = np.add(high, low) / 2, np.subtract(high, low) / 2
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=position,
        size=size,
        material=material,
        contype=0,
        conaffinity=0,
        mass=0,
        group=0,
    )


def draw_room(
    spec: mujoco.MjSpec, low: tuple[float, float, float], high: tuple[float, float, float], materials: dict[str, str]
) -> None:
    """Encloses the space between two corners, metres, with six boxes that neither collide nor leave a gap.

    materials: of floor, ceiling, left (-x), right (+x), front (-y) and back (+y).
    """
    (x0, y0, z0), (x1, y1, z1) = low, high
    t = WALL_THICKNESS
    # Each pair reaches over the ends of the pairs after it, so that no two surfaces share a plane the room can see.
    boxes = {
        "floor": ((x0 - t, y0 - t, z0 - t), (x1 + t, y1 + t, z0)),
        "ceiling": ((x0 - t, y0 - t, z1), (x1 + t, y1 + t, z1 + t)),
        "left": ((x0 - t, y0 - t, z0), (x0, y1 + t, z1)),
        "right": ((x1, y0 - t, z0), (x1 + t, y1 + t, z1)),
        "front": ((x0, y0 - t, z0), (x1, y0, z1)),
        "back": ((x0, y1, z0), (x1, y1 + t, z1)),
    }
    for name, (start, end) in boxes.items():
        draw_box(spec.worldbody, name, start, end, materials[name])


def dimmed(name: str, share: float, turn: float = 0.0) -> psf.Environment:
    """A built-in environment at a share of its light, turned about z by `turn` radians.

    Each alone lights a white floor to radiance 1; beside an area light, whose shadows it fills, that is too bright.
    """
    import warp_psf as psf

    full = psf.load_environment(name).rotated(turn)
    return psf.Environment(f"dimmed {name}", share * full.radiance)


def step_frames(
    model: mujoco.MjModel, data: mujoco.MjData, frames_per_second: float, duration: float = math.inf
) -> Iterator[mujoco.MjData]:
    """Yields `data` at the time of each frame, stepping it in between: always the same object, frame 0 unstepped."""
    steps = 0
    for frame in frame_numbers(frames_per_second, duration):
        target = round(frame / frames_per_second / model.opt.timestep)
        for _ in range(target - steps):
            mujoco.mj_step(model, data)
        steps = target
        # A step leaves the poses of bodies and geoms, and the vertices of flexes, one step behind the joints.
        mujoco.mj_kinematics(model, data)
        mujoco.mj_flex(model, data)
        mujoco.mj_camlight(model, data)
        yield data


def rest(model: mujoco.MjModel, frames_per_second: float = 30, duration: float = math.inf) -> Iterator[mujoco.MjData]:
    """The states of a scene in which nothing moves: the same `MjData` every time."""
    return step_frames(model, mujoco.MjData(model), frames_per_second, duration)


def frame_numbers(frames_per_second: float, duration: float) -> Iterator[int]:
    """0, 1, 2, ... for `duration` seconds, without end where that is infinite."""
    return itertools.count() if math.isinf(duration) else iter(range(round(duration * frames_per_second)))
