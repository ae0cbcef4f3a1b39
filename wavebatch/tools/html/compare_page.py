"""The page of `wavebatch compare --html`: echoes of two sides, their differences, and who misses which."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any

from wavebatch import __version__
from wavebatch.tools.compare.chains import Matchup
from wavebatch.tools.compare.pairing import Comparison
from wavebatch.tools.html import markup
from wavebatch.tools.html.charts import draw_counts, figures
from wavebatch.tools.html.page import write_page

_SPREAD = ("number", "median", "mean", "rms", "nmad")
"""What the tables show of a difference."""

_spread = attrgetter(*_SPREAD)


def write_compare_page(target: Path, result: Comparison | Matchup, broken: Sequence[str] = ()) -> None:
    """Write the page of a comparison; broken: the thresholds that are not met."""
    between = result.between if isinstance(result, Matchup) else result
    names = [Path(side).name for side in (between.a, between.b) if side]
    write_page(target, f"wavebatch compare: {' with '.join(names)}", _echo_parts(result, between, broken))


def _echo_parts(result: Comparison | Matchup, one: Any, broken: Sequence[str]) -> Iterator[str]:
    found = {"in both": one.matched, "only in A": one.extra, "only in B": one.missed}
    charts = [draw_counts(found, title="Echoes", label="")]
    if one.pulses:
        charts += [draw_counts(_named(counts), title=f"Echoes per pulse, {side}", label="echoes")
                   for side, counts in (("A", one.counts_a), ("B", one.counts_b))]  # fmt: skip
    yield markup.section("Summary", markup.bullets(broken, "warning"), figures(charts), _summarise(one))
    yield markup.section("Sums", _sums(one))
    rows = [[name, *_spread(spread)] for name, spread in one.differences.items()]
    head = ["A - B", *_SPREAD]
    yield markup.section("Differences", markup.paragraph("Times and widths in ns, amplitudes in DN."),
                         markup.table(head, rows))  # fmt: skip
    rows = [[kind, group, quantity, *_spread(spread)]
            for kind, groups in one.differences_by.items() if len(groups) > 1
            for group, quantities in groups.items() for quantity, spread in quantities.items()]  # fmt: skip
    if rows:
        head = ["by", "group", *head]
        yield markup.section("Differences by class and number of echoes", markup.table(head, rows, sortable=True))
    yield _breakdown("Missed echoes of B", one.missed_by)
    yield _breakdown("Extra echoes of A", one.extra_by)
    if one.errors:
        yield _truth_errors(one.errors)
    if isinstance(result, Matchup):
        yield from _strip_parts(result)
    yield markup.section("Provenance", markup.facts({"wavebatch": __version__, "A": one.a, "B": one.b}))


def _summarise(one: Comparison) -> str:
    left = f"{one.left_out_a:,} points of A, {one.left_out_b:,} of B"
    return markup.facts([
        ("A", one.a), ("B", one.b), ("matched by", f"{one.matched_by}, within {one.tolerance_ns:g} ns"),
        ("echoes of A", f"{one.echoes_a:,}"), ("echoes of B", f"{one.echoes_b:,}"),
        ("identical", f"{one.matched:,}"), ("missed", f"{one.missed:,}"), ("extra", f"{one.extra:,}"),
        ("completeness", markup.number(one.completeness, ".4f")),
        ("correctness", markup.number(one.correctness, ".4f")),
        ("same number of echoes", f"{markup.number(one.exact_count, '.4f')} of {one.pulses:,} pulses"),
        ("more points in A", markup.number(one.gain, "+.2%")),
        *([("left out by --where", left)] if one.left_out_a or one.left_out_b else []),
    ])  # fmt: skip


def _sums(one: Comparison) -> str:
    return markup.sums(
        (title, whole, f"{one.matched:,} identical + {rest:,} {name}", one.matched + rest == whole)
        for title, whole, rest, name in (("echoes of A", one.echoes_a, one.extra, "extra"),
                                         ("echoes of B", one.echoes_b, one.missed, "missed"))
    )  # fmt: skip


def _named(counts: Mapping[int, int]) -> dict[str, int]:
    last = max(counts, default=0)
    return {str(number): counts.get(number, 0) for number in range(min(last, 16) + 1)}


def _breakdown(title: str, tables: Mapping[str, Mapping[str, tuple[int, int]]]) -> str:
    rows = [[kind, name, alone, of, markup.Cell(markup.share(alone, of), alone / of if of else "")]
            for kind, classes in tables.items() for name, (alone, of) in classes.items() if alone]  # fmt: skip
    if not rows:
        return markup.section(title, markup.paragraph("none"))
    return markup.section(title, markup.table(["by", "class", "number", "of", "share"], rows, sortable=True))


def _truth_errors(errors: Mapping[str, Mapping[str, Any]]) -> str:
    rows = [[kind, name, one.number, one.bias, one.rmse, one.rms_per_bound, one.nmad_per_bound, one.calibration,
             one.calibration_nmad]
            for kind, each in errors.items() for name, one in each.items() if one.number]  # fmt: skip
    head = ["echoes", "quantity", "number", "bias", "rmse", "rms/bound", "nmad/bound", "rms/_err", "nmad/_err"]
    return markup.section("Errors against the truth", markup.table(head, rows, sortable=True))


def _strip_parts(result: Matchup) -> Iterator[str]:
    sides = [[side.upper(), one.echoes_a, one.matched, one.missed, one.extra] for side, one in result.vendor.items()]
    yield markup.section(
        "With the vendor's returns",
        markup.paragraph(f"{result.strip}: {result.waveforms:,} waveforms, {result.returns:,} returns of the vendor."),
        markup.table(["side", "echoes", "identical", "missed", "extra"], sides),
    )
    rows = [[side.upper(), name, fit.waveforms, fit.mean, fit.median, fit.floor_mean, fit.floor_median]
            for side, classes in result.fit.items() for name, fit in classes.items() if fit.waveforms]  # fmt: skip
    words = "E = |f - y|^2 / |f|^2 of model f and waveform y; E0 is the E that noise alone gives."
    head = ["side", "waveforms with", "number", "mean E", "median E", "mean E0", "median E0"]
    yield markup.section("Goodness of fit", markup.paragraph(words), markup.table(head, rows))
