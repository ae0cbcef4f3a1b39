"""Small text files: read with a bound, and written so that they appear whole or not at all.

Chain, system and calibration files, lists of strips and reports use it. Large outputs use `disk/publish.py`.
"""

from __future__ import annotations

from pathlib import Path

from wavebatch.core.errors import ConfigError
from wavebatch.files.disk.publish import Draft, is_stream, open_stream, reporting

MOST_BYTES = 4 << 20
"""Largest TOML file that is read: five times a system file with 255 digitizers of 16 Gaussians each."""


def read_text(path: Path | str, what: str, most: int = MOST_BYTES) -> str:
    """Return the text of a file of at most `most` bytes.

    `what` names the kind of file in messages, for example "chain file".
    Raises ConfigError where the file cannot be read, is too large or is not UTF-8 text.
    """
    try:
        with open(path, "rb") as file:
            data = file.read(most + 1)
    except OSError as error:
        raise ConfigError(f"{path}: {what} cannot be read: {error.strerror or error}") from error
    if len(data) > most:
        raise ConfigError(f"{path}: {what} is larger than {most >> 20} MiB; name another file")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: {what} is not UTF-8 text (byte {error.start})") from error


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
