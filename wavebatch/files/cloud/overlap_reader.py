"""Clean single echoes of point clouds with their calibrated columns; `wavebatch compare --overlap` reads with it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from wavebatch.core.echoes import PASSED_THROUGH, UNCLEAN
from wavebatch.files.cloud.echo_reader import CloudReader, find_columns
from wavebatch.files.las.point_formats import read_angles, split_numbers

LIGHT_COLUMNS = ("backscatter_coefficient", "relative_backscatter")
"""Columns that depend on the angle of incidence, as the cosine does on matt surfaces."""

SURFACE_COLUMNS = ("reflectance", "relative_reflectance")
"""Columns from which the angle is taken off."""

ANGLE = "incidence_angle_normals"
OVERLAP_COLUMNS = (*LIGHT_COLUMNS, *SURFACE_COLUMNS)

OVERLAP_DTYPE = np.dtype(
    [
        ("gps_time", "<f8"), ("xyz", "<f8", 3), ("scan_angle", "<f4"), ("angle", "<f4"),
        *((f"{name}{end}", "<f4") for name in OVERLAP_COLUMNS for end in ("", "_err")),
    ]  # fmt: skip
)
"""One echo: time [s], position [m], angle off nadir and of incidence [deg], columns and their errors (NaN: no data)."""


class OverlapReader(CloudReader):
    """A CloudReader of OVERLAP_DTYPE for echoes that are alone in their pulse; `has` are the columns of the cloud."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        names = [f"{name}{end}" for name in OVERLAP_COLUMNS for end in ("", "_err")]
        self._columns = find_columns(list(self._format.extra_dimensions), [*names, ANGLE])
        self.has = frozenset(self._columns)

    def _convert(self, raw: np.ndarray) -> np.ndarray:
        single = split_numbers(raw)[1] <= 1
        if "echo_flags" in self._sources:
            flags = raw[self._sources["echo_flags"].name].astype(np.uint16)
            single &= (flags & np.uint16(PASSED_THROUGH | UNCLEAN)) == 0
        raw = raw[single]
        rows = self._place(raw, OVERLAP_DTYPE)
        rows["scan_angle"] = read_angles(raw)
        rows["angle"] = self._read_column(raw, self._columns.get(ANGLE))
        for name in OVERLAP_COLUMNS:
            for end in ("", "_err"):
                rows[f"{name}{end}"] = self._read_column(raw, self._columns.get(f"{name}{end}"))
        return rows
