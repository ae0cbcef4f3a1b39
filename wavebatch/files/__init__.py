"""Reading and writing LAS files and wave packets: the only place that knows laspy, paths, picoseconds and volts."""
