"""Pixels: which surface each one sees, how radiance becomes a picture, and the files that pictures are kept in."""
