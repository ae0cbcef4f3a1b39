"""Points and packets of a piece of a PulseWaves file, for `import_file`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wavebatch.core.units import PS_PER_NS
from wavebatch.files.las.extra_bytes import ExtraRecord
from wavebatch.files.pulsewaves_file import OUTGOING, RETURNING, PulseHeader, PulsePiece, Segments
from wavebatch.files.strip.writer import FullwaveWriter
from wavebatch.kernels.fit.closed_form import estimate_starts
from wavebatch.kernels.signal.outgoing import measure_outgoing
from wavebatch.kernels.signal.signal import find_peaks, smooth_121, transpose_samples
from wavebatch.tools.archives.channels import SATURATED, code_segments, find_partners, group_rows
from wavebatch.tools.archives.first_pass import Outgoing, Plan

SENT = ("pulse_energy", "pulse_amplitude", "pulse_energy_err", "pulse_amplitude_err")
"""Extra bytes of the outgoing pulse, over the mean of the strip."""
FACET = "mirror_facet"
STEP = 1e-4
"""Time between pulses that have none [s]."""
PEAK = 6.0
"""Height of a detected echo, in noise of the smoothed waveform; detectors of runs use 4, but noise is rougher here."""
MOST_RETURNS = 15


def list_extra_bytes(plan: Plan) -> list[ExtraRecord]:
    """Return the extra dimensions of a strip that is imported by this plan."""
    records = [ExtraRecord.build(FACET, "u1", "mirror facet of the pulse")]
    if plan.outgoing is not None:
        texts = ("energy sent / mean of the strip", "height sent / mean of the strip", "std of pulse_energy",
                 "std of pulse_amplitude")  # fmt: skip
        records += [ExtraRecord.build(name, "<f4", text) for name, text in zip(SENT, texts, strict=True)]
    return records


@dataclass(slots=True)
class Counts:
    """What became of the segments of a file."""

    points: int = 0
    packets: int = 0
    without_returns: int = 0
    """Pulses without any returning segment: LAS has no place for them."""
    replaced: int = 0
    """Segments of the sensitive channel that are saturated, and whose packet is that of another channel."""
    covered: int = 0
    """Segments of other channels that the sensitive one recorded as well, unsaturated."""
    unknown_energy: int = 0
    """Pulses whose outgoing recording shows no pulse."""


def choose_segments(piece: PulsePiece, plan: Plan, counts: Counts) -> np.ndarray:
    """Return the rows of the segments that become packets, sorted by pulse and time."""
    segments = piece.segments
    returning = np.flatnonzero((segments.kind == RETURNING) & (segments.length > 0))
    first, second = find_partners(segments, plan.primary, returning)
    drop = np.zeros(len(segments), bool)
    known = np.isin(segments.channel[second], list(plan.ratios))
    for a, b in group_rows(segments, first[known], second[known]):
        over = piece.samples(a).max(axis=1) >= SATURATED * plan.top
        drop[a[over]], drop[b[~over]] = True, True
        counts.replaced += int(np.count_nonzero(over))
        counts.covered += int(np.count_nonzero(~over))
    rows = returning[~drop[returning]]
    start = (segments.start * segments.unit)[rows]
    return rows[np.lexsort((start, segments.pulse[rows]))]


def build_points(
    piece: PulsePiece, plan: Plan, writer: FullwaveWriter, header: PulseHeader, counts: Counts, *, detect: bool
) -> np.ndarray:
    """Write the packets of a piece and return its points, sorted by pulse and time."""
    segments = piece.segments
    rows = choose_segments(piece, plan, counts)
    offset, width = np.empty(len(rows), np.uint64), np.empty(len(rows), np.int64)
    owner, sample, height = [], [], []
    for (places,) in group_rows(segments.take(rows), np.arange(len(rows))):
        code = int(code_segments(segments, rows[places[:1]])[0])
        samples = _scale(piece.samples(rows[places]), plan, code)
        digitizer = plan.digitizers[code]
        offset[places] = writer.write_packets(samples, digitizer.index)
        width[places] = samples.shape[1] * digitizer.width
        found, at = _place_returns(samples, plan.noise, detect=detect)
        owner.append(places[found])
        sample.append(at)
        height.append(samples[found, np.round(at).astype(np.int64)])
    if not owner:
        counts.without_returns += len(piece.pulses)
        return np.empty(0, writer.dtype)
    owner, sample, height = (np.concatenate(part) for part in (owner, sample, height))
    order = np.lexsort((sample, owner))
    owner, sample, height = owner[order], sample[order], height[order]
    chosen = segments.take(rows[owner])
    points = np.zeros(len(owner), writer.dtype)
    sent = None if plan.outgoing is None else _measure_sent(piece, plan.outgoing, counts)
    _fill_places(points, piece, chosen, sample, writer, sent)
    _fill_pulses(points, piece, chosen.pulse, plan, header)
    codes = code_segments(chosen, np.arange(len(chosen)))
    kinds, which = np.unique(codes, return_inverse=True)
    points["wavepacket_index"] = np.array([plan.digitizers[int(kind)].index for kind in kinds], np.uint8)[which]
    points["wavepacket_offset"], points["wavepacket_size"] = offset[owner], width[owner]
    if plan.dark:
        points["intensity"] = np.minimum(height.astype(np.int64), 65535)
    if sent is not None:
        for name, line in zip(SENT, sent.measures, strict=True):
            points[name] = line[chosen.pulse]
    counts.points += len(points)
    counts.packets += len(rows)
    counts.without_returns += len(piece.pulses) - len(np.unique(chosen.pulse))
    return points


def _scale(samples: np.ndarray, plan: Plan, code: int) -> np.ndarray:
    """Counts on the scale of the sensitive channel, padded with zeros to the length of their descriptor."""
    digitizer, ratio = plan.digitizers[code], plan.ratios.get(code >> 46)
    if ratio is not None:
        samples = np.minimum(np.round(samples * ratio), digitizer.max_count).astype(f"<u{digitizer.width}")
    lack = digitizer.n_samples - samples.shape[1]
    return np.pad(samples, ((0, 0), (0, lack))) if lack else samples


def _place_returns(samples: np.ndarray, noise: float, *, detect: bool) -> tuple[np.ndarray, np.ndarray]:
    """Waveform and time [samples] of each return: the strongest sample, or all maxima that stand out of the noise.

    The time lies between samples: a run places echoes relative to the returns, so half a sample would be 7 cm.
    """
    smoothed = smooth_121(transpose_samples(samples))
    smoothed -= np.partition(smoothed, len(smoothed) // 4, axis=0)[len(smoothed) // 4]
    waveform, sample = np.arange(len(samples)), np.argmax(samples, axis=1)
    if detect:
        found, at = find_peaks(smoothed, np.full(len(samples), np.float32(PEAK * noise)))
        silent = np.setdiff1d(waveform, found)
        waveform, sample = np.concatenate([found, silent]), np.concatenate([at, sample[silent]])
    if len(smoothed) < 5:
        return waveform, sample
    _, time, _ = estimate_starts(smoothed, waveform, sample, 1.0)
    return waveform, np.clip(time, 0, len(smoothed) - 1)


def _fill_places(
    points: np.ndarray,
    piece: PulsePiece,
    chosen: Segments,
    sample: np.ndarray,
    writer: FullwaveWriter,
    sent: _Sent | None,
) -> None:
    """Coordinates, location in the packet and vectors toward the sensor."""
    direction = piece.direction[chosen.pulse]
    late = 0.0 if sent is None else sent.late[chosen.pulse]
    way = chosen.start + (sample * chosen.spacing - late) / chosen.unit
    xyz = piece.anchor[chosen.pulse] + way[:, None] * direction
    stored = np.round((xyz - np.array(writer.offsets)) / np.array(writer.scales))
    for axis, (name, vector) in enumerate(zip("XYZ", ("x_t", "y_t", "z_t"), strict=True)):
        points[name] = np.clip(stored[:, axis], -(2**31), 2**31 - 1)
        points[vector] = -direction[:, axis] / (chosen.unit * PS_PER_NS)
    points["return_point_wave_location"] = sample * chosen.spacing * PS_PER_NS


def _fill_pulses(points: np.ndarray, piece: PulsePiece, pulse: np.ndarray, plan: Plan, header: PulseHeader) -> None:
    """Fields that all returns of a pulse share, and return numbers; points are sorted by pulse and time."""
    records = piece.pulses[pulse]
    begin = np.searchsorted(pulse, pulse, side="left")
    count = np.searchsorted(pulse, pulse, side="right") - begin
    number = np.minimum(np.arange(len(pulse)) - begin + 1, MOST_RETURNS)
    points["bit_fields"] = number | (np.minimum(count, MOST_RETURNS) << 4)
    bits = records["bits"].astype(np.int64)
    scanner = np.zeros(256, np.int64)
    for index, descriptor in header.descriptors.items():
        scanner[index] = (descriptor.scanner - 1) & 3 if descriptor.scanner else 0
    edge, direction = (bits >> 12) & 1, (bits >> 13) & 1
    points["classification_flags"] = (scanner[bits & 255] << 4) | (direction << 6) | (edge << 7)
    points[FACET] = bits >> 14
    points["intensity"], points["classification"] = records["intensity"], records["classification"]
    has_source = "point_source" in records.dtype.names
    points["point_source_id"] = (records["point_source"] if has_source else np.array(header.source)) & 0xFFFF
    if plan.one_time:
        points["gps_time"] = (piece.first + pulse) * STEP
    else:
        points["gps_time"] = records["time"] * header.time_scale + plan.time_offset


@dataclass(frozen=True, slots=True, eq=False)
class _Sent:
    """Outgoing pulses of a piece, over the means of the strip, by pulse; NaN where there is none."""

    measures: np.ndarray
    """The values of SENT, f8 (4, n)."""
    late: np.ndarray
    """Time of the peak after the strip's mean one, f8 (n,) [ns]; 0 where it is not known."""


def _measure_sent(piece: PulsePiece, outgoing: Outgoing, counts: Counts) -> _Sent:
    """Measure the first outgoing segment of each pulse.

    A digitizer does not start in step with the laser: its samples lie up to half a spacing off. Where the outgoing
    pulse has a time on the clock of the echoes, that is taken off, else echoes would be up to 7 cm off.
    """
    segments = piece.segments
    kind = code_segments(segments, np.arange(len(segments))) & ~((1 << 18) - 1)
    sent = np.flatnonzero((segments.kind == OUTGOING) & (kind == outgoing.kind) & (segments.length > 2))
    sent = sent[np.append(True, np.diff(segments.pulse[sent]) != 0)[: len(sent)]]
    values, late = np.full((4, len(piece.pulses)), np.nan), np.zeros(len(piece.pulses))
    for (rows,) in group_rows(segments, sent):
        found, pulse = measure_outgoing(piece.samples(rows), outgoing.reference), segments.pulse[rows]
        measures = (found.energy, found.amplitude, found.energy_error, found.amplitude_error)
        for line, (measure, mean) in enumerate(zip(measures, (outgoing.energy, outgoing.amplitude) * 2, strict=True)):
            values[line, pulse] = measure / mean
        start, spacing = segments.start[rows] * segments.unit[rows], segments.spacing[rows]
        # Without a stored duration the recording has no place on the clock.
        peak = np.where(start != 0, start + (found.time - outgoing.origin) * spacing, 0.0)
        late[pulse] = np.where(np.isfinite(peak), peak, 0.0)
    counts.unknown_energy += int(np.count_nonzero(np.isnan(values[0])))
    return _Sent(values, late)
