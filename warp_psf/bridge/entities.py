"""The scene of a model: what its geoms, sites and area lights are as entities, and where they are in a frame."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import mujoco
import numpy as np

from warp_psf.bridge.lights import body_of_light, light_kind, model_lights_of
from warp_psf.bridge.look import SPACES, find_texture, make_material, read_texture
from warp_psf.bridge.model import check_data, label
from warp_psf.bridge.shapes import ShapeKey, geom_shape_key, make_shape, site_shape_key
from warp_psf.bridge.shown import OPAQUE, Shown, find_shown
from warp_psf.scene.light import AreaLight, Light, area_light_entities, check_lights
from warp_psf.scene.material import Material
from warp_psf.scene.mesh import Mesh
from warp_psf.scene.scene import Entity, Part, Poses, Scene
from warp_psf.scene.texture import Texture

OBJECT = mujoco.mjtObj


def build_scene(
    model: mujoco.MjModel,
    *,
    option: mujoco.MjvOption | None = None,
    material_space: str = "srgb",
    lights: Sequence[Light] = (),
    model_lights: bool = True,
) -> Scene:
    """Everything about a model that does not change from frame to frame.

    Entities are the geoms that `option` shows, in the model's order, then the sites, then one for every `AreaLight`
    (`area_light_entities` pairs them). Equal shapes share a mesh. A plane without a size becomes a square that reaches
    beyond what the camera sees. Sites are seen and shaded, but are marks and no bodies: they take light from nothing.
    What is not drawn yet (flexes, skins) is named in one warning.

    Args:
        option: what is shown; MuJoCo's defaults without.
        material_space: what MJCF's rgba and textures mean: "srgb" is decoded to linear, "linear" is taken as it is.
        lights: area lights, and any others, in addition to the model's.
        model_lights: False leaves out the model's lights and its headlight.

    Returns:
        The scene; its lights are the area lights of `lights` first, then the others, then the model's, headlight last.

    Raises:
        ValueError: `material_space` is unknown, or a light hangs on a body, or follows a light, that the model lacks.
        TypeError: `lights` is not a list of lights.
    """
    if material_space not in SPACES:
        raise ValueError(f"material_space is {material_space!r}; choose 'srgb' or 'linear'")
    check_lights(lights, model.nlight)
    undrawn = _undrawn(model)
    if undrawn:
        warnings.warn(f"not drawn, because not supported yet: {', '.join(undrawn)}", stacklevel=2)
    build = _Build(model, find_shown(model, option or mujoco.MjvOption()), material_space)
    for geom in build.shown.geoms:
        key = geom_shape_key(model, geom)
        if key is not None:
            rgba, material = build.shown.geom_rgba[geom], int(model.geom_matid[geom])
            build.add(key, "geom", geom, rgba, material, casts=True)
    for site in build.shown.sites:
        key = site_shape_key(model, site)
        if key is not None:
            rgba, material = build.shown.site_rgba[site], int(model.site_matid[site])
            build.add(key, "site", site, rgba, material, casts=False)
    area = [light for light in lights if isinstance(light, AreaLight)]
    for light in area:
        body_of_light(model, light)
        build.add_light(light)
    others = [light for light in lights if not isinstance(light, AreaLight)]
    of_model = model_lights_of(model) if model_lights else []
    return Scene(tuple(build.shapes), tuple(build.entities), (*area, *others, *of_model), tuple(build.textures))


def read_poses(model: mujoco.MjModel, data: mujoco.MjData, scene: Scene) -> Poses:
    """Where every entity of a scene is in this state, as one world: geoms, sites and area lights.

    Raises:
        ValueError: `data` is of another model, or holds no finite poses.
    """
    check_data(model, data)
    area = area_light_entities(scene)
    objects = scene.entities[: len(scene.entities) - len(area)]
    position = np.empty((1, len(scene.entities), 3), dtype=np.float32)
    rotation = np.empty((1, len(scene.entities), 3, 3), dtype=np.float32)
    kinds = np.array([entity.parts[0].object_type for entity in objects], np.int64)
    ids = np.array([entity.parts[0].object_id for entity in objects], np.int64)
    for kind, at, turned in (
        (OBJECT.mjOBJ_GEOM, data.geom_xpos, data.geom_xmat),
        (OBJECT.mjOBJ_SITE, data.site_xpos, data.site_xmat),
    ):
        chosen = np.flatnonzero(kinds == kind)
        position[0, chosen] = at[ids[chosen]]
        rotation[0, chosen] = turned[ids[chosen]].reshape(-1, 3, 3)
    for light, entity in area:
        body = body_of_light(model, light)
        world_from_body = data.xmat[body].reshape(3, 3)
        position[0, entity] = data.xpos[body] + world_from_body @ light.position
        rotation[0, entity] = world_from_body @ light.rotation
    broken = ~(np.isfinite(position[0]).all(axis=1) & np.isfinite(rotation[0]).all(axis=(1, 2)))
    if broken.any():
        name = scene.entities[int(broken.argmax())].name
        raise ValueError(f"the pose of {name} is not finite at time {data.time:g}; the simulation has diverged")
    # MjData is all zero until its kinematics have run, and so is the rotation.
    if not rotation[0].any(axis=(1, 2)).all():
        raise ValueError("data holds no poses yet; call mujoco.mj_forward(model, data) before it is drawn")
    return Poses(position, rotation)


class _Build:
    """A scene in the making: shapes and textures are made when the first entity needs them."""

    def __init__(self, model: mujoco.MjModel, shown: Shown, material_space: str):
        self.model, self.shown, self._space = model, shown, material_space
        self.shapes: list[Mesh] = []
        self.entities: list[Entity] = []
        self.textures: list[Texture] = []
        self._places: dict[ShapeKey, int] = {}
        self._texture_places: dict[int, int] = {}

    def add(self, key: ShapeKey, kind: str, index: int, rgba: np.ndarray, material: int, *, casts: bool) -> None:
        """Adds the geom or site of this shape and look."""
        if key not in self._places:
            self._places[key] = len(self.shapes)
            self.shapes.append(make_shape(self.model, key))
        name, alpha = label(self.model, kind, index), float(rgba[3])
        look = make_material(self.model, rgba, material, self._space)
        object_type = OBJECT.mjOBJ_GEOM if kind == "geom" else OBJECT.mjOBJ_SITE
        part = Part(name, look, index, int(object_type), self._texture(material))
        opacity = 1.0 if alpha >= OPAQUE else alpha
        self.entities.append(Entity(name, self._places[key], (part,), opacity=opacity, casts=casts))

    def add_light(self, light: AreaLight) -> None:
        """Adds the shining body of an area light; lights that were given the same mesh share it, like geoms."""
        known = next((index for index, mesh in enumerate(self.shapes) if mesh is light.mesh), len(self.shapes))
        if known == len(self.shapes):
            self.shapes.append(light.mesh)
        shine = Material(np.zeros(3), np.zeros(3), 0.0, light.radiance)
        part = Part(light.name, shine, -1, int(OBJECT.mjOBJ_UNKNOWN))
        self.entities.append(Entity(light.name, known, (part,), casts=False))

    def _texture(self, material: int) -> int:
        texture = find_texture(self.model, material) if self.shown.textured else -1
        if texture >= 0 and texture not in self._texture_places:
            self._texture_places[texture] = len(self.textures)
            self.textures.append(read_texture(self.model, texture, self._space))
        return self._texture_places.get(texture, -1)


def _undrawn(model: mujoco.MjModel) -> list[str]:
    """Names of what the model shows and this library does not."""
    names = [label(model, "flex", index) for index in range(model.nflex)]
    names += [label(model, "skin", index) for index in range(model.nskin)]
    images = [index for index in range(model.nlight) if light_kind(model, index) is None]
    return names + [f"{label(model, 'light', index)} (image)" for index in images]
