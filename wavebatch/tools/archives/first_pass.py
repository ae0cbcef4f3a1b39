"""The first pass over a PulseWaves file: lengths of segments, channels, and the outgoing pulses of a sample.

`import_file` makes it before anything is written: a file that cannot be read to its end leaves no output behind.

A sensor with two channels of different gain records strong echoes twice: the sensitive channel is saturated by them,
the other one is not. The pass learns the ratio of the gains; `import_file` then chooses a channel for each segment.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.core.units import MAD_TO_STD, QUANTISATION_STD
from wavebatch.core.waveforms import Digitizer
from wavebatch.files.pulsewaves_file import OUTGOING, RETURNING, PulsePiece, PulseReader, Segments
from wavebatch.kernels.signal.outgoing import OutgoingReference, find_reference, measure_outgoing
from wavebatch.surveying.outgoing import STACKED, OutgoingShape, learn_shape

SATURATED = 0.8
"""Share of the sensitive channel's largest counts from which the other channel is used: receivers bend before they
clip. RIEGL records its second channel from about this share on."""
LINEAR = (0.05, 0.4)
"""Shares of the largest counts between which a receiver is linear: heights that teach the ratio of the gains."""
LEAST_SAMPLES = 30
"""Samples that teach a ratio."""
MOST_PAIRS = 20_000
"""Pairs of segments that teach it."""


@dataclass(slots=True)
class Overlaps:
    """What pairs of segments of two channels say, summed up."""

    top: float = 0.0
    """Largest count of the sensitive channel [count]."""
    products: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)
    """Heights of the sensitive and of the other channel at the same time [count]."""
    pairs: int = 0

    def add(self, piece: PulsePiece, first: np.ndarray, second: np.ndarray) -> None:
        """Add pairs of segments: rows of the sensitive and of the other channel."""
        self.pairs += len(first)
        if self.pairs > MOST_PAIRS and self.products:
            return
        segments = piece.segments
        for a, b in group_rows(segments, first, second):
            x, y = (piece.samples(rows).astype(np.float64) for rows in (a, b))
            self.top = max(self.top, float(x.max(initial=0)))
            x -= np.percentile(x, 25, axis=1, keepdims=True)
            y -= np.percentile(y, 25, axis=1, keepdims=True)
            shift = (segments.start[b] - segments.start[a]) * segments.unit[a] / segments.spacing[a]
            other = _interpolate(y, np.arange(x.shape[1]) - shift[:, None])
            inside = np.isfinite(other)
            self.products.append((x[inside], other[inside]))

    def find_ratio(self) -> float | None:
        """Gain of the sensitive channel over that of the other; None where it is not known."""
        if not self.products:
            return None
        x, y = (np.concatenate(values) for values in zip(*self.products, strict=True))
        used = (x > LINEAR[0] * self.top) & (x < LINEAR[1] * self.top) & (y > 0)
        if np.count_nonzero(used) < LEAST_SAMPLES:
            return None
        return float((x[used] * y[used]).sum() / (y[used] ** 2).sum())


def _interpolate(values: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Values (n, s) at places (n, k) between samples, by Lagrange's cubic; NaN outside.

    A straight line would lift flanks, and with them the other channel: by 5 % for pulses of two samples.
    """
    at = np.floor(place).astype(np.int64)
    part = place - at
    inside = (at >= 1) & (at < values.shape[1] - 2)
    at = np.clip(at, 1, max(values.shape[1] - 3, 1))
    weights = (
        -part * (part - 1) * (part - 2) / 6,
        (part + 1) * (part - 1) * (part - 2) / 2,
        -(part + 1) * part * (part - 2) / 2,
        (part + 1) * part * (part - 1) / 6,
    )
    rows, last = np.arange(len(values))[:, None], values.shape[1] - 1
    found = sum(weight * values[rows, np.minimum(at + k - 1, last)] for k, weight in enumerate(weights))
    return np.where(inside, found, np.nan)


def find_partners(segments: Segments, primary: int, returning: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs of segments that recorded the same time in the sensitive channel and in another one.

    Parameters
    ----------
    segments : Segments
        Sorted by pulse.
    primary : int
        The sensitive channel.
    returning : int64 (k,)
        Rows of returning segments.

    Returns
    -------
    first, second : int64 (m,)
        Rows of the sensitive and of the other channel.
    """
    is_primary = segments.channel[returning] == primary
    mine, others = returning[is_primary], returning[~is_primary]
    if not len(mine) or not len(others):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    begin = segments.start * segments.unit
    end = begin + segments.length * segments.spacing
    low = np.searchsorted(segments.pulse[mine], segments.pulse[others], side="left")
    high = np.searchsorted(segments.pulse[mine], segments.pulse[others], side="right")
    best, longest = np.full(len(others), -1), np.zeros(len(others))
    for step in range(int((high - low).max())):
        here = np.flatnonzero(low + step < high)
        row = mine[low[here] + step]
        other = others[here]
        shared = np.minimum(end[row], end[other]) - np.maximum(begin[row], begin[other])
        half = 0.5 * np.minimum(end[row] - begin[row], end[other] - begin[other])
        better = (shared > longest[here]) & (shared > half)
        best[here[better]], longest[here[better]] = row[better], shared[better]
    return best[best >= 0], others[best >= 0]


def group_rows(segments: Segments, *rows: np.ndarray) -> list[tuple[np.ndarray, ...]]:
    """Return the rows in groups of one kind of samples: equal bits, spacing and length, in each of the columns."""
    if not len(rows[0]):
        return []
    group = np.zeros(len(rows[0]), np.int64)
    for column in rows:
        kinds, of_row = np.unique(code_segments(segments, column), return_inverse=True)
        group = group * len(kinds) + of_row
    if not group.any():
        return [rows]
    # NumPy sorts numbers of two bytes in one pass.
    order = np.argsort(group.astype(np.uint16) if group.max() < 1 << 16 else group, kind="stable")
    cuts = np.flatnonzero(np.diff(group[order])) + 1
    return [tuple(column[part] for column in rows) for part in np.split(order, cuts)]


def code_segments(segments: Segments, rows: np.ndarray) -> np.ndarray:
    """Return a number per segment that says its channel, bits, spacing [ps] and length, i8 (k,): see `decode`."""
    spacing = np.round(segments.spacing[rows] * 1000).astype(np.int64)
    code = (segments.channel[rows].astype(np.int64) << 46) | (segments.bits[rows].astype(np.int64) << 40)
    return code | (spacing << 18) | segments.length[rows]


def decode(code: int) -> tuple[int, int, float, int]:
    """Return channel, bits, spacing [ns] and length of a code."""
    return code >> 46, (code >> 40) & 63, ((code >> 18) & ((1 << 22) - 1)) / 1000, code & ((1 << 18) - 1)


MOST_DESCRIPTORS = 250
"""Wave packet descriptors that a strip gets: LAS has 255. With more lengths, lengths are rounded up."""
SAMPLED = 2 * STACKED
"""Pulses of the sample, about."""
STANDARD_TIME = 1e9
"""What GPS times in LAS lack: they are seconds since 1980 less this."""
SECONDS_OF_WEEK = 604_800 * 2
"""Largest time that can be one of a GPS week; flights over its end count on."""
ONE_TIME = 64
"""Pulses of one time from which that is no time."""


@dataclass(frozen=True, slots=True, eq=False)
class Outgoing:
    """What is known of the outgoing pulses of a file."""

    kind: int
    """Channel, bits and spacing as `code_segments` with length 0."""
    reference: OutgoingReference
    shape: OutgoingShape | None
    energy: float
    """Mean [count samples]."""
    amplitude: float
    """Mean [count]."""
    scatter: float
    """Standard deviation of energies from shot to shot beyond their errors, relative."""
    error: float
    """Mean error of an energy, relative."""
    width_scatter: float
    """The same of energy over amplitude: how much the width of pulses varies, relative."""
    origin: float
    """Mean time of their peaks on the clock of the pulses [samples]."""


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """How the segments of a file become packets and points."""

    primary: int
    """The most sensitive channel: most segments are of it."""
    top: float
    """Largest count of it where another channel recorded the same [count]."""
    ratios: dict[int, float]
    """By other channel: gain of the primary one over its gain."""
    unknown: tuple[int, ...]
    """Other channels whose gain is not known: nothing tells that they see the same, so all of them is kept."""
    noise: float
    """Of a sample of the primary channel [count]."""
    digitizers: dict[int, Digitizer]
    """By code of segments."""
    outgoing: Outgoing | None
    one_time: bool
    """All pulses have one and the same time."""
    week: bool
    """Times are seconds of the GPS week, not standard GPS time."""
    time_offset: float
    """Added to the scaled times [s]."""
    dark: bool
    """No pulse has an intensity."""


@dataclass(slots=True)
class _Found:
    codes: Counter[int] = field(default_factory=Counter)
    outgoing: dict[int, list[tuple[np.ndarray, np.ndarray]]] = field(default_factory=dict)
    """By kind: samples, and start of the first one [samples]."""
    steps: list[np.ndarray] = field(default_factory=list)
    overlaps: dict[int, Overlaps] = field(default_factory=dict)
    times: tuple[int, int] = (2**63 - 1, -(2**63))
    intensity: int = 0
    channels: Counter[int] = field(default_factory=Counter)


def make_plan(reader: PulseReader) -> Plan:
    """Read all pulses once; raises InputError for a file without any returning segment, or that ends too early."""
    found, every = _Found(), max(1, reader.header.count // SAMPLED)
    for piece in reader.pieces():
        _add(found, piece, every)
    if not found.codes:
        raise InputError(f"{reader.header.path}: none of its {reader.header.count} pulses has a returning waveform")
    primary = found.channels.most_common(1)[0][0]
    overlap = found.overlaps.get(primary, Overlaps())
    ratios, unknown = _find_ratios(found, primary)
    steps = np.concatenate([np.zeros(1), *found.steps])
    noise = max(float(np.median(steps)) * MAD_TO_STD / np.sqrt(2), QUANTISATION_STD)
    header = reader.header
    latest = max(abs(time * header.time_scale + header.time_offset) for time in found.times)
    week = latest <= SECONDS_OF_WEEK
    return Plan(
        primary, overlap.top, ratios, unknown, noise, _list_digitizers(found.codes, ratios),
        _learn_outgoing(found.outgoing), header.count >= ONE_TIME and found.times[0] == found.times[1], week,
        header.time_offset - (0.0 if week else STANDARD_TIME), found.intensity == 0,
    )  # fmt: skip


def _add(found: _Found, piece: PulsePiece, every: int) -> None:
    segments, pulses = piece.segments, piece.pulses
    returning = np.flatnonzero((segments.kind == RETURNING) & (segments.length > 0))
    for code, count in zip(*np.unique(code_segments(segments, returning), return_counts=True), strict=True):
        found.codes[int(code)] += int(count)
        found.channels[decode(int(code))[0]] += int(count)
    found.times = min(found.times[0], int(pulses["time"].min())), max(found.times[1], int(pulses["time"].max()))
    found.intensity = max(found.intensity, int(pulses["intensity"].max()))
    if len(found.channels) > 1:
        primary = found.channels.most_common(1)[0][0]
        pairs = found.overlaps.setdefault(primary, Overlaps())
        pairs.add(piece, *find_partners(segments, primary, returning))
    chosen = (piece.first + segments.pulse) % every == 0
    sent = np.flatnonzero(chosen & (segments.kind == OUTGOING) & (segments.length > 2))
    sent = sent[np.append(True, np.diff(segments.pulse[sent]) != 0)[: len(sent)]]
    for (rows,) in group_rows(segments, sent):
        start = (segments.start * segments.unit / segments.spacing)[rows]
        found.outgoing.setdefault(int(code_segments(segments, rows[:1])[0]), []).append((piece.samples(rows), start))
    for (rows,) in group_rows(segments, returning[chosen[returning] & (segments.length[returning] > 1)]):
        found.steps.append(np.abs(np.diff(piece.samples(rows).astype(np.int64), axis=1)).mean(axis=1))


def _find_ratios(found: _Found, primary: int) -> tuple[dict[int, float], tuple[int, ...]]:
    """Ratios of gains; overlaps show only that of sensors with two channels."""
    others = [channel for channel in found.channels if channel != primary]
    ratio = found.overlaps[primary].find_ratio() if len(others) == 1 and primary in found.overlaps else None
    if ratio is None or ratio <= 1:
        return {}, tuple(others)
    return {others[0]: ratio}, ()


def _list_digitizers(codes: Counter[int], ratios: dict[int, float]) -> dict[int, Digitizer]:
    """A descriptor per kind of segment; where they are too many, one for several lengths."""
    step = 1
    while True:
        # The last 18 bits are the length, which is rounded up.
        rounded = {code: code + -(code & ((1 << 18) - 1)) % step for code in codes}
        if len(set(rounded.values())) <= MOST_DESCRIPTORS:
            break
        step *= 2
    index = {code: number for number, code in enumerate(sorted(set(rounded.values())), 1)}
    digitizers = {}
    for code, wide in rounded.items():
        channel, bits, spacing, length = decode(wide)
        # Counts of a less sensitive channel are written on the scale of the sensitive one.
        bits = 16 if channel in ratios and bits == 8 else 32 if channel in ratios else bits
        digitizers[code] = Digitizer(index[wide], bits, length, spacing)
    return digitizers


def _learn_outgoing(samples: dict[int, list[tuple[np.ndarray, np.ndarray]]]) -> Outgoing | None:
    """Shape and means of the commonest kind of outgoing pulses."""
    if not samples:
        return None
    counts = {code: sum(len(start) for _, start in parts) for code, parts in samples.items()}
    code = max(counts, key=lambda one: (counts[one], -one))
    values, start = (np.concatenate(column) for column in zip(*samples[code], strict=True))
    reference = find_reference(values)
    if reference is None:
        return None
    pulses = measure_outgoing(values, reference)
    good = np.isfinite(pulses.energy)
    if np.count_nonzero(good) < 2:
        return None
    energy, amplitude = pulses.energy[good], pulses.amplitude[good]
    error = float((pulses.energy_error[good] / energy).mean())
    _, _, spacing, _ = decode(code)
    return Outgoing(
        code & ~((1 << 18) - 1), reference, learn_shape(values, spacing, reference), float(energy.mean()),
        float(amplitude.mean()), _beyond(energy, error), error,
        _beyond(energy / amplitude, float(np.hypot(error, (pulses.amplitude_error[good] / amplitude).mean()))),
        float((start + pulses.time)[good].mean()),
    )  # fmt: skip


def _beyond(values: np.ndarray, error: float) -> float:
    """Relative scatter of values beyond their relative error."""
    return float(np.sqrt(max((values.std() / values.mean()) ** 2 - error**2, 0.0)))
