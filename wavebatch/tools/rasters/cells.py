"""Statistics of values in the cells of a tile. `grid` calls it tile by tile."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

STATISTICS = ("mean", "median", "min", "max", "std", "count", "density")
"""std: standard deviation with n - 1, no-data for one value; density: points with a value per area."""


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
