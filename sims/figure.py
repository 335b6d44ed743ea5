"""A figure with one smooth skin walks on the spot: a body without a rigid shape. `python -m sims.figure`."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np

from sims import HIDDEN_GROUP, add_material, add_mesh, draw_box, draw_mesh, frame_numbers, new_stage
from sims.bodies import ball, pedestal
from sims.surfaces import Body, implicit_surface

# Metres. The figure is as tall as it says, and faces -y.
HEIGHT = 1.7
# Edge of the grid cubes of its skin, and over what length its limbs blend: shares of the height.
CELL, BLEND = 0.0188, 0.03
# Seconds of two steps: the motion repeats from there.
PERIOD = 1.6
# A vertex follows up to so many bones, by the inverse of this power of its distance to them.
BONES_PER_VERTEX, FOLLOWING = 4, 5
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
    return {
        f"upper arm {name}": Bone("chest", (0.115 * side, 0, 0.795), (0.19 * side, 0.01, 0.66), (0.042, 0.033)),
        f"forearm {name}": Bone(
            f"upper arm {name}", (0.19 * side, 0.01, 0.66), (0.22 * side, -0.03, 0.52), (0.033, 0.026)
        ),
        f"hand {name}": Bone(
            f"forearm {name}", (0.22 * side, -0.03, 0.52), (0.225 * side, -0.045, 0.46), (0.026, 0.024)
        ),
        f"thigh {name}": Bone("pelvis", (0.055 * side, 0, 0.54), (0.062 * side, -0.005, 0.31), (0.066, 0.046)),
        f"shin {name}": Bone(f"thigh {name}", (0.062 * side, -0.005, 0.31), (0.064 * side, 0.01, 0.075), (0.046, 0.03)),
        f"foot {name}": Bone(f"shin {name}", (0.064 * side, 0.012, 0.04), (0.072 * side, -0.08, 0.03), (0.035, 0.026)),
    }


BONES = {
    "pelvis": Bone("", (0, 0, 0.55), (0, 0.005, 0.63), (0.085, 0.072)),
    "chest": Bone("pelvis", (0, 0.005, 0.63), (0, 0.0, 0.77), (0.072, 0.098), axis=(0.0, 0.0, 1.0)),
    "head": Bone("chest", (0, 0.0, 0.84), (0, -0.008, 0.935), (0.034, 0.06)),
    **_limbs("left", 1.0),
    **_limbs("right", -1.0),
}
# Of each hinge: mean, and amplitude and phase (turns) of its swing; radians. The right side is half a period behind.
SWINGS = {
    "chest": (0.0, 0.12, 0.25),
    "head": (0.08, 0.04, 0.5),
    "upper arm": (0.1, 0.55, 0.5),
    "forearm": (-0.55, 0.3, 0.5),
    "thigh": (-0.12, 0.5, 0.0),
    "shin": (0.5, 0.5, 0.27),
    "foot": (-0.1, 0.2, 0.1),
}


def build() -> mujoco.MjModel:
    """The figure between a ball and a pedestal, on a floor."""
    spec = new_stage(position=(1.6, -3.6, 1.5), target=(0.0, 0.0, 0.78), fovy=34)
    add_material(spec, "floor", (0.8, 0.78, 0.74))
    add_material(spec, "skin", (0.78, 0.5, 0.36), gloss=0.1)
    add_material(spec, "blue", (0.25, 0.38, 0.6), gloss=0.2)
    add_material(spec, "stone", (0.62, 0.6, 0.57))
    draw_box(spec.worldbody, "floor", (-12.0, -6.0, -0.1), (12.0, 30.0, 0.0), "floor")
    add_mesh(spec, "ball", ball(cells=24, diameter=0.36))
    draw_mesh(spec.worldbody.add_body(pos=(-0.62, -0.45, 0.18)), "ball", "blue")
    add_mesh(spec, "pedestal", pedestal(0.2, 0.5))
    draw_mesh(spec.worldbody.add_body(pos=(0.75, 0.3, 0.0)), "pedestal", "stone")
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
        for name in BONES:
            limb, _, side = name.rpartition(" ")
            mean, swing, phase = SWINGS.get(limb or side, (0.0, 0.0, 0.0))
            turns = data.time / PERIOD + phase + (0.5 if side == "right" else 0.0)
            if BONES[name].parent:
                data.joint(name).qpos[0] = mean + swing * math.sin(2 * math.pi * turns)
        _stand(model, data)
        yield data


def skin() -> Body:
    """The figure's surface at rest, metres."""
    low, high = np.array([-0.3, -0.2, -0.05]), np.array([0.3, 0.15, 1.05])
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

    run_simulation(build, states, name="figure", camera="front", environment="studio")
