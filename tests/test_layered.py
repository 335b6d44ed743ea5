"""The layered area light map: visibility of lights, and pictures made of it, against closed forms and rays."""

import numpy as np
import pytest

from tests.oracles import polygon_form_factor, sphere_form_factor
from tests.test_slab import ball, box, camera_at
from warp_psf.area_light.layered import PARTS, bake_layered_map
from warp_psf.area_light.light_samples import sample_light
from warp_psf.area_light.projection import project_forward, retrieve_backward, trace_view, upload_layers
from warp_psf.scene.light import AreaLight, rectangle_light, sphere_light
from warp_psf.scene.primitives import sphere
from warp_psf.scene.still import StillScene, join_pieces, make_still

WIDTH, HEIGHT = 160, 128
LAMP = rectangle_light("lamp", 0.8, 0.8, (3, 2, 1), (0, 0, 2), (0, 0, 0))


def floor(side: float = 4.0):
    return box((-side, -side, -0.1), (side, side, 0))


@pytest.fixture(scope="module")
def scene() -> StillScene:
    pieces = [floor(), box((-0.8, -0.3, 0), (-0.3, 0.3, 0.9)), box((0.2, 0.3, 0), (0.7, 0.8, 0.4))]
    return join_pieces([*pieces, ball((0.5, -0.5, 0.3), 0.3)], [camera_at((0.5, -4.5, 3.0), (0, 0, 0.2))])


@pytest.fixture(scope="module")
def layers(scene):
    return upload_layers(bake_layered_map(scene, LAMP, 384, device="cpu"), scene, "cpu")


def rmse(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.sqrt(np.mean((a - b) ** 2)))


def test_samples_lie_evenly_on_the_light():
    """Means over the first samples of any number: of a square's coordinates 0 and of their squares a third."""
    for count in (16, 64, 1000):
        samples = sample_light(LAMP, count)
        place = (samples.position - LAMP.position) @ LAMP.rotation / 0.4
        assert samples.area.sum() == pytest.approx(0.64, rel=1e-6)
        assert np.abs(place[:, 2]).max() < 1e-6 and np.abs(place).max() <= 1.0 + 1e-6
        assert np.abs(place[:, :2].mean(axis=0)).max() < 1.5 / np.sqrt(count) ** 1.5
        assert (place[:, :2] ** 2).mean(axis=0) == pytest.approx([1 / 3, 1 / 3], abs=1.0 / np.sqrt(count) ** 1.5)


def test_samples_of_a_ball_look_outwards():
    samples = sample_light(sphere_light("bulb", 0.2, (1, 1, 1), (1, 2, 3)), 500)
    aside = samples.position - [1, 2, 3]
    assert np.linalg.norm(aside, axis=1) == pytest.approx(0.2, rel=0.02)
    assert ((samples.normal * aside).sum(axis=1) > 0.19).all()
    assert np.abs(samples.normal.mean(axis=0)).max() < 0.03


def test_a_half_plane_hides_as_much_as_it_covers():
    """Under the edge of a wide board the visible part of a far lamp grows evenly from nothing to all."""
    lamp = rectangle_light("far", 2.0, 2.0, (1, 1, 1), (0, 0, 20), (0, 0, 0))
    board = box((-5, 0, 9.999), (5, 5, 10.0))
    scene = join_pieces([floor(3), board], [camera_at((0, -3, 6), (0, 0, 0))])
    layered = bake_layered_map(scene, lamp, 512, samples=400, device="cpu")
    on_floor = np.abs(layered.position[:, 2]) < 1e-4
    y, visibility = layered.position[on_floor, 1], layered.visibility[on_floor]
    # From (x, y, 0) the board's edge, half way up, hides of the lamp what lies beyond -y.
    expected = np.clip(0.5 - 0.5 * y, 0.0, 1.0)
    inside = np.abs(y) < 2
    # 400 samples are 20 rows; cosines and distances over the lamp differ by less than a hundredth.
    assert np.abs(visibility - expected)[inside].max() < 0.05
    assert rmse(visibility[inside], expected[inside]) < 0.015


def test_what_nothing_hides_is_all_visible_and_the_umbra_is_dark(scene):
    empty = join_pieces([floor()], [camera_at((0, -3, 3), (0, 0, 0))])
    layered = bake_layered_map(empty, LAMP, 64, device="cpu")
    up = layered.normal[:, 2] > 0.5
    assert (layered.visibility[up] == 1.0).all()
    lid = join_pieces([floor(1.0), box((-3, -3, 1.4), (3, 3, 1.5))], [camera_at((0, -3, 1), (0, 0, 0))])
    layers = upload_layers(bake_layered_map(lid, LAMP, 128, device="cpu"), lid, "cpu")
    picture = project_forward(layers, lid.cameras[0], 64, 64)
    assert not picture.color[picture.surface == 5].any()


def test_a_cell_keeps_few_points_of_a_surface(scene):
    layered = bake_layered_map(scene, LAMP, 96, device="cpu")
    cell = np.repeat(np.arange(96 * 96), np.diff(layered.first))
    keys = cell * len(scene.flat) + layered.surface
    _, counts = np.unique(keys, return_counts=True)
    # Nine views through each cell.
    assert counts.max() <= PARTS**2 and 4 < counts.mean() <= 9.5
    # Beside the boxes the views from the light's corners see what the middle one does not.
    surfaces = np.bincount(np.unique(keys) // len(scene.flat), minlength=96 * 96)
    assert (surfaces > 1).mean() > 0.02


def test_forward_projection_agrees_with_rays(scene, layers):
    traced = trace_view(layers, scene.cameras[0], WIDTH, HEIGHT)
    forward = project_forward(layers, scene.cameras[0], WIDTH, HEIGHT)
    assert np.array_equal(forward.surface, traced.surface)
    # What is left lies on edges: convolution blurs a pixel, and a cell of the map is as wide.
    assert rmse(forward.visibility, traced.visibility) < 0.03
    assert rmse(forward.color, traced.color) < 0.01 * traced.color.max()


def test_forward_projection_is_better_than_backward_where_samples_are_few(scene):
    camera = scene.cameras[0]
    few = upload_layers(bake_layered_map(scene, LAMP, 96, device="cpu"), scene, "cpu")
    traced = trace_view(few, camera, WIDTH, HEIGHT).color
    forward, backward = (picture(few, camera, WIDTH, HEIGHT).color for picture in (project_forward, retrieve_backward))
    assert rmse(forward, traced) < 0.8 * rmse(backward, traced)


def test_unhindered_colour_is_the_light_s(scene, layers):
    """Gauss points against the polygon's form factor, on the floor, 2 m away; a pixel is off the middle by 1 %."""
    traced = trace_view(layers, scene.cameras[0], WIDTH, HEIGHT)
    layer = trace_view(
        upload_layers(bake_layered_map(floor_only(scene), LAMP, 32, device="cpu"), floor_only(scene), "cpu"),
        scene.cameras[0],
        WIDTH,
        HEIGHT,
    )
    assert traced.color.shape == (HEIGHT, WIDTH, 3)
    top = layer.surface == layer.surface[HEIGHT // 2, WIDTH // 2]
    middle = layer.color[top].max(axis=0)
    corners = LAMP.position + np.array([[x, y, 0] for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]) @ (
        0.4 * LAMP.rotation.T
    )
    below = np.abs(polygon_form_factor(np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]), corners))[0]
    np.testing.assert_allclose(middle, 0.8 * below * np.array([3, 2, 1]), rtol=0.02)


def floor_only(scene: StillScene) -> StillScene:
    return join_pieces([floor()], scene.cameras)


def test_a_ball_of_light_has_a_map_all_around():
    """Inside a box, a luminous ball: all six sides are lit as its form factor says."""
    room = box((-1, -1, -1), (1, 1, 1))
    inward = make_still(room.vertices, room.faces[:, ::-1], cameras=[camera_at((0.9, 0.05, 0.1), (-1, 0, 0))])
    bulb = sphere_light("bulb", 0.15, (2, 2, 2), (0, 0, 0))
    layered = bake_layered_map(inward, bulb, 48, samples=512, device="cpu")
    assert len(np.unique(layered.surface)) == 6
    # Float32 puts some points of the walls' very edges outside the room.
    assert (layered.visibility == 1.0).mean() > 0.99
    layers = upload_layers(layered, inward, "cpu")
    picture = trace_view(layers, inward.cameras[0], 48, 48)
    retrieved = retrieve_backward(layers, inward.cameras[0], 48, 48)
    assert (retrieved.visibility[1:-1, 1:-1] == 1.0).mean() > 0.99
    expected = 2 * 0.8 * sphere_form_factor(np.array([[-1.0, 0, 0]]), np.array([[1.0, 0, 0]]), np.zeros(3), 0.15)[0]
    # Of 512 samples half face the wall.
    assert picture.color.max() == pytest.approx(expected, rel=0.02)


def test_unhindered_light_is_the_sum_over_its_samples(scene):
    """Against a float64 sum; 20 samples fill one block of sixteen, and four places of the next."""
    camera = scene.cameras[0]
    bulb = sphere_light("bulb", 0.3, (2, 2, 2), (0.4, 0.2, 1.5))
    bare = floor_only(scene)
    layers = upload_layers(bake_layered_map(bare, bulb, 16, samples=20, device="cpu"), bare, "cpu")
    picture = trace_view(layers, camera, WIDTH, HEIGHT)
    x, y = np.meshgrid((np.arange(WIDTH) + 0.5) / WIDTH, (np.arange(HEIGHT) + 0.5) / HEIGHT)
    half = camera.half_sizes(WIDTH, HEIGHT)
    film = np.stack([(2 * x - 1) * half[0], (1 - 2 * y) * half[1], -np.ones_like(x)], axis=-1)
    ray = film @ np.asarray(camera.rotation).T
    top = picture.surface == picture.surface[HEIGHT // 2, WIDTH // 2]
    point = camera.position - ray[top] * (camera.position[2] / ray[top][:, 2:])
    samples = sample_light(bulb, 20)
    offset = samples.position - point[:, None]
    leaving = np.maximum(-(samples.normal * offset).sum(axis=2), 0)
    sent = (offset[..., 2] * leaving * samples.area / (offset**2).sum(axis=2) ** 2).sum(axis=1)
    # Nothing hides the bulb's near half, and its far half sends nothing down. Float32 leaves six digits.
    np.testing.assert_allclose(picture.color[top][:, 0], 2 * 0.8 / np.pi * sent, rtol=1e-4, atol=1e-6)


def test_a_light_of_any_mesh_casts_shadows():
    lamp = AreaLight("bar", sphere(0.05), (9, 9, 9), position=np.array([0.0, 0.0, 2.0]))
    scene = join_pieces([floor(2), box((-0.2, -0.2, 0.8), (0.2, 0.2, 1.0))], [camera_at((0, -4, 3), (0, 0, 0))])
    layers = upload_layers(bake_layered_map(scene, lamp, 256, device="cpu"), scene, "cpu")
    forward, traced = (picture(layers, scene.cameras[0], 96, 96) for picture in (project_forward, trace_view))
    assert rmse(forward.visibility, traced.visibility) < 0.05
    assert (traced.visibility[traced.surface >= 0] == 0).any() and (traced.visibility == 1).any()


def test_holes_are_not_filled_across_surfaces():
    """A lit board over a floor that it darkens: pixels of either have their own surface's light, up to the edge."""
    lamp = rectangle_light("near", 0.3, 0.3, (1, 1, 1), (0, 0, 1.2), (0, 0, 0))
    scene = join_pieces(
        [floor(0.6), box((-0.5, -0.5, 0.2), (0.5, 0.5, 0.21))], [camera_at((0, -1.5, 1.2), (0, 0, 0.1))]
    )
    layers = upload_layers(bake_layered_map(scene, lamp, 64, device="cpu"), scene, "cpu")
    picture = project_forward(layers, scene.cameras[0], 96, 96)
    ids = scene.surface[(scene.normals[scene.faces].mean(axis=1)[:, 2] > 0.5)]
    board = picture.visibility[picture.surface == ids[-1]]
    assert len(board) > 500 and (board > 0.999).all()


def test_the_same_bits_again(scene):
    pictures = []
    for _ in range(2):
        layers = upload_layers(bake_layered_map(scene, LAMP, 96, device="cpu"), scene, "cpu")
        pictures.append(project_forward(layers, scene.cameras[0], WIDTH, HEIGHT).color)
    assert np.array_equal(*pictures)


def test_what_cannot_be_used_is_refused(scene, layers):
    with pytest.raises(ValueError, match="cells"):
        bake_layered_map(scene, LAMP, 1)
    with pytest.raises(ValueError, match="samples"):
        bake_layered_map(scene, LAMP, samples=0)
    with pytest.raises(ValueError, match="before light 'up'"):
        bake_layered_map(scene, rectangle_light("up", 1, 1, (1, 1, 1), (0, 0, 5), (0, 0, 9)))
    with pytest.raises(ValueError, match="hangs on the body"):
        bake_layered_map(scene, sphere_light("bulb", 0.1, (1, 1, 1), (0, 0, 2), body="arm"))
    with pytest.raises(ValueError, match="height"):
        project_forward(layers, scene.cameras[0], 64, 0)
