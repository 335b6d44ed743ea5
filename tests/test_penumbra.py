"""How far directions lie from the silhouettes of closed forms."""

import numpy as np
import warp as wp

from warp_psf.device import launch
from warp_psf.shade.penumbra import box_outline, outline_distance


@wp.kernel(enable_backward=False, module="unique")
def _distances_to_slab(
    first: int,
    directions: wp.array(dtype=wp.vec3),
    points: wp.array(dtype=wp.vec3),
    half: wp.vec3,
    distance_out: wp.array(dtype=wp.float32),
):
    _, item = wp.tid()
    item += first
    distance_out[item] = outline_distance(box_outline(points[item], half), directions[item])


def _meets_box(directions: np.ndarray, points: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Whether rays meet a box about the origin: the slabs' spans along the ray overlap ahead of its start."""
    near, far = ((side * half - points) / directions for side in (-1.0, 1.0))
    entry, leaving = np.minimum(near, far).max(axis=1), np.maximum(near, far).min(axis=1)
    return (entry < leaving) & (leaving > 0.0)


def test_a_direction_is_within_a_boxs_silhouette_where_its_ray_meets_the_box():
    # A wall: long, thin and low, so that most points beside it look along it away from its middle.
    half = np.array([0.75, 0.04, 0.1])
    rng = np.random.default_rng(3)
    points = rng.uniform(-1.5, 1.5, (20000, 3)) * np.array([1.0, 0.5, 0.2])
    points = points[(np.abs(points) > half).any(axis=1)]
    directions = rng.normal(size=points.shape)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    device = wp.get_device("cpu")
    found = wp.zeros(len(points), dtype=wp.float32, device=device)
    arrays = [wp.array(values.astype(np.float32), dtype=wp.vec3, device=device) for values in (directions, points)]
    launch(_distances_to_slab, (1, len(points)), [*arrays, wp.vec3(*half)], [found], device)
    distance = found.numpy()
    # Within a thousandth of a radian of the edge float32 may decide either way.
    clear = np.abs(distance) > 1e-3
    assert clear.mean() > 0.95
    np.testing.assert_array_equal(distance[clear] > 0.0, _meets_box(directions, points, half)[clear])
