"""Several columns of any point cloud, read together in pieces: for rasters and for the pictures of reports."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from wavebatch.core.errors import ConfigError
from wavebatch.files.cloud.column_reader import ColumnFacts, ColumnReader


class ColumnsReader(ColumnReader):
    """A ColumnReader of several columns: rows have x, y [m], `values` f8 (k,) (NaN: no data) and `flags`.

    missing_ok: columns that the file does not have are left out instead of raising ConfigError.
    Raises InputError if the file cannot be read.
    """

    def __init__(self, path: Path, columns: Sequence[str], *, missing_ok: bool = False) -> None:
        super().__init__(path, None)
        found = []
        try:
            for name in columns:
                try:
                    found.append(self._find(name))
                except ConfigError:
                    if not missing_ok:
                        raise
        except BaseException:
            self.close()
            raise
        self.facts: tuple[ColumnFacts, ...] = tuple(facts for facts, _ in found)
        self._readers = [read for _, read in found]
        self._dtype = np.dtype([("x", "<f8"), ("y", "<f8"), ("values", "<f8", (len(found),)), ("flags", "<u2")])

    def _convert(self, raw: np.ndarray) -> np.ndarray:
        rows = np.zeros(len(raw), self._dtype)
        rows["x"], rows["y"] = self._locate(raw, 0), self._locate(raw, 1)
        for place, read in enumerate(self._readers):
            rows["values"][:, place] = read(raw)
        if self.has_flags:
            rows["flags"] = raw[self._sources["echo_flags"].name].astype(np.uint16)
        return rows
