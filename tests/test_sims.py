"""The simulations of `sims`: shapes, counts, determinism, and what happens in them."""

from __future__ import annotations

import copy
import math

import mujoco
import numpy as np
import pytest

from sims import HIDDEN_GROUP, bodies, bowling, falling, furniture, room, statues, sunlit, teapots

SIMULATIONS = {
    "bowling": bowling,
    "falling": falling,
    "statues": statues,
    "room": room,
    "teapots": teapots,
    "sunlit": sunlit,
}
# Drawn bodies and vertices of the scenes of figures 9 to 11 of the paper on adaptive shadow fields, and of figures 6,
# 7 and 8 of the paper on light interreflection; two count the six sides of the room, and the former a rug.
PAPER = {
    "bowling": (15, 41340),
    "falling": (20, 88739),
    "statues": (6, 32875),
    "room": (17, 50000),
    "teapots": (36, 122000),
    "sunlit": (2, 15082),
}
ROOMS = {"room": room, "teapots": teapots}
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
    "sofa": furniture.sofa,
    "armchair": lambda: furniture.sofa(room.ARMCHAIR_WIDTH, seats=1),
    "coffee_table": furniture.coffee_table,
    "floor_lamp": furniture.floor_lamp,
    "potted_plant": furniture.potted_plant,
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


@pytest.mark.parametrize("name", SIMULATIONS)
def test_states_are_finite(name: str, runs):
    frames, data = runs[name]
    assert np.isfinite(frames).all()
    # MuJoCo counts here when it starts a diverged simulation anew.
    assert not any(warning.number for warning in data.warning)


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


@pytest.mark.parametrize("name", ROOMS)
def test_room_is_closed(name: str, models):
    """From points all over the room, a ray in any direction meets one of the six sides where the room ends."""
    model, (low, high) = models[name], (np.array(ROOMS[name].LOW), np.array(ROOMS[name].HIGH))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    random = np.random.default_rng(6)
    # The sides of the room alone: whatever else is drawn leaves for a group that the rays do not meet.
    bare = copy.copy(model)
    sides = {bare.geom(side).id for side in ("floor", "ceiling", "left", "right", "front", "back")}
    bare.geom_group[[geom for geom in range(bare.ngeom) if geom not in sides]] = HIDDEN_GROUP
    seen = np.array([1, 0, 0, 0, 0, 0], np.uint8)
    met = set()
    for _ in range(2000):
        start = random.uniform(low + 0.01, high - 0.01)
        # Half of the rays go towards the room's edges, where a gap would be.
        aim = random.normal(size=3)
        if random.random() < 0.5:
            aim = np.where(
                random.permutation(3) == 0, random.uniform(low, high), np.where(random.random(3) < 0.5, low, high)
            )
            aim -= start
        aim /= np.linalg.norm(aim)
        geom = np.array([-1], np.int32)
        distance = mujoco.mj_ray(bare, data, start, aim, seen, 1, -1, geom)
        with np.errstate(divide="ignore"):
            expected = np.min(np.where(aim > 0, (high - start) / aim, (low - start) / aim))
        assert geom[0] in sides
        assert distance == pytest.approx(expected, abs=1e-6)
        met.add(int(geom[0]))
    assert met == sides


@pytest.mark.parametrize("name", ROOMS)
def test_everything_stays_in_the_room(name: str, models):
    model, (low, high) = models[name], (np.array(ROOMS[name].LOW), np.array(ROOMS[name].HIGH))
    meshes = [geom for geom in _drawn(model) if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH]
    for data in ROOMS[name].states(model, 5, DURATION):
        assert (data.camera("front").xpos > low).all() and (data.camera("front").xpos < high).all()
        for geom in meshes:
            vertices = _world_vertices(model, data, geom)
            # Contacts give way by less than this, metres.
            assert (vertices > low - 2e-3).all() and (vertices < high + 2e-3).all()


@pytest.mark.parametrize("name", ROOMS)
def test_light_hangs_under_the_ceiling(name: str):
    (light,) = ROOMS[name].lights()
    corners = light.mesh.vertices @ light.rotation.T + light.position
    assert light.rotation[:, 2] == pytest.approx([0, 0, -1])
    assert np.ptp(corners, axis=0) == pytest.approx([ROOMS[name].LIGHT_SIDE, ROOMS[name].LIGHT_SIDE, 0], abs=1e-6)
    assert (corners[:, :2] > ROOMS[name].LOW[:2]).all() and (corners[:, :2] < ROOMS[name].HIGH[:2]).all()
    assert 0 < ROOMS[name].HIGH[2] - corners[:, 2].max() < 0.05


def test_room_has_one_glossy_statue_that_turns(models, runs):
    model, (_, data) = models["room"], runs["room"]
    glossy = [model.geom(geom).id for geom in _drawn(model) if model.mat_specular[model.geom_matid[geom]] > 0]
    (statue,) = model.body("statue").geomadr
    assert glossy == [statue]
    turned = 2 * np.arccos(abs(data.mocap_quat[0, 0]))
    assert turned == pytest.approx(room.STATUE_SPEED * data.time, abs=1e-6)


def test_ball_bounces_through_the_room(models):
    model = models["room"]
    path, rug = [], model.geom("rug")
    low, high = rug.pos - rug.size, rug.pos + rug.size
    for data in room.states(model, FRAMES_PER_SECOND, DURATION):
        position = data.body("ball").xpos.copy()
        path.append(position)
        nearest = np.clip(position, low, high)
        assert np.linalg.norm(position - nearest) > room.BALL_RADIUS - 1e-3
    path = np.array(path)
    # It rises again after it fell, and crosses most of the room.
    rises = np.diff(np.sign(np.diff(path[:, 2])))
    assert (rises > 0).sum() >= 2
    assert np.ptp(path[:, 0]) > 2.5
    assert path[-1, 2] == pytest.approx(room.BALL_RADIUS, abs=2e-3)


def test_teapots_share_a_mesh_and_four_are_glossy(models):
    model = models["teapots"]
    assert model.nmesh == 1
    geoms = [geom for geom in _drawn(model) if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH]
    gloss = model.mat_specular[model.geom_matid[geoms]]
    assert len(geoms) == 30 and (gloss > 0).sum() == 4
    assert len(np.unique(model.geom_matid[geoms])) == 1 + len(teapots.COLORS)


def test_teapots_move_without_touching(models):
    model = models["teapots"]
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    upright = _world_vertices(model, data, _drawn(model)[-1]) - data.mocap_pos[-1]
    reach = np.hypot(upright[:, 0], upright[:, 1]).max()
    places, turns = [], []
    for data in teapots.states(model, 10, 2 * math.pi / min(abs(speed) for _, _, speed, _ in teapots.RINGS)):
        places.append(data.mocap_pos[:, :2].copy())
        turns.append(data.mocap_quat.copy())
    places, turns = np.array(places), np.array(turns)
    assert np.abs(turns[..., 1:3]).max() == 0.0
    assert np.abs(np.einsum("tpi,tpi->tp", turns[:-1], turns[1:])).max() < 1.0
    assert np.linalg.norm(np.diff(places, axis=0), axis=2).min() > 0.005
    # No two of the upright cylinders that the teapots turn in meet, in a whole turn of the slowest ring.
    pairs = np.triu_indices(places.shape[1], 1)
    distance = np.linalg.norm(places[:, pairs[0]] - places[:, pairs[1]], axis=2)
    assert distance.min() > 2 * reach + 0.01
