"""Entries sorted into numbered buckets: few of them stay in memory, many go to a temporary file.

The strip scan, the second pass and all that compares clouds use it; `buckets.py` has the usual buckets. A sealed spool
is pickled and read by other processes; only the process that made it removes the file.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from wavebatch.files.disk.closing import Closing
from wavebatch.files.disk.raw_bytes import read_exactly, take_whole_records
from wavebatch.files.disk.temp_folders import make_folder, reporting_scratch

MEMORY = 1 << 24
"""Bytes of entries in memory before they are written to disk."""
KEPT = 1 << 20
"""Bytes of entries that a sealed spool keeps in memory: it is pickled for other processes."""


class Spool(Closing):
    """Entries of one dtype in buckets 0..n-1: `append` all, then `read`; sealed it can be pickled. A context manager.

    The temporary file holds segments, each sorted by bucket, after a table of where its buckets begin. `close` removes
    the file; copies in other processes only read it.
    """

    def __init__(self, buckets: int, dtype: np.dtype) -> None:
        self.buckets = buckets
        self.dtype = np.dtype(dtype)
        self.path: Path | None = None
        """The temporary file; None while all entries are in memory."""
        self.count = 0
        self._pending: list[tuple[np.ndarray, np.ndarray]] = []
        self._held = 0
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
        self._pending.append((bucket.astype(np.int64), entries))
        self._held += entries.nbytes + 8 * len(bucket)
        self.count += len(entries)
        if self._held >= MEMORY:
            self._flush()

    def seal(self) -> Spool:
        """End the writing, as the first reading does; may be called twice."""
        if self._sealed:
            return self
        self._sealed = True
        if self._segments or self._held > KEPT:
            self._flush()
        else:
            self._memory = self._take_pending()
        return self

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

    def _take_pending(self) -> tuple[np.ndarray, np.ndarray]:
        """Start of every bucket, i8 (buckets + 1,), and the entries sorted by bucket."""
        pending, self._pending, self._held = self._pending, [], 0
        if not pending:
            return np.zeros(self.buckets + 1, np.int64), np.empty(0, self.dtype)
        bucket = np.concatenate([part for part, _ in pending])
        entries = np.concatenate([part for _, part in pending])
        if np.any(bucket[1:] < bucket[:-1]):
            order = np.argsort(bucket, kind="stable")
            bucket, entries = bucket[order], take_whole_records(entries, order)
        return np.searchsorted(bucket, np.arange(self.buckets + 1)).astype(np.int64), entries

    def _flush(self) -> None:
        starts, entries = self._take_pending()
        with reporting_scratch():
            if self.path is None:
                self.path = make_folder() / "spool"
            with open(self.path, "ab") as file:
                self._segments.append(file.tell())
                file.write(starts.data)
                file.write(entries.view(np.uint8).data)
