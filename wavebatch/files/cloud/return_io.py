"""Discrete returns: read in pieces from any LAS or LAZ file, and written to a file without packets.

`wavebatch stats` reads with it; `wavebatch simulate` reads and writes with it. Keep the records of RETURN_DTYPE small:
statistics hold many of them in memory.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from wavebatch.core.errors import ConfigError
from wavebatch.files.cloud.echo_reader import CloudReader
from wavebatch.files.las.extra_bytes import build_dtype
from wavebatch.files.las.header import LasHeader
from wavebatch.files.las.point_formats import ANGLE_UNIT, WITHOUT_WAVES, split_numbers
from wavebatch.files.las.write_points import PointFile

RETURN_DTYPE = np.dtype(
    [
        ("gps_time", "<f8"), ("xyz", "<f8", 3), ("number", "u1"), ("total", "u1"), ("intensity", "<u2"),
        ("angle", "<f4"), ("echo_width", "<f4"), ("flags", "<u2"), ("source", "<u2"),
    ]  # fmt: skip
)
"""One return: time [s], position [m], return number and number of returns, intensity, scan angle [deg], full width at
half maximum [ns] (NaN: unknown), EchoFlag bits, point source id."""


class ReturnReader(CloudReader):
    """Reads every point of a file in its order as RETURN_DTYPE; `records` has the raw records of the last piece."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.point_format: int = self._format.id
        self.has_flags = "echo_flags" in self._sources
        self.records = np.empty(0)

    def _convert(self, raw: np.ndarray) -> np.ndarray:
        rows = self._place(raw, RETURN_DTYPE)
        rows["number"], rows["total"] = split_numbers(raw)
        modern = "classification_flags" in raw.dtype.names
        rows["angle"] = raw["scan_angle"] * np.float32(ANGLE_UNIT) if modern else raw["scan_angle_rank"]
        rows["intensity"], rows["source"] = raw["intensity"], raw["point_source_id"]
        rows["echo_width"] = self._read_column(raw, self._sources.get("echo_width"))
        if self.has_flags:
            rows["flags"] = raw[self._sources["echo_flags"].name]
        self.records = raw
        return rows


class ReturnWriter(PointFile):
    """Writes a cloud of discrete returns without packets: `write` records of `dtype`, then `commit`.

    target: its suffix selects LAS or LAZ. point_format: 1 or 3 (LAS 1.2), 6 or 8 (LAS 1.4). wkt: CRS for LAS 1.4.
    Raises ConfigError for another point format, and errors as PointFile does.
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
        if point_format not in WITHOUT_WAVES.values():
            raise ConfigError(f"{target}: returns are written in point format 1, 3, 6 or 8, not {point_format}")
        version = (1, 4) if point_format >= 6 else (1, 2)
        header = LasHeader.new(version, point_format, scales, offsets, wkt if point_format >= 6 else None)
        super().__init__(target, header, build_dtype(point_format, ()), (), overwrite=overwrite)
