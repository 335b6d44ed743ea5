"""A MuJoCo state as a still scene."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import replace

import mujoco
import numpy as np

from warp_psf.bridge.cameras import find_camera, read_camera
from warp_psf.bridge.deforming import meet_deforming, read_deformed
from warp_psf.bridge.entities import build_scene, read_poses
from warp_psf.scene.mesh import Mesh
from warp_psf.scene.primitives import box, plane
from warp_psf.scene.scene import Entity, Scene
from warp_psf.scene.still import Piece, StillScene, join_pieces
from warp_psf.scene.texture import decode


def freeze_scene(
    model: mujoco.MjModel,
    data: mujoco.MjData | None = None,
    *,
    cameras: Sequence[int | str | mujoco.MjvCamera] = (-1,),
    scene_option: mujoco.MjvOption | None = None,
    material_space: str = "srgb",
) -> StillScene:
    """What MuJoCo would draw of a state, as triangles in the world, seen by cameras.

    The methods of `warp_psf.area_light` take it.

    Skins and flexes come as they are bent now; sites and tendons, which cast no shadows, are left out. A texture counts
    with its mean.

    ```python
    scene = psf.freeze_scene(model, data, cameras=["front", "side"])
    ```

    Args:
        model: the compiled model.
        data: its state; None takes the model's initial one.
        cameras: a list of ids, names, -1 for the free camera, or `MjvCamera`s.
        scene_option: what is drawn; MuJoCo's defaults without.
        material_space: whether MJCF's rgba is "srgb" or "linear".

    Raises:
        ValueError: there is no such camera, `data` is of another model, a name is unknown, or nothing is drawn.
        TypeError: an argument is something else.
    """
    option = mujoco.MjvOption() if scene_option is None else scene_option
    for name, value, wanted in (("model", model, mujoco.MjModel), ("scene_option", option, mujoco.MjvOption)):
        if not isinstance(value, wanted):
            raise TypeError(f"{name} is a {type(value).__name__}; give a mujoco.{wanted.__name__}")
    if not isinstance(cameras, Sequence) or isinstance(cameras, str):
        raise TypeError(f"cameras is {cameras!r}; give a list of names or numbers, such as [-1]")
    if data is None:
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
    views = [read_camera(model, data, camera) for camera in cameras]
    # Of a copy: meeting bodies moves the flexes of the state.
    bodies = meet_deforming(model, copy(data), option, material_space) if model.nflex + model.nskin else ()
    shapes = tuple(body.shape for body in bodies)
    scene = build_scene(model, option=option, material_space=material_space, model_lights=False, deforming=shapes)
    poses = read_poses(model, data, scene, views[0].position if views else None)
    deformed = {}
    if bodies:
        view = mujoco.MjvScene(model, 10000)
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(model, data, option, None, find_camera(model, -1), everything, view)
        deformed = dict(zip(scene.deforming, read_deformed(model, view, bodies), strict=True))
    pieces = []
    for index, entity in enumerate(scene.entities):
        mesh = scene.meshes[entity.mesh]
        if index in deformed:
            body = deformed[index]
            if body is not None:
                pieces.append(Piece(body.vertices, body.normals, mesh.faces, _albedo(scene, entity)))
        elif entity.casts:
            rotation = poses.rotation[0, index].astype(np.float64)
            mesh, albedo = _unrefined(mesh, _albedo(scene, entity))
            vertices = mesh.vertices @ rotation.T + poses.position[0, index]
            pieces.append(Piece(vertices, mesh.normals @ rotation.T, mesh.faces, albedo))
    return join_pieces(pieces, views)


def _unrefined(mesh: Mesh, albedo: np.ndarray) -> tuple[Mesh, np.ndarray]:
    """Boxes and rectangles of one colour with as few faces as they need: they are cut finely for shading vertices."""
    if mesh.slab is None or (albedo != albedo[0]).any():
        return mesh, albedo
    center, rotation, half = mesh.slab
    plain = plane(half[0], half[1], cells=1) if half[2] == 0.0 else box(half, cells=1)
    placed = replace(plain, vertices=plain.vertices @ rotation.T + center, normals=plain.normals @ rotation.T)
    return placed, np.repeat(albedo[:1], len(placed.faces), axis=0)


def _albedo(scene: Scene, entity: Entity) -> np.ndarray:
    """Linear, per face [F, 3]; a texture counts with its mean."""
    albedo = []
    for part in entity.parts:
        mean = decode(scene.textures[part.texture]).mean(axis=(0, 1, 2)) if part.texture >= 0 else 1.0
        albedo.append(part.material.albedo * mean)
    faces = len(scene.meshes[entity.mesh].faces)
    parts = np.zeros(faces, np.int32) if entity.face_part is None else entity.face_part
    return np.asarray(albedo, np.float32)[parts]
