"""Hemispherical rasterisation: the tables of Kautz 2004. `python -m benchmarks.hemisphere [--json PATH]`

Four bodies of the paper's sizes in motion. Table 1: how many triangles each vertex considers, frames per second on all
cores, and the error of the transfer against ray casting at all of the fine triangles, each without and with potentially
visible sets. The sets are learned from every other frame of the motion; rates and errors are of frames between those.
The paper's rates are of two processors of 3.06 GHz, for vertices of faces that the camera sees; ours are for all.
Table 2: where the time goes. Then the errors of masks alone, which take all fine triangles, beside those of the whole
method, by order, and with a Phong lobe. Last, the time of a frame over the number of vertices at a fixed coarse mesh.
"""

import argparse
import json
import os
import time
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from sims import chess_pieces, cloth, figure, hand
from sims.bodies import ball
from tests.oracles_hemisphere import HemisphereRun, phong_transfer, relative_error, traced_transfer, vertex_normals

ORDER, ORDERS, EXPONENT = 5, (3, 4, 5, 6), 10.0
# Frames of a motion, every other one of which visible sets are learned from, and simulated seconds of a cloth's fall.
FRAMES, FALL = 48, 3.0
# A rate is measured over at least so many seconds.
LONG_ENOUGH = 2.0
# Towards the viewer, in whose mirrored directions lobes are.
VIEW = np.array([0.0, -0.8, 0.6])
# How far chess pieces go round their board, radians, by how much they spread, shares of their distances, and how high
# they hop, metres.
TURN, SPREAD, HOP = 0.5 * np.pi, 0.8, 0.15
# Cells along the edges of the cube from which lumpy balls are made: 1,016 to 63,656 vertices. Their coarse mesh.
CELLS, LUMPY_COARSE = (13, 18, 26, 37, 52, 73, 103), 400
# Tables 1 and 2.
PAPER = {
    "cloth": {"vertices": 1378, "triangles": 2560, "coarse triangles": 160, "triangles per vertex": 236.4}
    | {"frames/s": 15.5, "error, %": 2.47},
    "fight": {"vertices": 2978, "triangles": 4806, "coarse triangles": 444, "triangles per vertex": 448.8}
    | {"with sets": 99.5, "frames/s": 4.9, "frames/s with sets": 9.5, "error, %": 7.93},
    "chess": {"vertices": 1897, "triangles": 3704, "coarse triangles": 382, "triangles per vertex": 378.8}
    | {"with sets": 73.9, "frames/s": 7.8, "frames/s with sets": 15.1, "error, %": 2.89},
    "hand": {"vertices": 8636, "triangles": 15854, "coarse triangles": 378, "triangles per vertex": 414.1}
    | {"with sets": 49.7, "frames/s": 2.6, "frames/s with sets": 6.1, "error, %": 3.82},
}
PAPER_SHARES = {
    "cloth": {"rasterisation": 0.480, "integration": 0.235, "transform": 0.265, "other": 0.020},
    "fight": {"rasterisation": 0.544, "integration": 0.194, "transform": 0.244, "other": 0.018},
    "chess": {"rasterisation": 0.520, "integration": 0.238, "transform": 0.219, "other": 0.023},
    "hand": {"rasterisation": 0.423, "integration": 0.352, "transform": 0.194, "other": 0.031},
}
METHODS = ("masks alone", "two levels", "with sets")


@dataclass(frozen=True, eq=False)
class Motion:
    """A body in motion: faces [F, 3] over the vertices [V, 3] of each frame."""

    faces: np.ndarray
    frames: list[np.ndarray]

    def normals(self) -> list[np.ndarray]:
        """Unit vertex normals of each frame, [V, 3]."""
        return [vertex_normals(vertices, self.faces) for vertices in self.frames]

    def learned(self) -> list[np.ndarray]:
        """The frames that visible sets come from."""
        return self.frames[::2]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=list(SCENES))
    parser.add_argument("--frames", type=int, default=3, help="of each motion whose errors are measured")
    parser.add_argument("--rays", type=int, default=2048, help="from each vertex, for the reference")
    parser.add_argument("--json", type=Path, metavar="PATH", help="also write the numbers here")
    options = parser.parse_args()
    found: dict = {"table 1": {}, "table 2": {}, "errors": {}}
    for name in options.scenes:
        print(f"{name} ...", flush=True)
        motion = SCENES[name]()
        found["table 1"][name], found["table 2"][name] = measure_rates(name, motion)
        found["errors"][name] = errors = measure_errors(name, motion, options.frames, options.rays)
        for label, method in (("error, %", "two levels"), ("error with sets, %", "with sets")):
            found["table 1"][name][label] = 100 * errors[method][f"order {ORDER}"]
    print_table(found["table 1"])
    print_shares(found["table 2"])
    print_errors(found["errors"])
    found["slope"] = print_slope()
    if options.json:
        options.json.write_text(json.dumps(found, indent=1) + "\n")


# Bodies in motion


def fall_cloth() -> Motion:
    model = cloth.build()
    frames = [np.array(data.flexvert_xpos, float) for data in cloth.states(model, FRAMES / FALL, FALL)]
    return Motion(np.asarray(model.flex_elem, np.int32).reshape(-1, 3), frames[:FRAMES])


def dance() -> Motion:
    """The figure, for the paper's fighting man."""
    model = figure.build()
    view, camera, option = mujoco.MjvScene(model, maxgeom=1000), mujoco.MjvCamera(), mujoco.MjvOption()
    option.flags[mujoco.mjtVisFlag.mjVIS_SKIN] = True
    frames = []
    for data in figure.states(model, FRAMES / figure.PERIOD, figure.PERIOD):
        mujoco.mjv_updateScene(model, data, option, None, camera, mujoco.mjtCatBit.mjCAT_ALL, view)
        frames.append(np.array(view.skinvert, float).reshape(-1, 3))
    return Motion(np.array(model.skin_face, np.int32).reshape(-1, 3), frames[:FRAMES])


def play_chess() -> Motion:
    """Pieces that slide round the middle of their board and away from it, and hop one after another."""
    vertices, faces, piece_of_vertex = chess_pieces.benchmark_set()
    pieces = range(1, piece_of_vertex.max() + 1)  # 0 is the board
    feet = [vertices[piece_of_vertex == piece, :2] for piece in pieces]
    middle = vertices[piece_of_vertex == 0, :2].mean(axis=0)
    place = np.array([0.5 * (foot.min(axis=0) + foot.max(axis=0)) for foot in feet])
    frames = []
    for share in np.arange(FRAMES) / FRAMES:
        turn, spread = TURN * share, 1.0 + SPREAD * np.sin(np.pi * share) ** 2
        rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        moved = np.zeros((len(place) + 1, 3))
        moved[1:, :2] = spread * (place - middle) @ rotation.T + middle - place
        hopping, part = divmod(share * len(place), 1.0)
        moved[1 + int(hopping), 2] = HOP * np.sin(np.pi * part) ** 2
        frames.append(vertices + moved[piece_of_vertex])
    return Motion(faces, frames)


def move_hand() -> Motion:
    return Motion(hand.hand()[1], list(hand.poses(FRAMES)))


SCENES = {"cloth": fall_cloth, "fight": dance, "chess": play_chess, "hand": move_hand}


def lumpy_ball(cells: int) -> tuple[np.ndarray, np.ndarray]:
    """A ball of radius 1 with lumps that shadow one another, 6 cells^2 + 2 vertices."""
    vertices, faces = ball(cells=cells, diameter=2.0)
    lumps = np.prod(np.sin(5.0 * vertices + (0.0, 0.0, 0.5)), axis=1)
    return vertices * (1.0 + 0.3 * lumps[:, None]), faces


# Measurements


def measure_rates(name: str, motion: Motion) -> tuple[dict, dict]:
    """What stands in the columns of tables 1 (without errors) and 2."""
    normals = motion.normals()
    coarse = PAPER[name]["coarse triangles"]
    run = HemisphereRun.prepare(motion.frames[0], normals[0], motion.faces, ORDER, coarse)
    found = {"vertices": len(normals[0]), "triangles": len(motion.faces), "coarse triangles": run.coarse_triangles}
    found |= {"frames/s": 1 / time_frame(run, motion.frames[1::2], normals[1::2])}
    found |= {"triangles per vertex": mean_triangles(run, motion, normals)}
    shares = run.stage_shares(motion.frames[FRAMES // 2], normals[FRAMES // 2])
    run.learn(motion.learned(), normals[::2])
    found |= {"frames/s with sets": 1 / time_frame(run, motion.frames[1::2], normals[1::2])}
    found |= {"with sets": mean_triangles(run, motion, normals)}
    return found, shares


def time_frame(run: HemisphereRun, frames: list[np.ndarray], normals: list[np.ndarray]) -> float:
    """Seconds of a frame on the average, after a round that compiles."""
    run.update(frames[0], normals[0])
    count, start = 0, time.perf_counter()
    while time.perf_counter() < start + LONG_ENOUGH:
        run.update(frames[count % len(frames)], normals[count % len(frames)])
        count += 1
    return (time.perf_counter() - start) / count


def mean_triangles(run: HemisphereRun, motion: Motion, normals: list[np.ndarray]) -> float:
    """Triangles per vertex, the mean over frames."""
    counts = []
    for vertices, normal in zip(motion.frames[1::2], normals[1::2], strict=True):
        run.update(vertices, normal)
        counts.append(run.triangles_per_vertex())
    return float(np.mean(counts))


def measure_errors(name: str, motion: Motion, count: int, rays: int) -> dict[str, dict[str, float]]:
    """Mean relative errors of every method by order and with a lobe, and those of the reference itself."""
    # In the middles of equal parts of the motion.
    chosen = [2 * int((part + 0.5) / count * (FRAMES // 2)) + 1 for part in range(count)]
    runs = prepare_methods(name, motion)
    body = runs[METHODS[0]]
    errors: dict = {method: [] for method in [*METHODS, "reference"]}
    left_out = []
    for index in chosen:
        expected = trace(motion, index, rays, body)
        left_out.append([relative_error(v, v)[1] for v in (expected[0][:, : ORDER**2], expected[1][expected[2]])])
        if index == chosen[count // 2]:
            # Two references differ by the square root of two times the error of one.
            again = trace(motion, index, rays, body, seed=1)
            errors["reference"].append(np.sqrt(0.5) * compare(again[0], again[1], expected))
        vertices, normals = motion.frames[index], vertex_normals(motion.frames[index], motion.faces)
        for method, run in runs.items():
            run.update(vertices, normals)
            gloss = run.gloss(eye_of(vertices), EXPONENT)
            errors[method].append(compare(run.transfer(), gloss, expected))
    labels = [*(f"order {order}" for order in ORDERS), "lobe"]
    found: dict = {}
    for method, rows in errors.items():
        found[method] = dict(zip(labels, map(float, np.mean(rows, axis=0)), strict=True))
    found["left out"] = dict(zip(("transfer", "lobe"), map(float, np.mean(left_out, axis=0)), strict=True))
    return found


def prepare_methods(name: str, motion: Motion) -> dict[str, HemisphereRun]:
    """A run of every method, on the most bands: vectors of fewer are the beginnings of theirs."""
    normals, runs = vertex_normals(motion.frames[0], motion.faces), {}
    for method in METHODS:
        coarse = None if method == "masks alone" else PAPER[name]["coarse triangles"]
        runs[method] = HemisphereRun.prepare(motion.frames[0], normals, motion.faces, ORDERS[-1], coarse)
    runs["with sets"].learn(motion.learned(), motion.normals()[::2])
    return runs


def trace(
    motion: Motion, index: int, rays: int, body: HemisphereRun, seed: int = 0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The reference for a frame: transfer on the most bands, and with a lobe, and which vertices face the viewer."""
    vertices, normals = motion.frames[index], vertex_normals(motion.frames[index], motion.faces)
    toward = eye_of(vertices) - vertices
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    cosine = np.sum(normals * toward, axis=1)
    mirrored = 2.0 * cosine[:, None] * normals - toward
    blockers, offset = (vertices, motion.faces, body.two_sided), body.offset
    transfer, _ = traced_transfer(vertices, normals, *blockers, ORDERS[-1], rays, offset, seed)
    gloss = phong_transfer(vertices, normals, mirrored, EXPONENT, *blockers, ORDER, rays, offset, seed)
    return transfer, gloss, cosine > 0.0


def compare(transfer: np.ndarray, gloss: np.ndarray, expected: tuple[np.ndarray, np.ndarray, np.ndarray]) -> np.ndarray:
    """Mean relative errors by order, and with the lobe of vertices that face the viewer."""
    every, glossy, facing = expected
    errors = [relative_error(transfer[:, : order**2], every[:, : order**2])[0] for order in ORDERS]
    return np.array([*errors, relative_error(gloss[facing, : ORDER**2], glossy[facing])[0]])


def eye_of(vertices: np.ndarray) -> np.ndarray:
    """Where a viewer of a body stands, metres [3]."""
    return vertices.mean(axis=0) + 3.0 * np.ptp(vertices, axis=0).max() * VIEW


# Tables


def print_table(rows: dict[str, dict]) -> None:
    """Table 1, the paper's numbers in brackets."""
    print(f"\ntable 1 (paper), on {len(os.sched_getaffinity(0))} cores")
    print(" " * 22 + "".join(f"{name:>22}" for name in rows))
    places = {"vertices": 0, "triangles": 0, "coarse triangles": 0, "triangles per vertex": 1, "with sets": 1}
    places |= {"frames/s": 1, "frames/s with sets": 1, "error, %": 2, "error with sets, %": 2}
    for label, digits in places.items():
        cells = [f"{row[label]:.{digits}f} ({PAPER[name].get(label, '-'):>6})" for name, row in rows.items()]
        print(f"{label:22}" + "".join(f"{cell:>22}" for cell in cells))
    ratios = [f"{row['frames/s'] / PAPER[name]['frames/s']:.1f} x" for name, row in rows.items()]
    print(f"{'frames/s over paper':22}" + "".join(f"{ratio:>22}" for ratio in ratios))


def print_shares(rows: dict[str, dict]) -> None:
    """Table 2."""
    print("\ntable 2: shares of the time of a frame, % (paper)")
    for name, shares in rows.items():
        cells = [
            f"{stage} {100 * share:5.1f} ({100 * PAPER_SHARES[name][stage]:4.1f})" for stage, share in shares.items()
        ]
        print(f"  {name:8}" + "   ".join(cells))


def print_errors(rows: dict[str, dict]) -> None:
    """The errors split up."""
    print("\nmean relative error of the transfer, %, by order")
    print(f"lobe: with a Phong lobe of exponent {EXPONENT:.0f}, order {ORDER}; reference: the rays' own error")
    for name, errors in rows.items():
        for method in [*METHODS, "reference"]:
            cells = "".join(f"{label:>10} {100 * error:5.2f}" for label, error in errors[method].items())
            print(f"  {name:8}{method:12}{cells}")
        left_out = errors["left out"]
        print(f"  {name:8}left out, as all but dark: {left_out['transfer']:.0f}; of the lobe {left_out['lobe']:.0f}")


def print_slope() -> dict:
    """The time of a frame over the number of vertices."""
    print(f"\na lumpy ball with {LUMPY_COARSE} coarse triangles")
    rows = []
    for cells in CELLS:
        vertices, faces = lumpy_ball(cells)
        normals = vertex_normals(vertices, faces)
        run = HemisphereRun.prepare(vertices, normals, faces, ORDER, LUMPY_COARSE)
        seconds = time_frame(run, [vertices], [normals])
        rows.append({"vertices": len(vertices), "seconds": seconds, "triangles": run.triangles_per_vertex()})
        print(
            f"  {len(vertices):6} vertices {1e3 * seconds:9.2f} ms {1e6 * seconds / len(vertices):7.2f} us per vertex "
            f"{rows[-1]['triangles']:7.1f} triangles per vertex",
            flush=True,
        )
    counts, times = ([row[label] for row in rows] for label in ("vertices", "seconds"))
    exponent = float(np.polyfit(np.log(counts), np.log(times), 1)[0])
    print(f"  the time goes as vertices^{exponent:.2f}")
    return {"rows": rows, "exponent": exponent}


if __name__ == "__main__":
    main()
