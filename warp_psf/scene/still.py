"""A scene at one moment, as triangles in the world: what methods for still scenes work on."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from warp_psf.scene.camera import Camera
from warp_psf.scene.mesh import make_mesh
from warp_psf.scene.topology import area_vectors, find_components, pair_edges

# Faces of a flat surface differ from its mean normal by less than this, radians: float32 corners a millimetre off a
# metre-wide face turn it by as much.
FLAT_ANGLE = 1e-3


@dataclass(frozen=True, eq=False)
class StillScene:
    """Triangles in the world, grouped into surfaces; arrays are read-only.

    Built by `warp_psf.freeze_scene` and `make_still`.

    Attributes:
        vertices: world positions, metres, float32 [V, 3].
        normals: smooth unit normals, float32 [V, 3]; at creases a position has one vertex per side.
        faces: vertex indices, counter-clockwise seen from outside, int32 [F, 3].
        surface: which surface a face lies on, int32 [F]: faces that are joined without a crease. A cube has six
            surfaces, a ball has one.
        flat: whether a surface is a plane, bool [surfaces].
        albedo: diffuse reflectance of a face, linear, float32 [F, 3]; of textures, their mean.
        cameras: viewpoints.
    """

    vertices: np.ndarray
    normals: np.ndarray
    faces: np.ndarray
    surface: np.ndarray
    flat: np.ndarray
    albedo: np.ndarray
    cameras: tuple[Camera, ...] = ()

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """The lowest and the highest corner, metres, float32 [3] each."""
        return self.vertices.min(axis=0), self.vertices.max(axis=0)

    @property
    def checksum(self) -> int:
        """Of its triangles: what was made of a scene is of no use for another."""
        return zlib.crc32(self.faces, zlib.crc32(self.vertices))


@dataclass(frozen=True, eq=False)
class Piece:
    """Triangles that belong together: vertices and normals [V, 3] in the world, faces [F, 3], albedo [F, 3]."""

    vertices: np.ndarray
    normals: np.ndarray
    faces: np.ndarray
    albedo: np.ndarray


def make_still(vertices, faces, albedo=(0.8, 0.8, 0.8), cameras: Sequence[Camera] = ()) -> StillScene:
    """A still scene of bare triangles.

    ```python
    A = psf.area_light
    mesh = psf.load_mesh("mesh.obj")
    camera = A.Camera(np.array([0.0, 0.0, 4.0]), np.eye(3), half_height=0.4)
    scene = A.make_still(mesh.vertices, mesh.faces, cameras=[camera])
    ```

    Args:
        vertices: world positions, metres, [V, 3].
        faces: vertex indices, [F, 3].
        albedo: of all faces, linear, 3 numbers from 0 to 1.
        cameras: a list of viewpoints.

    Raises:
        ValueError: an array has another shape, names a vertex that there is not, or holds what is no number.
        TypeError: `cameras` is no list of cameras.
    """
    try:
        shown = np.asarray(albedo, np.float64)
    except (TypeError, ValueError):
        shown = np.empty(0)
    if shown.shape != (3,) or not ((shown >= 0.0) & (shown <= 1.0)).all():
        raise ValueError(f"albedo of the still scene is {albedo!r}; give 3 numbers from 0 to 1")
    mesh = make_mesh("still scene", vertices, faces)
    shown = np.broadcast_to(shown, mesh.faces.shape)
    return join_pieces([Piece(mesh.vertices, mesh.normals, mesh.faces, shown)], cameras)


def join_pieces(pieces: Sequence[Piece], cameras: Sequence[Camera]) -> StillScene:
    """The still scene of all pieces.

    Raises:
        ValueError: there is no triangle in any of them.
        TypeError: `cameras` is no list of cameras.
    """
    if not any(len(piece.faces) for piece in pieces):
        raise ValueError("the scene has no triangles; give it at least one body that is drawn")
    if not isinstance(cameras, Sequence) or not all(isinstance(camera, Camera) for camera in cameras):
        raise TypeError("cameras of a still scene must be a list of Camera; give one such as [camera], or leave it out")
    surface, flat, first_vertex = [], [], 0
    faces = []
    for piece in pieces:
        own, own_flat = _find_surfaces(piece)
        surface.append(own + sum(map(len, flat)))
        flat.append(own_flat)
        faces.append(piece.faces + first_vertex)
        first_vertex += len(piece.vertices)
    return StillScene(
        _merged([piece.vertices for piece in pieces], np.float32),
        _merged([piece.normals for piece in pieces], np.float32),
        _merged(faces, np.int32),
        _merged(surface, np.int32),
        _merged(flat, bool),
        _merged([piece.albedo for piece in pieces], np.float32),
        tuple(cameras),
    )


def _find_surfaces(piece: Piece) -> tuple[np.ndarray, np.ndarray]:
    """The surface of each face [F], and whether each surface is flat. Creases have parted the vertices already."""
    (one, other), _ = pair_edges(piece.faces)
    roots = find_components(len(piece.faces), one // 3, other // 3)
    first, surface = np.unique(roots, return_inverse=True)
    vectors = area_vectors(piece.vertices.astype(np.float64), piece.faces)
    mean = np.stack([np.bincount(surface, vectors[:, axis], len(first)) for axis in range(3)], axis=1)
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-30)
    length = np.linalg.norm(vectors, axis=1)
    aside = np.linalg.norm(np.cross(vectors, mean[surface]), axis=1)
    bent = (aside > FLAT_ANGLE * length) | ((vectors * mean[surface]).sum(axis=1) <= 0.0)
    return surface, np.bincount(surface, bent, len(first)) == 0


def _merged(arrays: list[np.ndarray], dtype: type) -> np.ndarray:
    array = np.ascontiguousarray(np.concatenate(arrays), dtype)
    array.flags.writeable = False
    return array
