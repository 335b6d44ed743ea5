"""The cloth of `sims.cloth`: it falls, drapes itself over a ball and a block, and comes to rest."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from sims import HIDDEN_GROUP, cloth

FRAMES_PER_SECOND, DURATION = 30, 3.0
# Metres: how far a contact gives way while the cloth strikes, and how far when it lies still.
STRIKING, LYING = 0.012, 0.004
# What an edge stretches or shrinks by at most: as loose cotton does under its own weight, with room for the impact.
STRAIN, STRAIN_AT_REST = 0.12, 0.08


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return cloth.build()


@pytest.fixture(scope="module")
def run(model) -> tuple[np.ndarray, mujoco.MjData]:
    """The vertices in every frame, metres [frames, vertices, 3], and the last state."""
    frames, data = [], None
    for data in cloth.states(model, FRAMES_PER_SECOND, DURATION):
        frames.append(data.flexvert_xpos.copy())
    assert data is not None
    return np.array(frames), data


def strain(model: mujoco.MjModel, vertices: np.ndarray) -> np.ndarray:
    """By what share every edge is longer than at rest, [..., edges]."""
    ends = vertices[..., model.flex_edge, :]
    return np.linalg.norm(ends[..., 0, :] - ends[..., 1, :], axis=-1) / model.flexedge_length0 - 1


def height_over_block(points: np.ndarray) -> np.ndarray:
    """Signed distance to the block that the cloth collides with, metres [...]."""
    cosine, sine = np.cos(cloth.BLOCK_TURN), np.sin(cloth.BLOCK_TURN)
    local = (points - cloth.BLOCK_PLACE) @ np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
    beyond = np.abs(local) - cloth.BLOCK_HALF
    return np.linalg.norm(np.maximum(beyond, 0), axis=-1) + np.minimum(beyond.max(axis=-1), 0)


def test_one_cloth_of_the_size_it_says(model):
    assert model.nflex == 1 and model.flex_dim[0] == 2
    assert model.flex_vertnum[0] == cloth.COLUMNS * cloth.ROWS == 1378
    assert model.flex_elemnum[0] == 2 * (cloth.COLUMNS - 1) * (cloth.ROWS - 1) == 2600
    # The cloth's vertices are bodies; the ball and the block are fixed.
    first = model.flex_vertbodyid[0]
    assert model.body_mass[first:].sum() == pytest.approx(cloth.MASS)
    drawn = [geom for geom in range(model.ngeom) if model.geom_group[geom] != HIDDEN_GROUP]
    assert len(drawn) == 3 and not model.geom_contype[drawn].any() and not model.geom_conaffinity[drawn].any()


def test_the_cloth_hangs_clear_of_everything_and_flat_at_first(model, run):
    vertices = run[0][0]
    assert np.abs(strain(model, vertices)).max() < 1e-6
    assert np.linalg.norm(vertices - cloth.BALL_PLACE, axis=1).min() > cloth.BALL_RADIUS + cloth.RADIUS
    assert height_over_block(vertices).min() > cloth.RADIUS


def test_nothing_explodes(model, run):
    frames, data = run
    assert np.isfinite(frames).all()
    # MuJoCo counts here when it starts a diverged simulation anew, or when its solver does not converge.
    assert not any(warning.number for warning in data.warning)
    assert np.abs(strain(model, frames)).max() < STRAIN
    # No faster than free fall from where it starts.
    fastest = np.sqrt(2 * 9.81 * frames[0, :, 2].max())
    assert np.linalg.norm(np.diff(frames, axis=0), axis=2).max() * FRAMES_PER_SECOND < fastest


def test_the_cloth_goes_through_nothing(run):
    frames, _ = run
    for vertices, depth in ((frames, STRIKING), (frames[-1:], LYING)):
        # What is left of the distance that the cloth keeps.
        least = cloth.RADIUS - depth
        assert vertices[..., 2].min() > least
        assert np.linalg.norm(vertices - cloth.BALL_PLACE, axis=2).min() > cloth.BALL_RADIUS + least
        assert height_over_block(vertices).min() > least


def test_the_cloth_comes_to_rest_on_ball_block_and_floor(model, run):
    frames, _ = run
    last = frames[-1]
    speed = np.linalg.norm(np.diff(frames[-4:], axis=0), axis=2) * FRAMES_PER_SECOND
    # Metres per second: a corner may still tremble, the cloth does not move.
    assert speed.mean() < 0.01 and speed.max() < 0.25
    assert np.abs(strain(model, last)).max() < STRAIN_AT_REST
    near = 3 * cloth.RADIUS
    assert (np.linalg.norm(last - cloth.BALL_PLACE, axis=1) < cloth.BALL_RADIUS + near).sum() > 100
    assert (height_over_block(last) < near).sum() > 50
    assert (last[:, 2] < near).sum() > 20
    # It hangs lower between the two than they are high, and it is drawn in: there are folds.
    assert np.ptp(last[:, 0]) < 0.8 * np.ptp(frames[0, :, 0])


def test_the_cloth_stays_in_view(model, run):
    frames, data = run
    camera = model.camera("front").id
    x, y, z = np.moveaxis((frames - data.cam_xpos[camera]) @ data.cam_xmat[camera].reshape(3, 3), -1, 0)
    half_height = np.tan(np.radians(model.cam_fovy[camera]) / 2)
    assert (z < 0).all()
    assert np.abs(y / z).max() < half_height and np.abs(x / z).max() < half_height * 16 / 9


def test_states_are_deterministic(model, run):
    for frame, data in enumerate(cloth.states(cloth.build(), FRAMES_PER_SECOND, 1.0)):
        assert np.array_equal(data.flexvert_xpos, run[0][frame])
