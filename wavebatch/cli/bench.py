"""`wavebatch bench`: error against run time."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from wavebatch.cli.messages import debug_option, print_json, report_errors, talk
from wavebatch.cli.options import json_option


@click.command()
@click.argument("files", nargs=-1, type=click.Path(path_type=Path), metavar="[STRIP] [CHAIN...]")
@click.option(
    "--scene", "scenes", multiple=True, metavar="NAME", help="Scene: mixed, open, forest, empty, flat, stiff."
)
@click.option("-o", "--output", type=click.Path(path_type=Path), help="Folder for bench.json, bench.txt and the plots.")
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Of the simulated waveforms.")
@click.option(
    "--waveforms", type=click.IntRange(1), default=65_536, show_default=True, help="Simulated waveforms per scene."
)
@click.option(
    "--pulses",
    type=click.IntRange(0),
    default=50_000,
    show_default=True,
    help="Pulses from file to file; 0 for kernels only.",
)
@click.option("--repeat", "repeats", type=click.IntRange(1), default=3, show_default=True, help="Turns of the timing.")
@click.option(
    "--tolerance", metavar="LENGTH", help="Name the cheapest chain with this error for isolated echoes: 0.02m."
)
@click.option(
    "--peers/--no-peers", default=True, help="Measure gdecomp (if installed) and scipy too.  [default: peers]"
)
@click.option("--all-methods", is_flag=True, help="A row for every detector and every decomposer too.")
@click.option("--stability/--no-stability", default=True, help="The stiff and extreme cases.  [default: stability]")
@click.option("--hazard", "hazards", multiple=True, metavar="H1..H16", help="Only the cases of this hazard.")
@click.option("--promises", is_flag=True, help="Also measure what each release promises, and say what is met.")
@click.option("--large", is_flag=True, envvar="BENCH_LARGE", help="With --promises: memory for 10^7 pulses too.")
@json_option("Print the JSON document in place of the tables.")
@click.option("-q", "--quiet", is_flag=True, help="No progress on stderr.")
@debug_option
@report_errors()
def bench(files: tuple[Path, ...], output: Path | None, tolerance: str | None, as_json: bool, **options) -> None:
    """Error against run time of every shipped chain, the CHAIN files (.toml) and other decomposers.

    Waveforms with known echoes are simulated like those of STRIP: its noise, baselines, pulse and echoes, as its own
    survey finds them; or of named scenes (default: mixed). One row per chain; every figure with its standard error.
    Exit code: 0, 1 where the strip cannot be read or the folder not be written, 2 wrong usage.
    """
    from wavebatch.cli.options import parse_length
    from wavebatch.tools.bench.command import BenchOptions, run_bench
    from wavebatch.tools.bench.promises import format_promises
    from wavebatch.tools.bench.report import format_document, write_outputs

    strips = [path for path in files if path.suffix.lower() != ".toml"]
    if len(strips) > 1:
        raise click.UsageError(f"one strip at a time, not {len(strips)}; chain files end in .toml")
    say = _quiet if options["quiet"] or not sys.stderr.isatty() else talk
    document = run_bench(
        BenchOptions(
            strip=strips[0] if strips else None,
            scenes=options["scenes"] or (() if strips else ("mixed",)),
            chains=tuple(path for path in files if path.suffix.lower() == ".toml"),
            tolerance_cm=parse_length(tolerance) if tolerance else None,
            **{name: options[name] for name in _PASSED},
        ),
        say,
    )
    text = format_document(document)
    if "promises" in document:
        text += "\n\n" + format_promises(document["promises"])
    for line in write_outputs(document, text, output) if output else []:
        talk(line)
    if as_json:
        print_json(document)
    else:
        click.echo(text)


_PASSED = ("seed", "waveforms", "pulses", "repeats", "all_methods", "peers", "stability", "hazards")
_PASSED += ("promises", "large")


def _quiet(text: str) -> None:
    """Says nothing."""
