"""Worker processes on this machine; with one job, the same calls run in this process.

`run` submits all work through it, or through `dask_cluster.Cluster`, which has the same methods.
Before you change it: workers must end with this process, however it ends, or they would go on writing.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from pathlib import Path
from typing import Any

from wavebatch.core.memory import keep_freed_memory
from wavebatch.files.disk.temp_folders import owning_scratch, use_scratch

_ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "RAYON_NUM_THREADS")
"""Each process works on one thread: more threads than cores only wait for each other."""


class Workers:
    """Runs functions in worker processes, or at once in this process for one job; a context manager.

    The processes are spawned, so that they inherit no state, use one thread each, and end when this process ends.

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
        self._before = set(multiprocessing.active_children())
        self._pool: ProcessPoolExecutor | None = None
        self._stack = contextlib.ExitStack()
        self._scratch: Path | None = None

    def __enter__(self) -> Workers:
        self._scratch = self._stack.enter_context(owning_scratch())
        return self

    def __exit__(self, kind: type | None, *error: object) -> None:
        with self._stack:
            if kind is None:
                self._shut(cancel=False)
            else:
                self.restart()

    def submit(self, function: Callable, *arguments: Any) -> Future:
        """Return the future result of `function(*arguments)`; both must be picklable."""
        if self.jobs == 1:
            return settle(Future(), function, *arguments)
        if self._pool is None:
            context = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(
                self.jobs, mp_context=context, initializer=_start_worker, initargs=(self._scratch,)
            )
        with _single_threaded():
            return self._pool.submit(function, *arguments)

    def wait(self, futures: Iterable[Future]) -> set[Future]:
        """Wait for at least one future and return those that are done."""
        return wait(futures, return_when=FIRST_COMPLETED).done

    def restart(self) -> None:
        """End all processes at once, for example after one has died; the next `submit` starts new ones."""
        if self._pool is not None:
            for child in set(multiprocessing.active_children()) - self._before:
                child.kill()
        self._shut(cancel=True)

    def _shut(self, cancel: bool) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=cancel)
            self._pool = None


def settle(future: Future, function: Callable, *arguments: Any) -> Future:
    """Run `function(*arguments)` here; its result or its error becomes that of `future`."""
    try:
        future.set_result(function(*arguments))
    except Exception as error:
        future.set_exception(error)
    return future


@contextlib.contextmanager
def _single_threaded() -> Iterator[None]:
    """Libraries of processes that are started inside use one thread each."""
    before = {name: os.environ[name] for name in _ONE_THREAD if name in os.environ}
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name in _ONE_THREAD:
            del os.environ[name]
        os.environ.update(before)


def _start_worker(scratch: Path | None) -> None:
    """In a new process: leave Ctrl-C to the parent process, and end when the parent ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    use_scratch(scratch)
    keep_freed_memory()
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: Any) -> None:
    parent.join()
    os._exit(1)
