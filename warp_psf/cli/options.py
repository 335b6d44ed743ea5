"""The options that `warp-psf render` shares with every simulation."""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

# Neither H.264 nor a GPU's texture holds a longer side, and a typing slip should not ask for terabytes.
LONGEST_SIDE = 16384
# Nine hours at 30 frames per second: what lies beyond is a typing slip, too.
MOST_FRAMES = 1_000_000
# What --environment takes for "no environment at all".
NO_ENVIRONMENT = "none"
# Seconds that are rendered of a simulation when nothing says how many.
DEFAULT_DURATION = 4.0
# The groups of options in --help.
MOTION, OUTPUT, TIME, PICTURE, LIGHT = "Motion", "Output", "Time", "Picture", "Light"


def option(panel: str | None, text: str, metavar: str | None = None, **checks: Any) -> Any:
    """An option of the command line, in a group of `--help`."""
    return typer.Option(rich_help_panel=panel, help=text, metavar=metavar, **checks)


@dataclass(frozen=True)
class Options:
    """What `warp-psf render` and every simulation can be told; each field is one option of the command line."""

    out: Annotated[Path, option(OUTPUT, "Folder for the frames; a run that was stopped goes on there.", "DIR")]
    formats: Annotated[str, option(OUTPUT, "Some of exr, png, mp4.", "LIST")] = "exr,png,mp4"
    overwrite: Annotated[
        bool, typer.Option("--overwrite", rich_help_panel=OUTPUT, help="Render again what the folder holds.")
    ] = False
    duration: Annotated[
        float | None, option(TIME, f"Seconds; else the recording's length, or {DEFAULT_DURATION:g}.", "S")
    ] = None
    fps: Annotated[int, option(TIME, "Frames per second of simulated time.", "N")] = 30
    frames: Annotated[str | None, option(TIME, "Frames A to B - 1 instead of all.", "A:B")] = None
    size: Annotated[str, option(PICTURE, "Width and height in pixels.", "WxH")] = "640x360"
    camera: Annotated[
        str | None, option(PICTURE, "A camera of the model, by name or number; -1 is the free camera.", "NAME|N")
    ] = None
    exposure: Annotated[float, option(PICTURE, "Brightness of PNG and MP4.", "STOPS")] = 0.0
    view: Annotated[str, option(PICTURE, "View transform of PNG and MP4.", "neutral|srgb")] = "neutral"
    environment: Annotated[
        str | None, option(LIGHT, f"studio, sky, sunset, overcast, an EXR or HDR file, or {NO_ENVIRONMENT}.", "E")
    ] = None
    model_lights: Annotated[bool, option(LIGHT, "Use the lights that the model brings.")] = True
    order: Annotated[int, option(LIGHT, "Bands of spherical harmonics.", min=2, max=6)] = 4
    basis: Annotated[
        str, option(LIGHT, "sh, or haar, with sharp-edged shadows of suns, windows and area lights.", "sh|haar")
    ] = "sh"
    compose: Annotated[
        str, option(LIGHT, "How bodies' shadows combine: product, or log, which adds logarithms.", "product|log")
    ] = "product"
    bounces: Annotated[int, option(LIGHT, "Bounces between bodies; 0 is none.", "N", min=0, max=16)] = 3
    shading: Annotated[str, option(LIGHT, "Where light is computed.", "pixel|vertex")] = "pixel"
    device: Annotated[str | None, option(None, "cpu, cuda:0, ...; default: the first GPU.", "D")] = None


def with_options(function: Callable[..., None], **defaults: Any) -> Callable[..., None]:
    """`function(..., **options)` with a signature in which typer reads the fields of `Options` as options."""
    own = list(inspect.signature(function, eval_str=True).parameters.values())[:-1]
    shared = inspect.signature(Options, eval_str=True).parameters.values()
    options = [each.replace(kind=each.KEYWORD_ONLY, default=defaults.get(each.name, each.default)) for each in shared]
    function.__signature__ = inspect.Signature([*own, *options])
    return function


def parse_size(text: str) -> tuple[int, int]:
    """(width, height) from "640x360"."""
    match = re.fullmatch(r"(\d+)x(\d+)", text)
    width, height = map(int, match.groups()) if match else (0, 0)
    if not (1 <= width <= LONGEST_SIDE and 1 <= height <= LONGEST_SIDE):
        raise ValueError(f"--size {text} must be a width and a height of 1 to {LONGEST_SIDE} pixels, such as 640x360")
    return width, height


def parse_frames(text: str | None, frames_per_second: int, duration: float | None, recorded: int | None) -> range:
    """The frames of "A:B" (either side may be missing), or by default all frames.

    All are those of `duration` seconds; without it `recorded` frames; without either `DEFAULT_DURATION` seconds.
    """
    if frames_per_second < 1:
        raise ValueError(f"--fps {frames_per_second} must be at least 1")
    if duration is not None and not (math.isfinite(duration) and duration > 0.0):
        raise ValueError(f"--duration {duration} must be a positive number of seconds")
    # Cut to one frame too many, which is refused below: a product beyond the largest float has no integer.
    seconds = DEFAULT_DURATION if duration is None else duration
    count = max(1, round(min(frames_per_second * seconds, MOST_FRAMES + 1)))
    if duration is None and recorded is not None:
        count = recorded
    match = re.fullmatch(r"(\d*):(\d*)", text or ":")
    if not match:
        raise ValueError(f"--frames {text} is not a range such as 0:120")
    first, last = int(match[1] or 0), int(match[2] or count)
    if first >= last:
        raise ValueError(f"--frames {text} holds no frame: the first number must be below the second ({last})")
    if last > MOST_FRAMES:
        raise ValueError(f"frame {last - 1} is beyond the last one, {MOST_FRAMES - 1}: lower --frames or --duration")
    return range(first, last)
