"""Pieces of HTML: text, tables and sections. Everything that comes from a file goes through `text` first.

All pages are made of these. Before you change it: a strip's name may hold any character, also `<script>`.
"""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from wavebatch.core.errors import ConfigError, InputError, StageError

NO_VALUE = "\u2013"
"""Shown where there is no value."""


def text(value: Any) -> str:
    """The value as HTML text: markup characters are escaped, control characters are shown as escapes."""
    plain = "".join(c if c.isprintable() else " " if c.isspace() else repr(c)[1:-1] for c in str(value))
    return html.escape(plain.encode(errors="backslashreplace").decode(), quote=True)


def number(value: Any, form: str = ",") -> str:
    """A number in this form; NO_VALUE for None and for what is not finite."""
    if value is None or isinstance(value, float) and not math.isfinite(value):
        return NO_VALUE
    return text(format(value, form))


def significant(value: float, digits: int = 4) -> float:
    """The value with so many digits: a measured figure with more claims what it does not know."""
    return float(f"{value:.{digits}g}")


def share(part: float, whole: float) -> str:
    """A share in percent; NO_VALUE of nothing."""
    return f"{100 * part / whole:.2f} %" if whole else NO_VALUE


def rounded(value: float | None, form: str) -> Cell:
    """The cell of a number in this form; the table sorts by the number."""
    return Cell(number(value, form), "" if value is None or not math.isfinite(value) else float(value))


def percent(value: float | None) -> Cell:
    """The cell of a share, in percent."""
    return rounded(None if value is None else 100 * value, ".2f")


def section(title: str, *parts: str, level: int = 2, mark: str = "") -> str:
    """A part of the page under a heading; mark: its target of links."""
    place = f' id="{text(mark)}"' if mark else ""
    return f"<section{place}>\n<h{level}>{text(title)}</h{level}>\n" + "\n".join(filter(None, parts)) + "\n</section>"


def paragraph(words: str, kind: str = "") -> str:
    """A paragraph of plain text; kind: its class, for example `note` or `warning`."""
    return f'<p class="{kind}">{text(words)}</p>' if kind else f"<p>{text(words)}</p>"


def bullets(lines: Iterable[str], kind: str = "") -> str:
    """A list of lines; empty without lines."""
    items = "".join(f"<li>{text(line)}</li>" for line in lines)
    return f'<ul class="{kind}">{items}</ul>' if items else ""


def code(words: str) -> str:
    """Text as it is, in a box that scrolls."""
    lines = "\n".join(text(line) for line in words.splitlines())
    return f'<pre tabindex="0">{lines}</pre>'


def facts(rows: Mapping[str, Any] | Iterable[tuple[str, Any]]) -> str:
    """Names and values, in two columns."""
    pairs = rows.items() if isinstance(rows, Mapping) else rows
    body = "".join(f'<tr><th scope="row">{text(name)}</th><td>{text(value)}</td></tr>' for name, value in pairs)
    return f'<div class="scroll"><table class="facts"><tbody>{body}</tbody></table></div>'


class Cell(str):
    """A cell that is HTML already, with the value by which a table is sorted."""

    value: Any

    def __new__(cls, markup: str, value: Any = None) -> Cell:
        """The cell."""
        cell = super().__new__(cls, markup)
        cell.value = value
        return cell


FILTER = (
    '<p class="filter"><label>Show strips whose row contains <input type="search"></label> '
    '<label><input type="checkbox"> only marked</label> <span class="soft">A click on a head sorts the table.</span>'
    "</p>"
)
"""Fields that hide rows of the next table; page.js does it."""


def table(
    head: Sequence[str], rows: Iterable[Sequence[Any]], *, sortable: bool = False, tall: bool = False,
    caption: str = "",
) -> str:  # fmt: skip
    """A table; numbers stand to the right. sortable: a click on a head sorts by it; tall: it scrolls in its place."""
    title = f"<caption>{text(caption)}</caption>" if caption else ""
    heads = "".join(_head(name, sortable) for name in head)
    body = "\n".join("<tr>" + "".join(map(_cell, row)) + "</tr>" for row in rows)
    kind = ' class="sortable"' if sortable else ""
    whole = f"{title}<thead><tr>{heads}</tr></thead>\n<tbody>\n{body}\n</tbody>"
    return f'<div class="scroll{" tall" if tall else ""}"><table{kind}>{whole}</table></div>'


def sums(rows: Iterable[tuple[str, int, str, bool]], caption: str = "") -> str:
    """A table of sums: name, number, its parts in words, and whether they add up to it; one that does not is marked."""
    marks = {True: "adds up", False: Cell('<span class="mark">does not add up</span>')}
    lines = [[*row, marks[fine]] for *row, fine in rows]
    return table(["sum", "number", "is", "check"], lines, caption=caption)


def or_reason(draw: Callable[[], str], what: str) -> str:
    """What is drawn of a file, or a paragraph that says why it cannot be."""
    try:
        return draw()
    except (InputError, ConfigError, StageError, OSError) as error:
        return paragraph(f"{what} cannot be drawn: {error}", "warning")


def _head(name: str, sortable: bool) -> str:
    inner = f'<button type="button">{text(name)}</button>' if sortable else text(name)
    return f'<th scope="col">{inner}</th>'


def _cell(value: Any) -> str:
    if isinstance(value, Cell):
        order = value.value
        sort = "" if order is None else f' data-sort="{text(order)}"'
        kind = ' class="n"' if isinstance(order, int | float) else ""
        return f"<td{kind}{sort}>{value}</td>"
    if value is None or isinstance(value, int | float):
        order = "" if value is None or not math.isfinite(value) else repr(float(value))
        form = "," if isinstance(value, int) else ".4g"
        return f'<td class="n" data-sort="{order}">{number(value, form)}</td>'
    return f"<td>{text(value)}</td>"
