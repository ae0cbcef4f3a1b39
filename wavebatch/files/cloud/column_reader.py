"""One column of any point cloud, read in pieces: wavebatch's own, the vendor's extra bytes, or a standard field."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import laspy
import numpy as np
from laspy.point.dims import DimensionInfo

from wavebatch.core.echoes import COLUMNS
from wavebatch.core.errors import ConfigError
from wavebatch.core.suggest import nearest
from wavebatch.files.cloud.column_names import normalise
from wavebatch.files.cloud.echo_reader import CloudReader, find_columns
from wavebatch.files.disk.raw_bytes import widen

VALUE_DTYPE = np.dtype([("x", "<f8"), ("y", "<f8"), ("value", "<f8"), ("flags", "<u2")])
"""One point: position [m], the column's value (NaN: no data), EchoFlag bits (0 where the cloud has no flags)."""

_UNITS = {
    "x": "m", "y": "m", "z": "m", "gps_time": "s", "scan_angle": "deg", "scan_angle_rank": "deg",
    "return_point_wave_location": "ps", "wavepacket_offset": "bytes", "wavepacket_size": "bytes",
    "x_t": "m/ps", "y_t": "m/ps", "z_t": "m/ps",
}  # fmt: skip
"""Of the standard fields that have one."""
_SCAN_ANGLE = 0.006
"""Degrees per count of point formats 6 to 10."""


@dataclass(frozen=True, slots=True)
class ColumnFacts:
    """What a column is, as the file or its standard declares it."""

    name: str
    """As it stands in the file."""
    unit: str
    """`-` where it has none or nobody says it."""
    meaning: str
    """In field words; empty where nobody says it."""
    step: float
    """Distance between two values that can be stored; 0 for floating-point numbers."""
    is_flags: bool = False
    """Bits of EchoFlag, of which there is no mean."""

    @property
    def label(self) -> str:
        """Name, meaning and unit for an axis."""
        told = f"{self.name}: {self.meaning}" if self.meaning else self.name
        return f"{told} [{self.unit}]"


class ColumnReader(CloudReader):
    """A CloudReader whose pieces are VALUE_DTYPE, of every point of the file; `facts` says what the column is.

    column: name of an extra dimension or a standard field, or of one of wavebatch's columns, whatever style names it;
    case, spaces and underscores do not count where no other name fits. None: the value is 1 for every point.
    Raises InputError where the file cannot be read, ConfigError where it has no such column.
    """

    def __init__(self, path: Path, column: str | None) -> None:
        super().__init__(path)
        self._header = self._file.header
        self.has_flags = "echo_flags" in self._sources
        try:
            self.facts, self._read = self._find(column)
        except BaseException:
            self._file.close()
            raise

    def list_columns(self) -> list[str]:
        """Names of all that can be asked for."""
        dimensions = self._header.point_format.dimensions
        extra = [one.name for one in dimensions if not one.is_standard and one.num_elements == 1]
        standard = [one.name for one in dimensions if one.is_standard and one.name not in ("X", "Y", "Z")]
        return [*extra, "x", "y", "z", *standard]

    def _find(self, column: str | None) -> tuple[ColumnFacts, Callable[[laspy.ScaleAwarePointRecord], np.ndarray]]:
        if column is None:
            return ColumnFacts("points", "-", "", 1.0), lambda points: np.ones(len(points))
        known = self.list_columns()
        extra = {one.name: one for one in self._header.point_format.extra_dimensions if one.num_elements == 1}
        ours = find_columns(list(extra.values()), COLUMNS)
        alike = [name for name in known if normalise(name) == normalise(column)]
        if column not in known:
            if column in ours:
                column = ours[column].name
            elif alike or normalise(column) == "scanangle" and "scan_angle_rank" in known:
                column = alike[0] if alike else "scan_angle_rank"
        if column in extra:
            dimension = extra[column]
            return self._describe_extra(dimension), lambda points: self._read_column(points.array, dimension)
        if column in known:
            return self._describe_standard(column), lambda points: self._read_standard(points, column)
        hint = nearest(column, known)
        has = "" if hint.startswith("known") else f" It has {', '.join(known)}"
        raise ConfigError(f"{self.path}: has no column {column!r}; {hint}{has}")

    def _describe_extra(self, dimension: DimensionInfo) -> ColumnFacts:
        """From the description in the file; where it is one of ours, from the column's declaration."""
        text = dimension.description or ""
        found = re.search(r"\[([^\[\]]+)\]\s*$", text)
        unit, meaning = (found[1], text[: found.start()].strip()) if found else ("-", text.strip())
        name = dimension.name.removeprefix("wb ")
        if name in COLUMNS and found and unit == COLUMNS[name].unit:
            meaning = COLUMNS[name].meaning
        is_integer = np.dtype(dimension.dtype).kind in "ui"
        scale = 1.0 if dimension.scales is None else abs(float(dimension.scales[0]))
        flags = self._sources.get("echo_flags")
        return ColumnFacts(
            dimension.name,
            unit,
            meaning,
            scale if is_integer else 0.0,
            flags is not None and flags.name == dimension.name,
        )

    def _describe_standard(self, name: str) -> ColumnFacts:
        kind = self._header.point_format.dimension_by_name(name.upper() if name in "xyz" else name).kind.name
        step = 0.0 if kind == "FloatingPoint" else 1.0
        if name in "xyz":
            step = abs(float(self._header.scales["xyz".index(name)]))
        elif name == "scan_angle":
            step = _SCAN_ANGLE
        return ColumnFacts(name, _UNITS.get(name, "-"), "", step)

    def _read_standard(self, points: laspy.ScaleAwarePointRecord, name: str) -> np.ndarray:
        if name in "xyz":
            return self._scale(points, "xyz".index(name))
        values = widen(np.asarray(points[name]))
        values[~np.isfinite(values)] = np.nan
        return values * _SCAN_ANGLE if name == "scan_angle" else values

    def _scale(self, points: laspy.ScaleAwarePointRecord, axis: int) -> np.ndarray:
        return points.array["XYZ"[axis]] * points.scales[axis] + points.offsets[axis]

    def _convert(self, points: laspy.ScaleAwarePointRecord) -> np.ndarray:
        rows = np.zeros(len(points), VALUE_DTYPE)
        rows["x"], rows["y"] = self._scale(points, 0), self._scale(points, 1)
        rows["value"] = self._read(points)
        if self.has_flags:
            rows["flags"] = points.array[self._sources["echo_flags"].name].astype(np.uint16)
        return rows


def check_alike(readers: Iterable[tuple[Path, ColumnFacts]]) -> ColumnFacts:
    """The facts that the columns of several clouds share; raises ConfigError where their units differ."""
    readers = list(readers)
    first_path, first = readers[0]
    for path, facts in readers[1:]:
        if (facts.unit, facts.is_flags) != (first.unit, first.is_flags):
            raise ConfigError(
                f"{path}: {facts.name} is in [{facts.unit}], {first.name} of {first_path} in [{first.unit}]; draw them "
                "one by one"
            )
    return first
