"""One column of any point cloud, read in pieces: a wavebatch column, an extra dimension of the vendor, or a LAS field.

`wavebatch plot` reads clouds with it. Units and meanings come from the file; wavebatch's declarations are used only
for its own columns.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import laspy
import numpy as np
from laspy.point.dims import DimensionInfo

from wavebatch.core.condition import Condition
from wavebatch.core.echoes import COLUMNS
from wavebatch.core.errors import ConfigError
from wavebatch.core.suggest import nearest
from wavebatch.files.cloud.column_names import normalise
from wavebatch.files.cloud.echo_reader import CloudReader
from wavebatch.files.disk.raw_bytes import widen
from wavebatch.files.las.point_formats import ANGLE_UNIT

VALUE_DTYPE = np.dtype([("x", "<f8"), ("y", "<f8"), ("value", "<f8"), ("flags", "<u2")])
"""One point: position [m], the column's value (NaN: no data), EchoFlag bits (0 where the cloud has no flags)."""

_UNITS = {
    "x": "m", "y": "m", "z": "m", "gps_time": "s", "scan_angle": "deg", "scan_angle_rank": "deg",
    "return_point_wave_location": "ps", "wavepacket_offset": "bytes", "wavepacket_size": "bytes",
    "x_t": "m/ps", "y_t": "m/ps", "z_t": "m/ps",
}  # fmt: skip
"""Units of the standard fields that have one."""


_ANGLES = {"scanangle": "scan_angle_rank", "scananglerank": "scan_angle"}
"""The scan angle [deg] of the point formats 0 to 5 and of 6 to 10, each by the name that the other formats have."""


@dataclass(frozen=True, slots=True)
class ColumnFacts:
    """Name, unit and meaning of a column, as the file or the LAS standard declares them."""

    name: str
    """Name in the file."""
    unit: str
    """`-` if it has none or the file does not give it."""
    meaning: str
    """Short description; empty if the file does not give one."""
    step: float
    """Difference between two neighbouring values that can be stored; 0 for floating-point numbers."""
    is_flags: bool = False
    """Whether values are EchoFlag bits, which have no mean."""
    is_standard: bool = False
    """Whether it is a field of the point format, not an extra dimension."""

    @property
    def label(self) -> str:
        """Name, meaning and unit for an axis."""
        title = f"{self.name}: {self.meaning}" if self.meaning else self.name
        return f"{title} [{self.unit}]"


class ColumnReader(CloudReader):
    """A CloudReader of VALUE_DTYPE for every point of the file; `facts` describes the column.

    column: name of an extra dimension or a standard field, or a wavebatch column in the names of any style. If no name
    fits exactly, case, spaces and underscores are ignored. None: the value is 1 for every point. others: further
    columns; rows then have a field `others`, f8 (n, number of them), NaN for no data.
    Raises InputError if the file cannot be read, ConfigError if it has no such column.
    """

    def __init__(self, path: Path, column: str | None, others: Sequence[str] = ()) -> None:
        super().__init__(path)
        self._dtype = VALUE_DTYPE
        if others:
            self._dtype = np.dtype([*VALUE_DTYPE.descr, ("others", "<f8", (len(others),))])
        self.has_flags = "echo_flags" in self._sources
        try:
            self.facts, self._read = self._find(column)
            found = [self._find(other) for other in others]
        except BaseException:
            self._points.close()
            raise
        self.other_facts = tuple(facts for facts, _ in found)
        self._others = tuple(read for _, read in found)

    def list_columns(self) -> list[str]:
        """Return the names of all columns of the file."""
        dimensions = self._format.dimensions
        extra = [one.name for one in dimensions if not one.is_standard and one.num_elements == 1]
        standard = [one.name for one in dimensions if one.is_standard and one.name not in ("X", "Y", "Z")]
        return [*extra, "x", "y", "z", *standard]

    def find_value(self, column: str) -> Callable[[np.ndarray], np.ndarray]:
        """Return the function from raw records (n,) to the values of a column (n,), NaN for no data.

        It also works after the file is closed. Raises ConfigError if there is no such column.
        """
        return self._find(column)[1]

    def _find(
        self, column: str | None, *, stored: bool = False
    ) -> tuple[ColumnFacts, Callable[[np.ndarray], np.ndarray]]:
        """Facts and reading function of a column; stored: its name is that in the file."""
        if column is None:
            return ColumnFacts("points", "-", "", 1.0), lambda raw: np.ones(len(raw))
        known = self.list_columns()
        extra = {one.name: one for one in self._format.extra_dimensions if one.num_elements == 1}
        ours = self._find_ours(list(extra.values()), COLUMNS, decibel=True)
        alike = [name for name in known if normalise(name) == normalise(column)]
        if column in ours and column in self.written and not stored:
            column = ours[column].name
        elif column not in known:
            if column in ours:
                column = ours[column].name
            else:
                column = next(iter(alike), _ANGLES.get(normalise(column), column))
        if column in extra:
            dimension = extra[column]
            return self._describe_extra(dimension), lambda raw: self._read_column(raw, dimension)
        if column in known:
            return self._describe_standard(column), lambda raw: self._read_standard(raw, column)
        ours_not_here = [name for name in COLUMNS if normalise(name) == normalise(column)]
        if ours_not_here:
            raise ConfigError(
                f"{self.path}: has no column {column!r}; `wavebatch run` writes {ours_not_here[0]} into clouds"
                + (f": add --columns +{ours_not_here[0]}" if self.written else ", and this is none of them")
            )
        hint = nearest(column, known)
        has = "" if hint.startswith("known") else f" Columns of the file: {', '.join(known)}"
        raise ConfigError(f"{self.path}: has no column {column!r}; {hint}{has}")

    def _describe_extra(self, dimension: DimensionInfo) -> ColumnFacts:
        """Facts from the description in the file; for a wavebatch column from its declaration."""
        text = dimension.description or ""
        found = re.search(r"\[([^\[\]]+)\]\s*$", text)
        unit, meaning = (found[1], text[: found.start()].strip()) if found else ("-", text.strip())
        stored = {stored: column for column, stored in self.written.items()}
        name = stored.get(dimension.name) or re.sub(r"^wb\d*[ _]", "", dimension.name)
        if name in COLUMNS and found and unit == COLUMNS[name].unit:
            meaning = COLUMNS[name].meaning
        is_integer = np.dtype(dimension.dtype).kind in "ui"
        scale = 1.0 if dimension.scales is None else abs(float(dimension.scales[0]))
        is_flags = self.has_flags and self._sources["echo_flags"].name == dimension.name
        return ColumnFacts(dimension.name, unit, meaning, scale if is_integer else 0.0, is_flags)

    def _describe_standard(self, name: str) -> ColumnFacts:
        kind = self._format.dimension_by_name(name.upper() if name in "xyz" else name).kind.name
        step = 0.0 if kind == "FloatingPoint" else 1.0
        if name in "xyz":
            step = abs(float(self.scales["xyz".index(name)]))
        elif name == "scan_angle":
            step = ANGLE_UNIT
        return ColumnFacts(name, _UNITS.get(name, "-"), "", step, is_standard=True)

    def _read_standard(self, raw: np.ndarray, name: str) -> np.ndarray:
        if name in "xyz":
            return self._locate(raw, "xyz".index(name))
        values = widen(np.asarray(laspy.PackedPointRecord(raw, self._format)[name]))
        values[~np.isfinite(values)] = np.nan
        return values * ANGLE_UNIT if name == "scan_angle" else values

    def _convert(self, raw: np.ndarray) -> np.ndarray:
        rows = np.zeros(len(raw), self._dtype)
        rows["x"], rows["y"] = self._locate(raw, 0), self._locate(raw, 1)
        rows["value"] = self._read(raw)
        for place, read in enumerate(self._others):
            rows["others"][:, place] = read(raw)
        if self.has_flags:
            rows["flags"] = raw[self._sources["echo_flags"].name].astype(np.uint16)
        return rows


def find_keep(path: Path, condition: Condition) -> Callable[[np.ndarray], np.ndarray]:
    """Return the function from raw records (n,) of a cloud or strip to whether they meet a condition, bool (n,).

    Raises ConfigError, with the place in the text, if the file has no such column.
    """
    values: dict[str, Callable[[np.ndarray], np.ndarray]] = {}
    with ColumnReader(path, None) as reader:
        for column in condition.columns:
            try:
                values[column] = reader.find_value(column)
            except ConfigError as error:
                raise condition.complain(column, str(error)) from error
    return lambda raw: condition.choose({column: read(raw) for column, read in values.items()})


def select_points(reader: CloudReader, condition: Condition | None) -> None:
    """Let a reader give only the points that meet a condition (None: all); raises ConfigError as `find_keep` does."""
    if condition is not None:
        reader.keep = find_keep(reader.path, condition)


def check_alike(readers: Iterable[tuple[Path, ColumnFacts]]) -> ColumnFacts:
    """Return the facts of a column that several clouds have; raises ConfigError if their units differ."""
    readers = list(readers)
    first_path, first = readers[0]
    for path, facts in readers[1:]:
        if (facts.unit, facts.is_flags) != (first.unit, first.is_flags):
            raise ConfigError(
                f"{path}: {facts.name} is in [{facts.unit}], {first.name} of {first_path} in [{first.unit}]; plot them "
                "one by one"
            )
    return first
