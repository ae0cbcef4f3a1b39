"""Folders for temporary files that are removed when their process ends, or by the next run if it was killed.

Everything that does not fit into memory goes through here. A folder is in use as long as it is locked; nothing
else shows whether a process of another run is still alive.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import os
import re
import shutil
import socket
import tempfile
from collections.abc import Iterator
from contextvars import ContextVar
from pathlib import Path

from wavebatch.files.disk import locks
from wavebatch.files.disk.raw_bytes import in_one_line

_LOCK = "lock"
_place: ContextVar[Path | None] = ContextVar("wavebatch_scratch", default=None)
_own: list[_Owned] = []


def make_folder() -> Path:
    """Return a new folder for temporary files, in the folder of `use_scratch` or in one of this process.

    Raises OSError if there is no room for it.
    """
    place = _place.get()
    if place is None:
        if not _own:
            _own.append(_Owned(Path(tempfile.gettempdir()), ""))
            atexit.register(_own[0].close)
        place = _own[0].folder
    return Path(tempfile.mkdtemp(dir=place))


def scratch_place() -> Path:
    """Return the folder in which `make_folder` makes folders, for messages."""
    return _place.get() or Path(tempfile.gettempdir())


def reporting_scratch() -> contextlib.AbstractContextManager[None]:
    """Turn an error of the operating system with a temporary file into one InputError line."""
    remedy = "free space or set TMPDIR to another folder"
    return in_one_line(lambda _, why: f"{scratch_place()}: no temporary file can be used there ({why}); {remedy}")


def use_scratch(folder: Path | None) -> None:
    """Let `make_folder` of this thread work in a folder of another process."""
    _place.set(folder)


@contextlib.contextmanager
def owning_scratch(parent: Path | None = None) -> Iterator[Path | None]:
    """Make a folder in `parent` (default: TMPDIR) for `make_folder` of this thread, and remove it at the end.

    In a folder of the user its name is hidden. Gives None if it cannot be made: whoever needs it reports the error.
    """
    try:
        owned = _Owned(Path(parent or tempfile.gettempdir()), "." if parent else "")
    except OSError:
        yield None
        return
    token = _place.set(owned.folder)
    try:
        yield owned.folder
    finally:
        _place.reset(token)
        owned.close()


def remove_orphans(parent: Path) -> list[Path]:
    """Remove the folders of killed processes from `parent` and return their names.

    Only folders of this user and this machine: a locked folder is in use, and whether a process of another machine is
    alive cannot be known. On systems without file locks nothing is removed.
    """
    found = [*parent.glob(f"{_prefix()}*"), *parent.glob(f".{_prefix()}*")]
    return locks.remove_unlocked(found, _open_lock, functools.partial(shutil.rmtree, ignore_errors=True))


class _Owned:
    """A new folder with a lock that this process holds until it ends."""

    def __init__(self, parent: Path, hidden: str) -> None:
        remove_orphans(parent)
        self._lock: int | None
        self.folder, self._lock = locks.make_locked(lambda: _make_folder(parent, hidden))

    def close(self) -> None:
        """Remove the folder with its content; may be called twice."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None
        shutil.rmtree(self.folder, ignore_errors=True)


def _make_folder(parent: Path, hidden: str) -> tuple[Path, int]:
    """A new folder and the descriptor of its lock file."""
    while True:
        folder = Path(tempfile.mkdtemp(prefix=f"{hidden}{_prefix()}{os.getpid()}-", dir=parent))
        with contextlib.suppress(FileNotFoundError):  # another process removed it as left over
            return folder, os.open(folder / _LOCK, locks.FLAGS | os.O_CREAT, 0o600)


def _open_lock(folder: Path) -> int:
    """The descriptor of a folder's lock file; OSError for links and folders of other users."""
    if folder.is_symlink() or folder.lstat().st_uid != os.getuid():
        raise FileNotFoundError(folder)
    return os.open(folder / _LOCK, locks.FLAGS | os.O_CREAT, 0o600)


def _prefix() -> str:
    """Start of the names of this machine's folders."""
    return f"wavebatch-{re.sub('[^A-Za-z0-9.]', '_', socket.gethostname())}-"
