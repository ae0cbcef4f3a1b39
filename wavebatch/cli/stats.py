"""`wavebatch stats`: return numbers, separations and flags of point clouds."""

from __future__ import annotations

import csv
import io
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from wavebatch.cli.messages import debug_option, print_json, report_errors, talk
from wavebatch.cli.options import json_option, overwrite_option
from wavebatch.core.errors import InputError
from wavebatch.files.disk.publish import refuse_existing
from wavebatch.files.geojson import load_polygons
from wavebatch.files.inputs import find_files
from wavebatch.files.text_file import write_text
from wavebatch.tools.return_stats.areas import AreaStats, Grid, PolygonSet
from wavebatch.tools.return_stats.returns import ReturnStats, count_returns

EXIT_UNREADABLE = 1
"""A cloud could not be read; the others are counted."""

SHOWN = 20
"""Areas of a cloud that are printed; a table of all of them goes to -o or --json."""


@click.command()
@click.argument("clouds", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="CLOUD...")
@click.option("--area", "size", type=float, metavar="SIZE",
              help="Count by square cells with sides of SIZE, in the unit of the coordinates, too.")
@click.option("--polygons", type=click.Path(path_type=Path), metavar="FILE",
              help="Count by the polygons of a GeoJSON file too; the first one counts where they overlap.")
@click.option("-o", "--output", type=click.Path(dir_okay=False, path_type=Path), metavar="FILE.csv",
              help="A table with a row per cloud and area.")
@overwrite_option
@json_option("Print JSON: `files`, and `total` over all of them.")
@debug_option
@report_errors()
def stats(
    clouds: tuple[Path, ...],
    size: float | None,
    polygons: Path | None,
    output: Path | None,
    overwrite: bool,
    as_json: bool,
    debug: bool,
) -> None:
    """How many returns the pulses of CLOUDs have, how far apart they are, and which flags they carry.

    CLOUD is a LAS or LAZ file with its points in any order, a glob, a folder, or @list.txt. Warns what the sensor's
    dead zone and its largest number of returns hide. A pulse belongs to the area of its first return, with all of its
    returns. Exit code: 0, or 1 where a cloud cannot be read (the others are counted), 2 wrong usage.
    """  # fmt: skip
    if output is not None and not overwrite:
        refuse_existing(output)
    divisions = [] if size is None else [Grid(size)]
    divisions += [] if polygons is None else [PolygonSet(load_polygons(polygons))]
    failed: list[InputError] = []

    def skip(error: InputError) -> None:
        if debug:
            raise error
        failed.append(error)
        talk(f"error: {error}")

    files = find_files(map(str, clouds))
    each, total = count_returns(files, skip, divisions=divisions)
    if output is not None:
        write_text(output, _format_table(each, total), overwrite=overwrite)
    if as_json:
        print_json({"files": [_plain(one) for one in each], "total": _plain(total)})
    else:
        shown = [*each, total] if len(files) > 1 else each
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
    return lines + [f"warning        {line}" for line in found.warnings] + _list_areas(found.areas)


def _list_areas(areas: Sequence[AreaStats]) -> list[str]:
    if not areas:
        return []
    most = max(max(area.by_count) for area in areas[:SHOWN])
    width = max(len(area.name) for area in areas[:SHOWN])
    head = ("pulses", "each", *(f"{k} of pulse" for k in range(1, most + 1)), "pairs", "mean m", "least m")
    lines = [f"{'area':<{width}} " + " ".join(f"{name:>10}" for name in head)]
    for area in areas[:SHOWN]:
        shares = " ".join(f"{area.by_count.get(k, 0):>10.2%}" for k in range(1, most + 1))
        apart = f"{area.pairs:>10} {area.mean:>10.3f} {area.least:>10.3f}".replace("nan", "  -")
        lines.append(f"{area.name:<{width}} {area.pulses:>10} {area.returns_per_pulse:>10.3f} {shares} {apart}")
    left = len(areas) - SHOWN
    return lines + ([f"and {left} more areas; -o FILE.csv and --json have all of them"] if left > 0 else [])


def _format_table(each: Sequence[ReturnStats], total: ReturnStats) -> str:
    """CSV: a row per cloud and per area of it; of several clouds also of all together."""
    every = [*each, total] if len(each) > 1 else each
    rows = [(one.cloud, part) for one in every for part in (one, *one.areas)]
    numbers = range(1, 1 + max((max(part.by_number, default=0) for _, part in rows), default=0))
    counts = range(1, 1 + max((max(part.by_count, default=0) for _, part in rows), default=0))
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    head = ["cloud", "kind", "area", "x", "y", "points", "pulses", "returns_per_pulse"]
    head += [*(f"return_{k}" for k in numbers), *(f"pulses_with_{k}" for k in counts), "pairs", "mean_m", "least_m"]
    table.writerow(head)
    for cloud, part in rows:
        if isinstance(part, AreaStats):
            place, apart = [part.kind, part.name, part.x, part.y], (part.pairs, part.mean, part.least)
        else:
            alone = part.separations["all"]
            place, apart = ["cloud", "", math.nan, math.nan], (alone.pairs, alone.mean, alone.least)
        shares = [part.by_number.get(k, 0.0) for k in numbers] + [part.by_count.get(k, 0.0) for k in counts]
        values = [*place, part.points, part.pulses, part.returns_per_pulse, *shares, *apart]
        table.writerow([cloud, *(_cell(value) for value in values)])
    return text.getvalue()


def _cell(value: Any) -> Any:
    """Nothing for what is unknown."""
    if not isinstance(value, float):
        return value
    return f"{value:.10g}" if math.isfinite(value) else ""


def _plain(found: ReturnStats) -> dict[str, Any]:
    return {**asdict(found), "returns_per_pulse": found.returns_per_pulse}
