"""Devices: which one a renderer uses, and how a launch reaches all of its cores."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import cache
from threading import Lock

import warp as wp

# Each core gets this many pieces of a launch, so that a core with cheap pieces can take over another's.
PIECES_PER_CORE = 8
# A piece smaller than this costs more to hand over (about 10 microseconds) than it saves.
SMALLEST_PIECE = 64
# Per module, held while it is loaded: where two threads load one, the code of the first goes away while it runs.
_LOADING: dict[wp.Module, Lock] = {}


def find_device(name: str | None = None) -> wp.Device:
    """The named device, or by default the first CUDA device, else the CPU.

    Raises:
        ValueError: there is no such device on this machine.
    """
    _quiet_start()
    if name is None:
        return wp.get_device("cuda:0" if wp.get_cuda_device_count() else "cpu")
    try:
        return wp.get_device(name)
    except (ValueError, RuntimeError) as error:
        present = ", ".join(str(device) for device in wp.get_devices())
        raise ValueError(f"device {name!r} is not on this machine; choose one of: {present}") from error


def launch(kernel, dim: tuple[int, int], inputs: Sequence, outputs: Sequence, device: wp.Device) -> None:
    """Runs `kernel` over `dim` = (worlds, items), on every core of a CPU or as one launch on CUDA.

    A CPU launch runs on one core and releases the interpreter's lock, so the items are cut into pieces, and the caller
    and a thread for each other core launch one after another until none is left. Every kernel's first parameter is
    therefore `first`, the item at which its piece begins:

        world, item = wp.tid()
        item += first
    """
    worlds, items = dim
    if worlds == 0 or items == 0:
        return
    arguments = [0, *inputs, *outputs]
    if device.is_cuda:
        wp.launch(kernel, dim=dim, inputs=arguments, device=device, record_tape=False)
        return
    pieces = min(core_count() * PIECES_PER_CORE, max(1, items // SMALLEST_PIECE))
    left = iter(range(pieces))

    def record() -> wp.Launch:
        return wp.launch(kernel, dim=dim, inputs=arguments, device=device, record_cmd=True)

    def launch_pieces(command: wp.Launch | None = None) -> None:
        # The arguments are packed once for all pieces of a core.
        command = command or record()
        for piece in left:
            first, end = items * piece // pieces, items * (piece + 1) // pieces
            command.set_dim((worlds, end - first))
            command.set_param_at_index(0, first)
            command.launch()

    with _LOADING.setdefault(kernel.module, Lock()):
        command = record()
    if pieces == 1:
        command.launch()
        return
    others = [_workers().submit(launch_pieces) for _ in range(min(core_count(), pieces) - 1)]
    try:
        launch_pieces(command)
    finally:
        # Who has not begun finds nothing left.
        begun = [other for other in others if not other.cancel()]
        wait(begun)
    for other in begun:
        other.result()


def upload_tables(tables: Sequence, dtype: type, device: wp.Device) -> wp.array:
    """Structs of the type `dtype` as an array on the device, which keeps the arrays that they hold alive.

    A device function copies a struct that it is given with every array in it, kilobytes for each call. Of an array of
    one struct it copies a pointer.
    """
    array = wp.array(list(tables), dtype=dtype, device=device)
    array.tables = tuple(tables)
    return array


def core_count() -> int:
    """The CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@cache
def _workers() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max_workers=core_count(), thread_name_prefix="warp_psf")


if hasattr(os, "register_at_fork"):
    # A forked process has none of its parent's threads, so it must not wait for them.
    os.register_at_fork(after_in_child=_workers.cache_clear)


@cache
def _quiet_start() -> None:
    # Warp's banner, its compilation notes and its wish for a CUDA driver are not this library's output. Who chose a
    # level keeps it.
    if wp.config.log_level == wp.LOG_INFO:
        wp.config.log_level = wp.LOG_WARNING
    with _without_driver_warning():
        wp.init()


@contextmanager
def _without_driver_warning() -> Iterator[None]:
    """Keeps back Warp's warning that there is no CUDA driver, on machines that have none and need none.

    The warning is written by C code, past Python's stderr; only the file descriptor can be turned away.
    """
    if _has_cuda_driver():
        yield
        return
    sys.stderr.flush()
    try:
        kept = os.dup(2)
    except OSError:  # a process without stderr has nothing to keep clean
        yield
        return
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def _has_cuda_driver() -> bool:
    for library in ("libcuda.so.1", "nvcuda.dll"):
        try:
            ctypes.CDLL(library)
        except OSError:
            continue
        return True
    return False
