"""Worker processes on this machine; with one job, the same calls run in this process.

`run` submits all work through it, or through `dask_cluster.Cluster`, which has the same methods. The processes are in
`spawned`, which a run of one job does not import.
Before you change it: any worker may be killed or stopped at any instant, also while it sends a result: nothing here may
wait for a worker without a limit, except for the result of a call of a process that is alive.
"""

from __future__ import annotations

import contextlib
import pickle
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any

from wavebatch.batch.workers.futures import PATIENCE, WorkerDied, end_future, settle_future, wait_uninterrupted
from wavebatch.core.interrupts import uninterrupted
from wavebatch.core.process import keep_freed_memory
from wavebatch.files.disk.temp_store import owning_scratch

if TYPE_CHECKING:
    from wavebatch.batch.workers.spawned import Call, PipedProcess

_POLL = 1.0
"""Seconds between two looks at the processes, for a death that their pipes do not show."""

_MAIN = b"__main__"
"""Module of the user's script in a pickled call: a stage that is defined there."""


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
        self._calls: SimpleQueue[Call | None] = SimpleQueue()
        self._workers: list[PipedProcess] = []
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
        from wavebatch.batch.workers.spawned import Call, PipedProcess, end_early, start_early, take_early

        payload = pickle.dumps((function, arguments), pickle.HIGHEST_PROTOCOL)
        self._needs_main = self._needs_main or _MAIN in payload
        self._workers = [worker for worker in self._workers if worker.serves]
        if len(self._workers) < self.jobs:
            with uninterrupted():
                start_early(self.jobs - len(self._workers), self._needs_main)
                while len(self._workers) < self.jobs:
                    self._workers.append(PipedProcess(take_early(), self._calls, self._scratch))
                end_early()
        call = Call(payload)
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
        if self.jobs == 1:
            return
        from wavebatch.batch.workers.spawned import end_early

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
                self._workers, self._calls = [], SimpleQueue()


def refuse_import() -> None:
    """End this process where it only imports the user's script, and so would run it again."""
    spawned = sys.modules.get("multiprocessing")
    if spawned is not None and getattr(spawned.current_process(), "_inheriting", False):
        raise SystemExit(
            "error: this script has a stage, so that each process imports it: write what it does under "
            'if __name__ == "__main__":, or put the stage into a module'
        )
