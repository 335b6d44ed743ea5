"""Basis radiance: functions on a body, their fields and weights, against closed forms, twins and ray casting."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from sims import bodies
from tests.oracles_bake import trace
from warp_psf.bake import gather, radiance
from warp_psf.bake.body import upload_mesh
from warp_psf.bake.radiance import bake_radiance
from warp_psf.bake.shape import unit_shape
from warp_psf.basis import sh, sphere
from warp_psf.device import find_device, launch
from warp_psf.field.radiance import (
    RADIANCE_SHELLS,
    BasisRadianceField,
    make_radiance,
    make_summed,
    sum_fields,
    upload_radiance,
)
from warp_psf.field.shells import FIRST_OUTER_SHELL, find_corners, quantise, sample_directions, shell_radii
from warp_psf.field.store import cache_folder
from warp_psf.scene import primitives
from warp_psf.scene.mesh import make_mesh, tessellate

ORDER = 4
COUNT = ORDER * ORDER
FULL = np.sqrt(4 * np.pi)  # the norm of the vector of a sphere of radiance 1
MIXED = np.resize([8, 16, 16, 8, 8], RADIANCE_SHELLS)


def directions(count, seed=1):
    vectors = np.random.default_rng(seed).normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def scaled(mesh, factor):
    return make_mesh(mesh.name, mesh.vertices * np.float32(factor), mesh.faces, mesh.normals)


def bake_functions(mesh, **options):
    """Bakes with the coarsest field, which takes a fraction of the time, where only the functions matter."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(radiance, "FINEST_RADIANCE_RESOLUTION", 8)
        return bake_radiance(mesh, use_cache=False, **options)


@pytest.fixture(scope="module")
def device():
    return find_device("cpu")


@pytest.fixture(scope="module")
def mug():
    return make_mesh("mug", *bodies.mug(rings=24, segments=30))


@pytest.fixture(scope="module")
def pin():
    return make_mesh("pin", *bodies.pin(rings=30, segments=24))


@pytest.fixture(scope="module")
def hollow():
    """A ball of radius 1 with a cavity of radius 0.6 in its middle; its normals look into the cavity."""
    ball = primitives.sphere(1.0, subdivisions=2)
    count = len(ball.vertices)
    faces = np.concatenate([ball.faces, ball.faces[:, ::-1] + count])
    return make_mesh("hollow", np.concatenate([ball.vertices, 0.6 * ball.vertices]), faces)


@pytest.fixture(scope="module")
def baked_mug(mug):
    return bake_radiance(mug)


@pytest.fixture(scope="module")
def baked_pin(pin):
    return bake_radiance(pin)


def weighted_norm(values, areas):
    return np.sqrt(np.average(np.asarray(values, np.float64) ** 2, weights=areas, axis=0))


# The field on the device against its twin


def random_field(seed, order, functions, resolutions=MIXED, radius=0.7, center=(0.1, -0.2, 0.3)):
    random = np.random.default_rng(seed)
    count = order * order
    spread = random.uniform(0.1, 1.0, functions * count)
    kept = quantise(np.array(center), radius, [spread * random.normal(size=(r, r, len(spread))) for r in resolutions])
    return BasisRadianceField(
        center=kept.center,
        radius=kept.radius,
        resolutions=kept.resolutions,
        codes=kept.codes.reshape(-1, functions, count),
        minimum=kept.minimum.reshape(-1, functions, count),
        step=kept.step.reshape(-1, functions, count),
        covered=random.uniform(0, 1, kept.resolutions[FIRST_OUTER_SHELL] ** 2).astype(np.float32),
    )


@pytest.fixture(scope="module", params=[(4, 16), (4, 4), (4, 32), (3, 8)], ids=str)
def looked_up(request, device):
    """The order, the number of functions, and what looks points up with them (see `look_up`)."""
    return *request.param, make_look_up(*request.param, device)


def make_look_up(order, functions, device):
    kit = make_radiance(order, functions)

    @wp.kernel(module="unique")
    def look_up_points(
        first: int,
        table: kit.RadianceTable,
        field: int,
        entity: int,
        points: wp.array(dtype=wp.vec3),
        received: wp.array(dtype=kit.vec),
        summed: wp.array2d(dtype=kit.rgb),
        summed_first: wp.array(dtype=wp.int32),
        irradiance_out: wp.array(dtype=kit.weights),
        radiance_out: wp.array2d(dtype=kit.rgb),
    ):
        world, item = wp.tid()
        item += first
        place = kit.locate(table, field, points[item])
        irradiance_out[item] = kit.basis_irradiance(table, place, received[item])
        radiance_out[world, item] = kit.lookup_summed(summed[world], summed_first[entity], place)

    def look_up(fields, field, points, received, weights):
        """Basis irradiances [n, N], and the summed radiance [worlds, n, 3, K] of an entity that has the field."""
        table = upload_radiance(fields, order, functions, device)
        # Entity 1 has no field, 0 and 2 have the other one, and 3 is looked up.
        entities, worlds = [1 - field, -1, 1 - field, field], len(weights)
        summed = make_summed(entities, fields, order, functions, worlds, device)
        all_weights = np.full((worlds, len(entities), functions, 3), 100.0, np.float32)
        all_weights[:, 3] = weights
        sum_fields(summed, table, wp.array(all_weights, dtype=wp.vec3, device=device), device)
        irradiance = wp.zeros(len(points), dtype=kit.weights, device=device)
        radiance_out = wp.zeros((worlds, len(points)), dtype=kit.rgb, device=device)
        inputs = [
            table,
            field,
            3,
            wp.array(np.asarray(points, np.float32), dtype=wp.vec3, device=device),
            wp.array(np.asarray(received, np.float32), dtype=kit.vec, device=device),
            summed.summed,
            summed.first,
        ]
        launch(look_up_points, (worlds, len(points)), inputs, [irradiance, radiance_out], device)
        return irradiance.numpy(), radiance_out.numpy().reshape(worlds, len(points), 3, -1)

    return look_up


@pytest.mark.parametrize("field", [0, 1])
def test_device_and_twin_agree(looked_up, field):
    order, functions, look_up = looked_up
    fields = [
        random_field(1, order, functions),
        random_field(2, order, functions, MIXED[::-1], radius=2.0, center=(0.0, 0.0, 0.0)),
    ]
    random = np.random.default_rng(4)
    radii = np.exp(random.uniform(np.log(0.02), np.log(10), 500))  # from within the first shell to beyond the last
    points = fields[field].center + radii[:, None] * fields[field].radius * directions(500)
    received = random.normal(size=(500, order * order))
    weights = random.normal(size=(2, functions, 3))
    irradiance, summed = look_up(fields, field, points, received, weights)
    vectors = fields[field].lookup(points)
    # As in the shadow fields' test: float32 coordinates between random neighbours leave about 4e-3 of a unit, here in
    # sums of tens of terms.
    np.testing.assert_allclose(irradiance, np.einsum("nik,nk->ni", vectors, received), atol=0.02)
    np.testing.assert_allclose(summed, np.einsum("wic,nik->wnck", weights, vectors), atol=0.03)


def test_what_no_entity_and_no_field_need_takes_no_room(device):
    table = upload_radiance([], ORDER, 4, device)
    assert table.codes.shape == (0,)
    summed = make_summed([-1, -1], [], ORDER, 4, 2, device)
    assert summed.summed.shape == (2, 0)
    sum_fields(summed, table, wp.zeros((2, 2, 4), dtype=wp.vec3, device=device), device)


def test_other_numbers_of_functions_are_refused():
    with pytest.raises(ValueError, match="5 basis functions; choose one of: 4, 8, 16, 32"):
        make_radiance(ORDER, 5)


# What a field holds


@pytest.fixture(scope="module")
def white_ball(device):
    """The field of a ball of radius 0.5 whose functions are 1 everywhere."""
    ball = primitives.sphere(0.5, subdivisions=4)
    ones = np.ones((len(ball.vertices), 4), np.float32)
    return radiance._bake_field(ball, upload_mesh(ball, device), ones, ORDER, None, device, lambda share: None)


@pytest.mark.parametrize(
    ("radii", "tolerance"),
    [
        # Sampling, quantisation (1 % together), and the bend of the third band between samples 11 degrees apart, of
        # which the mean is taken off: (3 * 0.1)^2 / 3 of a third of the norm.
        ((1.2, 1.3, 1.4, 1.7, 2.0, 2.5, 3.0, 3.2, 5.0, 10.0), 0.02),
        # As in the shadow field of a ball (test_bake.py): between the first two shells outside, the changing shape of
        # the cap.
        ((1.02, 1.05, 1.1, 1.15), 0.065),
    ],
)
def test_a_white_ball_shines_over_the_cap_that_it_covers(white_ball, radii, tolerance):
    toward = directions(200)
    for radius in radii:
        found = white_ball.lookup(0.5 * radius * toward)
        expected = sh.zonal(sh.cap(np.arcsin(1 / radius), ORDER), -toward)[:, None]
        assert np.linalg.norm(found - expected, axis=-1).max() < tolerance * FULL, radius


def test_light_of_a_ball_fades_as_its_solid_angle(white_ball):
    assert white_ball.covered.min() > 0.95  # a ball reaches its bounding sphere; a tessellated one nearly
    at_last = white_ball.lookup(shell_radii(0.5)[-1] * directions(50))
    # The clamp of the last shell sets in to rounding.
    np.testing.assert_allclose(25 * white_ball.lookup(5 * shell_radii(0.5)[-1] * directions(50)), at_last, atol=1e-6)


def seen(mesh, values, points, toward):
    """Values [vertices, N] interpolated where rays from points [n, 3] first meet a front, [n, Q, N]; else 0."""
    faces = trace(mesh, points, toward)
    point, ray = np.nonzero(faces > 0)
    corners = mesh.vertices[mesh.faces[faces[point, ray] - 1]].astype(np.float64)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    origin, direction = np.asarray(points, np.float64)[point], toward[ray]
    along = ((corners[:, 0] - origin) * normal).sum(axis=1) / (direction * normal).sum(axis=1)
    hit = (origin + along[:, None] * direction)[:, None]
    opposite = np.cross(np.roll(corners, -1, axis=1) - hit, np.roll(corners, -2, axis=1) - hit)
    shares = np.einsum("hcx,hx->hc", opposite, normal) / (normal**2).sum(axis=1, keepdims=True)
    found = np.zeros((*faces.shape, values.shape[1]))
    found[point, ray] = np.einsum("hc,hci->hi", shares, values[mesh.faces[faces[point, ray] - 1]])
    return found


def test_sharpened_samples_are_right_in_the_mean():
    """A function that turns with the direction keeps its size when it is interpolated, on average over directions."""
    toward = directions(4000)
    expected = sh.evaluate(toward, 3)[:, 4:]  # second band
    sizes = []
    for change in (radiance._sharpen, lambda vectors: vectors):
        samples = sh.evaluate(sample_directions(16), 3)[..., 4:].astype(np.float32)
        corners = find_corners(np.zeros(3), 1.0, np.full(RADIANCE_SHELLS, 16), 2.4 * toward)
        on_shell = np.broadcast_to(change(samples).reshape(1, 256, 5), (RADIANCE_SHELLS, 256, 5)).reshape(-1, 5)
        found = corners.blend(on_shell)[0]
        sizes.append((found * expected).sum() / (expected**2).sum())
    assert sizes[0] == pytest.approx(1.0, abs=0.004)  # what is left is of the fourth order in the spacing
    assert sizes[1] < 0.98


def traced_vectors(mesh, basis, points, rays=12_000):
    """The functions' vectors [n, N, K] at points [n, 3], by rays all over the sphere."""
    toward = sphere.fibonacci_cap(rays)
    values = sh.evaluate(toward, ORDER) * (4 * np.pi / rays)
    return np.stack([(seen(mesh, basis, point[None], toward)[0].T @ values) for point in points])


@pytest.mark.parametrize("body", ["pin", "mug"])
def test_fields_are_what_rays_see(body, request):
    mesh, baked = request.getfixturevalue(body), request.getfixturevalue(f"baked_{body}")
    radii = np.random.default_rng(2).uniform(1.25, 3.2, 30)[:, None]
    points = mesh.center + mesh.radius * radii * directions(30)
    weights = np.random.default_rng(3).normal(size=(16, 10))
    expected = np.einsum("nik,iw->nwk", traced_vectors(mesh, baked.basis, points), weights)
    found = np.einsum("nik,iw->nwk", baked.field.lookup(points), weights)
    # Between samples 22 degrees of azimuth apart, the third band of a thin body bends by up to (3 * 0.2)^2 / 2.
    assert np.linalg.norm(found - expected) < 0.12 * np.linalg.norm(expected)
    # The light of the mean function, which carries the energy, falls on receivers that face the body.
    cosine = sh.zonal(sh.clamped_cosine(ORDER), (mesh.center - points) / (mesh.radius * radii))
    vectors = baked.field.lookup(points)[:, 0], traced_vectors(mesh, baked.basis[:, :1], points)[:, 0]
    fallen = [np.einsum("nk,nk->n", vector, cosine).sum() for vector in vectors]
    # 12,000 rays of which a tenth or less meet the body: 1 %; quantisation and the bend that is left: 1 %.
    assert fallen[0] == pytest.approx(fallen[1], rel=0.02)


def test_a_field_takes_about_a_megabyte(baked_pin, baked_mug):
    for baked in (baked_pin, baked_mug):
        assert baked.field.nbytes < 1.1e6
        assert baked.field.order == ORDER
        assert baked.field.functions == 16
        assert len(baked.field.covered) == baked.field.resolutions[FIRST_OUTER_SHELL] ** 2
        assert (baked.field.covered >= 0).all() and (baked.field.covered <= 1).all()


# The functions


def test_functions_are_orthogonal_and_the_mean_comes_first(baked_mug):
    basis, areas = baked_mug.basis.astype(np.float64), baked_mug.areas
    assert np.average(basis[:, 0], weights=areas) == pytest.approx(1.0, abs=1e-5)
    assert (basis[:, 0] >= 0).all()
    norms = weighted_norm(basis, areas)
    products = basis.T @ (basis * (areas / areas.sum())[:, None]) / np.outer(norms, norms)
    np.testing.assert_allclose(products, np.eye(16), atol=1e-4)  # float32
    assert (np.diff(norms[1:]) < 1e-6).all()  # by falling singular value
    assert norms[15] > 0.05


def test_areas_add_up(mug, baked_mug):
    assert baked_mug.areas.min() > 0
    corners = mug.vertices[mug.faces].astype(np.float64)
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    assert baked_mug.areas.sum() == pytest.approx(area, rel=1e-5)


def test_more_functions_represent_unseen_light_better(pin, device):
    warp_mesh = upload_mesh(pin, device)
    lights = pin.center + pin.radius * np.random.default_rng(7).uniform(1.6, 5.0, (40, 1)) * directions(40, seed=8)
    light = gather.light_surface(
        warp_mesh, radiance._off_surface(pin), pin.normals, lights, np.zeros(40), np.ones(40), device
    )
    errors = []
    for functions in (4, 8, 16, 32):
        baked = bake_functions(pin, functions=functions)
        count = min(128, len(baked.proxies))
        fit = baked.basis @ (baked.solver(count) @ light[baked.proxies[:count]])
        errors.append((weighted_norm(fit - light, baked.areas) / weighted_norm(light, baked.areas)).mean())
        # The least squares keep the energy: the mean function is there for it.
        assert (baked.areas @ fit).sum() == pytest.approx((baked.areas @ light).sum(), rel=0.01)
    assert errors == sorted(errors, reverse=True)
    assert errors[2] < 0.4 * errors[0]
    assert errors[2] < 0.15


@pytest.mark.parametrize("count", [32, 64, 256])
def test_the_solver_finds_the_weights_of_what_the_functions_can_make(baked_mug, count):
    weights = np.random.default_rng(5).normal(size=(16, 20))
    values = baked_mug.basis[baked_mug.proxies[:count]] @ weights
    solver = baked_mug.solver(count)
    assert solver.shape == (16, count)
    assert solver.dtype == np.float32
    # The ridge takes at most RIDGE / (smallest over mean eigenvalue), which is about 0.1 here, from a weight.
    np.testing.assert_allclose(solver @ values, weights, atol=0.02)


def test_the_solver_asks_for_as_many_proxies_as_there_are(baked_mug):
    assert len(baked_mug.proxies) == 256
    assert len(np.unique(baked_mug.proxies)) == 256
    for count in (0, 257):
        with pytest.raises(ValueError, match="256 proxies"):
            baked_mug.solver(count)


def test_proxies_spread_over_the_surface_and_its_two_sides(mug, baked_mug):
    first = baked_mug.proxies[:64]
    apart = np.linalg.norm(mug.vertices[:, None] - mug.vertices[first][None], axis=2)
    assert apart.min(axis=1).max() < 0.5 * mug.radius
    # The wall has proxies inside and outside.
    outward = mug.vertices * [1, 1, 0]
    side = (mug.normals * outward).sum(axis=1)[first] / np.maximum(np.linalg.norm(outward[first], axis=1), 1e-6)
    assert (side > 0.5).sum() > 10
    assert (side < -0.5).sum() > 5


def test_functions_do_not_depend_on_how_finely_the_surface_is_cut():
    coarse = make_mesh("ellipsoid", *bodies.ellipsoid((0.3, 0.2, 0.1), cells=10))
    fine = tessellate(coarse, 0.025)
    assert len(fine.vertices) > 3 * len(coarse.vertices)
    found = [bake_functions(mesh, functions=4) for mesh in (coarse, fine)]
    # Vertices keep their place when a mesh is tessellated; interpolated normals and areas differ a little.
    np.testing.assert_allclose(found[1].basis[: len(coarse.vertices)], found[0].basis, atol=0.05)


def test_the_dark_inside_of_a_hollow_body_has_functions(hollow):
    baked = bake_functions(hollow)
    inside = np.linalg.norm(hollow.vertices, axis=1) < 0.8
    assert inside.sum() == (~inside).sum()
    # The light of both sides counts alike.
    mean = np.average(baked.basis[inside, 0], weights=baked.areas[inside])
    assert 0.2 < mean < 5
    proxies = baked.proxies[:64]
    light = np.where(inside, 1.0, 0.0)
    fit = baked.basis @ (baked.solver(64) @ light[proxies])
    # An even glow of the cavity alone, half of the functions being the outside's.
    assert weighted_norm(fit - light, baked.areas) < 0.2


def test_buried_parts_have_no_light_and_no_proxies():
    ball, inner = primitives.sphere(1.0, subdivisions=3), primitives.sphere(0.5, subdivisions=2)
    faces = np.concatenate([ball.faces, inner.faces + len(ball.vertices)])
    mesh = make_mesh("buried", np.concatenate([ball.vertices, inner.vertices]), faces)
    baked = bake_functions(mesh, functions=4)
    buried = np.linalg.norm(mesh.vertices, axis=1) < 0.8
    assert not baked.basis[buried].any()
    assert not buried[baked.proxies].any()


# Light of a body on itself


def test_a_white_cavity_lights_itself_all_around(hollow, device):
    """Every point of a closed white cavity receives pi, whatever its shape; the outside of a ball nothing."""
    ones = np.ones((len(hollow.vertices), 4), np.float32)
    sight = radiance._look_at_itself(hollow, upload_mesh(hollow, device), device)
    assert sight is not None
    found = radiance._gather_on_itself(sight, ones, device)
    inside = np.linalg.norm(hollow.vertices, axis=1) < 0.8
    np.testing.assert_allclose(found[inside], np.pi, rtol=0.005)  # rays through an edge between faces
    np.testing.assert_allclose(found[~inside], 0.0)


def test_light_of_a_mug_on_itself_is_what_rays_see(mug, baked_mug):
    random = np.random.default_rng(6)
    chosen = random.choice(len(mug.vertices), 60, replace=False)
    rays = sphere.fibonacci_cap(10_000)
    points = mug.vertices[chosen] + 1e-3 * mug.radius * mug.normals[chosen]
    cosine = np.maximum(mug.normals[chosen] @ rays.T, 0) * (4 * np.pi / len(rays))
    expected = np.einsum("nqi,nq->ni", seen(mug, baked_mug.basis, points, rays), cosine)
    found = baked_mug.self_irradiance[chosen]
    assert np.abs(expected[:, 0]).max() > 0.5  # the inside of the mug lights itself
    # 512 rays spread as the cosine: 3 / 512^(3/4) of pi where the functions are about 1.
    np.testing.assert_allclose(found, expected, atol=0.09)
    assert np.sqrt(((found - expected) ** 2).mean()) < 0.02
    assert found[:, 0].sum() == pytest.approx(expected[:, 0].sum(), rel=0.02)


def test_convex_bodies_do_not_light_themselves(baked_pin):
    assert bake_functions(primitives.capsule(0.3, 0.5), functions=4).self_irradiance is None
    assert baked_pin.self_irradiance is not None


# Scale, repetition, odd meshes, the cache


def test_the_size_of_a_body_changes_nothing_but_its_size(pin, baked_pin):
    large = bake_radiance(scaled(pin, 64.0), use_cache=False)  # a power of two: float32 rounds alike
    np.testing.assert_allclose(large.basis, baked_pin.basis, atol=2e-3)
    np.testing.assert_allclose(large.self_irradiance, baked_pin.self_irradiance, atol=0.02)  # a ray along an edge
    np.testing.assert_array_equal(large.proxies[:32], baked_pin.proxies[:32])
    np.testing.assert_allclose(large.areas, 64.0**2 * baked_pin.areas, rtol=1e-5)
    points = baked_pin.field.center + baked_pin.field.radius * 1.7 * directions(50)
    np.testing.assert_allclose(large.field.lookup(64.0 * points), baked_pin.field.lookup(points), atol=0.02)


def test_baking_twice_gives_the_same_bits(mug, baked_mug):
    one, other = baked_mug, bake_radiance(mug, use_cache=False)
    for name in ("basis", "areas", "proxies", "self_irradiance"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    for name in ("resolutions", "codes", "minimum", "step", "covered"):
        np.testing.assert_array_equal(getattr(one.field, name), getattr(other.field, name))


def test_a_mesh_of_fewer_vertices_than_functions_has_finite_weights():
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float64)
    mesh = make_mesh("tetrahedron", corners, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]), smooth_angle=np.pi)
    baked = bake_functions(mesh)
    assert baked.basis.shape == (4, 16)
    assert len(baked.proxies) == 4
    for count in (1, 4):
        assert np.isfinite(baked.solver(count)).all()
    # As many functions as vertices make any light; the others are zero.
    light = np.array([1.0, 0.5, 2.0, 0.0])
    np.testing.assert_allclose(baked.basis @ (baked.solver(4) @ light[baked.proxies]), light, atol=0.01)
    assert not baked.basis[:, 4:].any()


def test_what_cannot_be_baked_is_refused(pin):
    with pytest.raises(ValueError, match="is a box or a rectangle"):
        bake_radiance(primitives.box((1, 1, 1)))
    with pytest.raises(ValueError, match="cannot bake 7 basis functions"):
        bake_radiance(pin, functions=7)
    with pytest.raises(ValueError, match="cannot bake order 9"):
        bake_radiance(pin, order=9)


def test_bakes_are_kept_and_broken_ones_baked_again(monkeypatch, tmp_path):
    monkeypatch.setenv("WARP_PSF_CACHE", str(tmp_path))
    monkeypatch.setattr(radiance, "FINEST_RADIANCE_RESOLUTION", 8)
    mesh = primitives.capsule(0.3, 0.5)
    shares, again = [], []
    baked = bake_radiance(mesh, functions=4, progress=shares.append)
    assert shares == sorted(set(shares))
    assert len(shares) > 10
    assert shares[-1] == 1.0
    kept = bake_radiance(mesh, functions=4, progress=again.append)
    assert again == [1.0]
    np.testing.assert_array_equal(kept.basis, baked.basis)
    np.testing.assert_array_equal(kept.field.codes, baked.field.codes)
    np.testing.assert_array_equal(kept.solver(20), baked.solver(20))
    assert kept.field.radius == baked.field.radius
    (file,) = cache_folder().glob("*.field")
    key = file.stem
    field, unit = replace(baked.field, covered=baked.field.covered[:-1]), unit_shape(mesh)
    radiance.save_radiance(key, unit, baked.basis, baked.proxies, baked.self_irradiance, field)
    with pytest.warns(UserWarning, match="wrong 'covered'"):
        bake_radiance(mesh, functions=4)
    radiance.save_radiance(key, unit, baked.basis, baked.proxies + 10**6, None, baked.field)
    with pytest.warns(UserWarning, match="wrong 'proxies'"):
        mended = bake_radiance(mesh, functions=4)
    np.testing.assert_array_equal(mended.proxies, baked.proxies)


def test_fields_of_other_settings_are_kept_apart(pin, baked_pin):
    assert bake_radiance(pin, threshold=None).field.nbytes > baked_pin.field.nbytes
    assert bake_radiance(pin, order=2, functions=4).field.codes.shape[1:] == (4, 4)


@pytest.mark.parametrize("open_side", ["outside", "inside"])
def test_open_surfaces_shine_on_the_side_of_their_faces(open_side):
    ball = primitives.sphere(1.0, subdivisions=3)
    upper = ball.vertices[ball.faces].mean(axis=1)[:, 2] > 0
    faces = ball.faces[upper] if open_side == "outside" else ball.faces[upper][:, ::-1]
    with pytest.warns(UserWarning, match="open"):
        dome = make_mesh("dome", ball.vertices, faces)
    baked = bake_functions(dome, functions=4)
    above, below = baked.field.lookup(dome.center + np.array([[0, 0, 2.0], [0, 0, -2.0]]))[:, 0, 0]
    bright, dim = (above, below) if open_side == "outside" else (below, above)
    assert bright > 0.1
    assert abs(dim) < 0.05 * bright
