"""Nineteen bodies fall into a pile: 20 drawn bodies with the floor, about 88,739 vertices. `python -m sims.falling`."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from sims import HIDDEN_GROUP, add_material, add_mesh, dimmed, draw_box, draw_mesh, new_stage, step_frames
from sims.bodies import (
    ball,
    chain_link,
    ellipsoid,
    gear,
    knot,
    knot_path,
    link_path,
    mug,
    mug_handle_path,
    pawn,
    rounded_box,
    spinning_top,
    star,
    teapot_handle_path,
    teapot_like,
    torus,
    vase,
)

if TYPE_CHECKING:
    import warp_psf as psf

BOX, SPHERE = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_SPHERE
CAPSULE, CYLINDER = mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER
ELLIPSOID = mujoco.mjtGeom.mjGEOM_ELLIPSOID
# Kilograms per cubic metre: hollow or wooden toys.
DENSITY = 500.0
# Sliding, spinning and rolling friction; the last two (metres) bring round bodies to rest.
FRICTION = (0.8, 0.02, 0.03)
# Time constant (s) and damping ratio of contacts.
SOLREF = (0.005, 1.2)
# sRGB colours and the gloss of each.
PALETTE = {
    "terracotta": ((0.78, 0.42, 0.31), 0.0),
    "ochre": ((0.85, 0.66, 0.35), 0.1),
    "teal": ((0.2, 0.49, 0.5), 0.15),
    "cream": ((0.9, 0.86, 0.77), 0.0),
    "ink": ((0.17, 0.23, 0.35), 0.2),
    "sage": ((0.57, 0.66, 0.54), 0.0),
}
# What falls, from the lowest to the highest: shape and colour.
BODIES = (
    ("teapot", "cream"),
    ("gear", "ochre"),
    ("die", "ink"),
    ("torus", "terracotta"),
    ("knot", "teal"),
    ("vase", "sage"),
    ("star", "ochre"),
    ("ball", "ink"),
    ("link", "cream"),
    ("mug", "terracotta"),
    ("pawn", "cream"),
    ("egg", "sage"),
    ("top", "terracotta"),
    ("die", "sage"),
    ("torus", "teal"),
    ("gear", "ink"),
    ("star", "cream"),
    ("ball", "terracotta"),
    ("link", "teal"),
)
# The bodies start on a helix, metres: its radius, the height of the first, and the rise from each to the next.
HELIX_RADIUS, HELIX_START, HELIX_RISE = 0.36, 0.3, 0.11
GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))
SEED = 18
# Enough for a hull to follow its body within a millimetre, few enough to collide fast.
HULL_VERTICES = 250


def build() -> mujoco.MjModel:
    """Floor and bodies, each body turned at random before it falls."""
    spec = new_stage(position=(0.2, -2.0, 1.45), target=(-0.03, -0.16, 0.1), fovy=28)
    add_material(spec, "floor", (0.84, 0.81, 0.77))
    for name, (rgb, gloss) in PALETTE.items():
        add_material(spec, name, rgb, gloss)
    draw_box(spec.worldbody, "floor", (-4.2, -3.4, -0.1), (4.2, 5.0, 0.0), "floor")
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], group=HIDDEN_GROUP, friction=FRICTION)
    hulls = _shapes(spec)
    random = np.random.default_rng(SEED)
    for number, (shape, material) in enumerate(BODIES):
        angle = number * GOLDEN_ANGLE
        place = HELIX_RADIUS * math.cos(angle), HELIX_RADIUS * math.sin(angle), HELIX_START + number * HELIX_RISE
        turn = random.normal(size=4)
        body = spec.worldbody.add_body(name=f"{shape}_{number}", pos=place, quat=turn / np.linalg.norm(turn))
        body.add_freejoint()
        draw_mesh(body, shape, material)
        for hull in hulls[shape]:
            body.add_geom(**hull, density=DENSITY, group=HIDDEN_GROUP, condim=6, friction=FRICTION, solref=SOLREF)
    return spec.compile()


def states(model: mujoco.MjModel, frames_per_second: float = 30, duration: float = math.inf) -> Iterator[mujoco.MjData]:
    """The state at each frame, from the start: the same `MjData` every time, stepped on."""
    return step_frames(model, mujoco.MjData(model), frames_per_second, duration)


def lights() -> tuple:
    """A window to the left of the pile."""
    import warp_psf as psf

    return (
        psf.rectangle_light(
            "window", 1.2, 1.2, radiance=(34.0, 32.4, 30.0), position=(-2.6, -0.8, 2.3), target=(0.0, 0.0, 0.1)
        ),
    )


def environment() -> psf.Environment:
    """Fills the shadows: on the floor, about half of what the window gives."""
    return dimmed("studio", 0.4)


def _shapes(spec: mujoco.MjSpec) -> dict[str, list[dict]]:
    """Makes the meshes known to the model; per shape, the convex geoms that collide for it."""
    drawn = {
        "teapot": teapot_like(),
        "gear": gear(),
        "die": rounded_box((0.11,) * 3, 0.024, 27),
        "torus": torus(0.12, 0.04),
        "knot": knot(wire=0.036),
        "vase": vase(0.34),
        "star": star(0.17, 0.08),
        "ball": ball(28, 0.24),
        "link": chain_link(wire=0.032),
        "mug": mug(0.09, 0.2),
        "pawn": pawn(0.34),
        "egg": ellipsoid((0.1, 0.1, 0.14), 28),
        "top": spinning_top(0.13),
    }
    for name, surface in drawn.items():
        add_mesh(spec, name, surface)

    def sliced(name: str, scale: float, *cuts: tuple[float, float]) -> list[dict]:
        return [_slice(spec, f"{name}_{low:g}", drawn[name][0], low * scale, high * scale) for low, high in cuts]

    return {
        "teapot": sliced("teapot", 0.16, (0.005, 1.16), (1.1, 1.32), (1.3, 1.545)) + _teapot_parts(0.16),
        "gear": [_solid(CYLINDER, 0.1595, 0.035)],
        "die": [_solid(BOX, 0.11, 0.11, 0.11)],
        "torus": _chain(_circle(16, 0.12), 0.04),
        "knot": _chain(knot_path(56), 0.036),
        "vase": [*sliced("vase", 0.34, (0.003, 0.63), (0.6, 0.88), (0.84, 1)), _foot(0.17 * 0.34)],
        "star": _star_arms(),
        "ball": [_solid(SPHERE, 0.12)],
        "link": _chain(link_path(28), 0.032),
        "mug": _mug_staves(0.09, 0.2),
        "pawn": [
            *sliced("pawn", 0.34, (0.003, 0.14), (0.11, 0.34), (0.31, 0.6), (0.56, 0.68)),
            _solid(SPHERE, 0.18 * 0.34, at=(0, 0, 0.82 * 0.34)),
            _foot(0.26 * 0.34),
        ],
        "egg": [_solid(ELLIPSOID, 0.1, 0.1, 0.14)],
        "top": sliced("top", 0.13, (0, 1.31), (1.3, 1.9)),
    }


def _slice(spec: mujoco.MjSpec, name: str, vertices: np.ndarray, low: float, high: float) -> dict:
    """The convex hull of the part of an upright body of revolution that lies between two heights."""
    # What is farther from the axis than the body is wide is a spout or a handle, which have hulls of their own.
    within = (
        (vertices[:, 2] >= low) & (vertices[:, 2] <= high) & (np.abs(vertices[:, 0]) <= np.abs(vertices[:, 1]).max())
    )
    spec.add_mesh(name=name, uservert=vertices[within].ravel(), maxhullvert=HULL_VERTICES)
    return {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": name}


def _solid(kind: mujoco.mjtGeom, *size: float, at=(0.0, 0.0, 0.0), turn: float = 0.0) -> dict:
    """A primitive at `at`, turned by `turn` radians about z."""
    quat = [math.cos(turn / 2), 0.0, 0.0, math.sin(turn / 2)]
    return {"type": kind, "size": [*size, 0.0, 0.0][:3], "pos": at, "quat": quat}


def _foot(radius: float) -> dict:
    """The flat that an upright body stands on: a disc touches the floor at four points, a hull at one."""
    return _solid(CYLINDER, radius, 0.004, at=(0.0, 0.0, 0.004))


def _bars(path, radius: float) -> list[dict]:
    """Capsules along the open polyline `path`."""
    return [
        {"type": CAPSULE, "size": [radius, 0.0, 0.0], "fromto": [*start, *end]}
        for start, end in itertools.pairwise(path)
    ]


def _chain(path: np.ndarray, radius: float) -> list[dict]:
    """Capsules along the closed loop `path` [K, 3]."""
    return _bars([*path, path[0]], radius)


def _circle(count: int, radius: float) -> np.ndarray:
    """Corners of a polygon whose sides run half within the circle and half without, [count, 3]."""
    angle = np.arange(count) * 2 * np.pi / count
    radius *= 0.5 + 0.5 / math.cos(math.pi / count)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], axis=1)


def _teapot_parts(radius: float) -> list[dict]:
    spout = radius * np.array([[0.8, 0, 0.41], [1.05, 0, 0.5], [1.28, 0, 0.75], [1.42, 0, 1.02], [1.55, 0, 1.13]])
    bars = [_bars(spout[k : k + 2], share * radius)[0] for k, share in enumerate((0.25, 0.21, 0.16, 0.125))]
    return [
        *bars,
        *_bars(teapot_handle_path(18, radius), 0.085 * radius),
        _foot(0.52 * radius),
    ]


def _star_arms() -> list[dict]:
    # Discs follow the dome between the arms: radius and half thickness, metres.
    dome = ((0.042, 0.0392), (0.06, 0.037), (0.073, 0.0335), (0.085, 0.0275), (0.093, 0.018))
    middle = [_solid(CYLINDER, *size) for size in dome]
    turns = np.arange(5) * 2 * np.pi / 5
    places = 0.085 * np.stack([np.cos(turns), np.sin(turns), np.zeros(5)], axis=1)
    arms = [
        _solid(ELLIPSOID, 0.086, 0.055, 0.0405, at=tuple(place), turn=turn)
        for place, turn in zip(places, turns, strict=True)
    ]
    return middle + arms


def _mug_staves(radius: float, height: float) -> list[dict]:
    """A barrel of boxes, a bottom and a handle."""
    count, wall = 16, 0.14 * radius
    middle, half_width = radius - wall / 2, radius * math.tan(math.pi / count)
    staves = [
        _solid(
            BOX,
            wall / 2,
            half_width,
            height / 2,
            at=(middle * math.cos(turn), middle * math.sin(turn), height / 2),
            turn=turn,
        )
        for turn in np.arange(count) * 2 * np.pi / count
    ]
    return [
        *staves,
        _solid(CYLINDER, radius * 0.93, wall / 2, at=(0.0, 0.0, wall / 2)),
        *_bars(mug_handle_path(18, radius, height), 0.12 * radius),
    ]


if __name__ == "__main__":
    from warp_psf.cli import run_simulation

    run_simulation(build, states, name="falling", camera="front", environment=environment(), lights=lights())
