"""Area lights: numbers at the boundary, sizes that are told, and lights that move between two steps of a script."""

from __future__ import annotations

import numpy as np
import pytest

from tests.test_slab import ball, camera_at
from warp_psf.area_light import script
from warp_psf.area_light.layered import bake_layered_map
from warp_psf.area_light.light_samples import sample_light
from warp_psf.area_light.points import sample_points
from warp_psf.area_light.quadtree import grow_quadtrees
from warp_psf.area_light.scene_map import bake_scene_map
from warp_psf.area_light.slab import LightPlane
from warp_psf.scene.light import rectangle_light
from warp_psf.scene.still import StillScene, join_pieces, make_still

LAMP = rectangle_light("lamp", 0.5, 0.5, (1, 1, 1), (0, 0, 2), (0, 0, 0))


@pytest.fixture(scope="module")
def scene() -> StillScene:
    return join_pieces([ball((0, 0, 0), 0.5)], [camera_at((0, -3, 1), (0, 0, 0))])


@pytest.mark.parametrize("count", [0, -1, 2.5, 65537, None])
def test_a_light_has_a_whole_number_of_samples(count):
    with pytest.raises(ValueError, match="samples of light 'lamp'; give a whole number from 1 to 65536"):
        sample_light(LAMP, count)
    assert sample_light(LAMP, 1).area.sum() == pytest.approx(0.25)


@pytest.mark.parametrize(("width", "height", "name"), [(1, 16, "width"), (16, 0, "height"), (16.0, 16, "width")])
def test_a_scene_map_has_a_whole_number_of_pixels(scene, width, height, name):
    with pytest.raises(ValueError, match=f"{name} is .*; give a whole number of pixels from 2"):
        bake_scene_map(scene, 0, width, height)


@pytest.mark.parametrize("name", ["center", "right", "up"])
@pytest.mark.parametrize("value", [(0, 1), (0, np.nan, 1), (np.inf, 0, 0)])
def test_a_light_plane_s_vectors_are_three_numbers(name, value):
    good = {"center": (0, 0, 2), "right": (1, 0, 0), "up": (0, 1, 0)}
    with pytest.raises(ValueError, match=f"{name} of a light plane is .*; give three numbers, metres"):
        LightPlane(**good | {name: value}, rows=3, columns=3)


def test_squares_too_many_are_refused_before_they_are_made(monkeypatch):
    """A sliver's area is small, but the squares in its bounds are many: refused without the memory."""
    sliver = make_still([[0, 0, 0], [1, 1, 0], [1, 1 + 1e-6, 0]], [[0, 1, 2]])
    monkeypatch.setattr("warp_psf.area_light.points.MOST_POINTS", 100)
    with pytest.raises(ValueError, match="give a larger `smallest`"):
        sample_points(sliver, smallest=1e-3, levels=1)
    # Larger squares first are few, and the small ones along the sliver are counted level by level.
    with pytest.raises(ValueError, match="make more than 100 points; give a larger `smallest`"):
        sample_points(sliver, smallest=1e-3, levels=6)
    assert sample_points(sliver, smallest=0.2, levels=1).counts.sum() <= 100


def test_a_layered_map_says_how_large_it_is(scene):
    layers = bake_layered_map(scene, LAMP, 32, samples=4, device="cpu")
    # A number per cell, and per element a surface, a share, a point and a normal: 4 + 4 + 12 + 12 bytes.
    assert layers.nbytes == layers.first.nbytes + 32 * len(layers.surface)
    assert len(layers.surface) > 100


def test_trees_say_how_large_they_are():
    """Without a division a map is one leaf with four samples at its corners."""

    def sample(maps, column, row):
        return (np.zeros(len(maps), np.float32),)

    trees = grow_quadtrees(3, 5, 0, sample, lambda cells, corners: np.zeros(len(cells), bool))
    assert len(trees.corners) == len(trees.link) == 3
    assert trees.nbytes == 3 * (4 + 4 * 4 + 4 * 4)


def test_a_light_s_numbers_go_evenly_from_step_to_step():
    before = {"shape": "square", "on": True, "side": 0.2, "at": (0.0, 1.0), "radiance": (1.0, 2.0, 3.0)}
    after = {"on": True, "side": 0.6, "at": (1.0, 0.0)}
    state = script._between(before, after, 0.25)
    assert state["side"] == pytest.approx(0.3) and np.ndim(state["side"]) == 0
    assert state["at"] == pytest.approx((0.25, 0.75)) and state["radiance"] == (1.0, 2.0, 3.0)
    end = script._between(before, after, 1.0)
    assert (end["side"], end["at"]) == (pytest.approx(0.6), pytest.approx((1.0, 0.0)))


def test_a_light_of_another_shape_has_its_own_numbers_at_once():
    before = {"shape": "square", "on": True, "at": (0.0, 1.0), "radiance": (1.0, 1.0, 1.0)}
    state = script._between(before, {"shape": "line", "at": (1.0, 0.0), "radiance": (3.0, 3.0, 3.0)}, 0.5)
    # A line is no square half-way, but light fades all the same.
    assert state["shape"] == "line" and state["at"] == (1.0, 0.0)
    assert state["radiance"] == pytest.approx((2.0, 2.0, 2.0))
