"""Motion: recordings that replay what was simulated, starts at keyframes, and files that are not to be trusted."""

from __future__ import annotations

import io
import itertools
import zipfile
from pathlib import Path

import mujoco
import numpy as np
import pytest

from warp_psf.motion import Recording, find_keyframe, read_recording, replay, simulate

# A free body, a ball joint and two driven hinges: nq is 7 + 4 + 2, nu is 2.
MODEL = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <geom type="plane" size="2 2 0.1"/>
    <body name="die" pos="0 0 1"><freejoint/><geom type="box" size="0.1 0.2 0.3"/></body>
    <body pos="1 0 2"><joint type="ball"/><geom type="capsule" fromto="0 0 0 0.5 0 0" size="0.05"/></body>
    <body pos="-1 0 2">
      <joint name="upper" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.05"/>
      <body pos="0 0 -0.5"><joint name="lower" axis="0 1 0"/><geom size="0.1"/></body>
    </body>
  </worldbody>
  <actuator><motor joint="upper" gear="9"/><motor joint="lower" gear="3"/></actuator>
  <keyframe>
    <key name="raised" qpos="0 0 3 1 0 0 0  1 0 0 0  0.5 0.25" qvel="0 0 1 5 3 1  1 2 3  0 1"/>
    <key/>
    <key name="0" qpos="0 0 5 1 0 0 0  1 0 0 0  0 0"/>
  </keyframe>
</mujoco>
"""
ROW = [0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.5, 0.25]


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(MODEL)


def recorded(model: mujoco.MjModel, steps: int, controls: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """Times and positions before each step of a plain simulation from the keyframe "raised", and the last ones."""
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    time, qpos = [data.time], [data.qpos.copy()]
    for step in range(steps):
        if controls is not None:
            data.ctrl[:] = controls[step]
        mujoco.mj_step(model, data)
        time.append(data.time)
        qpos.append(data.qpos.copy())
    return {"time": np.array(time), "qpos": np.array(qpos)}


def save_csv(path: Path, rows: np.ndarray, header: str = "") -> Path:
    # Seventeen digits hold a double exactly.
    np.savetxt(path, rows, fmt="%.17g", delimiter=",", header=header)
    return path


def save_npz(path: Path, **arrays) -> Path:
    np.savez(path, **arrays)
    return path


def poses(states, count: int) -> list[np.ndarray]:
    return [np.hstack((data.xpos, data.xquat)).copy() for data in itertools.islice(states, count)]


def test_recorded_controls_repeat_a_simulation_to_the_bit(model, tmp_path):
    controls = np.random.default_rng(1).uniform(-1, 1, (150, 2))
    direct = recorded(model, 150, controls)["qpos"]
    for path in (save_npz(tmp_path / "a.npz", ctrl=controls), save_csv(tmp_path / "a.csv", controls)):
        recording = read_recording(path, "ctrl", model)
        states = simulate(model, 50, keyframe=0, controls=recording)
        for frame, data in enumerate(itertools.islice(states, 15)):
            assert np.array_equal(data.qpos, direct[10 * frame])


@pytest.mark.parametrize("clock", [{"time": 7.0 + 0.1 * np.arange(3)}, {"fps": 10}])
def test_each_control_holds_until_the_next_and_the_last_one_on(model, tmp_path, clock):
    controls = np.array([[1.0, 0.0], [-1.0, 0.5], [0.0, -0.5]])
    # Rows are 50 steps apart, the last holds for 100.
    direct = recorded(model, 200, np.repeat(controls, [50, 50, 100], axis=0))["qpos"]
    recording = read_recording(save_npz(tmp_path / "a.npz", ctrl=controls, **clock), "ctrl", model)
    states = simulate(model, 50, keyframe=0, controls=recording)
    for frame, data in enumerate(itertools.islice(states, 21)):
        assert np.array_equal(data.qpos, direct[10 * frame])


def test_a_simulation_replayed_from_its_positions_looks_the_same(model, tmp_path):
    rows = recorded(model, 300)
    packed = tmp_path / "packed.npz"
    np.savez_compressed(packed, **rows)
    files = (
        packed,
        save_npz(tmp_path / "untimed.npz", qpos=np.asfortranarray(rows["qpos"])),
        save_csv(tmp_path / "untimed.csv", rows["qpos"]),
        save_csv(tmp_path / "timed.csv", np.column_stack((rows["qpos"], rows["time"])), "," * 12 + ",time"),
    )
    expected = poses(simulate(model, 50, keyframe=0), 31)
    for path in files:
        recording = read_recording(path, "qpos", model)
        assert recording.frame_count(50) == 31
        shown = poses(replay(model, 50, positions=recording), 31)
        # Frames meet rows but for the rounding of summed times, which a joint at 10 rad/s turns into 1e-13.
        assert np.allclose(shown, expected, rtol=0, atol=1e-12), path.name


def test_a_frame_at_a_row_shows_that_row(model):
    rows = np.array([ROW, ROW])
    rows[1, :3] = 0.1, 0.2, 0.3
    recording = Recording("r", "qpos", np.array([0.0, 0.5]), rows)
    shown = [data.qpos.copy() for data in replay(model, 2, positions=recording)]
    assert np.array_equal(shown, rows)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("scale", [1.0, 3.0])
def test_between_rows_quaternions_turn_evenly_the_short_way(model, sign, scale):
    rows = np.array([ROW, ROW])
    quarter = np.radians(90.0)
    rows[1, :3] = 0.4, 0.0, 2.0
    # A quaternion and its opposite are the same rotation, and so are its multiples.
    rows[1, 3:7] = scale * sign * np.array([np.cos(quarter / 2), 0.0, 0.0, np.sin(quarter / 2)])
    rows[1, 11] = 4.5
    recording = Recording("r", "qpos", np.array([0.0, 1.0]), rows)
    middle = [data.qpos.copy() for data in replay(model, 4, positions=recording)][1]
    eighth = quarter / 8
    expected = [0.1, 0.0, 1.25, np.cos(eighth), 0.0, 0.0, np.sin(eighth), 1.0, 0.0, 0.0, 0.0, 1.5, 0.25]
    # Rounding of a few operations in double precision.
    assert np.allclose(middle, expected, rtol=0, atol=1e-12)


def test_a_recording_has_a_frame_for_each_row_at_its_own_rate():
    for rate in (24, 25, 30, 50, 60):
        for count in (1, 2, 70, 100, 1000):
            recording = Recording("r", "qpos", np.arange(count) / rate, np.zeros((count, 1)))
            assert recording.frame_count(rate) == count


def test_keyframes_are_found_by_name_or_number(model):
    assert find_keyframe(model, "raised") == 0
    assert find_keyframe(model, "1") == 1
    # The name comes first.
    assert find_keyframe(model, "0") == 2
    for absent in ("lowered", "3", "-1", "1.0", ""):
        with pytest.raises(ValueError, match=r"choose one of 0 raised, 1, 2 0$"):
            find_keyframe(model, absent)
    with pytest.raises(ValueError, match="no keyframes"):
        find_keyframe(mujoco.MjModel.from_xml_string("<mujoco><worldbody/></mujoco>"), "0")


def test_a_simulation_starts_where_it_is_told_to(model):
    own, raised = (next(simulate(model, 30, keyframe=keyframe)) for keyframe in (None, 0))
    assert np.array_equal(own.qpos, model.qpos0)
    assert np.array_equal(raised.qpos, model.key_qpos[0])
    assert np.array_equal(raised.qvel, model.key_qvel[0])


@pytest.mark.parametrize(("velocity", "when"), [(1e12, "0"), (1.0, r"0\.\d+")])
def test_a_simulation_that_diverges_says_so(velocity, when):
    # A spring this stiff is unstable at this step, and grows for some steps; 1e12 rad/s MuJoCo refuses in the first.
    unstable = mujoco.MjModel.from_xml_string(
        "<mujoco><option timestep='0.01' integrator='Euler'><flag eulerdamp='disable'/></option><worldbody><body>"
        "<joint axis='0 1 0' stiffness='1e11'/><geom size='0.1' pos='0.1 0 0'/></body></worldbody>"
        f"<keyframe><key qvel='{velocity}'/></keyframe></mujoco>"
    )
    states = simulate(unstable, 30, keyframe=0)
    assert np.isfinite(next(states).qpos).all()
    with pytest.raises(ValueError, match=f"diverged at {when} s: .*--duration"):
        next(itertools.islice(states, 100, None))


def test_a_header_names_the_column_of_time(model, tmp_path):
    path = tmp_path / "a.csv"
    path.write_text('\ufeff"left", "Time","right"\r\n1,0.5,2\r\n\r\n3,0.75,4\r\n', encoding="utf-8")
    recording = read_recording(path, "ctrl", model)
    assert recording.rows.tolist() == [[1, 2], [3, 4]]
    assert recording.time.tolist() == [0.0, 0.25]
    path.write_text("left,right\n1,2\n3,4\n")
    assert read_recording(path, "ctrl", model).time.tolist() == [0.0, 0.002]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no rows"),
        ("time,a,b\n", "no rows"),
        ("1,2\n3\n", "line 2 has 1 columns; the model has nu = 2"),
        ("0,1,2\n", "nu = 2: give 2 columns, or one more that a header names 'time'"),
        ("a,b,c\n0,1,2\n", "line 2 has 3 columns; the model has nu = 2"),
        ("time,a,b\n0,1\n", "line 2 has 2 columns and the header 3"),
        ("time,a,b\ns,m,m\n0,1,2\n", "line 2 is not made of numbers"),
        ("1,2\n3,x\n", "line 2 is not made of numbers"),
        ("1,2\n\n3,nan\n", "ctrl is not finite in row 1"),
        ("1,2\n-inf,2\n", "ctrl is not finite in row 1"),
        ("time,a,b\nnan,1,2\n", "time is not finite in row 0"),
        ("time,a,b\n0,1,2\n1,1,2\n1,1,2\n", "time does not increase at row 2"),
        ("time,a,b\n-1e308,1,2\n1e308,1,2\n", "give it in seconds"),
        ("1," * 600_000 + "\n", "line 1 has more than"),
        (b"\xff\xfe\x00", "decode"),
    ],
)
def test_a_csv_that_does_not_fit_is_refused_in_one_sentence(model, tmp_path, text, words):
    path = tmp_path / "a.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ValueError) as refusal:
        read_recording(path, "ctrl", model)
    assert words in str(refusal.value)
    assert str(refusal.value).startswith(f"--ctrl {path}: ")


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        ({"qpos": np.zeros((3, 12))}, "[3, 12]; the model has nq = 13"),
        ({"qpos": np.zeros(13)}, "[13]; the model has nq = 13: give [rows, 13]"),
        ({"qpos": np.float64(1)}, "nq = 13"),
        ({"qpos": np.zeros((0, 13))}, "nq = 13"),
        ({"ctrl": np.zeros((3, 2)), "note": np.zeros(1)}, "no array 'qpos' (but ctrl, note)"),
        ({"qpos": np.full((3, 13), "1.0")}, "give numbers"),
        ({"qpos": np.full((3, 13), 1j)}, "give numbers"),
        ({"qpos": np.full((3, 13), None)}, "give numbers"),
        ({"qpos": np.zeros((3, 13)), "time": np.arange(4)}, "time has the shape [4]"),
        ({"qpos": np.zeros((3, 13)), "time": np.zeros((3, 1))}, "time has the shape [3, 1]"),
        ({"qpos": np.zeros((3, 13)), "time": np.array([0, 2, 1])}, "increase at row 2"),
        ({"qpos": np.zeros((3, 13)), "fps": np.array([30, 60])}, "fps must be one positive number"),
        ({"qpos": np.zeros((3, 13)), "fps": 0}, "fps must be one positive number"),
        ({"qpos": np.array([ROW, [*ROW[:-1], np.nan]])}, "qpos is not finite in row 1"),
    ],
)
def test_an_npz_that_does_not_fit_is_refused_in_one_sentence(model, tmp_path, arrays, words):
    with pytest.raises(ValueError) as refusal:
        read_recording(save_npz(tmp_path / "a.npz", **arrays), "qpos", model)
    assert words in str(refusal.value)


def broken_archives() -> dict[str, tuple[bytes, str]]:
    """Files that were tampered with, and words of the refusal."""
    header = io.BytesIO()
    promise = {"descr": "<f8", "fortran_order": False, "shape": (10**12, 13)}
    np.lib.format.write_array_header_1_0(header, promise)
    promising, bzipped = io.BytesIO(), io.BytesIO()
    with zipfile.ZipFile(promising, "w") as archive:
        archive.writestr("qpos.npy", header.getvalue() + bytes(13 * 8))
    with zipfile.ZipFile(bzipped, "w", zipfile.ZIP_BZIP2) as archive:
        archive.writestr("qpos.npy", bytes(100))
    whole = io.BytesIO()
    np.savez(whole, qpos=np.array([ROW]))
    flipped = bytearray(whole.getvalue())
    flipped[200] ^= 1
    return {
        "a terabyte is promised": (promising.getvalue(), "promises the shape [1000000000000, 13]"),
        "packed otherwise": (bzipped.getvalue(), "packed in a way"),
        "cut short": (whole.getvalue()[:-40], "no NPZ file"),
        "one bit flipped": (bytes(flipped), "no NPZ file"),
        "no archive": (b"qpos", "no NPZ file"),
    }


@pytest.mark.parametrize("name", broken_archives())
def test_a_broken_npz_is_refused_in_one_sentence(model, tmp_path, name):
    content, words = broken_archives()[name]
    (tmp_path / "a.npz").write_bytes(content)
    with pytest.raises(ValueError, match=r"--qpos .*a\.npz: ") as refusal:
        read_recording(tmp_path / "a.npz", "qpos", model)
    assert words in str(refusal.value)


def test_files_of_other_kinds_and_models_without_joints_are_refused(model, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"absent\.npz"):
        read_recording(tmp_path / "absent.npz", "qpos", model)
    np.save(tmp_path / "a.npy", np.zeros((3, 13)))
    with pytest.raises(ValueError, match=r"neither an \.npz nor a \.csv"):
        read_recording(tmp_path / "a.npy", "qpos", model)
    still = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
    with pytest.raises(ValueError, match="nq = 0"):
        read_recording(save_npz(tmp_path / "a.npz", qpos=np.zeros((3, 0))), "qpos", still)
