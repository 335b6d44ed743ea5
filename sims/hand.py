"""A right hand that closes to a grip and opens again: geometry alone, one smooth closed surface on sixteen bones.

The wrist is at the origin, the fingers point to +y, the thumb to +x, and the palm faces -z. Lengths are in metres.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sims.surfaces import Body, implicit_surface

MILLIMETRE = 1e-3
# Edge of the grid cubes of the skin: such that it has the 8,636 vertices of the hand of Kautz 2004, Table 1.
CELL = 2.815 * MILLIMETRE
# Over what length parts of the palm blend with each other, and a finger with its next bone and with the palm.
PALM_BLEND, FINGER_BLEND = 12.0 * MILLIMETRE, 5.0 * MILLIMETRE
# How a vertex's share in a bone falls with the distance to it; how often the shares are averaged along the surface.
FOLLOWING, REACH, SMOOTHINGS = 4, 5.0 * MILLIMETRE, 12
# Fingers: where the first joint is, its direction sideways, degrees; the bones' lengths and the radii at their ends.
FINGERS = {
    "index": ((27, 92, 1), 9.0, (42, 25, 20), (9.8, 8.8, 7.9, 6.8)),
    "middle": ((7.5, 96, 3), 1.5, (46, 29, 21), (10.0, 9.0, 8.1, 7.0)),
    "ring": ((-12, 91, 1), -6.5, (42, 27, 21), (9.6, 8.6, 7.7, 6.7)),
    "little": ((-29.5, 81, -3), -16.0, (34, 20, 18), (8.6, 7.5, 6.8, 5.9)),
}
# The thumb's joints from the wrist to its tip at rest, and the radii there.
THUMB = (((17, 16, -8), (43, 47, -19), (58, 74, -27), (64, 98, -32)), (14.5, 11.5, 9.6, 7.6))
# Where the thumb goes when it closes: before the palm, and across it, so that it ends in front of the fingers.
THUMB_GOAL = (-0.5, -0.1, -1.0)
# Parts of the palm that blend: start, end, and radii there.
PALM = (
    ((12, -42, -2), (10, 8, -2), 16, 13.5),
    ((-12, -42, -2), (-10, 8, -2), 16, 13.5),
    ((11, 4, -3), (26, 86, 0), 14, 10.5),
    ((4, 4, -2), (8, 90, 1), 14, 11),
    ((-4, 4, -2), (-11, 85, -1), 14, 10.5),
    ((-11, 4, -3), (-27, 75, -4), 14, 10),
    ((-17, 22, -10), (-26, 62, -11), 11, 8),
)
# Degrees: the angle of each joint when the hand is open, at rest and closed. At rest it is about halfway: what is bound
# midway between its extremes bends least.
FINGER_ANGLES = ((6, 32, 64), (8, 42, 84), (5, 26, 52))
THUMB_ANGLES = ((-16, 0, 16), (-6, 0, 24), (-10, 0, 36))
# By which share of the period each digit is behind the little finger.
DELAY = {"little": 0.0, "ring": 0.012, "middle": 0.024, "index": 0.036, "thumb": 0.05}


@dataclass(frozen=True)
class Bone:
    """A bone of a digit at rest: a capsule with two radii, metres; its joint sits at its start.

    digit: its name; joint: 0 next to the palm, then 1 and 2. axis: it closes by turning about this.
    """

    digit: str
    joint: int
    start: np.ndarray
    end: np.ndarray
    radii: tuple[float, float]
    axis: np.ndarray


def _finger(name: str) -> list[Bone]:
    start, sideways, lengths, radii = FINGERS[name]
    sideways = np.radians(sideways)
    point, straight = np.array(start, float), np.array([np.sin(sideways), np.cos(sideways), 0.0])
    axis, bent, bones = np.cross(straight, [0.0, 0.0, -1.0]), 0.0, []
    for joint, length in enumerate(lengths):
        bent += np.radians(FINGER_ANGLES[joint][1])
        end = point + length * (np.cos(bent) * straight - np.sin(bent) * np.array([0.0, 0.0, 1.0]))
        ends = radii[joint] * MILLIMETRE, radii[joint + 1] * MILLIMETRE
        bones.append(Bone(name, joint, MILLIMETRE * point, MILLIMETRE * end, ends, axis))
        point = end
    return bones


def _thumb() -> list[Bone]:
    points, radii = MILLIMETRE * np.array(THUMB[0], float), MILLIMETRE * np.array(THUMB[1])
    bones = []
    for joint in range(3):
        axis = np.cross(points[joint + 1] - points[joint], THUMB_GOAL)
        ends = (radii[joint], radii[joint + 1])
        bones.append(Bone("thumb", joint, points[joint], points[joint + 1], ends, axis / np.linalg.norm(axis)))
    return bones


# Three bones of each digit, in order.
BONES = [bone for name in FINGERS for bone in _finger(name)] + _thumb()


def hand() -> Body:
    """The hand at rest, half closed: about 8,636 vertices."""
    low, high = MILLIMETRE * np.array([-62.0, -62.0, -95.0]), MILLIMETRE * np.array([84.0, 190.0, 24.0])
    return implicit_surface(_distance, low, high, CELL)


def follow(body: Body) -> np.ndarray:
    """How much each vertex follows the palm and each bone, [vertices, 1 + bones]: rows sum to 1."""
    vertices, faces = body
    away = np.stack([_palm_distance(vertices), *(_distance_to(vertices, bone) for bone in BONES)], axis=1)
    nearest = away.argmin(axis=1)
    weights = 1 / (away - away.min(axis=1, keepdims=True) + REACH) ** FOLLOWING
    # A finger must not bend its neighbour: a vertex follows its nearest bone and the bones next to that.
    weights = np.where(_neighbours()[nearest], weights, 0.0)
    weights /= weights.sum(axis=1, keepdims=True)
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    # Each edge of a closed surface is in both directions here.
    count = np.bincount(ends[:, 0], minlength=len(vertices))
    for _ in range(SMOOTHINGS):
        around = [np.bincount(ends[:, 0], column[ends[:, 1]], len(vertices)) for column in weights.T]
        weights = 0.5 * weights + 0.5 * np.stack(around, axis=1) / count[:, None]
    return weights


def bone_motions(share: float) -> tuple[np.ndarray, np.ndarray]:
    """Where the palm and the bones are after a share of the period: rotations [1 + bones, 3, 3], shifts [1 + bones, 3].

    A point p that follows a bone from rest is at rotation @ p + shift. At 0 the hand is open, at 1/2 closed.
    """
    rotations, shifts = [np.eye(3)], [np.zeros(3)]
    for number, bone in enumerate(BONES):
        closed = 0.5 - 0.5 * np.cos(2 * np.pi * (share - DELAY[bone.digit]))
        opened, rest, grip = (THUMB_ANGLES if bone.digit == "thumb" else FINGER_ANGLES)[bone.joint]
        turn = _rotation(bone.axis, np.radians(opened + closed * (grip - opened) - rest))
        above = number if bone.joint else 0
        # About the joint, and then with the bone that carries it.
        rotations.append(rotations[above] @ turn)
        shifts.append(rotations[above] @ (bone.start - turn @ bone.start) + shifts[above])
    return np.array(rotations), np.array(shifts)


def poses(count: int) -> Iterator[np.ndarray]:
    """The vertices of the surface of `hand()` in each of `count` frames of one period, [V, 3]: open, closed, open."""
    body = hand()
    weights = follow(body)
    for frame in range(count):
        rotations, shifts = bone_motions(frame / count)
        moved = np.einsum("bij,vj->vbi", rotations, body[0]) + shifts
        yield np.einsum("vb,vbi->vi", weights, moved)


def _neighbours() -> np.ndarray:
    """Whether two of palm and bones are the same or joined, [1 + bones, 1 + bones]."""
    joined = np.eye(1 + len(BONES), dtype=bool)
    for number, bone in enumerate(BONES):
        above = number if bone.joint else 0
        joined[number + 1, above] = joined[above, number + 1] = True
    return joined


def _distance(points: np.ndarray) -> np.ndarray:
    """Approximate signed distance to the hand, [points]."""
    distance = _palm_distance(points)
    for first in range(0, len(BONES), 3):
        digit = _distance_to(points, BONES[first])
        for bone in BONES[first + 1 : first + 3]:
            digit = _blend(digit, _distance_to(points, bone), FINGER_BLEND)
        distance = _blend(distance, digit, PALM_BLEND if BONES[first].digit == "thumb" else FINGER_BLEND)
    return distance


def _palm_distance(points: np.ndarray) -> np.ndarray:
    distance = np.full(len(points), np.inf)
    for start, end, first, last in PALM:
        ends = MILLIMETRE * np.array(start, float), MILLIMETRE * np.array(end, float)
        part = _capsule_distance(points, *ends, (first * MILLIMETRE, last * MILLIMETRE))
        distance = _blend(distance, part, PALM_BLEND)
    return distance


def _distance_to(points: np.ndarray, bone: Bone) -> np.ndarray:
    return _capsule_distance(points, bone.start, bone.end, bone.radii)


def _capsule_distance(points: np.ndarray, start: np.ndarray, end: np.ndarray, radii: tuple) -> np.ndarray:
    axis = end - start
    along = np.clip((points - start) @ axis / (axis @ axis), 0, 1)
    return np.linalg.norm(points - start - along[:, None] * axis, axis=1) - (radii[0] + along * (radii[1] - radii[0]))


def _blend(a: np.ndarray, b: np.ndarray, width: float) -> np.ndarray:
    """The polynomial smooth minimum."""
    overlap = np.maximum(width - np.abs(a - b), 0) / width
    return np.minimum(a, b) - overlap**2 * width / 4


def _rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    """The turn by `angle` radians about a unit vector."""
    cross = np.cross(np.eye(3), axis)
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
