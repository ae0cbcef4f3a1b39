"""PulseWaves files: header and descriptors, checked against the sizes of both files; pulses and segments of waves.

`tools.import_file` reads all of a file through `PulseReader`, which starts with `read_pulse_header`. The format is
PulseWaves 0.3 revision 6 (docs/las-waveforms.md 10). The files may hold any bytes: every check here is there because
the reader relies on it. What varies from pulse to pulse stands inside the waves, so each piece of them is walked
through once: sampling by sampling, segment by segment, for all its pulses together, in bounded memory.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.core import interrupts
from wavebatch.core.errors import InputError
from wavebatch.core.frozen import frozen
from wavebatch.files.disk.raw_bytes import Closing, damaged, open_regular, read_exactly, reporting_reads, undoing
from wavebatch.files.las.header import MAX_FILE, MAX_FRONT, MAX_VLRS, PROJECTION, Vlr, decode_text
from wavebatch.files.las.read_points import LARGEST_OFFSET, LARGEST_SCALE, LEAST_SCALE
from wavebatch.files.strip.packet_check import MAX_SPACING
from wavebatch.files.strip.packets import MAX_SAMPLES

SIGNATURE = b"PulseWavesPulse\0"
WAVES_SIGNATURE, WAVES_HEADER_SIZE = b"PulseWavesWaves\0", 60

OUTGOING, RETURNING = 1, 2
MOST_SEGMENTS = 255
"""Segments of a sampling: sensors record up to a few, more are damage."""
LEAST_SPACING = 0.001
"""Least time between samples [ns]: LAS counts picoseconds."""
MOST_PULSE_BYTES = 4096
"""Longest pulse record: 48 bytes and attributes."""

_HEADER_SIZE, _SPEC, _PROJ = 352, "PulseWaves_Spec", "PulseWaves_Proj"
_END = 0xFFFFFFFF
_NUMBERS = struct.Struct("<HHBBHqqIIIIqIi2d2q6d")
_RECORD = struct.Struct("<16sIIq64s")
_COMPOSITION = struct.Struct("<IIiHHfII")
_SAMPLING = struct.Struct("<IIBBBBffBBHIHHfI")
_INTEGERS = (0, 8, 16, 32)
_POINT_SOURCE = {1: "<u2", 2: "<u4"}

PULSE = [
    ("time", "<i8"), ("offset", "<i8"), ("anchor", "<i4", 3), ("target", "<i4", 3), ("first", "<i2"), ("last", "<i2"),
    ("bits", "<u2"), ("intensity", "u1"), ("classification", "u1"),
]  # fmt: skip
"""Fields of a pulse record; `bits` has the descriptor, edge, direction and facet."""


@frozen
class Sampling:
    """One sampling of a pulse: how its segments are stored."""

    kind: int
    """OUTGOING or RETURNING."""
    channel: int
    duration_bits: int
    scale: float
    offset: float
    """Duration from the anchor to the first sample: scale x stored + offset [sampling units of the descriptor]."""
    segment_bits: int
    length_bits: int
    segments: int
    """Where segment_bits is 0."""
    samples: int
    """Where length_bits is 0."""
    bits: int
    """Per sample: 8, 16 or 32."""
    spacing: float
    """Time between samples [ns]."""


@frozen
class Descriptor:
    """How the waves of a pulse are stored."""

    extra: int
    """Bytes before the first sampling."""
    unit: float
    """Sampling unit [ns]: durations count in it, and 1000 of them lie between anchor and target."""
    scanner: int
    samplings: tuple[Sampling, ...]


@frozen(eq=False)
class PulseHeader:
    """What the header of a .pls says, checked."""

    path: Path
    waves: Path
    waves_size: int
    system: str
    software: str
    source: int
    start: int
    """First byte of the pulses."""
    count: int
    record: np.dtype
    time_scale: float
    time_offset: float
    scales: np.ndarray
    offsets: np.ndarray
    """Of coordinates, f8 (3,)."""
    descriptors: dict[int, Descriptor]
    projection: tuple[Vlr, ...]
    """GeoTIFF keys as LAS has them."""


def refuse_packed_waves(path: Path) -> InputError:
    """Return the error for compressed PulseWaves, with the command that decompresses them."""
    return InputError(
        f"{path}: it is compressed PulseWaves (.plz, .wvz), which wavebatch does not read; decompress it first with "
        f"the PulseWaves tools: pulsezip -i {path.name} -o {path.stem}.pls"
    )


def read_pulse_header(path: Path) -> PulseHeader:
    """Return the checked header of a .pls and of the .wvs beside it; raises InputError in one line."""
    with reporting_reads(path, remedy="; check name and permissions"), open_regular(path) as file:
        front = file.read(_HEADER_SIZE)
        if not front.startswith(SIGNATURE):
            remedy = "; it is LAS or LAZ, which `wavebatch run` reads" * front.startswith(b"LASF")
            remedy += f"; give the {path.stem}.pls that it belongs to" * front.startswith(b"PulseWavesWaves")
            raise InputError(f"{path}: not a PulseWaves file (it does not begin with PulseWavesPulse){remedy}")
        if len(front) < _HEADER_SIZE:
            raise damaged(path, f"a header of {len(front)} bytes instead of {_HEADER_SIZE}")
        (_, _, major, minor, header_size, start, count, form, attributes, length, compression, _, records, appended,
         time_scale, time_offset, _, _, *numbers) = _NUMBERS.unpack_from(front, 168)  # fmt: skip
        size = os.fstat(file.fileno()).st_size
        if compression or path.suffix.lower() == ".plz":
            raise refuse_packed_waves(path)
        if major or form:
            raise InputError(f"{path}: PulseWaves {major}.{minor}, pulse format {form}; wavebatch reads 0.3, format 0")
        if not (_HEADER_SIZE <= header_size <= start <= size < MAX_FILE) or start > MAX_FRONT or records > MAX_VLRS:
            what = f"header of {header_size} bytes and {records} records"
            raise damaged(path, f"{what}, pulses at byte {start} of {size}")
        if not 48 <= length <= MOST_PULSE_BYTES or not 0 <= count <= (size - start) // length:
            where = f"between byte {start} and the end at {size}"
            raise damaged(path, f"{count} pulses of {length} bytes do not fit {where}")
        scales, offsets = np.array(numbers[:3]), np.array(numbers[3:])
        sizes, shifts = np.abs(np.append(scales, time_scale)), np.abs(np.append(offsets, time_offset))
        if not ((sizes >= LEAST_SCALE) & (sizes <= LARGEST_SCALE) & (shifts <= LARGEST_OFFSET)).all():
            raise damaged(path, "scales or offsets of coordinates or time that no survey has")
        found, at = [], header_size
        for number in range(records):
            file.seek(at)
            user, record, _, size_of_record, _ = _RECORD.unpack(file.read(_RECORD.size).ljust(_RECORD.size, b"\0"))
            if size_of_record < 0 or at + _RECORD.size + size_of_record > start:
                raise damaged(path, f"record {number} of {records} runs into the pulses")
            found.append((decode_text(user), record, file.read(size_of_record)))
            at += _RECORD.size + size_of_record
        # Records behind the pulses: each ends with its head, so they are read from the end of the file.
        end, left = size, MAX_VLRS if appended < 0 else min(appended, MAX_VLRS)
        while left and end - _RECORD.size >= start + count * length:
            file.seek(end - _RECORD.size)
            user, record, _, size_of_record, _ = _RECORD.unpack(file.read(_RECORD.size))
            at = end - _RECORD.size - size_of_record
            if record == _END or not 0 <= size_of_record <= MAX_FRONT or at < start + count * length:
                break
            file.seek(at)
            found.append((decode_text(user), record, file.read(size_of_record)))
            end, left = at, left - 1
        descriptors: dict[int, Any] = {}
        for user, number, payload in found:
            if user == _SPEC and 200_000 < number <= 200_255:
                descriptors.setdefault(number - 200_000, _read_descriptor(path, number - 200_000, payload))
        # The attributes that 0.3 defines are sources of points of 2 and of 4 bytes.
        pulse, at = list(PULSE), 48
        for bit, kind in _POINT_SOURCE.items():
            if attributes & bit and at + int(kind[2]) <= length and "point_source" not in [field[0] for field in pulse]:
                pulse.append(("point_source", kind))
                at += int(kind[2])
        pulse += [("rest", f"V{length - at}")] * (length > at)
        beside = [path.with_suffix(suffix) for suffix in (".wvs", ".WVS")]
        waves = next(filter(Path.is_file, beside), None)
        if waves is None and any(path.with_suffix(suffix).is_file() for suffix in (".wvz", ".WVZ")):
            raise refuse_packed_waves(path)
        if waves is None:
            raise InputError(f"{path}: its waves are missing: put {beside[0].name} next to it")
        with reporting_reads(waves), open_regular(waves) as other:
            head = other.read(WAVES_HEADER_SIZE)
            waves_size = os.fstat(other.fileno()).st_size
        if len(head) < WAVES_HEADER_SIZE or not head.startswith(WAVES_SIGNATURE):
            raise damaged(path, f"{waves.name} does not begin with PulseWavesWaves")
        if struct.unpack_from("<I", head, 16)[0]:
            raise refuse_packed_waves(path)
        if waves_size >= MAX_FILE:
            raise damaged(path, f"{waves.name} has {waves_size} bytes")
        return PulseHeader(
            path, waves, waves_size, decode_text(front[40:104]), decode_text(front[104:168]),
            struct.unpack_from("<I", front, 20)[0], start, count, np.dtype(pulse), time_scale, time_offset,
            scales, offsets, descriptors,
            tuple(Vlr(PROJECTION.encode(), number, payload) for user, number, payload in found
                  if user == _PROJ and number in (34735, 34736, 34737) and len(payload) < 65536),
        )  # fmt: skip


def _read_descriptor(path: Path, index: int, payload: bytes) -> Descriptor:
    """The descriptor of a record; raises InputError for one that no waves can be read with."""
    if len(payload) < _COMPOSITION.size:
        raise damaged(path, f"descriptor {index} has {len(payload)} bytes")
    # Writers fill what follows the scanner with text; only the samplings say whether samples are compressed.
    size, _, _, extra, count, unit, scanner, _ = _COMPOSITION.unpack_from(payload)
    if not LEAST_SPACING <= unit <= MAX_SPACING or not count:
        raise damaged(path, f"descriptor {index} has {count} samplings and units of {unit:g} ns")
    samplings, at = [], max(size, _COMPOSITION.size)
    for number in range(count):
        if at + _SAMPLING.size > len(payload):
            raise damaged(path, f"descriptor {index} ends before sampling {number + 1} of {count}")
        (_, _, kind, channel, _, duration_bits, scale, offset, segment_bits, length_bits, segments, samples, bits, _,
         spacing, compression) = _SAMPLING.unpack_from(payload, at)  # fmt: skip
        if compression:
            raise refuse_packed_waves(path)
        widths = duration_bits in _INTEGERS and segment_bits in _INTEGERS[:3] and length_bits in _INTEGERS[:3]
        counts = (segment_bits or segments <= MOST_SEGMENTS) and (length_bits or samples <= MAX_SAMPLES)
        times = abs(scale) < LARGEST_OFFSET and abs(offset) < LARGEST_OFFSET and LEAST_SPACING <= spacing <= MAX_SPACING
        if not widths or not counts or not times or bits not in _INTEGERS[1:]:
            raise InputError(
                f"{path}: descriptor {index} has a sampling of {segments} segments of {samples} samples of {bits} "
                f"bits, {spacing:g} ns apart, with integers of {duration_bits}, {segment_bits} and {length_bits} bits; "
                "wavebatch reads samples of 8, 16 or 32 bits: the file is damaged, or write it again with such samples"
            )
        samplings.append(Sampling(
            kind, channel, duration_bits, float(scale), float(offset), segment_bits, length_bits, segments, samples,
            bits, float(spacing),
        ))  # fmt: skip
        at += max(struct.unpack_from("<I", payload, at)[0], _SAMPLING.size)
    return Descriptor(extra, float(unit), scanner, tuple(samplings))


PIECE_PULSES = 50_000
"""Most pulses read at a time."""
PIECE_BYTES = 1 << 25
"""Bytes of waves, about, that are read at a time; pulses that lie far apart are read in smaller pieces."""
_AHEAD = 1 << 16


@frozen(eq=False)
class Segments:
    """k segments of waves, in the order of pulse, sampling and time."""

    pulse: np.ndarray
    """Row of the pulse in its piece, i8 (k,)."""
    kind: np.ndarray
    """OUTGOING or RETURNING, u1 (k,)."""
    channel: np.ndarray
    """u1 (k,)."""
    bits: np.ndarray
    """Per sample, i8 (k,)."""
    spacing: np.ndarray
    """Time between samples [ns], f8 (k,)."""
    unit: np.ndarray
    """Sampling unit of the pulse [ns], f8 (k,)."""
    start: np.ndarray
    """Duration from the anchor to the first sample [units], f8 (k,)."""
    offset: np.ndarray
    """Byte of the first sample in the .wvs, i8 (k,)."""
    length: np.ndarray
    """Samples, i8 (k,)."""

    def __len__(self) -> int:
        """Number of segments."""
        return len(self.pulse)

    def take(self, rows: np.ndarray) -> Segments:
        """Return the segments at `rows` (indices or mask)."""
        return Segments(*(getattr(self, one.name)[rows] for one in fields(self)))


@frozen(eq=False)
class PulsePiece:
    """Consecutive pulses with their segments."""

    first: int
    """Index of the first pulse in the file."""
    pulses: np.ndarray
    """Pulse records (n,), see `PULSE`."""
    anchor: np.ndarray
    """f8 (n, 3), in the unit of the coordinates."""
    direction: np.ndarray
    """Away from the sensor, per sampling unit, f8 (n, 3)."""
    segments: Segments
    waves: Waves

    def samples(self, rows: np.ndarray) -> np.ndarray:
        """Return the samples (k, s) of segments with one length and one number of bits."""
        segments = self.segments
        width = int(segments.bits[rows[0]]) // 8
        taken = self.waves.take(segments.offset[rows], int(segments.length[rows[0]]) * width)
        return taken.view(f"<u{width}")


class Waves:
    """Bytes of a .wvs around the places that are asked for."""

    def __init__(self, path: Path, fd: int, size: int) -> None:
        self._path, self._fd, self._size = path, fd, size
        self._start = 0
        self._bytes = np.empty(0, np.uint8)

    def take(self, places: np.ndarray, width: int) -> np.ndarray:
        """Return `width` bytes from each place of the file on, u1 (n, width); all must lie inside the file."""
        if not len(places) or not width:
            return np.empty((len(places), width), np.uint8)
        low, high = int(places.min()), int(places.max()) + width
        if low < self._start or high > self._start + len(self._bytes):
            end = self._start + len(self._bytes)
            walks_on = self._start <= low < end  # then what is there stays
            high = min((max(high, low + 2 * (high - low)) if walks_on else high) + _AHEAD, self._size)
            kept = self._bytes[low - self._start :] if walks_on else self._bytes[:0]
            more = np.empty(high - low, np.uint8)
            more[: len(kept)] = kept
            with reporting_reads(self._path):
                read_exactly(self._fd, more[len(kept) :], low + len(kept))
            self._start, self._bytes = low, more
        return np.lib.stride_tricks.sliding_window_view(self._bytes, width)[places - self._start]


class PulseReader(Closing):
    """Reads the pulses of a PulseWaves file in order, piece by piece. A context manager.

    pulses, size: most pulses (None: PIECE_PULSES), and about the most bytes of waves, of a piece.
    """

    def __init__(self, header: PulseHeader, *, pulses: int | None = None, size: int = PIECE_BYTES) -> None:
        self.header, self._size = header, size
        self._pulses = open_regular(header.path)
        with undoing(self._pulses.close):
            self._waves = open_regular(header.waves)
        each = max(header.waves_size // max(header.count, 1), 1)
        self._step = int(np.clip(size // each, 1, pulses or PIECE_PULSES))

    def close(self) -> None:
        """Close both files."""
        self._pulses.close()
        self._waves.close()

    def pieces(self) -> Iterator[PulsePiece]:
        """Yield all pulses, piece by piece; raises InputError for waves that are not in the file."""
        header = self.header
        for first in range(0, header.count, self._step):
            interrupts.check()
            pulses = np.empty(min(self._step, header.count - first), header.record)
            with reporting_reads(header.path):
                at = header.start + first * header.record.itemsize
                read_exactly(self._pulses.fileno(), pulses.view(np.uint8), at)
            begin = 0
            while begin < len(pulses):
                # A piece has pulses whose waves lie near each other: at most twice as many bytes of the file as usual.
                offsets = pulses["offset"][begin:]
                span = np.maximum.accumulate(offsets) - np.minimum.accumulate(offsets)
                many = max(int(np.searchsorted(span, 2 * self._size, side="right")), 1)
                part = pulses[begin : begin + many]
                anchor = part["anchor"] * header.scales + header.offsets
                direction = (part["target"].astype(np.float64) - part["anchor"]) * (header.scales / 1000)
                waves = Waves(header.waves, self._waves.fileno(), header.waves_size)
                segments = self._walk(first + begin, part, waves)
                yield PulsePiece(first + begin, part, anchor, direction, segments, waves)
                begin += many

    def _walk(self, first: int, pulses: np.ndarray, waves: Waves) -> Segments:
        """The segments of pulses, by pulse, sampling and place in the waves."""
        index = pulses["bits"] & 0xFF
        parts: list[tuple] = []
        for number in np.flatnonzero(np.bincount(index, minlength=256)[1:]) + 1:
            rows = np.flatnonzero(index == number)
            descriptor = self.header.descriptors.get(int(number))
            if descriptor is None:
                pulse = first + int(rows[0])
                raise damaged(self.header.path, f"pulse {pulse} refers to descriptor {number}, which is not there")
            parts += self._follow(waves, first, rows, pulses["offset"][rows], descriptor)
        if not parts:
            return Segments(*(np.empty(0) for _ in fields(Segments)))
        columns = [np.concatenate([part[column] for part in parts]) for column in range(len(fields(Segments)))]
        order = np.argsort(columns[0] * (1 << 32) + np.concatenate([part[-1] for part in parts]), kind="stable")
        return Segments(*(column[order] for column in columns))

    def _follow(
        self, waves: Waves, first: int, rows: np.ndarray, offsets: np.ndarray, descriptor: Descriptor
    ) -> Iterator[tuple]:
        """Walk through the waves of the pulses `rows` of a descriptor.

        Yields the columns of `Segments`, and the order within a pulse, of each sampling and segment.
        """
        size = self.header.waves_size

        def refuse(wrong: np.ndarray, rows: np.ndarray) -> None:
            """Raise InputError where something is wrong (k,) with one of the pulses `rows` (k,)."""
            if wrong.any():
                pulse = first + int(rows[np.argmax(wrong)])
                raise damaged(self.header.waves, f"the waves of pulse {pulse} are not inside the file")

        def integers(rows: np.ndarray, at: np.ndarray, bits: int, *, signed: bool) -> np.ndarray:
            refuse(at > size - bits // 8, rows)
            return waves.take(at, bits // 8).view(f"<{'i' if signed else 'u'}{bits // 8}")[:, 0].astype(np.int64)

        at = offsets + descriptor.extra
        refuse(offsets < WAVES_HEADER_SIZE, rows)
        number = 0
        for sampling in descriptor.samplings:
            count = np.full(len(rows), sampling.segments)
            if sampling.segment_bits:
                count = integers(rows, at, sampling.segment_bits, signed=False)
                at = at + sampling.segment_bits // 8
            refuse(count > MOST_SEGMENTS, rows)
            for segment in range(int(count.max(initial=0))):
                has = np.flatnonzero(count > segment)
                those, place, n = rows[has], at[has], len(has)
                start, length = np.full(n, sampling.offset), np.full(n, sampling.samples)
                if sampling.duration_bits:
                    start = start + sampling.scale * integers(those, place, sampling.duration_bits, signed=True)
                    place = place + sampling.duration_bits // 8
                if sampling.length_bits:
                    length = integers(those, place, sampling.length_bits, signed=False)
                    place = place + sampling.length_bits // 8
                at[has] = place + length * (sampling.bits // 8)  # the next segment begins behind this one
                refuse((at[has] > size) | (length > MAX_SAMPLES), those)
                same = np.uint8(sampling.kind), np.uint8(sampling.channel), sampling.bits, sampling.spacing
                columns = (np.full(n, value) for value in (*same, descriptor.unit))
                yield those, *columns, start, place, length, np.full(n, number)
                number += 1
