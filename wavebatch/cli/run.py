"""`wavebatch run`: decompose strips into point clouds.

Only reads and checks options, starts the batch, shows its events (`Progress`: a bar, JSON lines on stdout, or a line
per strip on stderr) and turns its result into an exit code; the work is in `wavebatch.batch`.
"""

from __future__ import annotations

import json
import os
import sys
import traceback
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import click

from wavebatch.batch.options import OPTIONS, RunOptions
from wavebatch.cli import messages
from wavebatch.cli import options as shared
from wavebatch.core.errors import OF_FILES, WARNINGS, ConfigError, InputError, nearest
from wavebatch.core.process import importing
from wavebatch.core.units import count
from wavebatch.files.disk.publish import refuse_input
from wavebatch.files.disk.raw_bytes import Closing


class Progress(Closing):
    """Shows the events of a batch.

    kind: `bar`, `json`, `none`, or `auto`: a bar if stderr is a terminal. level: -1 shows errors only, 0 also a line
    per strip, 1 also how its points were processed.
    """

    def __init__(self, strips: Iterable[Path], kind: str, level: int, debug: bool) -> None:
        if kind == "auto":
            kind = "bar" if sys.stderr.isatty() and level >= 0 else "none"
        self._json = kind == "json"
        self.is_written = True
        """Whether all events could be written to stdout."""
        self._level = level
        self._debug = debug
        self._sizes = {str(path): _size(path) for path in strips}
        self._shown: dict[str, int] = {}
        self._bar = None
        if kind == "bar":
            from tqdm import tqdm

            total = sum(self._sizes.values())
            self._bar = tqdm(total=total, unit="B", unit_scale=True, file=sys.stderr, dynamic_ncols=True)

    def close(self) -> None:
        """Ends the bar."""
        if self._bar is not None:
            self._bar.close()

    def show(self, event: dict[str, Any]) -> None:
        """Shows one event of `run_batch`."""
        from wavebatch.core.echoes import REASONS, NoData

        error = event.get("error")
        if self._json:
            plain = event if error is None else {**event, "error": messages.one_line(error)}
            self._json = self.is_written = messages.print_safely(json.dumps(plain, sort_keys=True, ensure_ascii=False))
        kind, strip = event["event"], event["strip"]
        if self._bar is not None:
            share = event["done"] / event["of"] if kind == "unit" else float(kind != "start")
            done = round(self._sizes.get(strip, 0) * share)
            self._bar.set_description(Path(strip).name, refresh=False)
            self._bar.update(max(done - self._shown.get(strip, 0), 0))
            self._shown[strip] = done
        if error is not None and not event["again"]:
            if self._debug:
                self._say("".join(traceback.format_exception(error)).rstrip())
            name, line = messages.printable(strip), messages.one_line(error)
            self._say(f"error: {line}" if name in line else f"error: {name}: {line}")
        elif kind == "incomplete" and "decisions" not in event:
            cut = count(event["counts"]["points_cut"], "point")
            words = f"the packets of {cut} are missing; get its waveform data again, whole"
            self._say(messages.printable(f"{strip}: is incomplete as before: {words}"))
        elif kind in ("written", "incomplete"):
            self._tell(_summary(event, self._level > 0))
            for one in event["warnings"]:
                say = self._tell if one["code"] in OF_FILES else self._say
                say(messages.printable(f"{strip}: warning: {one['text']}"))
            chosen = [f"{one['part']}: {'yes' if one['needed'] else 'no'}: {one['reason']}"
                      for one in event["decisions"]]  # fmt: skip
            more = [*chosen, *_sensor_lines(event["sensor"])]
            for column, counts in sorted(event["counts"]["no_data"].items()):
                total = sum(counts.values())
                more += [f"{column}: no-data for {number} of {total} echoes: {REASONS[NoData[name]][0]}"
                         for name, number in counts.items() if name != NoData.KNOWN.name]  # fmt: skip
            for line in [*more * (self._level > 0), *event["remarks"]]:
                self._tell(f"{strip}: {line}")
        elif kind == "start" and event["outdated"]:
            self._tell(f"{strip}: is made again: {event['outdated']}")
        elif kind == "skipped":
            self._tell(f"{strip}: is up to date, skipped")
        elif kind == "flight" and self._level > 0:
            self._say(messages.printable(f"{strip}: survey of {count(event['strips'], 'strip')} together"))

    def _tell(self, line: str) -> None:
        """A message that --quiet leaves to the log."""
        if self._level >= 0:
            self._say(messages.printable(line))
        else:
            messages.log_text(messages.printable(line))

    def _say(self, line: str) -> None:
        if self._bar is not None:
            self._bar.clear()
        messages.write_message(line)
        messages.log_text(line)
        if self._bar is not None:
            self._bar.refresh()


def _size(path: Path) -> int:
    try:
        return os.path.getsize(path)
    except (OSError, ValueError):
        return 0


def _sensor_lines(sensor: dict[str, Any]) -> Iterator[str]:
    """The sensor's position and how exactly returns were placed, with their sources."""
    words = {
        "distance_m": "{:.0f} m away",
        "height_m": "{:.0f} m above the points",
        "speed_m_s": "{:.1f} m/s",
        "heading_deg": "heading {:.0f} degrees",
        "smoothness_m": "smooth to {:.3f} m",
        "range_error_m": "ranges to {:.3f} m",
    }
    parts = [text.format(sensor[key]) for key, text in words.items() if sensor.get(key) is not None]
    if parts:
        yield f"sensor from {sensor['source']}: {', '.join(parts)}"
    if returns := sensor.get("returns"):
        yield (
            f"returns were placed to {returns['scatter_m']:.3f} m, by {returns['from']}; an echo without a return is "
            f"off by {returns['phase_m']:.3f} m, or as far as the nearest return of its packet is from an echo"
        )


_COUNTED = {"points_in": "point", "waveforms": "waveform", "echoes": "echo"}


def _summary(event: dict[str, Any], long: bool) -> str:
    counts = event["counts"]
    passed = sum(counts["passed_through"].values())
    parts = [count(counts[key], name) for key, name in _COUNTED.items()]
    line = f"{event['strip']}: {', '.join(parts)}, {passed} passed through -> {count(counts['points_out'], 'point')}"
    left = {name: number for name, number in counts["left_out"].items() if number}
    if left:
        by = ", ".join(f"{number} by --{name.replace('_', '-')}" for name, number in left.items())
        line = f"{line}; left out: {by}"
    if not long:
        return line
    reasons, flags = (
        ", ".join(f"{name} {number}" for name, number in counts[key].items() if number) or "none"
        for key in ("passed_through", "flags")
    )
    return (
        f"{line}; returns matched {counts['matched_returns']}, unmatched {counts['unmatched_returns']}, echoes added "
        f"{counts['added_echoes']}; passed through: {reasons}; flags: {flags}"
    )


EXIT_UNREPORTED, EXIT_SOME_FAILED, EXIT_NOTHING = 1, 3, 4
"""All strips are written, but --report, --html or stdout could not be; some strips failed or lack packets; all failed.
"""


def _parse_codes(text: str) -> tuple[str, ...]:
    codes = tuple(code.strip() for code in text.split(","))
    for code in codes:
        if code not in ("warning", *WARNINGS):
            raise ConfigError(f"no warning has the code {code!r}; {nearest(code, ['warning', *WARNINGS])}")
    return tuple(WARNINGS) if "warning" in codes else codes


@click.command()
@shared.strips_argument
@shared.together(*(shared.declared(name, required=True) if name == "output" else shared.declared(name)
                   for name in OPTIONS if name != "recursive"))
@click.option("--dry-run", is_flag=True, help="Print what would be done with each strip; write nothing.")
@click.option("--report", type=shared.OutputPath(dir_okay=False, allow_dash=True), metavar="FILE",
              help="Write a summary of all strips as JSON; - is stdout. An existing FILE is replaced.")
@shared.html_option
@click.option("--fail-on", type=shared.Text("warning|CODES", _parse_codes), metavar="warning|CODES",
              help="Exit with code 3 if a strip has a warning, or one of these codes, e.g. pulse-guess,lost-packets.")
@click.option("--progress", type=click.Choice(["auto", "bar", "json", "none"]), default="auto", show_default=True,
              help="auto: a bar if stderr is a terminal; json: one line per event on stdout.")
@click.option("-v", "--verbose", is_flag=True, help="Print more about each strip.")
@shared.common_options("json", failure=EXIT_NOTHING)
def run(**options: Any) -> None:
    """Decompose strips into enriched point clouds.

    STRIP is a LAS or LAZ file with waveforms, a glob, a folder, or @list.txt with one of these per line. Each strip
    gives DIR/<stem>.laz and DIR/<stem>.report.json. The report is written last: if it exists, the cloud is complete.

    \b
    Exit codes:
      0    all strips are written
      1    all strips are written, but --report, --html or stdout cannot be written
      2    wrong usage or chain file, nothing was started; or no chain meets the tolerance
      3    some strips failed, the others are written; or packets of some are missing (see docs/reliability.md), or
           a strip has a warning of --fail-on
      4    all strips failed
      130  interrupted; --resume continues

    Examples:
      # one strip; the chain is chosen by a survey of it
      wavebatch run strip.las -o clouds
      # a flight on all processors, with a report page
      wavebatch run strips/ -o clouds --survey flight --jobs 0 --html run.html
      # go on after an interruption
      wavebatch run strips/ -o clouds --resume
      # with a trajectory, and the range as a column
      wavebatch run strip.las -o clouds --trajectory flight.txt --columns +range
      # show chain, columns and sizes; write nothing
      wavebatch run strip.las -o clouds --dry-run
    """  # fmt: skip
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    report, output = options["report"], os.path.abspath(options["output"])
    for name, target in (("--report", None if report == "-" else report), ("--html", options["html_file"])):
        folder = None if target is None else Path(os.path.abspath(target)).parent
        if folder and not folder.is_dir() and not folder.is_relative_to(output):  # folders in the output are made
            raise ConfigError(f"{name}: folder {Path(target).parent} does not exist; make it first")
    on_stdout = [*["--report -"][: report == "-"], *["--json"][: options["as_json"]]]
    on_stdout += ["--progress json"][: options["progress"] == "json"]
    if len(on_stdout) > 1:
        remedy = "give the report a file" if report == "-" else "leave one out"
        raise ConfigError(f"{' and '.join(on_stdout)} would both write to stdout; {remedy}")
    try:
        # The processes that will surely be needed start before this one imports what it needs itself. A limit of memory
        # may allow fewer, and resume may find nothing to do.
        wanted = options["jobs"] or os.cpu_count() or 1
        if wanted > 1 and not (options["memory"] or options["resume"] or options["dry_run"]):
            from wavebatch.batch.workers.spawned import end_early, start_early

            click.get_current_context().call_on_close(end_early)  # where an option is wrong, no run takes them
            start_early(wanted)
        with importing():
            from wavebatch.batch.run import find_outputs
            from wavebatch.tools.api import plan_run

        jobs, batch_options = plan_run(options["strips"], shared.from_options(RunOptions, options), shared.note_input)
        for option, target in (("--report", options["report"]), ("--html", options["html_file"])):
            if target not in (None, "-"):  # it must not replace a file that is read or written by this run
                refuse_input(Path(target))
                outputs = {os.path.realpath(path) for job in jobs for path in find_outputs(job, batch_options.folder)}
                if os.path.realpath(target) in outputs:
                    raise ConfigError(f"{option}: {target} is an output of a strip; choose another name")
        if options["html_file"] is not None:
            shared.check_html(options["html_file"], will_exist=True)
        if options["dry_run"]:
            sys.exit(_dry_run(jobs, batch_options, options))
        sys.exit(_run(jobs, batch_options, options))
    except KeyboardInterrupt:
        text = "interrupted: finished clouds are complete, no partial file remains; --resume continues"
        raise messages.Interrupted(text) from None


def _run(jobs: list[Any], batch_options: Any, options: dict[str, Any]) -> int:
    from wavebatch.batch.run import run_batch

    level, is_new = -1 if options["quiet"] else int(options["verbose"]), not os.path.exists(batch_options.folder)
    with Progress([job.path for job in jobs], options["progress"], level, options["debug"]) as progress:
        result = run_batch(jobs, batch_options, progress.show)
    if level > 0:
        timing = result.to_json()["timing"]
        parts = ", ".join(f"{name} {seconds:.2f} s" for name, seconds in sorted(timing["processor_seconds"].items()))
        messages.talk(f"{timing['elapsed_seconds']:.1f} s elapsed" + (f"; processor time: {parts}" if parts else ""))
        if advice := result.advice:
            messages.talk(advice)
    is_reported = _report(result.to_json(), options["report"]) and progress.is_written
    is_reported &= not options["as_json"] or _report(result.to_json(), "-")
    is_reported = _write_page(result, batch_options.folder, options) and is_reported
    code = find_exit_code([outcome.error for outcome in result.outcomes])
    if code == messages.EXIT_USAGE and is_new:  # wrong usage leaves nothing
        with suppress(OSError):
            batch_options.folder.rmdir()
    # Strips that --resume skipped have their warnings too.
    codes = set(options["fail_on"] or ())
    warned = [one.job.path for one in result.outcomes if {w.code for w in one.report.warnings} & codes]
    if not code and warned:
        some = f"{count(len(warned), 'strip')} with such a warning, the first is {warned[0]}"
        messages.talk(f"error: --fail-on: {some}; the clouds are written")
    if not code and (warned or any(outcome.status == "incomplete" for outcome in result.outcomes)):
        code = EXIT_SOME_FAILED
    return code or (0 if is_reported else EXIT_UNREPORTED)


def _report(document: dict[str, Any], target: str | None) -> bool:
    """Writes the summary; returns whether that worked. The clouds are written, whatever becomes of it."""
    from wavebatch.batch.report_file import format_report
    from wavebatch.files.text_file import write_text

    if target == "-":
        return messages.print_safely(messages.format_json(document))
    try:
        if target is not None:
            Path(target).parent.mkdir(parents=True, exist_ok=True)
            write_text(Path(target), format_report(document), overwrite=True)
    except InputError as error:
        messages.talk(f"error: --report: {messages.one_line(error)}")
        return False
    return True


def _write_page(result: Any, folder: Path, options: dict[str, Any]) -> bool:
    """Writes the page of --html; returns whether that worked or was not asked for."""
    target = options["html_file"]
    if target is None:
        return True
    from wavebatch.tools.sheets.run import write_run_page

    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        write_run_page(target, result, folder, messages.typed_command(click.get_current_context()))
    except Exception as error:  # the clouds are written, whatever becomes of the page
        if options["debug"]:
            traceback.print_exc()
        messages.talk(f"error: --html: {messages.one_line(error)}")
        return False
    messages.tell(f"{target}: written")
    return True


def find_exit_code(errors: Sequence[BaseException | None]) -> int:
    """The exit code for the errors of the strips, None for those that are written; all wrong options are wrong usage.
    """
    failed = [error for error in errors if error is not None]
    if not failed or len(failed) < len(errors):
        return EXIT_SOME_FAILED if failed else 0
    return messages.EXIT_USAGE if all(isinstance(error, ConfigError) for error in failed) else EXIT_NOTHING


def _dry_run(jobs: list[Any], batch_options: Any, options: dict[str, Any]) -> int:
    from wavebatch.batch.run import plan_strip
    from wavebatch.stages.chain import effective

    errors: list[BaseException | None] = []
    plans, as_json = [], options["as_json"]
    for job in jobs:
        try:
            plan = plan_strip(job, batch_options)
        except Exception as error:
            errors.append(error)
            if options["debug"]:
                traceback.print_exc()
            messages.talk(f"error: {messages.one_line(error)}")
            continue
        errors.append(None)
        plans.append(plan)
        line = (
            f"{plan['strip']}: {plan['action']} {plan['output']}: {count(plan['points'], 'point')}, format "
            f"{plan['point_format']} -> {plan['output_point_format']}, {plan['packet_bytes'] / 1e6:.1f} MB of packets, "
            f"about {plan['estimated_bytes'] / 1e6:.1f} MB to write; columns {', '.join(plan['columns'])}"
        )
        if not as_json:
            messages.print_text(messages.printable(line))
    for line in () if as_json else click.get_current_context().meta.get("wavebatch.settings", ()):
        messages.print_text(f"# setting: {line}")
    by = jobs[0].request.describe()
    messages.answer({"strips": plans, "chosen_by": by, "chain": effective(jobs[0].chain)}, mode="plan")
    if not as_json:
        words = "" if by is None else f"\n# the chain is chosen per strip ({by}); the largest possible one:"
        click.echo(f"{words}\n{effective(jobs[0].chain)}", nl=False)
    return find_exit_code(errors)
