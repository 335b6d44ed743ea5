"""The simulations of `sims`: shapes, counts, determinism, and what happens in them."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from sims import HIDDEN_GROUP, bodies, bowling, falling, statues

SIMULATIONS = {"bowling": bowling, "falling": falling, "statues": statues}
# Drawn bodies and vertices of the scenes of figures 9 to 11 of the paper on adaptive shadow fields.
PAPER = {"bowling": (15, 41340), "falling": (20, 88739), "statues": (6, 32875)}
# A gridded box has 12 cells along each edge and does not share vertices between its sides.
BOX_VERTICES = 6 * 13**2
FRAMES_PER_SECOND, DURATION = 30, 4.0

BODIES = {
    "pin": bodies.pin,
    "ball": bodies.ball,
    "die": lambda: bodies.rounded_box((0.1, 0.08, 0.06), 0.02, 12),
    "ellipsoid": lambda: bodies.ellipsoid((0.1, 0.1, 0.14), 12),
    "torus": bodies.torus,
    "gear": bodies.gear,
    "star": bodies.star,
    "chain_link": bodies.chain_link,
    "knot": bodies.knot,
    "spinning_top": bodies.spinning_top,
    "pawn": bodies.pawn,
    "vase": bodies.vase,
    "mug": bodies.mug,
    "teapot": bodies.teapot_like,
    "pedestal": bodies.pedestal,
    "raised": lambda: bodies.statue_like("raised", cells=statues.RAISED_CELLS),
    "staff": lambda: bodies.statue_like("staff", cells=statues.STAFF_CELLS),
}


@pytest.fixture(scope="module")
def models() -> dict[str, mujoco.MjModel]:
    return {name: simulation.build() for name, simulation in SIMULATIONS.items()}


@pytest.fixture(scope="module")
def runs(models) -> dict[str, tuple[list[np.ndarray], mujoco.MjData]]:
    """Per simulation: the geoms' positions in every frame, and the last state."""
    return {name: _simulate(name, model) for name, model in models.items()}


def _simulate(name: str, model: mujoco.MjModel) -> tuple[list[np.ndarray], mujoco.MjData]:
    frames, data = [], None
    for data in SIMULATIONS[name].states(model, FRAMES_PER_SECOND, DURATION):
        frames.append(np.concatenate([data.geom_xpos.ravel(), data.geom_xmat.ravel()]))
    assert data is not None
    return frames, data


def _drawn(model: mujoco.MjModel) -> list[int]:
    return [geom for geom in range(model.ngeom) if model.geom_group[geom] != HIDDEN_GROUP]


def _world_vertices(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> np.ndarray:
    mesh = model.geom_dataid[geom]
    first = model.mesh_vertadr[mesh]
    vertices = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
    return vertices @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]


@pytest.mark.parametrize("name", BODIES)
def test_body_is_closed_and_outward(name: str):
    vertices, faces = BODIES[name]()
    assert vertices.dtype == np.float64 and faces.dtype == np.int32
    assert np.isfinite(vertices).all()
    assert np.array_equal(np.unique(faces), np.arange(len(vertices)))
    # Closed: each edge of a triangle runs the other way in exactly one other triangle.
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    forward = edges[:, 0] * len(vertices) + edges[:, 1]
    backward = edges[:, 1] * len(vertices) + edges[:, 0]
    assert len(np.unique(forward)) == len(forward)
    assert np.array_equal(np.sort(forward), np.sort(backward))
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    assert np.einsum("ij,ij->i", a, np.cross(b, c)).sum() > 0
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).min() > 1e-7


def test_ball_volume():
    vertices, faces = bodies.ball(cells=24)
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6
    assert volume == pytest.approx(np.pi / 6 * bodies.BALL_DIAMETER**3, rel=0.01)
    assert np.linalg.norm(vertices, axis=1) == pytest.approx(4.25 * 0.0254, abs=1e-12)


def test_pin_has_regulation_dimensions():
    vertices, _ = bodies.pin()
    assert np.ptp(vertices[:, 2]) == pytest.approx(0.381, abs=1e-6)
    radius, height = np.hypot(vertices[:, 0], vertices[:, 1]), vertices[:, 2]
    assert 2 * radius.max() == pytest.approx(4.766 * 0.0254, abs=1e-3)
    rings = np.unique(np.round(height, 9))
    widths = np.array([2 * radius[np.abs(height - ring) < 1e-8].max() for ring in rings])
    # The table without its first row: the edge of the base is rounded.
    for inches, diameter in list(zip(bodies.PIN_HEIGHTS, bodies.PIN_DIAMETERS, strict=True))[1:]:
        assert np.interp(inches * 0.0254, rings, widths) == pytest.approx(diameter * 0.0254, abs=1e-3)
    base = radius[height < 0.006].max()
    assert 2 * base == pytest.approx(2.25 * 0.0254, abs=4e-3)


def test_unknown_pose_is_named():
    with pytest.raises(ValueError, match="pose 'seated' is unknown"):
        bodies.statue_like("seated")


@pytest.mark.parametrize("name", SIMULATIONS)
def test_scene_has_the_papers_size(name: str, models):
    model = models[name]
    drawn = _drawn(model)
    count = 0
    for geom in drawn:
        is_mesh = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH
        count += model.mesh_vertnum[model.geom_dataid[geom]] if is_mesh else BOX_VERTICES
        assert not model.geom_contype[geom] and not model.geom_conaffinity[geom]
    assert len(drawn) == PAPER[name][0]
    assert count == pytest.approx(PAPER[name][1], rel=0.01)


@pytest.mark.parametrize("name", SIMULATIONS)
def test_states_are_deterministic(name: str, models, runs):
    frames, _ = runs[name]
    again, _ = _simulate(name, models[name])
    assert len(frames) == round(FRAMES_PER_SECOND * DURATION)
    assert all(np.array_equal(first, second) for first, second in zip(frames, again, strict=True))


@pytest.mark.parametrize("name", SIMULATIONS)
def test_model_rebuilds_the_same(name: str, models):
    again = SIMULATIONS[name].build()
    assert np.array_equal(again.mesh_vert, models[name].mesh_vert)
    assert np.array_equal(again.geom_pos, models[name].geom_pos)


def test_states_go_on_without_a_duration(models):
    stream = statues.states(models["statues"], 1)
    times = [next(stream).time for _ in range(10)]
    assert times == list(range(10))


def test_ball_strikes(runs):
    _, data = runs["bowling"]
    upright = [data.body(f"pin_{number}").xmat[8] > np.cos(np.radians(20)) for number in range(1, 11)]
    assert upright.count(False) >= 7


def test_pins_stand_until_the_ball_comes(models):
    model = models["bowling"]
    *_, data = bowling.states(model, FRAMES_PER_SECOND, 0.8)
    for number in range(1, 11):
        assert data.body(f"pin_{number}").xmat[8] > 1 - 1e-6
        assert abs(data.body(f"pin_{number}").xpos[2]) < 5e-4


@pytest.mark.parametrize("name", ["bowling", "falling"])
def test_bodies_come_to_rest_above_the_floor(name: str, models, runs):
    model, (_, data) = models[name], runs[name]
    slow = np.ones(model.nv, dtype=bool)
    if name == "bowling":
        # The ball may still spin in the pit.
        first = model.joint("ball").dofadr[0]
        slow[first : first + 6] = False
    assert np.abs(data.qvel[slow]).max() < 0.2
    for geom in _drawn(model):
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
            assert _world_vertices(model, data, geom)[:, 2].min() > -2e-3
    assert min(data.contact.dist) > -2e-3


def test_pile_stays_in_view(models, runs):
    model, (_, data) = models["falling"], runs["falling"]
    camera = model.camera("front").id
    rotation = data.cam_xmat[camera].reshape(3, 3)
    half_height = np.tan(np.radians(model.cam_fovy[camera]) / 2)
    for geom in _drawn(model):
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
            x, y, z = ((_world_vertices(model, data, geom) - data.cam_xpos[camera]) @ rotation).T
            assert (z < 0).all()
            assert np.abs(y / z).max() < half_height
            assert np.abs(x / z).max() < half_height * 16 / 9


def test_statues_move_apart(models):
    model = models["statues"]
    places = []
    for data in statues.states(model, FRAMES_PER_SECOND, DURATION):
        places.append(data.mocap_pos.copy())
    places = np.array(places)
    travelled = np.linalg.norm(np.diff(places, axis=0), axis=2).sum(axis=0)
    assert (np.sort(travelled)[1:] > 0.5).all()
    flat = places[..., :2]
    distance = np.linalg.norm(flat[:, :, None] - flat[:, None, :], axis=-1)
    pairs = ~np.eye(flat.shape[1], dtype=bool)
    # Plinths, staffs and the pedestal keep clear of each other.
    assert distance[:, pairs].min() > 0.7
