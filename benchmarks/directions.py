"""Which directions to cast from a sample: ours against the paper's 64 x 64 of latitude and longitude.

    python -m benchmarks.directions [--samples 48] [--json PATH]

Both against a reference of 40,000 rays in the cone of the bounding sphere, for a teapot-like body: the norm of the
coefficients' error as a share of the norm of full coverage, root mean square and maximum over samples of a shell.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

import warp_psf as psf
from sims.bodies import teapot_like
from tests.oracles_bake import baked_samples, cone_coverage, latlong_coverage

ORDER = 4
REFERENCE_RAYS = 40_000
LATLONG = 64
# Shells within the bounding sphere, near it, farther, and far.
GROUPS = {"0.2 to 0.8": (1, 2, 3), "1.0 to 1.8": (4, 5, 8), "2.0 to 2.8": (9, 13), "3.0 to 6.4": (14, 22, 31)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=48, help="samples of each shell")
    parser.add_argument("--json", type=Path, metavar="PATH", help="also write the numbers here")
    options = parser.parse_args()
    mesh = psf.make_mesh("teapot-like", *teapot_like(rings=26, segments=40))
    random = np.random.default_rng(0)
    rows = []
    print("                      ours                         64 x 64 latitude-longitude")
    print("  radii         rays       RMS   maximum            rays       RMS   maximum")
    for name, shells in GROUPS.items():
        ours, paper, rays = [], [], 0
        for shell in shells:
            chosen = random.choice(64 * 64, options.samples, replace=False)
            points, vectors, rays = baked_samples(mesh, shell, ORDER, chosen)
            reference = cone_coverage(mesh, points, ORDER, REFERENCE_RAYS)
            ours.append(vectors - reference)
            paper.append(latlong_coverage(mesh, points, ORDER, LATLONG) - reference)
        row = {"radii": name, "ours": {"rays": rays} | summarise(ours)}
        row["latlong"] = {"rays": LATLONG**2} | summarise(paper)
        rows.append(row)
        cells = [
            f"{row[key]['rays']:>8}{row[key]['rms']:>10.5f}{row[key]['maximum']:>10.5f}" for key in ("ours", "latlong")
        ]
        print(f"  {name:<10}" + "        ".join(cells))
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n")


def summarise(errors: list[np.ndarray]) -> dict[str, float]:
    """Root mean square and maximum of the errors' norms, as shares of the norm of full coverage."""
    norms = np.linalg.norm(np.concatenate(errors), axis=1) / np.sqrt(4 * np.pi)
    return {"rms": float(np.sqrt((norms**2).mean())), "maximum": float(norms.max())}


if __name__ == "__main__":
    main()
