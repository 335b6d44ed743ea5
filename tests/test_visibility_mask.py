"""Visibility masks: planes, and integrals of basis functions over what a mask leaves open."""

import numpy as np
import pytest
import warp as wp

from warp_psf.basis import sh, visibility_mask
from warp_psf.basis.visibility_mask import SIDE, WORDS, MaskTables, make_masks, mask, upload_masks
from warp_psf.device import find_device, launch

RANDOM = np.random.default_rng(6)


def to_words(covered: np.ndarray) -> np.ndarray:
    """Masks bool [N, 1024] as words [N, 16]."""
    return np.packbits(covered, axis=1, bitorder="little").view("<u8").astype(np.uint64)


def frames(normals: np.ndarray) -> np.ndarray:
    """The masks' frames [N, 3, 3]: columns along growing theta, growing phi, and the normal."""
    level = np.linalg.norm(normals[:, :2], axis=1)
    x, y = np.where(level > 1e-6, normals[:, :2].T / np.maximum(level, 1e-300), [[1.0], [0.0]])
    along = np.stack([normals[:, 2] * x, normals[:, 2] * y, -level], axis=1)
    return np.stack([along, np.stack([-y, x, 0.0 * x], axis=1), normals], axis=2)


def directions(count: int) -> np.ndarray:
    found = RANDOM.normal(size=(count, 3))
    found[:2] = [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]  # where a frame's azimuth is free
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def integrate(order: int, covered: np.ndarray, normals: np.ndarray, mirrored: np.ndarray, exponent: float):
    """What the Warp side makes of masks: with the cosine, without, and with the cosine and a lobe."""
    kit, device = make_masks(order), find_device("cpu")

    @wp.kernel(enable_backward=False, module="unique")
    def kernel(
        first: int,
        covered: wp.array(dtype=mask),
        normals: wp.array(dtype=wp.vec3),
        mirrored: wp.array(dtype=wp.vec3),
        exponent: float,
        masks: MaskTables,
        transfer_out: wp.array(dtype=kit.vec),
        visibility_out: wp.array(dtype=kit.vec),
        lobe_out: wp.array(dtype=kit.vec),
    ):
        _, index = wp.tid()
        index += first
        both = kit.open_transfer(covered[index], normals[index], masks)
        transfer_out[index] = both[0]
        visibility_out[index] = both[1]
        lobe_out[index] = kit.open_lobe(covered[index], normals[index], mirrored[index], exponent, masks)

    inputs = [wp.array(to_words(covered), dtype=mask), *(wp.array(a, dtype=wp.vec3) for a in (normals, mirrored))]
    outputs = [wp.zeros(len(covered), dtype=kit.vec, device=device) for _ in range(3)]
    launch(kernel, (1, len(covered)), [*inputs, exponent, upload_masks(order, device)], outputs, device)
    return [output.numpy() for output in outputs]


def test_every_pixel_has_its_bit():
    places, inside = visibility_mask.pixel_places()
    assert len(np.unique(places, axis=0)) == SIDE**2
    # The disc takes pi / 4 of its square; a count of pixels errs by fewer than a fifth of those on its rim.
    assert abs(inside.sum() - np.pi / 4 * SIDE**2) < 20
    # The sixteen bits of a block lie within a square of a quarter of an eighth of the side.
    assert np.ptp(places.reshape(-1, 16, 2), axis=1).max() == pytest.approx(3 * 2 / SIDE)


def test_planes_hold_what_lies_above_them():
    planes = upload_masks(2, find_device("cpu")).tables[0].planes.numpy()
    assert planes.shape == (1 + 6 * 128**2, WORDS)
    assert planes.nbytes == pytest.approx(12 * 2**20, rel=1e-4)  # as in the paper
    assert not planes[0].any()
    normals, pixels = visibility_mask.plane_normals(), visibility_mask.pixel_directions()
    _, inside = visibility_mask.pixel_places()
    chosen = RANDOM.integers(len(normals), size=500)
    heights = normals[chosen] @ pixels.T
    found = np.unpackbits(planes[1 + chosen].astype("<u8").view(np.uint8), axis=1, bitorder="little").astype(bool)
    clear = np.abs(heights) > 1e-6  # past rounding of float32
    np.testing.assert_array_equal(found[clear], ((heights > 0) & inside)[clear])


def test_a_normal_finds_the_nearest_plane():
    device = find_device("cpu")

    @wp.func_native(
        "int found; " + visibility_mask.plane_snippet(*(f"n[{k}]" for k in range(3)), "found") + "return found;"
    )
    def plane_of(n: wp.vec3) -> int: ...

    @wp.kernel(enable_backward=False, module="unique")
    def kernel(first: int, normals: wp.array(dtype=wp.vec3), planes_out: wp.array(dtype=wp.int32)):
        _, index = wp.tid()
        planes_out[first + index] = plane_of(normals[first + index])

    corners = np.stack(np.meshgrid(*3 * [[-1.0, 0.0, 1.0]]), axis=-1).reshape(-1, 3)
    corners = corners[corners.any(axis=1)]
    normals = np.concatenate([1e-6 * RANDOM.normal(size=(2000, 3)), 1e6 * RANDOM.normal(size=(2000, 3)), corners])
    found = wp.zeros(len(normals), dtype=wp.int32, device=device)
    launch(kernel, (1, len(normals)), [wp.array(normals, dtype=wp.vec3)], [found], device)
    planes = visibility_mask.plane_normals()[found.numpy() - 1]
    cosine = (planes * normals).sum(axis=1) / np.linalg.norm(planes, axis=1) / np.linalg.norm(normals, axis=1)
    # A cell reaches from its centre to its corner by half a diagonal, seen from a distance of at least 1.
    assert np.arccos(np.minimum(cosine, 1.0)).max() <= np.arctan(np.sqrt(0.5) * 2 / 128) + 1e-6


@pytest.mark.parametrize("order", [2, 4, 5, 6])
def test_an_open_mask_is_the_whole_hemisphere(order):
    normals = directions(50).astype(np.float32)
    transfer, visibility, _ = integrate(order, np.zeros((50, 1024), bool), normals, normals, 1.0)
    # The quadrature over the hemisphere is exact; what remains is float32.
    np.testing.assert_allclose(transfer, sh.zonal(sh.clamped_cosine(order), normals), atol=3e-6)
    np.testing.assert_allclose(visibility, sh.zonal(sh.cap(np.pi / 2, order), normals), atol=6e-6)


@pytest.mark.parametrize("order", [3, 5])
def test_masks_are_integrated_pixel_by_pixel(order):
    count, exponent = 60, 7.0
    _, inside = visibility_mask.pixel_places()
    # From all open to all blocked, so that blocks of every filling occur.
    covered = (RANDOM.uniform(size=(count, 1024)) < np.linspace(0, 1, count)[:, None]) & inside
    covered[1] = inside
    normals, mirrored = directions(count).astype(np.float32), directions(count).astype(np.float32)
    found = integrate(order, covered, normals, mirrored, exponent)
    turned = frames(normals.astype(np.float64))
    matrices = sh.rotation_matrix(turned, order)
    local = np.einsum("np,prk->nrk", ~covered, visibility_mask.pixel_integrals(order))
    cosine = np.maximum(np.einsum("nij,pj,ni->np", turned, visibility_mask.pixel_directions(), mirrored), 0.0)
    lobe = (exponent + 2.0) / (2.0 * np.pi) * cosine**exponent * ~covered
    glossy = np.einsum("np,pk->nk", lobe, visibility_mask.pixel_integrals(order)[:, 0])
    expected = [*np.einsum("nij,nrj->rni", matrices, local), np.einsum("nij,nj->ni", matrices, glossy)]
    for name, a, b in zip(("transfer", "visibility", "lobe"), found, expected, strict=True):
        # A thousand terms of float32.
        np.testing.assert_allclose(a, b, atol=1e-5 * max(1.0, np.abs(b).max()), err_msg=name)
    assert not found[0][1].any()
