"""Priority point lists: what is sampled, and pictures without holes, against rays."""

import numpy as np
import pytest

from sims.bodies import teapot_like
from tests.oracles_area import view_points
from tests.test_slab import ball, box, camera_at
from warp_psf.area_light.points import sample_points
from warp_psf.area_light.splatting import splat_points, upload_points
from warp_psf.scene.camera import Camera
from warp_psf.scene.still import StillScene, join_pieces, make_still

WIDTH, HEIGHT = 160, 120
TRIANGLE = ([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])


def scenes() -> dict[str, StillScene]:
    """Large triangles, small ones, and both."""
    vertices, faces = teapot_like(rings=16, segments=24)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    teapot = make_still((vertices - 0.5 * (low + high)) / np.ptp(vertices, axis=0).max(), faces)
    return {
        "box": join_pieces([box((-0.5, -0.3, -0.2), (0.5, 0.3, 0.2))], []),
        "ball": join_pieces([ball((0, 0, 0), 0.5)], []),
        "teapot": teapot,
        "mixture": join_pieces([box((-0.6, -0.6, -0.5), (0.6, 0.6, -0.4)), ball((0.1, 0.1, -0.15), 0.25)], []),
    }


@pytest.fixture(scope="module", params=scenes())
def scene(request) -> StillScene:
    return scenes()[request.param]


def seen_from(scene: StillScene, camera: Camera):
    """The mask of what rays through pixels' centres meet, and those pixels whose neighbours all do."""
    held = StillScene(scene.vertices, scene.normals, scene.faces, scene.surface, scene.flat, scene.albedo, (camera,))
    there, *_ = view_points(held, 0, WIDTH, HEIGHT)
    return there


def shifted(mask: np.ndarray) -> np.ndarray:
    """A mask [9, height, width] and its shifts by a pixel in every direction."""
    padded = np.pad(mask, 1)
    return np.stack([padded[y : y + HEIGHT, x : x + WIDTH] for y in range(3) for x in range(3)])


def test_a_triangle_s_squares_cover_it_once_and_reach_little_beyond():
    """Areas: the squares hold the triangle, 1/2, and beyond it at most a band of their diagonal along its sides."""
    for levels in (1, 3, 4):
        lists = sample_points(make_still(*TRIANGLE), smallest=0.01, levels=levels)
        area = sum(count * lists.size(level) ** 2 for level, count in enumerate(lists.counts))
        assert 0.5 <= area <= 0.5 + (2 + np.sqrt(2)) * 0.01 * np.sqrt(2)
        # Inside, a larger square in place of small ones.
        assert (lists.counts.sum() > 4000) == (levels == 1)


def test_large_squares_lie_within_and_small_ones_along_the_edges():
    lists = sample_points(make_still(*TRIANGLE), smallest=1 / 256, levels=4)
    distance = []
    for group in range(len(lists.triangle)):
        if lists.stands_in[group]:
            continue
        size = lists.size(lists.level[group])
        middle = (lists.cell[lists.first[group] : lists.first[group + 1]] + 0.5) * size
        p = lists.origin[0] + middle @ lists.axes[0]
        inside = np.minimum(np.minimum(p[:, 0], p[:, 1]), (1 - p[:, 0] - p[:, 1]) / np.sqrt(2))
        distance += [(lists.level[group], value / size) for value in inside]
    level, aside = np.array(distance).T
    # A square within a triangle is half its side off the edges, at least. The smallest ones are quarters of squares
    # that an edge crosses: 3/4 of their diagonal of 2 sqrt(2) within, or half their own without.
    assert aside[level < 3].min() >= 0.5 - 1e-6
    assert aside[level == 3].max() < 1.5 * np.sqrt(2) + 1e-6 and aside[level == 3].min() > -np.sqrt(0.5) - 1e-6


def test_a_tiny_triangle_is_one_point_that_is_always_shown():
    tiny = make_still(0.001 * np.array(TRIANGLE[0]) + [0.002, 0.002, 0.0], TRIANGLE[1])
    lists = sample_points(tiny, smallest=0.01, levels=3)
    assert lists.counts.tolist() == [0, 0, 1]
    picture = splat_points(upload_points(lists, "cpu"), camera_at((0, 0.01, 100), (0, 0, 0)), 64, 64)
    assert picture.points >= 1


def covers(scene: StillScene, smallest: float, camera: Camera) -> tuple[int, int]:
    """How many pixels are holes, and how many lie more than a pixel beyond the silhouette."""
    picture = splat_points(upload_points(sample_points(scene, smallest=smallest), "cpu"), camera, WIDTH, HEIGHT)
    there, shown = seen_from(scene, camera), np.isfinite(picture.depth)
    assert there.sum() > 20
    return int((there & ~shown).sum()), int((shown & ~shifted(there).any(axis=0)).sum())


@pytest.mark.parametrize("pixels", [0.6, 4.0])
@pytest.mark.parametrize("distance", [1.8, 4.0, 16.0])
def test_no_holes_and_a_silhouette_within_a_pixel(scene, distance, pixels):
    """Squares cover their triangles, so that every pixel whose ray meets the mesh shows something; and a splat on a
    triangle's rim reaches beyond it by half a pixel, however many pixels wide its square is."""
    camera = camera_at(distance * np.array([0.5, -0.75, 0.45]), (0, 0, 0))
    smallest = min(pixels * distance * 2 * camera.half_height / HEIGHT, 0.1)
    assert covers(scene, smallest, camera) == (0, 0)


def test_large_squares_seen_from_near_leave_no_holes():
    """The nearer half of a square is wider than the farther one: views in which that matters most."""
    scene = scenes()["mixture"]
    for position in ((-0.765, -0.593, -0.694), (-0.715, 0.538, -0.754), (-0.616, -0.929, -0.535)):
        assert covers(scene, 0.02, camera_at(position, (0, 0, 0))) == (0, 0)


@pytest.mark.parametrize("height", [0.0005, 0.02, 0.1])
@pytest.mark.parametrize("smallest", [0.02, 0.05])
def test_squares_beside_the_viewer_are_drawn_as_far_as_they_are_before_it(height, smallest):
    """Of a floor under the viewer, some squares' middles lie behind the camera's plane, and parts before it."""
    floor = join_pieces([box((-2, -2, -0.1), (2, 2, 0))], [])
    assert covers(floor, smallest, camera_at((0, -1, height), (0, 0.3, 0.3 * height))) == (0, 0)


def test_a_ball_close_behind_a_plate_does_not_show_through_it():
    """The ball's points are of a later list than the plate's, and 4 mm behind its upper side: over half of 6 mm."""
    scene = join_pieces([box((-0.4, -0.4, 0.0), (0.4, 0.4, 0.001)), ball((0, 0, -0.103), 0.1)], [])
    camera = camera_at((0.2, -0.3, 1.5), (0, 0, 0))
    picture = splat_points(upload_points(sample_points(scene, smallest=0.006), "cpu"), camera, WIDTH, HEIGHT)
    there = seen_from(scene, camera)
    row, column = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    film = [(2 * column / WIDTH - 1) * camera.half_height * WIDTH / HEIGHT, (1 - 2 * row / HEIGHT) * camera.half_height]
    rays = np.stack([*film, -np.ones((HEIGHT, WIDTH))], axis=-1) @ camera.rotation.T
    seen = (camera.position + picture.depth[..., None] * rays)[there]
    # The plate's upper side is 1 mm up, and its rim as thick; float32 keeps 1e-6 m at this distance.
    assert seen[:, 2].min() > -1e-5


@pytest.mark.parametrize("distance", [3.0, 12.0, 48.0])
def test_points_that_are_too_small_to_see_leave_no_holes(scene, distance):
    """One set of points for a near view, seen from ever farther: fewer of them are rendered, and still no hole."""
    device_points = upload_points(sample_points(scene, smallest=0.004), "cpu")
    camera = camera_at(distance * np.array([0.5, -0.75, 0.45]), (0, 0, 0))
    picture = splat_points(device_points, camera, WIDTH, HEIGHT)
    there, shown = seen_from(scene, camera), np.isfinite(picture.depth)
    assert not (there & ~shown).any()
    assert not (shown & ~shifted(there).any(axis=0)).any()


def test_farther_away_fewer_points_are_rendered():
    scene = scenes()["teapot"]
    device_points = upload_points(sample_points(scene, smallest=0.002), "cpu")
    used = [
        splat_points(device_points, camera_at((0, -distance, 0), (0, 0, 0)), WIDTH, HEIGHT).points
        for distance in (1.0, 2.0, 4.0, 8.0)
    ]
    # From far away a few more triangles face the viewer.
    assert used[1] < 0.5 * used[0] and max(used[2:]) < 0.6 * used[1]


def test_depth_is_that_of_the_mesh(scene):
    """Splats lie on their triangles' planes: depths are exact but for the rims of neighbouring planes."""
    camera = camera_at((1.0, -1.5, 0.9), (0, 0, 0))
    picture = splat_points(upload_points(sample_points(scene, smallest=0.004), "cpu"), camera, WIDTH, HEIGHT)
    held = StillScene(scene.vertices, scene.normals, scene.faces, scene.surface, scene.flat, scene.albedo, (camera,))
    there, points, *_ = view_points(held, 0, WIDTH, HEIGHT)
    depth = -((points - camera.position) @ camera.rotation)[:, 2]
    inner = shifted(there).all(axis=0)[there]
    error = np.abs(picture.depth[there] - depth)[inner]
    # On the ball a neighbour's square, 4 mm wide, lies over the next facet by its tilt, a tenth, where it reaches it.
    assert np.median(error) < 4e-4
    # At a silhouette within the body the nearer part reaches over by a pixel: 1 % of the pixels, or a few.
    assert (error > 0.02).mean() < 0.03


def test_an_orthographic_camera_sees_the_same_body():
    scene = scenes()["box"]
    looking = camera_at((0.5, -0.75, 0.45), (0, 0, 0))
    camera = Camera(looking.position, looking.rotation, half_height=0.8, near=-10.0, far=10.0, orthographic=True)
    picture = splat_points(upload_points(sample_points(scene, smallest=0.005), "cpu"), camera, WIDTH, HEIGHT)
    # The silhouette's area is that of the visible sides, each by its normal's cosine.
    direction = looking.rotation[:, 2]
    area = np.abs(direction) @ [0.6 * 0.4, 1.0 * 0.4, 1.0 * 0.6]
    pixel = (2 * 0.8 / HEIGHT) ** 2
    assert np.isfinite(picture.depth).sum() * pixel == pytest.approx(area, rel=0.03)


def test_the_same_bits_again():
    scene = scenes()["mixture"]
    camera = camera_at((1.0, -1.5, 0.9), (0, 0, 0))
    first, second = (
        splat_points(upload_points(sample_points(scene, smallest=0.003), "cpu"), camera, 320, 240) for _ in range(2)
    )
    assert np.array_equal(first.color, second.color) and np.array_equal(first.depth, second.depth)
    assert first.points == second.points


@pytest.mark.parametrize(
    ("options", "message"),
    [({"levels": 0}, "levels"), ({"smallest": 0.0}, "smallest"), ({"smallest": 1e-6}, "larger `smallest`")],
)
def test_what_cannot_be_sampled_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        sample_points(make_still(*TRIANGLE), **options)


def test_a_picture_without_a_size_is_refused():
    device_points = upload_points(sample_points(make_still(*TRIANGLE), smallest=0.1), "cpu")
    with pytest.raises(ValueError, match="width"):
        splat_points(device_points, camera_at((0, -1, 1), (0, 0, 0)), 0, 10)
