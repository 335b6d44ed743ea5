"""The renderer that simulation scripts use, shaped like mujoco.Renderer."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from numbers import Integral
from typing import NoReturn

import mujoco
import numpy as np

from warp_psf.bridge import (
    build_scene,
    find_camera,
    looks,
    meet_deforming,
    read_camera,
    read_deformed,
    read_delta_lights,
    read_image_lights,
    read_loose,
    read_poses,
    read_skybox,
)
from warp_psf.bridge.deforming import DeformingBody
from warp_psf.device import find_device
from warp_psf.film.display import to_display
from warp_psf.film.resolve import read_layers
from warp_psf.scene.environment import Environment, load_environment
from warp_psf.scene.light import Light
from warp_psf.scene.loose import LooseRoom, make_room
from warp_psf.settings import Settings, check_bounces, check_options
from warp_psf.stage import (
    Progress,
    Stage,
    draw,
    learn,
    place,
    place_deforming,
    place_loose,
    relight,
    set_stage,
    take_over,
)

# Shadow rays towards directional lights end after this many extents of the model.
DIRECTIONAL_REACH = 1000.0


class Renderer:
    """Renders a MuJoCo model with soft shadows, frame after frame, without noise.

    ```python
    lamp = psf.sphere_light("lamp", 0.1, radiance=(40, 35, 30), position=(1, -1, 2))
    with psf.Renderer(model, 120, 160, environment="sky", lights=[lamp]) as renderer:
        for _ in range(3):
            mujoco.mj_step(model, data)
            renderer.update_scene(data, camera="front")
            rgb, layers = renderer.render(), renderer.layers()
    ```

    Args:
        model: the compiled model; edges are antialiased unless its `visual/quality` says offsamples below 2.
        height, width: of the picture, pixels.
        max_geom: how many geoms `scene` has room for.
        environment: light from all around, as `load_environment` takes it: "studio", "sky", "sunset", "overcast", the
            path of an EXR or HDR file, radiance as a float array [rows, columns, 3], an `Environment`, or None. A
            model's lights of type `image` add theirs; its skybox is seen in the background, and lights nothing.
        lights: a list of lights besides the model's own: `rectangle_light`, `sphere_light`, `AreaLight`, `DeltaLight`.
        order: bands of spherical harmonics, 2 to 6. Shadows sharpen and cost grows with the order.
        basis: "sh" shows all light in spherical harmonics; "haar" shows what is small and bright in it, suns, windows
            and area lights, at full frequency, with sharp-edged shadows.
        compose: how what bodies leave of the light is combined: "product" multiplies their visibilities, "log" adds
            their logarithms and exponentiates the sum. See the README for which is better when.
        bounces: how often light is passed on between the bodies, 0 to 16; 0 leaves only direct light.
        bounce_threshold: a body sends no bounced light to points where its (radius / distance)^2 is below this, a share
            between 0 and 1, unless it is flat.
        basis_functions: how many functions per body stand for the light that leaves it: 4, 8, 16 or 32.
        shading: "pixel" shades what each pixel sees; "vertex" shades vertices, once each, and interpolates. Boxes and
            planes are cut finely enough for that; other meshes show what their vertices resolve, and open ones the
            light of their front on both sides.
        material_space: whether MJCF's rgba is "srgb" or "linear".
        model_lights: False leaves out the model's own lights and headlight.
        exposure, view: how `render` develops the picture: stops, and a view transform; see `to_display`.
        device: "cpu", "cuda:0", ...; None takes the first CUDA device, else the CPU.
        progress: called as progress(what, share), a text and 0 to 1, while shapes are baked: once each, then cached;
            and while the first frame waits for kernels, which are compiled once per machine.

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
        max_geom: int = 10000,
        *,
        environment: str | np.ndarray | Environment | None = "studio",
        lights: Sequence[Light] = (),
        order: int = 4,
        basis: str = "sh",
        compose: str = "product",
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
        check_options(height, width, order, basis, compose, shading, exposure, view)
        if not isinstance(max_geom, Integral) or max_geom < 1:
            raise ValueError(f"max_geom is {max_geom!r}; give a whole number of geoms, at least 1")
        check_bounces(bounces, bounce_threshold, basis_functions)
        self._model = model
        self._settings = Settings(
            height=int(height),
            width=int(width),
            order=int(order),
            basis=basis,
            compose=compose,
            shading=shading,
            bounces=int(bounces),
            bounce_threshold=float(bounce_threshold),
            basis_functions=int(basis_functions),
            antialias=model.vis.quality.offsamples > 1,
            reach=DIRECTIONAL_REACH * float(model.stat.extent),
            device=find_device(device),
        )
        self._exposure, self._view = exposure, view
        self._environment = load_environment(environment)
        self._material_space, self._lights, self._model_lights = material_space, lights, model_lights
        self._skybox = read_skybox(model, material_space)
        self._progress = progress or (lambda what, share: None)
        self._option = mujoco.MjvOption()
        self._scene = mujoco.MjvScene(model, int(max_geom))
        self._shown = 0
        self._looks = looks(model, self._option)
        self._bodies, room = self._meet(self._option)
        self._standing: Stage | None = self._set_stage(self._option, self._bodies, room)
        self._depth_rendering = self._segmentation_rendering = False
        self._world_from_camera: np.ndarray | None = None
        self._drawn, self._drawn_geoms = False, 0

    @property
    def model(self) -> mujoco.MjModel:
        """The model that is rendered."""
        return self._model

    @property
    def height(self) -> int:
        """Rows of the picture."""
        return self._settings.height

    @property
    def width(self) -> int:
        """Columns of the picture."""
        return self._settings.width

    @property
    def scene(self) -> mujoco.MjvScene:
        """MuJoCo's abstract scene of the last `update_scene`.

        Geoms that a script adds to it (mjv_initGeom and ngeom + 1, mjv_connector) are drawn by the next `render`, as
        marks that cast no shadows; other changes of it change nothing. `update_scene` makes it anew, without them.
        """
        return self._scene

    @property
    def environment(self) -> Environment | None:
        """The light from all around, or None; it may be set at any time, to all that a new renderer takes for it."""
        return self._environment

    @environment.setter
    def environment(self, value: str | np.ndarray | Environment | None) -> None:
        stage = self._stage
        self._environment = load_environment(value)
        relight(stage, *self._read_environments())
        self._drawn = False

    @property
    def world_from_camera(self) -> np.ndarray:
        """The camera's pose as of the last `update_scene`, float64 [4, 4]; it looks along its -z, +y is up."""
        if self._world_from_camera is None:
            raise RuntimeError("there is no camera yet; call update_scene(data, camera) first")
        return self._world_from_camera

    @property
    def stage_seconds(self) -> dict[str, float]:
        """How long each stage of the last frame took, seconds, by name, in order; empty before the first one."""
        return dict(self._stage.seconds)

    @property
    def occluders(self) -> int:
        """How many bodies cast shadows: opaque meshes that lie together on one body of MuJoCo's are one."""
        return sum(entity.casts for entity in self._stage.scene.entities)

    @property
    def field_bytes(self) -> dict[str, int]:
        """What is baked and kept for this scene, bytes: `occlusion` fields, `transfer`, basis `radiance` fields."""
        return dict(self._stage.field_bytes)

    @property
    def vertices(self) -> int:
        """How many vertices all bodies have together, after boxes and planes are cut finely."""
        return sum(len(self._stage.scene.meshes[entity.mesh].vertices) for entity in self._stage.scene.entities)

    def update_scene(
        self,
        data: mujoco.MjData,
        camera: int | str | mujoco.MjvCamera = -1,
        scene_option: mujoco.MjvOption | None = None,
    ) -> None:
        """Takes over the state that the next `render` shows.

        Args:
            data: the state, brought up to date by mj_step or mj_forward.
            camera: a camera's id or name, -1 for the free camera, or an `MjvCamera`.
            scene_option: what is drawn: groups of geoms and sites, textures, transparency; MuJoCo's defaults without.
                Where it shows other geoms than before, and where the model's own sizes or colours have changed, the
                scene is set up anew, which takes about as long as a new renderer.

        Raises:
            ValueError: there is no such camera, or `data` is of another model.
            TypeError: an argument is of another type.
            RuntimeError: the renderer is closed.
        """
        stage = self._stage
        view = read_camera(self._model, data, camera)
        option = self._option if scene_option is None else scene_option
        if not isinstance(option, mujoco.MjvOption):
            raise TypeError(
                f"scene_option is a {type(option).__name__}; give a mujoco.MjvOption, or None for the defaults"
            )
        now = looks(self._model, option)
        if now != self._looks:
            bodies, room = self._meet(option)
            self._standing = self._set_stage(option, bodies, stage.room or room)
            self._looks, self._bodies, stage = now, bodies, self._stage
        poses = read_poses(self._model, data, stage.scene, view.position)
        self._read_scene(data, option, find_camera(self._model, camera))
        place(stage, poses, view, read_delta_lights(self._model, data, stage.scene, view))
        self._world_from_camera = view.world_from_camera
        self._drawn = False

    def learn_motion(self, states: Iterable[mujoco.MjData]) -> None:
        """Finds out what skins and flexes see of themselves in a recorded motion, so that motion like it costs less.

        Where a body later bends as it never did in them, it may lack some of its own shadow. What was learned holds
        until other geoms are shown, or the model's sizes or colours change. Source: Kautz 2004, section 3.2,
        potentially visible sets.

        Args:
            states: of the motion; the same `MjData` may come every time, moved on.

        Raises:
            ValueError: there are no states, or one is of another model.
            RuntimeError: the renderer is closed.
        """
        stage, view = self._stage, mujoco.MjvScene(self._model, self._scene.maxgeom)
        motion = []
        for data in states:
            read_camera(self._model, data, -1)
            _update_view(view, self._model, data, self._option, find_camera(self._model, -1))
            motion.append(read_deformed(self._model, view, self._bodies))
        if not motion:
            raise ValueError("the motion to learn has no states; give at least one MjData")
        learn(stage, motion, self._progress)
        self._drawn = False

    def render(self, *, out: np.ndarray | None = None) -> np.ndarray:
        """The picture of the last `update_scene`.

        Args:
            out: an array that receives it, cast to its type as MuJoCo's renderer does, and is returned.

        Returns:
            uint8 [height, width, 3], sRGB; with depth rendering on, float32 [height, width], metres, at most the far
            clipping plane; with segmentation rendering on, int32 [height, width, 2], object ids and types.

        Raises:
            RuntimeError: `update_scene` was not called, or the renderer is closed.
            ValueError: `out` has another shape.
        """
        stage = self._draw()
        if self._depth_rendering:
            depth = read_layers(stage.film, ("depth",))["depth"]
            far = self._model.vis.map.zfar * self._model.stat.extent
            picture = np.minimum(depth, np.float32(far))
        elif self._segmentation_rendering:
            picture = read_layers(stage.film, ("segmentation",))["segmentation"]
        else:
            start = time.perf_counter()
            color = stage.film.layers.color.numpy()[0].reshape(self.height, self.width, 3)
            picture = to_display(color, exposure=self._exposure, view=self._view)
            stage.seconds["display"] = time.perf_counter() - start
        if out is None:
            return picture
        if out.shape != picture.shape:
            raise ValueError(f"out has the shape {out.shape}, the picture {picture.shape}; give an array of its shape")
        np.copyto(out, picture, casting="unsafe")
        return out

    def layers(self) -> dict[str, np.ndarray]:
        """The layers of the last `update_scene`, as arrays of their own.

        - `color`, radiance with background and luminous surfaces; `direct`, what lights and environment cause by one
          reflection; `indirect`, what came by other bodies; `albedo`; `normal`, in the world: float32 [height, width,
          3], linear, before `exposure` and `view`.
        - `depth`: metres along the optical axis, infinite where nothing is, float32 [height, width].
        - `segmentation`: MuJoCo's object id and type, -1 where nothing is, int32 [height, width, 2].

        Raises:
            RuntimeError: `update_scene` was not called, or the renderer is closed.
        """
        return read_layers(self._draw().film)

    def enable_depth_rendering(self) -> None:
        """From now on `render` returns depth, in place of pictures or segmentation."""
        self._depth_rendering, self._segmentation_rendering = True, False

    def disable_depth_rendering(self) -> None:
        """`render` returns pictures again."""
        self._depth_rendering = False

    def enable_segmentation_rendering(self) -> None:
        """From now on `render` returns object ids and types, in place of pictures or depth."""
        self._depth_rendering, self._segmentation_rendering = False, True

    def disable_segmentation_rendering(self) -> None:
        """`render` returns pictures again."""
        self._segmentation_rendering = False

    def close(self) -> None:
        """Gives back the device's memory, as the end of a `with` block does; closing twice is no error."""
        self._standing = None

    def __enter__(self) -> Renderer:
        return self

    def __exit__(self, kind, error, trace) -> None:
        self.close()

    def __reduce__(self) -> NoReturn:
        raise TypeError("a Renderer cannot be pickled or copied; make one in each process that renders")

    @property
    def _stage(self) -> Stage:
        if self._standing is None:
            raise RuntimeError("the renderer is closed; make a new one")
        return self._standing

    def _set_stage(self, option: mujoco.MjvOption, bodies: tuple[DeformingBody, ...], room: LooseRoom | None) -> Stage:
        shapes = tuple(body.shape for body in bodies)
        scene = build_scene(
            self._model,
            option=option,
            material_space=self._material_space,
            lights=self._lights,
            model_lights=self._model_lights,
            deforming=shapes,
            loose=room,
        )
        return set_stage(scene, *self._read_environments(), self._settings, shapes, room, self._progress)

    def _read_environments(self) -> tuple[list[Environment], Environment | None]:
        """Those whose light adds up, and the one that is seen in the background."""
        environments = [] if self._environment is None else [self._environment]
        if self._model_lights:
            environments += read_image_lights(self._model, self._material_space)
        return environments, self._skybox or next(iter(environments), None)

    def _draw(self) -> Stage:
        """The stage with the layers of the present state."""
        stage = self._stage
        if self._world_from_camera is None:
            raise RuntimeError("there is nothing to render yet; call update_scene(data, camera) first")
        if not self._drawn or self._scene.ngeom != self._drawn_geoms:
            stage = self._bring_loose(stage)
            place_deforming(stage, read_deformed(self._model, self._scene, self._bodies))
            tell = (lambda what, share: None) if stage.seconds else self._progress  # of the first frame, which may wait
            tell("preparing kernels", 0.0)
            draw(stage)
            tell("preparing kernels", 1.0)
            self._drawn, self._drawn_geoms = True, self._scene.ngeom
        return stage

    def _bring_loose(self, stage: Stage) -> Stage:
        """Brings tendons and added geoms to the stage, or to a larger one where they need more room."""
        lasting = sum(len(entity.parts) for entity in stage.scene.entities if entity.parts[0].object_id >= 0)
        loose = None
        if self._scene.ngeom > lasting:
            loose = read_loose(self._model, self._scene, self._shown, self._material_space, self._metres_per_pixel())
        if loose is not None and (stage.room is None or not stage.room.holds(loose)):
            standing, self._standing = stage, self._set_stage(self._option_in_use, self._bodies, make_room(loose))
            stage = self._stage
            take_over(stage, standing)
        if stage.room is not None:
            place_loose(stage, loose)
        return stage

    def _meet(self, option: mujoco.MjvOption) -> tuple[tuple[DeformingBody, ...], LooseRoom | None]:
        """The deforming bodies that `option` shows, as the model's initial state has them, and room for the rest."""
        model = self._model
        if model.ntendon + model.nflex + model.nskin == 0:
            return (), None
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        view = mujoco.MjvScene(model, self._scene.maxgeom)
        _update_view(view, model, data, option, find_camera(model, -1))
        loose = read_loose(model, view, view.ngeom, self._material_space, 0.0)
        bodies = meet_deforming(model, data, option, self._material_space)
        return bodies, None if loose is None else make_room(loose)

    def _read_scene(self, data: mujoco.MjData, option: mujoco.MjvOption, camera: mujoco.MjvCamera) -> None:
        _update_view(self._scene, self._model, data, option, camera)
        self._shown, self._option_in_use = self._scene.ngeom, option

    def _metres_per_pixel(self) -> float:
        """What a pixel of the picture spans at a distance of one metre."""
        left = self._scene.camera[0]
        return float((left.frustum_top - left.frustum_bottom) / left.frustum_near) / self.height


def _update_view(
    view: mujoco.MjvScene,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    option: mujoco.MjvOption,
    camera: mujoco.MjvCamera,
) -> None:
    """Makes MuJoCo's abstract scene of a state."""
    mujoco.mjv_updateScene(model, data, option, None, camera, mujoco.mjtCatBit.mjCAT_ALL.value, view)


def _check_model(model: mujoco.MjModel) -> None:
    if not isinstance(model, mujoco.MjModel):
        raise TypeError(
            f"model is a {type(model).__name__}; give a mujoco.MjModel, for example mujoco.MjModel.from_xml_path(path)"
        )
