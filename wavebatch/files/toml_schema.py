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
from typing import Any, NamedTuple, TypeVar, get_args, get_origin, get_type_hints

from wavebatch.core.errors import ConfigError
from wavebatch.core.schema import Key, Range
from wavebatch.files.toml_file import TomlTable, check_number, shorten

MOST_ROWS = 1024
"""Rows of a list in a file: the correlation and the tail of a pulse have fewer than 64."""

_Record = TypeVar("_Record")
_EVERY = Range(-math.inf, math.inf)


class Entry(NamedTuple):
    """A field that stands in a file."""

    field: str
    shape: str
    """`value`, `rows`, `pairs` (rows of a mapping), `table` (numbers by name), `record` (its keys stand in the table of
    its owner), `records` (an array of tables), or `numbered` (a key for each number of a mapping).
    """
    kinds: tuple[type, ...]
    """Of the value or record, or of each number of a row."""
    limits: tuple[Range, ...]
    key: Key
    needed: bool
    optional: bool
    """Whether the field may be None."""


@functools.cache
def list_entries(kind: Any) -> tuple[Entry, ...]:
    """List the fields of a dataclass that have a Key."""
    hints, found = get_type_hints(kind, include_extras=True), []
    for one in dataclasses.fields(kind):
        hint, notes = _split(hints[one.name])
        if not (keys := [note for note in notes if isinstance(note, Key)]):
            continue
        optional = get_origin(hint) in (types.UnionType, typing.Union)
        hint = next(part for part in get_args(hint) if part is not type(None)) if optional else hint
        shape, parts = _read_shape(hint, keys[0])
        split = [(hint, notes)] if shape == "value" else list(map(_split, parts))
        limits = tuple(next((note for note in more if isinstance(note, Range)), _EVERY) for _, more in split)
        key = keys[0] if shape == "record" else keys[0]._replace(name=keys[0].name or one.name)
        has_none = one.default is one.default_factory is dataclasses.MISSING and key.missing is None
        kinds = tuple(part for part, _ in split)
        found.append(Entry(one.name, shape, kinds, limits, key, key.needed or has_none, optional))
    return tuple(found)


def _split(hint: Any) -> tuple[Any, tuple[Any, ...]]:
    """A type, and the notes of its annotation."""
    if get_origin(hint) is not typing.Annotated:
        return hint, ()
    kind, *notes = get_args(hint)
    return kind, tuple(notes)


def _read_shape(hint: Any, key: Key) -> tuple[str, tuple[Any, ...]]:
    """Shape of a field, and the types of its parts."""
    inner = get_args(hint)
    if get_origin(hint) is tuple:
        shape = "records" if dataclasses.is_dataclass(inner[0]) else "rows"
        return shape, get_args(inner[0]) if get_origin(inner[0]) is tuple else inner[:1]
    if get_origin(hint) is Mapping:
        shape = "numbered" if "{}" in key.name else "table" if inner[0] is str else "pairs"
        return shape, inner if shape == "pairs" else inner[1:]
    return "record" if dataclasses.is_dataclass(hint) else "value", (hint,)


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
    kind: Any = type(value)
    for one in list_entries(kind):
        part, key = getattr(value, one.field), one.key.name
        if one.shape == "record":
            for name, item in ({} if part is None else describe_record(part)).items():
                (lists if isinstance(item, list) else tables if isinstance(item, dict) else values)[key + name] = item
        elif one.shape == "numbered":
            for number, item in part.items():
                inner = describe_record(item) if dataclasses.is_dataclass(one.kinds[0]) else {"": one.kinds[0](item)}
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
        A dataclass.
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
    is_record, pattern = dataclasses.is_dataclass(one.kinds[0]), re.escape(key).replace(r"\{\}", "([0-9]{1,3})")
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
    (kind,), ((low, high),) = one.kinds, one.limits
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
        tuple(kind(check_number(value, *limits, f"{where} row {number}"))
              for value, kind, limits in zip(row, one.kinds, one.limits, strict=True))
        for number, row in enumerate(rows, 1)
    )  # fmt: skip
    return tuple(row[0] for row in read) if single else read
