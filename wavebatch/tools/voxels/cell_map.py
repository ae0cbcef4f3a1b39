"""The outermost return of each cell of a horizontal grid: the base of the maps `floor` and `ceiling`.

Cells without returns take no memory. Beyond MOST_CELLS, cells become twice as large: memory does not grow with the
strip.
"""

from __future__ import annotations

import numpy as np

MOST_CELLS = 1 << 18
"""Largest number of cells."""

_REACH = 1 << 28
_SHIFT = np.int64(1 << 30)
AROUND = np.array([a * _SHIFT + b for a in (-1, 0, 1) for b in (-1, 0, 1)])
"""From the key of a cell to those of the cell and of the eight around it, i8 (9,)."""


class CellMap:
    """The lowest or the highest return of each cell.

    middle: a position in the strip; returns more than 2^28 cells from it are ignored. cell: side of the cells [m].
    highest: keep the highest returns.
    """

    def __init__(self, middle: np.ndarray, cell: float, *, highest: bool) -> None:
        self._middle = np.array([middle[0], middle[1], 0.0])
        self.cell = cell
        self._sign = -1.0 if highest else 1.0
        self._key = np.empty(0, np.int64)
        self._kept = np.empty((0, 3))
        """Returns from the middle, one per key, f8 (n, 3) [m]."""

    def add(self, xyz: np.ndarray) -> None:
        """Adds returns (m, 3) [m]."""
        local = xyz - self._middle
        index = np.floor(local[:, :2] / self.cell)
        good = (np.abs(index) < _REACH).all(axis=1) & np.isfinite(xyz[:, 2])
        self._keep_outermost(np.concatenate([self._kept, local[good]]))
        while len(self._key) > MOST_CELLS:
            self.cell *= 2.0
            self._keep_outermost(self._kept)

    def _keep_outermost(self, local: np.ndarray) -> None:
        key = self._key_of(local)
        order = np.lexsort((local[:, 1], local[:, 0], self._sign * local[:, 2], key))
        first = np.append(True, np.diff(key[order]) != 0)[: len(key)]
        self._key, self._kept = key[order][first], local[order][first]

    def _key_of(self, local: np.ndarray) -> np.ndarray:
        """Keys of the cells, i8 (m,), of positions from the middle (m, 3)."""
        index = np.clip(np.nan_to_num(np.floor(local[:, :2] / self.cell)), -_REACH, _REACH).astype(np.int64)
        return index[:, 0] * _SHIFT + index[:, 1]

    def _row_of(self, key: np.ndarray) -> np.ndarray:
        """Rows of cells, -1 where there is none."""
        if not len(self._key):
            return np.full(key.shape, -1)
        at = np.minimum(np.searchsorted(self._key, key), len(self._key) - 1)
        return np.where(self._key[at] == key, at, -1)
