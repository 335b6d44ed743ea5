"""A simulation as `warp_psf.Renderer` shows it: large pictures as they are, small ones as fast as they can be."""

from __future__ import annotations

import math
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from warp_psf.renderer import Renderer
from warp_psf.scene.environment import Environment, load_environment
from warp_psf.viewer.eye import Eye, free_camera

# Renderers of so many sizes and settings are kept: two or three sizes for each of a few windows.
MOST_RENDERERS = 8
# Seconds: where a draft of DRAFT_PIXELS takes longer with bounces, drafts do without them.
FAST = 0.05
DRAFT_PIXELS = 160 * 90


@dataclass(frozen=True)
class Look:
    """What a person has chosen to see.

    order: bands of spherical harmonics. bounces: whether light bounces. turn: of the environment about +z, degrees.
    exposure: stops. layer: of the frame's.
    """

    order: int = 4
    bounces: bool = True
    turn: float = 0.0
    exposure: float = 0.0
    layer: str = "color"

    @property
    def drawn(self) -> tuple:
        """What of it a new frame is needed for: exposure and layer are chosen from a frame that is there."""
        return self.order, self.bounces, self.turn


@dataclass(eq=False)
class _Kept:
    """A renderer, how far its environment is turned, and what it has drawn last."""

    renderer: Renderer
    turn: float = 0.0
    drawn: tuple | None = None


class RenderedScene:
    """Draws the states of a simulation.

    model: is given the eye's field of view before each frame; `close` gives it back its own. environment: as
    `Renderer`'s. bounces: how often light bounces where it does. settings: further options of `Renderer`. progress: as
    `Renderer`'s.

    A draft leaves out the bounces where they take too long for it. Its light from other bodies is then the mean of the
    last large picture: `indirect` is taken for `albedo` times one colour.
    """

    layers = ("color", "direct", "indirect", "albedo", "normal", "depth", "segmentation")

    def __init__(
        self,
        model: Any,
        *,
        environment: Any = "studio",
        bounces: int = 3,
        settings: Mapping[str, Any] | None = None,
        progress: Callable[[str, float], None] | None = None,
    ):
        self._model, self._fovy = model, float(model.vis.global_.fovy)
        self._environment: Environment | None = load_environment(environment)
        self._bounces, self._settings, self.progress = bounces, dict(settings or {}), progress
        self._kept: OrderedDict[tuple, _Kept] = OrderedDict()
        self._ambient = np.zeros(3, np.float32)
        self._drafts_bounce: bool | None = None

    def draft(self, data: Any, moment: int, eye: Eye, look: Look, pixels: int) -> dict[str, np.ndarray]:
        """The layers of a picture of about so many pixels, drawn fast.

        moment: a number that changes with the state. The layers are those of `Renderer.layers`.
        """
        if look.bounces and self._drafts_bounce is None:
            self._drafts_bounce = self._are_bounces_fast(data, eye, look)
        full = look.bounces and (self._drafts_bounce or look.layer == "indirect")
        layers = self._draw(data, moment, eye, look, pixels, full)
        if look.bounces and not full:
            layers["indirect"] = layers["albedo"] * self._ambient
            layers["color"] = layers["color"] + layers["indirect"]
        return layers

    def picture(self, data: Any, moment: int, eye: Eye, look: Look, pixels: int) -> dict[str, np.ndarray]:
        """The layers of a picture of about so many pixels, drawn well."""
        layers = self._draw(data, moment, eye, look, pixels, look.bounces)
        if look.bounces:
            albedo = layers["albedo"].sum(axis=(0, 1))
            self._ambient = layers["indirect"].sum(axis=(0, 1)) / np.maximum(albedo, 1e-6)
        return layers

    def is_quick(self, moment: int, eye: Eye, look: Look, pixels: int) -> bool:
        """Whether `picture` has drawn this already."""
        kept = self._kept.get((*eye.size(pixels), look.order, look.bounces))
        return kept is not None and kept.drawn == (moment, eye, look.drawn)

    def close(self) -> None:
        """Gives back the device's memory, and to the model its field of view."""
        while self._kept:
            self._kept.popitem()[1].renderer.close()
        self._model.vis.global_.fovy = self._fovy

    def _draw(self, data: Any, moment: int, eye: Eye, look: Look, pixels: int, bounces: bool) -> dict[str, np.ndarray]:
        kept = self._renderer(eye.size(pixels), look.order, bounces)
        if kept.turn != look.turn and self._environment is not None:
            kept.renderer.environment = self._environment.rotated(math.radians(look.turn))
        kept.turn = look.turn
        wanted = (moment, eye, look.drawn)
        if kept.drawn != wanted:
            self._model.vis.global_.fovy = math.degrees(eye.fovy)
            kept.renderer.update_scene(data, camera=free_camera(self._model, eye))
            kept.drawn = wanted
        return kept.renderer.layers()

    def _renderer(self, size: tuple[int, int], order: int, bounces: bool) -> _Kept:
        key = (*size, order, bounces)
        if key not in self._kept:
            while len(self._kept) >= MOST_RENDERERS:
                self._kept.popitem(last=False)[1].renderer.close()
            self._kept[key] = _Kept(
                Renderer(
                    self._model,
                    size[1],
                    size[0],
                    environment=self._environment,
                    order=order,
                    bounces=self._bounces if bounces else 0,
                    progress=self.progress,
                    **self._settings,
                )
            )
        self._kept.move_to_end(key)
        return self._kept[key]

    def _are_bounces_fast(self, data: Any, eye: Eye, look: Look) -> bool:
        # The first frame may compile kernels; moments that no one asks for are always drawn.
        for moment in (-1, -2):
            start = time.perf_counter()
            self._draw(data, moment, eye, look, DRAFT_PIXELS, True)
            seconds = time.perf_counter() - start
        return seconds < FAST
