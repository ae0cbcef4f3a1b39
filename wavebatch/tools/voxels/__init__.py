"""`wavebatch voxelize`: deconvolved waveforms in a 3D grid: the signal of every voxel and the light in it.

strip     the whole task: reads, deconvolves, sums, writes
profile   waveforms to profiles along their rays (deconvolution, noise)
rays      profiles to rays in space;  ceiling: how far up rays are followed
grid      rays summed over voxels;    output: the files
"""

from wavebatch.tools.voxels.grid import COLUMNS
from wavebatch.tools.voxels.profile import METHODS, Deconvolution
from wavebatch.tools.voxels.strip import VoxelOptions, VoxelSummary, voxelize_strip

__all__ = ["COLUMNS", "METHODS", "Deconvolution", "VoxelOptions", "VoxelSummary", "voxelize_strip"]
