"""TOML documents of plain data: one writer, one bounded reader, and checks of typed keys with clear messages.

Chain files, calibration files and system files are read and written through this module.
Before you change the writer: files that it wrote earlier must stay readable, and equal data must give equal bytes.
"""

from __future__ import annotations

import datetime
import json
import math
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from wavebatch.core.errors import ConfigError
from wavebatch.core.suggest import nearest

LARGEST_INTEGER = 1 << 53
"""Largest integer that is taken for a number: a float64 holds all integers up to here exactly."""

REQUIRED: Any = object()
"""Default of a key that must be there."""

MOST_NESTED = 64
"""Tables and lists in each other; files of wavebatch have 4. tomllib takes 40 kB of memory per level of a key."""

MOST_DIGITS = 4000
"""Decimal digits of a number; Python refuses to read integers of more than 4300."""

_PART = r"(?:[A-Za-z0-9_-]++|\"[^\"\n]*+\"|'[^'\n]*+')"
_DEEP_KEY = re.compile(rf"(?<![A-Za-z0-9_-])(?:{_PART}[ \t]*+\.[ \t]*+){{{MOST_NESTED}}}")
_DEEP_VALUE = re.compile(rf"(?:[\[{{][^\[\]{{}}\"'#]*+){{{8 * MOST_NESTED}}}")
_LONG_NUMBER = re.compile(rf"(?<![A-Za-z0-9_.\"'-])[+-]?[0-9][0-9_]{{{MOST_DIGITS},}}")

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
_WORDS = {int: "an integer", float: "a number", bool: "true or false", str: "a string", dict: "a table"}


def format_toml(document: Mapping[str, Any], *, heading: str = "", comments: Mapping[str, str] | None = None) -> str:
    """Return the TOML text of a document of plain data; `tomllib.loads` gives the same data again.

    Parameters
    ----------
    document : mapping
        str, bool, int, float (NaN and infinities too), dates, lists and mappings of these; NumPy scalars too.
        A key with the value None is left out. A list of mappings becomes an array of tables.
    heading : str
        Comment on the first line.
    comments : mapping of str to str
        Comments by dotted key, for example "system.kappa"; an empty one is none. A comment stands after a plain
        value, and on the line above an array or a table. All tables of an array share their comments.

    Raises
    ------
    TypeError
        Where a value is of another type, or None stands in a list.
    """
    lines = [f"# {_one_line(heading)}"] if heading else []
    lines += _format_table(document, "", comments or {})
    return "\n".join(lines) + "\n"


def format_toml_value(value: Any) -> str:
    """Return the value as it stands in TOML, on one line; raises TypeError for a type that TOML does not have."""
    value = value.item() if hasattr(value, "dtype") else value
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, str):
        # JSON's escapes are TOML's too, except DEL, which JSON keeps. Other characters are written as they are:
        # JSON would escape those above U+FFFF as two surrogates, which TOML forbids. Bytes of a file name that are
        # no text are lone surrogates in Python; UTF-8 cannot hold them, so they become question marks.
        text = json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
        return text.encode(errors="replace").decode()
    if isinstance(value, datetime.date | datetime.time):
        return value.isoformat()
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(format_toml_value, value)) + "]"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_format_key(key)} = {format_toml_value(item)}" for key, item in _present(value)) + "}"
    raise TypeError(f"TOML cannot hold {shorten(value)} of type {type(value).__name__}")


def _format_table(table: Mapping[str, Any], prefix: str, comments: Mapping[str, str]) -> Iterator[str]:
    """Lines of one table: plain values first, because TOML counts all keys below a header to that header."""
    nested = []
    for key, value in _present(table):
        path = prefix + _format_key(key)
        is_tables = isinstance(value, list | tuple) and value and all(isinstance(item, Mapping) for item in value)
        if isinstance(value, Mapping) or is_tables:
            nested.append((path, value, is_tables))
            continue
        comment = _one_line(comments.get(path, ""))
        line = f"{_format_key(key)} = {format_toml_value(value)}"
        if comment and isinstance(value, list | tuple):
            yield f"# {comment}"
        yield f"{line}  # {comment}" if comment and not isinstance(value, list | tuple) else line
    for path, value, is_tables in nested:
        for item in value if is_tables else [value]:
            yield ""
            if comment := _one_line(comments.get(path, "")):
                yield f"# {comment}"
            yield f"[[{path}]]" if is_tables else f"[{path}]"
            yield from _format_table(item, f"{path}.", comments)


def _present(table: Mapping[str, Any]) -> list[tuple[str, Any]]:
    return [(key, value) for key, value in table.items() if value is not None]


def _format_key(key: str) -> str:
    return key if _BARE_KEY.fullmatch(key) else format_toml_value(key)


def _one_line(text: str) -> str:
    return " ".join(text.split())


def parse_toml(text: str, name: str) -> TomlTable:
    """Return the document that TOML text describes, as a table with checks; `name` starts every message.

    Raises ConfigError where the text is not TOML, is nested too deep, or has a number of too many digits.
    """
    if _DEEP_KEY.search(text) or _DEEP_VALUE.search(text):
        raise ConfigError(f"{name}: keys or values are nested more than {MOST_NESTED} deep")
    if _LONG_NUMBER.search(text):
        raise ConfigError(f"{name}: a number has more than {MOST_DIGITS} digits")
    try:
        document = tomllib.loads(text)
        if _is_deep(document):
            raise RecursionError
    except RecursionError as error:
        raise ConfigError(f"{name}: keys or values are nested more than {MOST_NESTED} deep") from error
    except ValueError as error:
        raise ConfigError(f"{name}: not valid TOML: {_one_line(str(error))}") from error
    return TomlTable(document, name)


def _is_deep(document: dict[str, Any]) -> bool:
    level: list[Any] = [document]
    for _ in range(MOST_NESTED):
        tables = [value.values() if isinstance(value, dict) else value for value in level]
        level = [item for items in tables for item in items if isinstance(item, dict | list)]
    return bool(level)


KINDS = {"chain": "a chain file", "system": "a survey", "calibration": "a calibration"}
"""TOML files of wavebatch, by the option that takes them."""


@dataclass(frozen=True, slots=True)
class TomlTable:
    """A table of a TOML file with checks; each check raises ConfigError with file, table, key and remedy."""

    values: Mapping[str, Any]
    """Keys and values as tomllib read them."""
    where: str
    """Start of every message: the file and the table, for example "a.toml: [system]"."""

    def check_kind(self, kind: str) -> None:
        """Raise ConfigError where the document is another of wavebatch's files, with the option that takes it."""
        schema = self.values.get("schema")
        found = schema.removeprefix("wavebatch.").split("/")[0] if isinstance(schema, str) else ""
        if not schema and isinstance(self.values.get("chain"), list):
            found = "chain"
        if found in KINDS and found != kind:
            raise ConfigError(f"{self.where}: this is {KINDS[found]}, not {KINDS[kind]}: give it as --{found}")

    def check_keys(self, known: Iterable[str], needed: Iterable[str] = (), remedy: str = "") -> None:
        """Raise ConfigError for a key that is not known, with the nearest known one, and for a needed one not there."""
        known = list(known)
        for key in self.values:
            if key not in known:
                raise ConfigError(f"{self.where}: unknown key {shorten(key)}; {nearest(key, known)}")
        for key in needed:
            if key not in self.values:
                raise ConfigError(f"{self.where}: key {key!r} is missing" + (f"; {remedy}" if remedy else ""))

    def check_schema(self, schema: str, remedy: str = "") -> None:
        """Raise ConfigError where the key `schema` does not name this schema."""
        found = self.values.get("schema")
        if found != schema:
            message = f"{self.where}: schema is {shorten(found)}, this version reads {schema!r}"
            raise ConfigError(message + (f"; {remedy}" if remedy else ""))

    def get(self, key: str, kind: type, default: Any = REQUIRED) -> Any:
        """Return the value of a key, which must be of this type: str, bool, int, float or dict."""
        if key not in self.values:
            return self._default(key, default)
        return check_type(self.values[key], (kind,), f"{self.where}: {key}")

    def number(
        self, key: str, low: float = -math.inf, high: float = math.inf, default: Any = REQUIRED, meaning: str = ""
    ) -> float:
        """Return a finite number from low to high; `meaning` explains the key where it is missing."""
        if key not in self.values:
            return self._default(key, default, meaning)
        return check_number(self.values[key], low, high, f"{self.where}: {key}")

    def integer(self, key: str, low: int, high: int, default: Any = REQUIRED) -> int:
        """Return an integer from low to high."""
        value = self.get(key, int, default)
        if key in self.values:
            check_range(value, low, high, f"{self.where}: {key}")
        return value

    def table(self, key: str, default: Any = REQUIRED) -> TomlTable:
        """Return the table of this key."""
        return TomlTable(self.get(key, dict, default), f"{self.where}: [{key}]")

    def tables(self, key: str, header: str = "") -> list[TomlTable]:
        """Return the array of tables of this key, empty where it is missing; `header` is its full dotted name."""
        rows = self.values.get(key, [])
        header = f"[[{header or key}]]"
        if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
            raise ConfigError(f"{self.where}: {key} must be written as {header} tables")
        return [TomlTable(row, f"{self.where}: [[{key}]] {number}") for number, row in enumerate(rows, 1)]

    def _default(self, key: str, default: Any, meaning: str = "") -> Any:
        if default is REQUIRED:
            raise ConfigError(f"{self.where}: key {key!r} is missing" + (f": {meaning}" if meaning else ""))
        return default


def check_type(value: Any, kinds: Sequence[type], where: str) -> Any:
    """Return the value in one of these types; an integer is taken for a number, nothing else is converted.

    `where` starts the message: file, table and key. Raises ConfigError for another type and for NaN and infinities.
    """
    converted = value
    if type(value) is int and float in kinds and int not in kinds:
        converted = float(value) if abs(value) <= LARGEST_INTEGER else math.inf
    elif type(value) not in kinds:
        words = " or ".join(_WORDS[kind] for kind in kinds if kind in _WORDS)
        raise ConfigError(f"{where} must be {words}, it is {shorten(value)}")
    if isinstance(converted, float) and not math.isfinite(converted):
        raise ConfigError(f"{where} must be a finite number, it is {shorten(value)}")
    return converted


def check_range(value: float, low: float, high: float, where: str) -> None:
    """Raise ConfigError where a number does not lie from low to high."""
    if not low <= value <= high:
        raise ConfigError(f"{where} must lie between {low:g} and {high:g}, it is {shorten(value)}")


def check_number(value: Any, low: float, high: float, where: str) -> float:
    """Return a finite number from low to high as a float; raises ConfigError for anything else."""
    number = check_type(value, (float,), where)
    check_range(number, low, high, where)
    return number


def shorten(value: Any, limit: int = 60) -> str:
    """Return the value as it is shown in messages: on one line, at most `limit` characters."""
    try:
        text = _one_line(repr(value))
    except ValueError:  # Python prints no integer of more than 4300 digits; a hexadecimal one can be read
        return "a very large number"
    return text if len(text) <= limit else text[: limit - 3] + "..."
