"""The renderer that simulation scripts use, shaped like mujoco.Renderer."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from numbers import Real
from typing import NoReturn

import mujoco
import numpy as np
import warp as wp

from warp_psf.bake import BakedBody, bake_radiance_field
from warp_psf.bake.bodies import bake_bodies, bake_light
from warp_psf.bridge import build_scene, read_camera, read_delta_lights, read_poses
from warp_psf.device import find_device
from warp_psf.field.radiance import FUNCTION_COUNTS
from warp_psf.film.display import LARGEST_EXPOSURE, VIEWS, to_display
from warp_psf.film.primary import EXTRA_GROUPS, aim, find_surfaces, make_surfaces
from warp_psf.film.resolve import make_film, read_layers, resolve_pixels
from warp_psf.scene.detail import refine_flat_bodies
from warp_psf.scene.environment import Environment, load_environment
from warp_psf.scene.geometry import upload_scene, write_poses
from warp_psf.scene.light import Light, area_light_entities
from warp_psf.scene.scene import Poses
from warp_psf.shade.bounce import BounceState, bounce, gather_basis_irradiances
from warp_psf.shade.delta import add_delta_lights, make_delta_lights, write_delta_lights
from warp_psf.shade.direct import shade_direct, upload_lighting, write_environment
from warp_psf.shade.gloss import shade_gloss
from warp_psf.shade.last_gather import LastGather, gather_last_bounce, make_last_gather
from warp_psf.shade.lattice import STRIDES, begin_lattice, make_lattice, refine_lattice
from warp_psf.shade.occlude import turn_occlusion, upload_occlusion
from warp_psf.shade.proxies import upload_bounces
from warp_psf.shade.receivers import VertexReceivers, interpolate_vertices, place_vertices, upload_vertices

ORDERS = (2, 3, 4, 5, 6)
SHADINGS = ("pixel", "vertex")
# A picture of more pixels than this is a mistyped size: its buffers would take over 30 GB.
MOST_PIXELS = 2**27
# After so many bounces between white walls a fiftieth of the light is left.
MOST_BOUNCES = 16
# Shadow rays towards directional lights end after this many extents of the model.
DIRECTIONAL_REACH = 1000.0
Progress = Callable[[str, float], None]


class Renderer:
    """Renders a MuJoCo model with soft shadows, frame after frame, without noise.

        with warp_psf.Renderer(model, 360, 640) as renderer:
            renderer.update_scene(data, camera="front")
            rgb = renderer.render()

    model: the compiled model; edges are antialiased unless its `visual/quality` says offsamples below 2. height, width:
        of the picture, pixels.
    environment: light from all around: a built-in name ("studio", "sky", "sunset", "overcast"), the path of an EXR or
        HDR file, radiance as a float array [rows, columns, 3], an `Environment`, or None for none.
    lights: area lights (`AreaLight`, `rectangle_light`) in addition to the model's own lights.
    bounces: how often light is passed on between the bodies, 0 to 16; 0 leaves only direct light.
    bounce_threshold: a body that takes up a smaller share of a point's view than this sends it no bounced light.
    basis_functions: how many functions per body stand for the light that leaves it: 4, 8, 16 or 32.
    order: bands of spherical harmonics, 2 to 6. Shadows sharpen and cost grows with the order.
    shading: "pixel" shades what each pixel sees; "vertex" shades vertices, once each, and interpolates. Boxes and
        planes are cut finely enough for that; other meshes show what their vertices resolve, and open ones the light of
        their front on both sides.
    material_space: whether MJCF's rgba is "srgb" or "linear".
    model_lights: False leaves out the model's own lights and headlight.
    exposure, view: how `render` develops the picture: stops, and a view transform, "neutral" or "srgb".
    device: "cpu", "cuda:0", ...; None takes the first CUDA device, else the CPU.
    progress: called as progress(what, share) while shadow fields are baked, which happens once per shape and is cached.

    Raises:
        ValueError: a size, order, name or device is not usable; the message says which and what is.
        TypeError: the model, the environment or a light is of another type.
        FileNotFoundError: the environment's file does not exist.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        height: int = 240,
        width: int = 320,
        *,
        environment: str | np.ndarray | Environment | None = "studio",
        lights: Sequence[Light] = (),
        order: int = 4,
        bounces: int = 3,
        bounce_threshold: float = 0.004,
        basis_functions: int = 16,
        shading: str = "pixel",
        material_space: str = "srgb",
        model_lights: bool = True,
        exposure: float = 0.0,
        view: str = "neutral",
        device: str | None = None,
        progress: Progress | None = None,
    ):
        _check_model(model)
        _check_options(height, width, order, shading, exposure, view)
        _check_bounces(bounces, bounce_threshold, basis_functions)
        self._model, self._height, self._width = model, int(height), int(width)
        self._order, self._shading = int(order), shading
        self._bounce_count, self._bounce_threshold = int(bounces), float(bounce_threshold)
        self._exposure, self._view = exposure, view
        self._device = find_device(device)
        self._environment = load_environment(environment)
        self._scene = build_scene(model, material_space=material_space, lights=lights, model_lights=model_lights)
        if shading == "vertex":
            self._scene = refine_flat_bodies(self._scene)
        report = progress or (lambda what, share: None)
        lamps = len(area_light_entities(self._scene))
        entities = len(self._scene.entities)
        self._casts = [entity < entities - lamps for entity in range(entities)]
        self._upload(bake_bodies(self._scene, self._casts, self._order, str(self._device), report))
        self._bounces = self._last_gather = None
        if self._bounce_count:
            self._upload_bounces(int(basis_functions), report)
        self._depth_rendering = self._segmentation_rendering = False
        self._world_from_camera: np.ndarray | None = None
        self._poses: Poses | None = None
        self._drawn = self._closed = self._has_moved = False
        self._stage_seconds: dict[str, float] = {}

    @property
    def model(self) -> mujoco.MjModel:
        """The model that is rendered."""
        return self._model

    @property
    def height(self) -> int:
        """Rows of the picture."""
        return self._height

    @property
    def width(self) -> int:
        """Columns of the picture."""
        return self._width

    @property
    def world_from_camera(self) -> np.ndarray:
        """The camera's pose as of the last `update_scene`, float64 [4, 4]; it looks along its -z."""
        if self._world_from_camera is None:
            raise RuntimeError("there is no camera yet; call update_scene(data, camera) first")
        return self._world_from_camera

    @property
    def stage_seconds(self) -> dict[str, float]:
        """How long each stage of the last frame took, seconds, in order."""
        return dict(self._stage_seconds)

    @property
    def occluders(self) -> int:
        """How many entities cast shadows."""
        return sum(self._casts)

    @property
    def field_bytes(self) -> dict[str, int]:
        """What is baked and kept for this scene, bytes: `occlusion` fields, `transfer`, basis `radiance` fields."""
        return dict(self._field_bytes)

    @property
    def vertices(self) -> int:
        """How many vertices all entities have together."""
        return sum(len(self._scene.meshes[entity.mesh].vertices) for entity in self._scene.entities)

    def update_scene(self, data: mujoco.MjData, camera: int | str | mujoco.MjvCamera = -1) -> None:
        """Takes over the state that the next `render` shows.

        camera: a camera's id or name, -1 for the free camera, or an `MjvCamera`.

        Raises:
            ValueError: there is no such camera, or `data` is of another model.
        """
        self._check_open()
        view = read_camera(self._model, data, camera)
        poses = read_poses(self._model, data, self._scene)
        self._has_moved = self._has_moved or not _same_poses(poses, self._poses)
        self._poses = poses
        lights = read_delta_lights(self._model, data, self._scene, view)
        write_poses(self._device_scene, poses)
        aim(self._surfaces, [view])
        self._lighting.table.eye.assign(np.array([view.position], np.float32))
        write_delta_lights(self._delta_lights, [lights])
        self._world_from_camera = np.eye(4)
        self._world_from_camera[:3, :3], self._world_from_camera[:3, 3] = view.rotation, view.position
        self._drawn = False

    def render(self, *, out: np.ndarray | None = None) -> np.ndarray:
        """The picture of the last `update_scene`.

        Returns uint8 [height, width, 3], ready to be shown; with depth rendering on, float32 [height, width], metres;
        with segmentation rendering on, int32 [height, width, 2], object ids and types. `out` receives it if given.

        Raises:
            RuntimeError: `update_scene` was not called, or the renderer is closed.
            ValueError: `out` has another shape or type.
        """
        self._draw()
        if self._depth_rendering:
            depth = read_layers(self._film, ("depth",))["depth"]
            far = self._model.vis.map.zfar * self._model.stat.extent
            picture = np.minimum(depth, np.float32(far))
        elif self._segmentation_rendering:
            picture = read_layers(self._film, ("segmentation",))["segmentation"]
        else:
            with self._timed("display"):
                color = self._film.layers.color.numpy()[0].reshape(self._height, self._width, 3)
                picture = to_display(color, exposure=self._exposure, view=self._view)
        if out is None:
            return picture
        if out.shape != picture.shape or out.dtype != picture.dtype:
            raise ValueError(
                f"out is {out.dtype} {out.shape}, the picture {picture.dtype} {picture.shape}; give an array like it"
            )
        np.copyto(out, picture)
        return out

    def layers(self) -> dict[str, np.ndarray]:
        """The layers of the last `update_scene`, as arrays of their own.

        `color`: radiance with background and luminous surfaces; `direct`: what lights and environment cause by one
        reflection; `indirect`: what came by other bodies; `albedo`; `normal` in the world: all float32 [height, width,
        3], scene-linear. `depth`: metres along the optical axis, infinite where nothing is, float32 [height, width].
        `segmentation`: object id and type, -1 where nothing is, int32 [height, width, 2].
        """
        self._draw()
        return read_layers(self._film)

    def enable_depth_rendering(self) -> None:
        """From now on `render` returns depth."""
        self._depth_rendering, self._segmentation_rendering = True, False

    def disable_depth_rendering(self) -> None:
        """`render` returns pictures again."""
        self._depth_rendering = False

    def enable_segmentation_rendering(self) -> None:
        """From now on `render` returns object ids and types."""
        self._depth_rendering, self._segmentation_rendering = False, True

    def disable_segmentation_rendering(self) -> None:
        """`render` returns pictures again."""
        self._segmentation_rendering = False

    def close(self) -> None:
        """Gives back the device's memory. A closed renderer renders no more; closing twice is no error."""
        if not self._closed:
            self._closed = True
            del self._device_scene, self._surfaces, self._film, self._occlusion, self._lighting
            del self._delta_lights, self._received, self._bounced, self._lattice, self._vertices
            del self._bounces, self._last_gather
            if self._shading == "vertex":
                del self._vertices_received, self._vertices_turns

    def __enter__(self) -> Renderer:
        return self

    def __exit__(self, kind, error, trace) -> None:
        self.close()

    def __reduce__(self) -> NoReturn:
        raise TypeError("a Renderer cannot be pickled or copied; make one in each process that renders")

    def _upload(self, bodies: list[BakedBody]) -> None:
        scene, device, order = self._scene, self._device, self._order
        area_lights = area_light_entities(scene)
        fields = [bodies[entity.mesh].field for entity in scene.entities]
        for light, entity in area_lights:
            fields[entity] = None
            if light.mesh.slab is None and light.mesh.sphere is None:
                radiance = np.ones(len(light.mesh.faces), np.float32)
                fields[entity] = bake_radiance_field(light.mesh, radiance, order, device=str(device))
        transfers = [
            None if body.transfer is None or body.visibility is None else (body.transfer, body.visibility)
            for body in bodies
        ]
        stored = {id(field): field.nbytes for field in fields if field is not None}
        self._field_bytes = {
            "occlusion": sum(stored.values()),
            "transfer": sum(pair[0].nbytes + pair[1].nbytes for pair in transfers if pair is not None),
            "radiance": 0,
        }

        self._device_scene = upload_scene(scene, 1, device)
        self._occlusion = upload_occlusion(scene, fields, self._casts, order, 1, device)
        shining = [(entity, light.radiance) for light, entity in area_lights]
        self._lighting = upload_lighting(scene, transfers, shining, order, 1, device)
        background = np.zeros((1, 1, 3), np.float32)
        if self._environment is not None:
            write_environment(self._lighting, self._environment.project(order))
            background = self._environment.radiance
        reach = DIRECTIONAL_REACH * float(self._model.stat.extent)
        self._delta_lights = make_delta_lights(scene, 1, reach, device)

        antialias = self._model.vis.quality.offsamples > 1
        self._surfaces = make_surfaces(1, self._width, self._height, len(scene.entities), antialias, device)
        self._film = make_film(1, self._width, self._height, background, device)
        self._received = self._make_received(self._surfaces.slots)
        self._bounced = self._make_received(self._surfaces.slots)
        self._lattice = make_lattice(1, self._surfaces.slots, self._width, self._height, device)
        self._vertices = None
        if self._shading == "vertex":
            self._vertices = upload_vertices(scene, 1, device)
            self._vertices_received = self._make_received(self.vertices)
            self._vertices_turns = wp.full((1, self.vertices), 1, dtype=wp.int32, device=device)

    def _upload_bounces(self, functions: int, progress: Progress) -> None:
        """Bakes what leaves the bodies, and makes room for the bounces."""
        scene, device = self._scene, self._device
        radiating, flat = bake_light(scene, self._casts, self._order, functions, str(device), progress)
        self._bounces = upload_bounces(scene, radiating, flat, self._occlusion, functions, 1, device)
        room = (self._bounce_threshold, self._width, self._height, self._surfaces.slots)
        self._last_gather = make_last_gather(self._bounces, *room, device)
        self._field_bytes["radiance"] = sum({id(b): b.field.nbytes for _, b in filter(None, radiating)}.values())

    def _make_received(self, count: int) -> tuple[wp.array, wp.array]:
        """Irradiance and Phong radiance of `count` receivers."""
        return (
            wp.zeros((1, count), dtype=wp.vec3, device=self._device),
            wp.zeros((1, count), dtype=wp.vec3, device=self._device),
        )

    def _draw(self) -> None:
        """Computes the layers, unless they show the present state already."""
        self._check_open()
        if self._world_from_camera is None:
            raise RuntimeError("there is nothing to render yet; call update_scene(data, camera) first")
        if self._drawn:
            return
        self._stage_seconds = {}
        scene, device, pixels = self._device_scene, self._device, self._surfaces.receivers
        with self._timed("primary visibility"):
            find_surfaces(scene, self._surfaces, device)
        with self._timed("turn fields"):
            turn_occlusion(self._occlusion, scene, device)
        if self._vertices is None:
            self._shade_pixels()
        else:
            self._shade_vertices(self._vertices)
        with self._timed("shadow rays"):
            casts, eye = self._occlusion.table.occluders.casts, self._lighting.table.eye
            add_delta_lights(pixels, scene, casts, eye, self._delta_lights, *self._received, device)
        if self._bounces is not None and self._last_gather is not None:
            self._bounce(self._bounces, self._last_gather)
        with self._timed("resolve pixels"):
            resolve_pixels(self._film, self._surfaces, scene, self._received, self._bounced, device)
        self._drawn = True

    def _bounce(self, bounces: BounceState, last_gather: LastGather) -> None:
        scene, device, lights = self._device_scene, self._device, (self._occlusion, self._lighting)
        if self._has_moved:
            with self._timed("basis irradiances"):
                gather_basis_irradiances(bounces, scene, *lights, self._bounce_threshold, device)
            self._has_moved = False
        with self._timed("light on proxies"):
            shade_direct(bounces.proxies, bounces.turns, 1, scene, *lights, *bounces.received, device)
            seen = (bounces.proxies, scene, *lights, self._delta_lights)
            shade_gloss(bounces.gloss, *seen, bounces.received[0], device)
            casts, eye = self._occlusion.table.occluders.casts, self._lighting.table.eye
            add_delta_lights(bounces.proxies, scene, casts, eye, self._delta_lights, *bounces.received, device)
        with self._timed("bounces"):
            bounce(bounces, scene, self._occlusion, self._bounce_count, device)
        with self._timed("last gather"):
            surfaces = self._surfaces
            seen = (surfaces.receivers, surfaces.extra, EXTRA_GROUPS)
            direct = self._received[0]
            gather_last_bounce(last_gather, *seen, scene, *lights, self._lattice, direct, self._bounced, device)

    def _shade_pixels(self) -> None:
        scene, device, pixels = self._device_scene, self._device, self._surfaces.receivers
        lattice, lights = self._lattice, (self._occlusion, self._lighting)
        with self._timed("shadow fields"):
            begin_lattice(lattice, pixels, self._surfaces.extra, device)
            for turn in range(1, len(STRIDES) + 1):
                shade_direct(pixels, lattice.turns, turn, scene, *lights, *self._received, device)
                if turn < len(STRIDES):
                    refine_lattice(lattice, turn, pixels, *self._received, device)

    def _shade_vertices(self, vertices: VertexReceivers) -> None:
        scene, device, pixels = self._device_scene, self._device, self._surfaces.receivers
        received, lights = self._vertices_received, (self._occlusion, self._lighting)
        with self._timed("place vertices"):
            place_vertices(vertices, pixels, scene, device)
        with self._timed("shadow fields"):
            shade_direct(vertices.receivers, self._vertices_turns, 1, scene, *lights, *received, device)
        with self._timed("interpolate vertices"):
            interpolate_vertices(vertices, pixels, scene, received, *self._received, device)
        # Every pixel receives bounced light by itself.
        self._lattice.turns.fill_(1)

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        wp.synchronize_device(self._device)
        self._stage_seconds[stage] = time.perf_counter() - start

    def _check_open(self) -> None:
        if self._closed:
            raise RuntimeError("the renderer is closed; make a new one")


def _check_model(model: mujoco.MjModel) -> None:
    if not isinstance(model, mujoco.MjModel):
        raise TypeError(
            f"model is a {type(model).__name__}; give a mujoco.MjModel, for example mujoco.MjModel.from_xml_path(path)"
        )


def _same_poses(a: Poses, b: Poses | None) -> bool:
    return b is not None and np.array_equal(a.position, b.position) and np.array_equal(a.rotation, b.rotation)


def _check_bounces(bounces: int, threshold: float, functions: int) -> None:
    if bounces not in range(MOST_BOUNCES + 1):
        raise ValueError(f"bounces is {bounces!r}; give a whole number from 0 to {MOST_BOUNCES}")
    if not isinstance(threshold, Real) or not 0.0 < threshold < 1.0:
        raise ValueError(f"bounce_threshold is {threshold!r}; give a share between 0 and 1")
    if functions not in FUNCTION_COUNTS:
        raise ValueError(f"basis_functions is {functions}; choose one of {', '.join(map(str, FUNCTION_COUNTS))}")


def _check_options(height: int, width: int, order: int, shading: str, exposure: float, view: str) -> None:
    for name, size in (("height", height), ("width", width)):
        if not np.isfinite(size) or int(size) != size or size < 1:
            raise ValueError(f"{name} is {size}; give a whole number of pixels, at least 1")
    if height * width > MOST_PIXELS:
        raise ValueError(f"a picture of {width} x {height} pixels is too large; give at most {MOST_PIXELS} pixels")
    if order not in ORDERS:
        raise ValueError(f"order is {order}; choose one of {', '.join(map(str, ORDERS))}")
    if shading not in SHADINGS:
        raise ValueError(f"shading is {shading!r}; choose {' or '.join(map(repr, SHADINGS))}")
    if view not in VIEWS:
        raise ValueError(f"view is {view!r}; choose {' or '.join(map(repr, VIEWS))}")
    if not abs(exposure) <= LARGEST_EXPOSURE:
        raise ValueError(f"exposure is {exposure}; give a number of stops within {LARGEST_EXPOSURE:g} of 0")
