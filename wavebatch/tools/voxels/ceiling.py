"""Map of the highest returns of a strip: above them, rays cross only air and need not be followed.

`strip.voxelize_strip` makes one where --headroom is not given. It counts each ray from the height of this map, so that
voxels near the surface get all light that crossed them, whether recorded or not.
"""

from __future__ import annotations

import numpy as np

from wavebatch.files.las.point_formats import locate
from wavebatch.files.strip.reader import StripReader, StripScan
from wavebatch.tools.voxels.floor import Floor

LEAST_CELL = 4.0
"""Least cell of the map [m]."""

VOXELS_PER_CELL = 4.0
"""Least cell of the map, in voxels."""

MOST_CELLS = 1 << 18
"""Beyond this number, cells become twice as large: memory does not grow with the strip."""

MARGIN = 3.0
"""Height above the highest return up to which there can be signal without a return [m]."""

STEEP = 0.1
"""Least vertical part of a ray: flatter rays are not followed upwards."""

MOST_STEPS = 1024
"""Cells over which a ray is followed at most."""
_REACH = 1 << 28
_SHIFT = np.int64(1 << 30)


class Ceiling:
    """Highest return of each cell of a map and its eight neighbours.

    middle: a position in the strip; returns more than 2^28 cells from it are ignored. size: of the voxels [m].
    """

    def __init__(self, middle: np.ndarray, size: float) -> None:
        self._middle = middle[:2]
        self.cell = max(LEAST_CELL, VOXELS_PER_CELL * size)
        self._key = np.empty(0, np.int64)
        self._top = np.empty(0)
        self.highest = -np.inf

    def add(self, xyz: np.ndarray) -> None:
        """Adds returns (m, 3) [m]."""
        index = np.floor((xyz[:, :2] - self._middle) / self.cell)
        good = (np.abs(index) < _REACH).all(axis=1) & np.isfinite(xyz[:, 2])
        index = index[good].astype(np.int64)
        self._merge(index[:, 0] * _SHIFT + index[:, 1], xyz[good, 2] + MARGIN)
        while len(self._key) > MOST_CELLS:
            self.cell *= 2.0
            x, y = self._split(self._key)
            self._merge((x >> 1) * _SHIFT + (y >> 1), self._top, fresh=True)

    def finish(self) -> Ceiling:
        """Raises every cell to the highest around it; returns the map."""
        if len(self._key):
            self.highest = float(self._top.max())
            around = [a * _SHIFT + b for a in (-1, 0, 1) for b in (-1, 0, 1)]
            key, top = self._key, self._top
            self._merge(np.concatenate([key + off for off in around]), np.tile(top, 9), fresh=True)
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
        """Adds cells, keeping the highest of equal ones; fresh: replaces all cells."""
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


def find_ceiling(
    reader: StripReader, scan: StripScan, middle: np.ndarray, size: float, floor: Floor | None = None
) -> Ceiling:
    """The ceiling of a strip; reads all of its points, and adds them to `floor` too."""
    ceiling = Ceiling(middle, size)
    for begin, end in zip(scan.borders[:-1].tolist(), scan.borders[1:].tolist(), strict=True):
        xyz = locate(reader.read_points(begin, end), reader.facts.header)
        ceiling.add(xyz)
        if floor is not None:
            floor.add(xyz)
    return ceiling.finish()
