"""The web viewer: a person orbits, plays the simulation and changes the light, in a browser."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

from warp_psf.bridge import freeze_scene
from warp_psf.viewer.eye import find_viewpoints
from warp_psf.viewer.rendered import Look, RenderedScene
from warp_psf.viewer.session import Session
from warp_psf.viewer.slab_scene import SlabScene, fit_light_plane
from warp_psf.viewer.web import Viewer, check_free

__all__ = ["Look", "Viewer", "open_viewer", "view"]


def view(model: Any, states: Callable[[Any, float], Iterator[Any]], **options: Any) -> None:
    """Shows a simulation in browsers until it is interrupted. The arguments are those of `open_viewer`."""
    with open_viewer(model, states, **options) as viewer:
        viewer.wait()


def open_viewer(
    model: Any,
    states: Callable[[Any, float], Iterator[Any]],
    *,
    environment: Any = "studio",
    lights: Sequence = (),
    bounces: int = 3,
    look: Look | None = None,
    camera: int | str | None = None,
    frames_per_second: float = 30.0,
    pixels: int = 640 * 360,
    slab: tuple[int, int] | None = None,
    host: str = "127.0.0.1",
    port: int = 8080,
    device: str | None = None,
    progress: Callable[[str, float], None] | None = None,
    **settings: Any,
) -> Viewer:
    """A viewer of a simulation, whose first pictures are prepared and whose port is open.

    states: takes the model and the frames per second, and yields the `MjData` of frame 0, 1, 2, ...
    environment, lights, device, progress: as those of `Renderer`. bounces: how often light bounces where it does.
    look: what is chosen at first. camera: the model's camera that people look from first; its first one without.
    pixels: of a picture that is still. slab: rows and columns of light samples: shows the state of frame 0 under those
    alone. host, port: where it listens, this machine alone by default. settings: further options of `Renderer`.

    Raises:
        ValueError, OSError: an option, the model, the host or the port cannot be used, in one sentence.
    """
    check_free(host, port)
    first = next(states(model, frames_per_second), None)
    if first is None:
        raise ValueError("the simulation has no state to show; let its states() yield at least one")
    viewpoints = find_viewpoints(model, first, camera)
    if slab is None:
        settings |= {"lights": lights, "device": device}
        scene = RenderedScene(model, environment=environment, bounces=bounces, settings=settings, progress=progress)
        session = Session(scene, lambda: states(model, frames_per_second), frames_per_second, pixels, look or Look())
    else:
        still = freeze_scene(model, first)
        shadows = SlabScene(still, fit_light_plane(still, lights, *slab), device=device)
        session = Session(shadows, lambda: iter((first,)), frames_per_second, pixels, look or Look())
    return Viewer(session, viewpoints, host=host, port=port)
