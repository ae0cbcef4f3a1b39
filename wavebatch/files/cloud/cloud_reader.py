"""Point clouds of any program, read in pieces: fields that are asked for, or columns by any of their names.

All commands that read clouds use `CloudReader` with the fields that they need, or a ColumnReader for columns that a
user names. Units and meanings come from the file; wavebatch's declarations are used only for its columns. All bytes are
read and checked by wavebatch.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.core.echoes import COLUMNS
from wavebatch.core.errors import ConfigError, nearest
from wavebatch.core.frozen import frozen
from wavebatch.files.cloud.column_names import NO_DATA, STYLES, name_standard, read_field, read_provenance, resolve
from wavebatch.files.cloud.point_filter import PlannedFilter, PointFilter, ReadColumn
from wavebatch.files.disk.raw_bytes import Closing, undoing, widen_integers
from wavebatch.files.las import header as las
from wavebatch.files.las.crs import metres_per_unit, name_units, read_crs
from wavebatch.files.las.read_points import open_points, read_checked_header

CLOUD_COLUMNS = ("echo_time", "amplitude", "echo_width", "amplitude_err", "echo_width_err", "range_err")
"""Columns that are read if the cloud has them."""

CLOUD_DTYPE = np.dtype(
    [
        ("gps_time", "<f8"),
        ("xyz", "<f8", 3),
        ("ray", "<f4", 3),
        ("flags", "<u2"),
        ("number", "u1"),
        ("total", "u1"),
        ("classification", "u1"),
        ("intensity", "<u2"),
        *((name, "<f4") for name in CLOUD_COLUMNS),
    ]  # fmt: skip
)
"""One echo of a cloud, as the comparisons read it."""

RETURN_DTYPE = np.dtype(
    [
        ("gps_time", "<f8"),
        ("xyz", "<f8", 3),
        ("number", "u1"),
        ("total", "u1"),
        ("intensity", "<u2"),
        ("scan_angle", "<f4"),
        ("echo_width", "<f4"),
        ("flags", "<u2"),
        ("source", "<u2"),
        ("scanner", "u1"),
    ]  # fmt: skip
)
"""One return of a cloud. Keep it small: statistics hold many of them in memory."""

_PIECE = 250_000
_PIECE_BYTES = 1 << 26

_PLACE = np.dtype([("x", "<f8"), ("y", "<f8")])

_UNITS = {
    "x": "m", "y": "m", "z": "m", "gps_time": "s", "scan_angle": "deg", "scan_angle_rank": "deg",
    "return_point_wave_location": "ps", "wavepacket_offset": "bytes", "wavepacket_size": "bytes",
    "x_t": "m/ps", "y_t": "m/ps", "z_t": "m/ps",
}  # fmt: skip
"""Units of the standard fields that have one."""


@frozen
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


class CloudReader(Closing):
    """Reads a LAS or LAZ file in pieces. A context manager.

    dtype: the fields to read. They are gps_time [s], xyz [m], ray (the stored packet vector, which may point either
    way; 0: none), flags (EchoFlag bits), number and total (of returns), classification, intensity, scan_angle [deg],
    source (point source id), and names of wavebatch columns (NaN: no data). With `ray`, points without a packet are
    left out if the cloud has packets.
    Raises InputError if the file is damaged, or compressed in a way that no installed library can read.
    """

    def __init__(self, path: Path, dtype: np.dtype = CLOUD_DTYPE) -> None:
        self.path = Path(path)
        self.dtype = dtype
        checked = read_checked_header(self.path, waveforms=False)
        self.point_count: int = checked.header.point_count
        self.scales: tuple[float, ...] = checked.header.scales
        self.offsets: tuple[float, ...] = checked.header.offsets
        self._header, self.unread = checked.header, checked.unread
        units = read_crs(self.path, checked.header)[1]
        self.metres = metres_per_unit(units)
        """Metres of a step of 1 in x, y and z; NaN in degrees."""
        self.unit = name_units(units)
        self.has_heights = all(unit.kind != "geocentric" for unit in units)
        self.bounds = checked.header.mins, checked.header.maxs
        self.point_format: int = checked.header.point_format
        fields = las.field_names(las.STANDARD_DTYPES[self.point_format])
        self.has_gps_time = "gps_time" in fields
        self.has_packets = "wavepacket_index" in fields
        self.extra = {field: record for field, record in checked.extra.items() if not record.dtype.shape}
        """The record of each extra dimension that is one number, by its field."""
        self._point_length = checked.dtype.itemsize
        runs = read_provenance(checked.header)
        written = runs[-1].get("columns") if runs else None
        self.written = {column: name for column, name in (written if isinstance(written, dict) else {}).items()
                        if isinstance(name, str) and name in self.extra
                        and (column != "echo_flags" or self.extra[name].dtype.kind == "u")}  # fmt: skip
        """The file's name of each wavebatch column, by the provenance of the latest run; empty without one. Columns
        that another program has renamed, left out or stored as several numbers, or flags as signed ones, are none."""
        # Other programs drop the declaration of no-data, laspy where it adds a dimension: -9999 would be an amplitude.
        # In a file that wavebatch made it is no value of any column with a point, as those of voxels.
        ours = {field: column for column, field in self._find_ours(COLUMNS, decibel=True).items()}
        for field, record in self.extra.items():
            stored = [style[ours[field]] for style in STYLES.values() if ours.get(field) in style]
            empty = next((one.no_data for one in stored if one.scale), None)
            if record.dtype.kind == "f" and (runs or field in ours):
                empty = NO_DATA["-9999"]
            if record.no_data is None and empty is not None:
                self.extra[field] = record.with_no_data([empty])
        self._sources = self._find_ours((*las.field_names(dtype), "echo_flags"))
        self.columns = tuple(name for name in las.field_names(dtype) if name in self._sources)
        """The wavebatch columns among the fields that the cloud has."""
        self.has_flags = "echo_flags" in self._sources
        self.records = np.empty(0)
        """The raw records of the last piece."""
        self.left_out = 0
        """Points that the filter of `select` has left out so far."""
        self._filter: PlannedFilter | None = None
        self._points = open_points(checked)

    def measure_in_metres(self) -> None:
        """Let positions be in metres; raises ConfigError for degrees, and for units of unknown length."""
        if any(map(math.isnan, self.metres)):
            raise ConfigError(f"{self.path}: coordinates are {self.unit}, which have no length; project it to metres")
        self.scales = tuple(scale * one for scale, one in zip(self.scales, self.metres, strict=True))
        self.offsets = tuple(offset * one for offset, one in zip(self.offsets, self.metres, strict=True))

    def close(self) -> None:
        """Close the file."""
        self._points.close()

    def read_pieces(self, size: int = _PIECE, most: int = _PIECE_BYTES) -> Iterator[np.ndarray]:
        """Yield the points of the file in order, at most `size`, and `most` bytes of records, at a time."""
        size = max(min(size, most // self._point_length), 1)
        for start in range(0, self.point_count, size):
            raw = self._points.read(start, min(start + size, self.point_count))
            if self._filter is not None:
                kept = self._filter.test(raw, len(raw)) == 0
                self.left_out += len(raw) - int(np.count_nonzero(kept))
                raw = np.asarray(raw)[kept]
            self.records = raw
            yield self._convert(raw)

    def plan(self, selection: PointFilter) -> PlannedFilter:
        """Return the filter for raw records of this file, which also works after the file is closed.

        Raises ConfigError for a column that there is not, and for polygons that cannot be placed.
        """
        standard = {
            "x": lambda raw: read_field(raw, self.point_format, "x", self._header),
            "y": lambda raw: read_field(raw, self.point_format, "y", self._header),
            "classification": las.read_classes,
            **({"echo_flags": self.read_flags} if self.has_flags else {}),
        }
        return selection.plan(standard, lambda column: self.find_column(column)[1], str(self.path))

    def select(self, selection: PointFilter) -> None:
        """Let the reader give only the points that a filter chooses; raises as `plan`."""
        self._filter = self.plan(selection) if selection else None

    def read_flags(self, raw: np.ndarray) -> np.ndarray:
        """Return the EchoFlag bits of raw records, u2 (n,); 0 where the cloud has no flags."""
        if not self.has_flags:
            return np.zeros(len(raw), np.uint16)
        return raw[self._sources["echo_flags"]].astype(np.uint16)

    def _find_ours(self, columns: Iterable[str], *, decibel: bool = False) -> dict[str, str]:
        """The field of each wavebatch column that the cloud has; decibel: also of those that are written in dB."""
        if self.written:
            known = {name: self.written[name] for name in columns if name in self.written}
            return {name: one for name, one in known.items()
                    if decibel or not self.extra[one].description.endswith("[dB]")}  # fmt: skip
        # Other programs may drop the provenance: then by the names of the extra dimensions alone. wavebatch's name is
        # preferred to those of other styles, and a name with the prefix `wb_` (`wb ` in old clouds) to one without. A
        # dimension of another style counts only if it is stored as that style stores it: RIEGL's Amplitude, for
        # example, is in dB.
        wanted = set(columns)
        names: list[tuple[str, str, float | None]] = [(column, column, None) for column in COLUMNS if column in wanted]
        for style in STYLES.values():
            names += [(key, naming.name, naming.scale) for key, naming in style.items() if not naming.decibel]
        found: dict[str, str] = {}
        for column, name, scale in names:
            for field in (f"wb_{name.replace(' ', '_')}", f"wb {name}", name):
                record = self.extra.get(field) if column in wanted else None
                if record is None or (record.scaling is None) != (scale is None):
                    continue
                if column != "echo_flags" or record.dtype.kind == "u":
                    found.setdefault(column, field)
        return found

    def list_columns(self) -> list[str]:
        """Return the names of all columns of the file."""
        standard = [name for name in las.list_dimensions(self.point_format) if name not in ("X", "Y", "Z")]
        return [*self.extra, "x", "y", "z", *standard]

    def find_column(self, column: str | None, *, stored: bool = False) -> tuple[ColumnFacts, ReadColumn]:
        """Return facts and reading function of a column; stored: its name is that in the file."""
        if column is None:
            return ColumnFacts("points", "-", "", 1.0), lambda raw: np.ones(len(raw))
        known = self.list_columns()
        ours = {} if stored else self._find_ours(COLUMNS, decibel=True)
        written = {name: found for name, found in ours.items() if name in self.written}
        standard = name_standard(self.point_format)
        wanted, column = column, resolve(column, written, {name: name for name in self.extra} | standard, ours)
        if column in self.extra:
            # Facts from the description in the file; for a wavebatch column from its declaration.
            record = self.extra[column]
            text = record.description
            found = re.search(r"\[([^\[\]]+)\]\s*$", text)
            unit, meaning = (found[1], text[: found.start()].strip()) if found else ("-", text.strip())
            by_field = {field: ours for ours, field in self.written.items()}
            name = by_field.get(column) or re.sub(r"^wb\d*[ _]", "", column)
            if name in COLUMNS and found and unit == COLUMNS[name].unit:
                meaning = COLUMNS[name].meaning
            step = 0.0 if record.dtype.kind == "f" else abs((record.scaling or (1.0,))[0])
            facts = ColumnFacts(column, unit, meaning, step, self._sources.get("echo_flags") == column)
            return facts, lambda raw: record.read(raw[column])
        if column in known:
            fields = las.STANDARD_DTYPES[self.point_format]
            step = 0.0 if column in las.field_names(fields) and fields[column].kind == "f" else 1.0
            if column in "xyz":
                step = abs(float(self.scales["xyz".index(column)]))
            elif column == "scan_angle":
                step = las.ANGLE_UNIT
            facts = ColumnFacts(column, _UNITS.get(column, "-"), "", step, is_standard=True)
            return facts, lambda raw: read_field(raw, self.point_format, column, self._header)
        missing = resolve(wanted, {name: name for name in COLUMNS})
        if missing:
            raise ConfigError(
                f"{self.path}: has no column {wanted!r}; `wavebatch run` writes {missing} into clouds"
                + (f": add --columns +{missing}" if self.written else ", and this is none of them")
            )
        hint = nearest(wanted, dict.fromkeys([*ours, *known]))  # ours by our names: `amplitude` for wb_amplitude
        has = "" if hint.startswith("known") else f" Columns of the file: {', '.join(known)}"
        raise ConfigError(f"{self.path}: has no column {wanted!r}; {hint}{has}")

    def _convert(self, raw: np.ndarray) -> np.ndarray:
        """Rows of `dtype`; fields that the file does not have are 0, wavebatch columns NaN."""
        if "ray" in las.field_names(self.dtype) and self.has_packets:
            raw = raw[raw["wavepacket_index"] != 0]
        readers = {
            "xyz": lambda: np.stack([read_field(raw, self.point_format, axis, self) for axis in "xyz"], axis=1),
            "flags": lambda: self.read_flags(raw),
            "number": lambda: las.split_numbers(raw)[0],
            "total": lambda: las.split_numbers(raw)[1],
            "classification": lambda: las.read_classes(raw),
            "intensity": lambda: raw["intensity"],
            "scan_angle": lambda: las.read_angles(raw),
            "source": lambda: raw["point_source_id"],
            "scanner": lambda: las.read_scanner(raw) if self.point_format > 5 else 0,
        }
        rows = np.zeros(len(raw), self.dtype)
        for name in las.field_names(self.dtype):
            if name in COLUMNS:
                field = self._sources.get(name)
                rows[name] = np.nan if field is None else self.extra[field].read(raw[field])
            elif name == "ray" and self.has_packets:
                ray = np.stack([widen_integers(raw[axis]) for axis in ("x_t", "y_t", "z_t")], axis=1)
                ray[~np.isfinite(ray).all(axis=1)] = 0.0  # damaged: as if there were none
                rows[name] = ray
            elif name == "gps_time" and self.has_gps_time:
                rows[name] = widen_integers(raw["gps_time"])
            elif name in readers:
                rows[name] = readers[name]()
        return rows


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
        with undoing(self.close):
            for name in columns:
                with contextlib.suppress(*[ConfigError] * missing_ok):
                    found.append(self.find_column(name))
        self.facts: tuple[ColumnFacts, ...] = tuple(facts for facts, _ in found)
        self._values = [read for _, read in found]

    def _convert(self, raw: np.ndarray) -> np.ndarray:
        rows = np.zeros(len(raw), [*_PLACE.descr, ("values", "<f8", (len(self._values),))])
        rows["x"], rows["y"] = (read_field(raw, self.point_format, axis, self) for axis in "xy")
        for place, read in enumerate(self._values):
            rows["values"][:, place] = read(raw)
        return rows


def read_cloud(path: Path | str, columns: Sequence[str] | None = None) -> np.ndarray:
    """Read the points of a LAS or LAZ cloud with all columns by name.

    Parameters
    ----------
    path : path or str
        A cloud of `run`, or any other LAS or LAZ file.
    columns : sequence of str or str, optional
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
    reader = _TableReader(Path(path), [columns] if isinstance(columns, str) else columns)
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
        # Name of every column in the table -> its name in the file.
        known = self.list_columns()
        ours = {field: name for name, field in self._find_ours(COLUMNS).items()}
        ours |= {name: f"input_{name}" for name in ours.values() if name in known and name not in ours}
        names = {axis: axis for axis in "xyz"}
        names |= {name: name for name in known if name not in names and name not in self.extra}
        names |= {ours.get(field, field): field for field in self.extra}
        chosen = list(names if columns is None else columns)  # a generator gives them once
        with undoing(self.close):
            if wrong := [name for name in chosen if not isinstance(name, str)]:
                raise ConfigError(f"columns: {wrong[0]!r} is no name; give texts, such as 'amplitude'")
            found = {name: self.find_column(names.get(name, name), stored=name in names) for name in chosen}
        self._readers = {name: read for name, (_, read) in found.items()}
        self._stored = {name: facts.name for name, (facts, _) in found.items()}
        self.dtype = np.dtype([(name, self._choose_dtype(stored)) for name, stored in self._stored.items()])

    def _choose_dtype(self, stored: str) -> np.dtype:
        if stored in ("x", "y", "z", "scan_angle"):
            return np.dtype(np.float64)
        record = self.extra.get(stored)
        if record is None:
            fields: Mapping[str, Any] = las.STANDARD_DTYPES[self.point_format].fields or {}
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
