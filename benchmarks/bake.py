"""What baking costs: `python -m benchmarks.bake [MODEL.xml ...] [--device D] [--json PATH]`.

A renderer is made of each model, or of a scene with one of the default shapes, with an empty cache of fields (cold) and
again with the full one (warm): seconds; `each` is cold over the number of differently named meshes; `files` is what the
cache then holds, two for a shape or one for a closed form; `bytes` are those of the fields, per mesh. Kernels are
compiled beforehand. Boxes and spheres cast shadows in closed form; of them only the light that leaves is baked.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

import warp_psf as psf
from sims import bodies

WIDTH, HEIGHT = 64, 48


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="*", type=Path, metavar="MODEL.xml", help="by default a few shapes")
    parser.add_argument("--device", metavar="D", help="cpu, cuda:0, ...")
    parser.add_argument("--json", type=Path, metavar="PATH", help="also write the numbers here")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    shapes = default_shapes()
    models = {path.stem: mujoco.MjModel.from_xml_path(str(path)) for path in options.models} or shapes
    for model in shapes.values():
        measure(model, options.device)  # compiles
    rows = []
    print(f"{'model':20}{'meshes':>8}{'cold':>9}{'each':>8}{'warm':>8}{'files':>7}{'bytes':>11}")
    for name, model in models.items():
        row: dict[str, Any] = {"model": name} | measure(model, options.device)
        rows.append(row)
        print(
            f"{name:20}{row['meshes']:8}{row['cold']:9.2f}{row['each']:8.2f}{row['warm']:8.2f}{row['files']:7}"
            f"{row['bytes']:11,.0f}",
            flush=True,
        )
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n")


def default_shapes() -> dict[str, mujoco.MjModel]:
    """Scenes of one body each: primitives, a turned body with a concave side, and an open bowl."""
    vertices, faces = bodies.ball(cells=16)
    lower = vertices[faces].mean(axis=1)[:, 2] < vertices[:, 2].mean()
    geoms = {
        "capsule": {"type": mujoco.mjtGeom.mjGEOM_CAPSULE, "size": [0.05, 0.2, 0]},
        "box": {"type": mujoco.mjtGeom.mjGEOM_BOX, "size": [0.1, 0.1, 0.1]},
        "sphere": {"type": mujoco.mjtGeom.mjGEOM_SPHERE, "size": [0.1, 0, 0]},
    }
    models = {name: one_geom(**geom) for name, geom in geoms.items()}
    models["pin (lathe)"] = one_mesh(*bodies.pin())
    models["bowl (open)"] = one_mesh(vertices, faces[lower])
    return models


def one_geom(**geom: Any) -> mujoco.MjModel:
    """A model of one geom."""
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(**geom)
    return spec.compile()


def one_mesh(vertices: np.ndarray, faces: np.ndarray) -> mujoco.MjModel:
    """A model of one mesh, which may be open."""
    spec = mujoco.MjSpec()
    mesh = spec.add_mesh(name="mesh", uservert=vertices.ravel(), userface=faces.ravel())
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="mesh")
    return spec.compile()


def measure(model: mujoco.MjModel, device: str | None) -> dict[str, float]:
    """Seconds to make a renderer with an empty and with a full cache, and what baking leaves."""
    with tempfile.TemporaryDirectory() as folder:
        os.environ["WARP_PSF_CACHE"] = folder
        cold, meshes, size = construct(model, device)
        warm, _, _ = construct(model, device)
        files = len(list(Path(folder).glob("*.field")))
    meshes = max(meshes, 1)
    return {
        "meshes": meshes,
        "cold": cold,
        "each": cold / meshes,
        "warm": warm,
        "files": files,
        "bytes": size / meshes,
    }


def construct(model: mujoco.MjModel, device: str | None) -> tuple[float, int, int]:
    """Seconds until the renderer is there, the number of meshes that were baked or read, and bytes of their fields."""
    names = set()

    def hear(what: str, share: float) -> None:
        names.add(what.removeprefix("baking light of ").removeprefix("baking "))

    begun = time.perf_counter()
    with psf.Renderer(model, HEIGHT, WIDTH, device=device, progress=hear) as renderer:
        return time.perf_counter() - begun, len(names), sum(renderer.field_bytes.values())


if __name__ == "__main__":
    main()
