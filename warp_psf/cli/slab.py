"""`warp-psf slab`."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Annotated

import typer

from warp_psf.cli.console import one_sentence, progress_bar
from warp_psf.cli.fingerprint import fingerprint
from warp_psf.cli.options import OUTPUT, PICTURE, TIME, option, parse_size


def slab(
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="MJCF or URDF model, or a compiled one (.mjb).")],
    script: Annotated[Path, typer.Argument(metavar="SCRIPT", help="Light changes, a JSON file.")],
    out: Annotated[Path, option(OUTPUT, "Folder for the frames; a run that was stopped goes on there.", "DIR")],
    formats: Annotated[str, option(OUTPUT, "Some of exr, png, mp4.", "LIST")] = "exr,png,mp4",
    overwrite: Annotated[
        bool, typer.Option("--overwrite", rich_help_panel=OUTPUT, help="Render again what the folder holds.")
    ] = False,
    fps: Annotated[int, option(TIME, "Frames per second of the film.", "N")] = 24,
    size: Annotated[str, option(PICTURE, "Width and height in pixels.", "WxH")] = "640x360",
    map_size: Annotated[int, option(PICTURE, "Samples along the side of a full shadow map, 2^n + 1.", "N")] = 513,
    exposure: Annotated[float, option(PICTURE, "Brightness of PNG and MP4.", "STOPS")] = 0.0,
    view: Annotated[str, option(PICTURE, "View transform of PNG and MP4.", "neutral|srgb")] = "neutral",
    device: Annotated[str | None, option(None, "cpu, cuda:0, ...; default: the first GPU.", "D")] = None,
) -> None:
    """Plays a script of area lights that switch, move and change their shape over a model at rest.

    Shadow maps of every light sample are made once; a frame asks only the samples that changed. EXR frames have the
    layers color, attenuation and shadowless. The README shows a script.
    """
    with one_sentence("stopped; run again to resume"):
        width, height = parse_size(size)
        from warp_psf.area_light.script import play_script, read_script
        from warp_psf.bridge import freeze_scene, load_model
        from warp_psf.film.display import to_display
        from warp_psf.film.sequence import FrameSequence

        played, loaded = read_script(script), load_model(model)
        scene = freeze_scene(loaded, cameras=played.cameras)
        settings = {
            "model": f"{model.name} {fingerprint(loaded)}",
            "script": fingerprint(played),
            "size": f"{width}x{height}",
            "map_size": map_size,
            "exposure": exposure,
            "view": view,
        }
        kinds = tuple(part.strip() for part in formats.split(","))
        sequence = FrameSequence(
            out, settings, frames=range(played.frames), formats=kinds, frames_per_second=fps, overwrite=overwrite
        )
        frames = play_script(played, scene, width, height, size=map_size, device=device)
        # What cannot be used is refused before the folder is touched.
        first = next(frames)
        with progress_bar() as bar, sequence:
            task = bar.add_task("Frames", total=played.frames, rate="")
            for index, frame in enumerate(itertools.chain([first], frames)):
                if sequence.missing(index):
                    layers = {name: getattr(frame, name) for name in ("color", "attenuation", "shadowless")}
                    picture = to_display(frame.color, exposure=exposure, view=view)
                    camera = scene.cameras[frame.camera]
                    sequence.write(index, layers, picture, camera.world_from_camera)
                bar.update(task, completed=index + 1)
            sequence.finish()
        typer.echo(f"{played.frames} frames: {out}")
