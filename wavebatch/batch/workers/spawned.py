"""The worker processes of `processes`, and the threads that hand them calls.

Runs of one job do not import it: with it comes `multiprocessing`.
Before you change it: workers must end with this process, however it ends, or they would go on writing.
"""

from __future__ import annotations

import atexit
import contextlib
import multiprocessing
import os
import pickle
import queue
import signal
import sys
import threading
import types
from collections.abc import Iterator
from concurrent.futures import Future
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any

from wavebatch.batch.workers.futures import PATIENCE, WorkerDied, end_future
from wavebatch.batch.workers.serve import serve_calls
from wavebatch.core.errors import InputError
from wavebatch.core.interrupts import uninterrupted
from wavebatch.core.process import CHILD
from wavebatch.files.disk.temp_store import use_scratch

_NAME = "wavebatch"
"""Start of the names of our processes."""


@atexit.register  # called before that of multiprocessing, which is registered earlier
def _kill_all() -> None:
    """At the end of the program: Python would wait for ever for a stopped process that an interrupt has left here."""
    for process in multiprocessing.active_children():
        if process.name.startswith(_NAME):
            process.kill()


def start_early(jobs: int, needs_main: bool = False) -> None:
    """Start processes that the next Workers will take: they import their modules while this process does the same.

    Parameters
    ----------
    jobs : int
        Number of processes.
    needs_main : bool
        Whether they import the user's script. It would run again in each of them, so they do so only for stages that
        are defined in it.

    Raises
    ------
    InputError
        Where the system has no more processes.
    """
    with uninterrupted(), _as_children(needs_main):  # half a start would leave a process that complains
        while len(_early) < jobs:
            try:
                _early.append(_Process())
            except OSError as error:
                why = error.strerror or error
                raise InputError(f"process {len(_early) + 1} of --jobs cannot be started ({why}); use fewer") from error


@atexit.register  # called before that of multiprocessing, which would wait for stopped processes
def end_early() -> None:
    """End the processes that no Workers took."""
    while _early:
        _early.pop().end()


class Call:
    """A call on its way to a process, and its result."""

    def __init__(self, pickled: bytes) -> None:
        self.pickled = pickled
        self.future: Future = Future()


class _Process:
    """A process that waits for calls at the other end of a pipe."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, there = context.Pipe()
        self.process = context.Process(target=serve_calls, args=(there,), daemon=True)
        self.process.name = f"{_NAME}-{self.process.name}"
        try:
            self.process.start()
        finally:
            there.close()  # else a dead process would leave the pipe open

    def end(self) -> None:
        """End it at once."""
        self.process.kill()
        self.process.join(PATIENCE)
        self.pipe.close()


_early: list[_Process] = []
"""Started, and not taken yet."""


def take_early() -> _Process:
    """A process that `start_early` has started."""
    return _early.pop(0)


class PipedProcess:
    """A process, and the thread that hands it calls and takes its results through a pipe.

    One pipe per process: a process that dies in the middle of a result cannot block the results of the others.
    """

    def __init__(self, started: _Process, calls: queue.SimpleQueue[Call | None], scratch: Path | None) -> None:
        self.process, self._pipe = started.process, started.pipe
        self._calls = calls
        self._first = Call(pickle.dumps((use_scratch, (scratch,))))
        self.call: Call | None = self._first
        """The call under way."""
        self.serves = True
        """Whether it takes calls."""
        self._seen_dead = False
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        try:
            self._ask(self._first.pickled)
            self.call = None
            while (call := self._calls.get()) is not None:
                if not call.future.set_running_or_notify_cancel():
                    continue
                self.call = call
                result, error = self._ask(call.pickled)
                self.call = None
                end_future(call.future, result, error)
        except (EOFError, OSError):  # the process is dead
            self.serves = False
            if self.call is not None:
                end_future(self.call.future, error=WorkerDied())
        finally:
            self.serves = False
            self._pipe.close()

    def _ask(self, call: bytes) -> tuple[Any, BaseException | None]:
        self._pipe.send_bytes(call)
        answer = self._pipe.recv_bytes()
        try:
            return pickle.loads(answer)
        except Exception as error:
            return None, error

    def look(self) -> None:
        """Give the call of a dead process up, where another process still holds its end of the pipe open."""
        if self.process.is_alive():
            return
        call = self.call
        if self._seen_dead:  # a second look: its thread had time to take the last result
            self.serves = False
            if call is not None:
                end_future(call.future, error=WorkerDied())
        self._seen_dead = True


@contextlib.contextmanager
def _as_children(needs_main: bool) -> Iterator[None]:
    """Processes that are started inside use one thread per library, and modules of the installation only.

    They do not see Ctrl-C, which a terminal sends to them too. Unless they need it, they do not import the user's
    script either: multiprocessing finds an empty one.
    """
    main, variables = sys.modules["__main__"], {name: os.environ[name] for name in CHILD if name in os.environ}
    before: set[Any] | None = None
    try:
        os.environ.update(CHILD)
        if hasattr(signal, "pthread_sigmask"):
            resource_tracker.ensure_running()  # the start of the first process would do it, and let the signals through
            before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        if not needs_main:
            sys.modules["__main__"] = types.ModuleType("__main__")
        yield
    finally:
        sys.modules["__main__"] = main
        if before is not None:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for name in CHILD:
            os.environ.pop(name, None)
        os.environ.update(variables)
