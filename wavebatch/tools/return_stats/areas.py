"""Counts of returns per area: whole clouds, cells of a grid, or polygons.

`returns` has one AreaTally per division and cloud, and one for the whole cloud; `wavebatch stats --area` and
`--polygon` choose the divisions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from wavebatch.core.errors import ConfigError
from wavebatch.files.area_crs import describe_miss
from wavebatch.files.geojson import Polygon, find_inside
from wavebatch.files.las.header import read_header

MOST_AREAS = 50_000
"""Most areas of all clouds together, so that memory is bounded."""

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


class Division(Protocol):
    """A division of the plane into areas that do not overlap."""

    def find(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """The number of the area of each position (n,), i8; -1 outside of all areas."""

    def describe(self, number: int) -> Area:
        """The area with this number."""

    def place(self, cloud: Path) -> Division:
        """The division in the coordinates of a cloud."""
        return self

    def miss(self, cloud: Path) -> str:
        """Says that no area lies in the cloud, once it is placed; empty where one does."""
        return ""


class AreaGrid(Division):
    """Square cells whose borders are multiples of `size`, in the unit of the coordinates."""

    def __init__(self, size: float) -> None:
        if not (np.isfinite(size) and size > 0):
            raise ConfigError(f"--area {size:g}: the side of a cell must be above 0")
        self.size = float(size)

    def find(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """As Division.find; ConfigError if the cells are too small to be numbered at these coordinates."""
        with np.errstate(over="ignore", invalid="ignore"):
            known = (np.abs([x, y]) < _FARTHEST).all(axis=0)
            place = np.floor(np.stack([x, y]) / self.size)
        if (np.abs(place[:, known]) >= _HALF).any():
            raise ConfigError(f"--area {self.size:g}: the cells are too small for these coordinates; give a larger one")
        column, row = np.where(known, place, 0.0).astype(np.int64) + _HALF
        return np.where(known, (column << 31) | row, _OUTSIDE)

    def describe(self, number: int) -> Area:
        """As Division.describe."""
        if number == _OUTSIDE:
            return OUTSIDE
        x, y = ((number >> 31) - _HALF) * self.size, ((number & ((1 << 31) - 1)) - _HALF) * self.size
        return Area("cell", f"{x:.10g} {y:.10g}", x, y)


class PolygonSet(Division):
    """Polygons; where polygons overlap, a position belongs to the first one."""

    def __init__(self, polygons: Sequence[Polygon]) -> None:
        self.polygons = tuple(polygons)

    def find(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """As Division.find."""
        found = np.full(len(x), _OUTSIDE, np.int64)
        for number, polygon in enumerate(self.polygons):
            free = np.flatnonzero(found == _OUTSIDE)
            found[free[find_inside(polygon.rings, x[free], y[free])]] = number
        return found

    def describe(self, number: int) -> Area:
        """As Division.describe."""
        return OUTSIDE if number == _OUTSIDE else Area("polygon", self.polygons[number].name)

    def place(self, cloud: Path) -> PolygonSet:
        """As Division.place; raises as `Polygon.place`."""
        header = read_header(cloud)
        return PolygonSet([polygon.place(cloud, header) for polygon in self.polygons])

    def miss(self, cloud: Path) -> str:
        """As Division.miss."""
        return describe_miss([ring for polygon in self.polygons for ring in polygon.rings], read_header(cloud))


class Whole(Division):
    """One area without borders, which counts also where it holds no pulse."""

    def find(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """As Division.find."""
        return np.zeros(len(x), np.int64)

    def describe(self, number: int) -> Area:
        """As Division.describe."""
        return Area("cloud", "")


def name_ranks(number: int) -> tuple[str, ...]:
    """Names of so many classes of pairs of consecutive returns.

    They count by the number of the first return; the last class holds all higher numbers.
    """
    return (*(f"{k}-{k + 1}" for k in range(1, number)), f"{number}-")


RANKS = name_ranks(4)
"""Classes of pairs per area and of dead zones."""


@dataclass(frozen=True, slots=True)
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


@dataclass(frozen=True, slots=True)
class AreaStats:
    """Statistics of the returns of one area."""

    kind: str
    name: str
    x: float
    y: float
    """As in Area."""
    points: int
    pulses: int
    returns_per_pulse: float
    by_number: dict[int, float]
    """Share of the returns of the area with this return number."""
    by_count: dict[int, float]
    """Share of the pulses of the area with exactly this many returns."""
    pairs: int
    """Pairs of consecutive returns of a pulse."""
    mean: float
    least: float
    """Mean and least distance of the pairs [m]; NaN without a pair."""
    separations: dict[str, Separation]
    """The same by return number: `1-2`, `2-3`, `3-4` and `4-`, as far as there are pairs."""
    several: int
    """Pulses with two or more returns."""
    depth: float
    """Mean height of the first above the last return of these pulses [m]: how deep they reach into the vegetation."""


class AreaTally:
    """Sums per area of one division; tallies of several clouds can be merged."""

    def __init__(self, division: Division, ranks: tuple[str, ...] = RANKS) -> None:
        self.division, self._ranks = division, ranks
        n = int(isinstance(division, Whole))
        self._areas = np.zeros(n, np.int64)
        self._counts = np.zeros((n, MOST_NUMBER + 1 + MOST_COUNT + 1 + len(ranks) + 1), np.int64)
        self._sums = np.zeros((n, len(ranks) + 1))
        self._least = np.full((n, len(ranks)), np.inf)

    def __len__(self) -> int:
        return len(self._areas)

    def add(
        self, rows: np.ndarray, first: np.ndarray, pairs: tuple[np.ndarray, ...], depths: tuple[np.ndarray, ...]
    ) -> None:
        """Adds whole pulses: a pulse belongs, with all its returns, to the area of its first return.

        rows: returns sorted by pulse, then number; first: row of the first return of each pulse; pairs: rows that form
        a pair with the next row, and their distances [m]; depths: from `measure_depths`.
        """
        (before, distance), (pulses, depth), ranks = pairs, depths, len(self._ranks)
        places = rows["xyz"][first]
        areas, area = np.unique(self.division.find(places[:, 0], places[:, 1]), return_inverse=True)
        n, number = len(areas), np.diff(np.append(first, len(rows)))
        of_row = np.repeat(area, number)
        by_number = np.bincount(of_row * (MOST_NUMBER + 1) + rows["number"], minlength=n * (MOST_NUMBER + 1))
        classes = area * (MOST_COUNT + 1) + np.minimum(number, MOST_COUNT)
        by_count = np.bincount(classes, minlength=n * (MOST_COUNT + 1))
        rank = np.minimum(rows["number"][before].astype(np.int64), ranks) - 1
        of_pair, cells = of_row[before] * ranks + rank, n * ranks
        number_of_pairs = np.bincount(of_pair, minlength=cells).reshape(n, -1)
        least = np.full(cells, np.inf)
        np.minimum.at(least, of_pair, distance)
        several = np.bincount(area[pulses], minlength=n)[:, None]
        tables = (by_number.reshape(n, -1), by_count.reshape(n, -1), number_of_pairs, several)
        apart = np.bincount(of_pair, distance, cells).reshape(n, -1)
        sums = np.concatenate([apart, np.bincount(area[pulses], depth, n)[:, None]], axis=1)
        self._join(areas, np.concatenate(tables, axis=1), sums, least.reshape(n, -1))

    def merge(self, other: AreaTally) -> None:
        """Adds the sums of another cloud."""
        self._join(other._areas, other._counts, other._sums, other._least)

    def _join(self, areas: np.ndarray, counts: np.ndarray, sums: np.ndarray, least: np.ndarray) -> None:
        """Adds sums of areas, which are ascending and unique."""
        known = np.union1d(self._areas, areas)
        if len(known) > MOST_AREAS:
            raise ConfigError(f"more than {MOST_AREAS} areas hold pulses; give a larger --area, or fewer clouds")
        old, new = np.searchsorted(known, self._areas), np.searchsorted(known, areas)
        if len(known) > len(self._areas):
            kept = self._counts, self._sums, self._least
            self._counts = np.zeros((len(known), counts.shape[1]), np.int64)
            self._sums = np.zeros((len(known), sums.shape[1]))
            self._least = np.full((len(known), least.shape[1]), np.inf)
            self._counts[old], self._sums[old], self._least[old] = kept
            self._areas = known
        self._counts[new] += counts
        self._sums[new] += sums
        self._least[new] = np.minimum(self._least[new], least)

    def finish(self) -> list[AreaStats]:
        """The statistics: cells by column and row, polygons in the order of their file, `outside` last."""
        order = np.argsort(np.where(self._areas == _OUTSIDE, np.iinfo(np.int64).max, self._areas), kind="stable")
        return [self._describe(row) for row in order.tolist()]

    def _describe(self, row: int) -> AreaStats:
        edge = MOST_NUMBER + 2 + MOST_COUNT
        by_number, by_count, pairs, several = np.split(self._counts[row], [MOST_NUMBER + 1, edge, -1])
        points, pulses, number = int(by_number.sum()), int(by_count.sum()), int(several[0])
        apart, depth = self._sums[row, :-1], float(self._sums[row, -1])
        every = describe_pairs(pairs.sum(), apart.sum(), self._least[row].min())
        ranks = zip(self._ranks, pairs, apart, self._least[row], strict=True)
        return AreaStats(
            *self.division.describe(int(self._areas[row])),
            points=points,
            pulses=pulses,
            returns_per_pulse=points / pulses if pulses else math.nan,
            by_number=_share_counts(by_number),
            by_count=_share_counts(by_count),
            pairs=every.pairs,
            mean=every.mean,
            least=every.least,
            separations={name: describe_pairs(*values) for name, *values in ranks if values[0]},
            several=number,
            depth=depth / number if number else math.nan,
        )


def measure_depths(rows: np.ndarray, first: np.ndarray, up: float) -> tuple[np.ndarray, np.ndarray]:
    """Pulses with several returns, and the height of their first above their last return [m].

    rows: returns sorted by pulse, then number; first: row of the first return of each pulse; up: metres of a step of 1
    in height.
    """
    last = np.append(first[1:], len(rows)) - 1
    with np.errstate(invalid="ignore", over="ignore"):
        depth = up * (rows["xyz"][first, 2] - rows["xyz"][last, 2])
    pulses = np.flatnonzero((last > first) & np.isfinite(depth))
    return pulses, depth[pulses]


def _share_counts(counts: np.ndarray) -> dict[int, float]:
    """Shares of the sum, without zeros."""
    total = int(counts.sum())
    return {int(n): int(counts[n]) / total for n in np.flatnonzero(counts)}
