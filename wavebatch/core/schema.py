"""Types, choices and ranges from annotations: a signature is a schema.

`stages.chain` reads the parameters of stages with it, `batch.options` the options of a run.
"""

from __future__ import annotations

import types
import typing
from typing import Any, NamedTuple


class Range(NamedTuple):
    """Least and largest value of a number, as in `threshold: Annotated[float, Range(0, 1e6)] = 4.0`."""

    low: float
    high: float


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
