"""The tables of a comparison as CSV: one row per figure, so that it can be filtered and pivoted.

`wavebatch compare -o` writes it, for two clouds, for a cloud and the truth, and for chains.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

from wavebatch.tools.csv_table import format_csv

HEAD = ("table", "side", "class", "name", "figure", "value")
"""Columns: e.g. `missed`, `B`, `return`, `1 of 2`, `share`, `0.012`."""

_TABLES = {"missed_by": ("missed", "B"), "extra_by": ("extra", "A")}

Row = tuple[str, str, str, str, str, Any]


def format_comparison(document: Mapping[str, Any]) -> str:
    """The figures of a comparison, as its JSON document has them; empty cells are no data.

    document: of `Comparison.to_json`, or of `Matchup.to_json`.
    """
    return format_csv(HEAD, _list_rows(document))


def _list_rows(document: Mapping[str, Any]) -> Iterator[Row]:
    for name, value in document.items():
        if name in _TABLES:
            yield from _list_classes(name, value)
        elif name in ("counts_a", "counts_b"):
            for number, pulses in value.items():
                yield "echoes per pulse", name[-1].upper(), "", str(number), "pulses", pulses
        elif name == "differences_by":
            for kind, groups in value.items():
                for group, quantities in groups.items():
                    yield from _list_group(kind, group, quantities)
        elif name == "between":
            yield from _list_rows(value)
        elif name == "vendor":
            for side, one in value.items():
                # Each side is compared with the vendor's returns: the tables are those of a comparison again.
                for table, part, *rest in _list_rows(one):
                    yield f"{table}, {side.upper()} and the vendor's returns", {"B": "vendor"}.get(part, part), *rest
        elif isinstance(value, Mapping):
            yield from _list_nested(name, value)
        elif not isinstance(value, list | tuple):
            yield "all", "", "", "", name, value


def _list_classes(name: str, tables: Mapping[str, Any]) -> Iterator[Row]:
    """Echoes without a partner by return number, amplitude, flags and company."""
    title, side = _TABLES[name]
    for kind, classes in tables.items():
        for each, (alone, of) in classes.items():
            for figure, value in (("echoes", alone), ("of", of), ("share", alone / of if of else math.nan)):
                yield title, side, kind, str(each), figure, value


def _list_group(kind: str, group: str, quantities: Mapping[str, Any]) -> Iterator[Row]:
    """Differences of one LAS class, or of the pulses with one number of echoes."""
    for quantity, spread in quantities.items():
        for figure, value in spread.items():
            yield "differences by " + kind, "", group, quantity, figure, value


def _list_nested(table: str, values: Mapping[str, Any], *path: str) -> Iterator[Row]:
    """Tables of any depth: differences, errors against the truth, goodness of fit."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _list_nested(table, value, *path, str(name))
        elif not isinstance(value, list | tuple):
            # The first part is the side where there are sides, the last one the name.
            side = path[0].upper() if path and path[0] in ("a", "b") else ""
            rest = path[1:] if side else path
            yield table, side, " ".join(rest[:-1]), rest[-1] if rest else "", str(name), value
