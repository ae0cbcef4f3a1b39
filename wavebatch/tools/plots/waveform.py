"""The data of a picture of a waveform: samples, noise, fit, residual, echoes and the vendor's returns, as arrays.

`wavebatch plot waveform` reads the views here and draws them with `draw_waveform`. The chain runs as in `wavebatch
run`; only the curves of the fitted pulses are computed again here. The echoes' parameters are lines of text below a
picture, or rows of a CSV file.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from wavebatch.core.echoes import COLUMNS, EchoFlag, EchoTable
from wavebatch.core.errors import InputError
from wavebatch.core.units import FWHM_PER_SIGMA, format_measure
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.files.strip.reader import StripReader, StripScan
from wavebatch.stages.chain import STAGES, Chain, Step
from wavebatch.stages.decompose.models import echo_pulses, fitted_pulse
from wavebatch.stages.pulse_tables import clip_level
from wavebatch.surveying.sensor import SensorRequest, find_sensor
from wavebatch.tools.plots.detector_signals import DetectorSignal, choose_step, describe_step, see_block
from wavebatch.tools.plots.packets import Place
from wavebatch.tools.sheets.sheet import format_csv

FINE = 8
"""Points of a curve per sample."""

MOST_POINTS = 20_000
"""Most points of a curve: more than any picture resolves."""

BEFORE, AFTER = 4.0, 8.0
"""What is shown before the first [full widths] and after the last echo [sigma] of the widest echo."""

VISIBLE = 5.0
"""Samples this far above the baseline, and residuals this large, are always shown [noise std]."""


@dataclass(frozen=True, slots=True, eq=False)
class WaveformView:
    """One waveform and the result of a chain."""

    packet: int
    """Number in the strip; -1 if not known."""
    point: int
    """Index of the first point of the file with this waveform."""
    gps_time: float
    """GPS time [s]."""
    time: np.ndarray
    """Times of the samples after the first one [ns], f8 (s,)."""
    samples: np.ndarray
    """Samples [DN], f8 (s,); NaN where nothing was recorded."""
    clipped: np.ndarray
    """Samples at the digitizer's limit, bool (s,)."""
    baseline: float
    std: float
    """Noise of a sample without signal [DN]."""
    level: np.ndarray
    """Baseline at each sample [DN], f8 (s,): recordings of one packet may differ."""
    fine: np.ndarray
    """Times of the curves [ns], f8 (q,)."""
    curves: np.ndarray
    """Pulse of each echo above the baseline [DN], f8 (k, q); (0, q) if the chain fits no pulses."""
    residual: np.ndarray | None
    """Samples less baseline and fit, in standard deviations of the noise at each sample, f8 (s,); NaN for clipped
    samples below the fit, which agree with it, and where nothing was recorded. None without a fit."""
    echoes: EchoTable
    """The k echoes of this waveform."""
    returns: np.ndarray
    """Times of the returns of the input [ns], f8 (r,)."""
    seen: DetectorSignal | None = None
    """What the detector saw, if it was asked for."""

    @property
    def spacing(self) -> float:
        """Time between two samples [ns]; 1 if there is only one sample."""
        return float(self.time[1]) if len(self.time) > 1 else 1.0

    @property
    def fit(self) -> np.ndarray | None:
        """Sum of baseline and curves [DN], f8 (q,); None without a fit. NaN in gaps between two recordings."""
        return None if self.residual is None else self.fine_level + self.curves.sum(axis=0)

    @property
    def fine_level(self) -> np.ndarray:
        """Level without signal at the times of the curves [DN], f8 (q,); NaN where nothing was recorded."""
        nearest = np.clip(np.rint(self.fine / self.spacing).astype(np.int64), 0, len(self.time) - 1)
        return np.where(np.isnan(self.samples), np.nan, self.level)[nearest]


    @property
    def span(self) -> tuple[float, float]:
        """The part that holds all that can be seen [ns]: echoes, returns, and samples or residuals above the noise."""
        seen = (self.samples > self.level + VISIBLE * self.std) | self.clipped
        if self.residual is not None:
            seen |= np.abs(np.nan_to_num(self.residual)) > VISIBLE
        marks = np.concatenate([self.echoes.time, self.returns, self.time[seen]])
        end, edge = float(self.time[-1]), 0.5 * self.spacing
        if not len(marks):
            return -edge, max(end + edge, 1.0)
        sigma = float(self.echoes.sigma.max()) if len(self.echoes) else 2 * self.spacing
        low = max(float(marks.min()) - BEFORE * FWHM_PER_SIGMA * sigma, -edge)
        return low, max(min(float(marks.max()) + AFTER * sigma, end + edge), low + 1.0)

    def span_is_cut(self, times: tuple[float, float]) -> bool:
        """Whether some samples lie outside of the times that are shown."""
        return times[0] > 0.0 or times[1] < float(self.time[-1])


def read_views(
    reader: StripReader,
    scan: StripScan,
    places: Sequence[Place],
    chain: Chain,
    system: SystemPulse,
    show: str | None = None,
    fill: Callable[[WaveformBlock], WaveformBlock] | None = None,
) -> list[WaveformView]:
    """The waveforms at `places`, in this order, with the result of the chain.

    show: also what the detector saw, as `detector_signals.choose_step` takes it. fill: adds the sensor's positions.
    """
    views: dict[tuple[int, int], WaveformView] = {}
    for number in sorted({place.unit for place in places}):
        unit = reader.read_unit(number, scan)
        packet = {place.row: place.packet for place in places if place.unit == number}
        for block, rows in reader.read_rows(unit, np.array(sorted(packet)), len(packet)):
            block = block if fill is None else fill(block)
            parts = build_views(block, chain, system, [packet[int(row)] for row in rows], show)
            views |= {(number, int(row)): view for row, view in zip(rows, parts, strict=True)}
    return [views[place.unit, place.row] for place in places]


def add_ranges(
    chain: Chain, reader: StripReader, scan: StripScan
) -> tuple[Chain, Callable[[WaveformBlock], WaveformBlock] | None, float]:
    """The chain with the distances of echoes from the sensor, the function that gives blocks their sensor, its error.

    The chain as it is, None and 0, where it computes no positions or those of the sensor are not known.
    """
    if not {"x", "y", "z"} <= {*chain.makes}:
        return chain, None, 0.0
    try:
        source = find_sensor(reader, scan, SensorRequest())
    except InputError:  # coordinates in feet or degrees
        return chain, None, 0.0
    step = () if "range" in chain.makes else (Step(STAGES["attribute.range"]),)
    return Chain((*chain.steps, *step), chain.name), source.fill, source.error


def name_chain(chain: Chain) -> str:
    """Name, detector and decomposer of a chain, with the parameters that it sets."""
    detector, decomposer = (describe_step(step) for step in chain.steps[1:3])
    return f"{chain.name.removeprefix('profile ') or 'chain'}: {detector}, {decomposer}"


def build_views(
    block: WaveformBlock, chain: Chain, system: SystemPulse, packets: Sequence[int], show: str | None = None
) -> list[WaveformView]:
    """One view per waveform of the block; packets: their numbers in the strip; show: as for `read_views`."""
    block, noise, system, echoes = chain.solve(block, system)
    shape = fitted_pulse(chain.steps[2], system, block.spacing)
    level = clip_level(block, system)
    seen: Sequence[DetectorSignal | None] = [None] * len(block)
    if show is not None:
        step = choose_step(chain, show)
        seen = see_block(block, noise, system, step, in_chain=step is chain.steps[1])
    views = []
    for row, number in enumerate(packets):
        table = echoes.take(np.flatnonzero(echoes.waveform == row))
        samples = block.samples[row].astype(np.float64)
        if block.missing is not None:
            samples[block.missing[row]] = np.nan
        clipped = samples >= level
        baseline, std = float(noise.baseline[row]), float(noise.std[row])
        time = np.arange(len(samples)) * block.spacing
        fine = np.linspace(0.0, time[-1], max(len(time), min(FINE * (len(time) - 1) + 1, MOST_POINTS)))
        curves, residual = np.zeros((0, len(fine))), None
        if shape is not None:
            pulses = echo_pulses(shape, system, block.spacing, table)
            curves = pulses(fine)
            residual = _residual(samples - noise.level[row], pulses(time).sum(axis=0), clipped, std, system.noise.gain)
        returns = np.empty(0) if block.returns is None else block.returns.time[block.returns.waveform == row]
        views.append(
            WaveformView(
                number, int(block.point[row]), float(block.gps_time[row]), time, samples, clipped, baseline, std,
                np.broadcast_to(noise.level[row].astype(np.float64), samples.shape), fine, curves, residual, table,
                returns, seen[row],
            )  # fmt: skip
        )
    return views


def _residual(signal: np.ndarray, fit: np.ndarray, clipped: np.ndarray, std: float, noise_gain: float) -> np.ndarray:
    """Signal less fit, in standard deviations of the noise at each sample (docs/algorithms.md H6, H12), f8 (s,)."""
    difference = signal - fit
    noise = np.sqrt(std**2 + noise_gain * np.maximum(fit, 0.0))
    return np.where(clipped & (difference <= 0), np.nan, difference / noise)


MOST_LISTED = 40
"""Most echoes in the table of a picture; the CSV has all."""

_FLAGS_WIDE = 50
_NAMES = {"time": "echo_time", "amplitude": "amplitude", "sigma": "echo_width"}


def name_flags(flags: int) -> str:
    """Names of EchoFlag bits, separated by commas; empty without any."""
    return ", ".join(flag.name for flag in EchoFlag(flags))


def list_echoes(views: Sequence[WaveformView], most: int = MOST_LISTED) -> str:
    """A table of the echoes, for a monospaced font: time, amplitude, width, range if it is known, and flags."""
    several, ranged = len(views) > 1, any(np.isfinite(_column(view, "range")).any() for view in views)
    head = [*["packet"] * several, "echo", "time [ns]", "amplitude [DN]", "width [ns]", *["range [m]"] * ranged]
    every = [(view, row) for view in views for row in range(len(view.echoes))]
    if not every:
        return "no echo"
    rows = [[head, ["flags"]]]
    for view, row in every[:most]:
        front = [str(view.packet) if view.packet >= 0 else "-"] * several + [str(row + 1)]
        front += [_measure(*pair) for pair in _measures(view, row)]
        front += [_measure(*(_column(view, name)[row] for name in ("range", "range_error")))] * ranged
        rows.append([front, textwrap.wrap(name_flags(int(view.echoes.flags[row])) or "-", _FLAGS_WIDE)])
    widths = [max(len(front[place]) for front, _ in rows) for place in range(len(head))]
    lines = []
    for front, flags in rows:
        text = "  ".join(f"{word:>{width}}" for word, width in zip(front, widths, strict=True))
        lines += [f"{text if number == 0 else ' ' * len(text)}  {more}" for number, more in enumerate(flags)]
    if len(every) > most:
        lines.append(f"and {len(every) - most} more: -o FILE.csv writes all")
    return "\n".join(lines)


def _measures(view: WaveformView, row: int) -> Iterator[tuple[float, float]]:
    """Time, amplitude and full width of an echo, each with its error."""
    for name in _NAMES:
        factor = FWHM_PER_SIGMA if name == "sigma" else 1.0
        yield tuple(factor * float(getattr(view.echoes, name + end)[row]) for end in ("", "_err"))


def _column(view: WaveformView, name: str) -> np.ndarray:
    """An attribute column of the echoes; NaN if the chain does not compute it."""
    return np.asarray(view.echoes.attributes.get(name, np.full(len(view.echoes), np.nan)), np.float64)


def _measure(value: float, error: float) -> str:
    return format_measure(value, error, "\N{PLUS-MINUS SIGN}")


def _cell(value: float, digits: int) -> str:
    """The value with so many digits; empty for no data."""
    return f"{value:.{digits}g}" if math.isfinite(value) else ""


def format_echoes(views: Sequence[WaveformView]) -> str:
    """CSV with one row per echo; a waveform without echoes has one row without values. Empty cells are no data."""
    extra = list(dict.fromkeys(name for view in views for name in view.echoes.attributes))
    head = ["packet", "point", "gps_time [s]", "echo"]
    head += [f"{name}{end} [{COLUMNS[name].unit}]" for name in _NAMES.values() for end in ("", "_err")]
    shown = (*_NAMES.values(), "point")
    rest = [name for name in extra if name.removesuffix("_err") not in shown and not name.endswith("_reason")]
    head += [f"{name} [{COLUMNS[name].unit}]" if name in COLUMNS else name for name in rest]
    table = []
    for view in views:
        place = [view.packet if view.packet >= 0 else "", view.point, f"{view.gps_time:.9f}"]
        for row in range(len(view.echoes)):
            texts = [_cell(value, 9) for pair in _measures(view, row) for value in pair]
            texts += [_cell(_column(view, name)[row], 9 if name not in ("x", "y", "z") else 13) for name in rest]
            flags = name_flags(int(view.echoes.flags[row])).replace(", ", " ")
            table.append([*place, row + 1, *texts, flags])
        if not len(view.echoes):
            table.append([*place, *[""] * (len(head) - 2)])
    return format_csv([*head, "flags"], table)
