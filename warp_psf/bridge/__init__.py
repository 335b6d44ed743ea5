"""MuJoCo's models and data as scenes, poses, lights and cameras."""

from warp_psf.bridge.cameras import find_camera, read_camera
from warp_psf.bridge.deforming import meet_deforming, read_deformed
from warp_psf.bridge.entities import build_scene, read_poses
from warp_psf.bridge.lights import read_delta_lights
from warp_psf.bridge.loose import read_loose
from warp_psf.bridge.model import check_data, load_model
from warp_psf.bridge.shown import looks
from warp_psf.bridge.sky import read_image_lights, read_skybox
from warp_psf.bridge.still import freeze_scene

__all__ = [
    "build_scene",
    "check_data",
    "find_camera",
    "freeze_scene",
    "load_model",
    "looks",
    "meet_deforming",
    "read_camera",
    "read_deformed",
    "read_delta_lights",
    "read_image_lights",
    "read_loose",
    "read_poses",
    "read_skybox",
]
