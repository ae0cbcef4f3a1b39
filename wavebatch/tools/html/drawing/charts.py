"""The figures of the pages: pulse, waveform, histograms, maps, values with errors. Each function gives a <figure>."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from wavebatch.core.echoes import EchoFlag
from wavebatch.core.units import FWHM_PER_SIGMA, format_measure
from wavebatch.core.waveforms import SystemPulse
from wavebatch.kernels.fit.pulse_shape import GAUSSIAN, evaluate_pulse
from wavebatch.stages.pulse_tables import model_parameters, pulse_shape, shape_limits
from wavebatch.tools.html.drawing.png import color_cells, image_address
from wavebatch.tools.html.drawing.svg import Axis, Chart, tick_label
from wavebatch.tools.html.markup import text

if TYPE_CHECKING:
    from wavebatch.tools.plots.waveform import WaveformView

SHOWN_SHARE = 0.001
"""Share of the values at each end that a histogram leaves out and counts in words."""

MOST_BARS = 60

FINEST = 160
"""Points of a fitted curve, about."""


@dataclass(frozen=True, slots=True, eq=False)
class CloudMap:
    """A map of a column."""

    title: str
    unit: str
    values: np.ndarray
    """f8 (rows, columns), the first row is the southernmost; NaN without a value."""
    extent: tuple[float, float, float, float]
    """West, east, south, north."""
    size: float
    """Side of a cell."""
    length: str
    """Unit of both."""
    shown: tuple[float, float]
    """Values at the ends of the colour scale."""
    note: str
    """What is left out; empty, or text that begins with a semicolon."""


def figure(picture: str, words: str = "") -> str:
    """A figure with its caption."""
    caption = f"<figcaption>{text(words)}</figcaption>" if words else ""
    return f"<figure>{picture}{caption}</figure>"


def figures(parts: Sequence[str], kind: str = "") -> str:
    """Figures side by side."""
    return f'<div class="figures {kind}">' + "\n".join(parts) + "</div>" if parts else ""


def draw_pulse(system: SystemPulse, spacing: float, title: str = "System pulse") -> str:
    """The pulse that is fitted, height 1 at its peak, with a Gaussian of its width and the distance of samples."""
    wide = 4 * system.sigma_ref
    delays = [delay + 3 * sigma for _, delay, sigma in system.components]
    time = np.linspace(-wide, max([2 * wide, *delays]), 400)
    shape = pulse_shape(system, spacing)
    described = np.array([[1.0, 0.0, system.sigma_ref / spacing]])
    amplitude, centre, width = model_parameters(shape, shape_limits(system, spacing), described).T
    pulse = float(amplitude[0]) * evaluate_pulse(shape, time / spacing, centre[0], width[0])[0]
    gaussian = evaluate_pulse(GAUSSIAN, time / system.sigma_ref, np.float64(0.0), np.float64(1.0))[0]
    low = min(0.0, float(pulse.min()))
    chart = Chart(Axis(time[0], time[-1]), Axis(low - 0.05, 1.1), title=title, labels=("ns after the peak", "height"))
    chart.line(time, np.zeros_like(time), "x", kind="thin")
    chart.line(time, gaussian, "x", kind="dash", name="Gaussian of the same width")
    chart.line(time, pulse, 0, name="pulse of this strip")
    at = np.arange(np.ceil(time[0] / spacing), np.floor(time[-1] / spacing) + 1) * spacing
    chart.points(at, np.interp(at, time, pulse), 0, radius=2)
    full = system.sigma_ref * FWHM_PER_SIGMA
    words = f"Full width at half maximum {full:.3f} ns; dots are {spacing:g} ns apart, as samples are."
    return figure(chart.render(), words)


def draw_waveform(view: WaveformView, note: str = "") -> str:
    """A small picture of a waveform: samples, fit, echoes (up) and returns of the input (below)."""
    near = view.span
    inside = (view.time >= near[0]) & (view.time <= near[1])
    shown = view.samples[inside]
    curve = np.full(len(view.fine), np.nan) if view.fit is None else view.fit
    # A small picture shows no more points than this: all of them would be most of the page.
    drawn = np.flatnonzero((view.fine >= near[0]) & (view.fine <= near[1]))
    drawn = drawn[:: max(1, len(drawn) // FINEST)]
    highest = [float(np.nanmax(values, initial=-np.inf)) for values in (shown, curve)]
    top = max(view.baseline + 6 * view.std, *highest)
    low = min(view.baseline - 3 * view.std, float(np.nanmin(shown, initial=np.inf)))
    room = 0.08 * (top - low)
    name = f"packet {view.packet}" if view.packet >= 0 else f"point {view.point}"
    chart = Chart(Axis(*near), Axis(low - room, top + room), title=name, size=(260, 170), small=True)
    chart.band(view.baseline - view.std, view.baseline + view.std, "x")
    chart.upright(view.returns, 2)
    chart.line(view.time[inside], shown, "x", kind="thin")
    chart.points(view.time[inside], shown, "x", radius=1.5)
    for one in view.curves if len(view.curves) > 1 else ():
        chart.line(view.fine[drawn], (view.fine_level + one)[drawn], 3, kind="thin")
    if view.fit is not None:
        chart.line(view.fine[drawn], curve[drawn], 1)
    peaks = view.baseline + view.echoes.amplitude.astype(np.float64)
    chart.points(view.echoes.time, peaks, 1, radius=3.5, names=[_describe_echo(view, k) for k in range(len(peaks))])
    words = [f"{len(peaks)} {'echo' if len(peaks) == 1 else 'echoes'}", *([note] if note else [])]
    names = sorted({flag.name for flag in EchoFlag for value in view.echoes.flags if int(value) & flag})
    return figure(chart.render(), ", ".join([*words, *names]))


def _describe_echo(view: WaveformView, row: int) -> str:
    echoes = view.echoes
    width = float(echoes.sigma[row]) * FWHM_PER_SIGMA
    return f"{echoes.time[row]:.3f} ns, {echoes.amplitude[row]:.1f} DN, width {width:.3f} ns"


def draw_histogram(edges: np.ndarray, counts: np.ndarray, *, title: str, label: str, log: bool = False,
                   beyond: int = 0) -> str:  # fmt: skip
    """A histogram of counts i8 (b,) between edges (b + 1,), without its outermost values, which are counted.

    beyond: values outside of the edges, to be counted too.
    """
    total = int(counts.sum())
    if not total:
        return figure("", f"{title}: no values")
    sums = np.cumsum(counts)
    first = int(np.searchsorted(sums, SHOWN_SHARE * total, side="right"))
    last = int(np.searchsorted(sums, (1 - SHOWN_SHARE) * total))
    first, last = min(first, last), max(first, last)
    step = max(1, -(-(last - first + 1) // MOST_BARS))
    last = min(first + step * -(-(last - first + 1) // step), len(counts))
    merged = np.add.reduceat(counts[first:last], np.arange(0, last - first, step))
    borders = np.append(edges[first:last:step], edges[last])
    left_out = total - int(merged.sum()) + beyond
    x = Axis(borders[0], borders[-1], log=log and borders[0] > 0)
    chart = Chart(x, Axis(0, 1.06 * merged.max()), title=title, labels=(label, "number"))
    names = [f"{tick_label(float(f'{a:.4g}'))} to {tick_label(float(f'{b:.4g}'))}: {n:,}"
             for a, b, n in zip(borders[:-1], borders[1:], merged, strict=True)]  # fmt: skip
    chart.bars(borders, merged, 0, names)
    return figure(chart.render(), f"{total + beyond:,} values; {left_out:,} of them outside of the picture.")


def draw_counts(counts: Mapping[str, int] | Sequence[tuple[str, int]], *, title: str, label: str) -> str:
    """A bar per name, which are few and short."""
    rows = list(counts.items() if isinstance(counts, Mapping) else counts)
    numbers = np.array([number for _, number in rows], np.float64)
    most = float(numbers.max(initial=0)) or 1.0
    names = [(place + 0.5, name) for place, (name, _) in enumerate(rows)]
    chart = Chart(Axis(0, len(rows), names=names), Axis(0, 1.06 * most), title=title, labels=(label, "number"))
    chart.bars(np.arange(len(rows) + 1), numbers, 0, [f"{name}: {number:,}" for name, number in rows])
    return figure(chart.render(), "; ".join(f"{name}: {number:,}" for name, number in rows))


def draw_map(found: CloudMap) -> str:
    """A map of a column: cells coloured from the 2nd to the 98th percentile, north up, equal scales."""
    rows, columns = found.values.shape
    west, east, south, north = found.extent
    wide = 420
    high = int(np.clip((wide - 80) * (north - south) / max(east - west, 1e-9), 120, 900)) + 78
    across = min(wide - 72, (high - 70) * (east - west) / max(north - south, 1e-9))
    labels = f"{found.length} east", f"{found.length} north"
    chart = Chart(Axis(0, east - west), Axis(0, north - south), title=found.title, labels=labels,
                  size=(int(across) + 72, high))  # fmt: skip
    chart.image(image_address(color_cells(found.values[::-1], *found.shown)))
    low, top = (tick_label(float(f"{value:.4g}")) for value in found.shown)
    words = (
        f"dark {low} to bright {top} {found.unit}; {columns} x {rows} cells of {found.size:g} {found.length}; origin "
        f"{west:.2f} E, {south:.2f} N{found.note}"
    )
    return figure(chart.render(), words)


def draw_values(
    names: Sequence[str], values: Sequence[float], errors: Sequence[float], *, title: str, label: str
) -> str:
    """Values with their errors, side by side."""
    middle, spread = np.asarray(values, np.float64), np.nan_to_num(np.asarray(errors, np.float64))
    low, high = float(np.nanmin(middle - spread)), float(np.nanmax(middle + spread))
    room = 0.1 * (high - low) or 0.1 * abs(high) or 1.0
    ticks = [(place + 0.5, str(place + 1)) for place in range(len(names))]
    chart = Chart(Axis(0, len(names), names=ticks), Axis(low - room, high + room), title=title, labels=("", label))
    for place, (value, error) in enumerate(zip(middle, spread, strict=True)):
        chart.line(np.full(2, place + 0.5), np.array([value - error, value + error]), 1)
        chart.points(place + 0.5, value, 0, radius=4, names=[f"{names[place]}: {format_measure(value, error)}"])
    return figure(chart.render(), ", ".join(f"{place + 1}: {name}" for place, name in enumerate(names)))


def draw_scatter(rows: Sequence[tuple[str, float, float]], *, title: str, labels: tuple[str, str],
                 note: str = "") -> str:  # fmt: skip
    """Named points over two logarithmic axes, for example error against time; rows: name, x, y, all positive."""
    known = [row for row in rows if row[1] > 0 and row[2] > 0]
    if not known:
        return ""
    spans = [(0.6 * min(values), 1.7 * max(values)) for values in zip(*(row[1:] for row in known), strict=True)]
    chart = Chart(Axis(*spans[0], log=True), Axis(*spans[1], log=True), title=title, labels=labels, size=(520, 320))
    for number, (name, x, y) in enumerate(known):
        chart.points(x, y, number % 6, radius=4, names=[f"{name}: {x:.4g}, {y:.4g}"], name=name)
    return figure(chart.render(), note)


def figures_of(document: Mapping[str, Any]) -> list[str]:
    """Histograms of a report's `quality`: amplitudes and widths of all echoes, echoes per waveform."""
    parts = []
    for name, title, label in (("amplitude_dn", "Amplitude", "DN"), ("echo_width_ns", "Echo width", "ns")):
        one = document[name]["histogram"]
        counts = np.array(one["counts"], np.int64)
        edges = one["low"] * np.exp(one["log_step"] * (one["first_bin"] + np.arange(len(counts) + 1)))
        parts.append(draw_histogram(edges, counts, title=title, label=label, log=True))
    per = document["echoes_per_waveform"]
    last = max((number for number, count in enumerate(per) if count), default=0)
    shown = [(f"{n}" if n < len(per) - 1 else f"{n} or more", count) for n, count in enumerate(per[: last + 1])]
    return [*parts, draw_counts(shown, title="Echoes per waveform", label="echoes")]
