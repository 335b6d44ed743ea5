"""The web viewer in a browser: until the first picture, and updates while the camera is dragged.

    python -m benchmarks.viewer

Opens `warp-psf view` of a simulation and a headless Chromium, which share this machine's cores, and drags the camera
with the mouse. An update is a picture that has come to the page and been given to the screen. Without a graphics card
Chromium draws on the cores as well, which a desktop's does not.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from playwright.sync_api import sync_playwright

BROWSER = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
# Counts the pictures that the page hands to the screen, and their sizes: they have the shape of the window.
COUNT = """
window.pictures = [];
for (const name of ['texImage2D', 'texSubImage2D']) {
  const real = WebGL2RenderingContext.prototype[name];
  WebGL2RenderingContext.prototype[name] = function(...given) {
    const source = given[given.length - 1];
    const aspect = (source && source.width || 0) / (source && source.height || 1);
    if (Math.abs(aspect - window.innerWidth / window.innerHeight) < 0.05)
      window.pictures.push([performance.now(), source.width, source.height]);
    return real.apply(this, given);
  };
}
"""
# Seconds: of the drag, and between two movements of the mouse, 60 of which are in a second on a desktop.
DRAG, MOVE = 8.0, 1 / 60
# Seconds after which something is wrong.
PATIENCE = 120.0
# Pixels: how far the mouse goes to both sides, and radians in a second as it goes to and fro.
REACH, PACE = 150.0, 1.5


def main() -> None:
    """Prints the table, and writes JSON if a path is given."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--simulation", default="bowling")
    parser.add_argument("--window", type=int, nargs=2, default=(1280, 720), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--slab", action="store_true", help="with a light to paint over the scene")
    parser.add_argument("--json", type=Path, help="file for the figures")
    arguments = parser.parse_args()
    extra = ["--slab"] if arguments.slab else []
    with served(arguments.simulation, *extra) as (url, opening), page_of(arguments.window) as page:
        row = {"simulation": arguments.simulation, "cores": len(os.sched_getaffinity(0)), "until open": opening}
        row |= measure(page, url)
    print(f"{row['simulation']} on {row['cores']} cores, {arguments.window[0]} x {arguments.window[1]} pixels")
    print(f"{'command to open port':<32}{row['until open']:8.2f} s")
    print(f"{'page opened to first picture':<32}{row['first']:8.2f} s")
    print(f"{'updates while dragged':<32}{row['updates']:8.1f} per second, {row['draft'][0]} x {row['draft'][1]}")
    print(f"{'still to large picture':<32}{row['sharp']:8.2f} s")
    if arguments.json:
        arguments.json.write_text(json.dumps(row, indent=1) + "\n", encoding="utf-8")


def measure(page: Any, url: str) -> dict[str, Any]:
    """Seconds to the first picture, updates per second while dragged with their size, seconds to the large picture."""
    start = time.perf_counter()
    page.goto(url)
    wait_for(page, "window.pictures.length > 0")
    first = time.perf_counter() - start
    wait_for(page, "window.pictures.length > 0 && performance.now() - window.pictures.at(-1)[0] > 2000")
    drag(page)
    # What came in the first second found the camera, the browser and the sizes of drafts at rest.
    pictures = page.evaluate("window.pictures.filter(p => p[0] > window.began + 1000)")
    updates = len(pictures) / (DRAG - 1.0)
    draft = pictures[-1][1:] if pictures else (0, 0)
    page.mouse.up()
    released = page.evaluate("performance.now()")
    wait_for(page, f"performance.now() - Math.max(window.pictures.at(-1)[0], {released}) > 2000")
    sharp = page.evaluate("window.pictures.at(-1)[0]") - released
    return {"first": first, "updates": updates, "draft": draft, "sharp": sharp / 1000.0}


def drag(page: Any) -> None:
    """Takes hold of the picture and moves it to and fro; the mouse stays down."""
    x, y = 500.0, 420.0
    page.mouse.move(x, y)
    page.mouse.down()
    page.evaluate("window.began = performance.now()")
    start = time.perf_counter()
    while (passed := time.perf_counter() - start) < DRAG:
        page.mouse.move(x + REACH * math.sin(PACE * passed), y + 0.2 * REACH * math.sin(0.7 * PACE * passed))
        page.wait_for_timeout(1000.0 * MOVE)


def wait_for(page: Any, condition: str) -> None:
    """Waits until a condition holds on the page."""
    page.wait_for_function(condition, timeout=1000.0 * PATIENCE)


@contextmanager
def served(simulation: str, *extra: str) -> Iterator[tuple[str, float]]:
    """The address of a viewer in a process of its own, and how long it took to open."""
    command = [str(Path(sys.executable).with_name("warp-psf")), "view", simulation, "--port", "0", *extra]
    start = time.perf_counter()
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            found = re.search(r"http://\S+", process.stdout.readline())
            if found is None:
                sys.exit(f"{' '.join(command)} has not opened")
            yield found[0], time.perf_counter() - start
        finally:
            process.terminate()


@contextmanager
def page_of(window: tuple[int, int]) -> Iterator[Any]:
    """A page of a headless Chromium."""
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if chromium is None:
        sys.exit("there is no Chromium on the path: install one, such as Debian's package chromium")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=list(BROWSER))
        page = browser.new_page(viewport={"width": window[0], "height": window[1]})
        page.add_init_script(COUNT)
        yield page
        browser.close()


if __name__ == "__main__":
    main()
