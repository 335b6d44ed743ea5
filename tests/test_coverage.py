"""Closed forms and fields against brute force: the SH projection of a ray-traced or analytic indicator."""

import numpy as np
import pytest
import warp as wp

from warp_psf.basis import sh, sphere
from warp_psf.basis.directions import basis_at_directions, quadrature_rows
from warp_psf.device import find_device, launch
from warp_psf.shade.coverage import make_coverage

# Directions of the brute-force projection: with 40,000 the projection of an indicator is good to about 1e-3.
DIRECTIONS = sphere.fibonacci_cap(40_000)


def project_indicator(covered: np.ndarray, order: int) -> np.ndarray:
    """Values at the quadrature's directions of the projected indicator of DIRECTIONS."""
    basis = sh.evaluate(DIRECTIONS, order)
    vector = (basis * covered[:, None]).mean(axis=0) * 4 * np.pi
    return basis_at_directions(order) @ vector


def box_indicator(p: np.ndarray, half: np.ndarray) -> np.ndarray:
    with np.errstate(divide="ignore", invalid="ignore"):
        near = (-half - p) / DIRECTIONS
        far = (half - p) / DIRECTIONS
    low, high = np.minimum(near, far).max(axis=1), np.maximum(near, far).min(axis=1)
    return (high >= np.maximum(low, 0)).astype(float)


@pytest.fixture(scope="module", params=[4, 6])
def slab_kernel(request):
    order = request.param
    kit = make_coverage(order)
    device = find_device("cpu")

    @wp.kernel(module="unique")
    def cover_points(
        first: int,
        points: wp.array(dtype=wp.vec3),
        half: wp.vec3,
        to_world: wp.mat33,
        quadrature: wp.array(dtype=kit.half_values),
        slab_out: wp.array(dtype=kit.values),
        cap_out: wp.array(dtype=kit.values),
    ):
        world, item = wp.tid()
        item += first
        slab_out[item] = kit.slab_coverage(wp.transpose(to_world) * points[item], half, to_world, quadrature)
        toward = wp.normalize(-points[item])
        sine = wp.min(1.0 / wp.length(points[item]), 1.0)
        cap_out[item] = kit.cap_coverage(toward, sine, quadrature)

    def cover(points, half, to_world):
        outs = [wp.zeros(len(points), dtype=kit.values, device=device) for _ in range(2)]
        inputs = [
            wp.array(points, dtype=wp.vec3),
            wp.vec3(*map(float, half)),
            wp.mat33(*map(float, np.ravel(to_world))),
            quadrature_rows(order, device),
        ]
        launch(cover_points, (1, len(points)), inputs, outs, device)
        return outs[0].numpy(), outs[1].numpy()

    return order, cover


@pytest.mark.parametrize("half", [(0.5, 0.3, 0.2), (2.0, 1.0, 0.0), (5.0, 5.0, 0.1)])
def test_slab_coverage_is_the_projection_of_the_box(slab_kernel, half):
    order, cover = slab_kernel
    random = np.random.default_rng(1)
    half = np.array(half)
    points = random.normal(size=(24, 3)) * 1.5
    points = points[np.any(np.abs(points) > half + 0.02, axis=1)]
    assert len(points) > 5
    rotation = sphere.frame(np.array([0.36, 0.48, 0.8]))
    covered, _ = cover(points @ rotation.T, half, rotation)
    for p, found in zip(points, covered, strict=True):
        # The indicator in the slab's frame, its vector turned to the world's.
        basis = sh.evaluate(DIRECTIONS @ rotation.T, order)
        vector = (basis * box_indicator(p, half)[:, None]).mean(axis=0) * 4 * np.pi
        expected = basis_at_directions(order) @ vector
        # 40,000 directions leave about 3e-3 at the highest order's peaks.
        np.testing.assert_allclose(found, expected, atol=5e-3)


def test_receiver_on_a_large_rectangle_sees_a_half_space(slab_kernel):
    order, cover = slab_kernel
    points = np.array([[0.3, -0.2, 0.0], [0.3, -0.2, 1e-6], [0.3, -0.2, -1e-6]])
    covered, _ = cover(points, np.array([1e3, 1e3, 0.0]), np.eye(3))
    below = sh.zonal(sh.cap(np.pi / 2, order), np.array([[0, 0, -1.0], [0, 0, -1.0], [0, 0, 1.0]]))
    # On the plane itself either side will do; 1e-3 is what a rim at 1,000 units hides.
    np.testing.assert_allclose(covered[1:], (below @ basis_at_directions(order).T)[1:], atol=2e-3)
    assert np.isfinite(covered).all()


def test_receiver_inside_a_box_sees_the_nearest_face(slab_kernel):
    order, cover = slab_kernel
    covered, _ = cover(np.array([[0.0, 0.0, 0.099]]), np.array([50.0, 50.0, 0.1]), np.eye(3))
    below = basis_at_directions(order) @ sh.zonal(sh.cap(np.pi / 2, order), np.array([0, 0, -1.0]))
    np.testing.assert_allclose(covered[0], below, atol=5e-3)


def test_sphere_coverage_is_the_projection_of_the_cap(slab_kernel):
    order, cover = slab_kernel
    points = np.array([[1.0, 0, 0], [0, 2.0, 0], [3.0, 4.0, 0], [0.5, 0, 0], [0, 0, 40.0], [0, 5e3, 0]])
    _, covered = cover(points, np.ones(3), np.eye(3))
    for p, found in zip(points, covered, strict=True):
        half_angle = np.arcsin(min(1.0, 1 / np.linalg.norm(p)))
        expected = basis_at_directions(order) @ sh.zonal(sh.cap(half_angle, order), -p / np.linalg.norm(p))
        # float32 sums of order one, and for small caps of their own order
        np.testing.assert_allclose(found, expected, atol=2e-5 * np.abs(expected).max() + 1e-12)
