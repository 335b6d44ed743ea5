"""How a model moves: stepped from its start or a keyframe, under recorded controls, or as recorded positions say."""

from __future__ import annotations

import itertools
import math
import os
import zipfile
import zlib
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import mujoco
import numpy as np

# What a row holds, and the number of MjModel that says how many columns it has.
KINDS = {"qpos": "nq", "ctrl": "nu"}
# An hour of a humanoid at 500 steps per second has 400 MB; a file that promises more is damaged or not meant for this.
MOST_BYTES = 2**30
# Characters: a row of ten thousand numbers has a quarter of that.
LONGEST_LINE = 2**20
# Seconds, thirty years: a recording of more has its time in another unit.
LONGEST = 1e9
# A frame within this part of a frame's duration after the last row still shows that row: 2.3 s are 69 frames at 30 per
# second, although 2.3 * 30 is less than 69 in floating point.
FRAME_TOLERANCE = 1e-6
# Counted by MuJoCo when it has found numbers that are not finite or too large, after which it starts anew.
DIVERGED = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)
# A message lists at most this many names.
MOST_NAMES = 20


@dataclass(frozen=True, eq=False)
class Recording:
    """Rows of numbers over time.

    name: the file's name. kind: "qpos" or "ctrl".
    time: of each row, seconds from the first, increasing, float64 [rows].
    rows: joint positions or controls, float64 [rows, nq or nu].
    """

    name: str
    kind: str
    time: np.ndarray
    rows: np.ndarray

    def frame_count(self, frames_per_second: float) -> int:
        """How many frames lie between the first row and the last, both included."""
        return math.floor(float(self.time[-1]) * frames_per_second + FRAME_TOLERANCE) + 1


def read_recording(path: str | os.PathLike, kind: str, model: mujoco.MjModel) -> Recording:
    """A recording for `model` from an NPZ or a CSV file.

    An NPZ file holds an array of the name `kind`, [rows, nq or nu], and perhaps `time` [rows], seconds, or `fps`, rows
    per second. A CSV file holds a row of numbers per line; a header may name its columns, and then one of them may be
    `time`. Where nothing tells the time, rows are a timestep of the model apart.

    Args:
        kind: "qpos" or "ctrl".

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no such file, it does not fit the model, a number is not finite, or time does not increase.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"--{kind} {str(path)!r} does not exist; give the path of an .npz or .csv file")
    if path.stat().st_size > MOST_BYTES:
        raise ValueError(f"--{kind} {path} has more than {MOST_BYTES:,} bytes; cut the recording into parts")
    suffix = path.suffix.lower()
    if suffix not in (".npz", ".csv"):
        raise ValueError(f"--{kind} {path} is neither an .npz nor a .csv file; save the recording as one of them")
    columns = getattr(model, KINDS[kind])
    if columns == 0:
        raise ValueError(f"--{kind} {path}: the model has {KINDS[kind]} = 0, so that there is nothing to replay")
    try:
        rows, time = (_read_npz if suffix == ".npz" else _read_csv)(path, kind, columns)
        if time is None:
            time = model.opt.timestep * np.arange(len(rows))
        _check_numbers(rows, time, kind)
    except ValueError as error:
        raise ValueError(f"--{kind} {path}: {error}") from error
    return Recording(path.name, kind, time - time[0], rows)


def find_keyframe(model: mujoco.MjModel, chosen: str) -> int:
    """The number of the keyframe of that name or, where none has it, of that number.

    Raises:
        ValueError: there is no such keyframe; the message lists those that there are.
    """
    index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, chosen)
    if index >= 0:
        return index
    if chosen.isdecimal() and int(chosen) < model.nkey:
        return int(chosen)
    if model.nkey == 0:
        raise ValueError(f"--keyframe {chosen}: the model has no keyframes; leave the option out")
    names = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_KEY, key) or "" for key in range(model.nkey)]
    listed = ", ".join(f"{key} {name}".strip() for key, name in enumerate(names[:MOST_NAMES]))
    more = ", ..." if model.nkey > MOST_NAMES else ""
    raise ValueError(f"--keyframe {chosen} is not in the model; choose one of {listed}{more}")


def simulate(
    model: mujoco.MjModel, frames_per_second: float, *, keyframe: int | None = None, controls: Recording | None = None
) -> Iterator[mujoco.MjData]:
    """The states of a simulation, frame after frame without end.

    Yields the same `MjData` every time, stepped on; frame 0 is the start: the keyframe, or the model's own. Simulated
    time follows the frames' to the nearest step. Each row of `controls` holds from the step nearest to its time until
    the next one does, and the last one holds on.

    Raises:
        ValueError: the simulation diverges; MuJoCo starts it anew then, which no film should show.
    """
    data = _start(model, keyframe)
    first_steps = None if controls is None else np.rint(controls.time / model.opt.timestep)
    steps = 0
    for frame in itertools.count():
        target = round(frame / frames_per_second / model.opt.timestep)
        for step in range(steps, target):
            if controls is not None and first_steps is not None:
                data.ctrl[:] = controls.rows[np.searchsorted(first_steps, step, side="right") - 1]
            before = data.time
            mujoco.mj_step(model, data)
            if any(data.warning[int(kind)].number for kind in DIVERGED):
                raise ValueError(
                    f"the simulation diverged at {before:g} s: end before it with --duration or --frames, or give the "
                    "model a shorter timestep or softer contacts"
                )
        steps = target
        # A step leaves the poses of bodies and geoms one step behind the joints.
        mujoco.mj_forward(model, data)
        yield data


def replay(
    model: mujoco.MjModel, frames_per_second: float, *, positions: Recording, keyframe: int | None = None
) -> Iterator[mujoco.MjData]:
    """The states of a recording of qpos, frame after frame to its end.

    Between two rows, joints move evenly and quaternions turn evenly the short way; at a row they are the row's own.
    Yields the same `MjData` every time. What is not in qpos, such as mocap bodies, stays as in the keyframe or as the
    model has it.
    """
    data = _start(model, keyframe)
    between = np.zeros(model.nv)
    for frame in range(positions.frame_count(frames_per_second)):
        now = min(frame / frames_per_second, float(positions.time[-1]))
        row = int(np.searchsorted(positions.time, now, side="right")) - 1
        data.qpos[:] = positions.rows[row]
        if now > positions.time[row]:
            last, following = positions.rows[row].copy(), positions.rows[row + 1].copy()
            for qpos in (last, following):
                mujoco.mj_normalizeQuat(model, qpos)
            mujoco.mj_differentiatePos(model, between, 1.0, last, following)
            share = (now - positions.time[row]) / (positions.time[row + 1] - positions.time[row])
            mujoco.mj_integratePos(model, last, between, share)
            data.qpos[:] = last
        data.time = frame / frames_per_second
        mujoco.mj_forward(model, data)
        yield data


def _start(model: mujoco.MjModel, keyframe: int | None) -> mujoco.MjData:
    data = mujoco.MjData(model)
    if keyframe is not None:
        mujoco.mj_resetDataKeyframe(model, data, keyframe)
    return data


def _check_numbers(rows: np.ndarray, time: np.ndarray, kind: str) -> None:
    if time.shape != (len(rows),):
        raise ValueError(f"time has the shape {list(time.shape)}; give one number for each of the {len(rows)} rows")
    for name, values in (("time", time[:, None]), (kind, rows)):
        broken = ~np.isfinite(values).all(axis=1)
        if broken.any():
            raise ValueError(f"{name} is not finite in row {int(broken.argmax())} (the first is row 0)")
    backwards = time[1:] <= time[:-1]
    if backwards.any():
        raise ValueError(f"time does not increase at row {int(backwards.argmax()) + 1} (the first is row 0)")
    # Halved, because the difference of two large numbers need not be finite.
    if time[-1] / 2 - time[0] / 2 > LONGEST / 2:
        raise ValueError(f"time goes on for more than {LONGEST:g} seconds; give it in seconds")


# Files: neither is trusted. What a file promises is compared with what is there before room is made for it.


def _read_npz(path: Path, kind: str, columns: int) -> tuple[np.ndarray, np.ndarray | None]:
    try:
        with zipfile.ZipFile(path) as archive:
            members = {entry.filename.removesuffix(".npy"): entry for entry in archive.infolist()}
            if kind not in members:
                raise ValueError(
                    f"it holds no array {kind!r} (but {', '.join(sorted(members)[:MOST_NAMES]) or 'none'})"
                )
            arrays = {
                name: _read_array(name, archive, members[name]) for name in (kind, "time", "fps") if name in members
            }
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError, zlib.error) as error:
        raise ValueError(f"it is no NPZ file that can be read ({error})") from error
    rows = arrays[kind]
    if rows.ndim != 2 or len(rows) == 0 or rows.shape[1] != columns:
        raise ValueError(
            f"{kind} has the shape {list(rows.shape)}; the model has {KINDS[kind]} = {columns}: give [rows, {columns}]"
        )
    if "time" in arrays:
        return rows, arrays["time"]
    if "fps" not in arrays:
        return rows, None
    rate = arrays["fps"]
    if rate.size != 1 or not (np.isfinite(rate) & (rate > 0)).all():
        raise ValueError("fps must be one positive number of rows per second")
    return rows, np.arange(len(rows)) / float(rate.reshape(()))


def _read_array(name: str, archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> np.ndarray:
    """An array of numbers as float64, read without unpickling."""
    if entry.file_size > MOST_BYTES:
        raise ValueError(f"array {name!r} has more than {MOST_BYTES:,} bytes; cut the recording into parts")
    # The two ways in which NumPy writes; the others may unpack to far more than they promise.
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"array {name!r} is packed in a way that NumPy does not use; save it with numpy.savez")
    content = BytesIO(archive.read(entry))
    headers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    version = np.lib.format.read_magic(content)
    if version not in headers:
        raise ValueError(f"array {name!r} has the unknown format {version}")
    shape, by_columns, dtype = headers[version](content)
    if dtype.kind not in "fiu":
        raise ValueError(f"array {name!r} holds {dtype}; give numbers")
    numbers = content.read()
    if math.prod(shape) * dtype.itemsize != len(numbers):
        raise ValueError(f"array {name!r} promises the shape {list(shape)}, which is not what it holds")
    return np.frombuffer(numbers, dtype).reshape(shape, order="F" if by_columns else "C").astype(np.float64)


def _read_csv(path: Path, kind: str, columns: int) -> tuple[np.ndarray, np.ndarray | None]:
    titles: list[str] | None = None
    numbers = array("d")
    # A spreadsheet marks its files with a byte-order mark, NumPy its headers with a "#".
    with path.open(encoding="utf-8-sig") as file:
        for number, line in enumerate(iter(lambda: file.readline(LONGEST_LINE), ""), 1):
            if len(line) == LONGEST_LINE:
                raise ValueError(f"line {number} has more than {LONGEST_LINE:,} characters")
            cells = [cell.strip().strip('"') for cell in line.strip().lstrip("#").split(",")]
            if cells == [""]:
                continue
            try:
                values = [float(cell) for cell in cells]
            except ValueError:
                if titles is not None or numbers:
                    raise ValueError(f"line {number} is not made of numbers and commas") from None
                titles = [cell.lower() for cell in cells]
                continue
            _check_cells(values, titles, number, kind, columns)
            numbers.extend(values)
    if not numbers:
        raise ValueError(f"it holds no rows; the model has {KINDS[kind]} = {columns}")
    timed = titles is not None and "time" in titles
    table = np.array(numbers).reshape(-1, columns + timed)
    if titles is None or not timed:
        return table, None
    clock = titles.index("time")
    return np.delete(table, clock, axis=1), table[:, clock]


def _check_cells(values: list[float], titles: list[str] | None, number: int, kind: str, columns: int) -> None:
    timed = titles is not None and "time" in titles
    if titles is not None and len(values) != len(titles):
        raise ValueError(f"line {number} has {len(values)} columns and the header {len(titles)}")
    if len(values) != columns + timed:
        raise ValueError(
            f"line {number} has {len(values)} columns; the model has {KINDS[kind]} = {columns}: "
            f"give {columns} columns, or one more that a header names 'time'"
        )
