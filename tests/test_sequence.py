"""Frame sequences: kill and resume, settings, foreign files, locks and failures of the writer."""

import json
import os
import subprocess
import sys
import threading
from pathlib import Path

import av
import numpy as np
import pytest

from warp_psf.film import sequence as sequence_module
from warp_psf.film.display import to_display
from warp_psf.film.sequence import FrameSequence
from warp_psf.film.writer import read_exr, read_png, write_png

SETTINGS = {"size": (64, 36), "exposure": 0.5, "view": "neutral", "camera": None}
COUNT = 6


def render(index):
    rows, columns = np.mgrid[0:36, 0:64].astype(np.float32)
    color = np.stack([rows + index, columns, rows + columns], axis=-1) / 100
    layers = {"color": color, "depth": rows + 1, "segmentation": np.full((36, 64, 2), index - 1, np.int32)}
    return layers, to_display(color, exposure=SETTINGS["exposure"]), np.eye(4)


def make(folder, settings=SETTINGS, count=COUNT, formats=("exr", "png", "mp4"), overwrite=False):
    return FrameSequence(
        folder, settings, frames=range(count), frames_per_second=24, formats=formats, overwrite=overwrite
    )


def run(folder, **arguments):
    """A whole run; returns the indices that it rendered."""
    rendered = []
    with make(folder, **arguments) as sequence:
        for index in sequence.frames:
            if sequence.missing(index):
                rendered.append(index)
                sequence.write(index, *render(index))
        sequence.finish()
    return rendered


def contents(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def start_and_kill(folder, formats):
    """Runs in a process of its own, which kills itself while frame 3 is being written, and leaves its temporary."""
    script = f"""
import os, signal, sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
import test_sequence
from warp_psf.film import sequence

def write_until_killed(path, image, write=sequence.write_png):
    if "frame_0003" not in path.name:
        return write(path, image)
    with sequence.replacing(path) as temporary:
        temporary.write_bytes(b"half a picture")
        os.kill(os.getpid(), signal.SIGKILL)

sequence.write_png = write_until_killed
test_sequence.run(sequence.Path({str(folder)!r}), formats={formats!r})
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=60)
    assert done.returncode == -9, done.stderr


@pytest.mark.parametrize("formats", [("exr", "png", "mp4"), ("mp4",)])
def test_killed_run_ends_with_the_same_files(tmp_path, formats):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    assert run(whole, formats=formats) == list(range(COUNT))
    start_and_kill(killed, formats)
    assert any(name.endswith(".tmp") for name in contents(killed))
    assert "film.mp4" not in contents(killed)

    kept = {path: path.stat().st_mtime_ns for path in killed.rglob("frame_000[012].*")}
    kept[killed / "settings.json"] = (killed / "settings.json").stat().st_mtime_ns
    assert run(killed, formats=formats) == [3, 4, 5]
    assert contents(killed) == contents(whole)
    for path, time in kept.items():
        assert not path.exists() or path.stat().st_mtime_ns == time
    expected = {"settings.json", "contact_sheet.png", "film.mp4"}
    if "png" in formats:
        expected |= {f"frame_{index:04d}.{kind}" for index in range(COUNT) for kind in ("exr", "png")}
    assert set(contents(killed)) == expected


def test_frames_hold_what_was_written(tmp_path):
    run(tmp_path)
    layers, image, _ = render(4)
    back = read_exr(tmp_path / "frame_0004.exr")
    np.testing.assert_array_equal(back["segmentation"], layers["segmentation"])
    np.testing.assert_array_equal(read_png(tmp_path / "frame_0004.png"), image)
    with av.open(str(tmp_path / "film.mp4")) as container:
        assert sum(1 for _ in container.decode(video=0)) == COUNT
    kept = json.loads((tmp_path / "settings.json").read_text())
    assert (kept["frames_per_second"], kept["settings"]["size"]) == (24.0, [64, 36])


def test_film_is_made_of_exr_where_there_are_no_pngs(tmp_path, monkeypatch):
    films = {}
    monkeypatch.setattr(sequence_module, "write_video", lambda path, images, rate: films.update({path: list(images)}))
    run(tmp_path, formats=("exr", "mp4"))
    half = read_exr(tmp_path / "frame_0002.exr")["color"]
    np.testing.assert_array_equal(films[tmp_path / "film.mp4"][2], to_display(half, exposure=0.5))


def test_range_and_formats_may_change(tmp_path):
    run(tmp_path, count=3, formats=("exr",))
    assert sorted(contents(tmp_path)) == [
        "contact_sheet.png",
        *(f"frame_000{i}.exr" for i in range(3)),
        "settings.json",
    ]
    times = {path: path.stat().st_mtime_ns for path in tmp_path.glob("*.exr")}
    assert run(tmp_path, count=4, formats=("exr", "png")) == [0, 1, 2, 3]
    assert all(path.stat().st_mtime_ns == time for path, time in times.items())
    assert run(tmp_path, count=2, formats=("exr", "mp4")) == []
    (tmp_path / "frame_0001.exr").write_bytes(b"")
    assert run(tmp_path, count=4, formats=("exr", "png")) == [1]


def test_other_settings_are_refused_by_name(tmp_path):
    run(tmp_path)
    before = contents(tmp_path)
    other = {"size": [128, 72], "view": "neutral", "camera": None, "order": 6, "exposure": 0.5}
    with pytest.raises(ValueError, match="--overwrite") as caught, make(tmp_path, settings=other):
        pass
    message = str(caught.value)
    assert "size was [64, 36] and is [128, 72]" in message
    assert "order was absent and is 6" in message
    assert "exposure was" not in message
    assert contents(tmp_path) == before
    slow = FrameSequence(tmp_path, SETTINGS, frames=range(2), frames_per_second=12)
    with pytest.raises(ValueError, match=r"frames_per_second was 24\.0 and is 12\.0"), slow:
        pass


def test_overwrite_removes_what_is_ours_and_nothing_else(tmp_path):
    run(tmp_path)
    foreign = ["notes.txt", "frame_1.png", "frame_0001.jpg", "my_frame_0001.png", ".frame_0001.png.tmp"]
    for name in foreign:
        (tmp_path / name).write_text("mine")
    (tmp_path / "more").mkdir()
    (tmp_path / "more" / "frame_0000.png").write_text("mine")
    with make(tmp_path, settings={"size": 1}, overwrite=True):
        assert set(contents(tmp_path)) == {*foreign, "more/frame_0000.png", "settings.json", sequence_module.LOCK}


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("name", ["frame_0007.png", "film.mp4", "contact_sheet.png", "settings.json"])
def test_foreign_files_in_the_way(tmp_path, name, overwrite):
    (tmp_path / name).write_text('{"mine": 1}')
    with pytest.raises(ValueError, match=f"{name}.*choose another folder"), make(tmp_path, overwrite=overwrite):
        pass
    assert contents(tmp_path) == {name: b'{"mine": 1}'}


def test_foreign_files_aside_are_left(tmp_path):
    (tmp_path / "model.xml").write_text("mine")
    run(tmp_path)
    assert (tmp_path / "model.xml").read_text() == "mine"


def test_two_runs_in_one_folder(tmp_path):
    with (
        make(tmp_path),
        pytest.raises(OSError, match=f"written by process {os.getpid()}"),
        make(tmp_path),
    ):
        pass
    # The lock of a dead process, even one whose id is in use again.
    (tmp_path / sequence_module.LOCK).write_text(str(os.getpid()))
    with make(tmp_path):
        pass
    assert not (tmp_path / sequence_module.LOCK).exists()


def test_folder_that_cannot_be_made(tmp_path):
    (tmp_path / "file").write_text("mine")
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(OSError, match=r"could not be written.*move away what is in its place"), make(folder):
            pass


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root may write everywhere")
def test_folder_without_permission(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(OSError, match="choose a folder that you may write to"), make(tmp_path):
        pass
    tmp_path.chmod(0o700)


def test_failure_of_the_writer_reaches_the_loop(tmp_path, monkeypatch):
    def fail(path, image):
        with sequence_module.replacing(path):
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(sequence_module, "write_png", fail)
    with pytest.raises(OSError, match=r"frame_0000\.png could not be written \(No space left on device\): free"):
        run(tmp_path)
    assert set(contents(tmp_path)) == {"settings.json", "frame_0000.exr"}
    # Without another write, leaving raises it.
    with pytest.raises(OSError, match="No space"), make(tmp_path) as sequence:
        sequence.write(0, *render(0))


def test_nan_reaches_the_loop_by_layer(tmp_path):
    layers, image, pose = render(0)
    layers["color"][1, 1] = np.nan
    with pytest.raises(ValueError, match="'color' holds NaN"), make(tmp_path) as sequence:
        sequence.write(0, layers, image, pose)
        sequence.finish()
    assert set(contents(tmp_path)) == {"settings.json"}


@pytest.mark.parametrize("interruption", [KeyboardInterrupt, RuntimeError])
def test_interrupted_loop_leaves_whole_frames(tmp_path, interruption):
    with pytest.raises(interruption), make(tmp_path) as sequence:
        for index in range(3):
            sequence.write(index, *render(index))
        raise interruption
    frames = {f"frame_000{index}.{kind}" for index in range(3) for kind in ("exr", "png")}
    assert set(contents(tmp_path)) == {"settings.json", *frames}
    assert not any(thread.name == "warp_psf frame writer" for thread in threading.enumerate())
    assert run(tmp_path) == [3, 4, 5]


def test_caller_may_reuse_its_arrays(tmp_path, monkeypatch):
    go_on = threading.Event()

    def write_late(path, image):
        go_on.wait(10)
        write_png(path, image)

    monkeypatch.setattr(sequence_module, "write_png", write_late)
    image = np.full((4, 4, 3), 7, np.uint8)
    with make(tmp_path, formats=("png",)) as sequence:
        sequence.write(0, {}, image, None)
        image[:] = 99
        go_on.set()
    assert (read_png(tmp_path / "frame_0000.png") == 7).all()


def test_film_needs_every_frame(tmp_path):
    with make(tmp_path) as sequence:
        sequence.write(1, *render(1))
        with pytest.raises(ValueError, match=r"5 of 6 frames are not in .* the first is 0"):
            sequence.finish()
    assert not (tmp_path / "film.mp4").exists()


def test_bad_arguments_are_named(tmp_path):
    cases = [
        ({"formats": ("exr", "gif")}, "gif"),
        ({"formats": ()}, "formats"),
        ({"count": 0}, "frames"),
        ({"settings": {"environment": np.zeros(3)}}, "'environment'"),
        ({"settings": {"exposure": float("nan")}}, "'exposure'"),
        ({"settings": {"view": "filmic"}}, "filmic"),
    ]
    for arguments, message in cases:
        with pytest.raises(ValueError, match=message):
            make(tmp_path / "out", **arguments)
    with pytest.raises(ValueError, match="with statement"):
        make(tmp_path / "out").write(0, *render(0))
    with make(tmp_path / "in") as sequence, pytest.raises(ValueError, match="frame 6"):
        sequence.missing(6)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("formats", [("exr", "mp4"), ("png", "mp4")])
def test_a_damaged_frame_is_named_with_its_remedy(tmp_path, formats):
    run(tmp_path, formats=formats)
    path = tmp_path / f"frame_0003.{formats[0]}"
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=rf"{path.name} .*: remove it and run again"):
        run(tmp_path, formats=formats)
    path.unlink()
    assert run(tmp_path, formats=formats) == [3]
    assert path.read_bytes() == whole
