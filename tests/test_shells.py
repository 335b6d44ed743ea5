"""Fields on shells: quantisation, and the Warp lookup against its NumPy twin and against what a field must be."""

import numpy as np
import pytest
import warp as wp

from warp_psf.basis import sphere
from warp_psf.device import find_device, launch, upload_tables
from warp_psf.field.shells import (
    FIRST_OUTER_SHELL,
    SHELL_COUNT,
    lookup,
    make_fields,
    quantise,
    sample_directions,
    shell_radii,
    upload_fields,
)

ORDER = 3
COEFFICIENTS = ORDER * ORDER
MIXED = np.resize([8, 64, 16, 32, 8, 8, 16], SHELL_COUNT)


def random_field(seed, resolutions, radius=0.7, center=(0.1, -0.2, 0.3)):
    random = np.random.default_rng(seed)
    # Of different spread per coefficient, so that a mistaken step or minimum shows.
    spread = random.uniform(0.1, 3.0, COEFFICIENTS)
    shells = [spread * random.normal(size=(r, r, COEFFICIENTS)) for r in resolutions]
    return quantise(np.array(center), radius, shells), shells


@pytest.fixture(scope="module")
def fields():
    return [
        random_field(1, MIXED)[0],
        random_field(2, MIXED[::-1], radius=2.0, center=(0.0, 0.0, 0.0))[0],
    ]


@pytest.fixture(scope="module")
def look_up(fields):
    """Looks points [N, 3] up in one of the two fields of a table."""
    device = find_device("cpu")
    kit = make_fields(ORDER)
    tables = upload_tables([upload_fields(fields, ORDER, device)], kit.FieldTable, device)

    @wp.kernel(module="unique")
    def look_up_points(
        first: int,
        tables: wp.array(dtype=kit.FieldTable),
        field: int,
        points: wp.array(dtype=wp.vec3),
        vectors_out: wp.array(dtype=kit.vec),
    ):
        world, item = wp.tid()
        item += first
        vectors_out[item] = kit.lookup_coverage(tables, 0, field, points[item])

    def run(field, points):
        out = wp.zeros(len(points), dtype=kit.vec, device=device)
        points = wp.array(np.asarray(points, np.float32), dtype=wp.vec3, device=device)
        launch(look_up_points, (1, len(points)), [tables, field, points], [out], device)
        return out.numpy()

    return run


def directions(count, seed=3):
    vectors = np.random.default_rng(seed).normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def points_at(field, radii, toward):
    return field.center + np.reshape(radii, (-1, 1)) * field.radius * toward


def test_quantisation_is_off_by_at_most_half_a_step():
    field, shells = random_field(5, MIXED)
    exact = np.concatenate([shell.reshape(-1, COEFFICIENTS) for shell in shells])
    half_step = 0.5 * np.repeat(field.step, MIXED**2, axis=0)
    # 1e-5 of the range covers float32, in which minimum and step are kept.
    assert np.all(np.abs(field.dequantised() - exact) <= half_step * 1.001 + 255 * half_step * 1e-5)
    assert field.order == ORDER
    assert field.codes.dtype == np.uint8
    assert field.nbytes == (MIXED**2).sum() * COEFFICIENTS + 2 * 4 * SHELL_COUNT * COEFFICIENTS


def test_a_constant_shell_is_kept_exactly():
    values = np.linspace(-2, 2, COEFFICIENTS)
    field = quantise(np.zeros(3), 1.0, [np.broadcast_to(values, (8, 8, COEFFICIENTS))] * SHELL_COUNT)
    np.testing.assert_array_equal(field.dequantised(), np.broadcast_to(values.astype(np.float32), (64 * 32, 9)))


def test_sample_directions_are_the_cells_of_a_latlong_image():
    np.testing.assert_allclose(sample_directions(16), sphere.latlong_directions(16, 16), atol=1e-14)


@pytest.mark.parametrize("field", [0, 1])
def test_warp_and_numpy_agree(fields, look_up, field):
    random = np.random.default_rng(4)
    radii = np.exp(random.uniform(np.log(0.02), np.log(20), 2000))  # from within the first shell to far beyond the last
    points = points_at(fields[field], radii, directions(2000))
    # Random neighbours differ by several units across a cell, so that float32 coordinates leave about 1e-3.
    np.testing.assert_allclose(look_up(field, points), lookup(fields[field], points), atol=4e-3)


def test_samples_are_returned_where_they_stand(fields):
    field = fields[0]
    first = np.cumsum(MIXED**2) - MIXED**2
    for shell, resolution in enumerate(MIXED):
        points = field.center + shell_radii(field.radius)[shell] * sample_directions(resolution).reshape(-1, 3)
        expected = field.dequantised()[first[shell] : first[shell] + resolution**2]
        np.testing.assert_allclose(lookup(field, points), expected, atol=1e-4)  # center is float32


def test_a_field_is_continuous_across_the_seam(fields, look_up):
    field = fields[0]
    theta = np.random.default_rng(6).uniform(0.1, np.pi - 0.1, 200)
    radii = np.random.default_rng(7).uniform(0.1, 8, 200)
    values = []
    for phi in (np.pi - 1e-6, -np.pi + 1e-6):
        toward = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=1)
        values.append(look_up(0, points_at(field, radii, toward)))
        np.testing.assert_allclose(values[-1], lookup(field, points_at(field, radii, toward)), atol=4e-3)
    np.testing.assert_allclose(*values, atol=4e-3)


def test_the_poles_mean_the_samples_around_them(fields, look_up):
    field = fields[0]
    samples = field.dequantised().astype(float)
    first = np.cumsum(MIXED**2) - MIXED**2
    for shell in (1, 4, 31):
        for z, row in ((1.0, 0), (-1.0, MIXED[shell] - 1)):
            point = points_at(field, [0.2 * (1 + shell)], np.array([[0.0, 0.0, z]]))
            around = samples[first[shell] + row * MIXED[shell] :][: MIXED[shell]]
            # At azimuth 0 exactly: the mean of the four samples on both sides of azimuth 0 and of pi.
            half = MIXED[shell] // 2
            expected = around[[0, -1, half, half - 1]].mean(axis=0)
            np.testing.assert_allclose(lookup(field, point)[0], expected, atol=1e-4)
            np.testing.assert_allclose(look_up(0, point)[0], expected, atol=4e-3)


def test_a_smooth_function_is_smooth_across_the_poles(look_up):
    """A linear function of the direction, sampled: near the pole it comes back without a jump between azimuths."""
    shells = [sample_directions(32) @ np.eye(3, COEFFICIENTS)] * SHELL_COUNT
    field = quantise(np.zeros(3), 1.0, shells)
    phi = np.linspace(-np.pi, np.pi, 60)
    for tilt in (1e-4, 0.02, 0.05):
        toward = np.stack([np.sin(tilt) * np.cos(phi), np.sin(tilt) * np.sin(phi), np.full(60, np.cos(tilt))], axis=1)
        found = lookup(field, 3.0 * toward)[:, :3]
        # Half a quantisation step (1/255) and the bend of the sphere over half a cell: 0.05^2 / 2.
        np.testing.assert_allclose(found, toward, atol=0.004 + 0.0015)


def test_beyond_the_last_shell_a_field_falls_as_solid_angle(fields, look_up):
    field = fields[0]
    toward = directions(50)
    last = 0.2 * SHELL_COUNT
    at_last = look_up(0, points_at(field, np.full(50, last), toward))
    for times in (1.5, 10.0, 1000.0):
        found = look_up(0, points_at(field, np.full(50, times * last), toward))
        np.testing.assert_allclose(found * times**2, at_last, atol=2e-2)


def test_within_the_first_shell_a_field_is_that_of_the_first(fields, look_up):
    field = fields[0]
    toward = directions(50)
    for radius in (0.01, 0.1, 0.2):
        points = points_at(field, np.full(50, radius), toward)
        on_first = lookup(field, points_at(field, np.full(50, 0.2), toward))
        np.testing.assert_allclose(look_up(0, points), on_first, atol=4e-3)
    assert np.isfinite(look_up(0, field.center[None])).all()
    assert np.isfinite(lookup(field, field.center[None])).all()


def test_outside_the_bounding_sphere_solid_angle_is_interpolated_exactly():
    """A constant over r^2 on every shell comes back at every radius between the outer shells and beyond.

    It covers too little of the sphere to be the surface of a body that touches the bounding sphere.
    """
    radii = shell_radii(1.0)
    shells = [np.full((8, 8, COEFFICIENTS), 1e-6 / r**2) for r in radii]
    field = quantise(np.zeros(3), 1.0, shells)
    between = np.random.default_rng(8).uniform(radii[FIRST_OUTER_SHELL], 30.0, 300)
    found = lookup(field, points_at(field, between, directions(300)))
    np.testing.assert_allclose(found, np.broadcast_to(1e-6 / between[:, None] ** 2, found.shape), rtol=1e-5)


def test_an_empty_table_can_be_uploaded():
    table = upload_fields([], ORDER, find_device("cpu"))
    assert table.codes.shape == (0,)
    assert table.shell_first.shape == (0, SHELL_COUNT)


def test_right_above_a_surface_coverage_falls_as_the_root_of_the_height():
    """Between the first outer shells, the solid angle of a sphere's cap: fully covered hemispheres at its surface."""
    radii = shell_radii(1.0)
    covered = 1 - np.sqrt(np.clip(1 - 1 / np.maximum(radii, 1) ** 2, 0, None))
    shells = [np.full((8, 8, COEFFICIENTS), share * np.sqrt(np.pi)) for share in covered]
    field = quantise(np.zeros(3), 1.0, shells)
    between = np.linspace(1.0, 1.2, 30)
    found = lookup(field, points_at(field, between, directions(30)))[:, 0] / np.sqrt(np.pi)
    np.testing.assert_allclose(found, 1 - np.sqrt(1 - 1 / between**2), atol=1e-6)
