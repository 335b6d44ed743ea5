"""A still scene under the light of a shadow slab, whose samples are switched (Jeng 2005, chapter 3)."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from warp_psf.area_light import LightPlane, SlabView, bake_scene_map, bake_shadow_slab, make_light_plane
from warp_psf.scene.light import AreaLight
from warp_psf.scene.still import StillScene
from warp_psf.viewer.eye import Eye
from warp_psf.viewer.rendered import Look

# Views of so many sizes are kept, each with what every light sample sends to its pixels.
MOST_VIEWS = 8
# So many samples are switched in a large picture about as fast as a draft is drawn.
FEW_SAMPLES = 8
# A white floor right below the fitted plane, all of whose samples shine, has about this radiance.
WHITE = 2.5
# What lies lower than this share of the scene's height is its floor, which the light need not span.
FLOOR = 0.02
# Of the fitted plane: half its side, and how high it hangs above the scene, in shares of the scene's width.
HALF_SIDE, CLEARANCE = 0.2, 0.25


class SlabScene:
    """Draws a still scene as the shadow slab of a plane of light samples has it, from any eye.

    size: samples along the side of a full shadow map, 2^n + 1. template: the share of its light that each sample sends,
    float32 [rows, columns]; a new array takes its place when it changes.
    """

    layers = ("color", "attenuation", "shadowless")

    def __init__(self, scene: StillScene, plane: LightPlane, *, size: int = 257, device: str | None = None):
        # Without cameras, the maps cover all of the scene, from wherever it is seen.
        self._scene, self._device = replace(scene, cameras=()), device
        self._slab = bake_shadow_slab(self._scene, plane, size, device=device)
        self._radiance = _bright_enough(scene, plane)
        self._views: OrderedDict[tuple[int, int], tuple[Eye, SlabView]] = OrderedDict()
        self.template = np.zeros((plane.rows, plane.columns), np.float32)

    def draft(self, data: Any, moment: int, eye: Eye, look: Look, pixels: int) -> dict[str, np.ndarray]:
        """As `picture`: a smaller one takes less time."""
        return self.picture(data, moment, eye, look, pixels)

    def picture(self, data: Any, moment: int, eye: Eye, look: Look, pixels: int) -> dict[str, np.ndarray]:
        """The layers of a picture of about so many pixels: radiance, the attenuation map and what would be without."""
        view = self._view(eye, pixels)
        view.set_light(0, self._radiance * self.template)
        return {"color": view.picture(), "attenuation": view.attenuation(), "shadowless": view.shadowless()}

    def is_quick(self, moment: int, eye: Eye, look: Look, pixels: int) -> bool:
        """Whether this eye's view is there, and few of its light samples are to be switched."""
        seen, view = self._views.get(eye.size(pixels), (None, None))
        if view is None or seen != eye:
            return False
        changed = view.template(0)[..., 0] != (self._radiance * self.template).astype(np.float32)
        return np.count_nonzero(changed) <= FEW_SAMPLES

    def close(self) -> None:
        """Gives back the device's memory."""
        self._views.clear()

    def _view(self, eye: Eye, pixels: int) -> SlabView:
        size = eye.size(pixels)
        if size not in self._views or self._views[size][0] != eye:
            still = replace(self._scene, cameras=(eye.camera(),))
            scene_map = bake_scene_map(still, 0, *size, device=self._device)
            self._views[size] = eye, SlabView(scene_map, [self._slab], device=self._device)
        self._views.move_to_end(size)
        while len(self._views) > MOST_VIEWS:
            self._views.popitem(last=False)
        return self._views[size][1]


def fit_light_plane(scene: StillScene, lights: Sequence[AreaLight], rows: int, columns: int) -> LightPlane:
    """A plane of light samples for a scene: its first rectangular light, or one above what stands in it."""
    for light in lights:
        try:
            return make_light_plane(light, rows, columns)
        except ValueError:
            # A light of another shape, or one that a body carries: the next may do.
            continue
    vertices = scene.vertices.astype(np.float64)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    standing = vertices[vertices[:, 2] > low[2] + FLOOR * (high[2] - low[2])]
    standing = standing if len(standing) else vertices
    low, high = standing.min(axis=0), standing.max(axis=0)
    width = float((high - low).max())
    center = (*(0.5 * (low + high))[:2], high[2] + CLEARANCE * width)
    half = HALF_SIDE * width
    # Rightwards x and upwards -y, so that it shines downwards.
    return LightPlane(np.array(center), np.array((half, 0.0, 0.0)), np.array((0.0, -half, 0.0)), rows, columns)


def _bright_enough(scene: StillScene, plane: LightPlane) -> float:
    """The radiance of a light sample, W/(m^2 sr), under which the scene is neither dark nor blinding.

    The irradiance below a small plane of area A at the distance h is A/h^2 times its radiance; a white surface sends
    back a 1/pi of it. That of a large plane, below which it nears pi times the radiance, is bounded alike.
    """
    depths = (scene.vertices - plane.center) @ plane.axes[:, 2]
    depth = float(np.median(depths[depths > 0.0])) if (depths > 0.0).any() else 1.0
    area = plane.cell_area * plane.rows * plane.columns
    return WHITE * math.pi * (1.0 / math.pi + depth * depth / area)
