"""Files that cannot be read or written: one sentence that names them, and nothing lost."""

from __future__ import annotations

import errno
import fcntl
import io
import os
import zipfile
from pathlib import Path

import mujoco
import numpy as np
import OpenEXR
import pytest

from tests.test_sequence import contents, make, render, run
from warp_psf import motion
from warp_psf.area_light import script
from warp_psf.field import store
from warp_psf.film import sequence as sequence_module
from warp_psf.film.sequence import LOCK, SETTINGS
from warp_psf.film.writer import read_exr, read_png, write_error, write_png

# Pictures


def test_a_png_that_is_not_there_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"gone\.png is not there"):
        read_png(tmp_path / "gone.png")


@pytest.mark.parametrize(
    ("number", "remedy"),
    [
        (errno.ENOENT, "create its folder first"),
        (errno.ENOTDIR, "move away what is in its place"),
        (errno.EROFS, "a folder that you may write to"),
        (errno.EACCES, "a folder that you may write to"),
        (errno.ENOSPC, "free some space there"),
    ],
)
def test_each_failure_to_write_has_its_remedy(number, remedy):
    told = str(write_error(Path("out/film.mp4"), OSError(number, os.strerror(number))))
    assert told.startswith("out/film.mp4 could not be written") and os.strerror(number) in told and remedy in told


def test_a_failure_told_twice_is_told_once():
    sentence = write_error(Path("film.mp4"), OSError(errno.ENOSPC, "No space left on device"))
    assert write_error(Path("folder"), sentence) is sentence


def test_an_exr_of_reduced_resolution_is_refused(tmp_path):
    path = tmp_path / "chroma.exr"
    window = np.array([0, 0], np.int32), np.array([5, 3], np.int32)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "dataWindow": window}
    with OpenEXR.File(header, {"Y": OpenEXR.Channel(np.zeros((2, 3), np.float16), 2, 2)}) as file:
        file.write(str(path))
    with pytest.raises(ValueError, match=r"chroma\.exr has channels at reduced resolution"):
        read_exr(path)


def test_a_deep_exr_is_refused(tmp_path):
    path = tmp_path / "deep.exr"
    samples = np.empty((2, 3), dtype=object)
    for place in np.ndindex(samples.shape):
        samples[place] = np.zeros(1, np.float32)
    header = {"compression": OpenEXR.ZIPS_COMPRESSION, "type": OpenEXR.deepscanline}
    with OpenEXR.File(header, {"Z": OpenEXR.Channel(samples)}) as file:
        file.write(str(path))
    with pytest.raises(ValueError, match=r"deep\.exr is a deep image"):
        read_exr(path)


# Frame sequences


def test_a_settings_file_that_is_no_json_is_left_alone(tmp_path):
    (tmp_path / SETTINGS).write_text("colour = blue")
    with pytest.raises(ValueError, match="is not of a frame sequence"), make(tmp_path):
        pass
    assert contents(tmp_path) == {SETTINGS: b"colour = blue"}


@pytest.mark.parametrize("name", [LOCK, SETTINGS])
def test_a_folder_in_the_place_of_a_file_is_named(tmp_path, name):
    (tmp_path / name).mkdir()
    with pytest.raises(OSError, match="could not be written") as caught, make(tmp_path):
        pass
    assert str(tmp_path) in str(caught.value) and "move away what is in its place" in str(caught.value)
    assert (tmp_path / name).is_dir()


def test_a_file_system_without_locks_says_so(tmp_path, monkeypatch):
    def refuse(handle: int, kind: int) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(sequence_module.fcntl, "flock", refuse)
    with pytest.raises(OSError, match=os.strerror(errno.ENOLCK)), make(tmp_path):
        pass


def test_a_lock_taken_while_its_file_is_removed_is_taken_again(tmp_path, monkeypatch):
    """The former holder removes its file between our opening and our locking: that lock keeps nobody out."""
    taken = []
    lock = fcntl.flock

    def lock_late(handle: int, kind: int) -> None:
        if not taken:
            (tmp_path / LOCK).unlink()
        elif len(taken) == 1:
            # Removed, and another process's in its place.
            (tmp_path / LOCK).unlink()
            (tmp_path / LOCK).touch()
        taken.append(handle)
        lock(handle, kind)

    monkeypatch.setattr(sequence_module.fcntl, "flock", lock_late)
    with make(tmp_path) as sequence:
        assert len(taken) == 3
        assert (tmp_path / LOCK).read_text() == str(os.getpid())
        with pytest.raises(OSError, match=f"is being written by process {os.getpid()}"), make(tmp_path):
            pass
        sequence.write(0, *render(0))
    assert not (tmp_path / LOCK).exists()
    assert run(tmp_path) == [1, 2, 3, 4, 5]


# What is too large


def test_a_field_too_large_to_be_read_is_not_kept(tmp_path, monkeypatch):
    monkeypatch.setenv("WARP_PSF_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(store, "_MOST_BYTES", 1000)
    store.save_arrays("large", {"codes": np.zeros(2000, np.uint8)})
    assert not (tmp_path / "cache").exists()
    store.save_arrays("small", {"codes": np.zeros(200, np.uint8)})
    assert store.load_arrays("small") is not None


def test_a_script_too_large_is_not_read(tmp_path, monkeypatch):
    monkeypatch.setattr(script, "LARGEST_FILE", 100)
    (tmp_path / "long.json").write_text(" " * 101)
    with pytest.raises(ValueError, match=r"long\.json' has more than 100 bytes; split it"):
        script.read_script(tmp_path / "long.json")


@pytest.fixture
def two_joints() -> mujoco.MjModel:
    body = '<body><joint/><geom size=".1"/><body pos="1 0 0"><joint/><geom size=".1"/></body></body>'
    return mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{body}</worldbody></mujoco>")


@pytest.mark.parametrize("most", [100, 1000])
def test_a_recording_too_large_is_not_read(tmp_path, monkeypatch, two_joints, most):
    """By its size on the disk, or by what its arrays would take: zeros are packed a thousandfold."""
    path = tmp_path / "long.npz"
    np.savez_compressed(path, qpos=np.zeros((500, 2)))
    assert 100 < path.stat().st_size < 1000 < 500 * 2 * 8
    monkeypatch.setattr(motion, "MOST_BYTES", most)
    with pytest.raises(ValueError, match=f"has more than {most:,} bytes; cut the recording into parts"):
        motion.read_recording(path, "qpos", two_joints)


def test_an_array_of_a_later_format_is_named(tmp_path, two_joints):
    content = io.BytesIO()
    np.lib.format.write_array(content, np.zeros((3, 2)), version=(3, 0))
    with zipfile.ZipFile(tmp_path / "new.npz", "w") as archive:
        archive.writestr("qpos.npy", content.getvalue())
    with pytest.raises(ValueError, match=r"'qpos' has the unknown format \(3, 0\)"):
        motion.read_recording(tmp_path / "new.npz", "qpos", two_joints)


def test_write_png_leaves_nothing_behind_a_refusal(tmp_path):
    with pytest.raises(ValueError, match="uint8"):
        write_png(tmp_path / "bad.png", np.zeros((2, 2, 3)))
    assert list(tmp_path.iterdir()) == []
