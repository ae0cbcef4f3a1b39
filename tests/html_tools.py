"""A strict reader of report pages: elements must nest, and nothing may be loaded from elsewhere."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path

VOID = {"meta", "link", "br", "hr", "img", "input"}
DRAWN = {"path", "rect", "circle", "image"}
"""SVG elements that end themselves."""


class Page(HTMLParser):
    """A page; raises AssertionError where elements do not nest."""

    def __init__(self, path: Path) -> None:
        super().__init__(convert_charrefs=True)
        self.source = path.read_text("utf-8")
        self.open: list[str] = []
        self.elements: list[tuple[str, dict]] = []
        self.words: list[str] = []
        self.rows: list[list[str]] = []
        self._cell = False
        self.feed(self.source)
        self.close()
        assert not self.open, self.open

    def handle_starttag(self, tag, attributes):
        self.elements.append((tag, dict(attributes)))
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")
            self._cell = True
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        assert tag in DRAWN, tag
        self.elements.append((tag, dict(attributes)))

    def handle_endtag(self, tag):
        assert self.open and self.open.pop() == tag, f"</{tag}> at {self.getpos()}"
        if tag in ("td", "th"):
            self._cell = False

    def handle_data(self, words):
        if self.open and self.open[-1] not in ("style", "script"):
            self.words.append(words)
            if self._cell:
                self.rows[-1][-1] += words

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())

    @property
    def headings(self) -> list[str]:
        return re.findall(r"<h[1-4]>(.*?)</h[1-4]>", self.source)

    def row(self, name: str) -> list[str]:
        """The first row of a table whose first cell is this."""
        return next(row for row in self.rows if row and row[0] == name)

    def check(self) -> Page:
        """Nothing comes from elsewhere, links lead to parts that exist, identifiers are unique, pictures have names."""
        assert self.source.startswith("<!doctype html>") and "default-src 'none'" in self.source
        assert not re.search(r"https?://|//cdn|@import|url\(", self.source)
        names = [attributes["id"] for _, attributes in self.elements if "id" in attributes]
        assert len(names) == len(set(names))
        for tag, attributes in self.elements:
            for key in ("src", "href"):
                target = attributes.get(key, "#")
                fine = target == "#" or target.startswith("data:") or target.removeprefix("#") in names
                assert fine, (tag, target)
            assert not any(key.startswith("on") for key in attributes), (tag, attributes)
            if tag == "svg" and attributes.get("role"):
                assert attributes["aria-label"]
            for key in ("d", "x", "y", "width", "height", "cx", "cy"):
                assert not re.search(r"nan|inf", attributes.get(key, "")), (tag, attributes)
        return self
