"""Lights without an extent: closed forms on a floor, and traced shadows."""

import numpy as np
import pytest

from tests.oracles import make_renderer
from warp_psf.bake import body as bake_body
from warp_psf.scene import primitives

HEIGHT, WIDTH = 54, 96
FLOOR = '<geom name="floor" type="plane" size="9 9 .1" material="white"/>'
CAMERA = '<camera name="down" pos="0 0 6" xyaxes="1 0 0 0 1 0"/>'
PLAIN = 'ambient="0 0 0" specular="0 0 0" castshadow="true"'
HEADLIGHT = '<visual><headlight active="1" diffuse=".5 .4 .3" ambient=".1 .2 .3" specular="0 0 0"/></visual>'


def lit_floor(lights: str, others: str = "", floor: str = FLOOR, **options) -> tuple[np.ndarray, np.ndarray]:
    """Points of the floor that the camera sees [N, 3], and the radiance that it reflects there [N, 3]."""
    renderer, data = make_renderer(floor + CAMERA + lights + others, HEIGHT, WIDTH, environment=None, **options)
    renderer.update_scene(data, "down")
    layers = renderer.layers()
    points = renderer._stage.surfaces.receivers.position.numpy()[0, : HEIGHT * WIDTH].reshape(HEIGHT, WIDTH, 3)
    on_floor = (layers["segmentation"][..., 0] == 0) & (
        renderer._stage.surfaces.extra.numpy().reshape(HEIGHT, WIDTH) < 0
    )
    return points[on_floor].astype(np.float64), layers["direct"][on_floor]


def test_directional():
    points, found = lit_floor(f'<light type="directional" dir="1 2 -2" diffuse=".9 .6 .3" {PLAIN}/>')
    assert len(points) == HEIGHT * WIDTH
    np.testing.assert_allclose(found, np.broadcast_to((2 / 3) * np.array((0.9, 0.6, 0.3)), found.shape), rtol=1e-5)


def test_from_below_nothing():
    _, found = lit_floor(f'<light type="directional" dir="1 2 2" diffuse="1 1 1" {PLAIN}/>')
    assert not found.any()


def test_ambient_reaches_everything():
    _, found = lit_floor('<light dir="0 0 1" pos="0 0 3" diffuse="0 0 0" specular="0 0 0" ambient=".1 .2 .3"/>')
    np.testing.assert_allclose(found, np.broadcast_to((0.1, 0.2, 0.3), found.shape), rtol=1e-5)


def test_spot():
    place, aim = np.array((1.0, 0.5, 3.0)), np.array((-0.3, 0.1, -1.0))
    points, found = lit_floor(
        f'<light type="spot" pos="1 .5 3" dir="-.3 .1 -1" cutoff="30" exponent="7" attenuation=".5 .1 .02" '
        f'diffuse="1 .5 .2" {PLAIN}/>'
    )
    toward = place - points
    distance = np.linalg.norm(toward, axis=1)
    along = -(toward @ aim) / np.linalg.norm(aim) / distance
    strength = along**7 * toward[:, 2] / distance / (0.5 + 0.1 * distance + 0.02 * distance**2)
    inside, rim = along > np.cos(np.radians(30)), np.abs(along - np.cos(np.radians(30))) < 1e-4
    assert 0.05 < inside.mean() < 0.95
    expected = np.where(inside, strength, 0)[:, None] * (1.0, 0.5, 0.2)
    np.testing.assert_allclose(found[~rim], expected[~rim], atol=1e-5)


def test_point_fades_with_the_square_of_distance():
    points, found = lit_floor(f'<light type="point" pos=".4 -.2 1.5" attenuation="0 0 1" diffuse="2 2 2" {PLAIN}/>')
    toward = np.array((0.4, -0.2, 1.5)) - points
    np.testing.assert_allclose(found[:, 0], 2 * 1.5 / np.linalg.norm(toward, axis=1) ** 3, rtol=1e-4)


def test_range_ends_a_point_light():
    points, found = lit_floor(f'<light type="point" pos="0 0 1" range="2" diffuse="1 1 1" {PLAIN}/>')
    distance = np.linalg.norm(points - (0, 0, 1), axis=1)
    assert (found[distance > 2.001] == 0).all()
    assert (found[distance < 1.999] > 0).all()


@pytest.mark.parametrize("floor", [FLOOR, FLOOR.replace("9 9 .1", "0 0 .1")], ids=["plane", "infinite plane"])
@pytest.mark.parametrize(
    ("light", "toward"),
    [
        ('type="directional" dir="-1 -.5 -2"', lambda points: np.broadcast_to((1.0, 0.5, 2.0), points.shape)),
        ('type="point" pos="2 1 3"', lambda points: np.array((2.0, 1.0, 3.0)) - points),
        ('type="spot" pos="2 1 3" dir="-2 -1 -3" cutoff="80"', lambda points: np.array((2.0, 1.0, 3.0)) - points),
    ],
)
def test_hard_shadow_lies_where_the_ball_hides_the_light(floor, light, toward):
    # A ball that touches the floor: its shadow begins at the contact.
    ball = '<geom type="sphere" size=".4" pos="0 0 .4"/>'
    points, found = lit_floor(f'<light {light} diffuse="1 1 1" bulbradius="0" {PLAIN}/>', ball, floor)
    ray = toward(points)
    ray = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    offset = np.array((0.0, 0.0, 0.4)) - points
    along = np.sum(offset * ray, axis=1)
    apart = np.linalg.norm(offset - along[:, None] * ray, axis=1) / 0.4
    # The tessellated ball is up to 1 % thinner than the ball.
    assert (found[apart < 0.99] == 0).all()
    assert (found[apart > 1.001] > 0).all()
    assert (apart < 0.99).sum() >= 10  # most of the shadow lies below the ball, out of sight


def test_a_body_that_bulges_inwards_shadows_itself(monkeypatch):
    # A floor and a wall in one mesh; the light stands beyond the wall.
    monkeypatch.setattr(bake_body, "FINEST_RESOLUTION", 16)  # a fraction of the time to bake
    wall = primitives.box((0.05, 0.5, 0.4), cells=4)
    base = primitives.box((1.0, 0.5, 0.1), cells=4)
    vertices = np.concatenate([base.vertices, wall.vertices + np.array((0.0, 0.0, 0.47))])
    faces = np.concatenate([base.faces, wall.faces + len(base.vertices)])
    numbers = ['"' + " ".join(map(str, array.ravel())) + '"' for array in (vertices, faces)]
    header = f"<asset><mesh name='corner' vertex={numbers[0]} face={numbers[1]} inertia='shell'/></asset>"
    light = f'<light type="directional" dir="-1 0 -1" diffuse="1 1 1" {PLAIN}/>'
    corner = '<geom name="corner" type="mesh" mesh="corner" material="white"/>'
    points, found = lit_floor(light, floor=corner, header=header)
    top = points[:, 2].min() + 0.02  # the base's upper side, lowest of what is seen from above
    base_top = points[:, 2] < top
    x = points[base_top, 0] - points[:, 0].mean()
    lit = found[base_top, 0] > 0
    # The wall rises 0.75 m above the base: its shadow covers the side away from the light from end to end.
    assert lit[x > 0.15].all()
    assert not lit[(x < -0.15) & (x > -0.6)].any()
    assert min((x > 0.15).sum(), ((x < -0.15) & (x > -0.6)).sum()) > 30


def test_no_shadow_from_lights_that_cast_none():
    ball = '<geom type="sphere" size=".4" pos="0 0 .6"/>'
    light = f'<light type="directional" dir="-1 -.5 -2" diffuse="1 1 1" {PLAIN.replace("true", "false")}/>'
    _, found = lit_floor(light, ball)
    np.testing.assert_allclose(found, 2 / np.sqrt(5.25), rtol=1e-5)


def test_bulbradius_softens_the_shadow():
    # A screen whose edge runs along y, halfway up to the light: the penumbra is as wide as the bulb's disc.
    screen = '<geom type="box" size="2 4 .005" pos="-2 0 1.5"/>'
    light = '<light type="point" pos="0 0 3" diffuse="1 1 1" bulbradius="{}" ' + PLAIN + "/>"
    shares = {}
    for radius in (0.0, 0.5):
        points, found = lit_floor(light.format(radius), screen)
        shares[radius] = found[:, 0] * np.linalg.norm(points - (0, 0, 3), axis=1) / 3
    x, near = points[:, 0], np.abs(points[:, 1]) < 0.4
    # The screen hides the floor up to x = 0. There half of the bulb is seen, all of it from x = 0.5 on.
    lit = np.array([shares[0.5][near & (x > low) & (x <= low + 0.1)].mean() for low in np.arange(0.05, 0.75, 0.1)])
    assert lit[0] == pytest.approx(0.5 + 0.1 * 4 / np.pi, abs=0.06)  # 0.1 of the disc's diameter past its middle
    assert (np.diff(lit) > -0.01).all()
    np.testing.assert_allclose(shares[0.5][near & (x > 0.52)], 1.0, rtol=1e-4)
    np.testing.assert_allclose(shares[0.0][near & (x > 0.02)], 1.0, rtol=1e-4)


def test_headlight_looks_where_the_camera_looks():
    _, found = lit_floor("", header=HEADLIGHT)
    np.testing.assert_allclose(found, np.broadcast_to((0.6, 0.6, 0.6), found.shape), rtol=1e-5)
    _, none = lit_floor("", header=HEADLIGHT, model_lights=False)
    assert not none.any()


def test_inactive_lights_are_dark_until_they_are_switched_on():
    light = f'<light type="directional" dir="0 0 -1" diffuse="1 1 1" active="false" {PLAIN}/>'
    renderer, data = make_renderer(FLOOR + CAMERA + light, 5, 5, environment=None)
    renderer.update_scene(data, "down")
    assert not renderer.layers()["direct"].any()
    renderer.model.light_active[0] = 1
    renderer.update_scene(data, "down")
    np.testing.assert_allclose(renderer.layers()["direct"], 1.0, rtol=1e-5)


@pytest.mark.parametrize("shininess", [0.0, 0.5])
def test_highlight_is_the_lobe_about_the_mirror_direction(shininess):
    header = f'<asset><material name="shiny" rgba="0 0 0 1" specular="1" shininess="{shininess}"/></asset>'
    floor = '<geom name="floor" type="plane" size="9 9 .1" material="shiny"/>'
    light = '<light type="directional" dir="-2 0 -.5" diffuse="0 0 0" specular="1 1 1" ambient="0 0 0"/>'
    points, found = lit_floor(light, floor=floor, header=header)
    view = np.array((0, 0, 6)) - points
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    mirrored = view * (-1, -1, 1)
    aligned = mirrored @ np.array((2, 0, 0.5)) / np.sqrt(4.25)
    exponent = 32 * shininess
    # The bridge gives the lobe the reflectance 2/(n + 2), the lobe is (n + 2)/2 high, and the light comes in aslant.
    expected = np.where(aligned > 0, np.maximum(aligned, 0) ** exponent, 0) * 0.5 / np.sqrt(4.25)
    clear = np.abs(aligned) > 1e-4
    assert (aligned < 0).any()
    np.testing.assert_allclose(found[clear, 0], expected[clear], atol=1e-5)


def test_two_lights_add_up():
    one = f'<light type="directional" dir="-1 0 -1" diffuse=".5 .5 .5" {PLAIN}/>'
    two = f'<light type="point" pos="0 0 2" diffuse=".3 .2 .1" {PLAIN}/>'
    sums = [lit_floor(lights)[1] for lights in (one, two, one + two)]
    np.testing.assert_allclose(sums[2], sums[0] + sums[1], rtol=1e-5)
