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
from wavebatch.core.even_sample import EvenSample
from wavebatch.files.cloud.column_reader import ColumnFacts
from wavebatch.files.disk.buckets import Buckets, count_buckets
from wavebatch.files.las.crs_name import describe_crs
from wavebatch.tools.plots.values import Clouds, Selection, Tally, robust_limits

STATISTICS = ("mean", "median", "min", "max", "count", "density")
"""Statistics of a cell; `density` is points per square metre."""

MOST_CELLS = 4_000_000
"""Most cells of a grid; a picture cannot show more."""

LARGEST_SIZE = 1e9
"""Largest side of a cell [m]: more than the world; larger ones overflow."""

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

_BUCKET_POINTS = 2_000_000
_SIDE = 128
_PLACED = np.dtype([("cell", "<u4"), ("value", "<f8")])


@dataclass(frozen=True, slots=True)
class Grid:
    """Square cells of `size` metres, starting at the south-west corner (x, y)."""

    x: float
    y: float
    size: float
    rows: int
    columns: int

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """West, east, south, north [m]."""
        return self.x, self.x + self.columns * self.size, self.y, self.y + self.rows * self.size

    def place(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Cell number of each point, row by row from the south; -1 outside, i8 (n,)."""
        with np.errstate(over="ignore", invalid="ignore"):
            column, row = np.floor((x - self.x) / self.size), np.floor((y - self.y) / self.size)
            inside = (column >= 0) & (column < self.columns) & (row >= 0) & (row < self.rows)
        cell = np.full(len(x), -1, np.int64)
        cell[inside] = row[inside].astype(np.int64) * self.columns + column[inside].astype(np.int64)
        return cell


@dataclass(frozen=True, slots=True, eq=False)
class Raster:
    """A map."""

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
    crs: str = ""
    """Name of the CRS of the clouds; empty if they give none."""
    unit: str = "m"
    """Unit of x and y."""

    @property
    def label(self) -> str:
        """Label of the colour scale, with the unit."""
        if self.statistic == "count":
            return "points per cell [-]"
        if self.statistic == "density":
            return f"points per area [1/{self.unit}2]"
        return f"{self.statistic} of {self.facts.label}"


def grid_values(
    paths: Sequence[Path],
    selection: Selection,
    statistic: str = "mean",
    *,
    size: float | None = None,
    bounds: tuple[float, float, float, float] | None = None,
) -> Raster:
    """The map of a column of clouds; medians of large clouds need room in TMPDIR.

    size: side of a cell [m], by default for about POINTS_PER_CELL points per cell. bounds: west, south, east, north
    [m], by default all points but far outliers.
    Raises InputError if there is nothing to draw, ConfigError for wrong options, more than MOST_CELLS cells, and clouds
    that are far apart or differ in their CRS.
    """
    _check(statistic, size, bounds)
    clouds = Clouds(paths, selection)
    if clouds.facts.is_flags and statistic in ("mean", "median", "min", "max"):
        raise ConfigError(
            f"{paths[0]}: {clouds.facts.name} are bits, which have no {statistic}; count the points with a flag: "
            "--statistic count --flags NAME"
        )
    crs, unit = check_crs(paths)
    total, sample, box = _survey(clouds, bounds)
    if not total.values:
        raise clouds.complain(total)
    if not sample.seen:
        where = "within the bounds" if bounds else "with finite coordinates"
        raise InputError(f"{paths[0]}: nothing to draw: no point {where} has a value")
    grid = _choose_grid(str(paths[0]), sample, box, size, fixed=bounds is not None)
    values, placed = _Cells(grid, statistic, total.values).fill(clouds)
    known = values[np.isfinite(values)]
    shown = tuple(np.percentile(known, SHOWN).tolist()) if len(known) else (0.0, 1.0)
    return Raster(clouds.facts, statistic, grid, values, total, total.values - placed, shown, crs, unit)


def _check(statistic: str, size: float | None, bounds: tuple[float, float, float, float] | None) -> None:
    if statistic not in STATISTICS:
        raise ConfigError(f"statistic {statistic!r} is not one of {', '.join(STATISTICS)}")
    if size is not None and not (LEAST_SIZE <= size <= LARGEST_SIZE):
        raise ConfigError(f"cells must be at least {LEAST_SIZE:g} and at most {LARGEST_SIZE:g} m long, got {size:g}")
    if bounds is not None:
        west, south, east, north = bounds
        if not (math.isfinite(east - west) and math.isfinite(north - south) and west < east and south < north):
            raise ConfigError("bounds must be WEST,SOUTH,EAST,NORTH in metres, west of east and south of north")


def _survey(
    clouds: Clouds, bounds: tuple[float, float, float, float] | None
) -> tuple[Tally, EvenSample, tuple[float, float, float, float]]:
    """Counts of the points, an even sample of positions (n, 2), and the box of all positions."""
    total, sample = Tally(), EvenSample()
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    each = [EvenSample() for _ in clouds.paths]
    for cloud, rows, tally in clouds.read():
        total += tally
        places = np.stack([rows["x"], rows["y"]], axis=1)
        keep = np.isfinite(places).all(axis=1)
        if bounds is not None:
            keep &= (places >= bounds[:2]).all(axis=1) & (places <= bounds[2:]).all(axis=1)
        places = places[keep]
        if len(places):
            sample.add({"place": places})
            if len(clouds.paths) > 1 and bounds is None:
                each[cloud].add({"place": places})
            low, high = np.minimum(low, places.min(axis=0)), np.maximum(high, places.max(axis=0))
    _refuse_far(clouds.paths, [one.read().get("place", np.empty((0, 2))) for one in each])
    return total, sample, bounds or (*low.tolist(), *high.tolist())


def _refuse_far(paths: Sequence[Path], places: Sequence[np.ndarray]) -> None:
    """Raises ConfigError for clouds so far apart that a map would show them as dots."""
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
            f"largest cloud is {reach / FAR:.4g} long: a map of both would show neither; draw them one by one, or give "
            "--bbox"
        )


def check_crs(paths: Sequence[Path]) -> tuple[str, str]:
    """The CRS and the unit of x and y that all clouds have; ConfigError where they differ.

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


def _choose_grid(
    where: str, sample: EvenSample, box: tuple[float, float, float, float], size: float | None, *, fixed: bool
) -> Grid:
    places = sample.read()["place"]
    west, south, east, north = box
    if not fixed:
        west, east = robust_limits(places[:, 0], west, east)
        south, north = robust_limits(places[:, 1], south, north)
    extent = max(east - west, north - south)
    if not extent <= LARGEST_EXTENT:
        raise InputError(f"{where}: points lie {extent:g} m apart, which must be damage; give --bbox to draw a part")
    if size is None:
        size = _choose_size(places, sample.seen, (west, south), extent)
    # Cell borders are multiples of the size, so that maps of neighbouring tiles fit together.
    x, y = (math.floor(start / size) * size for start in (west, south))
    x, y = x - size * (x > west), y - size * (y > south)
    columns, rows = (math.floor((end - start) / size) + 1 for end, start in ((east, x), (north, y)))
    if columns * rows > MOST_CELLS:
        least = _nice(math.sqrt((east - west) * (north - south) / MOST_CELLS) + 4 * extent / MOST_CELLS)
        raise ConfigError(
            f"{where}: {columns} x {rows} cells of {size:g} m are too many to draw; cells of {least:g} m will do"
        )
    return Grid(x, y, size, rows, columns)


def _choose_size(places: np.ndarray, seen: int, corner: tuple[float, float], extent: float) -> float:
    """Side of a cell [m], from the area that holds points: the filled cells of a coarse grid."""
    if not extent:
        return 1.0
    side = extent / _SIDE
    coarse = np.floor((places - corner) / side)
    inside = coarse[((coarse >= -1) & (coarse <= _SIDE + 1)).all(axis=1)].astype(np.int64)
    filled = len(np.unique(inside[:, 0] * 4 * _SIDE + inside[:, 1]))
    area = filled * side**2
    return _nice(max(math.sqrt(POINTS_PER_CELL * area / seen), extent / CHOSEN_SIDE))


def _nice(size: float) -> float:
    """The next of 1, 2, 5, 10 ... times a power of ten."""
    power = 10.0 ** math.floor(math.log10(size))
    return next(float(f"{factor * power:.3g}") for factor in (1, 2, 5, 10) if factor * power >= size * (1 - 1e-9))


_COMBINE = {"mean": (np.add, 0.0), "min": (np.minimum, np.inf), "max": (np.maximum, -np.inf)}
"""Statistics that are combined value by value: how, and from which start."""


class _Cells:
    """Collects the statistic of all cells, piece by piece; points go to disk for medians only."""

    def __init__(self, grid: Grid, statistic: str, points: int) -> None:
        self._grid, self._statistic = grid, statistic
        self._count = np.zeros(grid.rows * grid.columns, np.int64)
        self._combine, start = _COMBINE.get(statistic, (None, 0.0))
        self._value = np.full(len(self._count), start)
        self._number = count_buckets(points, _BUCKET_POINTS) if statistic == "median" else 0
        self._buckets = Buckets(_PLACED, max(self._number, 1))

    def fill(self, clouds: Clouds) -> tuple[np.ndarray, int]:
        """Values (rows, columns), and the number of points in the grid."""
        with self._buckets:
            for _, rows, _ in clouds.read():
                cell = self._grid.place(rows["x"], rows["y"])
                inside = np.flatnonzero(cell >= 0)
                self._add(cell[inside], rows["value"][inside])
            return self._finish().reshape(self._grid.rows, self._grid.columns), int(self._count.sum())

    def _add(self, cell: np.ndarray, value: np.ndarray) -> None:
        np.add.at(self._count, cell, 1)
        if self._combine is not None:
            with np.errstate(over="ignore"):
                self._combine.at(self._value, cell, value)
        elif self._statistic == "median":
            placed = np.empty(len(cell), _PLACED)
            placed["cell"], placed["value"] = cell, value
            self._buckets.add(placed, lambda rows: (np.arange(len(rows)), rows["cell"] % self._number))

    def _finish(self) -> np.ndarray:
        filled = self._count > 0
        if self._statistic == "median":
            for number in range(self._number):
                self._take_medians(self._buckets.read(number))
        elif self._statistic == "mean":
            self._value[filled] /= self._count[filled]
        elif self._statistic in ("count", "density"):
            self._value = self._count / (1.0 if self._statistic == "count" else self._grid.size**2)
        return np.where(filled, self._value, np.nan)

    def _take_medians(self, placed: np.ndarray) -> None:
        """Medians of the cells of a bucket; of an even number of values the mean of the middle two."""
        # Complex numbers sort by real, then by imaginary part: one fast sort by cell and value.
        pairs = np.empty(len(placed), np.complex128)
        pairs.real, pairs.imag = placed["cell"], placed["value"]
        pairs.sort()
        cell, value = pairs.real.astype(np.int64), pairs.imag
        first = np.flatnonzero(np.r_[True, np.diff(cell) != 0]) if len(cell) else np.empty(0, np.int64)
        count = np.diff(np.append(first, len(cell)))
        low, high = value[first + (count - 1) // 2], value[first + count // 2]
        self._value[cell[first]] = low + 0.5 * (high - low)
