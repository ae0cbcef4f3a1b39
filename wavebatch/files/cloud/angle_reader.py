"""Incidence angles of point clouds, from echo widths and from neighbouring points, with their errors.

`wavebatch compare-angles` reads with it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from wavebatch.files.cloud.echo_reader import CloudReader

WIDTHS, NORMALS = "incidence_angle", "incidence_angle_normals"
ANGLES = (WIDTHS, f"{WIDTHS}_err", NORMALS, f"{NORMALS}_err")

ANGLE_DTYPE = np.dtype([("gps_time", "<f8"), ("xyz", "<f8", 3), *((name, "<f8") for name in ANGLES)])
"""One point: time [s], position [m], angles and their errors [deg] (NaN: no data, or no such column)."""


class AngleReader(CloudReader):
    """A CloudReader of ANGLE_DTYPE; `has` are those of ANGLES that the cloud has."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._angles = self._find_ours(list(self._format.extra_dimensions), ANGLES)
        self.has = frozenset(self._angles)

    def _convert(self, raw: np.ndarray) -> np.ndarray:
        rows = self._place(raw, ANGLE_DTYPE)
        for name in ANGLES:
            rows[name] = self._read_column(raw, self._angles.get(name))
        return rows
