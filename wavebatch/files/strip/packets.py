"""Where the packets of a strip lie, how their samples were made, and the samples themselves, many at a time."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.core.units import PS_PER_NS
from wavebatch.core.waveforms import Digitizer
from wavebatch.files.disk.raw_bytes import read_exactly
from wavebatch.files.las.checked_header import CheckedHeader
from wavebatch.files.las.header import (
    EVLR_HEADER_SIZE,
    WAVEFORM_RECORD_ID,
    WAVES_EXTERNAL,
    WAVES_INTERNAL,
    LasHeader,
    find_evlrs,
)

MAX_SAMPLES = 1 << 16
"""Waveforms longer than this are taken for damage."""
MAX_EVLRS = 4096
BLOCK_BYTES = 1 << 25
"""Most bytes of samples in one block, whatever number of waveforms was asked for."""
_DESCRIPTOR = struct.Struct("<BBIIdd")
_FIRST_ID, _LAST_ID = 100, 354
_SPARSE = 4
"""A span is read whole when it is at most this many times what is wanted of it."""
_SPAN = 1 << 22
_GAP = 1 << 14


@dataclass(frozen=True, slots=True)
class PacketPlace:
    """Legal bytes [start, end) of `file`; the packet with byte offset o begins at `base` + o. None: there are none."""

    file: Path | None
    internal: bool
    base: int
    start: int
    end: int
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Descriptors:
    """The wave packet descriptors of a strip by index."""

    digitizers: dict[int, Digitizer]
    compression: dict[int, int]
    warnings: tuple[str, ...]


def read_descriptors(header: LasHeader) -> Descriptors:
    """Every descriptor among the VLRs, unused and empty ones too; what a file refers to is judged later."""
    digitizers: dict[int, Digitizer] = {}
    compression: dict[int, int] = {}
    warnings = []
    for vlr in header.vlrs:
        if vlr.user != "LASF_Spec" or not _FIRST_ID <= vlr.record_id <= _LAST_ID:
            continue
        index = vlr.record_id - _FIRST_ID + 1
        if len(vlr.payload) < _DESCRIPTOR.size:
            warnings.append(f"descriptor {index} has {len(vlr.payload)} bytes instead of 26 and is left out")
            continue
        bits, kind, samples, spacing, gain, offset = _DESCRIPTOR.unpack_from(vlr.payload)
        digitizer = Digitizer(index, bits, samples, spacing / PS_PER_NS, gain, offset)
        if index not in digitizers:
            digitizers[index], compression[index] = digitizer, kind
        elif digitizers[index] != digitizer:
            warnings.append(f"descriptor {index} stands there twice and differs; the first one is used")
    return Descriptors(digitizers, compression, tuple(warnings))


def locate_packets(checked: CheckedHeader, compression: dict[int, int], headerless: bool) -> PacketPlace:
    """Where the packets are: inside the strip, or in the .wdp beside it.

    headerless: take a .wdp that does not begin with the 60 bytes it should; its offsets are counted as if it did.
    Raises InputError where they are missing, compressed, or in a file that is no .wdp.
    """
    header, path = checked.header, checked.path
    if compression and all(compression.values()):
        raise refuse_compressed(path, next(iter(compression.values())))
    if header.global_encoding & WAVES_INTERNAL:
        return _locate_internal(checked)
    beside = _find_beside(path)
    if header.global_encoding & WAVES_EXTERNAL:
        if beside is None:
            if _find_beside(path, "wdz") is not None:
                raise refuse_compressed(path, 1)
            raise InputError(
                f"{path}: its packets are not there: put {path.with_suffix('.wdp').name} beside the strip"
            )
        return _locate_external(checked, beside, headerless)
    warning = "the header does not say where the packets are (global encoding bits 1 and 2)"
    if header.waveform_start:
        place = _locate_internal(checked)
        return replace(place, warnings=(*place.warnings, f"{warning}; they are taken from the record in the file"))
    if beside is not None:
        place = _locate_external(checked, beside, headerless)
        return replace(place, warnings=(*place.warnings, f"{warning}; they are taken from {beside.name}"))
    if _find_beside(path, "wdz") is not None:
        raise refuse_compressed(path, 1)
    return PacketPlace(None, False, 0, 0, 0, (f"{warning}, and there is no .wdp beside it",))


def refuse_compressed(path: Path, kind: int) -> InputError:
    """The error that says what to run for packets that are compressed."""
    return InputError(
        f"{path}: its packets are compressed (type {kind}, LAStools .wdz), which LAS does not define; decompress them "
        f"first: laszip -i {path.name} -o {path.stem}_raw.las -waveform"
    )


def _find_beside(path: Path, suffix: str = "wdp") -> Path | None:
    for candidate in (path.with_suffix(f".{suffix}"), path.with_suffix(f".{suffix.upper()}")):
        if candidate.is_file():
            return candidate
    return None


def _locate_internal(checked: CheckedHeader) -> PacketPlace:
    header, path, size = checked.header, checked.path, checked.size
    capped = replace(header, evlr_count=min(header.evlr_count, MAX_EVLRS))
    evlrs, _ = find_evlrs(path, capped)
    at, warnings = header.waveform_start, []
    if not at:
        at = next((evlr.start for evlr in evlrs if evlr.record_id == WAVEFORM_RECORD_ID), 0)
        warnings.append(f"the header does not point at the waveform record; it was found among the EVLRs at byte {at}")
    least = header.offset_to_points if header.compressed else checked.points_end
    if not least <= at <= size - EVLR_HEADER_SIZE:
        raise InputError(
            f"{path}: the record of its packets would begin at byte {at}; the points end at {least}, the file at "
            f"{size}: the file is cut or its header damaged, get it again"
        )
    with open(path, "rb") as file:
        file.seek(at)
        head = file.read(EVLR_HEADER_SIZE)
    record_id, length = struct.unpack_from("<HQ", head, 18)
    if record_id != WAVEFORM_RECORD_ID:
        raise InputError(
            f"{path}: no waveform record at byte {at} (record id {record_id} instead of 65535); the header's pointer "
            "(byte 227) is wrong: get the file again"
        )
    end = min([size, *(evlr.start for evlr in evlrs if evlr.start > at)])
    if at + EVLR_HEADER_SIZE + length != end:
        warnings.append(f"the waveform record claims {length} bytes, {end - at - EVLR_HEADER_SIZE} are there")
    return PacketPlace(path, True, at, at + EVLR_HEADER_SIZE, end, tuple(warnings))


def _locate_external(checked: CheckedHeader, beside: Path, headerless: bool) -> PacketPlace:
    size = beside.stat().st_size
    with open(beside, "rb") as file:
        head = file.read(EVLR_HEADER_SIZE)
    warnings = []
    if len(head) < EVLR_HEADER_SIZE or not head[2:].startswith(b"LAS") or head[18:20] != b"\xff\xff":
        if not headerless:
            raise InputError(
                f"{checked.path}: {beside.name} does not begin with the 60-byte header of a waveform record; if it "
                "has none, run again with --headerless, else get it again"
            )
        return PacketPlace(beside, False, -EVLR_HEADER_SIZE, 0, size, (f"{beside.name} has no header",))
    (length,) = struct.unpack_from("<Q", head, 20)
    if length not in (0, size - EVLR_HEADER_SIZE):
        warnings.append(f"{beside.name} claims {length} bytes of packets, {size - EVLR_HEADER_SIZE} are there")
    return PacketPlace(beside, False, 0, EVLR_HEADER_SIZE, size, tuple(warnings))


def settle_headerless(place: PacketPlace, points: np.ndarray) -> PacketPlace:
    """The place of packets in a .wdp without header: byte offsets below 60 show that they count from its first byte."""
    offsets = points["wavepacket_offset"][(points["wavepacket_index"] > 0) & (points["wavepacket_size"] > 0)]
    if len(offsets) and int(offsets.min()) < EVLR_HEADER_SIZE:
        return replace(place, base=0)
    return place


class PacketFile:
    """Reads samples of many packets at once."""

    def __init__(self, place: PacketPlace) -> None:
        self._place = place
        self._file = None
        self._buffer = np.empty(0, np.uint8)
        if place.file is not None:
            try:
                self._file = open(place.file, "rb", buffering=0)  # noqa: SIM115 - closed by close()
            except OSError as error:
                raise InputError(f"{place.file}: cannot be read: {error.strerror or error}") from error

    def close(self) -> None:
        """Closes the file; harmless twice."""
        if self._file is not None:
            self._file.close()

    def read(self, offsets: np.ndarray, n_samples: int, bits: int) -> np.ndarray:
        """Raw counts (n, n_samples), u1/u2/u4, read-only, of packets at byte offsets u8 (n,), checked before."""
        width = n_samples * (bits // 8)
        starts = (offsets + np.uint64(self._place.base % 2**64)).astype(np.int64)
        try:
            rows = self._gather(starts, width)
        except OSError as error:
            text = error.strerror or str(error)
            raise InputError(f"{self._place.file}: packets cannot be read: {text}; check the disk") from error
        samples = rows.view(f"<u{bits // 8}")
        samples.flags.writeable = False
        return samples

    def _gather(self, starts: np.ndarray, width: int) -> np.ndarray:
        n = len(starts)
        if n == 0:
            return np.empty((0, width), np.uint8)
        first, last = int(starts.min()), int(starts.max())
        if last - first == (n - 1) * width and (n == 1 or np.all(np.diff(starts) == width)):
            rows = np.empty((n, width), np.uint8)
            read_exactly(self._file.fileno(), rows.reshape(-1), first)
            return rows
        span = last - first + width
        if span <= max(_SPARSE * n * width, _SPAN):
            buffer = self._take_buffer(span)
            read_exactly(self._file.fileno(), buffer, first)
            return _pick(buffer, starts - first, width)
        return self._gather_sparse(starts, width)

    def _gather_sparse(self, starts: np.ndarray, width: int) -> np.ndarray:
        order = np.argsort(starts, kind="stable")
        ordered = starts[order]
        runs = [(a, z, int(ordered[a]), int(ordered[z - 1]) + width) for a, z in _find_runs(ordered, width)]
        buffer = self._take_buffer(sum(end - begin for _, _, begin, end in runs))
        place = np.empty(len(starts), np.int64)
        at = 0
        for a, z, begin, end in runs:
            read_exactly(self._file.fileno(), buffer[at : at + end - begin], begin)
            place[order[a:z]] = ordered[a:z] - begin + at
            at += end - begin
        return _pick(buffer, place, width)

    def _take_buffer(self, size: int) -> np.ndarray:
        if len(self._buffer) < size:
            self._buffer = np.empty(size, np.uint8)
        return self._buffer[:size]


def _find_runs(ordered: np.ndarray, width: int) -> Iterator[tuple[int, int]]:
    """Slices of sorted starts whose gaps are worth reading over."""
    cuts = np.flatnonzero(np.diff(ordered) > width + _GAP) + 1
    edges = [0, *cuts.tolist(), len(ordered)]
    return zip(edges[:-1], edges[1:], strict=True)


def _pick(buffer: np.ndarray, place: np.ndarray, width: int) -> np.ndarray:
    """Rows (n, width) that begin at `place` in the buffer."""
    return np.lib.stride_tricks.sliding_window_view(buffer, width)[place]


def block_rows(size: int, n_samples: int, bits: int) -> int:
    """Waveforms per block: `size`, fewer where so many would not fit memory."""
    return max(1, min(size, BLOCK_BYTES // (n_samples * (bits // 8))))
