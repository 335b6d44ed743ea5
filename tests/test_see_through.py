"""See-through surfaces: what lies behind them has the share of the pixel that they leave."""

import numpy as np
import pytest

from tests.oracles import make_renderer
from tests.test_primary import weights_of
from warp_psf.film.primary import EXTRA_GROUPS
from warp_psf.film.tracing import PANES

HEIGHT, WIDTH = 24, 40
CAMERA = '<camera name="c" pos="0 0 3" fovy="20"/>'
FLOOR = '<geom name="floor" type="box" size="3 3 .1" pos="0 0 -.1"/>'


def pane(height: float, opacity: float, half: float = 3.0, x: float = 0.0) -> str:
    return f'<geom type="box" size="{half} {half} .01" pos="{x} 0 {height - 0.01}" rgba=".5 .5 .5 {opacity}"/>'


def view(worldbody: str, camera: str = CAMERA, header: str = "", **options):
    options = {"environment": None, "bounces": 0, "order": 2} | options
    renderer, data = make_renderer(worldbody + camera, HEIGHT, WIDTH, header=header, **options)
    renderer.update_scene(data, "c")
    return renderer, renderer.layers()


def share_of(renderer, entity: int) -> np.ndarray:
    """The share of each pixel [HEIGHT, WIDTH] that shows an entity."""
    surfaces = renderer._stage.surfaces
    entities, weight = surfaces.receivers.entity.numpy()[0], surfaces.receivers.weight.numpy()[0]
    extra = surfaces.extra.numpy()[0]
    total = np.where(entities[: len(extra)] == entity, weight[: len(extra)], 0.0)
    for group in range(EXTRA_GROUPS):
        slots = np.maximum(extra + group, 0)
        total += np.where((extra >= 0) & (entities[slots] == entity), weight[slots], 0.0)
    return total.reshape(HEIGHT, WIDTH)


@pytest.mark.parametrize("header", ["", '<visual><quality offsamples="0"/></visual>'])
def test_two_panes_over_a_floor(header):
    a, b = 0.25, 0.6
    renderer, layers = view(FLOOR + pane(0.5, b) + pane(1.0, a), header=header)
    # Exact but for float32: eight samples with the same shares.
    for entity, share in enumerate(((1 - a) * (1 - b), (1 - a) * b, a)):
        np.testing.assert_allclose(share_of(renderer, entity), share, rtol=1e-5)
    # The nearest surface is what is there, however faint, as in MuJoCo.
    assert (layers["segmentation"][..., 0] == 2).all()
    np.testing.assert_allclose(layers["depth"], 2.0, rtol=1e-5)


def test_the_order_of_the_model_does_not_matter():
    pictures = [view(first + second)[1]["albedo"] for first, second in ((FLOOR, pane(1, 0.3)), (pane(1, 0.3), FLOOR))]
    np.testing.assert_allclose(*pictures, rtol=1e-5)


def test_the_sky_shows_through():
    renderer, layers = view(pane(1.0, 0.97), environment=np.full((4, 8, 3), 2.0))
    # 3 % is less than half a sample's share, and not lost.
    light = layers["direct"] + layers["indirect"]
    np.testing.assert_allclose(layers["color"] - light, 0.03 * 2, rtol=1e-3)
    np.testing.assert_allclose(share_of(renderer, 0), 0.97, rtol=1e-5)


def test_a_pane_covers_part_of_a_pixel():
    # The edge of a pane at x = 0.013 in a picture whose pixels at its height are about 3 cm wide.
    renderer, _ = view(FLOOR + pane(1.0, 0.5, x=-3 + 0.013))
    found, pixel = share_of(renderer, 1)[HEIGHT // 2], 2 * 2 * np.tan(np.radians(10)) / HEIGHT
    left = (np.arange(WIDTH) - WIDTH / 2) * pixel
    # Samples stand in eight columns.
    np.testing.assert_allclose(found, 0.5 * np.clip((0.013 - left) / pixel, 0, 1), atol=0.5 / 8)
    np.testing.assert_allclose(found + share_of(renderer, 0)[HEIGHT // 2], 1.0, rtol=1e-5)


def test_more_panes_than_a_pixel_has_room_for():
    opacity, count = 0.1, PANES + 3
    renderer, _ = view(FLOOR + "".join(pane(0.2 + 0.1 * index, opacity) for index in range(count)))
    # The nearest panes count, and what they leave is the floor's, which keeps a group of its own.
    np.testing.assert_allclose(weights_of(renderer), 1.0, rtol=1e-5)
    np.testing.assert_allclose(share_of(renderer, 0), (1 - opacity) ** PANES, rtol=1e-5)


def test_a_mesh_is_seen_once_per_front():
    # Two cubes above one another in one mesh.
    corners = [(x, y, z) for z in (0.0, 0.2, 0.5, 0.7) for y in (-1, 1) for x in (-1, 1)]
    cube = (
        (0, 2, 1),
        (1, 2, 3),
        (4, 5, 6),
        (5, 7, 6),
        (0, 1, 4),
        (1, 5, 4),
        (2, 6, 3),
        (3, 6, 7),
        (0, 4, 2),
        (2, 4, 6),
    )
    cube += ((1, 3, 5), (3, 7, 5))
    faces = [tuple(8 * block + corner for corner in face) for block in (0, 1) for face in cube]
    numbers = (" ".join(f"{value}" for row in rows for value in row) for rows in (corners, faces))
    asset = '<asset><mesh name="m" vertex="{}" face="{}"/></asset>'.format(*numbers)
    renderer, _ = view(FLOOR + '<geom type="mesh" mesh="m" pos="0 0 .8" rgba=".5 .5 .5 .4"/>', header=asset)
    np.testing.assert_allclose(share_of(renderer, 0), 0.6**2, rtol=1e-5)
    np.testing.assert_allclose(share_of(renderer, 1), 1 - 0.6**2, rtol=1e-5)


def test_a_film_of_paint_on_the_floor():
    # The pane's upper side and the floor lie in one plane: either may win, but nothing beyond is ever seen.
    renderer, _ = view(FLOOR + pane(0.0, 0.5))
    np.testing.assert_allclose(weights_of(renderer), 1.0, rtol=1e-5)
    assert (share_of(renderer, 0) >= 0.5 - 1e-5).all()


def test_a_viewer_in_a_bubble_does_not_see_it():
    renderer, layers = view(FLOOR + '<geom size=".5" pos="0 0 3" rgba=".5 .5 .5 .5"/>')
    assert (layers["segmentation"][..., 0] == 0).all()
    np.testing.assert_allclose(share_of(renderer, 0), 1.0, rtol=1e-6)
