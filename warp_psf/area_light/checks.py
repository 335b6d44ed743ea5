"""What every entry point of this room asks of its arguments, before anything is made of them."""

from __future__ import annotations

from reprlib import repr as brief
from typing import Any

import numpy as np

# As many as the renderer's pictures have at most: their buffers take 6 GB.
LARGEST_SIDE, MOST_PIXELS = 16384, 2**27
# The greatest radiance of a light; ten times the sun's.
MOST_RADIANCE = 1.0e8


def check_type(name: str, value: Any, wanted: type, source: str) -> None:
    """Raises TypeError unless `value` is of the type `wanted`, which comes from `source`."""
    if not isinstance(value, wanted):
        raise TypeError(f"{name} is a {type(value).__name__}; give a {wanted.__name__}, from {source}")


def check_picture(width: int, height: int, least: int = 1, largest: int = LARGEST_SIDE) -> tuple[int, int]:
    """Width and height as whole numbers; raises ValueError where a picture cannot have them."""
    for name, value in (("width", width), ("height", height)):
        if not isinstance(value, (int, np.integer)) or not least <= value <= largest:
            raise ValueError(f"{name} is {value!r}; give a whole number of pixels from {least} to {largest}")
    if int(width) * int(height) > MOST_PIXELS:
        raise ValueError(f"a picture of {width} x {height} pixels is too large; give at most {MOST_PIXELS} pixels")
    return int(width), int(height)


def read_numbers(name: str, value: Any, dtype: type = np.float64) -> np.ndarray:
    """`value` as a new array; raises ValueError where it is none of real numbers."""
    try:
        given = np.array(value)
        if given.dtype.kind == "c":
            raise TypeError
        # What is too large becomes infinite, which each caller refuses.
        with np.errstate(over="ignore"):
            return given.astype(dtype)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} is {brief(value)}, which is no array of numbers; give real numbers") from error
