"""`warp-psf render`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from warp_psf.cli.console import one_sentence
from warp_psf.cli.fingerprint import fingerprint
from warp_psf.cli.frames import render_frames
from warp_psf.cli.options import MOTION, Options, option, parse_frames, with_options


@with_options
def render(
    source: Annotated[Path, typer.Argument(metavar="MODEL", help="MJCF or URDF model, or a compiled one (.mjb).")],
    keyframe: Annotated[str | None, option(MOTION, "Start in this keyframe of the model.", "NAME|N")] = None,
    qpos: Annotated[Path | None, option(MOTION, "Show recorded joint positions (.npz, .csv).", "FILE")] = None,
    ctrl: Annotated[Path | None, option(MOTION, "Simulate under recorded controls (.npz, .csv).", "FILE")] = None,
    **options: Any,
) -> None:
    """Simulates a model and renders the frames: EXR with layers, PNG, MP4 and a contact sheet.

    A run that was stopped goes on where it stopped when it is started again.

    A recording has a row of qpos or ctrl per time. An .npz file holds an array of that name, and perhaps `time` in
    seconds, or `fps`; a .csv file holds plain columns, or columns under a header, one of which may be `time`. Where
    nothing tells the time, rows are a timestep of the model apart.
    """
    with one_sentence("stopped; run again to resume"):
        chosen = Options(**options)
        from warp_psf.bridge import load_model

        model = load_model(source)
        states, motion, recorded = _choose_motion(model, keyframe, qpos, ctrl, chosen.fps)
        frames = parse_frames(chosen.frames, chosen.fps, chosen.duration, recorded)
        if qpos is not None and recorded is not None and frames.stop > recorded:
            raise ValueError(f"--qpos {qpos} ends after {recorded} frames: ask for fewer with --frames or --duration")
        render_frames(model, states, frames, chosen, name=source.name, motion=motion)


def _choose_motion(
    model: Any, keyframe: str | None, qpos: Path | None, ctrl: Path | None, frames_per_second: int
) -> tuple[Callable[[Any, int], Iterator[Any]], dict[str, Any], int | None]:
    """What yields the states of the frames, the settings that tell it apart, and how many frames are recorded."""
    from warp_psf.motion import find_keyframe, read_recording, replay, simulate

    start = None if keyframe is None else find_keyframe(model, keyframe)
    settings: dict[str, Any] = {} if start is None else {"keyframe": start}
    if qpos is not None and ctrl is not None:
        raise ValueError("--qpos and --ctrl each say how the model moves: give one of them")
    if qpos is not None:
        recording = read_recording(qpos, "qpos", model)
        states = partial(replay, positions=recording, keyframe=start)
    elif ctrl is not None:
        recording = read_recording(ctrl, "ctrl", model)
        states = partial(simulate, controls=recording, keyframe=start)
    else:
        return partial(simulate, keyframe=start), settings, None
    settings[recording.kind] = f"{recording.name} {fingerprint((recording.time, recording.rows))}"
    return states, settings, recording.frame_count(frames_per_second)
