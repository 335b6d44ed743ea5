"""Texels of slabs: lit one by one where light changes, and mixed between where it does not."""

import numpy as np
import pytest

import warp_psf as psf
from tests.oracles import make_renderer
from warp_psf.shade import texels
from warp_psf.stage import _light_proxies

SCENE = """
<geom name="floor" type="box" size="2 2 .05" pos="0 0 -.05"/>
<body pos="0 0 .3"><freejoint/><geom name="ball" type="sphere" size=".3"/></body>
<camera name="front" pos="0 -4 1.6" xyaxes="1 0 0 0 .35 .93"/>
"""


@pytest.fixture(scope="module")
def lit():
    lamp = psf.rectangle_light("lamp", 0.3, 0.3, (60, 60, 60), position=(-1, -0.5, 2), target=(0, 0, 0))
    renderer, data = make_renderer(SCENE, 45, 80, environment="studio", lights=[lamp], basis="haar", bounces=2)
    renderer.update_scene(data, "front")
    renderer.render()
    return renderer._stage


def texel_light(stage) -> np.ndarray:
    """Irradiance of the texels of faces that are seen, [texels, 3]."""
    bounces = stage.bounces
    first = bounces.first_texel
    seen = bounces.proxies.entity.numpy()[0, first:] >= 0
    return bounces.received[0].numpy()[0, first:][seen]


def test_mixed_texels_are_as_bright_as_if_they_were_lit(lit):
    bounces = lit.bounces
    first, seen = bounces.first_texel, bounces.proxies.entity.numpy()[0, bounces.first_texel :] >= 0
    turns = bounces.turns.numpy()
    of_seen = turns[0, first:][seen]
    # The ball's shadow has an edge; most of the floor lies in even light or shade.
    assert 0.01 < (of_seen == texels.FINE).mean() < 0.3
    assert (of_seen == texels.BETWEEN).mean() > 0.4
    mixed = texel_light(lit)
    everywhere = turns.copy()
    everywhere[0, first:] = texels.COARSE
    bounces.turns.assign(everywhere)
    _light_proxies(lit, bounces)
    exact = texel_light(lit)
    bounces.turns.assign(turns)
    np.testing.assert_array_equal(mixed[of_seen != texels.BETWEEN], exact[of_seen != texels.BETWEEN])
    off = np.abs(mixed - exact).max(axis=1) / exact.max()
    # Between texels that differ by a fifth at most, light is off by a part of that, and hardly anywhere by much.
    assert off.max() < texels.UNLIKE
    assert np.sqrt((off**2).mean()) < 0.005


def test_texels_are_lit_anew_where_the_shadow_has_gone(lit):
    bounces = lit.bounces
    before, turns = texel_light(lit), bounces.turns.numpy()
    wrong = turns.copy()
    wrong[(turns == texels.FINE) | (turns == texels.BETWEEN)] = texels.BETWEEN
    bounces.turns.assign(wrong)
    _light_proxies(lit, bounces)
    np.testing.assert_array_equal(bounces.turns.numpy(), turns)
    np.testing.assert_array_equal(texel_light(lit), before)


def test_short_sides_and_last_rows_are_lit():
    assert texels._is_coarse(4).all()
    chosen = texels._is_coarse(16)
    assert chosen[::2].all()
    assert chosen[-1]
    assert not chosen[1:-1:2].any()
