"""The house's import rules, read from the sources, and the checker's own tests."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
# Which rooms and modules each part of warp_psf may import, besides itself and `device`.
ALLOWED = {
    "device": set(),
    "motion": set(),
    "basis": set(),
    "scene": {"basis"},
    "field": {"basis"},
    "bake": {"basis", "scene", "field"},
    "shade": {"basis", "scene", "field"},
    "area_light": {"basis", "scene", "field"},
    "film": {"basis", "scene"},
}
SEES_EVERYTHING = {"__init__", "bridge", "settings", "stage", "renderer", "viewer", "cli"}
# What sims may use besides warp_psf.__all__: the command line that they share with `warp-psf render`.
RUNNER = "warp_psf.cli.run_simulation"
MAY_IMPORT_MUJOCO = {"bridge", "motion", "renderer"}
OUTSIDE_THE_PACKAGE = {"sims", "benchmarks", "tests"}
MOST_LINES = 450  # of a file; the house style asks for about 400
MOST_NAMES = 20  # in warp_psf.__all__; the design asks for about fifteen


def imports(path: str, tree: ast.Module) -> list[tuple[int, str]]:
    """(line, dotted name) of everything imported anywhere in a file; `from a import b` gives a.b."""
    found = []
    package = path.removesuffix(".py").split("/")[:-1]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [(node.lineno, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            start = ".".join([*base, *([node.module] if node.module else [])])
            found += [(node.lineno, f"{start}.{alias.name}") for alias in node.names]
    return found


def violations(path: str, source: str, public: set[str]) -> list[str]:
    """What a file of the given path (from the repository's root, with slashes) breaks; `public`: warp_psf.__all__."""
    tree = ast.parse(source, path)
    top, *rest = path.removesuffix(".py").split("/")
    check = _package_rule if top == "warp_psf" else _outside_rule
    found = [(line, reason) for line, name in imports(path, tree) if (reason := check(rest[0], name, public))]
    if top == "warp_psf" and rest != ["__init__"]:
        found += [(line, "imports by a computed name, which no rule can read") for line in _hidden_imports(tree)]
    if top != "warp_psf":
        found += [(line, f"uses psf.{name}, which is not public") for line, name in _used(tree) if name not in public]
    return [f"{path}:{line}: {reason}" for line, reason in sorted(found)]


def _package_rule(part: str, name: str, public: set[str]) -> str | None:
    top, *rest = name.split(".")
    if top == "mujoco" and part not in MAY_IMPORT_MUJOCO:
        return f"imports mujoco, which only {' and '.join(sorted(MAY_IMPORT_MUJOCO))} may"
    if top in OUTSIDE_THE_PACKAGE:
        return f"imports {top}, which stands on warp_psf and not under it"
    if top != "warp_psf" or part in SEES_EVERYTHING:
        return None
    if part not in ALLOWED:
        return f"has no import rule: give {part} one in {Path(__file__).name}"
    room = rest[0] if rest else "warp_psf itself"
    if room in {part, "device"} | ALLOWED[part]:
        return None
    return (
        f"imports {room}, but {part} may import {', '.join(sorted(ALLOWED[part] | {'device'} - {part})) or 'nothing'}"
    )


def _outside_rule(part: str, name: str, public: set[str]) -> str | None:
    top, *rest = name.split(".")
    if top != "warp_psf" or not rest or name == RUNNER or (len(rest) == 1 and rest[0] in public):
        return None
    return f"imports {name}, which is not a public name of warp_psf"


def _hidden_imports(tree: ast.Module) -> list[int]:
    calls = (node for node in ast.walk(tree) if isinstance(node, ast.Call))
    return [
        call.lineno
        for call in calls
        if getattr(call.func, "attr", getattr(call.func, "id", None)) in {"import_module", "__import__"}
    ]


def _used(tree: ast.Module) -> list[tuple[int, str]]:
    """(line, name) of every attribute of warp_psf that is read, under whatever name it was imported."""
    aliases = {
        alias.asname or alias.name
        for node in ast.walk(tree)
        if isinstance(node, ast.Import)
        for alias in node.names
        if alias.name == "warp_psf"
    }
    return [
        (node.lineno, node.attr)
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in aliases
    ]


def sources(*folders: str) -> list[Path]:
    return sorted(path for folder in folders for path in (ROOT / folder).rglob("*.py"))


def public_names() -> list[str]:
    import warp_psf

    return warp_psf.__all__


def test_every_file_keeps_the_import_rules():
    files = sources("warp_psf", "sims", "benchmarks")
    assert files
    public = set(public_names())
    found = [
        line
        for path in files
        for line in violations(path.relative_to(ROOT).as_posix(), path.read_text(encoding="utf-8"), public)
    ]
    assert not found, "\n".join(found)


def test_no_room_is_empty():
    rooms = [path for path in (ROOT / "warp_psf").iterdir() if path.is_dir() and path.name != "__pycache__"]
    assert rooms
    empty = [room.name for room in rooms if not any(path.name != "__init__.py" for path in room.rglob("*.py"))]
    assert not empty


def test_public_names_exist_and_are_few():
    import warp_psf

    names = public_names()
    assert len(names) <= MOST_NAMES
    assert len(set(names)) == len(names)
    assert not [name for name in names if not hasattr(warp_psf, name)]


def test_files_are_short():
    sizes = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in sources("warp_psf", "sims")}
    assert not {path.relative_to(ROOT).as_posix(): size for path, size in sizes.items() if size > MOST_LINES}


@pytest.mark.parametrize(
    ("path", "source", "complaint"),
    [
        ("warp_psf/bake/a.py", "from warp_psf.shade.direct import light", "imports shade"),
        ("warp_psf/shade/a.py", "import warp_psf.bake.body", "imports bake"),
        ("warp_psf/shade/a.py", "from ..bake import body", "imports bake"),
        ("warp_psf/shade/a.py", "from .. import bake", "imports bake"),
        ("warp_psf/film/a.py", "from warp_psf import field", "imports field"),
        ("warp_psf/basis/a.py", "def f():\n    from warp_psf.scene import mesh", "a.py:2: imports scene"),
        ("warp_psf/scene/a.py", "import warp_psf as psf", "imports warp_psf itself"),
        ("warp_psf/scene/a.py", "import mujoco", "imports mujoco"),
        ("warp_psf/cli/a.py", "from mujoco import MjModel", "imports mujoco"),
        ("warp_psf/bridge/model.py", "from sims import bodies", "imports sims"),
        ("warp_psf/cellar/a.py", "from warp_psf.basis import sh", "no import rule"),
        ("warp_psf/bake/a.py", "import importlib\nimportlib.import_module('warp_psf.shade')", "a.py:2: imports by"),
        ("sims/a.py", "from warp_psf.bake import bake_mesh", "not a public name"),
        ("sims/a.py", "from warp_psf import bake", "not a public name"),
        ("sims/a.py", "import warp_psf.cli", "not a public name"),
        ("benchmarks/a.py", "import warp_psf as psf\npsf.bake.bake_mesh()", "a.py:2: uses psf.bake"),
        ("benchmarks/a.py", "import warp_psf\nwarp_psf.secret", "uses psf.secret"),
    ],
)
def test_the_checker_reports_what_is_forbidden(path: str, source: str, complaint: str):
    found = violations(path, source, {"Renderer"})
    assert len(found) == 1
    assert complaint in found[0]


@pytest.mark.parametrize(
    ("path", "source"),
    [
        ("warp_psf/bake/a.py", "import numpy\nfrom warp_psf.field.shells import quantise\nfrom warp_psf import device"),
        ("warp_psf/shade/a.py", "from . import occlude\nfrom .occlude import compose\nfrom ..basis import sh"),
        ("warp_psf/renderer.py", "import mujoco\nfrom warp_psf.bake import bake_mesh\nfrom .shade import direct"),
        ("warp_psf/cli/a.py", "from warp_psf import Renderer\nfrom warp_psf.film.writer import read_exr"),
        ("sims/a.py", "import mujoco\nimport warp_psf as psf\nfrom sims import bodies\npsf.Renderer(None)"),
        ("sims/a.py", "from warp_psf.cli import run_simulation"),
        ("benchmarks/a.py", "from warp_psf import Renderer"),
    ],
)
def test_the_checker_accepts_what_is_allowed(path: str, source: str):
    assert violations(path, source, {"Renderer"}) == []
