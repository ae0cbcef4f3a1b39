"""Pictures of clouds, drawn with matplotlib: histograms, counts of flags, maps.

`wavebatch plot histogram` and `wavebatch plot map` call these with the results of `histogram` and `rasters.cells`.
Style and files are those of `files.figure_file`; the same data give the same bytes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from wavebatch.files.figure_file import open_picture, plain_text
from wavebatch.tools.plots.histogram import PERCENTILES, FlagCounts, Histogram
from wavebatch.tools.plots.labels import fit_text, set_head, space_ticks
from wavebatch.tools.plots.values import Tally
from wavebatch.tools.rasters.cells import Raster

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SERIES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#8a8a8a")
"""Colours of Okabe and Ito, which colour-blind readers can distinguish; more than eight series repeat them."""

MARKERS = "os^Dv*"
"""Marks of points; each serves for a round of SERIES."""

MOST_TOGETHER = 6
"""Most series in one axes: more lines cannot be followed."""

FEWEST_IN_LINE = 5
"""Series of fewer values are points: two values make a line of two needles."""

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
    for series in range(len(found.counts)):
        _draw_series(axes, found, series, counts)
    whole = counts and not log
    text = _count_text if counts else "{:g}".format
    if log:
        axes.set_yscale("log")
    else:
        axes.set_ylim(bottom=0)
    axes.yaxis.set_major_formatter(lambda value, _: text(value) if not whole or value == round(value) else "")
    axes.ticklabel_format(axis="x", useOffset=False)
    axes.set_xlim(found.edges[0], found.edges[-1])
    axes.set_xlabel(fit_text(figure, plain_text(found.facts.label, 300), 7.0, size=9.5))
    width = f"{found.edges[1] - found.edges[0]:.4g}{_unit_text(found)}"
    axes.set_ylabel(f"{'values' if counts else 'share of the series'} per bin of {width} [{'-' if counts else '%'}]")
    rest = found.total.list_rest(int(found.below.sum()), "below the picture")
    above = int(found.above.sum())
    rest += [f"{above:,} above the picture"] * bool(above)
    axes.set_title(fit_text(figure, _title(found.clouds, found.total, found.facts.name, rest), 7.1, size=10.5))
    # Below the axes, where it covers no line.
    axes.legend(loc="upper left", bbox_to_anchor=(0.0, -0.15), borderaxespad=0.0, fontsize=8.0)


def _unit_text(found: Histogram) -> str:
    return "" if found.facts.unit == "-" else f" {plain_text(found.facts.unit)}"


def _draw_series(axes: Axes, found: Histogram, series: int, as_counts: bool) -> None:
    color = SERIES[series % len(SERIES)]
    style = "-" if series < len(SERIES) else (0, (3, 1))
    low_end, middle, high_end = found.percentiles[series]
    alone = len(found.counts) == 1
    number = int(found.values[series])
    counts = found.counts[series] if as_counts else found.counts[series] * (100.0 / max(number, 1))
    if alone:
        axes.stairs(counts, found.edges, fill=True, color=color, alpha=0.35)
    unit = _unit_text(found)
    low, median, high = (_value_text(value, found.edges) for value in found.percentiles[series])
    label = "" if alone else fit_text(axes.figure, f"{plain_text(found.names[series], 200)}: ", 3.6, size=8.0)
    text = f"{label}{number:,} values, mean {_value_text(found.means[series], found.edges)}, median {median}{unit}"
    if number < FEWEST_IN_LINE:
        filled, middles = np.flatnonzero(counts), 0.5 * (found.edges[:-1] + found.edges[1:])
        # A share of two values is a half: it would press all other series down.
        place = {} if as_counts else {"transform": axes.get_xaxis_transform()}
        height = counts[filled] if as_counts else np.full(len(filled), 0.02)
        axes.plot(middles[filled], height, "o", color=color, label=text, **place)
    else:
        axes.stairs(counts, found.edges, color=color, linewidth=1.2, linestyle=style, label=text)
    if math.isnan(middle):
        return
    axes.axvline(middle, color="#222222" if alone else color, linewidth=1.2, linestyle=(0, (5, 2)))
    if alone:
        axes.axvspan(low_end, high_end, color="#222222", alpha=0.06, linewidth=0, zorder=0,
                     label=f"{PERCENTILES[0]:g} to {PERCENTILES[2]:g} %: {low} to {high}{unit}")  # fmt: skip


def _value_text(value: float, edges: np.ndarray) -> str:
    """The value with digits down to a tenth of a bin."""
    digits = 1 - math.floor(math.log10(edges[1] - edges[0]))
    if math.isnan(value) or digits > 12 or abs(value) >= 1e15:
        return f"{value:.5g}"
    return f"{value:.{max(digits, 0)}f}"


def draw_flags(
    found: FlagCounts, target: Path, *, log: bool = False, overwrite: bool = False
) -> None:
    """Writes a picture of the points per flag; log: logarithmic axis of counts."""
    with open_picture(target, (8.0, 5.2), overwrite=overwrite) as figure:
        axes = figure.subplots()
        flags, counts = ["no flag", *found.names], np.array([found.clean, *found.counts.tolist()])
        place = np.arange(len(flags))
        axes.barh(place, counts, color=["#8a8a8a", *[SERIES[0]] * len(found.names)], height=0.7)
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
            figure.set_layout_engine("compressed")
        rest = found.total.list_rest(found.outside, "outside the map")
        parts = _title(found.names, found.total, found.facts.name, rest).replace("\n", "   ").split("   ")
        parts.append(f"{found.statistic} in cells of {grid.size:g} {found.crs.unit}")
        set_head(figure, [*parts, f"CRS: {plain_text(found.crs.name, 90) or 'not given'}"], size=10.5)
        axes, place = figure.subplots(1, 2, width_ratios=(1, 0.05)) if narrow else (figure.subplots(), None)
        axes.set_anchor("E" if narrow else "C")
        shown = draw_cells(axes, found, grid.extent)
        length = width if flat else height
        add_colorbar(axes, shown, found.values, found.shown, found.label, length=length, flat=flat, place=place)
        _place_ticks(axes, width, height, found.crs.unit)


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


def _place_ticks(axes: Axes, width: float, height: float, unit: str) -> None:
    """Places as many coordinates on the axes as fit; width, height: of the map [inches]."""
    narrow = width < 2.0
    space_ticks(axes.xaxis, width, 0.4 if narrow else 1.2)
    space_ticks(axes.yaxis, height, 0.5)
    if narrow:
        axes.tick_params(axis="x", labelrotation=90)
    axes.set_xlabel(f"x [{unit}]")
    axes.set_ylabel(f"y [{unit}]")


def _title(names: tuple[str, ...], total: Tally, column: str, rest: Sequence[str]) -> str:
    """Title: clouds, column, number of values, and points that are not shown, with the reason."""
    return f"{name_clouds(names)}   {plain_text(column, 60)}\n{', '.join([f'{total.values:,} values', *rest])}"


def name_clouds(names: tuple[str, ...]) -> str:
    return plain_text(names[0], 60) if len(names) == 1 else f"{len(names)} clouds"


def _count_text(value: float) -> str:
    return f"{value:,.0f}" if value >= 1 or value == 0 else f"{value:g}"
