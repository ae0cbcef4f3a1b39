"""A point cloud as one NumPy table: the standard fields of LAS and the columns by wavebatch's names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.core.echoes import COLUMNS
from wavebatch.files.cloud.cloud_reader import ColumnReader
from wavebatch.files.las.header import STANDARD_DTYPES


def read_cloud(path: Path | str, columns: Sequence[str] | None = None) -> np.ndarray:
    """Read the points of a LAS or LAZ cloud with all columns by name.

    Parameters
    ----------
    path : path or str
        A cloud of `run`, or any other LAS or LAZ file.
    columns : sequence of str, optional
        Names to read, in this order; all by default: x, y, z, the standard fields under laspy's names, extra bytes.

    Returns
    -------
    ndarray
        Structured array (n,), one row per point. `cloud["amplitude"]` is a column.

    Raises
    ------
    InputError
        Where the file cannot be read.
    ConfigError
        Where it has no column of a name, with the nearest name.

    Notes
    -----
    wavebatch's columns have wavebatch's names and units, whatever `--names` they were written with, except those that
    were written in dB. All other extra bytes have their names in the file; `input_amplitude` is one that the input of
    the run had under the name of a wavebatch column. Where the file stores a no-data value the
    column is NaN. Columns of floating-point numbers keep their type. Integer columns that are scaled or declare a
    no-data value become float64, so that they can be NaN; all other integer columns (`echo_flags`, return numbers,
    classes) keep their type. `scan_angle` is in degrees.
    """
    reader = _TableReader(Path(path), columns)
    with reader:
        table = np.empty(reader.point_count, reader.dtype)
        start = 0
        for piece in reader.read_pieces():
            table[start : start + len(piece)] = piece
            start += len(piece)
    return table


class _TableReader(ColumnReader):
    """A ColumnReader whose pieces have several columns, of `dtype`."""

    def __init__(self, path: Path, columns: Sequence[str] | None) -> None:
        super().__init__(path)
        names = self._name_columns()
        chosen = names if columns is None else columns
        try:
            found = {name: self.find_column(names.get(name, name), stored=name in names) for name in chosen}
        except BaseException:
            self.close()
            raise
        self._readers = {name: read for name, (_, read) in found.items()}
        self._stored = {name: facts.name for name, (facts, _) in found.items()}
        self.dtype = np.dtype([(name, self._choose_dtype(stored)) for name, stored in self._stored.items()])

    def _name_columns(self) -> dict[str, str]:
        """Name of every column in the table -> its name in the file."""
        known = self.list_columns()
        ours = {field: name for name, field in self._find_ours(COLUMNS).items()}
        ours |= {name: f"input_{name}" for name in ours.values() if name in known and name not in ours}
        axes = {axis: axis for axis in "xyz"}
        standard = {name: name for name in known if name not in axes and name not in self.extra}
        return axes | standard | {ours.get(field, field): field for field in self.extra}

    def _choose_dtype(self, stored: str) -> np.dtype:
        if stored in ("x", "y", "z", "scan_angle"):
            return np.dtype(np.float64)
        record = self.extra.get(stored)
        if record is None:
            fields: Mapping[str, Any] = STANDARD_DTYPES[self.point_format].fields or {}
            return fields[stored][0] if stored in fields else np.dtype(np.uint8)  # a part of a field
        kept = record.scaling is None and (record.dtype.kind == "f" or record.no_data is None)
        return record.dtype if kept else np.dtype(np.float64)

    def _convert(self, raw: np.ndarray) -> np.ndarray:
        rows = np.empty(len(raw), self.dtype)
        for name, read in self._readers.items():
            stored = self._stored[name]
            # Integers without no-data are copied: those above 2^53 are no floating-point numbers.
            whole = self.dtype[name].kind in "ui" and stored in (raw.dtype.names or ())
            rows[name] = raw[stored] if whole else read(raw)
        return rows
