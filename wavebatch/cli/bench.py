"""`wavebatch bench`: error against run time.

Only reads options and prints; the measurements are in `wavebatch.tools.bench`.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from wavebatch.cli import options as shared
from wavebatch.cli.command import complete
from wavebatch.cli.messages import answer, talk
from wavebatch.tools.bench import command
from wavebatch.tools.sheets.sheet import list_lines


@click.command()
@click.argument("files", nargs=-1, type=shared.INPUT, metavar="[STRIP...] [CHAIN...]")
@click.option("--scene", "scenes", multiple=True, metavar="NAME", shell_complete=complete("scenes"),
              help="Simulate this scene, e.g. mixed, open or forest; `wavebatch simulate --help` lists all; may be "
              "repeated.")
@shared.options_of(command.BenchOptions)
@shared.seed_option("Seed of the simulated waveforms.")
@shared.declared("tolerance", "Name the cheapest chain whose range error of isolated echoes is at most this, "
                 "e.g. 0.02m.")
@shared.output_option("Folder for bench.json, bench.txt and the plots. Existing files are replaced.", "DIR",
                      required=False, folder=True)
@shared.html_option
@shared.common_options("json")
def bench(files: tuple[Path, ...], output: Path | None, **options: Any) -> None:
    """Measure error and run time of all shipped chains and of CHAIN files (.toml).

    Waveforms with known echoes are simulated like those of STRIP: its noise, baselines, pulse and echoes come from a
    survey of it. Without STRIP, named scenes are simulated (default: mixed). The table has one row per chain and the
    standard error of each figure.

    Exit code: 0 done, 1 the strip cannot be read or the folder cannot be written, 2 wrong usage.

    Examples:
      # all shipped chains on echoes like those of the strip
      wavebatch bench strip.las -o bench
      # the cheapest chain with 2 cm of range error
      wavebatch bench --scene open --tolerance 0.02m
    """
    tolerance, html_file = options["tolerance"], options["html_file"]
    shared.check_html(html_file)
    strips = [path for path in files if path.suffix.lower() != ".toml"]
    silent = options["quiet"] or not sys.stderr.isatty()
    say = (lambda text: None) if silent else talk
    if len(strips) > 1:
        raise click.UsageError(f"one strip at a time, not {len(strips)}; chain files end in .toml")
    settings = shared.from_options(
        command.BenchOptions,
        options,
        strip=strips[0] if strips else None,
        scenes=options["scenes"] or (() if strips else ("mixed",)),
        chains=tuple(path for path in files if path.suffix.lower() == ".toml"),
        tolerance_cm=100.0 * tolerance if tolerance else None,
    )
    document = command.run_bench(settings, say)
    sheet = command.bench_sheet(document)
    for line in command.write_outputs(document, "\n".join(list_lines(sheet)), output) if output else []:
        talk(line)
    shared.write_html(html_file, ", ".join(section["scene"] for section in document["scenes"]), sheet.parts)
    answer(document, sheet)
