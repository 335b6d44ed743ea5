"""The light template of a shadow slab as a grid of samples that a click switches, and the maps beside the picture."""

from __future__ import annotations

from typing import Any

import numpy as np
import viser

from warp_psf.area_light import templates
from warp_psf.viewer.develop import develop
from warp_psf.viewer.session import Session, Shown
from warp_psf.viewer.slab_scene import SlabScene

# What a light sample looks like that is off, partly on, and on: circles.
OFF, PARTLY, ON = "\u25cb", "\u25d0", "\u2b24"
# Buttons of a row are told apart by what they are called: so many of these, which have no width, are the column.
NOTHING = "\u200b"
# Letters that a template begins with, and the share of a sample's light from which it counts as all of it.
TEXT, FULL = "psf", 0.75
# The rows of the grid follow this element. Their buttons stand close, without the space for a label before them.
STYLE = """<span class="light-template"></span><style>
  div:has(> .light-template) ~ div { padding-bottom: 0; }
  div:has(> .light-template) ~ div > div > div:first-child { display: none; }
  div:has(> .light-template) ~ div div { gap: 0; flex-wrap: nowrap; }
  div:has(> .light-template) ~ div button {
    border: none; color: #ffd43b !important; font-size: 1.1em; height: 1.5em; min-width: 0 !important; padding: 0;
  }
</style>"""


class SlabPanel:
    """The grid and its presets; all people share it, and it starts as a square."""

    def __init__(self, server: viser.ViserServer, session: Session, scene: SlabScene):
        self._session, self._scene = session, scene
        gui = server.gui
        rows, columns = scene.template.shape
        with gui.add_folder("Light template"):
            presets = gui.add_button_group("Preset", (*templates.SHAPES, "all", "none"))
            self._text = gui.add_text("Letters", TEXT)
            with gui.add_folder("Samples"):
                gui.add_html(STYLE)
                self._rows = [gui.add_button_group("", self._options(row)) for row in range(rows)]
        self._images: dict[int, dict[str, Any]] = {}
        self.beside = gui.add_folder("Beside the picture")
        for row, group in enumerate(self._rows):
            self._listen(row, group)

        @presets.on_click
        async def _(event: viser.GuiEvent) -> None:
            self.paint(self._preset(event.target.value))

        @self._text.on_update
        async def _(_event: viser.GuiEvent) -> None:
            if self._text.value.strip():
                self.paint(self._preset("letters"))

        self.paint(self._preset("square"))

    def paint(self, template: np.ndarray) -> None:
        """Shows another template, float32 [rows, columns], and lets its samples shine."""
        self._scene.template = np.asarray(template, np.float32)
        for row, group in enumerate(self._rows):
            options = self._options(row)
            if group.options != options:
                group.options = options
        self._session.touch()

    def switch(self, row: int, column: int) -> None:
        """Switches a light sample: off where it shines, else on."""
        template = self._scene.template.copy()
        template[row, column] = 0.0 if template[row, column] > 0.0 else 1.0
        self.paint(template)

    def join(self, client: viser.ClientHandle) -> None:
        """Makes room for the maps that someone sees."""
        blank = np.zeros((9, 16, 3), np.uint8)
        with self.beside:
            names = {"attenuation": "Attenuation", "shadowless": "Without shadows"}
            images = {layer: client.gui.add_image(blank, label=name) for layer, name in names.items()}
        self._images[client.client_id] = images

    def leave(self, client: viser.ClientHandle) -> None:
        """Someone looks no more."""
        self._images.pop(client.client_id, None)

    def show(self, client: viser.ClientHandle, shown: Shown) -> None:
        """Shows the maps beside a picture."""
        for layer, image in self._images.get(client.client_id, {}).items():
            image.image = develop(shown.layers, layer, self._session.look.exposure)

    def _listen(self, row: int, group: viser.GuiButtonGroupHandle) -> None:
        @group.on_click
        async def _(event: viser.GuiEvent) -> None:
            self.switch(row, event.target.value.count(NOTHING))

    def _options(self, row: int) -> tuple[str, ...]:
        marks = (OFF if share <= 0.0 else ON if share >= FULL else PARTLY for share in self._scene.template[row])
        return tuple(mark + column * NOTHING for column, mark in enumerate(marks))

    def _preset(self, name: str) -> np.ndarray:
        rows, columns = self._scene.template.shape
        if name in ("all", "none"):
            return np.full((rows, columns), float(name == "all"), np.float32)
        extra = (self._text.value,) if name == "letters" else ()
        return templates.SHAPES[name](rows, columns, *extra)
