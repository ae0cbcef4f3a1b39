"""The header of a PulseWaves file and the descriptors of its pulses, checked against the sizes of both files.

`PulseReader` starts with `read_pulse_header`. The format is PulseWaves 0.3 revision 6 (docs/las-waveforms.md 10). The
files may hold any bytes: every check here is there because the reader relies on it.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.files.disk.raw_bytes import damaged, open_regular, reporting_reads
from wavebatch.files.las.checked_header import LARGEST_OFFSET, LARGEST_SCALE, LEAST_SCALE
from wavebatch.files.las.header import MAX_FILE, MAX_FRONT, MAX_VLRS, PROJECTION, Vlr, decode_text
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


@dataclass(frozen=True, slots=True)
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


@dataclass(frozen=True, slots=True)
class Descriptor:
    """How the waves of a pulse are stored."""

    extra: int
    """Bytes before the first sampling."""
    unit: float
    """Sampling unit [ns]: durations count in it, and 1000 of them lie between anchor and target."""
    scanner: int
    samplings: tuple[Sampling, ...]


@dataclass(frozen=True, slots=True, eq=False)
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


def find_waves(path: Path) -> Path:
    """Return the .wvs beside a .pls; raises InputError where it is missing or compressed."""
    for suffix in (".wvs", ".WVS"):
        if path.with_suffix(suffix).is_file():
            return path.with_suffix(suffix)
    if any(path.with_suffix(suffix).is_file() for suffix in (".wvz", ".WVZ")):
        raise refuse_packed_waves(path)
    raise InputError(f"{path}: its waves are missing: put {path.with_suffix('.wvs').name} next to it")


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
            raise InputError(f"{path}: not a PulseWaves file (it does not begin with PulseWavesPulse)")
        if len(front) < _HEADER_SIZE:
            raise damaged(path, f"a header of {len(front)} bytes instead of {_HEADER_SIZE}")
        return _read(file, path, front)


def _read(file: BinaryIO, path: Path, front: bytes) -> PulseHeader:
    (_, _, major, minor, header_size, start, count, form, attributes, length, compression, _, records, appended,
     time_scale, time_offset, _, _, *numbers) = _NUMBERS.unpack_from(front, 168)  # fmt: skip
    size = os.fstat(file.fileno()).st_size
    if compression or path.suffix.lower() == ".plz":
        raise refuse_packed_waves(path)
    if major or form:
        raise InputError(f"{path}: PulseWaves {major}.{minor}, pulse format {form}; wavebatch reads 0.3, format 0")
    if not (_HEADER_SIZE <= header_size <= start <= size < MAX_FILE) or start > MAX_FRONT or records > MAX_VLRS:
        raise damaged(path, f"header of {header_size} bytes and {records} records, pulses at byte {start} of {size}")
    if not 48 <= length <= MOST_PULSE_BYTES or not 0 <= count <= (size - start) // length:
        raise damaged(path, f"{count} pulses of {length} bytes do not fit between byte {start} and the end at {size}")
    scales, offsets = np.array(numbers[:3]), np.array(numbers[3:])
    _check_scales(path, scales, offsets, time_scale, time_offset)
    found = [*_list_records(file, path, header_size, start, records)]
    found += _list_appended(file, size, start + count * length, appended)
    descriptors: dict[int, Any] = {}
    for user, number, payload in found:
        if user == _SPEC and 200_000 < number <= 200_255:
            descriptors.setdefault(number - 200_000, _read_descriptor(path, number - 200_000, payload))
    waves = find_waves(path)
    return PulseHeader(
        path, waves, _check_waves(path, waves), decode_text(front[40:104]), decode_text(front[104:168]),
        struct.unpack_from("<I", front, 20)[0], start, count, _build_dtype(attributes, length), time_scale, time_offset,
        scales, offsets, descriptors,
        tuple(Vlr(PROJECTION.encode(), number, payload) for user, number, payload in found
              if user == _PROJ and number in (34735, 34736, 34737) and len(payload) < 65536),
    )  # fmt: skip


def _check_scales(path: Path, scales: np.ndarray, offsets: np.ndarray, *time: float) -> None:
    good = (np.abs(scales) >= LEAST_SCALE) & (np.abs(scales) <= LARGEST_SCALE) & (np.abs(offsets) <= LARGEST_OFFSET)
    if not good.all() or not (LEAST_SCALE <= abs(time[0]) <= LARGEST_SCALE and abs(time[1]) <= LARGEST_OFFSET):
        raise damaged(path, "scales or offsets of coordinates or time that no survey has")


def _build_dtype(attributes: int, length: int) -> np.dtype:
    """The pulse record; the attributes that 0.3 defines are sources of points of 2 and of 4 bytes."""
    fields, at = list(PULSE), 48
    for bit, kind in _POINT_SOURCE.items():
        if attributes & bit and at + int(kind[2]) <= length and "point_source" not in [field[0] for field in fields]:
            fields.append(("point_source", kind))
            at += int(kind[2])
    return np.dtype([*fields, ("rest", f"V{length - at}")] if length > at else fields)


def _list_records(
    file: BinaryIO, path: Path, at: int, end: int, count: int
) -> Iterator[tuple[str, int, bytes]]:
    for number in range(count):
        file.seek(at)
        head = file.read(_RECORD.size)
        user, record, _, length, _ = _RECORD.unpack(head.ljust(_RECORD.size, b"\0"))
        if length < 0 or at + _RECORD.size + length > end:
            raise damaged(path, f"record {number} of {count} runs into the pulses")
        yield decode_text(user), record, file.read(length)
        at += _RECORD.size + length


def _list_appended(file: BinaryIO, end: int, least: int, count: int) -> Iterator[tuple[str, int, bytes]]:
    """Records behind the pulses: each ends with its head, so they are read from the end of the file."""
    left = MAX_VLRS if count < 0 else min(count, MAX_VLRS)
    while left and end - _RECORD.size >= least:
        file.seek(end - _RECORD.size)
        user, record, _, length, _ = _RECORD.unpack(file.read(_RECORD.size))
        start = end - _RECORD.size - length
        if record == _END or not 0 <= length <= MAX_FRONT or start < least:
            return
        file.seek(start)
        yield decode_text(user), record, file.read(length)
        end, left = start, left - 1


def _check_waves(path: Path, waves: Path) -> int:
    with reporting_reads(waves), open_regular(waves) as file:
        head = file.read(WAVES_HEADER_SIZE)
        size = os.fstat(file.fileno()).st_size
    if len(head) < WAVES_HEADER_SIZE or not head.startswith(WAVES_SIGNATURE):
        raise damaged(path, f"{waves.name} does not begin with PulseWavesWaves")
    if struct.unpack_from("<I", head, 16)[0]:
        raise refuse_packed_waves(path)
    if size >= MAX_FILE:
        raise damaged(path, f"{waves.name} has {size} bytes")
    return size


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
        samplings.append(_read_sampling(path, index, payload, at))
        at += max(struct.unpack_from("<I", payload, at)[0], _SAMPLING.size)
    return Descriptor(extra, float(unit), scanner, tuple(samplings))


def _read_sampling(path: Path, index: int, payload: bytes, at: int) -> Sampling:
    (_, _, kind, channel, _, duration_bits, scale, offset, segment_bits, length_bits, segments, samples, bits, _,
     spacing, compression) = _SAMPLING.unpack_from(payload, at)  # fmt: skip
    if compression:
        raise refuse_packed_waves(path)
    widths = duration_bits in _INTEGERS and segment_bits in _INTEGERS[:3] and length_bits in _INTEGERS[:3]
    counts = (segment_bits or segments <= MOST_SEGMENTS) and (length_bits or samples <= MAX_SAMPLES)
    times = abs(scale) < LARGEST_OFFSET and abs(offset) < LARGEST_OFFSET and LEAST_SPACING <= spacing <= MAX_SPACING
    if not widths or not counts or not times or bits not in _INTEGERS[1:]:
        raise InputError(
            f"{path}: descriptor {index} has a sampling of {segments} segments of {samples} samples of {bits} bits, "
            f"{spacing:g} ns apart, with integers of {duration_bits}, {segment_bits} and {length_bits} bits; wavebatch "
            "reads samples of 8, 16 or 32 bits: the file is damaged, or write it again with such samples"
        )
    return Sampling(
        kind, channel, duration_bits, float(scale), float(offset), segment_bits, length_bits, segments, samples, bits,
        float(spacing),
    )  # fmt: skip
