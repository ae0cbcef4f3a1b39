"""WKT of a CRS as a list of its nodes: the one scanner of it.

`las/crs.py` finds units with it, `wkt_repair.py` wrong ones, `geotiff_file.py` a third axis. Before you change it: the
text may hold anything, so the scanner does not recurse, and what is not well formed has no nodes.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

_TOKEN = re.compile(
    r'"((?:[^"]|"")*)"|([A-Za-z_][A-Za-z_0-9]*)\s*([\[(])?|([-+]?[0-9.][-+0-9.eE]*)|([\])])|,|\s+|(.)', re.DOTALL
)


@dataclass(slots=True, eq=False)
class Node:
    """A keyword with what stands in its brackets."""

    word: str
    """In upper case."""
    start: int
    """Place of the keyword in the text."""
    end: int = 0
    """Place after its closing bracket."""
    values: list[str] = field(default_factory=list)
    """Texts, numbers and words without brackets, in order."""
    nodes: list[Node] = field(default_factory=list)

    def find(self, *words: str) -> Node | None:
        """Return the first node in the brackets with one of these keywords."""
        return next((node for node in self.nodes if node.word in words), None)


def read_wkt(text: str) -> list[Node]:
    """Return all nodes of WKT (version 1 or 2) in the order of the text; empty where it is not well formed."""
    found: list[Node] = []
    nested: list[Node] = []
    for token in _TOKEN.finditer(text):
        quoted, word, opens, number, closes, other = token.groups()
        if opens:
            found.append(Node(word.upper(), token.start()))
            if nested:
                nested[-1].nodes.append(found[-1])
            nested.append(found[-1])
        elif other or closes and not nested:
            return []
        elif closes:
            nested.pop().end = token.end()
        elif nested:
            nested[-1].values += [value for value in (quoted, word, number) if value is not None]
    return [] if nested else found
