"""How well K separable terms stand for a Phong lobe: `python -m benchmarks.separable [--json PATH]`.

Root mean square error over pairs of directions of the upper hemisphere, weighted with both cosines, relative to that of
the lobe, for K = 1, 4 and 9 terms: `ours`, the least-squares fit by products of the first bands of spherical harmonics
about fixed axes, of which the renderer uses K = 4; `series`, the lobe's own first bands; `best`, the best possible with
K terms, by singular values of the sampled lobe (Kautz and McCool 1999; Wang 2004). `energy` is what a body would send
on by each under a uniform sky, relative to the lobe.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from tests.oracles_separable import best, cut_series, fitted, four_terms, hemisphere, phong_matrix, relative_error

EXPONENTS = (1.0, 2.56, 5.0, 10.0, 20.0, 50.0)
BANDS = (1, 2, 3)
# The narrowest lobe falls to a half within 9.5 degrees; rings of directions are 4.5 apart.
RINGS, ANGLES = 20, 48


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, metavar="PATH", help="also write the numbers here")
    options = parser.parse_args()
    rows = [row for exponent in EXPONENTS for row in measure(exponent)]
    print("                 error                     energy")
    print("exponent  K     ours   series     best     ours   series")
    for row in rows:
        numbers = "".join(f"{row[key]:9.3f}" for key in ("ours", "series", "best", "ours_energy", "series_energy"))
        print(f"{row['exponent']:8g}{row['terms']:3d}{numbers}")
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n")


def measure(exponent: float) -> list[dict[str, float]]:
    """The errors of one lobe for each number of terms."""
    directions, weights = hemisphere(RINGS, ANGLES)
    lobe = phong_matrix(exponent, directions)
    energy = weights @ lobe @ weights
    rows = []
    for bands in BANDS:
        ours = four_terms(exponent, directions) if bands == 2 else fitted(lobe, directions, weights, bands)
        series = cut_series(exponent, directions, bands)
        row = {"exponent": exponent, "terms": bands * bands}
        for name, found in (("ours", ours), ("series", series), ("best", best(lobe, weights, bands * bands))):
            row[name] = relative_error(found, lobe, weights)
            row[f"{name}_energy"] = float(weights @ found @ weights / energy)
        rows.append(row)
    return rows


if __name__ == "__main__":
    main()
