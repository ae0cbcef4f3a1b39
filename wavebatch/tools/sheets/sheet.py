"""A result as a sheet: facts, tables, notes and pictures, from which commands print text and pages are made.

A command makes one sheet of its result. `list_lines` is what it prints, `format_csv` a table as a file, and
`tools.sheets.page` the page of `--html`. Pictures and code are on pages only.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

from wavebatch.core.frozen import NamedTuple

NO_VALUE = "\u2013"
"""Shown on pages where there is no value."""

WIDE, WIDER = 18, 36
"""Columns before the value of a fact, and of an indented one."""


class Fact(NamedTuple):
    """A named value: text, or a number in a form."""

    name: str
    """Names that begin with blanks belong to the fact above."""
    value: Any
    form: str = ""
    """As for `format`."""


class Note(NamedTuple):
    """A sentence; kind `warning` or `problem`: it is printed behind this word, and marked on a page."""

    text: str
    kind: str = ""


class Cell(NamedTuple):
    """A cell of a table with words of its own."""

    text: str
    value: Any = ""
    """By which a page sorts the table."""
    note: str = ""
    """Why the cell is marked; empty: it is not."""
    link: str = ""
    """`mark` of the sheet to which the cell leads."""
    details: Sequence[str] = ()
    """Sentences that a page shows on a click; the cell is marked then."""


class Table(NamedTuple):
    """Rows of text, numbers and cells; nothing is shown of a table without rows."""

    heads: Sequence[str]
    """The first one is also the title where it is printed."""
    rows: Sequence[Sequence[Any]]
    forms: str | Sequence[str] = ".4g"
    """Form of floating-point numbers, or one for each column."""
    title: str = ""
    """On a page, above the heads."""
    shown: int | None = None
    """Most rows that are printed; a page has all."""
    sortable: bool = False
    filtered: bool = False
    """A page has fields that hide rows."""


class Code(NamedTuple):
    """Text of many lines, as it is."""

    text: str


class Picture(NamedTuple):
    """A drawn picture."""

    title: str
    svg: str
    size: tuple[float, float]
    """Width and height [inch]."""
    words: str = ""
    """Below it."""
    kind: str = "figures"
    """`sheet`: it keeps its size; others share a line."""


class Later(NamedTuple):
    """Parts that only a page has, made when it is written; what cannot be read for them becomes a note."""

    draw: Callable[[], Iterable[SheetPart]]
    what: str = "pictures"


class Sheet(NamedTuple):
    """Parts under a title."""

    title: str
    parts: Iterable[SheetPart]
    mark: str = ""
    """Target of links on a page."""


SheetPart = Fact | Note | Table | Code | Picture | Later | Sheet


def list_lines(sheet: Sheet) -> Iterator[str]:
    """The lines that a command prints; inner sheets follow an empty line, without their title."""
    for part in sheet.parts:
        if isinstance(part, Fact):
            wide = WIDER if part.name[:1] == " " else WIDE
            yield f"{part.name:{wide - 1}} {format_value(part.value, part.form, 'no-data')}"
        elif isinstance(part, Note):
            yield f"{part.kind:{WIDE - 1}} {part.text}" if part.kind else part.text
        elif isinstance(part, Table):
            yield from _list_rows(part)
        elif isinstance(part, Sheet):
            yield from ("", *list_lines(part))


def _list_rows(table: Table) -> Iterator[str]:
    """The head, and rows in columns below it: text to the left, numbers to the right."""
    rows = table.rows[: table.shown]
    if not rows:
        return
    forms = [table.forms] * len(table.heads) if isinstance(table.forms, str) else table.forms
    texts = [[format_value(value, form) for value, form in zip(row, forms, strict=True)] for row in rows]
    texts = [[f"  {first}", *rest] for first, *rest in texts]
    wide = [max(map(len, column)) for column in zip(table.heads, *texts, strict=True)]
    sides = ["<" if n == 0 or all(isinstance(row[n], str) for row in rows) else ">" for n in range(len(wide))]
    for line in (table.heads, *texts):
        cells = (f"{text:{side}{size}}" for text, side, size in zip(line, sides, wide, strict=True))
        yield "  ".join(cells).rstrip()
    if len(table.rows) > len(rows):
        yield f"and {len(table.rows) - len(rows)} more; --json has all of them"


def format_value(value: Any, form: str = "", unknown: str = "-") -> str:
    """A value of a fact or a table as text; unknown: the word for None and for what is not finite."""
    if isinstance(value, Cell):
        return value.text
    if value is None or isinstance(value, float) and not math.isfinite(value):
        return unknown
    if isinstance(value, float):
        return format(value, form)
    return str(value)


def list_facts(record: Any) -> Iterator[Fact]:
    """The fields of a dataclass that say in their Key how they are shown, and are known."""
    from wavebatch.files.toml_file import list_entries

    for one in list_entries(type(record)):
        value = getattr(record, one.field)
        if one.key.shown and value is not None and math.isfinite(value):
            name, _, words = one.key.shown.partition(": ")
            yield Fact(name, words.format(value))


def sum_table(rows: Iterable[tuple[str, int, str, bool]]) -> Table:
    """A table of sums: name, number, its parts in words, and whether they add up to it; one that does not is marked."""
    marks = {True: "adds up", False: Cell("does not add up", 1, note="counts are wrong; please report it")}
    lines = [[*row, marks[fine]] for *row, fine in rows]
    return Table(("sum", "number", "is", "check"), lines, title="Sums that are checked")


def format_csv(head: Sequence[str], rows: Iterable[Iterable[Any]], *, digits: int = 10) -> str:
    """Return the table as text; empty cells are no data: None, NaN and infinity.

    digits: significant ones of floating-point numbers.
    """
    import csv

    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(head)
    for row in rows:
        known = ["" if value is None or isinstance(value, float) and not math.isfinite(value) else value
                 for value in row]  # fmt: skip
        table.writerow([f"{value:.{digits}g}" if isinstance(value, float) else value for value in known])
    return text.getvalue()
