"""Image-based shadows of area lights in still scenes (Jeng 2005)."""

from warp_psf.area_light import templates
from warp_psf.area_light.attenuation import SlabView
from warp_psf.area_light.scene_map import SceneMap, bake_scene_map
from warp_psf.area_light.script import Script, play_script, read_script
from warp_psf.area_light.slab import LightPlane, ShadowSlab, bake_shadow_slab, make_light_plane

__all__ = [
    "LightPlane",
    "SceneMap",
    "Script",
    "ShadowSlab",
    "SlabView",
    "bake_scene_map",
    "bake_shadow_slab",
    "make_light_plane",
    "play_script",
    "read_script",
    "templates",
]
