"""Light that is cut in two: nothing is lost, and what is small and bright is found where it is."""

import numpy as np
import pytest

import warp_psf as psf
from warp_psf.basis import sphere
from warp_psf.scene.environment import Environment
from warp_psf.scene.leaves import GROUP, MOST_LEAVES, cut_environment, cut_light, merge_leaves

ROWS = 256
DIRECTIONS = sphere.latlong_directions(ROWS, 2 * ROWS)
SOLID_ANGLES = np.broadcast_to(sphere.latlong_solid_angles(ROWS, 2 * ROWS), (ROWS, 2 * ROWS))


def disc(toward, degrees, radiance=(1000.0, 900.0, 700.0)):
    """An image that is zero but for a disc of so many degrees across."""
    inside = DIRECTIONS @ (np.array(toward) / np.linalg.norm(toward)) > np.cos(np.radians(degrees / 2))
    return inside[..., None] * np.array(radiance)


def moments(image):
    """The integrals of radiance, and of radiance times direction: [4, 3]."""
    rows, columns = image.shape[:2]
    directions = sphere.latlong_directions(rows, columns)
    weighted = image * np.broadcast_to(sphere.latlong_solid_angles(rows, columns), (rows, columns))[..., None]
    return np.concatenate([weighted.sum(axis=(0, 1))[None], np.einsum("rcx,rck->kx", weighted, directions)])


@pytest.mark.parametrize("sky", [0.0, 0.4])
def test_both_parts_together_send_what_the_whole_sends(sky):
    image = sky + disc((1, -2, 1.5), 4) + disc((-1, 0, 0.2), 25, (9, 10, 11))
    smooth, leaves = cut_environment(Environment("two", image))
    sent = np.concatenate([leaves.sent.sum(axis=0)[None], leaves.direction.T @ leaves.sent])
    # Leaves lie at the mean direction of their light, which is a little shorter than 1: 3 degrees, 0.05 %.
    np.testing.assert_allclose(moments(smooth.radiance) + sent, moments(image), rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("toward", [(1, -2, 1.5), (0.03, 0.01, 1), (-1, 1e-9, -0.4)])
def test_a_sun_is_found_where_it_stands_and_as_wide_as_it_is(toward):
    _, leaves = cut_environment(Environment("sun", disc(toward, 5)))
    unit = np.array(toward) / np.linalg.norm(toward)
    light = leaves.sent[:, 0] / leaves.sent[:, 0].sum()
    mean = light @ leaves.direction
    # The pixels are 0.7 degrees wide, so that their disc is off by a fraction of that.
    assert np.degrees(np.arccos(mean @ unit / np.linalg.norm(mean))) < 0.15
    across = leaves.direction - (leaves.direction @ unit)[:, None] * unit
    spread = light @ ((across**2).sum(axis=1) + leaves.radius**2 / 2)
    np.testing.assert_allclose(np.degrees(np.sqrt(2 * spread)), 2.5, rtol=0.06)


def test_even_light_has_no_leaves():
    for image in (
        np.zeros((8, 16, 3)),
        np.ones((8, 16, 3)),
        np.linspace(0.5, 1.5, 32)[:, None, None] * np.ones((32, 64, 3)),
    ):
        smooth, leaves = cut_environment(Environment("even", image))
        assert len(leaves.sent) == 0
        np.testing.assert_array_equal(smooth.radiance, image.astype(np.float32))


def test_band_limited_light_stays_whole():
    environment = Environment.from_coefficients(np.random.default_rng(1).normal(size=(9, 3)))
    smooth, leaves = cut_environment(environment)
    assert smooth is environment
    assert len(leaves.sent) == 0


def test_leaves_are_bounded_and_what_they_leave_stays():
    stars = np.random.default_rng(2).uniform(size=(ROWS, 2 * ROWS, 1)) < 0.01
    image = stars * np.array((5.0, 5.0, 5.0))
    smooth, leaves = cut_environment(Environment("stars", image))
    assert len(leaves.sent) == MOST_LEAVES
    np.testing.assert_allclose(moments(smooth.radiance)[0] + leaves.sent.sum(axis=0), moments(image)[0], rtol=1e-4)


def test_groups_are_small_and_close_together():
    image = disc((0, 1, 1), 30)
    _, leaves = cut_environment(Environment("wide", image))
    assert (np.diff(leaves.group) >= 0).all()
    for group in np.unique(leaves.group):
        mine = leaves.direction[leaves.group == group]
        assert len(mine) <= GROUP
        # Four cells of 3.2 degrees along each side; equal-area cells at this height are up to twice as long.
        assert (mine @ mine.T).min() > np.cos(np.radians(30))


def test_merged_environments_share_no_group():
    parts = [cut_environment(Environment("sun", disc((0, 1, 1), 5)))[1] for _ in range(2)]
    merged = merge_leaves(parts)
    assert len(merged.sent) == 2 * len(parts[0].sent)
    assert not set(merged.group[: len(parts[0].sent)]) & set(merged.group[len(parts[0].sent) :])


def test_pieces_of_lights_have_their_area_and_face_as_they_do():
    lamp = psf.rectangle_light("lamp", 1.0, 0.6, (1, 1, 1), (0, 0, 2), (0, 0, 0))
    pieces = cut_light(lamp)
    np.testing.assert_allclose(pieces.area.sum(), 0.6, rtol=1e-6)
    np.testing.assert_allclose(pieces.position.mean(axis=0), 0, atol=1e-7)
    np.testing.assert_allclose(pieces.normal, np.tile((0, 0, 1), (GROUP, 1)), atol=1e-6)
    # A rectangle of sides a and b has second moments a^2/12 and b^2/12; the middles of four stretches 1/16 less.
    np.testing.assert_allclose((pieces.position**2).mean(axis=0)[:2], np.array((1, 0.36)) / 12 * 15 / 16, rtol=1e-5)
    ball = cut_light(psf.sphere_light("ball", 0.2, (1, 1, 1), (0, 0, 1)))
    np.testing.assert_allclose(ball.area, np.pi * 0.04, rtol=1e-6)
    vertices = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1.0)])
    faces = np.array([(0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3)])
    mesh = cut_light(psf.AreaLight("tetrahedron", psf.make_mesh("tetrahedron", vertices, faces), np.ones(3)))
    assert len(mesh.area) == 4
    np.testing.assert_allclose(mesh.area.sum(), 1.5 + np.sqrt(3) / 2, rtol=1e-6)
    # Of a closed surface the normals, weighted by area, cancel.
    np.testing.assert_allclose(mesh.area @ mesh.normal, 0, atol=1e-6)
