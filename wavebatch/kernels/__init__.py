"""Kernels: the arithmetic, as functions from arrays to arrays.

Stages and tools call them. A kernel knows no files, blocks, options or logging, and the result for one waveform must
not depend, bit for bit, on the other waveforms of its block.
"""
