"""Columns of any point cloud, read in pieces: a wavebatch column, an extra dimension of the vendor, or a LAS field.

`wavebatch plot` reads clouds with it. Units and meanings come from the file; wavebatch's declarations are used only
for columns of wavebatch.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from wavebatch.core.condition import Condition
from wavebatch.core.echoes import COLUMNS
from wavebatch.core.errors import ConfigError
from wavebatch.core.suggest import nearest
from wavebatch.files.cloud.column_names import resolve
from wavebatch.files.cloud.echo_reader import CloudReader, name_standard, read_field
from wavebatch.files.las.point_formats import ANGLE_UNIT
from wavebatch.files.point_dtypes import STANDARD_DTYPES, field_names, list_dimensions

_PLACE = np.dtype([("x", "<f8"), ("y", "<f8")])

_UNITS = {
    "x": "m", "y": "m", "z": "m", "gps_time": "s", "scan_angle": "deg", "scan_angle_rank": "deg",
    "return_point_wave_location": "ps", "wavepacket_offset": "bytes", "wavepacket_size": "bytes",
    "x_t": "m/ps", "y_t": "m/ps", "z_t": "m/ps",
}  # fmt: skip
"""Units of the standard fields that have one."""


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
    """A CloudReader of columns for every point: rows have x, y [m] and `values`, f8 (k,) (NaN: no data).

    columns: names of extra dimensions or standard fields, or wavebatch columns in the names of any style. If no name
    fits exactly, case, spaces and underscores are ignored. None: the value is 1 for every point.
    missing_ok: columns that the file does not have are left out.
    `facts` describes the columns.
    Raises InputError if the file cannot be read, ConfigError if it has no such column.
    """

    def __init__(self, path: Path, *columns: str | None, missing_ok: bool = False) -> None:
        super().__init__(path, _PLACE)
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
        self._values = [read for _, read in found]

    def list_columns(self) -> list[str]:
        """Return the names of all columns of the file."""
        standard = [name for name in list_dimensions(self.point_format) if name not in ("X", "Y", "Z")]
        return [*self.extra, "x", "y", "z", *standard]

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
        ours = {} if stored else self._find_ours(COLUMNS, decibel=True)
        written = {name: found for name, found in ours.items() if name in self.written}
        standard = name_standard(self.point_format)
        wanted, column = column, resolve(column, written, {name: name for name in self.extra} | standard, ours)
        if column in self.extra:
            return self._describe_extra(column), lambda raw: self.read_extra(raw, column)
        if column in known:
            return self._describe_standard(column), lambda raw: read_field(raw, self.point_format, column, self)
        missing = resolve(wanted, {name: name for name in COLUMNS})
        if missing:
            raise ConfigError(
                f"{self.path}: has no column {wanted!r}; `wavebatch run` writes {missing} into clouds"
                + (f": add --columns +{missing}" if self.written else ", and this is none of them")
            )
        hint = nearest(wanted, known)
        has = "" if hint.startswith("known") else f" Columns of the file: {', '.join(known)}"
        raise ConfigError(f"{self.path}: has no column {wanted!r}; {hint}{has}")

    def _describe_extra(self, field: str) -> ColumnFacts:
        """Facts from the description in the file; for a wavebatch column from its declaration."""
        record = self.extra[field]
        text = record.description
        found = re.search(r"\[([^\[\]]+)\]\s*$", text)
        unit, meaning = (found[1], text[: found.start()].strip()) if found else ("-", text.strip())
        stored = {stored: column for column, stored in self.written.items()}
        name = stored.get(field) or re.sub(r"^wb\d*[ _]", "", field)
        if name in COLUMNS and found and unit == COLUMNS[name].unit:
            meaning = COLUMNS[name].meaning
        step = 0.0 if record.dtype.kind == "f" else abs((record.scaling or (1.0,))[0])
        return ColumnFacts(field, unit, meaning, step, self._sources.get("echo_flags") == field)

    def _describe_standard(self, name: str) -> ColumnFacts:
        fields = STANDARD_DTYPES[self.point_format]
        step = 0.0 if name in field_names(fields) and fields[name].kind == "f" else 1.0
        if name in "xyz":
            step = abs(float(self.scales["xyz".index(name)]))
        elif name == "scan_angle":
            step = ANGLE_UNIT
        return ColumnFacts(name, _UNITS.get(name, "-"), "", step, is_standard=True)

    def _convert(self, raw: np.ndarray) -> np.ndarray:
        rows = np.zeros(len(raw), [*_PLACE.descr, ("values", "<f8", (len(self._values),))])
        rows["x"], rows["y"] = (read_field(raw, self.point_format, axis, self) for axis in "xy")
        for place, read in enumerate(self._values):
            rows["values"][:, place] = read(raw)
        return rows


def find_keep(path: Path, condition: Condition) -> Callable[[np.ndarray], np.ndarray]:
    """Return the function from raw records (n,) of a cloud or strip to whether they meet a condition, bool (n,).

    Raises ConfigError, with the place in the text, if the file has no such column.
    """
    values: dict[str, Callable[[np.ndarray], np.ndarray]] = {}
    with ColumnReader(path) as reader:
        for column in condition.columns:
            try:
                values[column] = reader.find_value(column)
            except ConfigError as error:
                raise condition.complain(column, str(error)) from error
    return lambda raw: condition.choose({column: read(raw) for column, read in values.items()})


def select_points(
    reader: CloudReader, condition: Condition | None, flags_with: int = 0, flags_without: int = 0
) -> None:
    """Let a reader give only the points that meet a condition (None: all) and have the right flags.

    flags_with: EchoFlag bits of which points must have one; 0: any point. flags_without: those they must not have.
    Raises ConfigError as `find_keep` does, and for a cloud without flags.
    """
    tests = [] if condition is None else [find_keep(reader.path, condition)]
    if flags_with or flags_without:
        if not reader.has_flags:
            raise ConfigError(f"{reader.path}: has no column echo_flags to select points by")
        tests.append(lambda raw: (reader.read_flags(raw) & np.uint16(flags_without)) == 0)
    if flags_with:
        tests.append(lambda raw: (reader.read_flags(raw) & np.uint16(flags_with)) != 0)
    if tests:
        reader.keep = lambda raw: np.logical_and.reduce([test(raw) for test in tests])


def check_alike(readers: Iterable[tuple[Path, ColumnFacts]]) -> ColumnFacts:
    """Return the facts of a column that several clouds have; raises ConfigError if their units differ.

    Its name is the shortest: one cloud may have `wb_amplitude` beside an `amplitude` of its strip.
    """
    readers = list(readers)
    first_path, first = readers[0]
    for path, facts in readers[1:]:
        if (facts.unit, facts.is_flags) != (first.unit, first.is_flags):
            raise ConfigError(
                f"{path}: {facts.name} is in [{facts.unit}], {first.name} of {first_path} in [{first.unit}]; plot them "
                "one by one"
            )
    return replace(first, name=min((facts.name for _, facts in readers), key=len))
