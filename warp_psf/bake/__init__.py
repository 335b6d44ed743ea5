"""What is computed once per geometry: shadow fields and self-shadowed transfer."""

from warp_psf.bake.body import bake_mesh, bake_radiance_field
from warp_psf.bake.kept import BakedBody

__all__ = ["BakedBody", "bake_mesh", "bake_radiance_field"]
