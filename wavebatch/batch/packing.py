"""Rows of units become the LAZ chunks of a cloud: cut after every 50,000 rows, wherever the units end.

`strip_task` gives it the rows in order. Workers compress each chunk as soon as its rows are there (`pack_chunk`), so
rows never reach the process that writes: it joins finished chunks, which are the same however many workers there are.
"""

from __future__ import annotations

from collections import deque
from pathlib import Path

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.core.process import Seconds
from wavebatch.files.disk.temp_store import RowParcel
from wavebatch.files.las.write_points import CHUNK_POINTS, Chunk, compress_rows

Part = tuple[RowParcel, int, int]
"""Rows [start, stop) of a unit."""


class Packing:
    """The rows of one strip that are not written yet: `add` those of all units in order, `take` a chunk when it may."""

    def __init__(self) -> None:
        self._parts: deque[Part] = deque()
        self._count = 0
        """Rows that are in no chunk yet."""
        self._open: deque[list[RowParcel]] = deque()
        """Of every chunk under way, the units that end in it."""

    def add(self, rows: RowParcel) -> None:
        """Take the rows of the next unit."""
        self._parts.append((rows, 0, len(rows)))
        self._count += len(rows)

    def has_chunk(self, last: bool) -> bool:
        """Whether there are rows for a chunk; last: no further units come."""
        return self._count >= (1 if last else CHUNK_POINTS)

    @property
    def is_empty(self) -> bool:
        """Whether all rows are written."""
        return not self._count + len(self._open)

    def next_chunk(self) -> list[Part]:
        """Return the rows of the next chunk, for `pack_chunk`."""
        parts, ended, left = [], [], min(self._count, CHUNK_POINTS)
        self._count -= left
        while left:
            rows, start, stop = self._parts.popleft()
            end = min(stop, start + left)
            parts.append((rows, start, end))
            left -= end - start
            if end < stop:
                self._parts.appendleft((rows, end, stop))
            else:
                ended.append(rows)
        self._open.append(ended)
        return parts

    def end_chunk(self) -> None:
        """The oldest chunk under way is written: remove the files of its rows."""
        for rows in self._open.popleft():
            rows.close()

    def close(self) -> None:
        """Remove all files; harmless twice."""
        for rows in [*(rows for ended in self._open for rows in ended), *(rows for rows, _, _ in self._parts)]:
            rows.close()


def pack_chunk(path: Path, parts: list[Part], point_format: int) -> tuple[Chunk, Seconds]:
    """Compress the rows of one LAZ chunk.

    Parameters
    ----------
    path : Path
        Of the strip, for messages.
    parts : list of Part
    point_format : int
        Of the cloud.

    Returns
    -------
    chunk : Chunk
    took : Seconds

    Raises
    ------
    InputError
        Where they cannot be compressed.
    """
    start = Seconds.now()
    rows = np.concatenate([rows.read(first, stop) for rows, first, stop in parts])
    (chunk,) = pack_rows(path, rows, point_format)
    return chunk, Seconds.now() - start


def pack_rows(path: Path, rows: np.ndarray, point_format: int) -> list[Chunk]:
    """Compress rows that begin where a chunk does; arguments and errors as for `pack_chunk`."""
    parts = (rows[first : first + CHUNK_POINTS] for first in range(0, len(rows), CHUNK_POINTS))
    try:
        return [compress_rows(part, point_format) for part in parts]
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
