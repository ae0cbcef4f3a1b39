"""Square cells over x and y, and statistics of the values in them: for rasters, maps and the pages.

`grid` writes the tiles of `compute_tiles` as a GeoTIFF, `plots/raster` makes a map of them: in memory that grows
neither with the clouds nor with the grid. Points go to buckets on disk by tile; one bucket after the other is read and
its tiles are computed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from wavebatch.core.errors import ConfigError
from wavebatch.files.disk.temp_store import Spool
from wavebatch.files.geotiff_file import TILE
from wavebatch.tools.plots.values import Clouds

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


HELD = 2_000_000
"""Points in memory at a time."""

MOST_BUCKETS = 4096
"""With HELD / 2 points each they hold 4e9 points."""


@dataclass(slots=True, kw_only=True)
class Placed:
    """How many points came into the cells."""

    points: int = 0
    left_out: int = 0
    """Points that were left out because of their flags or by --where."""
    outside: int = 0
    """Points outside of the bounds, or without a position."""
    values: tuple[int, ...] = ()
    """Points with a value, per band."""


Statistic = str | Callable[[np.ndarray, np.ndarray, int], np.ndarray]
"""One of STATISTICS; or a function from the cell of each point i8 (n,), the values of all columns f8 (n, k) and the
number of cells to bands f8 (m, cells)."""


def compute_tiles(
    clouds: Clouds, statistic: Statistic, grid: Grid, points: int, result: Placed, bounds: Box | None = None
) -> Iterator[tuple[int, int, np.ndarray]]:
    """Row from the north, column and values f8 (bands, TILE, TILE) of every tile with a point; NaN without a value.

    There is a band for each column of the clouds, or those that the statistic computes. points: of all clouds, about.
    result: gets the counts before the first tile comes. bounds: only points within them count.
    """
    number = int(np.clip(-(-points // (HELD // 2)), 1, MOST_BUCKETS))
    columns = 1 + len(clouds.other_facts)
    entries = Spool(number, np.dtype([("tile", "<u8"), ("cell", "<u4"), ("values", "<f8", (columns,))]))
    try:
        _fill(clouds, bounds, grid, entries, result)
        entries.seal()
        for bucket in range(number):
            for tile, values in _compute_bucket(entries, bucket, statistic, grid.size**2):
                yield *divmod(tile, _across(grid)), values
    finally:
        entries.close()


def _across(grid: Grid) -> int:
    return -(-grid.columns // TILE)


def is_in_bounds(rows: np.ndarray, bounds: Box | None) -> np.ndarray:
    """Points with a position within the bounds, bool (n,)."""
    inside = np.isfinite(rows["x"]) & np.isfinite(rows["y"])
    if bounds is not None:
        west, south, east, north = bounds
        inside &= (rows["x"] >= west) & (rows["x"] < east) & (rows["y"] >= south) & (rows["y"] < north)
    return inside


def _fill(clouds: Clouds, bounds: Box | None, grid: Grid, entries: Spool, result: Placed) -> None:
    """Put every point with a value into the bucket of its tile."""
    counted = np.zeros(1 + len(clouds.other_facts), np.int64)
    for _, rows, left_out in clouds.read_all():
        inside = is_in_bounds(rows, bounds)
        result.points += len(rows) + left_out
        result.left_out += left_out
        row, column, in_grid = grid.place(rows["x"], rows["y"])
        inside &= in_grid
        result.outside += int(len(rows) - inside.sum())
        rows, column, row = rows[inside], column[inside], grid.rows - 1 - row[inside]
        counted += np.isfinite(rows["values"]).sum(axis=0)
        found = np.empty(len(rows), entries.dtype)
        found["tile"] = row // TILE * _across(grid) + column // TILE
        found["cell"] = row % TILE * TILE + column % TILE
        found["values"] = rows["values"]
        entries.append((found["tile"] % np.uint64(entries.buckets)).astype(np.int64), found)
    result.values = tuple(counted.tolist())


def _compute_bucket(
    entries: Spool, bucket: int, statistic: Statistic, area: float
) -> Iterator[tuple[int, np.ndarray]]:
    """Number and values (bands, TILE, TILE) of every tile of a bucket."""
    total = sum(len(piece) for piece in entries.pieces(bucket))
    if not total:
        return
    if total <= HELD:
        rows = entries.read(bucket)
        rows = rows[np.argsort(rows["tile"], kind="stable")]
        tiles, first = np.unique(rows["tile"], return_index=True)
        for tile, part in zip(tiles.tolist(), np.split(rows, first[1:]), strict=True):
            yield tile, _compute(part, statistic, area)
        return
    tiles = np.unique(np.concatenate([np.unique(piece["tile"]) for piece in entries.pieces(bucket)]))
    for tile in tiles.tolist():
        yield tile, _compute_dense(entries, bucket, tile, statistic, area)


def _compute_dense(entries: Spool, bucket: int, tile: int, statistic: Statistic, area: float) -> np.ndarray:
    """A tile of a bucket that does not fit in memory: groups of cells, each of about HELD points, one by one."""
    count = np.zeros(TILE * TILE, np.int64)
    for piece in entries.pieces(bucket):
        count += np.bincount(piece["cell"][piece["tile"] == tile], minlength=len(count))
    group = np.cumsum(count) // HELD
    values = np.full((TILE, TILE), np.nan)
    for number in np.unique(group[count > 0]).tolist():
        wanted = group == number
        parts = [piece[(piece["tile"] == tile) & wanted[piece["cell"]]] for piece in entries.pieces(bucket)]
        values = np.fmax(values, _compute(np.concatenate(parts), statistic, area))  # NaN in the other cells
    return values


def _compute(rows: np.ndarray, statistic: Statistic, area: float) -> np.ndarray:
    cell = rows["cell"].astype(np.int64)
    if not isinstance(statistic, str):
        return statistic(cell, rows["values"], TILE * TILE).reshape(-1, TILE, TILE)
    bands = [compute_cells(statistic, cell, values, TILE * TILE, area) for values in rows["values"].T]
    return np.stack(bands).reshape(-1, TILE, TILE)
