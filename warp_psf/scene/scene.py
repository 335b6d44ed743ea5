"""What is rendered: entities that do not change from frame to frame, and the poses that do."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warp_psf.scene.light import Light
from warp_psf.scene.material import Material
from warp_psf.scene.mesh import Mesh


@dataclass(frozen=True)
class Entity:
    """One rigid thing that is seen, shaded and casts shadows.

    name: what messages call it.
    mesh: index into `Scene.meshes`; entities with the same shape share a mesh.
    material: its reflectance and emission.
    object_id, object_type: MuJoCo's id and type (mjtObj) of the thing, for the segmentation layer.
    """

    name: str
    mesh: int
    material: Material
    object_id: int
    object_type: int


@dataclass(frozen=True)
class Scene:
    """The unchanging part: shapes, entities and the lights that move with them."""

    meshes: tuple[Mesh, ...]
    entities: tuple[Entity, ...]
    lights: tuple[Light, ...]


@dataclass(frozen=True)
class Poses:
    """Where every entity is, in every world.

    position: world position of each entity's frame, metres, float32 [worlds, entities, 3].
    rotation: world_from_entity rotation matrices, float32 [worlds, entities, 3, 3].
    """

    position: np.ndarray
    rotation: np.ndarray
