"""What the commands share: talk on stderr, errors as one line and an exit code, JSON on stdout."""

from __future__ import annotations

import contextlib
import functools
import json
import sys
import traceback
from collections.abc import Callable, Iterator
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
