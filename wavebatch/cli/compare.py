"""`wavebatch compare`: two results or chains on one strip, one of them and the vendor's returns, or a result and the
truth."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

from wavebatch.cli.messages import debug_option, print_json, report_errors, talk
from wavebatch.cli.options import json_option, system_option
from wavebatch.tools.compare.clouds import Comparison, compare_clouds, compare_truth

if TYPE_CHECKING:
    from wavebatch.tools.compare.angles import AngleAgreement
    from wavebatch.tools.compare.chains import Matchup

EXIT_VIOLATED = 1
"""A threshold is not met."""

_BAR = 40
"""Characters of the longest bar of a histogram."""

_SHARE, _LENGTH = click.FloatRange(0.0, 1.0), click.FloatRange(0.0)


@click.command()
@click.argument("a", type=click.Path(path_type=Path))
@click.argument("b", type=click.Path(path_type=Path), required=False)
@click.option("--strip", type=click.Path(path_type=Path), metavar="STRIP",
              help="Run A and B on the waveforms of this strip: chain files, fast, balanced, accurate or auto.")
@system_option
@click.option("--limit", type=click.IntRange(1), metavar="N",
              help="About N waveforms spread over the strip, in place of all.")
@click.option("--truth", type=click.Path(path_type=Path), help="Truth of a simulated strip, in place of B.")
@click.option("--angles", is_flag=True, help="Angles from widths against those from normals: of A, or A against B.")
@click.option("--tolerance", type=float, help="Largest difference of the same echo [ns].  [default: 1; truth: 1.5]")
@click.option("--min-completeness", type=_SHARE, help="Least share of B's echoes that A has.")
@click.option("--min-correctness", type=_SHARE, help="Least share of A's echoes that B has.")
@click.option("--min-exact", type=_SHARE, help="Least share of pulses with as many echoes in A as in B.")
@click.option("--max-median", type=_LENGTH, help="Largest absolute median of the difference [ns].")
@click.option("--max-rmse", type=_LENGTH, help="Largest root mean square of the difference [ns].")
@click.option("--max-nmad", type=_LENGTH, help="Largest robust spread of the difference [ns].")
@json_option("Print the figures as JSON.")
@debug_option
@report_errors(failure=2)
def compare(
    a: Path, b: Path | None, strip: Path | None, truth: Path | None, angles: bool, as_json: bool, **options
) -> None:
    """Compare the echoes of cloud A with those of B: another result, or the strip itself with the vendor's returns.

    Echoes of a pulse are the same when they lie within the tolerance along the ray. Points that were passed through
    without an echo do not count.

    With --strip, A and B are chains that are run on it (one of them may be a cloud), and are compared waveform by
    waveform, also with the vendor's returns and by their goodness of fit; without B, A with the vendor's returns.

    With --angles, incidence_angle is compared with incidence_angle_normals: of A's points that have both, or of one
    cloud with the other of the other one.
    Exit code: 0 fine, 1 a threshold is not met, 2 wrong usage or a file unreadable.
    """  # fmt: skip
    if angles:
        agreement = _measure_angles(a, b, {**options, "strip": strip, "truth": truth})
        print_json(agreement.to_json()) if as_json else click.echo("\n".join(_list_angles(agreement)))
        return
    result = _match(a, b, strip, truth, options) if strip else _compare(a, b, truth, options)
    between = result.between if strip else result
    if as_json:
        print_json(result.to_json())
    else:
        click.echo("\n".join([*_list_lines(between), *(_list_match(result) if strip else [])]))
    broken = _check_thresholds(between, options)
    for line in broken:
        talk(line)
    if broken:
        sys.exit(EXIT_VIOLATED)


def _tolerance(options: dict) -> dict[str, float]:
    return {} if options["tolerance"] is None else {"tolerance_ns": options["tolerance"]}


def _compare(a: Path, b: Path | None, truth: Path | None, options: dict) -> Comparison:
    for name in ("system_file", "limit"):
        if options[name] is not None:
            raise click.UsageError(f"--{name.removesuffix('_file')} is for chains; give --strip STRIP too")
    if (b is None) == (truth is None):
        raise click.UsageError("give either B or --truth FILE.npz")
    for side in (a, b):
        if side is not None and _is_chain(side):
            raise click.UsageError(f"{side} is a chain; say with --strip STRIP what it is to be run on")
    if b is not None and b.suffix.lower() == ".npz":
        raise click.UsageError(f"{b} looks like a truth file; give it with --truth")
    given = _tolerance(options)
    return compare_truth(a, truth, **given) if truth else compare_clouds(a, b, **given)


def _is_chain(side: Path) -> bool:
    from wavebatch.tools.compare.chains import find_contender

    return side.suffix.lower() == ".toml" or (not side.is_file() and not find_contender(str(side)).is_cloud)


def _match(a: Path, b: Path | None, strip: Path, truth: Path | None, options: dict) -> Matchup:
    from wavebatch.core.suggest import nearest
    from wavebatch.surveying.choose_chain import COSTS
    from wavebatch.surveying.system_file import load_survey
    from wavebatch.tools.compare.chains import AUTO, find_contender, match_sides

    if truth is not None:
        raise click.UsageError("--truth is for a cloud; `wavebatch bench` holds chains against a truth")
    saved = load_survey(options["system_file"]).survey if options["system_file"] else None
    sides = [None if side is None else find_contender(str(side)) for side in (a, b)]
    for side in sides:
        if side is not None and side.is_cloud and not Path(side.name).exists():
            chain = nearest(side.name, [AUTO, *COSTS])
            raise click.UsageError(f"{side.name}: is neither a file nor a shipped chain; {chain}")
    return match_sides(strip, *sides, survey=saved, limit=options["limit"], **_tolerance(options))


def _check_thresholds(result: Comparison, options: dict) -> list[str]:
    """A line per threshold that is not met; a figure that does not exist meets none."""
    time = result.differences.get("time")
    figures = {
        "min_completeness": result.completeness,
        "min_correctness": result.correctness,
        "min_exact": result.exact_count,
        "max_median": abs(time.median) if time else math.nan,
        "max_rmse": time.rms if time else math.nan,
        "max_nmad": time.nmad if time else math.nan,
    }
    lines = []
    for name, figure in figures.items():
        limit = options[name]
        if limit is None:
            continue
        fine = figure >= limit if name.startswith("min") else figure <= limit
        if not fine:
            lines.append(f"threshold --{name.replace('_', '-')} {limit:g} is not met: {result.a} has {figure:.6g}")
    return lines


def _list_lines(result: Comparison) -> list[str]:
    numbers = sorted({*result.counts_a, *result.counts_b})
    lines = [
        f"A {result.a}",
        f"B {result.b}",
        f"matched by {result.matched_by}, within {result.tolerance_ns:g} ns",
        "",
        f"echoes        A {result.echoes_a:>12}   B {result.echoes_b:>12}",
        f"identical     {result.matched:>14}   missed {result.missed}   extra {result.extra}",
        f"completeness  {result.completeness:>14.4f}   correctness {result.correctness:.4f}",
        f"identical are {result.correctness:>14.2%} of A's   {result.completeness:.2%} of B's   {result.identical:.2%} "
        "of both",
        f"more points   {result.gain:>+14.2%} in A than in B",
    ]
    if result.pulses:
        lines += [f"exact count   {result.exact_count:>14.4f}   of {result.pulses} pulses", "", "echoes per pulse"]
        lines += [f"{n:>12}  A {result.counts_a.get(n, 0):>12}   B {result.counts_b.get(n, 0):>12}" for n in numbers]
    lines += ["", f"{'A - B':<13} {'number':>10} {'median':>10} {'mean':>10} {'rms':>10} {'nmad':>10}"]
    units = {"time": "time ns", "echo_time": "echo_time ns", "amplitude": "amplitude DN", "echo_width": "width ns"}
    for name, spread in result.differences.items():
        values = (spread.median, spread.mean, spread.rms, spread.nmad)
        lines.append(f"{units[name]:<13} {spread.number:>10} " + " ".join(f"{value:>10.4f}" for value in values))
    for title, tables in (("missed, of B's", result.missed_by), ("extra, of A's", result.extra_by)):
        lines += _list_breakdown(title, tables)
    return lines + _list_errors(result)


def _list_breakdown(title: str, tables: dict) -> list[str]:
    """The classes of echoes in which any has no partner."""
    rows = [
        f"{f'{kind} {name}':<40} {alone:>10} {of:>10} {alone / of:>8.2%}"
        for kind, table in tables.items()
        for name, (alone, of) in table.items()
        if alone
    ]
    return ["", f"{title:<40} {'number':>10} {'of':>10} {'share':>8}", *rows] if rows else []


def _list_match(result: Matchup) -> Iterator[str]:
    """What only runs on a strip tell: points per waveform and return, and the goodness of fit."""
    yield from ("", f"strip {result.strip}: {result.waveforms} waveforms, {result.returns} returns of the vendor")
    head = ("echoes", "/waveform", "/return", "identical", "missed", "extra")
    yield f"{'with the returns':<17}" + " ".join(f"{name:>10}" for name in head)
    for side, one in result.vendor.items():
        number = one.echoes_a
        each = [number / of if of else math.nan for of in (result.waveforms, result.returns)]
        shares = " ".join(f"{value:>10.4f}" for value in each)
        yield f"{side.upper():<17}{number:>10} {shares} {one.matched:>10} {one.missed:>10} {one.extra:>10}"
    head = ("waveforms", "mean E", "median E", "mean E0", "median E0")
    yield from ("", f"{'goodness of fit':<17}" + " ".join(f"{name:>10}" for name in head))
    for side, classes in result.fit.items():
        for name, fit in classes.items():
            if fit.waveforms:
                values = (fit.mean, fit.median, fit.floor_mean, fit.floor_median)
                yield f"{side.upper()} {name:<15}{fit.waveforms:>10} " + " ".join(f"{value:>10.6f}" for value in values)
        if not classes:
            yield f"{side.upper()} no-data: its echoes do not tell what was fitted"
    yield "E = |f - y|^2 / |f|^2 of model f and waveform y; E0 is what the noise alone makes of it"


def _list_errors(result: Comparison) -> list[str]:
    if not result.errors:
        return []
    head = ("number", "bias", "rmse", "rms/bound", "nmad/bound", "rms/_err", "nmad/_err")
    lines = ["", f"{'against truth':<22} " + " ".join(f"{name:>10}" for name in head)]
    for kind, quantities in result.errors.items():
        for name, stats in quantities.items():
            if not stats.number:
                continue
            scaled = (stats.rms_per_bound, stats.nmad_per_bound, stats.calibration, stats.calibration_nmad)
            values = (stats.bias, stats.rmse, *scaled)
            figures = " ".join(f"{'-':>10}" if math.isnan(value) else f"{value:>10.4f}" for value in values)
            lines.append(f"{kind + ' ' + name:<22} {stats.number:>10} {figures}")
    return lines


def _measure_angles(a: Path, b: Path | None, options: dict) -> AngleAgreement:
    """The agreement of one cloud or two; UsageError for options that mean nothing here."""
    from wavebatch.tools.compare.angles import compare_angles

    for name, value in options.items():
        if value is not None and name not in ("tolerance", "debug"):
            raise click.UsageError(f"--{name.removesuffix('_file').replace('_', '-')} has no meaning with --angles")
    given = {} if options["tolerance"] is None else {"tolerance_ns": options["tolerance"]}
    return compare_angles(a, b, **given)


def _list_angles(result: AngleAgreement) -> list[str]:
    """Figures and histograms as text."""
    lines = [f"A {result.a}"] + ([f"B {result.b}"] if result.b else [])
    lines += [
        f"points        {result.points:>12}   with angle from width {result.with_widths}, from normals "
        f"{result.with_normals}, both {result.number}",
    ]
    if not result.number:
        return [*lines, "no point has both angles; the report of the run says why"]
    share = "no errors" if math.isnan(result.within_error) else f"{100 * result.within_error:.1f} %"
    lines += [
        f"bias          {result.bias:>12.3f}   deg, angle from width less angle from normals",
        f"MAE           {result.mae:>12.3f}   deg",
        f"median abs    {result.median_absolute:>12.3f}   deg",
        f"rms           {result.rms:>12.3f}   deg",
        f"within errors {share:>12}   of the differences within one standard deviation of both",
        "",
        f"{'angle deg':>12}  from width",
        *_bars(result.edges, result.histogram_widths),
        f"{'angle deg':>12}  from normals",
        *_bars(result.edges, result.histogram_normals),
        f"{'difference':>12}  width less normals",
        *_bars(result.difference_edges, result.histogram_difference),
    ]
    return lines


def _bars(edges: tuple[float, ...], counts: tuple[int, ...]) -> list[str]:
    """A line per bin, from the first to the last that holds a thousandth of all; what lies beyond in one line."""
    filled = [number for number, count in enumerate(counts) if 1000 * count >= sum(counts)]
    most = max(counts)
    beyond = sum(counts) - sum(counts[filled[0] : filled[-1] + 1])
    lines = [
        f"{edges[number]:>5.0f} to {edges[number + 1]:>3.0f} {counts[number]:>11} "
        + "#" * math.ceil(_BAR * counts[number] / most)
        for number in range(filled[0], filled[-1] + 1)
    ]
    return [*lines, f"{'beyond':>12} {beyond:>11}"] if beyond else lines
