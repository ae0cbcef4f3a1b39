"""Types, choices, ranges and keys from annotations: options and files are declared once, as fields of a dataclass.

A signature is a schema: `stages.chain` reads the parameters of stages with it. A field made by `option` has the default
and the help of an option too: `cli.options` makes click's options of them; Python fills the dataclass itself.
"""

from __future__ import annotations

import functools
import numbers
import os
import sys
import types
import typing
from dataclasses import field, fields
from pathlib import Path
from typing import Any

from wavebatch.core.errors import ConfigError
from wavebatch.core.frozen import NamedTuple, frozen


class Range(NamedTuple):
    """Least and largest value of a number, as in `threshold: Annotated[float, Range(0, 1e6)] = 4.0`."""

    low: float
    high: float

    def hold(self, value: float) -> bool:
        """Whether a value lies in it; NaN does not."""
        return self.low <= value <= self.high

    def __str__(self) -> str:
        return f"from {self.low:g} to {self.high:g}"


class Above(Range):
    """A range without its least value."""

    # Early versions of Python 3.11 keep one `Annotated[float, limits]` of equal limits, and tuples of one content are.
    __hash__ = Range.__hash__

    def __eq__(self, other: object) -> bool:
        return type(other) is Above and tuple.__eq__(self, other)

    def __ne__(self, other: object) -> bool:
        return not self == other

    def hold(self, value: float) -> bool:
        """Whether a value lies in it; NaN does not."""
        return self.low < value <= self.high

    def __str__(self) -> str:
        return f"above {self.low:g}, up to {self.high:g}"


class Key(NamedTuple):
    """How a field of a dataclass stands in files and reports: `files.toml_file` writes and reads them."""

    name: str = ""
    """With the unit; empty: the name of the field. `{}` in it stands for the number of each item of a mapping. Of a
    field that is itself a record: what its keys begin with."""
    meaning: str = ""
    """A comment in the file."""
    needed: bool = False
    """A file without it is refused, although the field has a default."""
    blank: bool = False
    """An empty list is written too."""
    missing: Any = None
    """The value where a file lacks the key, for a field without a default."""
    form: str = "numbers"
    """What a list holds, for messages, e.g. `[lag, share]`."""
    averaged: bool = False
    """Of several digitizers the mean by their waveforms is taken."""
    shown: str = ""
    """Its line in the text of a result, where it is known: name, colon, and words with the value as `{}`."""


def read_hint(hint: Any) -> tuple[tuple[type, ...], tuple[Any, ...] | None, Range | None]:
    """Return types, choices and range that an annotation allows.

    Parameters
    ----------
    hint : annotation
        A type, Literal, Union or Annotated with a Range.

    Returns
    -------
    types : tuple of type
    choices : tuple or None
        Of Literal.
    range : Range or None
    """
    if typing.get_origin(hint) is typing.Annotated:
        hint, *notes = typing.get_args(hint)
        limits = next((note for note in notes if isinstance(note, Range)), None)
        return (*read_hint(hint)[:2], limits)
    if typing.get_origin(hint) is typing.Literal:
        choices = typing.get_args(hint)
        return tuple({type(choice) for choice in choices}), choices, None
    if typing.get_origin(hint) in (types.UnionType, typing.Union):
        kinds, choices, limits = zip(*map(read_hint, typing.get_args(hint)), strict=True)
        chosen = next((choice for choice in choices if choice is not None), None)
        return sum(kinds, ()), chosen, next((limit for limit in limits if limit is not None), None)
    return (hint,), None, None


_LATE = {name: type(name, (), {}) for name in ("Chain", "Condition", "Survey")}
"""Stand for types that only Python gives, which are known by their names: they take time to import."""


def evaluate_hints(kind: type) -> dict[str, Any]:
    """Annotations of a dataclass, as `typing.get_type_hints` gives them, which compiles each of them apart."""
    found: dict[str, Any] = {}
    for base in reversed(kind.__mro__):
        hints, known = vars(base).get("__annotations__", {}), vars(sys.modules[base.__module__])
        texts = [hint if isinstance(hint, str) else f"hints[{name!r}]" for name, hint in hints.items()]
        values = eval(f"({''.join(f'{text}, ' for text in texts)})", known, {**_LATE, "hints": hints})
        found |= dict(zip(hints, values, strict=True))
    return found


@frozen
class Option:
    """What the documentation says about an option."""

    help: str
    group: str = ""
    """Its heading in the help of a long command."""
    form: str = ""
    """What its value looks like, or its unit: `METAVAR` of --help."""
    unset: str = ""
    """The default in words, where a value does not say it."""
    short: str = ""
    """A letter for the command line."""
    usual: bool = False
    """Whether most users need it; --help of a long command begins with these."""
    name: str = ""
    """Its name on the command line, if not that of the field."""
    opposite: str = ""
    """Name of the flag that says no, if there is one."""


def option(default: Any, text: str, group: str = "", form: str = "", **more: Any) -> Any:
    """A field that is an option; text: its help, which calls other options as the command does; more: of Option."""
    return field(default=default, metadata={"option": Option(text, group, form, **more)})


class Declared(NamedTuple):
    """An option with what its annotation says."""

    default: Any
    words: Option
    kinds: tuple[type, ...]
    choices: tuple[Any, ...] | None
    limits: Range | None


@functools.cache
def declared_options(kind: type) -> dict[str, Declared]:
    """The options of a dataclass by the names of their fields."""
    hints = evaluate_hints(kind)
    declared = {one.name: one for one in fields(kind) if "option" in one.metadata}
    return {
        name: Declared(one.default, one.metadata["option"], *read_hint(hints[name])) for name, one in declared.items()
    }


def typed(name: str) -> str:
    """An option as it is typed."""
    return f"--{name.replace('_', '-')}"


_FORMS: dict[type, tuple[type | tuple[type, ...], str]] = {
    bool: (bool, "True or False"), int: (numbers.Integral, "a whole number"), float: (numbers.Real, "a number"),
    str: (str, "text"), Path: (os.PathLike, "a path"), tuple: ((tuple, list), "a tuple"),
    type(None): (type(None), "None"),
}  # fmt: skip
"""What Python may give for an option of a type, and its name in messages."""


def check_options(options: Any) -> None:
    """Raise ConfigError for an option that is of another type, none of its choices, or outside of its range.

    The parts of a tuple have one type.
    """
    for name, one in declared_options(options.__class__).items():
        value, place = getattr(options, name), typed(one.words.name or name)
        if value is None and type(None) in one.kinds:
            continue
        if hasattr(value, "tolist"):  # of NumPy: reports are JSON
            value = value.tolist()
            object.__setattr__(options, name, value)
        if value == "" and Path in one.kinds:  # pathlib takes it for the current folder
            raise ConfigError(f"{place}: the name is empty")
        if one.choices is not None and value not in one.choices:
            raise ConfigError(f"{place} {value!r}: choose {', '.join(map(str, one.choices))}")
        forms = [_FORMS.get(typing.get_origin(kind) or kind, (kind, kind.__name__)) for kind in one.kinds]
        if not any(isinstance(value, form) or type(value).__name__ == word for form, word in forms):
            raise ConfigError(f"{place} {value!r:.40}: must be {' or '.join(dict.fromkeys(word for _, word in forms))}")
        for form, word in [_FORMS[typing.get_args(kind)[0]] for kind in one.kinds if typing.get_origin(kind) is tuple]:
            if wrong := [part for part in value if not isinstance(part, form)]:
                raise ConfigError(f"{place} {value!r:.40}: {wrong[0]!r:.20} must be {word}")
        if one.limits is not None and not one.limits.hold(value):
            raise ConfigError(f"{place} {value!s:.20}: must lie {one.limits}")


class CheckedOptions:
    """Base of frozen options that are checked when they are made."""

    __slots__ = ()

    def __post_init__(self) -> None:
        check_options(self)
