"""Frame sequences: a folder of frames that a killed run can be continued in, and the film made of them."""

from __future__ import annotations

import json
import os
import queue
import re
import threading
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from warp_psf.film.display import to_display
from warp_psf.film.writer import (
    contact_sheet,
    frame_rate,
    read_exr,
    read_png,
    replacing,
    sheet_indices,
    write_error,
    write_exr,
    write_png,
    write_video,
)

try:
    import fcntl
except ImportError:  # Windows has no advisory locks: there, two runs in one folder are not noticed.
    fcntl = None

FORMATS = ("exr", "png", "mp4")

SETTINGS = "settings.json"
FILM = "film.mp4"
SHEET = "contact_sheet.png"
LOCK = ".warp_psf.lock"
# PNG frames of a film for which neither EXR nor PNG was asked; removed when the film is finished.
HIDDEN = ".frames"

# Marks a settings file as ours; the number changes when folders of this edition could no longer be continued.
FOLDER_MARK = "warp_psf frames"
FOLDER_FORMAT = f"{FOLDER_MARK} 1"

FRAME_NAME = re.compile(r"frame_\d{4,}\.(exr|png)")
TEMPORARY_NAME = re.compile(r"\.(frame_\d{4,}\.(exr|png)|film\.mp4|contact_sheet\.png|settings\.json)\.\d+\.tmp")

# Frames that wait for the writer: one being written, and enough that a slow disk does not stop the renderer at once.
QUEUE_LENGTH = 2


class FrameSequence:
    """Writes the frames of a sequence into a folder, in the background, and the film at the end.

    ```python
    settings = {"model": "model.xml", "bounces": 1}
    film = psf.FrameSequence("film", settings, frames=range(6), frames_per_second=24)
    with film as sequence, psf.Renderer(model, 60, 80, bounces=1) as renderer:
        for index in sequence.frames:
            if sequence.missing(index):
                renderer.update_scene(data, camera="front")
                image, layers = renderer.render(), renderer.layers()
                sequence.write(index, layers, image, renderer.world_from_camera)
            mujoco.mj_step(model, data)
        sequence.finish()
    ```

    Every file is whole under its name or not there, so a run that was killed is continued by the same lines. Entering
    creates the folder, takes its lock and clears what a dead run left; leaving waits for the frames that were handed
    over, also after an error or Ctrl-C. The attributes `folder` and `frames` are as given.

    Args:
        folder: its frames are frame_0000.exr and .png, beside film.mp4, contact_sheet.png and settings.json.
        settings: plain values (numbers, text, lists, None) that decide how a frame looks. They are kept in the folder,
            and a run with others is refused; the range of frames and the formats may change. `exposure` and `view`
            among them are used when the film is made from EXR frames.
        frames: the indices of the film, not negative.
        frames_per_second: from 0.01 to 1000; kept with the settings.
        formats: some of "exr", "png", "mp4". The contact sheet is always made. With "mp4" alone the frames are kept
            only until the film is finished.
        overwrite: removes what a former sequence wrote into the folder, and nothing else.

    Raises:
        ValueError: bad arguments; on entering, settings that differ or files in the way.
        OSError: on entering, the folder cannot be written or another process writes into it.
    """

    def __init__(
        self,
        folder: str | Path,
        settings: dict[str, Any],
        *,
        frames: range,
        frames_per_second: float | Fraction,
        formats: tuple[str, ...] = FORMATS,
        overwrite: bool = False,
    ) -> None:
        unknown = sorted(set(formats) - set(FORMATS))
        if unknown or not formats:
            raise ValueError(f"formats {list(formats)} must be some of {', '.join(FORMATS)}")
        if len(frames) == 0 or min(frames) < 0:
            raise ValueError(f"frames {frames} must hold at least one index and none below 0")
        self.folder = Path(folder)
        self.frames = frames
        self._rate = frame_rate(frames_per_second)
        self._formats = frozenset(formats)
        self._overwrite = overwrite
        self._settings = _plain_settings(settings, float(frames_per_second))
        self._display = {key: settings[key] for key in ("exposure", "view") if key in settings}
        to_display(np.zeros((1, 1, 3), np.float32), **self._display)  # a view that is not known is refused now
        self._lock: int | None = None
        self._writer: threading.Thread | None = None
        # The semaphore is the bound, not the queue: the end must go in without waiting, however leaving is interrupted.
        self._waiting: queue.Queue = queue.Queue()
        self._free_places = threading.Semaphore(QUEUE_LENGTH)
        self._failure: BaseException | None = None

    def __enter__(self) -> FrameSequence:
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise write_error(self.folder, error) from error
        self._lock = _take_lock(self.folder / LOCK)
        try:
            self._prepare_folder()
        except BaseException as error:
            _give_lock(self.folder / LOCK, self._lock)
            if isinstance(error, OSError):
                raise write_error(self.folder, error) from error
            raise
        self._writer = threading.Thread(target=self._write_waiting, name="warp_psf frame writer")
        self._writer.start()
        return self

    def __exit__(self, kind, error, trace) -> None:
        writer, self._writer = self._writer, None
        self._waiting.put(None)
        if writer is not None:
            writer.join()
        if kind is None:
            self._raise_failure()

    def missing(self, index: int) -> bool:
        """Whether frame `index` needs rendering: one of its files is not on the disk, or is empty.

        Raises:
            ValueError: the index is not of this sequence.
        """
        return any(not _is_complete(path) for path in self._frame_paths(index))

    def write(
        self, index: int, layers: dict[str, np.ndarray], image: np.ndarray, world_from_camera: np.ndarray | None
    ) -> None:
        """Hands a frame over to be written; its files that exist already are left as they are.

        Args:
            index: of the frame.
            layers: for the EXR file, as `Renderer.layers` returns them: float [height, width] or [height, width, 3],
                without NaN, and `segmentation`, integers [height, width, 2]. They are copied: the caller may reuse
                them.
            image: for the PNG file, of which the film is made if there is one, uint8 [height, width, 3]; copied, too.
            world_from_camera: the camera's pose [4, 4], for the EXR file, or None.

        Raises:
            ValueError: the index is not of this sequence, the sequence is not open, or an earlier frame was not usable.
            OSError: an earlier frame could not be written.
        """
        if self._writer is None:
            raise ValueError("the sequence is not open: use it in a with statement")
        self._raise_failure()
        paths = [path for path in self._frame_paths(index) if not _is_complete(path)]
        suffixes = {path.suffix for path in paths}
        kept_layers = {name: layer.copy() for name, layer in layers.items()} if ".exr" in suffixes else {}
        kept_image = image.copy() if ".png" in suffixes else image
        kept_pose = None if world_from_camera is None else np.array(world_from_camera)
        self._free_places.acquire()
        self._waiting.put((paths, kept_layers, kept_image, kept_pose))

    def finish(self) -> None:
        """Waits for the frames and makes film.mp4 (where asked for) and contact_sheet.png from the files on the disk.

        Raises:
            ValueError: frames are missing, damaged or were not usable.
            OSError: frames or the film could not be written.
        """
        self._waiting.join()
        self._raise_failure()
        absent = [index for index in self.frames if self.missing(index)]
        if absent:
            raise ValueError(
                f"{len(absent)} of {len(self.frames)} frames are not in {self.folder}, the first is {absent[0]}: "
                "render them before the film is finished"
            )
        if "mp4" in self._formats:
            pictures = (self._read_picture(index) for index in self.frames)
            write_video(self.folder / FILM, pictures, self._rate)
        chosen = [self.frames[place] for place in sheet_indices(len(self.frames))]
        write_png(self.folder / SHEET, contact_sheet([self._read_picture(index) for index in chosen]))
        _remove_hidden(self.folder)

    def _frame_paths(self, index: int) -> list[Path]:
        """The files that this frame consists of."""
        if index not in self.frames:
            raise ValueError(f"frame {index} is not one of {self.frames}: widen the range")
        name = f"frame_{index:04d}"
        paths = [self.folder / f"{name}.{kind}" for kind in ("exr", "png") if kind in self._formats]
        return paths or [self.folder / HIDDEN / f"{name}.png"]

    def _read_picture(self, index: int) -> np.ndarray:
        path = self._frame_paths(index)[-1]
        try:
            if path.suffix == ".png":
                return read_png(path)
            return to_display(read_exr(path)["color"], **self._display)
        except ValueError as error:
            # A frame that is there is not rendered again: somebody must remove it first.
            raise ValueError(f"{path} is damaged: remove it and run again") from error

    def _write_waiting(self) -> None:
        """The writer thread. After a failure it takes frames without writing them, so that nobody waits for it.

        It gives the lock back itself: the folder is in use until its last file is there, also when Ctrl-C cuts short
        the waiting for it.
        """
        while (frame := self._waiting.get()) is not None:
            try:
                if self._failure is None:
                    self._write_frame(*frame)
            except BaseException as error:
                self._failure = error
            finally:
                self._free_places.release()
                self._waiting.task_done()
        _give_lock(self.folder / LOCK, self._lock)

    def _write_frame(self, paths: list[Path], layers: dict, image: np.ndarray, pose: np.ndarray | None) -> None:
        for path in paths:
            if path.suffix == ".exr":
                write_exr(path, layers, frames_per_second=self._rate, world_from_camera=pose)
            else:
                write_png(path, image)

    def _raise_failure(self) -> None:
        if self._failure is not None:
            raise self._failure

    def _prepare_folder(self) -> None:
        """Clears what dead runs left, and makes sure that the folder is of a sequence with these settings."""
        settings_path = self.folder / SETTINGS
        _remove_matching(self.folder, TEMPORARY_NAME)
        _remove_matching(self.folder / HIDDEN, TEMPORARY_NAME)
        if settings_path.exists():
            former = _read_settings(settings_path)
            if self._overwrite:
                _remove_sequence(self.folder)
            elif former != self._settings:
                raise ValueError(_describe_difference(self.folder, former, self._settings))
        else:
            ours = [path.name for path in sorted(self.folder.iterdir()) if _is_our_name(path.name)]
            if ours:
                raise ValueError(
                    f"{self.folder} holds {ours[0]} and no {SETTINGS} of a sequence: choose another folder, or move "
                    f"{'it' if len(ours) == 1 else f'these {len(ours)} files'} away"
                )
        if not settings_path.exists():
            with replacing(settings_path) as temporary:
                temporary.write_text(json.dumps(self._settings, indent=2) + "\n", encoding="utf-8")
        if self._formats == {"mp4"}:
            (self.folder / HIDDEN).mkdir(exist_ok=True)


def _is_complete(path: Path) -> bool:
    # Frames are renamed into place, so what exists is whole; an empty file is what a crashed file system leaves.
    try:
        return path.stat().st_size > 0
    except FileNotFoundError:
        return False


def _is_our_name(name: str) -> bool:
    return name in (FILM, SHEET, HIDDEN) or FRAME_NAME.fullmatch(name) is not None


def _remove_matching(folder: Path, pattern: re.Pattern) -> None:
    if folder.is_dir():
        for path in folder.iterdir():
            if pattern.fullmatch(path.name):
                path.unlink()


def _remove_hidden(folder: Path) -> None:
    hidden = folder / HIDDEN
    _remove_matching(hidden, FRAME_NAME)
    if hidden.is_dir() and not any(hidden.iterdir()):
        hidden.rmdir()


def _remove_sequence(folder: Path) -> None:
    _remove_matching(folder, FRAME_NAME)
    _remove_hidden(folder)
    (folder / FILM).unlink(missing_ok=True)
    (folder / SHEET).unlink(missing_ok=True)
    # Last, because without it the rest would no longer count as ours.
    (folder / SETTINGS).unlink()


def _plain_settings(settings: dict[str, Any], frames_per_second: float) -> dict[str, Any]:
    """What settings.json holds, as reading it back gives it."""
    for key, value in settings.items():
        try:
            json.dumps(value, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise ValueError(f"setting {key!r} cannot be kept as JSON ({error}): give plain numbers or text") from error
    return json.loads(
        json.dumps({"format": FOLDER_FORMAT, "frames_per_second": frames_per_second, "settings": settings})
    )


def _read_settings(path: Path) -> dict[str, Any]:
    try:
        former = json.loads(path.read_text(encoding="utf-8"))
    except ValueError:
        former = None
    if not isinstance(former, dict) or not str(former.get("format")).startswith(FOLDER_MARK):
        raise ValueError(f"{path} is not of a frame sequence: choose another folder")
    return former


def _describe_difference(folder: Path, former: dict[str, Any], current: dict[str, Any]) -> str:
    before, now = ({**kept, **kept.get("settings", {}), "settings": None} for kept in (former, current))
    differences = [
        f"{key} was {json.dumps(before[key]) if key in before else 'absent'} "
        f"and is {json.dumps(now[key]) if key in now else 'absent'}"
        for key in [*before, *(key for key in now if key not in before)]
        if key not in before or key not in now or before[key] != now[key]
    ]
    return (
        f"{folder} holds frames rendered with other settings ({'; '.join(differences)}): "
        "use --overwrite to replace them, or choose another folder"
    )


def _take_lock(path: Path) -> int | None:
    """Locks the folder for this process. The system frees the lock of a dead process, whatever became of its id.

    Raises:
        OSError: another process holds it; the message gives its id.
    """
    if fcntl is None:
        return None
    while True:
        try:
            handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        except OSError as error:
            raise write_error(path.parent, error) from error
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # The former holder may have removed the file between opening and locking: then this lock is of nothing.
            current = os.path.samestat(os.fstat(handle), path.stat())
        except FileNotFoundError:
            current = False
        except OSError as error:
            holder = os.read(handle, 32).decode(errors="replace") or "that is just starting"
            os.close(handle)
            if not isinstance(error, BlockingIOError):
                raise write_error(path, error) from error
            raise OSError(f"{path.parent} is being written by process {holder}: wait for it or end it") from error
        if current:
            os.ftruncate(handle, 0)
            os.write(handle, str(os.getpid()).encode())
            return handle
        os.close(handle)


def _give_lock(path: Path, handle: int | None) -> None:
    if handle is not None:
        path.unlink(missing_ok=True)
        os.close(handle)
