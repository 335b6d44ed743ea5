"""The controls beside the picture. All people share them; what they change is the session's.

Callbacks are coroutines: they run one after the other, so that the last change is the one that stays.
"""

from __future__ import annotations

import time
from typing import Any

import viser

from warp_psf.scene.camera import Camera
from warp_psf.settings import ORDERS
from warp_psf.viewer.eye import Viewpoints
from warp_psf.viewer.session import Session, Shown

# What the simulation can be asked, and the method of `Session` that does it.
ACTIONS = {"Play": "play", "Pause": "pause", "Step": "step", "Reset": "reset"}
LARGEST_EXPOSURE = 5.0
# Seconds that a line of text stands at least while drafts follow each other; the browser lays out the panel for each.
READABLE = 0.5
# The buttons that follow this element take the place of the label that they do not have.
WIDE = """<span class="wide"></span><style>
  div:has(> .wide) ~ div > div > div:first-child { display: none; }
</style>"""


def add_simulation_panel(server: viser.ViserServer, session: Session) -> None:
    """Buttons that play, halt, step and reset the simulation."""
    with server.gui.add_folder("Simulation"):
        server.gui.add_html(WIDE)
        buttons = server.gui.add_button_group("", tuple(ACTIONS))

    @buttons.on_click
    async def _(event: viser.GuiEvent) -> None:
        getattr(session, ACTIONS[event.target.value])()


def add_light_panel(server: viser.ViserServer, session: Session) -> None:
    """Controls of the light that falls on the scene and is passed on in it."""
    gui, look = server.gui, session.look
    with gui.add_folder("Light"):
        turn = gui.add_slider("Turn", -180.0, 180.0, 1.0, look.turn, hint="Of the environment about z, degrees.")
        bounces = gui.add_checkbox("Bounces", look.bounces, hint="Light that bodies pass on to each other.")
        orders = tuple(map(str, ORDERS))
        order = gui.add_dropdown("Order", orders, initial_value=str(look.order), hint="Bands of spherical harmonics.")

    @turn.on_update
    async def _(event: viser.GuiEvent) -> None:
        session.choose(turn=float(event.target.value))

    @bounces.on_update
    async def _(event: viser.GuiEvent) -> None:
        session.choose(bounces=bool(event.target.value))

    @order.on_update
    async def _(event: viser.GuiEvent) -> None:
        session.choose(order=int(event.target.value))


def add_picture_panel(server: viser.ViserServer, session: Session, viewpoints: Viewpoints) -> None:
    """Controls of what is seen: the layer, its exposure, and the model's cameras to look from."""
    gui, cameras = server.gui, dict(viewpoints.cameras)
    with gui.add_folder("Picture"):
        layer = gui.add_dropdown("Layer", session.scene.layers, initial_value=session.look.layer)
        limits = (-LARGEST_EXPOSURE, LARGEST_EXPOSURE)
        exposure = gui.add_slider("Exposure", *limits, 0.1, session.look.exposure, hint="Stops.")
        look_from = gui.add_button_group("Look from", tuple(cameras))

    @layer.on_update
    async def _(event: viser.GuiEvent) -> None:
        session.choose(layer=event.target.value)

    @exposure.on_update
    async def _(event: viser.GuiEvent) -> None:
        session.choose(exposure=float(event.target.value))

    @look_from.on_click
    async def _(event: viser.GuiEvent) -> None:
        if event.client is not None:
            place(event.client.camera, cameras[event.target.value], viewpoints)


def place(browser: Any, camera: Camera, viewpoints: Viewpoints) -> None:
    """Puts a browser's camera, or the one that browsers start with, where a camera of the model is.

    It orbits about a point straight ahead, as far off as the model's middle.
    """
    forward = -camera.rotation[:, 2]
    distance = max(float((viewpoints.middle - camera.position) @ forward), 0.1 * viewpoints.extent)
    browser.position = tuple(camera.position)
    browser.look_at = tuple(camera.position + distance * forward)
    if not camera.orthographic:
        browser.fov = camera.fovy


class StatusLine:
    """A line of text that says what is shown, or what could not be done."""

    def __init__(self, server: viser.ViserServer, is_moving: bool):
        """is_moving: whether what is shown has a time."""
        self._is_moving = is_moving
        self._text = server.gui.add_markdown("Preparing the first picture.")
        self._sentence, self._told = "", 0.0

    def say(self, sentence: str) -> None:
        """Shows a sentence beside what `show` tells, until another one comes; none where it is empty."""
        self._sentence = sentence
        self._text.content = sentence

    def say_progress(self, what: str, share: float) -> None:
        """Tells how far something is that is being baked."""
        self.say(f"{what}: {share:.0%}" if share < 1.0 else "")

    def show(self, shown: Shown) -> None:
        """Tells the simulation's time and the picture's size; of drafts, which come fast, only now and then."""
        now = time.monotonic()
        if shown.is_draft and now - self._told < READABLE:
            return
        self._told = now
        height, width = shown.image.shape[:2]
        text = f"{f'{shown.time:.2f} s, ' if self._is_moving else ''}{width} x {height}"
        self._text.content = f"{text}. {self._sentence}" if self._sentence else text
