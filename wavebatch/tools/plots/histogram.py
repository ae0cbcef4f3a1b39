"""Histograms of a column over clouds of any size, and counts of points per flag.

`wavebatch plot histogram` calls `count_values` or `count_flags` and draws the result with `draw_cloud`. Clouds are read
twice: for the limits, then for the counts.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from wavebatch.core.echoes import EchoFlag
from wavebatch.core.errors import ConfigError
from wavebatch.files.cloud.column_reader import ColumnFacts
from wavebatch.files.las.point_formats import CLASS_NAMES
from wavebatch.tools.even_sample import EvenSample
from wavebatch.tools.plots.values import Clouds, Selection, Tally, name_paths, shown_limits

FEWEST, MOST_CHOSEN = 20, 120
"""Least and largest number of bins that are chosen if the user gives none."""

SMALL_GROUP = 20
"""Groups of --by with fewer values are one series: two values make bins of 50 %."""

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
    """Names of the series: columns, clouds and groups, as far as there are several."""
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
    selection: Selection | Sequence[Selection],
    *,
    bins: int | None = None,
    limits: tuple[float, float] | None = None,
    each: bool = False,
    by: str | None = None,
) -> Histogram:
    """The histogram of a column of clouds, or of several columns of one unit, in bounded memory.

    bins: number of bins, by default from the rule of Freedman and Diaconis; a column with a fixed step gets at most as
    many, each a whole number of steps wide. limits: lowest and highest edge, by default those of `values.shown_limits`.
    each: one series per cloud instead of one for all. by: one series per value of this column,
    and one for all values that fewer than SMALL_GROUP points have.
    Raises InputError without any value, ConfigError for a column of flags, columns of several units, and more than
    MOST_GROUPS groups.
    """
    selections = [selection] if isinstance(selection, Selection) else list(selection)
    if by is not None:
        selections = [replace(one, others=(by,)) for one in selections]
    columns = [Clouds(paths, one) for one in selections]
    facts = _check_columns(str(paths[0]), columns)
    series, total = _survey(columns, each, by)
    if not total.values:
        raise columns[0].complain(total)
    series, merged = _merge_small(series) if by is not None else (series, {})
    keys = sorted(series)
    kept = [series[key].sample.read().get("value", np.empty(0)) for key in keys]
    least, largest = min(one.least for one in series.values()), max(one.largest for one in series.values())
    everything = np.concatenate(kept)
    low, high = limits or _choose_limits(kept, least, largest, facts.step)
    edges = place_edges(everything, low, high, facts.step, bins, exact=limits is not None)
    place = {key: row for row, key in enumerate(keys)}
    place |= {key: place[other] for key, other in merged.items()}
    counts, below, above = _count(columns, edges, place, each, by)
    percentiles = [np.percentile(values, PERCENTILES) if len(values) else np.full(3, np.nan) for values in kept]
    means = [one.total / one.values if one.values else math.nan for one in map(series.get, keys)]
    names = tuple(_name_series(key, columns, paths, each, by) for key in keys)
    clouds = tuple(path.name for path in paths)
    values = np.array([series[key].values for key in keys])
    return Histogram(
        facts, names, clouds, edges, counts, below, above, values, total, np.stack(percentiles), np.array(means)
    )


_Key = tuple[int, int, float]
"""Number of the column, of the cloud (0 if all are one), and value of the group (0 without groups)."""


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


def _check_columns(where: str, columns: Sequence[Clouds]) -> ColumnFacts:
    """Facts for all columns together; the step is 0 where columns differ in it."""
    first = columns[0].facts
    for clouds in columns:
        if clouds.facts.is_flags:
            raise ConfigError(f"{where}: {clouds.facts.name} are bits: there is no histogram of their values")
        if clouds.facts.unit != first.unit:
            raise ConfigError(
                f"{where}: {clouds.facts.name} is in [{clouds.facts.unit}], {first.name} in [{first.unit}]: one axis "
                "cannot show both"
            )
    if len(columns) == 1:
        return first
    same = len({clouds.facts.step for clouds in columns}) == 1
    names = ", ".join(clouds.facts.name for clouds in columns)
    return ColumnFacts(names, first.unit, "", first.step if same else 0.0)


def _read_groups(
    columns: Sequence[Clouds], each: bool, by: str | None
) -> Iterator[tuple[Tally, int, dict[_Key, np.ndarray]]]:
    """Pieces of all columns: counts, number of the cloud, and the values of each series."""
    for column, clouds in enumerate(columns):
        for cloud, rows, tally in clouds.read():
            values, start = rows["values"][:, 0], (column, cloud if each else 0)
            if by is None:
                yield tally, cloud, {(*start, 0.0): values}
                continue
            group = np.where(np.isnan(rows["values"][:, 1]), _UNKNOWN, rows["values"][:, 1])
            yield tally, cloud, {(*start, one): values[group == one] for one in np.unique(group).tolist()}


_SMALL = math.inf
"""Group of all values that few points have."""

_UNKNOWN = -math.inf
"""Group of points without data in the column of --by: NaN is not equal to itself, so it is no key."""


def _survey(columns: Sequence[Clouds], each: bool, by: str | None) -> tuple[dict[_Key, _Series], Tally]:
    """The first pass: counts, limits and samples of every series, and the counts of all points."""
    found: dict[_Key, _Series] = {}
    total = Tally()
    if by is not None and columns[0].other_facts[0].is_flags:
        raise ConfigError(f"{columns[0].paths[0]}: {by} are bits and form no groups; --flags selects them")
    for tally, cloud, groups in _read_groups(columns, each, by):
        total += tally
        for key, values in groups.items():
            found.setdefault(key, _Series()).add(values)
        if len({key[2] for key in found}) > MOST_GROUPS:
            raise ConfigError(
                f"{columns[0].paths[cloud]}: {by} has more than {MOST_GROUPS} different values; --by is for columns "
                "with few, like number_of_returns or classification"
            )
    return found, total


def _merge_small(series: dict[_Key, _Series]) -> tuple[dict[_Key, _Series], dict[_Key, _Key]]:
    """Series in which small groups are one, if there are several; and that one for each of them."""
    merged: dict[_Key, _Key] = {}
    for column, cloud in {key[:2] for key in series}:
        small = [key for key, one in series.items() if key[:2] == (column, cloud) and one.values < SMALL_GROUP]
        if len(small) > 1:
            merged |= dict.fromkeys(small, (column, cloud, _SMALL))
    # Nothing but small groups: they are all that there is to see.
    if len(merged) == len(series):
        return series, {}
    found = {key: one for key, one in series.items() if key not in merged}
    for key, other in sorted(merged.items()):
        found.setdefault(other, _Series()).add(series[key].sample.read().get("value", np.empty(0)))
    return found, merged


def _choose_limits(samples: Sequence[np.ndarray], least: float, largest: float, step: float) -> tuple[float, float]:
    """All values of a column with few steps, like classes; else without the rare far ones."""
    if step > 0 and (largest - least) / step <= FEW_STEPS:
        return least, largest
    return shown_limits(samples, least, largest)


def _name_series(key: _Key, columns: Sequence[Clouds], paths: Sequence[Path], each: bool, by: str | None) -> str:
    column, cloud, group = key
    parts = [columns[column].facts.name] if len(columns) > 1 else []
    if each and len(paths) > 1:
        parts.append(name_paths(paths)[cloud])
    if by is not None:
        parts.append(_name_group(columns[0].other_facts[0].name, group))
    return " ".join(parts) or (paths[0].name if len(paths) == 1 else f"{len(paths)} clouds")


def _name_group(column: str, value: float) -> str:
    if value == _SMALL:
        return f"{column} with fewer than {SMALL_GROUP} points each"
    if value == _UNKNOWN:
        return f"no {column}"
    meaning = CLASS_NAMES.get(int(value), "") if column in ("classification", "raw_classification") else ""
    return f"{column} {value:g}" + (f" ({meaning})" if meaning else "")


def _count(
    columns: Sequence[Clouds], edges: np.ndarray, place: Mapping[_Key, int], each: bool, by: str | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The second pass: counts per series and bin, and values below and above; place: row of each group."""
    number = len(set(place.values()))
    # The first and the last column count what lies below and above.
    counts = np.zeros((number, len(edges) + 1), np.int64)
    for _, _, groups in _read_groups(columns, each, by):
        for key, values in groups.items():
            at = np.searchsorted(edges, values, side="right")
            at[values == edges[-1]] = len(edges) - 1
            counts[place[key]] += np.bincount(at, minlength=len(edges) + 1)
    return counts[:, 1:-1], counts[:, 0], counts[:, -1]


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
        flags = rows["values"][:, 0].astype(np.uint16)
        counts += [int(np.count_nonzero(flags & np.uint16(flag))) for flag in EchoFlag]
        clean += int(np.count_nonzero(flags == 0))
    if not total.values:
        raise clouds.complain(total)
    names = tuple(path.name for path in paths)
    return FlagCounts(clouds.facts, names, tuple(flag.name for flag in EchoFlag), counts, clean, total)
