"""Map of the ground of a strip: it divides the signal of a ray into ground and canopy.

`strip.voxelize_strip` makes one from the lowest returns, without any classification. Light of a ray is shared between
canopy and ground by it, so signal that is wrongly taken for ground changes gap probabilities by the ratio of both
reflectances only.
"""

from __future__ import annotations

import numpy as np

from wavebatch.kernels.geometry.planes import fit_planes
from wavebatch.tools.voxels.cell_map import AROUND, CellMap

CELL = 5.0
"""Cell of the map [m]: in each, some return should have reached the ground."""

STEEPEST = 0.5
"""Least vertical part of the normal of a cell's ground: steeper planes are no ground, the cell is level."""

LEAST_AROUND = 4
"""Least number of lowest returns in a cell and the eight around it for a slope."""

LEAST_WIDTH = 0.1
"""Least standard deviation of these returns across their longest direction [cells]: a single row has no slope."""


class Floor(CellMap):
    """Ground below a strip: a plane through the lowest returns of each cell and of the eight around it.

    middle: as for CellMap.
    """

    def __init__(self, middle: np.ndarray) -> None:
        super().__init__(middle, CELL, highest=False)
        self._slope = np.empty((0, 2))

    def finish(self) -> Floor:
        """Fits the planes; returns the map."""
        row = self._row_of(self._key[:, None] + AROUND)
        cell, number = np.nonzero(row >= 0)
        offset = self._kept[row[cell, number]] - self._kept[cell]
        planes = fit_planes(offset, cell, len(row))
        normal = np.where(planes.normal[:, 2:] < 0, -planes.normal, planes.normal)
        usable = (planes.kept >= LEAST_AROUND) & (normal[:, 2] >= STEEPEST)
        usable &= planes.spreads[:, 1] > (LEAST_WIDTH * self.cell) ** 2
        up = np.where(usable, normal[:, 2], 1.0)[:, None]
        self._slope = np.where(usable[:, None], -normal[:, :2] / up, 0.0)
        # The plane, not the lowest return itself: that may lie below the ground.
        base = planes.centre[:, 2] - (self._slope * planes.centre[:, :2]).sum(axis=1)
        self._kept[:, 2] += np.where(usable, base, 0.0)
        return self

    def measure_height(self, place: np.ndarray) -> np.ndarray:
        """Height (n,) of positions (n, 3) above the ground [m]; infinite where there is no map."""
        local = place - self._middle
        row = self._row_of(self._key_of(local))
        if not len(self._key):
            return np.full(len(place), np.inf)
        low, slope = self._kept[row], self._slope[row]
        ground = low[:, 2] + ((local[:, :2] - low[:, :2]) * slope).sum(axis=1)
        height = local[:, 2] - ground
        return np.where((row >= 0) & np.isfinite(height), height, np.inf)
