"""How MuJoCo lays textures on its geoms and sites: flat ones by coordinates of their own, cubes by direction."""

from __future__ import annotations

import mujoco
import numpy as np

from warp_psf.bridge.shapes import MESHES, plane_sizes
from warp_psf.scene.mesh import Mesh
from warp_psf.scene.texture import Mapping, Wrap
from warp_psf.scene.topology import merge_positions

GEOM = mujoco.mjtGeom
WRAPS = {
    GEOM.mjGEOM_SPHERE: Wrap.BALL,
    GEOM.mjGEOM_ELLIPSOID: Wrap.BALL,
    GEOM.mjGEOM_CAPSULE: Wrap.CAPSULE,
    GEOM.mjGEOM_CYLINDER: Wrap.CYLINDER,
    GEOM.mjGEOM_BOX: Wrap.BOX,
}


def make_mapping(
    model: mujoco.MjModel, kind: int, size: np.ndarray, data_id: int, material: int, texture: int
) -> Mapping:
    """How a texture of the model's lies on a geom or site of this type, with these sizes, by MuJoCo's rules.

    data_id: of a mesh or height field, -1 for none. material, texture: indices, neither -1.
    """
    shape, repeat = _unit_size(GEOM(kind), size), np.array(model.mat_texrepeat[material], np.float64)
    uniform = bool(model.mat_texuniform[material])
    if model.tex_type[texture] != mujoco.mjtTexture.mjTEXTURE_2D:
        wrap, drawn = Wrap.CUBE_CAPSULE if kind == GEOM.mjGEOM_CAPSULE else Wrap.CUBE, _drawn_size(GEOM(kind), size)
        # An endless plane has no size to be uniform over.
        stretch = drawn if uniform and drawn[:2].any() else np.ones(3)
        return Mapping(wrap, size=_triple(shape), stretch=_triple(stretch))
    drawn = _drawn_size(GEOM(kind), size)[:2]
    if (kind in MESHES and model.mesh_texcoordadr[data_id] < 0) or kind == GEOM.mjGEOM_HFIELD:
        # Looked at from above: once over the geom, or once over two metres where the texture is uniform.
        scale = np.where(drawn > 0.0, repeat / np.maximum(drawn, 1e-15), repeat)
        scale = np.where(uniform & (drawn > 0.0), scale * drawn, scale)
        return Mapping(Wrap.FLAT, (0.5 * scale[0], -0.5 * scale[1]), (-0.5, -0.5))
    scale = np.where(repeat > 0.0, repeat, 1.0)
    scale = np.where(uniform & (drawn > 0.0), scale * drawn, scale)
    if kind == GEOM.mjGEOM_PLANE:
        endless = size[0] <= 0.0 or size[1] <= 0.0
        half = plane_sizes(model, size)
        per_metre = [0.5 if size[axis] <= 0.0 else 0.5 / half[axis] for axis in range(2)]
        middle = [0.0 if size[axis] <= 0.0 else 0.5 for axis in range(2)]
        shift = -0.5 if endless else 0.0
        offset = tuple(float(scale[axis] * middle[axis] + shift) for axis in range(2))
        return Mapping(Wrap.FLAT, (scale[0] * per_metre[0], -scale[1] * per_metre[1]), (offset[0], offset[1]))
    wrap = Wrap.GIVEN if kind in MESHES else WRAPS[GEOM(kind)]
    return Mapping(wrap, (float(scale[0]), float(scale[1])), size=_triple(shape))


def mesh_coordinates(model: mujoco.MjModel, which: int, mesh: Mesh) -> np.ndarray:
    """The texture coordinates of a model's mesh at the corners of `mesh`, which was made from it; float32 [F, 3, 2].

    `mesh` may lack faces of the model's, and have others turned: faces are told by the positions of their corners.
    """
    vertices = slice(model.mesh_vertadr[which], model.mesh_vertadr[which] + model.mesh_vertnum[which])
    rows = slice(model.mesh_faceadr[which], model.mesh_faceadr[which] + model.mesh_facenum[which])
    given, faces = np.asarray(model.mesh_vert[vertices], np.float32), np.asarray(model.mesh_face[rows])
    point, _ = merge_positions(np.concatenate([given, mesh.vertices]).astype(np.float64))
    theirs, ours = point[: len(given)][faces], point[len(given) :][mesh.faces]
    keys = _keys(np.sort(theirs, axis=1), len(point))
    order = np.argsort(keys, kind="stable")
    wanted = _keys(np.sort(ours, axis=1), len(point))
    found = order[np.clip(np.searchsorted(keys[order], wanted), 0, len(keys) - 1)]
    # Of each of our corners, which corner of the model's face it is.
    corner = (ours[:, :, None] == theirs[found][:, None, :]).argmax(axis=2)
    number = np.asarray(model.mesh_facetexcoord[rows])[found[:, None], corner]
    start = model.mesh_texcoordadr[which]
    return np.asarray(model.mesh_texcoord[start:], np.float32)[number]


def _keys(triples: np.ndarray, count: int) -> np.ndarray:
    """One number for each sorted triple of point numbers below `count`."""
    # Three numbers of 21 bits; meshes of more than two million points would share keys.
    shift = max(int(count).bit_length(), 1)
    wide = triples.astype(np.uint64)
    return (wide[:, 0] << np.uint64(2 * shift)) | (wide[:, 1] << np.uint64(shift)) | wide[:, 2]


def _unit_size(kind: mujoco.mjtGeom, size: np.ndarray) -> np.ndarray:
    """The half extents by which MuJoCo scales its unit shape; 1 for shapes that it draws as they are."""
    if kind in MESHES or kind in (GEOM.mjGEOM_HFIELD, GEOM.mjGEOM_PLANE):
        return np.ones(3)
    return _drawn_size(kind, size)


def _drawn_size(kind: mujoco.mjtGeom, size: np.ndarray) -> np.ndarray:
    """The three sizes that MuJoCo's visualiser has for a geom."""
    if kind == GEOM.mjGEOM_SPHERE:
        return np.full(3, size[0], np.float64)
    if kind in (GEOM.mjGEOM_CAPSULE, GEOM.mjGEOM_CYLINDER):
        return np.array((size[0], size[0], size[1]), np.float64)
    return np.array(size, np.float64)


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z
