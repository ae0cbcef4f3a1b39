"""Planes, normals, rays, scan lines, tiles and voxels: geometry of points and pulses."""
