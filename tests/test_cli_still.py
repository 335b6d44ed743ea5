"""`warp-psf slab`, `layered` and `points`: what they write, and what they refuse."""

import json

import mujoco
import numpy as np
import pytest
from typer.testing import CliRunner

from sims import cubes
from sims.bodies import ball
from warp_psf.cli import app
from warp_psf.film.writer import read_exr, read_png

SCRIPT = {
    "cameras": ["front"],
    "lights": {
        "lamp": {"position": [0, 0, 1.7], "target": [0, 0, 0], "width": 0.7, "height": 0.7, "rows": 5, "columns": 5}
    },
    "steps": [{"lamp": {"side": 0.4, "radiance": [90, 80, 70]}}, {"frames": 2, "lamp": {"at": [0.5, 0.0]}}],
}
LIGHT = ["--position", "0,0,1.7", "--target", "0,0,0", "--light-size", "0.6,0.6"]


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> str:
    path = tmp_path_factory.mktemp("model") / "cubes.mjb"
    mujoco.mj_saveModel(cubes.build(), str(path), None)
    return str(path)


def run(*arguments) -> tuple[int, str]:
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    return result.exit_code, " ".join(result.output.split())


def test_a_script_becomes_frames_and_goes_on_where_it_stopped(model, tmp_path):
    script, out = tmp_path / "script.json", tmp_path / "out"
    script.write_text(json.dumps(SCRIPT))
    play = ("slab", model, script, "--out", out, "--size", "48x32", "--map-size", "65", "--device", "cpu")
    assert run(*play)[0] == 0
    assert {path.name for path in out.iterdir()} >= {
        "frame_0000.exr",
        "frame_0002.png",
        "film.mp4",
        "contact_sheet.png",
    }
    first = read_exr(out / "frame_0000.exr")
    assert set(first) == {"color", "attenuation", "shadowless"}
    np.testing.assert_allclose(first["color"], first["attenuation"] * first["shadowless"], atol=5e-3)
    (out / "frame_0001.exr").unlink()
    assert run(*play)[0] == 0 and (out / "frame_0001.exr").exists()


def test_a_layered_map_becomes_a_picture(model, tmp_path):
    out = tmp_path / "out"
    shoot = ("layered", model, "--out", out, *LIGHT, "--size", "48x32", "--map-size", "64", "--device", "cpu")
    assert run(*shoot)[0] == 0
    layers = read_exr(out / "front.exr")
    assert (
        set(layers) == {"color", "visibility"} and 0.0 <= layers["visibility"].min() < 0.5 < layers["visibility"].max()
    )
    assert read_png(out / "front.png").shape == (32, 48, 3)
    status, output = run(*shoot)
    assert status == 2 and "is there already" in output
    assert run(*shoot, "--overwrite")[0] == 0


def test_points_of_a_mesh_fill_the_film(tmp_path):
    vertices, faces = ball(8)
    lines = [f"v {x} {y} {z}" for x, y, z in vertices] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces]
    (tmp_path / "ball.obj").write_text("\n".join(lines))
    status, output = run(
        "points", tmp_path / "ball.obj", "--out", tmp_path / "out", "--size", "60x60", "--device", "cpu"
    )
    assert status == 0 and "points" in output
    depth = read_exr(tmp_path / "out" / "ball.exr")["depth"]
    # A disc whose diameter is the film's side.
    assert np.isfinite(depth).mean() == pytest.approx(np.pi / 4, rel=0.05)


def test_points_of_a_model_are_seen_by_all_its_cameras(model, tmp_path):
    assert run("points", model, "--out", tmp_path, "--size", "40x30", "--smallest", "0.02", "--device", "cpu")[0] == 0
    assert np.isfinite(read_exr(tmp_path / "front.exr")["depth"]).mean() > 0.5


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (
            ("layered", "MODEL", "--out", "OUT", "--position", "0,0", "--target", "0,0,0"),
            "--position 0,0 must be 3 numbers",
        ),
        (("layered", "MODEL", "--out", "OUT", *LIGHT, "--camera", "back"), "camera 'back' does not exist"),
        (("layered", "none.xml", "--out", "OUT", *LIGHT), "does not exist"),
        (("points", "MODEL", "--out", "OUT", "--smallest", "-1"), "smallest"),
        (("points", "none.obj", "--out", "OUT"), "none.obj"),
        (("slab", "MODEL", "none.json", "--out", "OUT"), "script 'none.json' does not exist"),
    ],
)
def test_what_cannot_be_done_is_one_sentence(arguments, sentence, model, tmp_path):
    places = {"MODEL": model, "OUT": tmp_path / "out"}
    status, output = run(*(places.get(argument, argument) for argument in arguments))
    assert status == 2 and sentence in output and output.startswith("warp-psf: ")
    assert not list((tmp_path / "out").glob("*")) if (tmp_path / "out").exists() else True
