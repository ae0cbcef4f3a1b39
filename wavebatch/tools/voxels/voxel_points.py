"""The voxels of an .npz of `wavebatch voxelize`, read as points: sections and height profiles draw them so."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.suggest import nearest
from wavebatch.files.cloud.cloud_reader import ColumnFacts
from wavebatch.files.cloud.point_filter import PointFilter
from wavebatch.files.disk.npz import read_npz, reading_npz
from wavebatch.files.las.crs import name_crs
from wavebatch.tools.plots.values import Tally
from wavebatch.tools.voxels.grid import COLUMNS

_PIECE = 1_000_000

_LARGEST = 1e12
"""Largest coordinate and size [m] of voxels, and the root of their largest value; damaged files have larger ones."""


class VoxelFile:
    """The voxels of an .npz of `wavebatch voxelize`, read as the points at their centres.

    Has the interface of `values.Clouds`. Raises InputError for a file that holds no voxels, ConfigError without the
    column.
    """

    def __init__(self, path: Path, column: str | None, chosen: PointFilter) -> None:
        self.paths, self._column = (path,), column
        if chosen.flags or chosen.drop_flags:
            raise ConfigError(f"{path}: voxels have no echo_flags to select by")
        what, remedy = "voxels of `wavebatch voxelize`", "make them again"
        columns = {f"{column.name}?": ("fu", 1) for column in COLUMNS}
        needed = {"index": ("i", 2), "origin": ("f", 1), "size": ("f", 0), "crs": ("U", 0), "meta": ("U", 0)}
        self._data = read_npz(path, {**needed, **columns}, what, remedy)
        self._index, self._origin = self._data["index"], self._data["origin"].astype(np.float64)
        self.size = float(self._data["size"])
        lengths = {len(self._data[column.name]) for column in COLUMNS if column.name in self._data}
        is_sound = self._index.shape[1] == 3 and lengths == {len(self._index)} and self._origin.shape == (3,)
        is_sound &= bool((np.abs(self._origin) < _LARGEST).all()) and 1e-6 <= self.size < _LARGEST
        values = [self._data[column.name] for column in COLUMNS if column.name in self._data]
        if not is_sound or any((np.abs(one) > _LARGEST**2).any() for one in values):
            raise InputError(f"{path}: holds no {what}: its arrays do not fit; {remedy}")
        with reading_npz(path, what, remedy):
            json.loads(str(self._data["meta"]))
        self.crs = name_crs(str(self._data["crs"])) if str(self._data["crs"]) else ""
        known = {column.name: column for column in COLUMNS if column.name in self._data}
        if column is not None and column not in known:
            raise ConfigError(f"{path}: has no column {column!r}; {nearest(column, known)}")
        drawn = known.get(column)
        unit, meaning = (drawn.unit, drawn.meaning) if drawn else ("-", "")
        self.facts = ColumnFacts(column or "voxels", unit, meaning, 0.0)

    def read(self) -> Iterator[tuple[int, np.ndarray, Tally]]:
        """As Clouds.read, with the height of the centre as second value."""
        dtype = [("x", "<f8"), ("y", "<f8"), ("values", "<f8", (2,))]
        for start in range(0, len(self._index), _PIECE):
            part = slice(start, start + _PIECE)
            place = self._origin + (self._index[part] + 0.5) * self.size
            rows = np.zeros(len(place), dtype)
            rows["x"], rows["y"], rows["values"][:, 1] = place.T
            rows["values"][:, 0] = 1.0 if self._column is None else self._data[self._column][part]
            good = rows[~np.isnan(rows["values"][:, 0])]
            yield 0, good, Tally(len(rows), 0, len(rows) - len(good), len(good))

    def complain(self, tally: Tally) -> InputError:
        """The error that says why nothing can be drawn."""
        return InputError(f"{self.paths[0]}: nothing to draw: {tally.points} voxels, {tally.no_data} without data")
