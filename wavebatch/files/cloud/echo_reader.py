"""Point clouds read in pieces: positions, GPS times and wavebatch's columns under the names of any style.

The comparisons read with `CloudReader`; the readers of returns, angles and single columns are built on it. Files may
come from any program: laspy only describes the fields, the bytes are read and checked by wavebatch.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from wavebatch.core.echoes import COLUMNS
from wavebatch.core.errors import ConfigError
from wavebatch.files.cloud.column_names import STYLES
from wavebatch.files.cloud.provenance import find_written
from wavebatch.files.disk.closing import Closing
from wavebatch.files.disk.raw_bytes import widen
from wavebatch.files.las.checked_header import CheckedHeader, read_checked_header
from wavebatch.files.las.crs import metres_per_unit, name_units, read_crs
from wavebatch.files.las.extra_bytes import ExtraRecord
from wavebatch.files.las.point_formats import read_classes, split_numbers
from wavebatch.files.las.read_points import open_points
from wavebatch.files.point_dtypes import list_dimensions

if TYPE_CHECKING:  # laspy takes 50 ms to import, and a run hardly ever needs it
    import laspy
    from laspy.point.dims import DimensionInfo, DimensionKind

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
"""One echo of a cloud: time [s], position [m], the stored packet vector (0: none; it may point either way), EchoFlag
bits, return number and number of returns, class, intensity, and columns (NaN: no data)."""

_PIECE = 250_000
_PIECE_BYTES = 1 << 26
_LARGEST = 1e30
"""Larger values are damage and become no data: their squares would overflow in single precision."""


class CloudReader(Closing):
    """Reads a LAS or LAZ file in pieces of CLOUD_DTYPE; subclasses read other records. A context manager.

    Raises InputError if the file is damaged, or compressed in a way that no installed library can read.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        checked = read_checked_header(self.path, waveforms=False)
        self.point_count: int = checked.header.point_count
        self.scales, self.offsets = checked.header.scales, checked.header.offsets
        units = read_crs(self.path, checked.header)[1]
        self.metres = metres_per_unit(units)
        """Metres of a step of 1 in x, y and z; NaN in degrees."""
        self.unit = name_units(units)
        self.bounds = checked.header.mins, checked.header.maxs
        self._format = describe_format(checked)
        names = set(self._format.dimension_names)
        self.has_gps_time = "gps_time" in names
        self.has_packets = "wavepacket_index" in names
        extra = list(self._format.extra_dimensions)
        written = find_written(checked.header, [one.name for one in extra if one.num_elements == 1])
        kinds = {one.name: one.kind for one in extra}
        self.written = {column: name for column, name in written.items() if _may_hold(kinds[name], column)}
        """The file's name of each wavebatch column, by its provenance; empty without one. Columns that another
        program has stored as several numbers, or flags as signed ones, are none."""
        self._sources = self._find_ours(extra, (*CLOUD_COLUMNS, "echo_flags"))
        self.columns = tuple(name for name in CLOUD_COLUMNS if name in self._sources)
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

    def read_pieces(self, size: int = _PIECE) -> Iterator[np.ndarray]:
        """Yield the points of the file in order, at most `size` at a time.

        CLOUD_DTYPE leaves out points whose packet index is 0, if the cloud still has packets.
        """
        size = max(min(size, _PIECE_BYTES // self._format.size), 1)
        for start in range(0, self.point_count, size):
            raw = self._points.read(start, min(start + size, self.point_count))
            if self.keep is not None:
                chosen = np.asarray(raw)[self.keep(raw)]
                self.left_out += len(raw) - len(chosen)
                raw = chosen
            yield self._convert(raw)

    def _find_ours(
        self, extra: list[DimensionInfo], columns: Iterable[str], *, decibel: bool = False
    ) -> dict[str, DimensionInfo]:
        """The dimension of each wavebatch column that the cloud has; decibel: also of those that are written in dB."""
        if not self.written:
            return find_columns(extra, columns)
        by_name = {one.name: one for one in extra}
        found = {name: by_name[self.written[name]] for name in columns if name in self.written}
        return {name: one for name, one in found.items() if decibel or not (one.description or "").endswith("[dB]")}

    def _convert(self, raw: np.ndarray) -> np.ndarray:
        rows = self._place(raw, CLOUD_DTYPE)
        for name in CLOUD_COLUMNS:
            rows[name] = self._read_column(raw, self._sources.get(name))
        rows["number"], rows["total"] = split_numbers(raw)
        rows["classification"] = read_classes(raw)
        rows["intensity"] = raw["intensity"]
        if "echo_flags" in self._sources:
            rows["flags"] = raw[self._sources["echo_flags"].name].astype(np.uint16)
        if not self.has_packets:
            return rows
        for axis, name in enumerate(("x_t", "y_t", "z_t")):
            rows["ray"][:, axis] = widen(raw[name])
        rows["ray"][~np.isfinite(rows["ray"]).all(axis=1)] = 0.0  # damaged: as if there were none
        return rows[raw["wavepacket_index"] != 0]

    def _place(self, raw: np.ndarray, dtype: np.dtype) -> np.ndarray:
        """New rows of `dtype` with positions and GPS times of raw records, zero otherwise."""
        rows = np.zeros(len(raw), dtype)
        for axis in range(3):
            rows["xyz"][:, axis] = self._locate(raw, axis)
        if self.has_gps_time:
            rows["gps_time"] = widen(raw["gps_time"])
        return rows

    def _locate(self, raw: np.ndarray, axis: int) -> np.ndarray:
        return raw["XYZ"[axis]] * self.scales[axis] + self.offsets[axis]

    def _read_column(self, raw: np.ndarray, dimension: DimensionInfo | None) -> np.ndarray | float:
        """Physical values with NaN for no data; NaN if the cloud has no such dimension."""
        return np.nan if dimension is None else read_dimension(raw, dimension)


def describe_format(checked: CheckedHeader) -> laspy.PointFormat:
    """Return laspy's point format with the extra dimensions of the checked records, under the names of the fields."""
    import laspy

    point_format = laspy.PointFormat(checked.header.point_format)
    for field, record in zip(checked.dtype.names[-len(checked.records) :], checked.records, strict=False):
        point_format.dimensions.append(describe_dimension(field, record))
    return point_format


def describe_dimension(field: str, record: ExtraRecord) -> DimensionInfo:
    """Return laspy's description of an extra dimension under the name of its field."""
    from laspy.point.dims import DimensionInfo

    scales, offsets = (None, None) if record.scaling is None else np.array(record.scaling)[:, None]
    dimension = DimensionInfo.from_dtype(field, record.dtype, False, record.description, offsets, scales)
    return dimension._replace(no_data=record.no_data)


def read_dimension(raw: np.ndarray, dimension: DimensionInfo) -> np.ndarray:
    """Return the physical values (n,) of a dimension of raw records, with NaN for no data."""
    values = widen(raw[dimension.name])
    with np.errstate(over="ignore", invalid="ignore"):
        if dimension.scales is not None:
            values = values * dimension.scales[0] + dimension.offsets[0]
        if dimension.no_data is not None:
            values[raw[dimension.name] == dimension.no_data[0]] = np.nan
        return np.where(np.abs(values) <= _LARGEST, values, np.nan)


def list_fields(point_format: int) -> tuple[str, ...]:
    """Return the names of the fields of a point format, with x, y and z in place of their integers."""
    return ("x", "y", "z", *(name for name in list_dimensions(point_format) if name not in ("X", "Y", "Z")))


def read_field(raw: np.ndarray, point_format: int, name: str) -> np.ndarray:
    """Return the stored values (n,) of a field of raw records, other than x, y and z."""
    import laspy

    return widen(np.asarray(laspy.PackedPointRecord(raw, laspy.PointFormat(point_format))[name]))


def find_columns(extra: list[DimensionInfo], columns: Iterable[str]) -> dict[str, DimensionInfo]:
    """Return the extra dimension of each column that the cloud has, by its names alone.

    For clouds without provenance, which other programs may drop. wavebatch's name is preferred to those of
    other styles, and a name with the prefix `wb_` (`wb ` in old clouds) to one without. A dimension of another style
    counts only if it is stored as that style stores it: RIEGL's Amplitude, for example, is in dB.
    """
    by_name = {dimension.name: dimension for dimension in extra}
    wanted = set(columns)
    names = [(column, column, None) for column in COLUMNS if column in wanted]
    for style in STYLES.values():
        names += [(key, naming.name, naming.scale) for key, naming in style.items() if not naming.decibel]
    found: dict[str, DimensionInfo] = {}
    for column, name, scale in names:
        for dimension in map(by_name.get, (f"wb_{name.replace(' ', '_')}", f"wb {name}", name)):
            if column in wanted and dimension is not None and _is_stored_as(dimension, column, scale):
                found.setdefault(column, dimension)
    return found


def _is_stored_as(dimension: DimensionInfo, column: str, scale: float | None) -> bool:
    """Whether the dimension is one number, scaled if the style scales it, and may hold the column."""
    if dimension.num_elements != 1 or (dimension.scales is None) != (scale is None):
        return False
    return _may_hold(dimension.kind, column)


def _may_hold(kind: DimensionKind, column: str) -> bool:
    """Whether numbers of a kind may be a column: flags are unsigned integers."""
    return column != "echo_flags" or kind.name == "UnsignedInteger"
