"""The API reference: pages of HTML from the docstrings of the public names. `make reference` writes out/reference."""

import re
import sys
from pathlib import Path
from types import ModuleType

import mujoco
import pdoc
import pdoc.render

import warp_psf

# pdoc takes every module without an underscore for a public one: all but these are told to it as left out.
MODULES = ("warp_psf", "warp_psf.area_light", "warp_psf.area_light.templates")
OTHERS = f"!(?!({'|'.join(MODULES)})$)"
TEMPLATES = Path(__file__).with_suffix("")


def bring_names(module: ModuleType) -> None:
    """Makes pdoc see a module's public names, in the order in which its docstring tells of them.

    pdoc reads the module's dictionary, where names that come on first use are not before it.
    """
    vars(module).update({name: getattr(module, name) for name in module.__all__})
    module.__all__ = sorted(module.__all__, key=lambda name: place_of(name, module))


def place_of(name: str, module: ModuleType) -> int:
    """Where the docstring of a module names one of its names, in full or alone."""
    found = re.search(rf"`({module.__name__}\.)?{name}`", module.__doc__ or "")
    if found is None:
        raise ValueError(f"the docstring of {module.__name__} says nothing of {name}; name it there in backticks")
    return found.start()


def main(folder: Path) -> None:
    """Writes the pages into a folder; index.html leads to the first one."""
    for module in (warp_psf, warp_psf.area_light):
        bring_names(module)
    # MuJoCo's types say that they live in private modules; scripts find them in mujoco.
    for kind in (mujoco.MjData, mujoco.MjModel, mujoco.MjvCamera, mujoco.MjvOption, mujoco.MjvScene):
        kind.__module__ = "mujoco"
    pdoc.render.configure(
        docformat="google", include_undocumented=False, show_source=False, template_directory=TEMPLATES
    )
    pdoc.pdoc(MODULES[0], OTHERS, output_directory=folder)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
