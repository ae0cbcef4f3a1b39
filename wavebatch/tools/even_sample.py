"""An evenly spaced sample of rows that arrive in pieces: enough for medians and percentiles of any number of rows.

Used by statistics that run over whole strips. The sample must not depend on the size of the pieces, because results
must be the same for any block size and any number of jobs.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np


class EvenSample:
    """Keeps all rows up to a limit, then every second, every fourth ... row.

    Parameters
    ----------
    limit : int, optional
        Largest number of rows that are kept; LIMIT if not given.
    """

    LIMIT = 1_000_000
    """Keeps percentiles right to about 0.1 % in some 10 MB per column."""

    def __init__(self, limit: int | None = None) -> None:
        self.limit = limit or self.LIMIT
        self.step, self.seen = 1, 0
        self._parts: list[dict[str, np.ndarray]] = []
        self._kept = 0

    def add(self, columns: Mapping[str, np.ndarray]) -> None:
        """Adds rows: columns are arrays (k, ...) by name, with the same names every time."""
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
        """The columns of the sample, rows in order of arrival; empty when no rows were added."""
        if len(self._parts) > 1:
            names = self._parts[0]
            self._parts = [{name: np.concatenate([part[name] for part in self._parts]) for name in names}]
        return self._parts[0] if self._parts else {}


def _length(columns: Mapping[str, np.ndarray]) -> int:
    return len(next(iter(columns.values())))
