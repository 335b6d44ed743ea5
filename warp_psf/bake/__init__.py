"""What is computed once per geometry: shadow fields and self-shadowed transfer."""

from warp_psf.bake.body import BakedBody, bake_mesh, bake_radiance_field

__all__ = ["BakedBody", "bake_mesh", "bake_radiance_field"]
