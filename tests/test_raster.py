"""Drawn faces: each pixel's centre, and on edges its eight places, see what rays through them meet."""

import numpy as np
import pytest

import warp_psf as psf
from sims.bodies import statue_like
from tests.oracles import make_renderer
from warp_psf.film import raster

HEIGHT, WIDTH = 135, 241
CAMERAS = {
    "front": 'pos="0 -4 1.6" xyaxes="1 0 0 0 .35 .93"',
    # Between the bodies, some of which reach behind the viewer.
    "among": 'pos=".2 -.35 .5" xyaxes="1 .3 0 0 .2 .97"',
    "parallel": 'pos="0 -4 1.6" xyaxes="1 0 0 0 .35 .93" projection="orthographic" fovy="2.4"',
}


def world() -> tuple[str, str]:
    vertices, faces = statue_like(cells=24)
    points = " ".join(map(str, np.ravel(vertices)))
    header = f'<asset><mesh name="statue" vertex="{points}" face="{" ".join(map(str, np.ravel(faces)))}"/></asset>'
    cameras = "".join(f'<camera name="{name}" {where}/>' for name, where in CAMERAS.items())
    bodies = (
        '<geom type="plane" size="20 20 .1"/><body pos="0 0 .55"><geom type="mesh" mesh="statue"/></body>'
        '<geom type="box" size="3 .1 .2" pos="0 -.2 .2" euler="0 0 20"/>'
        '<geom type="sphere" size=".3" pos="-.8 -.1 .3"/>'
        '<geom type="capsule" size=".1 .4" pos=".7 .2 .5" euler="40 10 0"/>'
        '<geom type="cylinder" size=".2 .3" pos="1 1 .3" rgba=".5 .5 .9 .5"/>'
    )
    return header, bodies + cameras


def seen(camera: str) -> dict[str, np.ndarray]:
    header, body = world()
    renderer, data = make_renderer(body, HEIGHT, WIDTH, header=header, environment="studio", bounces=0)
    renderer.update_scene(data, camera)
    layers = renderer.layers()
    receivers = renderer._stage.surfaces.receivers
    for name in ("entity", "position", "weight"):
        layers[name] = getattr(receivers, name).numpy()[0, : HEIGHT * WIDTH]
    layers["drawn"] = renderer._stage.surfaces.raster.drawn.entity.numpy()[0] >= 0
    return layers


@pytest.mark.parametrize("camera", CAMERAS)
def test_drawing_and_rays_see_the_same(camera, monkeypatch):
    drawn = seen(camera)
    monkeypatch.setattr(raster, "MOST_FACES", 0)
    met = seen(camera)
    assert drawn["drawn"].mean() > 0.15
    assert not met["drawn"].any()
    # A centre that lies on a silhouette to within rounding may fall to either side.
    same = drawn["entity"] == met["entity"]
    assert same.mean() > 0.9995
    same &= drawn["entity"] >= 0
    # Rays and planes agree to float32 at a distance of some metres.
    apart = np.linalg.norm(drawn["position"] - met["position"], axis=1)[same]
    assert np.quantile(apart, 0.999) < 1e-4
    # Of edge pixels, the share of what the centre sees; one of eight places may fall to either side, too.
    on_edge = same & (met["weight"] < 1.0)
    assert on_edge.sum() > 150
    assert (drawn["weight"] == met["weight"])[on_edge].mean() > 0.99
    np.testing.assert_allclose(drawn["weight"][same], met["weight"][same], atol=0.251)
    np.testing.assert_allclose(
        drawn["depth"].ravel()[same][apart < 1e-4], met["depth"].ravel()[same][apart < 1e-4], rtol=1e-4
    )


def test_no_gap_between_faces_lets_the_background_through():
    # A finely cut ball fills the picture.
    body = '<geom type="sphere" size="1"/><camera name="near" pos="0 -1.2 0" xyaxes="1 0 0 0 0 1"/>'
    renderer, data = make_renderer(
        body, HEIGHT, WIDTH, environment=psf.Environment("white", np.ones((1, 1, 3))), bounces=0
    )
    renderer.update_scene(data, "near")
    assert (renderer.layers()["segmentation"][..., 0] == 0).all()
