"""Slices: the waveforms of one scan line side by side, and the straight surface lines in them.

`wavebatch slice` reads scan lines and finds segments in slices of them (`segments`), and writes and draws these
(`output`), one line at a time, so that memory does not grow with the strip.
"""
