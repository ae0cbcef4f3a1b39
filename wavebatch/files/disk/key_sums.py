"""Sums of integers by key in bounded memory: sorted runs go to a temporary file and are merged at the end.

The voxel grid sums with it. Only integers: their sum does not depend on the order, so the result is the same however
often rows went to disk.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from typing import IO, NamedTuple

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.files.disk.closing import Closing
from wavebatch.files.disk.temp_folders import reporting_scratch, scratch_place

HELD = 1 << 18
"""Rows in memory before they are sorted and written to disk."""

STRIDE = 256
"""One key of so many rows on disk stays in memory, to find ranges of keys without reading."""


class KeyedSums(Closing):
    """Sums of `columns` integers per key: `add` any number of times, then `pieces`, then `close`.

    held: rows in memory; more rows go to a temporary file. stride: rows between two keys that mark places in it.
    A context manager.
    """

    def __init__(self, columns: int, *, held: int = HELD, stride: int = STRIDE) -> None:
        self._held, self._stride = held, stride
        self._dtype = np.dtype([("key", "<u8"), ("value", "<i8", (columns,))])
        self._parts: list[tuple[np.ndarray, np.ndarray]] = []
        self._number = 0
        self._file: IO[bytes] | None = None
        self._runs: list[_Run] = []

    def close(self) -> None:
        """Remove the temporary file."""
        self._parts = []
        if self._file is not None:
            self._file.close()

    def add(self, key: np.ndarray, value: np.ndarray) -> None:
        """Add rows: key u8 (m,), value i8 (m, columns)."""
        if not len(key):
            return
        self._parts.append(_sum([(key, value)]))
        self._number += len(self._parts[-1][0])
        if self._number > self._held:
            self._shrink()
            if self._number > self._held // 2:
                self._spill()

    def pieces(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield keys, ascending and each once, with their sums, some at a time."""
        if not self._runs:
            self._shrink()
            yield from self._parts
            return
        self._spill()
        for low, high in self._cut_ranges():
            yield _sum([self._read_range(run, low, high) for run in self._runs if run.touches(low, high)])

    def _cut_ranges(self) -> Iterator[tuple[int, int]]:
        """Ascending ranges of keys with about `held` rows each; none is empty."""
        marks = np.sort(np.concatenate([run.marks for run in self._runs]))
        borders = np.unique(marks[:: max(self._held // self._stride, 1)]).tolist()
        yield from zip(borders, [*borders[1:], 1 << 64], strict=True)

    def _shrink(self) -> None:
        """Sums up the rows in memory."""
        if len(self._parts) > 1:
            self._parts = [_sum(self._parts)]
        self._number = sum(len(key) for key, _ in self._parts)

    def _spill(self) -> None:
        self._shrink()
        with reporting_scratch():
            if self._file is None:
                self._file = tempfile.TemporaryFile(dir=scratch_place())  # noqa: SIM115 - closed by close()
            for key, value in self._parts:
                rows = np.empty(len(key), self._dtype)
                rows["key"], rows["value"] = key, value
                first = self._file.seek(0, 2) // self._dtype.itemsize
                self._file.write(rows.data)
                self._runs.append(_Run(first, len(key), key[::self._stride].copy(), int(key[-1])))
        self._parts, self._number = [], 0

    def _read_range(self, run: _Run, low: int, high: int) -> tuple[np.ndarray, np.ndarray]:
        """Keys and values of the rows of a run with keys in [low, high)."""
        begin = max(int(np.searchsorted(run.marks, np.uint64(low), side="right")) - 1, 0) * self._stride
        end = run.number
        if high <= run.last:
            end = min(int(np.searchsorted(run.marks, np.uint64(high))) * self._stride, end)
        size = self._dtype.itemsize
        if self._file is None:
            raise ValueError("the sums are closed")
        with reporting_scratch():
            self._file.seek((run.first + begin) * size)
            data = self._file.read((end - begin) * size)
        if len(data) != (end - begin) * size:
            raise InputError(f"{scratch_place()}: a temporary file was cut by another program; run again")
        rows = np.frombuffer(data, self._dtype)
        last = len(rows) if high > run.last else int(np.searchsorted(rows["key"], np.uint64(high)))
        rows = rows[int(np.searchsorted(rows["key"], np.uint64(low))) : last]
        return rows["key"], rows["value"]


class _Run(NamedTuple):
    """Rows in the file that are sorted by key."""

    first: int
    number: int
    marks: np.ndarray
    """Keys of its rows 0, STRIDE, 2 STRIDE ..., u8."""
    last: int
    """The largest key."""

    def touches(self, low: int, high: int) -> bool:
        """Whether keys of the run may lie in [low, high)."""
        return int(self.marks[0]) < high and self.last >= low


def _sum(parts: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Keys of all parts, ascending and each once, with the sums of their rows; there must be at least one row."""
    key, value = parts[0] if len(parts) == 1 else (np.concatenate(one) for one in zip(*parts, strict=True))
    order = np.argsort(key, kind="stable")
    key = key[order]
    first = np.flatnonzero(np.append(True, key[1:] != key[:-1]))
    return key[first], np.add.reduceat(np.take(value, order, axis=0), first, axis=0)
