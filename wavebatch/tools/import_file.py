"""One PulseWaves file as a LAS 1.4 strip of point format 9, with what its outgoing pulses say; `wavebatch import`.

`import_file` makes two passes: the first (`make_plan`) reads everything and learns lengths of segments, channels, and
the outgoing pulses of a sample; the second (`build_points`, piece by piece) writes. Memory holds one piece of the file.
The strip, its packets and its system file appear together or not at all, also where the file cannot be read to its end.

Packets need metres in all three directions, so pulses in degrees are projected to UTM: by the transverse Mercator
projection of GRS80 and WGS 84. Others stay as they are.

A sensor with two channels of different gain records strong echoes twice: the sensitive channel is saturated by them,
the other one is not. The first pass learns the ratio of the gains; the second chooses a channel for each segment.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from wavebatch import __version__
from wavebatch.core.errors import InputError
from wavebatch.core.frozen import frozen
from wavebatch.core.schema import option
from wavebatch.core.units import ADJUSTED, MAD_TO_STD, PS_PER_NS, QUANTISATION_STD, WEEK
from wavebatch.core.waveforms import Digitizer
from wavebatch.files import pulsewaves_file
from wavebatch.files.disk.publish import Draft, refuse_existing, reporting
from wavebatch.files.disk.raw_bytes import take_fingerprint
from wavebatch.files.las.crs import GeoKeys, build_utm
from wavebatch.files.las.header import GEOTIFF_ID, ExtraRecord, Vlr, read_header
from wavebatch.files.pulsewaves_file import OUTGOING, RETURNING, PulseHeader, PulsePiece, PulseReader, Segments
from wavebatch.files.strip.packets import FullwaveWriter
from wavebatch.kernels.fit.closed_form import estimate_starts
from wavebatch.kernels.signal.outgoing import OutgoingReference, find_reference, measure_outgoing
from wavebatch.kernels.signal.signal import find_peaks, smooth_121, transpose_samples
from wavebatch.surveying.measuring.noise_and_width import find_saturation
from wavebatch.surveying.outgoing import MOST_STACKED, SYSTEM_SUFFIX, OutgoingShape, learn_shape, save_outgoing
from wavebatch.surveying.systems.survey_result import format_survey

SUFFIXES = (".pls",)
USER_ID = b"wavebatch_import"
"""User id of the record in a strip that says what it was imported from."""


@frozen
class ImportOptions:
    """How files are imported."""

    returns: Literal["strongest", "detect"] = option(
        "strongest", "strongest: one point per recorded segment, at its strongest sample; detect: one at each maximum "
        "that stands out of the noise.",
    )  # fmt: skip
    internal: bool = option(
        False, "Store packets in the strip or in a .wdp file beside it.", opposite="external", unset="external"
    )
    overwrite: bool = False
    resume: bool = option(False, "Skip files whose strip is there and up to date.")


@dataclass(slots=True)
class ImportSummary:
    """What was made of a file, and what became of its segments."""

    file: str
    output: str
    pulses: int
    skipped: bool = False
    """The strip was there already and is up to date."""
    points: int = 0
    packets: int = 0
    descriptors: int = 0
    without_returns: int = 0
    """Pulses without any returning segment: LAS has no place for them."""
    replaced: int = 0
    """Segments of the sensitive channel that are saturated, and whose packet is that of another channel."""
    covered: int = 0
    """Segments of other channels that the sensitive one recorded as well, unsaturated."""
    outgoing: dict[str, float] | None = None
    """Of the outgoing pulses: fwhm_ns, energy_scatter, energy_error, width_scatter (relative), and two numbers of
    pulses: unknown (whose outgoing recording shows no pulse, or clips it) and other_kind (not measured)."""
    system_file: str | None = None
    notes: tuple[str, ...] = ()


def import_file(
    path: Path,
    target: Path,
    options: ImportOptions,
    progress: Callable[[int], Any] = lambda pulses: None,
    pulses: int | None = None,
) -> ImportSummary:
    """Import a PulseWaves file.

    Parameters
    ----------
    path : Path
        The .pls, with its .wvs beside it.
    target : Path
        The strip to write; its suffix selects LAS or LAZ.
    options : ImportOptions
    progress : callable
        Called with numbers of pulses that were written.
    pulses : int, optional
        Most pulses read at a time; the output does not depend on it.

    Returns
    -------
    ImportSummary

    Raises
    ------
    InputError
        Where the file cannot be read to its end, or the strip cannot be written; nothing is left behind.
    """
    header = pulsewaves_file.read_pulse_header(path)
    source = {"file": path.name, **take_fingerprint(path, header.waves)}
    changes = {"internal": options.internal, "returns": options.returns}
    account = {"import": source, "options": changes, "version": __version__}
    # Of this import, of another import or none, or another file.
    state = "mine"
    if target.exists():
        try:
            records = [vlr for vlr in read_header(target).vlrs if vlr.user_id.rstrip(b"\0") == USER_ID]
            found = json.loads(records[0].payload) if records else None
            state = "same" if found == account else "other" if found is None else "mine"
        except (InputError, ValueError):
            state = "other"
    if options.resume and state == "same":
        return ImportSummary(str(path), str(target), header.count, skipped=True)
    # A killed import may have left the packets of a strip that never appeared.
    overwrite = options.overwrite or (options.resume and state != "other")
    refuse_existing(target, overwrite)
    with PulseReader(header, pulses=pulses) as reader:
        plan, frame = make_plan(reader), find_frame(reader)
        by_index = {one.index: one for one in plan.digitizers.values()}
        counts = ImportSummary(str(path), str(target), header.count, descriptors=len(by_index))
        if (sent := plan.outgoing) is not None:
            counts.outgoing = {
                "fwhm_ns": float("nan") if sent.shape is None else sent.shape.fwhm,
                "energy_scatter": sent.scatter,
                "energy_error": sent.error,
                "width_scatter": sent.width_scatter,
                "unknown": 0,
                "other_kind": 0,
            }
        digitizers = [by_index[index] for index in sorted(by_index)]
        extra_bytes = [ExtraRecord.build(FACET, "u1", "mirror facet of the pulse")]
        if plan.outgoing is not None:
            texts = ("energy sent / mean of the strip", "height sent / mean of the strip", "std of pulse_energy",
                     "std of pulse_amplitude")  # fmt: skip
            extra_bytes += [ExtraRecord.build(name, "<f4", text) for name, text in zip(SENT, texts, strict=True)]
        record = Vlr(USER_ID, 1, json.dumps(account, sort_keys=True).encode(), b"what the strip was imported from")
        with FullwaveWriter(
            target, point_format=9, internal=options.internal, digitizers=digitizers,
            scales=frame.scales, offsets=frame.offsets, wkt=frame.wkt, extra_bytes=extra_bytes,
            records=(*frame.records, record), overwrite=overwrite, week=plan.week, system=header.system,
            source=header.source & 0xFFFF,
        ) as writer:  # fmt: skip
            if sent is not None and sent.shape is not None:
                channel, bits, spacing, _ = decode(sent.kind)
                saved = save_outgoing(
                    sent.shape, sent.reference, spacing, bits, path.name, source,
                    same_receiver=channel == plan.primary, energy_scatter=sent.scatter, energy_error=sent.error,
                    width_scatter=sent.width_scatter, time_error_ns=sent.time_error,
                )  # fmt: skip
                draft = Draft(writer.target.with_suffix(SYSTEM_SUFFIX), overwrite=overwrite)
                writer.drafts.insert(0, draft)
                with reporting(draft.target):
                    draft.file.write(format_survey(saved).encode())
                counts.system_file = str(draft.target)
            end = 0
            for piece in reader.pieces():
                some = piece.segments
                end = max(end, int((some.offset + some.length * (some.bits // 8)).max(initial=0)))
                points = build_points(
                    frame.place(piece), plan, writer, header, counts, detect=options.returns == "detect"
                )
                writer.write_points(points)
                progress(len(piece.pulses))
            writer.commit()
    counts.notes = (*frame.notes, *_list_notes(header, plan, counts, end))
    return counts


def _list_notes(header: PulseHeader, plan: Plan, counts: ImportSummary, end: int) -> Iterator[str]:
    """What a user should know of an imported file; end: of the waves that its pulses use [byte]."""
    if end < header.waves_size:  # nothing in a .wvs names its .pls
        used = f"{end} of the {header.waves_size} bytes of {header.waves.name}"
        yield f"warning: its pulses use {used}, which may be that of another file: then its points are wrong"
    if plan.one_time:
        yield "all pulses have the same time; they get times 0.1 ms apart"
    elif not plan.week and plan.time_offset == header.time_offset:
        yield "times are taken as adjusted standard GPS time: as standard GPS time they are of before 2000"
    if plan.unknown:
        names = ", ".join(map(str, plan.unknown))
        yield f"channel {names}: its gain over channel {plan.primary} is unknown; all of its segments are kept"
    for channel, ratio in plan.ratios.items():
        yield (
            f"channel {channel} is {ratio:.2f} times less sensitive than channel {plan.primary}: its counts are "
            f"multiplied by that, and it stands for {counts.replaced} segments that saturate channel {plan.primary}"
        )
    if counts.without_returns:
        yield f"{counts.without_returns} pulses have no returning segment, and so no point"
    if counts.outgoing and counts.outgoing["unknown"]:
        yield f"{counts.outgoing['unknown']} outgoing pulses are clipped or not seen: their energy is not known"
    if counts.outgoing and counts.outgoing["other_kind"]:
        yield (
            f"{counts.outgoing['other_kind']} outgoing pulses are recorded with another channel, bits or spacing than "
            "most: their energy is not known, because counts of two recordings have nothing in common"
        )
    kinds = {s.kind for one in header.descriptors.values() for s in one.samplings}
    if plan.outgoing is None and kinds - {RETURNING}:
        yield "its recordings of outgoing pulses show no pulse, or are clipped"


# The first pass: what segments and outgoing pulses there are

MOST_DESCRIPTORS = 250
"""Wave packet descriptors that a strip gets: LAS has 255. With more lengths, lengths are rounded up."""
SAMPLED_PULSES = 2 * MOST_STACKED
"""Pulses of the sample, about."""
ONE_TIME = 64
"""Pulses of one time from which that is no time."""
FIRST_STANDARD = 630_720_000.0
"""Standard GPS time of 2000: PulseWaves does not say which time it has, and few waveforms were recorded before.
Adjusted times reach it in 2031."""


@frozen(eq=False)
class Outgoing:
    """What is known of the outgoing pulses of a file."""

    kind: int
    """Channel, bits and spacing as `code_segments` with length 0."""
    reference: OutgoingReference
    shape: OutgoingShape | None
    energy: float
    """Mean [DN samples]."""
    amplitude: float
    """Mean [DN]."""
    scatter: float
    """Standard deviation of energies from shot to shot beyond their errors, relative."""
    error: float
    """Mean error of an energy, relative."""
    width_scatter: float
    """The same of energy over amplitude: how much the width of pulses varies, relative."""
    origin: float
    """Mean time of their peaks on the clock of the pulses [samples]."""
    time_error: float
    """Root mean square error of these times [ns]."""


@frozen(eq=False)
class Plan:
    """How the segments of a file become packets and points."""

    primary: int
    """The most sensitive channel: most segments are of it."""
    top: float
    """Largest count of it where another channel recorded the same [DN]."""
    ratios: dict[int, float]
    """By other channel: gain of the primary one over its gain."""
    unknown: tuple[int, ...]
    """Other channels whose gain is not known: nothing tells that they see the same, so all of them is kept."""
    noise: float
    """Of a sample of the primary channel [DN]."""
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


def make_plan(reader: PulseReader) -> Plan:
    """Read all pulses once; raises InputError for a file without any returning segment, or that ends too early."""
    header, every = reader.header, max(1, reader.header.count // SAMPLED_PULSES)
    codes: Counter[int] = Counter()  # segments by kind, and by channel
    channels: Counter[int] = Counter()
    overlaps: dict[int, Overlaps] = {}  # by the channel that was the primary one so far
    outgoing: dict[int, list[tuple[np.ndarray, np.ndarray]]] = {}  # by kind: samples, start of the first one [samples]
    steps, first, last, intensity = [np.zeros(1)], 2**63 - 1, -(2**63), 0
    for piece in reader.pieces():
        segments, pulses = piece.segments, piece.pulses
        returning = np.flatnonzero((segments.kind == RETURNING) & (segments.length > 0))
        for code, count in zip(*np.unique(code_segments(segments, returning), return_counts=True), strict=True):
            codes[int(code)] += int(count)
            channels[decode(int(code))[0]] += int(count)
        first, last = min(first, int(pulses["time"].min())), max(last, int(pulses["time"].max()))
        intensity = max(intensity, int(pulses["intensity"].max()))
        if len(channels) > 1:
            primary = channels.most_common(1)[0][0]
            pairs = find_partners(segments, primary, returning)
            overlaps.setdefault(primary, Overlaps()).add(piece, *pairs)
        chosen = (piece.first + segments.pulse) % every == 0
        sent = np.flatnonzero(chosen & (segments.kind == OUTGOING) & (segments.length > 2))
        sent = sent[np.append(True, np.diff(segments.pulse[sent]) != 0)[: len(sent)]]
        for (rows,) in group_rows(segments, sent):
            start = (segments.start * segments.unit / segments.spacing)[rows]
            outgoing.setdefault(int(code_segments(segments, rows[:1])[0]), []).append((piece.samples(rows), start))
        for (rows,) in group_rows(segments, returning[chosen[returning] & (segments.length[returning] > 1)]):
            steps.append(np.abs(np.diff(piece.samples(rows).astype(np.int64), axis=1)).mean(axis=1))
    if not codes:
        raise InputError(f"{header.path}: none of its {header.count} pulses has a returning waveform")
    primary = channels.most_common(1)[0][0]
    overlap = overlaps.get(primary, Overlaps())
    others = tuple(channel for channel in channels if channel != primary)
    # Gain of the sensitive channel over that of the other: overlaps show that of sensors with two channels.
    ratio = 0.0
    if len(others) == 1 and overlap.products:
        x, y = (np.concatenate(values) for values in zip(*overlap.products, strict=True))
        used = (x > LINEAR[0] * overlap.top) & (x < LINEAR[1] * overlap.top) & (y > 0)
        if np.count_nonzero(used) >= LEAST_SAMPLES:
            ratio = float((x[used] * y[used]).sum() / (y[used] ** 2).sum())
    ratios, unknown = ({}, others) if ratio <= 1 else ({others[0]: ratio}, ())
    noise = max(float(np.median(np.concatenate(steps))) * MAD_TO_STD / np.sqrt(2), QUANTISATION_STD)
    latest = max((time * header.time_scale + header.time_offset for time in (first, last)), key=abs)
    week = abs(latest) <= 2 * WEEK  # flights over the end of a week count on
    # A descriptor per kind of segment; where they are too many, one for several lengths.
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
    return Plan(
        primary, overlap.top, ratios, unknown, noise, digitizers, _learn_outgoing(outgoing),
        header.count >= ONE_TIME and first == last, week,
        header.time_offset - (ADJUSTED if latest >= FIRST_STANDARD else 0.0),
        intensity == 0,
    )  # fmt: skip


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
    _, bits, spacing, _ = decode(code)
    reference = reference._replace(top=find_saturation(values, (1 << bits) - 1) or np.inf)
    pulses = measure_outgoing(values, reference)
    good = np.isfinite(pulses.energy)
    if np.count_nonzero(good) < 2:
        return None
    energy, amplitude = pulses.energy[good], pulses.amplitude[good]
    error = float((pulses.energy_error[good] / energy).mean())
    shape_error = float(np.hypot(error, (pulses.amplitude_error[good] / amplitude).mean()))
    # Relative scatter of energies and shapes beyond their relative errors.
    beyond = [float(np.sqrt(max((values.std() / values.mean()) ** 2 - own**2, 0.0)))
              for values, own in ((energy, error), (energy / amplitude, shape_error))]  # fmt: skip
    return Outgoing(
        code & ~((1 << 18) - 1), reference, learn_shape(values, spacing, reference), float(energy.mean()),
        float(amplitude.mean()), beyond[0], error, beyond[1], float((start + pulses.time)[good].mean()),
        spacing * float(np.sqrt(np.mean(pulses.time_error[good] ** 2))),
    )  # fmt: skip


# The second pass: packets and points

SENT = ("pulse_energy", "pulse_amplitude", "pulse_energy_err", "pulse_amplitude_err")
"""Extra bytes of the outgoing pulse, over the mean of the strip."""
FACET = "mirror_facet"
STEP = 1e-4
"""Time between pulses that have none [s]."""
PEAK = 6.0
"""Height of a detected echo, in noise of the smoothed waveform; detectors of runs use 4, but noise is rougher here."""
MOST_RETURNS = 15


def build_points(
    piece: PulsePiece, plan: Plan, writer: FullwaveWriter, header: PulseHeader, counts: ImportSummary, *, detect: bool
) -> np.ndarray:
    """Write the packets of a piece and return its points, sorted by pulse and time."""
    segments = piece.segments
    # Segments that become packets, by pulse and time: of two channels that recorded the same, one.
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
    rows = rows[np.lexsort((start, segments.pulse[rows]))]
    offset, width = np.empty(len(rows), np.uint64), np.empty(len(rows), np.int64)
    owner, sample, height = [], [], []
    for (places,) in group_rows(segments.take(rows), np.arange(len(rows))):
        code = int(code_segments(segments, rows[places[:1]])[0])
        # Counts on the scale of the sensitive channel, padded with zeros to the length of their descriptor.
        samples, digitizer, ratio = piece.samples(rows[places]), plan.digitizers[code], plan.ratios.get(code >> 46)
        if ratio is not None:
            samples = np.minimum(np.round(samples * ratio), digitizer.max_count).astype(f"<u{digitizer.width}")
        samples = np.pad(samples, ((0, 0), (0, digitizer.n_samples - samples.shape[1])))
        offset[places] = writer.write_packets(samples, digitizer.index)
        width[places] = samples.shape[1] * digitizer.width
        # Each return is the strongest sample, or a maximum that stands out of the noise. Its time lies between samples:
        # a run places echoes relative to the returns, so half a sample would be 7 cm.
        smoothed = smooth_121(transpose_samples(samples))
        smoothed -= np.partition(smoothed, len(smoothed) // 4, axis=0)[len(smoothed) // 4]
        found, at = np.arange(len(samples)), np.argmax(samples, axis=1)
        if detect:
            high, top = find_peaks(smoothed, np.full(len(samples), np.float32(PEAK * plan.noise)))
            silent = np.setdiff1d(found, high)
            found, at = np.concatenate([high, silent]), np.concatenate([top, at[silent]])
        if len(smoothed) >= 5:
            at = np.clip(estimate_starts(smoothed, found, at, 1.0)[1], 0, len(smoothed) - 1)
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
    sent, late = (None, 0.0) if plan.outgoing is None else _measure_sent(piece, plan.outgoing, counts)
    # Coordinates, location in the packet and vectors toward the sensor.
    direction = piece.direction[chosen.pulse]
    late = late if isinstance(late, float) else late[chosen.pulse]
    way = chosen.start + (sample * chosen.spacing - late) / chosen.unit
    xyz = piece.anchor[chosen.pulse] + way[:, None] * direction
    stored = np.round((xyz - np.array(writer.offsets)) / np.array(writer.scales))
    for axis, (name, vector) in enumerate(zip("XYZ", ("x_t", "y_t", "z_t"), strict=True)):
        points[name] = np.clip(stored[:, axis], -(2**31), 2**31 - 1)
        points[vector] = -direction[:, axis] / (chosen.unit * PS_PER_NS)
    points["return_point_wave_location"] = sample * chosen.spacing * PS_PER_NS
    # Fields that all returns of a pulse share, and return numbers; points are sorted by pulse and time.
    records = piece.pulses[chosen.pulse]
    begin = np.searchsorted(chosen.pulse, chosen.pulse, side="left")
    count = np.searchsorted(chosen.pulse, chosen.pulse, side="right") - begin
    number = np.minimum(np.arange(len(chosen.pulse)) - begin + 1, MOST_RETURNS)
    points["bit_fields"] = number | (np.minimum(count, MOST_RETURNS) << 4)
    bits = records["bits"].astype(np.int64)
    scanner = np.zeros(256, np.int64)
    for index, descriptor in header.descriptors.items():
        scanner[index] = (descriptor.scanner - 1) & 3 if descriptor.scanner else 0
    edge, sweep = (bits >> 12) & 1, (bits >> 13) & 1
    points["classification_flags"] = (scanner[bits & 255] << 4) | (sweep << 6) | (edge << 7)
    points[FACET] = bits >> 14
    points["intensity"], points["classification"] = records["intensity"], records["classification"]
    has_source = "point_source" in records.dtype.names
    points["point_source_id"] = (records["point_source"] if has_source else np.array(header.source)) & 0xFFFF
    if plan.one_time:
        points["gps_time"] = (piece.first + chosen.pulse) * STEP
    else:
        points["gps_time"] = records["time"] * header.time_scale + plan.time_offset
    codes = code_segments(chosen, np.arange(len(chosen)))
    kinds, which = np.unique(codes, return_inverse=True)
    points["wavepacket_index"] = np.array([plan.digitizers[int(kind)].index for kind in kinds], np.uint8)[which]
    points["wavepacket_offset"], points["wavepacket_size"] = offset[owner], width[owner]
    if plan.dark:
        points["intensity"] = np.minimum(height.astype(np.int64), 65535)
    if sent is not None:
        for name, line in zip(SENT, sent, strict=True):
            points[name] = line[chosen.pulse]
    counts.points += len(points)
    counts.packets += len(rows)
    counts.without_returns += len(piece.pulses) - len(np.unique(chosen.pulse))
    return points


def _measure_sent(piece: PulsePiece, outgoing: Outgoing, counts: ImportSummary) -> tuple[np.ndarray, np.ndarray]:
    """Measure the first outgoing segment of each pulse: the values of SENT over the means of the strip, f8 (4, n), NaN
    where there is none; and the time of its peak after the strip's mean one, f8 (n,) [ns], 0 where it is not known.

    A digitizer does not start in step with the laser: its samples lie up to half a spacing off. Where the outgoing
    pulse has a time on the clock of the echoes, that is taken off, else echoes would be up to 7 cm off.
    """
    segments = piece.segments
    kind = code_segments(segments, np.arange(len(segments))) & ~((1 << 18) - 1)
    every = np.flatnonzero((segments.kind == OUTGOING) & (segments.length > 2))
    sent = every[kind[every] == outgoing.kind]
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
    other = len(np.setdiff1d(segments.pulse[every], segments.pulse[sent]))
    counts.outgoing["other_kind"] += other
    counts.outgoing["unknown"] += int(np.count_nonzero(np.isnan(values[0]))) - other
    return values, late


# Kinds of segments, and the two channels of a sensor

SATURATED = 0.8
"""Share of the sensitive channel's largest counts from which the other channel is used: receivers bend before they
clip. RIEGL records its second channel from about this share on."""
LINEAR = (0.05, 0.4)
"""Shares of the largest counts between which a receiver is linear: heights that teach the ratio of the gains."""
LEAST_SAMPLES = 30
"""Samples that teach a ratio."""
MOST_PAIRS = 20_000
"""Pairs of segments that teach it."""


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


@dataclass(slots=True)
class Overlaps:
    """What pairs of segments of two channels say, summed up."""

    top: float = 0.0
    """Largest count of the sensitive channel [DN]."""
    products: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)
    """Heights of the sensitive and of the other channel at the same time [DN]."""
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
            # Values between samples by Lagrange's cubic; NaN outside.
            # A straight line would lift flanks, and with them the other channel: by 5 % for pulses of two samples.
            place = np.arange(x.shape[1]) - shift[:, None]
            at = np.floor(place).astype(np.int64)
            part = place - at
            inside = (at >= 1) & (at < y.shape[1] - 2)
            at = np.clip(at, 1, max(y.shape[1] - 3, 1))
            weights = (
                -part * (part - 1) * (part - 2) / 6,
                (part + 1) * (part - 1) * (part - 2) / 2,
                -(part + 1) * part * (part - 2) / 2,
                (part + 1) * part * (part - 1) / 6,
            )
            rows, last = np.arange(len(y))[:, None], y.shape[1] - 1
            found = sum(weight * y[rows, np.minimum(at + k - 1, last)] for k, weight in enumerate(weights))
            other = np.where(inside, found, np.nan)
            inside = np.isfinite(other)
            self.products.append((x[inside], other[inside]))


# Coordinates

SCALE = 0.001
"""Largest unit of stored coordinates [m]: coarser ones would shift samples by as much."""
OFFSET_STEP = 1000.0
"""Offsets of coordinates are multiples of this [m]."""
_NO_WKT = (
    "the CRS stays as GeoTIFF keys: it is no UTM zone that wavebatch writes as WKT, which programs expect in LAS 1.4: "
    "give them the CRS by hand"
)
_ZONES = {4326: 32600, 4979: 32600, 4258: 25800, 4269: 26900}
"""EPSG code of zone 0 north by the code of the geographic CRS."""


@frozen
class Frame:
    """How coordinates of a file become those of a strip."""

    zone: int
    """UTM zone; 0: coordinates stay as they are."""
    south: bool
    scales: tuple[float, float, float]
    offsets: tuple[float, float, float]
    wkt: str | None
    records: tuple[Vlr, ...]
    """GeoTIFF keys that still hold."""
    notes: tuple[str, ...]

    def place(self, piece: PulsePiece) -> PulsePiece:
        """Return the piece with its pulses in the coordinates of the strip."""
        if not self.zone:
            return piece
        ends = piece.anchor, piece.anchor + 1000 * piece.direction
        anchor, target = (project_utm(one, self.zone, south=self.south) for one in ends)
        return replace(piece, anchor=anchor, direction=(target - anchor) / 1000)


def find_frame(reader: PulseReader) -> Frame:
    """Decide on the coordinates of a file from its GeoTIFF keys and its first pulse."""
    header = reader.header
    directory = next((vlr.payload for vlr in header.projection if vlr.record_id == GEOTIFF_ID), b"")
    keys = GeoKeys.parse(directory)
    first = next(iter(reader.pieces())).anchor[:1] if header.count else np.zeros((1, 3))
    zero = _ZONES.get(keys.code or 4326)
    if keys.kind == "geographic" and zero is not None:
        # Longitudes from -180 to 360.
        zone, south = int((first[0, 0] + 180) // 6) % 60 + 1, bool(first[0, 1] < 0) and zero == 32600
        code = zero + zone + (100 if south else 0)
        note = f"coordinates are degrees; they are projected to UTM zone {zone}{'S' if south else 'N'} (EPSG:{code})"
        frame = Frame(zone, south, (SCALE,) * 3, (0.0,) * 3, build_utm(code), (), (note,))
        first = project_utm(first, zone, south=south)
    else:
        code = keys.sure_code
        scales = tuple(min(abs(float(scale)), SCALE) for scale in header.scales)
        wkt = build_utm(code) if code else None
        notes = () if wkt else (_NO_WKT,)
        if keys.kind == "geocentric":
            notes = ("coordinates are geocentric and stay so: project the strip before steps that need heights",)
        elif keys.kind == "geographic":
            notes = ("coordinates are degrees of a datum that wavebatch does not project; packets need metres",)
        elif not keys.keys:
            notes = ("the file names no CRS",)
        frame = Frame(0, False, scales, (0.0,) * 3, wkt, header.projection, notes)
    return replace(frame, offsets=tuple(float(value) for value in np.floor(first[0] / OFFSET_STEP) * OFFSET_STEP))


_AXIS, _FLATTENING = 6_378_137.0, 1 / 298.257222101
"""GRS80 [m]; WGS 84 differs by 0.1 mm."""
_SCALE, _EASTING, _NORTHING = 0.9996, 500_000.0, 10_000_000.0


def project_utm(places: np.ndarray, zone: int, *, south: bool) -> np.ndarray:
    """Return places in a UTM zone.

    Parameters
    ----------
    places : float64 (n, 3), degrees and m
        Longitude, latitude and height.
    zone : int
    south : bool
        With the false northing of the southern hemisphere.

    Returns
    -------
    float64 (n, 3), m
        Easting, northing and height.

    References
    ----------
    Karney (2011), Transverse Mercator with an accuracy of a few nanometers, J. Geodesy 85: Krueger's series, equations
    7 to 11 and 35, to the third order: 0.1 mm within 6 degrees of the central meridian.
    """
    (longitude, latitude, height), n = places.T, _FLATTENING / (2 - _FLATTENING)
    eccentricity = np.sqrt(_FLATTENING * (2 - _FLATTENING))
    away = np.radians((longitude - (6 * zone - 183) + 180) % 360 - 180)
    # The poles themselves have no place in the series.
    sine = np.clip(np.sin(np.radians(latitude)), -1 + 1e-15, 1 - 1e-15)
    conformal = np.sinh(np.arctanh(sine) - eccentricity * np.arctanh(eccentricity * sine))
    xi = np.arctan2(conformal, np.cos(away))
    eta = np.arcsinh(np.sin(away) / np.hypot(conformal, np.cos(away)))
    alpha = (
        n / 2 - 2 * n**2 / 3 + 5 * n**3 / 16,
        13 * n**2 / 48 - 3 * n**3 / 5,
        61 * n**3 / 240,
    )
    north, east = xi.copy(), eta.copy()
    for order, factor in enumerate(alpha, 1):
        north += factor * np.sin(2 * order * xi) * np.cosh(2 * order * eta)
        east += factor * np.cos(2 * order * xi) * np.sinh(2 * order * eta)
    radius = _SCALE * _AXIS / (1 + n) * (1 + n**2 / 4 + n**4 / 64)
    return np.stack([_EASTING + radius * east, (_NORTHING if south else 0.0) + radius * north, height], axis=1)
