"""The file of a page: written part by part, so that memory stays small, and whole or not at all.

The commands call `check_page` before their work and a `write_..._page` after it. Style and script are in page.css and
page.js; both go into the file. The page forbids the browser to load anything from elsewhere.
"""

from __future__ import annotations

import base64
import hashlib
import os
from collections.abc import Iterable
from pathlib import Path

from wavebatch import __version__
from wavebatch.core.errors import ConfigError
from wavebatch.core.optional import advise_install
from wavebatch.files.disk.protect import refuse_input
from wavebatch.files.disk.publish import Draft, reporting
from wavebatch.files.figure_file import has_matplotlib
from wavebatch.tools.html.markup import paragraph, text

SIGN = '<!doctype html>\n<html lang="en">\n<!-- wavebatch report -->'
"""Start of every page: by it `check_page` knows a page of ours, which may be replaced."""


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


def write_page(target: Path, title: str, parts: Iterable[str]) -> None:
    """Write a page of these parts under a title; an older report of that name is replaced.

    Raises InputError where the file cannot be written, ConfigError as `check_page`.
    """
    check_page(target)
    with Draft(target, overwrite=True) as draft:
        with reporting(target):
            draft.file.write(_head(title).encode())
            if not has_matplotlib():
                words = f"This page has no pictures, which need matplotlib: {advise_install('matplotlib')}"
                draft.file.write(f"{paragraph(words, 'warning')}\n".encode())
            for part in parts:
                draft.file.write(part.encode(errors="backslashreplace") + b"\n")
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
