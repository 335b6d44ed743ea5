"""The end of a game of chess under two environments: a knight jumps, a pawn steps, a queen knocks the king over.

`python -m sims.chess` renders it. White sits at -y; a1 is the field at -x, -y; the board's top is z = 0.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from sims import HIDDEN_GROUP, add_material, add_mesh, draw_box, draw_mesh, frame_numbers, new_stage
from sims.chess_pieces import FIELD, FOOT, bishop, king, knight, pawn, queen, rook

if TYPE_CHECKING:
    import warp_psf as psf

# Metres: how far the board reaches to its edge and to the frame's, its thickness, and by what the frame rises above it.
EDGE, FRAME, THICKNESS, RIM = 4 * FIELD, 4 * FIELD + 0.09, 0.07, 0.012
SHAPES = {"king": king, "queen": queen, "bishop": bishop, "knight": knight, "rook": rook, "pawn": pawn}
# Piece by piece: where it stands, and by how much it is turned about its axis, radians.
POSITION = {
    "white king": ("g1", 0.0),
    "white rook": ("d1", 0.2),
    "white queen": ("a6", 0.0),
    "white bishop": ("c4", 0.8),
    "white knight": ("f3", 1.2),
    "white pawn b": ("b2", 0.0),
    "white pawn f": ("f2", 0.0),
    "white pawn g": ("h3", 0.0),
    "black king": ("e6", 0.3),
    "black rook": ("d8", 0.1),
    "black bishop": ("b4", -2.2),
    "black knight": ("c7", -1.2),
    "black pawn e": ("e5", 0.0),
    "black pawn g": ("g7", 0.0),
    "black pawn h": ("h6", 0.0),
}
# Who falls, and how far off the middle of its field it stands, metres: so that it rolls aside.
FALLING, OFF_CENTRE = "black king", (0.0, 0.012, 0.0)
# Kilograms per cubic metre.
DENSITY = 700.0
# Sliding, torsional and rolling friction (m); time constant (s) and damping ratio of contacts.
GRIP, SOLREF = (0.6, 0.01, 0.001), (0.004, 1.0)
# What collides for a king, fields: radius, lowest and highest point of the cylinders that its rims lie in.
KING_CYLINDERS = ((0.37, 0.0, 0.07), (0.15, 0.07, 1.4), (0.23, 0.98, 1.025), (0.225, 1.4, 1.43))
KING_CROSS = ((0.022, 0.08, 0.03), 1.615)  # half extents, height
# For every other piece: its foot, and a stem of a share of the foot's radius up to a height, fields.
FOOT_HEIGHT, STEM_SHARE = 0.15, 0.62
STEM_HEIGHT = {"queen": 1.38, "bishop": 1.1, "knight": 1.0, "rook": 0.94, "pawn": 0.85}


@dataclass(frozen=True)
class Move:
    """A piece is lifted, carried and set down.

    start, end: seconds; height: of the lift, and past: how far it goes beyond the field before it comes back, metres.
    """

    piece: str
    to: str
    start: float
    end: float
    height: float
    past: float = 0.0


MOVES = (
    Move("white knight", "g5", 0.1, 1.2, 0.26),
    Move("black pawn h", "h5", 0.9, 1.6, 0.06),
    Move("white queen", "d6", 1.4, 2.8, 0.19, past=0.15),
)
# Of the fields, sRGB.
DARK_FIELD, LIGHT_FIELD = (0.42, 0.27, 0.18), (0.86, 0.76, 0.58)
# Seconds in which the light changes.
DUSK = (1.2, 2.6)
# Shares of a move: in which a piece rises, and in which it is set down; when it goes, and when it comes back.
RISE, GO, BACK = 0.28, (0.14, 0.62), (0.6, 0.82)


def build() -> mujoco.MjModel:
    """Board, table and fifteen pieces: three are carried, the black king is free, the others stand fast."""
    spec = new_stage(position=(0.75, -2.5, 1.45), target=(0.03, -0.15, 0.03), fovy=32)
    add_material(spec, "table", (0.66, 0.66, 0.62))
    add_material(spec, "frame", (0.3, 0.18, 0.12), gloss=0.08)
    add_material(spec, "white", (0.88, 0.81, 0.68), gloss=0.15)
    add_material(spec, "black", (0.33, 0.21, 0.17), gloss=0.2)
    _add_board(spec)
    for kind, shape in SHAPES.items():
        add_mesh(spec, kind, shape())
    carried = {move.piece for move in MOVES}
    for name, (field, turn) in POSITION.items():
        quaternion = [math.cos(turn / 2), 0.0, 0.0, math.sin(turn / 2)]
        at = place(field) + OFF_CENTRE if name == FALLING else place(field)
        body = spec.worldbody.add_body(name=name, pos=at, quat=quaternion, mocap=name in carried)
        color, kind = name.split()[:2]
        draw_mesh(body, kind, color)
        if name == FALLING:
            body.add_freejoint(name=name)
        _add_contacts(body, kind)
    return spec.compile()


def states(model: mujoco.MjModel, frames_per_second: float = 30, duration: float = math.inf) -> Iterator[mujoco.MjData]:
    """The state at each frame, from the start: the same `MjData` every time, stepped on."""
    data = mujoco.MjData(model)
    steps = 0
    for frame in frame_numbers(frames_per_second, duration):
        target = round(frame / frames_per_second / model.opt.timestep)
        for _ in range(target - steps):
            _carry(model, data)
            mujoco.mj_step(model, data)
        steps = target
        _carry(model, data)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)
        yield data


def lights() -> tuple:
    """None: the environments are light enough."""
    return ()


def environments() -> tuple[psf.Environment, psf.Environment]:
    """A studio by day, and a sunset."""
    import warp_psf as psf

    return psf.load_environment("studio"), psf.load_environment("sunset")


def environment() -> psf.Environment:
    """The first of the two."""
    return environments()[0]


def environment_at(time: float) -> psf.Environment:
    """The light at a time, seconds: one passes into the other while the queen is on her way."""
    import warp_psf as psf

    first, second = environments()
    share = _ease(time, *DUSK)
    return psf.Environment("dusk", (1.0 - share) * first.radiance + share * second.radiance)


def place(field: str) -> np.ndarray:
    """The middle of a field such as "e4", metres [3]."""
    return FIELD * np.array(["abcdefgh".index(field[0]) - 3.5, int(field[1]) - 4.5, 0.0])


def _add_board(spec: mujoco.MjSpec) -> None:
    world = spec.worldbody
    draw_box(world, "table", (-12.0, -6.0, -THICKNESS - 0.1), (12.0, 20.0, -THICKNESS), "table")
    # Two by two fields, four times along each side of one box: a box for every field would be 64 bodies to shade.
    checker = {"builtin": mujoco.mjtBuiltin.mjBUILTIN_CHECKER, "rgb1": LIGHT_FIELD, "rgb2": DARK_FIELD}
    spec.add_texture(name="fields", type=mujoco.mjtTexture.mjTEXTURE_2D, width=256, height=256, **checker)
    add_material(spec, "fields", (1.0, 1.0, 1.0), gloss=0.08)
    fields = spec.material("fields")
    fields.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB], fields.texrepeat = "fields", [4, 4]
    draw_box(world, "board", (-EDGE, -EDGE, -THICKNESS), (EDGE, EDGE, 0.0), "fields")
    for name, low, high in (
        ("frame front", (-FRAME, -FRAME), (FRAME, -EDGE)),
        ("frame back", (-FRAME, EDGE), (FRAME, FRAME)),
        ("frame left", (-FRAME, -EDGE), (-EDGE, EDGE)),
        ("frame right", (EDGE, -EDGE), (FRAME, EDGE)),
    ):
        draw_box(world, name, (*low, -THICKNESS), (*high, RIM), "frame")
    world.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], group=HIDDEN_GROUP, **_contact())


def _contact() -> dict:
    return {"condim": 6, "friction": GRIP, "solref": SOLREF}


def _add_contacts(body: mujoco.MjsBody, kind: str) -> None:
    """What collides for a piece: cylinders about its axis."""
    cylinders = KING_CYLINDERS
    if kind != "king":
        cylinders = (
            (FOOT[kind], 0.0, FOOT_HEIGHT),
            (STEM_SHARE * FOOT[kind], FOOT_HEIGHT, STEM_HEIGHT[kind]),
        )
    for radius, low, high in cylinders:
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            size=[FIELD * radius, FIELD * (high - low) / 2, 0],
            pos=[0, 0, FIELD * (low + high) / 2],
            density=DENSITY,
            group=HIDDEN_GROUP,
            **_contact(),
        )
    if kind == "king":
        half, height = KING_CROSS
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=FIELD * np.array(half),
            pos=[0, 0, FIELD * height],
            density=DENSITY,
            group=HIDDEN_GROUP,
            **_contact(),
        )


def _carry(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Puts the carried pieces where they are at `data.time`."""
    for move in MOVES:
        share = (data.time - move.start) / (move.end - move.start)
        start = place(POSITION[move.piece][0])
        way = place(move.to) - start
        length = np.linalg.norm(way)
        # Sideways only while it is lifted.
        along = (length + move.past) * _ease(share, *GO) - move.past * _ease(share, *BACK)
        lift = move.height * _ease(share, 0, RISE) * _ease(1 - share, 0, RISE)
        position = start + along / length * way + [0.0, 0.0, lift]
        data.mocap_pos[model.body(move.piece).mocapid[0]] = position


def _ease(share: float, first: float, last: float) -> float:
    """From 0 at `first` to 1 at `last`, at rest at both: the polynomial of least jerk."""
    share = min(max((share - first) / (last - first), 0.0), 1.0)
    return share**3 * (10 - 15 * share + 6 * share**2)


if __name__ == "__main__":
    from warp_psf.cli import run_simulation

    run_simulation(build, states, name="chess", camera="front", environment=environment_at, lights=lights())
