"""Bounced light in rooms, and of what stands in them: traced paths, and what does not depend on a body's own frame."""

import numpy as np
import pytest

import warp_psf as psf
from tests.oracles import make_renderer
from tests.oracles_bounce import traced_bounces
from tests.test_bounce import PAINTS, PILL, SHARP, WIDTH, camera, closed_room, draw, geom

HEIGHT = 32


@pytest.mark.parametrize("spin", [30, 45])
def test_a_body_that_lies_on_a_floor_sends_its_light_whichever_side_is_up(spin):
    floor = geom('type="box" size="3 3 .1"', "0 0 -.1", "black")
    ceiling = geom('type="box" size="3 3 .1"', "0 0 1.7", "pale")
    seen = []
    for degrees in (0, spin):
        # Turned about its own axis, a capsule is what it was; the box around it in its own frame is not.
        pill = f'<body pos="0 0 .12" euler="0 90 0"><geom euler="0 0 {degrees}" {PILL} material="glow"/></body>'
        scene = floor + ceiling + pill + camera("0 -2 .8", "1 0 0 0 -.6 .8")
        seen.append(draw(scene, environment=None, bounces=1)["indirect"])
    # What is left is how the shells are interpolated at other places.
    assert seen[1].mean() == pytest.approx(seen[0].mean(), rel=0.01)


def test_walls_keep_the_shape_of_their_light():
    # A lamp in one corner of a closed room: near it the walls are bright, across they are dark.
    lamp = psf.rectangle_light("lamp", 0.4, 0.4, (20.0, 20.0, 20.0), position=(-0.3, 0.2, 0.7), target=(-0.3, 0.2, 0))
    body = closed_room("pale") + camera("0 -.95 0", "1 0 0 0 0 1", 95)
    options = {"header": PAINTS + SHARP, "environment": None, "lights": [lamp], "model_lights": False, "basis": "haar"}
    renderer, data = make_renderer(body, HEIGHT, WIDTH, bounces=1, **options)
    renderer.update_scene(data, "eye")
    layers, receivers = renderer.layers(), renderer._stage.surfaces.receivers
    points, normals = (getattr(receivers, name).numpy()[0, : HEIGHT * WIDTH] for name in ("position", "normal"))
    traced = traced_bounces(
        renderer.model, data, points, normals, bounces=1, lights=(lamp,), paths=512, material_space="linear"
    )
    expected = 0.8 / np.pi * traced[1][:, 0]
    found = layers["indirect"][..., 0].ravel()
    # Without the lamp, and without the seams, where rays of the oracle start behind the next wall.
    inside = np.sort(np.abs(points), axis=1)[:, 1] < 0.95
    walls = (layers["segmentation"][..., 0] >= 0).ravel() & inside & (np.abs(points).max(axis=1) > 0.99)
    assert walls.mean() > 0.8
    error = found[walls] / expected[walls].mean() - expected[walls] / expected[walls].mean()
    # Four bands blur the light that a wall sends to its neighbours: they lose a few per cent where it is uneven.
    assert abs(error.mean()) < 0.06
    assert np.sqrt(np.mean(error**2)) < 0.075
