"""`wavebatch grid`: columns of clouds of any size as a GeoTIFF, in memory that does not grow with clouds or raster.

Clouds are read twice: for the extent, then for the cells. Points go to buckets on disk by tile of the raster; one
bucket after the other is read and its tiles are written. Tiles without a point are not written at all.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from wavebatch import __version__
from wavebatch.core.condition import Condition
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.files.cloud.column_reader import ColumnFacts, select_points
from wavebatch.files.cloud.columns_reader import ColumnsReader
from wavebatch.files.disk.spool import Spool
from wavebatch.files.geotiff_file import TILE, Band, RasterLayout, RasterWriter, find_crs_unit, same_crs
from wavebatch.files.las.checked_header import read_checked_header
from wavebatch.files.las.crs import read_crs_definition
from wavebatch.tools.rasters.cells import STATISTICS, compute_cells

LARGEST_SIZE = 1e9
"""Largest side of a cell: more than the world; larger ones overflow."""

MOST_SIDE = 2_000_000
"""Most cells along a side: more is damage of coordinates, or a size that was meant in another unit."""

HELD = 2_000_000
"""Points in memory at a time."""

MOST_BUCKETS = 4096
"""With HELD / 2 points each they hold 4e9 points."""

_EXACT = float(1 << 23)
"""Steps of a column that float32 holds apart; larger values are written as float64."""


@dataclass(frozen=True, slots=True)
class GridOptions:
    """What is written."""

    columns: tuple[str, ...]
    """A band each; empty for count and density of all points."""
    statistic: str = "mean"
    size: float = 1.0
    """Side of a cell, in units of the coordinates."""
    bounds: tuple[float, float, float, float] | None = None
    """West, south, east, north."""
    flags_with: int = 0
    flags_without: int = 0
    where: Condition | None = None
    """Points must meet this."""
    crs: str | None = None
    no_data: float = -9999.0


@dataclass(slots=True)
class GridResult:
    """What was written."""

    layout: RasterLayout
    points: int = 0
    left_out: int = 0
    """Points that were left out because of their flags or by --where."""
    outside: int = 0
    """Points outside of the bounds, or without a position."""
    values: tuple[int, ...] = ()
    """Points with a value, per band."""
    filled: int = 0
    """Cells that have a value in a band at least."""
    bands: tuple[Band, ...] = ()
    """Name and unit of each band."""


def write_grid(paths: Sequence[Path], target: Path, options: GridOptions, *, overwrite: bool = False) -> GridResult:
    """Write the raster.

    Raises ConfigError for wrong options, InputError for clouds that cannot be read or have no point to write.
    """
    _check(options)
    options = replace(options, bounds=_grow(options.bounds, options.size))
    crs, unit = _find_crs(paths, options.crs)
    facts = _find_facts(paths, options.columns)
    box, points, largest = _find_extent(paths, options)
    layout = _lay_out(str(paths[0]), box, options)
    layout = replace(layout, dtype=_choose_dtype(facts, largest), crs=crs, unit=unit)
    bands = _describe(facts, options.statistic, unit)
    result = GridResult(layout, bands=tuple(bands))
    tags = {"TIFFTAG_SOFTWARE": f"wavebatch {__version__}", "STATISTIC": options.statistic}
    number = int(np.clip(-(-points // (HELD // 2)), 1, MOST_BUCKETS))
    entries = Spool(number, np.dtype([("tile", "<u8"), ("cell", "<u4"), ("values", "<f8", (len(bands),))]))
    try:
        _fill(paths, options, layout, entries, result)
        with RasterWriter(target, layout, bands, tags, overwrite=overwrite) as writer:
            for bucket in range(number):
                for tile, values in _compute_tiles(entries.seal(), bucket, options, layout):
                    result.filled += int(np.isfinite(values).any(axis=0).sum())
                    writer.write_tile(*divmod(tile, _across(layout)), values)
            writer.publish()
    finally:
        entries.close()
    return result


def _check(options: GridOptions) -> None:
    if options.statistic not in STATISTICS:
        raise ConfigError(f"statistic {options.statistic!r} is not one of {', '.join(STATISTICS)}")
    if not options.columns and options.statistic not in ("count", "density"):
        raise ConfigError(f"--statistic {options.statistic} needs a --column; only count and density need none")
    if not 0 < options.size <= LARGEST_SIZE:
        raise ConfigError(f"--size must be more than 0 and at most {LARGEST_SIZE:g}, got {options.size:g}")
    if not (math.isnan(options.no_data) or abs(options.no_data) <= float(np.finfo(np.float32).max)):
        raise ConfigError(f"--no-data must be nan or a number that float32 holds, got {options.no_data:g}")
    if options.bounds is not None:
        west, south, east, north = options.bounds
        if not (math.isfinite(east - west) and math.isfinite(north - south) and west < east and south < north):
            raise ConfigError("--bbox must be WEST,SOUTH,EAST,NORTH, west of east and south of north")


def _grow(
    bounds: tuple[float, float, float, float] | None, size: float
) -> tuple[float, float, float, float] | None:
    """The bounds up to the next borders of cells, so that no cell holds a part of its points only."""
    if bounds is None:
        return None
    west, south, east, north = (value / size for value in bounds)
    return math.floor(west) * size, math.floor(south) * size, math.ceil(east) * size, math.ceil(north) * size


def _find_crs(paths: Sequence[Path], given: str | None) -> tuple[str | None, str]:
    """The CRS of all clouds and its unit; ConfigError where they differ."""
    if given is not None:
        return given, find_crs_unit(given, "--crs")
    first: tuple[Path, str] | None = None
    unit = "m"
    for path in paths:
        checked = read_checked_header(path, waveforms=False)
        found = read_crs_definition(path, checked.header)
        if found is None:
            continue
        unit = find_crs_unit(found, str(path))
        if first is not None and not same_crs(first[1], found, str(path)):
            raise ConfigError(f"{path}: has another CRS than {first[0]}; make a raster of each, or give --crs")
        first = first or (path, found)
    return (None if first is None else first[1]), unit


def _find_facts(paths: Sequence[Path], columns: Sequence[str]) -> tuple[ColumnFacts, ...]:
    """The columns' facts, which all clouds must share."""
    known: tuple[ColumnFacts, ...] | None = None
    for path in paths:
        with ColumnsReader(path, columns) as reader:
            for mine, other in zip(reader.facts, known or reader.facts, strict=True):
                if mine.unit != other.unit:
                    raise ConfigError(f"{path}: {mine.name} is in [{mine.unit}], in {paths[0]} in [{other.unit}]; make "
                                      "a raster of each")  # fmt: skip
                if mine.is_flags:
                    raise ConfigError(f"{path}: {mine.name} are bits, which have no statistic; count the points with a "
                                      "flag: --statistic count --flags NAME")  # fmt: skip
            known = known or reader.facts
    return known or ()


def _read(paths: Sequence[Path], options: GridOptions) -> Iterator[tuple[np.ndarray, int]]:
    """Pieces of all clouds: points with the right flags that meet the condition, and the number of those left out."""
    for path in paths:
        with ColumnsReader(path, options.columns) as reader:
            if (options.flags_with or options.flags_without) and not reader.has_flags:
                raise ConfigError(f"{path}: has no column echo_flags to select points by")
            select_points(reader, options.where)
            seen = 0
            for rows in reader.read_pieces():
                keep = (rows["flags"] & np.uint16(options.flags_without)) == 0
                if options.flags_with:
                    keep &= (rows["flags"] & np.uint16(options.flags_with)) != 0
                more, seen = reader.left_out - seen, reader.left_out
                yield rows[keep], int(len(rows) - keep.sum()) + more


def _is_inside(rows: np.ndarray, bounds: tuple[float, float, float, float] | None) -> np.ndarray:
    inside = np.isfinite(rows["x"]) & np.isfinite(rows["y"])
    if bounds is not None:
        west, south, east, north = bounds
        inside &= (rows["x"] >= west) & (rows["x"] < east) & (rows["y"] >= south) & (rows["y"] < north)
    return inside


def _find_extent(
    paths: Sequence[Path], options: GridOptions
) -> tuple[tuple[float, float, float, float], int, np.ndarray]:
    """The box of all points, their number, and the largest absolute value of each column."""
    low, high, points = np.full(2, np.inf), np.full(2, -np.inf), 0
    largest = np.zeros(len(options.columns))
    for rows, _ in _read(paths, options):
        rows = rows[_is_inside(rows, options.bounds)]
        if len(rows):
            places = np.stack([rows["x"], rows["y"]], axis=1)
            low, high = np.minimum(low, places.min(axis=0)), np.maximum(high, places.max(axis=0))
            largest = np.maximum(largest, np.nan_to_num(np.abs(rows["values"])).max(axis=0, initial=0.0))
            points += len(rows)
    if not points:
        wanted = ["a position within --bbox" if options.bounds else "a position"]
        wanted += ["the chosen flags"] if options.flags_with or options.flags_without else []
        wanted += ["what --where asks for"] if options.where is not None else []
        raise InputError(f"{paths[0]}: no raster: no point has {' and '.join(wanted)}")
    return options.bounds or (*low.tolist(), *high.tolist()), points, largest


def _choose_dtype(facts: Sequence[ColumnFacts], largest: np.ndarray) -> str:
    """float32, or float64 where that would not hold neighbouring values of a column apart."""
    wide = (one.name == "gps_time" or one.step > 0 and top > _EXACT * one.step
            for one, top in zip(facts, largest, strict=True))  # fmt: skip
    return "float64" if any(wide) else "float32"


def _lay_out(where: str, box: tuple[float, float, float, float], options: GridOptions) -> RasterLayout:
    """Cell borders are multiples of the size, so that rasters of neighbouring clouds fit together."""
    west, south, east, north = box
    size = options.size
    if max(east - west, north - south) / size > MOST_SIDE:
        raise ConfigError(
            f"{where}: {(east - west) / size:.3g} x {(north - south) / size:.3g} cells of {size:g} are too many; a "
            "coordinate may be damaged: give --bbox, or a larger --size"
        )
    first = math.floor(west / size), math.floor(south / size)
    last = math.floor(east / size), math.floor(north / size)
    if options.bounds is not None:  # they end at a border, where no other cell begins
        last = max(round(east / size) - 1, first[0]), max(round(north / size) - 1, first[1])
        first = round(west / size), round(south / size)
    rows, columns = last[1] - first[1] + 1, last[0] - first[0] + 1
    return RasterLayout(first[0] * size, (last[1] + 1) * size, size, rows, columns, "float32", options.no_data, None)


def _describe(facts: Sequence[ColumnFacts], statistic: str, length: str) -> list[Band]:
    unit = {"count": "", "density": f"1/{length}2"}.get(statistic)
    if not facts:
        return [Band(f"{statistic} of points", unit or "")]
    return [Band(f"{statistic} of {one.name}", (one.unit.strip("-") if unit is None else unit)) for one in facts]


def _across(layout: RasterLayout) -> int:
    return -(-layout.columns // TILE)


def _fill(
    paths: Sequence[Path], options: GridOptions, layout: RasterLayout, entries: Spool, result: GridResult
) -> None:
    """Put every point with a value into the bucket of its tile."""
    bands = max(len(options.columns), 1)
    counted = np.zeros(bands, np.int64)
    west, bottom = round(layout.west / layout.size), round(layout.north / layout.size) - layout.rows
    for rows, left_out in _read(paths, options):
        inside = _is_inside(rows, options.bounds)
        result.points += len(rows) + left_out
        result.left_out += left_out
        # Whole numbers of cells first: x - west would round away what lies on a border.
        with np.errstate(invalid="ignore"):
            column = np.floor(rows["x"] / layout.size) - west
            row = layout.rows - 1 - (np.floor(rows["y"] / layout.size) - bottom)
            inside &= (column >= 0) & (column < layout.columns) & (row >= 0) & (row < layout.rows)
        result.outside += int(len(rows) - inside.sum())
        rows, column, row = rows[inside], column[inside].astype(np.int64), row[inside].astype(np.int64)
        values = rows["values"] if options.columns else np.ones((len(rows), 1))
        counted += np.isfinite(values).sum(axis=0)
        found = np.empty(len(rows), entries.dtype)
        found["tile"] = row // TILE * _across(layout) + column // TILE
        found["cell"] = row % TILE * TILE + column % TILE
        found["values"] = values
        entries.append((found["tile"] % np.uint64(entries.buckets)).astype(np.int64), found)
    result.values = tuple(counted.tolist())


def _compute_tiles(
    entries: Spool, bucket: int, options: GridOptions, layout: RasterLayout
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
            yield tile, _compute(part, options, layout.size**2)
        return
    tiles = np.unique(np.concatenate([np.unique(piece["tile"]) for piece in entries.pieces(bucket)]))
    for tile in tiles.tolist():
        yield tile, _compute_dense(entries, bucket, tile, options, layout.size**2)


def _compute_dense(entries: Spool, bucket: int, tile: int, options: GridOptions, area: float) -> np.ndarray:
    """A tile of a bucket that does not fit in memory: groups of cells, each of about HELD points, one by one."""
    count = np.zeros(TILE * TILE, np.int64)
    for piece in entries.pieces(bucket):
        count += np.bincount(piece["cell"][piece["tile"] == tile], minlength=len(count))
    group = np.cumsum(count) // HELD
    values = np.full((entries.dtype["values"].shape[0], len(count)), np.nan)
    for number in np.unique(group[count > 0]).tolist():
        wanted = group == number
        parts = [piece[(piece["tile"] == tile) & wanted[piece["cell"]]] for piece in entries.pieces(bucket)]
        part = _compute(np.concatenate(parts), options, area).reshape(len(values), -1)
        values[:, wanted] = part[:, wanted]
    return values.reshape(-1, TILE, TILE)


def _compute(rows: np.ndarray, options: GridOptions, area: float) -> np.ndarray:
    cell = rows["cell"].astype(np.int64)
    bands = [compute_cells(options.statistic, cell, values, TILE * TILE, area) for values in rows["values"].T]
    return np.stack(bands).reshape(-1, TILE, TILE)
