"""What is computed once per geometry: shadow fields, self-shadowed transfer and basis radiance."""

from warp_psf.bake.body import bake_mesh, bake_radiance_field
from warp_psf.bake.kept import BakedBody
from warp_psf.bake.radiance import BakedRadiance, bake_radiance

__all__ = ["BakedBody", "BakedRadiance", "bake_mesh", "bake_radiance", "bake_radiance_field"]
