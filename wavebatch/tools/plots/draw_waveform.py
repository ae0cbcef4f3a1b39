"""Pictures of waveforms with their fit, residual and echoes, drawn with matplotlib.

`wavebatch plot waveform` calls `draw_waveforms` with the views of `waveform.read_views`. Style and files are those of
`files.figure_file`; the same views give the same bytes.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from wavebatch.core.echoes import EchoFlag
from wavebatch.core.units import FWHM_PER_SIGMA
from wavebatch.files.figure_file import open_picture, plain_text
from wavebatch.kernels.signal.runs import find_stretches
from wavebatch.tools.plots.waveform import WaveformView

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.gridspec import SubplotSpec

INK, GREY = "#222222", "#8a8a8a"
FIT, PULSE, ECHO, VENDOR, CLIPPED = "#0072b2", "#56b4e9", "#d55e00", "#009e73", "#e69f00"
"""Colours of Okabe and Ito, which colour-blind readers can distinguish."""

_MOST_LISTED = 12
"""Most echoes in the table below a single waveform."""
_MANY = 150
"""Waveforms with more samples get smaller dots."""
_LEAST_SCALE = 5.0
"""Least half height of a residual panel [noise std]: pure noise then looks small."""
_DASHED = (0, (4, 2))


def draw_waveforms(
    views: Sequence[WaveformView],
    target: Path,
    *,
    strip: str,
    chain: str,
    times: tuple[float, float] | None = None,
    overwrite: bool = False,
) -> None:
    """Writes a picture of one waveform, or of several as small multiples.

    strip, chain: names for the title. times: part to show [ns]. Raises as figure_file.open_picture does.
    """
    columns = len(views) if len(views) <= 3 else math.ceil(math.sqrt(len(views)))
    rows = -(-len(views) // columns)
    table = _list_echoes(views[0]) if len(views) == 1 else ""
    # The table of a single waveform gets a row as high as its lines.
    below = 0.15 * (table.count("\n") + 1) if table else 0.0
    size = (9.0, 5.4 + below) if table else (max(4.3 * columns, 7.5), 3.3 * rows + 0.8)
    with open_picture(target, size, overwrite=overwrite) as figure:
        figure.suptitle(f"{plain_text(strip)}   {plain_text(chain, 40)}", x=0.01, ha="left", fontsize=11, weight="bold")
        heights = [size[1] - below - 0.9, below] if table else [1.0] * rows
        outer = figure.add_gridspec(len(heights), columns, height_ratios=heights)
        for number, view in enumerate(views):
            upper, lower = _draw_panels(figure, outer[number], view, times, small=not table)
            if number % columns == 0:
                upper.set_ylabel("signal [DN]")
                lower.set_ylabel("residual\n[noise std]")
            if number + columns >= len(views):
                lower.set_xlabel("time after the first sample [ns]")
        if table:
            axes = figure.add_subplot(outer[1])
            axes.set_axis_off()
            text = axes.text(0.0, 1.0, table, va="top", family="monospace", fontsize=8, linespacing=1.3)
            text.set_in_layout(False)
        _place_legend(figure, views)


def _draw_panels(
    figure: Figure, place: SubplotSpec, view: WaveformView, times: tuple[float, float] | None, *, small: bool
) -> tuple[Axes, Axes]:
    """Draws signal and residual, one above the other."""
    inner = place.subgridspec(2, 1, height_ratios=(3, 1), hspace=0.04)
    upper = figure.add_subplot(inner[0])
    lower = figure.add_subplot(inner[1], sharex=upper)
    _draw_signal(upper, view, small=small)
    _draw_residual(lower, view)
    upper.set_title(_title(view, short=small))
    lower.set_xlim(times or (-0.5 * view.spacing, view.time[-1] + 0.5 * view.spacing))
    _fit_height(upper, view, times or (-math.inf, math.inf))
    return upper, lower


def _title(view: WaveformView, *, short: bool) -> str:
    parts = [f"packet {view.packet}"] if view.packet >= 0 else []
    parts += [f"point {view.point}", f"GPS time {view.gps_time:.6f} s"]
    names = _name_flags(int(np.bitwise_or.reduce(view.echoes.flags, initial=0)))
    lines = textwrap.wrap(names or "no flags", 46 if short else 100)
    if short and len(lines) > 1:
        lines = [lines[0] + " ..."]
    return "\n".join(["   ".join(parts[:2] if short else parts), *lines])


def _name_flags(flags: int) -> str:
    return ", ".join(flag.name for flag in EchoFlag(flags))


def _draw_signal(axes: Axes, view: WaveformView, *, small: bool) -> None:
    axes.tick_params(labelbottom=False)
    axes.axhspan(view.baseline - view.std, view.baseline + view.std, color="#e6e6e6", zorder=0)
    axes.axhline(view.baseline, color=GREY, linewidth=0.8, zorder=1)
    shade_gaps(axes, view)
    level = view.fine_level
    for curve in view.curves:
        axes.fill_between(view.fine, level, level + curve, color=PULSE, alpha=0.15, linewidth=0)
        axes.plot(view.fine, level + curve, color=PULSE, linewidth=0.9)
    if view.fit is not None:
        axes.plot(view.fine, view.fit, color=FIT, linewidth=1.5)
    size = (2.4 if small else 3.4) * (1.0 if len(view.time) <= _MANY else 0.6)
    free = ~view.clipped
    axes.plot(view.time[free], view.samples[free], "o", color=INK, markersize=size, zorder=3)
    axes.plot(
        view.time[view.clipped], view.samples[view.clipped], "^", color=CLIPPED, markeredgecolor=INK,
        markersize=1.6 * size, markeredgewidth=0.6, zorder=3,
    )  # fmt: skip
    for place in view.returns:
        axes.axvline(place, color=VENDOR, linewidth=1.0, linestyle=_DASHED, zorder=1)
    _draw_echoes(axes, view, small=small)


def shade_gaps(axes: Axes, view: WaveformView) -> None:
    """Hatches the times between two recordings of a packet, at which nothing was recorded."""
    _, start, end = find_stretches(np.isnan(view.samples)[None])
    for first, last in zip(start.tolist(), end.tolist(), strict=True):
        low, high = ((place - 0.5) * view.spacing for place in (first, last))
        axes.axvspan(low, high, facecolor="none", edgecolor="#cccccc", hatch="//", linewidth=0.0, zorder=0)


def _draw_echoes(axes: Axes, view: WaveformView, *, small: bool) -> None:
    echoes = view.echoes
    if not len(echoes):
        return
    peak = np.interp(echoes.time, view.time, view.level) + echoes.amplitude.astype(np.float64)
    across, up = (np.nan_to_num(error.astype(np.float64)) for error in (echoes.time_err, echoes.amplitude_err))
    axes.errorbar(
        echoes.time, peak, xerr=across, yerr=up, fmt="D", markersize=4, markerfacecolor="none", color=ECHO,
        elinewidth=1.2, capsize=2, zorder=4,
    )  # fmt: skip
    for number, (time, height) in enumerate(zip(echoes.time, peak, strict=True), 1):
        axes.annotate(
            str(number), (time, height), xytext=(6, 2), textcoords="offset points", ha="left", va="bottom",
            color=ECHO, fontsize=7.5 if small else 9, weight="bold", annotation_clip=True,
        )  # fmt: skip


def _draw_residual(axes: Axes, view: WaveformView) -> None:
    axes.axhspan(-1, 1, color="#e6e6e6", zorder=0)
    axes.axhline(0, color=GREY, linewidth=0.8, zorder=1)
    if view.residual is None:
        axes.set_ylim(-_LEAST_SCALE, _LEAST_SCALE)
        axes.text(0.5, 0.5, "this chain fits no pulse", transform=axes.transAxes, ha="center", va="center", color=GREY)
        return
    axes.vlines(view.time, 0, view.residual, color=FIT, linewidth=0.8)
    axes.plot(view.time, view.residual, "o", color=FIT, markersize=2.0 if len(view.time) <= _MANY else 1.2)
    axes.yaxis.get_major_locator().set_params(nbins=4, integer=True, symmetric=True)
    known = np.abs(view.residual[np.isfinite(view.residual)])
    height = max(_LEAST_SCALE, 1.1 * float(known.max(initial=0.0)))
    axes.set_ylim(-height, height)


def _fit_height(axes: Axes, view: WaveformView, times: tuple[float, float]) -> None:
    """Scales the signal panel to the samples and the fit that are shown; long error bars may leave it."""

    def inside(time: np.ndarray) -> np.ndarray:
        return (time >= times[0]) & (time <= times[1])

    values = [view.samples[inside(view.time)], [view.baseline - view.std, view.baseline + view.std]]
    values.append(view.baseline + view.echoes.amplitude[inside(view.echoes.time)].astype(np.float64))
    if view.fit is not None:
        values.append(view.fit[inside(view.fine)])
    shown = np.concatenate(values)
    low, high = float(np.nanmin(shown)), float(np.nanmax(shown))
    axes.set_ylim(low - 0.05 * (high - low), high + 0.17 * (high - low))


def _list_echoes(view: WaveformView) -> str:
    """A table of the echoes, for a monospaced font."""
    echoes = view.echoes
    if not len(echoes):
        return "no echo"
    lines = [f"{'echo':>4}  {'time [ns]':>15}  {'amplitude [DN]':>15}  {'width [ns]':>15}  flags"]
    for row in range(min(len(echoes), _MOST_LISTED)):
        values = ((echoes.time, echoes.time_err, 1.0), (echoes.amplitude, echoes.amplitude_err, 1.0))
        values += ((echoes.sigma, echoes.sigma_err, FWHM_PER_SIGMA),)
        texts = [_measure(factor * value[row], factor * error[row]) for value, error, factor in values]
        front = f"{row + 1:>4}  " + "  ".join(f"{text:>15}" for text in texts) + "  "
        flags = textwrap.wrap(_name_flags(int(echoes.flags[row])) or "-", 58)
        lines += [(front if first is flags[0] else " " * len(front)) + first for first in flags]
    if len(echoes) > _MOST_LISTED:
        lines.append(f"and {len(echoes) - _MOST_LISTED} more")
    return "\n".join(lines)


def _measure(value: float, error: float) -> str:
    """`12.34 +- 0.05`, with two digits of the error."""
    if not (math.isfinite(error) and error > 0):
        return f"{value:.4g}"
    digits = min(max(1 - math.floor(math.log10(error)), 0), 6)
    return f"{value:.{digits}f} \N{PLUS-MINUS SIGN} {error:.{digits}f}"


def _place_legend(figure: Figure, views: Sequence[WaveformView]) -> None:
    """One legend for all panels, with the items that occur in them."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles = [
        Line2D([], [], marker="o", color=INK, linestyle="", markersize=3.4, label="samples"),
        Patch(color="#e6e6e6", label="baseline \N{PLUS-MINUS SIGN} noise"),
    ]
    if any(view.residual is not None for view in views):
        handles.append(Line2D([], [], color=FIT, linewidth=1.5, label="fit"))
        handles.append(Line2D([], [], color=PULSE, linewidth=0.9, label="one echo"))
    handles.append(Line2D([], [], marker="D", color=ECHO, markerfacecolor="none", markersize=4, label="echoes"))
    if any(len(view.returns) for view in views):
        handles.append(Line2D([], [], color=VENDOR, linestyle=_DASHED, label="returns of the file"))
    if any(np.isnan(view.samples).any() for view in views):
        handles.append(Patch(facecolor="none", edgecolor="#cccccc", hatch="//", linewidth=0.0, label="not recorded"))
    if any(view.clipped.any() for view in views):
        look = {"marker": "^", "color": CLIPPED, "markeredgecolor": INK, "linestyle": ""}
        handles.append(Line2D([], [], **look, label="saturated samples"))
    figure.legend(handles=handles, loc="outside lower left", ncols=len(handles))
