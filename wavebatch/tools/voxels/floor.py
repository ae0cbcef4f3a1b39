"""Map of the ground of a strip: which signal of a ray is the ground's, and which the canopy's.

`strip.voxelize_strip` makes one from the lowest returns, without any classification. Light of a ray is shared between
canopy and ground by it, so signal that is wrongly taken for ground changes gap probabilities by the ratio of both
reflectances only.
"""

from __future__ import annotations

import numpy as np

from wavebatch.kernels.geometry.planes import fit_planes

CELL = 5.0
"""Cell of the map [m]: in each, some return should have reached the ground."""

MOST_CELLS = 1 << 18
"""Beyond this number, cells become twice as large: memory does not grow with the strip."""

STEEPEST = 0.5
"""Least vertical part of the normal of a cell's ground: steeper planes are no ground, the cell is level."""

LEAST_AROUND = 4
"""Least number of lowest returns in a cell and the eight around it for a slope."""

LEAST_WIDTH = 0.1
"""Least standard deviation of these returns across their longest direction [cells]: a single row has no slope."""

_REACH = 1 << 28
_SHIFT = np.int64(1 << 30)


class Floor:
    """Ground below a strip: a plane through the lowest returns of each cell and of the eight around it.

    middle: a position in the strip; returns more than 2^28 cells from it are ignored.
    """

    def __init__(self, middle: np.ndarray) -> None:
        self._middle = np.array([middle[0], middle[1], 0.0])
        self.cell = CELL
        self._key = np.empty(0, np.int64)
        self._low = np.empty((0, 3))
        self._slope = np.empty((0, 2))

    def add(self, xyz: np.ndarray) -> None:
        """Adds returns (m, 3) [m]."""
        local = xyz - self._middle
        index = np.floor(local[:, :2] / self.cell)
        good = (np.abs(index) < _REACH).all(axis=1) & np.isfinite(xyz[:, 2])
        self._merge(self._key_of(local[good]), local[good])
        while len(self._key) > MOST_CELLS:
            self.cell *= 2.0
            low, self._key, self._low = self._low, np.empty(0, np.int64), np.empty((0, 3))
            self._merge(self._key_of(low), low)

    def finish(self) -> Floor:
        """Fits the planes; returns the map."""
        n = len(self._key)
        around = [a * _SHIFT + b for a in (-1, 0, 1) for b in (-1, 0, 1)]
        row = np.concatenate([self._row_of(self._key + off) for off in around]).reshape(9, n).T
        cell, number = np.nonzero(row >= 0)
        offset = self._low[row[cell, number]] - self._low[cell]
        planes = fit_planes(offset, cell, n)
        normal = np.where(planes.normal[:, 2:] < 0, -planes.normal, planes.normal)
        usable = (planes.kept >= LEAST_AROUND) & (normal[:, 2] >= STEEPEST)
        usable &= planes.spreads[:, 1] > (LEAST_WIDTH * self.cell) ** 2
        up = np.where(usable, normal[:, 2], 1.0)[:, None]
        self._slope = np.where(usable[:, None], -normal[:, :2] / up, 0.0)
        # The plane, not the lowest return itself: that may lie below the ground.
        base = planes.centre[:, 2] - (self._slope * planes.centre[:, :2]).sum(axis=1)
        self._low[:, 2] += np.where(usable, base, 0.0)
        return self

    def measure_height(self, place: np.ndarray) -> np.ndarray:
        """Height (n,) of positions (n, 3) above the ground [m]; infinite where there is no map."""
        local = place - self._middle
        row = self._row_of(self._key_of(local))
        if not len(self._key):
            return np.full(len(place), np.inf)
        low, slope = self._low[row], self._slope[row]
        ground = low[:, 2] + ((local[:, :2] - low[:, :2]) * slope).sum(axis=1)
        height = local[:, 2] - ground
        return np.where((row >= 0) & np.isfinite(height), height, np.inf)

    def _key_of(self, local: np.ndarray) -> np.ndarray:
        index = np.clip(np.nan_to_num(np.floor(local[:, :2] / self.cell)), -_REACH, _REACH).astype(np.int64)
        return index[:, 0] * _SHIFT + index[:, 1]

    def _row_of(self, key: np.ndarray) -> np.ndarray:
        """Rows of cells, -1 where there is none."""
        at = np.minimum(np.searchsorted(self._key, key), max(len(self._key) - 1, 0))
        return np.where(self._key[at] == key, at, -1) if len(self._key) else np.full(len(key), -1)

    def _merge(self, key: np.ndarray, low: np.ndarray) -> None:
        """Adds cells, keeping the lowest of equal ones."""
        key, low = np.concatenate([self._key, key]), np.concatenate([self._low, low])
        order = np.lexsort((low[:, 1], low[:, 0], low[:, 2], key))
        key, low = key[order], low[order]
        first = np.append(True, key[1:] != key[:-1])[: len(key)]
        self._key, self._low = key[first], low[first]
