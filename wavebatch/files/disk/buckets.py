"""Records sorted into buckets on disk, so that what belongs together is compared in bounded memory."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable
from typing import IO

import numpy as np

from wavebatch.files.disk.temp_folders import reporting_scratch, scratch_place

BUCKET_ROWS = 400_000
"""Rows that are held at a time, as long as MOST_BUCKETS are enough."""

MOST_BUCKETS = 72
"""Every bucket is an open file, of each side where two are compared: systems allow 256 at least."""

MOST_RETURNS = 16
"""Points per GPS time, on average, beyond which it is no pulse's."""

_MIX = np.uint64(0x9E3779B97F4A7C15)

Sorter = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Rows to (row numbers, bucket numbers): a row may go to several buckets, or to none."""


class Buckets:
    """Rows of one dtype in `number` buckets; temporary files hold them when there is more than one. A context manager.

    Raises InputError where there is no room for the files.
    """

    def __init__(self, dtype: np.dtype, number: int) -> None:
        self._dtype = dtype
        self._kept: list[np.ndarray] = []
        self._files: list[IO[bytes]] = []
        try:
            with reporting_scratch():
                for _ in range(number if number > 1 else 0):
                    self._files.append(tempfile.TemporaryFile(dir=scratch_place()))  # noqa: SIM115
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Buckets:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def add(self, rows: np.ndarray, sorter: Sorter) -> None:
        """Puts rows into the buckets that `sorter` says."""
        if not self._files:
            self._kept.append(rows)
            return
        index, bucket = sorter(rows)
        order = np.argsort(bucket, kind="stable")
        edges = np.searchsorted(bucket[order], np.arange(len(self._files) + 1))
        with reporting_scratch():
            for number, file in enumerate(self._files):
                part = index[order[edges[number] : edges[number + 1]]]
                if len(part):
                    file.write(rows[part].tobytes())

    def read(self, number: int) -> np.ndarray:
        """Rows of one bucket in the order they came."""
        if not self._files:
            return np.concatenate(self._kept) if self._kept else np.empty(0, self._dtype)
        with reporting_scratch():
            self._files[number].seek(0)
            return np.frombuffer(self._files[number].read(), self._dtype)

    def close(self) -> None:
        """Removes the temporary files; harmless twice."""
        for file in self._files:
            # What could not be written is told already, by `add` or `read`.
            with contextlib.suppress(OSError):
                file.close()


def count_buckets(rows: int, held: int | None = None) -> int:
    """How many buckets hold at most `held` rows each (None: BUCKET_ROWS), as far as MOST_BUCKETS go."""
    return min(-(-max(rows, 1) // (held or BUCKET_ROWS)), MOST_BUCKETS)


def sort_by_time(gps_time: np.ndarray, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows and their buckets by GPS time f8 (n,) [s]: those of one pulse in one, different pulses spread evenly."""
    return np.arange(len(gps_time)), spread_keys(time_keys(gps_time), number)


def tell_pulses_apart(gps_time: np.ndarray) -> bool:
    """Whether times (n,) of points are those of their pulses: on average no more than a pulse can have share one."""
    return len(np.unique(gps_time)) * MOST_RETURNS >= len(gps_time)


def time_keys(gps_time: np.ndarray) -> np.ndarray:
    """Keys u8 (n,) that are equal where GPS times f8 (n,) are: zero has two signs."""
    return (gps_time + 0.0).view(np.uint64)


def spread_keys(keys: np.ndarray, number: int) -> np.ndarray:
    """Bucket of each key u8 (n,): equal ones in the same, different ones spread evenly, i8 (n,)."""
    mixed = (keys ^ (keys >> np.uint64(29))) * _MIX
    return ((mixed >> np.uint64(33)) % np.uint64(number)).astype(np.int64)
