"""Point records of LAS and LAZ files by their index: each read costs what it returns, never the whole file."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from wavebatch.files.disk.raw_bytes import guarded, read_exactly
from wavebatch.files.las.checked_header import CheckedHeader
from wavebatch.files.las.laz_decode import open_laz


class PointSource(Protocol):
    """Reads points by index."""

    def read(self, start: int, stop: int) -> np.ndarray:
        """Records [start, stop), a writable structured array."""
        ...

    def close(self) -> None: ...


def open_points(checked: CheckedHeader) -> PointSource:
    """A reader of the strip's points: plain, lazrs, or the laszip backend where lazrs does not know the coding.

    Raises InputError where the compression's own records are damaged or nobody here can decode them.
    """
    return open_laz(checked) if checked.header.compressed else _PlainPoints(checked)


class _PlainPoints:
    def __init__(self, checked: CheckedHeader) -> None:
        self._checked = checked
        self._file = open(checked.path, "rb", buffering=0)  # noqa: SIM115 - closed by close()

    def read(self, start: int, stop: int) -> np.ndarray:
        rows = np.empty(stop - start, self._checked.dtype)
        at = self._checked.header.offset_to_points + start * rows.itemsize
        with guarded(self._checked.path, start, stop):
            read_exactly(self._file.fileno(), rows.view(np.uint8).reshape(-1), at)
        return rows

    def close(self) -> None:
        self._file.close()
