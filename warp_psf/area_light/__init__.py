"""Image-based shadows of area lights in still scenes (Jeng 2005).

Three methods for scenes in which nothing but the light or the viewpoint moves. All show direct light on matt surfaces.
They take a `StillScene`: `warp_psf.freeze_scene` makes one of a MuJoCo model, `make_still` of any triangles, and each
is seen by cameras (`Camera`).

The shadow slab, for lights that move and change their shape under a camera that stands still. A rectangle of light
samples has a shadow map each, what the camera sees is a scene map, and a change of the light asks only the samples that
changed: `make_light_plane`, `LightPlane`, `bake_shadow_slab`, `ShadowSlab`, `bake_scene_map`, `SceneMap`, `SlabView`,
`templates`. A file of such changes is played into frames: `read_script`, `Script`, `Step`, `play_script`, `SlabFrame`.

```python
A = psf.area_light
scene = psf.freeze_scene(model, data, cameras=["front", "side"])
lamp = psf.rectangle_light("lamp", 0.7, 0.7, (1, 1, 1), (0, 0, 2), target=(0, 0, 0))
plane = A.make_light_plane(lamp, rows=9, columns=9)
slab = A.bake_shadow_slab(scene, plane, size=65)
view = A.SlabView(A.bake_scene_map(scene, camera=0, width=160, height=120), [slab])
view.set_light(0, 20.0 * A.templates.ring(9, 9))
picture, share = view.picture(), view.attenuation()
```

The layered area light map, for a light of any shape that stands still, seen from anywhere: `bake_layered_map`,
`LayeredMap`, `upload_layers`, `DeviceLayers`, `project_forward`, `ShadowPicture`; to compare with, `retrieve_backward`
and `trace_view`.

```python
layers = A.upload_layers(A.bake_layered_map(scene, lamp, size=128, samples=16), scene)
picture = A.project_forward(layers, scene.cameras[1], 160, 120).color
```

Priority point lists, for meshes as points, large ones within triangles and small ones along their edges:
`sample_points`, `PointLists`, `upload_points`, `DevicePoints`, `splat_points`, `PointPicture`.

```python
points = A.upload_points(A.sample_points(scene, smallest=0.02))
picture = A.splat_points(points, scene.cameras[0], 160, 120).color
```
"""

from warp_psf.area_light import templates
from warp_psf.area_light.attenuation import SlabView
from warp_psf.area_light.layered import LayeredMap, bake_layered_map
from warp_psf.area_light.points import PointLists, sample_points
from warp_psf.area_light.projection import (
    DeviceLayers,
    ShadowPicture,
    project_forward,
    retrieve_backward,
    trace_view,
    upload_layers,
)
from warp_psf.area_light.scene_map import SceneMap, bake_scene_map
from warp_psf.area_light.script import Script, SlabFrame, Step, play_script, read_script
from warp_psf.area_light.slab import LightPlane, ShadowSlab, bake_shadow_slab, make_light_plane
from warp_psf.area_light.splatting import DevicePoints, PointPicture, splat_points, upload_points
from warp_psf.scene.camera import Camera
from warp_psf.scene.still import StillScene, make_still

__all__ = [
    "Camera",
    "DeviceLayers",
    "DevicePoints",
    "LayeredMap",
    "LightPlane",
    "PointLists",
    "PointPicture",
    "SceneMap",
    "Script",
    "ShadowPicture",
    "ShadowSlab",
    "SlabFrame",
    "SlabView",
    "Step",
    "StillScene",
    "bake_layered_map",
    "bake_scene_map",
    "bake_shadow_slab",
    "make_light_plane",
    "make_still",
    "play_script",
    "project_forward",
    "read_script",
    "retrieve_backward",
    "sample_points",
    "splat_points",
    "templates",
    "trace_view",
    "upload_layers",
    "upload_points",
]
