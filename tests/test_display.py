"""Exposure, view transforms and the sRGB transfer against their published formulas, in float64."""

import numpy as np
import pytest

from warp_psf.film.display import linear_to_srgb, srgb_to_linear, to_display


def neutral_pixel(color):
    """Khronos PBR Neutral of one pixel, branch by branch as its specification prints it."""
    start, desaturation = 0.8 - 0.04, 0.15
    lowest = min(color)
    offset = lowest - 6.25 * lowest * lowest if lowest < 0.08 else 0.04
    color = np.asarray(color, np.float64) - offset
    peak = max(color)
    if peak < start:
        return color
    headroom = 1.0 - start
    new_peak = 1.0 - headroom * headroom / (peak + headroom - start)
    color = color * new_peak / peak
    g = 1.0 - 1.0 / (desaturation * (peak - new_peak) + 1.0)
    return (1.0 - g) * color + g * new_peak


@pytest.mark.parametrize(("view", "twin"), [("neutral", neutral_pixel), ("srgb", lambda color: np.asarray(color))])
@pytest.mark.parametrize("exposure", [0.0, -1.5, 2.0])
def test_views_match_the_published_formula(view, twin, exposure):
    generator = np.random.default_rng(1)
    radiance = np.float32(10.0 ** generator.uniform(-4, 2, (40, 50, 3)))
    picture = to_display(radiance, exposure=exposure, view=view)
    scaled = radiance.astype(np.float64).reshape(-1, 3) * 2.0**exposure
    expected = 255.0 * linear_to_srgb(np.clip([twin(color) for color in scaled], 0.0, 1.0))
    # Half a step from rounding to 8 bits and 0.025 from the table.
    assert np.abs(picture.reshape(-1, 3) - expected).max() < 0.53


def test_srgb_transfer_has_its_fixed_points_and_inverse():
    assert linear_to_srgb(np.array([0.0, 1.0])) == pytest.approx([0.0, 1.0])
    assert linear_to_srgb(np.array(0.18)) == pytest.approx(0.46135612950)
    assert linear_to_srgb(np.array(0.0031308)) == pytest.approx(0.0404499, abs=1e-6)
    encoded = np.arange(256) / 255.0
    np.testing.assert_allclose(linear_to_srgb(srgb_to_linear(encoded)), encoded, atol=1e-7)
    assert linear_to_srgb(encoded.astype(np.float32)).dtype == np.float32


def test_srgb_view_brings_every_8_bit_value_back():
    encoded = np.arange(256, dtype=np.uint8).reshape(16, 16, 1).repeat(3, axis=2)
    linear = srgb_to_linear(encoded / 255.0).astype(np.float32)
    np.testing.assert_array_equal(to_display(linear, view="srgb"), encoded)


def test_neutral_keeps_base_colours():
    # A dielectric of this base colour reflects 0.04 more at normal incidence, which the view takes away again.
    base = np.array([[[0.6, 0.3, 0.1]]], np.float32)
    np.testing.assert_array_equal(to_display(base + np.float32(0.04)), to_display(base, view="srgb"))


@pytest.mark.parametrize("view", ["neutral", "srgb"])
@pytest.mark.filterwarnings("error")
def test_numbers_that_are_none_do_not_reach_the_picture(view):
    radiance = np.array([[[np.nan] * 3, [np.inf] * 3, [-np.inf] * 3, [-1.0] * 3, [3e38] * 3]], np.float32)
    picture = to_display(radiance, exposure=3.0, view=view)
    assert picture[0, :, 0].tolist() == [0, 255, 0, 0, 255]
    assert to_display(np.full((1, 1, 3), 1e300))[0, 0].tolist() == [255] * 3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"view": "filmic"}, "'filmic'.*neutral, srgb"),
        ({"exposure": float("nan")}, "stops"),
        ({"exposure": 1e4}, "stops"),
        ({"radiance": np.zeros((4, 4), np.float32)}, r"\[4, 4\]"),
        ({"radiance": np.zeros((4, 4, 4), np.float32)}, r"\[4, 4, 4\]"),
        ({"radiance": np.zeros((4, 4, 3), np.uint8)}, "uint8"),
    ],
)
def test_bad_input_is_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        to_display(**{"radiance": np.zeros((2, 2, 3), np.float32), **arguments})
