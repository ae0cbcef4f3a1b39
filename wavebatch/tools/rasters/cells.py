"""Square cells over x and y, and statistics of the values in them: for rasters, maps and the pages.

`tiles` computes clouds of any size with them, tile by tile.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from wavebatch.core.errors import ConfigError

Box = tuple[float, float, float, float]
"""West, south, east, north."""

LARGEST_SIZE = 1e9
"""Largest side of a cell: more than the world; larger ones overflow."""

STATISTICS = ("mean", "median", "min", "max", "std", "count", "density")
"""std: standard deviation with n - 1, no-data for one value; density: points with a value per area."""


@dataclass(frozen=True, slots=True)
class Grid:
    """Square cells of one size; their borders are multiples of it, so that rasters of neighbouring clouds fit."""

    size: float
    """Side of a cell, in units of the coordinates."""
    west: int
    south: int
    """Borders, in cells."""
    rows: int
    columns: int

    @classmethod
    def cover(cls, box: Box, size: float) -> Grid:
        """The cells that hold a box: west, south, east, north."""
        west, south, east, north = (int(np.floor(value / size)) for value in box)
        return cls(size, west, south, north - south + 1, east - west + 1)

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """West, east, south, north."""
        east, north = self.west + self.columns, self.south + self.rows
        return self.west * self.size, east * self.size, self.south * self.size, north * self.size

    def place(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Row from the south and column of each point, i8 (n,), and whether it lies in the grid; -1 outside."""
        # Whole numbers of cells first: x less the border would round away what lies on it.
        with np.errstate(over="ignore", invalid="ignore"):
            column, row = np.floor(x / self.size) - self.west, np.floor(y / self.size) - self.south
            inside = (column >= 0) & (column < self.columns) & (row >= 0) & (row < self.rows)
        return np.where(inside, row, -1).astype(np.int64), np.where(inside, column, -1).astype(np.int64), inside


def check_cells(statistic: str, bounds: Box | None) -> None:
    """Raises ConfigError for an unknown statistic, and for bounds that hold no place."""
    if statistic not in STATISTICS:
        raise ConfigError(f"statistic {statistic!r} is not one of {', '.join(STATISTICS)}")
    if bounds is not None:
        west, south, east, north = bounds
        if not (math.isfinite(east - west) and math.isfinite(north - south) and west < east and south < north):
            raise ConfigError("--bbox must be WEST,SOUTH,EAST,NORTH, west of east and south of north")


def compute_cells(statistic: str, cell: np.ndarray, values: np.ndarray, number: int, area: float) -> np.ndarray:
    """The statistic of values f8 (n,) by cell i8 (n,), f8 (number,); NaN in cells without a value.

    area: of a cell, for the density.
    """
    known = np.isfinite(values)
    cell, values = cell[known], values[known]
    count = np.bincount(cell, minlength=number)
    filled = np.where(count > 0, 1.0, np.nan)
    if statistic in ("count", "density"):
        return filled * count / (1.0 if statistic == "count" else area)
    if statistic in ("mean", "std"):
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = np.bincount(cell, values, number) / count
            if statistic == "mean":
                return mean
            # Differences from the mean first: squares of large values would cancel.
            square = np.bincount(cell, (values - mean[cell]) ** 2, number)
            return np.where(count > 1, np.sqrt(square / (count - 1)), np.nan)
    return _pick(cell, values, count, _PLACES[statistic])


_PLACES: dict[str, Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]] = {
    "median": lambda count: ((count - 1) // 2, count // 2),
    "min": lambda count: (np.zeros_like(count), np.zeros_like(count)),
    "max": lambda count: (count - 1, count - 1),
}
"""Ranks of the two values whose mean is the statistic, from the counts of cells."""


def _pick(
    cell: np.ndarray, values: np.ndarray, count: np.ndarray, places: Callable[[np.ndarray], tuple[np.ndarray, ...]]
) -> np.ndarray:
    """The values of these ranks in each cell."""
    ordered = values[np.lexsort((values, cell))]
    filled = np.flatnonzero(count)
    first = (np.cumsum(count) - count)[filled]
    low, high = (ordered[first + place] for place in places(count[filled]))
    result = np.full(len(count), np.nan)
    result[filled] = low + 0.5 * (high - low)
    return result
