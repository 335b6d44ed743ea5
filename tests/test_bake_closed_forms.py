"""Baked fields against closed forms, and what is kept of them on the disk when it is not theirs."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import warp_psf as psf
from warp_psf.bake.radiance import _principal_components
from warp_psf.bake.shape import unit_shape
from warp_psf.bake.silhouettes import bake_silhouettes, load_silhouettes, save_silhouettes
from warp_psf.bake.sphere_set import bake_spheres
from warp_psf.basis.sphere import fibonacci_cap
from warp_psf.field.silhouettes import SilhouetteField
from warp_psf.field.store import load_arrays, save_arrays
from warp_psf.scene import primitives
from warp_psf.scene.mesh import Mesh

TETRAHEDRON = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1.0)])
FACES = np.array([(0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3)])


@pytest.fixture
def cache(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("WARP_PSF_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def change(folder: Path, **arrays: np.ndarray) -> None:
    """Puts other arrays into the only file that is kept, under its key and with a right sum."""
    (path,) = folder.iterdir()
    kept = load_arrays(path.stem)
    assert kept is not None
    save_arrays(path.stem, kept | arrays)


def test_a_ball_hides_its_cap_s_share_of_the_sky():
    field = bake_silhouettes(replace(primitives.sphere(0.7), sphere=None), use_cache=False)
    radii = np.array([1.2, 1.5, 2.0, 4.0])
    outward = np.array([(1, 0, 0), (0, -1, 0), (0, 0, 1), (0.6, 0, 0.8)])
    points = 0.7 * radii[:, None] * outward
    shares = field.hidden_share(points, fibonacci_cap(20_000), device="cpu")
    assert shares.dtype == np.float32 and shares.shape == (4,)
    # The field's edge is within a hundredth of a radian or two of the ball's (test_silhouettes.py); beside a cap of
    # half angle a that is sin(a) / 2 times as much of the sphere. The mesh lies within the ball.
    expected = 0.5 * (1 - np.sqrt(1 - 1 / radii**2))
    np.testing.assert_allclose(shares, expected, atol=0.01 / radii.min())
    # Behind the observer is nothing of the ball.
    behind = fibonacci_cap(1000)
    behind = behind[behind @ outward[2] > 0]
    assert field.hidden_share(points[2:3], behind, device="cpu")[0] == 0.0


def test_under_no_light_at_all_a_body_may_glow_evenly():
    """A body that no light reaches has no components: the first function is even, so that it can be lit at all."""
    basis = _principal_components(np.zeros((6, 9), np.float32), np.arange(1.0, 7.0), 4)
    assert basis.dtype == np.float32
    np.testing.assert_array_equal(basis, np.repeat([[1.0, 0.0, 0.0, 0.0]], 6, axis=0))


def test_one_light_has_no_components_beside_its_mean():
    """Light that differs by its strength alone is the mean function times a number."""
    shape = np.array([1.0, 2.0, 3.0, 2.0])
    areas = np.array([1.0, 1.0, 2.0, 4.0])
    basis = _principal_components(np.outer(shape, [1.0, 5.0, 0.5]).astype(np.float32), areas, 3)
    np.testing.assert_allclose(basis[:, 0], shape / np.average(shape, weights=areas), rtol=1e-6)
    # Rounding alone is left of the rest: float32 lights.
    np.testing.assert_allclose(basis[:, 1:], 0.0, atol=1e-6)


@pytest.fixture(scope="module")
def tetrahedron() -> tuple[Mesh, SilhouetteField]:
    """The shape of bounding radius 1 that fields are kept of, and its field."""
    unit = unit_shape(psf.make_mesh("tetrahedron", TETRAHEDRON, FACES))
    return unit, bake_silhouettes(unit, use_cache=False)


@pytest.mark.parametrize(
    ("name", "spoil"),
    [
        ("rows", lambda kept: kept["rows"] + 1),
        ("codes", lambda kept: kept["codes"][:-1]),
        ("step", lambda kept: kept["step"] * np.nan),
    ],
)
def test_a_kept_silhouette_field_of_wrong_arrays_is_told_and_not_used(cache, tetrahedron, name, spoil):
    unit, baked = tetrahedron
    save_silhouettes("kept", unit, baked)
    again = load_silhouettes("kept", unit)
    assert again is not None
    np.testing.assert_array_equal(again.codes, baked.codes)
    change(cache, **{name: spoil(load_arrays("kept"))})
    with pytest.warns(UserWarning, match=f"silhouette field of mesh 'tetrahedron' has a wrong '{name}'"):
        assert load_silhouettes("kept", unit) is None


def test_a_silhouette_field_of_another_shape_is_no_damage(cache, tetrahedron):
    """Two shapes may share a key: what is kept of the other is passed over in silence."""
    unit, baked = tetrahedron
    save_silhouettes("kept", replace(unit, vertices=unit.vertices + np.float32(0.1)), baked)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert load_silhouettes("kept", unit) is None


@pytest.mark.parametrize("shift", [-1, 10**6])
def test_spheres_that_hang_on_no_vertex_are_fitted_again(cache, shift):
    mesh = primitives.capsule(0.1, 0.2)
    expected = bake_spheres(mesh, 6)
    change(cache, vertices=np.full_like(expected.vertices, shift))
    with pytest.warns(UserWarning, match="wrong 'vertices'; they are fitted again"):
        found = bake_spheres(mesh, 6)
    np.testing.assert_array_equal(found.vertices, expected.vertices)
