"""Incidence angles of point clouds, those from widths and those from the points around, with their errors."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.files.cloud.echo_reader import CloudReader, find_columns
from wavebatch.files.disk.raw_bytes import widen

WIDTHS, NORMALS = "incidence_angle", "incidence_angle_normals"
ANGLES = (WIDTHS, f"{WIDTHS}_err", NORMALS, f"{NORMALS}_err")

ANGLE_DTYPE = np.dtype([("gps_time", "<f8"), ("xyz", "<f8", 3), *((name, "<f8") for name in ANGLES)])
"""One point: time [s], position [m], angles and their errors [deg] (NaN: no data, or no such column)."""


class AngleReader(CloudReader):
    """A CloudReader of ANGLE_DTYPE; `has` says which of ANGLES the cloud has."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._angles = find_columns(list(self._file.header.point_format.extra_dimensions), ANGLES)
        self.has = frozenset(self._angles)

    def read_angles(self) -> Iterator[np.ndarray]:
        """Points from the first one on, ANGLE_DTYPE, some at a time."""
        return self.read_pieces()

    def _convert(self, points: Any) -> np.ndarray:
        raw = points.array
        rows = np.full(len(raw), np.nan, ANGLE_DTYPE)
        for axis, name in enumerate("XYZ"):
            rows["xyz"][:, axis] = raw[name] * points.scales[axis] + points.offsets[axis]
        if self.has_gps_time:
            rows["gps_time"] = widen(raw["gps_time"])
        for name, source in self._angles.items():
            rows[name] = self._read_column(raw, source)
        return rows
