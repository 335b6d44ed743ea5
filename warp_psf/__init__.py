"""Soft shadows and interreflection for MuJoCo simulations, frame after frame, on Warp kernels.

```python
import mujoco
import warp_psf as psf

model = mujoco.MjModel.from_xml_path("model.xml")
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
with psf.Renderer(model, height=240, width=320) as renderer:
    renderer.update_scene(data, camera="front")
    rgb = renderer.render()  # uint8 [240, 320, 3]
```

Examples further down take `psf` for this package, `np` for numpy, and `model` and `data` for a MuJoCo model and its
state. Lengths are metres, angles radians, axes right-handed with z up. Colours and radiance are linear Rec.709, three
numbers each; a white matt surface under an even radiance of 1 has the radiance 1. Arrays have the shape in brackets.

- Pictures: `Renderer`.
- Light: `rectangle_light`, `sphere_light`, `AreaLight`, `DeltaLight`, `load_environment`, `Environment`.
- Shapes: `load_mesh`, `make_mesh`, `Mesh`.
- Files: `FrameSequence`, `to_display`, `read_exr`, `image_difference`.
- What is precomputed of a shape, for those who study it; a renderer bakes by itself: `bake_mesh`, `BakedBody`,
  `bake_silhouettes`, `bake_wavelet_fields`.
- Scenes at rest, in which only the light or the viewpoint moves: `freeze_scene`, `warp_psf.area_light`.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from warp_psf import area_light
    from warp_psf.bake import BakedBody, bake_mesh
    from warp_psf.bake.silhouettes import bake_silhouettes
    from warp_psf.bake.wavelets import bake_wavelet_fields
    from warp_psf.bridge.still import freeze_scene
    from warp_psf.film.display import to_display
    from warp_psf.film.sequence import FrameSequence
    from warp_psf.film.writer import image_difference, read_exr
    from warp_psf.renderer import Renderer
    from warp_psf.scene.environment import Environment, load_environment
    from warp_psf.scene.light import AreaLight, DeltaLight, rectangle_light, sphere_light
    from warp_psf.scene.mesh import Mesh, load_mesh, make_mesh

__all__ = [
    "AreaLight",
    "BakedBody",
    "DeltaLight",
    "Environment",
    "FrameSequence",
    "Mesh",
    "Renderer",
    "area_light",
    "bake_mesh",
    "bake_silhouettes",
    "bake_wavelet_fields",
    "freeze_scene",
    "image_difference",
    "load_environment",
    "load_mesh",
    "make_mesh",
    "read_exr",
    "rectangle_light",
    "sphere_light",
    "to_display",
]

# The public names come on first use: `warp-psf --help` need not wait for Warp and MuJoCo.
_HOMES = {
    "AreaLight": "scene.light",
    "BakedBody": "bake",
    "DeltaLight": "scene.light",
    "Environment": "scene.environment",
    "FrameSequence": "film.sequence",
    "Mesh": "scene.mesh",
    "Renderer": "renderer",
    "bake_mesh": "bake",
    "bake_silhouettes": "bake.silhouettes",
    "bake_wavelet_fields": "bake.wavelets",
    "freeze_scene": "bridge.still",
    "image_difference": "film.writer",
    "load_environment": "scene.environment",
    "load_mesh": "scene.mesh",
    "make_mesh": "scene.mesh",
    "read_exr": "film.writer",
    "rectangle_light": "scene.light",
    "sphere_light": "scene.light",
    "to_display": "film.display",
}

# Rooms that are public with all they name.
_ROOMS = ("area_light",)


def __getattr__(name: str) -> Any:
    if name in _ROOMS:
        return import_module(f"warp_psf.{name}")
    if name not in _HOMES:
        raise AttributeError(f"module 'warp_psf' has no attribute {name!r}")
    return getattr(import_module(f"warp_psf.{_HOMES[name]}"), name)
