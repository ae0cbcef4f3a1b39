"""Workers of an existing dask cluster, for `wavebatch run --scheduler`; files must be visible to all machines.

`Cluster` has the same methods as `processes.Workers`. Work goes to workers that were asked whether they fit: those
that are there when the run starts must fit; of those that join later, only workers that fit get work.
Before you change it: calls and results travel as bytes, because dask takes tuples with functions for tasks and makes
arrays read-only; and a cluster that is lost must end the run with a message, never hang it.

A client of dask that fails may hang, leave threads, and print: so what can be known before is asked before
(`connected`), and a cluster is refused within seconds, in one line.
"""

from __future__ import annotations

import contextlib
import importlib.util
import logging
import pickle
import socket
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Future
from pathlib import Path
from typing import Any

from wavebatch.batch.workers.futures import end_future, settle_future, wait_uninterrupted
from wavebatch.batch.workers.worker_check import compare_workers, describe_worker, list_sizes
from wavebatch.core.errors import ConfigError, InputError, advise_install
from wavebatch.files.disk.publish import Draft, list_packet_files, reporting
from wavebatch.files.disk.temp_store import owning_scratch, use_scratch

PATIENCE = 60.0
"""Seconds without a worker, or without an answer of the scheduler, after which a cluster counts as lost."""
_WORKERS = 10.0
"""Seconds to wait for the first worker."""
_POLL = 5.0
"""Seconds between two questions to the scheduler."""
_ADVICE = "check that it runs, and run again with --resume: finished clouds are complete"


class Cluster:
    """Runs functions on the workers of a cluster; a context manager.

    Parameters
    ----------
    address : str
        Of the scheduler.
    folder : Path
        Of the outputs; temporary files that workers share lie in it.
    files : sequence of Path
        That all workers must see: `StripJob.files`.

    Raises
    ------
    ConfigError
        When the context is entered: the cluster cannot be reached, or its workers do not fit.
    """

    is_remote = True

    def __init__(self, address: str, folder: Path, files: Sequence[Path] = ()) -> None:
        self.address, self._folder, self._files = address, folder.absolute(), files
        self._workers: dict[str, int] = {}
        """Threads of each worker that is known to fit; others get no call."""
        self._asked: dict[str, Any] = {}
        """Answers, there or to come, of the workers that have joined since the start."""
        self._looked = time.monotonic()
        self._client: Any = None
        self._scratch: Path | None = None
        self._heard = time.monotonic()
        self._shared: list[str] = []
        """Files that all workers must see with the same sizes."""
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> Cluster:
        if importlib.util.find_spec("distributed") is None:
            raise ConfigError(f"--scheduler: dask's distributed is not installed: {advise_install('distributed')}")
        with contextlib.ExitStack() as stack:
            stack.enter_context(silent())
            self._client = stack.enter_context(connected(self.address))
            try:
                self._client.wait_for_workers(1, timeout=_WORKERS)
            except Exception as error:
                problem = "has no workers; start some: dask worker ADDRESS"
                raise ConfigError(f"--scheduler {self.address}: {problem}") from error
            self._workers = dict(self._client.nthreads())
            here = describe_worker()
            for worker, kind in sorted(self._ask(describe_worker).items()):
                if why := compare_workers(here, kind):
                    raise ConfigError(f"--scheduler {self.address}: worker {worker} {why}")
            try:
                self._client.run_on_scheduler(describe_worker)
            except Exception as error:
                raise ConfigError(
                    f"--scheduler {self.address}: the scheduler cannot load wavebatch ({shorten_error(error)}); "
                    "install the same there"
                ) from error
            with reporting(self._folder):
                self._folder.mkdir(parents=True, exist_ok=True)
            shared = (
                "strips and outputs must lie on a file system that all workers share, under the same names, and they "
                "must be the same files"
            )
            with Draft(self._folder / "workers", overwrite=False) as token:  # never published
                token.file.write(b"seen")
                token.file.flush()
                paths = [path.absolute() for path in self._files]
                strips = [(path, *filter(Path.exists, list_packet_files(path))) for path in paths]
                self._shared = [str(file) for strip in strips for file in strip]
                files = [*self._shared, str(token.path)]
                sizes = list_sizes(files)
                for worker, there in sorted(self._ask(list_sizes, files).items()):
                    lost = [file for file, mine, theirs in zip(files, sizes, there, strict=True) if mine != theirs]
                    if lost:
                        what = f"{self._folder}" if lost == files[-1:] else lost[0]
                        raise ConfigError(f"--scheduler {self.address}: worker {worker} does not see {what}; {shared}")
            self._scratch = stack.enter_context(owning_scratch(self._folder))
            self._shared += [str(file) for file in self._scratch.iterdir()] if self._scratch else []
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    @property
    def jobs(self) -> int:
        """Threads of all workers."""
        return sum(self._workers.values())

    @property
    def limit(self) -> int:
        """Most calls that may be under way."""
        return 2 * self.jobs

    def submit(self, function: Callable, *arguments: Any) -> Future:
        """Return the future result of `function(*arguments)`; both must be picklable."""
        if time.monotonic() - self._looked > _POLL:
            self._look()
        promise = _Promise(pickle.dumps((self._scratch, function, arguments), pickle.HIGHEST_PROTOCOL), self._translate)
        self._send(promise)
        return promise

    def _send(self, promise: _Promise) -> None:
        try:
            promise.follow(self._client.submit(_work, promise.call, pure=False, workers=list(self._workers)))
        except Exception as error:
            raise self._lost(error) from error
        promise.workers = frozenset(self._workers)

    def _look(self) -> set[str]:
        """Take in workers that have joined and fit; return those that are there and fit, none where nobody answers."""
        self._looked = time.monotonic()
        there: dict[str, int] = {}
        with contextlib.suppress(Exception):
            there = self._client.sync(self._client.scheduler.ncores, workers=None, callback_timeout=_POLL)
            for worker in there.keys() - self._workers.keys() - self._asked.keys():
                self._asked[worker] = self._client.submit(_introduce, self._shared, pure=False, workers=[worker])
        for worker in [worker for worker in there.keys() & self._asked.keys() if self._asked[worker].done()]:
            with contextlib.suppress(Exception):
                kind, sizes = self._asked[worker].result(timeout=_POLL)
                if not compare_workers(describe_worker(), kind) and sizes == list_sizes(self._shared):
                    self._workers.setdefault(worker, there[worker])
        return there.keys() & self._workers.keys()

    def map(self, function: Callable[[Any], Any], items: Iterable[Any]) -> Iterator[Any]:
        """Yield `function(item)` of every item, in this process: short calls are slower on another machine."""
        return map(function, items)

    def wait(self, futures: Iterable[Future]) -> set[Future]:
        """Wait for at least one future and return those done; BrokenExecutor where the cluster is lost."""
        futures = list(futures)
        self._heard = time.monotonic()
        while not (done := wait_uninterrupted(futures, _POLL)):
            if there := self._look():
                self._heard = time.monotonic()
                for promise in futures:
                    # Dask would wait until these workers come back.
                    if isinstance(promise, _Promise) and not promise.workers & there:
                        self._send(promise)
            if self._client.status == "closed" or time.monotonic() - self._heard > PATIENCE:
                raise self._lost("no worker answers")
        return done

    def restart(self) -> None:
        """Do nothing: calls of a worker that died go to the others."""

    def _ask(self, function: Callable, *arguments: Any) -> dict[str, Any]:
        """The answer of each worker."""
        try:
            return self._client.run(function, *arguments, workers=list(self._workers))
        except Exception as error:
            raise ConfigError(
                f"--scheduler {self.address}: a worker cannot be asked: {shorten_error(error)}; "
                "it needs the same wavebatch"
            ) from error

    def _translate(self, error: BaseException) -> BaseException:
        """The error of a call, in the words of wavebatch where it comes from the cluster."""
        from distributed import KilledWorker
        from distributed.client import FutureCancelledError

        if isinstance(error, FutureCancelledError):
            return self._lost(error)
        if isinstance(error, KilledWorker):
            return InputError(
                f"{self.address}: workers died while they worked on this strip (killed, or out of memory); run again "
                "with --resume and workers of more memory"
            )
        return error

    def _lost(self, reason: object) -> BrokenExecutor:
        return BrokenExecutor(f"{self.address}: the cluster is lost ({shorten_error(reason)}); {_ADVICE}")


class _Promise(Future):
    """The result of a call by a worker, with the interface of concurrent.futures."""

    def __init__(self, call: bytes, translate: Callable[[BaseException], BaseException]) -> None:
        super().__init__()
        self.call, self._translate = call, translate
        self.workers: frozenset[str] = frozenset()
        """Those that may make the call."""
        self._remote: Any = None

    def follow(self, remote: Any) -> None:
        """Take the result of this remote future, and of no earlier one."""
        self._remote = remote
        remote.add_done_callback(self._take)

    def _take(self, remote: Any) -> None:
        if remote is not self._remote:
            return
        try:
            result, error = pickle.loads(remote.result()), None
        except BaseException as failure:
            result, error = None, self._translate(failure)
        end_future(self, result, error)

    def cancel(self) -> bool:
        """Cancel the call, and release it so that the cluster drops it too."""
        cancelled = super().cancel()
        with contextlib.suppress(Exception):
            self._remote.release()
        return cancelled


def _work(call: bytes) -> bytes:
    """On a worker: the pickled result of a call; temporary files lie in a folder that all workers see."""
    scratch, function, arguments = pickle.loads(call)
    use_scratch(scratch)
    try:
        return pickle.dumps(function(*arguments), pickle.HIGHEST_PROTOCOL)
    finally:
        use_scratch(None)


def _introduce(files: list[str]) -> tuple[dict[str, str], list[int]]:
    """On a worker: its kind, and the sizes of the files as it sees them."""
    return describe_worker(), list_sizes(files)


_CONNECT = 4.0
"""Seconds to wait for a connection, and for the scheduler's first answer."""
_SCHEMES = ("tcp", "tls", "ws", "wss", "ucx")
"""Kinds of addresses that dask knows and that other machines can have."""
_CLOSE = 5.0
"""Seconds to wait for the end of a connection."""
_LOUD = ("distributed", "distributed.client", "distributed.core", "distributed.utils_perf", "tornado", "asyncio")


@contextlib.contextmanager
def connected(address: str) -> Iterator[Any]:
    """A client of the cluster; ConfigError where it cannot be reached."""
    from distributed import Client
    from distributed.security import Security

    try:
        # A client that fails can hang and leave threads.
        scheme, separator, place = address.rpartition("://")
        if separator and scheme not in _SCHEMES:
            raise ValueError(f"no scheduler has an address of the kind {scheme}://; known are {', '.join(_SCHEMES)}")
        host, _, port = place.rpartition(":")
        if not host or not port.isdigit():
            raise ValueError("it has no host and port")
        socket.create_connection((host.strip("[]"), int(port)), timeout=_CONNECT).close()
        # A client that fails prints more when it ends; one that waits too long goes on in its thread.
        if address.startswith("tls://") and Security().get_connection_args("client").get("ssl_context") is None:
            what = "no certificate and key here (distributed.comm.tls in its configuration)"
            raise ValueError(f"dask has {what}; set them")
        options = {"timeout": _CONNECT, "set_as_default": False, "name": "wavebatch"}
        future: Future = Future()
        threading.Thread(target=settle_future, args=(future, lambda: Client(address, **options)), daemon=True).start()
        client = future.result(timeout=_CONNECT + 0.5)
    except Exception as error:
        raise ConfigError(
            f"--scheduler {address}: cannot be reached: {shorten_error(error)}; "
            "give the address that dask scheduler prints"
        ) from error
    try:
        yield client
    finally:
        with contextlib.suppress(Exception):
            client.close(timeout=_CLOSE)


@contextlib.contextmanager
def silent() -> Iterator[None]:
    """Silence dask's messages on stderr: wavebatch reports the same in one line."""
    import dask
    import distributed  # noqa: F401 - creates the loggers that are silenced below

    levels = {name: logging.getLogger(name).level for name in _LOUD}
    quiet = dask.config.set({"distributed.admin.large-graph-warning-threshold": "1 TiB"})
    with quiet, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            for name in _LOUD:
                logging.getLogger(name).setLevel(logging.CRITICAL + 1)
            yield
        finally:
            for name, level in levels.items():
                logging.getLogger(name).setLevel(level)


def shorten_error(reason: object) -> str:
    """The text of an error on one line of bounded length."""
    return " ".join(str(reason).split())[:200] or type(reason).__name__
