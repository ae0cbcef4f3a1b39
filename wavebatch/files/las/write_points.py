"""Writer of one LAS or LAZ file: points in order, then extended records, then the header with true counts and bounds.

The writers of clouds, strips, returns and voxels are built on `PointFile`. The file appears under its name only when
it is complete; the header is written last, because counts and bounds are known only then. Workers call
`compress_rows`, so that the process that writes only joins LAZ chunks.

lazrs has defects with waveform formats (see `compress_rows` and `_encode_coding`), and seeks the wrong points where
chunks have different numbers of them; test changes by reading the output with LASzip too.
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import lazrs
import numpy as np

from wavebatch.core import interrupts
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.frozen import NamedTuple
from wavebatch.files.disk.publish import Draft, publish_together, refuse_existing, reporting
from wavebatch.files.disk.raw_bytes import naming, undoing
from wavebatch.files.las import header as las

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
        # lazrs 0.8 writes wrong packet fields of these formats after a change of scanner channel in a chunk.
        channels = (rows["classification_flags"] >> 4) & 0b11
        if np.any(channels != channels[0]):
            raise InputError(
                "points of several scanner channels with packets cannot be written as LAZ; write LAS, or leave "
                "--keep-packets out"
            )
    coding = lazrs.LazVlr(_encode_coding(point_format, rows.itemsize))
    file = BytesIO()
    try:
        with interrupts.uninterrupted():  # lazrs takes KeyboardInterrupt for a failed write
            compressor = lazrs.LasZipCompressor(file, coding)
            compressor.compress_many(np.ascontiguousarray(rows).view(np.uint8))
            compressor.done()
    except lazrs.LazrsError as error:
        raise InputError(f"the points cannot be compressed: {error}") from error
    whole = np.frombuffer(file.getbuffer(), np.uint8)
    return Chunk(len(rows), whole[8 : int(whole[:8].view("<i8")[0])])  # between the place of the table and the table


class PointEncoder:
    """Writes header, VLRs and records to the file as they are; `finish` ends the points and must be called once."""

    def __init__(self, file: BinaryIO, header: las.LasHeader) -> None:
        self._file = file
        file.write(header.encode())

    def write(self, rows: np.ndarray) -> None:
        self._file.write(rows.view(np.uint8).data)

    def append(self, chunk: Chunk) -> None:
        """Write what another process has encoded."""
        self._file.write(chunk.data.data)

    def finish(self) -> None:
        """Write what is left to be written."""


class _LazEncoder(PointEncoder):
    """Compresses records; adds the "laszip encoded" record to `header.vlrs`."""

    def __init__(self, file: BinaryIO, header: las.LasHeader) -> None:
        self._format, self._coding = header.point_format, _encode_coding(header.point_format, header.point_length)
        header.vlrs.append(las.Vlr(b"laszip encoded", 22204, self._coding, b"http://laszip.org"))
        super().__init__(file, header)
        self._start = file.tell()
        file.write(bytes(8))
        self._chunks: list[tuple[int, int]] = []
        """Points and bytes of each."""
        self._waiting: list[np.ndarray] = []
        self._count = 0
        """Of the points held."""

    def write(self, rows: np.ndarray) -> None:
        self._waiting.append(rows.copy())
        self._count += len(rows)
        if self._count >= CHUNK_POINTS:
            waiting = np.concatenate(self._waiting)
            whole = self._count // CHUNK_POINTS * CHUNK_POINTS
            for first in range(0, whole, CHUNK_POINTS):
                self.append(compress_rows(waiting[first : first + CHUNK_POINTS], self._format))
            self._waiting, self._count = [waiting[whole:].copy()], self._count - whole

    def append(self, chunk: Chunk) -> None:
        if self._chunks and self._chunks[-1][0] != CHUNK_POINTS or chunk.points > CHUNK_POINTS:
            raise ValueError(f"only the last LAZ chunk may have another number of points than {CHUNK_POINTS}")
        super().append(chunk)
        self._chunks.append((chunk.points, len(chunk.data)))

    def finish(self) -> None:
        if self._count:
            self.append(compress_rows(np.concatenate(self._waiting), self._format))
        table = BytesIO()
        lazrs.write_chunk_table(table, self._chunks, lazrs.LazVlr(self._coding))
        at = self._file.tell()
        self._file.write(table.getbuffer())
        self._file.seek(self._start)
        self._file.write(struct.pack("<q", at))


def _encode_coding(point_format: int, point_length: int) -> bytes:
    """The content of the "laszip encoded" record."""
    extra = point_length - las.STANDARD_DTYPES[point_format].itemsize
    payload = bytearray(lazrs.LazVlr.new_for_compression(point_format, extra).record_data())
    # The version of item WAVEPACKET13 becomes 1: LASzip refuses version 2 of lazrs, which has the same coding.
    for at in range(_ITEMS_AT, len(payload) - 5, 6):
        kind, _, version = np.frombuffer(bytes(payload), "<u2", 3, at)
        if (kind, version) == (_WAVE_ITEM, _BROKEN_VERSION):
            payload[at + 4 : at + 6] = _READABLE_VERSION.to_bytes(2, "little")
    return bytes(payload)


_COPY_SIZE = 1 << 22
_EXTRA_BYTES = ("LASF_Spec", las.EXTRA_BYTES_RECORD_ID)


class PointFile(contextlib.AbstractContextManager):
    """Writes points of one dtype to `target`: `write` in order, then `commit`; `.laz` is compressed.

    header: of the output; counts, bounds and offsets are filled in here.
    records: one per extra dimension of dtype; their VLR replaces that in `header.vlrs`, or is appended.
    As a context manager it aborts unless committed.
    Raises InputError if the target exists (without overwrite) or cannot be written, ConfigError for another suffix.
    """

    def __init__(
        self,
        target: Path,
        header: las.LasHeader,
        dtype: np.dtype,
        records: Sequence[las.ExtraRecord],
        *,
        overwrite: bool,
    ) -> None:
        self.target = Path(target)
        self.dtype = dtype
        self._header = header
        self._records = list(records)
        suffix = self.target.suffix.lower()
        if suffix not in (".las", ".laz"):
            raise ConfigError(f"{self.target}: an output's name must end in .las or .laz")
        header.compressed = suffix == ".laz"
        header.point_length = dtype.itemsize
        header.vlrs = [vlr for vlr in header.vlrs if not las.has_record([vlr], "laszip encoded", 22204)]
        self._place_extra_bytes()
        self.statistics = Statistics(dtype, self._records)
        """Of all rows; those of rows that `append` writes are joined to it."""
        refuse_existing(self.target, overwrite)
        self.draft = Draft(self.target, overwrite=overwrite)
        self.drafts = [self.draft]
        """All files that are published together, the point file last."""
        with undoing(self.draft.discard), self._guarded():
            self._encoder = (_LazEncoder if header.compressed else PointEncoder)(self.draft.file, header)

    def __exit__(self, *error: object) -> None:
        self.abort()

    def write(self, rows: np.ndarray) -> None:
        """Append records (m,) of `dtype`."""
        if rows.dtype != self.dtype:
            raise InputError(f"{self.target}: rows of another layout than the file's; this is a bug, please report it")
        if len(rows):
            rows = np.ascontiguousarray(rows)
            self.statistics.add(rows)
            self._write(self._encoder.write, rows)

    def append(self, chunk: Chunk) -> None:
        """Append rows of `dtype` as they stand in the file; of LAZ CHUNK_POINTS each time, but for the last."""
        self._write(self._encoder.append, chunk)

    def _write(self, write: Callable[[Any], None], what: Any) -> None:
        interrupts.check()
        if self.statistics.count >= 2**32 and self._header.version < (1, 4):
            version = "{}.{}".format(*self._header.version)
            raise InputError(f"{self.target}: LAS {version} holds at most 4294967295 points; use --las-version 1.4")
        with self._guarded():
            write(what)
            self.draft.file.flush()  # else a worker forked now would inherit the buffer and write it again

    def append_record(self, head: bytes, source: BinaryIO, start: int, end: int, *, waveforms: bool = False) -> None:
        """Append an extended record: the 60 bytes of `head`, then bytes [start, end) of `source`."""
        with self._guarded():
            at = self.draft.file.tell()
            self.draft.file.write(head)
            copy_bytes(source, start, end, self.draft.file)
        if waveforms:
            self._header.waveform_start = at
        if self._header.version >= (1, 4):
            self._header.evlr_start = self._header.evlr_start or at
            self._header.evlr_count += 1

    def commit(self) -> None:
        """Complete and publish the file with all that belongs to it; on an error nothing of it remains."""
        self.complete()
        self.publish()

    def complete(self) -> int:
        """Complete the file under its temporary name, and return its size; on an error nothing of it remains."""
        with undoing(self.abort):
            with self._guarded():
                self._encoder.finish()
                self.draft.file.seek(0, 2)
            self._append_records()
            self.statistics.fill(self._header)
            self._place_extra_bytes(self.statistics.ranged())
            with self._guarded():
                self.draft.file.seek(0)
                self.draft.file.write(self._header.encode())
                return self.draft.file.seek(0, 2)

    def publish(self, *more: Draft) -> None:
        """Publish the complete file, and the drafts that belong to it after it; on an error nothing of them remains."""
        publish_together([*self.drafts, *more])

    def _append_records(self) -> None:
        """Place for subclasses to append extended records and further drafts."""

    def abort(self) -> None:
        """Remove all that was written; does nothing after `commit`."""
        for draft in self.drafts:
            draft.discard()

    def _place_extra_bytes(self, records: Sequence[las.ExtraRecord] | None = None) -> None:
        records = self._records if records is None else records
        vlrs = self._header.vlrs
        old = next((vlr for vlr in vlrs if las.has_record([vlr], *_EXTRA_BYTES)), None)
        self._header.vlrs = [vlr for vlr in vlrs if not las.has_record([vlr], *_EXTRA_BYTES)]
        payload = b"".join(record.data for record in records)
        if len(payload) > 65535:
            raise InputError(f"{self.target}: a LAS file can describe at most 341 extra bytes, not {len(records)}")
        if records:
            new = replace(old or las.Vlr(b"LASF_Spec", las.EXTRA_BYTES_RECORD_ID, b"", b"Extra bytes"), payload=payload)
            self._header.vlrs.insert(vlrs.index(old) if old else len(vlrs), new)

    @contextlib.contextmanager
    def _guarded(self) -> Iterator[None]:
        """Turns errors of compressor and disk into one InputError line that names the target."""
        with naming(self.target), reporting(self.target):
            yield


class Statistics:
    """Counts, bounds and extremes of all rows written, for the header and the extra-bytes records."""

    def __init__(self, dtype: np.dtype, records: Sequence[las.ExtraRecord]) -> None:
        self.count = 0
        names = las.field_names(dtype)
        fields = names[len(names) - len(records) :]
        self._records = dict(zip(fields, records, strict=True))
        self._bits = np.zeros(256, np.int64)
        self._format_bits = 4 if "classification_flags" in names else 3
        self._axes = [name for name in ("X", "Y", "Z", "gps_time") if name in names]
        self._extremes: dict[tuple[str, int], tuple[Any, Any]] = {}

    def add(self, rows: np.ndarray) -> None:
        """Count the rows (m,) and widen the extremes."""
        self.count += len(rows)
        self._bits += np.bincount(rows["bit_fields"], minlength=256)
        for name in self._axes:
            self._widen(name, rows[name])
        for field, record in self._records.items():
            if record.code:
                self._widen(field, rows[field], record.no_data)

    def join(self, other: Statistics) -> None:
        """Add those of further rows of the same file."""
        self.count += other.count
        self._bits += other._bits
        for key, (low, high) in other._extremes.items():
            least, largest = self._extremes.get(key, (low, high))
            self._extremes[key] = min(low, least), max(high, largest)

    def _widen(self, name: str, values: np.ndarray, no_data: np.ndarray | None = None) -> None:
        for element, column in enumerate(np.atleast_2d(values.T)):
            column = np.ascontiguousarray(column)
            good = np.isfinite(column)
            if no_data is not None:
                good &= column != no_data[element]
            column = column if good.all() else column[good]
            if len(column):
                # Plus 0: which of 0.0 and -0.0 is the least depends on the order of the rows.
                plus = column.dtype.type(0)
                low, high = column.min() + plus, column.max() + plus
                least, largest = self._extremes.get((name, element), (low, high))
                self._extremes[name, element] = min(low, least), max(high, largest)

    def fill(self, header: las.LasHeader) -> None:
        """Set counts and bounds of the header; an empty file gets zeros."""
        header.point_count = self.count
        number = np.arange(256) & ((1 << self._format_bits) - 1)
        by_return = np.bincount(number, self._bits, 16).astype(np.int64)
        header.by_return = tuple(int(n) for n in by_return[1:16])
        bounds = []
        for axis, name in enumerate("XYZ"):
            scale, offset = header.scales[axis], header.offsets[axis]
            ends = self._extremes.get((name, 0))
            bounds.append([0.0, 0.0] if ends is None else sorted(end * scale + offset for end in ends))
        header.mins, header.maxs = (tuple(ends[side] for ends in bounds) for side in (0, 1))
        if header.version >= (1, 5):
            least, largest = self._extremes.get(("gps_time", 0), (0.0, 0.0))
            header.gps_range = (float(largest), float(least))

    def ranged(self) -> list[las.ExtraRecord]:
        """Return the records with the extremes of the written values; a column without any value declares none."""
        ranged = []
        for field, record in self._records.items():
            found = [self._extremes.get((field, element)) for element in range(*record.dtype.shape or (1,))]
            ends = (None, None) if None in found else tuple(map(np.array, zip(*found, strict=True)))
            ranged.append(record.with_range(*ends))
        return ranged


def copy_bytes(source: BinaryIO, start: int, end: int, target: BinaryIO) -> None:
    """Copy bytes [start, end) of one open file to the current place of another, in bounded memory."""
    source.seek(start)
    left = end - start
    while left:
        piece = source.read(min(left, _COPY_SIZE))
        if not piece:
            raise InputError(f"{source.name}: ends {left} bytes too early; it changed while it was read")
        target.write(piece)
        left -= len(piece)


def waveform_head(length: int) -> bytes:
    """Return the 60 bytes before the packets, in the cloud itself or in a `.wdp`."""
    return las.encode_evlr_header(b"LASF_Spec", las.WAVEFORM_RECORD_ID, length, b"wave packets")
