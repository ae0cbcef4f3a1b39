"""Map of the highest returns of a strip: above them, rays cross only air and need not be followed.

`strip.voxelize_strip` makes one where --headroom is not given. It counts each ray from the height of this map, so that
voxels near the surface get all light that crossed them, whether recorded or not.
"""

from __future__ import annotations

import numpy as np

from wavebatch.files.las.point_formats import locate
from wavebatch.files.strip.reader import StripReader, StripScan
from wavebatch.tools.voxels.cell_map import AROUND, CellMap
from wavebatch.tools.voxels.floor import Floor

LEAST_CELL = 4.0
"""Least cell of the map [m]."""

VOXELS_PER_CELL = 4.0
"""Least cell of the map, in voxels."""

MARGIN = 3.0
"""Height above the highest return up to which there can be signal without a return [m]."""

STEEP = 0.1
"""Least vertical part of a ray: flatter rays are not followed upwards."""

MOST_STEPS = 1024
"""Cells over which a ray is followed at most."""


class Ceiling(CellMap):
    """Highest return of each cell of a map and its eight neighbours.

    middle: as for CellMap. size: of the voxels [m].
    """

    def __init__(self, middle: np.ndarray, size: float) -> None:
        super().__init__(middle, max(LEAST_CELL, VOXELS_PER_CELL * size), highest=True)
        self._top = np.empty(0)

    def finish(self) -> Ceiling:
        """Raises every cell to the highest around it; returns the map."""
        self._key, row = np.unique(self._key[:, None] + AROUND, return_inverse=True)
        self._top = np.full(len(self._key), -np.inf)
        np.maximum.at(self._top, row.ravel(), np.repeat(self._kept[:, 2] + MARGIN, len(AROUND)))
        return self

    def measure_headroom(self, start: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Distance (n,) [m] from positions (n, 3) back along the rays to where they are above all returns."""
        with np.errstate(invalid="ignore", divide="ignore"):
            up = -step / np.sqrt((step * step).sum(axis=1))[:, None]
        headroom = np.zeros(len(start))
        rows = np.flatnonzero((up[:, 2] >= STEEP) & np.isfinite(start).all(axis=1))
        for number in range(MOST_STEPS):
            way = number * self.cell
            place = start[rows] + up[rows] * way
            rows, place = (values[place[:, 2] < self._top.max(initial=-np.inf)] for values in (rows, place))
            if not len(rows):
                break
            row = self._row_of(self._key_of(place - self._middle))
            below = place[:, 2] < np.where(row >= 0, self._top[row], -np.inf)
            headroom[rows[below]] = way + self.cell
        return headroom


def find_ceiling(reader: StripReader, scan: StripScan, middle: np.ndarray, size: float, floor: Floor) -> Ceiling:
    """The ceiling of a strip; reads all of its points, and adds them to `floor` too."""
    ceiling = Ceiling(middle, size)
    for begin, end in zip(scan.borders[:-1].tolist(), scan.borders[1:].tolist(), strict=True):
        xyz = locate(reader.read_points(begin, end), reader.facts.header)
        ceiling.add(xyz)
        floor.add(xyz)
    return ceiling.finish()
