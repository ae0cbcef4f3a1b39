"""Histograms of a column over clouds of any size, and counts of points per flag.

`wavebatch plot histogram` calls `count_values` or `count_flags` and draws the result with `draw_cloud`. Clouds are read
twice: for the limits, then for the counts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wavebatch.core.echoes import EchoFlag
from wavebatch.core.errors import ConfigError
from wavebatch.core.even_sample import EvenSample
from wavebatch.files.cloud.column_reader import ColumnFacts
from wavebatch.tools.plots.values import Clouds, Selection, Tally, robust_limits

FEWEST, MOST_CHOSEN = 20, 120
"""Least and largest number of bins that are chosen if the user gives none."""

_MOST_STEPS = 1e15
"""Most steps from zero for which a float64 still holds half a step."""

PERCENTILES = (5.0, 50.0, 95.0)
"""Percentiles that a picture marks."""

_LEAST_SPAN = 1e-300
"""A smaller range counts as a single value: float64 is too coarse there to be divided into bins."""


@dataclass(frozen=True, slots=True, eq=False)
class Histogram:
    """A histogram of one or several series."""

    facts: ColumnFacts
    names: tuple[str, ...]
    """Names of the series: clouds, or one name for all clouds."""
    edges: np.ndarray
    """Edges of the bins, f8 (b + 1,); the last bin includes its upper edge."""
    counts: np.ndarray
    """Values per series and bin, i8 (series, b)."""
    below: np.ndarray
    """Values below the first edge, i8 (series,)."""
    above: np.ndarray
    """Values above the last edge, i8 (series,)."""
    tallies: tuple[Tally, ...]
    percentiles: np.ndarray
    """PERCENTILES of each series (series, 3), of all values inside and outside the edges; NaN without values. For more
    than a million values, those of an even sample."""

    @property
    def total(self) -> Tally:
        """Counts of all series."""
        return sum(self.tallies, Tally())


@dataclass(frozen=True, slots=True, eq=False)
class FlagCounts:
    """Points per flag."""

    facts: ColumnFacts
    names: tuple[str, ...]
    """Names of the flags."""
    counts: np.ndarray
    """Points with each flag, i8 (16,)."""
    clean: int
    """Points without any flag."""
    total: Tally


def count_values(
    paths: Sequence[Path],
    selection: Selection,
    *,
    bins: int | None = None,
    limits: tuple[float, float] | None = None,
    each: bool = False,
) -> Histogram:
    """The histogram of a column of clouds, in bounded memory.

    bins: number of bins, by default from the rule of Freedman and Diaconis; a column with a fixed step gets at most as
    many, each a whole number of steps wide. limits: lowest and highest edge, by default all values but far outliers.
    each: one series per cloud instead of one for all.
    Raises InputError without any value, ConfigError for a column of flags.
    """
    clouds = Clouds(paths, selection)
    if clouds.facts.is_flags:
        raise ConfigError(f"{paths[0]}: {clouds.facts.name} are bits: there is no histogram of their values")
    number = len(paths) if each else 1
    tallies, samples = [Tally()] * number, [EvenSample() for _ in range(number)]
    least, largest = math.inf, -math.inf
    for cloud, rows, tally in clouds.read():
        series = cloud if each else 0
        tallies[series] += tally
        if len(rows):
            samples[series].add({"value": rows["value"]})
            least, largest = min(least, float(rows["value"].min())), max(largest, float(rows["value"].max()))
    total = sum(tallies, Tally())
    if not total.values:
        raise clouds.complain(total)
    kept = [sample.read().get("value", np.empty(0)) for sample in samples]
    everything = np.concatenate(kept)
    low, high = limits or robust_limits(everything, least, largest)
    edges = place_edges(everything, low, high, clouds.facts.step, bins, exact=limits is not None)
    counts, below, above = _count(clouds, edges, number, each)
    percentiles = [np.percentile(values, PERCENTILES) if len(values) else np.full(3, np.nan) for values in kept]
    names = tuple(path.name for path in paths) if each or len(paths) == 1 else (f"{len(paths)} clouds",)
    return Histogram(clouds.facts, names, edges, counts, below, above, tuple(tallies), np.stack(percentiles))


def _count(clouds: Clouds, edges: np.ndarray, number: int, each: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    counts = np.zeros((number, len(edges) - 1), np.int64)
    below, above = np.zeros(number, np.int64), np.zeros(number, np.int64)
    for cloud, rows, _ in clouds.read():
        series, value = cloud if each else 0, rows["value"]
        at = np.searchsorted(edges, value, side="right") - 1
        at[value == edges[-1]] = len(edges) - 2
        below[series] += np.count_nonzero(at < 0)
        above[series] += np.count_nonzero(at > len(edges) - 2)
        inside = at[(at >= 0) & (at <= len(edges) - 2)]
        counts[series] += np.bincount(inside, minlength=len(edges) - 1)
    return counts, below, above


def place_edges(
    sample: np.ndarray, low: float, high: float, step: float, bins: int | None, *, exact: bool = False
) -> np.ndarray:
    """Edges of bins over [low, high], f8.

    step: distance between possible values, 0 for any value. With a step all bins hold the same number of possible
    values, so that no bin looks fuller than its neighbours, and edges lie half a step from values. Without a step, the
    outer edges are low and high if `exact` or `bins` is given, else edges are multiples of the chosen width.
    """
    if high - low < _LEAST_SPAN:
        half = max(0.5 * step or 1e-3 * abs(low) or 0.5, high - low)
        return np.array([low - half, low + half])
    width = (high - low) / bins if bins else _choose_width(sample, high - low)
    if step > 0 and max(abs(low), abs(high)) / step < _MOST_STEPS:
        first, last = math.floor(low / step + 0.5), math.floor(high / step + 0.5)
        stride = max(1, math.ceil((last - first + 1) / bins)) if bins else max(1, round(width / step))
        number = -(-(last - first + 1) // stride)
        return (first - 0.5 + stride * np.arange(number + 1)) * step
    if not bins and not exact and max(abs(low), abs(high)) / width < _MOST_STEPS:
        return np.arange(math.floor(low / width), math.ceil(high / width) + 1) * width
    # If bins are narrower than the spacing of float64, linspace repeats edges.
    return np.unique(np.linspace(low, high, (bins or max(1, round((high - low) / width))) + 1))


def _choose_width(sample: np.ndarray, span: float) -> float:
    """Freedman and Diaconis: 2 IQR n^(-1/3), within FEWEST to MOST_CHOSEN bins, rounded down to 1, 2 or 5 times a power
    of ten."""
    quarter, three = np.percentile(sample, (25, 75))
    width = 2 * (three - quarter) * len(sample) ** (-1 / 3)
    width = float(np.clip(width, span / MOST_CHOSEN, span / FEWEST))
    power = 10.0 ** math.floor(math.log10(width))
    return next(float(f"{factor * power:.3g}") for factor in (5, 2, 1) if factor * power <= width * (1 + 1e-9))


def count_flags(paths: Sequence[Path], selection: Selection) -> FlagCounts:
    """Counts the points of the clouds per flag. Raises InputError without any point."""
    counts, clean, total = np.zeros(len(EchoFlag), np.int64), 0, Tally()
    clouds = Clouds(paths, selection)
    for _, rows, tally in clouds.read():
        total += tally
        flags = rows["flags"]
        counts += [int(np.count_nonzero(flags & np.uint16(flag))) for flag in EchoFlag]
        clean += int(np.count_nonzero(flags == 0))
    if not total.values:
        raise clouds.complain(total)
    return FlagCounts(clouds.facts, tuple(flag.name for flag in EchoFlag), counts, clean, total)


def is_flags(path: Path, column: str) -> bool:
    """Whether the column of the cloud holds EchoFlag bits."""
    return Clouds([path], Selection(column)).facts.is_flags
