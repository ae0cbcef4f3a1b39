"""`wavebatch stats`: return numbers, separations and flags of point clouds."""

from __future__ import annotations

import math
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from wavebatch.cli.common import debug_option, print_json, report_errors, talk
from wavebatch.errors import InputError
from wavebatch.returns import ReturnStats, count_returns

EXIT_UNREADABLE = 1
"""A cloud could not be read; the others are counted."""


@click.command()
@click.argument("clouds", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="CLOUD...")
@click.option("--json", "as_json", is_flag=True, help="Print JSON: `files`, and `total` over all of them.")
@debug_option
@report_errors()
def stats(clouds: tuple[Path, ...], as_json: bool, debug: bool) -> None:
    """How many returns the pulses of CLOUDs have, how far apart they are, and which flags they carry.

    Any LAS or LAZ file, in any order of points. Warns what the sensor's dead zone and its largest number of returns
    hide. Exit code: 0, or 1 where a cloud cannot be read (the others are counted).
    """
    failed: list[InputError] = []

    def skip(error: InputError) -> None:
        if debug:
            raise error
        failed.append(error)
        talk(f"error: {error}")

    each, total = count_returns(clouds, skip)
    if as_json:
        print_json({"files": [_plain(one) for one in each], "total": _plain(total)})
    else:
        shown = [*each, total] if len(clouds) > 1 else each
        click.echo("\n\n".join("\n".join(_list_lines(one)) for one in shown), nl=bool(shown))
    sys.exit(EXIT_UNREADABLE if failed else 0)


def _list_lines(found: ReturnStats) -> list[str]:
    lines = [
        found.cloud,
        f"points         {found.points}",
        f"pulses         {found.pulses} (by {found.pulses_by}), {found.returns_per_pulse:.3f} returns each"
        if found.pulses
        else "pulses         0",
    ]
    numbers = sorted({*found.by_number, *found.by_count})
    if numbers:
        lines.append(f"{'k':>14}  {'return k':>10}  {'k returns':>10}")
    for k in numbers:
        lines.append(f"{k:>14}  {found.by_number.get(k, 0):>10.2%}  {found.by_count.get(k, 0):>10.2%}")
    if found.separations["all"].pairs:
        lines.append(f"{'separation':<14}  {'pairs':>10}  {'mean m':>10}  {'least m':>10}")
        for name, one in found.separations.items():
            lines.append(f"{name:>14}  {one.pairs:>10}  {one.mean:>10.3f}  {one.least:>10.3f}")
    if found.flags is not None:
        lines += [f"{name:<22}  {number:>10}" for name, number in found.flags.items() if number]
    return lines + [f"warning        {line}" for line in found.warnings]


def _plain(found: ReturnStats) -> dict[str, Any]:
    """JSON has no NaN: what is unknown is null."""
    return _finite({**asdict(found), "returns_per_pulse": found.returns_per_pulse})


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _finite(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
