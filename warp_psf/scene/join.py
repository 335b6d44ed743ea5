"""Several meshes as one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from warp_psf.scene.fit import bounding_sphere
from warp_psf.scene.mesh import Mesh


def join_meshes(name: str, parts: Sequence[tuple[Mesh, np.ndarray, np.ndarray]]) -> Mesh:
    """Meshes placed in one frame, as a mesh that has their vertices and faces one after another.

    parts: each mesh with its position [3], metres, and its rotation [3, 3] in the new frame.
    """
    vertices = np.concatenate([mesh.vertices @ rotation.T + position for mesh, position, rotation in parts])
    normals = np.concatenate([mesh.normals @ rotation.T for mesh, _, rotation in parts])
    counts = np.array([len(mesh.vertices) for mesh, _, _ in parts])
    starts = np.cumsum(counts) - counts
    faces = np.concatenate([mesh.faces + start for (mesh, _, _), start in zip(parts, starts, strict=True)])
    center, radius = bounding_sphere(vertices)
    arrays = (vertices.astype(np.float32), faces.astype(np.int32), normals.astype(np.float32), center)
    for array in arrays:
        array.setflags(write=False)
    closed = all(mesh.closed for mesh, _, _ in parts)
    return Mesh(name, *arrays[:3], None, None, False, closed, center, radius)
