"""`wavebatch export`: strips for other programs, as repaired LAS or as arrays.

Only reads options and prints; the work is in `wavebatch.tools.archives.export_strip`.
"""

from __future__ import annotations

import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from wavebatch.cli import options as shared
from wavebatch.cli.messages import answer, counting, tell
from wavebatch.core.units import count
from wavebatch.tools.archives.export_strip import SUFFIXES, ExportSummary, export_strip


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
    targets = shared.name_outputs(paths, output, SUFFIXES, ".las")

    def work(path: Path) -> ExportSummary:
        with counting("waveforms", options["quiet"]) as bar:
            names = ("direction", "headerless", "overwrite")
            summary = export_strip(
                path, targets[path], progress=bar.update, **{name: options[name] for name in names}
            )
        _say(summary)
        return summary

    summaries, failed = shared.for_each(paths, work, debug=options["debug"])
    answer([asdict(one) for one in summaries])
    sys.exit(1 if failed else 0)


def _say(summary: ExportSummary) -> None:
    numbers = f"{count(summary.points, 'point')} and {count(summary.waveforms, 'waveform')}"
    tell(f"{summary.output}: {numbers}")
    for line in summary.repaired:
        tell(f"{summary.output}: repaired: {line}")
