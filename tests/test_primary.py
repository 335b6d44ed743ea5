"""Primary visibility: what the camera sees, against closed forms."""

import mujoco
import numpy as np
import pytest

import warp_psf as psf
from tests.oracles import make_renderer
from warp_psf.film.primary import EXTRA_GROUPS, SAMPLES

HEIGHT, WIDTH = 54, 96
GEOM = int(mujoco.mjtObj.mjOBJ_GEOM)
ALIASED = '<visual><quality offsamples="0"/></visual>'
CAMERA = '<camera name="front" pos="0 -6 2.5" xyaxes="1 0 0 0 .4 .9"/>'
DOWN = '<camera name="down" pos="0 0 2" xyaxes="1 0 0 0 1 0"/>'
# A sphere, a box behind it and a floor.
SCENE = (
    '<geom name="floor" type="plane" size="9 9 .1" material="white"/>'
    '<geom name="ball" type="sphere" size=".8" pos="-.5 0 .8" rgba="0 1 0 1"/>'
    '<geom name="box" type="box" size=".5 .5 .7" pos=".6 1 .7" rgba="1 0 0 1" euler="0 0 20"/>' + CAMERA
)


def camera_rays(renderer, data, camera: str, height: int = HEIGHT, width: int = WIDTH) -> tuple[np.ndarray, np.ndarray]:
    """The camera's position and its rays through the pixels' centres [height, width, 3], of depth 1."""
    index = renderer.model.camera(camera).id
    tangent = np.tan(np.radians(renderer.model.cam_fovy[index]) / 2)
    y, x = np.mgrid[:height, :width] + 0.5
    across, up = (x - width / 2) * 2 * tangent / height, (height / 2 - y) * 2 * tangent / height
    rays = np.stack([across, up, -np.ones_like(x)], axis=-1) @ data.cam_xmat[index].reshape(3, 3).T
    return data.cam_xpos[index], rays


def picture(worldbody: str, camera: str, height: int = HEIGHT, width: int = WIDTH, **options):
    renderer, data = make_renderer(worldbody, height, width, **({"environment": None} | options))
    renderer.update_scene(data, camera)
    return renderer, data, renderer.layers()


@pytest.fixture(scope="module")
def seen():
    return picture(SCENE, "front")


def test_depth_of_a_plane(seen):
    renderer, data, layers = seen
    floor = layers["segmentation"][..., 0] == 0
    origin, rays = camera_rays(renderer, data, "front")
    assert floor.sum() > 1000
    # Float32 coordinates of a 9 m plane.
    np.testing.assert_allclose(layers["depth"][floor], (-origin[2] / rays[..., 2])[floor], rtol=1e-5)


def test_depth_and_normals_of_a_sphere(seen):
    renderer, data, layers = seen
    ball = layers["segmentation"][..., 0] == 1
    origin, rays = camera_rays(renderer, data, "front")
    points = origin + layers["depth"][..., None] * rays
    outward = (points - (-0.5, 0, 0.8))[ball]
    # The icosphere's flat faces lie within 0.2 % of its radius below the sphere, its normals within a degree.
    np.testing.assert_allclose(np.linalg.norm(outward, axis=1), 0.8, rtol=3e-3)
    inner = (renderer._stage.surfaces.extra.numpy().reshape(ball.shape) < 0)[ball]  # else a normal is a mean of several
    assert inner.sum() > 100
    cosine = np.sum(layers["normal"][ball] * outward, axis=1) / np.linalg.norm(outward, axis=1)
    assert cosine[inner].min() > np.cos(np.radians(2))
    np.testing.assert_allclose(layers["normal"][layers["segmentation"][..., 0] == 0].mean(axis=0), (0, 0, 1), atol=0.02)


def test_segmentation_and_background(seen):
    renderer, _, layers = seen
    ids, types = layers["segmentation"][..., 0], layers["segmentation"][..., 1]
    assert set(np.unique(ids)) == {-1, 0, 1, 2}
    np.testing.assert_array_equal(types, np.where(ids >= 0, GEOM, -1))
    np.testing.assert_array_equal(np.isinf(layers["depth"]), ids < 0)
    nothing = (ids < 0) & (layers["albedo"].sum(axis=2) == 0)
    assert nothing.sum() > 500
    assert not layers["normal"][nothing].any()
    assert layers["segmentation"].dtype == np.int32
    assert layers["depth"].dtype == np.float32


def test_the_nearer_surface_hides_the_farther(seen):
    renderer, data, layers = seen
    origin, rays = camera_rays(renderer, data, "front")
    offset = origin - (-0.5, 0, 0.8)
    b, c = rays @ offset, offset @ offset - 0.8**2
    square = np.sum(rays**2, axis=-1)
    # Rays that pass the centre within 99 % of the radius meet the ball, which nothing hides.
    inside = b * b - square * (c + 0.8**2 * (1 - 0.99**2)) > 0
    assert (layers["segmentation"][..., 0][inside] == 1).all()


def test_back_of_a_plane_faces_the_viewer():
    below = '<camera name="below" pos="0 0 -2" xyaxes="1 0 0 0 -1 0"/>'
    _, _, layers = picture(f'<geom type="plane" size="9 9 .1" material="white"/>{below}', "below")
    np.testing.assert_allclose(layers["normal"][..., 2], -1.0)


# Edges


def half_plane_share(corner: np.ndarray, inward: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """The part of each pixel [H, W] of a downward camera at (0, 0, 2) that shows one side of a line on the floor."""
    pixel = 2 * (rays[0, 1] - rays[0, 0])[0]
    offsets = (np.arange(16) + 0.5) / 16 - 0.5
    y, x = np.meshgrid(offsets, offsets, indexing="ij")
    points = 2 * rays[:, :, None, None, :2] + pixel * np.stack([x, y], axis=-1)
    return ((points - corner) @ inward > 0).mean(axis=(2, 3))


@pytest.mark.parametrize("degrees", [0.0, 7.0, 45.0, 63.0])
def test_edges_are_antialiased(degrees):
    # A huge plane whose edge passes 4 cm beside the picture's centre; pixels are 3 cm wide.
    angle = np.radians(degrees)
    inward = np.array((np.cos(angle), np.sin(angle)))
    corner = 0.04 * inward
    center = corner + 50 * inward
    plane = (
        f'<geom type="plane" size="50 50 .1" pos="{center[0]} {center[1]} 0" euler="0 0 {degrees}" material="white"/>'
    )
    renderer, data, layers = picture(plane + DOWN, "down")
    _, rays = camera_rays(renderer, data, "down")
    expected = half_plane_share(corner, inward, rays)
    found = layers["albedo"][..., 0]
    edge = (expected > 0) & (expected < 1)
    np.testing.assert_allclose(found[~edge], expected[~edge], atol=1e-6)
    # Eight samples tell nine shares apart; along a diagonal every pixel is alike, and so is its error.
    error = (found - expected)[edge]
    assert np.abs(error).max() <= 0.25
    assert np.abs(error).mean() < 1 / SAMPLES
    assert abs(error.mean()) < (0.02 if degrees in (7.0, 63.0) else 1 / SAMPLES)


def test_no_offsamples_no_antialiasing(seen):
    _, _, smooth = seen
    renderer, _, aliased = picture(SCENE, "front", header=ALIASED)
    assert (renderer._stage.surfaces.extra.numpy() == -1).all()
    assert renderer._stage.surfaces.slots == HEIGHT * WIDTH
    colors = [np.float32(entity.lobe.albedo[1]) for entity in renderer._stage.scene.entities]
    assert np.isin(aliased["albedo"][..., 1], [0, *colors]).all()
    assert not np.isin(smooth["albedo"][..., 1], [0, *colors]).all()
    # Depth and segmentation are those of the centre, with antialiasing or without.
    np.testing.assert_array_equal(aliased["segmentation"], smooth["segmentation"])
    np.testing.assert_array_equal(aliased["depth"], smooth["depth"])


def weights_of(renderer) -> np.ndarray:
    """The sum of each pixel's shares [pixels]."""
    receivers = renderer._stage.surfaces.receivers
    weight = np.where(receivers.entity.numpy()[0] >= 0, receivers.weight.numpy()[0], 0.0)
    extra = renderer._stage.surfaces.extra.numpy()[0]
    total = weight[: len(extra)].copy()
    for group in range(EXTRA_GROUPS):
        total[extra >= 0] += weight[extra[extra >= 0] + group]
    return total


def test_shares_of_a_pixel_sum_to_one_where_it_is_covered(seen):
    renderer, _, layers = seen
    total = weights_of(renderer)
    assert total.max() <= 1 + 1e-6
    assert total.min() >= 0
    ids = layers["segmentation"][..., 0]
    deep = np.zeros_like(ids, bool)
    deep[1:-1, 1:-1] = True
    for axis in (0, 1):
        for step in (-1, 1):
            deep &= np.roll(ids, step, axis) >= 0
    np.testing.assert_allclose(total.reshape(ids.shape)[deep & (ids >= 0)], 1.0, atol=1e-6)


def test_many_bodies_in_one_pixel():
    # A fan of 12 thin boxes that meet under the centre of one pixel: more than a pixel has groups.
    fan = "".join(
        f'<geom type="box" size=".5 .02 .1" pos="0 0 {0.001 * k}" euler="0 0 {15 * k}" material="white"/>'
        for k in range(12)
    )
    plane = '<geom type="plane" size="9 9 .1" pos="0 0 -.3" material="white"/>'
    renderer, _, layers = picture(fan + plane + DOWN, "down", 9, 9)
    np.testing.assert_allclose(weights_of(renderer), 1.0, atol=1e-6)
    np.testing.assert_allclose(layers["albedo"], 1.0, atol=1e-6)


def test_more_edges_than_there_is_room_for():
    # 24 x 14 balls, an edge in every pixel: what has no room stays aliased, and nothing overflows.
    balls = "".join(
        f'<geom type="sphere" size=".03" pos="{0.08 * x - 0.92} {0.08 * y - 0.52} 0" material="white"/>'
        for x in range(24)
        for y in range(14)
    )
    renderer, _, layers = picture(balls + DOWN, "down", 27, 48)
    edges = int(renderer._stage.surfaces.edge.numpy().sum())
    assert edges > renderer._stage.surfaces.edge_capacity
    assert (renderer._stage.surfaces.extra.numpy() >= 0).sum() == renderer._stage.surfaces.edge_capacity
    assert weights_of(renderer).max() <= 1 + 1e-6
    # Balls take pi/4 (6/8)^2 of their cells, which take 1.92 m x 1.12 m of the picture's 2.95 m x 1.66 m.
    assert layers["albedo"].mean() == pytest.approx(0.44 * 1.92 * 1.12 / (2.95 * 1.66), rel=0.1)


# Background


def test_background_is_the_environment():
    random = np.random.default_rng(2)
    environment = psf.Environment("noise", random.uniform(0, 2, (16, 32, 3)).astype(np.float32))
    # A wide camera at the origin towards -x, where the azimuth wraps, and up to the zenith.
    wide = '<camera name="wide" pos="0 0 1" xyaxes="0 1 0 .5 0 .87" fovy="120"/>'
    renderer, data, layers = picture(
        f'<geom type="sphere" size=".1" pos="5 0 0"/>{wide}', "wide", environment=environment
    )
    _, rays = camera_rays(renderer, data, "wide")
    assert (layers["segmentation"][..., 0] < 0).all()
    np.testing.assert_allclose(layers["color"], environment.lookup(rays), atol=1e-4)  # float32 angles
    assert not layers["direct"].any()


def test_edges_blend_with_the_background():
    white = np.full((4, 8, 3), 2.0)
    renderer, _, layers = picture(SCENE, "front", environment=white)
    outside = 1 - weights_of(renderer).reshape(HEIGHT, WIDTH)
    light = layers["direct"] + layers["indirect"]
    np.testing.assert_allclose(layers["color"] - light, 2 * outside[..., None] * np.ones(3), atol=1e-5)
    assert ((outside > 0.1) & (outside < 0.9)).sum() > 30


def test_a_telephoto_view_loses_no_pixels():
    # Angles of a hundredth of a degree: acos has no digits for them in float32.
    camera = '<camera name="far" pos="0 -20 0" xyaxes="1 0 0 0 0 1" fovy=".1"/>'
    header = "<visual><quality offsamples='0'/></visual>"
    renderer, data = make_renderer('<geom type="sphere" size=".01"/>' + camera, 90, 90, header=header)
    renderer.update_scene(data, "far")
    seen = (renderer.layers()["segmentation"][..., 0] >= 0).sum()
    radius = 45 * (0.01 / 20) / np.tan(np.deg2rad(0.05))
    # The disc's area in pixels, but for its jagged rim.
    assert seen == pytest.approx(np.pi * radius**2, abs=2 * np.pi * radius * 0.5)
