"""Conditions on columns, such as `number_of_returns == 2 and echo_width < 8`: the grammar of --where.

`run`, `plot`, `stats`, `compare` and `voxelize` read the text with `parse_condition`; whoever has the points calls
`Condition.choose` with their columns. Nothing is ever evaluated as Python, so a text from anywhere is harmless.
Before you change it: a point without data in a column meets no comparison with it, and no negated one either.
"""

from __future__ import annotations

import functools
import operator
import re
from collections.abc import Callable, Mapping, Sequence
from typing import NoReturn

import numpy as np

from wavebatch.core.echoes import EchoFlag
from wavebatch.core.errors import ConfigError, nearest
from wavebatch.core.frozen import frozen

MOST_CHARACTERS = 2000
"""Longest text; longer ones are made by programs, and would be slow on every point."""

MOST_NESTED = 50
"""Most parentheses and `not` inside each other; Python's own stack ends at about 1000 calls."""

_COMPARISONS: dict[str, Callable[[np.ndarray, np.ndarray], np.ndarray]] = {
    "==": operator.eq, "!=": operator.ne, "<=": operator.le, ">=": operator.ge, "<": operator.lt, ">": operator.gt,
}  # fmt: skip
_WORDS = ("and", "or", "not")
_FOREIGN = {"=": "==", "&": "and", "&&": "and", "|": "or", "||": "or", "!": "not", "<>": "!=", "~": "not"}
"""What other languages write, and what is meant here."""

_TOKEN = r"""(?x)\s*(?:
    (?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?(?![\w.]))
    |(?P<name>[^\W\d]\w*)
    |(?P<quoted>`[^`]+`|"[^"]+"|'[^']+')
    |(?P<sign>==|!=|<=|>=|<>|&&|\|\||[-+<>()=&|!~])
    |(?P<end>$)
    )"""

Truth = tuple[np.ndarray, np.ndarray]
"""Points for which a part is true, and those for which it is false, bool (n,) each; neither: no data."""


@frozen
class Condition:
    """A condition on the columns of points; picklable.

    Parameters
    ----------
    text : str
        As the user wrote it.
    tree : tuple
        Nested: ("and" | "or", left, right), ("not", part) or (comparison, left, right), whose sides are a number or
        the name of a column; ("has", column, bit) for a flag.
    places : dict of str to int
        Every column with the character, from 1, at which it is first named.
    """

    text: str
    tree: tuple
    places: dict[str, int]

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns, as the user wrote them, in their order."""
        return tuple(self.places)

    def choose(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """Find the points that meet the condition.

        Parameters
        ----------
        values : mapping of str to array (n,)
            For each of `columns`; NaN is no data.

        Returns
        -------
        bool (n,)
            False where a value that decides has no data.
        """
        n = len(next(iter(values.values())))
        return _evaluate(self.tree, values, n)[0]

    def complain(self, column: str, reason: str) -> ConfigError:
        """Return the error about one of its columns, with its place."""
        return ConfigError(f"--where: character {self.places[column]}: {reason}")


def parse_condition(text: str) -> Condition:
    """Read a condition.

    Parameters
    ----------
    text : str
        Comparisons (== != < <= > >=) of columns and numbers, `and`, `or`, `not` and parentheses; `2 < x < 5` is both
        comparisons. `flag(NAME)` or `echo_flags has NAME` is true for points with that flag. Names with spaces or signs
        stand in quotes.

    Returns
    -------
    Condition

    Raises
    ------
    ConfigError
        Where the text is no condition, with the place.
    """
    if len(text) > MOST_CHARACTERS:
        raise ConfigError(f"--where: has {len(text)} characters; at most {MOST_CHARACTERS} are read")
    parser = _Parser(text)
    tree = parser.read_all()
    if not parser.places:
        raise ConfigError(f"--where: {text!r} names no column; write for example classification == 2")
    return Condition(text, tree, parser.places)


class _Parser:
    """Recursive descent, one method per level: or, and, not, comparison, operand."""

    def __init__(self, text: str) -> None:
        self.places: dict[str, int] = {}
        self._text, self._at, self._depth = text, 0, 0
        self._advance()

    def read_all(self) -> tuple:
        """The whole text as a tree."""
        tree = self._read_terms("or")
        if self._kind != "end":
            ends = self._value == ")"
            self._fail("the condition ends here, before" if ends else "`and`, `or` or the end is missing before")
        return tree

    def _advance(self) -> None:
        found = re.compile(_TOKEN).match(self._text, self._at)
        if found is None:
            rest = self._text[self._at :]
            self._place = self._at + len(rest) - len(rest.lstrip()) + 1
            self._kind, self._value = "", rest.split()[0][:20]
            self._fail("is neither a column, a number nor a comparison:")
        self._kind = found.lastgroup or ""
        self._value = found[self._kind]
        self._place = found.start(self._kind) + 1
        self._at = found.end()
        if self._kind == "name" and self._value.lower() in _WORDS:
            self._kind, self._value = "word", self._value.lower()
        if self._value in _FOREIGN and self._kind == "sign":
            self._fail(f"write {_FOREIGN[self._value]} for")

    def _fail(self, reason: str) -> NoReturn:
        what = "the end" if self._kind == "end" else repr(self._value)
        raise ConfigError(f"--where: character {self._place}: {reason} {what}")

    def _read_terms(self, word: str) -> tuple:
        """Terms with `word`, or or and, between them."""
        read = functools.partial(self._read_terms, "and") if word == "or" else self._read_not
        tree = read()
        while (self._kind, self._value) == ("word", word):
            self._advance()
            tree = (word, tree, read())
        return tree

    def _read_not(self) -> tuple:
        negated, opened = (self._kind, self._value) == ("word", "not"), self._value == "(" and self._kind == "sign"
        if not (negated or opened):
            return self._read_comparison()
        self._depth += 1
        if self._depth > MOST_NESTED:
            self._fail(f"more than {MOST_NESTED} parentheses or `not` inside each other at")
        self._advance()
        tree = ("not", self._read_not()) if negated else self._read_terms("or")
        if opened:
            if (self._kind, self._value) != ("sign", ")"):
                self._fail("a closing parenthesis is missing before")
            self._advance()
        self._depth -= 1
        return tree

    def _read_comparison(self) -> tuple:
        if (self._kind, self._value) == ("name", "flag") and self._text[self._at :].lstrip().startswith("("):
            # `flag(NAME)` is `echo_flags has NAME`.
            self.places.setdefault("echo_flags", self._place)
            self._advance()
            self._advance()
            found = ("has", "echo_flags", self._read_bits())
            if (self._kind, self._value) != ("sign", ")"):
                self._fail("a closing parenthesis is missing before")
            self._advance()
            return found
        tree: tuple | None = None
        left = self._read_operand()
        if (self._kind, self._value) == ("name", "has") and isinstance(left, str):
            self._advance()
            return ("has", left, self._read_bits())
        if self._kind != "sign" or self._value not in _COMPARISONS:
            self._fail("a comparison (== != < <= > >=) is missing before")
        while self._kind == "sign" and self._value in _COMPARISONS:
            sign = self._value
            self._advance()
            right = self._read_operand()
            part = (sign, left, right)
            tree, left = part if tree is None else ("and", tree, part), right
        return tree or ()

    def _read_bits(self) -> float:
        """The bit of a flag by its name."""
        if self._kind != "name":
            self._fail("the name of a flag is missing before")
        bits = read_flags([self._value], f"--where: character {self._place}")
        self._advance()
        return float(bits)

    def _read_operand(self) -> float | str:
        factor = 1.0
        if self._kind == "sign" and self._value in "+-":
            factor = -1.0 if self._value == "-" else 1.0
            self._advance()
            if self._kind != "number":
                self._fail("a number is missing before")
        value, kind, place = self._value, self._kind, self._place
        if kind not in ("number", "name", "quoted"):
            self._fail("a column or a number is missing before")
        if kind == "number" and not np.isfinite(float(value)):
            self._fail("too large a number:")
        self._advance()
        if kind == "number":
            return factor * float(value)
        name = value[1:-1] if kind == "quoted" else value
        self.places.setdefault(name, place)
        return name


def _evaluate(tree: tuple, values: Mapping[str, np.ndarray], n: int) -> Truth:
    """Logic with three values, as in SQL: what is not known stays so when it is negated.

    A chain of `and` or `or` leans to the left and may be as long as the text, so it is walked, not descended.
    """
    if tree[0] == "not":
        true, false = _evaluate(tree[1], values, n)
        return false, true
    if tree[0] not in ("and", "or"):
        sign, *names = tree
        left, right = (
            np.asarray(values[side] if isinstance(side, str) else side, np.float64) for side in names
        )
        if sign == "has":
            known = ~np.isnan(left)
            met = (np.where(known, left, 0).astype(np.int64) & int(right)) != 0
            return known & met, known & ~met
        known = np.broadcast_to(~(np.isnan(left) | np.isnan(right)), n)
        met = np.broadcast_to(_COMPARISONS[sign](left, right), n)
        return known & met, known & ~met
    word, parts = tree[0], []
    while tree[0] == word:
        parts.append(tree[2])
        tree = tree[1]
    true, false = _evaluate(tree, values, n)
    for part in reversed(parts):
        more, less = _evaluate(part, values, n)
        true, false = (true & more, false | less) if word == "and" else (true | more, false & less)
    return true, false


def read_flags(names: Sequence[str], option: str = "") -> int:
    """Return the bits of flags given by names.

    Parameters
    ----------
    names : sequence of str
        Each one name, or several separated by commas; in any case of letters.
    option : str, optional
        For the message, e.g. "--drop-flags".

    Returns
    -------
    int

    Raises
    ------
    ConfigError
        For an unknown name.
    """
    bits = 0
    for name in (part.strip().upper() for text in names for part in text.split(",")):
        if name not in EchoFlag.__members__:
            where = f"{option}: " if option else ""
            raise ConfigError(f"{where}flag {name!r} does not exist; {nearest(name, EchoFlag.__members__)}")
        bits |= int(EchoFlag[name])
    return bits
