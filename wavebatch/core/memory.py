"""Memory that NumPy frees stays with the process: kernels allocate the same few megabytes thousands of times."""

from __future__ import annotations

import ctypes
import sys

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
"""Parameters of glibc's mallopt(3)."""

KEEP = 128 << 20
"""Bytes of freed memory that a process may keep."""


def keep_freed_memory() -> bool:
    """Asks glibc not to hand freed arrays back to the kernel; True where that was possible.

    By default every array above some 100 kB is returned when freed and faulted in again page by page when the next
    one is made, which costs more than the arithmetic on it. Does nothing on other C libraries.
    """
    if not sys.platform.startswith("linux"):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError):
        return False
    return bool(mallopt(_TRIM_THRESHOLD, KEEP)) and bool(mallopt(_MMAP_THRESHOLD, KEEP // 4))
