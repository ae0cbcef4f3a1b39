"""Point clouds read in pieces: positions, GPS times and wavebatch's own columns, whatever style names them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import laspy
import numpy as np
from laspy.point.dims import DimensionInfo, DimensionKind

from wavebatch.core.echoes import COLUMNS
from wavebatch.files.cloud.column_names import STYLES
from wavebatch.files.cloud.points import CloudPoints
from wavebatch.files.disk.raw_bytes import widen

CLOUD_COLUMNS = ("echo_time", "amplitude", "echo_width", "amplitude_err", "echo_width_err", "range_err")
"""Columns that are read where the cloud has them."""

CLOUD_DTYPE = np.dtype(
    [
        ("gps_time", "<f8"),
        ("xyz", "<f8", 3),
        ("ray", "<f4", 3),
        ("flags", "<u2"),
        ("number", "u1"),
        ("total", "u1"),
        ("intensity", "<u2"),
        *((name, "<f4") for name in CLOUD_COLUMNS),
    ]
)
"""One echo of a cloud: time [s], position [m], the stored packet vector (0 where there is none; it may point either
way), EchoFlag bits, return number and number of returns, intensity, and columns (NaN: no data)."""

_PIECE = 250_000
_PIECE_BYTES = 1 << 26
_LARGEST = 1e30
"""Values beyond are damage, no data: their squares would leave single precision."""


class CloudReader:
    """A LAS or LAZ file read in pieces; packets and extended records are never touched. Raises InputError."""

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self._file = CloudPoints(self.path)
        header = self._file.header
        self.point_count: int = header.point_count
        names = set(header.point_format.dimension_names)
        self.has_gps_time = "gps_time" in names
        self.has_packets = "wavepacket_index" in names
        self._sources = find_columns(list(header.point_format.extra_dimensions), (*CLOUD_COLUMNS, "echo_flags"))
        self.columns = tuple(name for name in CLOUD_COLUMNS if name in self._sources)

    def __enter__(self) -> CloudReader:
        return self

    def __exit__(self, *error: object) -> None:
        self._file.close()

    def read_pieces(self, size: int = _PIECE) -> Iterator[np.ndarray]:
        """Echoes from the first one on, CLOUD_DTYPE, at most `size` at a time.

        Points whose packet index is 0 are left out of clouds that still have packets.
        """
        size = max(min(size, _PIECE_BYTES // self._file.header.point_format.size), 1)
        for start in range(0, self.point_count, size):
            yield self._convert(self._file.read(start, min(start + size, self.point_count)))

    def _convert(self, points: laspy.ScaleAwarePointRecord) -> np.ndarray:
        raw = points.array
        rows = np.zeros(len(raw), CLOUD_DTYPE)
        for axis, name in enumerate("XYZ"):
            rows["xyz"][:, axis] = raw[name] * points.scales[axis] + points.offsets[axis]
        if self.has_gps_time:
            rows["gps_time"] = widen(raw["gps_time"])
        for name in CLOUD_COLUMNS:
            source = self._sources.get(name)
            rows[name] = np.nan if source is None else self._read_column(raw, source)
        rows["number"], rows["total"] = split_numbers(raw)
        rows["intensity"] = raw["intensity"]
        if "echo_flags" in self._sources:
            rows["flags"] = raw[self._sources["echo_flags"].name].astype(np.uint16)
        if not self.has_packets:
            return rows
        for axis, name in enumerate(("x_t", "y_t", "z_t")):
            rows["ray"][:, axis] = widen(raw[name])
        return rows[raw["wavepacket_index"] != 0]

    def _read_column(self, raw: np.ndarray, dimension: DimensionInfo) -> np.ndarray:
        """Physical values, NaN where the no-data value stands."""
        values = widen(raw[dimension.name])
        with np.errstate(over="ignore", invalid="ignore"):
            if dimension.scales is not None:
                values = values * dimension.scales[0] + dimension.offsets[0]
            if dimension.no_data is not None:
                values[raw[dimension.name] == dimension.no_data[0]] = np.nan
            return np.where(np.abs(values) <= _LARGEST, values, np.nan)


def split_numbers(raw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return numbers and numbers of returns of raw records, u1 (n,) each."""
    if "classification_flags" in raw.dtype.names:
        return raw["bit_fields"] & 15, raw["bit_fields"] >> 4
    return raw["bit_fields"] & 7, raw["bit_fields"] >> 3 & 7


def find_columns(extra: list[DimensionInfo], columns: Iterable[str]) -> dict[str, DimensionInfo]:
    """Extra dimension per column, of those that are there: our own name before those of the other styles, `wb ` in
    front before without.

    A dimension of another style counts only when it is stored as that style stores it: RIEGL's Amplitude is in dB.
    """
    by_name = {dimension.name: dimension for dimension in extra}
    wanted = set(columns)
    names = [(column, column, None) for column in COLUMNS if column in wanted]
    for style in STYLES.values():
        names += [(key, naming.name, naming.scale) for key, naming in style.items() if not naming.decibel]
    found: dict[str, DimensionInfo] = {}
    for column, name, scale in names:
        for dimension in (by_name.get(f"wb {name}"), by_name.get(name)):
            if column in wanted and dimension is not None and _is_stored_as(dimension, column, scale):
                found.setdefault(column, dimension)
    return found


def _is_stored_as(dimension: DimensionInfo, column: str, scale: float | None) -> bool:
    """Whether the dimension is one number, scaled or not as the style has it, and flags are bits."""
    if dimension.num_elements != 1 or (dimension.scales is None) != (scale is None):
        return False
    return column != "echo_flags" or dimension.kind is DimensionKind.UnsignedInteger
