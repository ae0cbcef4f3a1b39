"""Classes of named fields that cost nothing to make: frozen ones, most types of the package, a few that change, tuples.

`dataclass` writes and compiles up to six methods for every class, and `typing.NamedTuple` a method and each annotation.
For the 150 classes of a small run that took a sixth of its processor time. The classes made here share their methods,
which look at the fields when they are called: an object takes up to two microseconds more.
"""

from __future__ import annotations

import collections
import functools
import inspect
import operator
from collections.abc import Callable
from dataclasses import MISSING, FrozenInstanceError, dataclass, field, fields
from typing import TYPE_CHECKING, Any, TypeVar, dataclass_transform, overload

T = TypeVar("T")


@overload
def frozen(kind: type[T], /) -> type[T]: ...
@overload
def frozen(*, eq: bool = True, order: bool = False) -> Callable[[type[T]], type[T]]: ...
@dataclass_transform(frozen_default=True, field_specifiers=(field,))
def frozen(kind: type | None = None, /, *, eq: bool = True, order: bool = False) -> Any:
    """Make a frozen dataclass with slots; `fields`, `replace`, `asdict`, pickling and copying work as for any other.

    Parameters
    ----------
    kind : type
        The class; methods that it or its bases have are kept.
    eq : bool
        Objects with equal values are equal. False, for fields that are arrays: an object equals only itself.
    order : bool
        Objects are sorted by their values.

    Returns
    -------
    type, or the decorator of the class
    """
    if kind is None:
        return functools.partial(frozen, eq=eq, order=order)
    bases = [vars(base)["__dataclass_params__"] for base in kind.__mro__[1:] if "__dataclass_params__" in vars(base)]
    bases = [base for base in bases if base.frozen]
    for base in bases:
        base.frozen = False  # else `dataclass` refuses a class that is not frozen, or writes methods into a frozen one
    made = _make(kind, {**_METHODS, **_FROZEN, **(_EQUALITY if eq else {}), **(_ORDER if order else {})})
    for one in (*bases, made.__dataclass_params__):
        one.frozen = True
    if len(fields(made)) < len(made.__dataclass_fields__) or not all(one.init and one.repr for one in fields(made)):
        raise TypeError(f"{kind.__name__} has a ClassVar, an InitVar, or a field without init or repr: use dataclass")
    return made


@dataclass_transform(field_specifiers=(field,))
def changeable(kind: type[T]) -> type[T]:
    """Make a dataclass with slots whose fields may be set: counters of a scan, headers, figures."""
    return _make(kind, {**_METHODS, "__eq__": _EQUALITY["__eq__"], "__hash__": None})


def _make(kind: Any, methods: dict[str, Any]) -> Any:
    """The dataclass of a class, with these methods, except those that it or one of its bases has."""
    for name, method in methods.items():
        if getattr(kind, name, None) is getattr(object, name, None):
            setattr(kind, name, method)
    hints = vars(kind).get("__annotations__", {})
    plain = {name: hint if "Var" in str(hint) or "KW_ONLY" in str(hint) else object for name, hint in hints.items()}
    kind.__annotations__ = plain  # `dataclass` looks for ClassVar and its like in each text by expressions
    made: Any = dataclass(init=False, repr=False, eq=False, slots=True)(kind)
    made.__annotations__ = hints
    for name in hints.keys() & made.__dataclass_fields__.keys():
        made.__dataclass_fields__[name].type = hints[name]
    return made


def _init(self: Any, *values: Any, **named: Any) -> None:
    kind, put = type(self), object.__setattr__
    if values:
        names = kind.__match_args__
        given = dict(zip(names, values, strict=False))
        if len(values) > len(names) or given.keys() & named.keys():
            raise TypeError(f"{kind.__name__} takes {', '.join(names)}, each once")
        named = given | named
    if named.keys() == kind.__dataclass_fields__.keys():  # most objects; it takes half as long
        for name, value in named.items():
            put(self, name, value)
    else:
        for name, one in kind.__dataclass_fields__.items():
            if name in named:
                value = named.pop(name)
            elif one.default_factory is not MISSING:
                value = one.default_factory()
            elif one.default is not MISSING:
                value = one.default
            else:
                raise TypeError(f"{kind.__name__} needs {name}")
            put(self, name, value)
        if named:
            raise TypeError(f"{kind.__name__} has no {', '.join(named)}")
    if hasattr(kind, "__post_init__"):
        self.__post_init__()


_SHOWN = 100
"""Characters of a field that a prompt shows: one long array would hide all other fields."""


def _values(self: Any) -> tuple[Any, ...]:
    return tuple(getattr(self, name) for name, one in self.__dataclass_fields__.items() if one.compare)


def _repr(self: Any) -> str:
    texts = {name: " ".join(repr(getattr(self, name)).split()) for name in self.__dataclass_fields__}
    shown = (f"{name}={text if len(text) <= _SHOWN else text[: _SHOWN - 3] + '...'}" for name, text in texts.items())
    return f"{type(self).__qualname__}({', '.join(shown)})"


def _compare(by: Callable[[Any, Any], bool]) -> Callable[[Any, object], bool]:
    return lambda self, other: by(_values(self), _values(other)) if type(other) is type(self) else NotImplemented


def _refuse(self: Any, name: str, value: object = None) -> None:
    raise FrozenInstanceError(f"{type(self).__name__}.{name} cannot be changed")


class _Signature:
    """What `inspect.signature` and help() show of a class."""

    def __get__(self, one: object, kind: Any) -> inspect.Signature:
        if kind.__init__ is not _init:
            raise AttributeError("__signature__")  # that of its own __init__
        parameters = []
        for name, known in kind.__dataclass_fields__.items():
            where = inspect.Parameter.KEYWORD_ONLY if known.kw_only else inspect.Parameter.POSITIONAL_OR_KEYWORD
            default = inspect.Parameter.empty if known.default is MISSING else known.default
            default = default if known.default_factory is MISSING else ...
            parameters.append(inspect.Parameter(name, where, default=default, annotation=known.type))
        return inspect.Signature(parameters)


def _set_state(self: Any, state: Any) -> None:
    """Fill an object that is copied or unpickled, from what `object` saves: attributes, those in slots, or both."""
    for values in state if isinstance(state, tuple) else (state,):
        for name, value in (values or {}).items():
            object.__setattr__(self, name, value)


_METHODS = {"__init__": _init, "__repr__": _repr, "__setstate__": _set_state, "__signature__": _Signature()}
_FROZEN = {"__setattr__": _refuse, "__delattr__": _refuse}
_EQUALITY = {"__eq__": _compare(operator.eq), "__hash__": lambda self: hash(_values(self))}
_ORDER = {"__lt__": _compare(operator.lt), "__le__": _compare(operator.le)}


if TYPE_CHECKING:
    from typing import NamedTuple as NamedTuple
else:

    class _Named(type):
        def __new__(meta: type, name: str, bases: tuple[type, ...], space: dict[str, Any]) -> type:
            if "__annotations__" in space and not bases[0]._fields:  # a class of one with fields has those of that
                names = tuple(space["__annotations__"])
                defaults = {field: space.pop(field) for field in names if field in space}
                space |= {field: property(operator.itemgetter(at)) for at, field in enumerate(names)}
                space |= {"_fields": names, "__match_args__": names, "_field_defaults": defaults}
            return type.__new__(meta, name, bases, {"__slots__": (), **space})

    class NamedTuple(collections.namedtuple("_NoFields", ()), metaclass=_Named):  # noqa: PYI024
        """As `typing.NamedTuple`, which type checkers take it for."""

        def __new__(cls, *values: Any, **named: Any) -> NamedTuple:
            """Make a tuple of the fields; those that are not given have their defaults."""
            names = cls._fields
            if named or len(values) != len(names):
                given = {**cls._field_defaults, **dict(zip(names, values)), **named}  # noqa: B905
                twice = len(values) > len(names) or values and not named.keys().isdisjoint(names[: len(values)])
                if twice or given.keys() != set(names):
                    raise TypeError(f"{cls.__name__} takes {', '.join(names)}, each once")
                values = map(given.__getitem__, names)
            return tuple.__new__(cls, values)

        def __repr__(self) -> str:
            return f"{type(self).__name__}({', '.join(f'{name}={value!r}' for name, value in self._asdict().items())})"

        _make = classmethod(lambda kind, values: kind(*values))
        _replace = lambda self, **named: type(self)(**self._asdict() | named)  # noqa: E731
