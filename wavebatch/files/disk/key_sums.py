"""Sums of integers by key: in memory while they are few, sorted and spilled to disk beyond that, merged at the end.

Integers add up to the same whatever their order: the result does not depend on how often anything was spilled.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from typing import IO, NamedTuple

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.files.disk.temp_folders import reporting_scratch, scratch_place

HELD = 1 << 18
"""Rows that are held in memory before they are sorted and spilled."""

STRIDE = 256
"""Every so many rows of what was spilled, a key stays in memory."""


class KeyedSums:
    """Sums rows of `columns` integers per key; `add` any number of times, then `pieces`, then `close`.

    held: rows in memory; more of them lie in temporary files. A context manager.
    """

    def __init__(self, columns: int, *, held: int = HELD) -> None:
        self._columns = columns
        self._held = held
        self._dtype = np.dtype([("key", "<u8"), ("value", "<i8", (columns,))])
        self._parts: list[tuple[np.ndarray, np.ndarray]] = []
        self._number = 0
        self._file: IO[bytes] | None = None
        self._runs: list[_Run] = []

    def __enter__(self) -> KeyedSums:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Removes the temporary file."""
        self._parts = []
        if self._file is not None:
            self._file.close()

    @property
    def spilled(self) -> int:
        """Runs on disk."""
        return len(self._runs)

    def add(self, key: np.ndarray, value: np.ndarray) -> None:
        """Adds rows: key u8 (m,), value i8 (m, columns)."""
        if not len(key):
            return
        self._parts.append(_sum([(key, value)]))
        self._number += len(self._parts[-1][0])
        if self._number > self._held:
            self._shrink()
            if self._number > self._held // 2:
                self._spill()

    def pieces(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Keys, ascending and each once, and their sums, some at a time."""
        if not self._runs:
            self._shrink()
            yield from self._parts
            return
        self._spill()
        for low, high in self._cut_ranges():
            yield _sum([self._read_range(run, low, high) for run in self._runs if run.touches(low, high)])

    def _cut_ranges(self) -> Iterator[tuple[int, int]]:
        """Ranges of keys, ascending and none without rows, that hold about as many rows each as are held."""
        marks = np.sort(np.concatenate([run.marks for run in self._runs]))
        borders = np.unique(marks[:: max(self._held // STRIDE, 1)]).tolist()
        yield from zip(borders, [*borders[1:], 1 << 64], strict=True)

    def _shrink(self) -> None:
        """All rows that are held, summed."""
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
                self._runs.append(_Run(first, len(key), key[::STRIDE].copy(), int(key[-1])))
        self._parts, self._number = [], 0

    def _read_range(self, run: _Run, low: int, high: int) -> tuple[np.ndarray, np.ndarray]:
        """Keys and values of the rows of a run whose keys lie in [low, high)."""
        begin = max(int(np.searchsorted(run.marks, np.uint64(low), side="right")) - 1, 0) * STRIDE
        end = run.number
        if high <= run.last:
            end = min(int(np.searchsorted(run.marks, np.uint64(high))) * STRIDE, end)
        size = self._dtype.itemsize
        with reporting_scratch():
            self._file.seek((run.first + begin) * size)
            data = self._file.read((end - begin) * size)
        if len(data) != (end - begin) * size:
            raise InputError(f"{scratch_place()}: a temporary file of sums ends too early; run again")
        rows = np.frombuffer(data, self._dtype)
        last = len(rows) if high > run.last else int(np.searchsorted(rows["key"], np.uint64(high)))
        rows = rows[int(np.searchsorted(rows["key"], np.uint64(low))) : last]
        return rows["key"], rows["value"]


class _Run(NamedTuple):
    """Rows in the file, sorted by key."""

    first: int
    number: int
    marks: np.ndarray
    """Keys of its rows 0, STRIDE, 2 STRIDE ..., u8."""
    last: int
    """Its largest key."""

    def touches(self, low: int, high: int) -> bool:
        """Whether any of its keys may lie in [low, high)."""
        return int(self.marks[0]) < high and self.last >= low


def _sum(parts: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Keys of all parts, ascending and each once, and the sums of their rows; there must be some."""
    key, value = parts[0] if len(parts) == 1 else (np.concatenate(one) for one in zip(*parts, strict=True))
    order = np.argsort(key, kind="stable")
    key = key[order]
    first = np.flatnonzero(np.append(True, key[1:] != key[:-1]))
    return key[first], np.add.reduceat(np.take(value, order, axis=0), first, axis=0)
