"""Fits of echoes to waveforms: start values, least squares, growth by residual, pulse models and error bounds.

Used by stages/decompose and the survey. Times and widths are in samples here; stages convert to nanoseconds.
"""
