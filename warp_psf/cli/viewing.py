"""`warp-psf view`."""

from __future__ import annotations

import runpy
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer

from warp_psf.cli.console import one_sentence, progress_bar, show_on
from warp_psf.cli.options import LIGHT, MOTION, NO_ENVIRONMENT, PICTURE, option, parse_size

# The group of options in --help that say where the viewer is found.
SERVER = "Server"
MODELS = (".xml", ".urdf", ".mjb")
# The package that simulations are looked for in when they are named without it.
PACKAGE = "sims"


def view(
    source: Annotated[
        str,
        typer.Argument(
            metavar="MODEL_OR_SIM",
            help="MJCF or URDF model, a compiled one (.mjb), or a simulation: a .py file or the name of a module.",
        ),
    ],
    host: Annotated[str, option(SERVER, "Address to listen at; by default, only this machine is heard.")] = "127.0.0.1",
    port: Annotated[int, option(SERVER, "Port to listen at; 0 is any.", min=0, max=65535)] = 8080,
    slab: Annotated[
        bool, typer.Option("--slab", rich_help_panel=LIGHT, help="Paint a light over the scene, which rests.")
    ] = False,
    samples: Annotated[int, option(LIGHT, "Light samples along each side of --slab.", "N", min=1, max=64)] = 7,
    environment: Annotated[
        str | None, option(LIGHT, f"studio, sky, sunset, overcast, an EXR or HDR file, or {NO_ENVIRONMENT}.", "E")
    ] = None,
    order: Annotated[int, option(LIGHT, "Bands of spherical harmonics.", min=2, max=6)] = 4,
    basis: Annotated[
        str, option(LIGHT, "sh, or haar, with sharp-edged shadows of suns, windows and area lights.", "sh|haar")
    ] = "sh",
    bounces: Annotated[int, option(LIGHT, "Bounces between bodies.", "N", min=1, max=16)] = 3,
    size: Annotated[str, option(PICTURE, "So many pixels have pictures that are still.", "WxH")] = "640x360",
    camera: Annotated[
        str | None, option(PICTURE, "A camera of the model to look from first, by name or number.", "NAME|N")
    ] = None,
    exposure: Annotated[float, option(PICTURE, "Brightness.", "STOPS")] = 0.0,
    keyframe: Annotated[str | None, option(MOTION, "Start in this keyframe of the model.", "NAME|N")] = None,
    fps: Annotated[int, option(MOTION, "Frames per second of simulated time.", "N", min=1)] = 30,
    device: Annotated[str | None, option(None, "cpu, cuda:0, ...; default: the first GPU.", "D")] = None,
) -> None:
    """Shows a model or a simulation in a browser: orbit, play, change the light, and see the shadows follow.

    A simulation has `build() -> MjModel` and `states(model, frames_per_second)`, which yields the MjData of each frame,
    and perhaps `lights()` and `environment()`: such as sims.bowling, or bowling for short.
    """
    with one_sentence("the viewer is closed"):
        width, height = parse_size(size)
        from warp_psf.viewer import Look, open_viewer
        from warp_psf.viewer.panel import LARGEST_EXPOSURE

        if not abs(exposure) <= LARGEST_EXPOSURE:
            raise ValueError(f"--exposure {exposure} must be within {LARGEST_EXPOSURE:g} stops of 0")
        if not host:
            raise ValueError("--host is empty, which every address would be; leave it out to be heard by this machine")
        seen = read_simulation(source, keyframe)
        if environment is not None:
            seen = seen._replace(environment=None if environment == NO_ENVIRONMENT else environment)
        with progress_bar() as bar:
            viewer = open_viewer(
                seen.model,
                seen.states,
                environment=seen.environment,
                lights=seen.lights,
                basis=basis,
                bounces=bounces,
                look=Look(order=order, exposure=exposure),
                camera=camera,
                frames_per_second=fps,
                pixels=width * height,
                slab=(samples, samples) if slab else None,
                host=host,
                port=port,
                device=device,
                progress=show_on(bar),
            )
        with viewer:
            typer.echo(f"{source} is shown at {viewer.url} until Ctrl-C is pressed")
            viewer.wait()


class Simulation(NamedTuple):
    """A model, how it moves, and its light."""

    model: Any
    states: Callable
    environment: Any = "studio"
    lights: tuple = ()


def read_simulation(source: str, keyframe: str | None) -> Simulation:
    """The simulation that a person named.

    Raises:
        FileNotFoundError: there is no such model or simulation.
        ValueError: it cannot be used, or has no such keyframe.
    """
    path = Path(source)
    if path.suffix.lower() in MODELS:
        from warp_psf.bridge import load_model
        from warp_psf.motion import find_keyframe, simulate

        model = load_model(path)
        start = None if keyframe is None else find_keyframe(model, keyframe)
        return Simulation(model, partial(simulate, keyframe=start))
    if keyframe is not None:
        raise ValueError(f"--keyframe {keyframe}: {source} is a simulation, which starts as it says; leave it out")
    names = _run(source)
    missing = [name for name in ("build", "states") if not callable(names.get(name))]
    if missing:
        raise ValueError(f"{source} has no {' and no '.join(missing)}; give it build() and states(model, fps)")
    values = [name for name in ("environment", "lights") if name in names and not callable(names[name])]
    if values:
        raise ValueError(f"{source}: {' and '.join(values)} must be functions without arguments; make them such")
    light = {name: names[name]() for name in ("environment", "lights") if name in names}
    model = names["build"]()
    if not hasattr(model, "ncam"):
        raise ValueError(f"{source}: build() returned a {type(model).__name__}; let it return a mujoco.MjModel")
    return Simulation(model, names["states"], **light)


def _run(source: str) -> dict[str, Any]:
    """What a simulation's file or module defines: a program that the person runs, as `python -m` would."""
    try:
        return _run_named(source)
    except SyntaxError as error:
        raise ValueError(f"simulation {source} is no Python program: {error}") from error


def _run_named(source: str) -> dict[str, Any]:
    path = Path(source)
    if path.suffix == ".py":
        if not path.is_file():
            raise FileNotFoundError(f"simulation {source!r} does not exist; give the path of a .py file")
        return runpy.run_path(source)
    names = [source] if "." in source else [f"{PACKAGE}.{source}", source]
    for name in names:
        try:
            return runpy.run_module(name, run_name=name)
        except ImportError as error:
            # A module that is there and lacks another one says so itself.
            if error.name is not None and not f"{name}.".startswith(f"{error.name}."):
                raise ValueError(f"simulation {name} cannot be imported: {error}") from error
    raise FileNotFoundError(
        f"{source!r} is neither a model nor a simulation; give an .xml, .urdf, .mjb or .py file, or a module's name"
    )
