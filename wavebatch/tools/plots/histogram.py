"""Histograms of a column over clouds of any size, and counts of points per flag.

`wavebatch plot histogram` calls `count_values` or `count_points_by_flag` and draws the result with `draw_cloud`. Clouds
are read twice: for the limits, then for the counts.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from wavebatch.core.echoes import EchoFlag
from wavebatch.core.errors import ConfigError
from wavebatch.files.cloud.cloud_reader import ColumnFacts
from wavebatch.files.cloud.point_filter import EVERY, PointFilter
from wavebatch.files.las.header import CLASS_NAMES
from wavebatch.tools.even_sample import EvenSample
from wavebatch.tools.plots.values import Clouds, Tally, name_paths, shown_limits

FEWEST, MOST_CHOSEN = 20, 120
"""Least and largest number of bins that are chosen if the user gives none."""

MOST_GROUPS = 12
"""Most series of --by: a picture of more cannot be read."""

FEW_STEPS = 64
"""A column with at most so many possible values is shown whole: a rare class is no outlier."""

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
    """Names of the series: clouds and groups, as far as there are several."""
    clouds: tuple[str, ...]
    """Names of the clouds."""
    edges: np.ndarray
    """Edges of the bins, f8 (b + 1,); the last bin includes its upper edge."""
    counts: np.ndarray
    """Values per series and bin, i8 (series, b)."""
    below: np.ndarray
    """Values below the first edge, i8 (series,)."""
    above: np.ndarray
    """Values above the last edge, i8 (series,)."""
    values: np.ndarray
    """Values of each series, inside and outside the edges, i8 (series,)."""
    total: Tally
    """Counts of all series."""
    percentiles: np.ndarray
    """PERCENTILES of each series (series, 3), of all values inside and outside the edges; NaN without values. For more
    than a million values, those of an even sample."""
    means: np.ndarray
    """Mean of each series, of all values inside and outside the edges, f8 (series,); NaN without values."""


@dataclass(frozen=True, slots=True, eq=False)
class FlagCounts:
    """Points per flag."""

    facts: ColumnFacts
    clouds: tuple[str, ...]
    """Names of the clouds."""
    names: tuple[str, ...]
    """Names of the flags."""
    counts: np.ndarray
    """Points with each flag, i8 (16,)."""
    clean: int
    """Points without any flag."""
    total: Tally


def count_values(
    paths: Sequence[Path],
    column: str,
    chosen: PointFilter = EVERY,
    *,
    bins: int | None = None,
    limits: tuple[float, float] | None = None,
    each: bool = False,
    by: str | None = None,
) -> Histogram:
    """The histogram of a column of clouds, in bounded memory.

    bins: number of bins, by default from the rule of Freedman and Diaconis; a column with a fixed step gets at most as
    many, each a whole number of steps wide. limits: lowest and highest edge, by default those of `values.shown_limits`.
    each: one series per cloud instead of one for all. by: one series per value of this column.
    Raises InputError without any value, ConfigError for a column of flags, and more than MOST_GROUPS groups.
    """
    clouds = Clouds(paths, (column,) if by is None else (column, by), chosen)
    if clouds.facts.is_flags:
        raise ConfigError(f"{paths[0]}: {clouds.facts.name} are bits: there is no histogram of their values")
    if by is not None and clouds.other_facts[0].is_flags:
        raise ConfigError(f"{paths[0]}: {by} are bits and form no groups; --flags selects them")
    series: dict[_Key, _Series] = {}
    total = Tally()
    for tally, cloud, groups in _read_groups(clouds, each, by):
        total += tally
        for key, values in groups.items():
            series.setdefault(key, _Series()).add(values)
        if len({group for _, group in series}) > MOST_GROUPS:
            raise ConfigError(
                f"{paths[cloud]}: {by} has more than {MOST_GROUPS} different values; --by is for columns "
                "with few, like number_of_returns or classification"
            )
    if not total.values:
        raise clouds.complain(total)
    keys = sorted(series)
    kept = [series[key].sample.read().get("value", np.empty(0)) for key in keys]
    least, largest = min(one.least for one in series.values()), max(one.largest for one in series.values())
    step = clouds.facts.step
    if limits is None:
        # All values of a column with few steps, like classes; else without the rare far ones.
        few = step > 0 and (largest - least) / step <= FEW_STEPS
        limits = (least, largest) if few else shown_limits(kept, least, largest)
    edges = place_edges(np.concatenate(kept), *limits, step, bins)
    # The second pass; the first and the last column count what lies below and above.
    counts = np.zeros((len(keys), len(edges) + 1), np.int64)
    for _, _, groups in _read_groups(clouds, each, by):
        for key, values in groups.items():
            at = np.searchsorted(edges, values, side="right")
            at[values == edges[-1]] = len(edges) - 1
            counts[keys.index(key)] += np.bincount(at, minlength=len(edges) + 1)
    return Histogram(
        clouds.facts,
        tuple(_name_series(key, clouds, each, by) for key in keys),
        tuple(path.name for path in paths),
        edges,
        counts[:, 1:-1],
        below=counts[:, 0],
        above=counts[:, -1],
        values=np.array([series[key].values for key in keys]),
        total=total,
        percentiles=np.stack([np.percentile(one, PERCENTILES) if len(one) else np.full(3, np.nan) for one in kept]),
        means=np.array([series[key].total / max(series[key].values, 1) for key in keys]),
    )


_Key = tuple[int, float]
"""Number of the cloud (0 if all are one), and value of the group (0 without groups)."""

_UNKNOWN = -math.inf
"""Group of points without data in the column of --by: NaN is not equal to itself, so it is no key."""


@dataclass(slots=True, eq=False)
class _Series:
    """What the first pass finds in a series."""

    values: int = 0
    sample: EvenSample = field(default_factory=EvenSample)
    least: float = math.inf
    largest: float = -math.inf
    total: float = 0.0

    def add(self, values: np.ndarray) -> None:
        if len(values):
            self.values += len(values)
            self.sample.add({"value": values})
            self.least, self.largest = min(self.least, float(values.min())), max(self.largest, float(values.max()))
            self.total += float(values.sum())


def _read_groups(clouds: Clouds, each: bool, by: str | None) -> Iterator[tuple[Tally, int, dict[_Key, np.ndarray]]]:
    """Pieces of the clouds: counts, number of the cloud, and the values of each series."""
    for cloud, rows, tally in clouds.read():
        values, number = rows["values"][:, 0], cloud if each else 0
        if by is None:
            yield tally, cloud, {(number, 0.0): values}
            continue
        group = np.where(np.isnan(rows["values"][:, 1]), _UNKNOWN, rows["values"][:, 1])
        yield tally, cloud, {(number, one): values[group == one] for one in np.unique(group).tolist()}


def _name_series(key: _Key, clouds: Clouds, each: bool, by: str | None) -> str:
    cloud, group = key
    parts = [name_paths(clouds.paths)[cloud]] if each and len(clouds.paths) > 1 else []
    if by is not None:
        column = clouds.other_facts[0].name
        meaning = CLASS_NAMES.get(int(group), "") if column.endswith("classification") and group >= 0 else ""
        known = f"{column} {group:g}" + (f" ({meaning})" if meaning else "")
        parts.append(f"no {column}" if group == _UNKNOWN else known)
    return " ".join(parts) or (clouds.paths[0].name if len(clouds.paths) == 1 else f"{len(clouds.paths)} clouds")


def place_edges(sample: np.ndarray, low: float, high: float, step: float, bins: int | None) -> np.ndarray:
    """Edges of bins over [low, high], f8.

    step: distance between possible values, 0 for any value. With a step all bins hold the same number of possible
    values, so that no bin looks fuller than its neighbours, and edges lie half a step from values.
    """
    if high - low < _LEAST_SPAN:
        half = max(0.5 * step or 1e-3 * abs(low) or 0.5, high - low)
        return np.array([low - half, low + half])
    number = bins
    if bins is None:
        # Freedman and Diaconis.
        quarter, three = np.percentile(sample, (25, 75))
        width = 2 * (three - quarter) * len(sample) ** (-1 / 3)
        number = round((high - low) / float(np.clip(width, (high - low) / MOST_CHOSEN, (high - low) / FEWEST)))
    if step > 0 and max(abs(low), abs(high)) / step < _MOST_STEPS:
        first, last = math.floor(low / step + 0.5), math.floor(high / step + 0.5)
        each = (last - first + 1) / number
        stride = math.ceil(each) if bins else max(1, round(each))
        return (first - 0.5 + stride * np.arange(-(-(last - first + 1) // stride) + 1)) * step
    # If bins are narrower than the spacing of float64, linspace repeats edges.
    return np.unique(np.linspace(low, high, number + 1))


def count_points_by_flag(paths: Sequence[Path], column: str, chosen: PointFilter = EVERY) -> FlagCounts:
    """Counts the points of the clouds per flag. Raises InputError without any point."""
    counts, clean, total = np.zeros(len(EchoFlag), np.int64), 0, Tally()
    clouds = Clouds(paths, (column,), chosen)
    for _, rows, tally in clouds.read():
        total += tally
        flags = rows["values"][:, 0].astype(np.uint16)
        counts += [int(np.count_nonzero(flags & np.uint16(flag))) for flag in EchoFlag]
        clean += int(np.count_nonzero(flags == 0))
    if not total.values:
        raise clouds.complain(total)
    names = tuple(path.name for path in paths)
    return FlagCounts(clouds.facts, names, tuple(flag.name for flag in EchoFlag), counts, clean, total)
