"""`wavebatch bench`: error against run time.

Only reads options and prints; the measurements are in `wavebatch.tools.bench`.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from wavebatch.cli.messages import format_json, one_line, print_json, print_result, talk
from wavebatch.cli.options import (
    check_html,
    common_options,
    from_options,
    html_option,
    output_option,
    parse_length,
    seed_option,
)
from wavebatch.cli.program.completion import complete_scenes
from wavebatch.core.errors import InputError

_MODES = {
    "real": ("seed", "stability"),
    "against": ("scenes", "pulses", "repeats", "seed"),
    "jobs_model": ("scenes", "pulses", "repeats", "seed"),
}
"""Modes that measure something else, and the options that they use."""
_ALWAYS = ("files", "output", "html_file", "as_json", "quiet", "log_path", "log_level", "debug")

JOBS_PULSES = 600_000
"""Of the strip of --jobs-model: more than ten units."""

SMALL_PULSES = 1_000
"""Of the strips that show what a strip costs, however small."""


@click.command()
@click.argument("files", nargs=-1, type=click.Path(path_type=Path), metavar="[STRIP...] [CHAIN...]")
@click.option("--scene", "scenes", multiple=True, metavar="NAME", shell_complete=complete_scenes,
              help="Simulate this scene: mixed, open, forest, empty, flat or stiff; may be repeated.")
@click.option("--waveforms", type=click.IntRange(1), default=65_536, show_default=True, metavar="N",
              help="Simulated waveforms per scene.")
@click.option("--pulses", type=click.IntRange(0), default=50_000, show_default=True, metavar="N",
              help="Pulses of the strip that is timed from file to file; 0: time the algorithms only.  "
              "[with --jobs-model: 600000]")
@click.option("--repeat", "repeats", type=click.IntRange(1), default=3, show_default=True, metavar="N",
              help="Repetitions of the timing.")
@seed_option("Seed of the simulated waveforms.")
@click.option("--tolerance", metavar="LENGTH",
              help="Name the cheapest chain whose range error of isolated echoes is at most this, e.g. 0.02m.")
@click.option("--peers/--no-peers", default=True, help="Measure gdecomp (if there) and scipy too.  [default: peers]")
@click.option("--all-methods", is_flag=True, help="Also measure every detector and every decomposer.")
@click.option("--stability/--no-stability", default=True,
              help="Measure the stiff and extreme cases.  [default: stability]")
@click.option("--hazard", "hazards", multiple=True, metavar="H1..H16",
              help="Measure only the cases of this hazard; may be repeated.")
@click.option("--promises", is_flag=True, help="Also measure and list what each release promises.")
@click.option("--large", is_flag=True, envvar="BENCH_LARGE",
              help="With --promises: measure memory for 10^7 pulses too.")
@click.option("--real", is_flag=True,
              help="Inject echoes into the waveforms of each STRIP and count those found, count false echoes, and "
              "compare surveys of parts of the strip (not with --no-stability).")
@click.option("--against", type=click.Path(exists=True, file_okay=False, path_type=Path), metavar="DIR",
              help="Time whole runs of each STRIP or scene by the wavebatch in DIR, the top folder of another "
              "checkout, and by this one, in turn; print the ratios and their range.")
@click.option("--jobs-model", is_flag=True,
              help="Measure what each part of a run costs in each process, with one and with two jobs, and print what "
              "up to 64 jobs reach on as many cores.")
@output_option("Folder for bench.json, bench.txt and the plots. Existing files are replaced.", "DIR", required=False,
               folder=True)
@html_option
@common_options("json", "quiet")
def bench(
    files: tuple[Path, ...], output: Path | None, tolerance: str | None, against: Path | None,
    html_file: Path | None, **options: Any,
) -> None:
    """Measure error and run time of all shipped chains, of CHAIN files (.toml) and of other decomposers.

    Waveforms with known echoes are simulated like those of STRIP: its noise, baselines, pulse and echoes come from a
    survey of it. Without STRIP, named scenes are simulated (default: mixed). The table has one row per chain and the
    standard error of each figure.

    With --real nothing is simulated: clear echoes of each STRIP, scaled and shifted, are added to its other waveforms.
    The tables show which of them are found, how right their errors are, false echoes, and surveys of halves and tiles.

    With --jobs-model runs of STRIP, or of one scene, take turns with one and with two jobs. The strip should have
    500,000 waveforms or more; below 100,000 nothing is predicted.

    With --against nothing but speed is measured, of this wavebatch and another: speeds of a shared machine change,
    ratios of runs that take turns hardly do.

    Exit code: 0 done, 1 the strip cannot be read or the folder cannot be written, 2 wrong usage.
    """  # fmt: skip
    from wavebatch.tools.bench.command import BenchOptions, run_bench
    from wavebatch.tools.bench.promises import format_promises
    from wavebatch.tools.bench.report import format_document, write_outputs

    check_html(html_file)
    _refuse_others(click.get_current_context())
    strips = [path for path in files if path.suffix.lower() != ".toml"]
    silent = options["quiet"] or not sys.stderr.isatty()
    say = (lambda text: None) if silent else talk
    if options["real"] or options["jobs_model"] or against is not None:
        _bench_mode(files, strips, output, against, html_file, options, say)
        return
    if len(strips) > 1:
        raise click.UsageError(f"one strip at a time, not {len(strips)}; chain files end in .toml")
    settings = from_options(
        BenchOptions,
        options,
        strip=strips[0] if strips else None,
        scenes=options["scenes"] or (() if strips else ("mixed",)),
        chains=tuple(path for path in files if path.suffix.lower() == ".toml"),
        tolerance_cm=parse_length(tolerance) if tolerance else None,
    )
    document = run_bench(settings, say)
    text = format_document(document)
    if "promises" in document:
        text += "\n\n" + format_promises(document["promises"])
    for line in write_outputs(document, text, output) if output else []:
        talk(line)
    if html_file is not None:
        from wavebatch.tools.html.bench_page import write_bench_page

        write_bench_page(html_file, document, text)
        talk(f"{html_file}: written")
    print_result(options["as_json"], document, [text])


def _bench_mode(
    files: Sequence[Path], strips: Sequence[Path], output: Path | None, against: Path | None, html_file: Path | None,
    options: Mapping[str, Any], say: Callable[[str], None],
) -> None:  # fmt: skip
    """Measures what --real, --against or --jobs-model asks for."""
    if options["real"]:
        if not strips or len(strips) < len(files):
            raise click.UsageError("--real needs strips to measure, and no chain file: their surveys choose the chain")
        _bench_real(strips, output, html_file, options, say)
    elif against is not None:
        if html_file is not None:
            raise click.UsageError("--against has no page: leave --html out; -o writes its table")
        _bench_against(against, strips, files, output, options, say)
    else:
        if html_file is not None or len(files) > 1 or len(strips) < len(files):
            raise click.UsageError("--jobs-model times one strip by the automatic chain, and has no page")
        if len(options["scenes"]) > 1:
            raise click.UsageError(f"--jobs-model times one scene, not {len(options['scenes'])}; give --scene once")
        _bench_jobs(strips, output, options, say)


def _list_given(context: click.Context) -> dict[str, str]:
    """The parameters that the command line gives, by name, as they are written there."""
    return {
        one.name: one.opts[0]
        for one in context.command.params
        if context.get_parameter_source(one.name) is ParameterSource.COMMANDLINE
    }


def _refuse_others(context: click.Context) -> None:
    """UsageError for options of the command line that the mode does not use, or that need no STRIP."""
    given = _list_given(context)
    mode = next((name for name in _MODES if name in given), None)
    if mode is None:
        return
    for name in given.keys() - {mode, *_MODES[mode], *_ALWAYS}:
        raise click.UsageError(f"{given[name]} has no meaning with {given[mode]}")
    if "files" in given:
        for name in given.keys() & {"scenes", "pulses"}:
            raise click.UsageError(f"{given[name]} is for simulated strips: leave it or STRIP out")


def _bench_against(
    other: Path,
    strips: Sequence[Path],
    files: Sequence[Path],
    output: Path | None,
    options: Mapping[str, Any],
    say: Callable[[str], None],
) -> None:
    """Times runs of strips, or of simulated scenes, by two checkouts."""
    from wavebatch.tools.bench.paired.compare import compare_runs, format_paired, simulate_strips, to_document

    if len(strips) < len(files):
        raise click.UsageError("--against compares runs of the automatic chain: leave chain files out")
    if not strips and not options["pulses"]:
        raise click.UsageError("--against times strips: --pulses must be more than 0")
    with tempfile.TemporaryDirectory(prefix="wavebatch-bench-") as folder:
        named = {path.name: path for path in strips}
        if not strips:
            scenes = options["scenes"] or ("mixed", "open", "forest", "empty")
            named = simulate_strips(scenes, options["pulses"], options["seed"], Path(folder))
        found = compare_runs(other, named, options["repeats"], say=say)
    text, document = format_paired(other, found), to_document(other, found)
    _show(options["as_json"], output, text, document, "against")


def _bench_jobs(
    strips: Sequence[Path], output: Path | None, options: Mapping[str, Any], say: Callable[[str], None]
) -> None:
    """Times the parts of a run, and predicts what many jobs reach."""
    from wavebatch.tools.bench.paired.compare import simulate_strips
    from wavebatch.tools.bench.paired.jobs import format_jobs, measure_jobs, to_document

    pulses = options["pulses"] if "pulses" in _list_given(click.get_current_context()) else JOBS_PULSES
    if not strips and not pulses:
        raise click.UsageError("--jobs-model times strips: --pulses must be more than 0")
    with tempfile.TemporaryDirectory(prefix="wavebatch-bench-") as name:
        folder = Path(name)
        scene = (options["scenes"] or ("mixed",))[0]
        strip = strips[0] if strips else simulate_strips([scene], pulses, options["seed"], folder)[scene]
        (folder / "small").mkdir()
        small = simulate_strips([scene], SMALL_PULSES, options["seed"], folder / "small")[scene]
        found = measure_jobs(strip, small, folder / "out", options["repeats"], say)
    text, document = format_jobs(strip.name, *found), to_document(strip.name, *found)
    _show(options["as_json"], output, text, document, "jobs")


def _show(as_json: bool, output: Path | None, text: str, document: Mapping[str, Any], mode: str) -> None:
    """Prints the figures of a mode, and writes them as MODE.txt and MODE.json into the folder of -o."""
    from wavebatch.tools.bench.report import write_texts

    if output is not None:
        talk(write_texts(output, {f"{mode}.txt": text, f"{mode}.json": format_json(document)}))
    print_result(as_json, document, [text], mode)


def _bench_real(
    strips: Sequence[Path], output: Path | None, html_file: Path | None, options: Mapping[str, Any],
    say: Callable[[str], None],
) -> None:  # fmt: skip
    """Measures strip after strip; one that cannot be measured is named, and the others go on."""
    from wavebatch.tools.bench.real.measure import measure_real
    from wavebatch.tools.bench.real.report import format_report, write_report

    reports, failed = [], False
    for path in strips:
        try:
            report = measure_real(path, seed=options["seed"], stability=options["stability"], say=say)
        except InputError as error:
            failed = True
            talk(f"error: {one_line(error)}")
            continue
        reports.append(report)
        if output:
            talk(write_report(report, output))
        if not options["as_json"]:
            click.echo(format_report(report) + "\n")
    if html_file is not None and reports:
        from wavebatch.tools.html.bench_page import write_real_page

        write_real_page(html_file, [(report.strip, format_report(report)) for report in reports])
        talk(f"{html_file}: written")
    if options["as_json"]:
        print_json({"strips": [asdict(report) for report in reports]}, "real")
    if failed:
        sys.exit(1)
