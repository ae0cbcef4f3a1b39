"""Deconvolved waveforms in a 3D grid: what came back from every voxel, and how much light reached it."""

from wavebatch.tools.voxels.grid import COLUMNS
from wavebatch.tools.voxels.profile import METHODS, Deconvolution
from wavebatch.tools.voxels.strip import VoxelOptions, VoxelSummary, voxelize_strip

__all__ = ["COLUMNS", "METHODS", "Deconvolution", "VoxelOptions", "VoxelSummary", "voxelize_strip"]
