"""The values of a column over clouds of any size: which points count, robust limits."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wavebatch.core.echoes import EchoFlag
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.suggest import nearest
from wavebatch.files.cloud.column_reader import ColumnFacts, ColumnReader, check_alike

OUTER = (0.1, 99.9)
"""Percentiles that a picture must show; what lies far beyond them is damage or a rarity."""

MARGIN = 0.25
"""Shown beyond them, in units of what lies between."""


@dataclass(frozen=True, slots=True)
class Selection:
    """Which points count."""

    column: str | None
    """The column; None counts points."""
    flags_with: int = 0
    """Points need one of these EchoFlag bits; 0 asks for none."""
    flags_without: int = 0
    """Points must have none of these."""

    def choose(self, rows: np.ndarray) -> np.ndarray:
        """The rows (io.columns.VALUE_DTYPE) whose flags are as they must be."""
        if not self.flags_with and not self.flags_without:
            return rows
        keep = (rows["flags"] & np.uint16(self.flags_without)) == 0
        if self.flags_with:
            keep &= (rows["flags"] & np.uint16(self.flags_with)) != 0
        return rows[keep]


@dataclass(slots=True)
class Tally:
    """What became of the points of a cloud."""

    points: int = 0
    left_out: int = 0
    """By their flags."""
    no_data: int = 0
    values: int = 0

    def __add__(self, other: Tally) -> Tally:
        return Tally(*(getattr(self, name) + getattr(other, name) for name in self.__slots__))


def read_flags(names: Sequence[str]) -> int:
    """The bits of flags given by name, several in one word separated by commas; raises ConfigError for an unknown."""
    bits = 0
    for name in (part.strip().upper() for text in names for part in text.split(",")):
        if name not in EchoFlag.__members__:
            raise ConfigError(f"flag {name!r} does not exist; {nearest(name, EchoFlag.__members__)}")
        bits |= int(EchoFlag[name])
    return bits


class Clouds:
    """Clouds that are read as one, more than once, one open at a time.

    Raises InputError where one cannot be read, ConfigError where one has no such column, another unit for it, or no
    flags to select by.
    """

    def __init__(self, paths: Sequence[Path], selection: Selection) -> None:
        self.paths, self.selection = tuple(paths), selection
        found: list[tuple[Path, ColumnFacts]] = []
        for path in self.paths:
            with ColumnReader(path, selection.column) as reader:
                found.append((path, reader.facts))
                if (selection.flags_with or selection.flags_without) and not reader.has_flags:
                    raise ConfigError(f"{path}: has no column echo_flags to select points by")
        self.facts: ColumnFacts = check_alike(found)

    def read(self) -> Iterator[tuple[int, np.ndarray, Tally]]:
        """Pieces of all clouds: number of the cloud, selected points that have a value, what became of the piece."""
        for number, path in enumerate(self.paths):
            with ColumnReader(path, self.selection.column) as reader:
                for rows in reader.read_pieces():
                    chosen = self.selection.choose(rows)
                    good = chosen[~np.isnan(chosen["value"])]
                    yield number, good, Tally(len(rows), len(rows) - len(chosen), len(chosen) - len(good), len(good))

    def complain(self, tally: Tally) -> InputError:
        """Why nothing can be drawn."""
        where = f"{self.paths[0]}" if len(self.paths) == 1 else f"{self.paths[0]} and {len(self.paths) - 1} more"
        if not tally.points:
            return InputError(f"{where}: holds no points: nothing to draw")
        reasons = []
        if tally.left_out:
            reasons.append(f"{tally.left_out} of {tally.points} points are left out by their flags")
        if tally.no_data:
            reasons.append(f"{tally.no_data} have no data in {self.facts.name}")
        return InputError(f"{where}: nothing to draw: {' and '.join(reasons)}")


def robust_limits(sample: np.ndarray, least: float, largest: float) -> tuple[float, float]:
    """What a picture should show of values from `least` to `largest`, without outliers that would squeeze the rest."""
    low, high = np.percentile(sample, OUTER)
    margin = MARGIN * (high - low)
    if not margin:
        return least, largest
    return max(least, float(low - margin)), min(largest, float(high + margin))
