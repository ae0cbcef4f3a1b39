"""Point records written to a file: plain, or compressed by lazrs.

`write_points.PointFile` calls it. lazrs has defects with waveform formats (see `_LazrsEncoder` and `_patch_wave_item`);
test changes by reading the output with LASzip too.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from typing import Any, BinaryIO

import lazrs
import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.core.interrupts import uninterrupted
from wavebatch.files.las.header import STANDARD_DTYPES, LasHeader, Vlr

_WAVE_ITEM, _BROKEN_VERSION, _READABLE_VERSION = 9, 2, 1
CHUNK_POINTS = 50_000
"""Points of a LAZ chunk: what lazrs writes."""
_ITEMS_AT = 34
"""Offset of the list of items in the "laszip encoded" record."""


class PointEncoder:
    """Writes records to the file as they are; `finish` ends the points and must be called once."""

    def __init__(self, file: BinaryIO, header: LasHeader) -> None:
        self._file = file
        file.write(header.encode())

    def write(self, rows: np.ndarray) -> None:
        self._file.write(rows.view(np.uint8).data)

    def finish(self) -> None:
        """Write what is left to be written."""


def open_encoder(file: BinaryIO, header: LasHeader, threads: int = 1) -> PointEncoder:
    """Write header and VLRs at the start of `file` and return the encoder for the points after them.

    For a compressed file the "laszip encoded" record is added to `header.vlrs`, and `threads` compress; the bytes do
    not depend on their number.
    """
    if not header.compressed:
        return PointEncoder(file, header)
    return _LazrsEncoder(file, header, threads)


class _WatchedFile:
    """File for the compressors that keeps the first error: they report only that a write failed, not why."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._error: BaseException | None = None

    def __getattr__(self, name: str) -> Callable:
        function = getattr(self._file, name)

        def watched(*arguments: Any) -> Any:
            try:
                return function(*arguments)
            except BaseException as error:
                self._error = self._error or error
                raise

        return watched

    @contextlib.contextmanager
    def explaining(self) -> Iterator[None]:
        """Around every call of a compressor, which would take KeyboardInterrupt for a failed write."""
        try:
            with uninterrupted():
                yield
        except lazrs.LazrsError as error:
            raise self._error or InputError(f"the points cannot be compressed: {error}") from error


class _LazrsEncoder(PointEncoder):
    """lazrs 0.8 writes wrong packet fields in formats 9 and 10 after a change of scanner channel; refused here."""

    def __init__(self, file: BinaryIO, header: LasHeader, threads: int) -> None:
        extra = header.point_length - STANDARD_DTYPES[header.point_format].itemsize
        vlr = lazrs.LazVlr.new_for_compression(header.point_format, extra)
        payload = _patch_wave_item(bytes(vlr.record_data()))
        header.vlrs.append(Vlr(b"laszip encoded", 22204, payload, b"http://laszip.org"))
        super().__init__(file, header)
        self._guarded = header.point_format in (9, 10)
        self._channel: int | None = None
        self._watched = _WatchedFile(file)
        self._coding, self._threads = lazrs.LazVlr(payload), threads
        self._compressor: Any = None
        self._held: list[np.ndarray] = []

    def write(self, rows: np.ndarray) -> None:
        if self._guarded:
            self._check_channel(rows)
        self._held.append(rows.view(np.uint8))
        least = self._threads * CHUNK_POINTS if self._threads > 1 else 1  # each thread takes a chunk
        if sum(map(len, self._held)) >= least * rows.itemsize:
            self._compress()

    def _compress(self) -> None:
        if self._compressor is None:
            os.environ.setdefault("RAYON_NUM_THREADS", str(self._threads))  # lazrs reads it when its threads start
            # Several threads would write a chunk into a file without points.
            several = self._threads > 1 and self._held
            make = lazrs.ParLasZipCompressor if several else lazrs.LasZipCompressor
            self._compressor = make(self._watched, self._coding)
        with self._watched.explaining():
            for held in [np.concatenate(self._held)] if len(self._held) > 1 else self._held:
                self._compressor.compress_many(held)
        self._held = []

    def _check_channel(self, rows: np.ndarray) -> None:
        channels = (rows["classification_flags"] >> 4) & 0b11
        if self._channel is None and len(rows):
            self._channel = int(channels[0])
        if np.any(channels != self._channel):
            raise InputError(
                "points of several scanner channels with packets cannot be written as LAZ; write LAS, or leave "
                "--keep-packets out"
            )

    def finish(self) -> None:
        self._compress()
        with self._watched.explaining():
            self._compressor.done()


def _patch_wave_item(payload: bytes) -> bytes:
    """Sets the version of item WAVEPACKET13 to 1: LASzip refuses version 2 of lazrs, which has the same coding."""
    patched = bytearray(payload)
    for at in range(_ITEMS_AT, len(payload) - 5, 6):
        kind, _, version = np.frombuffer(payload, "<u2", 3, at)
        if (kind, version) == (_WAVE_ITEM, _BROKEN_VERSION):
            patched[at + 4 : at + 6] = _READABLE_VERSION.to_bytes(2, "little")
    return bytes(patched)
