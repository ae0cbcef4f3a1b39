"""Small text files that appear whole or not at all.

The commands write their reports, system files and chain files with it. Large outputs use `disk/publish.py` directly.
"""

from __future__ import annotations

from pathlib import Path

from wavebatch.files.disk.publish import Draft, is_stream, open_stream, reporting


def write_text(path: Path, text: str, *, overwrite: bool) -> None:
    """Write a text file that appears whole or not at all; raises InputError if it exists or cannot be written.

    With `overwrite`, a device or a pipe (/dev/null, /dev/stdout) gets the text directly.
    """
    if overwrite and is_stream(path):
        with reporting(path), open_stream(path) as stream:
            stream.write(_encode(text))
        return
    draft = draft_text(path, text, overwrite=overwrite)
    try:
        draft.publish()
    finally:
        draft.discard()


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
