"""Folders for temporary files that go with the process they belong to: at its end, or, if it was killed, at the start
of the next one."""

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
except ImportError:  # not on Windows: folders of killed processes then stay until somebody removes them
    fcntl = None

_LOCK = "lock"
_place: ContextVar[Path | None] = ContextVar("wavebatch_scratch", default=None)
_own: list[_Owned] = []


def make_folder() -> Path:
    """A new folder for temporary files, in the place that `use_scratch` says, or in one of this process's own.

    Raises OSError where there is no room for it.
    """
    place = _place.get()
    if place is None:
        if not _own:
            _own.append(_Owned(Path(tempfile.gettempdir()), ""))
            atexit.register(_own[0].close)
        place = _own[0].folder
    return Path(tempfile.mkdtemp(dir=place))


def scratch_place() -> Path:
    """Where `make_folder` works, for messages."""
    return _place.get() or Path(tempfile.gettempdir())


@contextlib.contextmanager
def reporting_scratch() -> Iterator[None]:
    """Turns an operating system's error with a temporary file into one InputError line."""
    try:
        yield
    except OSError as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"{scratch_place()}: the temporary file for what does not fit memory cannot be used "
            f"({error.strerror or error}); free space there or set TMPDIR to another folder"
        ) from error


def use_scratch(folder: Path | None) -> None:
    """Lets `make_folder` of this thread work in a folder that another process owns."""
    _place.set(folder)


@contextlib.contextmanager
def owning_scratch(parent: Path | None = None) -> Iterator[Path | None]:
    """A folder in `parent`, usually TMPDIR, that is gone at the end; this thread's `make_folder` works in it meanwhile.

    In a parent of the user's own the name is hidden. None where it cannot be made: who needs it will say so.
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
    """Removes the folders of killed processes from `parent` and returns their names.

    Only this user's and this machine's: a folder whose lock somebody holds is in use and stays, and of a process on
    another machine nobody can tell whether it lives. On systems without file locks nothing is removed.
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
    """A new folder with a lock that this process holds as long as it lives."""

    def __init__(self, parent: Path, hidden: str) -> None:
        remove_orphans(parent)
        while True:
            self.folder = Path(tempfile.mkdtemp(prefix=f"{hidden}{_prefix()}{os.getpid()}-", dir=parent))
            self._lock: int | None = None
            if fcntl is None:
                return
            try:
                self._lock = _take_lock(self.folder)
            except (BlockingIOError, FileNotFoundError):  # another process took it for an orphan
                continue
            except OSError:  # a file system without locks
                return
            if (self.folder / _LOCK).exists():
                return
            os.close(self._lock)

    def close(self) -> None:
        """Removes the folder with all that is in it; harmless twice."""
        shutil.rmtree(self.folder, ignore_errors=True)
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None


def _take_lock(folder: Path) -> int:
    """Descriptor of the folder's lock, held; BlockingIOError where another process holds it."""
    descriptor = os.open(folder / _LOCK, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


def _prefix() -> str:
    """What the names of this machine's folders begin with."""
    return f"wavebatch-{re.sub('[^A-Za-z0-9.]', '_', socket.gethostname())}-"


def _is_ours(folder: Path) -> bool:
    return folder.is_dir() and not folder.is_symlink() and folder.lstat().st_uid == os.getuid()
