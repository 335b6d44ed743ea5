"""Skins and flexes as MuJoCo's visualiser shapes them, with what is seen of them welded into vertices that stay."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from warp_psf.bridge import solids
from warp_psf.bridge.look import find_texture, make_material
from warp_psf.bridge.model import label
from warp_psf.bridge.shown import OPAQUE, find_shown, flex_materials
from warp_psf.scene.deforming import Deformed, DeformingShape
from warp_psf.scene.scene import Part
from warp_psf.scene.texture import Mapping, Wrap

OBJECT = mujoco.mjtObj
# In the state that tells a flex's vertices apart each is so many radii beyond the one before it along x, and random
# places within so many times that tell their faces apart.
APART, WIDE = 8.0, 4.0
# Points of a tube of unit size that are nearer than this are one.
SAME_POINT = 1e-4


@dataclass(frozen=True, eq=False)
class Origin:
    """Which of MuJoCo's values a deforming body's are; see `_values`.

    corners: of each seen vertex, int [V]. points: of each blocker vertex, int [B].
    """

    corners: np.ndarray
    points: np.ndarray


@dataclass(frozen=True, eq=False)
class DeformingBody:
    """A skin or a flex, and where its vertices come from."""

    shape: DeformingShape
    origin: Origin


@dataclass(frozen=True, eq=False)
class _Surfaces:
    """The surfaces of a body before they are put in order, whose vertices MuJoCo may have several times.

    faces: int [F, 3] and seen: int [F, 3], MuJoCo's corners and which vertex each is; alike numbers are one vertex.
    point_of: the blocking point that each of MuJoCo's corners belongs to, int. blocking: its faces, int [G, 3].
    """

    faces: np.ndarray
    seen: np.ndarray
    point_of: np.ndarray
    blocking: np.ndarray


def meet_deforming(
    model: mujoco.MjModel, data: mujoco.MjData, option: mujoco.MjvOption, material_space: str
) -> tuple[DeformingBody, ...]:
    """The flexes and skins that `option` shows, in this order.

    data: the state whose shape they are to have. Afterwards its flexes are elsewhere.

    Raises:
        ValueError: a colour is not finite.
    """
    shown, view = find_shown(model, option), _make_view(model, data, option)
    asunder = _part_vertices(model, data, option)
    bodies = []
    for kind, ids, colors, materials in (
        (OBJECT.mjOBJ_FLEX, shown.flexes, shown.flex_rgba, flex_materials(model)),
        (OBJECT.mjOBJ_SKIN, shown.skins, shown.skin_rgba, model.skin_matid),
    ):
        for which in ids:
            surfaces = _skin(model, which) if kind == OBJECT.mjOBJ_SKIN else _flex(model, view, asunder, which)
            if len(surfaces.blocking) > 0:
                material, alpha = int(materials[which]), float(colors[which, 3])
                look = make_material(model, colors[which], material, material_space)
                given = _coordinates(model, view, kind, which, material) if shown.textured else None
                mapping = Mapping(Wrap.FLAT) if given is None else Mapping(Wrap.GIVEN, _repeats(model, material))
                name = label(model, "skin" if kind == OBJECT.mjOBJ_SKIN else "flex", which)
                part = Part(name, look, which, int(kind), mapping=mapping)
                opacity = 1.0 if alpha >= OPAQUE else alpha
                bodies.append(_put_in_order(model, view, part, opacity, surfaces, given))
    return tuple(bodies)


def read_deformed(
    model: mujoco.MjModel, view: mujoco.MjvScene, bodies: tuple[DeformingBody, ...]
) -> list[Deformed | None]:
    """Where the bodies are in MuJoCo's abstract scene; None for one that is not finite.

    view: after mjv_updateScene with the options under which the bodies were met.
    """
    states = []
    for body in bodies:
        vertices, normals, points = _values(model, view, body.shape.part)
        origin = body.origin
        state = Deformed(vertices[origin.corners], normals[origin.corners], points[origin.points])
        finite = all(np.isfinite(values).all() for values in (state.vertices, state.normals, state.blocker_vertices))
        states.append(state if finite else None)
    return states


def _put_in_order(
    model: mujoco.MjModel,
    view: mujoco.MjvScene,
    part: Part,
    opacity: float,
    surfaces: _Surfaces,
    texture_coordinates: np.ndarray | None,
) -> DeformingBody:
    """The body of such surfaces, with each vertex once."""
    vertices, normals, points = _values(model, view, part)
    number = np.empty(len(vertices), np.int64)
    number[surfaces.faces] = surfaces.seen
    used = np.unique(surfaces.faces)
    _, first, vertex = np.unique(number[used], return_index=True, return_inverse=True)
    corners = used[first]
    vertex_of = np.zeros(len(vertices), np.int32)
    vertex_of[used] = vertex
    faces = vertex_of[surfaces.faces]
    blocking, blocker_faces = np.unique(surfaces.blocking, return_inverse=True)
    shape = DeformingShape(
        name=part.name,
        part=part,
        opacity=opacity,
        vertices=vertices[corners],
        normals=normals[corners],
        faces=faces.astype(np.int32),
        texture_coordinates=texture_coordinates,
        blocker_vertices=points[blocking],
        blocker_faces=blocker_faces.reshape(-1, 3).astype(np.int32),
        blocker_of=_find_blockers(surfaces.point_of[corners], blocking, points),
    )
    return DeformingBody(shape, Origin(corners, blocking))


def _find_blockers(wanted: np.ndarray, blocking: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Where the points [V] are among the blocking ones [B], int32 [V]; of one within the body, the nearest."""
    place = np.minimum(np.searchsorted(blocking, wanted), len(blocking) - 1)
    for row in np.flatnonzero(blocking[place] != wanted):
        place[row] = ((points[blocking] - points[wanted[row]]) ** 2).sum(axis=1).argmin()
    return place.astype(np.int32)


def _values(model: mujoco.MjModel, view: mujoco.MjvScene, part: Part) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What MuJoCo has of a body: corners and normals of what is seen, and the points that block; float32 [*, 3].

    They are a skin's vertices, the corners of a flex's faces with its simulated vertices, or the vertices of tubes.
    """
    which = part.object_id
    if part.object_type == OBJECT.mjOBJ_SKIN:
        rows = slice(view.skinvertadr[which], view.skinvertadr[which] + view.skinvertnum[which])
        vertices, normals = (np.asarray(values).reshape(-1, 3)[rows] for values in (view.skinvert, view.skinnormal))
        return vertices, normals, vertices
    simulated = _simulated(view, which)
    if view.flexfaceused[which] > 0:
        return *_corners(view, which), simulated
    radius = float(model.flex_radius[which])
    tubes = [solids.tube(a, b, radius) for a, b in simulated[_edges(view, which)].astype(np.float64)]
    vertices, normals, _ = solids.join(*tubes)
    return vertices.astype(np.float32), normals.astype(np.float32), vertices.astype(np.float32)


def _corners(view: mujoco.MjvScene, which: int) -> tuple[np.ndarray, np.ndarray]:
    """The corners of a flex's faces and the normals there, float32 [3 faces, 3]."""
    rows = slice(3 * view.flexfaceadr[which], 3 * (view.flexfaceadr[which] + view.flexfaceused[which]))
    return np.asarray(view.flexface).reshape(-1, 3)[rows], np.asarray(view.flexnormal).reshape(-1, 3)[rows]


def _simulated(view: mujoco.MjvScene, which: int) -> np.ndarray:
    """Where a flex's simulated vertices are, float32 [vertices, 3]."""
    rows = slice(view.flexvertadr[which], view.flexvertadr[which] + view.flexvertnum[which])
    return np.asarray(view.flexvert).reshape(-1, 3)[rows]


def _edges(view: mujoco.MjvScene, which: int) -> np.ndarray:
    """The simulated vertices at the ends of a flex's edges, int [edges, 2]."""
    rows = slice(view.flexedgeadr[which], view.flexedgeadr[which] + view.flexedgenum[which])
    return np.asarray(view.flexedge).reshape(-1, 2)[rows]


def _skin(model: mujoco.MjModel, which: int) -> _Surfaces:
    """A skin as it is; vertices that lie in one place and follow the same bones block as one."""
    rows = slice(model.skin_vertadr[which], model.skin_vertadr[which] + model.skin_vertnum[which])
    faces = model.skin_face[model.skin_faceadr[which] : model.skin_faceadr[which] + model.skin_facenum[which]]
    # Sums with random factors of the bones tell those that follow others apart.
    followed = np.zeros(model.skin_vertnum[which])
    factors = np.random.default_rng(0).uniform(1.0, 2.0, model.skin_bonenum[which])
    for bone, factor in enumerate(factors, start=model.skin_boneadr[which]):
        bound = slice(model.skin_bonevertadr[bone], model.skin_bonevertadr[bone] + model.skin_bonevertnum[bone])
        np.add.at(followed, model.skin_bonevertid[bound], factor * model.skin_bonevertweight[bound])
    places = np.column_stack([model.skin_vert[rows], followed])
    _, first, same = np.unique(places, axis=0, return_index=True, return_inverse=True)
    point_of = first[same.reshape(-1)]
    return _Surfaces(faces, faces, point_of, _without_empty(point_of[faces]))


def _make_view(model: mujoco.MjModel, data: mujoco.MjData, option: mujoco.MjvOption) -> mujoco.MjvScene:
    """MuJoCo's abstract scene of a state, with skins and flexes alone."""
    view = mujoco.MjvScene(model, maxgeom=1)
    mujoco.mjv_updateScene(model, data, option, None, mujoco.MjvCamera(), 0, view)
    return view


def _part_vertices(model: mujoco.MjModel, data: mujoco.MjData, option: mujoco.MjvOption) -> mujoco.MjvScene:
    """The abstract scene of a state in which each corner of a flex's faces tells which of its vertices it is of.

    Corners that are then alike in place and normal are so in every state.
    """
    random = np.random.default_rng(0).uniform(-WIDE, WIDE, (model.nflexvert, 3))
    for which in range(model.nflex):
        rows = slice(model.flex_vertadr[which], model.flex_vertadr[which] + model.flex_vertnum[which])
        random[rows, 0] = np.arange(model.flex_vertnum[which])
        random[rows] *= _step(model, which)
    data.flexvert_xpos[:] = random
    return _make_view(model, data, option)


def _step(model: mujoco.MjModel, which: int) -> float:
    """How far apart a flex's vertices are in that state, metres."""
    return APART * float(model.flex_radius[which]) or 1.0


def _flex(model: mujoco.MjModel, view: mujoco.MjvScene, asunder: mujoco.MjvScene, which: int) -> _Surfaces:
    """A flex: its faces, and where it has none the tubes along its edges. asunder: see `_part_vertices`."""
    used = int(view.flexfaceused[which])
    if used == 0:
        return _tubes(model, view, which)
    corners = np.arange(3 * used).reshape(-1, 3)
    vertices, normals = _corners(asunder, which)
    _, seen = np.unique(np.column_stack([vertices, normals]), axis=0, return_inverse=True)
    simulated = np.round(vertices[:, 0] / _step(model, which)).astype(np.int64)
    triangles = _without_empty(simulated.reshape(-1, 3))
    _, first, count = np.unique(np.sort(triangles, axis=1), axis=0, return_index=True, return_counts=True)
    # A sheet has every triangle from both sides, and solids share those between them.
    kept = first if model.flex_dim[which] == 2 else first[count == 1]
    return _Surfaces(corners, seen.reshape(-1, 3), simulated, triangles[np.sort(kept)])


def _tubes(model: mujoco.MjModel, view: mujoco.MjvScene, which: int) -> _Surfaces:
    """The tubes along a flex's edges; nothing where they are not shown."""
    count = int(view.flexedgenum[which])
    vertices, _, faces = solids.capsule(1.0, 1.0)
    if model.flex_radius[which] <= 0.0 or not view.flexedgeopt or count == 0:
        return _Surfaces(*(np.zeros((0, 3), np.int64) for _ in range(2)), np.zeros(0), np.zeros((0, 3), np.int64))
    _, first, same = np.unique(np.round(vertices / SAME_POINT), axis=0, return_index=True, return_inverse=True)
    point_of = first[same.reshape(-1)]
    starts = len(vertices) * np.arange(count)
    blocking = (starts[:, None, None] + _without_empty(point_of[faces])).reshape(-1, 3)
    faces = (starts[:, None, None] + faces).reshape(-1, 3)
    return _Surfaces(faces, faces, (starts[:, None] + point_of).reshape(-1), blocking)


def _without_empty(faces: np.ndarray) -> np.ndarray:
    """The faces whose corners are three."""
    return faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]


def _coordinates(
    model: mujoco.MjModel, view: mujoco.MjvScene, kind: mujoco.mjtObj, which: int, material: int
) -> np.ndarray | None:
    """The texture coordinates of a body's faces [F, 3, 2], None where it has none or a texture that is not flat."""
    texture = find_texture(model, material)
    if texture < 0 or model.tex_type[texture] != mujoco.mjtTexture.mjTEXTURE_2D:
        return None
    if kind == OBJECT.mjOBJ_SKIN:
        start = model.skin_texcoordadr[which]
        rows = slice(model.skin_faceadr[which], model.skin_faceadr[which] + model.skin_facenum[which])
        return None if start < 0 else np.asarray(model.skin_texcoord[start:], np.float32)[model.skin_face[rows]]
    if model.flex_texcoordadr[which] < 0 or view.flexfaceused[which] == 0:
        return None
    rows = slice(view.flexfaceadr[which], view.flexfaceadr[which] + view.flexfaceused[which])
    return np.array(view.flextexcoord).reshape(-1, 3, 2)[rows]


def _repeats(model: mujoco.MjModel, material: int) -> tuple[float, float]:
    s, t = (float(repeat) if repeat > 0.0 else 1.0 for repeat in model.mat_texrepeat[material])
    return s, t
