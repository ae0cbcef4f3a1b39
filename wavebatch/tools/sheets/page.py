"""Pages of `--html`: sheets as one file that needs no network, written part by part, whole or not at all.

The commands call `check_page` before their work and `write_page` after it. Style and script are in page.css and
page.js; both go into the file. The page forbids the browser to load anything from elsewhere. Everything that comes from
a file goes through `text`: a strip's name may hold any character, also `<script>`.
"""

from __future__ import annotations

import base64
import hashlib
import html
import math
import os
from collections.abc import Iterable, Iterator
from itertools import groupby
from pathlib import Path
from typing import Any

from wavebatch import __version__
from wavebatch.core.errors import ConfigError, InputError, StageError, advise_install
from wavebatch.files.disk.publish import Draft, refuse_input, reporting
from wavebatch.files.figure_file import has_matplotlib
from wavebatch.tools.sheets.sheet import NO_VALUE, Cell, Code, Fact, Later, Note, Picture, SheetPart, Table

SIGN = '<!doctype html>\n<html lang="en">\n<!-- wavebatch report -->'
"""Start of every page: by it `check_page` knows a page of ours, which may be replaced."""

LONG = 40
"""Tables with more rows scroll in their place."""

FILTER = (
    '<p class="filter"><label>Show strips whose row contains <input type="search"></label> '
    '<label><input type="checkbox"> only marked</label> <span class="soft">A click on a head sorts the table.</span>'
    "</p>"
)
"""Fields that hide rows of the next table; page.js does it."""


def check_page(target: Path) -> None:
    """Raise ConfigError, before the work, where the page cannot be written: no folder, an input, a foreign file."""
    refuse_input(target)
    if not target.absolute().parent.is_dir():
        raise ConfigError(f"--html: folder {target.parent} does not exist; make it first")
    if not os.path.lexists(target):
        return
    with reporting(target):
        found = target.read_bytes()[: len(SIGN)] if target.is_file() else b"-"
    if found and found != SIGN.encode():
        raise ConfigError(f"--html: {target} exists and is no report of wavebatch; choose another name")


def write_page(
    target: Path, title: str, parts: Iterable[SheetPart | str], links: Iterable[tuple[str, str]] = ()
) -> None:
    """Write a page of these parts under a title; an older report of that name is replaced.

    A string among the parts is HTML already. links: mark and name of parts, above them.
    Raises InputError where the file cannot be written, ConfigError as `check_page`.
    """
    check_page(target)
    with Draft(target, overwrite=True) as draft:
        with reporting(target):
            draft.file.write(_head(title).encode())
            if not has_matplotlib():
                words = f"This page has no pictures, which need matplotlib: {advise_install('matplotlib')}"
                draft.file.write(f"{render(Note(words, 'warning'))}\n".encode())
            anchors = "".join(f'<a href="#{mark}">{text(name)}</a>' for mark, name in links)
            if anchors:
                draft.file.write(f'<nav aria-label="parts of the page">{anchors}</nav>\n'.encode())
            for whole in _render(parts, 2):
                draft.file.write(whole.encode(errors="backslashreplace") + b"\n")
            draft.file.write(f"</main>\n<script>{_read('page.js')}</script>\n</body>\n</html>\n".encode())
        draft.publish()


def _head(title: str) -> str:
    script = base64.b64encode(hashlib.sha256(_read("page.js").encode()).digest()).decode()
    rules = f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'sha256-{script}'"
    return f"""{SIGN}
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{rules}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="generator" content="wavebatch {text(__version__)}">
<link rel="icon" href="data:,">
<title>{text(title)}</title>
<style>
{_read("page.css")}</style>
</head>
<body>
<main>
<h1>{text(title)}</h1>
"""


def _read(name: str) -> str:
    """A file of this folder; it is part of the installed package."""
    return Path(__file__).with_name(name).read_text("utf-8")


def text(value: Any) -> str:
    """The value as HTML text: markup characters are escaped, control characters are shown as escapes."""
    plain = "".join(c if c.isprintable() else " " if c.isspace() else repr(c)[1:-1] for c in str(value))
    return html.escape(plain.encode(errors="backslashreplace").decode(), quote=True)


def section(title: str, *parts: str, level: int = 2, mark: str = "") -> str:
    """Parts of a page, which are HTML, under a heading; mark: its target of links."""
    place = f' id="{text(mark)}"' if mark else ""
    return f"<section{place}>\n<h{level}>{text(title)}</h{level}>\n" + "\n".join(filter(None, parts)) + "\n</section>"


def render(part: SheetPart, level: int = 2) -> str:
    """A part as HTML; level: of its heading."""
    return "\n".join(_render([part], level))


def _render(parts: Iterable[SheetPart | str], level: int) -> Iterator[str]:
    """Facts, notes of a kind and pictures that follow each other are drawn together; text is HTML already."""
    for (kind, word), some in groupby(parts, lambda part: (type(part), getattr(part, "kind", ""))):
        if kind is str:
            yield from some
        elif kind is Fact:
            cells = ((text(one.name.strip()), _number(one.value, one.form)) for one in some)
            rows = "".join(f'<tr><th scope="row">{name}</th><td>{value}</td></tr>' for name, value in cells)
            yield f'<div class="scroll"><table class="facts"><tbody>{rows}</tbody></table></div>'
        elif kind is Note and word:
            items = "".join(f"<li>{text(one.text)}</li>" for one in some)
            yield f'<ul class="{word}">{items}</ul>'
        elif kind is Note:
            yield from (f"<p>{text(one.text)}</p>" for one in some)
        elif kind is Picture:
            figures = []
            for one in some:
                address = f"data:image/svg+xml;base64,{base64.b64encode(one.svg.encode()).decode()}"
                words = f"<figcaption>{text(one.words)}</figcaption>" if one.words else ""
                wide, high = (round(96 * side) for side in one.size)
                image = f'<img alt="{text(one.title)}" width="{wide}" height="{high}" src="{address}">'
                figures.append(f"<figure>{image}{words}</figure>")
            drawn = "\n".join(figures)
            yield f'<div class="figures {word}">{drawn}</div>'
        elif kind is Table:
            yield from (_table(one) for one in some if one.rows)
        elif kind is Code:
            for one in some:
                lines = "\n".join(map(text, one.text.splitlines()))
                yield f'<pre tabindex="0">{lines}</pre>'
        elif kind is Later:
            for one in some:
                try:
                    yield from list(_render(one.draw(), level))
                except (InputError, ConfigError, StageError, OSError) as error:
                    yield render(Note(f"{one.what} cannot be drawn: {error}", "warning"))
        else:
            yield from (section(one.title, *_render(one.parts, level + 1), level=level, mark=one.mark) for one in some)


def _table(one: Table) -> str:
    """A table; numbers and their heads stand to the right, and a page sorts by them."""
    forms = [one.forms] * len(one.heads) if isinstance(one.forms, str) else one.forms
    before, after = ('<button type="button">', "</button>") if one.sortable else ("", "")
    rows = [[_cell(value, form) for value, form in zip(row, forms, strict=True)] for row in one.rows]
    kinds = [' class="n"' if any('class="n"' in cell for cell in column) else "" for column in zip(*rows, strict=True)]
    heads = "".join(
        f'<th scope="col"{kind}>{before}{text(name)}{after}</th>' for name, kind in zip(one.heads, kinds, strict=True)
    )
    body = "\n".join(f"<tr>{''.join(cells)}</tr>" for cells in rows)
    title = f"<caption>{text(one.title)}</caption>" if one.title else ""
    kind, tall = ' class="sortable"' if one.sortable else "", " tall" if len(one.rows) > LONG else ""
    whole = f"{title}<thead><tr>{heads}</tr></thead>\n<tbody>\n{body}\n</tbody>"
    return f'{FILTER if one.filtered else ""}<div class="scroll{tall}"><table{kind}>{whole}</table></div>'


def _cell(value: Any, form: str) -> str:
    if isinstance(value, str):
        return f"<td>{text(value)}</td>"
    shown, order = (text(value.text), value.value) if isinstance(value, Cell) else (_number(value, form), value)
    if isinstance(value, Cell):
        if value.link:
            shown = f'<a href="#{text(value.link)}">{shown}</a>'
        if value.note:
            shown = f'<span class="mark" title="{text(value.note)}">\u25b2 {shown}</span>'
        if value.details:
            says = "".join(f"<li>{text(line)}</li>" for line in value.details)
            shown = f'<details><summary class="mark">{shown}</summary><ul>{says}</ul></details>'
    if isinstance(order, str):
        return f'<td data-sort="{text(order)}">{shown}</td>' if order else f"<td>{shown}</td>"
    sort = "" if order is None or not math.isfinite(order) else repr(float(order))
    return f'<td class="n" data-sort="{sort}">{shown}</td>'


def _number(value: Any, form: str) -> str:
    """A value in its form as HTML; whole numbers have marks of thousands."""
    if value is None or isinstance(value, float) and not math.isfinite(value):
        return NO_VALUE
    if not isinstance(value, int | float):
        return text(value)
    return text(format(value, form if isinstance(value, float) else ","))
