"""Primitives against closed forms: areas, volumes, normals."""

import warnings

import numpy as np
import pytest

from tests.mesh_measures import PRIMITIVES, area, area_vectors, has_closed_edges, volume
from warp_psf.scene.primitives import SEGMENTS, box, capsule, cylinder, ellipsoid, plane, sphere


@pytest.fixture(autouse=True)
def no_unexpected_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


@pytest.mark.parametrize("mesh", PRIMITIVES, ids=lambda mesh: mesh.name)
def test_primitive_is_sound(mesh):
    assert (mesh.vertices.dtype, mesh.faces.dtype, mesh.normals.dtype) == (np.float32, np.int32, np.float32)
    assert 1000 <= len(mesh.vertices) <= 4500
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-6)
    # Every corner's normal is on the outside of its face.
    assert ((mesh.normals[mesh.faces] * area_vectors(mesh)[:, None]).sum(axis=2) > 0.0).all()
    assert not any(array.flags.writeable for array in (mesh.vertices, mesh.faces, mesh.normals, mesh.center))
    assert (mesh.closed, mesh.convex) == ((False, False) if mesh.name == "plane" else (True, True))
    assert has_closed_edges(mesh) == mesh.closed


def test_areas_and_volumes():
    flat, block, ball, egg, pill, can = PRIMITIVES
    turn = 2.0 * np.pi / SEGMENTS
    assert area(flat) == pytest.approx(24.0)
    assert area(block) == pytest.approx(8.0 * (0.02 + 0.06 + 0.03))
    assert volume(block) == pytest.approx(8.0 * 0.006)
    assert area(ball) == pytest.approx(4.0 * np.pi * 0.09, rel=3e-3)
    assert volume(ball) == pytest.approx(4.0 / 3.0 * np.pi * 0.027, rel=3e-3)
    assert volume(egg) == pytest.approx(4.0 / 3.0 * np.pi * 0.008, rel=3e-3)
    assert volume(pill) == pytest.approx(np.pi * (0.01 * 0.8 + 4.0 / 3.0 * 0.001), rel=5e-3)
    # A cylinder is exactly its polygon's prism.
    polygon = 0.5 * SEGMENTS * np.sin(turn) * 0.01
    assert volume(can) == pytest.approx(polygon * 0.8, rel=1e-6)
    assert area(can) == pytest.approx(2.0 * polygon + SEGMENTS * 0.2 * np.sin(turn / 2.0) * 0.8, rel=1e-6)


def test_normals_are_analytic():
    flat, block, ball, egg, pill, can = PRIMITIVES
    np.testing.assert_array_equal(flat.normals, np.broadcast_to([0.0, 0.0, 1.0], flat.normals.shape))
    side = np.abs(block.normals).argmax(axis=1)
    rows = np.arange(len(side))
    np.testing.assert_array_equal(block.normals[rows, side], np.sign(block.vertices[rows, side]))
    np.testing.assert_allclose(ball.normals, ball.vertices / 0.3, atol=1e-6)
    gradient = egg.vertices / np.square([0.1, 0.2, 0.4])
    np.testing.assert_allclose(egg.normals, gradient / np.linalg.norm(gradient, axis=1, keepdims=True), atol=1e-5)
    from_core = pill.vertices - np.clip(pill.vertices, [0, 0, -0.4], [0, 0, 0.4])
    np.testing.assert_allclose(pill.normals, from_core / 0.1, atol=1e-5)
    on_side = np.abs(can.normals[:, 2]) < 0.5
    np.testing.assert_allclose(can.normals[on_side], can.vertices[on_side] * [10, 10, 0], atol=1e-5)
    np.testing.assert_allclose(can.normals[~on_side][:, 2], can.vertices[~on_side][:, 2] / 0.4, atol=1e-5)


@pytest.mark.parametrize(
    "build",
    [
        lambda: plane(0.0, 1.0),
        lambda: plane(1.0, 1.0, cells=0),
        lambda: box((1.0, -1.0, 1.0)),
        lambda: box((1.0, 1.0)),
        lambda: sphere(np.nan),
        lambda: sphere(1.0, subdivisions=-1),
        lambda: ellipsoid((1.0, 0.0, 1.0)),
        lambda: capsule(-1.0, 1.0),
        lambda: cylinder(1.0, 0.0),
    ],
)
def test_primitives_refuse_sizes(build):
    with pytest.raises(ValueError, match=r"plane|box|sphere|ellipsoid|capsule|cylinder"):
        build()
