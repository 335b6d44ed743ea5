"""Silhouette fields: distances to what a body covers, against closed forms and rays."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import warp as wp

import warp_psf as psf
from sims.bodies import teapot_like
from warp_psf.bake.body import upload_mesh
from warp_psf.bake.silhouettes import bake_silhouettes, map_rays
from warp_psf.device import find_device, launch
from warp_psf.field.silhouettes import (
    LARGEST_DISTANCE,
    SilhouetteTables,
    find_silhouette,
    map_frames,
    own_distance,
    own_frame,
    silhouette_distance,
    upload_silhouettes,
)
from warp_psf.scene import primitives


@wp.kernel(enable_backward=False, module="unique")
def _look(
    first: int,
    tables: SilhouetteTables,
    points: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    distance_out: wp.array(dtype=wp.float32),
):
    _world, item = wp.tid()
    item += first
    seen = find_silhouette(tables, 0, points[item])
    distance_out[item] = silhouette_distance(tables, seen, directions[item])


@wp.kernel(enable_backward=False, module="unique")
def _look_at_self(
    first: int,
    tables: SilhouetteTables,
    vertex: int,
    normal: wp.vec3,
    directions: wp.array(dtype=wp.vec3),
    distance_out: wp.array(dtype=wp.float32),
):
    _world, item = wp.tid()
    item += first
    distance_out[item] = own_distance(tables, vertex, own_frame(normal) * directions[item])


@wp.kernel(enable_backward=False, module="unique")
def _cast(
    first: int,
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    hit_out: wp.array(dtype=wp.bool),
):
    _world, item = wp.tid()
    item += first
    hit_out[item] = wp.mesh_query_ray_anyhit(mesh, points[item], directions[item], 1.0e3)


def casts(mesh, points, directions):
    """Whether the ray from each point in its direction meets the mesh."""
    device = find_device("cpu")
    vectors = [wp.array(np.asarray(each, np.float32), dtype=wp.vec3, device=device) for each in (points, directions)]
    out = wp.zeros(len(points), dtype=wp.bool, device=device)
    warp_mesh = upload_mesh(mesh, device)
    launch(_cast, (1, len(points)), [warp_mesh.id, *vectors], [out], device)
    return out.numpy()


def look(field, points, directions):
    device = find_device("cpu")
    vectors = [wp.array(np.asarray(each, np.float32), dtype=wp.vec3, device=device) for each in (points, directions)]
    out = wp.zeros(len(points), dtype=wp.float32, device=device)
    launch(_look, (1, len(points)), [upload_silhouettes([field], device), *vectors], [out], device)
    return out.numpy()


def views(mesh, radii, count, seed=3):
    """Points at so many bounding radii from a mesh, and directions within its bounding sphere's disc."""
    random = np.random.default_rng(seed)
    outward = random.normal(size=(count, 3))
    outward /= np.linalg.norm(outward, axis=1)[:, None]
    cosine = 1 - random.uniform(size=count) * (1 - np.sqrt(1 - 1 / radii**2))
    turn = 2 * np.pi * random.uniform(size=count)
    level = np.sqrt(1 - cosine**2)
    local = np.stack([level * np.cos(turn), level * np.sin(turn), cosine], axis=-1)
    return mesh.center + radii * mesh.radius * outward, np.einsum("nij,ni->nj", map_frames(outward), local)


@pytest.fixture(scope="module")
def pot():
    mesh = psf.make_mesh("pot", *teapot_like(rings=14, segments=22))
    return mesh, bake_silhouettes(mesh, use_cache=False)


@pytest.fixture(scope="module")
def ball():
    mesh = replace(primitives.sphere(0.7), sphere=None)
    return mesh, bake_silhouettes(mesh, use_cache=False)


@pytest.mark.parametrize("radii", [1.1, 1.5, 3.0, 6.0])
def test_a_ball_s_rim(ball, radii):
    mesh, field = ball
    points, directions = views(mesh, radii, 2000)
    toward = mesh.center - points
    distance = np.linalg.norm(toward, axis=1)
    angle = np.arccos(np.clip((toward * directions).sum(axis=1) / distance, -1, 1))
    expected = np.arcsin(1 / radii) - angle
    # Distances are cut off at a share of the map, and are exact to about a cell's quarter where they are not; they are
    # lengths on the map, which within a disc of 65 degrees are up to a fifth off angles.
    near = np.abs(expected) < 0.5 * LARGEST_DISTANCE / radii
    error = field.distances(points, directions)[near] - expected[near]
    assert np.sqrt((error**2).mean()) < 0.02 / radii
    assert (np.sign(field.distances(points, directions))[~near] == np.sign(expected[~near])).all()


def test_the_device_looks_up_what_the_host_does(pot):
    mesh, field = pot
    for radii in (1.02, 1.3, 2.7, 9.0):
        points, directions = views(mesh, radii, 500)
        # The host is float64; float32 loses digits where the map is small.
        np.testing.assert_allclose(look(field, points, directions), field.distances(points, directions), atol=2e-5)
    inside = mesh.center + 0.8 * mesh.radius * map_frames(points - mesh.center)[:, 0]
    np.testing.assert_allclose(look(field, inside, directions), field.distances(inside, directions), atol=2e-4)


@pytest.mark.parametrize(("radii", "degrees"), [(1.3, 1.2), (2.0, 0.7), (4.0, 0.4)])
def test_edges_are_where_rays_find_them(pot, radii, degrees):
    mesh, field = pot
    points, directions = views(mesh, radii, 40000)
    found = np.degrees(look(field, points, directions))
    hit = casts(mesh, points, directions)
    # What is told wrong, over the length of the edges: how far they are off on average. A cell of the map is 1.5, 0.8
    # and 0.4 degrees wide.
    wrong = ((found > 0) != hit).mean()
    length = (np.abs(found) < 0.5).mean()
    assert wrong / length < degrees


def test_what_is_beside_the_bounding_sphere_is_clear(pot):
    mesh, field = pot
    points, _ = views(mesh, 2.0, 300)
    away = (points - mesh.center) / np.linalg.norm(points - mesh.center, axis=1)[:, None]
    assert (field.distances(points, away) < 0).all()


def test_a_wall_hides_half_of_the_sky_from_a_vertex_beside_it():
    floor = primitives.box((0.5, 0.5, 0.1), cells=4)
    wall = primitives.box((0.1, 0.5, 0.6), cells=4)
    moved = wall.vertices + np.array((-0.4, 0.0, 0.6), np.float32)
    vertices, faces = (
        np.concatenate([floor.vertices, moved]),
        np.concatenate([floor.faces, wall.faces + len(floor.vertices)]),
    )
    mesh = psf.make_mesh("corner", vertices, faces)
    field = bake_silhouettes(mesh, use_cache=False)
    assert field.own is not None
    assert field.own.shape == (len(mesh.vertices), 256)
    # A vertex of the floor's top, 0.25 from the wall, which rises 1.1 above it: up to 77 degrees.
    on_top = (mesh.normals[:, 2] > 0.99) & (np.abs(mesh.vertices - (-0.05, 0.0, 0.1)) < 0.06).all(axis=1)
    (vertex,) = np.flatnonzero(on_top)[:1]
    x = mesh.vertices[vertex][0]
    height = np.radians(np.linspace(5, 85, 60))
    toward = np.stack([-np.cos(height), np.zeros(60), np.sin(height)], axis=-1)
    device = find_device("cpu")
    out = wp.zeros(60, dtype=wp.float32, device=device)
    inputs = [upload_silhouettes([field], device), int(vertex), wp.vec3(*map(float, mesh.normals[vertex]))]
    launch(
        _look_at_self,
        (1, 60),
        [*inputs, wp.array(toward.astype(np.float32), dtype=wp.vec3, device=device)],
        [out],
        device,
    )
    edge = np.arctan2(1.1, x + 0.3)
    hidden = out.numpy() > 0
    assert hidden[np.degrees(height) < np.degrees(edge) - 4].all()
    assert not hidden[np.degrees(height) > np.degrees(edge) + 4].any()


def test_convex_bodies_hide_nothing_from_themselves(ball):
    assert ball[1].own is None


def test_a_map_s_rays_cover_its_cone_evenly():
    for spread in (1.0, 0.5):
        rays = map_rays(spread)
        rays = rays[np.linalg.norm(rays, axis=1) > 0]
        np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1, rtol=1e-6)
        if spread == 1.0:
            # Evenly over the sphere: no mean direction, and a third of the squares along each axis.
            # The last ring of cells is cut by the rim: a hundredth of them.
            np.testing.assert_allclose(rays.mean(axis=0), 0, atol=1e-2)
            np.testing.assert_allclose((rays**2).mean(axis=0), 1 / 3, atol=1e-2)


def test_a_field_of_a_scaled_and_moved_body_is_its_own_scaled_and_moved(pot):
    mesh, field = pot
    larger = psf.make_mesh("larger", 3 * mesh.vertices + (1, 2, 3), mesh.faces)
    other = bake_silhouettes(larger, use_cache=False)
    np.testing.assert_allclose(other.center, 3 * field.center + (1, 2, 3), rtol=1e-5)
    points, directions = views(mesh, 2.0, 200)
    # The vertices are rounded anew: a ray in a thousand meets an edge.
    found = other.distances(3 * points + (1, 2, 3), directions)
    assert np.abs(found - field.distances(points, directions)).mean() < 1e-3


def test_fields_are_kept_and_damaged_ones_are_baked_again(tmp_path, monkeypatch):
    monkeypatch.setenv("WARP_PSF_CACHE", str(tmp_path))
    vertices = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1.0)])
    mesh = psf.make_mesh("tetrahedron", vertices, np.array([(0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3)]))
    baked = bake_silhouettes(mesh)
    (path,) = tmp_path.glob("*.field")
    before = path.stat().st_mtime_ns
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        again = bake_silhouettes(mesh)
    assert path.stat().st_mtime_ns == before
    for name in ("codes", "modes", "minimum", "step", "rows", "columns"):
        np.testing.assert_array_equal(getattr(baked, name), getattr(again, name))
    assert again.nbytes == baked.nbytes
    content = bytearray(path.read_bytes())
    content[-100] ^= 1
    path.write_bytes(content)
    with pytest.warns(UserWarning, match="damaged"):
        bake_silhouettes(mesh)
