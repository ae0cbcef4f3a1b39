"""Locks of temporary files and folders: they show which of them a running process still uses.

`publish` locks each temporary file, `temp_folders` a file in each folder. Nothing else shows whether a process of
another run is still alive.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

fcntl: Any
try:
    import fcntl
except ImportError:  # Windows has no fcntl: what killed processes left then stays until the user removes it
    fcntl = None

FLAGS = os.O_RDWR | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)


def make_locked(make: Callable[[], tuple[Path, int]]) -> tuple[Path, int]:
    """Return a new path and the descriptor of its lock file, locked.

    make: makes both; it is called again if `remove_unlocked` of another process took them before they were locked.
    """
    while True:
        path, descriptor = make()
        with contextlib.suppress(BlockingIOError):
            if hold(descriptor):
                return path, descriptor
        os.close(descriptor)


def hold(descriptor: int) -> bool:
    """Lock an open file; False if it was removed meanwhile. Raises BlockingIOError if another process has locked it."""
    try:
        if fcntl is not None:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return os.fstat(descriptor).st_nlink > 0
    except BlockingIOError:
        raise
    except OSError:  # a file system without locks
        return True


def remove_unlocked(
    paths: Iterable[Path], open_lock: Callable[[Path], int], remove: Callable[[Path], None]
) -> list[Path]:
    """Remove those of the paths that no process has locked, and return them.

    open_lock: returns the descriptor of a path's lock file; a path for which it raises OSError stays. On systems
    without file locks nothing is removed.
    """
    removed: list[Path] = []
    for path in sorted(paths) if fcntl is not None else ():
        with contextlib.suppress(OSError):
            descriptor = open_lock(path)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                remove(path)
                removed.append(path)
            finally:
                os.close(descriptor)
    return removed
