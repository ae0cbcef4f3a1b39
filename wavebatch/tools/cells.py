"""Square cells over x and y, and statistics of the values in them: for rasters, maps and the pages.

`write_grid` writes the tiles of `compute_tiles` as a GeoTIFF, `grid_values` makes a map of them for `wavebatch plot
map`: in memory that grows neither with the clouds nor with the grid. No result depends on how the points come in
pieces. Points go to buckets on disk by tile; one bucket after the other is read and its tiles are computed.

`Clouds` reads columns of clouds of any size, piece by piece: chosen points, counts, samples and robust limits, also for
the pictures in tools/plots.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.frozen import frozen
from wavebatch.core.order import EvenSample
from wavebatch.files.cloud.cloud_reader import ColumnFacts, ColumnReader
from wavebatch.files.cloud.column_names import read_provenance
from wavebatch.files.cloud.point_filter import EVERY, PointFilter, check_bbox, read_bbox
from wavebatch.files.disk.raw_bytes import undoing
from wavebatch.files.disk.temp_store import Spool
from wavebatch.files.geotiff_file import TILE
from wavebatch.files.las.crs import CrsWords, describe_crs
from wavebatch.files.las.header import read_header
from wavebatch.files.las.read_points import read_checked_header

OUTER = (0.1, 99.9)
"""Percentiles that a picture must show; values far outside are damage or very rare."""

HISTOGRAM_ENDS = (5.0, 95.0)
"""Percentiles of most values: histograms show 1.5 times their distance on both sides, which cuts only long tails."""

EXTRA_EXTENT = 0.25
"""Also shown on both sides of these percentiles, as a share of the distance between them."""


@dataclass(slots=True)
class Tally:
    """Counts of the points of a cloud."""

    points: int = 0
    left_out: int = 0
    """Points that were left out because of their flags or by --where."""
    no_data: int = 0
    """Points without a value in the column."""
    values: int = 0
    """Points with a value."""

    def list_rest(self, outside: int, where: str = "outside") -> list[str]:
        """Points that a picture does not show, with the reason, for its title."""
        rest = {"without data": self.no_data, "left out": self.left_out, where: outside}
        return [f"{number:,} {text}" for text, number in rest.items() if number]

    def __add__(self, other: Tally) -> Tally:
        return Tally(*(getattr(self, name) + getattr(other, name) for name in self.__slots__))


def name_paths(paths: Sequence[Path]) -> tuple[str, ...]:
    """Names of files for legends and titles, with their folders where names are equal."""
    names = [path.name for path in paths]
    return tuple(str(path) if names.count(path.name) > 1 else path.name for path in paths)


@frozen(eq=False)
class CloudData:
    """What a picture shows of a column of clouds: the base of histograms, maps, sections and profiles."""

    facts: ColumnFacts
    names: tuple[str, ...]
    """Of the clouds, or of the series where there are several."""
    total: Tally
    """Counts of all points of the clouds."""


class Clouds:
    """Several clouds that are read as one, as often as needed; only one is open at a time.

    columns: read of each point; of the first one, None counts points. selection: the points that are used.
    Raises InputError if a cloud cannot be read, ConfigError if it lacks the column or the flags or units differ.
    """

    def __init__(self, paths: Sequence[Path], columns: Sequence[str | None], selection: PointFilter = EVERY) -> None:
        self.paths, self._columns, self.selection = tuple(paths), tuple(columns), selection
        found: list[Sequence[ColumnFacts]] = []
        for path in self.paths:
            with self._open(path) as reader:
                found.append(reader.facts)
        every, words = [], [describe_crs(path) for path in self.paths]
        for column in zip(*found, strict=True):
            if column[0].is_standard and column[0].name in ("x", "y", "z"):  # a coordinate has the unit of the CRS
                units = [each.upright_unit if column[0].name == "z" else each.unit for each in words]
                column = [replace(facts, unit=unit) for facts, unit in zip(column, units, strict=True)]
            first = column[0]
            for path, facts in zip(self.paths, column, strict=True):
                if (facts.unit, facts.is_flags) != (first.unit, first.is_flags):
                    raise ConfigError(
                        f"{path}: {facts.name} is in [{facts.unit}], {first.name} of {self.paths[0]} in "
                        f"[{first.unit}]; plot them one by one"
                    )
            # The shortest name: one cloud may have `wb_amplitude` beside an `amplitude` of its strip.
            every.append(replace(first, name=min((one.name for one in column), key=len)))
        self.every = tuple(every)
        """Facts of the columns."""
        self.facts = self.every[0]

    def _open(self, path: Path) -> ColumnReader:
        """A reader that gives the chosen points."""
        reader = ColumnReader(path, *self._columns)
        with undoing(reader.close):
            reader.select(self.selection)
        return reader

    def read(self) -> Iterator[tuple[int, np.ndarray, Tally]]:
        """Pieces of all clouds: number of the cloud, selected points with a value, and counts of the piece."""
        for number, rows, left in self.read_all():
            good = rows[~np.isnan(rows["values"][:, 0])]
            yield number, good, Tally(len(rows) + left, left, len(rows) - len(good), len(good))

    def read_all(self) -> Iterator[tuple[int, np.ndarray, int]]:
        """Pieces of all clouds: number of the cloud, selected points, and how many were left out."""
        for number, path in enumerate(self.paths):
            with self._open(path) as reader:
                seen = 0
                for rows in reader.read_pieces():
                    left, seen = reader.left_out - seen, reader.left_out
                    yield number, rows, left

    def complain(self, tally: Tally) -> InputError:
        """The error that says why nothing can be drawn."""
        where = f"{self.paths[0]}" if len(self.paths) == 1 else f"{self.paths[0]} and {len(self.paths) - 1} more"
        if not tally.points:
            return InputError(f"{where}: holds no points: nothing to draw")
        reasons = []
        if tally.left_out:
            by = "by --where" if self.selection.where is not None else "by their flags"
            reasons.append(f"{tally.left_out} of {tally.points} points are left out {by}")
        if tally.no_data:
            reasons.append(f"{tally.no_data} have no data in {self.facts.name}")
        return InputError(f"{where}: nothing to draw: {' and '.join(reasons)}")


def doubt_clouds(paths: Sequence[Path], columns: Sequence[str] = ()) -> Iterator[str]:
    """Yield a line for each cloud that seems to hold points that are not read, and for columns that do not compare.

    Columns in counts do not, where the strips of the clouds have other bits or spacing.
    """
    paths = [path for path in paths if path.suffix.lower() in (".las", ".laz")]
    for path in paths:
        yield from (f"{path}: {line}" for line in read_checked_header(path, waveforms=False).unread)
    named_by = Clouds(paths, columns).every if columns and paths else ()
    counts = [facts.name for facts in named_by if "DN" in facts.unit.split()]
    ways: dict[str, Path] = {}
    for path in paths if counts else ():
        for run in read_provenance(read_header(path))[-1:]:
            survey = run.get("survey")
            figures = survey.get("figures") if isinstance(survey, dict) else None
            way = [figures.get(key) for key in ("bits", "spacing_ns")] if isinstance(figures, dict) else [None]
            if all(isinstance(value, int | float) for value in way):
                ways.setdefault("{:g} bits, {:g} ns apart".format(*way), path)
    named = " and ".join(f"{path} ({way})" for way, path in [*ways.items()][:2])
    if len(ways) > 1:
        yield f"{', '.join(counts)}: counts of {named} do not compare; take a calibrated column"


def sample_points(
    clouds: Clouds, pick: Callable[[int, np.ndarray], np.ndarray], limit: int | None = None
) -> tuple[Tally, EvenSample, np.ndarray]:
    """Counts of all points, an even sample of what is picked of them, and its least and largest values.

    clouds: also a file of voxels, which has the same methods. pick: gives an array (k, m) from the number of a cloud
    and a piece of it; that is column `place` of the sample. The least and largest values are f8 (2, m), infinite if
    nothing is picked. Raises InputError without any value.
    """
    total, sample, box = Tally(), EvenSample(limit), np.array([[math.inf], [-math.inf]])
    for number, rows, tally in clouds.read():
        total += tally
        place = pick(number, rows)
        if len(place):
            sample.add({"place": place})
            box = np.stack([np.minimum(box[0], place.min(axis=0)), np.maximum(box[1], place.max(axis=0))])
    if not total.values:
        raise clouds.complain(total)
    return total, sample, box


def round_up(size: float) -> float:
    """The next of 1, 2, 5, 10 ... times a power of ten."""
    power = 10.0 ** math.floor(math.log10(size))
    return next(float(f"{factor * power:.3g}") for factor in (1, 2, 5, 10) if factor * power >= size * (1 - 1e-9))


def check_statistic(
    column: str | None, statistic: str, facts: ColumnFacts | None = None, path: Path | None = None
) -> None:
    """Raises ConfigError where a statistic of a cell or a bin needs a column, or its column, in a file, holds bits."""
    if statistic in ("count", "density"):
        return
    if column is None:
        raise ConfigError(f"--statistic {statistic} needs a --column; --statistic count needs none")
    if facts is not None and facts.is_flags:
        raise ConfigError(f"{path}: {facts.name} are bits, which have no {statistic}; count the points with a flag: "
                          "--statistic count --flags NAME")  # fmt: skip


def shown_limits(samples: Sequence[np.ndarray], least: float, largest: float) -> tuple[float, float]:
    """Limits that show the percentiles HISTOGRAM_ENDS of every sample, and 1.5 times their distance on both sides.

    Rare far values would compress the rest. Samples of one value only are shown from `least` to `largest`.
    """
    ends = []
    for sample in filter(len, samples):
        low, high = np.percentile(sample, HISTOGRAM_ENDS)
        near = sample[np.abs(sample - 0.5 * (low + high)) <= 2.0 * (high - low)]
        ends += [float(near.min()), float(near.max())] if len(near) else []
    return (min(ends), max(ends)) if ends and min(ends) < max(ends) else (least, largest)


def robust_limits(sample: np.ndarray, least: float, largest: float) -> tuple[float, float]:
    """Limits of a picture of values from `least` to `largest`, without far outliers that would compress the rest."""
    low, high = np.percentile(sample, OUTER)
    margin = EXTRA_EXTENT * (high - low)
    if not margin:
        return least, largest
    return max(least, float(low - margin)), min(largest, float(high + margin))


Box = tuple[float, float, float, float]
"""West, south, east, north."""

LARGEST_SIZE = 1e9
"""Largest side of a cell: more than the world; larger ones overflow."""

@frozen
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


def check_bounds(bounds: Box | None, paths: Sequence[Path]) -> None:
    """Raises ConfigError for bounds of clouds that hold no place, or in another order."""
    if bounds is not None:
        read_bbox(bounds)
        for path in paths:
            check_bbox(bounds, path, read_header(path))


def compute_cells(statistic: str, cell: np.ndarray, values: np.ndarray, number: int, area: float) -> np.ndarray:
    """The statistic of values f8 (n,) by cell i8 (n,), f8 (number,); NaN in cells without a value.

    statistic: mean, median, min, max, count; std: standard deviation with n - 1, NaN for one value; density: values per
    area. area: of a cell.
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
    ordered = values[np.lexsort((values, cell))]
    place = np.flatnonzero(count)
    first = (np.cumsum(count) - count)[place]
    low, high = (ordered[first + rank] for rank in _RANKS[statistic](count[place]))
    filled[place] = low + 0.5 * (high - low)
    return filled


_RANKS: dict[str, Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]] = {
    "median": lambda count: ((count - 1) // 2, count // 2),
    "min": lambda count: (np.zeros_like(count), np.zeros_like(count)),
    "max": lambda count: (count - 1, count - 1),
}
"""Ranks of the two values whose mean is the statistic, from the counts of cells."""


POINTS_IN_MEMORY = 2_000_000
"""Points in memory at a time."""

MOST_BUCKETS = 4096
"""With POINTS_IN_MEMORY / 2 points each they hold 4e9 points."""


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
"""A name, as for `compute_cells`; or a function from the cell of each point i8 (n,), the values of all columns f8
(n, k) and the number of cells to bands f8 (m, cells)."""


def compute_tiles(
    clouds: Clouds, statistic: Statistic, grid: Grid, points: int, result: Placed, bounds: Box | None = None,
    *, in_memory: int = POINTS_IN_MEMORY,
) -> Iterator[tuple[int, int, np.ndarray]]:
    """Row from the north, column and values f8 (bands, TILE, TILE) of every tile with a point; NaN without a value.

    There is a band for each column of the clouds, or those that the statistic computes. points: of all clouds, about.
    result: gets the counts before the first tile comes. bounds: only points within them count. in_memory: points at a
    time.
    """
    number, across = int(np.clip(-(-points // (in_memory // 2)), 1, MOST_BUCKETS)), -(-grid.columns // TILE)
    entries = Spool(number, np.dtype([("tile", "<u8"), ("cell", "<u4"), ("values", "<f8", (len(clouds.every),))]))
    try:
        # Every point with a value goes into the bucket of its tile.
        counted = np.zeros(len(clouds.every), np.int64)
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
            found["tile"] = row // TILE * across + column // TILE
            found["cell"] = row % TILE * TILE + column % TILE
            found["values"] = rows["values"]
            entries.append((found["tile"] % np.uint64(entries.buckets)).astype(np.int64), found)
        result.values = tuple(counted.tolist())
        entries.seal()
        compute = partial(_compute, statistic=statistic, area=grid.size**2)
        for bucket in range(number):
            for tile, values in _compute_bucket(entries, bucket, compute, in_memory):
                yield *divmod(tile, across), values
    finally:
        entries.close()


def is_in_bounds(rows: np.ndarray, bounds: Box | None) -> np.ndarray:
    """Points with a position within the bounds, bool (n,)."""
    inside = np.isfinite(rows["x"]) & np.isfinite(rows["y"])
    if bounds is not None:
        west, south, east, north = bounds
        inside &= (rows["x"] >= west) & (rows["x"] < east) & (rows["y"] >= south) & (rows["y"] < north)
    return inside


def _compute_bucket(
    entries: Spool, bucket: int, compute: Callable[[np.ndarray], np.ndarray], in_memory: int
) -> Iterator[tuple[int, np.ndarray]]:
    """Number and values (bands, TILE, TILE) of every tile of a bucket."""
    total = sum(len(piece) for piece in entries.pieces(bucket))
    if total <= in_memory:
        rows = entries.read(bucket)
        rows = rows[np.argsort(rows["tile"], kind="stable")]
        tiles, first = np.unique(rows["tile"], return_index=True)
        for tile, part in zip(tiles.tolist(), np.split(rows, first)[1:], strict=True):
            yield tile, compute(part)
        return
    # It does not fit in memory: groups of cells of a tile, each of about `in_memory` points, one by one.
    for tile in np.unique(np.concatenate([np.unique(piece["tile"]) for piece in entries.pieces(bucket)])).tolist():
        count = np.zeros(TILE * TILE, np.int64)
        for piece in entries.pieces(bucket):
            count += np.bincount(piece["cell"][piece["tile"] == tile], minlength=len(count))
        group = np.cumsum(count) // in_memory
        values = np.full((TILE, TILE), np.nan)
        for number in np.unique(group[count > 0]).tolist():
            wanted = group == number
            parts = [piece[(piece["tile"] == tile) & wanted[piece["cell"]]] for piece in entries.pieces(bucket)]
            values = np.fmax(values, compute(np.concatenate(parts)))  # NaN in the other cells
        yield tile, values


def _compute(rows: np.ndarray, statistic: Statistic, area: float) -> np.ndarray:
    cell = rows["cell"].astype(np.int64)
    if not isinstance(statistic, str):
        return statistic(cell, rows["values"], TILE * TILE).reshape(-1, TILE, TILE)
    bands = [compute_cells(statistic, cell, values, TILE * TILE, area) for values in rows["values"].T]
    return np.stack(bands).reshape(-1, TILE, TILE)


MOST_CELLS = 4_000_000
"""Most cells of a grid; a picture cannot show more."""

LEAST_SIZE = 1e-6
"""Least side of a cell [m]: smaller than any scale of LAS coordinates in use."""

LARGEST_EXTENT = 1e12
"""Largest extent of coordinates [m]; larger ones are damage."""

CHOSEN_SIDE = 1500
"""Most cells along a side if the size of cells is not given: about the pixels of a picture."""

FAR_APART = 20.0
"""Clouds may lie so many times the length of the longest one apart in one map: about three pixels per cloud remain."""

POINTS_PER_CELL = 6
"""Mean number of points in a filled cell if the size of cells is not given."""

SCALE_ENDS = (2.0, 98.0)
"""Percentiles of the cells at the ends of the colour scale."""

_SIDE = 128


@frozen(eq=False)
class Raster(CloudData):
    """A map."""

    statistic: str
    grid: Grid
    values: np.ndarray
    """f8 (rows, columns), the first row is the southernmost; NaN without a point."""
    outside: int
    """Points with a value outside the grid."""
    shown: tuple[float, float]
    """The percentiles SCALE_ENDS of the cells."""
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
    selection: PointFilter = EVERY,
    *,
    size: float | None = None,
    bounds: Box | None = None,
    in_memory: int = POINTS_IN_MEMORY,
) -> Raster:
    """The map of a column of clouds; medians of large clouds need room in TMPDIR.

    size: side of a cell [m], by default for about POINTS_PER_CELL points per cell. bounds: west, south, east, north
    [m], by default all points but far outliers. in_memory: points at a time.
    Raises InputError if there is nothing to draw, ConfigError for wrong options, more than MOST_CELLS cells, and clouds
    that are far apart or differ in their CRS.
    """
    if size is not None and not (LEAST_SIZE <= size <= LARGEST_SIZE):
        raise ConfigError(f"cells must be at least {LEAST_SIZE:g} and at most {LARGEST_SIZE:g} m long, got {size:g}")
    check_bounds(bounds, paths)
    clouds = Clouds(paths, (column,), selection)
    check_statistic(column, statistic, clouds.facts, paths[0])
    crs = check_crs(paths)
    total, sample, box = survey_places(clouds, bounds)
    if not sample.seen:
        where = "within the bounds" if bounds else "with finite coordinates"
        raise InputError(f"{paths[0]}: nothing to draw: no point {where} has a value")
    grid = choose_grid(str(paths[0]), sample, box, size, fixed=bounds is not None)
    values, placed = np.full((grid.rows, grid.columns), np.nan), Placed()
    for row, column, tile in compute_tiles(clouds, statistic, grid, total.values, placed, in_memory=in_memory):
        part = values[row * TILE : (row + 1) * TILE, column * TILE : (column + 1) * TILE]
        part[:] = tile[0, : part.shape[0], : part.shape[1]]
    values = values[::-1]  # the first row is the southernmost
    names = tuple(path.name for path in paths)
    outside = total.values - placed.values[0]
    return Raster(clouds.facts, names, total, statistic, grid, values, outside, find_shown(values), crs)


def find_shown(values: np.ndarray) -> tuple[float, float]:
    """Values at the ends of the colour scale: the percentiles SCALE_ENDS of the cells."""
    known = values[np.isfinite(values)]
    low, high = np.percentile(known, SCALE_ENDS).tolist() if len(known) else (0.0, 1.0)
    return low, high


def survey_places(clouds: Clouds, bounds: Box | None = None, option: str = "--bbox") -> tuple[Tally, EvenSample, Box]:
    """Counts of the points, an even sample of positions (n, 2), and the box of all positions.

    Raises ConfigError for clouds that lie far apart, where `option` does not choose a part.
    """
    each = [EvenSample() for _ in clouds.paths]

    def pick(cloud: int, rows: np.ndarray) -> np.ndarray:
        places = np.stack([rows["x"], rows["y"]], axis=1)
        places = places[np.isfinite(places).all(axis=1)]
        if bounds is not None:
            return places[(places >= bounds[:2]).all(axis=1) & (places <= bounds[2:]).all(axis=1)]
        if len(clouds.paths) > 1:
            each[cloud].add({"place": places})
        return places

    total, sample, box = sample_points(clouds, pick)
    # Clouds so far apart that a picture would show them as dots.
    places = [one.read().get("place", np.empty((0, 2))) for one in each]
    known = [number for number, place in enumerate(places) if len(place)]
    # Percentiles, so that a single damaged point moves no cloud.
    boxes = {number: np.percentile(places[number], (1, 99), axis=0) for number in known}
    reach = FAR_APART * max((float(np.hypot(*(box[1] - box[0]))) for box in boxes.values()), default=0.0)
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
            f"{clouds.paths[away[0]]}: lies {float(np.hypot(*(middle[1] - middle[0]))):.6g} from "
            f"{clouds.paths[known[0]]}, and the largest cloud is {reach / FAR_APART:.4g} long: a picture of both would "
            f"show neither; draw them one by one, or give {option}"
        )
    return total, sample, bounds or tuple(box.ravel().tolist())


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
    if size is None and not extent:
        size = 1.0
    elif size is None:  # from the area that holds points: the filled cells of a coarse grid
        side = extent / _SIDE
        coarse = np.floor((places - (west, south)) / side)
        inside = coarse[((coarse >= -1) & (coarse <= _SIDE + 1)).all(axis=1)].astype(np.int64)
        area = len(np.unique(inside[:, 0] * 4 * _SIDE + inside[:, 1])) * side**2
        size = round_up(max(math.sqrt(POINTS_PER_CELL * area / sample.seen), extent / most))
    grid = Grid.cover((west, south, east, north), size)
    if grid.columns * grid.rows > MOST_CELLS:
        least = round_up(math.sqrt((east - west) * (north - south) / MOST_CELLS) + 4 * extent / MOST_CELLS)
        raise ConfigError(
            f"{where}: {grid.columns} x {grid.rows} cells of {size:g} m are too many to draw; cells of {least:g} m "
            "will do"
        )
    return grid
