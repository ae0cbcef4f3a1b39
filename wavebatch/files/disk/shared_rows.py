"""Rows that one process hands to another through memory, not through a pipe.

`batch/row_transfer.py` uses it: a worker writes the rows of a unit into a file of the folder that
`temp_folders.owning_memory` gives, and whoever needs them reads them there.
Before you change it: read and write, never map. A full file system in memory is an error of `write` here, but kills the
process that touches a mapped page.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.files.disk.raw_bytes import read_exactly

LEAST = 1 << 16
"""Fewer bytes than this travel faster through a pipe: making, opening and removing a file takes 50 us."""


@dataclass(frozen=True, slots=True)
class SharedRows:
    """Rows [start, stop) of a file in memory; picklable."""

    path: Path
    dtype: np.dtype
    start: int
    stop: int

    def __len__(self) -> int:
        return self.stop - self.start

    @property
    def nbytes(self) -> int:
        """Bytes of the rows."""
        return len(self) * self.dtype.itemsize

    def __getitem__(self, part: slice) -> SharedRows:
        start, stop, _ = part.indices(len(self))
        return SharedRows(self.path, self.dtype, self.start + start, self.start + stop)

    def read_into(self, target: np.ndarray) -> None:
        """Fill `target` (n,) of the same dtype; raises InputError if the file is gone."""
        try:
            with open(self.path, "rb", buffering=0) as file:
                read_exactly(file.fileno(), target.view(np.uint8).reshape(-1), self.start * self.dtype.itemsize)
        except OSError as error:
            where = f"{self.path.parent}: rows that another process has left there cannot be read"
            raise InputError(f"{where} ({error.strerror or error}); run again, with --jobs 1 if it stays") from error

    def discard(self) -> None:
        """Remove the file; may be called twice."""
        with contextlib.suppress(OSError):
            os.unlink(self.path)


Rows = np.ndarray | SharedRows


def share_rows(rows: np.ndarray, folder: Path | None) -> Rows:
    """Return the rows as a new file in the folder; unchanged where there is no folder, no room, or few of them."""
    if folder is None or rows.nbytes < LEAST:
        return rows
    path = None
    try:
        descriptor, path = tempfile.mkstemp(dir=folder)
        with os.fdopen(descriptor, "wb", buffering=0) as file:
            left = memoryview(np.ascontiguousarray(rows).view(np.uint8).reshape(-1))
            while left:
                left = left[file.write(left) :]
    except OSError:
        if path is not None:
            with contextlib.suppress(OSError):
                os.unlink(path)
        return rows
    return SharedRows(Path(path), rows.dtype, 0, len(rows))


def read_rows(rows: Rows) -> np.ndarray:
    """Return the rows as an array."""
    return join_rows([rows]) if isinstance(rows, SharedRows) else rows


def join_rows(parts: list[Rows]) -> np.ndarray:
    """Return parts of one dtype, at least one, as one new array."""
    joined = np.empty(sum(map(len, parts)), parts[0].dtype)
    plain, at = joined.view(f"V{joined.dtype.itemsize}"), 0
    for part in parts:
        target = joined[at : at + len(part)]
        if isinstance(part, SharedRows):
            part.read_into(target)
        else:  # as plain bytes: NumPy copies records field by field
            plain[at : at + len(part)] = np.ascontiguousarray(part).view(plain.dtype)
        at += len(part)
    return joined


def discard_rows(rows: Rows) -> None:
    """Remove the file of the rows, if they are in one."""
    if isinstance(rows, SharedRows):
        rows.discard()
