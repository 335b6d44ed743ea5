"""Sixteen directions at once say what each of them says alone."""

import numpy as np
import warp as wp

import warp_psf as psf
from sims.bodies import teapot_like
from warp_psf.bake.silhouettes import bake_silhouettes
from warp_psf.device import find_device, launch
from warp_psf.field.silhouette_lanes import LANES, directions, lanes, own_distances, silhouette_distances
from warp_psf.field.silhouettes import (
    SilhouetteTables,
    find_silhouette,
    own_distance,
    own_frame,
    silhouette_distance,
    upload_silhouettes,
)
from warp_psf.shade.penumbra import disc_share, disc_shares

TURN = wp.mat33(0.6, -0.8, 0.0, 0.8, 0.6, 0.0, 0.0, 0.0, 1.0)


@wp.kernel(enable_backward=False, module="unique")
def _ask_both(
    first: int,
    tables: SilhouetteTables,
    points: wp.array(dtype=wp.vec3),
    toward: wp.array2d(dtype=wp.vec3),  # (point, lane)
    vertex: int,
    normal: wp.vec3,
    others_out: wp.array2d(dtype=wp.float32),  # (point, 2 * lane)
    own_out: wp.array2d(dtype=wp.float32),
):
    _world, item = wp.tid()
    item += first
    seen = find_silhouette(tables, 0, points[item])
    rows = directions()
    for k in range(wp.static(LANES)):
        for axis in range(3):
            rows[axis, k] = toward[item, k][axis]
    frame = own_frame(normal)
    together = silhouette_distances(tables, seen, TURN, rows)
    own_together = own_distances(tables, vertex, frame, rows)
    for k in range(wp.static(LANES)):
        others_out[item, 2 * k] = together[k]
        others_out[item, 2 * k + 1] = silhouette_distance(tables, seen, TURN * toward[item, k])
        own_out[item, 2 * k] = own_together[k]
        own_out[item, 2 * k + 1] = own_distance(tables, vertex, frame * toward[item, k])


@wp.kernel(enable_backward=False, module="unique")
def _share_both(
    first: int, distance: wp.array(dtype=lanes), radius: wp.array(dtype=lanes), out: wp.array2d(dtype=wp.float32)
):
    _world, item = wp.tid()
    item += first
    together = disc_shares(distance[item], radius[item])
    for k in range(wp.static(LANES)):
        out[item, 2 * k] = together[k]
        out[item, 2 * k + 1] = disc_share(distance[item][k], radius[item][k])


def test_distances_in_lanes_are_those_of_single_directions():
    mesh = psf.make_mesh("pot", *teapot_like())
    field = bake_silhouettes(mesh)
    assert field.own is not None
    rng = np.random.default_rng(5)
    count = 400
    outward = rng.normal(size=(count, 3))
    outward *= (mesh.radius * rng.uniform(0.8, 6.0, (count, 1))) / np.linalg.norm(outward, axis=1, keepdims=True)
    # Towards the body, away from it and past its rim.
    toward = -outward[:, None] / mesh.radius + rng.normal(size=(count, LANES, 3)) * 1.5
    toward /= np.linalg.norm(toward, axis=2, keepdims=True)
    vertex = int(np.argmax(np.abs(field.own.astype(int)).std(axis=1)))
    normal = mesh.normals[vertex]
    device = find_device("cpu")
    points = wp.array((mesh.center + outward).astype(np.float32), dtype=wp.vec3, device=device)
    aimed = wp.array(toward.astype(np.float32), dtype=wp.vec3, ndim=2, device=device)
    others, own = (wp.zeros((count, 2 * LANES), dtype=wp.float32, device=device) for _ in range(2))
    inputs = [upload_silhouettes([field], device), points, aimed, vertex, wp.vec3(*map(float, normal))]
    launch(_ask_both, (1, count), inputs, [others, own], device)
    # Radians; both sum in float32, in different order, and directions are turned in two steps or in one.
    others, own = others.numpy(), own.numpy()
    np.testing.assert_allclose(others[:, ::2], others[:, 1::2], atol=2e-5)
    assert np.ptp(others) > 1.0
    above = (toward @ normal) > 0.05
    np.testing.assert_allclose(own[:, ::2][above], own[:, 1::2][above], atol=2e-5)
    assert np.ptp(own[:, ::2][above]) > 0.05


def test_shares_in_lanes_are_those_of_single_discs():
    rng = np.random.default_rng(6)
    distance, radius = rng.uniform(-0.4, 0.4, (500, LANES)), rng.uniform(0.01, 0.4, (500, LANES))
    distance[0], radius[0] = np.repeat([-0.2, 0.0, 0.1, 0.2], 4), 0.2
    device = find_device("cpu")
    both = [wp.array(each.astype(np.float32), dtype=lanes, device=device) for each in (distance, radius)]
    out = wp.zeros((500, 2 * LANES), dtype=wp.float32, device=device)
    launch(_share_both, (1, 500), both, [out], device)
    found = out.numpy()
    # The arc sine's polynomial is off by 7e-5 radians, a share of 2.2e-5.
    np.testing.assert_allclose(found[:, ::2], found[:, 1::2], atol=3e-5)
    np.testing.assert_allclose(found[0, ::8], [0.0, 0.5, 0.5 + (0.5 * 0.75**0.5 + np.pi / 6) / np.pi, 1.0], atol=3e-5)
