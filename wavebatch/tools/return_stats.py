"""Statistics of discrete returns: returns per pulse, distances between them, flags, areas, and the sensor's dead zone.

`wavebatch stats` and the examples call `count_returns`. The points of a pulse may lie anywhere in a cloud: rows go to
buckets on disk by pulse, so that memory is bounded. Whole clouds, cells of a grid and polygons are counted alike, by
one AreaTally per division and cloud. A sensor that looks for its second and its third return in another way has
another dead zone for each, so there is one per return number.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Annotated

import numpy as np

from wavebatch.core.echoes import PASSED_THROUGH, EchoFlag
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.frozen import NamedTuple, frozen
from wavebatch.core.schema import Key
from wavebatch.core.units import HALF_C
from wavebatch.files.cloud.cloud_reader import RETURN_DTYPE, CloudReader
from wavebatch.files.cloud.point_filter import EVERY, PointFilter
from wavebatch.files.disk.temp_store import BUCKET_ROWS, Spool, count_buckets, spread_keys, time_keys
from wavebatch.files.geojson import Polygon, describe_miss, find_inside
from wavebatch.files.las.header import read_header

MOST_AREAS = 50_000
"""Most areas of all clouds together, so that memory is bounded."""

MOST_RETURNS = 16
"""Most points per GPS time on average; with more, times are not those of pulses (LAS allows 15 returns)."""

MOST_NUMBER, MOST_COUNT = 15, 64
"""Largest return number of LAS; pulses with at least so many returns are counted as one class."""

_OUTSIDE = -1
_HALF = 1 << 30

_FARTHEST = 1e9
"""Larger coordinates are damaged: no CRS of the Earth has them."""


class Area(NamedTuple):
    """Kind, name and corner of an area."""

    kind: str
    """`cell`, `polygon`, or `outside`: in no polygon, or without a valid position."""
    name: str
    x: float = math.nan
    y: float = math.nan
    """Lower left corner of a cell; NaN for others."""


OUTSIDE = Area("outside", "outside")


class AreaGrid:
    """A division of the plane into square cells whose borders are multiples of `size`, in the unit of the coordinates.
    """

    def __init__(self, size: float) -> None:
        if not (np.isfinite(size) and size > 0):
            raise ConfigError(f"--area {size:g}: the side of a cell must be above 0")
        self.size = float(size)

    def find(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """The number of the area of each position (n,), i8; -1 outside of all areas.

        Raises ConfigError if the cells are too small to be numbered at these coordinates.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            known = (np.abs([x, y]) < _FARTHEST).all(axis=0)
            place = np.floor(np.stack([x, y]) / self.size)
        if (np.abs(place[:, known]) >= _HALF).any():
            raise ConfigError(f"--area {self.size:g}: the cells are too small for these coordinates; give a larger one")
        column, row = np.where(known, place, 0.0).astype(np.int64) + _HALF
        return np.where(known, (column << 31) | row, _OUTSIDE)

    def describe(self, number: int) -> Area:
        """The area with this number of `find`."""
        if number == _OUTSIDE:
            return OUTSIDE
        x, y = ((number >> 31) - _HALF) * self.size, ((number & ((1 << 31) - 1)) - _HALF) * self.size
        return Area("cell", f"{x:.10g} {y:.10g}", x, y)


class PolygonSet:
    """A division into polygons; where polygons overlap, a position belongs to the first one."""

    def __init__(self, polygons: Sequence[Polygon]) -> None:
        self.polygons = tuple(polygons)

    def find(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """As AreaGrid.find."""
        found = np.full(len(x), _OUTSIDE, np.int64)
        for number, polygon in enumerate(self.polygons):
            free = np.flatnonzero(found == _OUTSIDE)
            found[free[find_inside(polygon.rings, x[free], y[free])]] = number
        return found

    def describe(self, number: int) -> Area:
        """As AreaGrid.describe."""
        return OUTSIDE if number == _OUTSIDE else Area("polygon", self.polygons[number].name)

    def place(self, cloud: Path) -> tuple[PolygonSet, str]:
        """The polygons in the coordinates of a cloud, and a line where none lies there, else an empty one.

        Raises as `Polygon.place`.
        """
        header = read_header(cloud)
        placed = [polygon.place(cloud, header) for polygon in self.polygons]
        return PolygonSet(placed), describe_miss([ring for polygon in placed for ring in polygon.rings], header)


Division = AreaGrid | PolygonSet

AREA_RANKS = ("1-2", "2-3", "3-4", "4-")
"""Classes of pairs of consecutive returns per area and of dead zones.

They count by the number of the first return; the last class holds all higher numbers.
"""


@frozen
class Separation:
    """Distances between two consecutive returns of a pulse [m]."""

    pairs: int
    mean: float
    least: float
    """NaN, as the mean, without a pair."""


def describe_pairs(pairs: int, total: float, least: float) -> Separation:
    """The distances of pairs from their number, sum and least distance."""
    if not pairs:
        return Separation(0, math.nan, math.nan)
    return Separation(int(pairs), float(total) / int(pairs), float(least))


@dataclass(frozen=True, slots=True, kw_only=True)
class PulseStats:
    """What is counted of the returns of a cloud, and of each of its areas.

    A field with a Key is a column of `stats -o` of this name, and a line of its text if the Key says how it is shown.
    """

    points: int
    pulses: int
    returns_per_pulse: float
    """Mean number of returns; NaN without pulses."""
    by_number: dict[int, float]
    """Share of the returns with this return number."""
    by_count: dict[int, float]
    """Share of the pulses with exactly this many returns in the cloud."""
    separations: dict[str, Separation]
    """By return number, as far as there are pairs, without points passed through without an echo: of a cloud `all`, and
    `1-2`, `2-3` ...; of an area `1-2`, `2-3`, `3-4` and `4-`."""
    several: Annotated[int, Key("pulses_with_several")]
    """Pulses with two or more returns."""
    depth: Annotated[float, Key("first_above_last_m")]
    """Mean height of the first above the last return of these pulses [m]: how deep they reach into the vegetation; NaN
    without any."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AreaStats(PulseStats):
    """Statistics of the returns of one area."""

    kind: str
    name: str
    x: float
    y: float
    """As in Area."""
    pairs: int
    """Pairs of consecutive returns of a pulse."""
    mean: float
    least: float
    """Mean and least distance of the pairs [m]; NaN without a pair."""


class AreaTally:
    """Sums per area of one division; tallies of several clouds can be merged.

    always: numbers of areas that count also without a pulse.
    """

    def __init__(self, division: Division, ranks: tuple[str, ...] = AREA_RANKS, always: Sequence[int] = ()) -> None:
        self.division, self._ranks, n = division, ranks, len(ranks)
        quantities = [("by_number", "i8", (MOST_NUMBER + 1,)), ("by_count", "i8", (MOST_COUNT + 1,)),
                      ("pairs", "i8", (n,)), ("apart", "f8", (n,)), ("least", "f8", (n,)), ("several", "i8"),
                      ("depth", "f8")]  # fmt: skip
        self._dtype = np.dtype(quantities)
        self._areas = np.array(always, np.int64)
        self._sums = self._begin(len(always))

    def _begin(self, number: int) -> np.ndarray:
        """The sums of areas of which nothing was counted."""
        sums = np.zeros(number, self._dtype)
        sums["least"] = np.inf
        return sums

    def add(
        self, rows: np.ndarray, first: np.ndarray, pairs: tuple[np.ndarray, ...], depths: tuple[np.ndarray, ...]
    ) -> None:
        """Adds whole pulses: a pulse belongs, with all its returns, to the area of its first return.

        rows: returns sorted by pulse, then number; first: row of the first return of each pulse; pairs: rows that form
        a pair with the next row, and their distances [m]; depths: pulses with several returns, and the height of their
        first above their last return [m].
        """
        (before, distance), (pulses, depth) = pairs, depths
        places = rows["xyz"][first]
        areas, area = np.unique(self.division.find(places[:, 0], places[:, 1]), return_inverse=True)
        sums, number = self._begin(len(areas)), np.diff(np.append(first, len(rows)))
        of_row = np.repeat(area, number)
        rank = np.minimum(rows["number"][before].astype(np.int64), len(self._ranks)) - 1

        def put(name: str, owner: np.ndarray, kind: np.ndarray | int, weights: np.ndarray | None = None) -> None:
            """Counts, or adds weights, by area and kind."""
            wide = sums[name].size // max(len(sums), 1)
            sums[name] = np.bincount(owner * wide + kind, weights, sums[name].size).reshape(sums[name].shape)

        put("by_number", of_row, rows["number"])
        put("by_count", area, np.minimum(number, MOST_COUNT))
        put("pairs", of_row[before], rank)
        put("apart", of_row[before], rank, distance)
        np.minimum.at(sums["least"], (of_row[before], rank), distance)
        put("several", area[pulses], 0)
        put("depth", area[pulses], 0, depth)
        self._join(areas, sums)

    def _join(self, areas: np.ndarray, more: np.ndarray) -> None:
        """Adds sums of areas, which are ascending and unique."""
        known = np.union1d(self._areas, areas)
        if len(known) > MOST_AREAS:
            raise ConfigError(f"more than {MOST_AREAS} areas hold pulses; give a larger --area, or fewer clouds")
        if len(known) > len(self._areas):
            sums = self._begin(len(known))
            sums[np.searchsorted(known, self._areas)] = self._sums
            self._areas, self._sums = known, sums
        place = np.searchsorted(known, areas)
        for name in self._dtype.names or ():
            join = np.minimum if name == "least" else np.add
            self._sums[name][place] = join(self._sums[name][place], more[name])

    def finish(self) -> list[AreaStats]:
        """The statistics: cells by column and row, polygons in the order of their file, `outside` last."""
        order = np.argsort(np.where(self._areas == _OUTSIDE, np.iinfo(np.int64).max, self._areas), kind="stable")
        found = []
        for row in order.tolist():
            sums, area = self._sums[row], self.division.describe(int(self._areas[row]))
            several, parts = int(sums["several"]), (sums["pairs"], sums["apart"], sums["least"])
            points, pulses = int(sums["by_number"].sum()), int(sums["by_count"].sum())
            ranks = zip(self._ranks, *parts, strict=True)
            shares = {}
            for name in ("by_number", "by_count"):  # of the sum, without zeros
                total = int(sums[name].sum())
                shares[name] = {int(n): int(sums[name][n]) / total for n in np.flatnonzero(sums[name])}
            found.append(AreaStats(
                **area._asdict(),
                **asdict(describe_pairs(parts[0].sum(), parts[1].sum(), parts[2].min())),
                points=points,
                pulses=pulses,
                returns_per_pulse=points / pulses if pulses else math.nan,
                by_number=shares["by_number"],
                by_count=shares["by_count"],
                separations={name: describe_pairs(*values) for name, *values in ranks if values[0]},
                several=several,
                depth=float(sums["depth"]) / several if several else math.nan,
            ))  # fmt: skip
        return found


BIN, BINS = 0.01, 10_000
"""Width [m] and number of the bins of distances: to 1 cm, up to 100 m."""

LEAST_PAIRS = 100
"""Fewer pairs give no dead zone."""

WITHIN_DEAD_ZONE = 0.001
"""Share of the distances that may lie within the dead zone, so that a few duplicate points do not hide it."""

_NEXT = 10
"""Pairs above the edge from which the distance of neighbouring pairs is measured."""


@frozen
class DeadZone:
    """The shortest distance between a return and the next one."""

    pairs: int
    size: float
    """Distance [m], to 1 cm, below which at most one pair in a thousand lies. NaN with fewer than LEAST_PAIRS, and
    where it lies in the last bin, which holds all larger distances too (100 m)."""
    error: float
    """How much shorter the sensor's own distance may well be [m]: where pairs are rare, none is at the very edge. To
    1 mm; NaN where the size is."""


def find_dead_zone(bins: np.ndarray) -> DeadZone:
    """The dead zone of the pairs of a histogram: the 0.1 % quantile of their distances."""
    pairs = int(bins.sum())
    if pairs < LEAST_PAIRS:
        return DeadZone(pairs, math.nan, math.nan)
    below = np.cumsum(bins)
    edge = int(np.searchsorted(below, WITHIN_DEAD_ZONE * pairs, side="right"))
    if edge == BINS - 1:
        return DeadZone(pairs, math.nan, math.nan)
    # The pairs that were left out may be pairs of surfaces: then the edge is as many gaps between pairs below.
    rank = int(WITHIN_DEAD_ZONE * pairs) + 1
    gap = (int(np.searchsorted(below, rank + _NEXT)) - edge) * BIN / _NEXT
    return DeadZone(pairs, round(edge * BIN, 2), round(max(rank * gap, BIN), 3))


_WHOLE_RANKS = (*(f"{k}-{k + 1}" for k in range(1, 15)), "15-")
"""Classes of pairs of whole clouds."""

_NOT_A_TIME = np.uint64(0x7FF8 << 48)
"""Bits of a NaN: above the key of every GPS time that is a number and at least 0."""

_BEFORE_ZERO = np.uint64(1 << 63)
"""Least key of a GPS time below 0: adjusted standard times before September 2011."""

_MOST_COUNTED = np.uint64(1 << 48)
"""Above any number of a pulse that is counted, below the bits of any time."""

_ROW = np.dtype([("key", "<u8"), ("xyz", "<f8", 3), ("number", "u1"), ("total", "u1"), ("echo", "?")])
_SURE = 3.0
"""A sensor limit is reported if pulses with the most returns outnumber those with one less by so many standard
deviations; without a limit, counts fall with the number of returns."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReturnStats(PulseStats):
    """Statistics of the returns of one cloud, or of several together."""

    cloud: str
    incomplete: int
    """Pulses with another number of points than stored in them: cut by the border of a tile, thinned, or merged."""
    pulses_by: str
    """How pulses were found: `gps_time`, or `return_number` if times do not separate pulses."""
    dead_zone: float
    """Distance [m] below which only one pair in a thousand lies; NaN with fewer than a hundred pairs, and where nearly
    all of them are farther apart than the histogram reaches, see `DeadZone`."""
    dead_zones: dict[str, DeadZone]
    """The same with its error, for `all` pairs and by return number: `1-2`, `2-3`, `3-4` and `4-` (all higher ones)."""
    hidden: float
    """Pairs per pulse that the dead zone would hold if they were as frequent there as up to twice its size."""
    flags: dict[str, int] | None
    """Points per flag of `echo_flags`; None if no cloud has the column."""
    warnings: tuple[str, ...]
    areas: tuple[AreaStats, ...]
    """Areas with a pulse, if divisions are given; together they hold all points and pulses."""
    left_out: int
    """Points that do not meet the condition of --where; `points` are the others."""


def count_returns(
    clouds: Sequence[Path],
    skip: Callable[[InputError], None] | None = None,
    *,
    divisions: Sequence[Division] = (),
    selection: PointFilter = EVERY,
    in_memory: int = BUCKET_ROWS,
) -> tuple[list[ReturnStats], ReturnStats]:
    """Statistics of each cloud and of all together, for points in any order.

    A pulse is the points of equal GPS time and scanner in a cloud; if times do not separate pulses, a run of rising
    return numbers.
    selection: count only these points. divisions: count also by areas; a pulse belongs, with all its returns, to the
    area of its first return. skip: called with the InputError of a cloud that cannot be read, which is then left out;
    without it, the error is raised.
    in_memory: rows at a time; large clouds need room in TMPDIR. Raises ConfigError for too many areas.
    """
    each, total, number = [], _Tally(areas=[AreaTally(one) for one in divisions]), 0
    for path in clouds:
        try:
            tally = _tally_cloud(Path(path), divisions, selection, in_memory)
        except InputError as error:
            if skip is None:
                raise
            skip(error)
            continue
        number += sum(len(one._areas) for one in tally.areas)
        if number > MOST_AREAS:
            raise ConfigError(f"{path}: more than {MOST_AREAS} areas with it; give a larger --area, or fewer clouds")
        each.append(tally.finish(str(path)))
        total.merge(tally)
    return each, total.finish("total")


def times_separate_pulses(reader: CloudReader) -> bool:
    """Whether the GPS times of the first points separate pulses."""
    if not reader.has_gps_time:
        return False
    rows = next(reader.read_pieces(), None)
    return rows is None or len(np.unique(rows["gps_time"])) * MOST_RETURNS >= len(rows)


def _tally_cloud(path: Path, divisions: Sequence[Division], selection: PointFilter, in_memory: int) -> _Tally:
    with CloudReader(path, RETURN_DTYPE) as reader:
        by_time = times_separate_pulses(reader)  # by all points
        reader.select(selection)
        placed = [one.place(path) if isinstance(one, PolygonSet) else (one, "") for one in divisions]
        areas = [AreaTally(division) for division, _ in placed]
        tally = _Tally(methods={"gps_time" if by_time else "return_number"}, areas=areas)
        tally.notes = [*reader.unread, *(line for _, line in placed if line)]
        tally.metres = reader.metres
        if math.isnan(reader.metres[0]):
            tally.notes.append(f"coordinates are {reader.unit}: returns have no distances; project the cloud to metres")
        elif reader.metres != (1.0, 1.0, 1.0):
            tally.notes.append(f"coordinates are {reader.unit}: distances and depths are converted to metres")
        elif not reader.has_heights:
            tally.notes.append(f"coordinates are {reader.unit}: first to last is along Z, which is no height")
        if reader.has_flags:
            tally.flags = np.zeros(16, np.int64)
        number = count_buckets(reader.point_count, in_memory)
        with Spool(number, _ROW) as buckets:
            keys = _Keys(by_time)
            for rows in reader.read_pieces(in_memory):
                if tally.flags is not None:
                    tally.flags += [int(np.count_nonzero(rows["flags"] & np.uint16(flag))) for flag in EchoFlag]
                shaped = np.zeros(len(rows), _ROW)
                shaped["key"] = keys.of(rows)
                for name in ("xyz", "number", "total"):
                    shaped[name] = rows[name]
                shaped["echo"] = (rows["flags"] & np.uint16(PASSED_THROUGH)) == 0
                buckets.append(spread_keys(shaped["key"], number), shaped)
            for bucket in range(number):
                tally.add_pulses(buckets.read(bucket))
        if keys.untimed:
            tally.notes.append(
                f"points without GPS time (0 or NaN): {keys.untimed}; their pulses are found by return numbers, and a "
                "pulse of which only some points have a time counts more than once"
            )
        tally.left_out = reader.left_out
    return tally


class _Keys:
    """Numbers the pulses, piece by piece."""

    def __init__(self, by_time: bool) -> None:
        self._by_time, self._pulse, self._last = by_time, 0, 255
        self.untimed = 0
        """Points without a time, while others have one."""

    def of(self, rows: np.ndarray) -> np.ndarray:
        """Pulse number of each row, u8 (n,)."""
        if not self._by_time:
            return self._count_up(rows["number"])
        # Two bits that no exponent of a GPS time uses.
        keys = time_keys(rows["gps_time"]) ^ (rows["scanner"].astype(np.uint64) << np.uint64(60))
        # Hundreds of points without a time are no pulse of hundreds of returns.
        missing = np.flatnonzero(np.isnan(rows["gps_time"]) | (rows["gps_time"] == 0))
        keys[missing] = _NOT_A_TIME + self._count_up(rows["number"][missing])
        self.untimed += len(missing)
        return keys

    def _count_up(self, numbers: np.ndarray) -> np.ndarray:
        """Runs of rising return numbers, counted from 1, u8 (n,); goes on where the last piece ended."""
        if not len(numbers):
            return np.empty(0, np.uint64)
        starts = numbers <= np.concatenate([[self._last], numbers[:-1]])
        pulse = self._pulse + np.cumsum(starts)
        self._pulse, self._last = int(pulse[-1]), int(numbers[-1])
        return pulse.astype(np.uint64)


@dataclass(slots=True, eq=False)
class _Tally:
    """Sums of one cloud; tallies of several clouds can be merged."""

    left_out: int = 0
    incomplete: int = 0
    crowded: int = 0
    """Those of `incomplete` with more points of one time than stored in them."""
    depth: float = 0.0
    methods: set[str] = field(default_factory=set)
    distances: np.ndarray = field(default_factory=lambda: np.zeros((len(AREA_RANKS), BINS), np.int64))
    """Histograms of the distances between consecutive returns, one per class of AREA_RANKS."""
    whole: AreaTally = field(default_factory=lambda: AreaTally(PolygonSet(()), _WHOLE_RANKS, (_OUTSIDE,)))
    """All of the cloud lies outside of no polygons."""
    flags: np.ndarray | None = None
    areas: list[AreaTally] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    """Lines about the areas and the unit of the coordinates."""
    metres: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Of a step of 1 in x, y and z; NaN in degrees, which have no distances."""

    def add_pulses(self, rows: np.ndarray) -> None:
        """Adds counts and separations of whole pulses, in any order."""
        if not len(rows):
            return
        rows = rows[np.lexsort((rows["number"], rows["key"]))]
        first = np.flatnonzero(np.concatenate([[True], rows["key"][1:] != rows["key"][:-1]]))
        counts = np.diff(np.append(first, len(rows)))
        total = rows["total"][first]
        self.incomplete += int(np.count_nonzero(counts != total))
        # Runs of rising return numbers, where points have no time, grow together where points are missing.
        key = rows["key"][first]
        by_time = (key > _MOST_COUNTED) & ((key < _NOT_A_TIME) | (key >= _BEFORE_ZERO))
        self.crowded += int(np.count_nonzero((counts > total) & (total > 0) & by_time))
        # Pulses with several returns, and the height of their first above their last return [m].
        last = np.append(first[1:], len(rows)) - 1
        with np.errstate(invalid="ignore", over="ignore"):
            depth = self.metres[2] * (rows["xyz"][first, 2] - rows["xyz"][last, 2])
        several = np.flatnonzero((last > first) & np.isfinite(depth))
        depths = several, depth[several]
        self.depth += float(depths[1].sum())
        pair = (rows["key"][1:] == rows["key"][:-1]) & rows["echo"][1:] & rows["echo"][:-1]
        before = np.flatnonzero(pair & (rows["number"][1:] == rows["number"][:-1] + 1) & (rows["number"][:-1] > 0))
        with np.errstate(over="ignore", invalid="ignore"):
            distance = np.linalg.norm((rows["xyz"][before + 1] - rows["xyz"][before]) * self.metres, axis=1)
        known = np.isfinite(distance)
        before, distance = before[known], distance[known]
        rank = np.minimum(rows["number"][before].astype(np.int64), len(AREA_RANKS)) - 1
        np.add.at(self.distances, (rank, np.minimum(distance / BIN, BINS - 1).astype(np.int64)), 1)
        for area in (self.whole, *self.areas):
            area.add(rows, first, (before, distance), depths)

    def merge(self, other: _Tally) -> None:
        """Adds the sums of another cloud."""
        self.methods |= other.methods
        for name in ("left_out", "incomplete", "crowded", "depth", "distances"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        for area, more in zip((self.whole, *self.areas), (other.whole, *other.areas), strict=True):
            area._join(more._areas, more._sums)
        if other.flags is not None:
            self.flags = other.flags + (0 if self.flags is None else self.flags)

    def finish(self, cloud: str) -> ReturnStats:
        """The statistics."""
        (whole,) = self.whole.finish()
        bins = self.distances
        zones = {"all": find_dead_zone(bins.sum(axis=0))}
        zones |= {name: find_dead_zone(each) for name, each in zip(AREA_RANKS, bins, strict=True) if each.any()}
        zone = zones["all"].size
        # Pairs that the zone would hold if they were as frequent there as up to twice its size.
        above = slice(0, 0) if math.isnan(zone) else slice(round(zone / BIN), round(2 * zone / BIN))
        hidden = math.nan if math.isnan(zone) else int(bins[:, above].sum()) / whole.pulses
        names = list(EchoFlag.__members__)
        found = {one.name: getattr(whole, one.name) for one in fields(PulseStats)}
        found["separations"] = {"all": Separation(whole.pairs, whole.mean, whole.least), **whole.separations}
        found["depth"] = self.depth / whole.several if whole.several else math.nan
        lines = list(self.notes)
        if self.left_out:
            lines.append(
                f"--where: {self.left_out} of {whole.points + self.left_out} points are left out; pulses and distances "
                "are those of the points that are left"
            )
        if zone >= 0.05 and hidden > 0.001:
            lines.append(
                f"dead zone: almost no returns of a pulse lie closer together than {zone:.2f} m ({zone / HALF_C:.1f} "
                "ns); surfaces that are closer give one return. If returns were as frequent there as just above it, "
                f"there would be {hidden:.3f} more returns per pulse"
            )
        most = max(whole.by_count, default=0)
        last, before = (round(whole.pulses * whole.by_count.get(k, 0.0)) for k in (most, most - 1))
        if most >= 3 and last - before > _SURE * math.sqrt(last + before):
            lines.append(
                f"limit: {whole.by_count[most]:.1%} of the pulses have {most} returns, more than have "
                f"{most - 1}; the sensor records at most {most}, and later surfaces are missing"
            )
        if self.crowded > 0.001 * whole.pulses:
            lines.append(
                f"crowded: {self.crowded} of {whole.pulses} pulses have more points than their number of returns: "
                "points are stored twice, or pulses share a time (it is rounded, or lasers fire together); returns per "
                "pulse and distances are wrong"
            )
        incomplete = self.incomplete - self.crowded
        if incomplete > 0.001 * whole.pulses and not self.left_out:  # the line about --where says it already
            lines.append(
                f"incomplete: {incomplete} of {whole.pulses} pulses have another number of points than stored in "
                "them; tiles and thinned clouds give fewer returns per pulse than the sensor recorded"
            )
        return ReturnStats(
            cloud=cloud,
            **found,
            incomplete=self.incomplete,
            pulses_by=" and ".join(sorted(self.methods)),
            dead_zone=zone,
            dead_zones=zones,
            hidden=hidden,
            flags=None if self.flags is None else dict(zip(names, self.flags.tolist(), strict=True)),
            warnings=tuple(lines),
            areas=tuple(stats for area in self.areas for stats in area.finish()),
            left_out=self.left_out,
        )
