"""Small text files, and the input files that arguments and lists name.

Texts are read with a bound, and written so that they appear whole or not at all: chain, system and calibration files,
lists of strips and reports. Large outputs use `disk/publish.py`.

All commands that take several files find them with `find_files`: files, patterns, folders and lists. The order of the
arguments is kept, because outputs are made in it.
"""

from __future__ import annotations

import contextlib
import glob
import os
import stat
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

from wavebatch.core.errors import ConfigError
from wavebatch.files.disk.publish import Draft, is_stream, open_stream, protect, real_name, reporting
from wavebatch.files.disk.raw_bytes import undoing

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
        data = _read(path, most + 1)
    except (OSError, ValueError) as error:  # ValueError: a name that no file can have
        why = getattr(error, "strerror", None) or error
        raise ConfigError(f"{path}: {what} cannot be read: {why}") from error
    if len(data) > most:
        raise ConfigError(f"{path}: {what} is larger than {most >> 20} MiB; name another file")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: {what} is not UTF-8 text (byte {error.start}); save it as UTF-8") from error


def _read(path: Path | str, most: int) -> bytes:
    """Read at most so many bytes of a file or a pipe.

    Raises OSError for devices, which may never end, and pipes that nothing writes to.
    """
    mode = os.stat(path).st_mode
    if stat.S_ISREG(mode) or stat.S_ISDIR(mode):
        with open(path, "rb") as file:
            return file.read(most)
    if not stat.S_ISFIFO(mode):
        raise OSError("it is a device; give a file")
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)  # else this would wait for a writer, for ever
    with os.fdopen(descriptor, "rb") as file:
        begin, deadline = b"", time.monotonic() + _PATIENCE
        with contextlib.suppress(BlockingIOError):  # its writer is there but slow
            while not (begin := os.read(descriptor, 1 << 16)):
                if time.monotonic() > deadline:
                    raise OSError("nothing writes into this pipe")
                time.sleep(0.01)
        os.set_blocking(descriptor, True)
        return begin + file.read(most - len(begin))


def write_text(path: Path, text: str, *, overwrite: bool) -> None:
    """Write a text file that appears whole or not at all; raises InputError if it exists or cannot be written.

    With `overwrite`, a device or a pipe (/dev/null, /dev/stdout) gets the text directly.
    """
    if overwrite and is_stream(path):
        with reporting(path), open_stream(path) as stream:
            stream.write(text.encode(errors="replace"))  # a strip's file name may hold bytes that are not text
        return
    with draft_text(path, text, overwrite=overwrite) as draft:
        draft.publish()


def draft_text(path: Path, text: str, *, overwrite: bool) -> Draft:
    """Write a text file under a temporary name, to be published; raises InputError if it cannot be written."""
    draft = Draft(path, overwrite=overwrite)
    with undoing(draft.discard), reporting(path):
        draft.file.write(text.encode(errors="replace"))
        draft.file.flush()
    return draft


SUFFIXES = (".las", ".laz")

MOST_NAMED = 5
"""Subfolders that a line names."""

LONGEST_PATTERN = 4096
"""Characters of a pattern: a longer one is taken as a name, which no file can have. 100,000 brackets took minutes."""


def find_files(
    arguments: Iterable[str],
    *,
    recursive: bool = False,
    kinds: Sequence[Sequence[str]] = (SUFFIXES,),
    note: Callable[[str], None] | None = None,
) -> list[Path]:
    """Return the files of the arguments, each once, in the order of the arguments.

    A folder gives its LAS and LAZ files by name; recursive: with those of all its subfolders, but not of hidden ones
    and not of links to folders, which may lead in a circle.
    `@list.txt` holds one argument per line, relative to the folder of the list; empty lines and lines that start with #
    are skipped. `@-` is a list from stdin. A file that does not exist or a folder that cannot be read is kept: it fails
    in its turn, so that the other files are still processed. Subfolders that cannot be read, such as `lost+found` of a
    disk, are noted only, where there are other files.
    kinds: suffixes of the files that folders and patterns give, kind after kind: the first that is there is taken.
    note: is called with a line about each link to a file that was given before, and about subfolders that cannot be
    read: without it they are kept.
    Raises ConfigError if a folder, pattern or list gives no file, or if there is no argument.
    """
    files: dict[str, Path] = {}
    for argument in arguments:
        if not argument:  # pathlib takes it for the current folder
            raise ConfigError("the name of a file is empty")
        for path in _expand(argument, Path(), recursive, kinds, note):
            first = files.setdefault(real_name(path), path)
            if note is not None and os.path.abspath(first) != os.path.abspath(path):
                note(f"{path}: is the same file as {first}; it is used once")
    if not files:
        raise ConfigError("no file given; name files, folders, patterns or @list.txt")
    protect(files.values())
    return list(files.values())


def find_strips(
    arguments: Iterable[str], *, recursive: bool = False, note: Callable[[str], None] | None = None
) -> list[Path]:
    """Return the strips of the arguments, as `find_files` does.

    Raises ConfigError if there is none, or if two strips would get outputs of the same name.
    """
    strips = find_files(arguments, recursive=recursive, note=note)
    stems: dict[str, Path] = {}
    for path in strips:
        other = stems.setdefault(os.path.normcase(path.stem), path)
        if other is not path:
            raise ConfigError(f"{other} and {path}: both outputs would be named {path.stem}; use two output folders, "
                              "and one for clouds, without strips")  # fmt: skip
    return strips


def _expand(
    argument: str, folder: Path, recursive: bool, kinds: Sequence[Sequence[str]], note: Callable[[str], None] | None
) -> Iterator[Path]:
    if argument.startswith("@"):
        path, empty = Path("/dev/stdin") if argument == "@-" else folder / argument[1:], True
        # A list from a pipe lies in no folder: its names are seen from where the command runs.
        beside = Path() if path.as_posix().startswith(("/dev/fd/", "/dev/std", "/proc/")) else path.parent
        protect([path])
        for number, line in enumerate(read_text(path, "the list", MOST_LIST).splitlines(), 1):
            entry = line.strip()
            if entry and not entry.startswith("#"):
                if entry.startswith("@"):
                    raise ConfigError(f"{path}: line {number}: a list cannot name another list")
                empty = False
                yield from _expand(entry, beside, recursive, kinds, note)
        if empty:
            raise ConfigError(f"{path}: the list names no file; write one file, folder or pattern per line")
        return
    path = folder / argument
    if argument.startswith("~") and not os.path.lexists(path):  # shells expand it, but neither in quotes nor in lists
        with contextlib.suppress(ValueError):  # no user can have this name
            path = folder / os.path.expanduser(argument)
    closed: list[str] = []  # subfolders that cannot be read
    if os.path.isdir(path):
        try:
            names = _walk(path, closed) if recursive else os.listdir(path)
        except OSError:
            yield path
            return
        found, problem = sorted(path / name for name in names), f"{path}: the folder holds"
    elif os.path.exists(path) or not glob.has_magic(argument) or len(argument) > LONGEST_PATTERN:
        yield path
        return
    else:
        found, problem = [Path(name) for name in sorted(glob.glob(str(path), recursive=True))], f"{argument}: matches"
    for suffixes in kinds:
        # A link to nothing fails in its turn: the disk that it leads to may be missing.
        chosen = [entry for entry in found if entry.suffix.lower() in suffixes and not entry.name.startswith(".")
                  and (os.path.isfile(entry) or not os.path.exists(entry))]  # fmt: skip
        if chosen and note is not None and closed:
            note(
                f"warning: {path}: {len(closed)} of its subfolders cannot be read, and their files are left out: "
                f"{', '.join(sorted(closed)[:MOST_NAMED])}{', ...' * (len(closed) > MOST_NAMED)}"
            )
            closed = []
        if chosen:
            yield from (*map(Path, closed), *chosen)
            return
    if closed:
        yield from map(Path, closed)
        return
    *names, last = [suffix for suffixes in kinds for suffix in suffixes]
    hint = "; --recursive takes those of its subfolders too" if os.path.isdir(path) and not recursive else ""
    raise ConfigError(f"{problem} no {' or '.join(filter(None, (', '.join(names), last)))} file{hint}")


def _walk(folder: Path, closed: list[str]) -> list[str]:
    """All files of a folder and its subfolders, relative to it; raises OSError where it cannot be read.

    closed: gets the subfolders that cannot be read.
    """
    os.listdir(folder)  # os.walk would say nothing
    found = []
    for place, folders, files in os.walk(folder, onerror=lambda error: closed.append(error.filename)):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        found += [os.path.relpath(os.path.join(place, name), folder) for name in files]
    return found
