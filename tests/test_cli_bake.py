"""`warp-psf bake`: a table of all that rendering needs, and nothing left to bake for it."""

from __future__ import annotations

import mujoco
import pytest

import warp_psf
from tests.flat_renderer import assert_refused, model_path, run

__all__ = ["model_path"]

MODEL = """
<mujoco>
  <worldbody>
    <geom type="plane" size="2 2 0.1"/>
    <body pos="0 0 1"><freejoint/><geom size="0.2"/></body>
    <body pos="1 0 1"><freejoint/><geom size="0.3"/></body>
    <body pos="2 0 1"><freejoint/><geom size="0.3"/></body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(autouse=True)
def cold_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("WARP_PSF_CACHE", str(tmp_path / "cache"))


def table(output: str) -> dict[str, list[str]]:
    """The cells after the name of each row."""
    lines = [line.strip("│").split("│") for line in output.splitlines() if line.startswith("│")]
    return {name.strip(): [cell.strip() for cell in cells] for name, *cells in lines}


def test_bake_leaves_nothing_for_the_renderer_to_bake(tmp_path):
    path = tmp_path / "balls.xml"
    path.write_text(MODEL)
    result = run("bake", path)
    assert result.exit_code == 0, result.output
    rows = table(result.stdout)
    assert list(rows) == ["plane", "sphere", "sphere #2", "all"]
    # Faces, bodies, seconds, kB of occlusion, transfer, light. The light of the floor is kept in textures.
    assert [row[1] for row in rows.values()] == ["1", "1", "2", "4"]
    assert rows["plane"][2:] == ["-", "-", "-", "-"]
    assert rows["sphere"][3:5] == ["-", "-"]
    # A sphere of another size is the same shape, which is baked once.
    assert "cached" in {rows["sphere"][2], rows["sphere #2"][2]}
    assert float(rows["all"][2]) >= 0

    shares = []
    model = mujoco.MjModel.from_xml_path(str(path))
    with warp_psf.Renderer(model, 18, 32, progress=lambda what, share: shares.append(share)) as renderer:
        stored = renderer.field_bytes
    # What is read from the cache is finished when it is first reported.
    assert set(shares) == {1.0}
    assert rows["all"][5] == f"{stored['radiance'] / 1e3:,.1f}"
    assert f"{sum(stored.values()) / 1e6:.2f} MB of fields" in result.stdout
    again = table(run("bake", path).stdout)
    assert again["sphere"][2] == again["sphere #2"][2] == "cached"
    assert again["sphere"][3:] == rows["sphere"][3:]


def test_bake_takes_a_mesh_and_says_what_it_stores(tmp_path):
    # Two triangles with an edge in common: open and bent, so that one half shadows the other.
    (tmp_path / "fold.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 4 2\n")
    result = run("bake", tmp_path / "fold.obj", "--order", 2)
    assert result.exit_code == 0, result.output
    assert "warp-psf: warning: mesh 'fold.obj' is open" in result.stderr
    ((name, row),) = table(result.stdout).items()
    assert (name, row[:2]) == ("fold.obj", ["2", "1"])
    occlusion, transfer, light = (float(cell.replace(",", "")) for cell in row[3:])
    assert min(occlusion, transfer, light) > 0
    # Per vertex four coefficients of four bytes, of transfer and of visibility; the crease parts the vertices.
    assert transfer == pytest.approx(6 * 2 * 4 * 4 / 1e3, abs=0.05)
    assert f"{(occlusion + transfer + light) / 1e3:.2f} MB" in result.stdout


def test_bake_of_a_model_without_geoms_is_an_empty_table(tmp_path):
    (tmp_path / "empty.xml").write_text("<mujoco><worldbody/></mujoco>")
    result = run("bake", tmp_path / "empty.xml")
    assert result.exit_code == 0, result.output
    assert "0.00 MB of fields" in result.stdout


def test_bake_names_a_file_that_is_not_there(tmp_path):
    for name in ("absent.obj", "absent.xml", "absent.urdf"):
        assert_refused(run("bake", tmp_path / name), name)
    assert_refused(run("bake", tmp_path / "absent.obj", "--device", "cuda:99"), "cuda:99")
