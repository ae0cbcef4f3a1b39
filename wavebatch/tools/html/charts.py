"""The pictures of the pages: pulse, histograms, values with errors, maps, sheets of waveforms; SVG by matplotlib.

Each function gives a <figure>, empty where matplotlib is not installed: `page` then says how to get the pictures.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from wavebatch.core.waveforms import SystemPulse
from wavebatch.files.figure_file import has_matplotlib, open_svg, plain_text
from wavebatch.kernels.fit.pulse_shape import GAUSSIAN, evaluate_pulse
from wavebatch.surveying.systems.shown import full_width, sample_pulse
from wavebatch.tools.html.markup import text
from wavebatch.tools.plots.draw_cloud import MARKERS, SERIES, add_colorbar, draw_cells
from wavebatch.tools.plots.draw_sheet import HEAD, LEGEND, draw_small_waveforms, sheet_size
from wavebatch.tools.plots.raster import Raster
from wavebatch.tools.plots.waveform import WaveformView

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SHOWN_SHARE = 0.001
"""Share of the values at each end that a histogram leaves out and counts in words."""

MOST_BARS = 60

SIZE = (4.2, 2.7)
"""Width and height of a chart [inch]."""

PLACE = (0.19, 0.18, 0.78, 0.69)
"""Of the axes in it: left, bottom, width and height."""

MAP_SIDE = 3.4
"""Most width and height of a map [inch]."""

SHEET_COLUMNS = 4


def picture(title: str, size: tuple[float, float], draw: Callable[[Figure], None], words: str = "") -> str:
    """A figure with its caption; nothing without matplotlib."""
    if not has_matplotlib():
        return ""
    with open_svg(size) as (figure, drawn):
        draw(figure)
    address = f"data:image/svg+xml;base64,{b64encode(drawn[0].encode()).decode()}"
    caption = f"<figcaption>{text(words)}</figcaption>" if words else ""
    wide, high = (round(96 * side) for side in size)
    return f'<figure><img alt="{text(title)}" width="{wide}" height="{high}" src="{address}">{caption}</figure>'


def chart(title: str, labels: tuple[str, str], draw: Callable[[Axes], None], words: str = "") -> str:
    """A figure of one chart with a title and labels of its axes."""

    def fill(figure: Figure) -> None:
        axes = figure.add_axes(PLACE)
        axes.set_title(plain_text(title, 60))
        axes.set_xlabel(plain_text(labels[0], 60))
        axes.set_ylabel(plain_text(labels[1], 40))
        draw(axes)

    return picture(title, SIZE, fill, words)


def figures(parts: Sequence[str], kind: str = "") -> str:
    """Figures side by side; those that could not be drawn are left out."""
    drawn = [part for part in parts if part]
    return f'<div class="figures {kind}">' + "\n".join(drawn) + "</div>" if drawn else ""


def chart_pulse(system: SystemPulse, spacing: float, title: str = "System pulse") -> str:
    """The pulse that is fitted, height 1 at its peak, with a Gaussian of its width and the distance of samples."""
    time, pulse = sample_pulse(system, spacing)
    gaussian = evaluate_pulse(GAUSSIAN, time / system.sigma_ref, np.float64(0.0), np.float64(1.0))[0]
    at = np.arange(np.ceil(time[0] / spacing), np.floor(time[-1] / spacing) + 1) * spacing

    def draw(axes: Axes) -> None:
        axes.plot(time, gaussian, "--", color="#8a8a8a", linewidth=1, label="Gaussian of the same width")
        axes.plot(time, pulse, color=SERIES[0], label="pulse of this strip")
        axes.plot(at, np.interp(at, time, pulse), "o", color=SERIES[0], markersize=2.5)
        axes.set(xlim=(time[0], time[-1]), ylim=(min(0.0, float(pulse.min())) - 0.05, 1.35))
        axes.legend(loc="upper right", fontsize=7.5, borderaxespad=0.2)

    words = f"Full width at half maximum {full_width(system):.3f} ns; dots are {spacing:g} ns apart, as samples are."
    return chart(title, ("time after the peak [ns]", "height"), draw, words)


def draw_sheet(views: Sequence[WaveformView], title: str, notes: Sequence[str] = ()) -> str:
    """Small pictures of waveforms; notes: a word on each."""
    columns = min(SHEET_COLUMNS, len(views)) or 1
    wide, high = sheet_size(len(views), columns)
    size = (wide, high - HEAD)
    draw = lambda figure: draw_small_waveforms(figure, views, columns, notes=notes, head=0.0)  # noqa: E731
    return picture(title, size, draw, LEGEND)


def draw_histogram(edges: np.ndarray, counts: np.ndarray, *, title: str, label: str, log: bool = False,
                   beyond: int = 0) -> str:  # fmt: skip
    """A histogram of counts i8 (b,) between edges (b + 1,) without its outermost values, which are counted.

    beyond: values outside of the edges, to be counted too.
    """
    borders, merged = merge_bins(edges, counts)
    total, shown = int(counts.sum()) + beyond, int(merged.sum())
    if not shown:
        return ""

    def draw(axes: Axes) -> None:
        axes.stairs(merged, borders, fill=True, color=SERIES[0], alpha=0.75)
        if log and borders[0] > 0:
            _scale_log(axes.set_xscale, axes.xaxis)
        axes.set(xlim=(borders[0], borders[-1]), ylim=(0, 1.06 * merged.max()))
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:,.0f}" if value == round(value) else "")

    words = f"{total:,} values; {total - shown:,} of them outside of the picture."
    return chart(title, (label, "number"), draw, words)


def merge_bins(edges: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """At most MOST_BARS bins without the outermost SHOWN_SHARE of the values at each end."""
    total = int(counts.sum())
    sums = np.cumsum(counts)
    first = int(np.searchsorted(sums, SHOWN_SHARE * total, side="right"))
    last = int(np.searchsorted(sums, (1 - SHOWN_SHARE) * total))
    first, last = min(first, last, len(counts) - 1), max(first, last)
    step = max(1, -(-(last - first + 1) // MOST_BARS))
    last = min(first + step * -(-(last - first + 1) // step), len(counts))
    return np.append(edges[first:last:step], edges[last]), np.add.reduceat(
        counts[first:last], np.arange(0, last - first, step)
    )


def _scale_log(scale: Callable[..., Any], axis: Any) -> None:
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    scale("log")
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=6))
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_formatter(NullFormatter())


def draw_counts(counts: Mapping[str, int] | Sequence[tuple[str, int]], *, title: str, label: str) -> str:
    """A bar per name, which are few and short."""
    rows = list(counts.items() if isinstance(counts, Mapping) else counts)

    def draw(axes: Axes) -> None:
        axes.bar(range(len(rows)), [number for _, number in rows], color=SERIES[0], alpha=0.75)
        axes.set_xticks(range(len(rows)), [name for name, _ in rows], fontsize=8)
        axes.grid(axis="x", visible=False)
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:,.0f}" if value == round(value) else "")

    return chart(title, (label, "number"), draw, "; ".join(f"{name}: {number:,}" for name, number in rows))


def draw_map(found: Raster, note: str = "") -> str:
    """A map: cells coloured from the 2nd to the 98th percentile, north up, equal scales; note: added to the caption."""
    grid = found.grid
    across, up = (MAP_SIDE * side / max(grid.columns, grid.rows) for side in (grid.columns, grid.rows))
    across, up = max(across, 0.8), max(up, 0.8)
    size = (across + 2.2, up + 1.0)
    west, east, south, north = grid.extent

    def draw(figure: Figure) -> None:
        axes = figure.add_axes((0.95 / size[0], 0.55 / size[1], across / size[0], up / size[1]))
        axes.set_title(f"{found.statistic} of {found.facts.name}", fontsize=9.5)
        shown = draw_cells(axes, found, (0, east - west, 0, north - south))
        place = figure.add_axes(((1.1 + across) / size[0], 0.55 / size[1], 0.12 / size[0], up / size[1]))
        label = found.label if found.statistic == "density" else f"{found.facts.name} [{found.facts.unit}]"
        add_colorbar(axes, shown, found.values, found.shown, label, length=up, flat=False, place=place)
        axes.locator_params(axis="x", nbins=4 if across > 1.5 else 1)
        axes.locator_params(axis="y", nbins=4 if up > 1.5 else 1)
        axes.set_xlabel(f"east [{found.crs.unit}]")
        axes.set_ylabel(f"north [{found.crs.unit}]")

    words = f"Cells of {grid.size:g} {found.crs.unit}; origin {west:.10g} E, {south:.10g} N{note}."
    return picture(f"{found.statistic} of {found.facts.name}", size, draw, words)


def draw_values(
    names: Sequence[str], values: Sequence[float], errors: Sequence[float], *, title: str, label: str
) -> str:
    """Values with their errors, side by side."""
    middle, spread = np.asarray(values, np.float64), np.nan_to_num(np.asarray(errors, np.float64))
    # Small constants: a power of ten in the label, so that ticks differ and stay short.
    largest = float(np.abs(middle).max())
    power = int(np.floor(np.log10(largest))) if largest else 0
    if abs(power) > 3:
        middle, spread, label = middle / 10.0**power, spread / 10.0**power, f"1e{power} {label}"

    def draw(axes: Axes) -> None:
        axes.errorbar(np.arange(len(names)) + 1, middle, yerr=spread, fmt="o", color=SERIES[0], capsize=3)
        axes.set_xticks(np.arange(len(names)) + 1)
        axes.margins(x=0.1, y=0.15)

    return chart(title, ("", label), draw, ", ".join(f"{place + 1}: {name}" for place, name in enumerate(names)))


def draw_scatter(rows: Sequence[tuple[str, float, float]], *, title: str, labels: tuple[str, str],
                 note: str = "") -> str:  # fmt: skip
    """Named points over two logarithmic axes, for example error against time; rows: name, x, y, all positive."""
    known = [row for row in rows if row[1] > 0 and row[2] > 0]
    if not known:
        return ""

    def draw(figure: Figure) -> None:
        axes = figure.add_axes((0.12, 0.14, 0.85, 0.77))
        axes.set(title=title, xlabel=labels[0], ylabel=labels[1])
        for set_scale, axis in ((axes.set_xscale, axes.xaxis), (axes.set_yscale, axes.yaxis)):
            _scale_log(set_scale, axis)
        for number, (name, x, y) in enumerate(known):
            marker = MARKERS[number // len(SERIES) % len(MARKERS)]
            axes.plot(x, y, marker, color=SERIES[number % len(SERIES)], label=name)
        axes.margins(0.2)
        axes.legend(fontsize=7.0)

    return picture(title, (5.6, 3.6), draw, note)


def figures_of(document: Mapping[str, Any]) -> list[str]:
    """Histograms of a report's `quality`: amplitudes and widths of all echoes, echoes per waveform."""
    parts = []
    for name, title, label in (("amplitude_dn", "Amplitude", "[DN]"), ("echo_width_ns", "Echo width", "[ns]")):
        one = document[name]["histogram"]
        counts = np.array(one["counts"], np.int64)
        edges = one["low"] * np.exp(one["log_step"] * (one["first_bin"] + np.arange(len(counts) + 1)))
        if counts.any():
            parts.append(draw_histogram(edges, counts, title=title, label=f"{title.lower()} {label}", log=True))
    per = document["echoes_per_waveform"]
    last = max((number for number, count in enumerate(per) if count), default=0)
    shown = [(f"{n}" if n < len(per) - 1 else f"{n} or more", count) for n, count in enumerate(per[: last + 1])]
    return [*parts, draw_counts(shown, title="Echoes per waveform", label="echoes")]
