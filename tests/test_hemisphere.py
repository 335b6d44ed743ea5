"""Hemispherical rasterisation: masks against exact visibility, and transfer against closed forms and rays."""

import numpy as np
import pytest
import warp as wp

from tests.test_visibility_mask import directions, frames
from warp_psf.basis import sh, visibility_mask
from warp_psf.basis.visibility_mask import upload_masks
from warp_psf.device import find_device
from warp_psf.field.blockers import BlockerSet
from warp_psf.shade.hemisphere import (
    NOT_SEEN,
    SEEN,
    bring_shape,
    integrate_masks,
    make_hemisphere,
    rasterise_masks,
    upload_blockers,
)

RANDOM = np.random.default_rng(7)
# A normal and the plane that stands for it differ by no more: half the diagonal of a cell of the cube map, radians.
PLANE_ERROR = np.arctan(np.sqrt(0.5) * 2 / visibility_mask.CUBE_EDGE)


def far(faces: np.ndarray, vertices: int, two_sided: bool, clusters: int = 1) -> BlockerSet:
    """All faces are looked at from each of so many vertices."""
    nothing = np.zeros(vertices + 1, np.int32)
    first = np.linspace(0, len(faces), clusters + 1).astype(np.int32)
    empty = np.zeros(0, np.int32)
    parent, levels = np.full(len(faces), -1, np.int32), np.array([0, len(faces), len(faces)], np.int32)
    lists = (nothing, empty, nothing, empty)
    return BlockerSet(faces.astype(np.int32), first, *lists, two_sided, parent, levels)


def near(faces: np.ndarray, vertices: int, two_sided: bool) -> BlockerSet:
    """The same, by lists of each vertex."""
    count, empty = len(faces), np.zeros(0, np.int32)
    first = np.arange(vertices + 1, dtype=np.int32) * count
    parent, levels = np.full(count, -1, np.int32), np.array([0, 0, count], np.int32)
    lists = (first, np.tile(np.arange(count, dtype=np.int32), vertices), 0 * first, empty)
    return BlockerSet(faces.astype(np.int32), np.zeros(1, np.int32), *lists, two_sided, parent, levels)


def start(blockers: BlockerSet, points, normals, blocker_vertices, radius: float = 0.0, blocker_of=None):
    """A state with all vertices seen; `blocker_of` is 0 for all by default."""
    device = find_device("cpu")
    points, normals, blocker_vertices = (np.asarray(a, np.float32)[None] for a in (points, normals, blocker_vertices))
    if blocker_of is None:
        blocker_of = np.zeros(points.shape[1], np.int32)
    state = upload_blockers(blockers, blocker_of, radius, 1, device)
    bring_shape(state, points, normals, blocker_vertices, device)
    state.table.progress.fill_(SEEN)
    return state


def masks_of(state) -> np.ndarray:
    """What is blocked, bool [V, 1024]."""
    device = find_device("cpu")
    rasterise_masks(state, upload_masks(2, device), device)
    words = state.table.masks.numpy()[0].astype("<u8")
    return np.unpackbits(words.view(np.uint8), axis=1, bitorder="little").astype(bool)


def hidden_by(faces, corners, points, normals) -> np.ndarray:
    return masks_of(start(far(faces, len(corners), True), points, normals, corners))


def transfer_of(state, order: int) -> tuple[np.ndarray, np.ndarray]:
    device = find_device("cpu")
    vec, count = make_hemisphere(order).vec, state.table.position.shape[1]
    transfer, visibility = (wp.zeros(count, dtype=vec, device=device) for _ in range(2))
    masks = upload_masks(order, device)
    rasterise_masks(state, masks, device)
    integrate_masks(state, masks, order, 0, transfer, visibility, device)
    return transfer.numpy(), visibility.numpy()


def exact(corners: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of a triangle [3, 3] about the origin: which pixels it covers, how far each is from the planes of its edges,
    radians, and the signed volume that it spans with the origin."""
    world = visibility_mask.pixel_directions() @ frames(normal[None])[0].T
    edges = np.stack([np.cross(corners[k], corners[(k + 1) % 3]) for k in range(3)])
    volume = edges[0] @ corners[2]
    length = np.linalg.norm(edges, axis=1, keepdims=True)
    heights = world @ (edges / np.maximum(length, 1e-300)).T * np.sign(volume)
    _, inside = visibility_mask.pixel_places()
    return (heights > 0).all(axis=1) & inside, np.abs(np.arcsin(np.clip(heights, -1, 1))).min(axis=1), volume


def triangles(kind: str, count: int) -> np.ndarray:
    """Corners [count, 3, 3] about the origin."""
    corners = RANDOM.normal(size=(count, 3, 3)) * 10.0 ** RANDOM.uniform(-2, 2, (count, 1, 1))
    if kind == "slivers":
        corners[:, 2] = corners[:, 0] + 0.02 * RANDOM.normal(size=(count, 3)) * np.abs(corners[:, 0]).max()
    elif kind == "beside the horizon":
        corners[:, :, 2] *= 0.05
    elif kind == "huge":
        corners *= 1e4
    elif kind == "next to the origin":
        corners = 0.3 * corners / np.linalg.norm(corners, axis=2, keepdims=True) + [0.0, 0.0, 1e-3]
    return corners


@pytest.mark.parametrize("kind", ["any", "slivers", "beside the horizon", "huge", "next to the origin"])
def test_the_mask_of_a_triangle_is_what_it_hides(kind):
    normals = directions(12)
    if kind == "beside the horizon":
        normals[:] = [0.0, 0.0, 1.0]
    crossing, covered_any = 0, 0
    for corners in triangles(kind, 40):
        found = masks_of(start(far(np.array([[0, 1, 2]]), 3, True), np.zeros((12, 3)), normals, corners))
        for normal, mask in zip(normals, found, strict=True):
            expected, clear, volume = exact(corners, normal)
            heights = corners @ normal
            crossing += heights.min() < 0.0 < heights.max()
            covered_any += expected.any()
            size = np.prod(np.linalg.norm(corners, axis=1))
            if abs(volume) < 1e-4 * size:  # about to be edge-on: at most what three nearly equal planes let through
                assert (mask != expected).sum() <= (clear < 2 * PLANE_ERROR).sum()
                continue
            sure = clear > PLANE_ERROR + 1e-5
            np.testing.assert_array_equal(mask[sure], expected[sure])
    assert crossing > 20 and covered_any > 20


def test_orientation_does_not_matter_when_both_sides_hide():
    corners, normals = triangles("any", 1)[0], directions(20)
    points = np.zeros((20, 3))
    one, other = (
        masks_of(start(far(np.array([face]), 3, True), points, normals, corners)) for face in ([0, 1, 2], [1, 0, 2])
    )
    np.testing.assert_array_equal(one, other)


def test_only_the_front_of_a_closed_body_hides():
    # Counter-clockwise seen from the origin is the front.
    corners = np.array([[1.0, 0.0, 1.0], [-1.0, 1.0, 1.0], [-1.0, -1.0, 1.0]])
    points, normals = np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]])
    behind, front = (
        masks_of(start(far(np.array([face]), 3, False), points, normals, corners)) for face in ([0, 1, 2], [1, 0, 2])
    )
    assert front.sum() > 100 and not behind.any()


@pytest.mark.parametrize(
    "corners",
    [
        [[1, 2, 3], [1, 2, 3], [1, 2, 3]],  # a point
        [[1, 0, 1], [2, 0, 2], [0, 1, 1]],  # an edge through the origin
        [[0, 0, 0], [1, 0, 1], [0, 1, 1]],  # a corner at the origin
        [[1, 0, 0.5], [0, 0, 0.7], [-3, 0, 0.2]],  # edge-on
        [[1, 0, -1], [0, 1, -1], [-1, -1, -1]],  # below the horizon
        [[1, 0, 0], [0, 1, 0], [-1, -1, 0]],  # in the horizon
    ],
)
def test_a_triangle_without_an_image_hides_nothing(corners):
    points, normals = np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]])
    assert not masks_of(start(far(np.array([[0, 1, 2]]), 3, True), points, normals, corners)).any()


def soup(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Small triangles scattered around the origin: corners [3 count, 3] and faces."""
    centers = RANDOM.normal(size=(count, 1, 3)) * 2.0
    corners = centers + 0.5 * RANDOM.normal(size=(count, 3, 3))
    return corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3)


def test_occluders_fuse_in_any_order():
    corners, faces = soup(40)
    normals, points = directions(30), 0.1 * RANDOM.normal(size=(30, 3))
    together = masks_of(start(far(faces, len(corners), True, clusters=5), points, normals, corners))
    backwards = masks_of(start(far(faces[::-1], len(corners), True, clusters=7), points, normals, corners))
    listed = masks_of(start(near(faces, len(corners), True), points, normals, corners))
    single = [masks_of(start(far(faces[k : k + 1], len(corners), True), points, normals, corners)) for k in range(40)]
    np.testing.assert_array_equal(together, np.any(single, axis=0))
    np.testing.assert_array_equal(together, backwards)
    np.testing.assert_array_equal(together, listed)
    assert 0.05 < together.mean() < 0.7


def test_triangles_that_share_an_edge_leave_no_gap():
    # A tent over the origin, whose ribs lie where cells of the table and pixels meet, and one where nothing does.
    for turn in (0.0, 0.3):
        angles = np.arange(8) * np.pi / 4 + turn
        rim = np.stack([np.cos(angles), np.sin(angles), np.zeros(8)], axis=1)
        corners = np.concatenate([rim, [[0.0, 0.0, 0.5]]])
        corners[:8] = np.round(corners[:8], 2)
        faces = np.stack([np.arange(8), (np.arange(8) + 1) % 8, np.full(8, 8)], axis=1)
        found = hidden_by(faces, corners, np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]))[0]
        _, inside = visibility_mask.pixel_places()
        high = visibility_mask.pixel_directions()[:, 2] > 2 * PLANE_ERROR
        np.testing.assert_array_equal(found[inside & high], True)


def test_each_vertex_skips_its_own_triangles():
    # Each is seen by itself: one per cell of a grid overhead.
    x, y = np.meshgrid(np.linspace(-0.75, 0.75, 6), np.linspace(-0.75, 0.75, 6))
    corners = np.stack([x.ravel(), y.ravel(), np.ones(36)], axis=1)[:, None] + [[0.1, 0, 0], [0, 0.1, 0], [-0.1, 0, 0]]
    corners, faces = corners.reshape(-1, 3), np.arange(108).reshape(-1, 3)
    points, normals = np.zeros((2, 3)), np.tile([[0.0, 0.0, 1.0]], (2, 1))
    first_skip = np.full(len(corners) + 1, 9, np.int32)
    first_skip[:2] = 0, 6
    skip = np.array([0, 7, 8, 17, 18, 35, 5, 6, 29], np.int32)  # of vertex 0 the first six, of vertex 1 the rest
    for clusters in (1, 2, 6):
        blockers = BlockerSet(
            **(vars(far(faces, len(corners), True, clusters)) | {"first_skip": first_skip, "skip": skip})
        )
        found = masks_of(start(blockers, points, normals, corners, blocker_of=np.array([0, 1], np.int32)))
        for mask, rows in zip(found, (skip[:6], skip[6:]), strict=True):
            left = np.delete(faces, rows, axis=0)
            np.testing.assert_array_equal(mask, hidden_by(left, corners, points[:1], normals[:1])[0])
            assert mask.sum() < hidden_by(faces, corners, points[:1], normals[:1]).sum()


def test_vertices_that_are_not_seen_have_no_masks():
    corners, faces = soup(20)
    state = start(far(faces, len(corners), True), np.zeros((3, 3)), directions(3), corners)
    state.table.progress.assign(np.array([[SEEN, NOT_SEEN, SEEN]], np.int32))
    found = masks_of(state)
    assert found[0].any() and found[2].any() and not found[1].any()


def walls() -> tuple[np.ndarray, np.ndarray]:
    """Four walls around the origin, without floor and ceiling, each of 32 triangles: the upper half of a cube."""
    x, z = np.meshgrid(np.linspace(-1.0, 1.0, 17), [0.0, 1.0])
    wall = np.stack([x.ravel(), np.ones(34), z.ravel()], axis=1)
    faces = np.concatenate([np.arange(16)[:, None] + corners for corners in ([0, 1, 17], [1, 18, 17])])
    turns = [about_z(quarter * np.pi / 2) for quarter in range(4)]
    return np.concatenate([wall @ turn for turn in turns]), np.concatenate([faces + 34 * k for k in range(4)])


def about_z(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def test_a_well_lets_the_light_of_its_opening_in():
    corners, faces = walls()
    turns = np.linspace(0.0, np.pi / 2, 12, endpoint=False)
    up = np.array([[0.0, 0.0, 1.0]])
    states = [start(far(faces, len(corners), True), 0 * up, up, corners @ about_z(turn)) for turn in turns]
    transfer, visibility = np.mean([[part[0, 0] for part in transfer_of(state, 4)] for state in states], axis=0)
    # Lambert: the form factor of a square of edge 2 from its axis, at a distance of 1.
    irradiance = 4 * np.arctan(1 / np.sqrt(2)) / np.sqrt(2)
    # One mask errs by up to half a pixel along the rim, 3 %; turned against one another, they err to both sides.
    assert transfer * np.sqrt(4 * np.pi) == pytest.approx(irradiance, rel=0.01)
    # The opening is a face of the cube about the origin: a sixth of the sphere.
    assert visibility * np.sqrt(4 * np.pi) == pytest.approx(4 * np.pi / 6, rel=0.01)


def test_transfer_turns_with_the_body():
    corners, faces = soup(30)
    normals, points = directions(10), np.zeros((10, 3))
    rotation = frames(directions(3)[2:])[0]
    plain, _ = transfer_of(start(far(faces, len(corners), True), points, normals, corners), 4)
    turned, _ = transfer_of(
        start(far(faces, len(corners), True), points, normals @ rotation.T, corners @ rotation.T), 4
    )
    expected = plain @ sh.rotation_matrix(rotation, 4).T
    # The masks' frames turn otherwise than the body: each vertex's pixels lie differently.
    error = np.linalg.norm(turned - expected, axis=1) / np.linalg.norm(expected, axis=1)
    assert error.mean() < 0.02


def test_every_world_has_its_own_shape():
    corners, faces = soup(20)
    device = find_device("cpu")
    blockers, of = far(faces, len(corners), True), np.zeros(3, np.int32)
    state = upload_blockers(blockers, of, 0.0, 2, device)
    points, normals = np.zeros((2, 3, 3), np.float32), np.tile(directions(3)[None], (2, 1, 1)).astype(np.float32)
    both = np.stack([corners, -corners]).astype(np.float32)
    bring_shape(state, points, normals, both, device)
    state.table.progress.fill_(SEEN)
    masks = upload_masks(3, device)
    vec = make_hemisphere(3).vec
    transfer, visibility = (wp.zeros(7, dtype=vec, device=device) for _ in range(2))
    rasterise_masks(state, masks, device)
    integrate_masks(state, masks, 3, 1, transfer, visibility, device)
    found = transfer.numpy()
    assert not found[0].any()
    for world, shape in enumerate((corners, -corners)):
        alone, _ = transfer_of(start(blockers, points[0], normals[0], shape), 3)
        np.testing.assert_array_equal(found[1 + 3 * world : 4 + 3 * world], alone)
