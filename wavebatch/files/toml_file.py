"""TOML documents of plain data: one writer, one bounded reader, checks of typed keys, and a schema for dataclasses.

Chain files, calibration files and system files are read and written through this module. Before you change the writer:
files that it wrote earlier must stay readable, and equal data must give equal bytes.

A field `std: Annotated[float, Range(1e-3, 1e10), Key("noise_std_dn", "noise of one sample")]` is its own key, range and
comment: `describe_record` writes an object as plain values under its keys, `read_record` reads them back, both to the
last bit; reports hold them too. Fields without a Key are not in the file. Before you change a key: files of earlier
versions must stay readable.
"""

from __future__ import annotations

import dataclasses
import datetime
import functools
import json
import math
import re
import tomllib
import types
import typing
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any, TypeVar, get_args, get_origin

from wavebatch.core.errors import ConfigError, nearest
from wavebatch.core.frozen import NamedTuple, frozen
from wavebatch.core.schema import Key, Range, evaluate_hints

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

_SHOWN = 60
"""Characters of a value in a message."""

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
        present = ((_format_key(key), item) for key, item in value.items() if item is not None)
        return "{" + ", ".join(f"{key} = {format_toml_value(item)}" for key, item in present) + "}"
    raise TypeError(f"TOML cannot hold {shorten(value)} of type {type(value).__name__}")


def _format_table(table: Mapping[str, Any], prefix: str, comments: Mapping[str, str]) -> Iterator[str]:
    """Lines of one table: plain values first, because TOML counts all keys below a header to that header."""
    nested = []
    for key, value in table.items():
        if value is None:
            continue
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
        level: list[Any] = [document]
        for _ in range(MOST_NESTED):
            tables = [value.values() if isinstance(value, dict) else value for value in level]
            level = [item for items in tables for item in items if isinstance(item, dict | list)]
        if level:
            raise RecursionError
    except RecursionError as error:
        raise ConfigError(f"{name}: keys or values are nested more than {MOST_NESTED} deep") from error
    except ValueError as error:
        hint = "; a table that stands several times is written [[name]]" if "twice" in str(error) else ""
        raise ConfigError(f"{name}: not valid TOML: {_one_line(str(error))}{hint}") from error
    return TomlTable(document, name)


KINDS = {"chain": "a chain file", "system": "a survey", "calibration": "a calibration"}
"""TOML files of wavebatch, by the option that takes them."""


@frozen
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


def shorten(value: Any) -> str:
    """Return the value as it is shown in messages: on one line, at most _SHOWN characters."""
    try:
        text = _one_line(repr(value))
    except ValueError:  # Python prints no integer of more than 4300 digits; a hexadecimal one can be read
        return "a very large number"
    return text if len(text) <= _SHOWN else text[: _SHOWN - 3] + "..."


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
    hints, found = evaluate_hints(kind), []
    for one in dataclasses.fields(kind):
        hint, notes = _split(hints[one.name])
        if not (keys := [note for note in notes if isinstance(note, Key)]):
            continue
        optional = get_origin(hint) in (types.UnionType, typing.Union)
        hint = next(part for part in get_args(hint) if part is not type(None)) if optional else hint
        inner, parts = get_args(hint), (hint,)
        if get_origin(hint) is tuple:
            shape = "records" if dataclasses.is_dataclass(inner[0]) else "rows"
            parts = get_args(inner[0]) if get_origin(inner[0]) is tuple else inner[:1]
        elif get_origin(hint) is Mapping:
            # The Key of the field stands behind that of a shared annotation.
            shape = "numbered" if "{}" in keys[-1].name else "table" if inner[0] is str else "pairs"
            parts = inner if shape == "pairs" else inner[1:]
        else:
            shape = "record" if dataclasses.is_dataclass(hint) else "value"
        split = [(hint, notes)] if shape == "value" else list(map(_split, parts))
        limits = tuple(next((note for note in more if isinstance(note, Range)), _EVERY) for _, more in split)
        key = keys[-1] if shape == "record" else keys[-1]._replace(name=keys[-1].name or one.name)
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
            rows = sorted(part.items()) if isinstance(part, Mapping) else part
            if one.shape == "records":
                lists[key] = list(map(describe_record, rows))
            elif len(one.kinds) == 1:
                lists[key] = list(map(one.kinds[0], rows))
            else:
                lists[key] = [[kind(number) for kind, number in zip(one.kinds, row, strict=True)] for row in rows]
    return {**values, **tables, **lists}


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
        rows = tuple(row[0] for row in read) if single else read
        return rows if one.shape == "rows" else dict(rows)
    (kind,), ((low, high),) = one.kinds, one.limits
    if one.shape == "table":
        inner = table.table(key)
        return {name: inner.number(name, low, high) for name in inner.values}
    if kind is int:
        return table.integer(key, int(low), int(high))
    if kind is str and isinstance(table.values[key], datetime.date | int | float):
        return str(table.values[key])  # a day or a number that a person wrote without quotes
    return table.number(key, low, high) if kind is float else table.get(key, kind)
