"""Image-based shadows of area lights in still scenes (Jeng 2005)."""

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
from warp_psf.area_light.script import Script, play_script, read_script
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
    "SlabView",
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
