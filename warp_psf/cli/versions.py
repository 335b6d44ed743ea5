"""`warp-psf info`."""

from __future__ import annotations

from pathlib import Path

import typer

from warp_psf.cli.console import one_sentence


def info() -> None:
    """Prints versions, devices, cores, and the cache folder with its size."""
    with one_sentence("stopped"):
        import platform
        from importlib.metadata import version

        import warp as wp

        from warp_psf.device import core_count, find_device
        from warp_psf.field.store import cache_folder

        lines = {"Python": platform.python_version()}
        for package in ("warp-psf", "warp-lang", "mujoco", "numpy", "trimesh", "OpenEXR", "av"):
            lines[package] = version(package)
        lines["devices"] = ", ".join(f"{device} ({device.name})" for device in wp.get_devices())
        lines["default device"] = str(find_device())
        lines["CPU cores"] = str(core_count())
        folder = Path(cache_folder())
        sizes = [entry.stat().st_size for entry in folder.rglob("*") if entry.is_file()]
        lines["cache"] = f"{folder} ({len(sizes)} files, {sum(sizes) / 1e6:.1f} MB)"
        for label, value in lines.items():
            typer.echo(f"{label:<16}{value}")
