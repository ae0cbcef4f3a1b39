"""Input files from command-line arguments: files, patterns, folders and lists.

All commands that take several files use it. The order of the arguments is kept, because outputs are made in it.
"""

from __future__ import annotations

import glob
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

from wavebatch.core.errors import ConfigError
from wavebatch.files.disk.publish import protect, real_name
from wavebatch.files.text_file import MOST_LIST, read_text

SUFFIXES = (".las", ".laz")

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

    A folder gives its LAS and LAZ files by name; recursive: with those of all its subfolders, but not of hidden ones.
    `@list.txt` holds one argument per line, relative to the folder of the list; empty lines and lines that start with #
    are skipped. A file that does not exist or a folder that cannot be read is kept: it fails in its turn, so that the
    other files are still processed.
    kinds: suffixes of the files that folders and patterns give, kind after kind: the first that is there is taken.
    note: is called with a line about each link to a file that was given before.
    Raises ConfigError if a folder, pattern or list gives no file, or if there is no argument.
    """
    files: dict[str, Path] = {}
    for argument in arguments:
        for path in _expand(argument, Path(), recursive, kinds):
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
            raise ConfigError(f"{other} and {path}: both outputs would be named {path.stem}; use two output folders")
    return strips


def _expand(argument: str, folder: Path, recursive: bool, kinds: Sequence[Sequence[str]]) -> Iterator[Path]:
    if argument.startswith("@"):
        yield from _read_list(folder / argument[1:], recursive, kinds)
        return
    path = folder / argument
    if argument.startswith("~") and not os.path.lexists(path):  # shells expand it, but neither in quotes nor in lists
        path = folder / _expand_home(argument)
    if os.path.isdir(path):
        try:
            names = _walk(path) if recursive else os.listdir(path)
        except OSError:  # it fails in its turn
            yield path
            return
        found, problem = sorted(path / name for name in names), f"{path}: the folder holds"
    elif os.path.exists(path) or not glob.has_magic(argument) or len(argument) > LONGEST_PATTERN:
        yield path
        return
    else:
        found, problem = [Path(name) for name in sorted(glob.glob(str(path), recursive=True))], f"{argument}: matches"
    for suffixes in kinds:
        chosen = [entry for entry in found if entry.suffix.lower() in suffixes and os.path.isfile(entry)
                  and not entry.name.startswith(".")]  # fmt: skip
        if chosen:
            yield from chosen
            return
    *names, last = [suffix for suffixes in kinds for suffix in suffixes]
    raise ConfigError(f"{problem} no {', '.join(names)} or {last} file")


def _walk(folder: Path) -> list[str]:
    """All files of a folder and its subfolders, relative to it; raises OSError where it cannot be read."""
    os.listdir(folder)  # os.walk would say nothing
    found = []
    for place, folders, files in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        found += [os.path.relpath(os.path.join(place, name), folder) for name in files]
    return found


def _expand_home(name: str) -> str:
    try:
        return os.path.expanduser(name)
    except ValueError:  # no user can have this name
        return name


def _read_list(path: Path, recursive: bool, kinds: Sequence[Sequence[str]]) -> Iterator[Path]:
    protect([path])
    empty = True
    for number, line in enumerate(read_text(path, "the list", MOST_LIST).splitlines(), 1):
        entry = line.strip()
        if entry and not entry.startswith("#"):
            if entry.startswith("@"):
                raise ConfigError(f"{path}: line {number}: a list cannot name another list")
            empty = False
            yield from _expand(entry, path.parent, recursive, kinds)
    if empty:
        raise ConfigError(f"{path}: the list names no file; write one file, folder or pattern per line")
