"""`warp-psf render` with keyframes, recordings, URDF, cameras, and simulations that end badly."""

from __future__ import annotations

import json

import mujoco
import numpy as np
import pytest

from tests.flat_renderer import SMALL, assert_refused, files_of, model_path, renderers, run
from warp_psf.film.writer import read_exr

__all__ = ["model_path", "renderers"]

PENDULUM = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <camera name="front" pos="0 -3 1" xyaxes="1 0 0 0 0.3 1"/>
    <camera name="2" pos="0 -3 1" xyaxes="1 0 0 0 0.3 1"/>
    <body pos="0 0 1"><joint name="swing" axis="0 1 0"/><body pos="0.5 0 0"><geom size="0.1"/></body></body>
  </worldbody>
  <actuator><motor joint="swing" gear="5"/></actuator>
  <keyframe><key name="up" qpos="-1.5"/><key name="down" qpos="1.5"/></keyframe>
</mujoco>
"""
URDF = """
<robot name="arm">
  <link name="base"><collision><geometry><box size="0.4 0.4 0.1"/></geometry></collision></link>
  <link name="tip">
    <inertial><origin xyz="0.3 0 0"/><mass value="1"/>
      <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin xyz="0.3 0 0"/><geometry><sphere radius="0.1"/></geometry></collision>
  </link>
  <joint name="hinge" type="continuous">
    <parent link="base"/><child link="tip"/><origin xyz="0 0 2"/><axis xyz="0 1 0"/>
  </joint>
</robot>
"""
# Radius of the pendulum, height of its axis: metres.
ARM, AXIS = 0.5, 1.0


@pytest.fixture
def pendulum(tmp_path):
    path = tmp_path / "pendulum.xml"
    path.write_text(PENDULUM)
    return path


def levels(folder) -> list[float]:
    """The height of the last body in every frame, as the flat renderer draws it: half floats."""
    return [float(read_exr(path)["color"][0, 0, 0]) for path in sorted(folder.glob("frame_*.exr"))]


def test_a_keyframe_is_where_the_film_starts(renderers, pendulum, tmp_path):
    for chosen, folder in (("down", "a"), ("1", "b")):
        result = run("render", pendulum, "--out", tmp_path / folder, *SMALL, "--keyframe", chosen)
        assert result.exit_code == 0, result.output
    # A half float near 0.5 is exact to 2^-12.
    assert levels(tmp_path / "a")[0] == pytest.approx(AXIS - ARM * np.sin(1.5), abs=2**-12)
    assert files_of(tmp_path / "a") == files_of(tmp_path / "b")
    refused = run("render", pendulum, "--out", tmp_path / "c", *SMALL, "--keyframe", "left")
    assert_refused(refused, "--keyframe left", "0 up, 1 down")
    assert not (tmp_path / "c").exists()


def test_recorded_positions_are_shown_to_their_end(renderers, pendulum, tmp_path):
    angles = np.linspace(0.0, 1.4, 8)
    np.savez(tmp_path / "swing.npz", qpos=angles[:, None], fps=10)
    flags = ("--size", "32x18", "--fps", 10, "--qpos", tmp_path / "swing.npz")
    result = run("render", pendulum, "--out", tmp_path / "a", *flags)
    assert result.exit_code == 0, result.output
    # A half float below 1 is exact to 2^-12.
    assert levels(tmp_path / "a") == pytest.approx(list(AXIS - ARM * np.sin(angles)), abs=2**-12)
    part = run("render", pendulum, "--out", tmp_path / "b", *flags, "--frames", "2:4")
    assert part.exit_code == 0, part.output
    assert levels(tmp_path / "b") == levels(tmp_path / "a")[2:4]
    for more in (("--duration", 2), ("--frames", ":9")):
        assert_refused(run("render", pendulum, "--out", tmp_path / "c", *flags, *more), "ends after 8 frames")
    assert not (tmp_path / "c").exists()


def test_recorded_controls_are_simulated(renderers, pendulum, tmp_path):
    rows = np.column_stack((np.arange(21) * 0.02, np.sin(np.arange(21))))
    np.savetxt(tmp_path / "push.csv", rows, fmt="%.17g", delimiter=",", header="time,motor")
    flags = ("--size", "32x18", "--fps", 10, "--camera", "front", "--ctrl", tmp_path / "push.csv")
    result = run("render", pendulum, "--out", tmp_path / "a", *flags)
    assert result.exit_code == 0, result.output
    model = mujoco.MjModel.from_xml_string(PENDULUM)
    data = mujoco.MjData(model)
    expected = []
    for step in range(41):
        if step % 10 == 0:
            mujoco.mj_kinematics(model, data)
            expected.append(float(np.float16(data.xpos[-1, 2])))
        data.ctrl[:] = rows[step // 2, 1]
        mujoco.mj_step(model, data)
    assert levels(tmp_path / "a") == expected
    # The last control is held on.
    longer = run("render", pendulum, "--out", tmp_path / "b", *flags, "--duration", 1)
    assert longer.exit_code == 0, longer.output
    assert levels(tmp_path / "b")[:5] == expected
    assert len(levels(tmp_path / "b")) == 10


def test_other_motion_is_not_mixed_into_a_folder(renderers, pendulum, tmp_path):
    recording = tmp_path / "swing.csv"
    recording.write_text("0\n0.5\n1\n")
    out, flags = tmp_path / "out", ("--size", "32x18", "--fps", "50")
    assert run("render", pendulum, "--out", out, *flags, "--qpos", recording).exit_code == 0
    before = files_of(out)
    assert run("render", pendulum, "--out", out, *flags, "--qpos", recording).exit_code == 0
    assert_refused(run("render", pendulum, "--out", out, *flags), "qpos was", "absent")
    other = run("render", pendulum, "--out", out, *flags, "--qpos", recording, "--keyframe", "up")
    assert_refused(other, "keyframe was absent and is 0")
    recording.write_text("0\n0.5\n1.25\n")
    assert_refused(run("render", pendulum, "--out", out, *flags, "--qpos", recording), "qpos was")
    assert_refused(run("render", pendulum, "--out", out, *flags, "--ctrl", recording), "ctrl was absent")
    assert files_of(out) == before


def test_recordings_that_do_not_fit_leave_no_folder(renderers, pendulum, tmp_path):
    (tmp_path / "wide.csv").write_text("1,2\n")
    (tmp_path / "good.csv").write_text("1\n")
    out = ("--out", tmp_path / "out", *SMALL)
    assert_refused(run("render", pendulum, *out, "--qpos", tmp_path / "wide.csv"), "wide.csv", "nq = 1")
    assert_refused(run("render", pendulum, *out, "--ctrl", tmp_path / "absent.csv"), "absent.csv")
    both = ("--qpos", tmp_path / "good.csv", "--ctrl", tmp_path / "good.csv")
    assert_refused(run("render", pendulum, *out, *both), "--qpos and --ctrl")
    assert not (tmp_path / "out").exists()


def test_the_frames_before_a_divergence_are_kept(renderers, tmp_path):
    model = PENDULUM.replace('axis="0 1 0"', 'axis="0 1 0" stiffness="1e6"')
    (tmp_path / "stiff.xml").write_text(model)
    flags = ("--out", tmp_path / "out", "--size", "32x18", "--fps", 100, "--keyframe", "up")
    assert_refused(run("render", tmp_path / "stiff.xml", *flags, "--duration", 2), "diverged at", "--duration")
    kept = len(levels(tmp_path / "out"))
    assert kept > 1
    ended = run("render", tmp_path / "stiff.xml", *flags, "--frames", f":{kept}")
    assert ended.exit_code == 0, ended.output
    assert f"{kept} were there" in ended.stdout
    assert (tmp_path / "out" / "film.mp4").exists()


def test_urdf_and_compiled_models_are_rendered(renderers, pendulum, tmp_path):
    (tmp_path / "arm.urdf").write_text(URDF)
    mujoco.mj_saveModel(mujoco.MjModel.from_xml_string(PENDULUM), str(tmp_path / "pendulum.mjb"), None)
    for path, start in ((tmp_path / "arm.urdf", 2.0), (tmp_path / "pendulum.mjb", AXIS)):
        out = tmp_path / path.stem
        result = run("render", path, "--out", out, "--size", "32x18", "--fps", 10, "--duration", 0.2)
        assert result.exit_code == 0, result.output
        # A model without cameras has the free one.
        assert json.loads((out / "settings.json").read_text())["settings"]["camera"] == -1
        assert levels(out)[0] == start
    assert renderers[0].model.ngeom == 2


@pytest.mark.parametrize(("chosen", "meant"), [("front", "front"), ("0", 0), ("1", 1), ("2", "2"), ("-1", -1)])
def test_a_camera_is_a_name_or_a_number(renderers, pendulum, tmp_path, chosen, meant):
    flags = ("--size", "32x18", "--frames", ":1", "--formats", "png", "--camera", chosen)
    result = run("render", pendulum, "--out", tmp_path / "out", *flags)
    assert result.exit_code == 0, result.output
    assert json.loads((tmp_path / "out" / "settings.json").read_text())["settings"]["camera"] == meant
    assert_refused(run("render", pendulum, "--out", tmp_path / "none", *flags[:-1], "7"), "7")
    assert not (tmp_path / "none").exists()


def test_a_model_that_shows_nothing_shows_its_surroundings(tmp_path):
    (tmp_path / "empty.xml").write_text("<mujoco><worldbody><geom size='1' group='3'/></worldbody></mujoco>")
    out, flags = tmp_path / "out", ("--size", "32x18", "--frames", ":1", "--formats", "exr", "--bounces", 0)
    result = run("render", tmp_path / "empty.xml", "--out", out, *flags, "--environment", "overcast")
    assert result.exit_code == 0, result.output
    assert "warning: empty.xml shows no geoms" in result.stderr
    layers = read_exr(out / "frame_0000.exr")
    assert (layers["segmentation"] == -1).all()
    assert (layers["color"] > 0).all()
