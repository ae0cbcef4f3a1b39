"""Values of one column of clouds of any size, read piece by piece: selection of points, counts, robust limits.

`histogram` and `raster` read their clouds through `Clouds`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from wavebatch.core.condition import Condition
from wavebatch.core.errors import InputError
from wavebatch.files.cloud.column_reader import ColumnFacts, ColumnReader, check_alike, select_points
from wavebatch.files.las.crs import describe_crs

OUTER = (0.1, 99.9)
"""Percentiles that a picture must show; values far outside are damage or very rare."""

MOST = (5.0, 95.0)
"""Percentiles of most values: histograms show 1.5 times their distance on both sides, which cuts only long tails."""

MARGIN = 0.25
"""Also shown on both sides of these percentiles, as a share of the distance between them."""


@dataclass(frozen=True, slots=True)
class Selection:
    """Which points are used."""

    column: str | None
    """The column; None counts points."""
    flags_with: int = 0
    """Points must have one of these EchoFlag bits; 0: any point."""
    flags_without: int = 0
    """Points must have none of these EchoFlag bits."""
    others: tuple[str, ...] = ()
    """Further columns that are read with it."""
    where: Condition | None = None
    """Points must meet this."""


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

    def __add__(self, other: Tally) -> Tally:
        return Tally(*(getattr(self, name) + getattr(other, name) for name in self.__slots__))


def name_paths(paths: Sequence[Path]) -> tuple[str, ...]:
    """Names of files for legends and titles, with their folders where names are equal."""
    names = [path.name for path in paths]
    return tuple(str(path) if names.count(path.name) > 1 else path.name for path in paths)


class Clouds:
    """Several clouds that are read as one, as often as needed; only one is open at a time.

    Raises InputError if a cloud cannot be read, ConfigError if it lacks the column or the flags or units differ.
    """

    def __init__(self, paths: Sequence[Path], selection: Selection) -> None:
        self.paths, self.selection = tuple(paths), selection
        found: list[tuple[Path, ColumnFacts]] = []
        for path in self.paths:
            with ColumnReader(path, selection.column, *selection.others) as reader:
                found.append((path, reader.facts[0]))
                self.other_facts = reader.facts[1:]
                select_points(reader, selection.where, selection.flags_with, selection.flags_without)  # it can
        self.facts: ColumnFacts = check_alike(found)
        if selection.column in ("x", "y", "z"):
            words = describe_crs(self.paths[0])
            unit = words.upright_unit if selection.column == "z" else words.unit
            self.facts = replace(self.facts, unit=unit)

    def read(self) -> Iterator[tuple[int, np.ndarray, Tally]]:
        """Pieces of all clouds: number of the cloud, selected points with a value, and counts of the piece."""
        for number, path in enumerate(self.paths):
            with ColumnReader(path, self.selection.column, *self.selection.others) as reader:
                select_points(reader, self.selection.where, self.selection.flags_with, self.selection.flags_without)
                seen = 0
                for rows in reader.read_pieces():
                    left, seen = reader.left_out - seen, reader.left_out
                    good = rows[~np.isnan(rows["values"][:, 0])]
                    yield number, good, Tally(len(rows) + left, left, len(rows) - len(good), len(good))

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
