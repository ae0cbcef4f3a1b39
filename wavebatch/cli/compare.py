"""`wavebatch compare`: two results on one strip, a result and the vendor's returns, or a result and the truth."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import click

from wavebatch.cli.common import debug_option, print_json, report_errors, talk
from wavebatch.compare import Comparison, compare_clouds, compare_truth

EXIT_VIOLATED = 1
"""A threshold is not met."""


@click.command()
@click.argument("a", type=click.Path(path_type=Path))
@click.argument("b", type=click.Path(path_type=Path), required=False)
@click.option("--truth", type=click.Path(path_type=Path), help="Truth of a simulated strip, in place of B.")
@click.option("--tolerance", type=float, help="Largest difference of the same echo [ns].  [default: 1; truth: 1.5]")
@click.option("--min-completeness", type=float, help="Least share of B's echoes that A has.")
@click.option("--min-correctness", type=float, help="Least share of A's echoes that B has.")
@click.option("--min-exact", type=float, help="Least share of pulses with as many echoes in A as in B.")
@click.option("--max-median", type=float, help="Largest absolute median of the difference [ns].")
@click.option("--max-rmse", type=float, help="Largest root mean square of the difference [ns].")
@click.option("--max-nmad", type=float, help="Largest robust spread of the difference [ns].")
@click.option("--json", "as_json", is_flag=True, help="Print the figures as JSON.")
@debug_option
@report_errors(failure=2)
def compare(a: Path, b: Path | None, truth: Path | None, tolerance: float | None, as_json: bool, **options) -> None:
    """Compare the echoes of cloud A with those of B: another result, or the strip itself with the vendor's returns.

    Echoes of a pulse are the same when they lie within the tolerance along the ray. Points that were passed through
    without an echo do not count. Exit code: 0 fine, 1 a threshold is not met, 2 wrong usage or a file unreadable.
    """
    if (b is None) == (truth is None):
        raise click.UsageError("give either B or --truth FILE.npz")
    if b is not None and b.suffix.lower() == ".npz":
        raise click.UsageError(f"{b} looks like a truth file; give it with --truth")
    given = {} if tolerance is None else {"tolerance_ns": tolerance}
    result = compare_truth(a, truth, **given) if truth else compare_clouds(a, b, **given)
    if as_json:
        print_json(_finite(result.to_dict()))
    else:
        click.echo("\n".join(_list_lines(result)))
    broken = _check_thresholds(result, options)
    for line in broken:
        talk(line)
    if broken:
        sys.exit(EXIT_VIOLATED)


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
    ]
    if result.pulses:
        lines += [f"exact count   {result.exact_count:>14.4f}   of {result.pulses} pulses", "", "echoes per pulse"]
        lines += [f"{n:>12}  A {result.counts_a.get(n, 0):>12}   B {result.counts_b.get(n, 0):>12}" for n in numbers]
    lines += ["", f"{'A - B':<13} {'number':>10} {'median':>10} {'mean':>10} {'rms':>10} {'nmad':>10}"]
    units = {"time": "time ns", "echo_time": "echo_time ns", "amplitude": "amplitude DN", "echo_width": "width ns"}
    for name, spread in result.differences.items():
        values = (spread.median, spread.mean, spread.rms, spread.nmad)
        lines.append(f"{units[name]:<13} {spread.number:>10} " + " ".join(f"{value:>10.4f}" for value in values))
    return lines + _list_errors(result)


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


def _finite(value):
    """The same structure with None for what is not a number, so that every JSON reader takes it."""
    if isinstance(value, dict):
        return {str(key): _finite(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
