"""The records of LAS point formats 0 to 10, with the names that laspy gives to their fields.

All readers and writers use `STANDARD_DTYPES`. It is written out here, because laspy takes 50 ms to import: every
process of a run would pay that, for names alone. A test holds it against laspy.
"""

from __future__ import annotations

import numpy as np

_XYZ = [("X", "<i4"), ("Y", "<i4"), ("Z", "<i4"), ("intensity", "<u2"), ("bit_fields", "u1")]
_OLD = [
    *_XYZ, ("raw_classification", "u1"), ("scan_angle_rank", "i1"), ("user_data", "u1"), ("point_source_id", "<u2"),
]  # fmt: skip
_NEW = [
    *_XYZ, ("classification_flags", "u1"), ("classification", "u1"), ("user_data", "u1"), ("scan_angle", "<i2"),
    ("point_source_id", "<u2"), ("gps_time", "<f8"),
]  # fmt: skip
_TIME = [("gps_time", "<f8")]
_RGB = [("red", "<u2"), ("green", "<u2"), ("blue", "<u2")]
_NIR = [("nir", "<u2")]
_WAVE = [
    ("wavepacket_index", "u1"), ("wavepacket_offset", "<u8"), ("wavepacket_size", "<u4"),
    ("return_point_wave_location", "<f4"), ("x_t", "<f4"), ("y_t", "<f4"), ("z_t", "<f4"),
]  # fmt: skip

STANDARD_DTYPES = {
    number: np.dtype(fields)
    for number, fields in enumerate(
        (
            _OLD, [*_OLD, *_TIME], [*_OLD, *_RGB], [*_OLD, *_TIME, *_RGB], [*_OLD, *_TIME, *_WAVE],
            [*_OLD, *_TIME, *_RGB, *_WAVE], _NEW, [*_NEW, *_RGB], [*_NEW, *_RGB, *_NIR], [*_NEW, *_WAVE],
            [*_NEW, *_RGB, *_NIR, *_WAVE],
        )
    )
}  # fmt: skip
"""Record of every point format without extra bytes; fields have the names of laspy's raw arrays."""

_EDGES = ("scan_direction_flag", "edge_of_flight_line")
_MARKS = ("synthetic", "key_point", "withheld")
_NUMBERS = ("return_number", "number_of_returns")


def field_names(dtype: np.dtype) -> tuple[str, ...]:
    """Return the names of the fields of a record."""
    return dtype.names or ()


def list_dimensions(point_format: int) -> tuple[str, ...]:
    """Return the names of the standard dimensions of a point format: fields, and parts of fields, as laspy has them."""
    parts: dict[str, tuple[str, ...]]
    parts = {"bit_fields": (*_NUMBERS, *_EDGES), "raw_classification": ("classification", *_MARKS)}
    if point_format > 5:
        flags = (*_MARKS, "overlap", "scanner_channel", *_EDGES)
        parts = {"bit_fields": _NUMBERS, "classification_flags": flags}
    return tuple(part for name in field_names(STANDARD_DTYPES[point_format]) for part in parts.get(name, (name,)))
