"""What a mesh is found to be: its smallest sphere, slab, sphere, convex or not."""

import warnings

import numpy as np
import pytest

from tests.mesh_measures import CUBE_FACES, PRIMITIVES, moved, rotation, triangles
from warp_psf.scene.fit import bounding_sphere
from warp_psf.scene.mesh import make_mesh
from warp_psf.scene.primitives import box, cylinder, ellipsoid, plane, sphere


@pytest.fixture(autouse=True)
def no_unexpected_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


# Bounding spheres


@pytest.mark.parametrize(
    ("mesh", "radius"),
    list(zip(PRIMITIVES, [np.hypot(2, 3), np.sqrt(0.14), 0.3, 0.4, 0.5, np.hypot(0.1, 0.4)], strict=True)),
    ids=lambda value: getattr(value, "name", ""),
)
def test_bounding_sphere_of_primitives(mesh, radius):
    shifted = moved(mesh) if mesh.name != "plane" else mesh
    center = np.zeros(3) if mesh.name == "plane" else np.array([0.3, -0.2, 0.7])
    assert shifted.radius == pytest.approx(radius, rel=1e-6)
    np.testing.assert_allclose(shifted.center, center, atol=2e-4 * radius)


def test_bounding_sphere_is_the_smallest():
    # A regular triangle and a regular tetrahedron hold their circumspheres, an obtuse triangle its longest side's.
    corners = np.array([[np.cos(a), np.sin(a), 0.0] for a in (0.0, 2.0, 4.0)])
    assert bounding_sphere(corners)[1] == pytest.approx(1.0)
    tetrahedron = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=float)
    center, radius = bounding_sphere(np.vstack([tetrahedron, 0.2 * tetrahedron]) + 5.0)
    np.testing.assert_allclose(center, 5.0)
    assert radius == pytest.approx(np.sqrt(3.0))
    assert bounding_sphere(np.array([[0, 0, 0], [4, 0, 0], [1, 0.5, 0]], dtype=float))[1] == pytest.approx(2.0)
    # No centre nearby does better for a cloud.
    generator = np.random.default_rng(0)
    cloud = generator.normal(size=(500, 3))
    center, radius = bounding_sphere(cloud)
    others = center + 0.02 * generator.normal(size=(200, 3))
    assert np.linalg.norm(cloud[None] - others[:, None], axis=2).max(axis=1).min() >= radius


# Closed forms


@pytest.mark.parametrize("half", [(0.5, 1.0, 2.0), (5.0, 5.0, 0.001), (1.0, 1.0, 1.0)])
def test_rotated_box_is_a_slab(half):
    mesh = moved(box(half))
    center, axes, extents = mesh.slab
    np.testing.assert_allclose(center, [0.3, -0.2, 0.7], atol=1e-5)
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-9)
    assert np.linalg.det(axes) == pytest.approx(1.0)
    np.testing.assert_allclose(np.sort(extents), np.sort(half), atol=1e-5)
    # The axes are the box's: its corners come back.
    local = (mesh.vertices - center) @ axes
    np.testing.assert_allclose(np.abs(local).max(axis=0), extents, atol=1e-5)
    assert extents[2] == pytest.approx(min(half), abs=1e-5)


def test_float32_rounding_hides_no_closed_form():
    # A needle far from its origin has coordinates that are a thousandth of its width apart.
    needle = make_mesh(
        "needle", box((2.0, 0.002, 0.004)).vertices @ rotation().T + [9.0, 5.0, 7.0], box((1, 1, 1)).faces
    )
    assert needle.slab is not None and needle.convex
    np.testing.assert_allclose(np.sort(needle.slab[2]), [0.002, 0.004, 2.0], atol=3e-6)


def test_rectangle_is_a_slab():
    mesh = moved(plane(2.0, 0.5, cells=9))
    center, axes, extents = mesh.slab
    np.testing.assert_allclose(center, [0.3, -0.2, 0.7], atol=1e-6)
    np.testing.assert_allclose(axes[:, 2], rotation()[:, 2], atol=1e-6)
    np.testing.assert_allclose(sorted(extents), [0.0, 0.5, 2.0], atol=1e-6)
    assert extents[2] == 0.0
    assert not mesh.closed


def test_coarse_thin_sides_do_not_hide_a_slab():
    # Gridded tops over sides of two triangles each do not share edges, and still are a box.
    top = plane(3.0, 2.0, cells=40)
    count = len(top.vertices)
    corners = np.array([[x, y, z] for x in (-3, 3) for y in (-2, 2) for z in (-0.01, 0.0)])
    sides = CUBE_FACES[:8] + 2 * count
    vertices = np.vstack([top.vertices, top.vertices - np.array([0.0, 0.0, 0.01]), corners])
    mesh = make_mesh("plate", vertices @ rotation().T, [*top.faces, *(top.faces[:, ::-1] + count), *sides])
    assert mesh.slab is not None
    np.testing.assert_allclose(np.sort(mesh.slab[2]), [0.005, 2.0, 3.0], atol=1e-6)


def dented_box():
    mesh = box((1.0, 1.0, 1.0))
    vertices = mesh.vertices.copy()
    vertices[np.argmin(np.linalg.norm(vertices - [0, 0, 1], axis=1))] -= [0, 0, 0.05]
    return vertices, mesh.faces


def notched_floor():
    mesh = plane(1.0, 1.0, cells=8)
    return mesh.vertices, mesh.faces[~(triangles(mesh)[:, :, :2] >= 0.0).all(axis=(1, 2))]


def disc():
    mesh = cylinder(1.0, 1.0)
    return mesh.vertices, mesh.faces[(triangles(mesh)[:, :, 2] > 0.99).all(axis=1)]


def open_box():
    mesh = box((1.0, 1.0, 1.0))
    return mesh.vertices, mesh.faces[~(triangles(mesh)[:, :, 2] > 0.99).all(axis=1)]


def box_with_doubled_bottom():
    vertices, faces = open_box()
    bottom = faces[(vertices[faces][:, :, 2] < -0.99).all(axis=1)]
    return vertices, np.vstack([faces, bottom[:, ::-1]])


@pytest.mark.parametrize("shape", [dented_box, notched_floor, disc, open_box, box_with_doubled_bottom])
def test_no_slab(shape):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert make_mesh("no slab", *shape()).slab is None
    assert all(mesh.slab is None for mesh in PRIMITIVES[2:])


def test_sphere_is_found_by_its_geometry():
    ball = sphere(0.3)
    assert ball.sphere == pytest.approx(0.3)
    assert make_mesh("turned", ball.vertices @ rotation().T, ball.faces).sphere == pytest.approx(0.3)
    assert ellipsoid((0.2, 0.2, 0.2)).sphere == pytest.approx(0.2)
    assert sphere(1.0, subdivisions=1).sphere == pytest.approx(1.0)
    assert sphere(1.0, subdivisions=0).sphere is None
    assert moved(ball).sphere is None
    assert ellipsoid((0.2, 0.2, 0.201)).sphere is None
    assert all(mesh.sphere is None for mesh in (*PRIMITIVES[:2], *PRIMITIVES[3:]))


def test_ball_with_a_flat_cap_is_no_sphere():
    # Every vertex is on the sphere; the cap is a fan between vertices of its rim.
    ball = sphere(1.0)
    hull = ball.faces[(triangles(ball)[:, :, 2] < 0.8).all(axis=1)]
    ends = np.stack([hull, np.roll(hull, -1, axis=1)], axis=2).reshape(-1, 2)
    edges = set(map(tuple, ends.tolist()))
    rim = {b: a for a, b in edges if (b, a) not in edges}
    loop = [next(iter(rim))]
    while rim[loop[-1]] != loop[0]:
        loop.append(rim[loop[-1]])
    fan = [[loop[0], loop[i], loop[i + 1]] for i in range(1, len(loop) - 1)]
    mesh = make_mesh("dome", ball.vertices, np.vstack([hull, fan]))
    assert mesh.closed
    assert mesh.sphere is None


def test_convexity():
    ball = sphere(1.0)
    assert make_mesh("one", ball.vertices, ball.faces).convex
    two = make_mesh(
        "two",
        np.vstack([ball.vertices, ball.vertices + np.array([3.0, 0.0, 0.0])]),
        np.vstack([ball.faces, ball.faces + 2562]),
    )
    assert two.closed and not two.convex
    dent = make_mesh("dent", *dented_box())
    assert dent.closed and not dent.convex
