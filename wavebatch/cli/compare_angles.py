"""`wavebatch compare --angles`: angles from widths beside those from the points around."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from wavebatch.compare.angles import AngleAgreement

_BAR = 40


def measure(a: Path, b: Path | None, options: dict) -> AngleAgreement:
    """The agreement of one cloud or two; UsageError for options that mean nothing here."""
    from wavebatch.compare.angles import compare_angles

    for name, value in options.items():
        if value is not None and name not in ("tolerance", "debug"):
            raise click.UsageError(f"--{name.removesuffix('_file').replace('_', '-')} has no meaning with --angles")
    given = {} if options["tolerance"] is None else {"tolerance_ns": options["tolerance"]}
    return compare_angles(a, b, **given)


def list_lines(result: AngleAgreement) -> list[str]:
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
