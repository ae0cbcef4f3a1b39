"""A separate process for measurements: one thread, clean memory, and it may crash or hang without harm.

`speed`, and tests/bench, run functions in it. It is a plain subprocess, not multiprocessing, because that would import
the caller's main module into the measured process.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from wavebatch.core.errors import StageError
from wavebatch.core.process import CHILD
from wavebatch.files.disk.closing import Closing

_START = "from wavebatch.tools.bench.worker import serve; serve()"


class BenchWorkerDied(Exception):
    """The process ended before it answered."""


class Worker(Closing):
    """Runs functions in another Python process, one after another; a context manager."""

    def __init__(self) -> None:
        path = [str(Path(__file__).resolve().parents[3]), *filter(None, [os.environ.get("PYTHONPATH")]), *sys.path]
        environment = {**os.environ, **CHILD, "PYTHONPATH": os.pathsep.join(path)}
        self._process = subprocess.Popen(
            [sys.executable, "-c", _START], stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment
        )

    def call(self, function: Callable, *arguments: Any) -> Any:
        """`function(*arguments)` computed in the process; the function must be importable by name.

        Raises WorkerDied, or whatever the function raised. A caller that cannot wait uses a thread: `close` ends it.
        """
        try:
            pickle.dump((function, arguments), self._process.stdin, pickle.HIGHEST_PROTOCOL)
            self._process.stdin.flush()
            kind, value = pickle.load(self._process.stdout)
        except (EOFError, OSError, ValueError, pickle.UnpicklingError):
            raise BenchWorkerDied("the measuring process ended") from None
        if kind == "raised":
            raise value
        return value

    def close(self) -> None:
        """Kills the process."""
        self._process.kill()
        self._process.wait()
        with contextlib.suppress(OSError):  # what a call had not sent yet
            self._process.stdin.close()
        self._process.stdout.close()


def serve() -> None:
    """Answers calls on stdin until stdin ends; other output to stdout is sent to stderr."""
    from wavebatch.core.process import keep_freed_memory

    keep_freed_memory()
    replies = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    while True:
        try:
            function, arguments = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        try:
            answer = ("value", function(*arguments))
        except Exception as error:
            answer = ("raised", StageError(f"{type(error).__name__}: {error}"))
        pickle.dump(answer, replies, pickle.HIGHEST_PROTOCOL)
        replies.flush()


def peak_memory() -> int | None:
    """Peak memory of this process [bytes]; None where the system does not report it."""
    try:
        lines = Path("/proc/self/status").read_text("ascii").splitlines()
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM"))
    except (OSError, StopIteration):
        pass
    try:
        import resource
    except ImportError:
        return None
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else most * 1024
