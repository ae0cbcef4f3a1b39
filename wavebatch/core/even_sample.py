"""An even sample of rows that come in pieces: enough for medians and percentiles, whatever the number of rows."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np


class EvenSample:
    """All rows up to a limit, then every second, fourth ... of them; the same for any size of the pieces.

    limit: most rows that are kept; None: LIMIT.
    """

    LIMIT = 1_000_000

    def __init__(self, limit: int | None = None) -> None:
        self.limit = limit or self.LIMIT
        self.step, self.seen = 1, 0
        self._parts: list[dict[str, np.ndarray]] = []
        self._kept = 0

    def add(self, columns: Mapping[str, np.ndarray]) -> None:
        """Takes in rows: columns (k, ...) of the same names every time."""
        start, number = -self.seen % self.step, _length(columns)
        self.seen += number
        # Copies, because slices would keep the whole records alive.
        self._parts.append({name: values[start :: self.step].copy() for name, values in columns.items()})
        self._kept += _length(self._parts[-1])
        while self._kept > self.limit:
            self._parts = [{name: values[::2].copy() for name, values in self.read().items()}]
            self._kept = _length(self._parts[0])
            self.step *= 2

    def read(self) -> dict[str, np.ndarray]:
        """The sample's columns, rows in order; empty where nothing was taken in."""
        if len(self._parts) > 1:
            names = self._parts[0]
            self._parts = [{name: np.concatenate([part[name] for part in self._parts]) for name in names}]
        return self._parts[0] if self._parts else {}


def _length(columns: Mapping[str, np.ndarray]) -> int:
    return len(next(iter(columns.values())))
