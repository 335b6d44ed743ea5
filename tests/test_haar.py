"""Haar wavelets on the sphere: an orthonormal basis, its best truncations, products and turns."""

import numpy as np
import pytest

from warp_psf.basis import haar

SIZE = 16
SOLID_ANGLE = 4 * np.pi / SIZE**2


def random_maps(count, size=SIZE, seed=1):
    return np.random.default_rng(seed).normal(size=(count, size, size))


def test_the_basis_is_orthonormal():
    units = np.eye(SIZE**2).reshape(-1, SIZE, SIZE)
    functions = haar.inverse(units).reshape(SIZE**2, -1)
    np.testing.assert_allclose(functions @ functions.T * SOLID_ANGLE, np.eye(SIZE**2), atol=1e-12)


@pytest.mark.parametrize("size", [1, 2, 64])
def test_there_and_back(size):
    maps = random_maps(3, size)
    np.testing.assert_allclose(haar.inverse(haar.transform(maps)), maps, atol=1e-12)


def test_the_sum_of_squares_is_the_integral_of_the_square():
    maps = random_maps(4)
    squares = (haar.transform(maps) ** 2).sum(axis=(1, 2))
    np.testing.assert_allclose(squares, (maps**2).sum(axis=(1, 2)) * SOLID_ANGLE, rtol=1e-12)


def test_even_light_is_one_coefficient():
    vector = haar.transform(np.full((SIZE, SIZE), 0.7))
    np.testing.assert_allclose(vector[0, 0], 0.7 * np.sqrt(4 * np.pi), rtol=1e-12)
    vector[0, 0] = 0
    np.testing.assert_allclose(vector, 0, atol=1e-12)


def test_cells_are_where_their_directions_say_and_all_alike():
    directions = haar.map_directions(64)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1, rtol=1e-12)
    assert directions[0, 0, 2] > 0.98
    assert directions[32, 0, 0] > 0.99
    assert directions[32, 16, 1] > 0.99
    np.testing.assert_allclose(directions.mean(axis=(0, 1)), 0, atol=1e-12)
    # A third of the squares along each axis; sums over 64 heights are off by (1/64)^2 / 3 and less.
    np.testing.assert_allclose((directions**2).mean(axis=(0, 1)), 1 / 3, atol=1e-4)


def test_a_product_is_that_of_the_maps():
    a, b = random_maps(5), random_maps(5, seed=2)
    expected = haar.transform(a * b)
    np.testing.assert_allclose(haar.product(haar.transform(a), haar.transform(b)), expected, atol=1e-12)
    # Of sparse vectors too, whose product has other places than they.
    sparse = haar.keep_largest(haar.transform(a)), haar.keep_largest(haar.transform(b))
    expected = haar.transform(haar.inverse(sparse[0]) * haar.inverse(sparse[1]))
    np.testing.assert_allclose(haar.product(*sparse), expected, atol=1e-12)


def test_a_product_with_one_function_of_many():
    a, b = random_maps(4), random_maps(1)[0]
    expected = haar.transform(a * b)
    np.testing.assert_allclose(haar.product(haar.transform(a), haar.transform(b)), expected, atol=1e-12)


def test_double_and_triple_products_are_integrals():
    a, b, c = random_maps(3)
    vectors = [haar.transform(each) for each in (a, b, c)]
    np.testing.assert_allclose(haar.double_product(vectors[0], vectors[1]), (a * b).sum() * SOLID_ANGLE, rtol=1e-10)
    triple = haar.double_product(haar.product(vectors[0], vectors[1]), vectors[2])
    np.testing.assert_allclose(triple, (a * b * c).sum() * SOLID_ANGLE, rtol=1e-10)


def test_what_is_kept_is_the_best_of_its_size():
    vectors = haar.transform(random_maps(3, 64))
    kept = haar.keep_largest(vectors)
    assert ((kept != 0).sum(axis=(1, 2)) == 205).all()
    for whole, part in zip(vectors, kept, strict=True):
        assert np.abs(part[part != 0]).min() >= np.abs(whole[part == 0]).max()


def test_a_disc_keeps_its_edge_in_a_twentieth():
    covered = (haar.map_directions(64) @ np.array((0.6, 0.0, 0.8)) > np.cos(0.6)).astype(float)
    kept = haar.inverse(haar.keep_largest(haar.transform(covered)))
    # The rim has some 85 cells, each of which asks for a detail of six levels, which neighbours share.
    assert np.abs(kept - covered).mean() < 0.01


def test_a_quarter_turn_about_the_vertical_moves_columns():
    maps = random_maps(2)
    turn = np.array([(0, -1, 0), (1, 0, 0), (0, 0, 1.0)])
    turned = haar.inverse(haar.rotate(haar.transform(maps), turn))
    np.testing.assert_allclose(turned, np.roll(maps, SIZE // 4, axis=2), atol=1e-12)


def test_a_turned_cap_is_the_cap_about_the_turned_axis():
    axis, angle = np.array((0.36, 0.48, 0.8)), 0.7
    directions = haar.map_directions(64)
    tilt = np.array([(1, 0, 0), (0, np.cos(1.1), -np.sin(1.1)), (0, np.sin(1.1), np.cos(1.1))])
    turned = haar.inverse(haar.rotate(haar.transform((directions @ axis > np.cos(angle)).astype(float)), tilt))
    expected = directions @ (tilt @ axis) > np.cos(angle)
    # Cells on the rim, 2 pi sin(0.7) / 0.055 of 4,096, are covered in part.
    assert np.abs(turned - expected).mean() < 0.02
    np.testing.assert_allclose(turned.mean(), expected.mean(), atol=2e-3)
