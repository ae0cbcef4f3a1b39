"""Pulses of a PulseWaves file and the segments of their waves, many pulses at a time, in bounded memory.

`tools.archives` reads all of a file through `PulseReader`. What varies from pulse to pulse stands inside the waves, so
each piece of them is walked through once: sampling by sampling, segment by segment, for all its pulses together.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wavebatch.core import interrupts
from wavebatch.files.disk.raw_bytes import Closing, damaged, open_regular, read_exactly, reporting_reads
from wavebatch.files.pulsewaves.header import MOST_SEGMENTS, WAVES_HEADER_SIZE, Descriptor, PulseHeader, Sampling
from wavebatch.files.strip.packets import MAX_SAMPLES

PULSES = 50_000
"""Most pulses read at a time."""
PIECE_BYTES = 1 << 25
"""Bytes of waves, about, that are read at a time; pulses that lie far apart are read in smaller pieces."""
_AHEAD = 1 << 16


@dataclass(frozen=True, slots=True, eq=False)
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
        return Segments(*(getattr(self, name)[rows] for name in self.__slots__))


@dataclass(frozen=True, slots=True, eq=False)
class PulsePiece:
    """Consecutive pulses with their segments."""

    first: int
    """Index of the first pulse in the file."""
    pulses: np.ndarray
    """Pulse records (n,), see `header.PULSE`."""
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
            self._hold(low, high)
        return np.lib.stride_tricks.sliding_window_view(self._bytes, width)[places - self._start]

    def _hold(self, low: int, high: int) -> None:
        end = self._start + len(self._bytes)
        if self._start <= low < end:  # walking on: what is there stays
            high = min(max(high, low + 2 * (high - low)) + _AHEAD, self._size)
            kept = self._bytes[low - self._start :]
            more = np.empty(high - low, np.uint8)
            more[: len(kept)] = kept
            self._read(more[len(kept) :], low + len(kept))
            self._start, self._bytes = low, more
            return
        high = min(high + _AHEAD, self._size)
        self._start, self._bytes = low, np.empty(high - low, np.uint8)
        self._read(self._bytes, low)

    def _read(self, target: np.ndarray, at: int) -> None:
        with reporting_reads(self._path):
            read_exactly(self._fd, target, at)


class PulseReader(Closing):
    """Reads the pulses of a PulseWaves file in order, piece by piece. A context manager.

    pulses, size: most pulses (None: PULSES), and about the most bytes of waves, of a piece.
    """

    def __init__(self, header: PulseHeader, *, pulses: int | None = None, size: int = PIECE_BYTES) -> None:
        self.header, self._size = header, size
        self._pulses = open_regular(header.path)
        try:
            self._waves = open_regular(header.waves)
        except BaseException:
            self._pulses.close()
            raise
        each = max(header.waves_size // max(header.count, 1), 1)
        self._step = int(np.clip(size // each, 1, pulses or PULSES))

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
            for begin, end in self._cut(pulses["offset"]):
                yield self._read(first + begin, pulses[begin:end])

    def _cut(self, offsets: np.ndarray) -> Iterator[tuple[int, int]]:
        """Runs of pulses whose waves lie near each other, so that no piece of the file is larger than twice a usual."""
        begin = 0
        while begin < len(offsets):
            part = offsets[begin:]
            span = np.maximum.accumulate(part) - np.minimum.accumulate(part)
            many = int(np.searchsorted(span, 2 * self._size, side="right"))
            yield begin, begin + max(many, 1)
            begin += max(many, 1)

    def _read(self, first: int, pulses: np.ndarray) -> PulsePiece:
        header = self.header
        anchor = pulses["anchor"] * header.scales + header.offsets
        direction = (pulses["target"].astype(np.float64) - pulses["anchor"]) * (header.scales / 1000)
        waves = Waves(header.waves, self._waves.fileno(), header.waves_size)
        return PulsePiece(first, pulses, anchor, direction, self._walk(first, pulses, waves), waves)

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
            parts += _Walk(self.header, waves, first).follow(rows, pulses["offset"][rows], descriptor)
        if not parts:
            return Segments(*(np.empty(0) for _ in Segments.__slots__))
        columns = [np.concatenate([part[column] for part in parts]) for column in range(len(Segments.__slots__))]
        order = np.argsort(columns[0] * (1 << 32) + np.concatenate([part[-1] for part in parts]), kind="stable")
        return Segments(*(column[order] for column in columns))


class _Walk:
    """One walk through the waves of the pulses of a descriptor."""

    def __init__(self, header: PulseHeader, waves: Waves, first: int) -> None:
        self._header, self._waves, self._first = header, waves, first

    def follow(self, rows: np.ndarray, offsets: np.ndarray, descriptor: Descriptor) -> Iterator[tuple]:
        """Yields the columns of `Segments`, and the order within a pulse, of each sampling and segment."""
        at = offsets + descriptor.extra
        if offsets.min(initial=WAVES_HEADER_SIZE) < WAVES_HEADER_SIZE:
            self._refuse(rows[np.argmin(offsets)])
        number = 0
        for sampling in descriptor.samplings:
            count = np.full(len(rows), sampling.segments)
            if sampling.segment_bits:
                count = self._integers(rows, at, sampling.segment_bits, signed=False)
                at = at + sampling.segment_bits // 8
            if count.max(initial=0) > MOST_SEGMENTS:
                self._refuse(rows[np.argmax(count)])
            for segment in range(int(count.max(initial=0))):
                has = np.flatnonzero(count > segment)
                yield self._step(rows[has], at, has, sampling, descriptor.unit, number)
                number += 1

    def _step(
        self, rows: np.ndarray, at: np.ndarray, has: np.ndarray, sampling: Sampling, unit: float, number: int
    ) -> tuple:
        """One segment of the pulses `has`; moves their places in `at` behind it."""
        place, n = at[has], len(has)
        start, length = np.full(n, sampling.offset), np.full(n, sampling.samples)
        if sampling.duration_bits:
            start = start + sampling.scale * self._integers(rows, place, sampling.duration_bits, signed=True)
            place = place + sampling.duration_bits // 8
        if sampling.length_bits:
            length = self._integers(rows, place, sampling.length_bits, signed=False)
            place = place + sampling.length_bits // 8
        at[has] = place + length * (sampling.bits // 8)
        over = (at[has] > self._header.waves_size) | (length > MAX_SAMPLES)
        if over.any():
            self._refuse(rows[np.argmax(over)])
        same = (np.full(n, value) for value in (np.uint8(sampling.kind), np.uint8(sampling.channel), sampling.bits))
        return rows, *same, np.full(n, sampling.spacing), np.full(n, unit), start, place, length, np.full(n, number)

    def _integers(self, rows: np.ndarray, at: np.ndarray, bits: int, *, signed: bool) -> np.ndarray:
        over = at > self._header.waves_size - bits // 8
        if over.any():
            self._refuse(rows[np.argmax(over)])
        return self._waves.take(at, bits // 8).view(f"<{'i' if signed else 'u'}{bits // 8}")[:, 0].astype(np.int64)

    def _refuse(self, row: int) -> None:
        raise damaged(self._header.waves, f"the waves of pulse {self._first + int(row)} are not inside the file")
