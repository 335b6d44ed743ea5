"""The path tracer against closed forms."""

import numpy as np
import pytest

from tests.oracles import make_model, polygon_form_factor, sphere_form_factor
from tests.oracles_bounce import traced_bounces, world_meshes
from warp_psf import rectangle_light
from warp_psf.basis import sh

UP = np.array([0.0, 0.0, 1.0])
# The coefficients of a sky of radiance 1.
WHITE_SKY = np.full((1, 3), np.sqrt(4 * np.pi))
# Shares of a plate that lie this many gaps away matter less than its square.
PLATE = 300.0


def surfaces(*materials: tuple[str, str, float]) -> str:
    """Materials by name, colour and emission: an MJCF section."""
    rows = [f'<material name="{n}" rgba="{rgb} 1" specular="0" emission="{e}"/>' for n, rgb, e in materials]
    return f"<asset>{''.join(rows)}</asset>"


def trace(model_and_data: tuple, points, normals, bounces: int, **options) -> np.ndarray:
    """Irradiance over pi, [bounces + 1, N, 3]."""
    points = np.atleast_2d(np.asarray(points, np.float64))
    normals = np.broadcast_to(normals, points.shape)
    options = {"paths": 1024, "material_space": "linear"} | options
    return traced_bounces(*model_and_data, points, normals, bounces=bounces, **options) / np.pi


def closed_room(material: str) -> str:
    walls = [(axis, side) for axis in range(3) for side in (-1.1, 1.1)]
    boxes = []
    for axis, side in walls:
        position, size = np.zeros(3), np.full(3, 1.2)
        position[axis], size[axis] = side, 0.1
        numbers = [" ".join(map(str, vector)) for vector in (position, size)]
        boxes.append(f'<geom type="box" pos="{numbers[0]}" size="{numbers[1]}" material="{material}"/>')
    return "".join(boxes)


def test_a_furnace_is_a_geometric_series():
    # MJCF's emission is a multiple of the colour: half of 2 is 1.
    model = make_model(closed_room("glow"), surfaces(("glow", ".5 .5 .5", 2.0)))
    found = trace(model, [[0.3, -0.2, -1.0], [0.95, 0.9, -1.0]], UP, bounces=4, coefficients=WHITE_SKY)
    expected = np.array([0.0, 1.0, 0.5, 0.25, 0.125])
    # No ray escapes and every path carries the same light: only rounding is left.
    assert found == pytest.approx(np.broadcast_to(expected[:, None, None], found.shape), abs=1e-5)


def test_a_sphere_over_a_plane_takes_and_gives_its_form_factor():
    ball = (
        '<geom type="plane" size="0 0 1" material="black"/><geom type="sphere" size=".5" pos="0 0 1" material="sun"/>'
    )
    model = make_model(ball, surfaces(("black", "0 0 0", 0), ("sun", "1 .5 0", 1.0)))
    points = np.stack([np.linspace(0.0, 2.0, 9), np.zeros(9), np.zeros(9)], axis=1)
    share = sphere_form_factor(points, UP, np.array([0, 0, 1.0]), 0.5)
    found = trace(model, points, UP, bounces=1, coefficients=WHITE_SKY, paths=4096)
    # The ball is a polyhedron, whose silhouette is smaller by up to 0.2 %.
    assert found[0] == pytest.approx(np.repeat(1 - share[:, None], 3, axis=1), abs=2e-3)
    # What the ball emits is the same in every direction; what it reflects of the sky comes on top.
    alone = trace(model, points, UP, bounces=1, paths=4096)
    assert alone[1] == pytest.approx(share[:, None] * np.array([1, 0.5, 0]), abs=2e-3)
    assert (found[1, :, :2] > alone[1, :, :2]).all()
    assert not alone[0].any()


def test_light_between_two_plates_swings_to_and_fro():
    plate = f'<geom type="box" size="{PLATE} {PLATE} .1" pos="0 0 {{}}" material="{{}}"/>'
    plates = plate.format(-0.1, "lower") + plate.format(1.1, "upper")
    model = make_model(plates, surfaces(("lower", ".8 .4 .2", 1.25), ("upper", ".5 .5 .9", 0)))
    emission, lower, upper = np.array([1, 0.5, 0.25]), np.array([0.8, 0.4, 0.2]), np.array([0.5, 0.5, 0.9])
    above = trace(model, [0, 0, 1.0], -UP, bounces=3)[:, 0]
    below = trace(model, [0, 0, 0.0], UP, bounces=3)[:, 0]
    nothing = np.zeros(3)
    # One path in 1 / PLATE^2 escapes, and paths are 1024.
    assert above == pytest.approx(np.array([nothing, emission, nothing, emission * upper * lower]), abs=2e-3)
    assert below == pytest.approx(np.array([nothing, nothing, emission * upper, nothing]), abs=2e-3)


def test_an_area_light_lights_a_plate_by_lamberts_formula():
    model = make_model('<geom type="plane" size="9 9 1" material="white"/>')
    light = rectangle_light("panel", 0.8, 0.6, (3.0, 2.0, 1.0), position=(0.2, 0, 1), target=(0.2, 0, 0))
    corners = np.array([[-0.4, -0.3, 0], [0.4, -0.3, 0], [0.4, 0.3, 0], [-0.4, 0.3, 0]]) @ light.rotation.T
    corners = corners + light.position
    points = np.stack([np.linspace(-1.0, 1.0, 9), np.full(9, 0.1), np.zeros(9)], axis=1)
    share = np.abs(polygon_form_factor(points, UP, corners))
    found = trace(model, points, UP, bounces=0, lights=(light,))[0]
    # A (0, 2)-sequence of 1024 points on a smooth integrand.
    assert found == pytest.approx(share[:, None] * light.radiance, rel=2e-3)
    # Nothing comes from the light's back, and it hides no sky.
    behind = trace(model, points + 1.5 * UP, -UP, bounces=0, lights=(light,))[0]
    assert not behind.any()
    with_sky = trace(model, points, UP, bounces=0, lights=(light,), coefficients=WHITE_SKY)[0]
    assert with_sky - found == pytest.approx(np.ones((9, 3)), abs=1e-5)


def test_an_area_light_is_hidden_by_what_stands_before_it():
    screen = '<geom type="box" size="1 1 .01" pos="0 0 .5" material="white"/>'
    model = make_model('<geom type="plane" size="9 9 1" material="white"/>' + screen)
    light = rectangle_light("panel", 0.4, 0.4, (1.0, 1.0, 1.0), position=(0, 0, 1), target=(0, 0, 0))
    assert not trace(model, [0, 0, 0], UP, bounces=0, lights=(light,)).any()


def test_an_area_light_over_a_plate_lights_a_plate_behind_it():
    # The light shines down at a floor; a point at the height h sees the lit spot through the light's back. All that the
    # light sends out, pi times its area, leaves the spot by the cosine: irradiance = albedo * pi * area / (pi h^2).
    model = make_model('<geom type="plane" size="9 9 1" material="grey"/>')
    light = rectangle_light("panel", 0.02, 0.02, (1.0, 1.0, 1.0), position=(0, 0, 0.05), target=(0, 0, 0))
    height = 4.0
    found = trace(model, [0, 0, height], -UP, bounces=1, lights=(light,), paths=2**16)[1]
    # `trace` divides by pi. The spot is centimetres wide: foreshortening and the noise of rays that hit it, 1 % each.
    assert found == pytest.approx(0.4 * 0.02**2 / (np.pi * height**2) * np.ones((1, 3)), rel=0.03)


def test_bounced_light_takes_the_colour_of_what_it_met():
    walls = (
        '<geom type="plane" size="3 3 1" material="white"/><geom type="box" size=".1 1 1" pos="1 0 1" material="red"/>'
    )
    model = make_model(walls, surfaces(("red", ".8 0 0", 0)))
    found = trace(model, [0.5, 0, 0], UP, bounces=1, coefficients=WHITE_SKY)[1, 0]
    assert found[0] > 0.01
    assert not found[1:].any()


def test_black_surfaces_reflect_nothing():
    model = make_model(closed_room("black"), surfaces(("black", "0 0 0", 0)))
    light = rectangle_light("panel", 0.5, 0.5, (1.0, 1.0, 1.0), position=(0, 0, 0.9), target=(0, 0, 0))
    found = trace(model, [0, 0, -1.0], UP, bounces=3, lights=(light,))
    assert found[0].all()
    assert not found[1:].any()


def test_band_limited_light_counts_where_it_is_negative():
    model = make_model('<geom type="plane" size="9 9 1" material="white"/>')
    coefficients = np.random.default_rng(3).normal(size=(16, 3))
    expected = sh.zonal(sh.clamped_cosine(4), UP) @ coefficients / np.pi
    found = trace(model, [0, 0, 0], UP, bounces=0, coefficients=coefficients, paths=4096)[0, 0]
    # A smooth integrand of size 1: 4096 scrambled points err by less than 1e-3.
    assert found == pytest.approx(expected, abs=1e-3)


def test_both_sides_of_a_sheet_reflect_and_only_the_front_emits():
    sheet = f'<geom type="plane" size="{PLATE} {PLATE} 1" material="glow"/>'
    model = make_model(sheet, surfaces(("glow", ".5 .5 .5", 2.0)))
    behind = trace(model, [0, 0, -1.0], UP, bounces=1, coefficients=WHITE_SKY)
    before = trace(model, [0, 0, 1.0], -UP, bounces=1, coefficients=WHITE_SKY)
    # Light from below on the sheet's back, radiance 0.5; from its front there is its emission too.
    assert behind[1] == pytest.approx(np.full((1, 3), 0.5), abs=2e-3)
    assert before[1] == pytest.approx(np.full((1, 3), 1.5), abs=5e-3)


def test_seeds_are_independent_and_repeatable():
    model = make_model('<geom type="plane" size="9 9 1" material="white"/><geom type="sphere" size=".3" pos="0 0 .3"/>')
    runs = [trace(model, [0.5, 0, 0], UP, 1, coefficients=WHITE_SKY, paths=64, seed=seed) for seed in (0, 0, 1)]
    assert np.array_equal(runs[0], runs[1])
    assert not np.array_equal(runs[0], runs[2])


def test_meshes_stand_where_the_model_puts_them():
    model, data = make_model('<geom type="box" size=".1 .2 .3" pos="1 2 3" euler="0 0 90"/>')
    light = rectangle_light("panel", 2.0, 2.0, (4.0, 5.0, 6.0), position=(0, 0, 2), target=(0, 0, 0))
    surfaces_found, lights_found = world_meshes(model, data, (light,))
    assert surfaces_found.vertices.min(axis=0) == pytest.approx([0.8, 1.9, 2.7], abs=1e-6)
    assert surfaces_found.entity.tolist() == [0] * len(surfaces_found.faces)
    assert lights_found is not None
    assert lights_found.emission.tolist() == [[4.0, 5.0, 6.0]]
    assert lights_found.normals == pytest.approx(np.broadcast_to(-UP, lights_found.normals.shape))
