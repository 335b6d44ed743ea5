"""Vectors stored on concentric shells around a body: occlusion and radiance fields."""
