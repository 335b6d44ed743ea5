"""Functions on the sphere, without a scene: directions and quadrature, spherical harmonics."""
