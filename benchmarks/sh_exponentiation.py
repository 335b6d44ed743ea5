"""Logarithms of visibility against products: the tables and figures of the supplement to Ren 2006.

    python -m benchmarks.sh_exponentiation --bunny FILE [--json PATH]

A plane of 128 x 128 receivers under a bunny of 63 spheres, without which a statue of ours stands there. RMS of the
visibility vectors and of the shaded value, relative to those of TRIP (the triple products of all spheres, nearest
first). The supplement does not say how large its plane is, on which the errors depend as 1 / side; ours is given in
units of the bunny. Then the error of both logarithms over the subtended angle (figure 1), and on the plane (figure 2),
the renderer's shading pass in log and in product space (figure 3), and a skinned figure against ray casting.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

import warp_psf as psf
from benchmarks.frame import measure_direct
from sims import figure
from sims.bodies import statue_like
from tests import oracles_log
from tests.oracles import loose_triangles, shade_points, traced_irradiance

ORDER, SPHERES, RESOLUTION, SIDE = 4, 63, 128, 12.0
# Environment, and how high the bunny floats, in its own size: so that the largest norms of logarithms are the paper's.
SETTINGS = {"norm 16.5, studio": ("studio", 0.116), "norm 12.8, sunset": ("sunset", 0.172)}
# The supplement's: RMS of the vector, RMS of the shaded value; kitchen and beach.
PAPER = {
    "PS*-9": ((0.009122, 0.002740), (0.003261, 0.004354)),
    "PS*-2": ((0.01009, 0.002875), (0.004136, 0.004436)),
    "HYB": ((0.009133, 0.002795), (0.004035, 0.004446)),
    "OL": ((0.017135, 0.0241328), (0.011595, 0.012560)),
    "PS-2": ((0.085408, 0.222010), (0.049708, 0.147138)),
    "PS-3": ((0.095092, 0.371026), (0.040657, 0.162911)),
    "PS-4": ((0.144249, 0.750868), (0.038439, 0.228313)),
    "PS-21": ((0.0055160, 0.0046910), None),
    "PS-30": ((0.002121, 0.009653), None),
}
# Figure 3: total rendering speed-up in log space.
PAPER_SPEED_UP = {3: 1.9, 4: 3.4, 5: 6.5, 6: 11.0}
SPEED_SCENES = ("bowling", "falling")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bunny", type=Path, help="the Stanford bunny, an OBJ file with y up")
    parser.add_argument("--side", type=float, default=SIDE, help="of the plane, in units of the body")
    parser.add_argument("--json", type=Path, metavar="PATH", help="also write the numbers here")
    options = parser.parse_args()
    center, radius, size = oracles_log.stand_spheres(load_body(options.bunny), SPHERES)
    found: dict = {"table": {}}
    for setting, (name, lift) in SETTINGS.items():
        plane = oracles_log.make_plane(center + np.array([0, 0, lift * size]), radius, options.side * size, RESOLUTION)
        which = list(SETTINGS).index(setting)
        found["table"][setting] = print_table(setting, plane, psf.load_environment(name).project(ORDER), which)
    found["figure 1"] = print_angles(center, radius, size)
    found["figure 2"] = print_logarithms(center, radius, options.side * size)
    found["figure 3"] = print_speed()
    found["figure"] = print_skin()
    if options.json:
        options.json.write_text(json.dumps(found, indent=1) + "\n")


def load_body(bunny: Path | None) -> psf.Mesh:
    if bunny is not None:
        return psf.load_mesh(bunny)
    vertices, faces = statue_like(cells=40)
    return psf.make_mesh("statue", vertices[:, [0, 2, 1]] * (1, 1, -1), faces)


def relative(found: np.ndarray, expected: np.ndarray) -> float:
    return float(np.sqrt(((found - expected) ** 2).sum() / (expected**2).sum()))


def print_table(setting: str, plane: oracles_log.Plane, environment: np.ndarray, which: int) -> list[dict]:
    """The supplement's table for one environment."""
    expected, _, _ = oracles_log.run_method(plane, "TRIP", ORDER)
    light = oracles_log.light_times_cosine(environment, ORDER)
    _, logarithms, _ = oracles_log.run_method(plane, "OL", ORDER)
    print(f"\n{setting}: largest norm of a logarithm {np.linalg.norm(logarithms, axis=1).max():.2f}")
    print("          RMS vector (paper)    RMS shaded (paper)    squares  products   receivers/s")
    rows = []
    for method in oracles_log.METHODS:
        visible, _, seconds = oracles_log.run_method(plane, method, ORDER)
        squares, products = oracles_log.count_products(plane, method, logarithms)
        errors = relative(visible, expected), relative(visible @ light.T, expected @ light.T)
        paper = PAPER.get(method, (None, None))[which] or ("", "")
        cells = "".join(f"{error:12.6f} ({of_paper or '-':>8})" for error, of_paper in zip(errors, paper, strict=True))
        print(f"{method:6}{cells} {squares:9} {products:9} {len(visible) / seconds:13,.0f}", flush=True)
        rows.append({"method": method, "vector": errors[0], "shaded": errors[1], "squares": squares})
        rows[-1] |= {"products": products, "receivers_per_second": len(visible) / seconds}
    best = relative(best_line(logarithms, expected), expected)
    print(f"the best that any a 1 + b f does, chosen anew for each receiver: {best:.6f}", flush=True)
    return [*rows, {"method": "best line", "vector": best}]


def best_line(f: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Of every receiver the combination of 1 and f [R, n*n] that is nearest to what is expected."""
    first = expected[:, 0] - f[:, 0] * (f[:, 1:] * expected[:, 1:]).sum(axis=1) / (f[:, 1:] ** 2).sum(axis=1)
    found = f * ((f[:, 1:] * expected[:, 1:]).sum(axis=1) / (f[:, 1:] ** 2).sum(axis=1))[:, None]
    found[:, 0] += first
    return found


def print_angles(center: np.ndarray, radius: np.ndarray, size: float) -> list[dict]:
    """Figure 1: relative error over the angle that one sphere, or the whole body, spans at a receiver under it."""
    print("\nfigure 1: relative error of the logarithms, PS*-9      one sphere                 the body")
    print("  half-angle                                    inversion  integration    inversion  integration")
    rows = []
    middle = 0.5 * (center.min(axis=0) + center.max(axis=0))
    reach = float((np.linalg.norm(center - middle, axis=1) + radius).max())
    for angle in np.linspace(0.1, 1.5, 15):
        errors = []
        away = np.array([0.0, 0.0, 1.0]) / np.sin(angle)
        for places, radii in ((away[None], np.ones(1)), ((center - middle) / reach + away, radius / reach)):
            plane = oracles_log.make_plane(places, radii, 1e-6, 1)
            expected, _, _ = oracles_log.run_method(plane, "TRIP", ORDER, repeats=1)
            for inversion in (True, False):
                logarithm = oracles_log.log_sum(plane, ORDER, inversion)
                errors.append(relative(exponentiate(logarithm), expected))
        print(f"  {angle:10.2f}" + " " * 34 + "{:11.4f}{:13.4f}{:13.4f}{:13.4f}".format(*errors))
        rows.append({"angle": float(angle), "sphere": errors[:2], "body": errors[2:]})
    return rows


def print_logarithms(center: np.ndarray, radius: np.ndarray, side: float) -> dict[str, float]:
    """Figure 2: both logarithms on the plane of the table."""
    plane = oracles_log.make_plane(center, radius, side, 48)
    expected, _, _ = oracles_log.run_method(plane, "TRIP", ORDER, repeats=1)
    errors = {
        name: relative(exponentiate(oracles_log.log_sum(plane, ORDER, inversion)), expected)
        for name, inversion in (("inversion", True), ("integration", False))
    }
    print("\nfigure 2, RMS on the plane: " + ", ".join(f"{name} {error:.4f}" for name, error in errors.items()))
    return errors


def exponentiate(logarithm: np.ndarray) -> np.ndarray:
    """PS*-9, with which the figures compare the logarithms."""
    return oracles_log.sh_exp.scaled_power_series(logarithm, 9)


def print_speed() -> list[dict]:
    """Figure 3: the whole shading pass of the renderer, in both spaces."""
    print("\nfigure 3: shading pass of a frame of 640x360, ms")
    rows = []
    for scene in SPEED_SCENES:
        for order, paper in PAPER_SPEED_UP.items():
            seconds = {compose: measure_direct(scene, order, compose) for compose in ("product", "log")}
            ratio = seconds["product"] / seconds["log"]
            print(
                f"  {scene:9} order {order}: product {1e3 * seconds['product']:7.1f}  log {1e3 * seconds['log']:7.1f}"
                f"  speed-up {ratio:5.2f} (paper {paper})",
                flush=True,
            )
            rows.append({"scene": scene, "order": order, "speed_up": ratio} | seconds)
    return rows


def print_skin() -> list[dict]:
    """The ground under the walking figure against ray casting, in units of unshadowed irradiance."""
    model = figure.build()
    x = np.linspace(-1.4, 1.4, 40)
    points = np.stack([*np.meshgrid(x, x), np.zeros((40, 40))], axis=-1).reshape(-1, 3)
    normals = np.broadcast_to((0.0, 0.0, 1.0), points.shape)
    rows = []
    print("\na skinned figure on its ground, RMSE over unshadowed irradiance (without its shadow)")
    for order in (4, 6):
        light = psf.Environment.from_coefficients(psf.load_environment("studio").project(order))
        errors = []
        with psf.Renderer(model, 4, 4, bounces=0, environment=light, order=order, model_lights=False) as renderer:
            for frame, data in enumerate(figure.states(model, 30, figure.PERIOD)):
                if frame % 12 == 0:
                    renderer.update_scene(data, "front")
                    renderer.layers()
                    found, _ = shade_points(renderer, "floor", points, normals)
                    loose, coefficients = loose_triangles(renderer), light.project(order)
                    expected = traced_irradiance(model, data, points, normals, coefficients, loose=loose)
                    clear = traced_irradiance(model, data, points, normals, coefficients)
                    errors.append([np.mean(((a - expected) / clear.max()) ** 2) for a in (found, clear)])
        rmse, without = np.sqrt(np.mean(errors, axis=0))
        print(f"  order {order}: {rmse:.4f} ({without:.4f})", flush=True)
        rows.append({"order": order, "rmse": float(rmse), "without": float(without)})
    return rows


if __name__ == "__main__":
    main()
