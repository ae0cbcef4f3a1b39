"""`--log-file`: every message of a command with its time, whatever --quiet says. `cli/messages.py` writes to it.

Lines are appended, so that the runs of a night stand in one file.
"""

from __future__ import annotations

import contextlib
import datetime
import os
import re
import shlex
import stat
import sys
from pathlib import Path
from typing import IO

import click

from wavebatch.core.errors import ConfigError

_LEVEL, LOG = "wavebatch.log_level", "wavebatch.log_path"
"""Keys of a context's `meta`: the level, and the file of the log."""

LEVELS = ("error", "warning", "info")

_log: tuple[IO[str], int] | None = None
"""The open file and the last level that is written; None without --log-file."""


def open_log(path: Path, level: str, command: str) -> None:
    """Begin to write messages up to a level; the first line holds version and command.

    Raises ConfigError if the file cannot be written, or is something else than a log.
    """
    global _log
    from wavebatch import __version__

    close_log()
    begin = b""
    try:
        if os.path.isfile(path):
            with open(path, "rb") as old:
                begin = old.read(20)
        elif stat.S_ISFIFO(_mode(path)):  # opening it would wait for a reader, for ever
            raise ConfigError(f"--log-file: {path} is a pipe; choose a file")
        if begin and not re.fullmatch(rb"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ", begin):
            raise ConfigError(f"--log-file: {path} exists and is no log; choose another name")
        file = open(path, "a", encoding="utf-8", errors="backslashreplace", buffering=1)  # noqa: SIM115
    except OSError as error:
        raise ConfigError(f"--log-file: {path}: cannot be written: {error.strerror or error}") from error
    _log = file, LEVELS.index(level)
    log(f"wavebatch {__version__}: {command}")


def _mode(path: Path) -> int:
    try:
        return os.stat(path).st_mode
    except FileNotFoundError:
        return 0


def close_log() -> None:
    """End the log; harmless without one."""
    global _log
    if _log is not None:
        with contextlib.suppress(OSError):
            _log[0].close()
        _log = None


def log(message: str, level: str | None = None) -> None:
    """A line with time and level; the level is found from the message if it is not given. Does nothing without a log.

    A full disk ends the log, not the work; it is said once.
    """
    global _log
    if _log is None:
        return
    level = level or next((name for name in LEVELS[:2] if f"{name}: " in message), "info")
    if LEVELS.index(level) > _log[1]:
        return
    time = datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
    try:
        _log[0].write(f"{time} {level.upper():7} {message}\n")
    except (OSError, ValueError) as error:
        _log = None
        click.echo(f"warning: --log-file: cannot be written, so it ends here: {error}", err=True)


def typed_command(context: click.Context) -> str:
    """The command line as it was typed, with the short name of the program."""
    return " ".join([context.find_root().info_name or "wavebatch", *map(shlex.quote, sys.argv[1:])])


def keep_level(context: click.Context, parameter: click.Parameter, level: str) -> None:
    """Keeps the level for `begin_log`, which comes after it."""
    context.meta[_LEVEL] = level


def begin_log(context: click.Context, parameter: click.Parameter, path: Path | None) -> None:
    """Opens the log of --log-file before the command starts, and closes it after its end."""
    if path is None or context.resilient_parsing:
        return
    try:
        open_log(path, context.meta.get(_LEVEL, "info"), typed_command(context))
    except ConfigError as error:
        raise click.UsageError(str(error), ctx=context) from error
    context.meta[LOG] = path
    context.call_on_close(close_log)
