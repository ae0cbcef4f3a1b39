"""`wavebatch bench`: error against run time."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from wavebatch.cli.messages import debug_option, one_line, print_json, report_errors, talk
from wavebatch.cli.options import json_option


@click.command()
@click.argument("files", nargs=-1, type=click.Path(path_type=Path), metavar="[STRIP...] [CHAIN...]")
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
@click.option(
    "--real", is_flag=True, help="Inject echoes into the STRIPs' own waveforms, and compare surveys of their parts."
)
@json_option("Print the JSON document in place of the tables.")
@click.option("-q", "--quiet", is_flag=True, help="No progress on stderr.")
@debug_option
@report_errors()
def bench(files: tuple[Path, ...], output: Path | None, tolerance: str | None, as_json: bool, **options) -> None:
    """Error against run time of every shipped chain, the CHAIN files (.toml) and other decomposers.

    Waveforms with known echoes are simulated like those of STRIP: its noise, baselines, pulse and echoes, as its own
    survey finds them; or of named scenes (default: mixed). One row per chain; every figure with its standard error.

    With --real nothing is simulated: clear echoes of each STRIP, scaled and shifted, are added to its own waveforms.
    It reports which of them are found and how right their errors are, false echoes, and surveys of halves and tiles.
    Exit code: 0, 1 where the strip cannot be read or the folder not be written, 2 wrong usage.
    """
    from wavebatch.cli.options import parse_length
    from wavebatch.tools.bench.command import BenchOptions, run_bench
    from wavebatch.tools.bench.promises import format_promises
    from wavebatch.tools.bench.report import format_document, write_outputs

    strips = [path for path in files if path.suffix.lower() != ".toml"]
    say = _quiet if options["quiet"] or not sys.stderr.isatty() else talk
    if options["real"]:
        _bench_real(files, output, as_json, say, seed=options["seed"], stability=options["stability"])
        return
    if len(strips) > 1:
        raise click.UsageError(f"one strip at a time, not {len(strips)}; chain files end in .toml")
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


def _bench_real(
    strips: tuple[Path, ...], output: Path | None, as_json: bool, say: Callable[[str], None], **options: Any
) -> None:
    """Measures strip after strip; one that cannot be measured is named, and the others go on."""
    from wavebatch.core.errors import InputError
    from wavebatch.tools.bench.real import measure_real
    from wavebatch.tools.bench.real.report import format_report, write_report

    if not strips:
        raise click.UsageError("--real needs the strips to measure")
    if any(path.suffix.lower() == ".toml" for path in strips):
        raise click.UsageError("--real measures the chain that a strip's survey chooses; leave chain files out")
    reports, failed = [], 0
    for path in strips:
        try:
            reports.append(measure_real(path, say=say, **options))
        except InputError as error:
            failed += 1
            talk(f"error: {one_line(error)}")
            continue
        if output:
            talk(write_report(reports[-1], output))
        if not as_json:
            click.echo(format_report(reports[-1]) + "\n")
    if as_json:
        print_json({"strips": [report.to_json() for report in reports]})
    if failed:
        sys.exit(1)


_PASSED = ("seed", "waveforms", "pulses", "repeats", "all_methods", "peers", "stability", "hazards")
_PASSED += ("promises", "large")


def _quiet(text: str) -> None:
    """Says nothing."""
