"""Worker processes on this machine; with one job, the same calls run in this process.

`run` submits all work through it, or through `dask_cluster.Cluster`, which has the same methods. Futures are waited for
so that no interrupt leaves a lock taken, and ended once.
Before you change it: workers must end with this process, however it ends, or they would go on writing. Any worker may
be killed or stopped at any instant, also while it sends a result: nothing here may wait for a worker without a limit,
except for the result of a call of a process that is alive.
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
import time
import types
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, InvalidStateError, wait
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any

from wavebatch.batch.workers.serve import PATIENCE, serve_calls
from wavebatch.core.errors import InputError
from wavebatch.core.interrupts import uninterrupted
from wavebatch.core.process import CHILD, keep_freed_memory
from wavebatch.files.disk.temp_store import owning_scratch, use_scratch

LATENCY = 0.1
"""Seconds after which Ctrl-C is seen at the latest while results are waited for."""


def wait_uninterrupted(futures: list[Future], seconds: float) -> set[Future]:
    """Return the futures that are done within so many seconds, or as soon as one is.

    An interrupt inside `wait` may leave a lock taken. The thread that settles this future would then hold it for ever,
    and so would `cancel`. So interrupts come between short waits only.
    """
    deadline = time.monotonic() + seconds
    while True:
        with uninterrupted():
            done = wait(futures, timeout=LATENCY, return_when=FIRST_COMPLETED).done
        if done or time.monotonic() > deadline:
            return done


def end_future(future: Future, result: Any = None, error: BaseException | None = None) -> None:
    """Give the future its end, unless it has one."""
    with contextlib.suppress(InvalidStateError):
        if error is None:
            future.set_result(result)
        else:
            future.set_exception(error)


def settle_future(future: Future, function: Callable, *arguments: Any) -> Future:
    """Run `function(*arguments)` here; its result or its error becomes that of `future`."""
    try:
        future.set_result(function(*arguments))
    except Exception as error:
        future.set_exception(error)
    return future


_POLL = 1.0
"""Seconds between two looks at the processes, for a death that their pipes do not show."""

_MAIN = b"__main__"
"""Module of the user's script in a pickled call: a stage that is defined there."""

_NAME = "wavebatch"
"""Start of the names of our processes."""


class WorkerDied(Exception):
    """A worker process ended while it made a call: killed, or out of memory."""


class Workers:
    """Runs functions in worker processes, or at once in this process for one job; a context manager.

    The processes are spawned, so that they inherit no state, use one thread each, and end when this process ends.
    A future whose process dies gets WorkerDied; the other processes go on, and the next `submit` starts a new one.

    Parameters
    ----------
    jobs : int
        Number of processes.
    """

    is_remote = False

    def __init__(self, jobs: int) -> None:
        self.jobs = jobs
        self.limit = 1 if jobs == 1 else 2 * jobs
        """Most calls that may be under way; two per process keep it busy while results are written."""
        keep_freed_memory()
        self._calls: queue.SimpleQueue[_Call | None] = queue.SimpleQueue()
        self._workers: list[_Worker] = []
        self._stack = contextlib.ExitStack()
        self._scratch: Path | None = None
        self._needs_main = False
        """Whether calls use functions of the user's script, which the processes then import."""

    def __enter__(self) -> Workers:
        self._scratch = self._stack.enter_context(owning_scratch())
        return self

    def __exit__(self, *error: object) -> None:
        with self._stack:
            self._end()

    def submit(self, function: Callable, *arguments: Any) -> Future:
        """Return the future result of `function(*arguments)`; both must be picklable."""
        if self.jobs == 1:
            return settle_future(Future(), function, *arguments)
        payload = pickle.dumps((function, arguments), pickle.HIGHEST_PROTOCOL)
        self._needs_main = self._needs_main or _MAIN in payload
        self._workers = [worker for worker in self._workers if worker.serves]
        if len(self._workers) < self.jobs:
            with uninterrupted():
                start_early(self.jobs - len(self._workers), self._needs_main)
                while len(self._workers) < self.jobs:
                    self._workers.append(_Worker(_early.pop(0), self._calls, self._scratch))
                end_early()
        call = _Call(payload)
        self._calls.put(call)
        return call.future

    def map(self, function: Callable[[Any], Any], items: Iterable[Any]) -> Iterator[Any]:
        """Yield `function(item)` of every item, in order; here, where a process died of it."""
        waiting: deque[tuple[Any, Future]] = deque()
        for item in items:
            waiting.append((item, self.submit(function, item)))
            if len(waiting) >= self.limit:
                yield self._take_first(function, waiting)
        while waiting:
            yield self._take_first(function, waiting)

    def _take_first(self, function: Callable[[Any], Any], waiting: deque[tuple[Any, Future]]) -> Any:
        item, future = waiting.popleft()
        while not future.done():
            self.wait([future])
        try:
            return future.result()
        except WorkerDied:
            return function(item)

    def wait(self, futures: Iterable[Future]) -> set[Future]:
        """Wait for at least one future and return those that are done."""
        futures = list(futures)
        while not (done := wait_uninterrupted(futures, _POLL)):
            for worker in self._workers:
                worker.look()
            if not any(worker.serves for worker in self._workers):  # calls that no process has taken
                for future in futures:
                    end_future(future, error=WorkerDied())
        return done

    def restart(self) -> None:
        """End all processes, with the calls that they make; the next `submit` starts new ones."""
        for worker in self._workers:
            worker.process.kill()
        self._end()

    def _end(self) -> None:
        """End all processes: those that wait for a call are asked to end, the others are killed."""
        try:
            end_early()
            for worker in self._workers:
                if worker.call is not None:
                    worker.process.kill()
                self._calls.put(None)
            deadline = time.monotonic() + PATIENCE
            for worker in self._workers:
                worker.process.join(max(deadline - time.monotonic(), 0))
        finally:
            with uninterrupted():  # also after Ctrl-C while it waits above
                for worker in self._workers:
                    worker.process.kill()  # also one that is stopped
                    worker.process.join(PATIENCE)
                self._workers, self._calls = [], queue.SimpleQueue()


@atexit.register  # called before that of multiprocessing, which is registered earlier
def _kill_all() -> None:
    """At the end of the program: Python would wait for ever for a stopped process that an interrupt has left here."""
    for process in multiprocessing.active_children():
        if process.name.startswith(_NAME):
            process.kill()


def refuse_import() -> None:
    """End this process where it only imports the user's script, and so would run it again."""
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        raise SystemExit(
            "error: this script has a stage, so that each process imports it: write what it does under "
            'if __name__ == "__main__":, or put the stage into a module'
        )


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
    # Half a start would leave a process that complains.
    with uninterrupted(), _single_threaded(), _ctrl_c_held(), contextlib.nullcontext() if needs_main else _no_main():
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


class _Call:
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


class _Worker:
    """A process, and the thread that hands it calls and takes its results through a pipe.

    One pipe per process: a process that dies in the middle of a result cannot block the results of the others.
    """

    def __init__(self, started: _Process, calls: queue.SimpleQueue[_Call | None], scratch: Path | None) -> None:
        self.process, self._pipe = started.process, started.pipe
        self._calls = calls
        self._first = _Call(pickle.dumps((use_scratch, (scratch,))))
        self.call: _Call | None = self._first
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
        return _unpack(self._pipe.recv_bytes())

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


def _unpack(answer: bytes) -> tuple[Any, BaseException | None]:
    try:
        return pickle.loads(answer)
    except Exception as error:
        return None, error


@contextlib.contextmanager
def _no_main() -> Iterator[None]:
    """Processes that are started inside do not import the user's script: multiprocessing finds an empty one."""
    before = sys.modules["__main__"]
    sys.modules["__main__"] = types.ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = before


@contextlib.contextmanager
def _single_threaded() -> Iterator[None]:
    """Libraries of processes that are started inside use one thread each, and modules of the installation only."""
    before = {name: os.environ[name] for name in CHILD if name in os.environ}
    os.environ.update(CHILD)
    try:
        yield
    finally:
        for name in CHILD:
            del os.environ[name]
        os.environ.update(before)


@contextlib.contextmanager
def _ctrl_c_held() -> Iterator[None]:
    """Processes that are started inside do not see Ctrl-C, which a terminal sends to them too."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    resource_tracker.ensure_running()  # the start of the first process would do it, and let the signals through
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
