"""Small bright sources at full frequency: closed forms, rays, and what must not depend on the scene's turn."""

import mujoco
import numpy as np
import pytest
import warp as wp

import warp_psf as psf
from sims.bodies import statue_like
from tests.oracles import make_renderer, polygon_form_factor
from tests.oracles_bounce import traced_bounces
from tests.oracles_sun import traced_sun
from warp_psf.basis import sphere
from warp_psf.shade.sharp import add_sharp_light

FLOOR = '<geom name="floor" type="plane" size="20 20 .1" material="white"/>'
ROWS = 512
DIRECTIONS = sphere.latlong_directions(ROWS, 2 * ROWS)
SOLID_ANGLES = np.broadcast_to(sphere.latlong_solid_angles(ROWS, 2 * ROWS), (ROWS, 2 * ROWS))
TOWARD = np.array((0.6, -0.5, 0.8)) / np.linalg.norm((0.6, -0.5, 0.8))
DIAMETER = np.radians(3.0)


def sun(toward=TOWARD, diameter=DIAMETER):
    """A sun that gives what faces it the irradiance 1."""
    inside = DIRECTIONS @ toward > np.cos(diameter / 2)
    return np.repeat((inside / (inside * SOLID_ANGLES).sum())[..., None], 3, axis=2)


def picture(worldbody, light, *, header="", lights=(), height=90, width=160, basis="haar", order=4):
    """Irradiance, place, normal and geom of every pixel's centre."""
    options = {"environment": light, "basis": basis, "bounces": 0, "lights": lights, "order": order}
    camera = '<camera name="front" pos="0 -5 4" xyaxes="1 0 0 0 .62 .78" fovy="40"/>'
    renderer, data = make_renderer(worldbody + camera, height, width, header=header, **options)
    renderer.update_scene(data, "front")
    renderer.render()
    stage, count = renderer._stage, height * width
    receivers = stage.surfaces.receivers
    entity = receivers.entity.numpy()[0, :count]
    names = np.array([each.name for each in stage.scene.entities] + ["nothing"])[entity]
    arrays = (stage.received[0], receivers.position, receivers.normal)
    found = (array.numpy()[0, :count] for array in arrays)
    return *found, names, renderer, data


def test_an_open_floor_gets_the_sun_s_cosine():
    irradiance, _, _, names, *_ = picture(FLOOR, sun())
    np.testing.assert_allclose(irradiance[names == "floor"], TOWARD[2], rtol=2e-3)


# A penumbra is two pixels wide here. What a share of the sun is beside a curved edge, in place of a straight one, costs
# some per cent of it; an edge from a field is up to 0.4 degrees off besides, an eighth of this sun.
@pytest.mark.parametrize(
    ("shape", "rms"),
    [('type="sphere" size=".5"', 0.06), ('type="box" size=".4 .3 .5"', 0.06), ('type="capsule" size=".3 .4"', 0.12)],
)
def test_shadows_are_those_of_rays(shape, rms):
    body = f'<geom name="body" {shape} pos="0 0 1" material="white" euler="20 30 10"/>'
    irradiance, points, normals, names, renderer, data = picture(FLOOR + body, sun())
    on_floor = names == "floor"
    visible, _ = traced_sun(renderer.model, data, points[on_floor], normals[on_floor], TOWARD, DIAMETER)
    error = irradiance[on_floor, 0] / TOWARD[2] - visible
    shadow = visible < 1
    assert shadow.sum() > 100
    assert np.sqrt((error[shadow] ** 2).mean()) < rms
    assert np.abs(error[~shadow]).mean() < 0.004


@pytest.fixture(scope="module")
def statue():
    vertices, faces = statue_like(cells=24)
    points = " ".join(map(str, np.ravel(vertices)))
    header = f'<asset><mesh name="statue" vertex="{points}" face="{" ".join(map(str, np.ravel(faces)))}"/></asset>'
    return header, FLOOR + '<body pos="0 0 .55"><geom name="statue" type="mesh" mesh="statue" material="white"/></body>'


def test_a_statue_s_shadow_is_twice_as_right_as_that_of_six_bands(statue):
    header, world = statue
    errors = {}
    for basis, order in (("haar", 4), ("sh", 6)):
        irradiance, points, normals, names, renderer, data = picture(
            world, sun(), header=header, basis=basis, order=order
        )
        seen = names != "nothing"
        _, expected = traced_sun(renderer.model, data, points[seen], normals[seen], TOWARD, DIAMETER)
        scale = 1 / (4 * np.pi * np.sin(DIAMETER / 4) ** 2)
        errors[basis] = np.sqrt(((irradiance[seen, 0] - scale * expected) ** 2).mean())
    assert errors["haar"] < 0.5 * errors["sh"]


def test_turning_everything_turns_the_light(statue):
    header, world = statue
    plain = picture(world, sun(), header=header)
    turned_sun = sun(np.array((-TOWARD[1], TOWARD[0], TOWARD[2])))
    camera_turned = world.replace("<body pos", '<body euler="0 0 90" pos')
    renderer = plain[4]
    receivers = renderer._stage.surfaces.receivers
    other = picture(camera_turned, turned_sun, header=header)[4]
    # The same points, turned by a right angle, on the turned floor.
    stage = other._stage
    turn = np.array(((0, -1, 0), (1, 0, 0), (0, 0, 1.0)))
    count = 90 * 160
    for name in ("position", "normal"):
        values = getattr(receivers, name).numpy()[0] @ turn.T
        getattr(stage.surfaces.receivers, name).assign(values[None].astype(np.float32))
    for name in ("entity", "face", "uv"):
        getattr(stage.surfaces.receivers, name).assign(getattr(receivers, name).numpy())
    received = [wp.zeros_like(array) for array in stage.received]
    stage.lattice.turns.fill_(1)
    add_sharp_light(
        stage.surfaces.receivers,
        stage.lattice.turns,
        1,
        stage.device_scene,
        stage.occlusion,
        stage.lighting,
        stage.sharp,
        *received,
        stage.settings.device,
    )
    found, expected = received[0].numpy()[0, :count, 0], plain[0][:, 0]
    seen = plain[3] != "nothing"
    # The two images of the sun have their pixels at other places.
    assert np.abs(found - expected)[seen].mean() < 0.004


def test_half_of_the_light_passes_a_body_of_half_opacity():
    body = '<geom name="body" type="sphere" size=".5" pos="0 0 1" rgba="1 1 1 .5"/>'
    irradiance, points, _, names, *_ = picture(FLOOR + body, sun())
    # The middle of the shadow.
    middle = np.array((0, 0, 1.0)) - TOWARD / TOWARD[2]
    inside = (names == "floor") & (np.linalg.norm(points - middle, axis=1) < 0.2)
    assert inside.sum() > 5
    np.testing.assert_allclose(irradiance[inside], 0.5 * TOWARD[2], rtol=5e-3)


def test_a_rectangle_light_past_nothing_is_its_form_factor():
    lamp = psf.rectangle_light("lamp", 1.0, 0.8, (2, 2, 2), (0.3, 0.2, 2.0), (0.3, 0.2, 0.0))
    irradiance, points, normals, names, *_ = picture(FLOOR, None, lights=[lamp])
    on_floor = names == "floor"
    corners = np.array([(-0.2, -0.2, 2), (0.8, -0.2, 2), (0.8, 0.6, 2), (-0.2, 0.6, 2.0)])
    expected = np.abs(polygon_form_factor(points[on_floor], normals[on_floor], corners)) * 2 * np.pi
    # Between the pixels that are shaded, half a percent is interpolation's.
    error = np.abs(irradiance[on_floor, 0] / expected - 1)
    assert np.median(error) < 1e-3
    assert error.max() < 6e-3


def test_a_plate_between_hides_a_lamp_from_what_is_right_below():
    lamp = psf.rectangle_light("lamp", 0.2, 0.2, (2, 2, 2), (0, 0, 2.0), (0, 0, 0))
    plate = '<geom name="plate" type="box" size=".5 .5 .01" pos="0 0 1" material="white"/>'
    irradiance, points, _, names, *_ = picture(FLOOR + plate, None, lights=[lamp])
    bare, *_ = picture(FLOOR, None, lights=[lamp])
    on_floor = names == "floor"
    # From a lamp of half-width 0.1 at twice the plate's height the umbra ends 0.9 from the middle, the penumbra at 1.1.
    reach = np.abs(points[:, :2]).max(axis=1)
    assert irradiance[on_floor & (reach < 0.85)].max() < 1e-4
    outside = on_floor & (reach > 1.2)
    # Half a percent is interpolation's.
    np.testing.assert_allclose(irradiance[outside], bare[outside], rtol=6e-3)


@pytest.mark.parametrize("turn", ["90 0 20", "60 0 20"])
def test_a_lamp_s_shadow_is_that_of_rays_right_beside_what_casts_it(turn):
    lamp = psf.rectangle_light("lamp", 0.6, 0.6, (9, 9, 9), (1.2, -0.8, 1.8), (0, 0, 0))
    # It sinks into the floor a little, as contacts leave bodies.
    body = f'<geom name="body" type="cylinder" size=".3 .3" pos="0 0 .29" material="white" euler="{turn}"/>'
    irradiance, points, normals, names, renderer, data = picture(FLOOR + body, None, lights=[lamp])
    beside = (names == "floor") & (np.linalg.norm(points - (0, 0, 0.29), axis=1) < 0.58)
    light = {"lights": (lamp,), "bounces": 0, "paths": 1024}
    expected = traced_bounces(renderer.model, data, points[beside], normals[beside], **light)[0]
    error = (irradiance[beside] - expected)[:, 0] / expected.max()
    assert beside.sum() > 50
    # Rays of the reference leave noise of 0.01; pixels between those that are shaded are interpolated.
    assert np.sqrt((error**2).mean()) < 0.018


def test_a_lamp_above_a_ceiling_s_plane_is_hidden_by_nothing_behind_it():
    lamp = psf.rectangle_light("lamp", 0.4, 0.4, (2, 2, 2), (0, 0, 2.0), (0, 0, 0))
    ceiling = '<geom name="ceiling" type="box" size="3 3 .1" pos="0 0 2.2" material="white"/>'
    arrays = [picture(FLOOR + others, None, lights=[lamp])[0] for others in ("", ceiling)]
    np.testing.assert_allclose(arrays[0][-2000:], arrays[1][-2000:], rtol=1e-4)


def test_a_mirror_like_ball_shows_the_sun_in_one_spot():
    header = '<asset><material name="gloss" rgba="0 0 0 1" specular="1" shininess=".5"/></asset>'
    body = '<geom name="ball" type="sphere" size="1" pos="0 0 1" material="gloss"/>'
    *_, renderer, _ = picture(body, sun(), header=header)
    stage = renderer._stage
    count = 90 * 160
    glossy = stage.received[1].numpy()[0, :count, 0]
    entity = stage.surfaces.receivers.entity.numpy()[0, :count]
    n = stage.surfaces.receivers.normal.numpy()[0, :count]
    p = stage.surfaces.receivers.position.numpy()[0, :count]
    view = stage.lighting.table.eye.numpy()[0] - p
    view /= np.linalg.norm(view, axis=1)[:, None]
    mirrored = 2 * (n * view).sum(axis=1)[:, None] * n - view
    e = float(stage.device_scene.geometry.tables[0].exponent.numpy()[0])
    aligned, cosine = np.maximum(mirrored @ TOWARD, 0), np.maximum(n @ TOWARD, 0)
    expected = (e + 2) / (2 * np.pi) * aligned**e * cosine
    seen = entity >= 0
    # The lobe is taken at the middle of the sun: over 1.5 degrees it changes by e tan(1.5)^2 / 4 and less.
    np.testing.assert_allclose(glossy[seen], expected[seen], atol=0.01 * expected.max())


def test_the_same_twice_is_the_same_to_the_bit(statue):
    header, world = statue
    first, second = (picture(world, sun(), header=header)[0] for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_other_light_on_the_same_stage_is_as_on_a_new_one():
    body = '<geom name="body" type="sphere" size=".5" pos="0 0 1" material="white"/>'
    fresh = picture(FLOOR + body, sun())[0]
    *_, renderer, data = picture(FLOOR + body, np.ones((8, 16, 3)))
    renderer.environment = sun()
    renderer.update_scene(data, "front")
    renderer.render()
    np.testing.assert_array_equal(renderer._stage.received[0].numpy()[0, : 90 * 160], fresh)


def test_a_small_sun_lights_in_bounces():
    wall = '<geom name="wall" type="box" size=".1 1 1" pos="-1 0 1" rgba="1 0 0 1"/>'
    model = FLOOR + wall + '<geom name="ball" type="sphere" size=".3" pos="0 0 .3" material="white"/>'
    red = {}
    for basis in ("sh", "haar"):
        renderer, data = make_renderer(
            model + '<camera name="front" pos="0 -5 4" xyaxes="1 0 0 0 .62 .78" fovy="40"/>',
            45,
            80,
            environment=sun(),
            basis=basis,
            bounces=2,
        )
        renderer.update_scene(data, "front")
        red[basis] = renderer.layers()["indirect"].mean(axis=(0, 1))
    # What bounces is smooth: both bases agree about its amount, and that it is red.
    assert red["haar"][0] > 2 * red["haar"][2]
    np.testing.assert_allclose(red["haar"], red["sh"], rtol=0.15)


def test_an_unknown_basis_is_refused():
    with pytest.raises(ValueError, match="basis is 'fourier'; choose 'sh' or 'haar'"):
        psf.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), basis="fourier")
