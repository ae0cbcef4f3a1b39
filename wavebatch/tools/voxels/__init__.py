"""`wavebatch voxelize`: deconvolved waveforms in a 3D grid: the signal of every voxel and the light in it.

strip     the whole task: reads, deconvolves, sums, writes
profile   waveforms to profiles along their rays (deconvolution, noise)
rays      profiles to rays in space, and the light in them;  floor: lowest and highest returns
grid      rays summed over voxels;    output: the files, written and read
"""
