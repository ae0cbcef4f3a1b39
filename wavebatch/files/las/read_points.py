"""Point records of LAS and LAZ files, read by index; a read never loads the whole file.

The strip reader and the cloud readers open their points here. Add a new kind of compression in `laz_decode.py`.
"""

from __future__ import annotations

import numpy as np

from wavebatch.files.disk.raw_bytes import guarded, read_exactly, reading
from wavebatch.files.las.checked_header import CheckedHeader
from wavebatch.files.las.laz_decode import LazPoints, open_laz


def open_points(checked: CheckedHeader) -> PointSource:
    """Return a reader of the points of a checked file: plain LAS, or LAZ.

    Raises InputError if the records of the compression are damaged, or are those of LAS 1.5.
    """
    with reading(checked.path):
        return open_laz(checked) if checked.header.compressed else _PlainPoints(checked)


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
