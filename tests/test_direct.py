"""Direct light against closed forms: furnaces, one occluder, area lights."""

import numpy as np
import pytest

import warp_psf as psf
from tests.oracles import make_renderer, polygon_form_factor, shade_points, sphere_form_factor
from tests.oracles_bake import trace
from warp_psf.bake import body as bake_body
from warp_psf.basis import sh, sphere
from warp_psf.scene import primitives

WHITE = np.ones((4, 8, 3))
UP = np.array((0.0, 0.0, 1.0))
FLOOR = '<geom name="floor" type="plane" size="20 20 .1" material="white"/>'
# Points on the floor, along a line through the origin and two that miss it.
GRID = np.stack(np.meshgrid(np.linspace(-4, 4, 41), (0.0, -2.1, 1.7), 0.0), axis=-1).reshape(-1, 3)


def rectangle(width: float, height: float, at: float) -> np.ndarray:
    """Corners of a level rectangle above the origin, clockwise seen from below."""
    return np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]) * (width / 2, height / 2, 0) + (0, 0, at)


def light_share(lights, others: str = "", points: np.ndarray = GRID, order: int = 4, geom: str = "floor") -> np.ndarray:
    """Irradiance [N] of points on the floor from area lights of radiance 1, in units of pi."""
    renderer, _ = make_renderer(FLOOR + others, environment=None, lights=lights, order=order)
    return shade_points(renderer, geom, points, UP)[0][:, 0] / np.pi


# Furnaces: under a white sky with nothing in the way a receiver gets pi L, and white is as bright as the sky.


@pytest.mark.parametrize("shading", ["pixel", "vertex"])
@pytest.mark.parametrize("geom", ['"sphere" size=".5"', '"plane" size="2 2 .1"', '"box" size=".5 .3 .2"'])
def test_furnace(geom, shading):
    renderer, _ = make_renderer(f"<geom type={geom} material='white'/>", 54, 96, environment=WHITE, shading=shading)
    layers = renderer.layers()
    assert (layers["segmentation"][..., 0] == 0).mean() > 0.03
    # The body vanishes, edges and background included. 1e-4: float32 sums of 64 directions.
    np.testing.assert_allclose(layers["color"], 1.0, atol=1e-4)


def test_albedo_colours_the_furnace():
    renderer, _ = make_renderer('<geom type="sphere" size=".5" material="grey"/>', 54, 96, environment=WHITE)
    layers = renderer.layers()
    inside = layers["albedo"][..., 0] > 0.4 - 1e-6
    assert inside.mean() > 0.05
    np.testing.assert_allclose(layers["color"][inside], 0.4, atol=1e-4)
    np.testing.assert_allclose(layers["direct"][inside], 0.4, atol=1e-4)


@pytest.mark.parametrize("order", [4, 6])
def test_tilted_receivers_over_a_floor(order):
    ball = '<geom name="ball" type="sphere" size="1" pos="0 0 4" material="white"/>'
    renderer, _ = make_renderer(FLOOR.replace("20 20", "4000 4000") + ball, environment=2 * WHITE, order=order)
    normals = sphere.fibonacci_cap(200)
    irradiance, glossy = shade_points(renderer, "ball", normals + 4 * UP, normals)
    # The floor takes (1 - cos)/2 of a receiver's sky. Its rim leaves 0.001; the rest is the truncation of a half-space
    # times a cosine, whose closed form it meets too.
    share = irradiance[:, 0] / (2 * np.pi)
    np.testing.assert_allclose(share, 0.5 * (1 + normals[:, 2]), atol={4: 0.03, 6: 0.01}[order])
    below, cosine = sh.zonal(sh.cap(np.pi / 2, order), -UP), sh.zonal(sh.clamped_cosine(order), normals)
    np.testing.assert_allclose(share, 1 - cosine @ below / np.pi, atol=2e-3)
    assert not glossy.any()


def glossy_ball(shininess: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """A white sky in a ball: the lobe's share of it [N], normals and mirror directions [N, 3], and the exponent."""
    xml = '<geom name="ball" type="sphere" size="1" material="shiny"/>'
    header = f'<asset><material name="shiny" rgba="0 0 0 1" specular="1" shininess="{shininess}"/></asset>'
    renderer, _ = make_renderer(xml, environment=WHITE, header=header)
    normals = sphere.fibonacci_cap(400)
    view = renderer.world_from_camera[:3, 3] - normals
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    cosine = np.sum(view * normals, axis=1)
    seen = cosine > 0.02
    _, glossy = shade_points(renderer, "ball", normals[seen], normals[seen])
    mirrored = 2 * cosine[:, None] * normals - view
    return glossy[:, 0], normals[seen], mirrored[seen], renderer._stage.scene.entities[0].lobe.exponent


@pytest.mark.parametrize("shininess", [0.03125, 0.125, 1.0])
def test_glossy_reflection_is_the_lobe_times_the_cosine(shininess):
    glossy, normals, mirrored, exponent = glossy_ball(shininess)
    lobe = sh.zonal(sh.phong_lobe(exponent, 5), mirrored)
    expected = np.maximum(np.sum(lobe * sh.zonal(sh.clamped_cosine(5), normals), axis=1), 0)
    np.testing.assert_allclose(glossy, expected, atol=1e-4)  # float32 sums of 64 directions
    # Seen straight on the lobe with its cosine is normalised. The bands cut a sharp lobe's peak by 11 %.
    straight = np.sum(normals * mirrored, axis=1).argmax()
    assert glossy[straight] == pytest.approx(1.0, rel=0.15)


def test_glossy_furnace_conserves_energy():
    glossy, *_ = glossy_ball(0.03125)  # exponent 1: exact on two bands, nothing is truncated
    assert glossy.max() <= 1.0 + 1e-4


# One occluder


@pytest.mark.parametrize(("order", "largest", "rms"), [(4, 0.027, 0.011), (6, 0.006, 0.003)])
def test_sphere_over_a_plane(order, largest, rms):
    # What truncation allows one unit sphere over a plane, as a share of the unshadowed irradiance, for light of the
    # same order; a uniform sky is far within it.
    center = np.array((0.0, 0.0, 1.05))
    ball = '<geom name="ball" type="sphere" size="1" pos="0 0 1.05"/>'
    renderer, _ = make_renderer(FLOOR + ball, environment=WHITE, order=order)
    share = shade_points(renderer, "floor", GRID, UP)[0][:, 0] / np.pi
    error = share - (1 - sphere_form_factor(GRID, UP, center, 1.0))
    assert share.min() < 0.15
    assert np.abs(error).max() < largest
    assert np.sqrt(np.mean(error**2)) < rms


def test_box_takes_its_form_factor():
    # A level slab above the floor: its underside is all that the floor sees.
    slab = '<geom name="slab" type="box" size="2 1.5 .0005" pos="0 0 1"/>'
    renderer, _ = make_renderer(FLOOR + slab, environment=WHITE)
    share = shade_points(renderer, "floor", GRID, UP)[0][:, 0] / np.pi
    expected = 1 - polygon_form_factor(GRID, UP, rectangle(4, 3, 1.0))
    assert expected.min() < 0.25
    np.testing.assert_allclose(share, expected, atol=0.027)  # truncation, as for the sphere


# Area lights


def test_rectangle_light_over_a_floor():
    # Unhindered, its irradiance is the closed form and not the truncated projection; what is left is float32.
    for size, height in ((4, 1.5), (0.5, 0.8)):
        light = psf.rectangle_light("panel", size, size, (1, 1, 1), (0, 0, height), (0, 0, 0))
        expected = polygon_form_factor(GRID, UP, rectangle(size, size, height))
        np.testing.assert_allclose(light_share([light]), expected, atol=1e-5)


@pytest.mark.parametrize(
    ("light", "meets"),
    [
        (
            psf.rectangle_light("panel", 1.4, 1, (1, 1, 1), (0, 0, 1.0), (0, 0, 0)),
            lambda p, d: (
                (np.abs(p[:2] + d[:, :2] / np.maximum(d[:, 2:], 1e-9)) < (0.7, 0.5)).all(axis=1) & (d[:, 2] > 0)
            ),
        ),
        (
            psf.AreaLight("bulb", primitives.sphere(0.6), (1, 1, 1), position=(0, 0, 1.0)),
            lambda p, d: (d @ (UP - p)) > np.sqrt((UP - p) @ (UP - p) - 0.36),
        ),
        (psf.AreaLight("crate", primitives.box((0.7, 0.5, 0.3)), (1, 1, 1), position=(0, 0, 1.0)), None),
    ],
    ids=["rectangle", "sphere", "box"],
)
def test_lights_that_the_horizon_cuts(light, meets):
    # Points below the light with normals to all sides; some see a part of it, some nothing.
    points = GRID[::5]
    normals = np.random.default_rng(6).normal(size=points.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    directions = sphere.fibonacci_cap(40_000)
    renderer, _ = make_renderer(FLOOR, environment=None, lights=[light])
    found = np.array(
        [shade_points(renderer, "floor", p[None], n)[0][0, 0] for p, n in zip(points, normals, strict=True)]
    )
    if meets is None:
        seen = trace(light.mesh, points - UP, directions) > 0
    else:
        seen = np.array([meets(p, directions) for p in points])
    cosine = np.maximum(directions @ normals.T, 0).T
    expected = (seen * cosine).sum(axis=1) * (4 * np.pi / len(directions))
    below = (seen & (cosine == 0)).any(axis=1) & (expected > 0)
    assert below.sum() >= 2
    # The grid of directions errs by about 2e-3 on the largest, whose irradiance is 1.
    np.testing.assert_allclose(found, expected, atol=4e-3)


def test_lights_add_up_in_their_colours():
    above = psf.rectangle_light("above", 2, 2, (3, 0, 0.5), (0, 0, 1.5), (0, 0, 0))
    aside = psf.rectangle_light("aside", 1, 1, (0, 2, 0.5), (3, 0, 1.0), (0, 0, 0))
    received = []
    for lights in ([above], [aside], [above, aside]):
        renderer, _ = make_renderer(FLOOR, environment=0.3 * WHITE, lights=lights)
        received.append(shade_points(renderer, "floor", GRID, UP)[0] - 0.3 * np.pi)
    np.testing.assert_allclose(received[2], received[0] + received[1], atol=1e-5)
    np.testing.assert_allclose(received[0][:, 1], 0.0, atol=1e-5)
    np.testing.assert_allclose(received[0][:, 0], 6 * received[0][:, 2], atol=1e-5)


def test_nothing_behind_a_rectangle_light():
    light = psf.rectangle_light("panel", 2, 2, (1, 1, 1), (0, 0, 1.5), (0, 0, 3))
    assert not light_share([light]).any()


@pytest.mark.parametrize(
    "other",
    [
        '<geom type="sphere" size="1" pos="0 0 4"/>',  # behind
        '<geom type="box" size="1 1 .3" pos="0 0 4"/>',
        '<geom type="sphere" size=".5" pos="9 0 3"/>',  # beside
        '<geom type="box" size=".3 .3 .3" pos="-9 3 .3"/>',
        '<geom type="plane" size="5 5 .1" pos="0 0 8" euler="180 0 0"/>',  # a ceiling
    ],
)
def test_occluders_behind_and_beside_a_light_change_nothing(other):
    light = psf.rectangle_light("panel", 2, 2, (1, 1, 1), (0, 0, 1.5), (0, 0, 0))
    np.testing.assert_array_equal(light_share([light], other), light_share([light]))


def test_a_ceiling_right_above_a_light_changes_nothing():
    light = psf.rectangle_light("panel", 1, 1, (1, 1, 1), (0, 0, 1.99), (0, 0, 0))
    ceiling = '<geom type="box" size="5 5 .1" pos="0 0 2.1"/>'
    np.testing.assert_allclose(light_share([light], ceiling), light_share([light]), atol=1e-3)


@pytest.mark.parametrize("shape", ['"sphere" size=".5"', '"box" size=".8 .8 .05"'])
def test_an_occluder_that_covers_a_light_takes_most_of_it(shape):
    light = psf.rectangle_light("panel", 0.4, 0.4, (1, 1, 1), (0, 0, 2), (0, 0, 0))
    below = GRID[np.linalg.norm(GRID, axis=1) < 0.3]
    free, hidden = light_share([light], points=below), light_share([light], f"<geom type={shape} pos='0 0 1'/>", below)
    # Four bands resolve 45 degrees: the sphere, 60 degrees wide, lets two fifths of a light behind it through.
    assert (hidden < {"sph": 0.45, "box": 0.2}[shape[1:4]] * free).all()


@pytest.mark.parametrize(("order", "rms"), [(4, 0.03), (6, 0.01)])
def test_shadow_of_a_ball_before_a_light(order, rms):
    # The light's visible part, sampled. Its share is the quotient of truncated products, the worse the smaller light
    # and body are: this light is 74 degrees wide, the ball up to 60.
    center, radius = np.array((0.3, 0.0, 0.8)), 0.4
    places = (np.arange(24) + 0.5) / 24 - 0.5
    x, y = np.meshgrid(3 * places, 3 * places)
    toward = np.stack([x.ravel(), y.ravel(), np.full(x.size, 2.0)], axis=1) - GRID[:, None]
    squared = np.sum(toward**2, axis=2)
    along = np.clip(np.sum((center - GRID)[:, None] * toward, axis=2) / squared, 0, 1)
    free = np.sum(((center - GRID)[:, None] - along[..., None] * toward) ** 2, axis=2) > radius**2
    weight = toward[..., 2] ** 2 / squared**2 * (9 / x.size / np.pi)
    expected, most = (weight * free).sum(axis=1), weight.sum(axis=1).max()
    light = psf.rectangle_light("panel", 3, 3, (1, 1, 1), (0, 0, 2), (0, 0, 0))
    error = light_share([light], '<geom type="sphere" size=".4" pos=".3 0 .8"/>', order=order) - expected
    assert (expected / weight.sum(axis=1)).min() < 0.5
    assert np.sqrt(np.mean(error**2)) < rms * most


def test_sphere_light_is_its_form_factor():
    ball = psf.AreaLight("bulb", primitives.sphere(1.0), (1, 1, 1), position=(0, 0, 1.6))
    expected = sphere_form_factor(GRID, UP, np.array((0, 0, 1.6)), 1.0)
    np.testing.assert_allclose(light_share([ball]), expected, atol=1e-5)  # a closed form, in float32


def test_mesh_light_through_its_radiance_field(monkeypatch):
    monkeypatch.setattr(bake_body, "FINEST_RESOLUTION", 16)  # a fraction of the time to bake
    capsule = primitives.capsule(0.4, 0.6)
    rotation = np.array([(0.0, 0, 1), (1, 0, 0), (0, 1, 0)])  # lying along x
    light = psf.AreaLight("tube", capsule, (1, 1, 1), position=(0, 0, 0.9), rotation=rotation)
    directions = sphere.fibonacci_cap(20_000)
    points = GRID[::4]
    hits = trace(capsule, (points - (0, 0, 0.9)) @ rotation, directions @ rotation) > 0
    expected = hits @ np.maximum(directions[:, 2], 0) * (4 * np.pi / 20_000) / np.pi
    assert expected.max() > 0.3
    # Truncation at order 4 (0.027 of a unit sphere, which is larger), interpolation in the field, 8-bit codes.
    np.testing.assert_allclose(light_share([light], points=points), expected, atol=0.03)


def test_lights_are_luminous_bodies_that_cast_no_shadow():
    light = psf.rectangle_light("panel", 1, 1, (3, 2, 1), (0, 0, 1), (0, 0, 0))
    lit, _ = make_renderer(FLOOR, environment=WHITE, lights=[light])
    free, _ = make_renderer(FLOOR, environment=WHITE)
    assert [entity.name for entity in lit._stage.scene.entities] == ["floor", "panel"]
    assert lit.occluders == free.occluders == 1
    # The sky reaches the floor past the light, which adds to it.
    assert (shade_points(lit, "floor", GRID, UP)[0] >= shade_points(free, "floor", GRID, UP)[0] - 1e-6).all()


def test_camera_sees_a_light_s_front_luminous_and_its_back_dark():
    below = '<camera name="below" pos="0 0 .2" xyaxes="1 0 0 0 -1 0"/>'
    above = '<camera name="above" pos="0 0 2" xyaxes="1 0 0 0 1 0"/>'
    light = psf.rectangle_light("panel", 1, 1, (3, 2, 1), (0, 0, 1), (0, 0, 0))
    renderer, data = make_renderer(FLOOR + below + above, 9, 9, environment=None, lights=[light])
    renderer.update_scene(data, "below")
    layers = renderer.layers()
    np.testing.assert_array_equal(layers["color"][4, 4], (3, 2, 1))
    np.testing.assert_array_equal(layers["direct"][4, 4], 0)
    renderer.update_scene(data, "above")
    np.testing.assert_array_equal(renderer.layers()["color"][4, 4], 0)


def test_an_open_bowl_is_seen_from_its_outside(monkeypatch):
    monkeypatch.setattr(bake_body, "FINEST_RESOLUTION", 16)  # a fraction of the time to bake
    ball = primitives.sphere(1.0, 2)
    used, faces = np.unique(ball.faces[(ball.vertices[ball.faces][..., 2] < 1e-4).all(axis=1)], return_inverse=True)
    numbers = ['"' + " ".join(map(str, array.ravel())) + '"' for array in (ball.vertices[used], faces)]
    header = f"<asset><mesh name='bowl' vertex={numbers[0]} face={numbers[1]} inertia='shell'/></asset>"
    above, below = '<camera name="above" pos="0 0 4"/>', '<camera name="below" pos="0 0 -4" euler="180 0 0"/>'
    sky = psf.Environment.from_coefficients(np.pad([[1.0] * 3, [0] * 3, [0.577] * 3], ((0, 13), (0, 0))))
    bowl = '<geom name="bowl" type="mesh" mesh="bowl" material="white"/>'
    with pytest.warns(UserWarning, match="'bowl' is open"):
        renderer, data = make_renderer(bowl + above + below, 9, 9, header=header, environment=sky)
    middle = {}
    for camera in ("above", "below"):
        renderer.update_scene(data, camera)
        layers = renderer.layers()
        middle[camera] = layers["segmentation"][4, 4, 0], layers["direct"][4, 4, 0]
    # Into the bowl one sees its faces from behind, which MuJoCo does not draw; the sky lights its outside from below.
    assert middle["above"] == (-1, 0.0)
    assert middle["below"][0] == 0
    assert 0.0 < middle["below"][1] < 0.5


# Lights in awkward places


@pytest.mark.parametrize("shading", ["pixel", "vertex"])
def test_a_panel_that_stands_on_the_floor_lights_it(shading):
    # The panel's lower edge lies exactly in the floor's plane: corners at height zero must close its polygon too.
    camera = '<camera name="front" pos="0 0 4" xyaxes="1 0 0 0 1 0"/>'
    floor = '<geom name="floor" type="box" size="2 2 .1" pos="0 0 -.1"/>'
    mean = {}
    for height in (0.5, 0.5 + 1e-4):
        lifted = psf.rectangle_light("panel", 1, 1, (1, 1, 1), (0, 2, height), (0, 0, height))
        renderer, data = make_renderer(floor + camera, 32, 32, environment=None, lights=[lifted], shading=shading)
        renderer.update_scene(data, "front")
        mean[height] = renderer.layers()["direct"].mean()
    # A ten-thousandth of a metre changes the light by about as much.
    assert mean[0.5] == pytest.approx(mean[0.5 + 1e-4], rel=1e-2)
    assert mean[0.5] > 0


def test_a_tiny_lamp_keeps_its_light():
    # The coverage of small caps must keep its digits, or an empty floor would count as shadowed: 4 mm at 10 m.
    kit = [psf.AreaLight("lamp", primitives.sphere(0.004), (1e4,) * 3, (0, 0, 10))]
    renderer, _ = make_renderer(FLOOR, environment=None, lights=kit)
    found = shade_points(renderer, "floor", np.zeros((1, 3)), UP)[0][0, 0]
    assert found == pytest.approx(np.pi * 1e4 * (0.004 / 10) ** 2, rel=1e-3)
