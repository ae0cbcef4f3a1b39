"""What the commands print: messages, progress and one-line errors on stderr, results as text or JSON on stdout.

Every command of `wavebatch.cli` uses this module. stdout holds only results, so that programs can read it; everything
for people goes to stderr. Errors of wavebatch become one line and an exit code in `report_errors`.
"""

from __future__ import annotations

import contextlib
import functools
import json
import math
import os
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import IO, Any

import click

from wavebatch.cli.program import log_file
from wavebatch.core import interrupts
from wavebatch.core.errors import ConfigError, InputError, StageError

EXIT_USAGE = 2
"""Wrong usage or chain file; nothing was started."""


_PLAIN = {
    "is not a valid integer range": "is no whole number",
    "is not a valid float range": "is no number",
    "is not a valid integer": "is no whole number",
    "is not a valid float": "is no number",
    "is a file": "is a file, not a folder",
}
"""Click's words for values of a wrong type, and plain ones."""


class WrongUsage(click.ClickException):
    """Wrong usage as one line, like all other errors; click would print four."""

    exit_code = EXIT_USAGE

    def __init__(self, error: click.UsageError) -> None:
        text = " ".join(error.format_message().split()).removesuffix(".").replace(". (Did", " (did")
        for jargon, plain in _PLAIN.items():
            text = text.replace(jargon, plain)
        if not text[1:2].isupper():  # CRS stays
            text = text[:1].lower() + text[1:]
        if error.ctx:
            text += f"{'' if text.endswith('?') else ';'} see `{error.ctx.command_path} --help`"
        super().__init__(text)

    def show(self, file: IO[Any] | None = None) -> None:
        """The line on stderr."""
        click.echo(f"error: {self.message}", file=file, err=file is None)


class Unprinted(click.ClickException):
    """stdout that cannot be written, such as a full disk, as one line."""

    def __init__(self, error: OSError) -> None:
        super().__init__(f"stdout: cannot be written: {error.strerror or error}")

    def show(self, file: IO[Any] | None = None) -> None:
        """The line on stderr."""
        click.echo(f"error: {self.message}", file=file, err=file is None)


class Interrupted(click.ClickException):
    """Ctrl-C or SIGTERM as one line and an exit code; click would say `Aborted!` and give 1."""

    exit_code = interrupts.EXIT_INTERRUPTED

    def show(self, file: IO[Any] | None = None) -> None:
        """The line on stderr."""
        click.echo(self.message, file=file, err=file is None)


@contextlib.contextmanager
def _errors_in_one_line() -> Iterator[None]:
    try:
        yield
    except KeyboardInterrupt:
        raise Interrupted("interrupted") from None
    except click.UsageError as error:
        if type(error).__name__ == "NoArgsIsHelpError":  # of click 8.2: the whole help
            raise
        raise WrongUsage(error) from error
    except BrokenPipeError:
        raise
    except OSError as error:  # of help and version: commands report their own
        raise Unprinted(error) from error


class NearestGroup(click.Group):
    """A group of commands that suggests the nearest name for an unknown command; wrong usage is one line."""

    def make_context(self, *args: Any, **options: Any) -> click.Context:
        """Parses the options of the group."""
        with _errors_in_one_line():
            return super().make_context(*args, **options)

    def invoke(self, ctx: click.Context) -> Any:
        """Parses and runs the command."""
        with _errors_in_one_line():
            return super().invoke(ctx)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Finds the command; fails with the nearest name for an unknown one."""
        name = args[0] if args else ""
        if name and not name.startswith("-") and name not in self.list_commands(ctx):
            from wavebatch.core.suggest import nearest

            ctx.fail(f"no command {name!r}; {nearest(name, self.list_commands(ctx))}")
        return super().resolve_command(ctx, args)


def talk(message: str) -> None:
    """One line on stderr, and in the file of --log-file."""
    _write_message(printable(message))
    log_file.log(printable(message))


def _write_message(line: str) -> None:
    """One line on stderr; where it cannot be written, later ones are dropped, and the work goes on."""
    try:
        click.echo(line, err=True)
    except (OSError, ValueError):
        _drop_output(sys.stderr)


def _drop_output(stream: Any) -> None:
    """Let the stream write to the null device, else Python would fail with what is left at its end."""
    with contextlib.suppress(OSError, ValueError), open(os.devnull, "wb") as nothing:
        os.dup2(nothing.fileno(), stream.fileno())


def printable(text: str) -> str:
    """The text without control characters and line breaks: a file name may hold escape codes of the terminal."""
    return "".join(c if c.isprintable() else " " if c.isspace() else repr(c)[1:-1] for c in text)


def print_json(value: Any, mode: str = "") -> None:
    """Prints `value` (plain, or a dataclass) as JSON with sorted keys; NaN becomes null, because JSON has no NaN.

    Each document says what it is in its key `schema`, as docs/json.md has it. mode: what the command did, where its
    documents differ.
    """
    value = asdict(value) if is_dataclass(value) else value
    path, context = [mode] if mode else [], click.get_current_context()
    while context.parent is not None:
        path.insert(0, str(context.info_name))
        context = context.parent
    schema = {"schema": f"wavebatch.{'-'.join(path)}/1"}
    named = [{**schema, **one} for one in value] if isinstance(value, list) else {**schema, **value}
    print_text(format_json(named))


def print_text(text: str) -> None:
    """Prints the text on stdout; a stdout that cannot be written, such as a full disk, is named as such."""
    try:
        click.echo(text)
        sys.stdout.flush()
    except BrokenPipeError:
        raise
    except OSError as error:
        _drop_output(sys.stdout)
        raise Unprinted(error) from error


def format_json(value: Any) -> str:
    """The value (plain, or a dataclass) as JSON text with sorted keys; NaN becomes null."""
    from wavebatch.core.no_data import without_nan

    value = asdict(value) if is_dataclass(value) else value
    text = json.dumps(without_nan(value), allow_nan=False, indent=2, sort_keys=True, ensure_ascii=False)
    return text.encode(errors="backslashreplace").decode()


def print_safely(text: str) -> bool:
    """Prints the text on stdout; if that fails, says so once, drops all later output and returns False.

    For a batch: a reader that has gone or a full disk must not stop it.
    """
    try:
        click.echo(text.encode(errors="backslashreplace").decode())
        return True
    except (OSError, ValueError) as error:
        talk(f"error: stdout: cannot be written: {getattr(error, 'strerror', None) or error}")
        _drop_output(sys.stdout)
        return False


def print_result(as_json: bool, document: Any, lines: Iterable[str], mode: str = "") -> None:
    """The result of a command on stdout: the document as JSON, with its mode, or the lines."""
    if as_json:
        print_json(document, mode)
    else:
        print_text("\n".join(printable(part) for line in lines for part in line.split("\n")))


def print_summary(options: Mapping[str, Any], summary: Any, lines: Iterable[str]) -> None:
    """The summary (a dataclass or dictionary) as JSON if --json is given, and the lines on stderr unless --quiet."""
    if options["as_json"]:
        print_json(summary)
    if not options["quiet"]:
        for line in lines:
            talk(line)


def count(number: int, name: str) -> str:
    """`1 echo`, `2 echoes`."""
    if number == 1:
        return f"1 {name}"
    return f"{number} {name}{'es' if name.endswith(('o', 's', 'x', 'ch')) else 's'}"


def row(name: str, values: Iterable[Any], form: str = "", *, width: int = 10) -> str:
    """A line of a table: the name as it is, then values of one width to the right; form: of floats, NaN is `-`."""
    texts = (("-" if math.isnan(v) else format(v, form)) if isinstance(v, float) else str(v) for v in values)
    return name + " ".join(f"{text:>{width}}" for text in texts)


def one_line(error: BaseException) -> str:
    """The error's message on one line; a bug also shows its type."""
    text = printable(" ".join(str(error).split()))
    if isinstance(error, OSError) and error.strerror:  # of a disk or a network, wherever it comes
        place = "" if error.filename is None else f"{printable(os.fsdecode(error.filename))}: "
        return f"{place}{error.strerror}; check disk and permissions"
    if isinstance(error, ConfigError | InputError | StageError | click.ClickException):
        return text
    if isinstance(error, MemoryError):
        needed = f" ({text[0].lower()}{text[1:]})" if text else ""
        return f"not enough memory{needed}; close other programs, or use fewer --jobs or a smaller --block-size"
    return f"{type(error).__name__}: {text}; this is a bug, please report it with the output of --debug"


def report_errors(failure: int = 1) -> Callable:
    """Decorator of a command function: wavebatch's errors become one line on stderr and an exit code.

    failure: exit code for files that cannot be read or written, and for bugs; a ConfigError gives EXIT_USAGE. The
    command's option `debug` prints the traceback too.
    """

    def decorate(function: Callable) -> Callable:
        @functools.wraps(function)
        def guarded(*args: Any, **options: Any) -> Any:
            try:
                return function(*args, **options)
            except (click.ClickException, click.exceptions.Exit, click.Abort, BrokenPipeError) as error:
                if isinstance(error, click.ClickException):
                    log_file.log(printable(error.format_message()), "error")
                raise
            except Exception as error:
                if interrupts.arrived():  # compiled code may have turned KeyboardInterrupt into this
                    raise Interrupted("interrupted") from None
                if options.get("debug"):
                    traceback.print_exc()
                talk(f"error: {one_line(error)}")
                sys.exit(EXIT_USAGE if isinstance(error, ConfigError) else failure)

        return guarded

    return decorate


def counting(unit: str, quiet: bool, total: int | None = None) -> Any:
    """A progress bar up to `total`, shown on a terminal only and not if `quiet`; use it with `with`."""
    from tqdm import tqdm

    return tqdm(total=total, unit=f" {unit}", disable=quiet or not sys.stderr.isatty(), leave=False)


class Progress:
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

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *error: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def show(self, event: dict[str, Any]) -> None:
        """Shows one event of `run_batch`."""
        error = event.get("error")
        if self._json:
            plain = event if error is None else {**event, "error": one_line(error)}
            self._json = self.is_written = print_safely(json.dumps(plain, sort_keys=True, ensure_ascii=False))
        kind, strip = event["event"], event["strip"]
        if self._bar is not None:
            share = event["done"] / event["of"] if kind == "unit" else float(kind != "start")
            self._advance(strip, share)
        if error is not None and not event["again"]:
            if self._debug:
                self._say("".join(traceback.format_exception(error)).rstrip())
            self._say(f"error: {_place(printable(strip), one_line(error))}")
        elif kind == "written" and self._level >= 0:
            self._say(printable(_summary(event, self._level > 0)))
            warnings = [f"warning: {line}" for line in event["warnings"]]
            more = [*_sensor_lines(event["sensor"]), *_reasons(event["counts"]["no_data"])] * (self._level > 0)
            for line in [*warnings, *more, *event["remarks"]]:
                self._say(printable(f"{strip}: {line}"))
        elif kind == "written":
            log_file.log(printable(_summary(event, False)))
            # Printed with --quiet too: what is written is less sure, or less, than its inputs promise.
            for line in (*event["serious"], *event["doubts"]):
                self._say(printable(f"{strip}: warning: {line}"))
        elif kind == "skipped" and self._level >= 0:
            self._say(printable(f"{strip}: is up to date, skipped"))
        elif kind == "worker":
            self._say(printable(f"{strip}: warning: {event['warning']}"))
        elif kind == "flight" and self._level > 0:
            self._say(printable(f"{strip}: survey of {count(event['strips'], 'strip')} together"))

    def _advance(self, strip: str, share: float) -> None:
        done = round(self._sizes.get(strip, 0) * share)
        self._bar.set_description(Path(strip).name, refresh=False)
        self._bar.update(max(done - self._shown.get(strip, 0), 0))
        self._shown[strip] = done

    def _say(self, line: str) -> None:
        if self._bar is not None:
            self._bar.clear()
        _write_message(line)
        log_file.log(line)
        if self._bar is not None:
            self._bar.refresh()


def _size(path: Path) -> int:
    try:
        return os.path.getsize(path)
    except (OSError, ValueError):
        return 0


def _place(strip: str, line: str) -> str:
    """The line with the strip's name first, unless it contains the name already."""
    return line if strip in line else f"{strip}: {line}"


def _sensor_lines(sensor: dict[str, Any]) -> Iterator[str]:
    """The sensor position and its source."""
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


def _reasons(no_data: dict[str, dict[str, int]]) -> Iterator[str]:
    """For each column and reason: how many echoes have no value."""
    from wavebatch.core.no_data import REASONS, NoData

    for column, counts in sorted(no_data.items()):
        total = sum(counts.values())
        for name, number in counts.items():
            if name != NoData.KNOWN.name:
                yield f"{column}: no-data for {number} of {total} echoes: {REASONS[NoData[name]][0]}"


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
