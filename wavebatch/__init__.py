"""wavebatch: decomposes full-waveform lidar strips and gives the point cloud back with what the waveform knows."""

__version__ = "0.1.0"
