"""Slices: the waveforms of one scan line side by side, and the straight surface lines in them.

`wavebatch slice` reads scan lines (`lines`), cuts slices and finds segments in them (`segments`), and writes these
(`output`), one line at a time, so that memory does not grow with the strip.
"""
