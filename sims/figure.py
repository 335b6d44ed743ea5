"""A figure with one smooth skin dances on the spot: a body without a rigid shape. `python -m sims.figure`."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from sims import HIDDEN_GROUP, add_material, add_mesh, draw_box, draw_mesh, frame_numbers, new_stage
from sims.bodies import ball, rounded_box
from sims.surfaces import Body, implicit_surface

if TYPE_CHECKING:
    import warp_psf as psf

# Metres. The figure is as tall as it says, and faces -y.
HEIGHT = 1.7
# Edge of the grid cubes of its skin, and over what length its limbs blend: shares of the height.
CELL, BLEND = 0.01855, 0.03
# Seconds in which each foot and each arm is lifted once: the motion repeats from there.
PERIOD = 4.0
# A vertex follows up to so many bones, by the inverse of this power of its distance to them.
BONES_PER_VERTEX, FOLLOWING = 4, 4
CLEARANCE = 0.01  # of the lower foot above the floor, metres


@dataclass(frozen=True)
class Bone:
    """A bone at rest, as a capsule with two radii, in shares of the height; its joint sits at its start.

    parent: the bone that carries it, "" for the first. axis: of its hinge.
    """

    parent: str
    start: tuple[float, float, float]
    end: tuple[float, float, float]
    radii: tuple[float, float]
    axis: tuple[float, float, float] = (1.0, 0.0, 0.0)


def _limbs(name: str, side: float) -> dict[str, Bone]:
    # At rest arms are half lifted and legs apart: what is bound midway between its extremes bends least.
    shoulder, elbow, wrist, tip = (
        (0.105 * side, 0.0, 0.8),
        (0.205 * side, 0.008, 0.7),
        (0.293 * side, -0.012, 0.61),
        (0.338 * side, -0.024, 0.56),
    )
    hip, knee, ankle = (0.062 * side, 0.0, 0.53), (0.078 * side, -0.008, 0.3), (0.085 * side, 0.004, 0.062)
    heel, toe = (0.085 * side, 0.01, 0.038), (0.1 * side, -0.088, 0.028)
    return {
        f"upper arm {name}": Bone("chest", shoulder, elbow, (0.043, 0.032), (0.0, -side, 0.0)),
        f"forearm {name}": Bone(f"upper arm {name}", elbow, wrist, (0.032, 0.023), (0.0, -side, 0.0)),
        f"hand {name}": Bone(f"forearm {name}", wrist, tip, (0.023, 0.026), (0.0, -side, 0.0)),
        f"thigh {name}": Bone("pelvis", hip, knee, (0.064, 0.044)),
        f"shin {name}": Bone(f"thigh {name}", knee, ankle, (0.044, 0.029)),
        f"foot {name}": Bone(f"shin {name}", heel, toe, (0.036, 0.026)),
    }


BONES = {
    "pelvis": Bone("", (0, 0, 0.56), (0, 0.004, 0.63), (0.084, 0.072)),
    "chest": Bone("pelvis", (0, 0.004, 0.63), (0, 0.0, 0.765), (0.07, 0.093), axis=(0.0, 0.0, 1.0)),
    "head": Bone("chest", (0, 0.004, 0.86), (0, -0.012, 0.932), (0.036, 0.066), axis=(0.0, 0.0, 1.0)),
    **_limbs("left", 1.0),
    **_limbs("right", -1.0),
}


def build() -> mujoco.MjModel:
    """The figure between a ball and a block, on a floor."""
    spec = new_stage(position=(1.5, -4.3, 1.35), target=(0.0, 0.0, 0.86), fovy=29)
    add_material(spec, "floor", (0.8, 0.78, 0.74))
    add_material(spec, "skin", (0.8, 0.56, 0.43), gloss=0.1)
    add_material(spec, "ball", (0.22, 0.4, 0.5), gloss=0.2)
    add_material(spec, "block", (0.86, 0.76, 0.5))
    draw_box(spec.worldbody, "floor", (-30.0, -8.0, -0.1), (30.0, 54.0, 0.0), "floor")
    add_mesh(spec, "ball", ball(cells=24, diameter=0.36))
    draw_mesh(spec.worldbody.add_body(pos=(-0.66, -0.3, 0.18)), "ball", "ball")
    add_mesh(spec, "block", rounded_box((0.2, 0.16, 0.22), 0.025, cells=16))
    draw_mesh(spec.worldbody.add_body(pos=(0.78, 0.3, 0.22), quat=(0.97, 0.0, 0.0, 0.24)), "block", "block")
    bodies: dict[str, mujoco.MjsBody] = {}
    for name, bone in BONES.items():
        above = bodies.get(bone.parent, spec.worldbody)
        origin = BONES[bone.parent].start if bone.parent else (0.0, 0.0, 0.0)
        body = above.add_body(name=name, pos=HEIGHT * np.subtract(bone.start, origin))
        if bone.parent:
            body.add_joint(name=name, axis=bone.axis)
        else:
            body.add_joint(name="lift", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=(0, 0, 1))
        tip = HEIGHT * np.subtract(bone.end, bone.start)
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            size=(HEIGHT * min(bone.radii), 0, 0),
            fromto=[0, 0, 0, *tip],
            group=HIDDEN_GROUP,
        )
        bodies[name] = body
    _add_skin(spec)
    return spec.compile()


def states(model: mujoco.MjModel, frames_per_second: float = 30, duration: float = math.inf) -> Iterator[mujoco.MjData]:
    """The state at each frame, from the start: the same `MjData` every time, moved on."""
    data = mujoco.MjData(model)
    for frame in frame_numbers(frames_per_second, duration):
        data.time = frame / frames_per_second
        for name, angle in _pose(data.time / PERIOD).items():
            data.joint(name).qpos[0] = angle
        _stand(model, data)
        yield data


def lights() -> tuple:
    """None: the studio is light enough."""
    return ()


def environment() -> psf.Environment:
    """A studio, whose lamps are large."""
    import warp_psf as psf

    return psf.load_environment("studio")


def skin() -> Body:
    """The figure's surface at rest, metres."""
    low, high = np.array([-0.43, -0.2, -0.05]), np.array([0.43, 0.15, 1.05])
    vertices, faces = implicit_surface(_distance, low, high, CELL)
    return vertices * HEIGHT, faces


def _distance(points: np.ndarray) -> np.ndarray:
    """Approximate signed distance to the blended bones, [points]; in shares of the height."""
    distance = np.full(len(points), np.inf)
    for bone in BONES.values():
        limb = _distance_to(points, bone)
        # Polynomial smooth minimum.
        overlap = np.maximum(BLEND - np.abs(distance - limb), 0) / BLEND
        distance = np.minimum(distance, limb) - overlap**2 * BLEND / 4
    return distance


def _distance_to(points: np.ndarray, bone: Bone) -> np.ndarray:
    axis = np.subtract(bone.end, bone.start)
    along = np.clip((points - bone.start) @ axis / (axis @ axis), 0, 1)
    away = np.linalg.norm(points - bone.start - along[:, None] * axis, axis=1)
    return away - (bone.radii[0] + along * (bone.radii[1] - bone.radii[0]))


def follow() -> tuple[Body, np.ndarray]:
    """The skin, and how much each vertex follows each bone, [vertices, bones]: rows sum to 1."""
    vertices, faces = skin()
    away = np.stack([_distance_to(vertices / HEIGHT, bone) for bone in BONES.values()], axis=1)
    weights = 1 / np.maximum(away - away.min(axis=1, keepdims=True) + BLEND, 1e-6) ** FOLLOWING
    weights[weights < np.sort(weights, axis=1)[:, [-BONES_PER_VERTEX]]] = 0.0
    return (vertices, faces), weights / weights.sum(axis=1, keepdims=True)


def _add_skin(spec: mujoco.MjSpec) -> None:
    (vertices, faces), weights = follow()
    ids = [np.flatnonzero(column > 0) for column in weights.T]
    spec.add_skin(
        name="skin",
        material="skin",
        vert=vertices.ravel().tolist(),
        face=faces.ravel().tolist(),
        bodyname=list(BONES),
        bindpos=np.concatenate([HEIGHT * np.array(bone.start, float) for bone in BONES.values()]).tolist(),
        bindquat=[1.0, 0.0, 0.0, 0.0] * len(BONES),
        vertid=[rows.tolist() for rows in ids],
        vertweight=[weights[rows, bone].tolist() for bone, rows in enumerate(ids)],
    )


def _pose(turns: float) -> dict[str, float]:
    """The angle of every hinge, radians, after a share of the period. The right side is half a period behind."""
    angles = {"chest": 0.16 * _wave(turns, 0.25), "head": -0.22 * _wave(turns, 0.2)}
    for side, behind in (("left", 0.0), ("right", 0.5)):
        # Thigh and shin are about equally long: bent so, they lift the foot straight up, and it stays level.
        lift = 0.3 + 0.12 * _wave(2 * turns, 0.0) + 0.75 * max(_wave(turns, behind), 0.0) ** 2
        arm = _wave(turns, behind + 0.4)
        angles |= {f"thigh {side}": -lift, f"shin {side}": 2 * lift, f"foot {side}": -lift}
        angles |= {
            f"upper arm {side}": 0.1 + 0.42 * arm,
            f"forearm {side}": 0.4 + 0.35 * arm,
            f"hand {side}": 0.1 + 0.2 * arm,
        }
    return angles


def _wave(turns: float, phase: float) -> float:
    return math.sin(2 * math.pi * (turns - phase))


def _stand(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Lifts the figure until its lower foot stands on the floor."""
    data.joint("lift").qpos[0] = 0.0
    mujoco.mj_kinematics(model, data)
    lowest = math.inf
    for side in ("left", "right"):
        bone, body = BONES[f"foot {side}"], data.body(f"foot {side}")
        for place, radius in zip((bone.start, bone.end), bone.radii, strict=True):
            height = (body.xmat.reshape(3, 3) @ (HEIGHT * np.subtract(place, bone.start)) + body.xpos)[2]
            lowest = min(lowest, height - HEIGHT * radius)
    data.joint("lift").qpos[0] = CLEARANCE - lowest
    mujoco.mj_forward(model, data)


if __name__ == "__main__":
    from warp_psf.cli import run_simulation

    run_simulation(build, states, name="figure", camera="front", environment=environment(), lights=lights())
