"""The tables of `wavebatch compare` as lines of text; `wavebatch.cli.compare` prints them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

from wavebatch.cli.messages import count, row

if TYPE_CHECKING:
    from wavebatch.tools.compare.chains import Matchup
    from wavebatch.tools.compare.clouds import Comparison
    from wavebatch.tools.compare.differences import ErrorSpread

def list_lines(result: Comparison) -> Iterator[str]:
    """The tables of every comparison of echoes."""
    a, b = result.correctness, result.completeness
    yield from (f"A {result.a}", f"B {result.b}", f"matched by {result.matched_by}, within {result.tolerance_ns:g} ns")
    if result.left_out_a or result.left_out_b:
        yield f"left out      A {result.left_out_a:>12}   B {result.left_out_b:>12}   by --where"
    yield from ("", f"echoes        A {result.echoes_a:>12}   B {result.echoes_b:>12}")
    yield f"identical     {result.matched:>14}   missed {result.missed}   extra {result.extra}"
    yield f"completeness  {_known(b, '.4f'):>14}   correctness {_known(a, '.4f')}"
    both = _known(result.identical, ".2%")
    yield f"identical are {_known(a, '.2%'):>14} of A's   {_known(b, '.2%')} of B's   {both} of both"
    yield f"more points   {_known(result.gain, '+.2%'):>14} in A than in B"
    if result.pulses:
        yield f"exact count   {result.exact_count:>14.4f}   of {count(result.pulses, 'pulse')}"
        yield from ("", "echoes per pulse")
        for n in sorted({*result.counts_a, *result.counts_b}):
            yield f"{n:>12}  A {result.counts_a.get(n, 0):>12}   B {result.counts_b.get(n, 0):>12}"
    yield from ("", row(f"{'A - B':<14}", ("number", "median", "mean", "rms", "nmad")))
    units = {"time": "time ns", "echo_time": "echo_time ns", "amplitude": "amplitude DN", "echo_width": "width ns"}
    for name, spread in result.differences.items():
        yield row(f"{units[name]:<14}", (spread.number, spread.median, spread.mean, spread.rms, spread.nmad), ".4f")
    for kind, groups in result.differences_by.items():
        yield from _list_groups(kind, groups, units)
    yield from _list_breakdown("missed, of B's", result.missed_by)
    yield from _list_breakdown("extra, of A's", result.extra_by)
    if result.errors:
        head = ("number", "bias", "rmse", "rms/bound", "nmad/bound", "rms/_err", "nmad/_err")
        yield from ("", row(f"{'against truth':<23}", head))
    for kind, quantities in result.errors.items():
        for name, one in quantities.items():
            if one.number:
                scaled = (one.rms_per_bound, one.nmad_per_bound, one.calibration, one.calibration_nmad)
                yield row(f"{kind + ' ' + name:<23}", (one.number, one.bias, one.rmse, *scaled), ".4f")
    if result.errors and "echo_time" not in result.differences:
        yield "time: of positions, which the strip's returns anchor; `run --columns +echo_time` adds that of the fits"


def _known(value: float, form: str) -> str:
    """The value, or no-data: a share of no echoes."""
    return "no-data" if math.isnan(value) else format(value, form)


def _list_groups(kind: str, groups: dict[str, dict[str, ErrorSpread]], units: dict[str, str]) -> Iterator[str]:
    """Differences by LAS class or by number of echoes, where there are several."""
    if len(groups) < 2:
        return
    yield from ("", row(f"{f'A - B by {kind}':<41}", ("number", "median", "mean", "rms", "nmad")))
    for name, quantities in groups.items():
        for quantity, one in quantities.items():
            title = f"{name}, {units[quantity]}" if kind == "class" else f"{name} of the pulse, {units[quantity]}"
            yield row(f"{title:<41}", (one.number, one.median, one.mean, one.rms, one.nmad), ".4f")


def _list_breakdown(title: str, tables: dict) -> Iterator[str]:
    """The classes of echoes in which some have no partner."""
    head = row(f"{title:<41}", ("number", "of")) + f" {'share':>8}"
    for kind, table in tables.items():
        for name, (alone, of) in table.items():
            if alone:
                yield from ("", head) if head else ()
                yield row(f"{f'{kind} {name}':<41}", (alone, of)) + f" {alone / of:>8.2%}"
                head = ""


def list_match(result: Matchup) -> Iterator[str]:
    """The tables that only chains have: points per waveform and per return, and the goodness of fit."""
    found = f"{count(result.waveforms, 'waveform')}, {count(result.returns, 'return')} of the vendor"
    yield from ("", f"strip {result.strip}: {found}")
    yield row(f"{'with the returns':<17}", ("echoes", "/waveform", "/return", "identical", "missed", "extra"))
    for side, one in result.vendor.items():
        each = [one.echoes_a / of if of else math.nan for of in (result.waveforms, result.returns)]
        yield row(f"{side.upper():<17}", (one.echoes_a, *each, one.matched, one.missed, one.extra), ".4f")
    head = ("waveforms", "mean E", "median E", "mean E0", "median E0")
    yield from ("", row(f"{'goodness of fit':<17}", head))
    for side, classes in result.fit.items():
        for name, fit in classes.items():
            if fit.waveforms:
                values = (fit.waveforms, fit.mean, fit.median, fit.floor_mean, fit.floor_median)
                yield row(f"{side.upper()} {name:<15}", values, ".6f")
        if not classes:
            yield f"{side.upper()} no-data: a cloud does not hold the fitted model"
    yield "E = |f - y|^2 / |f|^2 of model f and waveform y; E0 is the E that noise alone gives"
