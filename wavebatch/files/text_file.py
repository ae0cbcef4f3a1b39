"""Small text files: read with a bound, and written so that they appear whole or not at all.

Chain, system and calibration files, lists of strips and reports use it. Large outputs use `disk/publish.py`.
"""

from __future__ import annotations

import io
import os
import stat
import time
from pathlib import Path
from typing import BinaryIO, cast

from wavebatch.core.errors import ConfigError
from wavebatch.files.disk.publish import Draft, is_stream, open_stream, reporting

MOST_BYTES = 4 << 20
"""Largest TOML file that is read: five times a system file with 255 digitizers of 16 Gaussians each."""

MOST_LIST = 64 << 20
"""Largest list, polygon or target file that is read: a million names or corners."""

_PATIENCE = 2.0
"""Seconds in which something must write into a pipe that is read."""


def read_text(path: Path | str, what: str, most: int = MOST_BYTES) -> str:
    """Return the text of a file of at most `most` bytes.

    `what` names the kind of file in messages, for example "chain file".
    Raises ConfigError where the file cannot be read, is too large or is not UTF-8 text.
    """
    try:
        with _open(path) as file:
            data = file.read(most + 1)
    except (OSError, ValueError) as error:  # ValueError: a name that no file can have
        why = getattr(error, "strerror", None) or error
        raise ConfigError(f"{path}: {what} cannot be read: {why}") from error
    if len(data) > most:
        raise ConfigError(f"{path}: {what} is larger than {most >> 20} MiB; name another file")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: {what} is not UTF-8 text (byte {error.start})") from error


def _open(path: Path | str) -> BinaryIO:
    """Open a file or a pipe for reading; OSError for devices, which may never end, and pipes that nothing writes to."""
    mode = os.stat(path).st_mode
    if stat.S_ISREG(mode) or stat.S_ISDIR(mode):
        return open(path, "rb")
    if not stat.S_ISFIFO(mode):
        raise OSError("it is a device; give a file")
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)  # else this would wait for a writer, for ever
    file = os.fdopen(descriptor, "rb")
    try:
        begin = _read_first(descriptor)
    except BaseException:
        file.close()
        raise
    os.set_blocking(descriptor, True)
    return cast(BinaryIO, _Pipe(file, begin))


def _read_first(descriptor: int) -> bytes:
    """The first bytes of a pipe, empty where its writer is there but slow; OSError where nothing comes."""
    deadline = time.monotonic() + _PATIENCE
    while True:
        try:
            begin = os.read(descriptor, 1 << 16)
        except BlockingIOError:
            return b""
        if begin:
            return begin
        if time.monotonic() > deadline:
            raise OSError("nothing writes into this pipe")
        time.sleep(0.01)


class _Pipe(io.RawIOBase):
    """A pipe whose first bytes are read already."""

    def __init__(self, file: BinaryIO, begin: bytes) -> None:
        self._file, self._begin = file, begin

    def read(self, size: int = -1, /) -> bytes:
        """Return at most so many bytes."""
        return self._begin + self._file.read(size - len(self._begin))

    def close(self) -> None:
        """Close the pipe."""
        self._file.close()
        super().close()


def write_text(path: Path, text: str, *, overwrite: bool) -> None:
    """Write a text file that appears whole or not at all; raises InputError if it exists or cannot be written.

    With `overwrite`, a device or a pipe (/dev/null, /dev/stdout) gets the text directly.
    """
    if overwrite and is_stream(path):
        with reporting(path), open_stream(path) as stream:
            stream.write(_encode(text))
        return
    with draft_text(path, text, overwrite=overwrite) as draft:
        draft.publish()


def draft_text(path: Path, text: str, *, overwrite: bool) -> Draft:
    """Write a text file under a temporary name, to be published; raises InputError if it cannot be written."""
    draft = Draft(path, overwrite=overwrite)
    try:
        with reporting(path):
            draft.file.write(_encode(text))
            draft.file.flush()
    except BaseException:
        draft.discard()
        raise
    return draft


def _encode(text: str) -> bytes:
    return text.encode(errors="replace")  # a strip's file name may hold bytes that are not text
