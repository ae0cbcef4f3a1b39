"""Rows on their way between processes: pickled, many of them go to a temporary file, and only its place travels.

Workers give the rows of a unit to those that compress them, past the process that writes the cloud.
"""

from __future__ import annotations

import contextlib
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.files.disk.closing import Closing
from wavebatch.files.disk.raw_bytes import read_exactly
from wavebatch.files.disk.temp_folders import make_folder, reporting_scratch

KEPT = 1 << 16
"""Bytes that travel themselves: a file costs more."""


class RowParcel(Closing):
    """Rows (m,), in memory or in a file; the last to use them calls `close`."""

    def __init__(self, rows: np.ndarray) -> None:
        self.count, self._dtype = len(rows), rows.dtype
        self._rows: np.ndarray | Path = np.ascontiguousarray(rows)
        """Or the file that has them."""

    def __len__(self) -> int:
        return self.count

    def __getstate__(self) -> dict[str, Any]:
        """Move the rows to a file; without room for it they travel themselves."""
        if isinstance(self._rows, np.ndarray) and self._rows.nbytes > KEPT:
            with contextlib.suppress(OSError):
                path = make_folder() / "rows"
                self._rows.tofile(path)
                self._rows = path
        return self.__dict__

    def read(self, start: int, stop: int) -> np.ndarray:
        """Return rows [start, stop)."""
        if isinstance(self._rows, np.ndarray):
            return self._rows[start:stop]
        rows = np.empty(stop - start, self._dtype)
        with reporting_scratch(), open(self._rows, "rb", buffering=0) as file:
            read_exactly(file.fileno(), rows.view(np.uint8), start * rows.itemsize)
        return rows

    def close(self) -> None:
        """Remove the file; may be called twice."""
        if isinstance(self._rows, Path):
            shutil.rmtree(self._rows.parent, ignore_errors=True)
