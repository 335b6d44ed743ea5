"""Meshes: creases, repairs, bad input, tessellation, and files written by trimesh."""

import warnings

import numpy as np
import pytest
import trimesh

from tests.mesh_measures import (
    CUBE_FACES,
    CUBE_VERTICES,
    PRIMITIVES,
    area,
    area_vectors,
    has_closed_edges,
    moved,
    triangles,
    volume,
)
from warp_psf.scene.mesh import cut_faces, load_mesh, make_mesh, tessellate
from warp_psf.scene.primitives import box, sphere


@pytest.fixture(autouse=True)
def no_unexpected_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


# Normals and creases


def test_cube_is_split_and_sphere_is_smooth():
    cube = make_mesh("cube", CUBE_VERTICES, CUBE_FACES)
    assert len(cube.vertices) == 24
    assert set(map(tuple, np.round(cube.normals).astype(int))) == {
        tuple(sign * np.eye(3, dtype=int)[axis]) for axis in range(3) for sign in (-1, 1)
    }
    np.testing.assert_allclose(np.abs(cube.normals).max(axis=1), 1.0, atol=1e-6)
    # With a wide angle it is smooth, and the weights by angle make its corners symmetric.
    smooth = make_mesh("cube", CUBE_VERTICES, CUBE_FACES, smooth_angle=np.pi)
    assert len(smooth.vertices) == 8
    np.testing.assert_allclose(smooth.normals, smooth.vertices / np.sqrt(3.0), atol=1e-6)
    ball = PRIMITIVES[2]
    again = make_mesh("ball", ball.vertices, ball.faces)
    assert len(again.vertices) == len(ball.vertices)
    # Half the square of an edge, 0.07 radians, is what flat faces cost.
    np.testing.assert_allclose(again.normals, again.vertices / 0.3, atol=2.5e-3)


def test_cylinder_is_split_at_its_rims_only():
    can = PRIMITIVES[5]
    again = make_mesh("can", can.vertices, can.faces)
    assert len(again.vertices) == len(can.vertices)
    order, expected = (np.lexsort(np.round(np.hstack([m.vertices, m.normals]), 3).T) for m in (again, can))
    np.testing.assert_allclose(again.normals[order], can.normals[expected], atol=1e-3)


def test_seams_make_no_creases():
    ball = PRIMITIVES[2]
    loose = make_mesh("loose", ball.vertices[ball.faces].reshape(-1, 3), np.arange(ball.faces.size).reshape(-1, 3))
    assert (loose.closed, loose.convex, len(loose.vertices)) == (True, True, len(ball.vertices))
    # A seam that rounding has opened: cos(2 pi) and cos(0) of a lathe.
    jitter = loose.vertices[loose.faces].reshape(-1, 3) + np.random.default_rng(1).uniform(-3e-9, 3e-9, (5120 * 3, 3))
    assert make_mesh("seam", jitter, np.arange(5120 * 3).reshape(-1, 3)).closed


def test_given_normals_are_kept():
    normals = np.tile([0.0, 3.0, 4.0], (8, 1))
    mesh = make_mesh("cube", CUBE_VERTICES, CUBE_FACES, _outward(normals))
    assert len(mesh.vertices) == 8
    np.testing.assert_allclose(np.abs(mesh.normals), np.tile([0.0, 0.6, 0.8], (8, 1)), atol=1e-6)


def _outward(normals):
    return normals * np.where((CUBE_VERTICES * normals).sum(axis=1, keepdims=True) < 0.0, -1.0, 1.0)


# Repairs


def test_inverted_faces_are_turned():
    with pytest.warns(UserWarning, match=r"'cube': turned 12 of 12"):
        inverted = make_mesh("cube", CUBE_VERTICES, CUBE_FACES[:, ::-1])
    mixed = CUBE_FACES.copy()
    mixed[[1, 4, 5]] = mixed[[1, 4, 5], ::-1]
    with pytest.warns(UserWarning, match=r"'cube': turned 3 of 12"):
        repaired = make_mesh("cube", CUBE_VERTICES, mixed)
    for mesh in (inverted, repaired):
        assert volume(mesh) == pytest.approx(8.0)
        assert mesh.convex and mesh.slab is not None
    with pytest.warns(UserWarning, match="turned"):
        given = make_mesh("cube", CUBE_VERTICES, CUBE_FACES[:, ::-1], -CUBE_VERTICES)
    np.testing.assert_allclose(given.normals, given.vertices / np.sqrt(3.0), atol=1e-6)


def test_each_piece_looks_outwards_but_a_cavity():
    ball = sphere(1.0)
    inverted = ball.faces[:, ::-1] + len(ball.vertices)
    with pytest.warns(UserWarning, match="turned 5120 of 10240"):
        pieces = make_mesh(
            "pair", np.vstack([ball.vertices, ball.vertices + np.array([3.0, 0.0, 0.0])]), [*ball.faces, *inverted]
        )
    assert volume(pieces) == pytest.approx(2.0 * volume(ball), rel=1e-5)
    hollow = make_mesh("hollow", np.vstack([ball.vertices, 0.5 * ball.vertices]), [*ball.faces, *inverted])
    assert volume(hollow) == pytest.approx(0.875 * volume(ball), rel=1e-5)
    assert hollow.closed and not hollow.convex


def test_open_mesh_warns_and_works():
    with pytest.warns(UserWarning, match="'bowl' is open"):
        mesh = make_mesh("bowl", CUBE_VERTICES, CUBE_FACES[2:])
    assert not mesh.closed and not mesh.convex and mesh.slab is None
    assert area(mesh) == pytest.approx(20.0)
    with pytest.warns(UserWarning) as caught:
        mixed = CUBE_FACES[2:].copy()
        mixed[0] = mixed[0, ::-1]
        repaired = make_mesh("bowl", CUBE_VERTICES, mixed)
    assert ["turned 1 of 10" in str(caught[0].message), "is open" in str(caught[1].message)] == [True, True]
    np.testing.assert_allclose(area_vectors(repaired).sum(axis=0), area_vectors(mesh).sum(axis=0), atol=1e-6)


def test_empty_faces_are_dropped():
    faces = np.vstack([CUBE_FACES, [[0, 0, 1], [2, 3, 2]]])
    with pytest.warns(UserWarning, match="'cube': dropped 2 of 14 faces"):
        mesh = make_mesh("cube", CUBE_VERTICES, faces)
    assert mesh.closed and mesh.convex and len(mesh.faces) == 12
    # A collinear face along an edge: without area, yet it closes the surface.
    vertices = np.vstack([CUBE_VERTICES, 0.5 * (CUBE_VERTICES[0] + CUBE_VERTICES[3])])
    faces = np.vstack([CUBE_FACES[1:], [[0, 1, 8], [8, 1, 3], [0, 8, 3]]])
    with pytest.warns(UserWarning, match="dropped 1 of 14 faces"):
        mesh = make_mesh("cube", vertices, faces)
    assert mesh.closed and mesh.convex and mesh.slab is not None
    assert area(mesh) == pytest.approx(24.0)


def test_unused_vertices_are_left_out():
    mesh = make_mesh(
        "cube", np.vstack([CUBE_VERTICES, [[1e6, 0, 0]]]), CUBE_FACES, np.vstack([CUBE_VERTICES, [1, 0, 0]])
    )
    assert len(mesh.vertices) == 8
    assert mesh.radius == pytest.approx(np.sqrt(3.0))


def test_one_sided_surface_is_usable():
    angle = np.linspace(0.0, 2.0 * np.pi, 40, endpoint=False)
    out = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    across = 0.3 * (np.cos(angle / 2)[:, None] * out + np.sin(angle / 2)[:, None] * [0, 0, 1])
    a, b = np.arange(40), np.arange(40) + 40
    c, d = np.append(a[1:], 40), np.append(b[1:], 0)
    faces = np.vstack([np.stack([a, b, c], axis=1), np.stack([b, d, c], axis=1)])
    with pytest.warns(UserWarning, match="open"):
        mesh = make_mesh("moebius", np.vstack([out - across, out + across]), faces)
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-6)


# Bad input


def with_value(value):
    vertices = CUBE_VERTICES.astype(np.float64)
    vertices[3, 1] = value
    return vertices


@pytest.mark.parametrize(
    ("vertices", "faces", "normals", "message"),
    [
        (with_value(np.nan), CUBE_FACES, None, "1 of 8 vertices are not finite .* number 3"),
        (with_value(np.inf), CUBE_FACES, None, "not finite"),
        (with_value(1e300), CUBE_FACES, None, "not finite"),
        (CUBE_VERTICES[:, :2], CUBE_FACES, None, r"shape \[8, 2\]"),
        (CUBE_VERTICES.ravel(), CUBE_FACES, None, r"shape \[24\]"),
        (np.zeros((0, 3)), CUBE_FACES, None, r"shape \[0, 3\]"),
        ([], CUBE_FACES, None, r"shape \[0\]"),
        ([[0, 0, 0], [1, 0]], CUBE_FACES, None, "not real numbers"),
        (CUBE_VERTICES * 1j, CUBE_FACES, None, "not real numbers"),
        ([["a", "b", "c"]], CUBE_FACES, None, "not real numbers"),
        (CUBE_VERTICES, np.zeros((0, 3), dtype=int), None, "no faces"),
        (CUBE_VERTICES, [], None, "no faces"),
        (CUBE_VERTICES, CUBE_FACES.astype(float), None, r"faces are float64 \[12, 3\]"),
        (CUBE_VERTICES, CUBE_FACES.reshape(9, 4), None, r"int64 \[9, 4\]"),
        (CUBE_VERTICES, [[0, 1, 2], [0, 1, 2, 3]], None, "different lengths"),
        (CUBE_VERTICES, [[0, 1, 8]], None, "uses vertex 8; there are only vertices 0 to 7"),
        (CUBE_VERTICES, [[0, 1, -1]], None, "uses vertex -1"),
        (CUBE_VERTICES, [[0, 0, 1]], None, "none of its 1 faces has an area"),
        (np.ones((8, 3)), CUBE_FACES, None, "none of its 12 faces has an area"),
        (np.outer(np.arange(8), [1, 2, 3]), CUBE_FACES, None, "none of its 12 faces has an area"),
        (CUBE_VERTICES, CUBE_FACES, CUBE_VERTICES[:7], "7 normals for 8 vertices"),
        (CUBE_VERTICES, CUBE_FACES, 0 * CUBE_VERTICES, "normal 0 has no length"),
        (CUBE_VERTICES, CUBE_FACES, with_value(np.nan), "normals are not finite"),
    ],
)
def test_bad_arrays(vertices, faces, normals, message):
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*turned")
        with pytest.raises(ValueError, match=f"mesh 'wrong'.*{message}"):
            make_mesh("wrong", vertices, faces, normals)


def test_bad_smooth_angle():
    with pytest.raises(ValueError, match=r"mesh 'cube': smooth_angle is 40"):
        make_mesh("cube", CUBE_VERTICES, CUBE_FACES, smooth_angle=40.0)


# Tessellation


@pytest.mark.parametrize("mesh", [*PRIMITIVES, moved(box((1.0, 0.2, 0.1), cells=1))], ids=lambda mesh: mesh.name)
def test_tessellate(mesh):
    longest = mesh.radius / 15.0
    fine = tessellate(mesh, longest)
    corner = triangles(fine)
    assert np.linalg.norm(corner - np.roll(corner, -1, axis=1), axis=2).max() <= longest * (1.0 + 1e-6)
    assert area(fine) == pytest.approx(area(mesh), rel=1e-6)
    assert volume(fine) == pytest.approx(volume(mesh), rel=1e-5)
    assert has_closed_edges(fine) == mesh.closed
    np.testing.assert_allclose(np.linalg.norm(fine.normals, axis=1), 1.0, atol=1e-6)
    assert (fine.slab is mesh.slab, fine.closed, fine.convex) == (True, mesh.closed, mesh.convex)
    assert not fine.vertices.flags.writeable


@pytest.mark.parametrize("mesh", [*PRIMITIVES, moved(box((1.0, 0.2, 0.1), cells=1))], ids=lambda mesh: mesh.name)
def test_pieces_lie_in_the_faces_that_they_come_from(mesh):
    fine, origin = cut_faces(mesh, mesh.radius / 4.0)
    whole, piece = area_vectors(mesh), area_vectors(fine)
    total = np.stack([np.bincount(origin, piece[:, axis], minlength=len(whole)) for axis in range(3)], axis=1)
    # Pieces of one plane, on the same side: float32 rounding of their corners is all that differs.
    np.testing.assert_allclose(total, whole, atol=1e-6 * np.ptp(mesh.vertices) ** 2)
    corner = mesh.vertices[mesh.faces[origin]]
    low, high = corner.min(axis=1) - 1e-6 * mesh.radius, corner.max(axis=1) + 1e-6 * mesh.radius
    middle = triangles(fine).mean(axis=1)
    assert ((middle > low) & (middle < high)).all()


def test_tessellated_sphere_keeps_its_flag_while_it_is_one():
    ball = sphere(1.0)
    assert tessellate(ball, 0.1).sphere == ball.sphere
    fine = tessellate(sphere(1.0, subdivisions=2), 0.1)
    assert fine.sphere is None
    np.testing.assert_allclose(fine.normals, fine.vertices / np.linalg.norm(fine.vertices, axis=1)[:, None], atol=2e-3)


@pytest.mark.parametrize("longest", [0.0, -1.0, np.nan, np.inf, 1e-9])
def test_tessellate_refuses_lengths(longest):
    with pytest.raises(ValueError, match=r"mesh 'box': .*longest_edge"):
        tessellate(PRIMITIVES[1], longest)


# Files


@pytest.mark.parametrize("suffix", ["obj", "stl", "ply", "glb"])
@pytest.mark.parametrize("mesh", [PRIMITIVES[1], PRIMITIVES[4]], ids=lambda mesh: mesh.name)
def test_round_trip(tmp_path, suffix, mesh):
    path = tmp_path / f"thing.{suffix}"
    trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(path)
    loaded = load_mesh(path, scale=2.0)
    assert loaded.name == f"thing.{suffix}"
    assert (loaded.closed, loaded.convex) == (True, True)
    assert len(loaded.faces) == len(mesh.faces)
    assert volume(loaded) == pytest.approx(8.0 * volume(mesh), rel=1e-5)
    assert (loaded.slab is None) == (mesh.slab is None)
    np.testing.assert_allclose(loaded.center, 2.0 * mesh.center, atol=1e-5)


def test_scene_graph_is_flattened(tmp_path):
    ball = trimesh.Trimesh(PRIMITIVES[2].vertices, PRIMITIVES[2].faces, process=False)
    scene = trimesh.Scene()
    scene.add_geometry(ball, transform=np.diag([2.0, 2.0, 2.0, 1.0]))
    mirrored = np.diag([-1.0, 1.0, 1.0, 1.0])
    mirrored[:3, 3] = [4.0, 0.0, 0.0]
    scene.add_geometry(ball, transform=mirrored)
    scene.export(tmp_path / "two.glb")
    loaded = load_mesh(tmp_path / "two.glb")
    assert volume(loaded) == pytest.approx(9.0 * volume(PRIMITIVES[2]), rel=1e-5)
    np.testing.assert_allclose(loaded.vertices.max(axis=0), [4.3, 0.6, 0.6], atol=1e-5)


def test_quads_groups_and_seams_of_an_obj(tmp_path):
    quads = [[1, 2, 4, 3], [5, 7, 8, 6], [1, 5, 6, 2], [3, 4, 8, 7], [1, 3, 7, 5], [2, 6, 8, 4]]
    lines = ["mtllib missing.mtl", *("v {} {} {}".format(*v) for v in CUBE_VERTICES), "vt 0 0", "vt 1 1"]
    for index, quad in enumerate(quads):
        lines += [f"usemtl m{index % 2}", f"o part{index}", "f " + " ".join(f"{v}/{1 + index % 2}" for v in quad)]
    path = tmp_path / "cube.obj"
    path.write_text("\n".join(lines))
    mesh = load_mesh(str(path))
    assert (len(mesh.vertices), len(mesh.faces), mesh.closed, mesh.convex) == (24, 12, True, True)


def test_bad_files(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.obj"):
        load_mesh(tmp_path / "none.obj")
    cases = {
        "text.txt": b"v 0 0 0",
        "junk.stl": b"\x00\x01junk",
        "junk.glb": b"glTF but not quite",
        "junk.ply": b"ply\nformat ascii 1.0\nelement vertex 3\n",
        "empty.obj": b"",
        "points.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\n",
        "nan.obj": b"v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
        "index.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n",
    }
    for name, content in cases.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match=name.replace(".", r"\.")):
            load_mesh(tmp_path / name)
    (tmp_path / "folder.obj").mkdir()
    with pytest.raises(ValueError, match=r"folder\.obj"):
        load_mesh(tmp_path / "folder.obj")
    box_path = tmp_path / "cut.glb"
    trimesh.Trimesh(CUBE_VERTICES, CUBE_FACES, process=False).export(box_path)
    box_path.write_bytes(box_path.read_bytes()[:-100])
    with pytest.raises(ValueError, match=r"cut\.glb"):
        load_mesh(box_path)
    for scale in (0.0, -1.0, np.nan):
        with pytest.raises(ValueError, match="scale"):
            load_mesh(tmp_path / "points.obj", scale=scale)
