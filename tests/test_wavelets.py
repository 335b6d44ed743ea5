"""All-frequency fields by wavelets: coverage against closed forms, what is cut off, and lookups on host and device."""

from dataclasses import replace

import numpy as np
import pytest

from sims.bodies import pin
from warp_psf.bake import wavelets
from warp_psf.bake.adapt import interpolate_double
from warp_psf.bake.body import upload_mesh
from warp_psf.bake.wavelets import (
    MOST_ENTRIES,
    bake_wavelet_fields,
    bake_wavelet_radiance_field,
    cast_maps,
    code_shell,
    map_error,
    sparsify,
)
from warp_psf.basis import haar
from warp_psf.device import find_device
from warp_psf.field import wavelets as field_wavelets
from warp_psf.field.shells import SHELL_SPACING, sample_directions
from warp_psf.field.wavelets import CELLS, MAP_SIZE, WaveletField, coefficient_levels
from warp_psf.scene import primitives
from warp_psf.scene.mesh import make_mesh

# What these tests bake: shells out to 1.6 radii or further, and so many samples per axis to begin with.
SHELLS, MORE_SHELLS, RESOLUTION = 8, 12, 16
DIRECTIONS = haar.map_directions(MAP_SIZE).reshape(-1, 3)


def bake(mesh, thresholds=(None,), shells=SHELLS, **options):
    return bake_wavelet_fields(mesh, thresholds, shell_count=shells, resolution=RESOLUTION, **options)


def points_around(count, near=0.05, far=2.5, seed=0):
    """Points [count, 3] at `near` to `far` radii from the origin."""
    random = np.random.default_rng(seed)
    points = random.normal(size=(count, 3))
    return points * (random.uniform(near, far, count) / np.linalg.norm(points, axis=1))[:, None]


def samples_of(shell, radius=1.0):
    return SHELL_SPACING * (1 + shell) * radius * sample_directions(RESOLUTION).reshape(-1, 3)


@pytest.fixture(scope="module")
def ball():
    return primitives.sphere(1.0, subdivisions=4)


@pytest.fixture(scope="module")
def ball_field(ball):
    return bake(ball)[0]


@pytest.fixture(scope="module")
def tenpin():
    return make_mesh("pin", *pin(rings=31, segments=28))


@pytest.fixture(scope="module")
def pin_fields(tenpin):
    return bake(tenpin, (0.05, None, 0.02), MORE_SHELLS)


@pytest.mark.parametrize("shell", [5, 6, 7])
def test_a_sphere_covers_a_cap(ball_field, shell):
    points = samples_of(shell)
    sine = 1 / np.linalg.norm(points[0])
    maps = ball_field.lookup(points).reshape(-1, CELLS)
    cap = -points @ DIRECTIONS.T / np.linalg.norm(points[0]) > np.sqrt(1 - sine**2)
    # At a sample: 8 bits, what 205 coefficients cannot tell of an edge of 100 cells, and the few cells that the edge of
    # the icosphere, up to 0.2 % within the sphere's, misses: 25 of 4,096.
    assert map_error(maps - cap).max() < 0.008
    assert map_error(maps - cap).mean() < 0.003
    share = 0.5 * (1 - np.sqrt(1 - sine**2))
    # Counting cells: about 100 lie at the edge, each right or wrong by chance; sqrt(100) / 2 of 4,096.
    np.testing.assert_allclose(maps.mean(axis=1), share, atol=0.005)
    np.testing.assert_allclose(maps.mean(), share, atol=0.0015)


def test_between_samples_a_sphere_covers_as_much(ball_field):
    points = points_around(200, 1.2, 1.6)
    share = 0.5 * (1 - np.sqrt(1 - 1 / np.sum(points**2, axis=1)))
    # Samples stand 22 degrees apart in azimuth; they all cover the same share, and so do their mixtures. Between the
    # shells at 1.2 and 1.4 a weight in 1/r^2 is off by 2 % of the share.
    np.testing.assert_allclose(ball_field.lookup(points).mean(axis=(1, 2)), share, atol=0.007)


def test_inside_a_hollow_ball_everything_is_covered(ball):
    # Turned inside out, the ball has no inside that samples would have to leave.
    field = bake(replace(ball, faces=ball.faces[:, ::-1], sphere=None))[0]
    shells = 4 * RESOLUTION**2
    # A constant is its mean: one entry per sample.
    np.testing.assert_array_equal(np.diff(field.first)[:shells], 1)
    np.testing.assert_array_equal(field.index[:shells], 0)
    maps = field.lookup(points_around(50, 0.1, 0.79))
    np.testing.assert_allclose(maps, 1, atol=1e-6)


def test_what_nobody_reads_takes_one_entry(ball_field):
    # Of the ball's inside, the shells at 0.2 to 0.6 radii.
    shells = 3 * RESOLUTION**2
    np.testing.assert_array_equal(np.diff(ball_field.first)[:shells], 1)
    np.testing.assert_allclose(ball_field.dequantised(np.arange(shells))[:, 0, 0], np.sqrt(4 * np.pi), rtol=1e-6)


def test_the_largest_coefficients_are_kept(tenpin):
    device = find_device()
    outward = sample_directions(8).reshape(-1, 3)
    for shell, least in ((4, 0.985), (6, 0.999)):
        points = (tenpin.center + SHELL_SPACING * (1 + shell) * tenpin.radius * outward).astype(np.float32)
        maps = cast_maps(tenpin, upload_mesh(tenpin, device), shell, points, outward, device)
        vectors = haar.transform(maps.reshape(-1, MAP_SIZE, MAP_SIZE).astype(np.float64)).reshape(-1, CELLS)
        coded = sparsify(maps.reshape(8, 8, CELLS))
        assert coded.counts.max() <= MOST_ENTRIES == 205
        kept = np.zeros_like(vectors)
        rows = np.repeat(np.arange(len(maps)), coded.counts)
        level = coefficient_levels()[coded.index]
        kept[rows, coded.index] = coded.minimum[level] + coded.step[level] * coded.codes
        # 8 bits between the least and the largest of a level.
        stored = kept[rows, coded.index] - vectors[rows, coded.index]
        assert (np.abs(stored) <= 0.5 * coded.step[level] + 1e-6).all()
        energy = (vectors**2).sum(axis=1)
        largest = (haar.keep_largest(vectors.reshape(-1, MAP_SIZE, MAP_SIZE)) ** 2).sum(axis=(1, 2))
        lost = ((vectors - kept) ** 2).sum(axis=1)
        # On the bounding sphere a tenth of the coefficients is not zero, further out the edge is short enough for 205.
        assert (1 - lost / energy).min() > least
        # No other 205 keep more; the rest is what 8 bits cost.
        rounding = MOST_ENTRIES * (0.5 * coded.step.max()) ** 2
        assert (lost <= energy - largest + rounding).all()


def test_few_probes_find_what_all_rays_find(tenpin):
    device = find_device()
    outward = sample_directions(8).reshape(-1, 3)
    points = (tenpin.center + 0.8 * tenpin.radius * outward).astype(np.float32)
    warp_mesh = upload_mesh(tenpin, device)
    few = cast_maps(tenpin, warp_mesh, 3, points, outward, device)
    every = cast_maps(replace(tenpin, closed=False), warp_mesh, 3, points, outward, device)
    assert every.any()
    # A part narrower than two cells can be missed: the pin has none but its silhouette's tips.
    assert np.mean(few != every) < 1e-4


def test_equation_1_is_that_of_the_vectors():
    vectors = np.random.default_rng(1).normal(size=(3, 5, MAP_SIZE, MAP_SIZE))
    expected = np.abs(haar.inverse(vectors)).mean(axis=(2, 3))
    np.testing.assert_allclose(map_error(haar.inverse(vectors).reshape(3, 5, CELLS)), expected, rtol=1e-12)
    # A function that is c everywhere differs from zero by c.
    assert map_error(np.full((1, CELLS), -0.3)) == pytest.approx(0.3)


def test_adaptive_sampling_keeps_equation_1(pin_fields):
    coarse, full, fine = pin_fields
    assert (full.resolutions == RESOLUTION).all()
    assert (coarse.resolutions <= fine.resolutions).all()
    assert coarse.nbytes < fine.nbytes < full.nbytes
    for field, threshold in ((coarse, 0.05), (fine, 0.02)):
        counts = field.resolutions.astype(int) ** 2
        for shell in range(MORE_SHELLS):
            whole = full.dequantised(np.arange(RESOLUTION**2) + shell * RESOLUTION**2)
            samples = field.dequantised(np.arange(counts[shell]) + counts[:shell].sum())
            if counts[shell] == RESOLUTION**2:
                np.testing.assert_array_equal(samples, whole)
                continue
            size = field.resolutions[shell]
            assert size == RESOLUTION // 2
            between = interpolate_double(samples.reshape(size, size, CELLS)).reshape(whole.shape)
            errors = map_error(haar.inverse(whole - between).reshape(-1, CELLS))
            # The means of four maps have more coefficients than are kept: what is cut off comes on top.
            assert errors.max() < threshold + 0.004
    # Both happen here.
    assert set(coarse.resolutions) == set(fine.resolutions) == {8, 16}


def test_one_bake_serves_several_thresholds(tenpin, pin_fields):
    alone = bake(tenpin, (0.05,), MORE_SHELLS)[0]
    np.testing.assert_array_equal(alone.resolutions, pin_fields[0].resolutions)
    np.testing.assert_array_equal(alone.first, pin_fields[0].first)
    np.testing.assert_array_equal(alone.codes, pin_fields[0].codes)


def test_samples_that_nobody_reads_do_not_count():
    maps = np.zeros((16, 16, CELLS), np.uint8)
    maps[4:6, 7] = 1
    matters = np.ones((16, 16), bool)
    assert code_shell(maps, [0.01], matters, 1)[0].resolution == 16
    matters[1:9, 4:11] = False
    coded = code_shell(maps, [0.01], matters, 1)[0]
    assert coded.resolution == 8
    # New samples all of whose four are not read are covered all around: one entry.
    np.testing.assert_array_equal(coded.counts.reshape(8, 8)[1:4, 2:5], 1)


def test_a_glowing_ball_is_its_coverage(ball, ball_field):
    field = bake(ball, face_radiance=np.full(len(ball.faces), 2.5, np.float32))[0]
    points = samples_of(6)
    np.testing.assert_allclose(field.lookup(points), 2.5 * ball_field.lookup(points), atol=0.05)


def test_only_the_fronts_of_faces_shine(ball):
    radiance = np.where(ball.vertices[ball.faces].mean(axis=1)[:, 2] > 0, 1.0, 0.0).astype(np.float32)
    field = bake(ball, face_radiance=radiance)[0]
    above, below = field.lookup(np.array([[0, 0, 1.4], [0, 0, -1.4]])).mean(axis=(1, 2))
    # From above the upper half is all that is seen (0.15 of the sphere); from below none of it.
    assert above == pytest.approx(0.5 * (1 - np.sqrt(1 - 1 / 1.4**2)), abs=0.005)
    assert below == pytest.approx(0, abs=1e-3)


@pytest.mark.parametrize("field", ["coarse", "full"])
def test_the_kernel_does_what_the_host_does(tenpin, pin_fields, field, monkeypatch):
    # Receivers are served 32 at a time, and the last turn is not full.
    monkeypatch.setattr(field_wavelets, "TURN", 64)
    field = pin_fields[field == "full"]
    points = tenpin.center + tenpin.radius * points_around(150)
    lights = np.random.default_rng(5).uniform(size=(3, MAP_SIZE, MAP_SIZE)) ** 8
    worlds = np.stack([points, points[::-1]])
    found = field.double_products(worlds, lights)
    expected = np.einsum("nij,lij->nl", field.lookup(points), lights) * (4 * np.pi / CELLS)
    # float32 sums of up to 1,640 entries, and directions from polynomials that are good to 1e-7.
    np.testing.assert_allclose(found[0], expected, atol=3e-5)
    np.testing.assert_array_equal(found[1], found[0, ::-1])
    np.testing.assert_array_equal(field.double_products(points, lights), found[0])


def test_beyond_the_last_shell_coverage_falls_as_solid_angle(ball_field):
    direction = np.array([0.3, 0.5, 0.81]) / np.linalg.norm([0.3, 0.5, 0.81])
    near, far = ball_field.lookup(np.stack([1.6 * direction, 3.2 * direction]))
    np.testing.assert_allclose(far, near / 4, atol=1e-6)  # the radius is known to float32


def test_sizes_count_what_is_stored():
    field = WaveletField(
        center=np.zeros(3, np.float32),
        radius=1.0,
        resolutions=np.array([2, 1], np.int32),
        first=np.array([0, 3, 3, 4, 6, 7], np.int32),
        index=np.array([0, 5, 9, 0, 0, 7, 4095], np.uint16),
        codes=np.arange(7, dtype=np.uint8),
        minimum=np.zeros((2, 7), np.float32),
        step=np.ones((2, 7), np.float32),
    )
    # 7 codes, 7 places of 12 bits (11 bytes), 5 counts, and two floats per shell and level.
    assert field.nbytes == 7 + 11 + 5 + 2 * 2 * 7 * 4
    vectors = field.dequantised(np.array([4, 0, 1])).reshape(3, -1)
    np.testing.assert_array_equal(vectors[0, [0, 4095]], [0, 6])
    np.testing.assert_array_equal(vectors[1, [0, 5, 9, 7]], [0, 1, 2, 0])
    assert not vectors[2].any()


def test_fields_are_well_formed(pin_fields):
    for field in pin_fields:
        assert len(field.first) == 1 + (field.resolutions.astype(int) ** 2).sum()
        assert field.first[-1] == len(field.codes) == len(field.index)
        counts = np.diff(field.first)
        assert 0 <= counts.min() <= counts.max() <= MOST_ENTRIES
        sample = np.repeat(np.arange(len(counts)), counts)
        # Rising within each sample, which `first_coefficient` relies on.
        assert (np.diff(sample * CELLS + field.index) > 0).all()


def test_levels_are_those_of_the_transform():
    # The details of 2^k x 2^k blocks: a map of one cell has 3 of each, and the mean.
    spike = np.zeros((MAP_SIZE, MAP_SIZE))
    spike[37, 11] = 1
    level = coefficient_levels()[np.flatnonzero(np.abs(haar.transform(spike)) > 1e-9)]
    np.testing.assert_array_equal(np.bincount(level), [1, 3, 3, 3, 3, 3, 3])
    # Per level the coefficients are of one size, twice as large from one level to the next.
    sizes = [np.abs(haar.transform(spike)).ravel()[coefficient_levels() == k].max() for k in range(7)]
    np.testing.assert_allclose(sizes[2:], 2 * np.array(sizes[1:-1]), rtol=1e-9)


def test_bad_input_is_named(ball):
    for threshold in (-0.1, float("nan")):
        with pytest.raises(ValueError, match="threshold is"):
            wavelets.bake_wavelet_field(ball, threshold=threshold)
    for radiance in (np.ones(3), np.full(len(ball.faces), -1.0), np.full(len(ball.faces), np.nan)):
        with pytest.raises(ValueError, match="one per face"):
            bake_wavelet_radiance_field(ball, radiance)


def test_progress_ends_at_one(ball):
    shares = []
    bake(ball, progress=shares.append)
    assert shares == sorted(shares)
    assert shares[-1] == 1
