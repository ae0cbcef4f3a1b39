"""`wavebatch import`: PulseWaves files as strips; `wavebatch export`: strips for other programs.

Only reads options and prints; the work is in `wavebatch.tools.import_file` and `export_strip`.
"""

from __future__ import annotations

import math
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from wavebatch.cli import options as shared
from wavebatch.cli.command import complete_files
from wavebatch.cli.messages import answer, counting, tell
from wavebatch.core.units import count
from wavebatch.tools.export_strip import SUFFIXES as WRITTEN
from wavebatch.tools.export_strip import ExportSummary, export_strip
from wavebatch.tools.import_file import SUFFIXES, ImportOptions, ImportSummary, import_file

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

    def work(path: Path) -> ImportSummary:
        with counting("pulses", options["quiet"]) as bar:
            summary = import_file(path, targets[path], chosen, bar.update)
        _say(summary)
        return summary

    # A single file that fails is one line too, with the exit code of a batch.
    results, failed = shared.for_each(paths, work, debug=options["debug"], alone=True)
    answer({"files": [asdict(one) for one in results], "failed": failed})
    sys.exit(0 if not failed else EXIT_SOME if results else EXIT_NONE)


def _name_strips(paths: list[Path], output: Path | None) -> dict[Path, Path]:
    if output is None:
        return {path: path.with_suffix(".las") for path in paths}
    if output.suffix.lower() not in (".las", ".laz"):
        output.mkdir(parents=True, exist_ok=True)
    return shared.name_outputs(paths, output, (".las", ".laz"), ".las")


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


@click.command()
@shared.strips_argument
@shared.output_option("File to write: .las or .laz with a .wdp beside it, or .npz; or a folder, which gets STEM.las "
                      "for each strip.", "FILE|DIR", folder=None)
@shared.strip_options
@shared.common_options("overwrite", "json")
def export(strips: tuple[str, ...], output: Path, recursive: bool, **options: Any) -> None:
    """Write STRIPs as other programs need them: LAS with repaired packets, or waveforms as arrays.

    \b
    LAS, LAZ: packets without compression, of 8, 16 or 32 bits, with descriptors of their true length; vectors toward
              the sensor in metres per picosecond; true counts and bounds. Points whose packet cannot be used have
              none. A record of the file says what was repaired.
    NPZ:      arrays samples and missing, of all waveforms behind each other; waveform p has count[p] of them from
              first[p] on, at origin[p] + t direction[p] with t = 0, spacing[p], ... ns; its returns are those with
              return_waveform p.

    Exit code: 0 done, 1 a strip cannot be read or an output cannot be written (the others are made), 2 wrong usage.

    Examples:
      # packets as the LAS specification has them
      wavebatch export strip.las -o repaired.laz
      # waveforms with their geometry as arrays
      wavebatch export strip.las -o strip.npz
    """  # fmt: skip
    paths = shared.find_inputs(strips, recursive=recursive)
    targets = shared.name_outputs(paths, output, WRITTEN, ".las")

    def work(path: Path) -> ExportSummary:
        with counting("waveforms", options["quiet"]) as bar:
            names = ("direction", "headerless", "overwrite")
            summary = export_strip(
                path, targets[path], progress=bar.update, **{name: options[name] for name in names}
            )
        numbers = f"{count(summary.points, 'point')} and {count(summary.waveforms, 'waveform')}"
        tell(f"{summary.output}: {numbers}")
        for line in summary.repaired:
            tell(f"{summary.output}: repaired: {line}")
        return summary

    summaries, failed = shared.for_each(paths, work, debug=options["debug"])
    answer([asdict(one) for one in summaries])
    sys.exit(1 if failed else 0)
