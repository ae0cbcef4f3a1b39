"""Memory, threads and time of a process.

`keep_freed_memory` is called once at the start of each command and worker process, because kernels allocate the same
few megabytes thousands of times. It changes speed only, never results.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import sys
import time
from collections.abc import Iterator

from wavebatch.core.frozen import frozen

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
"""Parameters of glibc's mallopt(3)."""

KEEP = 128 << 20
"""Freed memory that a process may keep [bytes]: the arrays of one block need less."""

ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
"""Variables that keep libraries to one thread, in processes that start with them: wavebatch's arrays are too small for
more, and the last bits of a product depend on how it is shared out."""

CHILD = {**dict.fromkeys(ONE_THREAD, "1"), "PYTHONSAFEPATH": "1"}
"""Variables of processes that wavebatch starts: one thread, and no modules from the current folder, where a `signal.py`
that came with the data would run."""


def keep_freed_memory() -> bool:
    """Asks glibc to keep freed arrays instead of returning them to the operating system.

    By default every array above about 100 kB is returned when freed and mapped page by page when the next one is made,
    which costs more than the arithmetic on it.

    Returns
    -------
    bool
        True where it worked; False on other C libraries, where nothing changes.
    """
    if not sys.platform.startswith("linux"):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError):
        return False
    return bool(mallopt(_TRIM_THRESHOLD, KEEP)) and bool(mallopt(_MMAP_THRESHOLD, KEEP // 4))


OBJECTS = 10_000
"""New objects after which a process looks for cyclic garbage, instead of 700: a survey makes 20,000 and hardly any
cycle; arrays are in none."""


@contextlib.contextmanager
def importing() -> Iterator[None]:
    """Do not look for cyclic garbage while modules are imported, and never in what they leave.

    Nothing there is garbage, and looking for it again and again takes a tenth of the start of a run. What a process
    holds already is never looked through again either: for commands and workers, which import before they work.
    Afterwards garbage is looked for OBJECTS at a time.
    """
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.set_threshold(OBJECTS)
        if was_on:
            gc.enable()


@frozen
class Seconds:
    """Time that tasks took; sums and differences are taken part by part."""

    processor: float = 0.0
    """Of all threads of the process that did the task [s]."""
    wall: float = 0.0
    """By the clock, with waiting for the disk and for other programs [s]."""

    @classmethod
    def now(cls) -> Seconds:
        """Return the times of this process; only differences mean something."""
        return cls(time.process_time(), time.perf_counter())

    def __add__(self, other: Seconds) -> Seconds:
        return Seconds(self.processor + other.processor, self.wall + other.wall)

    def __sub__(self, other: Seconds) -> Seconds:
        return Seconds(self.processor - other.processor, self.wall - other.wall)
