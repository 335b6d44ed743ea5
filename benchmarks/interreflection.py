"""How far bounced light is from traced paths: `python -m benchmarks.interreflection`.

A bunny between coloured walls, bowling, falling and a room, one frame each, in their own environment (of order 4) and
area lights, every surface Lambert. Every pixel's centre is compared with paths from the same point. For the error the
reference is scaled to a mean luminance of 0.5 and both are clamped to [0, 1], as in figures 9 and 10 of Iwasaki 2007;
energies are means of the unclamped radiance.
"""

import argparse
import dataclasses
import importlib
import json
from collections import deque
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image

import warp_psf as psf
from benchmarks.accuracy import LUMINANCE, pixel_points
from sims import add_material, add_mesh, draw_box, draw_mesh, new_stage
from sims.bodies import statue_like
from tests.oracles_bounce import WorldMeshes, traced_bounces, world_meshes

ORDER = 4
BOUNCES = 3
# Simulated seconds at which each scene is compared: bodies in the air, lying and standing.
MOMENTS = {"bunny": 0.0, "bowling": 2.0, "falling": 2.5, "room": 1.0, "statues": 1.0, "teapots": 1.0}
# Metres that the body between the walls is high.
BUNNY_HEIGHT = 1.0
# Neighbouring pixels on one smooth surface: the cosine between their normals is at least this.
SAME_NORMAL = 0.97
# Mitsuba's environment image: cells of a degree, between which it interpolates light that turns within 45.
ENVMAP_ROWS = 180


@dataclasses.dataclass(frozen=True)
class Case:
    """A frame to compare: SH coefficients of the environment [ORDER^2, 3], area lights, and what the body is."""

    name: str
    model: mujoco.MjModel
    data: mujoco.MjData
    coefficients: np.ndarray
    lights: tuple[psf.AreaLight, ...]
    size: tuple[int, int]


@dataclasses.dataclass(frozen=True)
class Reference:
    """Radiance at the pixels that see a surface, bool [H, W], by bounce, [2 halves, BOUNCES + 1, N, 3]."""

    seen: np.ndarray
    halves: np.ndarray

    @property
    def radiance(self) -> np.ndarray:
        """The mean of both halves, [BOUNCES + 1, N, 3]."""
        return self.halves.mean(axis=0)


def build_bunny(path: Path | None) -> tuple[mujoco.MjModel, str]:
    """A body on a white floor between a red and a green wall; and what the body is: a mesh file (y up), or our own."""
    spec = new_stage(position=(0.0, -4.6, 1.5), target=(0.0, 0.0, 0.68), fovy=27)
    for name, rgb in (("white", (0.9, 0.9, 0.9)), ("red", (0.85, 0.2, 0.15)), ("green", (0.25, 0.75, 0.25))):
        add_material(spec, name, rgb)
    draw_box(spec.worldbody, "floor", (-1.1, -1.1, -0.1), (1.1, 1.1, 0.0), "white")
    draw_box(spec.worldbody, "left wall", (-1.2, -1.1, -0.1), (-1.1, 1.1, 1.8), "red")
    draw_box(spec.worldbody, "right wall", (1.1, -1.1, -0.1), (1.2, 1.1, 1.8), "green")
    if path is not None and path.is_file():
        mesh = psf.load_mesh(path)
        vertices, faces, what = mesh.vertices[:, [0, 2, 1]] * (1.0, -1.0, 1.0), mesh.faces, path.name
    else:
        (vertices, faces), what = statue_like(), "a statue of ours instead of the bunny; name one with --bunny"
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    foot = np.array([*(0.5 * (low + high))[:2], low[2]])
    add_mesh(spec, "bunny", ((vertices - foot) * (BUNNY_HEIGHT / (high - low)[2]), faces))
    # The scan is open at its base; MuJoCo takes the volume of a solid, but a shell of anything.
    spec.meshes[0].inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    draw_mesh(spec.worldbody, "bunny", "white")
    return spec.compile(), what


def find_case(name: str, options: argparse.Namespace) -> Case | None:
    """The scene of that name at its moment, all Lambert and not antialiased; None where there is no such simulation."""
    if name == "bunny":
        model, what = build_bunny(options.bunny)
        print(f"bunny: {what}")
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        lights = (psf.rectangle_light("panel", 1, 1, (8.0, 8.0, 8.0), position=(0.0, -0.4, 2.4), target=(0, 0, 0)),)
        environment: psf.Environment | None = psf.Environment("uniform", np.full((1, 1, 3), 0.2))
    else:
        try:
            scene = importlib.import_module(f"sims.{name}")
        except ModuleNotFoundError:
            print(f"{name}: there is no sims.{name}; left out")
            return None
        model, lights, environment = scene.build(), tuple(scene.lights()), scene.environment()
        # The last state; a deque of one forgets the others.
        data = deque(scene.states(model, 30, MOMENTS[name]), maxlen=1).pop()
    model.mat_specular[:] = 0.0
    model.vis.quality.offsamples = 0
    coefficients = np.zeros((ORDER * ORDER, 3)) if environment is None else environment.project(ORDER)
    if options.mitsuba:
        coefficients = without_negatives(coefficients)
    return Case(name, model, data, coefficients, lights, tuple(options.size))


def without_negatives(coefficients: np.ndarray) -> np.ndarray:
    """The same light with so much less contrast that it is nowhere negative: an image can hold it."""
    radiance = psf.Environment.from_coefficients(coefficients).radiance
    # `radiance` is clamped: the negative light is the positive light of the negated coefficients.
    negative = psf.Environment.from_coefficients(-coefficients).radiance
    mean = coefficients[0] / np.sqrt(4.0 * np.pi)
    lowest = np.where(negative.max(axis=(0, 1)) > 0.0, -negative.max(axis=(0, 1)), radiance.min(axis=(0, 1)))
    contrast = min(1.0, float((mean / np.maximum(mean - lowest, 1e-9)).min()))
    return np.concatenate([coefficients[:1], contrast * coefficients[1:]])


def render(case: Case, bounces: int, functions: int) -> dict:
    """The layers of the frame, with the camera's pose."""
    with psf.Renderer(
        case.model,
        case.size[1],
        case.size[0],
        environment=psf.Environment.from_coefficients(case.coefficients),
        lights=case.lights,
        model_lights=False,
        order=ORDER,
        bounces=bounces,
        basis_functions=functions,
    ) as renderer:
        renderer.update_scene(case.data, camera="front")
        return renderer.layers() | {"pose": renderer.world_from_camera}


def trace(case: Case, layers: dict, paths: int) -> Reference:
    """The same pixels by path tracing, `paths` for each of the two halves together."""
    fovy = np.deg2rad(case.model.cam_fovy[case.model.camera("front").id])
    seen = layers["segmentation"][..., 0] >= 0
    points = pixel_points(layers["depth"], layers["pose"], fovy)[seen]
    light = {"coefficients": case.coefficients, "lights": case.lights, "paths": paths // 2, "bounces": BOUNCES}
    halves = [
        traced_bounces(case.model, case.data, points, layers["normal"][seen], seed=seed, **light) for seed in (0, 1)
    ]
    return Reference(seen, layers["albedo"][seen] / np.pi * np.stack(halves).astype(np.float64))


def scaled_error(found: np.ndarray, expected: np.ndarray, chosen: np.ndarray | slice = slice(None)) -> float:
    """RMSE of radiance [N, 3] over the chosen points, `expected` scaled to mean luminance 0.5, both clamped."""
    return noiseless_error(found[None], expected[None], chosen)


def noiseless_error(found: np.ndarray, expected: np.ndarray, chosen: np.ndarray | slice = slice(None)) -> float:
    """The same error from halves [halves, N, 3] with independent noise, which then cancels: by the halves' product."""
    scale = 0.5 / (expected.mean(axis=0) @ LUMINANCE).mean()
    difference = np.clip(found * scale, 0, 1) - np.clip(expected * scale, 0, 1)
    return float(np.sqrt(max(np.mean(difference[0][chosen] * difference[-1][chosen]), 0.0)))


def compare(case: Case, reference: Reference, images: list[dict]) -> dict:
    """The figures of frames rendered with 0, 1, ... BOUNCES bounces (or with BOUNCES alone) against the reference."""
    seen, expected = reference.seen, reference.radiance
    last = images[-1]
    indirect, bounced = last["indirect"][seen], expected[1:].sum(axis=0)
    halves = reference.halves[:, 1:].sum(axis=1)
    figures = {
        "indirect": scaled_error(indirect, bounced),
        "whole": scaled_error(last["direct"][seen] + indirect, expected.sum(axis=0)),
        # The halves differ by twice the error of their mean.
        "reference's noise": 0.5 * scaled_error(halves[0], halves[1]),
        "indirect less noise": noiseless_error(indirect[None], halves),
    }
    for bounce in range(1, len(images)):
        gained = images[bounce]["indirect"][seen] - images[bounce - 1]["indirect"][seen]
        figures[f"bounce {bounce} %"] = 100.0 * float(gained.mean() / expected[bounce].mean() - 1.0)
    return {"scene": case.name} | figures


def save_sheet(path: Path, reference: Reference, found: np.ndarray, expected: np.ndarray) -> None:
    """Rendered, reference and five times their difference, side by side, scaled as for the error; radiance [N, 3]."""
    scale = 0.5 / (expected @ LUMINANCE).mean()
    pictures = np.zeros((2, *reference.seen.shape, 3), np.float32)
    pictures[:, reference.seen] = np.clip(scale * np.stack([found, expected]), 0, 1)
    difference = np.clip(0.5 + 5 * (pictures[0] - pictures[1]), 0, 1)
    encoded = [psf.to_display(picture, view="srgb") for picture in pictures]
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.concatenate([*encoded, (255 * difference).astype(np.uint8)], axis=1)).save(path)


def inner_pixels(layers: dict) -> np.ndarray:
    """Pixels whose four neighbours show the same smooth surface, bool [H, W]."""
    body, normal = layers["segmentation"][..., 0], layers["normal"]
    inner = body >= 0
    for axis in (0, 1):
        for step in (-1, 1):
            same = body == np.roll(body, step, axis)
            inner &= same & (np.sum(normal * np.roll(normal, step, axis), axis=-1) > SAME_NORMAL)
    # At the border the neighbour would be the opposite edge's.
    inner[[0, -1]] = False
    inner[:, [0, -1]] = False
    return inner


def import_mitsuba():
    """Mitsuba 3, in its variant that needs no compiler.

    Raises:
        SystemExit: it is not installed.
    """
    try:
        mitsuba = importlib.import_module("mitsuba")
    except ModuleNotFoundError as error:
        raise SystemExit("Mitsuba 3 is not installed; install the extra: pip install 'warp-psf[validate]'") from error
    mitsuba.set_variant("scalar_rgb")
    return mitsuba


def mitsuba_shapes(mi, meshes: WorldMeshes, shining: bool) -> dict:
    """One Mitsuba mesh per entity: Lambert on both sides; or a light like ours, which is in no path's way."""
    shapes = {}
    for entity, albedo in enumerate(meshes.albedo):
        used, faces = np.unique(meshes.faces[meshes.entity == entity], return_inverse=True)
        diffuse = {"type": "diffuse", "reflectance": {"type": "rgb", "value": albedo.tolist()}}
        properties = mi.Properties()
        properties["surface"] = mi.load_dict({"type": "null"} if shining else {"type": "twosided", "nested": diffuse})
        if shining:
            radiance = {"type": "rgb", "value": meshes.emission[entity].tolist()}
            properties["shine"] = mi.load_dict({"type": "area", "radiance": radiance})
        name = f"{'light' if shining else 'entity'}{entity}"
        mesh = mi.Mesh(name, len(used), faces.size // 3, has_vertex_normals=True, props=properties)
        parameters = mi.traverse(mesh)
        parameters["vertex_positions"] = meshes.vertices[used].ravel()
        parameters["vertex_normals"] = meshes.normals[used].ravel()
        parameters["faces"] = faces.ravel().astype(np.uint32)
        parameters.update()
        shapes[name] = mesh
    return shapes


def mitsuba_environment(mi, coefficients: np.ndarray) -> dict:
    """The environment as an image: Mitsuba's rows run from +y, its columns from -z towards +x."""
    theta = np.pi * (np.arange(ENVMAP_ROWS) + 0.5)[:, None] / ENVMAP_ROWS
    phi = np.pi * (np.arange(2 * ENVMAP_ROWS) + 0.5)[None] / ENVMAP_ROWS
    x, y, z = np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi, -np.sin(theta) * np.cos(phi)
    radiance = psf.Environment.from_coefficients(coefficients).lookup(np.stack([x, y, z], axis=-1))
    return {"type": "envmap", "bitmap": mi.Bitmap(radiance.astype(np.float32))}


def mitsuba_indirect(case: Case, pose: np.ndarray, paths: int) -> np.ndarray:
    """Bounced radiance in two halves [2, H, W, 3] by Mitsuba's path tracer: all depths less direct light."""
    mi = import_mitsuba()
    surfaces, lamps = world_meshes(case.model, case.data, case.lights)
    camera = {
        "type": "perspective",
        "fov": float(case.model.cam_fovy[case.model.camera("front").id]),
        "fov_axis": "y",
        "to_world": mi.ScalarTransform4f().look_at(
            origin=pose[:3, 3].tolist(), target=(pose[:3, 3] - pose[:3, 2]).tolist(), up=pose[:3, 1].tolist()
        ),
        "film": {"type": "hdrfilm", "width": case.size[0], "height": case.size[1], "rfilter": {"type": "box"}},
    }
    shapes = mitsuba_shapes(mi, surfaces, shining=False)
    # Together they would be noisier: Mitsuba chooses one of its lights for every sample, whatever their power.
    lightings = [{"environment": mitsuba_environment(mi, case.coefficients)}] if case.coefficients.any() else []
    if lamps is not None:
        lightings.append(mitsuba_shapes(mi, lamps, shining=True))
    halves = np.zeros((2, case.size[1], case.size[0], 3))
    for lighting in lightings:
        scene = mi.load_dict({"type": "scene", "camera": camera} | shapes | lighting)
        for sign, depth in ((1.0, BOUNCES + 2), (-1.0, 2)):
            # Passing a lamp costs `volpath` no depth. Paths are as long as asked for: without Russian roulette.
            integrator = mi.load_dict({"type": "volpath", "max_depth": depth, "rr_depth": 99, "hide_emitters": True})
            for half in (0, 1):
                picture = mi.render(scene, integrator=integrator, spp=paths // 2, seed=2 * depth + half)
                halves[half] += sign * np.array(picture)[..., :3]
    return halves


def compare_mitsuba(case: Case, reference: Reference, layers: dict, options: argparse.Namespace) -> dict:
    """Our oracle and our rendering against Mitsuba, where a pixel is one smooth surface."""
    found = mitsuba_indirect(case, layers["pose"], options.paths)[:, reference.seen]
    inner = inner_pixels(layers)[reference.seen]
    halves = reference.halves[:, 1:].sum(axis=1)
    mean, expected = halves.mean(axis=0), found.mean(axis=0)
    if options.pictures:
        save_sheet(options.pictures / f"mitsuba-{case.name}.png", reference, mean, expected)
    return {
        "oracle to mitsuba": scaled_error(mean, expected, inner),
        "less noise": noiseless_error(halves, found, inner),
        "ours to mitsuba": scaled_error(layers["indirect"][reference.seen], expected, inner),
        "energy of oracle %": 100.0 * float(mean[inner].mean() / expected[inner].mean() - 1.0),
    }


def print_row(figures: dict) -> None:
    """One line of a table, its names with it."""
    parts = [f"{key} {value:+.2f}" if "%" in key else f"{key} {value:.4f}" for key, value in figures.items()]
    print("  " + "  ".join(parts), flush=True)


def measure(case: Case, options: argparse.Namespace) -> dict:
    """Everything about one scene, printed as it is found."""
    images = [render(case, bounces, options.basis) for bounces in range(BOUNCES + 1)]
    reference = trace(case, images[-1], options.paths)
    figures = compare(case, reference, images)
    print_row({key: value for key, value in figures.items() if key != "scene"})
    if options.pictures:
        path = options.pictures / f"interreflection-{case.name}.png"
        bounced = reference.radiance[1:].sum(axis=0)
        save_sheet(path, reference, images[-1]["indirect"][reference.seen], bounced)
    for functions in options.functions:
        found = compare(case, reference, [render(case, BOUNCES, functions)])
        figures[f"indirect with {functions} functions"] = found["indirect"]
        print_row({f"{functions:3} functions: indirect": found["indirect"], "whole": found["whole"]})
    if options.mitsuba:
        against = compare_mitsuba(case, reference, images[-1], options)
        print_row(against)
        figures |= against
    return figures


def main() -> None:
    """Prints the tables."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--scenes", nargs="+", default=list(MOMENTS), choices=list(MOMENTS))
    parser.add_argument("--bunny", type=Path, help="mesh file of the body between the walls, y up")
    parser.add_argument("--basis", type=int, default=16, help="PCA functions per body")
    parser.add_argument("--functions", nargs="+", type=int, default=[], help="numbers of PCA functions to compare")
    parser.add_argument("--paths", type=int, default=1024, help="of the reference, per pixel")
    parser.add_argument("--size", nargs=2, type=int, default=[320, 180], metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--mitsuba", action="store_true", help="against Mitsuba 3; environments without negative light")
    parser.add_argument("--pictures", type=Path, help="folder for rendered, reference and difference")
    parser.add_argument("--json", type=Path, help="file for the figures")
    options = parser.parse_args()
    if options.mitsuba:
        import_mitsuba()
    rows = []
    print("RMSE of radiance scaled to mean luminance 0.5, the reference's own noise, energy of each bounce in per cent")
    for name in options.scenes:
        case = find_case(name, options)
        if case is not None:
            print(name)
            rows.append(measure(case, options))
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
