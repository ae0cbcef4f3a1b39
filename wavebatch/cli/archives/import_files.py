"""`wavebatch import`: PulseWaves files as strips.

Only reads options and prints; the work is in `wavebatch.tools.archives.import_file`.
"""

from __future__ import annotations

import math
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from wavebatch.cli import options as shared
from wavebatch.cli.messages import answer, counting, tell
from wavebatch.cli.program.command import complete_files
from wavebatch.core.units import count
from wavebatch.tools.archives.import_file import SUFFIXES, ImportOptions, ImportSummary, import_file

EXIT_SOME, EXIT_NONE = 3, 4
"""Exit codes of `wavebatch run`: some files failed; no file was written."""


@click.command("import")
@click.argument("files", nargs=-1, required=True, metavar="FILE...", shell_complete=complete_files)
@shared.declared("recursive")
@shared.output_option("Strip to write, .las or .laz, or a folder.  [default: X.las beside each X.pls]", "FILE|DIR",
                      required=False, folder=None)
@shared.options_of(ImportOptions)
@shared.common_options("overwrite", "json")
def import_(files: tuple[str, ...], output: Path | None, recursive: bool, **options: Any) -> None:
    """Import PulseWaves FILEs (.pls with the .wvs beside it) as LAS 1.4 strips of point format 9.

    FILE is a .pls, a glob, a folder, or @list.txt with one of these per line. A strip has the energy and the height of
    every outgoing pulse as extra bytes, and X.system.toml beside it has the shape of these pulses. A file that is
    damaged or cut gives one line and no output.

    Exit code: 0 all written, 2 wrong usage, 3 some files failed, 4 no file was written.

    Examples:
      # flight.las and flight.wdp, and flight.system.toml
      wavebatch import flight.pls -o flight.las
      # all files of a folder; go on after an interruption
      wavebatch import archive/ -o strips --resume
    """  # fmt: skip
    paths = shared.find_inputs(files, recursive=recursive, kinds=(SUFFIXES,))
    targets = _name_strips(paths, output)
    chosen = shared.from_options(ImportOptions, options)
    # A single file that fails is one line too, with the exit code of a batch.
    results, failed = shared.for_each(
        paths, lambda path: _import(path, targets[path], chosen, options), debug=options["debug"], alone=True
    )
    answer({"files": [asdict(one) for one in results], "failed": failed})
    sys.exit(0 if not failed else EXIT_SOME if results else EXIT_NONE)


def _name_strips(paths: list[Path], output: Path | None) -> dict[Path, Path]:
    if output is None:
        return {path: path.with_suffix(".las") for path in paths}
    if output.suffix.lower() not in (".las", ".laz"):
        output.mkdir(parents=True, exist_ok=True)
    return shared.name_outputs(paths, output, (".las", ".laz"), ".las")


def _import(path: Path, target: Path, chosen: ImportOptions, options: dict[str, Any]) -> ImportSummary:
    bar = counting("pulses", options["quiet"])
    with bar:
        summary = import_file(path, target, chosen, bar.update)
    _say(summary)
    return summary


def _say(summary: ImportSummary) -> None:
    if summary.skipped:
        tell(f"{summary.output}: is up to date, skipped")
        return
    parts = (summary.points, "point"), (summary.packets, "packet"), (summary.pulses, "pulse")
    points, packets, pulses = (count(*part) for part in parts)
    tell(f"{summary.output}: {points} and {packets} of {pulses}")
    sent = summary.outgoing
    if sent is not None:
        spread, error = 100 * sent["energy_scatter"], 100 * sent["energy_error"]
        width = f" {sent['fwhm_ns']:.3f} ns wide at half maximum," if math.isfinite(sent["fwhm_ns"]) else ":"
        tell(f"{summary.output}: outgoing pulses{width} energies vary by {spread:.2f} %, known to {error:.2f} %")
    for note in summary.notes:
        tell(f"{summary.output}: {note}")
