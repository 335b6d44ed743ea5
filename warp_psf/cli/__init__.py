"""The command `warp-psf`, and the runner that the simulations of `sims` share with it.

What is heavy (Warp, MuJoCo, rich's tables) is imported by the command that needs it, so that `--help` answers at once.
"""

from __future__ import annotations

import typer

from warp_psf.cli.baking import bake
from warp_psf.cli.comparing import compare
from warp_psf.cli.frames import run_simulation
from warp_psf.cli.rendering import render
from warp_psf.cli.slab import slab
from warp_psf.cli.still import layered, points
from warp_psf.cli.versions import info
from warp_psf.cli.viewing import view

__all__ = ["app", "main", "run_simulation"]

app = typer.Typer(
    name="warp-psf",
    help="Soft shadows and bounced light for MuJoCo simulations, without noise.",
    add_completion=False,
    rich_markup_mode="markdown",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
for command in (render, view, slab, layered, points, bake, compare, info):
    app.command()(command)


def main() -> None:
    """Runs the command line."""
    app()
