"""Baked fields and transfers against closed forms and brute-force ray casting."""

import threading
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import warp_psf as psf
from tests.oracles_bake import trace, traced_coverage
from warp_psf.bake import bake_radiance_field, body, visibility
from warp_psf.bake.bodies import bake_bodies
from warp_psf.bake.body import can_be_read
from warp_psf.bake.transfer import VERTEX_OFFSET, bake_transfer
from warp_psf.basis import sh, sphere
from warp_psf.device import find_device
from warp_psf.field.shells import lookup
from warp_psf.scene import primitives
from warp_psf.scene.mesh import make_mesh

ORDER = 4
# The norm of the vector of full coverage: errors are given as shares of it.
FULL = np.sqrt(4 * np.pi)


@pytest.fixture(scope="module")
def bake():
    """Bakes at a lower resolution, which takes a fraction of the time."""

    def bake(mesh, resolution=16, order=ORDER, threshold=None, **options):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(body, "FINEST_RESOLUTION", resolution)
            return psf.bake_mesh(mesh, order, threshold=threshold, use_cache=False, **options)

    return bake


def unknown(mesh):
    """The mesh without its closed form."""
    return replace(mesh, slab=None, sphere=None)


def merge(*meshes):
    counts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces + count for mesh, count in zip(meshes, counts, strict=False)]
    return np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces)


def shifted(mesh, shift):
    return replace(mesh, vertices=mesh.vertices + np.array(shift, np.float32))


@pytest.fixture(scope="module")
def corner():
    """A floor slab with a wall standing in it: concave, and of two overlapping closed parts."""
    floor = primitives.box((0.5, 0.5, 0.1), cells=4)
    wall = shifted(primitives.box((0.1, 0.5, 0.35), cells=4), (-0.4, 0.0, 0.3))
    return make_mesh("corner", *merge(floor, wall))


@pytest.fixture(scope="module")
def dome():
    """Half a sphere's surface, z > 0, without a floor."""
    ball = primitives.sphere(1.0, subdivisions=3)
    upper = ball.vertices[ball.faces].mean(axis=1)[:, 2] > 0
    with pytest.warns(UserWarning, match="open"):
        return make_mesh("dome", ball.vertices, ball.faces[upper])


@pytest.fixture(scope="module")
def ball_field(bake):
    baked = bake(unknown(primitives.sphere(0.5, subdivisions=4)), resolution=32)
    assert baked.transfer is None
    return baked.field


def directions(count, seed=1):
    vectors = np.random.default_rng(seed).normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def solid_angle(vectors):
    """Of the covered directions: the integral of the coverage."""
    return vectors[..., 0] * np.sqrt(4 * np.pi)


@pytest.mark.parametrize(
    ("radii", "tolerance"),
    [
        # On a shell: sampling (under 0.2 %), quantisation (0.3 % at most), and the bend of the functions between
        # samples 5.6 degrees apart, up to (3 * 0.05)^2 / 2 = 1 % of the third band.
        ((1.2, 1.4, 2.0, 3.0, 6.4), 0.008),
        # Between the bounding sphere and the next shell coverage falls from a hemisphere to 45 % of one. The shape of
        # its boundary changes with it, which no mean of two vectors follows.
        ((1.02, 1.05, 1.1, 1.15), 0.065),
        # Farther out the shells follow one another more slowly.
        ((1.3, 1.5), 0.015),
        ((1.7, 2.5, 3.3, 5.1, 6.3), 0.008),
        # Beyond the last shell, the solid angle alone tells how coverage falls.
        ((7.0, 10.0, 20.0), 0.001),
    ],
)
def test_a_ball_is_covered_as_its_closed_form_says(ball_field, radii, tolerance):
    toward = directions(200)
    for radius in radii:
        found = lookup(ball_field, 0.5 * radius * toward)
        expected = sh.zonal(sh.cap(np.arcsin(1 / radius), ORDER), -toward)
        assert np.linalg.norm(found - expected, axis=1).max() < tolerance * FULL, radius


def test_far_away_the_shadow_of_a_ball_is_right_in_proportion(ball_field):
    for radius in (4.1, 6.0, 10.0, 100.0):
        found = solid_angle(lookup(ball_field, 0.5 * radius * directions(100)))
        expected = 2 * np.pi * (1 - np.sqrt(1 - 1 / radius**2))
        np.testing.assert_allclose(found, expected, rtol=0.03)


def test_the_inside_does_not_darken_who_stands_on_the_surface(ball_field):
    toward = directions(400)
    share = solid_angle(lookup(ball_field, 0.5 * 1.002 * toward)) / (4 * np.pi)
    np.testing.assert_allclose(share, 0.5, atol=0.06)
    # Not within the body either, where a receiver may stand by rounding.
    share = solid_angle(lookup(ball_field, 0.5 * 0.97 * toward)) / (4 * np.pi)
    np.testing.assert_allclose(share, 0.5, atol=0.06)


def test_the_inside_of_a_box_does_not_darken_who_stands_on_its_sides(bake):
    half = np.array([0.5, 0.4, 0.3])
    field = bake(unknown(primitives.box(half, cells=2)), resolution=32).field
    random = np.random.default_rng(5)
    for axis in range(3):
        points = random.uniform(-0.8, 0.8, size=(200, 3)) * half
        points[:, axis] = half[axis] * 1.01
        found = lookup(field, points)
        hemisphere = sh.zonal(sh.cap(np.pi / 2, ORDER), -np.eye(3)[axis])
        error = np.linalg.norm(found - hemisphere, axis=1) / FULL
        share = solid_angle(found) / (4 * np.pi)
        # Full coverage of the samples inside would double the share; some neighbours stand beyond an edge, or off the
        # surface by up to a shell's spacing, and see less.
        assert share.max() < 0.55
        assert share.mean() > 0.3
        assert error.mean() < 0.25


@pytest.mark.parametrize(("order", "tolerance"), [(2, 0.008), (6, 0.014)])
def test_coverage_is_that_of_brute_force(corner, order, tolerance):
    """The more coefficients, the more of the sampling error they hold."""
    device = find_device("cpu")
    warp_mesh = body.upload_mesh(corner, device)
    inside_sphere = np.array([[0.3, 0.1, 0.2], [0.0, 0.3, 0.3], [-0.2, -0.2, 0.5], [0.2, 0.0, -0.2]])
    axes = -directions(20).astype(np.float32)
    for radii, points in ((0.5, inside_sphere), (1.0, None), (1.4, None), (2.4, None), (5.0, None)):
        if points is None:
            points = corner.center - radii * corner.radius * axes
        half_angle = np.pi if radii < 1 else np.arcsin(1 / radii) * 1.001
        rays = visibility.rays_at(radii)
        points = points.astype(np.float32)
        found = visibility.project_coverage(warp_mesh, points, axes[: len(points)], half_angle, rays, order, device)
        expected = traced_coverage(corner, points, order, rays=60_000)
        assert np.linalg.norm(found - expected, axis=1).max() < tolerance * FULL, radii
        np.testing.assert_allclose(solid_angle(found), solid_angle(expected), atol=0.06)


def test_samples_leave_the_solid_and_nothing_else(corner):
    points = np.random.default_rng(3).uniform(-0.6, 0.7, size=(3000, 3)).astype(np.float32)
    moved, inside = leave(corner, points)
    in_floor = (np.abs(points) < (0.5, 0.5, 0.1)).all(axis=1)
    in_wall = (np.abs(points - (-0.4, 0, 0.3)) < (0.1, 0.5, 0.35)).all(axis=1)
    np.testing.assert_array_equal(inside, in_floor | in_wall)
    np.testing.assert_array_equal(moved[~inside], points[~inside])
    still_inside = (np.abs(moved) < (0.5, 0.5, 0.1)).all(axis=1)
    still_inside |= (np.abs(moved - (-0.4, 0, 0.3)) < (0.1, 0.5, 0.35)).all(axis=1)
    assert not still_inside.any()
    before, after = points[inside] - corner.center, moved[inside] - corner.center
    assert np.linalg.norm(np.cross(before, after), axis=1).max() < 1e-6
    assert (np.linalg.norm(after, axis=1) > np.linalg.norm(before, axis=1)).all()


def test_the_space_in_a_cup_is_outside(dome):
    points = np.float32([[0, 0, 0.1], [0, 0.3, 0.5], [0, 0, 0.9], [0, 0, -0.5], [0.2, 0, 1.2]])
    moved, inside = leave(dome, points)
    assert not inside.any() and (moved == points).all()


def test_the_space_in_a_body_with_a_small_hole_is_inside():
    ball = primitives.sphere(1.0, subdivisions=2)
    with pytest.warns(UserWarning, match="open"):
        pierced = make_mesh("pierced", ball.vertices, ball.faces[3:])
    points = np.array([[0.1, 0, 0.1], [0, 0.3, -0.5], [0, -0.8, 0], [0.2, 0, 1.2]], np.float32)
    moved, inside = leave(pierced, points)
    np.testing.assert_array_equal(inside, [True, True, True, False])
    np.testing.assert_allclose(np.linalg.norm(moved[:3], axis=1), 1.0, atol=0.03)


def leave(mesh, points):
    device = find_device("cpu")
    warp_mesh = body.upload_mesh(mesh, device)
    return visibility.leave_solid(warp_mesh, mesh.center, mesh.radius, mesh.closed, points, device)


def test_an_open_mesh_bakes_a_usable_field(dome, bake):
    baked = bake(dome, resolution=32)
    assert np.isfinite(baked.field.dequantised()).all()
    points = np.array([[0, 0, 0.2], [0.3, 0.1, 0.3], [0.2, -0.3, -0.4], [0, 0.5, 1.4], [-1.5, 0, 0.2], [0, 3.0, -2.0]])
    error = lookup(baked.field, points) - traced_coverage(dome, points, ORDER)
    # Under the dome shells of a fifth of its radius follow one another.
    assert np.linalg.norm(error, axis=1).max() < 0.06 * FULL
    # Under the dome there is no sky.
    top = np.flatnonzero(dome.vertices[:, 2] > 0.9)
    assert baked.visibility is not None
    assert baked.transfer.shape == baked.visibility.shape == (len(dome.vertices), 16)
    np.testing.assert_allclose(solid_angle(baked.visibility[top]), 2 * np.pi, rtol=1e-3)


def test_the_transfer_of_a_convex_body_is_the_clamped_cosine():
    device = find_device("cpu")
    for mesh in (primitives.sphere(0.3, 3), primitives.box((0.1, 0.2, 0.3), cells=3)):
        transfer, self_visibility = bake_transfer(mesh, body.upload_mesh(mesh, device), ORDER, device)
        cosine = sh.zonal(sh.clamped_cosine(ORDER), mesh.normals.astype(float))
        hemisphere = sh.zonal(sh.cap(np.pi / 2, ORDER), mesh.normals.astype(float))
        np.testing.assert_allclose(transfer, cosine, atol=1e-6)
        np.testing.assert_allclose(self_visibility, hemisphere, atol=1e-6)


def test_the_transfer_in_a_corner_is_that_of_brute_force(corner, bake):
    device = find_device("cpu")
    transfer, self_visibility = bake_transfer(corner, body.upload_mesh(corner, device), ORDER, device)
    points = (corner.vertices + VERTEX_OFFSET * corner.radius * corner.normals).astype(np.float32)
    rays = sphere.fibonacci_cap(20_000)
    open_directions = trace(corner, points, rays) == 0
    cosine = np.clip(corner.normals @ rays.T, 0, None)
    weights = np.full(len(rays), 4 * np.pi / len(rays))
    expected = sh.project(open_directions * cosine, rays, weights, ORDER)
    expected_visibility = sh.project(open_directions * (cosine > 0), rays, weights, ORDER)
    # What is buried in the other part takes the light of the vertices around it.
    seen = ~leave(corner, points)[1]
    # 1,024 rays over a hemisphere: the boundary of what blocks leaves about 2 pi 1024^(-3/4) = 0.03 in a coefficient.
    np.testing.assert_allclose(transfer[seen], expected[seen], atol=0.04)
    np.testing.assert_allclose(self_visibility[seen], expected_visibility[seen], atol=0.06)
    # Under a white sky a vertex keeps between nothing and pi; in the corner's foot, about half.
    irradiance = solid_angle(transfer)
    assert irradiance.min() > -0.01
    assert irradiance.max() < np.pi + 1e-4
    top = (corner.normals[:, 2] > 0.9) & (np.abs(corner.vertices[:, 2] - 0.1) < 1e-6)
    foot = top & (corner.vertices[:, 0] > -0.3) & (corner.vertices[:, 0] < -0.1) & (np.abs(corner.vertices[:, 1]) < 0.3)
    assert foot.any()
    assert irradiance[foot].max() < 0.95 * np.pi


def test_a_body_of_uniform_radiance_is_its_coverage(corner, monkeypatch):
    monkeypatch.setattr(body, "FINEST_RESOLUTION", 16)
    covered = psf.bake_mesh(corner, 2, use_cache=False).field
    shining = bake_radiance_field(corner, np.ones(len(corner.faces)), 2, use_cache=False)
    assert covered is not None
    np.testing.assert_array_equal(covered.resolutions, shining.resolutions)
    # The nearest hit and any hit may disagree on a ray that passes along an edge; quantisation adds a step.
    points = corner.center + corner.radius * 1.3 * directions(200)
    np.testing.assert_allclose(lookup(shining, points), lookup(covered, points), atol=0.02)


def test_only_the_luminous_side_of_a_body_shines(monkeypatch):
    monkeypatch.setattr(body, "FINEST_RESOLUTION", 32)
    panel = unknown(primitives.box((0.05, 0.5, 0.5), cells=1))
    front = panel.vertices[panel.faces][:, :, 0].min(axis=1) > 0.04
    assert front.sum() == 2
    field = bake_radiance_field(panel, 3.0 * front, 3, use_cache=False)
    points = np.array([[2.0, 0.1, 0.0], [-2.0, 0.1, 0.0], [3.0, 3.0, 1.0]])
    rays = sphere.fibonacci_cap(40_000)
    hits = trace(panel, points, rays)
    radiance = np.where(hits > 0, 3.0 * front[np.abs(hits) - 1], 0.0)
    expected = sh.project(radiance, rays, np.full(len(rays), 4 * np.pi / len(rays)), 3)
    # The threshold lets a mean of 0.01 pass, of a norm of 0.035.
    np.testing.assert_allclose(lookup(field, points), expected, atol=0.035)
    assert np.abs(lookup(field, points[1:2])).max() < 2e-3


@pytest.mark.parametrize("radiance", [np.ones(3), -np.ones(12), np.full(12, np.nan)])
def test_radiance_is_checked(radiance):
    with pytest.raises(ValueError, match="one per face"):
        bake_radiance_field(primitives.box((1, 1, 1), cells=1), radiance, use_cache=False)


@pytest.mark.parametrize("order", [1, 7, 0, -2])
def test_the_order_is_checked(order):
    with pytest.raises(ValueError, match="choose 2 to 6"):
        psf.bake_mesh(primitives.box((1, 1, 1)), order)
    with pytest.raises(ValueError, match="choose 2 to 6"):
        bake_radiance_field(primitives.box((1, 1, 1), cells=1), np.ones(12), order)


@pytest.mark.parametrize("threshold", [-0.1, np.nan])
def test_the_threshold_is_checked(threshold):
    with pytest.raises(ValueError, match="threshold"):
        psf.bake_mesh(primitives.box((1, 1, 1)), threshold=threshold)


@pytest.mark.parametrize("mesh", [primitives.plane(1, 2, 2), primitives.box((1, 2, 3)), primitives.sphere(0.5)])
def test_closed_forms_need_no_field(mesh, monkeypatch, tmp_path):
    monkeypatch.setenv("WARP_PSF_CACHE", str(tmp_path / "cache"))
    shares = []
    assert psf.bake_mesh(mesh, progress=shares.append) == psf.BakedBody(None, None, None)
    assert shares == [1.0]
    assert not (tmp_path / "cache").exists()


def test_progress_grows_to_one(corner, monkeypatch, tmp_path):
    monkeypatch.setenv("WARP_PSF_CACHE", str(tmp_path))
    monkeypatch.setattr(body, "FINEST_RESOLUTION", 8)
    shares = []
    baked = psf.bake_mesh(corner, 2, progress=shares.append)
    assert shares == sorted(shares)
    assert len(set(shares)) == len(shares)
    assert len(shares) > 30
    assert 0 <= shares[0] < 0.2
    assert shares[-1] == 1.0
    again = []
    assert psf.bake_mesh(corner, 2, progress=again.append).field is not None
    assert again == [1.0]
    assert baked.field is not None
    assert baked.field.resolutions.max() == 8


def test_the_sizes_are_the_papers(bake):
    field = bake(unknown(primitives.box((1, 1, 1), cells=1)), resolution=8).field
    assert (field.resolutions == 8).all()
    # 32 shells of 64 x 64 samples of 16 bytes: 2 MB. A shell's minimum and step come to it.
    assert field.codes.nbytes * (64 // 8) ** 2 == 2 * 2**20
    assert field.nbytes - field.codes.nbytes == 32 * 2 * 16 * 4


def test_vectors_taken_over_are_those_that_would_be_cast(corner, monkeypatch):
    device = find_device("cpu")
    warp_mesh = body.upload_mesh(corner, device)
    cast_points = []

    def project(shell, points, outward):
        cast_points.append(len(points))
        return body._project(corner, warp_mesh, shell, points, outward, ORDER, device, None)

    def sample():
        cast_points.clear()
        shells, _ = body.sample_shells(corner, warp_mesh, 5, 16, project, device, lambda share: None)
        return np.stack(shells), sum(cast_points)

    taken, fewer = sample()
    monkeypatch.setattr(body, "SAME_POINT", 0.0)
    monkeypatch.setattr(body, "can_be_read", lambda inside, shell: np.ones_like(inside[shell]))
    cast_all, all_samples = sample()
    assert all_samples == 5 * 16 * 16
    assert fewer < all_samples
    inside = [leave(corner, body._sample_points(corner, shell, 16)[0])[1].reshape(16, 16) for shell in range(5)]
    readable = np.stack([can_be_read(inside, shell) for shell in range(5)])
    # The same point to rounding: a ray along an edge may go either way.
    np.testing.assert_allclose(taken[readable], cast_all[readable], atol=0.02)


@pytest.mark.parametrize("shape", ["ball", "corner"])
def test_bundled_rays_find_what_all_rays_find_around_solids(shape, corner):
    mesh = primitives.sphere(1.0, subdivisions=3) if shape == "ball" else corner
    device = find_device("cpu")
    points, _ = leave(mesh, (mesh.center + mesh.radius * 0.5 * directions(100)).astype(np.float32))
    axes = directions(100, seed=4).astype(np.float32)
    arguments = body.upload_mesh(mesh, device), points, axes, np.pi, 2048, ORDER, device
    bundled, whole = (visibility.project_coverage(*arguments, solid=each) for each in (True, False))
    # Half of what 2,048 rays themselves err by, 0.005: an edge that runs between probes on one side of all of them.
    assert np.sqrt(((bundled - whole) ** 2).sum(axis=1).mean()) < 0.0025 * FULL


def test_samples_deep_inside_are_not_read():
    # Shell 0 is inside everywhere, shell 1 but for one sample, shell 2 nowhere.
    inside = [np.ones((8, 8), bool), np.ones((8, 8), bool), np.zeros((8, 8), bool)]
    inside[1][3, 0] = False
    readable = can_be_read(inside, 0)
    expected = np.zeros((8, 8), bool)
    expected[2:5, [7, 0, 1]] = True  # its neighbours, across the seam too
    np.testing.assert_array_equal(readable, expected)
    assert can_be_read(inside, 1).all()
    assert can_be_read(inside, 2).all()


def scene_of(*meshes):
    return SimpleNamespace(meshes=meshes, entities=[SimpleNamespace(mesh=index) for index in range(len(meshes))])


def capsules(*radii):
    return scene_of(*(replace(primitives.capsule(radius, 0.2), name=f"capsule {radius}") for radius in radii))


@pytest.fixture
def coarse(monkeypatch, tmp_path):
    monkeypatch.setenv("WARP_PSF_CACHE", str(tmp_path))
    monkeypatch.setattr(body, "FINEST_RESOLUTION", 8)
    monkeypatch.setattr("warp_psf.bake.bodies.core_count", lambda: 3)


def test_bodies_that_are_baked_side_by_side_are_those_baked_alone(coarse):
    scene = capsules(0.05, 0.1, 0.15, 0.2)
    heard = []

    def hear(what, share):
        assert threading.current_thread() is threading.main_thread()
        heard.append((what, share))

    baked = bake_bodies(scene, [True, True, False, True], 2, "cpu", hear)
    assert baked[2] == psf.BakedBody(None, None, None)
    for index in (0, 1, 3):
        mesh = scene.meshes[index]
        alone, found = psf.bake_mesh(mesh, 2, use_cache=False).field, baked[index].field
        assert alone is not None and found is not None and found.radius == mesh.radius
        np.testing.assert_array_equal(found.codes, alone.codes)
        shares = [share for what, share in heard if what == f"baking {mesh.name}"]
        assert shares == sorted(shares)
        assert shares[-1] == 1.0


def test_copies_of_a_shape_are_baked_once(coarse, tmp_path):
    one, other = capsules(0.05, 0.1).meshes
    large = make_mesh("large", one.vertices * np.float32(2.3), one.faces, one.normals)
    baked = bake_bodies(scene_of(one, other, large), [True] * 3, 2, "cpu", lambda what, share: None)
    assert len(list(tmp_path.iterdir())) == 2
    first, copy = baked[0].field, baked[2].field
    assert first is not None and copy is not None and (copy.codes == first.codes).all()
    assert copy.radius == pytest.approx(2.3 * first.radius, rel=1e-6)


@pytest.mark.parametrize("where", ["bake", "progress"])
def test_the_first_error_ends_all_bakes_and_reaches_the_caller(coarse, monkeypatch, where):
    begun = []

    def bake(mesh, order, *, device, progress):
        begun.append(mesh.name)
        if where == "bake" and mesh.name == "capsule 0.06":
            raise MemoryError("no room")
        for share in np.linspace(0, 0.99, 10_000):
            time.sleep(0.001)  # ten seconds, unless it is stopped by its progress
            progress(share)

    monkeypatch.setattr("warp_psf.bake.bodies.bake_mesh", bake)

    def hear(what, share):
        if where == "progress" and share > 0:
            raise MemoryError("no room")

    threads = threading.active_count()
    with pytest.raises(MemoryError, match="no room"):
        bake_bodies(capsules(*np.linspace(0.05, 0.2, 16).round(2)), [True] * 16, 2, "cpu", hear)
    assert len(begun) < 8  # those that had not begun never do
    assert threading.active_count() == threads
