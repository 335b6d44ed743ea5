"""A renderer that draws flat pictures, and what the tests of the command line share."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

import warp_psf
from warp_psf import cli
from warp_psf.bridge import read_camera

MODEL = """
<mujoco>
  <worldbody>
    <light pos="0 0 3"/>
    <camera name="front" pos="0 -3 1" xyaxes="1 0 0 0 0.3 1"/>
    <geom name="floor" type="plane" size="2 2 0.1"/>
    <body pos="0 0 1"><freejoint/><geom name="ball" size="0.2"/></body>
  </worldbody>
</mujoco>
"""
SMALL = ("--size", "32x18", "--fps", "10", "--duration", "0.4", "--camera", "front")


class FlatRenderer:
    """Stands in for `warp_psf.Renderer`: the brightness of a picture is the height of the model's last body."""

    made: list[FlatRenderer]
    stop_after: int | None  # pictures until Ctrl-C

    def __init__(self, model, height: int, width: int, *, progress, **options):
        if options["environment"] == "nowhere":
            raise ValueError("environment 'nowhere' is neither built in nor a file")
        progress("baking ball", 0.5)
        progress("baking ball", 1.0)
        self.model, self.height, self.width, self.options = model, height, width, options
        self.vertices = model.ngeom
        self.world_from_camera = np.eye(4)
        self.pictures = 0
        self.made.append(self)

    def __enter__(self) -> FlatRenderer:
        return self

    def __exit__(self, *_) -> None:
        pass

    def update_scene(self, data, camera=-1) -> None:
        self.view = read_camera(self.model, data, camera)
        self.level = float(data.xpos[-1, 2])

    def render(self) -> np.ndarray:
        if self.pictures == self.stop_after:
            raise KeyboardInterrupt
        self.pictures += 1
        return np.full((self.height, self.width, 3), np.clip(100 * self.level, 0, 255), np.uint8)

    def layers(self) -> dict[str, np.ndarray]:
        shape = (self.height, self.width)
        color = np.full((*shape, 3), self.level, np.float32)
        layers = dict.fromkeys(("color", "direct", "albedo", "normal"), color) | {"indirect": color / 4}
        return layers | {"depth": np.ones(shape, np.float32), "segmentation": np.zeros((*shape, 2), np.int32)}


@pytest.fixture
def renderers(monkeypatch) -> Iterator[list[FlatRenderer]]:
    """The renderers that commands make from here on."""
    FlatRenderer.made = []
    FlatRenderer.stop_after = None
    monkeypatch.setattr(warp_psf, "Renderer", FlatRenderer, raising=False)
    yield FlatRenderer.made


@pytest.fixture
def model_path(tmp_path) -> Path:
    path = tmp_path / "fall.xml"
    path.write_text(MODEL)
    return path


def run(*arguments) -> Result:
    return CliRunner().invoke(cli.app, [str(argument) for argument in arguments])


def files_of(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def assert_refused(result: Result, *words: str, status: int = 2) -> None:
    """One sentence on stderr that holds the words, and nothing else."""
    lines = result.stderr.strip().splitlines()
    sentence = lines[-1]
    assert result.exit_code == status, result.output
    assert sentence.startswith("warp-psf: ")
    assert not any("Traceback" in line for line in lines)
    for word in words:
        assert word in sentence
