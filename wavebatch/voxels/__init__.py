"""Deconvolved waveforms in a 3D grid: what came back from every voxel, and how much light reached it."""

from wavebatch.voxels.grid import COLUMNS
from wavebatch.voxels.profile import METHODS, Deconvolution
from wavebatch.voxels.strip import VoxelOptions, VoxelSummary, voxelize_strip

__all__ = ["COLUMNS", "METHODS", "Deconvolution", "VoxelOptions", "VoxelSummary", "voxelize_strip"]
