"""The shadow slab: sampling, retrieval, and light that moves, against rays and closed forms."""

import numpy as np
import pytest

from tests.oracles import polygon_form_factor
from tests.oracles_area import sample_irradiance, traced_sight, view_points
from warp_psf.area_light.attenuation import SlabView, next_states
from warp_psf.area_light.quadtree import grow_quadtrees, levels_of
from warp_psf.area_light.scene_map import bake_scene_map, retrieve_pixels
from warp_psf.area_light.slab import LightPlane, bake_shadow_slab, make_light_plane
from warp_psf.device import find_device
from warp_psf.scene.camera import Camera
from warp_psf.scene.light import rectangle_light, sphere_light
from warp_psf.scene.primitives import sphere
from warp_psf.scene.still import Piece, StillScene, join_pieces, make_still

WIDTH, HEIGHT = 96, 80
BOX_FACES = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]


def box(low, high) -> Piece:
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * np.subtract(high, low) + low
    faces = [triangle for a, b, c, d in BOX_FACES for triangle in ((a, b, c), (a, c, d))]
    still = make_still(corners, np.array(faces))
    return Piece(still.vertices, still.normals, still.faces, still.albedo)


def ball(center, radius: float) -> Piece:
    mesh = sphere(radius)
    return Piece(mesh.vertices + np.float32(center), mesh.normals, mesh.faces, np.full((len(mesh.faces), 3), 0.8))


def camera_at(position, target) -> Camera:
    back = np.subtract(position, target) / np.linalg.norm(np.subtract(position, target))
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(back, right), back], axis=1)
    return Camera(np.array(position, np.float64), rotation, half_height=np.tan(np.radians(20)))


@pytest.fixture(scope="module")
def scene() -> StillScene:
    """Two boxes and a ball on a floor, seen from above at an angle."""
    pieces = [
        box((-3, -3, -0.1), (3, 3, 0)),
        box((-0.8, -0.3, 0), (-0.3, 0.3, 0.9)),
        box((0.2, 0.3, 0), (0.7, 0.8, 0.4)),
    ]
    return join_pieces([*pieces, ball((0.5, -0.5, 0.3), 0.3)], [camera_at((0.5, -4.5, 3.0), (0, 0, 0.2))])


@pytest.fixture(scope="module")
def plane() -> LightPlane:
    return make_light_plane(rectangle_light("lamp", 0.8, 0.8, (1, 1, 1), (0.6, -0.8, 2.2), (0, 0, 0.2)), 5, 5)


@pytest.fixture(scope="module")
def seen(scene):
    """What rays through the pixels meet: mask [pixels], points, normals of triangles and smooth normals [N, 3]."""
    there, points, flat, smooth = view_points(scene, 0, WIDTH, HEIGHT)
    return there.ravel(), points, flat, smooth


def test_a_cell_that_an_edge_crosses_is_divided_to_the_last():
    """Samples of a half-plane: leaves with both sides in them are one sample wide, and others as wide as may be."""

    def sample(maps, column, row):
        return ((column + 2 * row > 40).astype(np.int32),)

    def split(cells, corners):
        return (corners[0] != corners[0][:, :1]).any(axis=1)

    trees = grow_quadtrees(2, 33, 1, sample, split)
    sides = trees.samples[0][trees.corners]
    mixed = (sides != sides[:, :1]).any(axis=1)
    # The line crosses 33 columns and 16 rows: at most a cell for each step of either.
    assert 2 * 16 <= mixed.sum() <= 2 * 49
    assert (np.diff(trees.first_sample) < 33 * 33 / 2).all()
    assert np.array_equal(*np.split(trees.samples[0], 2))


def test_many_maps_are_the_maps_one_by_one():
    def sample(maps, column, row):
        return ((column > 3 + maps % 11).astype(np.int32), maps.astype(np.int32))

    def split(cells, corners):
        return (corners[0] != corners[0][:, :1]).any(axis=1)

    many = grow_quadtrees(70, 17, 1, sample, split)
    assert np.array_equal(np.repeat(np.arange(70), many.counts), many.samples[1])
    for index in (0, 12, 66):
        start, end = many.first_node[index : index + 2]
        leaves = [-1 - link for link in many.link[start:end] if link < 0]
        assert all((many.samples[1][many.corners[leaf]] == index).all() for leaf in leaves)


@pytest.mark.parametrize("size", [0, 1, 2.5, 512, 10**6 + 1, "513", None])
def test_sizes_that_are_no_power_of_two_and_one_are_refused(size):
    with pytest.raises(ValueError, match="give 2\\^n \\+ 1"):
        levels_of(size, "size")


def test_a_steep_flat_surface_needs_no_samples_beyond_the_preset():
    """Inverse depth is linear over a plane: the preset's samples hold it, and no point of it is in its own shadow."""
    floor = make_still([[-2, -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0]], [[0, 1, 2], [0, 2, 3]])
    scene = join_pieces(
        [Piece(floor.vertices, floor.normals, floor.faces, floor.albedo)], [camera_at((0, -3, 2), (0, 0, 0))]
    )
    # 6 degrees above the plane.
    light = make_light_plane(rectangle_light("low", 0.2, 0.2, (1, 1, 1), (-6, 0, 0.6), (0, 0, 0)), 3, 3)
    slab = bake_shadow_slab(scene, light, 257)
    view = SlabView(bake_scene_map(scene, 0, WIDTH, HEIGHT), [slab])
    view.set_light(0, np.ones((3, 3)))
    assert view.shadowless().max() > 0
    assert np.array_equal(view.picture(), view.shadowless())


def test_hard_shadows_agree_with_rays(scene, plane, seen):
    """Each light sample alone. What differs lies on the edges: a texel of the map is 12 mm on the floor."""
    there, points, flat, normals = seen
    slab = bake_shadow_slab(scene, plane, 513)
    view = SlabView(bake_scene_map(scene, 0, WIDTH, HEIGHT), [slab])
    targets = plane.positions.reshape(-1, 3)
    facing = ((targets[None] - points[:, None]) * normals[:, None]).sum(axis=2) > 0.02
    sight = traced_sight(scene, points, flat, targets)
    wrong = []
    for sample in (0, 7, 12, 24):
        template = np.zeros(25)
        template[sample] = 1.0
        view.set_light(0, template.reshape(5, 5))
        share = view.attenuation()[..., 0].ravel()[there][facing[:, sample]]
        wrong.append(np.abs(share - sight[facing[:, sample], sample]))
    wrong = np.concatenate(wrong)
    # 1.5 % of the pixels are on an edge of a shadow, and the map's answer there is between 0 and 1.
    assert (wrong > 0.5).mean() < 0.005
    assert wrong.mean() < 0.01


def test_adaptive_maps_are_as_good_as_full_ones(scene, plane):
    scene_map = bake_scene_map(scene, 0, WIDTH, HEIGHT)
    images = []
    shares = []
    for preset in (5, 8):
        slab = bake_shadow_slab(scene, plane, 257, preset=preset)
        view = SlabView(scene_map, [slab])
        view.set_light(0, np.ones((5, 5)))
        images.append(view.attenuation()[..., 0])
        shares.append(slab.share)
    assert shares[1] == 1.0 and shares[0] < 0.2
    # Flat bodies are held exactly; the ball's depths between samples are off by up to 1 %.
    assert np.sqrt(np.mean((images[0] - images[1]) ** 2)) < 0.01


def test_soft_shadows_agree_with_rays(scene, plane, seen):
    there, points, flat, normals = seen
    view = SlabView(bake_scene_map(scene, 0, WIDTH, HEIGHT), [bake_shadow_slab(scene, plane, 513)])
    view.set_light(0, np.full((5, 5), 3.0))
    targets = plane.positions.reshape(-1, 3)
    sent = sample_irradiance(points, normals, targets, plane.axes[:, 2], plane.cell_area)
    lit = (sent * traced_sight(scene, points, flat, targets)).sum(axis=1)
    expected = 3.0 * 0.8 / np.pi * lit
    picture = view.picture()[..., 0].ravel()[there]
    assert np.sqrt(np.mean((picture - expected) ** 2)) < 0.01 * expected.max()


def test_unhindered_light_is_that_of_the_rectangle(scene, seen):
    """Sums over 16 x 16 samples come near the polygon's form factor; a sample is 5 cm wide, at 1.5 m or more."""
    there, points, _, normals = seen
    plane = LightPlane((0.3, 0.2, 2.4), (0.4, 0, 0), (0, -0.4, 0), 16, 16)
    view = SlabView(bake_scene_map(scene, 0, WIDTH, HEIGHT), [bake_shadow_slab(scene, plane, 33)])
    view.set_light(0, np.ones((16, 16)))
    corners = [plane.center + x * plane.right + y * plane.up for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    expected = np.pi * polygon_form_factor(points, normals, np.array(corners))
    irradiance = np.pi / 0.8 * view.shadowless()[..., 0].ravel()[there]
    # Where the plane crosses the horizon, samples are above or below it as a whole.
    above = ((np.array(corners)[None] - points[:, None]) * normals[:, None]).sum(axis=2).min(axis=1) > 0.0
    np.testing.assert_allclose(irradiance[above], np.abs(expected[above]), rtol=2e-3)


def test_light_that_goes_and_comes_back_leaves_the_same_bits(scene, plane):
    rng = np.random.default_rng(1)
    slab, scene_map = bake_shadow_slab(scene, plane, 129), bake_scene_map(scene, 0, WIDTH, HEIGHT)
    moved, at_once = SlabView(scene_map, [slab]), SlabView(scene_map, [slab])
    last = rng.uniform(0, 9, (5, 5, 3)) * (rng.uniform(size=(5, 5, 1)) < 0.5)
    for _ in range(6):
        moved.set_light(0, rng.uniform(0, 1e4, (5, 5, 3)) * (rng.uniform(size=(5, 5, 1)) < 0.5))
    moved.set_light(0, last)
    at_once.set_light(0, last)
    assert np.array_equal(moved.picture(), at_once.picture())
    assert np.array_equal(moved.attenuation(), at_once.attenuation())
    moved.set_light(0, np.zeros((5, 5)))
    assert not moved.picture().any()


def test_only_samples_that_changed_are_asked(scene, plane):
    view = SlabView(bake_scene_map(scene, 0, 32, 32), [bake_shadow_slab(scene, plane, 33)])
    column = np.zeros((5, 5))
    column[:, 1] = 1.0
    assert view.set_light(0, column) == 5
    assert view.set_light(0, column) == 0
    # A line that steps aside: five samples off, five on.
    assert view.set_light(0, np.roll(column, 1, axis=1)) == 10
    assert view.set_light(0, 2.0 * np.roll(column, 1, axis=1)) == 5
    assert (view.states(0)[:, 2] == 3).all() and (view.states(0)[:, 1] == 1).all()


def test_two_lights_add_up(scene, plane):
    scene_map = bake_scene_map(scene, 0, WIDTH, HEIGHT)
    other = make_light_plane(rectangle_light("other", 0.5, 0.5, (1, 1, 1), (-1.5, -1, 1.8), (0, 0, 0)), 3, 3)
    slabs = [bake_shadow_slab(scene, each, 129) for each in (plane, other)]
    both, first, second = SlabView(scene_map, slabs), SlabView(scene_map, slabs[:1]), SlabView(scene_map, slabs[1:])
    for view, light, template in ((both, 0, np.ones((5, 5))), (both, 1, np.full((3, 3), 2.0))):
        view.set_light(light, template)
    first.set_light(0, np.ones((5, 5)))
    second.set_light(0, np.full((3, 3), 2.0))
    np.testing.assert_allclose(both.picture(), first.picture() + second.picture(), rtol=1e-5, atol=1e-7)


def test_the_differential_map_is_the_thesis_s():
    """Its pseudo code, cell by cell."""
    for state in (1, 2, 3, 4):
        for active in (False, True):
            expected = (2 if state in (1, 4) else 3) if active else (1 if state in (1, 4) else 4)
            assert next_states(np.array([state], np.int8), np.array([active]))[0] == expected


def test_a_scene_map_is_what_rays_see(scene):
    """Every pixel's point, interpolated between samples, lies on a surface of the scene and on the pixel's ray."""
    adaptive = bake_scene_map(scene, 0, WIDTH, HEIGHT)
    pixels = retrieve_pixels(adaptive, find_device("cpu"))
    assert adaptive.share < 0.5
    camera = scene.cameras[0]
    there = pixels.surface.numpy()[0] >= 0
    points = pixels.position.numpy()[0][there].astype(np.float64)
    floor = np.abs(points[:, 2])
    ball_distance = np.abs(np.linalg.norm(points - [0.5, -0.5, 0.3], axis=1) - 0.3)
    sides = []
    for low, high in (
        ((-0.8, -0.3, 0), (-0.3, 0.3, 0.9)),
        ((0.2, 0.3, 0), (0.7, 0.8, 0.4)),
        ((-3, -3, -0.1), (3, 3, 0)),
    ):
        outside = np.maximum(np.subtract(low, points), np.subtract(points, high))
        sides.append(np.abs(outside.max(axis=1)))
    nearest = np.min([floor, ball_distance, *sides], axis=0)
    # The ball's facets lie 2 mm under it; between samples its depth is off by up to 1 % of 5 m.
    flat = ball_distance > 0.02
    assert nearest[flat].max() < 2e-5
    assert nearest.max() < 0.02
    eye = points - camera.position
    local = eye @ camera.rotation
    film = -local[:, :2] / local[:, 2:]
    row, column = np.divmod(np.flatnonzero(there), WIDTH)
    expected = np.stack([(2 * (column + 0.5) / WIDTH - 1) * WIDTH / HEIGHT, 1 - 2 * (row + 0.5) / HEIGHT], axis=1)
    np.testing.assert_allclose(film, expected * camera.half_height, atol=1e-5)


def test_a_picture_is_the_same_bits_again(scene, plane):
    pictures = []
    for _ in range(2):
        view = SlabView(bake_scene_map(scene, 0, WIDTH, HEIGHT), [bake_shadow_slab(scene, plane, 129)])
        view.set_light(0, np.ones((5, 5)))
        pictures.append(view.picture())
    assert np.array_equal(*pictures)


def test_what_cannot_be_used_is_refused(scene, plane):
    slab, scene_map = bake_shadow_slab(scene, plane, 17), bake_scene_map(scene, 0, 16, 16)
    view = SlabView(scene_map, [slab])
    with pytest.raises(ValueError, match="at right angles"):
        LightPlane((0, 0, 1), (1, 0, 0), (1, 1, 0), 2, 2)
    with pytest.raises(ValueError, match="whole number"):
        LightPlane((0, 0, 1), (1, 0, 0), (0, 1, 0), 0, 2)
    with pytest.raises(ValueError, match="no flat rectangle"):
        make_light_plane(sphere_light("bulb", 0.1, (1, 1, 1), (0, 0, 2)), 3, 3)
    with pytest.raises(ValueError, match="before the light plane"):
        bake_shadow_slab(scene, LightPlane((0, 0, 3), (1, 0, 0), (0, 1, 0), 2, 2))
    with pytest.raises(ValueError, match="preset"):
        bake_shadow_slab(scene, plane, 17, preset=5)
    with pytest.raises(ValueError, match="counted from 0"):
        bake_scene_map(scene, 1)
    with pytest.raises(ValueError, match="at least one"):
        SlabView(scene_map, [])
    with pytest.raises(IndexError, match="no light 1"):
        view.set_light(1, np.ones((5, 5)))
    with pytest.raises(ValueError, match="shape"):
        view.set_light(0, np.ones((4, 5)))
    with pytest.raises(ValueError, match="radiance"):
        view.set_light(0, np.full((5, 5), np.nan))
    with pytest.raises(ValueError, match="no triangles"):
        join_pieces([], [])


def test_what_corners_miss_is_met_at_the_sides_of_cells():
    """A bar 3 pixels wide between the samples of the first level: its end is found, and from there all of it."""
    pieces = [box((-3, -3, -0.1), (3, 3, 0)), box((-2, 0.5, 0), (2, 0.56, 0.05)), box((1.9, 0.4, 0), (2.3, 0.8, 0.4))]
    scene = join_pieces(pieces, [camera_at((0, -0.5, 6.0), (0, 0, 0))])
    pixels = retrieve_pixels(bake_scene_map(scene, 0, 257, 257), find_device("cpu"))
    there, points, *_ = view_points(scene, 0, 257, 257)
    found = pixels.position.numpy()[0][there.ravel()]
    # A pixel whose ray runs along an edge may meet either side of it.
    assert (np.linalg.norm(found - points, axis=1) > 1e-3).mean() < 1e-4


def test_surfaces_end_at_creases():
    """A box has six flat surfaces; a ball is one that is not flat, though its faces' normals add up to nothing."""
    scene = join_pieces([box((0, 0, 0), (1, 2, 3)), ball((3, 0, 0), 0.5)], [])
    assert scene.flat.tolist() == [True] * 6 + [False]
    assert np.bincount(scene.surface)[:6].tolist() == [2] * 6
