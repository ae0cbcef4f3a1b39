"""Processes that work for a batch, or none: the same calls run in this process when one job is asked for."""

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


class Workers:
    """`submit` runs a function in one of `jobs` processes, or at once in this one if jobs is 1; a context manager.

    The processes are spawned, so that nothing is inherited, use one thread each, and end when this process ends.
    """

    is_remote = False

    def __init__(self, jobs: int) -> None:
        self.jobs = jobs
        self.limit = 1 if jobs == 1 else 2 * jobs
        """Calls that may wait for their results to be used."""
        keep_freed_memory()
        self._before = set(multiprocessing.active_children())
        self._pool: ProcessPoolExecutor | None = None
        self._own = owning_scratch()
        self._scratch: Path | None = None

    def __enter__(self) -> Workers:
        self._scratch = self._own.__enter__()
        return self

    def __exit__(self, kind: type | None, *error: object) -> None:
        try:
            if kind is None:
                self._shut(cancel=False)
            else:
                self.kill()
        finally:
            self._own.__exit__(None, None, None)

    def submit(self, function: Callable, *arguments: Any) -> Future:
        """The future result of `function(*arguments)`."""
        if self.jobs == 1:
            return _run_now(function, arguments)
        if self._pool is None:
            context = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(
                self.jobs, mp_context=context, initializer=_start_worker, initargs=(self._scratch,)
            )
        with _single_threaded():
            return self._pool.submit(function, *arguments)

    def wait(self, futures: Iterable[Future]) -> set[Future]:
        """Those that are done, at least one."""
        return wait(futures, return_when=FIRST_COMPLETED).done

    def restart(self) -> None:
        """Gives up the processes, of which one has died; the next `submit` starts new ones."""
        self.kill()

    def kill(self) -> None:
        """Ends the processes at once, whatever they do."""
        if self._pool is not None:
            for child in set(multiprocessing.active_children()) - self._before:
                child.kill()
        self._shut(cancel=True)

    def _shut(self, cancel: bool) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=cancel)
            self._pool = None


def _run_now(function: Callable, arguments: tuple) -> Future:
    future: Future = Future()
    try:
        future.set_result(function(*arguments))
    except Exception as error:
        future.set_exception(error)
    return future


@contextlib.contextmanager
def _single_threaded() -> Iterator[None]:
    """The libraries of processes started meanwhile use one thread each."""
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _start_worker(scratch: Path | None) -> None:
    """In a new process: Ctrl-C is the parent's business, and without the parent there is nothing to do."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    use_scratch(scratch)
    keep_freed_memory()
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: Any) -> None:
    parent.join()
    os._exit(1)
