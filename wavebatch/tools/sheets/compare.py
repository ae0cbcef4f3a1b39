"""A comparison as a sheet, which `wavebatch compare` prints and writes as a page, and as CSV: one row per figure."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wavebatch import __version__
from wavebatch.core.units import count
from wavebatch.tools.pairing import Comparison
from wavebatch.tools.sheets.sheet import Fact, Later, Note, Part, Picture, Sheet, Table, format_csv, sum_table

if TYPE_CHECKING:
    from wavebatch.tools.compare_chains import Matchup

_UNITS = {"time": "time ns", "echo_time": "echo_time ns", "amplitude": "amplitude DN", "echo_width": "width ns"}
_SPREAD = ("number", "median", "mean", "rms", "nmad")
"""What the tables show of a difference."""


def comparison_sheet(result: Comparison | Matchup) -> Sheet:
    """The sheet of two clouds, of a cloud and the truth, or of chains."""
    # A match has the comparison of its sides; only chains need the rooms that run them.
    between = result if isinstance(result, Comparison) else result.between
    chains = () if isinstance(result, Comparison) else _list_match(result)
    return Sheet("compare", [*_list_echoes(between), *_list_differences(between), *_list_alone(between), *chains])


def write_compare_page(target: Path, result: Comparison | Matchup, broken: Sequence[str] = ()) -> None:
    """Write the page of a comparison; broken: the thresholds that are not met."""
    from wavebatch.tools.sheets.page import write_page

    between = result if isinstance(result, Comparison) else result.between
    names = [Path(side).name for side in (between.a, between.b) if side]
    warnings = [Note(words, "warning") for words in broken]
    parts = [*warnings, *comparison_sheet(result).parts, Fact("wavebatch", __version__)]
    write_page(target, f"wavebatch compare: {' with '.join(names)}", parts)


def _list_echoes(one: Comparison) -> Iterator[Part]:
    """How many echoes both sides have, and how many are the same."""
    yield Later(partial(_draw, one))
    yield from (Fact("A", one.a), Fact("B", one.b))
    yield Fact("matched by", f"{one.matched_by}, within {one.tolerance_ns:g} ns")
    if one.left_out_a or one.left_out_b:
        yield Fact("left out", f"A {one.left_out_a}   B {one.left_out_b}   by --where")
    yield from (Fact("echoes of A", one.echoes_a), Fact("echoes of B", one.echoes_b), Fact("identical", one.matched))
    yield from (Fact("missed", one.missed), Fact("extra", one.extra))
    yield from (Fact("completeness", one.completeness, ".4f"), Fact("correctness", one.correctness, ".4f"))
    yield Fact("identical, of all", one.identical, ".2%")
    yield Fact("more points in A", one.gain, "+.2%")
    if one.pulses:
        yield Fact("exact count", one.exact_count, ".4f")
        yield Fact("pulses", one.pulses)
    numbers = sorted({*one.counts_a, *one.counts_b}) if one.pulses else ()
    rows = [(str(n), one.counts_a.get(n, 0), one.counts_b.get(n, 0)) for n in numbers]
    yield Sheet("Echoes per pulse", [Table(("echoes per pulse", "A", "B"), rows), Later(lambda: [_sums(one)])])


def _draw(one: Comparison) -> Iterator[Picture]:
    from wavebatch.tools.plots.charts import draw_counts

    found = {"in both": one.matched, "only in A": one.extra, "only in B": one.missed}
    yield from draw_counts(found, title="Echoes", label="")
    for side, counts in (("A", one.counts_a), ("B", one.counts_b)) if one.pulses else ():
        shown = {str(number): counts.get(number, 0) for number in range(min(max(counts, default=0), 16) + 1)}
        yield from draw_counts(shown, title=f"Echoes per pulse, {side}", label="echoes")


def _sums(one: Comparison) -> Table:
    sides = (("echoes of A", one.echoes_a, one.extra, "extra"), ("echoes of B", one.echoes_b, one.missed, "missed"))
    return sum_table((title, whole, f"{one.matched:,} identical + {rest:,} {name}", one.matched + rest == whole)
                     for title, whole, rest, name in sides)  # fmt: skip


def _list_differences(one: Comparison) -> Iterator[Sheet]:
    """Differences of the echoes of both sides, also by class and by number of echoes where there are several."""
    spread = lambda of: tuple(getattr(of, name) for name in _SPREAD)  # noqa: E731
    rows = [(_UNITS[name], *spread(of)) for name, of in one.differences.items()]
    tables = [Table(("A - B", *_SPREAD), rows, ".4f")]
    for kind, groups in one.differences_by.items():
        rows = [(group if kind == "class" else f"{group} of the pulse", _UNITS[name], *spread(of))
                for group, quantities in groups.items() for name, of in quantities.items()]  # fmt: skip
        if len(groups) > 1:
            tables.append(Table((f"A - B by {kind}", "", *_SPREAD), rows, ".4f", sortable=True))
    yield Sheet("Differences", tables)
    if one.errors:
        head = ("against truth", "", "number", "bias", "rmse", "rms/bound", "nmad/bound", "rms/_err", "nmad/_err")
        rows = [(kind, name, of.number, of.bias, of.rmse, of.rms_per_bound, of.nmad_per_bound, of.calibration,
                 of.calibration_nmad)
                for kind, each in one.errors.items() for name, of in each.items() if of.number]  # fmt: skip
        words = "time: of positions, which the strip's returns anchor; `run --columns +echo_time` adds that of the fits"
        notes = [] if "echo_time" in one.differences else [Note(words)]
        yield Sheet("Errors against the truth", [Table(head, rows, ".4f", sortable=True), *notes])


def _list_alone(one: Comparison) -> Iterator[Sheet]:
    """The classes of echoes in which some have no partner."""
    for title, tables in (("missed, of B's", one.missed_by), ("extra, of A's", one.extra_by)):
        rows = [(kind, str(name), alone, of, alone / of)
                for kind, classes in tables.items() for name, (alone, of) in classes.items() if alone]  # fmt: skip
        if rows:
            head = (title, "", "number", "of", "share")
            yield Sheet(f"Echoes {title}", [Table(head, rows, ".2%", sortable=True)])


def _list_match(result: Matchup) -> Iterator[Sheet]:
    """The tables that only chains have: points per waveform and per return, and the goodness of fit."""
    found = f"{count(result.waveforms, 'waveform')}, {count(result.returns, 'return')} of the vendor"
    sizes = (result.waveforms, result.returns)
    rows = [(side.upper(), one.echoes_a, *(one.echoes_a / of if of else math.nan for of in sizes), one.matched,
             one.missed, one.extra) for side, one in result.vendor.items()]  # fmt: skip
    head = ("with the returns", "echoes", "/waveform", "/return", "identical", "missed", "extra")
    yield Sheet("With the vendor's returns", [Fact("strip", f"{result.strip}: {found}"), Table(head, rows, ".4f")])
    rows = [(f"{side.upper()} {name}", fit.waveforms, fit.mean, fit.median, fit.floor_mean, fit.floor_median)
            for side, classes in result.fit.items() for name, fit in classes.items() if fit.waveforms]  # fmt: skip
    head = ("goodness of fit", "waveforms", "mean E", "median E", "mean E0", "median E0")
    clouds = [side.upper() for side, classes in result.fit.items() if not classes]
    notes = [Note(f"{side} no-data: a cloud does not hold the fitted model") for side in clouds]
    words = "E = |f - y|^2 / |f|^2 of model f and waveform y; E0 is the E that noise alone gives"
    yield Sheet("Goodness of fit", [Table(head, rows, ".6f"), *notes, Note(words)])


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
            # Echoes without a partner by return number, amplitude, flags and company.
            title, side = _TABLES[name]
            for kind, classes in value.items():
                for each, (alone, of) in classes.items():
                    for figure, number in (("echoes", alone), ("of", of), ("share", alone / of if of else math.nan)):
                        yield title, side, kind, str(each), figure, number
        elif name in ("counts_a", "counts_b"):
            for number, pulses in value.items():
                yield "echoes per pulse", name[-1].upper(), "", str(number), "pulses", pulses
        elif name == "differences_by":
            for kind, groups in value.items():
                yield from _list_nested(f"differences by {kind}", groups)
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
