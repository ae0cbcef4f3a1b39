"""Array kernels: arrays in, arrays out; times in samples, waveforms along the last axis."""
