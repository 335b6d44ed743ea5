"""The chess set of `sims.chess_pieces`, the game of `sims.chess`, and the hand of `sims.hand`."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

import warp_psf as psf
from benchmarks.accuracy import pixel_points
from sims import HIDDEN_GROUP, chess, chess_pieces, hand
from sims.chess_pieces import FIELD

FRAMES_PER_SECOND, DURATION = 30, 4.0
SURFACES = {**chess.SHAPES, "hand": hand.hand}


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return chess.build()


@pytest.fixture(scope="module")
def run(model) -> tuple[np.ndarray, np.ndarray, mujoco.MjData]:
    """Where all bodies are in every frame, [frames, bodies, 3], how upright, [frames, bodies], and the last state."""
    places, upright, data = [], [], None
    for data in chess.states(model, FRAMES_PER_SECOND, DURATION):
        places.append(data.xpos.copy())
        upright.append(data.xmat[:, 8].copy())
    assert data is not None
    return np.array(places), np.array(upright), data


def is_closed(faces: np.ndarray) -> bool:
    """Each edge of a triangle runs the other way in exactly one other triangle."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    forward, backward = np.unique(edges, axis=0), np.unique(edges[:, ::-1], axis=0)
    return len(forward) == len(edges) and np.array_equal(forward, backward)


def volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    return np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6


def lowest(model: mujoco.MjModel, data: mujoco.MjData, name: str) -> float:
    """The height of the lowest point of a piece as it is drawn, metres."""
    geom = model.body(name).geomadr[0]
    mesh = model.geom_dataid[geom]
    first = model.mesh_vertadr[mesh]
    vertices = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
    return (vertices @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom])[:, 2].min()


@pytest.mark.parametrize("name", SURFACES)
def test_surface_is_closed_and_faces_outward(name: str):
    vertices, faces = SURFACES[name]()
    assert vertices.dtype == np.float64 and faces.dtype == np.int32
    assert np.array_equal(np.unique(faces), np.arange(len(vertices)))
    assert is_closed(faces)
    assert volume(vertices, faces) > 0
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    # Square metres: no triangle is a line.
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).min() > 1e-9


@pytest.mark.parametrize("kind", chess_pieces.FOOT)
def test_piece_stands_on_its_foot_within_a_field(kind: str):
    vertices, _ = chess.SHAPES[kind]()
    assert vertices[:, 2].min() == 0.0
    radius = np.hypot(vertices[:, 0], vertices[:, 1])
    # The foot's edge is rounded over less than a hundredth of a field.
    on_board = radius[vertices[:, 2] < 0.02 * FIELD].max()
    assert on_board == pytest.approx(chess_pieces.FOOT[kind] * FIELD, abs=0.02 * FIELD)
    assert radius.max() < FIELD / 2
    assert len(vertices) < 4000


def test_pieces_rank_by_height():
    heights = {kind: np.ptp(shape()[0][:, 2]) for kind, shape in chess.SHAPES.items()}
    assert sorted(heights, key=lambda kind: -heights[kind]) == ["king", "queen", "bishop", "knight", "rook", "pawn"]


def test_benchmark_set_has_the_papers_size():
    vertices, faces, part = chess_pieces.benchmark_set()
    # Kautz 2004, Table 1: the chess scene.
    assert vertices.shape == (1897, 3) and faces.shape == (3704, 3) and part.shape == (1897,)
    assert (part[faces] == part[faces[:, :1]]).all()
    assert vertices[:, 2].min() == 0.0
    for number in range(1, part.max() + 1):
        own = faces[part[faces[:, 0]] == number]
        assert is_closed(own) and volume(vertices, own) > 0
    board = faces[part[faces[:, 0]] == 0]
    a, b, c = (vertices[board[:, corner]] for corner in range(3))
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()
    # The pieces stand apart, on the board.
    middles = np.array([vertices[part == number].mean(axis=0) for number in range(1, part.max() + 1)])
    apart = np.linalg.norm(middles[:, None, :2] - middles[None, :, :2], axis=2)[np.triu_indices(len(middles), 1)]
    assert apart.min() > 2 * max(chess_pieces.FOOT.values()) * FIELD
    assert vertices[part == 0].max() == pytest.approx(8 * FIELD)


def test_board_lies_level_and_only_what_is_hidden_collides(model):
    board = model.geom("board")
    np.testing.assert_allclose(board.size[:2], 4 * FIELD)
    assert board.pos[2] + board.size[2] == pytest.approx(0.0, abs=1e-12)
    for geom in range(model.ngeom):
        collides = model.geom_contype[geom] or model.geom_conaffinity[geom]
        assert bool(collides) == (model.geom_group[geom] == HIDDEN_GROUP)


def test_fields_alternate_and_a1_is_dark(model):
    data = mujoco.MjData(model)
    camera = mujoco.MjvCamera()
    camera.lookat, camera.distance, camera.elevation, camera.azimuth = (0.0, 0.0, 0.0), 8 * FIELD / 0.36, -90.0, 90.0
    mujoco.mj_forward(model, data)
    with psf.Renderer(model, 160, 160, bounces=0) as renderer:
        renderer.update_scene(data, camera)
        layers, pose = renderer.layers(), renderer.world_from_camera
    points = pixel_points(layers["depth"], pose, np.deg2rad(model.vis.global_.fovy))
    on_board = layers["segmentation"][..., 0] == model.geom("board").id
    field = np.floor(points[on_board][:, :2] / FIELD).astype(int)
    # Off the edges of fields, where pixels show two.
    inside = (np.abs(points[on_board][:, :2] / FIELD - field - 0.5) < 0.35).all(axis=1)
    light = layers["albedo"][on_board][inside].mean(axis=1) > 0.3
    # Pixels at the edges of pieces mix the colours of both.
    assert np.mean(light == (field[inside].sum(axis=1) % 2 == 1)) > 0.98
    assert len(np.unique(field[inside], axis=0)) > 55  # pieces hide the others


def test_every_piece_stands_on_the_board_at_first(model):
    data = next(chess.states(model))
    for name, (field, _) in chess.POSITION.items():
        assert lowest(model, data, name) == pytest.approx(0.0, abs=1e-6)
        assert np.linalg.norm(data.body(name).xpos - chess.place(field)) < 0.1 * FIELD
    assert len({field for field, _ in chess.POSITION.values()}) == len(chess.POSITION)


def test_carried_pieces_are_lifted_and_set_down(model, run):
    places, _, data = run
    for move in chess.MOVES:
        path = places[:, model.body(move.piece).id]
        assert path[:, 2].max() == pytest.approx(move.height, rel=0.02)
        np.testing.assert_allclose(path[-1], chess.place(move.to), atol=1e-9)
        assert lowest(model, data, move.piece) == pytest.approx(0.0, abs=1e-6)
        # It slides on nothing: off the board's surface whenever it moves sideways by more than a millimetre.
        sideways = np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1) > 1e-3
        assert (path[1:][sideways, 2] > 1e-3).all()


def test_the_queen_knocks_the_king_over(model, run):
    places, upright, data = run
    king = model.body(chess.FALLING).id
    hit = round(chess.MOVES[-1].start * FRAMES_PER_SECOND)
    assert upright[:hit, king].min() > 1 - 1e-6
    assert abs(upright[-1, king]) < 0.3
    # It lies still on the board, and sinks in by no more than contacts give way, metres.
    assert np.abs(data.qvel).max() < 0.02
    assert -2e-3 < lowest(model, data, chess.FALLING) < 5e-3
    assert np.abs(places[:, king, :2]).max() < chess.EDGE - 0.1 * FIELD
    assert not any(warning.number for warning in data.warning)


def test_everyone_else_stays_upright(model, run):
    _, upright, _ = run
    others = [model.body(name).id for name in chess.POSITION if name != chess.FALLING]
    assert upright[:, others].min() > 1 - 1e-9


def test_states_are_deterministic(run):
    places = [data.xpos.copy() for data in chess.states(chess.build(), FRAMES_PER_SECOND, DURATION)]
    assert np.array_equal(places, run[0])


def test_two_environments_of_which_the_first_is_the_default():
    first, second = chess.environments()
    assert first.name != second.name
    assert np.array_equal(chess.environment().radiance, first.radiance)


@pytest.fixture(scope="module")
def grip() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The hand's vertices in eight frames of a period, its faces, and how its vertices follow the bones."""
    body = hand.hand()
    return np.array(list(hand.poses(8))), body[1], hand.follow(body)


def test_hand_has_the_papers_size(grip):
    frames, faces, _ = grip
    # Kautz 2004, Table 1: the hand. Without holes or handles, triangles are twice the vertices but four.
    assert frames.shape[1] == pytest.approx(8636, rel=0.02)
    assert len(faces) == 2 * frames.shape[1] - 4
    # A grown man's hand, with a stub of the arm.
    assert np.ptp(frames[0], axis=0)[1] == pytest.approx(0.25, rel=0.1)


def test_hand_follows_its_bones_with_weights_that_sum_to_one(grip):
    weights = grip[2]
    assert weights.min() >= 0.0
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-12)
    rotations, _ = hand.bone_motions(0.3)
    np.testing.assert_allclose(
        rotations @ rotations.transpose(0, 2, 1), np.broadcast_to(np.eye(3), rotations.shape), atol=1e-12
    )
    assert np.linalg.det(rotations) == pytest.approx(1.0)


def test_hand_closes_opens_and_keeps_its_volume(grip):
    frames, faces, _ = grip
    reach = frames[..., 1].max(axis=1)
    # Open at the start, closed in the middle: the fingertips come back by half of their length.
    assert reach.argmax() in (0, 1) and reach.argmin() in (4, 5)
    assert reach.max() - reach.min() > 0.05
    volumes = [volume(vertices, faces) for vertices in frames]
    # Blending rotations thins a joint that bends; flesh keeps its volume.
    assert volumes == pytest.approx([np.mean(volumes)] * len(volumes), rel=0.03)


def test_fingers_do_not_enter_each_other(grip):
    frames, _, weights = grip
    digit = np.append(np.repeat(np.arange(5), 3), -1)[weights.argmax(axis=1) - 1]
    for frame, vertices in enumerate(frames):
        rotations, shifts = hand.bone_motions(frame / len(frames))
        for number, bone in enumerate(hand.BONES):
            others = (digit >= 0) & (digit != number // 3)
            at_rest = (vertices[others] - shifts[number + 1]) @ rotations[number + 1]
            axis = bone.end - bone.start
            along = np.clip((at_rest - bone.start) @ axis / (axis @ axis), 0, 1)
            away = np.linalg.norm(at_rest - bone.start - along[:, None] * axis, axis=1)
            radius = bone.radii[0] + along * (bone.radii[1] - bone.radii[0])
            # Metres: a tenth of a finger's radius, where two of them touch.
            assert (away - radius).min() > -1e-3
