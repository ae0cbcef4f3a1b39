"""Folders for temporary files that are removed when their process ends, or by the next run if it was killed.

Everything that does not fit into memory goes through here. A folder is in use as long as its lock is held; nothing
else shows whether a process of another run is still alive.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import re
import shutil
import socket
import tempfile
from collections.abc import Iterator
from contextvars import ContextVar
from pathlib import Path

from wavebatch.core.errors import InputError

try:
    import fcntl
except ImportError:  # Windows has no fcntl: folders of killed processes then stay until the user removes them
    fcntl = None

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


@contextlib.contextmanager
def reporting_scratch() -> Iterator[None]:
    """Turn an error of the operating system with a temporary file into one InputError line."""
    try:
        yield
    except OSError as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"{scratch_place()}: no temporary file can be used there ({error.strerror or error}); free space or set "
            "TMPDIR to another folder"
        ) from error


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
    removed: list[Path] = []
    if fcntl is None:
        return removed
    for folder in sorted(parent.glob(f"*{_prefix()}*")):
        with contextlib.suppress(OSError):
            if not folder.name.removeprefix(".").startswith(_prefix()) or not _is_ours(folder):
                continue
            descriptor = _take_lock(folder)
            try:
                shutil.rmtree(folder, ignore_errors=True)
                removed.append(folder)
            finally:
                os.close(descriptor)
    return removed


class _Owned:
    """A new folder with a lock that this process holds until it ends."""

    def __init__(self, parent: Path, hidden: str) -> None:
        remove_orphans(parent)
        while True:
            self.folder = Path(tempfile.mkdtemp(prefix=f"{hidden}{_prefix()}{os.getpid()}-", dir=parent))
            self._lock: int | None = None
            if fcntl is None:
                return
            try:
                self._lock = _take_lock(self.folder)
            except (BlockingIOError, FileNotFoundError):  # another process removed it as left over
                continue
            except OSError:  # a file system without locks
                return
            if (self.folder / _LOCK).exists():
                return
            os.close(self._lock)

    def close(self) -> None:
        """Remove the folder with its content; may be called twice."""
        shutil.rmtree(self.folder, ignore_errors=True)
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None


def _take_lock(folder: Path) -> int:
    """Takes the lock of the folder and returns its descriptor; BlockingIOError if another process holds it."""
    descriptor = os.open(folder / _LOCK, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


def _prefix() -> str:
    """Start of the names of this machine's folders."""
    return f"wavebatch-{re.sub('[^A-Za-z0-9.]', '_', socket.gethostname())}-"


def _is_ours(folder: Path) -> bool:
    return folder.is_dir() and not folder.is_symlink() and folder.lstat().st_uid == os.getuid()
