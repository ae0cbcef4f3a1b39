"""Point clouds read in pieces: positions, GPS times and wavebatch's own columns, whatever style names them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import laspy
import numpy as np
from laspy.point.dims import DimensionInfo

from wavebatch.blocks import COLUMNS
from wavebatch.errors import InputError
from wavebatch.io.extra import EXTRA_BYTES_RECORD_ID, read_records
from wavebatch.io.header import STANDARD_DTYPES, has_record, read_header
from wavebatch.io.names import STYLES

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
_FAULTS = (ValueError, OSError, OverflowError, MemoryError, RuntimeError, laspy.errors.LaspyException)


class CloudReader:
    """A LAS or LAZ file read in pieces; packets and extended records are never touched. Raises InputError."""

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        try:
            self._file = laspy.open(self.path, read_evlrs=False, laz_backend=_backends())
            self._no_data = _read_no_data(self.path)
        except _FAULTS as error:
            raise self._complain(error) from error
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
        done = 0
        try:
            if self.point_count:
                self._file.seek(0)
            for points in self._file.chunk_iterator(size):
                done += len(points)
                yield self._convert(points)
        except _FAULTS as error:
            raise self._complain(error) from error
        if done != self.point_count:
            raise InputError(f"{self.path}: holds {done} points, its header says {self.point_count}; the file is cut")

    def _convert(self, points: laspy.ScaleAwarePointRecord) -> np.ndarray:
        raw = points.array
        rows = np.zeros(len(raw), CLOUD_DTYPE)
        for axis, name in enumerate("XYZ"):
            rows["xyz"][:, axis] = raw[name] * points.scales[axis] + points.offsets[axis]
        if self.has_gps_time:
            rows["gps_time"] = raw["gps_time"]
        for name in CLOUD_COLUMNS:
            source = self._sources.get(name)
            rows[name] = np.nan if source is None else self._read_column(raw, source)
        rows["number"], rows["total"] = split_numbers(raw)
        rows["intensity"] = raw["intensity"]
        if "echo_flags" in self._sources:
            rows["flags"] = raw[self._sources["echo_flags"].name]
        if not self.has_packets:
            return rows
        for axis, name in enumerate(("x_t", "y_t", "z_t")):
            rows["ray"][:, axis] = raw[name]
        return rows[raw["wavepacket_index"] != 0]

    def _read_column(self, raw: np.ndarray, dimension: DimensionInfo) -> np.ndarray:
        """Physical values, NaN where the no-data value stands."""
        stored = raw[dimension.name]
        values = stored.astype(np.float64)
        if dimension.scales is not None:
            values = values * dimension.scales[0] + (0.0 if dimension.offsets is None else dimension.offsets[0])
        if dimension.name in self._no_data:
            values[stored == self._no_data[dimension.name]] = np.nan
        return values

    def _complain(self, error: BaseException) -> InputError:
        if isinstance(error, InputError):
            return error
        reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
        return InputError(f"{self.path}: cannot be read as LAS or LAZ: {reason}; run `wavebatch check` on it")


def split_numbers(raw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return numbers and numbers of returns of raw records, u1 (n,) each."""
    if "classification_flags" in raw.dtype.names:
        return raw["bit_fields"] & 15, raw["bit_fields"] >> 4
    return raw["bit_fields"] & 7, raw["bit_fields"] >> 3 & 7


def _backends() -> list[laspy.LazBackend]:
    """LAZ decoders that are there; the single-threaded one, because it takes the same time in a batch of jobs."""
    wanted = (laspy.LazBackend.Lazrs, laspy.LazBackend.Laszip)
    return [backend for backend in wanted if backend.is_available()]


def _read_no_data(path: Path) -> dict[str, float]:
    """Stored value that means "none" per extra dimension that declares one; laspy loses it on reading."""
    header = read_header(path)
    payloads = [vlr.payload for vlr in header.vlrs if has_record([vlr], "LASF_Spec", EXTRA_BYTES_RECORD_ID)]
    size = header.point_length - STANDARD_DTYPES[header.point_format].itemsize
    records = read_records(payloads[0] if payloads else b"", size)
    return {record.name: record.no_data[0] for record in records if record.no_data is not None}


def find_columns(extra: list[DimensionInfo], columns: Iterable[str]) -> dict[str, DimensionInfo]:
    """Extra dimension of those among `columns` that are there: our own name before those of the other styles, `wb ` in front before without.

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
            if column in wanted and dimension is not None and (dimension.scales is None) == (scale is None):
                found.setdefault(column, dimension)
    return found
