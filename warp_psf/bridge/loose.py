"""Tendons as MuJoCo's visualiser shapes them in a frame, and the geoms that a script has added."""

from __future__ import annotations

import mujoco
import numpy as np

from warp_psf.bridge import solids
from warp_psf.bridge.look import make_material
from warp_psf.bridge.model import label
from warp_psf.bridge.shapes import MESHES
from warp_psf.bridge.solids import Surface
from warp_psf.scene.loose import Loose
from warp_psf.scene.scene import Part

GEOM, OBJECT = mujoco.mjtGeom, mujoco.mjtObj
# MuJoCo's arrows: how much wider the head is than the shaft.
HEAD = 1.75
DECOR = mujoco.mjtCatBit.mjCAT_DECOR
HAVE_ENTITIES = (OBJECT.mjOBJ_GEOM, OBJECT.mjOBJ_SITE, OBJECT.mjOBJ_FLEX, OBJECT.mjOBJ_SKIN)


def read_loose(
    model: mujoco.MjModel, view: mujoco.MjvScene, shown: int, material_space: str, metres_per_pixel: float
) -> Loose | None:
    """What has no lasting shape in MuJoCo's abstract scene, None where there is nothing of that.

    view: after mjv_updateScene. shown: how many geoms that left in it; those behind were added by a script and are
    drawn too, while MuJoCo's own decor (contacts, frames, joints) is not. metres_per_pixel: at a distance of 1 m, for
    lines, whose width is in pixels.

    Raises:
        ValueError: an added geom names a mesh or a material that the model lacks, or has a colour that is not finite.
    """
    surfaces: list[Surface] = []
    parts: list[Part] = []
    eye = 0.5 * (np.array(view.camera[0].pos) + np.array(view.camera[1].pos))
    for index, geom in enumerate(view.geoms[: view.ngeom]):
        added = index >= shown
        if added or (geom.objtype not in HAVE_ENTITIES and geom.category != DECOR):
            if added:
                _check_added(model, geom)
            if geom.rgba[3] != 0.0:
                surface = _surface(model, geom, eye, metres_per_pixel)
                if surface is not None and len(surface[2]) > 0:
                    surfaces.append(surface)
                    parts.append(_part(model, geom, material_space))
    if not surfaces:
        return None
    counts = np.array([len(vertices) for vertices, _, _ in surfaces])
    starts = np.cumsum(counts) - counts
    faces = np.concatenate([faces + start for (_, _, faces), start in zip(surfaces, starts, strict=True)])
    return Loose(
        np.concatenate([vertices for vertices, _, _ in surfaces]).astype(np.float32),
        np.concatenate([normals for _, normals, _ in surfaces]).astype(np.float32),
        faces.astype(np.int32),
        np.repeat(np.arange(len(parts)), [len(faces) for _, _, faces in surfaces]).astype(np.int32),
        tuple(parts),
    )


def _check_added(model: mujoco.MjModel, geom: mujoco.MjvGeom) -> None:
    """Raises ValueError where a geom that a script added names a thing that the model lacks."""
    if geom.type in (GEOM.mjGEOM_FLEX, GEOM.mjGEOM_SKIN):
        raise ValueError("a geom added to the scene is a flex or a skin; those are drawn from the model alone")
    if geom.type in MESHES and geom.dataid >= 2 * model.nmesh:
        raise ValueError(
            f"a geom added to the scene has the dataid {geom.dataid}; give 2 * mesh id, below {2 * model.nmesh}"
        )
    if geom.matid >= model.nmat:
        raise ValueError(f"a geom added to the scene has the matid {geom.matid}; the model has {model.nmat} materials")


def _part(model: mujoco.MjModel, geom: mujoco.MjvGeom, material_space: str) -> Part:
    name = label(model, "tendon", geom.objid) if geom.objtype == OBJECT.mjOBJ_TENDON else "added geom"
    material = make_material(model, np.array(geom.rgba), int(geom.matid), material_space)
    return Part(name, material, int(geom.objid), int(geom.objtype))


def _surface(model: mujoco.MjModel, geom: mujoco.MjvGeom, eye: np.ndarray, metres_per_pixel: float) -> Surface | None:
    """Vertices, normals and faces of a geom in the world; None for what has no surface."""
    size = np.array(geom.size, np.float64)
    position, rotation = np.array(geom.pos, np.float64), np.array(geom.mat, np.float64).reshape(3, 3)
    thickness = 0.5 * size[0] * metres_per_pixel * float(np.linalg.norm(position - eye))
    if geom.type in MESHES and geom.dataid >= 0:
        return solids.place(_model_mesh(model, geom.dataid // 2), position, rotation)
    if geom.type == GEOM.mjGEOM_LINE:
        return solids.place(solids.rod(thickness, 0.0, size[2]), position, rotation)
    if geom.type == GEOM.mjGEOM_LINEBOX:
        return solids.place(solids.wires(size, thickness / max(size[0], 1e-9)), position, rotation)
    local = _solid(int(geom.type), size)
    return None if local is None else solids.place(local, position, rotation)


def _model_mesh(model: mujoco.MjModel, which: int) -> Surface:
    vertices = slice(model.mesh_vertadr[which], model.mesh_vertadr[which] + model.mesh_vertnum[which])
    faces = slice(model.mesh_faceadr[which], model.mesh_faceadr[which] + model.mesh_facenum[which])
    return solids.faceted(np.asarray(model.mesh_vert[vertices], np.float64), np.asarray(model.mesh_face[faces]))


def _solid(kind: int, size: np.ndarray) -> Surface | None:
    """A geom of MuJoCo's in its own frame."""
    x, y, z = size
    if kind in (GEOM.mjGEOM_SPHERE, GEOM.mjGEOM_ELLIPSOID):
        return solids.scaled(solids.capsule(1.0, 0.0), size)
    if kind == GEOM.mjGEOM_CAPSULE:
        return solids.capsule(x, z)
    if kind == GEOM.mjGEOM_CYLINDER:
        return solids.rod(x, -z, z)
    if kind == GEOM.mjGEOM_BOX:
        return solids.scaled(solids.cube(), size)
    if kind == GEOM.mjGEOM_PLANE and x > 0.0 and y > 0.0:
        corners = np.array(((-x, -y, 0.0), (x, -y, 0.0), (x, y, 0.0), (-x, y, 0.0)))
        return solids.two_sided(corners)
    if kind in (GEOM.mjGEOM_ARROW, GEOM.mjGEOM_ARROW1):
        wide = HEAD if kind == GEOM.mjGEOM_ARROW else 1.0
        return solids.join(solids.rod(x, 0.0, z / 3.0), solids.cone(wide * x, z / 3.0, 2.0 * z / 3.0))
    if kind == GEOM.mjGEOM_ARROW2:
        heads = [solids.cone(HEAD * x, side * z / 3.0, side * 2.0 * z / 3.0) for side in (1.0, -1.0)]
        return solids.join(solids.rod(x, -z / 3.0, z / 3.0), *heads)
    if kind == GEOM.mjGEOM_TRIANGLE:
        return solids.two_sided(np.array(((0.0, 0.0, 0.0), (x, 0.0, 0.0), (0.0, y, 0.0))))
    return None
