"""`wavebatch run`: decompose strips into point clouds.

Only reads and checks options, starts the batch and turns its result into an exit code; the work is in
`wavebatch.batch`. `plot waveform` also uses `choose_chain`.
"""

from __future__ import annotations

import os
import re
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from wavebatch.cli.messages import (
    EXIT_USAGE,
    Interrupted,
    count,
    format_json,
    one_line,
    print_json,
    print_safely,
    print_text,
    printable,
    talk,
)
from wavebatch.cli.options import (
    OutputPath,
    air_options,
    calibration_option,
    chain_options,
    check_html,
    common_options,
    file_option,
    floats_reader,
    html_option,
    output_option,
    read_air,
    read_sensor,
    sensor_options,
    strip_options,
    strips_argument,
    system_option,
    where_option,
)
from wavebatch.cli.program.completion import complete_flags, complete_written
from wavebatch.cli.program.log_file import typed_command
from wavebatch.cli.program.progress import Progress
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.files.disk.protect import refuse_input

EXIT_UNREPORTED, EXIT_SOME_FAILED, EXIT_NOTHING = 1, 3, 4
"""All strips are written, but --report, --html or stdout could not be; some strips failed; all strips failed."""

_UNITS = {"": 1, "K": 1 << 10, "M": 1 << 20, "G": 1 << 30, "T": 1 << 40}


def _read_size(context: click.Context, parameter: click.Parameter, text: str | None) -> int | None:
    """Bytes from `800M`, `2G` or a plain number."""
    if text is None:
        return None
    found = re.fullmatch(r"(\d+\.?\d*|\.\d+)([KMGT]?)(I?B)?", text.strip().upper())
    size = int(float(found[1]) * _UNITS[found[2]]) if found else 0
    if not size:
        raise click.BadParameter(f"{text!r} is not a size such as 800M or 2G")
    return size


def _read_classes(context: click.Context, parameter: click.Parameter, text: str | None) -> tuple[int, ...] | None:
    if text is None:
        return None
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError:
        raise click.BadParameter(f"{text!r} is no list of numbers such as 2,6") from None


@click.command()
@strips_argument
@output_option("Folder for clouds and reports; created if it does not exist.", "DIR", folder=True)
@chain_options
@click.option("--tolerance", metavar="LENGTH",
              help="For each strip, choose the cheapest shipped chain whose predicted range error is at most this, "
              "e.g. 0.02m.")
@system_option
@click.option("--survey", type=click.Choice(["each", "flight"]), default="each", show_default=True,
              help="Survey each strip alone, or all strips once: kept as DIR/flight.system.toml, used again with "
              "--resume and for later strips; a strip that does not fit it is named and surveyed alone.")
@sensor_options
@calibration_option
@air_options
@strip_options
@click.option("--points", type=click.Choice(["echoes", "returns"]), default="echoes", show_default=True,
              help="Write one point per echo, or the input points with the attributes of their echoes.")
@where_option("Write only points")
@click.option("--drop-flags", metavar="NAMES", shell_complete=complete_flags,
              help="Leave out points with one of these flags, e.g. RINGING_SUSPECT,WEAK; return numbers are counted "
              "without them.")
@click.option("--classes", callback=_read_classes, metavar="LIST", help="Write only points of these classes, e.g. 2,6.")
@click.option("--bbox", callback=floats_reader("WEST,SOUTH,EAST,NORTH"), metavar="W,S,E,N",
              help="Write only points of this part: west, south, east, north, in the coordinates of the strips.")
@file_option("--polygon", metavar="FILE.geojson",
             text="Write only points inside these polygons, in WGS 84, in the CRS that the file names, or in the "
                  "coordinates of the strips.")
@click.option("--columns", metavar="LIST", shell_complete=complete_written,
              help="a,b writes only these columns; +a,+b adds them to the usual ones. The automatic chain and the "
              "shipped ones get the stages that make them.")
@click.option("--names", type=click.Choice(["wavebatch", "asprs", "riegl", "pdal", "opals"]), default="wavebatch",
              show_default=True, help="Naming scheme for names and units of the extra bytes.")
@click.option("--format", "file_format", type=click.Choice(["laz", "las"]), default="laz", show_default=True,
              help="File format of the clouds.")
@click.option("--point-format", type=click.IntRange(0, 10), metavar="0-10",
              help="LAS point format of the clouds.  [default: 6, or 7 or 8 where the strip has colours]")
@click.option("--las-version", type=click.Choice(["1.4", "1.3", "keep"]), default="1.4", show_default=True,
              help="LAS version of the clouds. PDAL and QGIS read extra bytes only from LAS 1.4; keep: that of the "
              "strip, with its point format.")
@click.option("--no-data", type=click.Choice(["-9999", "nan"]), default="-9999", show_default=True,
              help="What floating-point columns hold where an echo has no value; declared in the cloud.")
@click.option("--strict", is_flag=True, help="Fail where extra bytes of the strip have no free value to mark added "
              "echoes; these get the value of the nearest return otherwise.")
@click.option("--keep-packets", is_flag=True, help="Copy the waveforms too: point format and packets stay as they are.")
@click.option("--jobs", type=click.IntRange(0), metavar="N",
              help="Processes; 0: one per processor. The result does not depend on it.  [default: 1]")
@click.option("--scheduler", metavar="ADDRESS",
              help="Use the workers of this dask cluster instead of --jobs, e.g. tcp://10.0.0.1:8786. They must see "
              "strips and DIR under the same paths, and have the same wavebatch.")
@click.option("--memory", callback=_read_size, metavar="SIZE", help="Most memory of all processes together, e.g. 2G.")
@click.option("--block-size", type=click.IntRange(1), metavar="N",
              help="Waveforms processed at once. The result does not depend on it.  [default: by their length]")
@click.option("--resume", is_flag=True, help="Skip strips whose output is complete and up to date; redo the others.")
@click.option("--dry-run", is_flag=True, help="Print what would be done with each strip; write nothing.")
@click.option("--report", type=OutputPath(dir_okay=False, allow_dash=True), metavar="FILE",
              help="Write a summary of all strips as JSON; - is stdout. An existing FILE is replaced.")
@html_option
@click.option("--progress", type=click.Choice(["auto", "bar", "json", "none"]), default="auto", show_default=True,
              help="auto: a bar if stderr is a terminal; json: one line per event on stdout.")
@click.option("-v", "--verbose", is_flag=True, help="Print more about each strip.")
@common_options("overwrite", "json", "quiet", failure=EXIT_NOTHING)
def run(**options: Any) -> None:
    """Decompose strips into enriched point clouds.

    STRIP is a LAS or LAZ file with waveforms, a glob, a folder, or @list.txt with one of these per line. Each strip
    gives DIR/<stem>.laz and DIR/<stem>.report.json. The report is written last: if it exists, the cloud is complete.

    \b
    Exit codes:
      0    all strips are written
      1    all strips are written, but --report, --html or stdout cannot be written
      2    wrong usage or chain file, nothing was started; or no chain meets the tolerance
      3    some strips failed, the others are written
      4    all strips failed
      130  interrupted; --resume continues
    """  # fmt: skip
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    _check_options(options)
    try:
        _start_processes(options)
        jobs, batch_options = _plan(options)
        if options["report"] not in (None, "-"):
            _check_report(Path(options["report"]), jobs, batch_options)
        if options["html_file"] is not None:
            _check_report(options["html_file"], jobs, batch_options, "--html")
            check_html(options["html_file"])
        if options["dry_run"]:
            sys.exit(_dry_run(jobs, batch_options, options))
        sys.exit(_run(jobs, batch_options, options))
    except KeyboardInterrupt:
        text = "interrupted: finished clouds are complete, no partial file remains; --resume continues"
        raise Interrupted(text) from None


def _start_processes(options: dict[str, Any]) -> None:
    """Start the worker processes that will surely be needed, before this process imports what it needs itself."""
    jobs = 1 if options["jobs"] is None else options["jobs"] or os.cpu_count() or 1
    # A limit of memory may allow fewer processes, and resume may find nothing to do.
    if jobs > 1 and not (options["memory"] or options["resume"] or options["dry_run"]):
        from wavebatch.batch.workers.processes import end_early, start_early

        click.get_current_context().call_on_close(end_early)  # where an option is wrong, no run takes them
        start_early(jobs)


def _check_options(options: dict[str, Any]) -> None:
    report = options["report"]
    if report not in (None, "-") and not Path(report).absolute().parent.is_dir():
        raise ConfigError(f"--report: folder {Path(report).parent} does not exist; make it first")
    on_stdout = [*["--report -"][: report == "-"], *["--json"][: options["as_json"]]]
    on_stdout += ["--progress json"][: options["progress"] == "json"]
    if len(on_stdout) > 1:
        raise ConfigError(f"{' and '.join(on_stdout)} would both write to stdout; give the report a file")


def _check_report(report: Path, jobs: list[Any], batch_options: Any, option: str = "--report") -> None:
    """Raises ConfigError if the summary would replace a file that is read or written by this run."""
    from wavebatch.batch.preflight import find_outputs

    refuse_input(report)
    outputs = {os.path.realpath(path) for job in jobs for path in find_outputs(job, batch_options.folder)}
    if os.path.realpath(report) in outputs:
        raise ConfigError(f"{option}: {report} is an output of a strip; choose another name")


_PASSED_ON = (
    "energy", "columns", "points", "point_format", "las_version", "names", "no_data", "strict", "keep_packets",
    "direction", "headerless", "scheduler", "memory", "block_size", "overwrite", "resume", "where", "drop_flags",
    "classes", "bbox", "polygon",
)  # fmt: skip
"""Options that `plan_run` takes under the same names."""


def _plan(options: dict[str, Any]) -> tuple[list[Any], Any]:
    """Jobs and options of the batch; raises ConfigError for whatever is wrong with them."""
    from wavebatch.tools.api.run import plan_run

    return plan_run(
        options["strips"],
        options["output"],
        chain=options["chain_file"] or options["profile"],
        tolerance=_read_tolerance(options["tolerance"]),
        system=options["system_file"],
        force=options["force"],
        recursive=options["recursive"],
        survey=options["survey"],
        sensor=read_sensor(options),
        calibration=options["calibration_file"],
        attenuation=read_air(options),
        format=options["file_format"],
        jobs=1 if options["jobs"] is None else options["jobs"],
        **{name: options[name] for name in _PASSED_ON},
    )


def _read_tolerance(text: str | None) -> float | None:
    """The length in m."""
    from wavebatch.cli.options import parse_length

    try:
        return None if text is None else parse_length(text) / 100
    except ConfigError as error:
        raise ConfigError(f"--tolerance: {error}") from error


def _run(jobs: list[Any], batch_options: Any, options: dict[str, Any]) -> int:
    from wavebatch.batch.run import run_batch

    level = -1 if options["quiet"] else int(options["verbose"])
    with Progress([job.path for job in jobs], options["progress"], level, options["debug"]) as progress:
        result = run_batch(jobs, batch_options, progress.show)
    if level > 0:
        timing = result.to_json()["timing"]
        parts = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in sorted(timing["seconds"].items()))
        talk(f"{timing['elapsed_seconds']:.1f} s elapsed" + (f"; of the processes' time: {parts}" if parts else ""))
        if result.advice:
            talk(result.advice)
    is_reported = _report(result.to_json(), options["report"]) and progress.is_written
    is_reported &= not options["as_json"] or _report(result.to_json(), "-")
    is_reported = _write_page(result, batch_options.folder, options) and is_reported
    return find_exit_code([outcome.error for outcome in result.outcomes]) or (0 if is_reported else EXIT_UNREPORTED)


def _report(document: dict[str, Any], target: str | None) -> bool:
    """Writes the summary; returns whether that worked. The clouds are written, whatever becomes of it."""
    from wavebatch.batch.report_file import write_json

    if target == "-":
        return print_safely(format_json(document))
    try:
        if target is not None:
            write_json(Path(target), document, overwrite=True)
    except InputError as error:
        talk(f"error: --report: {one_line(error)}")
        return False
    return True


def _write_page(result: Any, folder: Path, options: dict[str, Any]) -> bool:
    """Writes the page of --html; returns whether that worked or was not asked for."""
    target = options["html_file"]
    if target is None:
        return True
    from wavebatch.tools.html.run_page import write_run_page

    try:
        write_run_page(target, result, folder, typed_command(click.get_current_context()))
    except Exception as error:  # the clouds are written, whatever becomes of the page
        if options["debug"]:
            traceback.print_exc()
        talk(f"error: --html: {one_line(error)}")
        return False
    if not options["quiet"]:
        talk(f"{target}: written")
    return True


def find_exit_code(errors: Sequence[BaseException | None]) -> int:
    """The exit code for the errors of the strips, None for those that are written; all wrong options are wrong usage.
    """
    failed = [error for error in errors if error is not None]
    if not failed or len(failed) < len(errors):
        return EXIT_SOME_FAILED if failed else 0
    return EXIT_USAGE if all(isinstance(error, ConfigError) for error in failed) else EXIT_NOTHING


def _dry_run(jobs: list[Any], batch_options: Any, options: dict[str, Any]) -> int:
    from wavebatch.batch.preflight import plan_strip
    from wavebatch.stages.chain_file import effective

    errors: list[BaseException | None] = []
    plans, as_json = [], options["as_json"]
    for job in jobs:
        try:
            plan = plan_strip(job, batch_options)
        except Exception as error:
            errors.append(error)
            if options["debug"]:
                traceback.print_exc()
            talk(f"error: {one_line(error)}")
            continue
        errors.append(None)
        plans.append(plan)
        line = (
            f"{plan['strip']}: {plan['action']} {plan['output']}: {count(plan['points'], 'point')}, format "
            f"{plan['point_format']} -> {plan['output_point_format']}, {plan['packet_bytes'] / 1e6:.1f} MB of packets, "
            f"about {plan['estimated_bytes'] / 1e6:.1f} MB to write; columns {', '.join(plan['columns'])}"
        )
        if not as_json:
            print_text(printable(line))
    for line in () if as_json else click.get_current_context().meta.get("wavebatch.settings", ()):
        print_text(f"# setting: {line}")
    by = jobs[0].request.describe(jobs[0].chain)
    if as_json:
        print_json({"strips": plans, "chosen_by": by, "chain": effective(jobs[0].chain)}, "plan")
        return find_exit_code(errors)
    if by is not None:
        click.echo(f"\n# the chain is chosen per strip ({by}); the largest possible one:", nl=False)
    click.echo(f"\n{effective(jobs[0].chain)}", nl=False)
    return find_exit_code(errors)
