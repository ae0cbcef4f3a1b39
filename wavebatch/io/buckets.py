"""Records sorted into buckets on disk, so that what belongs together is compared in bounded memory."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from typing import IO

import numpy as np

from wavebatch.errors import InputError

Sorter = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Rows to (row numbers, bucket numbers): a row may go to several buckets, or to none."""


class Buckets:
    """Rows of one dtype in `number` buckets; temporary files hold them when there is more than one."""

    def __init__(self, dtype: np.dtype, number: int) -> None:
        self._dtype = dtype
        self._kept: list[np.ndarray] = []
        try:
            used = number if number > 1 else 0
            self._files: list[IO[bytes]] = [tempfile.TemporaryFile() for _ in range(used)]  # noqa: SIM115
        except OSError as error:
            raise InputError(f"{tempfile.gettempdir()}: {error.strerror or error}; set TMPDIR to a folder") from error

    def add(self, rows: np.ndarray, sorter: Sorter) -> None:
        """Puts rows into the buckets that `sorter` says."""
        if not self._files:
            self._kept.append(rows)
            return
        index, bucket = sorter(rows)
        order = np.argsort(bucket, kind="stable")
        edges = np.searchsorted(bucket[order], np.arange(len(self._files) + 1))
        try:
            for number, file in enumerate(self._files):
                part = index[order[edges[number] : edges[number + 1]]]
                if len(part):
                    file.write(rows[part].tobytes())
        except OSError as error:
            where = tempfile.gettempdir()
            raise InputError(f"{where}: {error.strerror or error}; set TMPDIR to a folder with more room") from error

    def read(self, number: int) -> np.ndarray:
        """Rows of one bucket in the order they came."""
        if not self._files:
            return np.concatenate(self._kept) if self._kept else np.empty(0, self._dtype)
        file = self._files[number]
        file.seek(0)
        return np.frombuffer(file.read(), self._dtype)

    def close(self) -> None:
        """Removes the temporary files."""
        for file in self._files:
            file.close()
