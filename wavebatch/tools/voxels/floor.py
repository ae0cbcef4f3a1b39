"""Maps of the lowest and of the highest returns of a strip.

`strip.voxelize_strip` makes both. The floor divides the signal of a ray into ground and canopy, without any
classification: light of a ray is shared between them, so signal that is wrongly taken for ground changes gap
probabilities by the ratio of both reflectances only. Above the ceiling rays cross only air; without --headroom each
ray is counted from there, so that voxels near the surface get all light that crossed them, whether recorded or not.
"""

from __future__ import annotations

import numpy as np

from wavebatch.files.las.header import locate
from wavebatch.files.strip.reader import StripReader, StripScan
from wavebatch.kernels.geometry.planes import fit_planes

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
