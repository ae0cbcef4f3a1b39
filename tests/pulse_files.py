"""Writes PulseWaves files for tests, record by record as the specification has them."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

HEAD = struct.Struct("<16sII16s64s64sHHBBHqqIIIIqIi2d2q6d6d")
PULSE = struct.Struct("<qq3i3ihhHBB")


@dataclass(frozen=True)
class Sampling:
    """A sampling record; widths of 0 mean that the value stands here."""

    kind: int = 2
    channel: int = 0
    duration_bits: int = 16
    scale: float = 1.0
    offset: float = 0.0
    segment_bits: int = 0
    length_bits: int = 16
    segments: int = 1
    samples: int = 0
    bits: int = 8
    spacing: float = 1.0
    compression: int = 0
    size: int = 104
    """As the record states it; its fields are written in any case."""

    def encode(self) -> bytes:
        """The record."""
        front = struct.pack(
            "<IIBBBBffBBHIHHfI", self.size, 0, self.kind, self.channel, 0, self.duration_bits, self.scale, self.offset,
            self.segment_bits, self.length_bits, self.segments, self.samples, self.bits, 0, self.spacing,
            self.compression,
        )  # fmt: skip
        return front.ljust(self.size, b"\0")


@dataclass
class Pulse:
    """A pulse: per sampling a list of (duration as stored, samples)."""

    waves: Sequence[Sequence[tuple[int, np.ndarray]]]
    time: int = 0
    anchor: tuple[int, int, int] = (0, 0, 1_000_000)
    target: tuple[int, int, int] = (0, 0, 1_000_000 - 149_896)
    descriptor: int = 1
    bits: int = 0
    intensity: int = 0
    classification: int = 0


@dataclass
class PulseFile:
    """All of a file."""

    descriptors: dict[int, Sequence[Sampling]]
    pulses: list[Pulse]
    unit: float = 1.0
    scales: tuple[float, float, float] = (0.001,) * 3
    offsets: tuple[float, float, float] = (500_000.0, 5_000_000.0, 0.0)
    time: tuple[float, float] = (1e-6, 0.0)
    records: list[tuple[str, int, bytes]] = field(default_factory=list)
    appended: list[tuple[str, int, bytes]] = field(default_factory=list)
    extra: int = 0
    """Bytes before the waves of a pulse."""
    source: int = 7

    def write(self, path: Path) -> Path:
        """Write the .pls and the .wvs."""
        waves, offsets = bytearray(b"PulseWavesWaves\0".ljust(60, b"\0")), []
        for pulse in self.pulses:
            offsets.append(len(waves))
            waves += self._encode_waves(pulse)
        path.with_suffix(".wvs").write_bytes(waves)
        records = [("PulseWaves_Spec", 200_000 + index, self._encode(samplings))
                   for index, samplings in self.descriptors.items()]  # fmt: skip
        front = b"".join(
            struct.pack("<16sIIq64s", user.encode(), number, 0, len(data), b"") + data
            for user, number, data in [*records, *self.records]
        )
        body = b"".join(
            PULSE.pack(p.time, at, *p.anchor, *p.target, 0, 0, p.descriptor | p.bits << 12, p.intensity,
                       p.classification)
            for p, at in zip(self.pulses, offsets, strict=True)
        )  # fmt: skip
        tail = struct.pack("<16sIIq64s", b"PulseWaves_Spec", 0xFFFFFFFF, 0, 0, b"")
        tail += b"".join(data + struct.pack("<16sIIq64s", user.encode(), number, 0, len(data), b"")
                         for user, number, data in self.appended)  # fmt: skip
        head = HEAD.pack(
            b"PulseWavesPulse", 0, self.source, bytes(16), b"a sensor", b"tests", 1, 2026, 0, 3, 352, 352 + len(front),
            len(self.pulses), 0, 0, 48, 0, 0, len(records) + len(self.records), -1, *self.time, 0, 0, *self.scales,
            *self.offsets, *(0.0,) * 6,
        )  # fmt: skip
        path.write_bytes(head + front + body + tail)
        return path

    def _encode(self, samplings: Sequence[Sampling]) -> bytes:
        size = 92 if all(sampling.size for sampling in samplings) else 0  # as its samplings, shorter than its fields
        front = struct.pack("<IIiHHfII", size, 0, 0, self.extra, len(samplings), self.unit, 0, 0).ljust(size, b"\0")
        return front + b"".join(sampling.encode() for sampling in samplings)

    def _encode_waves(self, pulse: Pulse) -> bytes:
        data = bytearray(self.extra)
        for sampling, segments in zip(self.descriptors.get(pulse.descriptor, ()), pulse.waves, strict=True):
            data += _integer(len(segments), sampling.segment_bits)
            for duration, samples in segments:
                data += _integer(duration, sampling.duration_bits, signed=True)
                data += _integer(len(samples), sampling.length_bits)
                data += np.asarray(samples).astype(f"<u{sampling.bits // 8}").tobytes()
        return bytes(data)


def _integer(value: int, bits: int, *, signed: bool = False) -> bytes:
    return value.to_bytes(bits // 8, "little", signed=signed) if bits else b""


def bell(length: int, centre: float, height: float, sigma: float, level: float = 2.0) -> np.ndarray:
    """Counts of a Gaussian pulse."""
    time = np.arange(length)
    return np.round(level + height * np.exp(-0.5 * ((time - centre) / sigma) ** 2)).astype(np.int64)
