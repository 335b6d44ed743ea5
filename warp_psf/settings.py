"""What a renderer is set up for, and which values are usable."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Real

import numpy as np
import warp as wp

from warp_psf.field.radiance import FUNCTION_COUNTS
from warp_psf.film.display import LARGEST_EXPOSURE, VIEWS

ORDERS = (2, 3, 4, 5, 6)
SHADINGS = ("pixel", "vertex")
COMPOSITIONS = ("product", "log")
BASES = ("sh", "haar")
# A picture of more pixels than this is a mistyped size: its buffers would take over 30 GB.
MOST_PIXELS = 2**27
# After so many bounces between white walls a fiftieth of the light is left.
MOST_BOUNCES = 16


@dataclass(frozen=True)
class Settings:
    """What a stage is set up for; see `Renderer` for the meaning of each.

    reach: how far shadow rays towards directional lights go, metres.
    """

    height: int
    width: int
    order: int
    basis: str
    compose: str
    shading: str
    bounces: int
    bounce_threshold: float
    basis_functions: int
    antialias: bool
    reach: float
    device: wp.Device


def check_bounces(bounces: int, threshold: float, functions: int) -> None:
    """Raises ValueError for options of the bounces that are not usable."""
    if bounces not in range(MOST_BOUNCES + 1):
        raise ValueError(f"bounces is {bounces!r}; give a whole number from 0 to {MOST_BOUNCES}")
    if not isinstance(threshold, Real) or not 0.0 < threshold < 1.0:
        raise ValueError(f"bounce_threshold is {threshold!r}; give a share between 0 and 1")
    if functions not in FUNCTION_COUNTS:
        raise ValueError(f"basis_functions is {functions}; choose one of {', '.join(map(str, FUNCTION_COUNTS))}")


def check_options(
    height: int, width: int, order: int, basis: str, compose: str, shading: str, exposure: float, view: str
) -> None:
    """Raises ValueError for options of the picture that are not usable."""
    for name, size in (("height", height), ("width", width)):
        if not np.isfinite(size) or int(size) != size or size < 1:
            raise ValueError(f"{name} is {size}; give a whole number of pixels, at least 1")
    if height * width > MOST_PIXELS:
        raise ValueError(f"a picture of {width} x {height} pixels is too large; give at most {MOST_PIXELS} pixels")
    if order not in ORDERS:
        raise ValueError(f"order is {order}; choose one of {', '.join(map(str, ORDERS))}")
    if basis not in BASES:
        raise ValueError(f"basis is {basis!r}; choose {' or '.join(map(repr, BASES))}")
    if compose not in COMPOSITIONS:
        raise ValueError(f"compose is {compose!r}; choose {' or '.join(map(repr, COMPOSITIONS))}")
    if shading not in SHADINGS:
        raise ValueError(f"shading is {shading!r}; choose {' or '.join(map(repr, SHADINGS))}")
    if view not in VIEWS:
        raise ValueError(f"view is {view!r}; choose {' or '.join(map(repr, VIEWS))}")
    if not abs(exposure) <= LARGEST_EXPOSURE:
        raise ValueError(f"exposure is {exposure}; give a number of stops within {LARGEST_EXPOSURE:g} of 0")
