"""The figure of `sims.figure`: its skin at rest and in motion."""

from __future__ import annotations

import itertools
import math

import mujoco
import numpy as np
import pytest

from sims import HIDDEN_GROUP, figure

# One period is a whole number of frames, so that the motion can be compared after it.
FRAMES_PER_SECOND = 10


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return figure.build()


@pytest.fixture(scope="module")
def period(model) -> list[tuple[np.ndarray, np.ndarray]]:
    """Joint positions and skin vertices in each frame of one period, and in the frame after it."""
    view = mujoco.MjvScene(model, maxgeom=200)
    count = round(figure.PERIOD * FRAMES_PER_SECOND) + 1
    stream = itertools.islice(figure.states(model, FRAMES_PER_SECOND), count)
    return [(data.qpos.copy(), skin(model, data, view)) for data in stream]


def skin(model: mujoco.MjModel, data: mujoco.MjData, view: mujoco.MjvScene) -> np.ndarray:
    """The vertices of the skin as MuJoCo bends it, metres [vertices, 3]."""
    everything = mujoco.mjtCatBit.mjCAT_ALL
    mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, mujoco.MjvCamera(), everything, view)
    return np.array(view.skinvert, float).reshape(-1, 3)


def volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    return np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6


def test_one_skin_of_the_size_it_says(model):
    assert model.nskin == 1
    assert 2900 <= model.nskinvert <= 3050
    assert np.ptp(model.skin_vert[:, 2]) == pytest.approx(figure.HEIGHT, rel=0.03)
    # Only the skin is seen: the bones' geoms are where MuJoCo does not draw them.
    bones = set(model.skin_bonebodyid)
    assert {model.geom_group[geom] for geom in range(model.ngeom) if model.geom_bodyid[geom] in bones} == {HIDDEN_GROUP}


def test_the_skin_is_closed_and_faces_outward(model):
    faces = model.skin_face.astype(np.int64)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    # Each edge of a triangle runs the other way in exactly one other triangle.
    assert len(np.unique(edges, axis=0)) == len(edges)
    assert np.array_equal(np.unique(edges, axis=0), np.unique(edges[:, ::-1], axis=0))
    assert np.array_equal(np.unique(faces), np.arange(model.nskinvert))
    # A person of this height has about 0.07 m^3; were the faces inside out, it would be negative.
    assert 0.04 < volume(model.skin_vert.astype(float), faces) < 0.12


def test_every_vertex_follows_up_to_four_bones_with_weights_that_sum_to_one(model):
    # MuJoCo normalises what it is given, so what it is given is looked at too.
    np.testing.assert_allclose(figure.follow()[1].sum(axis=1), 1.0, atol=1e-12)
    total = np.bincount(model.skin_bonevertid, model.skin_bonevertweight, model.nskinvert)
    # Float32 of four weights.
    np.testing.assert_allclose(total, 1.0, atol=1e-6)
    assert np.bincount(model.skin_bonevertid).max() <= figure.BONES_PER_VERTEX
    assert model.skin_bonevertweight.min() >= 0


def test_the_skin_at_rest_is_the_surface_it_was_bound_to(model):
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    found = skin(model, data, mujoco.MjvScene(model, maxgeom=200))
    # Float32 of lengths up to two metres.
    np.testing.assert_allclose(found, model.skin_vert, atol=2e-6)


def test_the_motion_repeats_and_is_continuous(period):
    poses = np.array([pose for pose, _ in period])
    # Sines of angles that differ by whole turns.
    np.testing.assert_allclose(poses[-1], poses[0], atol=1e-9)
    assert np.ptp(poses, axis=0).max() > 0.5  # radians: it does move
    # No joint turns faster than a runner's knee, about 10 rad/s.
    assert np.abs(np.diff(poses, axis=0)).max() * FRAMES_PER_SECOND < 10


def test_the_lowest_vertex_stays_near_the_floor(period):
    lowest = np.array([vertices[:, 2].min() for _, vertices in period])
    assert lowest.min() >= 0.0
    assert lowest.max() <= 0.03


def test_joints_do_not_collapse(model, period):
    at_rest = volume(model.skin_vert.astype(float), model.skin_face)
    # Blending rotations thins a joint that bends; flesh keeps its volume.
    assert [volume(vertices, model.skin_face) for _, vertices in period] == pytest.approx(
        [at_rest] * len(period), rel=0.06
    )


def test_states_end_after_their_duration(model):
    assert len(list(figure.states(model, FRAMES_PER_SECOND, 0.5))) == round(0.5 * FRAMES_PER_SECOND)
    assert math.isclose(next(figure.states(model)).time, 0.0)
