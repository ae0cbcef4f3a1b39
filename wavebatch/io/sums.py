"""Sums of integers by key: in memory while they are few, sorted and spilled to disk beyond that, merged at the end.

Integers add up to the same whatever their order: the result does not depend on how often anything was spilled.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from typing import IO

import numpy as np

from wavebatch.errors import InputError

HELD = 1 << 20
"""Rows that are held in memory before they are sorted and spilled."""


class KeyedSums:
    """Sums rows of `columns` integers per key; `add` any number of times, then `pieces`, then `close`.

    held: rows in memory; more of them lie in temporary files. A context manager.
    """

    def __init__(self, columns: int, *, held: int = HELD) -> None:
        self._columns = columns
        self._held = held
        self._dtype = np.dtype([("key", "<u8"), ("value", "<i8", (columns,))])
        self._parts: list[np.ndarray] = []
        self._number = 0
        self._file: IO[bytes] | None = None
        self._runs: list[tuple[int, int]] = []
        """First row and number of rows of every sorted run in the file."""

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
        rows = self._sum(_rows(self._dtype, key, value))
        self._parts.append(rows)
        self._number += len(rows)
        if self._number > self._held:
            self._shrink()
            if self._number > self._held // 2:
                self._spill()

    def pieces(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Keys, ascending and each once, and their sums, some at a time."""
        if not self._runs:
            self._shrink()
            for part in self._parts:
                for begin in range(0, len(part), self._held):
                    rows = part[begin : begin + self._held]
                    yield rows["key"], rows["value"]
            return
        self._spill()
        yield from self._merge()

    def _merge(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        piece = max(self._held // len(self._runs), 256)
        places = list(self._runs)
        heads: list[np.ndarray] = [np.empty(0, self._dtype) for _ in places]
        while True:
            for number, (first, left) in enumerate(places):
                if left and not len(heads[number]):
                    taken = min(left, piece)
                    heads[number] = self._read(first, taken)
                    places[number] = (first + taken, left - taken)
            # Up to the least of the last keys at hand of runs that go on, nothing more can come.
            more = [head["key"][-1] for head, (_, left) in zip(heads, places, strict=True) if left]
            border = min(more, default=None)
            taken_rows = []
            for number, head in enumerate(heads):
                cut = len(head) if border is None else int(np.searchsorted(head["key"], border, side="right"))
                taken_rows.append(head[:cut])
                heads[number] = head[cut:]
            rows = self._sum(np.concatenate(taken_rows))
            if len(rows):
                yield rows["key"], rows["value"]
            if border is None:
                return

    def _shrink(self) -> None:
        """All rows that are held, summed."""
        if len(self._parts) > 1:
            self._parts = [self._sum(np.concatenate(self._parts))]
        self._number = sum(len(part) for part in self._parts)

    def _spill(self) -> None:
        self._shrink()
        with _reported():
            if self._file is None:
                self._file = tempfile.TemporaryFile()  # noqa: SIM115 - closed by close()
            for rows in self._parts:
                first = self._file.seek(0, 2) // self._dtype.itemsize
                self._file.write(rows.tobytes())
                self._runs.append((first, len(rows)))
        self._parts, self._number = [], 0

    def _read(self, first: int, number: int) -> np.ndarray:
        with _reported():
            self._file.seek(first * self._dtype.itemsize)
            data = self._file.read(number * self._dtype.itemsize)
        if len(data) != number * self._dtype.itemsize:
            raise InputError(f"{tempfile.gettempdir()}: a temporary file of sums ends too early; run again")
        return np.frombuffer(data, self._dtype)

    def _sum(self, rows: np.ndarray) -> np.ndarray:
        """Rows sorted by key, those of one key added up."""
        if not len(rows):
            return rows
        order = np.argsort(rows["key"], kind="stable")
        key = rows["key"][order]
        first = np.flatnonzero(np.append(True, key[1:] != key[:-1]))
        return _rows(self._dtype, key[first], np.add.reduceat(rows["value"][order], first, axis=0))


def _rows(dtype: np.dtype, key: np.ndarray, value: np.ndarray) -> np.ndarray:
    rows = np.empty(len(key), dtype)
    rows["key"], rows["value"] = key, value
    return rows


@contextlib.contextmanager
def _reported() -> Iterator[None]:
    try:
        yield
    except OSError as error:
        folder = tempfile.gettempdir()
        raise InputError(
            f"{folder}: the temporary file of sums cannot be used ({error.strerror or error}); free space there or set "
            "TMPDIR to another folder"
        ) from error
