"""Starting Warp says nothing on stderr, whatever that is, and leaves it as it was."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from warp_psf import device


def test_what_c_code_says_about_drivers_is_kept_back_and_what_comes_after_is_not(capfd, monkeypatch):
    monkeypatch.setattr(device, "_has_cuda_driver", lambda: False)
    with device._without_driver_warning():
        os.write(2, b"no driver")
    os.write(2, b"after")
    assert capfd.readouterr().err == "after"


def test_where_there_is_a_driver_its_warnings_are_heard(capfd, monkeypatch):
    monkeypatch.setattr(device, "_has_cuda_driver", lambda: True)
    with device._without_driver_warning():
        os.write(2, b"driver too old")
    assert capfd.readouterr().err == "driver too old"


def test_stderr_comes_back_after_an_error(capfd, monkeypatch):
    monkeypatch.setattr(device, "_has_cuda_driver", lambda: False)
    with pytest.raises(RuntimeError, match="no start"), device._without_driver_warning():
        raise RuntimeError("no start")
    os.write(2, b"after")
    assert capfd.readouterr().err == "after"


def test_a_process_without_stderr_starts():
    """As services do: file descriptor 2 is closed."""
    script = "import os; os.close(2); from warp_psf.device import find_device; print(find_device('cpu'))"
    ended = subprocess.run([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True, timeout=120)
    assert (ended.returncode, ended.stdout.strip()) == (0, "cpu")


def test_without_a_descriptor_to_keep_nothing_is_turned_away(monkeypatch):
    def closed(descriptor: int) -> int:
        raise OSError(9, "Bad file descriptor")

    monkeypatch.setattr(device, "_has_cuda_driver", lambda: False)
    monkeypatch.setattr(os, "dup", closed)
    entered = False
    with device._without_driver_warning():
        entered = True
    assert entered
