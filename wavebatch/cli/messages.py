"""What the commands print: messages and progress on stderr, errors as one line and an exit code, JSON on stdout."""

from __future__ import annotations

import contextlib
import functools
import json
import os
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import IO, Any

import click

from wavebatch.core.errors import ConfigError, InputError, StageError

EXIT_USAGE = 2
"""Wrong usage or chain file; nothing was started."""
EXIT_INTERRUPTED = 130
"""Ctrl-C or SIGTERM."""


class WrongUsage(click.ClickException):
    """Wrong usage in one line, as all other errors are told, where click takes four."""

    exit_code = EXIT_USAGE

    def __init__(self, error: click.UsageError) -> None:
        text = " ".join(error.format_message().split()).removesuffix(".").replace(". (Did", " (did")
        if not text[1:2].isupper():  # CRS stays
            text = text[:1].lower() + text[1:]
        if error.ctx:
            text += f"{'' if text.endswith('?') else ';'} see `{error.ctx.command_path} --help`"
        super().__init__(text)

    def show(self, file: IO[Any] | None = None) -> None:
        """The line on stderr."""
        click.echo(f"error: {self.message}", file=file, err=file is None)


@contextlib.contextmanager
def _usage_in_one_line() -> Iterator[None]:
    try:
        yield
    except click.UsageError as error:
        if type(error).__name__ == "NoArgsIsHelpError":  # of click 8.2: the whole help
            raise
        raise WrongUsage(error) from error


class NearestGroup(click.Group):
    """A group of commands that names the nearest one where there is none of the name; wrong usage is one line."""

    def make_context(self, *args: Any, **options: Any) -> click.Context:
        """As click does it, for the options of the group itself."""
        with _usage_in_one_line():
            return super().make_context(*args, **options)

    def invoke(self, ctx: click.Context) -> Any:
        """As click does it, for the commands."""
        with _usage_in_one_line():
            return super().invoke(ctx)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """As click does it, with a better line."""
        name = args[0] if args else ""
        if name and not name.startswith("-") and name not in self.list_commands(ctx):
            from wavebatch.core.suggest import nearest

            ctx.fail(f"no command {name!r}; {nearest(name, self.list_commands(ctx))}")
        return super().resolve_command(ctx, args)


def talk(message: str) -> None:
    """One line on stderr."""
    click.echo(printable(message), err=True)


def printable(text: str) -> str:
    """The text without what would change the terminal or begin another line: names of files may hold anything."""
    return "".join(c if c.isprintable() else " " if c.isspace() else repr(c)[1:-1] for c in text)


def print_json(value: Any) -> None:
    """`value` as JSON with sorted keys on stdout; null for what is no number, so that every reader takes it."""
    from wavebatch.core.no_data import without_nan

    text = json.dumps(without_nan(value), allow_nan=False, indent=2, sort_keys=True, ensure_ascii=False)
    click.echo(text.encode(errors="backslashreplace").decode())


def one_line(error: BaseException) -> str:
    """The error's message without line breaks; a bug shows its type too."""
    text = printable(" ".join(str(error).split()))
    if isinstance(error, ConfigError | InputError | StageError | click.ClickException):
        return text
    return f"{type(error).__name__}: {text}; this is a bug, please report it with the output of --debug"


def debug_option(command: Callable) -> Callable:
    """`--debug`: tracebacks instead of lines."""
    return click.option("--debug", is_flag=True, help="Show the traceback of an error.")(command)


def report_errors(failure: int = 1) -> Callable:
    """Decorator of a command function: wavebatch's errors become one line on stderr and an exit code.

    failure: exit code for files that cannot be read or written, and for bugs; a ConfigError gives EXIT_USAGE, an
    interrupt EXIT_INTERRUPTED. Where the command has a parameter `debug`, it decides whether tracebacks are shown.
    """

    def decorate(function: Callable) -> Callable:
        @functools.wraps(function)
        def guarded(*args: Any, **options: Any) -> Any:
            try:
                return function(*args, **options)
            except (click.ClickException, click.exceptions.Exit, click.Abort):
                raise
            except KeyboardInterrupt:
                talk("interrupted")
                sys.exit(EXIT_INTERRUPTED)
            except BrokenPipeError:
                raise
            except Exception as error:
                if options.get("debug"):
                    traceback.print_exc()
                talk(f"error: {one_line(error)}")
                sys.exit(EXIT_USAGE if isinstance(error, ConfigError) else failure)

        return guarded

    return decorate


KINDS = ("auto", "bar", "json", "none")


def counting(unit: str, quiet: bool, total: int | None = None) -> Any:
    """A bar that counts up to `total`, on a terminal and unless `quiet`; a context manager with `update(number)`."""
    from tqdm import tqdm

    return tqdm(total=total, unit=f" {unit}", disable=quiet or not sys.stderr.isatty(), leave=False)


class Progress:
    """Takes the events of a batch. kind: one of KINDS; auto is a bar where stderr is a terminal.

    level: -1 tells errors only, 0 also what was written, 1 also where the points went.
    """

    def __init__(self, strips: Iterable[Path], kind: str, level: int, debug: bool) -> None:
        if kind == "auto":
            kind = "bar" if sys.stderr.isatty() and level >= 0 else "none"
        self._json = kind == "json"
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

    def tell(self, event: dict[str, Any]) -> None:
        """Shows one event of `run_batch`."""
        error = event.get("error")
        if self._json:
            plain = event if error is None else {**event, "error": one_line(error)}
            click.echo(json.dumps(plain, sort_keys=True, ensure_ascii=False))
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
            more = [*_tell_sensor(event["sensor"]), *_reasons(event["counts"]["no_data"])] * (self._level > 0)
            for line in [*warnings, *more, *event["remarks"]]:
                self._say(printable(f"{strip}: {line}"))
        elif kind == "skipped" and self._level >= 0:
            self._say(printable(f"{strip}: is there already"))

    def _advance(self, strip: str, share: float) -> None:
        done = round(self._sizes.get(strip, 0) * share)
        self._bar.set_description(Path(strip).name, refresh=False)
        self._bar.update(max(done - self._shown.get(strip, 0), 0))
        self._shown[strip] = done

    def _say(self, line: str) -> None:
        if self._bar is not None:
            self._bar.clear()
        click.echo(line, err=True)
        if self._bar is not None:
            self._bar.refresh()


def _size(path: Path) -> int:
    try:
        return os.path.getsize(path)
    except OSError:
        return 0


def _place(strip: str, line: str) -> str:
    """The line with the strip in front, unless it names it already."""
    return line if strip in line else f"{strip}: {line}"


def _tell_sensor(sensor: dict[str, Any]) -> Iterator[str]:
    """Where the sensor was, and how one knows."""
    words = {
        "distance_m": "{:.0f} m away",
        "height_m": "{:.0f} m above the points",
        "speed_m_s": "{:.1f} m/s",
        "heading_deg": "heading {:.0f} degrees",
        "smoothness_m": "smooth to {:.3f} m",
        "range_error_m": "ranges to {:.3f} m",
    }
    told = [text.format(sensor[key]) for key, text in words.items() if sensor.get(key) is not None]
    if told:
        yield f"sensor from {sensor['source']}: {', '.join(told)}"


def _reasons(no_data: dict[str, dict[str, int]]) -> Iterator[str]:
    """Per column how many echoes lack a value, one line for each reason."""
    from wavebatch.core.no_data import REASONS, NoData

    for column, counts in sorted(no_data.items()):
        total = sum(counts.values())
        for name, number in counts.items():
            if name != NoData.KNOWN.name:
                yield f"{column}: no-data for {number} of {total} echoes: {REASONS[NoData[name]][0]}"


def _summary(event: dict[str, Any], long: bool) -> str:
    counts = event["counts"]
    passed = sum(counts["passed_through"].values())
    line = (
        f"{event['strip']}: {counts['points_in']} points, {counts['waveforms']} waveforms, {counts['echoes']} echoes, "
        f"{passed} passed through -> {counts['points_out']} points"
    )
    if not long:
        return line
    reasons = ", ".join(f"{name} {number}" for name, number in counts["passed_through"].items() if number)
    flags = ", ".join(f"{name} {number}" for name, number in counts["flags"].items() if number)
    return (
        f"{line}; returns matched {counts['matched_returns']}, unmatched {counts['unmatched_returns']}, echoes added "
        f"{counts['added_echoes']}; passed through: {reasons or 'none'}; flags: {flags or 'none'}"
    )
