"""The rule that no output replaces a file that is read in the same call, whatever --overwrite says.

`protecting` begins a call: the command line does it for every command, `run_batch` and the other functions that write
do it for programs. `Draft` looks at the rule, so every output obeys it; `refuse_input` checks before long work.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Iterator
from contextvars import ContextVar
from pathlib import Path

from wavebatch.core.errors import ConfigError

_FORMAT_BYTE, _ENCODING_BYTE = 104, 6
_WAVEFORM_FORMATS, _WAVES_INTERNAL = (4, 5, 9, 10), 2


class _Inputs:
    """Files by name and by number, so that links and hard links are found too."""

    def __init__(self) -> None:
        self.names: set[str] = set()
        self.numbers: set[tuple[int, int]] = set()

    def add(self, path: Path) -> None:
        for one in (path, *_packet_files(path)):
            self.names.add(real_name(one))
            self.numbers |= _number(one)

    def has(self, target: Path) -> bool:
        return real_name(target) in self.names or bool(_number(target) & self.numbers)


_inputs: ContextVar[_Inputs | None] = ContextVar("wavebatch_inputs", default=None)


@contextlib.contextmanager
def protecting(paths: Iterable[Path | str | None] = ()) -> Iterator[None]:
    """A call that reads these files: no output inside may replace one of them; inside another call, it adds to that."""
    token = _inputs.set(_Inputs()) if _inputs.get() is None else None
    try:
        protect(paths)
        yield
    finally:
        if token is not None:
            _inputs.reset(token)


def protect(paths: Iterable[Path | str | None]) -> None:
    """Add files to the inputs of the call, with the packet files of strips; does nothing outside `protecting`."""
    inputs = _inputs.get()
    if inputs is not None:
        for path in paths:
            if path is not None:
                inputs.add(Path(path))


def refuse_input(target: Path) -> None:
    """Raise ConfigError if the output would replace an input of the call, also through a link."""
    inputs = _inputs.get()
    if inputs is not None and inputs.has(Path(target)):
        raise ConfigError(f"{target}: the output would replace this input; choose another output")


def real_name(path: Path) -> str:
    """The file that a name leads to, links resolved."""
    try:
        return os.path.realpath(path)
    except (OSError, ValueError):  # no file can have this name
        return os.path.abspath(path)


def _number(path: Path) -> set[tuple[int, int]]:
    try:
        found = os.stat(path)
    except (OSError, ValueError):
        return set()
    return {(found.st_dev, found.st_ino)}


def _packet_files(path: Path) -> list[Path]:
    """The files in which the packets of a strip may be; none for other files and for strips that hold their packets."""
    if path.suffix.lower() not in (".las", ".laz") or not os.path.isfile(path):  # a pipe would block for ever
        return []
    try:
        with open(path, "rb") as file:
            head = file.read(_FORMAT_BYTE + 1)
    except (OSError, ValueError):
        return []
    if len(head) <= _FORMAT_BYTE or head[_FORMAT_BYTE] & 63 not in _WAVEFORM_FORMATS:
        return []
    if head[_ENCODING_BYTE] & _WAVES_INTERNAL:
        return []
    return list_packet_files(path)


def list_packet_files(path: Path, suffixes: Iterable[str] = (".wdp", ".WDP", ".wdz", ".WDZ")) -> list[Path]:
    """Where the packets of a strip may be: beside it, then beside the file to which it is a link."""
    places = dict.fromkeys((path, Path(real_name(path))))
    return [place.with_suffix(suffix) for place in places for suffix in suffixes]
