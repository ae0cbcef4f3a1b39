"""Slices: the waveforms of one scan line side by side, and the straight surface lines in them.

`wavebatch slice` reads scan lines (`lines`), cuts slices and finds segments in them (`segments`), and writes these
(`output`), one line at a time, so that memory does not grow with the strip.
"""

from wavebatch.tools.slices.lines import ScanLine, read_scan_lines
from wavebatch.tools.slices.output import SEGMENT_SUFFIXES, SegmentWriter, draw_slice
from wavebatch.tools.slices.segments import Segment, Slice, SliceOptions, cut_slice, find_segments

__all__ = [
    "SEGMENT_SUFFIXES",
    "ScanLine",
    "Segment",
    "SegmentWriter",
    "Slice",
    "SliceOptions",
    "cut_slice",
    "draw_slice",
    "find_segments",
    "read_scan_lines",
]
