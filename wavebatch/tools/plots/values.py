"""Values of columns of clouds of any size, read piece by piece: chosen points, counts, samples, robust limits.

`draw_cloud`, `sections` and `tools/rasters` read their clouds through `Clouds`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from wavebatch.core.errors import ConfigError, InputError
from wavebatch.files.cloud.cloud_reader import ColumnFacts, ColumnReader, check_alike
from wavebatch.files.cloud.point_filter import EVERY, PointFilter
from wavebatch.files.las.crs import describe_crs
from wavebatch.tools.even_sample import EvenSample

OUTER = (0.1, 99.9)
"""Percentiles that a picture must show; values far outside are damage or very rare."""

MOST = (5.0, 95.0)
"""Percentiles of most values: histograms show 1.5 times their distance on both sides, which cuts only long tails."""

MARGIN = 0.25
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


class Clouds:
    """Several clouds that are read as one, as often as needed; only one is open at a time.

    columns: read of each point; of the first one, None counts points. chosen: the points that are used.
    Raises InputError if a cloud cannot be read, ConfigError if it lacks the column or the flags or units differ.
    """

    def __init__(self, paths: Sequence[Path], columns: Sequence[str | None], chosen: PointFilter = EVERY) -> None:
        self.paths, self._columns, self.chosen = tuple(paths), tuple(columns), chosen
        found: list[list[tuple[Path, ColumnFacts]]] = []
        for path in self.paths:
            with self._open(path) as reader:
                found.append([(path, facts) for facts in reader.facts])
        self.facts, *others = (self._with_unit(check_alike(column)) for column in zip(*found, strict=True))
        self.other_facts: tuple[ColumnFacts, ...] = tuple(others)

    def _open(self, path: Path) -> ColumnReader:
        """A reader that gives the chosen points."""
        reader = ColumnReader(path, *self._columns)
        try:
            reader.select(self.chosen)
        except BaseException:
            reader.close()
            raise
        return reader

    def _with_unit(self, facts: ColumnFacts) -> ColumnFacts:
        """Facts with the unit of the CRS for a coordinate."""
        if not (facts.is_standard and facts.name in ("x", "y", "z")):
            return facts
        words = describe_crs(self.paths[0])
        return replace(facts, unit=words.upright_unit if facts.name == "z" else words.unit)

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
            by = "by --where" if self.chosen.where is not None else "by their flags"
            reasons.append(f"{tally.left_out} of {tally.points} points are left out {by}")
        if tally.no_data:
            reasons.append(f"{tally.no_data} have no data in {self.facts.name}")
        return InputError(f"{where}: nothing to draw: {' and '.join(reasons)}")


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


def find_positions(rows: np.ndarray) -> np.ndarray:
    """Finite x and y of points, f8 (k, 2)."""
    places = np.stack([rows["x"], rows["y"]], axis=1)
    return places[np.isfinite(places).all(axis=1)]


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
        raise ConfigError(f"--statistic {statistic} needs a --column; only count and density need none")
    if facts is not None and facts.is_flags:
        raise ConfigError(f"{path}: {facts.name} are bits, which have no {statistic}; count the points with a flag: "
                          "--statistic count --flags NAME")  # fmt: skip


def shown_limits(samples: Sequence[np.ndarray], least: float, largest: float) -> tuple[float, float]:
    """Limits that show the percentiles MOST of every sample, and 1.5 times their distance on both sides.

    Rare far values would compress the rest. Samples of one value only are shown from `least` to `largest`.
    """
    ends = []
    for sample in filter(len, samples):
        low, high = np.percentile(sample, MOST)
        near = sample[np.abs(sample - 0.5 * (low + high)) <= 2.0 * (high - low)]
        ends += [float(near.min()), float(near.max())] if len(near) else []
    return (min(ends), max(ends)) if ends and min(ends) < max(ends) else (least, largest)


def robust_limits(sample: np.ndarray, least: float, largest: float) -> tuple[float, float]:
    """Limits of a picture of values from `least` to `largest`, without far outliers that would compress the rest."""
    low, high = np.percentile(sample, OUTER)
    margin = MARGIN * (high - low)
    if not margin:
        return least, largest
    return max(least, float(low - margin)), min(largest, float(high + margin))
