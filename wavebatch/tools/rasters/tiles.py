"""Statistics of columns of clouds in the tiles of a grid of any size, in memory that does not grow with either.

`grid` writes the tiles as a GeoTIFF, `plots/raster` makes a map of them. Points go to buckets on disk by tile; one
bucket after the other is read and its tiles are computed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from wavebatch.files.disk.spool import Spool
from wavebatch.files.geotiff_file import TILE
from wavebatch.tools.plots.values import Clouds
from wavebatch.tools.rasters.cells import Box, Grid, compute_cells

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


def compute_tiles(
    clouds: Clouds, statistic: str, grid: Grid, points: int, result: Placed, bounds: Box | None = None
) -> Iterator[tuple[int, int, np.ndarray]]:
    """Row from the north, column and values f8 (bands, TILE, TILE) of every tile with a point; NaN without a value.

    There is a band for each column of the clouds. points: of all clouds, about. result: gets the counts before the
    first tile comes. bounds: only points within them count.
    """
    number = int(np.clip(-(-points // (HELD // 2)), 1, MOST_BUCKETS))
    bands = 1 + len(clouds.other_facts)
    entries = Spool(number, np.dtype([("tile", "<u8"), ("cell", "<u4"), ("values", "<f8", (bands,))]))
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


def is_in_tile(rows: np.ndarray, bounds: Box | None) -> np.ndarray:
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
        inside = is_in_tile(rows, bounds)
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
    entries: Spool, bucket: int, statistic: str, area: float
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


def _compute_dense(entries: Spool, bucket: int, tile: int, statistic: str, area: float) -> np.ndarray:
    """A tile of a bucket that does not fit in memory: groups of cells, each of about HELD points, one by one."""
    count = np.zeros(TILE * TILE, np.int64)
    for piece in entries.pieces(bucket):
        count += np.bincount(piece["cell"][piece["tile"] == tile], minlength=len(count))
    group = np.cumsum(count) // HELD
    values = np.full((entries.dtype["values"].shape[0], len(count)), np.nan)
    for number in np.unique(group[count > 0]).tolist():
        wanted = group == number
        parts = [piece[(piece["tile"] == tile) & wanted[piece["cell"]]] for piece in entries.pieces(bucket)]
        part = _compute(np.concatenate(parts), statistic, area).reshape(len(values), -1)
        values[:, wanted] = part[:, wanted]
    return values.reshape(-1, TILE, TILE)


def _compute(rows: np.ndarray, statistic: str, area: float) -> np.ndarray:
    cell = rows["cell"].astype(np.int64)
    bands = [compute_cells(statistic, cell, values, TILE * TILE, area) for values in rows["values"].T]
    return np.stack(bands).reshape(-1, TILE, TILE)
