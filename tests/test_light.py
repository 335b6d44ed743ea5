"""Lights and environments: closed forms, conventions, files and every error."""

from __future__ import annotations

import numpy as np
import OpenEXR
import pytest

from warp_psf.basis import sh, sphere
from warp_psf.scene import environment, light, primitives
from warp_psf.scene.environment import BUILT_IN, Environment, load_environment
from warp_psf.scene.light import AreaLight, DeltaLight, rectangle_light, sphere_light

BLACK = np.zeros(3)


def image(rows: int = 16, columns: int = 32, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).random((rows, columns, 3)).astype(np.float32)


def radiance_file(pixels: np.ndarray, size_line: bytes | None = None, header: bytes = b"") -> bytes:
    """A Radiance image of rgbe bytes [rows, columns, 4], scanlines run-length encoded as literal runs."""
    rows, columns = pixels.shape[:2]
    size_line = size_line or b"-Y %d +X %d" % (rows, columns)
    content = b"#?RADIANCE\n" + header + b"FORMAT=32-bit_rle_rgbe\n\n" + size_line + b"\n"
    for row in pixels:
        content += bytes((2, 2, columns >> 8, columns & 255))
        for channel in row.T:
            for start in range(0, columns, 128):
                run = channel[start : start + 128]
                content += bytes((len(run),)) + run.tobytes()
    return content


def rgbe(rows: int = 6, columns: int = 16) -> tuple[np.ndarray, np.ndarray]:
    """Random rgbe bytes [rows, columns, 4] and the radiance [rows, columns, 3] that they mean."""
    pixels = np.random.default_rng(3).integers(1, 255, (rows, columns, 4), dtype=np.uint8)
    pixels[..., 3] = 126 + pixels[..., 3] % 5
    return pixels, pixels[..., :3] * 2.0 ** (pixels[..., 3:].astype(int) - 136)


# Environments


@pytest.mark.parametrize("shape", [(1, 1), (2, 3), (16, 32), (65, 130)])
def test_white_projects_to_one_coefficient(shape):
    coefficients = Environment("white", np.full((*shape, 3), 2.5)).project(6)
    expected = np.zeros((36, 3))
    expected[0] = np.sqrt(4.0 * np.pi) * 2.5
    np.testing.assert_allclose(coefficients, expected, atol=1e-12)


def test_hemisphere_projects_to_its_closed_form():
    radiance = np.zeros((8, 4, 3))
    radiance[:4] = 1.0
    coefficients = Environment("upper half", radiance).project(3)[:, 0]
    # Over z > 0 the integral of y_10 = sqrt(3 / 4 pi) z is sqrt(3 pi) / 2, that of y_20 vanishes.
    expected = np.array([np.sqrt(np.pi), 0.0, np.sqrt(3.0 * np.pi) / 2.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(coefficients, expected, atol=1e-12)


def test_projection_is_the_integral_over_cells():
    radiance = image(5, 7)
    fine = np.repeat(np.repeat(radiance, 80, axis=0), 80, axis=1)
    directions = sphere.latlong_directions(*fine.shape[:2]).reshape(-1, 3)
    solid_angles = sphere.latlong_solid_angles(*fine.shape[:2]).ravel()
    summed = sh.project(fine.reshape(-1, 3).T, directions, solid_angles, 5).T
    np.testing.assert_allclose(Environment("cells", radiance).project(5), summed, atol=1e-4)


def test_image_convention():
    radiance = np.zeros((4, 8, 3))
    radiance[1, 2] = 1.0
    direction = sphere.latlong_directions(4, 8)[1, 2]
    azimuth = np.arctan2(direction[1], direction[0])
    assert azimuth == pytest.approx(2.0 * np.pi * 2.5 / 8)
    env = Environment("dot", radiance)
    np.testing.assert_allclose(env.lookup(direction), 1.0)
    first_band = env.project(2)[[3, 1, 2], 0]
    np.testing.assert_allclose(first_band[:2] / np.hypot(*first_band[:2]), [np.cos(azimuth), np.sin(azimuth)])
    assert first_band[2] > 0.0


def test_lookup_is_bilinear_and_periodic():
    env = Environment("random", image())
    directions = sphere.latlong_directions(16, 32)
    np.testing.assert_allclose(env.lookup(3.0 * directions), env.radiance, atol=1e-6)
    theta = np.pi * 5.5 / 16
    seam = [np.sin(theta), 0.0, np.cos(theta)]
    np.testing.assert_allclose(env.lookup(seam), 0.5 * (env.radiance[5, 0] + env.radiance[5, -1]), atol=1e-6)
    np.testing.assert_allclose(env.lookup([0.0, 0.0, -1.0]).shape, 3)


def test_rotation_turns_images_and_coefficients_alike():
    env = Environment("random", image())
    angle = 2.0 * np.pi * 5 / 32
    np.testing.assert_array_equal(env.rotated(angle).radiance, np.roll(env.radiance, 5, axis=1))
    turn = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    rotated = sh.rotate(env.project(4).T, turn).T
    np.testing.assert_allclose(env.rotated(angle).project(4), rotated, atol=1e-6)
    smooth = Environment.from_coefficients(env.project(4))
    np.testing.assert_allclose(smooth.rotated(angle).project(4), rotated, atol=1e-6)
    half = env.rotated(2.0 * np.pi * 2.5 / 32).radiance
    between = 0.5 * (np.roll(env.radiance, 2, axis=1) + np.roll(env.radiance, 3, axis=1))
    np.testing.assert_allclose(half, between, atol=1e-6)


def test_coefficients_are_kept_exactly():
    coefficients = np.random.default_rng(2).normal(size=(16, 3))
    env = Environment.from_coefficients(coefficients)
    np.testing.assert_array_equal(env.project(4), coefficients)
    np.testing.assert_array_equal(env.project(2), coefficients[:4])
    np.testing.assert_array_equal(env.project(5), np.concatenate([coefficients, np.zeros((9, 3))]))
    assert env.radiance.min() == 0.0
    white = Environment.from_coefficients(np.full((1, 3), np.sqrt(4.0 * np.pi)))
    assert white.mean_luminance() == pytest.approx(1.0)
    np.testing.assert_allclose(white.radiance, 1.0, atol=1e-6)


@pytest.mark.parametrize("name", BUILT_IN)
def test_built_in(name):
    env = load_environment(name)
    assert env.radiance.shape == (128, 256, 3)
    assert 0.5 <= env.mean_luminance() <= 1.0
    coefficients = env.project(4)
    # A white floor under it has luminance 1: its irradiance is pi, summed here over the bands of the clamped cosine.
    floor = sh.double_product(coefficients.T, sh.zonal(sh.clamped_cosine(4), np.array([0.0, 0.0, 1.0])))
    assert floor @ environment.LUMINANCE == pytest.approx(np.pi, rel=0.02)
    # Smooth enough that four bands hold it: hardly any light is negative after the projection.
    directions = sphere.latlong_directions(32, 64)
    light_of_bands = sh.evaluate(directions, 4) @ coefficients * sphere.latlong_solid_angles(32, 64)[..., None]
    assert -np.minimum(light_of_bands, 0.0).sum() < 1e-3 * light_of_bands.sum()


def test_values_that_are_environments():
    assert load_environment(None) is None
    env = load_environment("studio")
    assert load_environment(env) is env
    np.testing.assert_array_equal(load_environment(image()).radiance, image())


def test_large_images_keep_their_light():
    large = image(700, 1500)
    small = load_environment(large)
    assert small.radiance.shape == (512, 1024, 3)
    np.testing.assert_allclose(small.project(4), Environment("large", large).project(4), atol=2e-4)
    np.testing.assert_array_equal(environment.shrink(np.ones((1024, 2048, 3), np.float32)), np.ones((512, 1024, 3)))


@pytest.mark.parametrize(
    ("radiance", "message"),
    [
        (np.ones((4, 8)), r"shape \(4, 8\)"),
        (np.ones((4, 8, 4)), r"shape \(4, 8, 4\)"),
        (np.ones((0, 8, 3)), r"shape \(0, 8, 3\)"),
        ([[["a"]]], "not an array of numbers"),
        (np.where(np.arange(96).reshape(4, 8, 3) == 7, np.nan, 1.0), "1 of 32 pixels are NaN or infinite"),
        (np.where(np.arange(96).reshape(4, 8, 3) < 6, -2.0, 1.0), r"2 of 32 pixels are negative \(lowest -2\)"),
    ],
)
def test_bad_radiance(radiance, message):
    with pytest.raises(ValueError, match=message):
        load_environment(radiance)


@pytest.mark.parametrize(
    ("coefficients", "message"),
    [(np.ones(4), "shape"), (np.ones((5, 3)), "5 is not a number"), (np.full((4, 3), np.nan), "finite")],
)
def test_bad_coefficients(coefficients, message):
    with pytest.raises(ValueError, match=message):
        Environment.from_coefficients(coefficients)


# Files


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_exr(tmp_path, dtype):
    pixels = image().astype(dtype)
    path = tmp_path / "env.exr"
    OpenEXR.File({"type": OpenEXR.scanlineimage}, {"RGB": pixels}).write(str(path))
    env = load_environment(path)
    assert env.name == "env.exr"
    np.testing.assert_array_equal(env.radiance, pixels.astype(np.float32))


def test_exr_of_one_channel_and_of_others(tmp_path):
    path = tmp_path / "y.EXR"
    OpenEXR.File({"type": OpenEXR.scanlineimage}, {"Y": image()[..., 0].copy()}).write(str(path))
    np.testing.assert_array_equal(load_environment(str(path)).radiance, np.repeat(image()[..., :1], 3, axis=2))
    OpenEXR.File({"type": OpenEXR.scanlineimage}, {"Z": image()[..., 0].copy()}).write(str(path))
    with pytest.raises(ValueError, match=r"channels \['Z'\]; give R, G and B"):
        load_environment(path)


@pytest.mark.parametrize("header", [b"", b"#?RADIANCE\n# a comment\nEXPOSURE=1.0\n"])
def test_hdr(tmp_path, header):
    pixels, radiance = rgbe()
    path = tmp_path / "env.hdr"
    path.write_bytes(radiance_file(pixels, header=header))
    np.testing.assert_allclose(load_environment(path).radiance, radiance, rtol=1e-6)


def test_hdr_without_runs(tmp_path):
    pixels, radiance = rgbe(3, 5)
    path = tmp_path / "flat.hdr"
    path.write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 3 +X 5\n" + pixels.tobytes())
    np.testing.assert_allclose(load_environment(path).radiance, radiance, rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("env.hdr", radiance_file(rgbe()[0])[:-100], "damaged or cut short"),
        ("env.hdr", b"nothing of the kind", "not a Radiance image"),
        ("env.hdr", b"", "not a Radiance image"),
        ("env.hdr", radiance_file(rgbe()[0], b"-Y 0 +X 16"), "16 x 0 pixels"),
        ("env.hdr", radiance_file(rgbe()[0], b"-Y 900000 +X 900000"), "900000 x 900000 pixels"),
        ("env.hdr", radiance_file(rgbe()[0], b"+X 16 -Y 6"), "usual order"),
        ("env.hdr", radiance_file(rgbe()[0]).replace(b"rgbe", b"xyze"), "only Radiance images in RGB"),
        ("env.exr", b"nothing of the kind", "not a readable OpenEXR image"),
        ("env.exr", b"", "not a readable OpenEXR image"),
        ("env.png", b"", r"'.*\.png': \.png extension"),
    ],
)
def test_bad_files(tmp_path, name, content, message):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(ValueError, match=message) as caught:
        load_environment(path)
    assert "\n" not in str(caught.value)


def test_truncated_exr(tmp_path):
    path = tmp_path / "env.exr"
    OpenEXR.File({"type": OpenEXR.scanlineimage}, {"RGB": image()}).write(str(path))
    path.write_bytes(path.read_bytes()[:900])
    with pytest.raises(ValueError, match=r"env\.exr.* damaged or cut short"):
        load_environment(path)


def test_no_such_environment(tmp_path):
    with pytest.raises(FileNotFoundError, match="built-in ones are studio, sky, sunset, overcast"):
        load_environment("studoi")
    with pytest.raises(FileNotFoundError, match=r"missing\.exr"):
        load_environment(tmp_path / "missing.exr")
    with pytest.raises(TypeError, match="environment is a int"):
        load_environment(3)


# Lights


def test_rectangle_light_faces_its_target():
    lamp = rectangle_light("lamp", 0.4, 0.2, [1.0, 2.0, 3.0], [1.0, 2.0, 3.0], target=[1.0, 5.0, 3.0])
    np.testing.assert_allclose(lamp.rotation[:, 2], [0.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(lamp.rotation), 1.0)
    assert lamp.rotation[2, 0] == 0.0
    assert lamp.mesh.slab is not None
    np.testing.assert_allclose(np.sort(lamp.mesh.slab[2]), [0.0, 0.1, 0.2], atol=1e-7)
    np.testing.assert_allclose(lamp.mesh.normals, np.broadcast_to([0.0, 0.0, 1.0], lamp.mesh.normals.shape))


def test_rectangle_light_straight_down_and_by_rotation():
    down = rectangle_light("lamp", 1.0, 1.0, [1.0, 1.0, 1.0], [0.0, 0.0, 3.0], target=[0.0, 0.0, 0.0])
    np.testing.assert_allclose(down.rotation @ [0.0, 0.0, 1.0], [0.0, 0.0, -1.0])
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_array_equal(rectangle_light("lamp", 1, 1, [1, 1, 1], [0, 0, 1], rotation=turn).rotation, turn)
    np.testing.assert_array_equal(rectangle_light("lamp", 1, 1, [1, 1, 1], [0, 0, 1]).rotation, np.eye(3))


def test_a_sphere_light_is_a_sphere_about_its_position():
    lamp = sphere_light("lamp", 0.3, [1.0, 2.0, 3.0], [0.0, 1.0, 2.0], body="arm")
    assert lamp.mesh.sphere == pytest.approx(0.3)
    np.testing.assert_array_equal(lamp.position, [0.0, 1.0, 2.0])
    assert lamp.body == "arm"
    for radius in (0.0, -1.0, np.nan, np.inf, "wide", None):
        with pytest.raises(ValueError, match=f"light 'lamp': radius is {radius!r}; give a positive number of metres"):
            sphere_light("lamp", radius, [1.0, 1.0, 1.0], [0.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"radiance": [1.0, np.nan, 1.0]}, "'lamp': radiance .* finite"),
        ({"radiance": [1.0, -1.0, 1.0]}, "radiance .* negative"),
        ({"radiance": 1.0}, r"radiance has shape \(\)"),
        ({"radiance": "red"}, "radiance is 'red'"),
        ({"position": [0.0, np.inf, 0.0]}, "position"),
        ({"rotation": 2.0 * np.eye(3)}, "not a rotation matrix"),
        ({"rotation": np.diag([1.0, 1.0, -1.0])}, "not a rotation matrix"),
        ({"rotation": np.full((3, 3), np.nan)}, "rotation .* finite"),
        ({"rotation": np.eye(4)}, "give 3 x 3 numbers"),
    ],
)
def test_bad_area_light(changes, message):
    values = {"radiance": [1.0, 1.0, 1.0]} | changes
    with pytest.raises(ValueError, match=message):
        AreaLight("lamp", primitives.plane(1.0, 1.0, cells=1), **values)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"width": 0.0}, "width is 0.0"),
        ({"height": np.nan}, "height is nan"),
        ({"target": [0.0, 0.0, 1.0]}, "no length"),
        ({"target": [0.0, 0.0, 0.0], "rotation": np.eye(3)}, "give one of them"),
    ],
)
def test_bad_rectangle_light(arguments, message):
    values = {"width": 1.0, "height": 1.0, "radiance": np.ones(3), "position": [0.0, 0.0, 1.0]} | arguments
    with pytest.raises(ValueError, match=message):
        rectangle_light("lamp", **values)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kind": "area"}, "kind 'area' is unknown"),
        ({"direction": BLACK}, "direction .* no length"),
        ({"diffuse": [-1.0, 0.0, 0.0]}, "diffuse .* negative"),
        ({"radius": -1.0}, "radius is -1.0"),
        ({"cutoff": np.nan}, "cutoff is nan"),
    ],
)
def test_bad_delta_light(changes, message):
    values = {"kind": "spot", "position": BLACK, "direction": [0.0, 0.0, -2.0]}
    values |= {"diffuse": BLACK, "specular": BLACK, "ambient": BLACK}
    np.testing.assert_array_equal(DeltaLight("good", **values).direction, [0.0, 0.0, -1.0])
    with pytest.raises(ValueError, match=message):
        DeltaLight("bad", **(values | changes))


def test_light_is_either_kind():
    assert set(light.Light.__args__) == {AreaLight, DeltaLight}
