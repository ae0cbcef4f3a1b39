"""Planes, normals, rays, lines and grids."""
