"""Point records written to a file: plain, or as LAZ chunks that lazrs compresses.

`write_points.PointFile` calls it; workers call `compress_rows`, so that the process that writes only joins chunks.
lazrs has defects with waveform formats (see `_check_channel` and `_patch_wave_item`), and seeks the wrong points where
chunks have different numbers of them; test changes by reading the output with LASzip too.
"""

from __future__ import annotations

import struct
from io import BytesIO
from typing import BinaryIO, NamedTuple

import lazrs
import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.core.interrupts import uninterrupted
from wavebatch.files.las.header import STANDARD_DTYPES, LasHeader, Vlr

_WAVE_ITEM, _BROKEN_VERSION, _READABLE_VERSION = 9, 2, 1
CHUNK_POINTS = 50_000
"""Points of every LAZ chunk but the last: what lazrs and LASzip write."""
_ITEMS_AT = 34
"""Offset of the list of items in the "laszip encoded" record."""


class Chunk(NamedTuple):
    """Records as their bytes in the file; of LAZ one chunk."""

    points: int
    data: np.ndarray
    """u1 (k,)."""


def compress_rows(rows: np.ndarray, point_format: int) -> Chunk:
    """Compress records (m,), at most CHUNK_POINTS; the bytes depend on nothing that is written before them.

    Raises
    ------
    InputError
        Where lazrs cannot compress them.
    """
    if point_format in (9, 10):
        _check_channel(rows)
    coding = lazrs.LazVlr(_encode_coding(point_format, rows.itemsize))
    file = BytesIO()
    try:
        with uninterrupted():  # lazrs takes KeyboardInterrupt for a failed write
            compressor = lazrs.LasZipCompressor(file, coding)
            compressor.compress_many(np.ascontiguousarray(rows).view(np.uint8))
            compressor.done()
    except lazrs.LazrsError as error:
        raise InputError(f"the points cannot be compressed: {error}") from error
    whole = np.frombuffer(file.getbuffer(), np.uint8)
    return Chunk(len(rows), whole[8 : int(whole[:8].view("<i8")[0])])  # between the place of the table and the table


class PointEncoder:
    """Writes records to the file as they are; `finish` ends the points and must be called once."""

    def __init__(self, file: BinaryIO, header: LasHeader) -> None:
        self._file = file
        file.write(header.encode())

    def write(self, rows: np.ndarray) -> None:
        self._file.write(rows.view(np.uint8).data)

    def append(self, chunk: Chunk) -> None:
        """Write what another process has encoded."""
        self._file.write(chunk.data.data)

    def finish(self) -> None:
        """Write what is left to be written."""


def open_encoder(file: BinaryIO, header: LasHeader) -> PointEncoder:
    """Write header and VLRs at the start of `file` and return the encoder for the points after them.

    For a compressed file the "laszip encoded" record is added to `header.vlrs`.
    """
    return _LazEncoder(file, header) if header.compressed else PointEncoder(file, header)


class _LazEncoder(PointEncoder):
    def __init__(self, file: BinaryIO, header: LasHeader) -> None:
        self._format, self._coding = header.point_format, _encode_coding(header.point_format, header.point_length)
        header.vlrs.append(Vlr(b"laszip encoded", 22204, self._coding, b"http://laszip.org"))
        super().__init__(file, header)
        self._start = file.tell()
        file.write(bytes(8))
        self._chunks: list[tuple[int, int]] = []
        """Points and bytes of each."""
        self._held: list[np.ndarray] = []
        self._count = 0
        """Of the points held."""

    def write(self, rows: np.ndarray) -> None:
        self._held.append(rows.copy())
        self._count += len(rows)
        if self._count >= CHUNK_POINTS:
            held = np.concatenate(self._held)
            whole = self._count // CHUNK_POINTS * CHUNK_POINTS
            for first in range(0, whole, CHUNK_POINTS):
                self.append(compress_rows(held[first : first + CHUNK_POINTS], self._format))
            self._held, self._count = [held[whole:].copy()], self._count - whole

    def append(self, chunk: Chunk) -> None:
        if self._chunks and self._chunks[-1][0] != CHUNK_POINTS or chunk.points > CHUNK_POINTS:
            raise ValueError(f"only the last LAZ chunk may have another number of points than {CHUNK_POINTS}")
        super().append(chunk)
        self._chunks.append((chunk.points, len(chunk.data)))

    def finish(self) -> None:
        if self._count:
            self.append(compress_rows(np.concatenate(self._held), self._format))
        table = BytesIO()
        lazrs.write_chunk_table(table, self._chunks, lazrs.LazVlr(self._coding))
        at = self._file.tell()
        self._file.write(table.getbuffer())
        self._file.seek(self._start)
        self._file.write(struct.pack("<q", at))


def _check_channel(rows: np.ndarray) -> None:
    """lazrs 0.8 writes wrong packet fields of formats 9 and 10 after a change of scanner channel in a chunk."""
    channels = (rows["classification_flags"] >> 4) & 0b11
    if np.any(channels != channels[0]):
        raise InputError(
            "points of several scanner channels with packets cannot be written as LAZ; write LAS, or leave "
            "--keep-packets out"
        )


def _encode_coding(point_format: int, point_length: int) -> bytes:
    """The content of the "laszip encoded" record."""
    extra = point_length - STANDARD_DTYPES[point_format].itemsize
    return _patch_wave_item(bytes(lazrs.LazVlr.new_for_compression(point_format, extra).record_data()))


def _patch_wave_item(payload: bytes) -> bytes:
    """Sets the version of item WAVEPACKET13 to 1: LASzip refuses version 2 of lazrs, which has the same coding."""
    patched = bytearray(payload)
    for at in range(_ITEMS_AT, len(payload) - 5, 6):
        kind, _, version = np.frombuffer(payload, "<u2", 3, at)
        if (kind, version) == (_WAVE_ITEM, _BROKEN_VERSION):
            patched[at + 4 : at + 6] = _READABLE_VERSION.to_bytes(2, "little")
    return bytes(patched)
