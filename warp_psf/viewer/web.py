"""The server that shows a session to browsers."""

from __future__ import annotations

import os
import socket
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import redirect_stdout
from io import StringIO

import viser

from warp_psf.viewer.eye import Viewpoints, eye_of_browser, eye_of_camera
from warp_psf.viewer.panel import StatusLine, add_light_panel, add_picture_panel, add_simulation_panel, place
from warp_psf.viewer.rendered import RenderedScene
from warp_psf.viewer.session import Session, Shown
from warp_psf.viewer.slab_panel import SlabPanel
from warp_psf.viewer.slab_scene import SlabScene

# The window that pictures are prepared for before anyone has opened one.
ASPECT = 16 / 9
# Quality of the pictures that are sent, of 100.
DRAFT_QUALITY, QUALITY = 80, 92
TITLE = "warp_psf"


class Viewer:
    """A server that shows a session to browsers, from when it is made to `close`.

    session: prepared as the viewpoints' first camera sees it before the port opens. host, port: to listen at; port 0
    takes any that is free.

    Raises:
        OSError: the host is not this machine's, or the port is in use.
    """

    def __init__(self, session: Session, viewpoints: Viewpoints, *, host: str = "127.0.0.1", port: int = 8080):
        check_free(host, port)
        self.session = session
        name, first = viewpoints.cameras[0]
        session.warm(eye_of_camera(first, ASPECT))
        # The server tells its address in a box of its own; whoever opens the viewer tells it in a sentence.
        with redirect_stdout(StringIO()):
            self._server = server = viser.ViserServer(host=host, port=port, label=TITLE, verbose=False)
        server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, control_width="small")
        server.scene.set_up_direction("+z")
        server.scene.configure_default_lights(False)
        place(server.initial_camera, first, viewpoints)
        self._status = StatusLine(server, is_moving=not isinstance(session.scene, SlabScene))
        self._slab: SlabPanel | None = None
        if isinstance(session.scene, SlabScene):
            self._slab = SlabPanel(server, session, session.scene)
        else:
            add_simulation_panel(server, session)
            add_light_panel(server, session)
        add_picture_panel(server, session, viewpoints)
        session.report = self._status.say
        if isinstance(session.scene, RenderedScene):
            # What is baked from now on, for another order, was asked for in a browser.
            session.scene.progress = self._status.say_progress
        server.on_client_connect(self._join)
        server.on_client_disconnect(self._leave)
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="viewer")
        self._work: Future[None] = self._worker.submit(session.run)
        self.url = f"http://{host}:{server.get_port()}"

    def wait(self) -> None:
        """Returns when the viewer is closed; raises what ended it if it could not go on."""
        self._work.result()

    def close(self) -> None:
        """Ends the session and closes the port."""
        self.session.stop()
        # The server says on stdout that it has stopped, which whoever closes it knows.
        with redirect_stdout(StringIO()):
            self._server.stop()
        self._worker.shutdown()
        self.session.scene.close()

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, kind, error, trace) -> None:
        self.close()

    async def _join(self, client: viser.ClientHandle) -> None:
        if self._slab is not None:
            self._slab.join(client)
        self._look(client)

        @client.camera.on_update
        async def _(_camera: viser.CameraHandle) -> None:
            self._look(client)

    async def _leave(self, client: viser.ClientHandle) -> None:
        self.session.leave(client.client_id)
        if self._slab is not None:
            self._slab.leave(client)

    def _look(self, client: viser.ClientHandle) -> None:
        self.session.watch(client.client_id, eye_of_browser(client.camera), lambda shown: self._show(client, shown))

    def _show(self, client: viser.ClientHandle, shown: Shown) -> None:
        quality = DRAFT_QUALITY if shown.is_draft else QUALITY
        client.scene.set_background_image(shown.image, format="jpeg", jpeg_quality=quality)
        # The maps beside the picture are small, and follow when it is still.
        if self._slab is not None and not shown.is_draft:
            self._slab.show(client, shown)
        self._status.show(shown)
        client.flush()


def check_free(host: str, port: int) -> None:
    """Raises OSError unless a server may listen at a port: the server itself would try others for long."""
    try:
        with socket.create_server((host, port)):
            pass
    except OSError as error:
        raise OSError(
            f"cannot listen at {host}:{port} ({os.strerror(error.errno or 0)}); choose another --port or --host"
        ) from error
