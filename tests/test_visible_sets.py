"""Potentially visible sets: what the vertices of a body see of it in a recorded motion, and nothing else."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

import warp_psf as psf
from sims import figure
from tests.oracles_hemisphere import vertex_normals
from tests.test_hemisphere import far, masks_of, start
from warp_psf.bake.coarse import make_blockers
from warp_psf.bake.visible_sets import find_visible_sets
from warp_psf.field.blockers import BlockerSet
from warp_psf.scene import primitives
from warp_psf.scene.deforming import Deformed

OFFSET = 1e-3


def state_of(vertices: np.ndarray, faces: np.ndarray) -> Deformed:
    places = np.asarray(vertices, np.float32)
    return Deformed(places, vertex_normals(vertices, faces).astype(np.float32), places)


def learn(blockers: BlockerSet, states: list[Deformed]) -> BlockerSet:
    itself = np.arange(len(states[0].vertices), dtype=np.int32)
    return find_visible_sets("body", blockers, itself, states, OFFSET)


def list_of(sets: BlockerSet, vertex: int) -> list[int]:
    return sorted(sets.near[sets.first_near[vertex] : sets.first_near[vertex + 1]].tolist())


def masks_in(blockers: BlockerSet, state: Deformed) -> np.ndarray:
    itself = np.arange(len(state.vertices), dtype=np.int32)
    # A radius that gives the offset of the recording.
    return masks_of(start(blockers, state.vertices, state.normals, state.blocker_vertices, 1.0, itself))


def bent(angle: float) -> tuple[np.ndarray, np.ndarray]:
    """A sheet of 2 x 1 m whose right half is lifted by an angle about the y axis, and its faces."""
    x, y = np.meshgrid(np.linspace(-1, 1, 21), np.linspace(0, 1, 11), indexing="ij")
    corner = np.arange(231).reshape(21, 11)
    quads = np.stack([corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]], axis=-1).reshape(-1, 4)
    lifted = np.maximum(x, 0.0)
    places = np.stack([np.minimum(x, 0.0) + lifted * np.cos(angle), y, lifted * np.sin(angle)], axis=-1)
    return places.reshape(-1, 3), np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]])


def test_a_convex_body_sees_nothing_of_itself():
    mesh = primitives.ellipsoid(np.array([0.3, 0.2, 0.1]))
    blockers = make_blockers("ellipsoid", mesh.vertices, mesh.faces)
    sets = learn(blockers, [state_of(mesh.vertices, mesh.faces)])
    assert len(sets.near) == 0 and len(sets.first_of_cluster) == 1 and len(sets.skip) == 0


def walls(places: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """A square on the floor about the origin, and upright ones behind one another at x = places: two faces each."""
    square = np.array([[-0.1, -0.1, 0], [0.1, -0.1, 0], [0.1, 0.1, 0], [-0.1, 0.1, 0]])
    upright = np.array([[0, -1, 0.05], [0, 1, 0.05], [0, 1, 2], [0, -1, 2.0]])
    corners = [square, *(upright * (1, 0.5 + x, 0.5 + x) + (x, 0, 0) for x in places)]
    faces = [np.array([[0, 1, 2], [0, 2, 3]]) + 4 * index for index in range(len(corners))]
    return np.concatenate(corners), np.concatenate(faces)


def test_a_wall_hides_the_smaller_one_behind_it():
    for order in ((1.0, 1.5), (1.5, 1.0)):
        vertices, faces = walls(order)
        # The one behind, as seen from the floor, lies within the one before it.
        behind = 1 + order.index(1.5)
        rows = slice(4 * behind, 4 * behind + 4)
        vertices[rows, 1:] = (vertices[rows, 1:] - (0, 1.0)) * 0.2 + (0, 1.0)
        sets = learn(far(faces, len(vertices), True), [state_of(vertices, faces)])
        for vertex in range(4):
            front = 1 + order.index(1.0)
            assert list_of(sets, vertex) == [2 * front, 2 * front + 1]


def test_sets_of_a_motion_are_those_of_its_states_together():
    angles = (0.4, 1.2, 2.0)
    faces = bent(0.0)[1]
    states = [state_of(bent(angle)[0], faces) for angle in angles]
    blockers = make_blockers("sheet", bent(0.0)[0], faces, coarse=60)
    together, backwards = learn(blockers, states), learn(blockers, states[::-1])
    alone = [learn(blockers, [state]) for state in states]
    np.testing.assert_array_equal(together.near, backwards.near)
    for vertex in range(231):
        expected = set().union(*(list_of(sets, vertex) for sets in alone))
        assert list_of(together, vertex) == sorted(expected)


@pytest.mark.parametrize("name", ["sheet", "figure"])
def test_masks_of_recorded_states_stay_the_same(name):
    if name == "sheet":
        vertices, faces = bent(1.4)
        blockers = make_blockers(name, bent(0.0)[0], faces, coarse=60)
    else:
        vertices, faces = figure.skin()
        blockers = make_blockers(name, vertices, faces)
    states = [state_of(vertices, faces), state_of(vertices * (1.0, 1.0, 0.7), faces)]
    sets = learn(blockers, states)
    looked_at = np.diff(blockers.first_near) + blockers.first_of_cluster[-1] - np.diff(blockers.first_skip)
    assert np.diff(sets.first_near).mean() < 0.4 * looked_at.mean()
    for state in states:
        expected = masks_in(blockers, state)
        np.testing.assert_array_equal(masks_in(sets, state), expected)
        assert expected.any()


def test_both_sides_of_a_sheet_share_a_list():
    vertices, faces = bent(1.2)
    one = state_of(vertices, faces)
    both = Deformed(np.tile(one.vertices, (2, 1)), np.concatenate([one.normals, -one.normals]), one.blocker_vertices)
    blockers = make_blockers("sheet", bent(0.0)[0], faces, coarse=60)
    twice = np.tile(np.arange(231, dtype=np.int32), 2)
    found = find_visible_sets("sheet", blockers, twice, [both], OFFSET)
    back = replace(one, normals=-one.normals)
    sides = [learn(blockers, [state]) for state in (one, back)]
    for vertex in range(231):
        assert list_of(found, vertex) == sorted(set(list_of(sides[0], vertex)) | set(list_of(sides[1], vertex)))


def test_motions_that_do_not_fit_are_refused():
    vertices, faces = bent(1.0)
    blockers = make_blockers("sheet", vertices, faces)
    with pytest.raises(ValueError, match="'body' has no states"):
        find_visible_sets("body", blockers, np.arange(231, dtype=np.int32), [], OFFSET)
    state = state_of(vertices, faces)
    with pytest.raises(ValueError, match="state 1 of 'body' has 230 vertices and 231 that block; the body has 231"):
        learn(blockers, [state, replace(state, vertices=state.vertices[1:], normals=state.normals[1:])])


def test_a_renderer_learns_a_motion():
    model = figure.build()
    pictures, counts = [], []
    with psf.Renderer(model, 45, 80, bounces=0) as renderer:
        data = next(figure.states(model, 30, 1.0))
        for learned in (False, True, True):
            if learned:
                renderer.learn_motion(figure.states(model, 6, 1.0))
            renderer.update_scene(data, "front")
            pictures.append(renderer.layers()["direct"])
            (state,) = renderer._stage.hemispheres.states.values()
            counts.append(len(state.table.near) + len(state.blockers.first_of_cluster))
        assert counts[0] > counts[1] == counts[2]  # learning again starts from all triangles
        # The state is one of those that were recorded.
        np.testing.assert_array_equal(pictures[1], pictures[0])
        np.testing.assert_array_equal(pictures[2], pictures[0])
        with pytest.raises(ValueError, match="no states"):
            renderer.learn_motion([])
        with pytest.raises(ValueError):
            renderer.learn_motion([mujoco.MjData(mujoco.MjModel.from_xml_string("<mujoco/>"))])
