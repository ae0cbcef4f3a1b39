"""Point clouds read in pieces: positions, GPS times and wavebatch's columns under the names of any style.

All commands that read clouds use `CloudReader` with the fields that they need, or a ColumnReader, which is built on it.
Files may come from any program: all bytes are read and checked by wavebatch.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Protocol

import numpy as np

from wavebatch.core.echoes import COLUMNS
from wavebatch.core.errors import ConfigError
from wavebatch.files.cloud.column_names import STYLES
from wavebatch.files.cloud.provenance import find_written
from wavebatch.files.disk.closing import Closing
from wavebatch.files.disk.raw_bytes import widen_integers
from wavebatch.files.las.checked_header import read_checked_header
from wavebatch.files.las.crs import metres_per_unit, name_units, read_crs
from wavebatch.files.las.extra_bytes import ExtraRecord
from wavebatch.files.las.point_formats import read_angles, read_classes, split_numbers
from wavebatch.files.las.read_points import open_points
from wavebatch.files.point_dtypes import STANDARD_DTYPES, field_names, list_dimensions

CLOUD_COLUMNS = ("echo_time", "amplitude", "echo_width", "amplitude_err", "echo_width_err", "range_err")
"""Columns that are read if the cloud has them."""

CLOUD_DTYPE = np.dtype(
    [
        ("gps_time", "<f8"),
        ("xyz", "<f8", 3),
        ("ray", "<f4", 3),
        ("flags", "<u2"),
        ("number", "u1"),
        ("total", "u1"),
        ("classification", "u1"),
        ("intensity", "<u2"),
        *((name, "<f4") for name in CLOUD_COLUMNS),
    ]  # fmt: skip
)
"""One echo of a cloud, as the comparisons read it."""

RETURN_DTYPE = np.dtype(
    [
        ("gps_time", "<f8"), ("xyz", "<f8", 3), ("number", "u1"), ("total", "u1"), ("intensity", "<u2"),
        ("scan_angle", "<f4"), ("echo_width", "<f4"), ("flags", "<u2"), ("source", "<u2"),
    ]  # fmt: skip
)
"""One return of a cloud. Keep it small: statistics hold many of them in memory."""

_PIECE = 250_000
_PIECE_BYTES = 1 << 26

class Placing(Protocol):
    """A header or a reader: what stored positions mean."""

    scales: tuple[float, ...]
    offsets: tuple[float, ...]

class CloudReader(Closing):
    """Reads a LAS or LAZ file in pieces. A context manager.

    dtype: the fields to read. They are gps_time [s], xyz [m], ray (the stored packet vector, which may point either
    way; 0: none), flags (EchoFlag bits), number and total (of returns), classification, intensity, scan_angle [deg],
    source (point source id), and names of wavebatch columns (NaN: no data). With `ray`, points without a packet are
    left out if the cloud has packets.
    Raises InputError if the file is damaged, or compressed in a way that no installed library can read.
    """

    def __init__(self, path: Path, dtype: np.dtype = CLOUD_DTYPE) -> None:
        self.path = Path(path)
        self.dtype = dtype
        checked = read_checked_header(self.path, waveforms=False)
        self.point_count: int = checked.header.point_count
        self.scales: tuple[float, ...] = checked.header.scales
        self.offsets: tuple[float, ...] = checked.header.offsets
        units = read_crs(self.path, checked.header)[1]
        self.metres = metres_per_unit(units)
        """Metres of a step of 1 in x, y and z; NaN in degrees."""
        self.unit = name_units(units)
        self.bounds = checked.header.mins, checked.header.maxs
        self.point_format: int = checked.header.point_format
        fields = field_names(STANDARD_DTYPES[self.point_format])
        self.has_gps_time = "gps_time" in fields
        self.has_packets = "wavepacket_index" in fields
        self.extra = {field: record for field, record in checked.extra.items() if not record.dtype.shape}
        """The record of each extra dimension that is one number, by its field."""
        self._point_length = checked.dtype.itemsize
        written = find_written(checked.header, self.extra)
        self.written = {column: name for column, name in written.items() if _may_hold(self.extra[name], column)}
        """The file's name of each wavebatch column, by its provenance; empty without one. Columns that another
        program has stored as several numbers, or flags as signed ones, are none."""
        self._sources = self._find_ours((*field_names(dtype), "echo_flags"))
        self.columns = tuple(name for name in field_names(dtype) if name in self._sources)
        """The wavebatch columns among the fields that the cloud has."""
        self.has_flags = "echo_flags" in self._sources
        self.records = np.empty(0)
        """The raw records of the last piece."""
        self.keep: Callable[[np.ndarray], np.ndarray] | None = None
        """Which raw records (n,) are read, bool (n,); None: all. `column_reader.select_points` sets it."""
        self.left_out = 0
        """Points that `keep` has left out so far."""
        self._points = open_points(checked)

    def measure_in_metres(self) -> None:
        """Let positions be in metres; raises ConfigError for degrees, and for units of unknown length."""
        if any(map(math.isnan, self.metres)):
            raise ConfigError(f"{self.path}: coordinates are {self.unit}, which have no length; project it to metres")
        self.scales = tuple(scale * one for scale, one in zip(self.scales, self.metres, strict=True))
        self.offsets = tuple(offset * one for offset, one in zip(self.offsets, self.metres, strict=True))

    def close(self) -> None:
        """Close the file."""
        self._points.close()

    def read_pieces(self, size: int = _PIECE, most: int = _PIECE_BYTES) -> Iterator[np.ndarray]:
        """Yield the points of the file in order, at most `size`, and `most` bytes of records, at a time."""
        size = max(min(size, most // self._point_length), 1)
        for start in range(0, self.point_count, size):
            raw = self._points.read(start, min(start + size, self.point_count))
            if self.keep is not None:
                chosen = np.asarray(raw)[self.keep(raw)]
                self.left_out += len(raw) - len(chosen)
                raw = chosen
            self.records = raw
            yield self._convert(raw)

    def read_flags(self, raw: np.ndarray) -> np.ndarray:
        """Return the EchoFlag bits of raw records, u2 (n,); 0 where the cloud has no flags."""
        if not self.has_flags:
            return np.zeros(len(raw), np.uint16)
        return raw[self._sources["echo_flags"]].astype(np.uint16)

    def _find_ours(self, columns: Iterable[str], *, decibel: bool = False) -> dict[str, str]:
        """The field of each wavebatch column that the cloud has; decibel: also of those that are written in dB."""
        if not self.written:
            return find_columns(self.extra, columns)
        found = {name: self.written[name] for name in columns if name in self.written}
        return {name: one for name, one in found.items() if decibel or not self.extra[one].description.endswith("[dB]")}

    def read_extra(self, raw: np.ndarray, field: str) -> np.ndarray:
        """Return the physical values (n,) of an extra dimension of raw records, with NaN for no data."""
        return self.extra[field].read(raw[field])

    def _convert(self, raw: np.ndarray) -> np.ndarray:
        if "ray" in field_names(self.dtype) and self.has_packets:
            raw = raw[raw["wavepacket_index"] != 0]
        rows = np.zeros(len(raw), self.dtype)
        for name in field_names(self.dtype):
            values = self._read_named(raw, name)
            if values is not None:
                rows[name] = values
        return rows

    def _read_named(self, raw: np.ndarray, name: str) -> np.ndarray | float | None:
        """Values of a field of `dtype`; None where the file has none and they are 0."""
        if name in COLUMNS:
            return self.read_extra(raw, self._sources[name]) if name in self._sources else np.nan
        if name == "ray" and self.has_packets:
            ray = np.stack([widen_integers(raw[axis]) for axis in ("x_t", "y_t", "z_t")], axis=1)
            ray[~np.isfinite(ray).all(axis=1)] = 0.0  # damaged: as if there were none
            return ray
        if name == "gps_time" and self.has_gps_time:
            return widen_integers(raw["gps_time"])
        readers = {
            "xyz": lambda: np.stack([read_field(raw, self.point_format, axis, self) for axis in "xyz"], axis=1),
            "flags": lambda: self.read_flags(raw),
            "number": lambda: split_numbers(raw)[0],
            "total": lambda: split_numbers(raw)[1],
            "classification": lambda: read_classes(raw),
            "intensity": lambda: raw["intensity"],
            "scan_angle": lambda: read_angles(raw),
            "source": lambda: raw["point_source_id"],
        }
        return readers[name]() if name in readers else None

def read_field(raw: np.ndarray, point_format: int, name: str, placing: Placing) -> np.ndarray:
    """Return the values (n,) of a field of raw records, NaN for those that are not finite.

    placing: scales and offsets of the positions.
    """
    if name in ("x", "y", "z"):
        axis = "xyz".index(name)
        return raw[name.upper()] * placing.scales[axis] + placing.offsets[axis]
    if name.startswith("scan_angle"):
        return read_angles(raw)
    import laspy

    values = widen_integers(np.asarray(laspy.PackedPointRecord(raw, laspy.PointFormat(point_format))[name]))
    values[~np.isfinite(values)] = np.nan
    return values

def name_standard(point_format: int) -> dict[str, str]:
    """Return the names of the fields of a point format, x, y and z for its integers, each with the field that it means.

    The scan angle also has the name that other point formats give it.
    """
    names = ("x", "y", "z", *(name for name in list_dimensions(point_format) if name not in ("X", "Y", "Z")))
    angle = next(name for name in names if name in ("scan_angle", "scan_angle_rank"))
    return {**{name: name for name in names}, "scan_angle": angle, "scan_angle_rank": angle}

def find_columns(extra: Mapping[str, ExtraRecord], columns: Iterable[str]) -> dict[str, str]:
    """Return the field of each column that the cloud has, by the names of its extra dimensions alone.

    For clouds without provenance, which other programs may drop. wavebatch's name is preferred to those of
    other styles, and a name with the prefix `wb_` (`wb ` in old clouds) to one without. A dimension of another style
    counts only if it is stored as that style stores it: RIEGL's Amplitude, for example, is in dB.
    """
    wanted = set(columns)
    names: list[tuple[str, str, float | None]] = [(column, column, None) for column in COLUMNS if column in wanted]
    for style in STYLES.values():
        names += [(key, naming.name, naming.scale) for key, naming in style.items() if not naming.decibel]
    found: dict[str, str] = {}
    for column, name, scale in names:
        for field in (f"wb_{name.replace(' ', '_')}", f"wb {name}", name):
            record = extra.get(field) if column in wanted else None
            if record is not None and (record.scaling is None) == (scale is None) and _may_hold(record, column):
                found.setdefault(column, field)
    return found

def _may_hold(record: ExtraRecord, column: str) -> bool:
    """Whether numbers of a dimension may be a column: flags are unsigned integers."""
    return column != "echo_flags" or record.dtype.kind == "u"
