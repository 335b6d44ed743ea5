"""What is rendered: shapes, materials, lights, cameras and poses, as plain data."""
