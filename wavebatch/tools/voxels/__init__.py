"""`wavebatch voxelize`: deconvolved waveforms in a 3D grid: the signal of every voxel and the light in it.

strip    the whole task: reads, deconvolves, sums, writes
rays     waveforms to profiles along their rays, rays in space and the light in them; lowest and highest returns
grid     rays summed over voxels; the files, written and read
"""
