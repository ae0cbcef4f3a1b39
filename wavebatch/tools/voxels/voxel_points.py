"""The voxels of an .npz of `wavebatch voxelize`, read as points: sections and height profiles draw them so."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.suggest import nearest
from wavebatch.files.cloud.column_reader import ColumnFacts
from wavebatch.files.las.crs_name import name_crs
from wavebatch.tools.plots.values import Selection, Tally
from wavebatch.tools.voxels.grid import COLUMNS

_PIECE = 1_000_000


class VoxelFile:
    """The voxels of an .npz of `wavebatch voxelize`, read as the points at their centres.

    Has the interface of `values.Clouds`. Raises InputError for a file that holds no voxels, ConfigError without the
    column.
    """

    def __init__(self, path: Path, selection: Selection) -> None:
        self.paths, self.selection = (path,), selection
        if selection.flags_with or selection.flags_without:
            raise ConfigError(f"{path}: voxels have no echo_flags to select by")
        try:
            with np.load(path, allow_pickle=False) as data:
                self._data = {name: data[name] for name in data.files}
            self._index, self._origin = self._data["index"], self._data["origin"].astype(np.float64)
            self.size = float(self._data["size"])
            self.crs = name_crs(str(self._data["crs"])) if str(self._data["crs"]) else ""
            json.loads(str(self._data["meta"]))
        except (OSError, ValueError, KeyError, EOFError) as error:
            raise InputError(f"{path}: holds no voxels of `wavebatch voxelize` ({error})") from error
        known = {column.name: column for column in COLUMNS if column.name in self._data}
        name = selection.column
        if name is not None and name not in known:
            raise ConfigError(f"{path}: has no column {name!r}; {nearest(name, known)}")
        facts = known.get(name)
        unit, meaning = (facts.unit, facts.meaning) if facts else ("-", "")
        self.facts = ColumnFacts(name or "voxels", unit, meaning, 0.0)

    def read(self) -> Iterator[tuple[int, np.ndarray, Tally]]:
        """As Clouds.read, with the height of the centre in `others`."""
        dtype = [("x", "<f8"), ("y", "<f8"), ("value", "<f8"), ("others", "<f8", (1,))]
        for start in range(0, len(self._index), _PIECE):
            part = slice(start, start + _PIECE)
            place = self._origin + (self._index[part] + 0.5) * self.size
            rows = np.zeros(len(place), dtype)
            rows["x"], rows["y"], rows["others"][:, 0] = place.T
            rows["value"] = 1.0 if self.selection.column is None else self._data[self.selection.column][part]
            good = rows[~np.isnan(rows["value"])]
            yield 0, good, Tally(len(rows), 0, len(rows) - len(good), len(good))

    def complain(self, tally: Tally) -> InputError:
        """The error that says why nothing can be drawn."""
        return InputError(f"{self.paths[0]}: nothing to draw: {tally.points} voxels, {tally.no_data} without data")
