"""Rows of a cloud that wait for the second pass, in a temporary file next to the cloud.

`batch/neighbour_pass.py` uses it. The file lies next to the output because that disk has room for the cloud; the
folder for temporary files may be small.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.files.disk.publish import Draft, reporting

PIECE = 1 << 16
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

    def pieces(self, size: int = PIECE) -> Iterator[np.ndarray]:
        """Yield all rows, at most `size` at a time; the arrays are writable."""
        for start in range(0, self.count, size):
            yield self.read(start, min(start + size, self.count))

    def close(self) -> None:
        """Remove the file; may be called twice."""
        self._draft.discard()
