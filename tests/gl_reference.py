"""Pictures, depth and segmentation by MuJoCo's own renderer, in a process of its own that may choose its OpenGL.

`python -m tests.gl_reference OUT.npz` reads a list of views, JSON [[MJCF, camera, width, height], ...], from stdin.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

# The exit status that says that no picture can be made here, whatever is asked for.
NO_OPENGL = 3
View = tuple[str, str | int, int, int]


def reference_views(views: list[View], folder: Path) -> list[tuple[np.ndarray, np.ndarray]]:
    """Of each view the segmentation [height, width, 2] and depth [height, width]; skips the test without OpenGL."""
    found = _render(views, folder)
    return [(found[f"segmentation{index}"], found[f"depth{index}"]) for index in range(len(views))]


def reference_pictures(views: list[View], folder: Path) -> list[np.ndarray]:
    """The picture of each view, uint8 [height, width, 3]; skips the test without OpenGL."""
    found = _render(views, folder)
    return [found[f"picture{index}"] for index in range(len(views))]


def _render(views: list[View], folder: Path) -> dict[str, np.ndarray]:
    out = folder / "views.npz"
    environment = {"MUJOCO_GL": "egl"} | dict(os.environ)
    command = [sys.executable, "-m", "tests.gl_reference", str(out)]
    root = Path(__file__).parents[1]
    ended = subprocess.run(
        command, input=json.dumps(views), env=environment, cwd=root, capture_output=True, text=True, timeout=300
    )
    if ended.returncode == NO_OPENGL:
        pytest.skip(f"MuJoCo's renderer finds no OpenGL: {ended.stderr.strip().rpartition(chr(10))[2]}")
    assert ended.returncode == 0, ended.stderr
    with np.load(out) as found:
        return dict(found)


def main(out: str) -> None:
    """Renders the views of stdin."""
    try:
        import mujoco

        mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8).close()
    except Exception as error:  # what is missing where there is no OpenGL raises errors of many types
        print(error, file=sys.stderr)
        sys.exit(NO_OPENGL)
    found = {}
    for index, (xml, camera, width, height) in enumerate(json.load(sys.stdin)):
        model = mujoco.MjModel.from_xml_string(xml)
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        renderer = mujoco.Renderer(model, height, width)
        renderer.update_scene(data, camera)
        found[f"picture{index}"] = renderer.render().copy()
        renderer.enable_segmentation_rendering()
        found[f"segmentation{index}"] = renderer.render().copy()
        renderer.enable_depth_rendering()
        found[f"depth{index}"] = renderer.render().copy()
        renderer.close()
    np.savez(out, **found)


if __name__ == "__main__":
    main(sys.argv[1])
