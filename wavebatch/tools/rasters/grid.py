"""`wavebatch grid`: columns of clouds of any size as a GeoTIFF, in memory that does not grow with clouds or raster.

Clouds are read twice: here for the extent, then by `cells.compute_tiles`. Tiles without a point are not written at all.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from wavebatch import __version__
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.schema import Above, check_options, option
from wavebatch.files.cloud.cloud_reader import ColumnFacts
from wavebatch.files.cloud.point_filter import EVERY, PointFilter
from wavebatch.files.geotiff_file import Band, RasterLayout, RasterWriter, find_crs_unit, same_crs
from wavebatch.files.las.crs import read_crs_definition
from wavebatch.files.las.read_points import read_checked_header
from wavebatch.tools.plots.values import Clouds, check_statistic
from wavebatch.tools.rasters import forest
from wavebatch.tools.rasters.cells import LARGEST_SIZE, Box, Grid, Placed, check_cells, compute_tiles, is_in_bounds

MOST_SIDE, MOST_CELLS = 2_000_000, 100_000_000_000
"""Most cells along a side, and of the raster (300 km x 300 km at 1 m): more is damage of coordinates, clouds of several
projects, or a size that was meant in another unit."""

_EXACT = float(1 << 23)
"""Steps of a column that float32 holds apart; larger values are written as float64."""


@dataclass(frozen=True, slots=True)
class GridOptions:
    """What is written of which points."""

    columns: tuple[str, ...] = ()
    """A band for each; points are counted without one."""
    chosen: PointFilter = EVERY
    """The points that are used."""
    statistic: Literal["mean", "median", "min", "max", "std", "count", "density"] = option(
        "mean", "Statistic of the values in a cell; density is points per area."
    )
    bbox: Box | None = None
    """Only this part."""
    size: Annotated[float, Above(0.0, LARGEST_SIZE)] = option(
        1.0, "Side of a cell, in the unit of the coordinates. Borders are multiples of it, so that neighbouring "
        "rasters fit together.", form="M",
    )  # fmt: skip
    crs: str | None = option(
        None, "CRS of the clouds, e.g. EPSG:32632.", form="CRS", unset="that of their headers"
    )
    no_data: float = option(-9999.0, "Value of cells without data; nan is possible.", form="VALUE")
    forest: forest.ForestOptions | None = None
    """Metrics of voxels, in place of columns and a statistic."""


@dataclass(slots=True, kw_only=True)
class GridResult(Placed):
    """What was written."""

    layout: RasterLayout
    unnamed: tuple[Path, ...] = ()
    """Clouds without a CRS, if others have one."""
    filled: int = 0
    """Cells that have a value in a band at least."""
    bands: tuple[Band, ...] = ()
    """Name and unit of each band."""
    reasons: tuple[int, ...] = ()
    """Of a forest: cells with metrics, with too few rays, and without light on the ground."""


def write_grid(paths: Sequence[Path], target: Path, options: GridOptions, *, overwrite: bool = False) -> GridResult:
    """Write the raster.

    Raises ConfigError for wrong options, InputError for clouds that cannot be read or have no point to write.
    """
    metrics = None
    if options.forest is not None:
        if options.chosen:
            raise ConfigError("--forest: metrics need all voxels of a cell: leave out --where, --class and flags; "
                              "--bbox takes whole cells")  # fmt: skip
        metrics = forest.Forest(paths, options.size, options.forest)
        options = replace(options, columns=tuple(forest.COLUMNS))
    _check(options)
    options = replace(options, bbox=_grow(options.bbox, options.size))
    crs, unit, unnamed = _find_crs(paths, options.crs)
    if metrics is not None and unit != "m":
        raise ConfigError(f"{paths[0]}: --forest: voxels are measured in metres, and coordinates are in {unit}; "
                          "project the strip to a CRS in metres first")  # fmt: skip
    clouds = Clouds(paths, options.columns or (None,), options.chosen)
    facts = (clouds.facts, *clouds.other_facts)
    for one in facts:
        check_statistic(one.name, options.statistic, one, paths[0])
    box, points, largest = _find_extent(clouds, options)
    if unit == "degree" and options.size > max(box[2] - box[0], box[3] - box[1]):
        raise ConfigError(f"{paths[0]}: coordinates are degrees, and cells of {options.size:g} degrees are larger than "
                          "the clouds; --size 1e-05 gives cells of about 1 m")  # fmt: skip
    grid = _lay_out(str(paths[0]), box, options)
    west, _, _, north = grid.extent
    dtype = _choose_dtype(facts, largest) if metrics is None else "float32"
    layout = RasterLayout(west, north, grid.size, grid.rows, grid.columns, dtype, options.no_data, crs, unit)
    if metrics is None:
        bands, statistic = [_describe(one, options.statistic, unit) for one in facts], options.statistic
    else:
        bands, statistic = metrics.list_bands(largest[forest.COLUMNS.index("height")]), metrics.compute
    result = GridResult(layout=layout, bands=tuple(bands), unnamed=unnamed)
    tags = {"TIFFTAG_SOFTWARE": f"wavebatch {__version__}"}
    tags |= {"STATISTIC": options.statistic} if metrics is None else metrics.describe()
    with RasterWriter(target, layout, bands, tags, overwrite=overwrite) as writer:
        for row, column, values in compute_tiles(clouds, statistic, grid, points, result, options.bbox):
            result.filled += int(np.isfinite(values).any(axis=0).sum())
            writer.write_tile(row, column, values)
        writer.publish()
    if metrics is not None:
        result.reasons = tuple(metrics.reasons.tolist())
        result.values = (*[result.reasons[forest.KNOWN]] * (len(bands) - 1), result.filled)
    return result


def _check(options: GridOptions) -> None:
    check_cells(options.statistic, options.bbox)
    check_statistic(next(iter(options.columns), None), options.statistic)
    check_options(options)
    if not (math.isnan(options.no_data) or abs(options.no_data) <= float(np.finfo(np.float32).max)):
        raise ConfigError(f"--no-data must be nan or a number that float32 holds, got {options.no_data:g}")


def _grow(bounds: Box | None, size: float) -> Box | None:
    """The bounds up to the next borders of cells, so that no cell holds a part of its points only."""
    if bounds is None:
        return None
    west, south, east, north = (value / size for value in bounds)
    return math.floor(west) * size, math.floor(south) * size, math.ceil(east) * size, math.ceil(north) * size


def _find_crs(paths: Sequence[Path], given: str | None) -> tuple[str | None, str, tuple[Path, ...]]:
    """The CRS of all clouds, its unit, and the clouds that have none; ConfigError where they differ."""
    if given is not None:
        return given, find_crs_unit(given, "--crs"), ()
    first: tuple[Path, str] | None = None
    unit, unnamed = "m", []
    for path in paths:
        checked = read_checked_header(path, waveforms=False)
        found = read_crs_definition(path, checked.header)
        if found is None:
            unnamed.append(path)
            continue
        unit = find_crs_unit(found, str(path))
        if first is not None and not same_crs(first[1], found, str(path)):
            raise ConfigError(f"{path}: has another CRS than {first[0]}; make a raster of each, or give --crs")
        first = first or (path, found)
    return (None, unit, ()) if first is None else (first[1], unit, tuple(unnamed))


def _find_extent(clouds: Clouds, options: GridOptions) -> tuple[Box, int, np.ndarray]:
    """The box of all points, their number, and the largest absolute value of each column."""
    low, high, points = np.full(2, np.inf), np.full(2, -np.inf), 0
    largest = np.zeros(1 + len(clouds.other_facts))
    for _, rows, _ in clouds.read_all():
        rows = rows[is_in_bounds(rows, options.bbox)]
        if len(rows):
            places = np.stack([rows["x"], rows["y"]], axis=1)
            low, high = np.minimum(low, places.min(axis=0)), np.maximum(high, places.max(axis=0))
            largest = np.maximum(largest, np.nan_to_num(np.abs(rows["values"])).max(axis=0, initial=0.0))
            points += len(rows)
    if not points:
        wanted, chosen = ["a position within --bbox" if options.bbox else "a position"], options.chosen
        wanted += ["the chosen flags"] if chosen.flags or chosen.drop_flags else []
        wanted += ["what --where asks for"] if chosen.where is not None else []
        raise InputError(f"{clouds.paths[0]}: no raster: no point has {' and '.join(wanted)}")
    return options.bbox or (*low.tolist(), *high.tolist()), points, largest


def _choose_dtype(facts: Sequence[ColumnFacts], largest: np.ndarray) -> str:
    """float32, or float64 where that would not hold neighbouring values of a column apart."""
    wide = (one.name == "gps_time" or one.step > 0 and top > _EXACT * one.step
            for one, top in zip(facts, largest, strict=True))  # fmt: skip
    return "float64" if any(wide) else "float32"


def _lay_out(where: str, box: Box, options: GridOptions) -> Grid:
    """The cells of the raster; ConfigError for too many."""
    west, south, east, north = box
    size = options.size
    columns, rows = (east - west) / size, (north - south) / size
    if max(columns, rows) > MOST_SIDE or columns * rows > MOST_CELLS:
        raise ConfigError(
            f"{where}: {columns:.3g} x {rows:.3g} cells of {size:g} are too many (at most {MOST_CELLS:.0g}): points "
            f"lie from {west:.10g}, {south:.10g} to {east:.10g}, {north:.10g}; clouds far apart need a raster each; if "
            "a coordinate is damaged, give --bbox; or give a larger --size"
        )
    if options.bbox is not None:  # its cells end at a border, where no other cell begins
        first = round(west / size), round(south / size)
        last = max(round(east / size) - 1, first[0]), max(round(north / size) - 1, first[1])
        return Grid(size, *first, last[1] - first[1] + 1, last[0] - first[0] + 1)
    return Grid.cover(box, size)


def _describe(facts: ColumnFacts, statistic: str, length: str) -> Band:
    unit = {"count": "", "density": f"1/{length}2"}.get(statistic, facts.unit.strip("-"))
    return Band(f"{statistic} of {facts.name}", unit)
