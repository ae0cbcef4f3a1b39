"""How high up a strip's rays matter: above the highest return of its neighbourhood a ray crosses nothing but air."""

from __future__ import annotations

import numpy as np

from wavebatch.files.strip.reader import StripReader, StripScan
from wavebatch.files.strip.scanner import locate

LEAST_CELL = 4.0
"""Of the map of highest returns [m]."""

VOXELS_PER_CELL = 4.0
MOST_CELLS = 1 << 18
"""Where a strip has more, they become twice as large."""

MARGIN = 3.0
"""Above the highest return, in which signal may lie that is none [m]."""

STEEP = 0.1
"""Least share of a ray that is vertical: flatter ones are not followed upwards."""

MOST_STEPS = 1024
_REACH = 1 << 28
_SHIFT = np.int64(1 << 30)


class Ceiling:
    """Highest return of each cell of a map and the eight around it; cells without any have none.

    middle: a place in the strip; what lies absurdly far from it does not count. size: of the voxels [m].
    """

    def __init__(self, middle: np.ndarray, size: float) -> None:
        self._middle = middle[:2]
        self.cell = max(LEAST_CELL, VOXELS_PER_CELL * size)
        self._key = np.empty(0, np.int64)
        self._top = np.empty(0)
        self.highest = -np.inf

    def add(self, xyz: np.ndarray) -> None:
        """Takes returns (m, 3) into account."""
        index = np.floor((xyz[:, :2] - self._middle) / self.cell)
        good = (np.abs(index) < _REACH).all(axis=1) & np.isfinite(xyz[:, 2])
        index = index[good].astype(np.int64)
        self._merge(index[:, 0] * _SHIFT + index[:, 1], xyz[good, 2] + MARGIN)
        while len(self._key) > MOST_CELLS:
            self.cell *= 2.0
            x, y = self._split(self._key)
            self._merge((x >> 1) * _SHIFT + (y >> 1), self._top, fresh=True)

    def finish(self) -> Ceiling:
        """The map with every cell as high as the highest around it."""
        if len(self._key):
            self.highest = float(self._top.max())
            around = [a * _SHIFT + b for a in (-1, 0, 1) for b in (-1, 0, 1)]
            key, top = self._key, self._top
            self._merge(np.concatenate([key + off for off in around]), np.tile(top, 9), fresh=True)
        return self

    def measure_headroom(self, start: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Way (n,) [m] before positions (n, 3), against their direction, up to where rays are above all returns."""
        with np.errstate(invalid="ignore", divide="ignore"):
            up = -step / np.sqrt((step * step).sum(axis=1))[:, None]
        headroom = np.zeros(len(start))
        rows = np.flatnonzero((up[:, 2] >= STEEP) & np.isfinite(start).all(axis=1))
        for number in range(MOST_STEPS):
            way = number * self.cell
            place = start[rows] + up[rows] * way
            rows, place = (values[place[:, 2] < self.highest] for values in (rows, place))
            if not len(rows):
                break
            below = place[:, 2] < self._find(place)
            headroom[rows[below]] = way + self.cell
        return headroom

    def _find(self, place: np.ndarray) -> np.ndarray:
        index = np.clip(np.floor((place[:, :2] - self._middle) / self.cell), -_REACH, _REACH).astype(np.int64)
        key = index[:, 0] * _SHIFT + index[:, 1]
        at = np.minimum(np.searchsorted(self._key, key), len(self._key) - 1)
        return np.where(self._key[at] == key, self._top[at], -np.inf)

    def _merge(self, key: np.ndarray, top: np.ndarray, *, fresh: bool = False) -> None:
        """Takes cells in, or in place of those that are there."""
        if not fresh:
            key, top = np.concatenate([self._key, key]), np.concatenate([self._top, top])
        order = np.lexsort((top, key))
        key, top = key[order], top[order]
        last = np.append(key[1:] != key[:-1], True)[: len(key)]
        self._key, self._top = key[last], top[last]

    @staticmethod
    def _split(key: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x = (key + (_SHIFT >> 1)) // _SHIFT
        return x, key - x * _SHIFT


def find_ceiling(reader: StripReader, scan: StripScan, middle: np.ndarray, size: float) -> Ceiling:
    """The ceiling of a strip from all of its points, which are read once more."""
    ceiling = Ceiling(middle, size)
    for begin, end in zip(scan.borders[:-1].tolist(), scan.borders[1:].tolist(), strict=True):
        ceiling.add(locate(reader.read_points(begin, end), reader.facts))
    return ceiling.finish()
