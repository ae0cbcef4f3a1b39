"""`--log-file`: every message of a command with its time, whatever --quiet says. `cli/messages.py` writes to it.

Lines are appended, so that the runs of a night stand in one file.
"""

from __future__ import annotations

import contextlib
import logging
import os
import re
import shlex
import stat
import sys
import time
from pathlib import Path

import click

from wavebatch.core.errors import ConfigError

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


def open_log(path: Path, level: str, command: str) -> None:
    """Begin to write messages up to a level; the first line holds version and command.

    Raises ConfigError if the file cannot be written, or is something else than a log.
    """
    from wavebatch import __version__

    close_log()
    begin = b""
    try:
        if os.path.isfile(path):
            with open(path, "rb") as old:
                begin = old.read(20)
        elif os.path.lexists(path) and stat.S_ISFIFO(os.stat(path).st_mode):  # opening it would wait for a reader
            raise ConfigError(f"--log-file: {path} is a pipe; choose a file")
        if begin and not re.fullmatch(rb"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ", begin):
            raise ConfigError(f"--log-file: {path} exists and is no log; choose another name")
        _logger.addHandler(_LogFile(path))
    except OSError as error:
        raise ConfigError(f"--log-file: {path}: cannot be written: {error.strerror or error}") from error
    _logger.setLevel(level.upper())
    log_text(f"wavebatch {__version__}: {command}")


def close_log() -> None:
    """End the log; harmless without one."""
    for handler in [one for one in _logger.handlers if isinstance(one, _LogFile)]:
        _logger.removeHandler(handler)
        with contextlib.suppress(OSError):
            handler.close()


def is_open() -> bool:
    """Whether a log is written."""
    return any(isinstance(one, _LogFile) for one in _logger.handlers)


def log_text(message: str, level: str | None = None) -> None:
    """A line with time and level; the level is found from the message if it is not given. Does nothing without a log.
    """
    if is_open():
        level = level or next((name for name in LEVELS[:2] if f"{name}: " in message), "info")
        _logger.log(getattr(logging, level.upper()), "%s", message)


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
