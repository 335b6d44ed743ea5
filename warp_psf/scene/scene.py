"""What is rendered: entities that do not change from frame to frame, and the poses that do."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from warp_psf.scene.light import Light
from warp_psf.scene.material import Material
from warp_psf.scene.mesh import Mesh
from warp_psf.scene.texture import Mapping, Texture, Wrap


@dataclass(frozen=True)
class Part:
    """What a viewer tells apart on an entity: a geom of MuJoCo's, with its look.

    name: what messages call it.
    material: its reflectance and emission; a texture multiplies the albedo and the emission.
    object_id, object_type: MuJoCo's id and type (mjtObj) of the thing, for the segmentation layer.
    texture: index into `Scene.textures`, -1 for none.
    mapping: how the texture lies on the part.
    """

    name: str
    material: Material
    object_id: int
    object_type: int
    texture: int = -1
    mapping: Mapping = field(default_factory=lambda: Mapping(Wrap.FLAT))


@dataclass(frozen=True, eq=False)
class Entity:
    """One thing that is seen and shaded, and that casts shadows and reflects light.

    name: what messages call it.
    mesh: index into `Scene.meshes`; entities with the same shape share a mesh.
    parts: one, or several where geoms of one body have one shape together; their lobes are the first one's.
    face_part: which part each face of the mesh belongs to, int32 [F]; None when there is only one.
    texture_coordinates: (s, t) of each face's corners, float32 [F, 3, 2], for parts whose mesh brings its own; else
        None.
    opacity: the share of light that it stops, in (0, 1].
    casts: False for what neither takes light from others by a field of its own nor sends any: marks, which are only
        seen, and deforming bodies, which have other ways.
    """

    name: str
    mesh: int
    parts: tuple[Part, ...]
    face_part: np.ndarray | None = None
    texture_coordinates: np.ndarray | None = None
    opacity: float = 1.0
    casts: bool = True

    @property
    def lobe(self) -> Material:
        """The material whose Phong lobe holds for all parts."""
        return self.parts[0].material


@dataclass(frozen=True)
class Scene:
    """The unchanging part: shapes, entities, their textures, and the lights that move with them.

    loose: the entity that stands for tendons and added geoms, -1 for none.
    deforming: the entities that deform, whose vertices move in every frame, in the world.
    """

    meshes: tuple[Mesh, ...]
    entities: tuple[Entity, ...]
    lights: tuple[Light, ...]
    textures: tuple[Texture, ...] = ()
    loose: int = -1
    deforming: tuple[int, ...] = ()


@dataclass(frozen=True)
class Poses:
    """Where every entity is, in every world.

    position: world position of each entity's frame, metres, float32 [worlds, entities, 3].
    rotation: world_from_entity rotation matrices, float32 [worlds, entities, 3, 3].
    """

    position: np.ndarray
    rotation: np.ndarray
