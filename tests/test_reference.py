"""The docstrings of the public face: every name has one, the examples run, and the module tells of all its names."""

from __future__ import annotations

import inspect
import re
from types import ModuleType
from typing import Any

import mujoco
import numpy as np
import pytest

import warp_psf as psf

MODULES = (psf, psf.area_light, psf.area_light.templates)
MODEL = """
<mujoco>
  <worldbody>
    <light pos="0 0 3" dir="0 0 -1"/>
    <camera name="front" pos="0 -3 1.5" xyaxes="1 0 0 0 .45 .9"/>
    <camera name="side" pos="3 0 1.5" xyaxes="0 1 0 -.45 0 .9"/>
    <geom name="floor" type="plane" size="2 2 .1"/>
    <body pos="0 0 .6"><freejoint/><geom name="ball" type="sphere" size=".3" rgba=".8 .2 .1 1"/></body>
    <geom name="block" type="box" size=".3 .2 .4" pos="-.8 .3 .4" rgba=".2 .6 .3 1"/>
  </worldbody>
</mujoco>
"""
WEDGE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def public_names(module: ModuleType) -> list[str]:
    """Those in __all__ or, where a module has none, its own functions without an underscore."""
    own = [name for name, value in vars(module).items() if inspect.isfunction(value) and not name.startswith("_")]
    return getattr(module, "__all__", own)


def documented() -> dict[str, Any]:
    """The public modules, what they name, and the methods and properties of classes: each by its dotted name."""
    found: dict[str, Any] = {module.__name__: module for module in MODULES}
    for module in MODULES:
        for name in public_names(module):
            value = getattr(module, name)
            found[f"{module.__name__}.{name}"] = value
            if inspect.isclass(value):
                found |= {f"{module.__name__}.{name}.{part}": member for part, member in public_members(value)}
    return found


def public_members(owner: type) -> list[tuple[str, Any]]:
    members = [(name, inspect.getattr_static(owner, name)) for name in dir(owner) if not name.startswith("_")]
    return [(name, m) for name, m in members if isinstance(m, (property, staticmethod, classmethod)) or callable(m)]


def own_docstring(name: str, value: Any) -> str:
    """Its docstring, "" without; a dataclass without one gets its signature from Python, which is none."""
    text = inspect.cleandoc(value.__doc__ or "")
    return "" if text.startswith(f"{name.rpartition('.')[2]}(") else text


def blocks(text: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", text, flags=re.MULTILINE | re.DOTALL)


DOCSTRINGS = {name: own_docstring(name, value) for name, value in documented().items()}
EXAMPLES = {name: blocks(text, "python") for name, text in DOCSTRINGS.items() if blocks(text, "python")}


def test_every_public_name_has_a_docstring():
    # Attributes of dataclasses are told of in the docstring of their class.
    assert len(DOCSTRINGS) > 100
    assert not [name for name, text in DOCSTRINGS.items() if not text]


def test_every_field_of_a_public_dataclass_is_told_of():
    for name, value in documented().items():
        for field in getattr(value, "__dataclass_fields__", {}):
            assert re.search(rf"\b{field}\b", DOCSTRINGS[name]), f"{name} says nothing of {field}"


def test_every_parameter_of_a_public_function_is_told_of():
    for name, value in documented().items():
        if inspect.isfunction(value) and "takes what `" not in DOCSTRINGS[name]:
            for parameter in inspect.signature(value).parameters.keys() - {"self"}:
                assert re.search(rf"\b{parameter}\b", DOCSTRINGS[name]), f"{name} says nothing of {parameter}"


@pytest.mark.parametrize("module", MODULES[:2], ids=lambda module: module.__name__)
def test_a_module_tells_of_all_its_names(module: ModuleType):
    told = re.findall(r"`(?:[a-z_.]+\.)?(\w+)`", module.__doc__ or "")
    assert set(module.__all__) <= set(told)


@pytest.mark.parametrize("name", EXAMPLES)
@pytest.mark.filterwarnings("error")
def test_examples_run(name: str, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "model.xml").write_text(MODEL)
    (tmp_path / "mesh.obj").write_text(WEDGE)
    (script,) = blocks(DOCSTRINGS["warp_psf.area_light.read_script"], "json")
    (tmp_path / "script.json").write_text(script)
    model = mujoco.MjModel.from_xml_string(MODEL)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    names = {"mujoco": mujoco, "np": np, "psf": psf, "model": model, "data": data}
    for number, block in enumerate(EXAMPLES[name]):
        exec(compile(block, f"<example {number + 1} of {name}>", "exec"), names)


def test_examples_show_what_is_used_most():
    most = {"Renderer", "FrameSequence", "area_light", "area_light.SlabView", "rectangle_light", "load_mesh"}
    assert {"warp_psf", *(f"warp_psf.{name}" for name in most)} <= set(EXAMPLES)
