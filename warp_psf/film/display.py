"""From scene-linear radiance to a picture on a screen: exposure, view transform, sRGB transfer."""

from __future__ import annotations

from functools import cache

import numpy as np

VIEWS = ("neutral", "srgb")

# Stops beyond this are a mistake, and 2^stops would leave float32.
LARGEST_EXPOSURE = 64.0
# Radiance after exposure is cut here: every view is at its brightest long before, and infinity would become NaN.
LARGEST_RADIANCE = np.float32(1e6)

# Linear values are rounded to this many steps before the sRGB transfer is looked up. The curve is steepest at black,
# with slope 12.92: rounding there moves the result by at most 12.92 * 255 / (2 * 65535) = 0.025 of an 8-bit step.
TRANSFER_STEPS = 65535

# Khronos PBR Neutral: where highlights begin to be compressed, how fast they lose colour, and the reflectance of a
# dielectric at normal incidence, which is taken away so that a base colour comes back as it was given.
NEUTRAL_START = np.float32(0.8 - 0.04)
NEUTRAL_DESATURATION = np.float32(0.15)
NEUTRAL_REFLECTANCE = np.float32(0.04)


def to_display(radiance: np.ndarray, *, exposure: float = 0.0, view: str = "neutral") -> np.ndarray:
    """The picture that a screen shows: uint8 [height, width, 3], sRGB.

    ```python
    brighter = psf.to_display(np.full((90, 160, 3), 0.18), exposure=1.0, view="srgb")
    ```

    Args:
        radiance: linear Rec.709, floats [height, width, 3]. NaN and negative values show as 0, infinity saturates.
        exposure: stops within 64 of 0; the radiance is multiplied by 2^exposure.
        view: "neutral" is the Khronos PBR Neutral tone mapper, which takes away up to 0.04 (what a smooth dielectric
            reflects), keeps what is then below 0.76 and rolls highlights off towards white (Khronos PBR Neutral Tone
            Mapper specification, version 1.0); "srgb" cuts off at 1.

    Raises:
        ValueError: the array is not a float image, the view is unknown, or the exposure is not within 64 stops.
    """
    radiance = np.asarray(radiance)
    if radiance.ndim != 3 or radiance.shape[2] != 3 or radiance.dtype.kind != "f":
        raise ValueError(
            f"radiance must be floats [height, width, 3], but is {radiance.dtype} {list(radiance.shape)}: "
            "pass the linear colour layer"
        )
    if view not in VIEWS:
        raise ValueError(f"view {view!r} is not known: choose one of {', '.join(VIEWS)}")
    if not abs(exposure) <= LARGEST_EXPOSURE:
        raise ValueError(f"exposure {exposure} is not within {LARGEST_EXPOSURE:g} stops: give stops, 0 for none")

    scale = np.float32(2.0**exposure)
    planes = [_expose(radiance[..., channel], scale) for channel in range(3)]
    if view == "neutral":
        _compress_neutral(planes)
    picture = np.empty(radiance.shape, np.uint8)
    table = _transfer_table()
    for channel, plane in enumerate(planes):
        np.minimum(plane, np.float32(1.0), out=plane)
        plane *= np.float32(TRANSFER_STEPS)
        plane += np.float32(0.5)
        picture[..., channel] = table[plane.astype(np.uint16)]
    return picture


def linear_to_srgb(linear: np.ndarray) -> np.ndarray:
    """The sRGB transfer function, exact and piecewise (IEC 61966-2-1), of linear floats in [0, 1]; any shape."""
    linear = np.asarray(linear)
    curve = 1.055 * np.maximum(linear, 0.0) ** (1.0 / 2.4) - 0.055
    return np.where(linear <= 0.0031308, 12.92 * linear, curve)


def srgb_to_linear(encoded: np.ndarray) -> np.ndarray:
    """The inverse of `linear_to_srgb`, of encoded floats in [0, 1]; any shape."""
    encoded = np.asarray(encoded)
    curve = (np.maximum(encoded + 0.055, 0.0) / 1.055) ** 2.4
    return np.where(encoded <= 0.04045, encoded / 12.92, curve)


def _expose(plane: np.ndarray, scale: np.float32) -> np.ndarray:
    """One channel times the scale, float32 in [0, LARGEST_RADIANCE]."""
    with np.errstate(over="ignore"):
        # fmax takes the number where the other is NaN.
        exposed = np.fmax(plane.astype(np.float32), np.float32(0.0))
        exposed *= scale
    return np.minimum(exposed, LARGEST_RADIANCE, out=exposed)


def _compress_neutral(planes: list[np.ndarray]) -> None:
    """Khronos PBR Neutral on three channels, in place, written without branches.

    The published formula branches at x < 0.08 and at peak < start. Both branches meet there, so that clamping x to at
    most 0.08 and the peak to at least the start gives the same values.
    """
    red, green, blue = planes
    lowest = np.minimum(np.minimum(red, green), blue)
    np.minimum(lowest, 2 * NEUTRAL_REFLECTANCE, out=lowest)
    offset = lowest - lowest * lowest / (4 * NEUTRAL_REFLECTANCE)
    peak = np.maximum(np.maximum(red, green), blue)
    peak -= offset
    np.maximum(peak, NEUTRAL_START, out=peak)

    headroom = np.float32(1.0) - NEUTRAL_START
    new_peak = 1 - headroom * headroom / (peak + (headroom - NEUTRAL_START))
    # 1 - g of the specification: how much colour is kept.
    kept = 1 / (NEUTRAL_DESATURATION * (peak - new_peak) + 1)
    scale = kept * new_peak / peak
    white = new_peak * (1 - kept)
    for plane in planes:
        plane -= offset
        plane *= scale
        plane += white


@cache
def _transfer_table() -> np.ndarray:
    """sRGB in 8 bits of every quantised linear value, uint8 [65536]."""
    encoded = linear_to_srgb(np.arange(TRANSFER_STEPS + 1) / TRANSFER_STEPS)
    return np.round(255.0 * encoded).astype(np.uint8)
