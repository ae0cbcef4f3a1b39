"""Discrete returns: read in pieces from any LAS or LAZ file, and written to one without packets."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import laspy
import numpy as np

from wavebatch import __version__
from wavebatch.core.errors import ConfigError
from wavebatch.files.cloud.echo_reader import CloudReader, split_numbers
from wavebatch.files.disk.publish import publish_together
from wavebatch.files.disk.raw_bytes import widen
from wavebatch.files.las.extra_bytes import build_dtype
from wavebatch.files.las.header import WKT_BIT, LasHeader, build_wkt
from wavebatch.files.las.write_points import PointFile

RETURN_DTYPE = np.dtype(
    [
        ("gps_time", "<f8"),
        ("xyz", "<f8", 3),
        ("number", "u1"),
        ("total", "u1"),
        ("intensity", "<u2"),
        ("angle", "<f4"),
        ("echo_width", "<f4"),
        ("flags", "<u2"),
        ("source", "<u2"),
    ]
)
"""One return: time [s], position [m], return number and number of returns, intensity, scan angle [deg], full width
at half maximum [ns] (NaN: unknown), EchoFlag bits, point source id."""

FORMATS = {4: 1, 5: 3, 9: 6, 10: 8}
"""Point format without waveforms by the one of its family that has them."""


class ReturnReader(CloudReader):
    """A CloudReader whose pieces are RETURN_DTYPE: every point of the file, in its order. `records` has the raw records
    of the piece that was read last, under laspy's names."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        header = self._file.header
        self.point_format: int = header.point_format.id
        self.scales, self.offsets = tuple(header.scales), tuple(header.offsets)
        self.has_flags = "echo_flags" in self._sources
        self.records = np.empty(0)

    def _convert(self, points: laspy.ScaleAwarePointRecord) -> np.ndarray:
        raw = points.array
        rows = np.zeros(len(raw), RETURN_DTYPE)
        for axis, name in enumerate("XYZ"):
            rows["xyz"][:, axis] = raw[name] * points.scales[axis] + points.offsets[axis]
        if self.has_gps_time:
            rows["gps_time"] = widen(raw["gps_time"])
        rows["number"], rows["total"] = split_numbers(raw)
        modern = "classification_flags" in raw.dtype.names
        rows["angle"] = raw["scan_angle"] * np.float32(0.006) if modern else raw["scan_angle_rank"]
        rows["intensity"], rows["source"] = raw["intensity"], raw["point_source_id"]
        width = self._sources.get("echo_width")
        rows["echo_width"] = np.nan if width is None else self._read_column(raw, width)
        if self.has_flags:
            rows["flags"] = raw[self._sources["echo_flags"].name]
        self.records = raw
        return rows


class ReturnWriter:
    """Streams a cloud of discrete returns: `write` records of `dtype`, then `commit`; as a context manager it aborts
    itself unless committed.

    target: its suffix says LAS or LAZ. point_format: 1 or 3 (LAS 1.2), 6 or 8 (LAS 1.4). wkt: CRS of LAS 1.4, or None.
    Raises ConfigError for a format of another kind, InputError where the target exists or cannot be written.
    """

    def __init__(
        self,
        target: Path,
        *,
        point_format: int,
        scales: Sequence[float],
        offsets: Sequence[float],
        wkt: str | None = None,
        overwrite: bool = False,
    ) -> None:
        if point_format not in FORMATS.values():
            raise ConfigError(f"{target}: returns are written in point format 1, 3, 6 or 8, not {point_format}")
        modern = point_format >= 6
        self.dtype = build_dtype(point_format, ())
        header = LasHeader(
            version=(1, 4) if modern else (1, 2),
            point_format=point_format,
            point_length=0,
            scales=tuple(map(float, scales)),
            offsets=tuple(map(float, offsets)),
            global_encoding=1 | (WKT_BIT if modern else 0),
            system_identifier=b"OTHER",
            generating_software=f"wavebatch {__version__}".encode(),
            creation=(1, 2025),
        )
        if modern and wkt:
            header.vlrs.append(build_wkt(wkt))
        self._file = PointFile(Path(target), header, self.dtype, (), overwrite=overwrite)

    def __enter__(self) -> ReturnWriter:
        return self

    def __exit__(self, *error: object) -> None:
        self._file.abort()

    def write(self, rows: np.ndarray) -> None:
        """Appends records (m,) of `dtype`."""
        self._file.write(rows)

    def commit(self) -> None:
        """Completes and publishes the file."""
        self._file.finish_points()
        self._file.finish()
        publish_together([self._file.draft])
