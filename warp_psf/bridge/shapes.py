"""Shapes: the meshes of geoms and sites, each made once however many share it."""

from __future__ import annotations

import mujoco
import numpy as np

from warp_psf.bridge.model import label
from warp_psf.scene import primitives
from warp_psf.scene.mesh import Mesh, make_mesh

GEOM = mujoco.mjtGeom
# Half the side of an infinite plane, in units of model.stat.extent: twice MuJoCo's default far plane (zfar, 50).
INFINITE_PLANE = 100.0
# How many of a geom's sizes a type uses (the others hold anything and must not tell equal shapes apart), and its mesh.
PRIMITIVES = {
    GEOM.mjGEOM_PLANE: (2, lambda sizes: primitives.plane(*sizes)),
    GEOM.mjGEOM_BOX: (3, primitives.box),
    GEOM.mjGEOM_SPHERE: (1, lambda sizes: primitives.sphere(*sizes)),
    GEOM.mjGEOM_CAPSULE: (2, lambda sizes: primitives.capsule(*sizes)),
    GEOM.mjGEOM_CYLINDER: (2, lambda sizes: primitives.cylinder(*sizes)),
    GEOM.mjGEOM_ELLIPSOID: (3, primitives.ellipsoid),
}
# Geoms whose shape is a mesh of the model's; the surface of a signed distance field is one too.
MESHES = (GEOM.mjGEOM_MESH, GEOM.mjGEOM_SDF)
ShapeKey = tuple


def plane_sizes(model: mujoco.MjModel, sizes: np.ndarray) -> tuple[float, float]:
    """Half sides of a plane, metres; MuJoCo's 0, infinite, is more than the camera sees."""
    endless = max(INFINITE_PLANE, 2.0 * float(model.vis.map.zfar)) * float(model.stat.extent)
    x, y = (float(half) if half > 0.0 else endless for half in sizes[:2])
    return x, y


def plane_step(model: mujoco.MjModel, geom: int, axis: int) -> float:
    """The steps in which an infinite plane follows the camera along its axis 0 or 1: a quarter of its half side.

    They are whole periods of its texture, so that the pattern stays where it is.
    """
    step = 0.25 * plane_sizes(model, np.zeros(2))[axis]
    material = int(model.geom_matid[geom])
    repeat = float(model.mat_texrepeat[material, axis]) if material >= 0 else 0.0
    # MuJoCo's own steps, two spans of the texture's repetition.
    period = 4.0 / repeat if repeat > 0.0 else step
    return max(round(step / period), 1) * period


def geom_shape_key(model: mujoco.MjModel, geom: int) -> ShapeKey | None:
    """What tells a geom's shape from others'; None for a geom that has none."""
    kind, which = GEOM(model.geom_type[geom]), int(model.geom_dataid[geom])
    if kind in MESHES:
        return (GEOM.mjGEOM_MESH, which) if which >= 0 else None
    if kind == GEOM.mjGEOM_HFIELD:
        return (kind, which) if which >= 0 else None
    return _primitive_key(model, kind, model.geom_size[geom])


def site_shape_key(model: mujoco.MjModel, site: int) -> ShapeKey | None:
    """What tells a site's shape from others'; None for a site that has none."""
    return _primitive_key(model, GEOM(model.site_type[site]), model.site_size[site])


def make_shape(model: mujoco.MjModel, key: ShapeKey) -> Mesh:
    """The mesh that a key stands for, in the frame of the geoms that have it.

    Raises:
        ValueError: a size is not positive, or no face has an area.
    """
    kind, which = key
    if kind == GEOM.mjGEOM_MESH:
        vertices = slice(model.mesh_vertadr[which], model.mesh_vertadr[which] + model.mesh_vertnum[which])
        faces = slice(model.mesh_faceadr[which], model.mesh_faceadr[which] + model.mesh_facenum[which])
        # Already in the frame of the geoms that use it: MuJoCo centres meshes and turns them to their principal axes.
        return make_mesh(label(model, "mesh", which), model.mesh_vert[vertices], model.mesh_face[faces])
    if kind == GEOM.mjGEOM_HFIELD:
        return _height_field(model, which)
    _, make = PRIMITIVES[kind]
    return make(which)


def _primitive_key(model: mujoco.MjModel, kind: mujoco.mjtGeom, size: np.ndarray) -> ShapeKey | None:
    if kind not in PRIMITIVES:
        return None
    count, _ = PRIMITIVES[kind]
    if kind == GEOM.mjGEOM_PLANE:
        return kind, plane_sizes(model, size)
    return kind, tuple(float(value) for value in size[:count])


def _height_field(model: mujoco.MjModel, which: int) -> Mesh:
    """A height field as MuJoCo draws it: the surface, four sides and the bottom."""
    rows, columns = int(model.hfield_nrow[which]), int(model.hfield_ncol[which])
    half_x, half_y, height, base = (float(size) for size in model.hfield_size[which])
    start = model.hfield_adr[which]
    data = model.hfield_data[start : start + rows * columns].reshape(rows, columns)
    x, y = np.meshgrid(np.linspace(-half_x, half_x, columns), np.linspace(-half_y, half_y, rows))
    top = np.stack([x, y, height * data], axis=2).reshape(-1, 3)
    number = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (part.ravel() for part in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
    # Quads are cut from the first corner to the last, as MuJoCo's picture has them.
    surface = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    rim = np.concatenate([number[0, :-1], number[:-1, -1], number[-1, :0:-1], number[:0:-1, 0]])
    bottom = top[rim] * (1.0, 1.0, 0.0) - (0.0, 0.0, base)
    below, next_rim = len(top) + np.arange(len(rim)), np.roll(rim, -1)
    next_below = np.roll(below, -1)
    sides = np.concatenate([np.stack([rim, below, next_rim], axis=1), np.stack([next_rim, below, next_below], axis=1)])
    middle = len(top) + len(rim)
    floor = np.stack([np.full(len(rim), middle), next_below, below], axis=1)
    vertices = np.concatenate([top, bottom, [[0.0, 0.0, -base]]])
    return make_mesh(label(model, "hfield", which), vertices, np.concatenate([surface, sides, floor]))
