"""What a long run holds: `python -m benchmarks.memory`.

Renders ten thousand frames of scattered bodies (those of benchmarks.scaling) between two states, in small pictures with
three bounces, and prints the resident set of the process and what Warp's arrays hold after 10, 100, 1,000 and 10,000
frames, MiB, and by how many KiB per frame the resident set grew from row to row. It needs Linux.
"""

import argparse

from benchmarks.scaling import FEW, Run, array_bytes, build, open_renderer, render_frame, resident_bytes, two_states


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--frames", type=int, default=10_000)
    parser.add_argument("--size", default="160x90", metavar="WxH")
    parser.add_argument("--order", type=int, default=4)
    parser.add_argument("--bounces", type=int, default=3)
    parser.add_argument("--device")
    options = parser.parse_args()
    model = build(FEW)
    states = two_states(model)
    run = Run(FEW, options.size, options.order, options.bounces, cores=0)
    print(f"{'frames':>8}{'resident':>10}{'arrays':>8}{'KiB per frame':>15}")
    with open_renderer(model, run, options) as renderer:
        shown, before = 0, 0
        for frame in range(1, options.frames + 1):
            render_frame(renderer, states[frame % 2])
            if frame in (10, 100, 1_000, 10_000) or frame == options.frames:
                resident = resident_bytes()
                growth = f"{(resident - before) / 1024 / (frame - shown):.2f}" if shown else ""
                print(f"{frame:8}{resident / 2**20:10.1f}{array_bytes() / 2**20:8.1f}{growth:>15}", flush=True)
                shown, before = frame, resident


if __name__ == "__main__":
    main()
