"""MuJoCo's models and data as scenes, poses, lights and cameras."""

from __future__ import annotations

import itertools
import operator
import os
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import mujoco
import numpy as np

from warp_psf.scene import primitives
from warp_psf.scene.camera import Camera
from warp_psf.scene.light import AreaLight, DeltaLight, Light, area_light_entities, check_lights
from warp_psf.scene.material import Material
from warp_psf.scene.mesh import Mesh, make_mesh
from warp_psf.scene.scene import Entity, Poses, Scene

# Geoms of these groups are drawn, as by default in MuJoCo (MjvOption.geomgroup); 3 to 5 are for collision shapes.
VISIBLE_GROUPS = (0, 1, 2)
# Half the side of an infinite plane, in units of model.stat.extent: twice MuJoCo's default far plane (zfar, 50).
INFINITE_PLANE = 100.0
# The colour by which MuJoCo knows that a geom has none of its own, so that its material's counts.
NO_COLOR = np.array((0.5, 0.5, 0.5, 1.0), dtype=np.float32)
# What a geom without a material has (mjv_initGeom).
DEFAULT_SPECULAR, DEFAULT_SHININESS = 0.5, 0.5
# MuJoCo's classic renderer: exponent of its highlight around the half vector, per unit of shininess.
CLASSIC_EXPONENT = 128.0
# A lobe around the half vector is as wide as one around the mirror direction with a quarter of its exponent.
MIRROR_PER_HALF_VECTOR = 0.25
# A camera whose image is shifted by more than this part of its height is warned about.
CENTERED = 1e-4
# A message lists at most this many bodies: a large model has thousands.
MOST_NAMES = 20
# The index of the light at the camera.
HEADLIGHT = -1
# MJCF's default range, metres. As the classic renderer has no range, only one that somebody chose ends a light.
UNSET_RANGE = 10.0

GEOM = mujoco.mjtGeom
# How many of a geom's sizes a type uses (the others hold anything and must not tell equal shapes apart), and its mesh.
PRIMITIVES = {
    GEOM.mjGEOM_PLANE: (2, lambda sizes: primitives.plane(*sizes)),
    GEOM.mjGEOM_BOX: (3, primitives.box),
    GEOM.mjGEOM_SPHERE: (1, lambda sizes: primitives.sphere(*sizes)),
    GEOM.mjGEOM_CAPSULE: (2, lambda sizes: primitives.capsule(*sizes)),
    GEOM.mjGEOM_CYLINDER: (2, lambda sizes: primitives.cylinder(*sizes)),
    GEOM.mjGEOM_ELLIPSOID: (3, primitives.ellipsoid),
}


def load_model(path: str | os.PathLike) -> mujoco.MjModel:
    """The model of an MJCF or URDF file (.xml, .urdf), or of a compiled one (.mjb).

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: MuJoCo cannot read it; the message carries MuJoCo's reason.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"model {str(path)!r} does not exist; give the path of an .xml, .urdf or .mjb file")
    load = mujoco.MjModel.from_binary_path if path.suffix.lower() == ".mjb" else mujoco.MjModel.from_xml_path
    try:
        return load(str(path))
    except (ValueError, RuntimeError, mujoco.FatalError) as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"model {str(path)!r} cannot be loaded: {reason}") from error


def simulate(model: mujoco.MjModel, frames_per_second: float) -> Iterator[mujoco.MjData]:
    """The states of a passive simulation from the model's start, frame after frame without end.

    Yields the same `MjData` every time, stepped on; frame 0 is the start. Simulated time follows the frames' to the
    nearest step.

    Raises:
        ValueError: the simulation diverges; MuJoCo starts it anew then, which no film should show.
    """
    data = mujoco.MjData(model)
    steps = 0
    for frame in itertools.count():
        target = round(frame / frames_per_second / model.opt.timestep)
        for _ in range(target - steps):
            before = data.time
            mujoco.mj_step(model, data)
            if data.time <= before:
                raise ValueError(
                    f"the simulation diverged at {before:g} s; give the model a shorter timestep or softer contacts"
                )
        steps = target
        # A step leaves the poses of bodies and geoms one step behind the joints.
        mujoco.mj_forward(model, data)
        yield data


def build_scene(
    model: mujoco.MjModel,
    *,
    material_space: str = "srgb",
    lights: Sequence[Light] = (),
    model_lights: bool = True,
) -> Scene:
    """Everything about a model that does not change from frame to frame.

    Entities come in the order of the model's geoms, then one for every `AreaLight` (`area_light_entities` pairs them).
    Drawn are the geoms of groups 0, 1 and 2 whose alpha is not 0; any other alpha counts as opaque. Equal shapes share
    a mesh. A plane without a size becomes a square of 200 times the model's extent. What is not drawn yet (height
    fields, signed distance fields, flexes, skins, image lights) is named in one warning.

    Args:
        material_space: what MJCF's rgba means: "srgb" is decoded to linear, "linear" is taken as it is.
        lights: area lights, and any others, in addition to the model's.
        model_lights: False leaves out the model's lights and its headlight.

    Returns:
        The scene; its lights are the area lights of `lights` first, then the others, then the model's, headlight last.

    Raises:
        ValueError: `material_space` is unknown, or a light hangs on a body, or follows a light, that the model lacks.
        TypeError: `lights` is not a list of lights.
    """
    if material_space not in ("srgb", "linear"):
        raise ValueError(f"material_space is {material_space!r}; choose 'srgb' or 'linear'")
    check_lights(lights, model.nlight)
    undrawn = _undrawn(model)
    if undrawn:
        warnings.warn(f"not drawn, because not supported yet: {', '.join(undrawn)}", stacklevel=2)
    shapes, entities = _geom_entities(model, material_space)
    area = [light for light in lights if isinstance(light, AreaLight)]
    for light in area:
        _body_id(model, light)
        # Lights that were given the same mesh share it, like geoms.
        known = next((index for index, mesh in enumerate(shapes) if mesh is light.mesh), len(shapes))
        if known == len(shapes):
            shapes.append(light.mesh)
        shine = Material(np.zeros(3), np.zeros(3), 0.0, light.radiance)
        entities.append(Entity(light.name, known, shine, -1, int(mujoco.mjtObj.mjOBJ_UNKNOWN)))
    others = [light for light in lights if not isinstance(light, AreaLight)]
    of_model = _model_lights(model) if model_lights else []
    return Scene(tuple(shapes), tuple(entities), (*area, *others, *of_model))


def read_poses(model: mujoco.MjModel, data: mujoco.MjData, scene: Scene) -> Poses:
    """Where every entity of a scene is in this state, as one world: the geoms and the area lights.

    Raises:
        ValueError: `data` is of another model, or holds no finite poses.
    """
    check_data(model, data)
    area = area_light_entities(scene)
    geoms = [entity.object_id for entity in scene.entities[: len(scene.entities) - len(area)]]
    position = np.empty((1, len(scene.entities), 3), dtype=np.float32)
    rotation = np.empty((1, len(scene.entities), 3, 3), dtype=np.float32)
    position[0, : len(geoms)] = data.geom_xpos[geoms]
    rotation[0, : len(geoms)] = data.geom_xmat[geoms].reshape(-1, 3, 3)
    for light, entity in area:
        body = _body_id(model, light)
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


def read_delta_lights(
    model: mujoco.MjModel, data: mujoco.MjData, scene: Scene, camera: Camera
) -> tuple[DeltaLight, ...]:
    """The scene's delta lights as they are in this state: moved with their bodies, without those that are switched off.

    The headlight sits at `camera` and shines along its view.

    Raises:
        ValueError: `data` is of another model.
    """
    check_data(model, data)
    now = []
    for light in scene.lights:
        if not isinstance(light, DeltaLight):
            continue
        if light.index is None:
            now.append(light)
        elif light.index == HEADLIGHT:
            now.append(replace(light, position=camera.position, direction=-camera.rotation[:, 2]))
        elif model.light_active[light.index]:
            position, direction = data.light_xpos[light.index], data.light_xdir[light.index]
            now.append(replace(light, position=position, direction=direction))
    return tuple(now)


def read_camera(model: mujoco.MjModel, data: mujoco.MjData, camera: int | str | mujoco.MjvCamera = -1) -> Camera:
    """The pinhole camera that `mujoco.Renderer` would use: an id, a name, -1 for the free camera, or an MjvCamera.

    Raises:
        ValueError: there is no such camera, it is orthographic, or `data` is of another model.
    """
    check_data(model, data)
    chosen = _find_camera(model, camera)
    # MuJoCo itself computes the view: this object holds no more than its two cameras, and needs no OpenGL.
    view = mujoco.MjvScene()
    mujoco.mjv_updateCamera(model, data, chosen, view)
    left, right = view.camera[0], view.camera[1]
    if left.orthographic:
        raise ValueError(f"camera {_camera_name(model, chosen)} is orthographic; only perspective cameras are drawn")
    height = left.frustum_top - left.frustum_bottom
    shift = max(abs(left.frustum_top + left.frustum_bottom), abs(2.0 * left.frustum_center))
    if shift > CENTERED * height:
        warnings.warn(f"camera {_camera_name(model, chosen)}: its shifted image is drawn centred", stacklevel=2)
    position = 0.5 * (np.array(left.pos, dtype=np.float64) + np.array(right.pos, dtype=np.float64))
    back = -np.array(left.forward, dtype=np.float64)
    back /= np.linalg.norm(back)
    across = np.cross(np.array(left.up, dtype=np.float64), back)
    across /= np.linalg.norm(across)
    rotation = np.stack((across, np.cross(back, across), back), axis=1)
    return Camera(position, rotation, float(2.0 * np.arctan(0.5 * height / left.frustum_near)))


def check_data(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Raises ValueError unless `data` was made for `model`, TypeError unless it is MuJoCo's."""
    if not isinstance(data, mujoco.MjData):
        raise TypeError(f"data is a {type(data).__name__}; give the mujoco.MjData of the model")
    sizes = {
        "nq": (model.nq, len(data.qpos)),
        "nv": (model.nv, len(data.qvel)),
        "nbody": (model.nbody, len(data.xpos)),
        "ngeom": (model.ngeom, len(data.geom_xpos)),
        "nlight": (model.nlight, len(data.light_xpos)),
        "ncam": (model.ncam, len(data.cam_xpos)),
    }
    different = [f"{name} {theirs} instead of {ours}" for name, (ours, theirs) in sizes.items() if ours != theirs]
    # The first MuJoCo 3.3 has no signature of a compiled model: there the sizes have to do.
    if not different and getattr(model, "signature", None) != getattr(data, "signature", None):
        different = ["another signature"]
    if different:
        raise ValueError(f"data is of another model ({', '.join(different)}); make it with mujoco.MjData(model)")


# Geoms


def _geom_entities(model: mujoco.MjModel, material_space: str) -> tuple[list[Mesh], list[Entity]]:
    places: dict[tuple, int] = {}
    shapes: list[Mesh] = []
    entities: list[Entity] = []
    for geom in range(model.ngeom):
        key = _shape_key(model, geom)
        rgba, material = _geom_material(model, geom, material_space)
        if key is None or rgba[3] == 0.0 or model.geom_group[geom] not in VISIBLE_GROUPS:
            continue
        if key not in places:
            places[key] = len(shapes)
            shapes.append(_shape(model, key))
        name = _label(model, "geom", geom)
        entities.append(Entity(name, places[key], material, geom, int(mujoco.mjtObj.mjOBJ_GEOM)))
    return shapes, entities


def _undrawn(model: mujoco.MjModel) -> list[str]:
    """Names of what the model shows and this library does not."""
    visible = [geom for geom in range(model.ngeom) if model.geom_group[geom] in VISIBLE_GROUPS]
    unknown = [geom for geom in visible if _shape_key(model, geom) is None]
    names = [f"{_label(model, 'geom', geom)} ({GEOM(model.geom_type[geom]).name[7:].lower()})" for geom in unknown]
    names += [_label(model, "flex", index) for index in range(model.nflex)]
    names += [_label(model, "skin", index) for index in range(model.nskin)]
    images = [index for index in range(model.nlight) if _light_kind(model, index) is None]
    return names + [f"{_label(model, 'light', index)} (image)" for index in images]


def _label(model: mujoco.MjModel, kind: str, index: int) -> str:
    """The name of an object for messages: its own, or what it is and its number."""
    own = mujoco.mj_id2name(model, mujoco.mju_str2Type(kind), index)
    return own or f"{kind} {index}"


def _shape_key(model: mujoco.MjModel, geom: int) -> tuple | None:
    """What tells shapes apart: the type and the sizes that it uses, or the mesh; None for types that are not drawn."""
    kind = GEOM(model.geom_type[geom])
    if kind == GEOM.mjGEOM_MESH:
        return kind, int(model.geom_dataid[geom])
    if kind not in PRIMITIVES:
        return None
    count, _ = PRIMITIVES[kind]
    sizes = tuple(float(size) for size in model.geom_size[geom][:count])
    if kind == GEOM.mjGEOM_PLANE:
        sizes = tuple(half if half > 0.0 else INFINITE_PLANE * float(model.stat.extent) for half in sizes)
    return kind, sizes


def _shape(model: mujoco.MjModel, key: tuple) -> Mesh:
    kind, which = key
    if kind == GEOM.mjGEOM_MESH:
        vertices = slice(model.mesh_vertadr[which], model.mesh_vertadr[which] + model.mesh_vertnum[which])
        faces = slice(model.mesh_faceadr[which], model.mesh_faceadr[which] + model.mesh_facenum[which])
        # Already in the frame of the geoms that use it: MuJoCo centres meshes and turns them to their principal axes.
        return make_mesh(_label(model, "mesh", which), model.mesh_vert[vertices], model.mesh_face[faces])
    _, make = PRIMITIVES[kind]
    return make(which)


def _geom_material(model: mujoco.MjModel, geom: int, material_space: str) -> tuple[np.ndarray, Material]:
    """A geom's rgba as MuJoCo draws it, and the material that stands for its look.

    The colour is the geom's own; only where that is MuJoCo's default does the material's count (as in MuJoCo's
    visualiser). A texture counts with its mean colour. The classic renderer adds specular * cos^(128 shininess) of the
    angle at the half vector; here that is a Phong lobe about the mirror direction of a quarter of that exponent n, with
    the reflectance 2 specular / (n + 2), which gives the highlight of a light straight ahead the same height. Where the
    sum of both reflectances exceeds 1 both are scaled down. MuJoCo's emission times the colour is the radiance sent
    out.
    """
    rgba, index = model.geom_rgba[geom], int(model.geom_matid[geom])
    specular, shininess, emission, tint = DEFAULT_SPECULAR, DEFAULT_SHININESS, 0.0, np.ones(3)
    if index >= 0:
        if np.array_equal(rgba, NO_COLOR):
            rgba = model.mat_rgba[index]
        specular, shininess = float(model.mat_specular[index]), float(model.mat_shininess[index])
        emission = float(model.mat_emission[index])
        tint = _mean_texture(model, index, material_space)
    color = np.clip(rgba[:3].astype(np.float64), 0.0, 1.0)
    color = tint * (_linear(color) if material_space == "srgb" else color)
    exponent = MIRROR_PER_HALF_VECTOR * CLASSIC_EXPONENT * max(shininess, 0.0)
    lobe = np.full(3, 2.0 * np.clip(specular, 0.0, 1.0) / (exponent + 2.0))
    scale = 1.0 / max(1.0, float((color + lobe).max()))
    return rgba, Material(scale * color, scale * lobe, exponent, max(emission, 0.0) * color)


def _mean_texture(model: mujoco.MjModel, material: int, material_space: str) -> np.ndarray:
    """The mean linear colour of a material's colour texture, white where it has none."""
    texture = int(model.mat_texid[material, mujoco.mjtTextureRole.mjTEXROLE_RGB])
    if texture < 0 or model.tex_nchannel[texture] < 3:
        return np.ones(3)
    channels = int(model.tex_nchannel[texture])
    start, count = model.tex_adr[texture], model.tex_height[texture] * model.tex_width[texture] * channels
    pixels = model.tex_data[start : start + count].reshape(-1, channels)[:, :3]
    # A byte has 256 values: their shares give the mean without a float copy of the image.
    levels = np.arange(256) / 255.0
    levels = _linear(levels) if material_space == "srgb" else levels
    return np.array([np.bincount(pixels[:, channel], minlength=256) @ levels for channel in range(3)]) / len(pixels)


def _linear(encoded: np.ndarray) -> np.ndarray:
    """sRGB values in [0, 1] decoded to linear (IEC 61966-2-1)."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


# Lights


def _model_lights(model: mujoco.MjModel) -> list[DeltaLight]:
    """The model's lights, in its initial state, and its headlight."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_camlight(model, data)
    lights = []
    for index in range(model.nlight):
        kind = _light_kind(model, index)
        if kind is None:
            continue
        place = {"position": data.light_xpos[index], "direction": data.light_xdir[index]}
        colors = _light_colors(model.light_diffuse[index], model.light_specular[index], model.light_ambient[index])
        limits = {}
        if kind != "directional":
            limits = {"attenuation": model.light_attenuation[index], "range": _light_range(model, index)}
        if kind == "spot":
            limits |= {"cutoff": np.radians(model.light_cutoff[index]), "exponent": model.light_exponent[index]}
        bulb = {"radius": model.light_bulbradius[index], "castshadow": bool(model.light_castshadow[index])}
        lights.append(DeltaLight(_label(model, "light", index), kind, **place, **colors, **limits, **bulb, index=index))
    head = model.vis.headlight
    # 2 is "auto", which MuJoCo's own renderer takes for on.
    if head.active:
        colors = _light_colors(head.diffuse, head.specular, head.ambient)
        place = {"position": np.zeros(3), "direction": np.array((0.0, 0.0, -1.0))}
        lights.append(DeltaLight("headlight", "directional", **place, **colors, castshadow=False, index=HEADLIGHT))
    return lights


def _light_colors(diffuse, specular, ambient) -> dict[str, np.ndarray]:
    # MuJoCo accepts negative colours, and its picture clamps them.
    return {"diffuse": np.maximum(diffuse, 0), "specular": np.maximum(specular, 0), "ambient": np.maximum(ambient, 0)}


def _light_kind(model: mujoco.MjModel, index: int) -> Literal["directional", "spot", "point"] | None:
    if not hasattr(model, "light_type"):
        # The first MuJoCo 3.3 tells two kinds apart.
        return "directional" if model.light_directional[index] else "spot"
    kinds = mujoco.mjtLightType
    known = {kinds.mjLIGHT_DIRECTIONAL: "directional", kinds.mjLIGHT_SPOT: "spot", kinds.mjLIGHT_POINT: "point"}
    return known.get(kinds(model.light_type[index]))


def _light_range(model: mujoco.MjModel, index: int) -> float:
    limit = float(model.light_range[index]) if hasattr(model, "light_range") else UNSET_RANGE
    return np.inf if limit == UNSET_RANGE else max(limit, 0.0)


def _body_id(model: mujoco.MjModel, light: AreaLight) -> int:
    """The body that a light hangs on, 0 for the world; raises ValueError if the model lacks it."""
    if light.body is None:
        return 0
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, light.body)
    if body < 0:
        names = ", ".join(_label(model, "body", index) for index in range(min(model.nbody, MOST_NAMES)))
        raise ValueError(f"light {light.name!r} hangs on body {light.body!r}, which the model lacks; it has {names}")
    return body


# Cameras


def _find_camera(model: mujoco.MjModel, camera: int | str | mujoco.MjvCamera) -> mujoco.MjvCamera:
    """The MjvCamera that an id, a name or an MjvCamera means, checked against the model."""
    kinds = mujoco.mjtCamera
    chosen = camera
    if not isinstance(chosen, mujoco.MjvCamera):
        chosen = mujoco.MjvCamera()
        mujoco.mjv_defaultFreeCamera(model, chosen)
        named = isinstance(camera, str)
        index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, camera) if named else operator.index(camera)
        if named or index != -1:
            chosen.type, chosen.fixedcamid = kinds.mjCAMERA_FIXED, index
    if chosen.type == kinds.mjCAMERA_USER:
        raise ValueError("the MjvCamera is of type mjCAMERA_USER, which has no pose; choose free, tracking or fixed")
    if chosen.type == kinds.mjCAMERA_TRACKING and not 0 <= chosen.trackbodyid < model.nbody:
        raise ValueError(f"the MjvCamera tracks body {chosen.trackbodyid}; the model has 0 to {model.nbody - 1}")
    if chosen.type == kinds.mjCAMERA_FIXED and not 0 <= chosen.fixedcamid < model.ncam:
        asked = chosen.fixedcamid if isinstance(camera, mujoco.MjvCamera) else repr(camera)
        raise ValueError(f"camera {asked} does not exist; {_known_cameras(model)}")
    return chosen


def _known_cameras(model: mujoco.MjModel) -> str:
    names = ", ".join(_label(model, "camera", index) for index in range(model.ncam))
    return f"the model has {names}, and -1 is the free camera" if names else "the model has only -1, the free one"


def _camera_name(model: mujoco.MjModel, camera: mujoco.MjvCamera) -> str:
    return _label(model, "camera", camera.fixedcamid) if camera.type == mujoco.mjtCamera.mjCAMERA_FIXED else "free"
