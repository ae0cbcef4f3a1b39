"""The header of a LAS or LAZ file, checked before anything else in it is believed, and its points, read by index.

The strip reader, the cloud readers and the output's layout start with `read_checked_header`; points come from
`open_points`, and a read never loads the whole file. Every check is there because later code relies on it: allocations
by counts, offsets into the file, indices of descriptors.

lazrs trusts its input: a wrong size can make it crash, hang or allocate without limit. So all sizes of LAZ chunks are
checked before it gets any bytes, and each chunk is passed on as a small file in memory.
"""

from __future__ import annotations

import itertools
import struct
from io import BytesIO
from pathlib import Path
from typing import Any

import lazrs
import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.core.frozen import NamedTuple, frozen
from wavebatch.files.disk.raw_bytes import damaged, guarded, hiding_failures, read_exactly, reading, undoing
from wavebatch.files.las import header as las

WAVEFORM_FORMATS = (4, 5, 9, 10)
LEAST_SCALE, LARGEST_SCALE, LARGEST_OFFSET = 1e-12, 1e6, 1e12
"""Scales and offsets of coordinates outside these limits [m] are damage: no survey needs them."""


@frozen(eq=False)
class CheckedHeader:
    """A header whose claims fit the size of the file."""

    path: Path
    size: int
    """Bytes of the file."""
    header: las.LasHeader
    dtype: np.dtype
    """One point record with laspy's field names, extra bytes included."""
    records: tuple[las.ExtraRecord, ...]
    points_end: int
    """Byte at which the points end: exact for LAS; for LAZ the start of what follows them."""
    warnings: tuple[str, ...]
    unread: tuple[str, ...]
    """Those of them that say that points are not read."""

    @property
    def version(self) -> str:
        """The LAS version, for example 1.4."""
        return "{}.{}".format(*self.header.version)

    @property
    def extra(self) -> dict[str, las.ExtraRecord]:
        """The record of each extra dimension by its field of `dtype`, in order."""
        names = las.field_names(self.dtype)
        return dict(zip(names[len(names) - len(self.records) :], self.records, strict=True))


def read_checked_header(path: Path, *, waveforms: bool = True) -> CheckedHeader:
    """Return the checked header of a full-waveform strip; its VLRs are read, its points and EVLRs are not.

    waveforms: False accepts any LAS or LAZ file, of any version and point format.
    Raises InputError if it is not a LAS or LAZ file with waveforms, or contradicts itself.
    """
    header = las.read_header(path, (1, 3) if waveforms else (1, 0))
    number = header.point_format
    if waveforms:
        if any(vlr.user == "lascompatible" for vlr in header.vlrs):
            restore = f"laszip -i {path.name} -o {path.stem}_restored.las"
            raise InputError(f"{path}: written in LAStools' LAS 1.4 compatibility mode; restore it first: {restore}")
        if number not in WAVEFORM_FORMATS:
            cloud = "a cloud that wavebatch wrote" if header.generating_software.startswith(b"wavebatch") else "clouds"
            raise InputError(f"{path}: point format {number} has no waveforms, which need format 4, 5, 9 or 10; "
                             f"`wavebatch info` and `stats` read {cloud}")  # fmt: skip
    if number not in las.STANDARD_DTYPES:
        raise damaged(path, f"point format {number} is not known")
    if number >= 6 and header.version < (1, 4):
        major, minor = header.version
        raise damaged(path, f"point format {number} needs LAS 1.4, but the header has version {major}.{minor}")
    extra = header.point_length - las.STANDARD_DTYPES[number].itemsize
    if extra < 0:
        raise damaged(
            path, f"point records of {header.point_length} bytes are too short for format {number} "
            f"({las.STANDARD_DTYPES[number].itemsize})"
        )  # fmt: skip
    for axis, scale, offset in zip("xyz", header.scales, header.offsets, strict=True):
        if not (LEAST_SCALE <= abs(scale) <= LARGEST_SCALE and abs(offset) <= LARGEST_OFFSET):
            raise damaged(path, f"scale {scale} and offset {offset} of {axis} give no usable coordinates")
    payloads = [vlr.payload for vlr in header.vlrs if las.has_record([vlr], "LASF_Spec", las.EXTRA_BYTES_RECORD_ID)]
    records = tuple(las.read_records(payloads[0] if payloads else b"", extra))
    dtype = las.build_dtype(number, records)
    # The claimed points must fit before what follows them.
    start = header.offset_to_points
    points_end, limit = header.file_size, "it ends"
    followers = {"its EVLRs begin": header.evlr_start if header.evlr_count else 0}
    if not header.global_encoding & las.WAVES_EXTERNAL:
        followers["its waveform record begins"] = header.waveform_start
    for what, at in followers.items():
        if start <= at <= header.file_size - las.EVLR_HEADER_SIZE and at < points_end:
            points_end, limit = at, what
    unread: tuple[str, ...] = ()
    if not header.compressed:
        room, points_end = points_end, start + header.point_count * header.point_length
        if points_end > room:
            raise damaged(
                path,
                f"the header claims {header.point_count} points of {header.point_length} bytes from byte {start} on, "
                f"but {limit} at byte {room}, which leaves room for {(room - start) // header.point_length}",
            )
        # Packets may lie in the file although the header says that they do not.
        room = header.waveform_start if points_end <= header.waveform_start < room else room
        if more := (room - points_end) // header.point_length:
            # A program that was stopped writes its points, but not their number.
            unread = (f"the header claims {header.point_count} points, which leaves room for {more} more before "
                      f"{limit}; what is there is not read: if points are missing, get the file again",)  # fmt: skip
    elif (returns := sum(header.by_return)) > header.point_count:  # the size of the last chunk does not say how many
        unread = (f"the header claims {header.point_count} points, but {returns} by return number; no more are "
                  "read: if points are missing, get the file again",)  # fmt: skip
    warnings = unread
    legacy, count = header.counts
    if header.version >= (1, 4) and legacy and legacy != count:
        used = "64-bit" if count else "legacy"
        warnings += (f"legacy point count {legacy} differs from the 64-bit count {count}; the {used} count is used",)
    return CheckedHeader(path, header.file_size, header, dtype, records, points_end, warnings, unread)


LASZIP_USER, LASZIP_ID = "laszip encoded", 22204
MAX_CHUNKS = 2_000_000
"""Most chunks of a file: 10^11 points in chunks of 50,000, the usual size."""
MAX_CHUNK_POINTS = 5_000_000
MAX_CHUNK_BYTES = 1 << 28
"""Largest chunk: it is kept in memory, compressed and decompressed."""
MAX_POINTS_PER_BYTE = 1000
"""More points per byte of file than any compression reaches; real files have fewer than one."""
_PIECE = 50_000
_LASZIP = struct.Struct("<HHBBHIIqqH")
_ITEM = struct.Struct("<HHH")
_VARIABLE = 2**32 - 1
_ITEM_SIZES = {6: 20, 7: 8, 8: 6, 9: 29, 10: 30, 11: 6, 12: 8, 13: 29}
_FORMAT_ITEMS = {
    0: (6,), 1: (6, 7), 2: (6, 8), 3: (6, 7, 8), 4: (6, 7, 9), 5: (6, 7, 8, 9),
    6: (10,), 7: (10, 11), 8: (10, 12), 9: (10, 13), 10: (10, 12, 13),
}  # fmt: skip
_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}
"""Layers per item of the layered coding (point formats 6 to 10); extra bytes have one layer per byte."""
_BYTES = {0, 14}
"""Items of extra bytes."""


NEWEST = 3
"""Highest version of an item that lazrs decodes; the compression of LAS 1.5 has version 4."""


class _Coding(NamedTuple):
    """The checked content of the "laszip encoded" record."""

    payload: bytes
    chunk_points: int
    newest: int
    """Highest version of its items."""
    layers: int
    """Layers of a chunk; 0 in point formats 0 to 5."""


class LazPoints:
    """Reads with lazrs, one chunk in memory at a time; points of a chunk before the wanted ones are decoded too."""

    def __init__(self, checked: CheckedHeader, coding: _Coding) -> None:
        self._checked, self._coding = checked, coding
        self._file = open(checked.path, "rb", buffering=0)  # noqa: SIM115 - closed by close()
        with undoing(self._file.close):
            self._first, self._place = _read_chunk_table(self._file.fileno(), checked, coding)
        self._chunk, self._next = -1, 0
        self._decoder: Any = None

    def read(self, start: int, stop: int) -> np.ndarray:
        rows = np.empty(stop - start, self._checked.dtype)
        done = 0
        with guarded(self._checked.path, start, stop), hiding_failures():
            while done < len(rows):
                chunk = int(np.searchsorted(self._first, start + done, "right")) - 1
                count = min(len(rows) - done, int(self._first[chunk + 1]) - start - done)
                if count == self._first[chunk + 1] - self._first[chunk]:
                    # From memory: 8 % faster than from a file, which lazrs needs for a part of a chunk.
                    data = np.frombuffer(self._read_chunk(chunk).getbuffer(), np.uint8)
                    whole = rows[done : done + count].view(np.uint8).reshape(-1)
                    lazrs.decompress_points(data, self._coding.payload, whole, False)
                else:
                    self._decode_part(chunk, start + done, rows[done : done + count])
                done += count
        return rows

    def _decode_part(self, chunk: int, start: int, rows: np.ndarray) -> None:
        if chunk != self._chunk or start < self._next:
            small = self._read_chunk(chunk)
            small.seek(0)
            self._decoder = lazrs.LasZipDecompressor(small, self._coding.payload)
            self._chunk, self._next = chunk, int(self._first[chunk])
        places = range(self._next, start, _PIECE)
        before = (np.empty(min(_PIECE, start - place), self._checked.dtype) for place in places)
        for part in itertools.chain(before, [rows]):
            self._decoder.decompress_many(part.view(np.uint8).reshape(-1))
            self._next += len(part)

    def _read_chunk(self, chunk: int) -> BytesIO:
        """This chunk as a small LAZ file in memory, so that lazrs cannot read beyond it."""
        start, end = int(self._place[chunk]), int(self._place[chunk + 1])
        data = np.empty(end - start + 8, np.uint8)
        data[:8] = np.frombuffer(struct.pack("<q", len(data)), np.uint8)
        read_exactly(self._file.fileno(), data[8:], start)
        if self._coding.layers:
            at = 8 + self._checked.dtype.itemsize + 4
            sizes, total = data[at : at + 4 * self._coding.layers], at + 4 * self._coding.layers - 8
            if len(sizes) == 4 * self._coding.layers:
                total += int(sizes.view("<u4").sum(dtype=np.uint64))
            if total > len(data) - 8:
                raise damaged(self._checked.path, f"a LAZ chunk of {len(data) - 8} bytes claims {total} bytes")
        count = int(self._first[chunk + 1] - self._first[chunk])
        small = BytesIO(data.data)
        small.seek(0, 2)
        lazrs.write_chunk_table(small, [(count, end - start)], lazrs.LazVlr(self._coding.payload))
        return small

    def close(self) -> None:
        self._file.close()
        self._decoder = None


def _read_chunk_table(fd: int, checked: CheckedHeader, coding: _Coding) -> tuple[np.ndarray, np.ndarray]:
    """First point and first byte of every chunk, i8, both with one more entry for the end."""
    start, total = checked.header.offset_to_points, checked.header.point_count
    if not total:
        return np.zeros(1, np.int64), np.zeros(1, np.int64)
    broken = damaged(checked.path, "the table of LAZ chunks is missing or wrong")
    if start + 8 > checked.size:
        raise broken
    table = _read_number(fd, start, "<i8")
    if table == -1:  # written as a stream: the last 8 bytes hold the place of the table
        table = _read_number(fd, checked.size - 8, "<i8")
    if not start + 8 <= table <= checked.size - 8:
        raise broken
    version, count = _read_number(fd, table, "<u4"), _read_number(fd, table + 4, "<u4")
    if version != 0 or not 0 < count <= min(MAX_CHUNKS, table - start - 8):
        raise broken
    with open(checked.path, "rb") as file, guarded(checked.path, 0, total), hiding_failures():
        file.seek(table)
        chunks = np.array(lazrs.read_chunk_table_only(file, lazrs.LazVlr(coding.payload)), np.uint64)
    if len(chunks) != count or (chunks > np.uint64(max(MAX_CHUNK_BYTES, MAX_CHUNK_POINTS))).any():
        raise broken
    counts, sizes = chunks.astype(np.int64).T
    if coding.chunk_points != _VARIABLE:
        counts = np.full(count, coding.chunk_points)
    counts[-1] = min(counts[-1], total - counts[:-1].sum())
    if counts.min() < 0 or counts.max() > MAX_CHUNK_POINTS or counts.sum() != total or sizes.max() > MAX_CHUNK_BYTES:
        raise InputError(
            f"{checked.path}: {count} LAZ chunks hold {counts.clip(0).sum()} points, the header claims {total}; the "
            "file is damaged or its chunks are too large: see what laszip -i IN.laz -o OUT.las reports"
        )
    first = np.concatenate([[0], np.cumsum(counts)])
    place = start + 8 + np.concatenate([[0], np.cumsum(sizes)])
    if place[-1] > table or (sizes < checked.dtype.itemsize)[counts > 0].any():
        raise broken
    return first, place


def _read_number(fd: int, at: int, dtype: str) -> int:
    data = np.empty(1, dtype)
    read_exactly(fd, data.view(np.uint8), at)
    return int(data[0])


def open_points(checked: CheckedHeader) -> PointSource:
    """Return a reader of the points of a checked file: plain LAS, or LAZ.

    Raises InputError if the records of the compression are damaged, or are those of LAS 1.5.
    """
    path, header = checked.path, checked.header
    with reading(path):
        if not header.compressed:
            return _PlainPoints(checked)
        payload = next((vlr.payload for vlr in header.vlrs if las.has_record([vlr], LASZIP_USER, LASZIP_ID)), b"")
        broken = damaged(path, 'its "laszip encoded" record is missing or wrong')
        if len(payload) < _LASZIP.size:
            raise broken
        compressor, coder, *_, chunk_points, _, _, n_items = _LASZIP.unpack_from(payload)
        if len(payload) < _LASZIP.size + n_items * _ITEM.size or not n_items:
            raise broken
        payload = payload[: _LASZIP.size + n_items * _ITEM.size]
        items = list(_ITEM.iter_unpack(payload[_LASZIP.size :]))
        kinds = tuple(kind for kind, _, _ in items if kind not in _BYTES)
        good = all(size == _ITEM_SIZES[kind] if kind in _ITEM_SIZES else kind in _BYTES for kind, size, _ in items)
        length = sum(size for _, size, _ in items)
        if not good or kinds != _FORMAT_ITEMS[header.point_format] or length != header.point_length or coder != 0:
            raise broken
        if [kind for kind, _, _ in items if kind in _BYTES] not in ([], [14 if header.point_format > 5 else 0]):
            raise broken
        remedy = "run laszip -i IN.laz -o OUT.las first"
        if compressor != (3 if header.point_format > 5 else 2) or not 0 < chunk_points <= _VARIABLE:
            raise InputError(f"{path}: compressed without chunks; {remedy}")
        if MAX_CHUNK_POINTS < chunk_points < _VARIABLE:
            raise InputError(f"{path}: LAZ chunks of {chunk_points} points do not fit into memory; {remedy}")
        layers = (size if kind in _BYTES else _LAYERS[kind] for kind, size, _ in items) if kinds[0] == 10 else ()
        coding = _Coding(payload, chunk_points, max(version for _, _, version in items), sum(layers))
        total = checked.header.point_count
        if total > checked.size * MAX_POINTS_PER_BYTE:  # a scan of points that cannot be there would never end
            raise damaged(checked.path, f"the header claims {total} points in {checked.size} bytes")
        if coding.newest > NEWEST:
            raise InputError(
                f"{checked.path}: has the compression of LAS 1.5, which wavebatch does not read; "
                "decompress it first: laszip -i IN.laz -o OUT.las"
            )
        return LazPoints(checked, coding)


class _PlainPoints:
    """Reads points that are not compressed; all readers of points have these two methods."""

    def __init__(self, checked: CheckedHeader) -> None:
        self._checked = checked
        self._file = open(checked.path, "rb", buffering=0)  # noqa: SIM115 - closed by close()

    def read(self, start: int, stop: int) -> np.ndarray:
        """Return records [start, stop), a writable structured array."""
        rows = np.empty(stop - start, self._checked.dtype)
        at = self._checked.header.offset_to_points + start * rows.itemsize
        with guarded(self._checked.path, start, stop):
            read_exactly(self._file.fileno(), rows.view(np.uint8).reshape(-1), at)
        return rows

    def close(self) -> None:
        self._file.close()


PointSource = _PlainPoints | LazPoints
"""A reader of points by index."""
