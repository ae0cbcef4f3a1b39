"""Data that does not fit into memory, or that travels between processes: temporary files and their folders.

The strip scan, the second pass, the voxel grid and all that compares clouds use it. Folders are removed when their
process ends, or by the next run if it was killed: a folder is in use as long as it is locked. `Spool` sorts entries
into numbered buckets (`count_buckets`, `spread_keys`); that of `spool_rows` takes rows from one process to another past
the one that writes the cloud. `RowStore` keeps the rows of a cloud for the second pass, `KeyedSums` sums integers by
key. All points of a pulse must come into the same bucket: sort by keys that are equal for equal GPS times.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import os
import platform
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextvars import ContextVar
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.files.disk.publish import LOCK_FLAGS, Draft, list_names, make_locked, remove_unlocked, reporting
from wavebatch.files.disk.raw_bytes import Closing, in_one_line, join_records, read_exactly, take_whole_records

_LOCK = "lock"
_place: ContextVar[Path | None] = ContextVar("wavebatch_scratch", default=None)


def make_folder() -> Path:
    """Return a new folder for temporary files, in the folder of `use_scratch` or in one of this process.

    Raises OSError if there is no room for it.
    """
    return Path(tempfile.mkdtemp(dir=_place.get() or _own_folder()))


@functools.cache
def _own_folder() -> Path:
    """The folder of this process, made when it is first asked for."""
    owned = _Owned(Path(tempfile.gettempdir()), "")
    atexit.register(owned.close)
    return owned.folder


def scratch_place() -> Path:
    """Return the folder in which `make_folder` makes folders, for messages."""
    return _place.get() or Path(tempfile.gettempdir())


def reporting_scratch() -> contextlib.AbstractContextManager[None]:
    """Turn an error of the operating system with a temporary file into one InputError line."""
    remedy = "free space or set TMPDIR to another folder"
    return in_one_line(lambda _, why: f"{scratch_place()}: no temporary file can be used there ({why}); {remedy}")


def use_scratch(folder: Path | None) -> None:
    """Let `make_folder` of this thread work in a folder of another process."""
    _place.set(folder)


@contextlib.contextmanager
def owning_scratch(parent: Path | None = None) -> Iterator[Path | None]:
    """Make a folder in `parent` (default: TMPDIR) for `make_folder` of this thread, and remove it at the end.

    In a folder of the user its name is hidden. Gives None if it cannot be made: whoever needs it reports the error.
    """
    try:
        owned = _Owned(Path(parent or tempfile.gettempdir()), "." if parent else "")
    except OSError:
        yield None
        return
    token = _place.set(owned.folder)
    try:
        yield owned.folder
    finally:
        _place.reset(token)
        owned.close()


def remove_orphans(parent: Path) -> list[Path]:
    """Remove the folders of killed processes from `parent` and return their names.

    Only folders of this user and this machine: a locked folder is in use, and whether a process of another machine is
    alive cannot be known. On systems without file locks nothing is removed.
    """
    found = list_names(parent, (_prefix(), f".{_prefix()}"))
    return remove_unlocked(found, _open_lock, functools.partial(shutil.rmtree, ignore_errors=True))


class _Owned:
    """A new folder with a lock that this process holds until it ends."""

    def __init__(self, parent: Path, hidden: str) -> None:
        remove_orphans(parent)
        self._lock: int | None
        self.folder, self._lock = make_locked(lambda: _make_folder(parent, hidden))

    def close(self) -> None:
        """Remove the folder with its content; may be called twice."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None
        shutil.rmtree(self.folder, ignore_errors=True)


def _make_folder(parent: Path, hidden: str) -> tuple[Path, int]:
    """A new folder and the descriptor of its lock file."""
    while True:
        folder = Path(tempfile.mkdtemp(prefix=f"{hidden}{_prefix()}{os.getpid()}-", dir=parent))
        with contextlib.suppress(FileNotFoundError):  # another process removed it as left over
            return folder, os.open(folder / _LOCK, LOCK_FLAGS | os.O_CREAT, 0o600)


def _open_lock(folder: Path) -> int:
    """The descriptor of a folder's lock file; OSError for links and folders of other users."""
    if folder.is_symlink() or folder.lstat().st_uid != os.getuid():
        raise FileNotFoundError(folder)
    return os.open(folder / _LOCK, LOCK_FLAGS | os.O_CREAT, 0o600)


def _prefix() -> str:
    """Start of the names of this machine's folders."""
    return f"wavebatch-{re.sub('[^A-Za-z0-9.]', '_', platform.node())}-"


SPOOL_MEMORY, SPOOL_KEPT = 1 << 24, 1 << 20
"""Bytes of entries that are in memory at a time, and that a spool takes to other processes."""


class Spool(Closing):
    """Entries of one dtype in buckets 0..n-1: `append` all, then `read`; sealed it can be pickled. A context manager.

    The temporary file holds segments, each sorted by bucket, after a table of where its buckets begin. `close` removes
    the file; copies in other processes only read it. memory: bytes of entries before they are written to disk. kept:
    bytes of entries that travel themselves to other processes; more of them read a file.
    """

    def __init__(self, buckets: int, dtype: np.dtype, *, memory: int = SPOOL_MEMORY, kept: int = SPOOL_KEPT) -> None:
        self.buckets, self._most, self._kept = buckets, memory, kept
        self.dtype = np.dtype(dtype)
        self.path: Path | None = None
        """The temporary file; None while all entries are in memory."""
        self.count = 0
        self._pending: list[tuple[np.ndarray, np.ndarray]] = []
        self._in_memory = 0
        self._segments: list[int] = []
        self._memory: tuple[np.ndarray, np.ndarray] | None = None
        self._sealed = False
        self._joined: list[Spool] = []

    def join(self, other: Spool) -> None:
        """Read, and close, with this one the entries of another sealed spool of as many buckets, before its own."""
        self._joined.append(other)

    def append(self, bucket: np.ndarray, entries: np.ndarray) -> None:
        """Add entries (k,) to buckets (k,)."""
        if not len(entries):
            return
        self._pending.append((bucket.astype(np.int64), entries.astype(self.dtype, casting="same_kind", copy=False)))
        self._in_memory += entries.nbytes + 8 * len(bucket)
        self.count += len(entries)
        if self._in_memory >= self._most:
            self._write(*self._take_pending())

    def seal(self) -> Spool:
        """End the writing, as the first reading does; may be called twice."""
        if self._sealed:
            return self
        self._sealed = True
        if self._segments:
            self._write(*self._take_pending())
        else:
            starts, parts = self._take_pending()
            self._memory = starts, parts[0] if len(parts) == 1 else join_records(np.empty(0, self.dtype), *parts)
        return self

    def __getstate__(self) -> dict[str, Any]:
        """Move many entries to a file; without room for it they travel themselves."""
        if self._memory is not None and self._memory[1].nbytes > self._kept:
            with contextlib.suppress(InputError):
                self._write(self._memory[0], [self._memory[1]])
                self._memory = None
        return self.__dict__

    def read(self, bucket: int) -> np.ndarray:
        """Return the entries of a bucket in the order in which they were added."""
        parts = list(self.pieces(bucket))
        if not parts:
            return np.empty(0, self.dtype)
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def pieces(self, bucket: int) -> Iterator[np.ndarray]:
        """Yield the same entries in parts, one per segment."""
        self.seal()
        for other in self._joined:
            yield from other.pieces(bucket)
        if self._memory is not None:
            starts, entries = self._memory
            if starts[bucket + 1] > starts[bucket]:
                yield entries[starts[bucket] : starts[bucket + 1]]
            return
        if self.path is None:
            return
        with reporting_scratch(), open(self.path, "rb", buffering=0) as file:
            for at in self._segments:
                edges = np.empty(2, np.int64)
                read_exactly(file.fileno(), edges.view(np.uint8), at + 8 * bucket)
                part = np.empty(int(edges[1] - edges[0]), self.dtype)
                begin = at + 8 * (self.buckets + 1) + int(edges[0]) * self.dtype.itemsize
                read_exactly(file.fileno(), part.view(np.uint8).reshape(-1), begin)
                if len(part):
                    yield part

    def close(self) -> None:
        """Remove the temporary file; may be called twice."""
        for other in self._joined:
            other.close()
        if self.path is not None:
            shutil.rmtree(self.path.parent, ignore_errors=True)
        self._pending, self._memory = [], None

    def _take_pending(self) -> tuple[np.ndarray, list[np.ndarray]]:
        """Start of every bucket, i8 (buckets + 1,), and the entries sorted by bucket, in parts."""
        pending, self._pending, self._in_memory = self._pending, [], 0
        parts = [part for _, part in pending]
        if not pending:
            return np.zeros(self.buckets + 1, np.int64), parts
        bucket = np.concatenate([part for part, _ in pending])
        if np.any(bucket[1:] < bucket[:-1]):
            order = np.argsort(bucket, kind="stable")
            bucket, parts = bucket[order], [take_whole_records(join_records(*parts), order)]
        return np.searchsorted(bucket, np.arange(self.buckets + 1)).astype(np.int64), parts

    def _write(self, starts: np.ndarray, parts: list[np.ndarray]) -> None:
        with reporting_scratch():
            if self.path is None:
                self.path = make_folder() / "spool"
            with open(self.path, "ab") as file:
                at = file.tell()
                file.write(starts.data)
                for part in parts:
                    file.write(np.ascontiguousarray(part).view(np.uint8).data)
            # Only what is written as a whole is read.
            self._segments.append(at)


ROWS_KEPT = 1 << 16
"""Bytes of rows that travel themselves: a file costs more."""


def spool_rows(rows: np.ndarray) -> Spool:
    """Return a spool of rows (m,), in one bucket, which takes them past the process that writes.

    They stay in memory until it is pickled. The last to use them calls `close`.
    """
    spool = Spool(1, rows.dtype, memory=1 << 62, kept=ROWS_KEPT)
    spool.append(np.zeros(len(rows), np.int64), rows)
    return spool.seal()


STORE_PIECE = 1 << 16
"""Rows read at a time."""


class RowStore:
    """Rows of `dtype` in one temporary file, which is locked so that no other run removes it as left over.

    target: the output that the rows are for. Raises InputError if its folder cannot be written.
    """

    def __init__(self, target: Path, dtype: np.dtype) -> None:
        self.dtype = dtype
        self.count = 0
        self._draft = Draft(target, overwrite=True)

    def add(self, rows: np.ndarray) -> None:
        """Append rows (m,) of `dtype`."""
        with reporting(self._draft.target):
            self._draft.file.write(np.ascontiguousarray(rows).view(np.uint8).data if len(rows) else b"")
            self._draft.file.flush()  # else a worker forked now would inherit the buffer and write it again
        self.count += len(rows)

    def extend(self, count: int) -> None:
        """Set the length to `count` rows; new rows are zeros."""
        with reporting(self._draft.target):
            self._draft.file.truncate(count * self.dtype.itemsize)
        self.count = count

    def put(self, index: np.ndarray, rows: np.ndarray) -> None:
        """Write rows (m,) at the ascending places `index` (m,)."""
        if not len(rows):
            return
        size = self.dtype.itemsize
        content = np.ascontiguousarray(rows).view(np.uint8).data
        starts = np.flatnonzero(np.concatenate([[True], np.diff(index) != 1]))
        ends = np.append(starts[1:], len(index))
        with reporting(self._draft.target):
            for place, start, end in zip(index[starts].tolist(), starts.tolist(), ends.tolist(), strict=True):
                self._draft.file.seek(place * size)
                self._draft.file.write(content[start * size : end * size])

    def read(self, start: int, stop: int) -> np.ndarray:
        """Return rows [start, stop)."""
        rows = np.empty(stop - start, self.dtype)
        with reporting(self._draft.target):
            self._draft.file.seek(start * self.dtype.itemsize)
            if self._draft.file.readinto(rows.view(np.uint8).data) != rows.nbytes:
                raise InputError(f"{self._draft.target}: its temporary file was cut by another program; run again")
        return rows

    def pieces(self, size: int = STORE_PIECE) -> Iterator[np.ndarray]:
        """Yield all rows, at most `size` at a time; the arrays are writable."""
        for start in range(0, self.count, size):
            yield self.read(start, min(start + size, self.count))

    def close(self) -> None:
        """Remove the file; may be called twice."""
        self._draft.discard()


ROWS_IN_MEMORY = 1 << 18
"""Rows in memory before they are written to disk."""


class KeyedSums(Closing):
    """Sums of `columns` integers per key: `add` any number of times, then `pieces`, then `close`. A context manager.

    borders: ascending keys, u8; all sums from one to the next are in memory at a time. in_memory: most rows there until
    some go to a temporary file.
    """

    def __init__(self, columns: int, borders: np.ndarray, *, in_memory: int = ROWS_IN_MEMORY) -> None:
        dtype = np.dtype([("key", "<u8"), ("value", "<i8", (columns,))])
        self._borders, self._rows = borders, Spool(len(borders) + 1, dtype, memory=in_memory * dtype.itemsize)
        self._most = in_memory

    def close(self) -> None:
        """Remove the temporary file."""
        self._rows.close()

    def add(self, key: np.ndarray, value: np.ndarray) -> None:
        """Add rows: key u8 (m,), value i8 (m, columns)."""
        if len(key):
            key, value = _sum(key, value)
            rows = np.empty(len(key), self._rows.dtype)
            rows["key"], rows["value"] = key, value
            self._rows.append(np.searchsorted(self._borders, key, side="right"), rows)

    def pieces(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield keys, ascending and each once, with their sums, those between two borders at a time."""
        for bucket in range(self._rows.buckets):
            parts: list[tuple[np.ndarray, ...]] = []
            number, most = 0, self._most
            # Batches of a strip that is not in the order of its pulses bring rows of all voxels, each of them again.
            for rows in self._rows.pieces(bucket):
                parts.append((rows["key"], rows["value"]))
                number += len(rows)
                if number > most:
                    parts = [_sum(*map(np.concatenate, zip(*parts, strict=True)))]
                    number = len(parts[0][0])
                    most = max(self._most, 2 * number)
            if parts:
                yield _sum(*map(np.concatenate, zip(*parts, strict=True)))


def _sum(key: np.ndarray, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Keys (m,), m > 0, ascending and each once, with the sums of their rows."""
    order = np.argsort(key, kind="stable")
    key = key[order]
    first = np.flatnonzero(np.append(True, key[1:] != key[:-1]))
    return key[first], np.add.reduceat(np.take(value, order, axis=0), first, axis=0)


BUCKET_ROWS = 400_000
"""Rows in memory at a time, unless MOST_BUCKETS are too few."""

MOST_BUCKETS = 72
"""With BUCKET_ROWS these hold 29 million rows; more rows make larger buckets, so that reads from disk stay long."""

_MIX = np.uint64(0x9E3779B97F4A7C15)
"""2^64 divided by the golden ratio: multiplicative hashing (Knuth, The Art of Computer Programming 3, 6.4)."""


def count_buckets(rows: int, in_memory: int = BUCKET_ROWS) -> int:
    """Return how many buckets of at most `in_memory` rows are needed, at most MOST_BUCKETS."""
    return min(-(-max(rows, 1) // in_memory), MOST_BUCKETS)


def time_keys(gps_time: np.ndarray) -> np.ndarray:
    """Return keys u8 (n,) that are equal if GPS times f8 (n,) are; +0 and -0 get the same key."""
    return (gps_time + 0.0).view(np.uint64)


def spread_keys(keys: np.ndarray, number: int) -> np.ndarray:
    """Return the bucket i8 (n,) of each key u8 (n,): equal keys in the same bucket, others spread evenly."""
    mixed = (keys ^ (keys >> np.uint64(29))) * _MIX
    return ((mixed >> np.uint64(33)) % np.uint64(number)).astype(np.int64)
