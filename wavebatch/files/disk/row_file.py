"""Rows of a cloud on their way, or what is found out about them, in a temporary file beside the cloud."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.files.disk.publish import Draft, reporting

PIECE = 1 << 16
"""Rows that are read at a time."""


class RowStore:
    """Rows of `dtype` in one temporary file, read again in their order; nobody else's `remove_stale` takes it.

    target: the file that they are for, beside which they lie. Raises InputError where the folder cannot be written.
    """

    def __init__(self, target: Path, dtype: np.dtype) -> None:
        self.dtype = dtype
        self.count = 0
        self._draft = Draft(target, overwrite=True)

    def __len__(self) -> int:
        return self.count

    def add(self, rows: np.ndarray) -> None:
        """Appends rows (m,) of `dtype`."""
        with reporting(self._draft.target):
            self._draft.file.write(np.ascontiguousarray(rows).view(np.uint8).data if len(rows) else b"")
            self._draft.file.flush()  # a worker forked now must not inherit bytes that it would write once more
        self.count += len(rows)

    def extend(self, count: int) -> None:
        """Makes it `count` rows long; new ones are zeros."""
        with reporting(self._draft.target):
            self._draft.file.truncate(count * self.dtype.itemsize)
        self.count = count

    def put(self, index: np.ndarray, rows: np.ndarray) -> None:
        """Puts rows (m,) at places `index` (m,), ascending; the others stay."""
        if not len(rows):
            return
        size = self.dtype.itemsize
        content = memoryview(np.ascontiguousarray(rows).view(np.uint8))
        starts = np.flatnonzero(np.concatenate([[True], np.diff(index) != 1]))
        ends = np.append(starts[1:], len(index))
        with reporting(self._draft.target):
            for place, start, end in zip(index[starts].tolist(), starts.tolist(), ends.tolist(), strict=True):
                self._draft.file.seek(place * size)
                self._draft.file.write(content[start * size : end * size])

    def pieces(self, size: int = PIECE) -> Iterator[np.ndarray]:
        """All rows, at most `size` at a time; they may be changed."""
        with reporting(self._draft.target):
            for start in range(0, self.count, size):
                rows = np.empty(min(size, self.count - start), self.dtype)
                self._draft.file.seek(start * self.dtype.itemsize)
                if self._draft.file.readinto(rows.view(np.uint8)) != rows.nbytes:
                    raise InputError(f"{self._draft.target}: its temporary file was cut by somebody else; run it again")
                yield rows

    def close(self) -> None:
        """Removes the file; harmless twice."""
        self._draft.discard()
