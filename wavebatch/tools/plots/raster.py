"""Maps: a statistic of a column in the cells of a grid over x and y, for clouds of any size.

`wavebatch plot map` calls `grid_values` and draws the result with `draw_cloud`. Clouds are read twice: for the grid,
then for the cells. No result depends on how the points come in pieces.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wavebatch.core.errors import ConfigError, InputError
from wavebatch.files.cloud.cloud_reader import ColumnFacts
from wavebatch.files.cloud.point_filter import EVERY, PointFilter
from wavebatch.files.geotiff_file import TILE
from wavebatch.files.las.crs import CrsWords, describe_crs
from wavebatch.tools.even_sample import EvenSample
from wavebatch.tools.plots.values import (
    Clouds,
    Tally,
    check_statistic,
    find_positions,
    robust_limits,
    round_up,
    sample_points,
)
from wavebatch.tools.rasters.cells import LARGEST_SIZE, Box, Grid, Placed, check_cells, compute_tiles

MOST_CELLS = 4_000_000
"""Most cells of a grid; a picture cannot show more."""

LEAST_SIZE = 1e-6
"""Least side of a cell [m]: smaller than any scale of LAS coordinates in use."""

LARGEST_EXTENT = 1e12
"""Largest extent of coordinates [m]; larger ones are damage."""

CHOSEN_SIDE = 1500
"""Most cells along a side if the size of cells is not given: about the pixels of a picture."""

FAR = 20.0
"""Clouds may lie so many times the length of the longest one apart in one map: about three pixels per cloud remain."""

POINTS_PER_CELL = 6
"""Mean number of points in a filled cell if the size of cells is not given."""

SHOWN = (2.0, 98.0)
"""Percentiles of the cells at the ends of the colour scale."""

_SIDE = 128


@dataclass(frozen=True, slots=True, eq=False)
class Raster:
    """A map."""

    names: tuple[str, ...]
    """Of the clouds."""
    facts: ColumnFacts
    statistic: str
    grid: Grid
    values: np.ndarray
    """f8 (rows, columns), the first row is the southernmost; NaN without a point."""
    total: Tally
    outside: int
    """Points with a value outside the grid."""
    shown: tuple[float, float]
    """The percentiles SHOWN of the cells."""
    crs: CrsWords = CrsWords()
    """Of the clouds."""

    @property
    def label(self) -> str:
        """Label of the colour scale, with the unit."""
        if self.statistic == "count":
            return "points per cell [-]"
        if self.statistic == "density":
            return f"points per area [1/{self.crs.unit}2]"
        return f"{self.statistic} of {self.facts.label}"


def grid_values(
    paths: Sequence[Path],
    column: str | None,
    statistic: str = "mean",
    chosen: PointFilter = EVERY,
    *,
    size: float | None = None,
    bounds: Box | None = None,
) -> Raster:
    """The map of a column of clouds; medians of large clouds need room in TMPDIR.

    size: side of a cell [m], by default for about POINTS_PER_CELL points per cell. bounds: west, south, east, north
    [m], by default all points but far outliers.
    Raises InputError if there is nothing to draw, ConfigError for wrong options, more than MOST_CELLS cells, and clouds
    that are far apart or differ in their CRS.
    """
    if size is not None and not (LEAST_SIZE <= size <= LARGEST_SIZE):
        raise ConfigError(f"cells must be at least {LEAST_SIZE:g} and at most {LARGEST_SIZE:g} m long, got {size:g}")
    check_cells(statistic, bounds)
    check_statistic(column, statistic)
    clouds = Clouds(paths, (column,), chosen)
    check_statistic(column, statistic, clouds.facts, paths[0])
    crs = check_crs(paths)
    total, sample, box = survey_places(clouds, bounds)
    if not sample.seen:
        where = "within the bounds" if bounds else "with finite coordinates"
        raise InputError(f"{paths[0]}: nothing to draw: no point {where} has a value")
    grid = choose_grid(str(paths[0]), sample, box, size, fixed=bounds is not None)
    values, placed = _fill(clouds, statistic, grid, total.values)
    names = tuple(path.name for path in paths)
    return Raster(names, clouds.facts, statistic, grid, values, total, total.values - placed, find_shown(values), crs)


def find_shown(values: np.ndarray) -> tuple[float, float]:
    """Values at the ends of the colour scale: the percentiles SHOWN of the cells."""
    known = values[np.isfinite(values)]
    low, high = np.percentile(known, SHOWN).tolist() if len(known) else (0.0, 1.0)
    return low, high


def _fill(clouds: Clouds, statistic: str, grid: Grid, points: int) -> tuple[np.ndarray, int]:
    """Values (rows, columns), the first row is the southernmost, and the number of values in the grid."""
    values, placed = np.full((grid.rows, grid.columns), np.nan), Placed()
    for row, column, tile in compute_tiles(clouds, statistic, grid, points, placed):
        part = values[row * TILE : (row + 1) * TILE, column * TILE : (column + 1) * TILE]
        part[:] = tile[0, : part.shape[0], : part.shape[1]]
    return values[::-1], placed.values[0]


def survey_places(clouds: Clouds, bounds: Box | None = None, option: str = "--bbox") -> tuple[Tally, EvenSample, Box]:
    """Counts of the points, an even sample of positions (n, 2), and the box of all positions.

    Raises ConfigError for clouds that lie far apart, where `option` does not choose a part.
    """
    each = [EvenSample() for _ in clouds.paths]

    def pick(cloud: int, rows: np.ndarray) -> np.ndarray:
        places = find_positions(rows)
        if bounds is not None:
            return places[(places >= bounds[:2]).all(axis=1) & (places <= bounds[2:]).all(axis=1)]
        if len(clouds.paths) > 1:
            each[cloud].add({"place": places})
        return places

    total, sample, box = sample_points(clouds, pick)
    _refuse_far(clouds.paths, [one.read().get("place", np.empty((0, 2))) for one in each], option)
    return total, sample, bounds or tuple(box.ravel().tolist())


def _refuse_far(paths: Sequence[Path], places: Sequence[np.ndarray], option: str) -> None:
    """Raises ConfigError for clouds so far apart that a picture would show them as dots."""
    known = [number for number, place in enumerate(places) if len(place)]
    # Percentiles, so that a single damaged point moves no cloud.
    boxes = {number: np.percentile(places[number], (1, 99), axis=0) for number in known}
    reach = FAR * max((float(np.hypot(*(box[1] - box[0]))) for box in boxes.values()), default=0.0)
    near = known[:1]
    for number in near:
        for other in known:
            gap = np.maximum(boxes[number][0] - boxes[other][1], boxes[other][0] - boxes[number][1])
            if other not in near and float(np.hypot(*np.maximum(gap, 0.0))) <= max(reach, 1.0):
                near.append(other)
    away = [number for number in known if number not in near]
    if away:
        middle = [boxes[number].mean(axis=0) for number in (known[0], away[0])]
        raise ConfigError(
            f"{paths[away[0]]}: lies {float(np.hypot(*(middle[1] - middle[0]))):.6g} from {paths[known[0]]}, and the "
            f"largest cloud is {reach / FAR:.4g} long: a picture of both would show neither; draw them one by one, or "
            f"give {option}"
        )


def check_crs(paths: Sequence[Path]) -> CrsWords:
    """The CRS that all clouds have; ConfigError where they differ.

    A cloud without a CRS is taken to have that of the others.
    """
    found = {path: describe_crs(path) for path in paths}
    first = next((path for path in paths if found[path][0]), paths[0])
    for path in paths:
        if found[path][0] and found[path] != found[first]:
            raise ConfigError(
                f"{path}: its CRS is {found[path][0]}, that of {first} is {found[first][0]}; one map cannot show both"
            )
    return found[first]


def choose_grid(
    where: str, sample: EvenSample, box: Box, size: float | None, *, fixed: bool, most: int = CHOSEN_SIDE
) -> Grid:
    """Cells for points; `sample` has positions of some of them.

    size: None to choose it, for at most `most` cells along a side. fixed: the box is the user's.
    """
    places = sample.read()["place"]
    west, south, east, north = box
    if not fixed:
        west, east = robust_limits(places[:, 0], west, east)
        south, north = robust_limits(places[:, 1], south, north)
    extent = max(east - west, north - south)
    if not extent <= LARGEST_EXTENT:
        raise InputError(f"{where}: points lie {extent:g} m apart, which must be damage; give --bbox to draw a part")
    if size is None:
        size = _choose_size(places, sample.seen, (west, south), extent, most)
    grid = Grid.cover((west, south, east, north), size)
    if grid.columns * grid.rows > MOST_CELLS:
        least = round_up(math.sqrt((east - west) * (north - south) / MOST_CELLS) + 4 * extent / MOST_CELLS)
        raise ConfigError(
            f"{where}: {grid.columns} x {grid.rows} cells of {size:g} m are too many to draw; cells of {least:g} m "
            "will do"
        )
    return grid


def _choose_size(places: np.ndarray, seen: int, corner: tuple[float, float], extent: float, most: int) -> float:
    """Side of a cell [m], from the area that holds points: the filled cells of a coarse grid."""
    if not extent:
        return 1.0
    side = extent / _SIDE
    coarse = np.floor((places - corner) / side)
    inside = coarse[((coarse >= -1) & (coarse <= _SIDE + 1)).all(axis=1)].astype(np.int64)
    filled = len(np.unique(inside[:, 0] * 4 * _SIDE + inside[:, 1]))
    area = filled * side**2
    return round_up(max(math.sqrt(POINTS_PER_CELL * area / seen), extent / most))

