"""Keys of a TOML table as data: the field of an object that a key holds, its limits and its meaning.

System files and calibration files are written and read by the same tables of keys, so that both ways agree.
Before you change one: files of earlier versions must stay readable.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from operator import attrgetter
from typing import Any, NamedTuple

from wavebatch.core.errors import ConfigError
from wavebatch.files.toml_file import REQUIRED, TomlTable, check_number, shorten

MOST_ROWS = 1024
"""Rows of a list in a file: the correlation and the tail of a pulse have fewer than 64."""


class Key(NamedTuple):
    """A number."""

    field: str
    """Of the object; dotted where it is in a part of it, for example "noise.std"."""
    low: float
    high: float
    meaning: str = ""
    optional: bool = False
    """A missing key leaves the field's default."""
    kind: type = float


class Rows(NamedTuple):
    """A list of numbers, or of rows of numbers; empty where it is missing."""

    field: str
    limits: tuple[tuple[float, float], ...]
    """Of each number of a row."""
    form: str
    """Of a row, for messages."""
    meaning: str
    kind: type = float
    optional: bool = False
    """An empty list is left out."""


def describe_keys(found: Any, keys: Mapping[str, Key | Rows]) -> dict[str, Any]:
    """Return the values of an object under the keys of a file; None where a key is to be left out.

    Numbers that are infinite are left out; a mapping of numbers becomes sorted pairs.
    """
    return {key: _describe(attrgetter(entry.field)(found), entry) for key, entry in keys.items()}


def _describe(value: Any, entry: Key | Rows) -> Any:
    if isinstance(entry, Rows):
        rows = sorted(value.items()) if isinstance(value, Mapping) else value
        if not rows and entry.optional:
            return None
        return [entry.kind(row) if len(entry.limits) == 1 else list(map(entry.kind, row)) for row in rows]
    return None if value is None or math.isinf(value) else entry.kind(value)


def read_keys(table: TomlTable, keys: Mapping[str, Key | Rows]) -> dict[str, Any]:
    """Return the values of a table by field, without those of missing optional keys; raises ConfigError."""
    return {
        entry.field: _read(table, key, entry)
        for key, entry in keys.items()
        if key in table.values or isinstance(entry, Key) and not entry.optional
    }


def _read(table: TomlTable, key: str, entry: Key | Rows) -> Any:
    if isinstance(entry, Rows):
        return _read_rows(table, key, entry)
    if entry.kind is int:
        return table.integer(key, int(entry.low), int(entry.high))
    return table.number(key, entry.low, entry.high, REQUIRED, entry.meaning)


def _read_rows(table: TomlTable, key: str, entry: Rows) -> tuple[Any, ...]:
    where, rows, single = f"{table.where}: {key}", table.values[key], len(entry.limits) == 1
    if isinstance(rows, list) and single:
        rows = [[value] for value in rows]
    if not isinstance(rows, list) or not all(isinstance(row, list) and len(row) == len(entry.limits) for row in rows):
        raise ConfigError(f"{where} must be a list of {entry.form}, it is {shorten(rows)}")
    if len(rows) > MOST_ROWS:
        raise ConfigError(f"{where} holds {len(rows)} rows, at most {MOST_ROWS} are read")
    read = (
        tuple(
            entry.kind(check_number(value, *pair, f"{where} row {number}"))
            for value, pair in zip(row, entry.limits, strict=True)
        )
        for number, row in enumerate(rows, 1)
    )
    return tuple(row[0] for row in read) if single else tuple(read)
