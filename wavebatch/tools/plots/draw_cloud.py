"""Pictures of clouds, drawn with matplotlib: histograms, counts of flags, maps.

`wavebatch plot histogram` and `wavebatch plot map` call these with the results of `histogram` and `raster`. Style and
files are those of `files.figure_file`; the same data give the same bytes.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from wavebatch.files.figure_file import open_picture, plain_text
from wavebatch.tools.plots.histogram import PERCENTILES, FlagCounts, Histogram
from wavebatch.tools.plots.raster import Raster
from wavebatch.tools.plots.values import Tally

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SERIES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#8a8a8a")
"""Colours of Okabe and Ito, which colour-blind readers can distinguish; more than eight series repeat them."""

_LONG = 8.0
"""Longer side of a map [inches]."""


def draw_histogram(found: Histogram, target: Path, *, log: bool = False, overwrite: bool = False) -> None:
    """Writes a picture of a histogram; log: logarithmic axis of counts. Raises as figure_file.open_picture does."""
    with open_picture(target, (8.0, 4.8), overwrite=overwrite) as figure:
        axes = figure.subplots()
        for series, counts in enumerate(found.counts):
            _draw_series(axes, found, series, counts)
        if log:
            axes.set_yscale("log")
            axes.yaxis.set_major_formatter(lambda value, _: _count_text(value))
        else:
            axes.yaxis.set_major_formatter(lambda value, _: _count_text(value) if value == round(value) else "")
            axes.set_ylim(bottom=0)
        axes.ticklabel_format(axis="x", useOffset=False)
        axes.set_xlim(found.edges[0], found.edges[-1])
        axes.set_xlabel(plain_text(found.facts.label, 110))
        unit = "" if found.facts.unit == "-" else f" {plain_text(found.facts.unit)}"
        axes.set_ylabel(f"values per bin of {found.edges[1] - found.edges[0]:.4g}{unit} [-]")
        axes.set_title(_title(found.names, found.total, found.facts.name, int(found.below.sum() + found.above.sum())))
        axes.legend()


def _draw_series(axes: Axes, found: Histogram, series: int, counts: np.ndarray) -> None:
    color = SERIES[series % len(SERIES)]
    low_end, middle, high_end = found.percentiles[series]
    alone = len(found.counts) == 1
    label = f"{plain_text(found.names[series], 40)}: " if not alone else ""
    if alone:
        axes.stairs(counts, found.edges, fill=True, color=color, alpha=0.35)
    unit = "" if found.facts.unit == "-" else f" {plain_text(found.facts.unit)}"
    low, median, high = (_value_text(value, found.edges) for value in found.percentiles[series])
    text = f"{label}{found.tallies[series].values:,} values, median {median}{unit}"
    axes.stairs(counts, found.edges, color=color, linewidth=1.2, label=text)
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
    found: FlagCounts, target: Path, *, names: tuple[str, ...], log: bool = False, overwrite: bool = False
) -> None:
    """Writes a picture of the points per flag; names: of the clouds; log: logarithmic axis of counts."""
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
        name = _name_clouds(names)
        axes.set_title(f"{name}   {found.facts.name}\n{found.total.values:,} points; a point may have several flags")


def draw_map(found: Raster, target: Path, *, names: tuple[str, ...], overwrite: bool = False) -> None:
    """Writes a picture of a map; names: of the clouds. Raises as figure_file.open_picture does."""
    grid = found.grid
    ratio = grid.rows / grid.columns
    width, height = _LONG / max(ratio, 1.0), _LONG * min(ratio, 1.0)
    flat = ratio < 0.5
    size = (max(width + (1.2 if flat else 2.4), 6.0), max(height + (2.6 if flat else 1.5), 3.0))
    # At least as many pixels as cells, or the picture would skip some cells.
    dpi = float(np.clip(1.25 * max(grid.columns, grid.rows) / _LONG, 150, 400))
    with open_picture(target, size, overwrite=overwrite, dpi=dpi) as figure:
        title = _title(names, found.total, found.facts.name, found.outside)
        figure.suptitle(f"{title}\n{found.statistic} in cells of {grid.size:g} m", x=0.01, ha="left", fontsize=10.5)
        axes = figure.subplots()
        axes.grid(visible=False)
        axes.set_facecolor("#f2f2f2")
        low, high = found.shown if found.shown[1] > found.shown[0] else (found.shown[0] - 0.5, found.shown[0] + 0.5)
        shown = axes.imshow(
            found.values.astype(np.float32), extent=grid.extent, origin="lower", cmap="viridis", vmin=low, vmax=high,
            interpolation="nearest", interpolation_stage="data", aspect="equal",
        )  # fmt: skip
        known = found.values[np.isfinite(found.values)]
        ends = (known.min(initial=low) < low) + 2 * (known.max(initial=high) > high)
        bar = figure.colorbar(
            shown, ax=axes, extend=("neither", "min", "max", "both")[ends], extendfrac=0.03,
            orientation="horizontal" if flat else "vertical", **({"aspect": 40} if flat else {"pad": 0.02}),
        )  # fmt: skip
        bar.set_label(plain_text(found.label, 90))
        bar.outline.set_visible(False)
        _place_ticks(axes, width, height)


def _place_ticks(axes: Axes, width: float, height: float) -> None:
    """Places as many coordinates on the axes as fit; width, height: of the map [inches]."""
    narrow = width < 2.0
    for axis, length, each in ((axes.xaxis, width, 0.4 if narrow else 1.2), (axes.yaxis, height, 0.5)):
        if length < 0.4:
            axis.set_ticks([axis.get_view_interval()[0]])
        else:
            axis.get_major_locator().set_params(nbins=int(np.clip(length / each, 1, 8)))
        axis.set_major_formatter(lambda value, _: f"{value:.10g}")
    if narrow:
        axes.tick_params(axis="x", labelrotation=90)
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")


def _title(names: tuple[str, ...], total: Tally, column: str, outside: int) -> str:
    """Title: clouds, column, number of values, and points that are not shown, with the reason."""
    rest = {"without data": total.no_data, "left out by flags": total.left_out, "outside the picture": outside}
    parts = [f"{total.values:,} values", *(f"{number:,} {text}" for text, number in rest.items() if number)]
    return f"{_name_clouds(names)}   {plain_text(column, 40)}\n{', '.join(parts)}"


def _name_clouds(names: tuple[str, ...]) -> str:
    return plain_text(names[0], 60) if len(names) == 1 else f"{len(names)} clouds"


def _count_text(value: float) -> str:
    return f"{value:,.0f}" if value >= 1 or value == 0 else f"{value:g}"
