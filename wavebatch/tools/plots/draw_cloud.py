"""Histograms of a column and counts of points per flag, over clouds of any size; pictures of both, and of maps.

`wavebatch plot histogram` calls `count_values` or `count_points_by_flag`, which read clouds twice: for the limits, then
for the counts. Style and files are those of `files.figure_file`; the same data give the same bytes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from wavebatch.core.echoes import EchoFlag
from wavebatch.core.errors import ConfigError
from wavebatch.core.frozen import frozen
from wavebatch.core.order import EvenSample
from wavebatch.files.cloud.point_filter import EVERY, PointFilter
from wavebatch.files.figure_file import fit_text, open_picture, plain_text, set_head, set_layout, space_ticks
from wavebatch.files.las.header import CLASS_NAMES
from wavebatch.tools.cells import CloudData, Clouds, Raster, Tally, name_paths, shown_limits

if TYPE_CHECKING:
    from matplotlib.axes import Axes

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


@frozen(eq=False)
class Histogram(CloudData):
    """A histogram of one or several series, which are clouds and groups, as far as there are several."""

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
    percentiles: np.ndarray
    """PERCENTILES of each series (series, 3), of all values inside and outside the edges; NaN without values. For more
    than a million values, those of an even sample."""
    means: np.ndarray
    """Mean of each series, of all values inside and outside the edges, f8 (series,); NaN without values."""


@frozen(eq=False)
class FlagCounts(CloudData):
    """Points per flag: the series are the flags."""

    clouds: tuple[str, ...]
    """Names of the clouds."""
    counts: np.ndarray
    """Points with each flag, i8 (16,)."""
    clean: int
    """Points without any flag."""


def count_values(
    paths: Sequence[Path],
    column: str,
    selection: PointFilter = EVERY,
    *,
    bins: int | None = None,
    limits: tuple[float, float] | None = None,
    each: bool = False,
    by: str | None = None,
) -> Histogram:
    """The histogram of a column of clouds, in bounded memory.

    bins: number of bins, by default from the rule of Freedman and Diaconis; a column with a fixed step gets at most as
    many, each a whole number of steps wide. limits: lowest and highest edge, by default those of `shown_limits`.
    each: one series per cloud instead of one for all. by: one series per value of this column.
    Raises InputError without any value, ConfigError for a column of flags, and more than MOST_GROUPS groups.
    """
    clouds = Clouds(paths, (column,) if by is None else (column, by), selection)
    if clouds.facts.is_flags:
        raise ConfigError(f"{paths[0]}: {clouds.facts.name} are bits: there is no histogram of their values")
    if by is not None and clouds.every[1].is_flags:
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
    names = []
    for cloud, group in keys:
        parts = [name_paths(clouds.paths)[cloud]] if each and len(clouds.paths) > 1 else []
        if by is not None:
            name = clouds.every[1].name
            meaning = CLASS_NAMES.get(int(group), "") if name.endswith("classification") and group >= 0 else ""
            known = f"{name} {group:g}" + (f" ({meaning})" if meaning else "")
            parts.append(f"no {name}" if group == _UNKNOWN else known)
        whole = clouds.paths[0].name if len(clouds.paths) == 1 else f"{len(clouds.paths)} clouds"
        names.append(" ".join(parts) or whole)
    return Histogram(
        clouds.facts,
        tuple(names),
        total,
        tuple(path.name for path in paths),
        edges,
        counts[:, 1:-1],
        below=counts[:, 0],
        above=counts[:, -1],
        values=np.array([series[key].values for key in keys]),
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


def count_points_by_flag(paths: Sequence[Path], column: str, selection: PointFilter = EVERY) -> FlagCounts:
    """Counts the points of the clouds per flag. Raises InputError without any point."""
    counts, clean, total = np.zeros(len(EchoFlag), np.int64), 0, Tally()
    clouds = Clouds(paths, (column,), selection)
    for _, rows, tally in clouds.read():
        total += tally
        flags = rows["values"][:, 0].astype(np.uint16)
        counts += [int(np.count_nonzero(flags & np.uint16(flag))) for flag in EchoFlag]
        clean += int(np.count_nonzero(flags == 0))
    if not total.values:
        raise clouds.complain(total)
    names = tuple(path.name for path in paths)
    return FlagCounts(clouds.facts, tuple(flag.name for flag in EchoFlag), total, names, counts, clean)


SERIES_COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#8a8a8a")
"""Colours of Okabe and Ito, which colour-blind readers can distinguish; more than eight series repeat them."""

MARKERS = "os^Dv*"
"""Marks of points; each serves for a round of SERIES_COLORS."""

MOST_TOGETHER = 6
"""Most series in one axes: more lines cannot be followed."""

_NARROW = 4.0
"""Maps so many times as high as wide have a separate place for the scale of colours: it would shrink with them."""

_LONG = 8.0
"""Longer side of a map [inches]."""


def draw_cloud_histogram(
    found: Histogram, target: Path, *, log: bool = False, counts: bool = False, overwrite: bool = False
) -> None:
    """Writes a picture of a histogram.

    Several series are drawn as shares of their values, so that small and large ones can be compared;
    more than MOST_TOGETHER side by side, each in axes for it alone.
    counts: as numbers of values all the same. log: logarithmic axis of counts. Raises as figure_file.open_picture does.
    """
    every = _split_series(found)
    columns = 1 if len(every) <= MOST_TOGETHER else 2
    rows, lines = -(-len(every) // columns), sum(len(found.names) + (len(found.names) == 1) for found in every)
    size = 8.0 * columns, 3.9 * rows + 0.3 + 0.2 * lines / columns
    with open_picture(target, size, overwrite=overwrite) as figure:
        panels = figure.subplots(rows, columns, squeeze=False).ravel()
        for axes, found in zip(panels, every, strict=False):
            _draw_histogram(axes, found, log=log, counts=counts or len(found.names) == 1)
        for axes in panels[len(every) :]:
            axes.set_axis_off()


def _split_series(found: Histogram) -> list[Histogram]:
    """The histogram, or one for each of its series where these are too many for one picture."""
    if len(found.names) <= MOST_TOGETHER:
        return [found]
    by_series = ("counts", "below", "above", "values", "percentiles", "means")
    parts = []
    for row, name in enumerate(found.names):
        rows = {key: getattr(found, key)[row : row + 1] for key in by_series}
        parts.append(replace(found, names=(name,), clouds=(name,), total=Tally(values=int(rows["values"][0])), **rows))
    return parts


def _draw_histogram(axes: Axes, found: Histogram, *, log: bool, counts: bool) -> None:
    figure = axes.figure
    unit = "" if found.facts.unit == "-" else f" {plain_text(found.facts.unit)}"
    alone = len(found.counts) == 1
    for series, (low_end, middle, high_end) in enumerate(found.percentiles):
        color = SERIES_COLORS[series % len(SERIES_COLORS)]
        style = "-" if series < len(SERIES_COLORS) else (0, (3, 1))
        number = int(found.values[series])
        shown = found.counts[series] if counts else found.counts[series] * (100.0 / max(number, 1))
        if alone:
            axes.stairs(shown, found.edges, fill=True, color=color, alpha=0.35)
        low, median, high = (_value_text(value, found.edges) for value in (low_end, middle, high_end))
        label = "" if alone else fit_text(figure, f"{plain_text(found.names[series], 200)}: ", 3.6, size=8.0)
        text = f"{label}{number:,} values, mean {_value_text(found.means[series], found.edges)}, median {median}{unit}"
        if number < FEWEST:  # than bins: each value would be a needle of a line
            filled, middles = np.flatnonzero(shown), 0.5 * (found.edges[:-1] + found.edges[1:])
            # A share of two values is a half: it would press all other series down.
            place = {} if counts else {"transform": axes.get_xaxis_transform()}
            height = shown[filled] if counts else np.full(len(filled), 0.02)
            axes.plot(middles[filled], height, "o", color=color, label=text, **place)
        else:
            axes.stairs(shown, found.edges, color=color, linewidth=1.2, linestyle=style, label=text)
        if math.isnan(middle):
            continue
        axes.axvline(middle, color="#222222" if alone else color, linewidth=1.2, linestyle=(0, (5, 2)))
        if alone:
            axes.axvspan(low_end, high_end, color="#222222", alpha=0.06, linewidth=0, zorder=0,
                         label=f"{PERCENTILES[0]:g} to {PERCENTILES[2]:g} %: {low} to {high}{unit}")  # fmt: skip
    whole = counts and not log
    tick = _count_text if counts else "{:g}".format
    if log:
        axes.set_yscale("log")
    else:
        axes.set_ylim(bottom=0)
    axes.yaxis.set_major_formatter(lambda value, _: tick(value) if not whole or value == round(value) else "")
    axes.ticklabel_format(axis="x", useOffset=False)
    axes.set_xlim(found.edges[0], found.edges[-1])
    axes.set_xlabel(fit_text(figure, plain_text(found.facts.label, 300), 7.0, size=9.5))
    width = f"{found.edges[1] - found.edges[0]:.4g}{unit}"
    axes.set_ylabel(f"{'values' if counts else 'share of the series'} per bin of {width} [{'-' if counts else '%'}]")
    rest = found.total.list_rest(int(found.below.sum()), "below the picture")
    above = int(found.above.sum())
    rest += [f"{above:,} above the picture"] * bool(above)
    axes.set_title(fit_text(figure, _title(found.clouds, found.total, found.facts.name, rest), 7.1, size=10.5))
    # Below the axes, where it covers no line.
    axes.legend(loc="upper left", bbox_to_anchor=(0.0, -0.15), borderaxespad=0.0, fontsize=8.0)


def _value_text(value: float, edges: np.ndarray) -> str:
    """The value with digits down to a tenth of a bin."""
    digits = 1 - math.floor(math.log10(edges[1] - edges[0]))
    if math.isnan(value) or digits > 12 or abs(value) >= 1e15:
        return f"{value:.5g}"
    return f"{value:.{max(digits, 0)}f}"


def draw_flags(found: FlagCounts, target: Path, *, log: bool = False, overwrite: bool = False) -> None:
    """Writes a picture of the points per flag; log: logarithmic axis of counts."""
    with open_picture(target, (8.0, 5.2), overwrite=overwrite) as figure:
        axes = figure.subplots()
        flags, counts = ["no flag", *found.names], np.array([found.clean, *found.counts.tolist()])
        place = np.arange(len(flags))
        axes.barh(place, counts, color=["#8a8a8a", *[SERIES_COLORS[0]] * len(found.names)], height=0.7)
        axes.set_yticks(place, flags)
        axes.invert_yaxis()
        axes.grid(axis="y", visible=False)
        total = max(found.total.values, 1)
        for at, count in zip(place, counts.tolist(), strict=True):
            text = f" {count:,}  ({count / total:.2%})" if count else " 0"
            axes.annotate(text, (count, at), va="center", fontsize=8.5, annotation_clip=False)
        if log:
            axes.set_xscale("symlog", linthresh=1.0)
        axes.set_xlim(0, max(int(counts.max(initial=1)), 1) * (10.0 if log else 1.25))
        axes.xaxis.set_major_formatter(lambda value, _: _count_text(value))
        axes.set_xlabel("points [-]")
        name = name_clouds(found.clouds)
        title = f"{name}   {plain_text(found.facts.name, 40)}\n"
        title += f"{found.total.values:,} points; a point may have several flags"
        axes.set_title(fit_text(figure, title, 6.0, size=10.5))


def draw_cloud_map(found: Raster, target: Path, *, overwrite: bool = False) -> None:
    """Writes a picture of a map. Raises as figure_file.open_picture does."""
    grid = found.grid
    ratio = grid.rows / grid.columns
    width, height = _LONG / max(ratio, 1.0), _LONG * min(ratio, 1.0)
    flat = ratio < 0.5
    size = (max(width + (1.2 if flat else 2.4), 5.0), max(height + (2.6 if flat else 1.8), 3.4))
    # At least as many pixels as cells, or the picture would skip some cells.
    dpi = float(np.clip(1.25 * max(grid.columns, grid.rows) / _LONG, 150, 400))
    with open_picture(target, size, overwrite=overwrite, dpi=dpi) as figure:
        narrow = ratio > _NARROW
        if not narrow:
            # Axes with equal scales do not fill their places; this layout brings the colour bar next to them.
            set_layout(figure, compress=True)
        rest = found.total.list_rest(found.outside, "outside the map")
        parts = _title(found.names, found.total, found.facts.name, rest).replace("\n", "   ").split("   ")
        parts.append(f"{found.statistic} in cells of {grid.size:g} {found.crs.unit}")
        set_head(figure, [*parts, f"CRS: {plain_text(found.crs.name, 90) or 'not given'}"], size=10.5)
        axes, place = figure.subplots(1, 2, width_ratios=(1, 0.05)) if narrow else (figure.subplots(), None)
        axes.set_anchor("E" if narrow else "C")
        shown = draw_cells(axes, found, grid.extent)
        length = width if flat else height
        add_colorbar(axes, shown, found.values, found.shown, found.label, length=length, flat=flat, place=place)
        # As many coordinates as fit.
        space_ticks(axes.xaxis, width, 0.4 if width < 2.0 else 1.2)
        space_ticks(axes.yaxis, height, 0.5)
        if width < 2.0:
            axes.tick_params(axis="x", labelrotation=90)
        axes.set(xlabel=f"x [{found.crs.unit}]", ylabel=f"y [{found.crs.unit}]")


def draw_cells(axes: Axes, found: Raster, extent: tuple[float, float, float, float]) -> Any:
    """Draws the cells of a map with equal scales and gives the image; cells without a value are grey."""
    axes.grid(visible=False)
    axes.set_facecolor("#f2f2f2")
    return axes.imshow(found.values.astype(np.float32), extent=extent, origin="lower", cmap="viridis",
                       interpolation="nearest", interpolation_stage="data", aspect="equal")  # fmt: skip


def add_colorbar(
    axes: Axes, shown: Any, values: np.ndarray, limits: tuple[float, float], label: str, *, length: float, flat: bool,
    place: Axes | None = None,
) -> None:  # fmt: skip
    """Scales the colours to the limits and adds their scale, of a length [inches], below the axes if flat, or in place.

    Arrows at its ends show that some values lie beyond.
    """
    low, high = limits if limits[1] > limits[0] else (limits[0] - 0.5, limits[0] + 0.5)
    shown.set_clim(low, high)
    known = values[np.isfinite(values)]
    ends = (known.min(initial=low) < low) + 2 * (known.max(initial=high) > high)
    shape = {"aspect": 40} if flat else {} if place else {"pad": 0.02}
    bar = axes.figure.colorbar(
        shown, ax=None if place else axes, cax=place, extend=("neither", "min", "max", "both")[ends], extendfrac=0.03,
        orientation="horizontal" if flat else "vertical", **shape,
    )  # fmt: skip
    bar.set_label(fit_text(axes.figure, plain_text(label, 300), max(length, 2.0), size=9.5))
    bar.outline.set_visible(False)


def _title(names: tuple[str, ...], total: Tally, column: str, rest: Sequence[str]) -> str:
    """Title: clouds, column, number of values, and points that are not shown, with the reason."""
    return f"{name_clouds(names)}   {plain_text(column, 60)}\n{', '.join([f'{total.values:,} values', *rest])}"


def name_clouds(names: tuple[str, ...]) -> str:
    return plain_text(names[0], 60) if len(names) == 1 else f"{len(names)} clouds"


def _count_text(value: float) -> str:
    return f"{value:,.0f}" if value >= 1 or value == 0 else f"{value:g}"
