"""Fits of echoes to waveforms: start values, least squares, growth, and tests of the residual."""
