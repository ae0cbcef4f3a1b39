"""Maps and histograms of the columns of a cloud, all columns in two passes, for the pages. Memory does not grow.

`strip_part` draws them. `wavebatch plot` and `wavebatch grid` make the pictures and rasters that are finer than this.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from wavebatch.core.even_sample import EvenSample
from wavebatch.files.cloud.columns_reader import ColumnsReader
from wavebatch.files.las.crs_name import describe_crs
from wavebatch.tools.html.drawing.charts import CloudMap, draw_histogram, draw_map

SIDE = 240
"""Most cells along a side of a map."""

_BINS = 240
_OUTER = (0.1, 99.9)
_SHOWN = (2.0, 98.0)


def picture_cloud(path: Path, columns: Sequence[str]) -> tuple[list[str], list[str]]:
    """Histograms and maps (figures) of the columns that the cloud has; raises InputError if it cannot be read."""
    with ColumnsReader(path, columns, missing_ok=True) as reader:
        sample = EvenSample(200_000)
        for rows in reader.read_pieces():
            good = np.isfinite(rows["x"]) & np.isfinite(rows["y"])
            sample.add({name: rows[name][good] for name in ("x", "y", "values")})
        seen = sample.read()
        if not seen or not len(seen["x"]):
            return [], []
        cells = _Cells(seen["x"], seen["y"], len(reader.facts))
        bins = [_choose_bins(seen["values"][:, place]) for place in range(len(reader.facts))]
        counts = [np.zeros(_BINS, np.int64) for _ in bins]
        beyond = [0] * len(bins)
        for rows in reader.read_pieces():
            cells.add(rows)
            for place, edges in enumerate(bins):
                values = rows["values"][:, place]
                values = values[np.isfinite(values)]
                if edges is not None:
                    number = np.histogram(values, edges)[0]
                    counts[place] += number
                    beyond[place] += len(values) - int(number.sum())
        histograms = [
            draw_histogram(edges, number, title=facts.name, label=facts.unit, beyond=out)
            for facts, edges, number, out in zip(reader.facts, bins, counts, beyond, strict=True)
            if edges is not None
        ]
        names = [(facts.name, facts.unit) for facts in reader.facts]
        return histograms, [draw_map(one) for one in cells.finish(names, describe_crs(path)[1])]


def _choose_bins(values: np.ndarray) -> np.ndarray | None:
    values = values[np.isfinite(values)]
    if not len(values):
        return None
    low, high = np.percentile(values, _OUTER)
    room = 0.02 * (high - low) or max(abs(high), 1.0) * 1e-6
    return np.linspace(low - room, high + room, _BINS + 1)


class _Cells:
    """Counts and sums per cell; the grid leaves out the outermost points, which may be damage."""

    def __init__(self, x: np.ndarray, y: np.ndarray, columns: int) -> None:
        (west, east), (south, north) = (_limits(values) for values in (x, y))
        area = max((east - west) * (north - south), 1e-6)
        # A few points per cell; the sample may stand for more points, which only fills the cells better.
        self.size = max(max(east - west, north - south) / SIDE, math.sqrt(4 * area / len(x)), 1e-3)
        self.west, self.south = west, south
        self.columns, self.rows = (int((end - start) // self.size) + 1 for start, end in ((west, east), (south, north)))
        self.count = np.zeros(self.rows * self.columns, np.int64)
        self.known = np.zeros((columns, len(self.count)), np.int64)
        self.sums = np.zeros((columns, len(self.count)))
        self.outside = 0

    def add(self, rows: np.ndarray) -> None:
        """Adds points."""
        with np.errstate(invalid="ignore", over="ignore"):
            column, row = (rows["x"] - self.west) // self.size, (rows["y"] - self.south) // self.size
            inside = (column >= 0) & (column < self.columns) & (row >= 0) & (row < self.rows)
        self.outside += int(len(rows) - inside.sum())
        cell = (row[inside] * self.columns + column[inside]).astype(np.int64)
        self.count += np.bincount(cell, minlength=len(self.count))
        for place, values in enumerate(rows["values"][inside].T):
            known = np.isfinite(values)
            self.known[place] += np.bincount(cell[known], minlength=len(self.count))
            self.sums[place] += np.bincount(cell[known], values[known], minlength=len(self.count))

    def finish(self, names: list[tuple[str, str]], length: str) -> list[CloudMap]:
        """The map of density, and the mean of each column; length: unit of the coordinates."""
        density = np.where(self.count > 0, self.count / self.size**2, np.nan)
        maps = [("points per area", f"1/{length}2", density)]
        with np.errstate(invalid="ignore", divide="ignore"):
            maps += [(f"mean {name}", unit, total / number)
                     for (name, unit), total, number in zip(names, self.sums, self.known, strict=True)
                     if number.any()]  # fmt: skip
        extent = (self.west, self.west + self.columns * self.size, self.south, self.south + self.rows * self.size)
        note = f"; {self.outside:,} points far away are left out" if self.outside else ""
        found = []
        for title, unit, values in maps:
            known = values[np.isfinite(values)]
            if len(known):
                shown = tuple(np.percentile(known, _SHOWN).tolist())
                grid = values.reshape(self.rows, self.columns)
                found.append(CloudMap(title, unit, grid, extent, float(f"{self.size:.3g}"), length, shown, note))
        return found


def _limits(values: np.ndarray) -> tuple[float, float]:
    """Least and largest value, without far outliers."""
    low, high = np.percentile(values, _OUTER)
    room = 0.25 * (high - low)
    if not room:
        return float(low) - 0.5, float(high) + 0.5
    return float(max(values.min(), low - room)), float(min(values.max(), high + room))
