"""What the commands print: messages and one-line errors on stderr, results as text or JSON on stdout.

Every command of `wavebatch.cli` uses this module. stdout holds only results, so that programs can read it; everything
for people goes to stderr, and with its time into the file of --log-file, whatever --quiet says. Errors of wavebatch
become one line and an exit code in `report_errors`.
"""

from __future__ import annotations

import contextlib
import functools
import json
import logging
import os
import re
import shlex
import stat
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import click

from wavebatch.core import interrupts
from wavebatch.core.errors import ConfigError, InputError, StageError, nearest

if TYPE_CHECKING:
    from wavebatch.tools.sheets.sheet import Sheet

_LEVEL, LOG = "wavebatch.log_level", "wavebatch.log_path"
"""Keys of a context's `meta`: the level, and the file of the log."""

LEVELS = ("error", "warning", "info")

_logger = logging.getLogger("wavebatch.log")
_logger.propagate = False  # a program that calls commands has its own log


class _LogFile(logging.FileHandler):
    """A file of lines with time and level. A full disk ends the log, not the work; one message says so."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, "a", "utf-8", errors="backslashreplace")
        form = logging.Formatter("%(asctime)sZ %(levelname)-7s %(message)s", "%Y-%m-%dT%H:%M:%S")
        form.converter = time.gmtime
        self.setFormatter(form)

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802
        """Ends the log."""
        error = sys.exc_info()[1]
        _logger.removeHandler(self)
        click.echo(f"warning: --log-file: cannot be written, so it ends here: {error}", err=True)


def close_log() -> None:
    """End the log; harmless without one."""
    for handler in [one for one in _logger.handlers if isinstance(one, _LogFile)]:
        _logger.removeHandler(handler)
        with contextlib.suppress(OSError):
            handler.close()


def log_text(message: str, level: str | None = None) -> None:
    """A line with time and level; the level is found from the message if it is not given. Does nothing without a log.
    """
    if any(isinstance(one, _LogFile) for one in _logger.handlers):
        level = level or next((name for name in LEVELS[:2] if f"{name}: " in message), "info")
        _logger.log(getattr(logging, level.upper()), "%s", message)


def typed_command(context: click.Context) -> str:
    """The command line as it was typed, with the short name of the program."""
    return " ".join([context.find_root().info_name or "wavebatch", *map(shlex.quote, sys.argv[1:])])


def keep_level(context: click.Context, parameter: click.Parameter, level: str) -> None:
    """Keeps the level for `begin_log`, which comes after it."""
    context.meta[_LEVEL] = level


def begin_log(context: click.Context, parameter: click.Parameter, path: Path | None) -> None:
    """Opens the log of --log-file before the command starts, and closes it after its end.

    Its first line has version and command. Nothing but a log is appended to.
    """
    from wavebatch import __version__

    if path is None or context.resilient_parsing:
        return
    close_log()
    begin = b""
    try:
        if os.path.isfile(path):
            with open(path, "rb") as old:
                begin = old.read(20)
        elif os.path.lexists(path) and stat.S_ISFIFO(os.stat(path).st_mode):  # opening it would wait for a reader
            raise click.UsageError(f"--log-file: {path} is a pipe; choose a file", ctx=context)
        if begin and not re.fullmatch(rb"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ", begin):
            raise click.UsageError(f"--log-file: {path} exists and is no log; choose another name", ctx=context)
        _logger.addHandler(_LogFile(path))
    except OSError as error:
        problem = f"--log-file: {path}: cannot be written: {error.strerror or error}"
        raise click.UsageError(problem, ctx=context) from error
    _logger.setLevel(context.meta.get(_LEVEL, "info").upper())
    log_text(f"wavebatch {__version__}: {typed_command(context)}")
    context.meta[LOG] = path
    context.call_on_close(close_log)


EXIT_USAGE = 2
"""Wrong usage or chain file; nothing was started."""

EXIT_PIPE = 141
"""The reader of stdout has gone: the exit code that shells give for cat and grep then."""


_PLAIN = {
    "is not a valid integer range": "is no whole number",
    "is not a valid float range": "is no number",
    "is not a valid integer": "is no whole number",
    "is not a valid float": "is no number",
    "is a file": "is a file, not a folder",
}
"""Click's words for values of a wrong type, and plain ones."""


class _OneLine(click.ClickException):
    """An error that is printed as one line."""

    kind = "error: "

    def show(self, file: IO[Any] | None = None) -> None:
        """The line on stderr."""
        click.echo(printable(f"{self.kind}{self.message}"), file=file, err=file is None)


class WrongUsage(_OneLine):
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


class Unprinted(_OneLine):
    """stdout that cannot be written, such as a full disk, as one line; what is left for it is dropped."""

    def __init__(self, error: OSError) -> None:
        _drop_output(sys.stdout)
        super().__init__(f"stdout: cannot be written: {error.strerror or error}")


class Interrupted(_OneLine):
    """Ctrl-C or SIGTERM as one line and an exit code; click would say `Aborted!` and give 1."""

    kind, exit_code = "", interrupts.EXIT_INTERRUPTED


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
    except BrokenPipeError:  # `| head` has what it wants; 1 would say that a problem was found
        _drop_output(sys.stdout)
        raise click.exceptions.Exit(EXIT_PIPE) from None
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
            ctx.fail(f"no command {name!r}; {nearest(name, self.list_commands(ctx))}")
        return super().resolve_command(ctx, args)


def talk(*messages: str) -> None:
    """One line each on stderr, and in the file of --log-file."""
    for message in messages:
        write_message(printable(message))
        log_text(printable(message))


def tell(message: str) -> None:
    """As `talk`; with --quiet in the file of --log-file only, unless it is a warning."""
    if "warning: " in message or not click.get_current_context().params["quiet"]:
        write_message(printable(message))
    log_text(printable(message))


def write_message(line: str) -> None:
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


def answer(document: Any, sheet: Sheet | None = None, mode: str = "") -> None:
    """The result of a command on stdout: with --json the document, else the lines of the sheet, if there is one.

    document: plain values, a dataclass, or a list of these. As JSON it has sorted keys, and null for NaN, which JSON
    does not have. Each document says what it is in its key `schema`, as docs/json.md has it. mode: what the command
    did, where its documents differ.
    """
    context = click.get_current_context()
    if not context.params["as_json"]:
        if sheet is not None:
            print_sheet(sheet)
        return
    path = [mode] if mode else []
    while context.parent is not None:
        path.insert(0, str(context.info_name))
        context = context.parent
    schema = {"schema": f"wavebatch.{'-'.join(path)}/1"}
    listed = document if isinstance(document, list) else [document]
    named = [{**schema, **(asdict(one) if is_dataclass(one) else one)} for one in listed]
    print_text(format_json(named if isinstance(document, list) else named[0]))


def print_text(text: str) -> None:
    """Prints the text on stdout; a stdout that cannot be written, such as a full disk, is named as such."""
    try:
        click.echo(text)
        sys.stdout.flush()
    except BrokenPipeError:
        raise
    except OSError as error:
        raise Unprinted(error) from error


def format_json(value: Any) -> str:
    """Plain values as JSON text with sorted keys; NaN becomes null."""
    from wavebatch.core.echoes import without_nan

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


def print_sheet(sheet: Sheet) -> None:
    """A result as text on stdout."""
    from wavebatch.tools.sheets.sheet import list_lines

    print_text("\n".join(printable(part) for line in list_lines(sheet) for part in line.split("\n")))


def print_summary(summary: Any, lines: Iterable[str]) -> None:
    """The summary (a dataclass or dictionary) as JSON if --json is given, and the lines on stderr unless --quiet."""
    answer(summary)
    for line in lines:
        tell(line)


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


def report_errors(function: Callable, failure: int = 1) -> Callable:
    """A command function that makes of wavebatch's errors one line on stderr and an exit code.

    failure: exit code for files that cannot be read or written, and for bugs; a ConfigError gives EXIT_USAGE. The
    command's option `debug` prints the traceback too.
    """

    @functools.wraps(function)
    def guarded(*args: Any, **options: Any) -> Any:
        try:
            return function(*args, **options)
        except (click.ClickException, click.exceptions.Exit, click.Abort, BrokenPipeError) as error:
            if isinstance(error, click.ClickException):
                log_text(printable(error.format_message()), "error")
            raise
        except Exception as error:
            if interrupts.arrived():  # compiled code may have turned KeyboardInterrupt into this
                raise Interrupted("interrupted") from None
            if options.get("debug"):
                traceback.print_exc()
            talk(f"error: {one_line(error)}")
            sys.exit(EXIT_USAGE if isinstance(error, ConfigError) else failure)

    return guarded


def counting(unit: str, quiet: bool, total: int | None = None) -> Any:
    """A progress bar up to `total`, shown on a terminal only and not if `quiet`; use it with `with`."""
    from tqdm import tqdm

    return tqdm(total=total, unit=f" {unit}", disable=quiet or not sys.stderr.isatty(), leave=False)
