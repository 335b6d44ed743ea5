"""The references for self-shadowing bodies against closed forms."""

import numpy as np
import pytest

from sims.bodies import ball
from tests.oracles import polygon_form_factor, sphere_coverage
from tests.oracles_hemisphere import (
    cosine_directions,
    exact_coverage,
    phong_transfer,
    relative_error,
    traced_transfer,
    turned_frames,
    vertex_normals,
)
from warp_psf.basis import sh, sphere

ORDER, RAYS = 5, 4096
# The lattice of 4096 rays errs along a blocker's outline by about its length times 1 / rays^(3/4).
NOISE = 6e-3
# The constant function.
Y_0 = 1 / np.sqrt(4 * np.pi)
# A triangle that nothing above the horizons of upright points sees.
BELOW = np.array([[0, 0, -1], [1, 0, -1], [0, 1, -1]]), np.array([[0, 1, 2]])
FACE = np.array([[0, 1, 2]])


def upright(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points on z = 0 with upright normals."""
    points = np.zeros((count, 3))
    points[:, :2] = np.random.default_rng(1).uniform(-0.3, 0.3, (count, 2))
    return points, np.tile((0.0, 0.0, 1.0), (count, 1))


def random_units(count: int, seed: int) -> np.ndarray:
    vectors = np.random.default_rng(seed).normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def wall() -> tuple[np.ndarray, np.ndarray]:
    """An upright wall at x = 1, that all but fills one half of the hemispheres."""
    far = 1e4
    return np.array([[1, -far, 0], [1, far, 0], [1, far, far], [1, -far, far]]), np.array([[0, 1, 2], [0, 2, 3]])


def integrate_hemisphere(values, order: int = ORDER) -> np.ndarray:
    """SH vector of a function of directions [N, 3] above the horizon, by a million evenly spread directions."""
    directions = sphere.fibonacci_cap(2**20, np.pi / 2)
    return (values(directions) * 2 * np.pi / len(directions)) @ sh.evaluate(directions, order)


def test_directions_are_distributed_as_the_cosine():
    directions = cosine_directions(4096)
    assert np.linalg.norm(directions, axis=1) == pytest.approx(np.ones(4096))
    # Moments of the height under the density cos / pi: 2/3 and 1/2; a lattice is far better than 1 / sqrt(4096).
    assert directions[:, 2].mean() == pytest.approx(2 / 3, abs=1e-4)
    assert (directions[:, 2] ** 2).mean() == pytest.approx(0.5, abs=1e-6)
    assert directions[:, :2].mean(axis=0) == pytest.approx(np.zeros(2), abs=1e-3)


def test_frames_are_rotations_about_the_normals():
    normals = random_units(50, seed=2)
    frames = turned_frames(normals)
    assert frames @ frames.transpose(0, 2, 1) == pytest.approx(np.broadcast_to(np.eye(3), (50, 3, 3)), abs=1e-12)
    assert np.linalg.det(frames) == pytest.approx(np.ones(50))
    assert frames[..., 2] == pytest.approx(normals)
    assert np.array_equal(frames, turned_frames(normals))
    assert not np.array_equal(frames, turned_frames(normals, seed=1))


def test_an_open_vertex_has_the_closed_form():
    normals = random_units(20, seed=3)
    # A blocker behind each horizon.
    for point, normal in zip(2 * normals, normals, strict=True):
        corners = sphere.frame(normal).T - normal
        transfer, visibility = traced_transfer(point[None], normal[None], corners, FACE, True, ORDER, 64, 0)
        assert transfer[0] == pytest.approx(sh.zonal(sh.clamped_cosine(ORDER), normal), abs=1e-12)
        assert visibility[0] == pytest.approx(sh.zonal(sh.cap(np.pi / 2, ORDER), normal), abs=1e-12)


def test_a_wall_leaves_half_a_hemisphere():
    points, up = upright(8)
    transfer, visibility = traced_transfer(points, up, *wall(), True, ORDER, RAYS, 0.0)
    cosine = integrate_hemisphere(lambda d: d[:, 2] * (d[:, 0] < 0))
    half = integrate_hemisphere(lambda d: 1.0 * (d[:, 0] < 0))
    assert transfer == pytest.approx(np.tile(cosine, (8, 1)), abs=NOISE)
    assert visibility == pytest.approx(np.tile(half, (8, 1)), abs=NOISE)


@pytest.mark.parametrize("place", [(0.0, 0.0, 1.5), (1.0, -0.5, 1.4)])
def test_a_sphere_above_covers_a_cap(place: tuple[float, float, float]):
    vertices, faces = ball(cells=40, diameter=1.0)
    vertices = vertices + place
    points, up = upright(8)
    transfer, visibility = traced_transfer(points, up, vertices, faces, False, ORDER, RAYS, 0.0)
    # The ball is a polyhedron inside of its sphere: smaller by 0.1 %.
    expected = sh.zonal(sh.cap(np.pi / 2, ORDER), up) - sphere_coverage(points, np.array(place), 0.5, ORDER)
    assert visibility == pytest.approx(expected, abs=NOISE)
    # Visibility times cosine, from the closed form of the one on many bands: the cosine is a polynomial of degree 1.
    covered = sphere_coverage(points, np.array(place), 0.5, ORDER + 1)
    height = sh.zonal(np.array([0.0, np.sqrt(4 * np.pi / 3)] + [0.0] * (ORDER - 1)), up)
    blocked = sh.triple_product(covered, height)[:, : ORDER**2]
    assert transfer == pytest.approx(sh.zonal(sh.clamped_cosine(ORDER), up) - blocked, abs=NOISE)


def test_a_triangle_takes_its_form_factor():
    corners = np.array([[0.9, -0.4, 0.5], [-0.6, -0.5, 0.8], [0.1, 0.8, 0.4]])
    points, up = upright(30)
    share = np.abs(polygon_form_factor(points, up, corners))
    transfer, _ = traced_transfer(points, up, corners, FACE, True, ORDER, RAYS, 0.0)
    assert transfer[:, 0] == pytest.approx(np.pi * Y_0 * (1 - share), abs=0.5 * NOISE)


def test_faces_seen_from_behind_do_not_count_in_closed_surfaces():
    points, up = upright(4)
    # Counter-clockwise seen from above: the points below see its back.
    sheet = np.array([[-1, -1, 0.5], [1, -1, 0.5], [0, 1, 0.5]])
    open_vector = sh.zonal(sh.clamped_cosine(ORDER), up)
    back, _ = traced_transfer(points, up, sheet, FACE, False, ORDER, 256, 0.0)
    assert back == pytest.approx(open_vector, abs=1e-12)
    front, _ = traced_transfer(points, up, sheet, FACE[:, ::-1], False, ORDER, 256, 0.0)
    both, _ = traced_transfer(points, up, sheet, FACE, True, ORDER, 256, 0.0)
    assert np.array_equal(front, both)
    assert (front[:, 0] < 0.9 * open_vector[:, 0]).all()
    # What stands behind a back does.
    far = sheet * (1, 1, 2)
    pair = np.concatenate([sheet, far]), np.concatenate([FACE, FACE[:, ::-1] + 3])
    hidden, _ = traced_transfer(points, up, *pair, False, ORDER, 256, 0.0)
    alone, _ = traced_transfer(points, up, far, FACE[:, ::-1], False, ORDER, 256, 0.0)
    assert np.array_equal(hidden, alone)


def test_the_origin_leaves_the_surface():
    # Points that lie in a sheet see nothing of it from their side, and all of it from below.
    points, up = upright(4)
    sheet = np.array([[-9.0, -9, 0], [9, -9, 0], [0, 18, 0]])
    above, _ = traced_transfer(points, up, sheet, FACE, True, ORDER, 256, 1e-3)
    assert above == pytest.approx(sh.zonal(sh.clamped_cosine(ORDER), up), abs=1e-12)
    below, _ = traced_transfer(points, up, sheet, FACE, True, ORDER, 256, -1e-3)
    assert np.abs(below[:, 0]).max() < 1e-2


def test_turning_everything_turns_the_vectors():
    points, up = upright(8)
    rotation = sphere.frame(random_units(1, seed=5))[0]
    vertices, faces = wall()
    still, _ = traced_transfer(points, up, vertices, faces, True, ORDER, RAYS, 0.0)
    turned, _ = traced_transfer(points @ rotation.T, up @ rotation.T, vertices @ rotation.T, faces, True, 5, RAYS, 0.0)
    # The lattices lie at other angles.
    assert turned == pytest.approx(sh.rotate(still, rotation), abs=NOISE)


def test_other_seeds_turn_the_rays():
    points, up = upright(4)
    runs = [traced_transfer(points, up, *wall(), True, 3, 256, 0.0, seed)[0] for seed in (0, 0, 1)]
    assert np.array_equal(runs[0], runs[1])
    assert not np.array_equal(runs[0], runs[2])


@pytest.mark.parametrize("exponent", [1.0, 10.0, 40.0])
def test_an_open_lobe_about_the_normal_is_zonal(exponent: float):
    # Cosine times lobe is the lobe of the next power, normalised otherwise.
    profile = sh.phong_lobe(exponent + 1, ORDER) * (exponent + 2) / (exponent + 3)
    points, up = upright(3)
    found = phong_transfer(points, up, up, exponent, *BELOW, True, ORDER, 64, 0.0)
    assert found == pytest.approx(sh.zonal(profile, up), abs=1e-9)


def test_an_open_lobe_aside_matches_brute_force():
    points, up = upright(3)
    mirrored = np.array([[0.6, 0.0, 0.8], [0.0, 0.96, 0.28], [-0.48, 0.64, 0.6]])
    found = phong_transfer(points, up, mirrored, 10.0, *BELOW, True, ORDER, 64, 0.0)
    for axis, vector in zip(mirrored, found, strict=True):
        expected = integrate_hemisphere(lambda d, a=axis: 6 / np.pi * np.maximum(d @ a, 0) ** 10 * d[:, 2])
        # A million even directions on a smooth function.
        assert vector == pytest.approx(expected, abs=1e-5)


def test_a_wall_halves_the_lobe_that_it_cuts():
    points, up = upright(8)
    open_lobe = phong_transfer(points, up, up, 10.0, *BELOW, True, ORDER, RAYS, 0.0)
    found = phong_transfer(points, up, up, 10.0, *wall(), True, ORDER, RAYS, 0.0)
    # Nine tenths of the rays are far from the lobe, so that its noise is that of fewer.
    assert found[:, 0] == pytest.approx(0.5 * open_lobe[:, 0], abs=2 * NOISE)
    aside = np.tile((-1.0, 0.0, 0.0), (8, 1))
    # A lobe that points away from the wall is whole.
    found = phong_transfer(points, up, aside, 10.0, *wall(), True, ORDER, RAYS, 0.0)
    assert found == pytest.approx(phong_transfer(points, up, aside, 10.0, *BELOW, True, ORDER, 64, 0.0), abs=NOISE)


def test_an_octant_is_covered_exactly():
    directions = random_units(2000, seed=7)
    covered = exact_coverage(np.eye(3), directions)
    assert np.array_equal(covered, (directions > 0).all(axis=1))
    assert np.array_equal(covered, exact_coverage(np.eye(3)[::-1], directions))


def test_coverage_is_the_solid_angle():
    generator = np.random.default_rng(8)
    directions = sphere.fibonacci_cap(20_000)
    for _ in range(20):
        corners = generator.normal(size=(3, 3))
        a, b, c = corners / np.linalg.norm(corners, axis=1, keepdims=True)
        # Van Oosterom and Strackee 1983.
        angle = 2 * np.arctan2(np.abs(np.dot(a, np.cross(b, c))), 1 + a @ b + b @ c + c @ a)
        # Outlines are up to 6 long; along them a lattice errs by 1 / 20000^(3/4) of its sphere.
        assert exact_coverage(corners, directions).mean() == pytest.approx(angle / (4 * np.pi), abs=2e-3)


def test_pieces_cover_what_the_whole_does_once():
    generator = np.random.default_rng(9)
    directions = random_units(4000, seed=10)
    for _ in range(20):
        corners = generator.normal(size=(3, 3))
        middle = generator.dirichlet(np.ones(3)) @ corners
        pieces = [exact_coverage(np.stack([corners[k], corners[(k + 1) % 3], middle]), directions) for k in range(3)]
        # The middle is rounded into float64: no random direction is so near to a seam.
        assert np.array_equal(np.sum(pieces, axis=0), exact_coverage(corners, directions))


def test_signs_are_exact_where_rounding_hides_them():
    # A needle: its determinant is 2^50, of terms of 2^150. Sums of few such whole numbers are exact in float64.
    a, b, c = 2.0**50 + np.array([[0, 0, 0], [3, 1, 0], [0, 1, 2]])
    within = np.stack([a + b + c, 2 * a + b + c])
    without = np.stack([a, a + b, a + 2 * c, a + b - c, 2 * c - a, -(a + b + c)])
    for corners in (np.stack([a, b, c]), np.stack([c, b, a])):
        assert exact_coverage(corners, within).all()
        assert not exact_coverage(corners, without).any()


def test_triangles_seen_edge_on_cover_nothing():
    a, b, c = random_units(3, seed=11)
    # Whole numbers, so that the corners lie in one plane with the origin exactly.
    flat = np.array([[1.0, 2, 3], [4, 5, 6], [7, 8, 9]])
    for corners in (flat, np.stack([a, a, c]), np.stack([a, 2 * a, b]), np.stack([a, b, np.zeros(3)])):
        assert not exact_coverage(corners, random_units(100, seed=12)).any()


def test_relative_error_leaves_out_what_vanishes():
    expected = np.array([[3.0, 4.0], [0.0, 0.0], [0.0, 1.0], [0.0, 1e-3]])
    found = expected + np.array([[0.5, 0.0], [9.0, 9.0], [0.0, 0.3], [9.0, 0.0]])
    error, left_out = relative_error(found, expected)
    assert error == pytest.approx((0.1 + 0.3) / 2)
    assert left_out == 2


def test_normals_of_a_ball_point_outwards():
    vertices, faces = ball(cells=20, diameter=2.0)
    found = vertex_normals(vertices, faces)
    # Faces 0.08 wide bend by half of that at most to one side of a vertex.
    assert np.sum(found * vertices, axis=1) == pytest.approx(np.ones(len(vertices)), abs=1e-3)
    # A large face weighs more than a small one at their common vertices.
    bent = np.array([[0.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, 0, 3]])
    tilted = vertex_normals(bent, np.array([[0, 1, 2], [0, 3, 1]]))
    assert tilted[0] == pytest.approx(np.array([-3.0, 0, 1]) / np.sqrt(10))
