"""Pictures of waveforms with their fit, residual and echoes, large or as a contact sheet, drawn with matplotlib.

`wavebatch plot waveform` calls `draw_waveform_panels` with the views of `waveform.read_views`. Style and files are
those of `files.figure_file`; the same views give the same bytes.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from wavebatch.core.echoes import EchoFlag
from wavebatch.files.figure_file import fit_parts, fit_text, open_picture, plain_text, set_head
from wavebatch.kernels.signal.runs import find_stretches
from wavebatch.tools.plots.waveform import WaveformView, list_echoes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.gridspec import SubplotSpec


INK, GREY = "#222222", "#8a8a8a"
FIT, PULSE, ECHO, VENDOR, CLIPPED = "#0072b2", "#56b4e9", "#d55e00", "#009e73", "#e69f00"
"""Colours of Okabe and Ito, which colour-blind readers can distinguish."""

_LONGEST_BAR = 1e6
"""Longer error bars leave every panel all the same, and could overflow [ns, DN]."""

_MANY = 150
"""Waveforms with more samples get smaller dots."""
_LEAST_SCALE = 5.0
"""Least half height of a residual panel [noise std]: pure noise then looks small."""
_ERROR_ROOM = 0.5
"""Error bars may widen the signal panel by this share of the signal on each side; longer ones are cut."""
_DASHED = (0, (4, 2))
_LEGEND = (
    "samples", "baseline \N{PLUS-MINUS SIGN} noise", "fit", "one echo", "echoes", "returns of the file", "not recorded",
    "saturated samples", "detector's threshold", "found by the detector",
)  # fmt: skip
"""Labels of the artists, in the order of the legend."""
_LETTER = 0.085
"""Width of a letter of a title [inches]."""


def draw_waveform_panels(
    views: Sequence[WaveformView],
    target: Path,
    *,
    strip: str,
    chain: str,
    times: tuple[float, float] | None = None,
    table: bool = False,
    overwrite: bool = False,
) -> None:
    """Writes a picture of one waveform, or of several as small multiples.

    strip, chain: for the title. times: part to show [ns]; None: each waveform's part with signal. table: list the
    echoes below; those of a single waveform always are. Raises as figure_file.open_picture does.
    """
    columns = len(views) if len(views) <= 3 else math.ceil(math.sqrt(len(views)))
    rows = -(-len(views) // columns)
    small = len(views) > 1
    text = list_echoes(views) if table or not small else ""
    seen = any(view.seen is not None for view in views)
    width = max(4.3 * columns, 7.5) if small else 9.0
    height = (3.3 + 1.2 * seen) * rows + 0.8 if small else 5.4 + 1.4 * seen
    # The table gets a row as high as its lines.
    below = 0.155 * (text.count("\n") + 1) if text else 0.0
    width = max(width, 0.0665 * max(map(len, text.split("\n"))) + 0.4) if text else width
    room = (width - 0.8) / columns - 0.5
    # And a title gets its lines: panels keep their height.
    flags = max(sum(len(part) + 3 for part in _list_flags(view)) for view in views)
    height += 0.16 * rows * int(_LETTER * flags / room)
    with open_picture(target, (width, height + below), overwrite=overwrite) as figure:
        set_head(figure, (plain_text(strip), plain_text(chain, 300)), size=11, weight="bold")
        outer = figure.add_gridspec(2, 1, height_ratios=(height - 0.9, below)) if text else figure.add_gridspec(1, 1)
        inner = outer[0].subgridspec(rows, columns)
        panels = []
        for number, view in enumerate(views):
            panel = _draw_panels(figure, inner[number], view, times or view.span, small=small, room=room)
            if number % columns == 0:
                panel[0].set_ylabel("signal [DN]")
                panel[-1].set_ylabel("residual\n[noise std]")
                if view.seen is not None:
                    # Narrow panels: longer lines would run into the labels above and below.
                    panel[1].set_ylabel(textwrap.fill(view.seen.label, 15))
            if number + columns >= len(views):
                panel[-1].set_xlabel("time after the first sample [ns]")
            panels.append(panel[0])
        figure.align_ylabels()
        if text:
            axes = figure.add_subplot(outer[1])
            axes.set_axis_off()
            note = axes.text(0.0, 1.0, text, va="top", family="monospace", fontsize=8, linespacing=1.3)
            note.set_in_layout(False)
        # One legend for all panels, with the items that occur in them.
        found = [pair for axes in figure.axes for pair in zip(*axes.get_legend_handles_labels(), strict=True)]
        items = {label: handle for handle, label in reversed(found)}
        items = {label: items[label] for label in _LEGEND if label in items}
        lines = max(int(-(-len(items) * 1.35 // width)), 1)
        figure.legend(items.values(), items, loc="outside lower left", ncols=-(-len(items) // lines))
        # The panels must have their final size before labels can be placed.
        figure.draw_without_rendering()
        for axes, view in zip(panels, views, strict=True):
            _number_echoes(axes, view, small=small)


def _draw_panels(
    figure: Figure, place: SubplotSpec, view: WaveformView, times: tuple[float, float], *, small: bool, room: float
) -> list[Axes]:
    """Draws signal, what the detector saw, and residual, one below the other; room: for the title [inches]."""
    heights = (3, 1) if view.seen is None else (3, 1.5, 1)
    inner = place.subgridspec(len(heights), 1, height_ratios=heights, hspace=0.04)
    panels = [figure.add_subplot(inner[0])]
    panels += [figure.add_subplot(inner[row], sharex=panels[0]) for row in range(1, len(heights))]
    axes = panels[0]
    axes.tick_params(labelbottom=False)
    axes.axhspan(view.baseline - view.std, view.baseline + view.std, color="#e6e6e6", zorder=0, label=_LEGEND[1])
    level = view.fine_level
    for curve in view.curves:
        low = level[curve.part]
        axes.fill_between(view.fine[curve.part], low, low + curve.height, color=PULSE, alpha=0.15, linewidth=0)
    draw_samples(axes, view, times, dot=(2.4 if small else 3.4) * (1.0 if len(view.time) <= _MANY else 0.6))
    shown = (view.echoes.time >= times[0]) & (view.echoes.time <= times[1])
    time, amplitude = (
        np.minimum(np.nan_to_num(error[shown].astype(np.float64)), _LONGEST_BAR)
        for error in (view.echoes.time_err, view.echoes.amplitude_err)
    )
    axes.errorbar(view.echoes.time[shown].astype(np.float64), find_echo_heights(view)[shown], yerr=amplitude, xerr=time,
                  fmt="D", markersize=4, markerfacecolor="none", color=ECHO, capsize=2, zorder=4, label="echoes")
    fit_signal_panel(axes, view, times)
    seen = view.seen
    if seen is not None:  # what the detector saw, its threshold, and where it found echoes
        axes = panels[1]
        axes.tick_params(labelbottom=False)
        axes.plot(seen.time, seen.values, color=INK, linewidth=1.0)
        tested = seen.values if seen.second is None else seen.second
        if seen.second is not None:
            axes.plot(seen.time, seen.second, color=PULSE, linewidth=0.9)
        found = seen.found.time.astype(np.float64)
        height = np.interp(found, seen.time, tested)
        if seen.deep:
            axes.vlines(found, height, height + seen.least, color=CLIPPED, linewidth=2.0, label="detector's threshold")
            # Strong echoes are so much deeper than the threshold that a bar alone would not be seen.
            axes.plot(found, height + seen.least, "_", color=CLIPPED, markersize=11, markeredgewidth=2.0, zorder=4)
        elif np.isfinite(seen.least):
            axes.axhline(float(seen.least), color=CLIPPED, linewidth=1.0, linestyle=_DASHED,
                         label="detector's threshold")  # fmt: skip
        axes.plot(found, height, "^" if seen.deep else "v", color=ECHO, markersize=5, markerfacecolor="none", zorder=4,
                  label="found by the detector")  # fmt: skip
        rule = seen.rule + (f"; blue: {seen.second_label}" if seen.second_label else "")
        wrapped = textwrap.fill(rule, 52 if small else 110)
        inside = (seen.time >= times[0]) & (seen.time <= times[1])
        lines = [line[inside] for line in (seen.values, tested)] + [np.atleast_1d(0.0 if seen.deep else seen.least)]
        low, high = np.nanmin(np.concatenate(lines)), np.nanmax(np.concatenate(lines))
        span = float(high - low) or 1.0
        # Room above for the rule, which must not lie on the line.
        first, more = (0.4, 0.36) if small else (0.3, 0.22)
        axes.set_ylim(low - 0.08 * span, high + (first + more * wrapped.count("\n")) * span)
        axes.text(0.995, 0.97, wrapped, transform=axes.transAxes, ha="right", va="top", fontsize=7.5, color=GREY)
    _draw_residual(panels[-1], view, times)
    size = 9 if small else 10.5
    parts = [f"packet {view.packet}"] if view.packet >= 0 else []
    parts += [f"point {view.point}"] + ([] if small else [f"GPS time {view.gps_time:.6f} s"])
    if times[0] > 0.0 or times[1] < float(view.time[-1]):  # some samples are not shown
        parts.append(f"{max(times[0], 0):.0f} to {min(times[1], view.time[-1]):.0f} of {view.time[-1]:.0f} ns")
    lines = ["   ".join(parts)]
    if view.seen is not None:
        lines.append(view.seen.stage)
    lines = [fit_text(figure, "\n".join(lines), room, size=size),
             fit_parts(figure, _list_flags(view), room, size=size)]  # fmt: skip
    panels[0].set_title("\n".join(lines), fontsize=size)
    panels[-1].set_xlim(times)
    return panels


def _list_flags(view: WaveformView) -> list[str]:
    """Each flag with the numbers of the echoes that have it."""
    rows = {flag: [str(row) for row, bits in enumerate(view.echoes.flags.tolist(), 1) if bits & flag]
            for flag in EchoFlag}  # fmt: skip
    return [f"{flag.name} {','.join(found)}" for flag, found in rows.items() if found] or ["no flags"]


def draw_samples(axes: Axes, view: WaveformView, times: tuple[float, float], *, dot: float, thin: float = 1.0) -> None:
    """Draws baseline, gaps, returns, pulses, fit and samples; dot: size of a sample; thin: factor of all lines."""
    axes.axhline(view.baseline, color=GREY, linewidth=0.8 * thin, zorder=1)
    _, start, end = find_stretches(np.isnan(view.samples)[None])  # between two recordings of a packet
    for first, last in zip(start.tolist(), end.tolist(), strict=True):
        low, high = ((place - 0.5) * view.spacing for place in (first, last))
        axes.axvspan(low, high, facecolor="none", edgecolor="#cccccc", hatch="//", linewidth=0.0, zorder=0,
                     label="not recorded")  # fmt: skip
    for place in view.returns:
        axes.axvline(place, color=VENDOR, linewidth=thin, linestyle=_DASHED, zorder=1, label="returns of the file")
    # Up to the sample beyond each side: all of a long waveform would be most of a page.
    near = (view.fine >= times[0] - view.spacing) & (view.fine <= times[1] + view.spacing)
    level, fit = view.fine_level, view.fit
    for curve in view.curves:
        shown = curve.part.start + np.flatnonzero(near[curve.part])
        height = curve.height[shown - curve.first]
        axes.plot(view.fine[shown], level[shown] + height, color=PULSE, linewidth=0.9 * thin, label="one echo")
    if fit is not None:
        axes.plot(view.fine[near], fit[near], color=FIT, linewidth=1.5 * thin, label="fit")
    inside = (view.time >= times[0]) & (view.time <= times[1])
    free, full = inside & ~view.clipped, inside & view.clipped
    axes.plot(view.time[free], view.samples[free], "o", color=INK, markersize=dot, zorder=3, label="samples")
    if full.any():
        axes.plot(view.time[full], view.samples[full], "^", color=CLIPPED, markeredgecolor=INK, markersize=1.6 * dot,
                  markeredgewidth=0.6 * thin, zorder=3, label="saturated samples")  # fmt: skip


def find_echo_heights(view: WaveformView) -> np.ndarray:
    """Heights of the echoes in the signal panel [DN], f8 (k,)."""
    level = np.interp(view.echoes.time, view.time, view.level)
    return level + view.echoes.amplitude.astype(np.float64)


def _number_echoes(axes: Axes, view: WaveformView, *, small: bool) -> None:
    """Writes numbers above the echoes; one that would lie on the number before it is left out."""
    (low, high), size = axes.get_xlim(), 7.5 if small else 9.0
    room = 1.3 * size / 72 * axes.figure.dpi / axes.get_window_extent().width * (high - low)
    last = -np.inf
    peaks = zip(view.echoes.time.tolist(), find_echo_heights(view).tolist(), strict=True)
    for row, (time, height) in enumerate(peaks, 1):
        if max(low, last + room * len(str(row))) <= time <= high:
            axes.annotate(str(row), (time, height), textcoords="offset points", xytext=(0, 5), ha="center",
                          annotation_clip=False, color=ECHO, fontsize=size, weight="bold").set_in_layout(False)
            last = time


def _draw_residual(axes: Axes, view: WaveformView, times: tuple[float, float], height: float | None = None) -> None:
    """Draws the residual of each sample as a line from 0.

    height: half that of a small panel [noise std], with larger residuals in red up to its edge; None: a large panel.
    """
    axes.axhspan(-1, 1, color="#e6e6e6", zorder=0)
    small = height is not None
    if not small:
        axes.axhline(0, color=GREY, linewidth=0.8, zorder=1)
    if view.residual is None:
        axes.set_ylim(-(height or _LEAST_SCALE), height or _LEAST_SCALE)
        if not small:
            axes.text(0.5, 0.5, "this chain fits no pulse", transform=axes.transAxes, ha="center", va="center",
                      color=GREY)  # fmt: skip
        return
    inside = (view.time >= times[0]) & (view.time <= times[1])
    time, residual = view.time[inside], view.residual[inside]
    height = height or max(_LEAST_SCALE, 1.1 * float(np.abs(residual[np.isfinite(residual)]).max(initial=0.0)))
    large = np.abs(residual) > height
    for rows, color in ((~large, FIT), (large, ECHO)):
        # One line with gaps: a line for each sample of long waveforms would take half a gigabyte.
        shown = np.clip(residual[rows], -height, height)
        heights = np.stack([np.zeros(len(shown)), shown, np.full(len(shown), np.nan)], axis=1)
        axes.plot(np.repeat(time[rows], 3), heights.ravel(), color=color, linewidth=0.7 if small else 0.8)
    if not small:
        axes.plot(time, residual, "o", color=FIT, markersize=2.0 if len(view.time) <= _MANY else 1.2)
        axes.yaxis.get_major_locator().set_params(nbins=4, integer=True, symmetric=True)
    axes.set_ylim(-height, height)


def fit_signal_panel(axes: Axes, view: WaveformView, times: tuple[float, float]) -> None:
    """Scales the signal panel to what is shown, with error bars up to half of its height."""
    echoes, samples, fine = (
        (time >= times[0]) & (time <= times[1]) for time in (view.echoes.time, view.time, view.fine)
    )
    peak, error = find_echo_heights(view)[echoes], np.nan_to_num(view.echoes.amplitude_err[echoes].astype(np.float64))
    values = [view.samples[samples], [view.baseline - view.std, view.baseline + view.std], peak]
    if view.fit is not None:
        values.append(view.fit[fine])
    shown = np.concatenate(values)
    low, high = float(np.nanmin(shown)), float(np.nanmax(shown))
    room = _ERROR_ROOM * (high - low)
    low = min(low, float((peak - np.minimum(error, room)).min(initial=low)))
    high = max(high, float((peak + np.minimum(error, room)).max(initial=high)), low + 6 * view.std)
    axes.set_ylim(low - 0.05 * (high - low), high + 0.17 * (high - low))


PANEL_SIZE = (2.3, 1.9)
"""Width and height of a small picture [inch]."""

HEAD, FOOT = 0.45, 0.25
"""Room for the title above and the legend below [inch]."""

SHARE = 0.28
"""Of a small picture's height for the residual."""

RESIDUAL = 4.0
"""Half the height of every residual panel [noise std]; larger residuals are drawn at its edge in red."""

LEGEND = (
    "dots: samples (triangles: saturated); dark line: fit; light: single echoes; diamonds: echoes; dashed: "
    f"returns of the file; below: residual, -{RESIDUAL:g} to {RESIDUAL:g} noise std; time in ns"
)

QUIET_FLAGS = EchoFlag.OVERLAPPED | EchoFlag.WEAK
"""Flags that are too common to be named."""


def draw_waveform_sheet(
    views: Sequence[WaveformView],
    target: Path,
    *,
    strip: str,
    chain: str,
    times: tuple[float, float] | None = None,
    overwrite: bool = False,
) -> None:
    """Writes a contact sheet, row by row in the order of `views`.

    Each picture is scaled to its samples; its title gives packet, strongest amplitude and flags. times: part to show
    in all [ns]; None: each is cut to its echoes and returns. Raises as figure_file.open_picture does.
    """
    columns = math.ceil(math.sqrt(len(views)))
    size = sheet_size(len(views), columns)
    with open_picture(target, size, overwrite=overwrite) as figure:
        # A layout for 200 axes takes a minute; a grid needs none.
        figure.set_layout_engine("none")
        draw_small_waveforms(figure, views, columns, times)
        parts = (plain_text(strip), plain_text(chain, 200), f"{len(views)} waveforms")
        title = fit_text(figure, "   ".join(parts), size[0] - 0.2, size=10, weight="bold")
        figure.text(0.1 / size[0], 1 - 0.1 / size[1], title, va="top", fontsize=10, weight="bold")
        legend = fit_parts(figure, LEGEND.split("; "), size[0] - 0.2, size=7)
        figure.text(0.1 / size[0], 0.06 / size[1], legend, va="bottom", fontsize=7, color=GREY)


def sheet_size(number: int, columns: int) -> tuple[float, float]:
    """Size of a sheet of so many pictures [inch]."""
    return PANEL_SIZE[0] * columns, PANEL_SIZE[1] * -(-number // columns) + HEAD + FOOT


def draw_small_waveforms(
    figure: Figure, views: Sequence[WaveformView], columns: int, times: tuple[float, float] | None = None,
    notes: Sequence[str] = (), head: float = HEAD,
) -> None:  # fmt: skip
    """Draws the pictures row by row, below a head [inch]; notes: a word for each title."""
    size = figure.get_size_inches()
    for number, view in enumerate(views):
        row, column = divmod(number, columns)
        left = (column * PANEL_SIZE[0] + 0.3) / size[0]
        bottom = (size[1] - head - (row + 1) * PANEL_SIZE[1] + 0.25) / size[1]
        width, height = (PANEL_SIZE[0] - 0.4) / size[0], (PANEL_SIZE[1] - 0.5) / size[1]
        upper = figure.add_axes((left, bottom + SHARE * height, width, (1 - SHARE) * height))
        lower = figure.add_axes((left, bottom, width, (SHARE - 0.03) * height), sharex=upper)
        shown = times or view.span
        draw_samples(upper, view, shown, dot=1.2, thin=0.55)
        upper.plot(view.echoes.time, find_echo_heights(view), "D", color=ECHO, markersize=3, markerfacecolor="none",
                   markeredgewidth=0.7)  # fmt: skip
        fit_signal_panel(upper, view, shown)
        _draw_residual(lower, view, shown, RESIDUAL)
        upper.set_xlim(shown)
        for axes in (upper, lower):
            axes.tick_params(labelsize=5.5, length=2, pad=1)
            axes.grid(False)
        upper.locator_params(nbins=4)
        upper.tick_params(labelbottom=False)
        lower.set_yticks([])
        name = f"packet {view.packet}" if view.packet >= 0 else f"point {view.point}"
        strongest = f"{view.echoes.amplitude.max():.0f} DN" if len(view.echoes) else "no echo"
        flags = EchoFlag(int(np.bitwise_or.reduce(view.echoes.flags, initial=0))) & ~QUIET_FLAGS
        names = ", ".join(flag.name for flag in flags)
        title = "   ".join(filter(None, (name, strongest, *notes[number : number + 1])))
        title = fit_text(figure, title + (f"\n{names}" if names else ""), PANEL_SIZE[0] - 0.45, size=6.5)
        upper.set_title(title, fontsize=6.5, pad=2)
