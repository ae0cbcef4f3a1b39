"""The data of a picture of a waveform: samples, noise, fit, residual, echoes and the vendor's returns, as arrays.

`wavebatch plot waveform` calls, in the order of this module, `find_places` and `read_views`, and draws the views with
`draw_waveform`. `find_places` finds the waveforms: by packet, point or GPS time, by flags of their echoes, or a few
spread evenly; the strip is read unit by unit, only as far as needed. For a view the chain runs as in `wavebatch run`;
only the curves of the fitted pulses are computed again here. The echoes' parameters are lines of text below a picture
(`list_echoes`), or rows of a CSV file (`format_echoes`).

`see_block` gives what a detector saw: the signal in which it searched for echoes, with its threshold, by the function
that its stage names (`searches`). tests/tools/test_plot_waveform.py holds that the stages find echoes exactly where
these signals pass their thresholds.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Iterator, Sequence
from dataclasses import field

import numpy as np

from wavebatch.core.echoes import COLUMNS, EchoFlag, EchoTable
from wavebatch.core.errors import ConfigError, InputError, nearest
from wavebatch.core.frozen import NamedTuple, frozen
from wavebatch.core.order import even_places
from wavebatch.core.units import FWHM_PER_SIGMA, format_measure
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.files.cloud.point_filter import PlannedFilter, PointFilter, ReadColumn
from wavebatch.files.strip.reader import StripReader, StripScan, Unit
from wavebatch.stages.chain import STAGES, Chain, Step
from wavebatch.stages.decompose.models import echo_pulses, fitted_pulse
from wavebatch.stages.detect.direct import Searched
from wavebatch.stages.pulse_tables import clip_level
from wavebatch.surveying.sensor import SensorRequest, find_sensor
from wavebatch.tools.sheets.sheet import format_csv

FARTHEST_IN_TIME = 1e-3
"""Largest distance of a pulse from the wanted GPS time [s]."""
USUAL_IN_PICTURE = 6
"""Waveforms of a picture if their number is not given."""
MOST_IN_PICTURE = 24
"""Most waveforms of a picture: more would be too small to read."""
MOST_ON_SHEET = 100
"""Most waveforms of a contact sheet."""
_BLOCK = 4096
"""Waveforms that run through the chain at once when flags are searched."""


@frozen
class Wanted:
    """Which waveforms to find; by default a few of them, spread evenly over the strip."""

    packets: tuple[tuple[int, int | None], ...] = ()
    """Spans of packets: first number and end (not included; None: the last), in the order of their first points."""
    points: tuple[int, ...] = ()
    """Indices of points in the file."""
    times: tuple[float, ...] = ()
    """GPS times [s]; the nearest pulse of each."""
    selection: PointFilter = PointFilter()
    """The first waveforms with an echo that it chooses."""
    most: int | None = None
    """Most waveforms with such an echo, or spread evenly; None: USUAL_IN_PICTURE of them, or a full sheet."""
    random: int = 0
    """Number of packets to draw at random; 0: none."""
    seed: int = 0
    """Seed of the random packets."""
    sheet: bool = False
    """Whether the picture is a contact sheet."""

    @property
    def limit(self) -> int:
        """Most waveforms of the picture."""
        return MOST_ON_SHEET if self.sheet else MOST_IN_PICTURE

    @property
    def number(self) -> int:
        """Most waveforms with chosen echoes, or spread evenly."""
        return self.most or (MOST_ON_SHEET if self.sheet else USUAL_IN_PICTURE)


@frozen
class Place:
    """Where a waveform is in the strip."""

    unit: int
    row: int
    """Row of unit.packets."""
    packet: int
    """Number of the packet in the strip; -1 if its first point is in another unit."""


def find_places(
    reader: StripReader, scan: StripScan, wanted: Wanted, run: Callable[[WaveformBlock], EchoTable]
) -> list[Place]:
    """Places of the wanted waveforms, each once: packets, then points, then times, in the given order.

    run: gives the echoes of a block; only used to search for flags. Raises ConfigError for packets, points and times
    that the strip does not have and for more waveforms than fit, InputError if the strip has no waveform.
    """
    path = reader.facts.path
    if not scan.packets:
        raise InputError(f"{path}: holds no waveform to draw; `wavebatch check` shows what it holds")
    more = "" if wanted.sheet else f", {MOST_ON_SHEET} with --sheet"
    too_many = ConfigError(f"{path}: too many waveforms for a picture; {wanted.limit} fit{more}")
    if wanted.number > wanted.limit:
        raise too_many
    if wanted.selection:
        return _find_flagged(reader, scan, wanted, run)
    numbers: list[int] = []
    if wanted.random:
        number = min(wanted.random, scan.packets)
        numbers = np.sort(np.random.default_rng(wanted.seed).choice(scan.packets, number, replace=False)).tolist()
    elif not (wanted.packets or wanted.points or wanted.times):
        numbers = even_places(scan.packets, wanted.number).tolist()
    else:
        for first, end in wanted.packets:
            end = scan.packets if end is None else end
            if not 0 <= first < end <= scan.packets:
                span = str(first) if end == first + 1 else f"{first}:{end}"
                raise ConfigError(f"{path}: there is no packet {span}; packets are 0 to {scan.packets - 1}")
            numbers += range(first, min(end, first + wanted.limit + 1))
    if len(numbers) + len(wanted.points) + len(wanted.times) > wanted.limit:
        raise too_many
    for point in wanted.points:
        if not 0 <= point < scan.points:
            raise ConfigError(f"{path}: there is no point {point}; points are 0 to {scan.points - 1}")
    found: dict[tuple[str, float], Place] = {}
    away = dict.fromkeys(wanted.times, np.inf)
    for unit, base in _read_units(reader, scan):
        owned = np.flatnonzero(unit.packets.owned)
        rows = {number: owned[number - base] for number in numbers if base <= number < base + len(owned)}
        found |= {("packet", number): Place(unit.number, int(row), number) for number, row in rows.items()}
        for point in wanted.points:
            if 0 <= point - unit.start < len(unit.points):
                row = int(unit.packet_of_point[point - unit.start])
                if row < 0:
                    broken = unit.point_flags[point - unit.start] & EchoFlag.BROKEN_PACKET
                    why = "a packet that cannot be used" if broken else "no waveform"
                    raise ConfigError(f"{path}: point {point} has {why}; name another")
                found["point", point] = _place(unit, base, row)
        for time in wanted.times:
            points = np.flatnonzero(unit.packet_of_point >= 0)
            with np.errstate(invalid="ignore"):
                apart = np.abs(unit.points["gps_time"][points] - time)
            apart[np.isnan(apart)] = np.inf
            if len(points) and apart.min() < away[time]:
                away[time] = float(apart.min())
                found["time", time] = _place(unit, base, int(unit.packet_of_point[points[np.argmin(apart)]]))
        # Times need not be in order: all units are read for them.
        if not wanted.times and len(found) == len({*numbers}) + len({*wanted.points}):
            break
    for time, apart in away.items():
        if apart > FARTHEST_IN_TIME:
            why = f"the nearest is {apart:g} s away" if np.isfinite(apart) else "no pulse has a time"
            raise ConfigError(f"{path}: no pulse lies within {FARTHEST_IN_TIME:g} s of GPS time {time!r}: {why}")
    for number in numbers:
        if ("packet", number) not in found:
            raise InputError(f"{path}: packet {number} was not found; the file changed while it was read")
    wants = [("packet", numbers), ("point", wanted.points), ("time", wanted.times)]
    places = [found[kind, one] for kind, each in wants for one in each]
    return list({(place.unit, place.row): place for place in places}.values())


def _read_units(reader: StripReader, scan: StripScan) -> Iterator[tuple[Unit, int]]:
    """The units of the strip, each with the number of packets in the units before it."""
    base = 0
    for unit in reader.read_units(scan):
        yield unit, base
        base += int(np.count_nonzero(unit.packets.owned))


def _place(unit: Unit, base: int, row: int) -> Place:
    owned = unit.packets.owned
    return Place(unit.number, row, base + int(np.count_nonzero(owned[:row])) if owned[row] else -1)


def _find_flagged(
    reader: StripReader, scan: StripScan, wanted: Wanted, run: Callable[[WaveformBlock], EchoTable]
) -> list[Place]:
    """The first waveforms in the file with an echo that is chosen."""
    keep: PlannedFilter | None = None
    found: list[Place] = []
    for unit, base in _read_units(reader, scan):
        rows = np.flatnonzero(unit.packets.owned)
        for begin in range(0, len(rows), _BLOCK):
            hits = []
            for block, index in reader.read_rows(unit, rows[begin : begin + _BLOCK], _BLOCK):
                table = run(block)
                keep = keep or _plan(wanted.selection, table)
                kept = keep.test((table, len(block)), len(table)) == 0
                hits += index[np.unique(table.waveform[kept])].tolist()
            found += [_place(unit, base, row) for row in sorted(hits)]
            if len(found) >= wanted.number:
                return found[: wanted.number]
    if not found:
        text = "has one of these flags" if wanted.selection.where is None else f"meets {wanted.selection.where.text!r}"
        raise InputError(f"{reader.facts.path}: no echo {text}: nothing to draw")
    return found


def _plan(selection: PointFilter, some: EchoTable) -> PlannedFilter:
    """The filter for tables of echoes like this one, given with their numbers of waveforms."""
    made: dict[str, ReadColumn] = {
        "echo_time": lambda rows: rows[0].time,
        "echo_flags": lambda rows: rows[0].flags,
        "number_of_returns": lambda rows: rows[0].count(rows[1])[rows[0].waveform],
    }

    def find(name: str) -> ReadColumn:
        have = {**some.attributes, **made}
        if name not in have:
            raise ConfigError(f"echoes have no column {name!r}; {nearest(name, have)}")
        return made.get(name) or (lambda rows: rows[0].attributes[name])

    return selection.plan(made, find, "echoes")


# Views

CURVE_POINTS = 8
"""Points of a curve per sample."""
MOST_POINTS = 20_000
"""Most points of a curve: more than any picture resolves."""
NEGLIGIBLE = 1e-4
"""Share of its peak below which a curve is not kept: less than any line is wide."""
BEFORE, AFTER = 4.0, 8.0
"""What is shown before the first [full widths] and after the last echo [sigma] of the widest echo."""
VISIBLE = 5.0
"""Samples this far above the baseline, and residuals this large, are always shown [noise std]."""


class Curve(NamedTuple):
    """The pulse of an echo where it is not negligible."""

    first: int
    """Where it begins in `WaveformView.fine`."""
    height: np.ndarray
    """Above the baseline [DN], f8 (n,)."""

    @property
    def part(self) -> slice:
        """The part of the times of the curves that it has."""
        return slice(self.first, self.first + len(self.height))


@frozen(eq=False)
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
    curves: tuple[Curve, ...]
    """Pulse of each echo; none if the chain fits no pulses."""
    total: np.ndarray
    """Their sum [DN], f8 (q,)."""
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
        return None if self.residual is None else self.fine_level + self.total

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

    show: also what the detector saw, as `choose_step` takes it. fill: adds the sensor's positions.
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


def build_views(
    block: WaveformBlock, chain: Chain, system: SystemPulse, packets: Sequence[int], show: str | None = None
) -> list[WaveformView]:
    """One view per waveform of the block; packets: their numbers in the strip; show: as for `read_views`."""
    block, noise, system, echoes = chain.solve(block, system)
    shape = fitted_pulse(chain.decomposer, system, block.spacing)
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
        fine = np.linspace(0.0, time[-1], max(len(time), min(CURVE_POINTS * (len(time) - 1) + 1, MOST_POINTS)))
        curves, total, fit, residual = [], np.zeros(len(fine)), np.zeros(len(time)), None
        if shape is not None:
            # One echo after the other: long waveforms have hundreds.
            for echo in range(len(table)):
                pulse = echo_pulses(shape, system, block.spacing, table.take(np.array([echo])))
                height = pulse(fine)[0]
                total += height
                fit += pulse(time)[0]
                seen_at = np.flatnonzero(np.abs(height) > NEGLIGIBLE * np.abs(height).max())
                first, last = (seen_at[0], seen_at[-1]) if len(seen_at) else (0, 0)
                curves.append(Curve(int(first), height[first : last + 1].copy()))
            # In standard deviations of the noise at each sample (docs/algorithms.md H6, H12).
            residual = samples - noise.level[row] - fit
            agrees = clipped & (residual <= 0)
            residual = np.where(agrees, np.nan, residual / np.sqrt(std**2 + system.noise.gain * np.maximum(fit, 0.0)))
        returns = np.empty(0) if block.returns is None else block.returns.time[block.returns.waveform == row]
        views.append(
            WaveformView(
                number, int(block.point[row]), float(block.gps_time[row]), time, samples, clipped, baseline, std,
                np.broadcast_to(noise.level[row].astype(np.float64), samples.shape), fine, tuple(curves), total,
                residual, table, returns, seen[row],
            )  # fmt: skip
        )
    return views


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


# What a detector saw

@frozen(eq=False)
class DetectorSignal(Searched):
    """The signal of a detector in one waveform; its arrays have no second axis."""

    time: np.ndarray = field(default_factory=lambda: np.empty(0))
    """Times of its values after the first sample [ns], f8 (q,)."""
    stage: str = ""
    """The detector, with the parameters that are not its defaults."""
    found: EchoTable | None = None
    """The echoes that the detector found in the one waveform."""


def choose_step(chain: Chain, show: str) -> Step:
    """The detector whose signal is shown: that of the chain if it searches in this kind, else the kind's first one."""
    step = chain.steps[1]
    kinds: dict[str, str] = {}  # of signal that --show names, and the first detector of each by its name
    for name, one in sorted(STAGES.items()):
        if one.searches and one.searches[0]:
            kinds.setdefault(one.searches[0], name)
    if show == "detector":
        if step.stage.searches is None:
            raise ConfigError(f"--show detector: {step.stage.name} has no known signal; choose {', '.join(kinds)}")
        return step
    if show not in kinds:
        raise ConfigError(f"--show {show!r}: must be one of {', '.join(('detector', *kinds))}")
    is_chains = step.stage.searches is not None and step.stage.searches[0] == show
    return step if is_chains else Step(STAGES[kinds[show]])


def see_block(
    block: WaveformBlock, noise: Noise, system: SystemPulse, step: Step, *, in_chain: bool = True
) -> list[DetectorSignal]:
    """What the detector of a step sees in each waveform of a block, with the echoes that it finds there.

    in_chain: whether it is the detector of the chain; the title then does not say that it is another one.
    """
    whole: Searched = step.stage.searches[1](block, noise, system, **step.effective())
    found = step.stage.function(block, noise, system, **step.parameters)
    name = describe_step(step) + ("" if in_chain else ", which the chain does not use")
    time = (whole.first + np.arange(len(whole.values))) * block.spacing
    words = (whole.label, whole.rule)
    rest = {"first": whole.first, "deep": whole.deep, "second_label": whole.second_label, "time": time, "stage": name}
    return [
        DetectorSignal(
            *words, whole.values[:, row] / np.float32(whole.unit), whole.least[row] / whole.unit, whole.signal[:, row],
            second=None if whole.second is None else whole.second[:, row],
            found=found.take(np.flatnonzero(found.waveform == row)), **rest,
        )
        for row in range(len(block))
    ]  # fmt: skip


def describe_step(step: Step) -> str:
    """The stage, with the parameters that the chain sets."""
    given = ", ".join(f"{name} = {value}" for name, value in step.parameters.items())
    return step.stage.name + (f" ({given})" if given else "")


# Echoes as text

MOST_LISTED = 40
"""Most echoes in the table of a picture; the CSV has all."""
_FLAGS_WIDE = 50
_NAMES = {"time": "echo_time", "amplitude": "amplitude", "sigma": "echo_width"}


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
        pairs = [*_measures(view, row), *[[_column(view, name)[row] for name in ("range", "range_error")]] * ranged]
        front += [format_measure(value, error, "\N{PLUS-MINUS SIGN}") for value, error in pairs]
        flags = ", ".join(flag.name for flag in EchoFlag(int(view.echoes.flags[row])))
        rows.append([front, textwrap.wrap(flags or "-", _FLAGS_WIDE)])
    widths = [max(len(front[place]) for front, _ in rows) for place in range(len(head))]
    lines = []
    for front, flags in rows:
        text = "  ".join(f"{word:>{width}}" for word, width in zip(front, widths, strict=True))
        lines += [f"{text if number == 0 else ' ' * len(text)}  {more}" for number, more in enumerate(flags)]
    if len(every) > most:
        lines.append(f"and {len(every) - most} more: -o FILE.csv writes all")
    return "\n".join(lines)


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
            values = [value for pair in _measures(view, row) for value in pair]
            found = {name: _column(view, name)[row] for name in rest}
            found |= {name: f"{found[name]:.13g}" for name in "xyz" if math.isfinite(found.get(name, math.nan))}
            flags = " ".join(flag.name for flag in EchoFlag(int(view.echoes.flags[row])))
            table.append([*place, row + 1, *values, *found.values(), flags])
        if not len(view.echoes):
            table.append([*place, *[""] * (len(head) - 2)])
    return format_csv([*head, "flags"], table, digits=9)


def _measures(view: WaveformView, row: int) -> Iterator[tuple[float, float]]:
    """Time, amplitude and full width of an echo, each with its error."""
    for name in _NAMES:
        factor = FWHM_PER_SIGMA if name == "sigma" else 1.0
        yield tuple(factor * float(getattr(view.echoes, name + end)[row]) for end in ("", "_err"))


def _column(view: WaveformView, name: str) -> np.ndarray:
    """An attribute column of the echoes; NaN if the chain does not compute it."""
    return np.asarray(view.echoes.attributes.get(name, np.full(len(view.echoes), np.nan)), np.float64)
