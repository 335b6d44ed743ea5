"""Procedural triangle bodies, so that no simulation downloads a mesh.

Every function returns `(vertices, faces)`: float64 [V, 3] in metres and int32 [F, 3], counter-clockwise seen from
outside. Every part is closed; a body of several parts (teapot, mug) is the union of overlapping closed parts.
"""

from __future__ import annotations

import numpy as np

from sims.surfaces import (
    DENSE,
    Body,
    around,
    clamped_spline,
    cube_lattice,
    fillet,
    implicit_surface,
    join,
    resample,
    revolve,
    rounded_path,
    rounded_polygon,
    sheet,
    smooth,
    tube,
)

INCH = 0.0254
# Height and diameter of a regulation tenpin, inches (United States Bowling Congress, equipment specifications).
PIN_HEIGHTS = (0.0, 0.75, 2.25, 3.375, 4.5, 5.875, 7.25, 8.625, 9.375, 10.0, 10.875, 11.75, 12.625, 13.5)
PIN_DIAMETERS = (2.25, 2.828, 3.906, 4.510, 4.766, 4.563, 3.703, 2.472, 1.965, 1.797, 1.870, 2.094, 2.406, 2.547)
PIN_TOP = 15.0
PIN_BASE_FILLET = 5 / 32
BALL_DIAMETER = 8.5 * INCH


def pin(rings: int = 62, segments: int = 56) -> Body:
    """A regulation tenpin standing on z = 0: rings * segments + 2 vertices."""
    return revolve(pin_profile(rings), segments)


def pin_profile(rings: int) -> np.ndarray:
    """Radius and height of a tenpin from the middle of its base to its top, metres [rings + 2, 2]."""
    heights, radii = np.array(PIN_HEIGHTS), np.array(PIN_DIAMETERS) / 2
    # The spline ends level at the head's widest height; the head is a spherical cap on a short cylinder.
    cap = radii[-1]
    # Slopes: that of the first table interval at the base, none at the head.
    z = np.linspace(0, heights[-1], DENSE)
    side = np.stack([clamped_spline(heights, radii, 0.36, 0.0, z), z], axis=1)
    angle = np.linspace(0, np.pi / 2, DENSE // 4)
    head = np.stack([cap * np.cos(angle), PIN_TOP - cap + cap * np.sin(angle)], axis=1)
    foot = fillet(np.array([0.0, 0.0]), side[0], side[150], PIN_BASE_FILLET)
    side = side[side[:, 1] > foot[-1, 1]]
    profile = np.concatenate([[[0.0, 0.0]], foot, side, head]) * INCH
    return resample(profile, rings + 2, bend=0.6)


def ball(cells: int = 20, diameter: float = BALL_DIAMETER) -> Body:
    """A sphere about the origin, by default a regulation bowling ball: 6 cells^2 + 2 vertices."""
    return rounded_box((diameter / 2,) * 3, diameter / 2, cells)


def rounded_box(half_extents: tuple[float, float, float], radius: float, cells: int) -> Body:
    """A box with rounded edges about the origin: 6 cells^2 + 2 vertices."""
    lattice, faces = cube_lattice(cells)
    extents = np.array(half_extents)
    # A flat share of the cells spans the flat faces, the rest the rounded edges.
    flat = 0.0 if radius >= extents.min() else 0.5
    inner = np.clip(lattice, -flat, flat)
    direction = np.tan((lattice - inner) / (1 - flat) * np.pi / 4)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    core = inner / flat * (extents - radius) if flat else np.sign(lattice) * 0.0
    return core + radius * direction, faces


def ellipsoid(half_extents: tuple[float, float, float], cells: int) -> Body:
    """An ellipsoid about the origin: 6 cells^2 + 2 vertices."""
    vertices, faces = rounded_box((1.0, 1.0, 1.0), 1.0, cells)
    return vertices * half_extents, faces


def torus(major: float = 0.12, minor: float = 0.04, rings: int = 40, segments: int = 112) -> Body:
    """A ring about the z axis: rings * segments vertices."""
    angle = np.arange(rings) * 2 * np.pi / rings
    return revolve(np.stack([major + minor * np.cos(angle), minor * np.sin(angle)], axis=1), segments, closed=True)


def gear(radius: float = 0.16, thickness: float = 0.07, teeth: int = 12, rings: int = 28, segments: int = 168) -> Body:
    """A toothed wheel with a bore, about the z axis: rings * segments vertices."""
    angle = np.arange(segments) * 2 * np.pi / segments
    rim = radius * (1 - 0.09 * (1 - np.tanh(2.5 * np.sin(teeth * angle)) / np.tanh(2.5)))
    bore, half, edge = 0.28 * radius, thickness / 2, 0.12 * thickness
    corners = np.array([[bore, -half], [radius, -half], [radius, half], [bore, half]])
    section = resample(rounded_polygon(corners, edge), rings + 1, bend=0.5)[:-1]
    share = (section[:, :1] - bore) / (radius - bore)
    return sheet(around(bore + share * (rim - bore), section[:, 1:], angle), wrap=True)


def star(radius: float = 0.17, thickness: float = 0.08, points: int = 5, rings: int = 34, segments: int = 130) -> Body:
    """A soft star with a domed face, about the z axis: rings * segments + 2 vertices."""
    angle = np.arange(segments) * 2 * np.pi / segments
    outline = radius * (0.78 + 0.22 * np.cos(points * angle))
    turn = np.linspace(-np.pi / 2, np.pi / 2, rings + 2)
    # A superellipse: rounder than a slab, fuller than an ellipsoid.
    share = np.cos(turn) ** 0.7
    height = thickness / 2 * np.sign(turn) * np.abs(np.sin(turn)) ** 0.8
    return sheet(around(share[1:-1, None] * outline, height[1:-1, None], angle), (height[0], height[-1]))


def chain_link(length: float = 0.16, radius: float = 0.075, wire: float = 0.032, rings: int = 130, sides: int = 34):
    """A link of a chain in the xy plane, its long axis x: rings * sides vertices."""
    return tube(link_path(rings, length, radius), np.full(rings, wire), sides, closed=True)


def link_path(count: int, length: float = 0.16, radius: float = 0.075) -> np.ndarray:
    """Points along the middle of a chain link's wire, metres [count, 3]: a stadium of straight sides `length`."""
    turn = np.linspace(-np.pi / 2, np.pi / 2, DENSE // 4)
    bow = np.stack([length / 2 + radius * np.cos(turn), radius * np.sin(turn), np.zeros(len(turn))], axis=1)
    loop = np.concatenate([bow, bow * [-1, -1, 1], bow[:1]])
    return resample(loop, count + 1)[:-1]


def knot(scale: float = 0.06, wire: float = 0.036, rings: int = 200, sides: int = 26) -> Body:
    """A trefoil knot about the z axis: rings * sides vertices."""
    return tube(knot_path(rings, scale), np.full(rings, wire), sides, closed=True)


def knot_path(count: int, scale: float = 0.06) -> np.ndarray:
    """Points along the middle of a trefoil's wire, metres [count, 3]."""
    t = np.linspace(0, 2 * np.pi, DENSE)
    x, y = np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t)
    return resample(scale * np.stack([x, y, -np.sin(3 * t)], axis=1), count + 1)[:-1]


def spinning_top(radius: float = 0.13, rings: int = 50, segments: int = 80) -> Body:
    """A child's spinning top, its tip at z = 0: rings * segments + 2 vertices."""
    outline = np.array([[0, 0], [0.09, 0.06], [0.6, 0.5], [1, 0.85], [0.95, 1.12], [0.3, 1.28], [0.16, 1.42]])
    outline = np.concatenate([outline, [[0.15, 1.72], [0.13, 1.85], [0, 1.9]]]) * radius
    return revolve(resample(smooth(outline), rings + 2, bend=0.4), segments)


def pawn(height: float = 0.34, rings: int = 60, segments: int = 72) -> Body:
    """A chess pawn standing on z = 0: rings * segments + 2 vertices."""
    foot = [
        [0, 0],
        [0.27, 0],
        [0.3, 0.03],
        [0.3, 0.08],
        [0.25, 0.12],
        [0.23, 0.18],
        [0.14, 0.32],
        [0.1, 0.5],
        [0.1, 0.57],
    ]
    collar = [[0.19, 0.6], [0.19, 0.635], [0.11, 0.665]]
    turn = np.linspace(-0.85, np.pi / 2, 24)
    head = np.stack([0.18 * np.cos(turn), 0.82 + 0.18 * np.sin(turn)], axis=1)
    outline = np.concatenate([rounded_path(np.array(foot + collar + [head[0].tolist()]), 0.03), head])
    return revolve(resample(outline * height, rings + 2, bend=0.5), segments)


def vase(height: float = 0.34, rings: int = 60, segments: int = 76) -> Body:
    """A hollow vase standing on z = 0: rings * segments + 2 vertices."""
    outer = np.array([[0.17, 0], [0.2, 0.02], [0.3, 0.25], [0.31, 0.45], [0.2, 0.72], [0.14, 0.86], [0.2, 1.0]])
    inner = np.array([[0.16, 0.99], [0.1, 0.86], [0.155, 0.72], [0.262, 0.45], [0.252, 0.27], [0.14, 0.06], [0, 0.05]])
    wall = np.concatenate([[[0, 0], [0.1, 0]], smooth(outer), smooth(inner)])
    return revolve(resample(wall * height, rings + 2, bend=0.4), segments)


def mug(radius: float = 0.09, height: float = 0.2, rings: int = 50, segments: int = 72) -> Body:
    """A hollow mug with a handle towards +x, standing on z = 0: rings * segments + 882 vertices."""
    wall, lip = 0.14 * radius, 0.06 * radius
    corners = np.array(
        [[0, 0], [radius, 0], [radius, height], [radius - wall, height], [radius - wall, wall], [0, wall]]
    )
    cup = revolve(resample(rounded_path(corners, lip), rings + 2, bend=0.5), segments)
    return join(cup, tube(mug_handle_path(44, radius, height), np.full(44, 0.12 * radius), 20))


def mug_handle_path(count: int, radius: float = 0.09, height: float = 0.2) -> np.ndarray:
    """Points along the middle of a mug's handle, metres [count, 3]; its ends stop inside the wall."""
    x, z = [0.93, 1.18, 1.55, 1.68, 1.55, 1.18, 0.93], [0.22, 0.2, 0.28, 0.5, 0.72, 0.8, 0.78]
    return resample(smooth(np.stack([x, np.zeros(7), z], axis=1) * [radius, 1, height]), count)


def teapot_like(radius: float = 0.16, rings: int = 70, segments: int = 64) -> Body:
    """A solid teapot on z = 0, spout towards +x: rings * segments + 1,924 vertices."""
    outline = [
        [0, 0],
        [0.52, 0],
        [0.6, 0.05],
        [0.86, 0.25],
        [1, 0.55],
        [0.9, 0.9],
        [0.68, 1.1],
        [0.66, 1.14],
        [0.62, 1.14],
    ]
    lid = [[0.6, 1.13], [0.4, 1.24], [0.13, 1.3], [0.09, 1.35], [0.16, 1.42], [0.15, 1.5], [0.07, 1.54], [0, 1.545]]
    pot = revolve(resample(smooth(np.array(outline + lid)) * radius, rings + 2, bend=0.4), segments)
    spout = smooth(np.array([[0.7, 0, 0.38], [1.05, 0, 0.5], [1.28, 0, 0.75], [1.42, 0, 1.02], [1.62, 0, 1.17]]))
    spout, along = resample(spout, 48) * radius, np.linspace(0, 1, 48)
    # The mouth closes as a rounded rim.
    rim = np.sqrt(np.clip(1 - ((along - 0.97) / 0.03).clip(0) ** 2, 0.05, None))
    spout_part = tube(spout, radius * (0.3 - 0.34 * along + 0.15 * along**2) * rim, 22)
    handle_part = tube(teapot_handle_path(48, radius), np.full(48, 0.085 * radius), 18)
    return join(pot, spout_part, handle_part)


def teapot_handle_path(count: int, radius: float = 0.16) -> np.ndarray:
    """Points along the middle of a teapot's handle, metres [count, 3]; its ends stop inside the pot."""
    x, z = [-0.8, -1.2, -1.5, -1.5, -1.2, -0.85], [0.98, 1.08, 0.95, 0.68, 0.4, 0.3]
    return resample(smooth(np.stack([x, np.zeros(6), z], axis=1)), count) * radius


def pedestal(radius: float = 0.34, height: float = 0.5, rings: int = 30, segments: int = 64) -> Body:
    """A round plinth with a moulded foot and cap, standing on z = 0: rings * segments + 2 vertices."""
    side = [[0, 0], [1, 0], [1, 0.16], [0.86, 0.26], [0.82, 0.5], [0.86, 0.76], [0.98, 0.86], [0.98, 1], [0, 1]]
    outline = np.array(side) * [radius, height]
    return revolve(resample(rounded_path(outline, 0.03 * radius), rings + 2, bend=0.6), segments)


# A figure of height 1: tapered capsules as (start, end, start radius, end radius). The figure faces -y.
_TRUNK = (
    ((0, 0.0, 0.56), (0, 0.01, 0.66), 0.088, 0.07),
    ((0, 0.01, 0.66), (0, 0.0, 0.77), 0.072, 0.098),
    ((-0.07, 0.0, 0.79), (0.07, 0.0, 0.79), 0.058, 0.058),
    ((0, 0.005, 0.82), (0, -0.008, 0.88), 0.036, 0.034),
    ((0, -0.012, 0.922), (0, 0.0, 0.945), 0.05, 0.056),
)
_LEGS = (
    ((0.05, 0, 0.54), (0.062, -0.015, 0.32), 0.068, 0.046),
    ((0.062, -0.015, 0.32), (0.058, 0.015, 0.1), 0.047, 0.032),
    ((0.058, 0.015, 0.085), (0.072, -0.07, 0.075), 0.033, 0.026),
    ((-0.05, 0, 0.54), (-0.085, -0.07, 0.34), 0.066, 0.046),
    ((-0.085, -0.07, 0.34), (-0.085, 0.02, 0.11), 0.046, 0.032),
    ((-0.085, 0.02, 0.085), (-0.11, -0.06, 0.075), 0.033, 0.026),
)
_ARMS_RAISED = (
    ((0.11, 0, 0.79), (0.2, -0.02, 0.68), 0.042, 0.032),
    ((0.2, -0.02, 0.68), (0.1, -0.07, 0.58), 0.032, 0.026),
    ((-0.11, 0, 0.8), (-0.21, -0.02, 0.9), 0.042, 0.032),
    ((-0.21, -0.02, 0.9), (-0.2, -0.06, 1.05), 0.031, 0.025),
    ((-0.2, -0.06, 1.115), (-0.2, -0.06, 1.117), 0.055, 0.055),
)
_ARMS_STAFF = (
    ((0.11, 0, 0.79), (0.2, 0.0, 0.67), 0.042, 0.032),
    ((0.2, 0.0, 0.67), (0.19, -0.12, 0.74), 0.031, 0.026),
    ((0.175, -0.13, 0.03), (0.205, -0.13, 1.1), 0.019, 0.019),
    ((-0.11, 0, 0.79), (-0.18, 0.03, 0.66), 0.042, 0.032),
    ((-0.18, 0.03, 0.66), (-0.17, -0.06, 0.55), 0.031, 0.026),
)
_ROBE = (
    ((0, 0.02, 0.5), (0, 0.03, 0.12), 0.105, 0.165),
    ((0.05, -0.02, 0.5), (0.06, -0.06, 0.1), 0.07, 0.085),
    ((-0.05, -0.02, 0.5), (-0.1, -0.04, 0.1), 0.07, 0.09),
)
_POSES = {"raised": _TRUNK + _LEGS + _ARMS_RAISED, "staff": _TRUNK + _ROBE + _ARMS_STAFF}
# Width of the blend between neighbouring limbs, and the plinth under the feet, as shares of the height.
_BLEND, _PLINTH_RADIUS, _PLINTH_HEIGHT = 0.022, 0.225, 0.045


def statue_like(pose: str = "raised", height: float = 1.3, cells: int = 84) -> Body:
    """A standing figure on a round plinth at z = 0, facing -y; `cells` cubes span its height.

    pose: "raised" (an arm lifts a sphere) or "staff" (a robed figure with a staff).

    Raises:
        ValueError: there is no such pose.
    """
    if pose not in _POSES:
        raise ValueError(f"statue_like: pose {pose!r} is unknown; choose one of {', '.join(_POSES)}")
    limbs = _POSES[pose]
    low, high = np.array([-0.34, -0.34, -0.05]), np.array([0.34, 0.34, 1.22])
    vertices, faces = implicit_surface(lambda points: _figure_distance(points, limbs), low, high, 1 / cells)
    return vertices * height, faces


def _figure_distance(points: np.ndarray, limbs: tuple) -> np.ndarray:
    """Approximate signed distance to a blended figure, [points]."""
    # The plinth: a round cylinder with a softened edge.
    edge = 0.012
    radial = np.hypot(points[:, 0], points[:, 1]) - (_PLINTH_RADIUS - edge)
    axial = np.abs(points[:, 2] - _PLINTH_HEIGHT / 2) - (_PLINTH_HEIGHT / 2 - edge)
    outside = np.hypot(np.maximum(radial, 0), np.maximum(axial, 0))
    distance = outside + np.minimum(np.maximum(radial, axial), 0) - edge
    return blended_limbs(points, limbs, _BLEND, distance)


def blended_limbs(points: np.ndarray, limbs: tuple, blend: float, distance: np.ndarray | None = None) -> np.ndarray:
    """Approximate signed distance to tapered capsules that run into one another, [points].

    limbs: (start, end, start radius, end radius) of each. blend: width of the transition. distance: to what they run
        into, besides each other.
    """
    distance = np.full(len(points), np.inf) if distance is None else distance
    for start, end, start_radius, end_radius in limbs:
        axis = np.subtract(end, start)
        along = np.clip((points - start) @ axis / (axis @ axis), 0, 1)
        limb = np.linalg.norm(points - start - along[:, None] * axis, axis=1)
        limb -= start_radius + along * (end_radius - start_radius)
        # Polynomial smooth minimum.
        overlap = np.maximum(blend - np.abs(distance - limb), 0) / blend
        distance = np.minimum(distance, limb) - overlap**2 * blend / 4
    return distance
