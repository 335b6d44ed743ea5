"""The script shadow viewer: a file of light changes, played into frames (Jeng 2005, 3.5.2.2).

`read_script` says what such a file holds.
"""

from __future__ import annotations

import inspect
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from reprlib import repr as brief
from typing import Any

import numpy as np

from warp_psf.area_light.attenuation import SlabView
from warp_psf.area_light.checks import check_type
from warp_psf.area_light.scene_map import bake_scene_map
from warp_psf.area_light.slab import LightPlane, bake_shadow_slab, make_light_plane
from warp_psf.area_light.templates import SHAPES
from warp_psf.scene.light import rectangle_light
from warp_psf.scene.still import StillScene

# A file beyond this is no script, and so many frames last nine hours at 30 per second.
LARGEST_FILE, MOST_FRAMES = 10_000_000, 1_000_000
# What a light is until a step says otherwise.
DARK: dict[str, Any] = {"on": True, "shape": "square", "radiance": (1.0, 1.0, 1.0)}


@dataclass(frozen=True)
class Step:
    """What changes over some frames.

    Attributes:
        frames: over how many.
        camera: the viewpoint from then on; None leaves the one before.
        lights: for each light named, what it becomes.
    """

    frames: int
    camera: str | None
    lights: dict[str, dict[str, Any]]


@dataclass(frozen=True)
class Script:
    """A script as `read_script` reads it.

    Attributes:
        cameras: the viewpoints' names, of which the first one begins.
        lights: the plane of samples of each light, by its name.
        steps: what changes, and over how many frames, in order.
    """

    cameras: tuple[str, ...]
    lights: dict[str, LightPlane]
    steps: tuple[Step, ...]

    @property
    def frames(self) -> int:
        """How many frames it lasts."""
        return sum(step.frames for step in self.steps)


@dataclass(frozen=True, eq=False)
class SlabFrame:
    """A frame of a script.

    Attributes:
        color, attenuation, shadowless: linear, float32 [height, width, 3], as `SlabView.picture`,
            `SlabView.attenuation` and `SlabView.shadowless`.
        camera: its place among the script's cameras.
    """

    color: np.ndarray
    attenuation: np.ndarray
    shadowless: np.ndarray
    camera: int


def read_script(path: str | Path) -> Script:
    """Reads a script of changes of light: a JSON file, at most 10 MB.

    ```json
    {"cameras": ["front", "side"],
     "lights": {"lamp": {"position": [0, 0, 2], "target": [0, 0, 0],
                         "width": 1.2, "height": 1.2, "rows": 9, "columns": 9}},
     "steps": [{"lamp": {"shape": "square", "side": 0.4, "radiance": [90, 80, 70]}},
               {"frames": 24, "lamp": {"at": [0.5, 0.0]}},
               {"frames": 12, "camera": "side", "lamp": {"on": false}}]}
    ```

    A light is a rectangle, as of `warp_psf.rectangle_light`, of rows x columns samples. A step lasts some frames, one
    unless it says otherwise, and tells what changes: the camera, and of a light whether it is `on`, its `radiance`, its
    `shape` (square, line, ring or letters) and what that shape takes (`side`, `at`, `angle`, `radius`, `width`, `text`;
    see `warp_psf.area_light.templates`). Numbers go evenly from what they were to what the step says, over its frames;
    all else changes with its first frame and stays. A light is off until a step names it.

    Args:
        path: of the file.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no script; the message says where and how to mend it.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"script {str(path)!r} does not exist; give the path of a JSON file")
    if path.stat().st_size > LARGEST_FILE:
        raise ValueError(f"script {str(path)!r} has more than {LARGEST_FILE} bytes; split it")
    try:
        content = json.loads(path.read_text(encoding="utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"script {str(path)!r} is no JSON file: {error}") from error
    try:
        return _read(content)
    except ValueError as error:
        raise ValueError(f"script {str(path)!r}: {error}") from error


def play_script(
    script: Script,
    scene: StillScene,
    width: int = 513,
    height: int = 513,
    *,
    size: int = 513,
    device: str | None = None,
) -> Iterator[SlabFrame]:
    """The frames of a script, one after another. Slabs and scene maps are baked, and errors raised, before the first.

    Each has `color`, `attenuation` and `shadowless`, linear, float32 [height, width, 3], as `SlabView.picture`,
    `SlabView.attenuation` and `SlabView.shadowless`, and `camera`, the place of its camera among the script's.

    ```python
    A = psf.area_light
    script = A.read_script("script.json")
    scene = psf.freeze_scene(model, data, cameras=script.cameras)
    frames = A.play_script(script, scene, width=160, height=120, size=65)
    pictures = [frame.color for frame in frames]
    ```

    Args:
        script: of `read_script`.
        scene: with the script's cameras, in their order.
        width, height: of the pictures, pixels, 2 to 4096.
        size: samples along the side of a full shadow map, 2^n + 1, at most 4097.
        device: "cpu", "cuda:0", ...; None takes the first CUDA device, else the CPU.

    Raises:
        ValueError: the scene has another number of cameras, or a size is not usable.
        TypeError: `script` or `scene` is something else.
    """
    check_type("script", script, Script, "read_script")
    check_type("scene", scene, StillScene, "freeze_scene or make_still")
    if len(scene.cameras) != len(script.cameras):
        raise ValueError(
            f"the scene has {len(scene.cameras)} cameras, the script {len(script.cameras)}; freeze it with its"
        )
    # What is quick comes first, so that a picture that cannot be is refused at once.
    maps = [bake_scene_map(scene, camera, width, height, device=device) for camera in range(len(scene.cameras))]
    slabs = [bake_shadow_slab(scene, plane, size, device=device) for plane in script.lights.values()]
    views = [SlabView(scene_map, slabs, device=device) for scene_map in maps]
    names = list(script.lights)
    planes = list(script.lights.values())
    states: list[dict[str, Any]] = [dict(DARK, on=False) for _ in names]
    camera = 0
    for step in script.steps:
        camera = camera if step.camera is None else script.cameras.index(step.camera)
        before = [dict(state) for state in states]
        for frame in range(step.frames):
            share = (frame + 1) / step.frames
            for light, name in enumerate(names):
                if name in step.lights:
                    states[light] = _between(before[light], {"on": True} | step.lights[name], share)
                template = _template(states[light], planes[light])
                # Every viewpoint keeps its own attenuation map, and follows when it is looked through.
                views[camera].set_light(light, template)
            view = views[camera]
            yield SlabFrame(view.picture(), view.attenuation(), view.shadowless(), camera)


def _between(before: dict[str, Any], after: dict[str, Any], share: float) -> dict[str, Any]:
    """A light's state at a share of a step. Numbers that both have go evenly from one to the other."""
    state = before | after
    same_shape = after.get("shape", before["shape"]) == before["shape"] and before["on"]
    for name, value in after.items():
        numbers = name not in ("on", "shape", "text") and name in before
        if numbers and (same_shape or name == "radiance"):
            state[name] = tuple(np.atleast_1d((1 - share) * np.asarray(before[name]) + share * np.asarray(value)))
            if np.ndim(value) == 0:
                (state[name],) = state[name]
    return state


def _template(state: dict[str, Any], plane: LightPlane) -> np.ndarray:
    """Radiance of each sample, float32 [rows, columns, 3]."""
    shape = SHAPES[state["shape"]]
    takes = {name: state[name] for name in _takes(state["shape"]) if name in state}
    template = shape(plane.rows, plane.columns, **takes) if state["on"] else np.zeros((plane.rows, plane.columns))
    return (template[..., None] * np.asarray(state["radiance"])).astype(np.float32)


def _takes(shape: str) -> list[str]:
    """What a shape takes besides rows and columns."""
    return list(inspect.signature(SHAPES[shape]).parameters)[2:]


def _read(content: Any) -> Script:
    _check_keys(content, "the script", {"cameras", "lights", "steps"})
    cameras = content.get("cameras")
    if not isinstance(cameras, list) or not cameras or not all(isinstance(name, str) for name in cameras):
        raise ValueError('cameras must be a list of names, for example ["front"]')
    lights = content.get("lights")
    if not isinstance(lights, dict) or not lights or {"frames", "camera"} & set(lights):
        raise ValueError("lights must be an object of named planes, none of them called frames or camera")
    planes = {name: _read_plane(name, plane) for name, plane in lights.items()}
    steps = content.get("steps")
    if not isinstance(steps, list) or not steps:
        raise ValueError('steps must be a list, for example [{"frames": 1}]')
    script = Script(tuple(cameras), planes, tuple(_read_step(*each, cameras, planes) for each in enumerate(steps)))
    if script.frames > MOST_FRAMES:
        raise ValueError(f"its {brief(script.frames)} frames are more than {MOST_FRAMES}; shorten the steps")
    return script


def _read_plane(name: str, plane: Any) -> LightPlane:
    lengths = {"position": 3, "target": 3, "width": 1, "height": 1}
    known = {*lengths, "rows", "columns"}
    _check_keys(plane, f"light {name!r}", known)
    if known - set(plane):
        raise ValueError(f"light {name!r} lacks {', '.join(sorted(known - set(plane)))}")
    given = {key: _numbers(plane[key], count, f"light {name!r}: {key}") for key, count in lengths.items()}
    light = rectangle_light(name, radiance=(1.0, 1.0, 1.0), **given)
    try:
        return make_light_plane(light, plane["rows"], plane["columns"])
    except ValueError as error:
        raise ValueError(f"light {name!r}: {error}") from error


def _read_step(number: int, step: Any, cameras: list[str], planes: dict[str, LightPlane]) -> Step:
    owner = f"step {number + 1}"
    _check_keys(step, owner, {"frames", "camera", *planes})
    frames, camera = step.get("frames", 1), step.get("camera")
    if not isinstance(frames, int) or isinstance(frames, bool) or frames < 1:
        raise ValueError(f"{owner}: frames is {brief(frames)}; give a whole number of at least 1")
    if camera is not None and camera not in cameras:
        raise ValueError(f"{owner}: camera {brief(camera)} is not among {', '.join(cameras)}")
    lights = {name: _read_change(f"{owner}: {name}", step[name]) for name in planes if name in step}
    return Step(frames, camera, lights)


def _read_change(owner: str, change: Any) -> dict[str, Any]:
    sizes = {"side": 1, "angle": 1, "radius": 1, "width": 1, "at": 2, "radiance": 3}
    _check_keys(change, owner, {"on", "shape", "text", *sizes})
    read: dict[str, Any] = {}
    for name, value in change.items():
        if name == "on" and not isinstance(value, bool):
            raise ValueError(f"{owner}: on is {brief(value)}; give true or false")
        if name == "shape" and value not in list(SHAPES):
            raise ValueError(f"{owner}: shape {brief(value)} is unknown; choose {', '.join(SHAPES)}")
        if name == "text" and not (isinstance(value, str) and 0 < len(value.strip()) <= 64):
            raise ValueError(f"{owner}: text is {brief(value)}; give 1 to 64 letters")
        read[name] = _numbers(value, sizes[name], f"{owner}: {name}") if name in sizes else value
    if min(np.atleast_1d(read.get("radiance", 0.0))) < 0.0:
        raise ValueError(f"{owner}: radiance is below 0; give numbers of at least 0")
    return read


def _numbers(value: Any, count: int, owner: str) -> Any:
    """A number, or a tuple of `count` of them where count is more than 1."""
    given = [value] if count == 1 else value
    plain = isinstance(given, list) and len(given) == count
    if not plain or not all(type(each) in (int, float) and abs(each) <= 1e6 for each in given):
        wanted = "a number" if count == 1 else f"{count} numbers"
        raise ValueError(f"{owner} is {brief(value)}; give {wanted} within a million")
    return float(value) if count == 1 else tuple(map(float, value))


def _check_keys(value: Any, owner: str, known: set[str]) -> None:
    if not isinstance(value, dict):
        raise ValueError(f"{owner} is {brief(value)}; give an object in braces")
    unknown = sorted(set(value) - known)
    if unknown:
        raise ValueError(f"{owner} has {brief(unknown[0])}, which is unknown; it may have {', '.join(sorted(known))}")
