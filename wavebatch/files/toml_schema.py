"""One schema for TOML files and JSON reports: the dataclass whose fields they hold.

A field `std: Annotated[float, Range(1e-3, 1e10), Key("noise_std_dn", "noise of one sample")]` is its own key, range and
comment: `describe_record` writes an object as plain values under its keys, `read_record` reads them back, both to the
last bit. Fields without a Key are not in the file. System and calibration files are written and read so.
Before you change a key: files of earlier versions must stay readable.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import re
import types
import typing
from collections.abc import Collection, Mapping
from datetime import date
from typing import Any, NamedTuple, TypeVar

from wavebatch.core.errors import ConfigError
from wavebatch.core.schema import Key, Range
from wavebatch.files.toml_file import TomlTable, check_number, shorten

MOST_ROWS = 1024
"""Rows of a list in a file: the correlation and the tail of a pulse have fewer than 64."""

_Record = TypeVar("_Record")


class Entry(NamedTuple):
    """A field that stands in a file."""

    field: str
    shape: str
    """`value`, `rows`, `pairs` (rows of a mapping), `table` (numbers by name), `record` (its keys stand in the table of
    its owner), `records` (an array of tables), or `numbered` (a key for each number of a mapping).
    """
    kinds: tuple[type, ...]
    """Of the value or record, or of each number of a row."""
    limits: tuple[Range | None, ...]
    key: Key
    needed: bool
    optional: bool
    """Whether the field may be None."""


@functools.cache
def list_entries(kind: type) -> tuple[Entry, ...]:
    """List the fields of a dataclass that have a Key, and all of a NamedTuple."""
    hints, found = typing.get_type_hints(kind, include_extras=True), []
    if dataclasses.is_dataclass(kind):
        defaults = {one.name for one in dataclasses.fields(kind)
                    if (one.default, one.default_factory) != (dataclasses.MISSING, dataclasses.MISSING)}  # fmt: skip
        usual = None
    else:
        defaults, usual = set(kind._field_defaults), Key()  # type: ignore[attr-defined]
    for name, annotation in hints.items():
        hint, *notes = typing.get_args(annotation) if _origin(annotation) is typing.Annotated else (annotation,)
        key = next((note for note in notes if isinstance(note, Key)), usual)
        if key is None:
            continue
        optional = _origin(hint) in (types.UnionType, typing.Union)
        hint = next(part for part in typing.get_args(hint) if part is not type(None)) if optional else hint
        shape, parts = _read_shape(hint, key)
        kinds, limits = zip(*map(_split, parts), strict=True)
        limits = limits if any(limits) else tuple(note for note in notes if isinstance(note, Range)) or limits
        is_record = shape == "record"
        key = key._replace(name=key.name if is_record else key.name or name)
        needed = key.needed or (name not in defaults and key.missing is None)
        found.append(Entry(name, shape, kinds, limits, key, needed, optional))
    return tuple(found)


def _origin(hint: Any) -> Any:
    return typing.get_origin(hint)


def _read_shape(hint: Any, key: Key) -> tuple[str, tuple[Any, ...]]:
    """Shape of a field, and the types of its parts."""
    inner = typing.get_args(hint)
    if _origin(hint) is tuple:
        if _is_record(inner[0]):
            return "records", inner[:1]
        return "rows", typing.get_args(inner[0]) if _origin(inner[0]) is tuple else inner[:1]
    if _origin(hint) is Mapping:
        numbered, named = "{}" in key.name, inner[0] is str
        return "numbered" if numbered else "table" if named else "pairs", inner[1:] if numbered or named else inner
    return "record" if _is_record(hint) else "value", (hint,)


def _split(hint: Any) -> tuple[type, Range | None]:
    """A type, and its range where it has one."""
    if _origin(hint) is not typing.Annotated:
        return hint, None
    kind, *notes = typing.get_args(hint)
    return kind, next((note for note in notes if isinstance(note, Range)), None)


def _is_record(hint: Any) -> bool:
    return isinstance(hint, type) and (dataclasses.is_dataclass(hint) or hasattr(hint, "_fields"))


def list_keys(kind: type, prefix: str = "") -> dict[str, Entry]:
    """List the keys of a table, those of numbered ones excepted, with their entries."""
    found: dict[str, Entry] = {}
    for one in list_entries(kind):
        if one.shape == "record":
            found |= list_keys(one.kinds[0], prefix + one.key.name)
        elif one.shape != "numbered":
            found[prefix + one.key.name] = one
    return found


def list_comments(kind: type, *places: str) -> dict[str, str]:
    """Return the meaning of each key by its dotted name in a file, for tables at these places ("" for the document)."""
    keys = list_keys(kind)
    return {f"{place}{'.' * bool(place)}{key}": one.key.meaning for place in places for key, one in keys.items()}


def describe_record(value: Any) -> dict[str, Any]:
    """Return an object as plain values under its keys: first single values, then tables, then lists.

    None and infinite numbers are None, which a file leaves out; a mapping of numbers becomes sorted pairs; empty lists
    are left out where their Key does not ask for them.
    """
    values: dict[str, Any] = {}
    tables: dict[str, Any] = {}
    lists: dict[str, Any] = {}
    for one in list_entries(type(value)):
        part, key = getattr(value, one.field), one.key.name
        if one.shape == "record":
            for name, item in ({} if part is None else describe_record(part)).items():
                (lists if isinstance(item, list) else tables if isinstance(item, dict) else values)[key + name] = item
        elif one.shape == "numbered":
            for number, item in part.items():
                inner = describe_record(item) if _is_record(one.kinds[0]) else {"": one.kinds[0](item)}
                values |= {key.format(number) + name: plain for name, plain in inner.items()}
        elif one.shape == "table":
            tables[key] = {name: one.kinds[0](item) for name, item in part.items()}
        elif one.shape == "value":
            lost = part is None or isinstance(part, float) and math.isinf(part)
            values[key] = None if lost else one.kinds[0](part)
        elif part or one.key.blank:
            lists[key] = list(map(describe_record, part)) if one.shape == "records" else _describe_rows(part, one)
    return {**values, **tables, **lists}


def _describe_rows(rows: Any, one: Entry) -> list[Any]:
    rows = sorted(rows.items()) if isinstance(rows, Mapping) else rows
    if len(one.kinds) == 1:
        return list(map(one.kinds[0], rows))
    return [[kind(number) for kind, number in zip(one.kinds, row, strict=True)] for row in rows]


def read_record(
    kind: type[_Record], table: TomlTable, *, remedy: str = "", also: Collection[str] = (), strict: bool = True
) -> _Record:
    """Read an object from the table that holds its keys.

    Parameters
    ----------
    kind : type
        A dataclass, or a NamedTuple.
    table : TomlTable
    remedy : str, optional
        What to do where a key is missing.
    also : collection of str, optional
        Further keys that the table may have.
    strict : bool, optional
        Whether an unknown key is wrong; else it is left out.

    Returns
    -------
    object of this kind

    Raises
    ------
    ConfigError
        With file, table and key: for an unknown key, a missing one, another type, and a number out of its range.
    """
    if strict:
        table.check_keys((*list_keys(kind), *also))
    values, missing = _read_fields(kind, table, "")
    for key, meaning in missing:
        words = f"; {remedy}" if remedy else f": {meaning}" if meaning else ""
        raise ConfigError(f"{table.where}: key {key!r} is missing{words}")
    return kind(**values)


def _read_fields(kind: type, table: TomlTable, prefix: str) -> tuple[dict[str, Any], list[tuple[str, str]]]:
    """Values by field, and the needed keys that are missing, with their meanings."""
    values: dict[str, Any] = {}
    missing: list[tuple[str, str]] = []
    for one in list_entries(kind):
        key = prefix + one.key.name
        if one.shape == "record":
            inner, lacking = _read_fields(one.kinds[0], table, key)
            missing += [] if one.optional else lacking
            if not lacking:
                values[one.field] = one.kinds[0](**inner)
        elif one.shape == "numbered":
            values[one.field] = _read_numbered(one, table, key)
        elif key in table.values:
            values[one.field] = _read_entry(one, table, key)
        elif one.needed:
            missing.append((key, one.key.meaning))
        elif one.key.missing is not None:
            values[one.field] = one.key.missing
    return values, missing


def _read_numbered(one: Entry, table: TomlTable, key: str) -> dict[int, Any]:
    """Values by number; none where a part of one is missing."""
    is_record, pattern = _is_record(one.kinds[0]), re.escape(key).replace(r"\{\}", "([0-9]{1,3})")
    matches = filter(None, (re.fullmatch(pattern + r"\w*" * is_record, name) for name in table.values))
    found: dict[int, Any] = {}
    for number in dict.fromkeys(int(match[1]) for match in matches):
        if not is_record:
            found[number] = _read_entry(one._replace(shape="value"), table, key.format(number))
            continue
        inner, lacking = _read_fields(one.kinds[0], table, key.format(number))
        if lacking:
            return {}
        found[number] = one.kinds[0](**inner)
    return found


def _read_entry(one: Entry, table: TomlTable, key: str) -> Any:
    if one.shape == "records":
        return tuple(read_record(one.kinds[0], row) for row in table.tables(key))
    if one.shape in ("rows", "pairs"):
        rows = _read_rows(one, table, key)
        return rows if one.shape == "rows" else dict(rows)
    (kind,), (limits,) = one.kinds, one.limits
    low, high = limits or (-math.inf, math.inf)
    if one.shape == "table":
        inner = table.table(key)
        return {name: inner.number(name, low, high) for name in inner.values}
    if kind is int:
        return table.integer(key, int(low), int(high))
    if kind is str and isinstance(table.values[key], date | int | float):
        return str(table.values[key])  # a day or a number that a person wrote without quotes
    return table.number(key, low, high) if kind is float else table.get(key, kind)


def _read_rows(one: Entry, table: TomlTable, key: str) -> Any:
    where, rows, single = f"{table.where}: {key}", table.values[key], len(one.kinds) == 1
    if isinstance(rows, list) and single:
        rows = [[value] for value in rows]
    if not isinstance(rows, list) or not all(isinstance(row, list) and len(row) == len(one.kinds) for row in rows):
        raise ConfigError(f"{where} must be a list of {one.key.form}, it is {shorten(rows)}")
    if len(rows) > MOST_ROWS:
        raise ConfigError(f"{where} holds {len(rows)} rows, at most {MOST_ROWS} are read")
    read = tuple(
        tuple(
            kind(check_number(value, *(limits or (-math.inf, math.inf)), f"{where} row {number}"))
            for value, kind, limits in zip(row, one.kinds, one.limits, strict=True)
        )
        for number, row in enumerate(rows, 1)
    )
    return tuple(row[0] for row in read) if single else read
