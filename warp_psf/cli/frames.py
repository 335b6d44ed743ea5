"""Frames of a simulation: the runner that the simulations of `sims` share with `warp-psf render`."""

from __future__ import annotations

import re
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import typer

from warp_psf.cli.console import one_sentence, progress_bar, show_on
from warp_psf.cli.fingerprint import describe_environment, fingerprint
from warp_psf.cli.options import NO_ENVIRONMENT, Options, parse_frames, parse_size, with_options


def run_simulation(
    build: Callable[[], Any],
    states: Callable[[Any, int], Iterator[Any]],
    *,
    name: str,
    camera: str,
    environment: Any = "studio",
    lights: Sequence = (),
    basis: str = "sh",
) -> None:
    """Reads the command line of `python -m sims.NAME`, simulates and renders: options as `warp-psf render`'s.

    build: returns the MjModel.
    states: takes the model and the frames per second, and yields the MjData of frame 0, 1, 2, ...
    name: of the simulation; frames go to out/NAME by default.
    camera, environment, lights, basis: what the simulation is rendered with, unless the command line says otherwise.
        Where light changes, `environment` is a function of the time in seconds.
    """

    def simulate(**values: Any) -> None:
        with one_sentence("stopped; run again to resume"):
            options = Options(**values)
            frames = parse_frames(options.frames, options.fps, options.duration, None)
            lit = {"environment": environment, "lights": lights}
            render_frames(build(), states, frames, options, name=name, camera=camera, **lit)

    program = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    program.command(name, help=f"Simulates and renders {name}.")(
        with_options(simulate, out=Path("out", name), basis=basis)
    )
    program()


def render_frames(
    model: Any,
    states: Callable[[Any, int], Iterator[Any]],
    frames: range,
    options: Options,
    *,
    name: str,
    camera: str | None = None,
    environment: Any = "studio",
    lights: Sequence = (),
    motion: Mapping[str, Any] | None = None,
) -> None:
    """Renders those of `frames` that `options.out` lacks. What `options` say goes before the other arguments.

    model, states, name, camera, environment, lights: as those of `run_simulation`.
    motion: settings that tell how the model moves, where it is not simulated from its start.

    Raises:
        ValueError, OSError: an option, the model or the folder cannot be used, in one sentence.
    """
    width, height = parse_size(options.size)
    formats = tuple(part.strip() for part in options.formats.split(","))
    chosen_camera = _find_camera(model, options.camera or camera or "-1")
    if options.environment is not None:
        environment = None if options.environment == NO_ENVIRONMENT else options.environment
    shared = ("order", "basis", "compose", "bounces", "shading", "model_lights", "exposure", "view")
    same = {option: getattr(options, option) for option in shared}
    # What a frame's pixels depend on. The device is not among it: a run may move to another machine.
    settings = same | dict(motion or {})
    settings |= {
        "model": f"{name} {fingerprint(model)}",
        "camera": chosen_camera,
        "environment": _describe_light(environment, frames, options.fps),
        "lights": fingerprint(lights) if lights else None,
        "size": f"{width}x{height}",
    }
    from warp_psf import Renderer
    from warp_psf.film.sequence import FrameSequence

    files = {"formats": formats, "frames_per_second": options.fps, "overwrite": options.overwrite}
    sequence = FrameSequence(options.out, settings, frames=frames, **files)
    light = (lambda index: environment(index / options.fps)) if callable(environment) else None
    same |= {"environment": None if light else environment, "lights": lights, "device": options.device}
    with progress_bar() as bar, Renderer(model, height, width, **same, progress=show_on(bar)) as renderer:
        stream = _frame_states(states, model, options.fps)
        # What the renderer refuses, such as a camera that is not there, it refuses before the folder is touched.
        first = next(stream)
        renderer.update_scene(first, camera=chosen_camera)
        if renderer.vertices == 0:
            warnings.warn(f"{name} shows no geoms, so that only the environment is rendered", stacklevel=2)
        with sequence:
            rendered = _render_missing(sequence, chain([first], stream), renderer, chosen_camera, light, bar)
            sequence.finish()
    kept = len(frames) - rendered
    typer.echo(f"{rendered} frames rendered{f', {kept} were there' if kept else ''}: {options.out}")


def _find_camera(model: Any, chosen: str) -> int | str:
    """A camera's name as it is, and a number as a number unless a camera has that name."""
    names = [model.camera(index).name for index in range(model.ncam)]
    return int(chosen) if re.fullmatch(r"-?\d{1,9}", chosen) and chosen not in names else chosen


def _describe_light(environment: Any, frames: range, frames_per_second: float) -> str:
    """What an environment is, or one that changes is at the start, in the middle and at the end."""
    if not callable(environment) or not frames:
        return describe_environment(environment)
    times = (frames[index] / frames_per_second for index in (0, len(frames) // 2, -1))
    return fingerprint([environment(time) for time in times])


def _render_missing(
    sequence: Any, stream: Iterator[Any], renderer: Any, camera: str | int, light: Callable | None, bar: Any
) -> int:
    """Steps the simulation up to the last missing frame, renders and writes the missing ones, and counts them.

    light: gives the environment of each frame, where it changes.
    """
    missing = [index for index in sequence.frames if sequence.missing(index)]
    task = bar.add_task("Frames", total=len(missing), rate="")
    start, done = time.perf_counter(), 0
    # Frames that are there already are simulated all the same: the ones after them depend on their state.
    for index, data in zip(range(missing[-1] + 1 if missing else 0), stream, strict=False):
        if index == missing[done]:
            renderer.update_scene(data, camera=camera)
            if light is not None:
                renderer.environment = light(index)
            image = renderer.render()
            sequence.write(index, renderer.layers(), image, renderer.world_from_camera)
            done += 1
            bar.update(task, completed=done, rate=f"{done / (time.perf_counter() - start):.2f} frames/s")
    return done


def _frame_states(states: Callable[[Any, int], Iterator[Any]], model: Any, frames_per_second: int) -> Iterator[Any]:
    """The states of the frames; asking for one that the simulation does not have is an error."""
    count = 0
    for data in states(model, frames_per_second):
        yield data
        count += 1
    raise ValueError(f"the simulation ends after {count} frames: ask for fewer with --frames or --duration")
