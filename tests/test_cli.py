"""The command line: options, errors, resuming, comparing. Frames come from a renderer that draws flat pictures."""

from __future__ import annotations

import json
import subprocess
import sys

import mujoco
import numpy as np
import pytest

from tests.flat_renderer import MODEL, SMALL, FlatRenderer, assert_refused, files_of, model_path, renderers, run
from warp_psf import cli
from warp_psf.cli.fingerprint import fingerprint
from warp_psf.film.writer import read_exr, write_exr, write_png

__all__ = ["model_path", "renderers"]


def test_render_writes_every_frame_and_what_is_made_of_them(renderers, model_path, tmp_path):
    out = tmp_path / "out"
    result = run("render", model_path, "--out", out, *SMALL)
    assert result.exit_code == 0, result.output
    names = set(files_of(out))
    assert {f"frame_{index:04d}.{kind}" for index in range(4) for kind in ("exr", "png")} <= names
    assert {"film.mp4", "contact_sheet.png"} <= names
    assert "4 frames rendered" in result.stdout
    assert "baking" not in result.stdout
    layers = read_exr(out / "frame_0000.exr")
    assert set(layers) == {"color", "direct", "indirect", "albedo", "normal", "depth", "segmentation"}
    # The ball starts at 1 m; a quarter of that is exact in half floats.
    assert (layers["direct"] == 1.0).all()
    assert (layers["indirect"] == 0.25).all()


def test_options_reach_the_renderer(renderers, model_path, tmp_path):
    flags = (
        "--environment",
        "none",
        "--order",
        5,
        "--basis",
        "haar",
        "--shading",
        "vertex",
        "--exposure",
        "-1.5",
        "--view",
        "srgb",
    )
    rest = (
        "--device",
        "cpu",
        "--compose",
        "log",
        "--no-model-lights",
        "--formats",
        "png",
        "--frames",
        "1:3",
        "--bounces",
        0,
    )
    result = run("render", model_path, "--out", tmp_path / "out", *SMALL, *flags, *rest)
    assert result.exit_code == 0, result.output
    (renderer,) = renderers
    assert (renderer.width, renderer.height, renderer.pictures) == (32, 18, 2)
    expected = {
        "environment": None,
        "order": 5,
        "basis": "haar",
        "shading": "vertex",
        "exposure": -1.5,
        "view": "srgb",
    }
    assert renderer.options == expected | {
        "device": "cpu",
        "compose": "log",
        "model_lights": False,
        "lights": (),
        "bounces": 0,
    }
    assert {"frame_0001.png", "frame_0002.png"} < set(files_of(tmp_path / "out"))


def test_frames_follow_the_simulation(renderers, model_path, tmp_path):
    run("render", model_path, "--out", tmp_path / "all", *SMALL)
    result = run("render", model_path, "--out", tmp_path / "last", *SMALL, "--frames", "3:")
    assert result.exit_code == 0, result.output
    everything, last = files_of(tmp_path / "all"), files_of(tmp_path / "last")
    assert everything["frame_0000.png"] != everything["frame_0003.png"]
    assert last["frame_0003.png"] == everything["frame_0003.png"]


def test_a_stopped_run_resumes_to_the_same_files(renderers, model_path, tmp_path):
    FlatRenderer.stop_after = 2
    stopped = run("render", model_path, "--out", tmp_path / "a", *SMALL)
    assert_refused(stopped, "stopped; run again to resume", status=130)
    assert (tmp_path / "a" / "frame_0001.exr").exists()
    FlatRenderer.stop_after = None
    resumed = run("render", model_path, "--out", tmp_path / "a", *SMALL)
    assert resumed.exit_code == 0, resumed.output
    assert renderers[-1].pictures == 2
    assert "2 were there" in resumed.stdout
    run("render", model_path, "--out", tmp_path / "b", *SMALL)
    assert files_of(tmp_path / "a") == files_of(tmp_path / "b")


def test_other_settings_are_not_mixed_into_a_folder(renderers, model_path, tmp_path):
    out = tmp_path / "out"
    run("render", model_path, "--out", out, *SMALL)
    before = files_of(out)
    assert_refused(run("render", model_path, "--out", out, *SMALL, "--order", 3), "order")
    assert_refused(run("render", model_path, "--out", out, *SMALL, "--bounces", 2), "bounces")
    model_path.write_text(MODEL.replace('pos="0 0 1"', 'pos="0 0 0.5"'))
    assert_refused(run("render", model_path, "--out", out, *SMALL), "model")
    assert files_of(out) == before
    replaced = run("render", model_path, "--out", out, *SMALL, "--overwrite")
    assert replaced.exit_code == 0, replaced.output
    assert files_of(out)["frame_0000.png"] != before["frame_0000.png"]


@pytest.mark.parametrize("bounces", ["-1", "17", "1.5"])
def test_bounces_are_a_whole_number_of_at_most_16(renderers, model_path, tmp_path, bounces):
    result = run("render", model_path, "--out", tmp_path / "out", *SMALL, "--bounces", bounces)
    assert result.exit_code == 2
    assert "--bounces" in result.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (("--size", "0x18"), ("--size", "0x18")),
        (("--size", "32"), ("--size", "640x360")),
        (("--size", "99999x18"), ("--size", "16384")),
        (("--frames", "5"), ("--frames", "0:120")),
        (("--frames", "3:3"), ("--frames", "no frame")),
        (("--frames", "0:99999999"), ("--frames",)),
        (("--fps", "0"), ("--fps",)),
        (("--duration", "nan"), ("--duration",)),
        (("--duration", "-1"), ("--duration",)),
        (("--duration", "1e308"), ("frame 1000000", "--duration")),
        (("--formats", "exr,gif"), ("gif", "exr, png, mp4")),
        (("--formats", ""), ("formats",)),
        (("--view", "rosy"), ("rosy",)),
        (("--camera", "nobody"), ("nobody",)),
        (("--environment", "nowhere"), ("nowhere",)),
    ],
)
def test_bad_options_are_named_and_leave_no_folder(renderers, model_path, tmp_path, flags, words):
    assert_refused(run("render", model_path, "--out", tmp_path / "out", *SMALL, *flags), *words)
    assert not (tmp_path / "out").exists()


def test_bad_option_with_overwrite_keeps_the_frames(renderers, model_path, tmp_path):
    run("render", model_path, "--out", tmp_path / "out", *SMALL)
    before = files_of(tmp_path / "out")
    assert_refused(run("render", model_path, "--out", tmp_path / "out", *SMALL, "--camera", "x", "--overwrite"), "'x'")
    assert files_of(tmp_path / "out") == before


def test_bad_models_are_named(renderers, model_path, tmp_path):
    assert_refused(run("render", tmp_path / "absent.xml", "--out", tmp_path / "out"), "absent.xml")
    model_path.write_text("<mujoco><worldbody><geom/>")
    assert_refused(run("render", model_path, "--out", tmp_path / "out"), "fall.xml")
    assert not (tmp_path / "out").exists()


def test_out_that_is_a_file_is_named(renderers, model_path, tmp_path):
    (tmp_path / "out").write_text("mine")
    assert_refused(run("render", model_path, "--out", tmp_path / "out", *SMALL), "out")
    assert (tmp_path / "out").read_text() == "mine"


def three_states(model, frames_per_second):
    data = mujoco.MjData(model)
    for _ in range(3):
        mujoco.mj_forward(model, data)
        yield data


def test_simulations_share_the_options(renderers, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["sims.fall", "--size", "32x18", "--frames", ":3", "--formats", "png"])
    with pytest.raises(SystemExit) as ending:
        cli.run_simulation(lambda: mujoco.MjModel.from_xml_string(MODEL), three_states, name="fall", camera="front")
    assert ending.value.code in (0, None), capsys.readouterr().err
    assert (tmp_path / "out" / "fall" / "frame_0002.png").exists()
    settings = json.loads((tmp_path / "out" / "fall" / "settings.json").read_text())["settings"]
    assert (settings["camera"], settings["environment"], settings["bounces"]) == ("front", "studio", 3)
    assert renderers[-1].options["bounces"] == 3


def test_a_simulation_that_ends_early_says_so(renderers, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["sims.fall", "--size", "32x18", "--out", str(tmp_path / "out")])
    with pytest.raises(SystemExit) as ending:
        cli.run_simulation(lambda: mujoco.MjModel.from_xml_string(MODEL), three_states, name="fall", camera="front")
    assert ending.value.code == 2
    assert "ends after 3 frames" in capsys.readouterr().err


def test_fingerprint_sees_any_number_of_a_model():
    model, twin = (mujoco.MjModel.from_xml_string(MODEL) for _ in range(2))
    assert fingerprint(model) == fingerprint(twin)
    seen = {fingerprint(twin)}
    twin.geom_size[1, 0] += 1e-9
    seen.add(fingerprint(twin))
    twin.opt.timestep *= 2
    seen.add(fingerprint(twin))
    twin.vis.headlight.ambient[0] += 0.5
    seen.add(fingerprint(twin))
    assert len(seen) == 4


def test_compare_images(tmp_path):
    image = np.zeros((4, 6, 3), np.uint8)
    write_png(tmp_path / "a.png", image)
    image[0, 0, 0] = 51
    write_png(tmp_path / "b.png", image)
    result = run("compare", tmp_path / "a.png", tmp_path / "b.png")
    assert result.exit_code == 0, result.output
    assert "0.200000" in result.stdout
    assert f"{0.2 / np.sqrt(image.size):.6f}" in result.stdout


def test_compare_folders(tmp_path):
    for folder, levels in (("a", (0.0, 1.0)), ("b", (0.5, 1.0))):
        (tmp_path / folder).mkdir()
        for index, level in enumerate(levels):
            color = np.full((4, 6, 3), level, np.float32)
            write_exr(tmp_path / folder / f"frame_{index:04d}.exr", {"color": color})
    result = run("compare", tmp_path / "a", tmp_path / "b")
    assert result.exit_code == 0, result.output
    rows = {line.split()[1]: line.split()[3:6:2] for line in result.stdout.splitlines() if line.startswith("│")}
    assert rows["frame_0000.exr"] == ["0.500000", "0.500000"]
    assert rows["frame_0001.exr"] == ["0.000000", "0.000000"]
    assert rows["all"] == [f"{np.sqrt(0.125):.6f}", "0.500000"]
    (tmp_path / "b" / "frame_0001.exr").unlink()
    assert_refused(run("compare", tmp_path / "a", tmp_path / "b"), "frame_0001.exr", "only in", status=1)


def test_compare_refuses_what_does_not_belong_together(tmp_path):
    write_png(tmp_path / "a.png", np.zeros((4, 6, 3), np.uint8))
    write_png(tmp_path / "b.png", np.zeros((4, 7, 3), np.uint8))
    write_exr(tmp_path / "c.exr", {"color": np.zeros((4, 6, 3), np.float32)})
    (tmp_path / "d.png").write_bytes(b"no picture")
    (tmp_path / "e").mkdir()
    assert_refused(run("compare", tmp_path / "a.png", tmp_path / "b.png"), "6x4 and 7x4", status=1)
    assert_refused(run("compare", tmp_path / "a.png", tmp_path / "c.exr"), "different kinds")
    assert_refused(run("compare", tmp_path / "a.png", tmp_path / "d.png"), "d.png")
    assert_refused(run("compare", tmp_path / "a.png", tmp_path / "e"), "not one with the other")
    assert_refused(run("compare", tmp_path / "e", tmp_path / "e"), "no frames")
    assert_refused(run("compare", tmp_path / "a.png", tmp_path / "absent.png"), "absent.png")


def test_info_names_versions_and_the_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("WARP_PSF_CACHE", str(tmp_path / "cache"))
    result = run("info")
    assert result.exit_code == 0, result.output
    for word in ("Python", "warp-lang", "mujoco", "cpu", "cores", str(tmp_path / "cache"), "0 files"):
        assert word in result.stdout


def test_warnings_are_one_line(tmp_path, monkeypatch):
    monkeypatch.setenv("WARP_PSF_CACHE", str(tmp_path / "cache"))
    quad = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\nf 1 1 1\n"
    (tmp_path / "flat.obj").write_text(quad)
    result = run("bake", tmp_path / "flat.obj")
    assert result.exit_code == 0, result.output
    assert "warp-psf: warning: mesh 'flat.obj'" in result.stderr
    assert "UserWarning" not in result.stderr


def test_help_imports_nothing_heavy():
    script = "import sys, warp_psf.cli; print(*({'warp', 'mujoco', 'numpy'} & set(sys.modules)))"
    ending = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert ending.stdout.strip() == ""
    assert run("--help").exit_code == 0
