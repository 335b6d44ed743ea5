"""What the README names is there, and the figure of how it works maps directions as it says."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from docs.method import disc_directions, disc_places

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("path", sorted(set(re.findall(r"!\[[^\]]*\]\(([^)]+)\)", README))))
def test_pictures_of_the_readme_exist(path: str):
    assert (ROOT / path).is_file()


@pytest.mark.parametrize("name", sorted(set(re.findall(r"\bbenchmarks\.(\w+)", README))))
def test_benchmarks_of_the_readme_exist(name: str):
    assert (ROOT / "benchmarks" / f"{name}.py").is_file()


def test_a_direction_lies_where_the_map_shows_it():
    directions, inside = disc_directions(64)
    y, x = np.nonzero(inside)
    assert np.allclose(np.linalg.norm(directions[inside], axis=-1), 1.0)
    assert np.allclose(disc_places(directions[inside], 64), np.stack([x, y], axis=-1) + 0.5, atol=1e-9)


def test_equal_areas_of_the_map_are_equal_solid_angles():
    directions, inside = disc_directions(400)
    # Over half of the sphere the mean of z is 1/2, and that of z^2 is 1/3; pixels at the rim lie in or out as a whole.
    z = directions[inside][:, 2]
    assert abs(z.mean() - 1 / 2) < 1 / 400
    assert abs((z**2).mean() - 1 / 3) < 1 / 400
