"""The command `warp-psf`, and the runner that the simulations of `sims` share with it.

What is heavy (Warp, MuJoCo, rich's tables) is imported by the command that needs it, so that `--help` answers at once.
"""

from __future__ import annotations

import hashlib
import inspect
import math
import os
import re
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

# Neither H.264 nor a GPU's texture holds a longer side, and a typing slip should not ask for terabytes.
LONGEST_SIDE = 16384
# Nine hours at 30 frames per second: what lies beyond is a typing slip, too.
MOST_FRAMES = 1_000_000
# What --environment takes for "no environment at all".
NO_ENVIRONMENT = "none"

app = typer.Typer(
    name="warp-psf",
    help="Soft shadows and bounced light for MuJoCo simulations, without noise.",
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


@dataclass(frozen=True)
class Options:
    """What `warp-psf render` and every simulation can be told; each field is one option of the command line."""

    out: Annotated[Path, typer.Option(help="Folder for the frames; a run that was stopped goes on there.")]
    frames: Annotated[str | None, typer.Option(metavar="A:B", help="Frames A to B - 1 instead of all.")] = None
    size: Annotated[str, typer.Option(metavar="WxH", help="Width and height in pixels.")] = "640x360"
    camera: Annotated[str | None, typer.Option(metavar="NAME", help="A camera of the model.")] = None
    fps: Annotated[int, typer.Option(metavar="N", help="Frames per second of simulated time.")] = 30
    duration: Annotated[float, typer.Option(metavar="S", help="Simulated seconds.")] = 4.0
    environment: Annotated[
        str | None, typer.Option(metavar="E", help=f"Built-in name, EXR or HDR file, or '{NO_ENVIRONMENT}'.")
    ] = None
    order: Annotated[int, typer.Option(min=2, max=6, help="Bands of spherical harmonics.")] = 4
    bounces: Annotated[int, typer.Option(min=0, max=16, metavar="N", help="Bounces between bodies; 0 is none.")] = 3
    shading: Annotated[str, typer.Option(metavar="pixel|vertex", help="Where light is computed.")] = "pixel"
    exposure: Annotated[float, typer.Option(metavar="STOPS", help="Brightness of PNG and MP4.")] = 0.0
    view: Annotated[str, typer.Option(metavar="neutral|srgb", help="View transform of PNG and MP4.")] = "neutral"
    device: Annotated[str | None, typer.Option(metavar="D", help="cpu, cuda:0, ...; default: the first GPU.")] = None
    formats: Annotated[str, typer.Option(metavar="LIST", help="Some of exr, png, mp4.")] = "exr,png,mp4"
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Render again what the folder holds.")] = False
    model_lights: Annotated[bool, typer.Option(help="Use the lights that the model brings.")] = True


def main() -> None:
    """Runs the command line."""
    app()


def run_simulation(
    build: Callable[[], Any],
    states: Callable[[Any, int], Iterator[Any]],
    *,
    name: str,
    camera: str,
    environment: Any = "studio",
    lights: Sequence = (),
) -> None:
    """Reads the command line of `python -m sims.NAME`, simulates and renders: options as `warp-psf render`'s.

    build: returns the MjModel.
    states: takes the model and the frames per second, and yields the MjData of frame 0, 1, 2, ...
    name: of the simulation; frames go to out/NAME by default.
    camera, environment, lights: what the simulation is rendered with, unless the command line says otherwise.
    """

    def simulate(**values: Any) -> None:
        with _one_sentence("stopped; run again to resume"):
            options = Options(**values)
            render_frames(build(), states, options, name=name, camera=camera, environment=environment, lights=lights)

    program = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    program.command(name, help=f"Simulates and renders {name}.")(_with_options(simulate, out=Path("out", name)))
    program()


def render_frames(
    model: Any,
    states: Callable[[Any, int], Iterator[Any]],
    options: Options,
    *,
    name: str,
    camera: str | None = None,
    environment: Any = "studio",
    lights: Sequence = (),
) -> None:
    """Renders the frames that `options.out` lacks. The arguments are those of `run_simulation`; `options` come first.

    Raises:
        ValueError, OSError: an option, the model or the folder cannot be used, in one sentence.
    """
    width, height = parse_size(options.size)
    frames = parse_frames(options.frames, options.fps, options.duration)
    formats = tuple(part.strip() for part in options.formats.split(","))
    chosen_camera = options.camera or camera or -1
    if options.environment is not None:
        environment = None if options.environment == NO_ENVIRONMENT else options.environment
    shared = ("order", "bounces", "shading", "model_lights", "exposure", "view")
    same = {option: getattr(options, option) for option in shared}
    # What a frame's pixels depend on. The device is not among it: a run may move to another machine.
    settings = same | {
        "model": f"{name} {fingerprint(model)}",
        "camera": chosen_camera,
        "environment": _describe_environment(environment),
        "lights": fingerprint(lights) if lights else None,
        "size": f"{width}x{height}",
    }
    from warp_psf import Renderer
    from warp_psf.film.sequence import FrameSequence

    files = {"formats": formats, "frames_per_second": options.fps, "overwrite": options.overwrite}
    sequence = FrameSequence(options.out, settings, frames=frames, **files)
    same |= {"environment": environment, "lights": lights, "device": options.device}
    with _progress_bar() as bar, Renderer(model, height, width, **same, progress=_show_on(bar)) as renderer:
        stream = _frame_states(states, model, options.fps)
        # What the renderer refuses, such as a camera that is not there, it refuses before the folder is touched.
        first = next(stream)
        renderer.update_scene(first, camera=chosen_camera)
        with sequence:
            rendered = _render_missing(sequence, chain([first], stream), renderer, chosen_camera, bar)
            sequence.finish()
    kept = len(frames) - rendered
    typer.echo(f"{rendered} frames rendered{f', {kept} were there' if kept else ''}: {options.out}")


def _render_missing(sequence: Any, stream: Iterator[Any], renderer: Any, camera: str | int, bar: Any) -> int:
    """Steps the simulation up to the last missing frame, renders and writes the missing ones, and counts them."""
    missing = [index for index in sequence.frames if sequence.missing(index)]
    task = bar.add_task("Frames", total=len(missing), rate="")
    start, done = time.perf_counter(), 0
    # Frames that are there already are simulated all the same: the ones after them depend on their state.
    for index, data in zip(range(missing[-1] + 1 if missing else 0), stream, strict=False):
        if index == missing[done]:
            renderer.update_scene(data, camera=camera)
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


@contextmanager
def _progress_bar() -> Iterator[Any]:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = [TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn()]
    rate = TextColumn("{task.fields[rate]}")
    with Progress(*columns, rate, TimeRemainingColumn(), console=Console(stderr=True)) as bar:
        yield bar


def _show_on(bar: Any) -> Callable[[str, float], None]:
    """`progress(label, share)` for whoever bakes or compiles: a line on the bar until its share reaches 1."""
    tasks: dict[str, Any] = {}

    def progress(label: str, share: float) -> None:
        if label not in tasks:
            tasks[label] = bar.add_task(label, total=100, rate="%")
        bar.update(tasks[label], completed=round(100 * share))
        if share >= 1.0:
            bar.remove_task(tasks.pop(label))

    return progress


def _with_options(function: Callable[..., None], **defaults: Any) -> Callable[..., None]:
    """`function(..., **options)` with a signature in which typer reads the fields of `Options` as options."""
    own = list(inspect.signature(function, eval_str=True).parameters.values())[:-1]
    shared = inspect.signature(Options, eval_str=True).parameters.values()
    options = [each.replace(kind=each.KEYWORD_ONLY, default=defaults.get(each.name, each.default)) for each in shared]
    function.__signature__ = inspect.Signature([*own, *options])
    return function


@app.command()
@_with_options
def render(source: Annotated[Path, typer.Argument(metavar="MODEL.xml", help="MJCF model.")], **options: Any) -> None:
    """Simulates a model from its start and renders the frames: EXR with layers, PNG, MP4 and a contact sheet.

    A run that was stopped goes on where it stopped when it is started again.
    """
    with _one_sentence("stopped; run again to resume"):
        chosen = Options(**options)
        from warp_psf.bridge import load_model, simulate

        render_frames(load_model(source), simulate, chosen, name=source.name)


@app.command()
def bake(
    source: Annotated[Path, typer.Argument(metavar="MODEL_OR_MESH", help="MJCF model, or OBJ, STL, PLY, GLB mesh.")],
    order: Annotated[int, typer.Option(min=2, max=6, help="Bands of spherical harmonics.")] = 4,
    device: Annotated[str | None, typer.Option(metavar="D", help="cpu, cuda:0, ...")] = None,
) -> None:
    """Bakes the fields of a model or a mesh, for shadows and bounced light, into the cache, and says what they cost."""
    with _one_sentence("stopped; run again to resume"):
        from warp_psf.bake import bake_mesh, bake_radiance
        from warp_psf.bake.bodies import is_patch
        from warp_psf.device import find_device
        from warp_psf.field.shells import FINEST_RESOLUTION, SHELL_COUNT
        from warp_psf.scene.detail import refine_radiating

        where, meshes = str(find_device(device)), _load_meshes(source)
        rows = []
        with _progress_bar() as bar:
            show = _show_on(bar)
            for mesh in meshes:
                start = time.perf_counter()
                field = bake_mesh(mesh, order, device=where, progress=partial(show, mesh.name)).field
                size, saving, light = "closed form", "", "textures"
                if field is not None:
                    size = f"{field.nbytes:,}"
                    saving = f"{1.0 - field.nbytes / (SHELL_COUNT * FINEST_RESOLUTION**2 * order**2):.0%}"
                if not is_patch(mesh):
                    progress = partial(show, f"light of {mesh.name}")
                    radiating = bake_radiance(refine_radiating(mesh), order, device=where, progress=progress)
                    light = f"{radiating.field.nbytes:,}"
                seconds = time.perf_counter() - start
                rows.append((mesh.name, f"{len(mesh.vertices):,}", f"{seconds:.1f}", size, saving, light))
        _print_table(("mesh", "vertices", "seconds", "shadow bytes", "adaptive saving", "light bytes"), rows)


@app.command()
def compare(
    first: Annotated[Path, typer.Argument(metavar="A", help="An EXR or PNG image, or a folder of frames.")],
    second: Annotated[Path, typer.Argument(metavar="B", help="What A is compared with.")],
) -> None:
    """Prints how far two images, or two folders of frames, are apart: RMSE and largest difference.

    EXR images are compared as linear light, PNG images as display values in [0, 1].
    Exit status 1: sizes or frames differ.
    """
    with _one_sentence("stopped"):
        from warp_psf.film.writer import image_difference

        pairs, complaints = _pair_images(first, second)
        rows = []
        for label, paths in pairs:
            a, b = (_read_image(path) for path in paths)
            if a.shape != b.shape:
                sizes = " and ".join(f"{image.shape[1]}x{image.shape[0]}" for image in (a, b))
                complaints.append(f"{label}: the sizes differ, {sizes}")
                continue
            difference = image_difference(a, b)
            rows.append((label, difference["rmse"], difference["maximum"]))
        if len(rows) > 1:
            whole = math.sqrt(sum(rmse * rmse for _, rmse, _ in rows) / len(rows))
            rows.append(("all", whole, max(largest for _, _, largest in rows)))
        if rows:
            _print_table(("frame", "RMSE", "max"), [(row[0], f"{row[1]:.6f}", f"{row[2]:.6f}") for row in rows])
        if complaints:
            _fail("; ".join(complaints), 1)


@app.command()
def info() -> None:
    """Prints versions, devices, cores, and the cache folder with its size."""
    with _one_sentence("stopped"):
        import platform
        from importlib.metadata import version

        import warp as wp

        from warp_psf.device import core_count, find_device
        from warp_psf.field.store import cache_folder

        lines = {"Python": platform.python_version()}
        for package in ("warp-psf", "warp-lang", "mujoco", "numpy", "trimesh", "OpenEXR", "av"):
            lines[package] = version(package)
        lines["devices"] = ", ".join(f"{device} ({device.name})" for device in wp.get_devices())
        lines["default device"] = str(find_device())
        lines["CPU cores"] = str(core_count())
        folder = Path(cache_folder())
        sizes = [entry.stat().st_size for entry in folder.rglob("*") if entry.is_file()]
        lines["cache"] = f"{folder} ({len(sizes)} files, {sum(sizes) / 1e6:.1f} MB)"
        for label, value in lines.items():
            typer.echo(f"{label:<16}{value}")


@contextmanager
def _one_sentence(stopped: str) -> Iterator[None]:
    """Ends the command with one line on stderr: status 2 after an expected error, 130 after Ctrl-C.

    Warnings become lines of the same kind.
    """
    try:
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *_: typer.echo(f"warp-psf: warning: {message}", err=True)
            yield
    except OSError as error:
        # What the system raises has its parts apart; what this library raises is a sentence already.
        _fail(f"{error.filename}: {error.strerror}" if error.filename and error.strerror else str(error), 2)
    except ValueError as error:
        _fail(str(error), 2)
    except KeyboardInterrupt:
        _fail(stopped, 130)


def _fail(sentence: str, status: int) -> NoReturn:
    # MuJoCo's messages span several lines.
    typer.echo(f"warp-psf: {' '.join(sentence.split())}", err=True)
    raise typer.Exit(status) from None


def _print_table(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Prints a table whose first column is a name and whose others are numbers."""
    from rich.console import Console
    from rich.table import Column, Table

    table = Table(titles[0], *(Column(title, justify="right", no_wrap=True) for title in titles[1:]))
    for row in rows:
        table.add_row(*row)
    Console(markup=False, highlight=False).print(table)


def parse_size(text: str) -> tuple[int, int]:
    """(width, height) from "640x360"."""
    match = re.fullmatch(r"(\d+)x(\d+)", text)
    width, height = map(int, match.groups()) if match else (0, 0)
    if not (1 <= width <= LONGEST_SIDE and 1 <= height <= LONGEST_SIDE):
        raise ValueError(f"--size {text} must be a width and a height of 1 to {LONGEST_SIDE} pixels, such as 640x360")
    return width, height


def parse_frames(text: str | None, frames_per_second: int, duration: float) -> range:
    """The frames of "A:B" (either side may be missing), or by default all frames of `duration` seconds."""
    if frames_per_second < 1:
        raise ValueError(f"--fps {frames_per_second} must be at least 1")
    if not (math.isfinite(duration) and duration > 0.0):
        raise ValueError(f"--duration {duration} must be a positive number of seconds")
    # Cut to one frame too many, which is refused below: a product beyond the largest float has no integer.
    count = max(1, round(min(frames_per_second * duration, MOST_FRAMES + 1)))
    match = re.fullmatch(r"(\d*):(\d*)", text or ":")
    if not match:
        raise ValueError(f"--frames {text} is not a range such as 0:120")
    first, last = int(match[1] or 0), int(match[2] or count)
    if first >= last:
        raise ValueError(f"--frames {text} holds no frame: the first number must be below the second ({last})")
    if last > MOST_FRAMES:
        raise ValueError(f"frame {last - 1} is beyond the last one, {MOST_FRAMES - 1}: lower --frames or --duration")
    return range(first, last)


def fingerprint(value: Any) -> str:
    """Twelve hexadecimal digits that change when any array or number in `value` does, however deep inside it lies."""
    digest = hashlib.sha256()
    _fold(value, digest)
    return digest.hexdigest()[:12]


def _fold(value: Any, digest: Any) -> None:
    if isinstance(value, (str, bytes, int, float, type(None), os.PathLike)):
        digest.update(repr(value).encode())
    elif hasattr(value, "tobytes"):
        digest.update(f"{value.dtype}{value.shape}".encode() + value.tobytes())
    elif isinstance(value, dict):
        _fold(list(value.items()), digest)
    elif isinstance(value, (list, tuple)):
        for item in value:
            _fold(item, digest)
    else:
        # A dataclass, or MuJoCo's structures: MjModel, MjOption, MjVisual, whose public attributes are their content.
        names = [field.name for field in fields(value)] if is_dataclass(value) else dir(value)
        for name in names:
            content = None if name.startswith("_") else getattr(value, name)
            if not callable(content):
                _fold((name, content), digest)


def _describe_environment(environment: Any) -> str:
    if environment is None:
        return NO_ENVIRONMENT
    if not isinstance(environment, (str, os.PathLike)):
        return fingerprint(environment)
    path = Path(environment)
    return f"{path.name} {fingerprint(path.read_bytes())}" if path.is_file() else str(environment)


def _load_meshes(source: Path) -> Sequence:
    if source.suffix.lower() in (".xml", ".urdf", ".mjb"):
        from warp_psf.bridge import build_scene, load_model

        return build_scene(load_model(source)).meshes
    from warp_psf.scene.mesh import load_mesh

    return [load_mesh(source)]


def _pair_images(first: Path, second: Path) -> tuple[list[tuple[str, tuple[Path, Path]]], list[str]]:
    """The pairs (label, (A, B)) to compare, and a complaint for each image that only one of two folders has."""
    for path in (first, second):
        if not path.exists():
            raise FileNotFoundError(f"{path} does not exist: name an image or a folder of frames")
    if first.is_file() and second.is_file():
        if first.suffix.lower() != second.suffix.lower():
            raise ValueError(f"{first} and {second} are of different kinds: compare EXR with EXR, or PNG with PNG")
        return [(first.name, (first, second))], []
    if first.is_file() or second.is_file():
        raise ValueError(f"{first} and {second}: compare two images or two folders, not one with the other")
    # The EXR frames of a sequence are what its PNG frames were made from.
    for suffix in (".exr", ".png"):
        left, right = ({path.relative_to(top) for path in top.rglob(f"*{suffix}")} for top in (first, second))
        if left and right:
            complaints = [f"{name} is only in {first if name in left else second}" for name in sorted(left ^ right)]
            return [(str(name), (first / name, second / name)) for name in sorted(left & right)], complaints
    raise ValueError(f"{first} and {second} hold no frames of the same kind: neither EXR nor PNG is in both")


def _read_image(path: Path) -> Any:
    """An EXR's colour or a PNG as float [height, width, 3]."""
    from warp_psf.film.writer import read_exr, read_png

    if path.suffix.lower() == ".exr":
        layers = read_exr(path)
        if "color" not in layers:
            raise ValueError(f"{path} has no R, G and B channels: only colour is compared")
        return layers["color"]
    if path.suffix.lower() == ".png":
        return read_png(path) / 255.0
    raise ValueError(f"{path} is neither an EXR nor a PNG image")
