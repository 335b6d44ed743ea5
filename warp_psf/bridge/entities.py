"""The scene of a model: what its geoms, sites and area lights are as entities, and where they are in a frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np

from warp_psf.bridge.grouping import group_geoms
from warp_psf.bridge.lights import body_of_light, model_lights_of
from warp_psf.bridge.look import SPACES, find_texture, make_material, read_texture
from warp_psf.bridge.mapping import make_mapping, mesh_coordinates
from warp_psf.bridge.model import check_data, label
from warp_psf.bridge.shapes import ShapeKey, geom_shape_key, make_shape, plane_step, site_shape_key
from warp_psf.bridge.shown import OPAQUE, Shown, find_shown, flex_materials
from warp_psf.scene.deforming import DeformingShape, make_entity
from warp_psf.scene.join import join_meshes
from warp_psf.scene.light import AreaLight, Light, area_light_entities, check_lights
from warp_psf.scene.loose import LooseRoom, reserve
from warp_psf.scene.material import Material
from warp_psf.scene.mesh import Mesh
from warp_psf.scene.scene import Entity, Part, Poses, Scene
from warp_psf.scene.texture import Texture, Wrap

OBJECT = mujoco.mjtObj


def build_scene(
    model: mujoco.MjModel,
    *,
    option: mujoco.MjvOption | None = None,
    material_space: str = "srgb",
    lights: Sequence[Light] = (),
    model_lights: bool = True,
    deforming: Sequence[DeformingShape] = (),
    loose: LooseRoom | None = None,
) -> Scene:
    """Everything about a model that does not change from frame to frame.

    Entities are the geoms that `option` shows, alone or in groups (`group_geoms`), then the sites, then the bodies that
    deform (`meet_deforming`), then one that stands for all that has no lasting shape (`read_loose`), then one for every
    `AreaLight` (`area_light_entities` pairs them). Equal shapes share a mesh. A plane without a size becomes a square
    that reaches beyond what the camera sees. Sites and loose things are seen and shaded, but take light from nothing.

    Args:
        option: what is shown; MuJoCo's defaults without.
        material_space: what MJCF's rgba and textures mean: "srgb" is decoded to linear, "linear" is taken as it is.
        lights: area lights, and any others, in addition to the model's.
        model_lights: False leaves out the model's lights and its headlight.
        deforming: the skins and flexes that `option` shows.
        loose: room for what has no lasting shape; None for none.

    Returns:
        The scene; its lights are the area lights of `lights` first, then the others, then the model's, headlight last.

    Raises:
        ValueError: `material_space` is unknown, or a light hangs on a body, or follows a light, that the model lacks.
        TypeError: `lights` is not a list of lights.
    """
    if material_space not in SPACES:
        raise ValueError(f"material_space is {material_space!r}; choose 'srgb' or 'linear'")
    check_lights(lights, model.nlight)
    build = _Build(model, find_shown(model, option or mujoco.MjvOption()), material_space)
    for geoms in group_geoms(model, build.shown):
        if len(geoms) > 1:
            build.add_group(geoms)
        elif (key := geom_shape_key(model, geoms[0])) is not None:
            rgba, material = build.shown.geom_rgba[geoms[0]], int(model.geom_matid[geoms[0]])
            build.add(key, "geom", geoms[0], rgba, material, casts=True)
    for site in build.shown.sites:
        key = site_shape_key(model, site)
        if key is not None:
            rgba, material = build.shown.site_rgba[site], int(model.site_matid[site])
            build.add(key, "site", site, rgba, material, casts=False)
    places = tuple(build.add_deforming(shape) for shape in deforming)
    place_of_loose = -1
    if loose is not None:
        place_of_loose = len(build.entities)
        shape, entity = reserve(loose, len(build.shapes))
        build.shapes.append(shape)
        build.entities.append(entity)
    area = [light for light in lights if isinstance(light, AreaLight)]
    for light in area:
        body_of_light(model, light)
        build.add_light(light)
    others = [light for light in lights if not isinstance(light, AreaLight)]
    of_model = model_lights_of(model) if model_lights else []
    lamps = (*area, *others, *of_model)
    return Scene(tuple(build.shapes), tuple(build.entities), lamps, tuple(build.textures), place_of_loose, places)


def read_poses(model: mujoco.MjModel, data: mujoco.MjData, scene: Scene, eye: np.ndarray | None = None) -> Poses:
    """Where every entity of a scene is in this state, as one world: geoms, sites and area lights.

    eye: the camera's position, [3], metres; infinite planes follow it. Without it they stay where the model has them.

    Raises:
        ValueError: `data` is of another model, or holds no finite poses.
    """
    check_data(model, data)
    area = area_light_entities(scene)
    objects = scene.entities[: len(scene.entities) - len(area)]
    position = np.zeros((1, len(scene.entities), 3), dtype=np.float32)
    # What deforms and what is loose lies in the world's frame.
    rotation = np.tile(np.eye(3, dtype=np.float32), (1, len(scene.entities), 1, 1))
    kinds = np.array([entity.parts[0].object_type for entity in objects], np.int64)
    ids = np.array([entity.parts[0].object_id for entity in objects], np.int64)
    grouped = np.array([len(entity.parts) > 1 and index != scene.loose for index, entity in enumerate(objects)], bool)
    for kind, at, turned in (
        (OBJECT.mjOBJ_GEOM, data.geom_xpos, data.geom_xmat),
        (OBJECT.mjOBJ_SITE, data.site_xpos, data.site_xmat),
    ):
        chosen = np.flatnonzero((kinds == kind) & ~grouped)
        position[0, chosen] = at[ids[chosen]]
        rotation[0, chosen] = turned[ids[chosen]].reshape(-1, 3, 3)
    bodies = model.geom_bodyid[ids[grouped]]
    position[0, np.flatnonzero(grouped)] = data.xpos[bodies]
    rotation[0, np.flatnonzero(grouped)] = data.xmat[bodies].reshape(-1, 3, 3)
    if eye is not None:
        _follow(model, ids, kinds, position[0], rotation[0], eye)
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


def _follow(
    model: mujoco.MjModel,
    ids: np.ndarray,
    kinds: np.ndarray,
    position: np.ndarray,
    rotation: np.ndarray,
    eye: np.ndarray,
) -> None:
    """Moves the infinite planes in steps along themselves, so that the camera never comes near their ends."""
    for entity in np.flatnonzero(kinds == OBJECT.mjOBJ_GEOM):
        geom = ids[entity]
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE and (model.geom_size[geom, :2] <= 0.0).any():
            offset = rotation[entity].T @ (eye - position[entity])
            for axis in np.flatnonzero(model.geom_size[geom, :2] <= 0.0):
                step = plane_step(model, geom, int(axis))
                position[entity] += step * np.round(offset[axis] / step) * rotation[entity][:, axis]


class _Build:
    """A scene in the making: shapes and textures are made when the first entity needs them."""

    def __init__(self, model: mujoco.MjModel, shown: Shown, material_space: str):
        self.model, self.shown, self._space = model, shown, material_space
        self.shapes: list[Mesh] = []
        self.entities: list[Entity] = []
        self.textures: list[Texture] = []
        self._places: dict[ShapeKey, int] = {}
        self._meshes: dict[ShapeKey, Mesh] = {}
        self._texture_places: dict[int, int] = {}

    def add(self, key: ShapeKey, kind: str, index: int, rgba: np.ndarray, material: int, *, casts: bool) -> None:
        """Adds the geom or site of this shape and look."""
        part, alpha = self._part(kind, index, rgba, material), float(rgba[3])
        opacity, mesh = 1.0 if alpha >= OPAQUE else alpha, self._mesh(key)
        given = self._coordinates(index, mesh) if part.mapping.wrap == Wrap.GIVEN else None
        self.entities.append(Entity(part.name, self._place(key), (part,), None, given, opacity, casts))

    def add_group(self, geoms: tuple[int, ...]) -> None:
        """Adds geoms of one body that make up one shape, in the frame of the body."""
        model, keys = self.model, [geom_shape_key(self.model, geom) for geom in geoms]
        rotations = np.zeros((len(geoms), 9))
        for rotation, geom in zip(rotations, geoms, strict=True):
            mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
        positions, rotations = model.geom_pos[list(geoms)], rotations.reshape(-1, 3, 3)
        # Both arms of a robot share the shapes of their links.
        joint = ("group", tuple(keys), positions.tobytes(), rotations.tobytes())
        meshes = [self._mesh(key) for key in keys if key is not None]
        body = int(model.geom_bodyid[geoms[0]])
        if joint not in self._places:
            self._places[joint] = len(self.shapes)
            placed = list(zip(meshes, positions, rotations, strict=True))
            self.shapes.append(join_meshes(label(model, "body", body), placed))
        parts = [self._part("geom", geom, self.shown.geom_rgba[geom], int(model.geom_matid[geom])) for geom in geoms]
        parts = [
            replace(part, mapping=replace(part.mapping, position=position, rotation=rotation))
            for part, position, rotation in zip(parts, positions, rotations, strict=True)
        ]
        given = None
        if any(part.mapping.wrap == Wrap.GIVEN for part in parts):
            pairs = list(zip(geoms, meshes, parts, strict=True))
            given = np.concatenate([self._coordinates(geom, mesh, part.mapping.wrap) for geom, mesh, part in pairs])
        face_part = np.repeat(np.arange(len(geoms)), [len(mesh.faces) for mesh in meshes]).astype(np.int32)
        name = label(model, "body", body)
        self.entities.append(Entity(name, self._places[joint], tuple(parts), face_part, given))

    def _coordinates(self, geom: int, mesh: Mesh, wrap: Wrap = Wrap.GIVEN) -> np.ndarray:
        """What a geom's mesh brings of texture coordinates, zeros where a formula gives them; float32 [F, 3, 2]."""
        if wrap != Wrap.GIVEN:
            return np.zeros((len(mesh.faces), 3, 2), np.float32)
        return mesh_coordinates(self.model, int(self.model.geom_dataid[geom]), mesh)

    def _place(self, key: ShapeKey) -> int:
        """Where the shape is among the shapes."""
        if key not in self._places:
            self._places[key] = len(self.shapes)
            self.shapes.append(self._mesh(key))
        return self._places[key]

    def _mesh(self, key: ShapeKey) -> Mesh:
        if key not in self._meshes:
            self._meshes[key] = make_shape(self.model, key)
        return self._meshes[key]

    def _part(self, kind: str, index: int, rgba: np.ndarray, material: int) -> Part:
        look = make_material(self.model, rgba, material, self._space)
        object_type = OBJECT.mjOBJ_GEOM if kind == "geom" else OBJECT.mjOBJ_SITE
        name = label(self.model, kind, index)
        texture = find_texture(self.model, material) if self.shown.textured else -1
        if texture < 0:
            return Part(name, look, index, int(object_type))
        model = self.model
        if kind == "geom":
            shape = int(model.geom_type[index]), model.geom_size[index], int(model.geom_dataid[index])
        else:
            shape = int(model.site_type[index]), model.site_size[index], -1
        mapping = make_mapping(model, *shape, material, texture)
        return Part(name, look, index, int(object_type), self._texture(texture), mapping)

    def add_deforming(self, shape: DeformingShape) -> int:
        """Adds a skin or flex; returns its place among the entities."""
        part = shape.part
        if shape.texture_coordinates is not None:
            is_skin = part.object_type == OBJECT.mjOBJ_SKIN
            materials = self.model.skin_matid if is_skin else flex_materials(self.model)
            texture = find_texture(self.model, int(materials[part.object_id]))
            part = replace(part, texture=self._texture(texture))
        mesh, entity = make_entity(shape, len(self.shapes), part)
        self.shapes.append(mesh)
        self.entities.append(entity)
        return len(self.entities) - 1

    def add_light(self, light: AreaLight) -> None:
        """Adds the shining body of an area light; lights that were given the same mesh share it, like geoms."""
        known = next((index for index, mesh in enumerate(self.shapes) if mesh is light.mesh), len(self.shapes))
        if known == len(self.shapes):
            self.shapes.append(light.mesh)
        shine = Material(np.zeros(3), np.zeros(3), 0.0, light.radiance)
        part = Part(light.name, shine, -1, int(OBJECT.mjOBJ_UNKNOWN))
        self.entities.append(Entity(light.name, known, (part,), casts=False))

    def _texture(self, texture: int) -> int:
        """Where a texture of the model's is among the textures."""
        if texture not in self._texture_places:
            self._texture_places[texture] = len(self.textures)
            self.textures.append(read_texture(self.model, texture, self._space))
        return self._texture_places[texture]
