"""`warp-psf compare`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

import typer

from warp_psf.cli.console import fail, one_sentence, print_table


def compare(
    first: Annotated[Path, typer.Argument(metavar="A", help="An EXR or PNG image, or a folder of frames.")],
    second: Annotated[Path, typer.Argument(metavar="B", help="What A is compared with.")],
) -> None:
    """Prints how far two images, or two folders of frames, are apart: RMSE and largest difference.

    EXR images are compared as linear light, PNG images as display values in [0, 1].
    Exit status 1: sizes or frames differ.
    """
    with one_sentence("stopped"):
        from warp_psf.film.writer import image_difference

        pairs, complaints = _pair_images(first, second)
        rows = []
        for label, paths in pairs:
            a, b = (_read_image(path) for path in paths)
            if a.shape != b.shape:
                sizes = " and ".join(f"{image.shape[1]}x{image.shape[0]}" for image in (a, b))
                complaints.append(f"{label}: the sizes differ, {sizes}")
                continue
            difference = image_difference(a, b)
            rows.append((label, difference["rmse"], difference["maximum"]))
        if len(rows) > 1:
            whole = math.sqrt(sum(rmse * rmse for _, rmse, _ in rows) / len(rows))
            rows.append(("all", whole, max(largest for _, _, largest in rows)))
        if rows:
            print_table(("frame", "RMSE", "max"), [(row[0], f"{row[1]:.6f}", f"{row[2]:.6f}") for row in rows])
        if complaints:
            fail("; ".join(complaints), 1)


def _pair_images(first: Path, second: Path) -> tuple[list[tuple[str, tuple[Path, Path]]], list[str]]:
    """The pairs (label, (A, B)) to compare, and a complaint for each image that only one of two folders has."""
    for path in (first, second):
        if not path.exists():
            raise FileNotFoundError(f"{path} does not exist: name an image or a folder of frames")
    if first.is_file() and second.is_file():
        if first.suffix.lower() != second.suffix.lower():
            raise ValueError(f"{first} and {second} are of different kinds: compare EXR with EXR, or PNG with PNG")
        return [(first.name, (first, second))], []
    if first.is_file() or second.is_file():
        raise ValueError(f"{first} and {second}: compare two images or two folders, not one with the other")
    # The EXR frames of a sequence are what its PNG frames were made from.
    for suffix in (".exr", ".png"):
        left, right = ({path.relative_to(top) for path in top.rglob(f"*{suffix}")} for top in (first, second))
        if left and right:
            complaints = [f"{name} is only in {first if name in left else second}" for name in sorted(left ^ right)]
            return [(str(name), (first / name, second / name)) for name in sorted(left & right)], complaints
    raise ValueError(f"{first} and {second} hold no frames of the same kind: neither EXR nor PNG is in both")


def _read_image(path: Path) -> Any:
    """An EXR's colour or a PNG as float [height, width, 3]."""
    from warp_psf.film.writer import read_exr, read_png

    if path.suffix.lower() == ".exr":
        layers = read_exr(path)
        if "color" not in layers:
            raise ValueError(f"{path} has no R, G and B channels: only colour is compared")
        return layers["color"]
    if path.suffix.lower() == ".png":
        return read_png(path) / 255.0
    raise ValueError(f"{path} is neither an EXR nor a PNG image")
