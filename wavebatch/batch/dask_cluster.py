"""Workers of a dask cluster that somebody else runs: the same calls, made there, on files that all machines see."""

from __future__ import annotations

import contextlib
import importlib.util
import logging
import os
import pickle
import platform
import socket
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, InvalidStateError, wait
from pathlib import Path
from typing import Any

from wavebatch.core.errors import ConfigError, InputError
from wavebatch.files.disk.publish import reporting
from wavebatch.files.disk.temp_folders import owning_scratch, use_scratch

PATIENCE = 60.0
"""Seconds without a worker, or without a word of the scheduler, after which a cluster counts as lost."""
_CONNECT = 10.0
_POLL = 5.0
_SAME = ("wavebatch", "numpy", "scipy")
"""Packages that must have one version everywhere, because they decide what is written."""
_LOUD = ("distributed", "distributed.client", "distributed.core", "distributed.utils_perf", "tornado", "asyncio")
_ADVICE = "see that it runs, and run again with --resume: finished clouds are complete"


class Cluster:
    """`submit` runs a function on any worker of the cluster at `address`; a context manager.

    folder: of the outputs; temporary files that workers share lie in it, so that all of them must see it.
    Entering raises ConfigError where the cluster cannot be reached or its workers are not fit.
    """

    is_remote = True

    def __init__(self, address: str, folder: Path) -> None:
        self.address, self._folder = address, folder.absolute()
        self.limit = 2
        self._client: Any = None
        self._scratch: Path | None = None
        self._heard = time.monotonic()
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> Cluster:
        if importlib.util.find_spec("distributed") is None:
            raise ConfigError("--scheduler: dask's distributed is not installed; pip install wavebatch[cluster]")
        with contextlib.ExitStack() as stack:
            stack.enter_context(_silent())
            self._client = stack.enter_context(_connected(self.address))
            self.limit = 2 * self._count_threads()
            self._check_versions()
            with reporting(self._folder):
                self._folder.mkdir(parents=True, exist_ok=True)
            self._check_folder()
            self._scratch = stack.enter_context(owning_scratch(self._folder))
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    def submit(self, function: Callable, *arguments: Any) -> Future:
        """The future result of `function(*arguments)`."""
        try:
            call = pickle.dumps((_work, (self._scratch, function, arguments)), pickle.HIGHEST_PROTOCOL)
            remote = self._client.submit(_travelling_call(), call, pure=False)
        except Exception as error:
            raise self._lost(error) from error
        return _Promise(remote, self._translate)

    def wait(self, futures: Iterable[Future]) -> set[Future]:
        """Those that are done, at least one; BrokenExecutor where the cluster is lost."""
        futures = list(futures)
        self._heard = time.monotonic()
        while not (done := wait(futures, timeout=_POLL, return_when=FIRST_COMPLETED).done):
            with contextlib.suppress(Exception):
                if self._client.sync(self._client.scheduler.ncores, workers=None, callback_timeout=_POLL):
                    self._heard = time.monotonic()
            if self._client.status == "closed" or time.monotonic() - self._heard > PATIENCE:
                raise self._lost("no worker answers")
        return done

    def restart(self) -> None:
        """Nothing: the cluster replaces its own workers."""

    def _count_threads(self) -> int:
        try:
            self._client.wait_for_workers(1, timeout=_CONNECT)
        except Exception as error:
            raise ConfigError(f"--scheduler {self.address}: has no workers; start some: dask worker ADDRESS") from error
        return sum(self._client.nthreads().values())

    def _check_versions(self) -> None:
        """Raises ConfigError where a worker has another Python, or another version of what decides the result."""
        here = {"python": platform.python_version()}
        self._compare("python", here["python"], self._ask(platform.python_version), lambda text: text.split(".")[:2])

        tell = _travelling_versions()
        here, there = tell(_SAME), self._ask(tell, _SAME)
        for name in _SAME:
            self._compare(name, here[name], {worker: found.get(name) for worker, found in there.items()})

    def _compare(self, name: str, mine: str, theirs: dict[str, Any], part: Callable = str) -> None:
        for worker, found in sorted(theirs.items()):
            if found is None or part(found) != part(mine):
                has = f"has no {name}" if found is None else f"has {name} {found}"
                raise ConfigError(
                    f"--scheduler {self.address}: worker {worker} {has}, this machine {mine}; install the same there, "
                    "so that the result is the same"
                )

    def _check_folder(self) -> None:
        for worker, seen in sorted(self._ask(os.path.isdir, str(self._folder)).items()):
            if not seen:
                raise ConfigError(
                    f"--scheduler {self.address}: worker {worker} does not see {self._folder}; strips and outputs must "
                    "lie on a file system that all workers share, under the same names"
                )

    def _ask(self, function: Callable, *arguments: Any) -> dict[str, Any]:
        """What each worker answers."""
        try:
            return self._client.run(function, *arguments)
        except Exception as error:
            raise ConfigError(f"--scheduler {self.address}: a worker cannot be asked: {_tell(error)}") from error

    def _translate(self, error: BaseException) -> BaseException:
        """What a strip's task ended with, in our words."""
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
        return BrokenExecutor(f"{self.address}: the cluster is lost ({_tell(reason)}); {_ADVICE}")


class _Promise(Future):
    """The result of a remote future, as other executors give it."""

    def __init__(self, remote: Any, translate: Callable[[BaseException], BaseException]) -> None:
        super().__init__()
        self._remote, self._translate = remote, translate
        remote.add_done_callback(self._take)

    def _take(self, remote: Any) -> None:
        with contextlib.suppress(InvalidStateError):
            try:
                result, error = pickle.loads(remote.result())
            except BaseException as failure:
                result, error = None, self._translate(failure)
            if error is None:
                self.set_result(result)
            else:
                self.set_exception(error)

    def cancel(self) -> bool:
        """Lets go of it, so that the cluster drops it too."""
        cancelled = super().cancel()
        with contextlib.suppress(Exception):
            self._remote.release()
        return cancelled


def _work(scratch: Path | None, function: Callable, arguments: tuple) -> Any:
    """On a worker: the function's result, its temporary files in a folder that all workers see."""
    use_scratch(scratch)
    try:
        return function(*arguments)
    finally:
        use_scratch(None)


def _travelling_call() -> Callable[[bytes], bytes]:
    """A function that makes a pickled call and pickles (result, error).

    It travels as code, and calls and results as bytes: the scheduler, which looks into all else, may lack wavebatch.
    """

    def call(pickled: bytes) -> bytes:
        import pickle
        import traceback

        try:
            function, arguments = pickle.loads(pickled)
            return pickle.dumps((function(*arguments), None), pickle.HIGHEST_PROTOCOL)
        except Exception as error:
            error.add_note(traceback.format_exc())
            return pickle.dumps((None, error))

    return call


def _travelling_versions() -> Callable[[tuple[str, ...]], dict[str, str]]:
    """A function that tells versions of packages, without those that are not there; of wavebatch the files count too.

    It travels as code: a worker may lack wavebatch.
    """

    def tell(names: tuple[str, ...]) -> dict[str, str]:
        import importlib
        import pathlib
        import zlib

        found = {}
        for name in names:
            try:
                package = importlib.import_module(name)
            except ImportError:
                continue
            found[name] = package.__version__
            if name == "wavebatch":
                files = sorted(pathlib.Path(package.__file__).parent.rglob("*.py"))
                found[name] += f" (files {zlib.crc32(b''.join(file.read_bytes() for file in files)):08x})"
        return found

    return tell


@contextlib.contextmanager
def _connected(address: str) -> Iterator[Any]:
    """A client of the cluster; ConfigError where there is none."""
    from distributed import Client

    try:
        _knock(address)
        options = {"timeout": _CONNECT, "set_as_default": False, "name": "wavebatch"}
        client = _call_in_time(2 * _CONNECT, lambda: Client(address, **options))
    except Exception as error:
        raise ConfigError(
            f"--scheduler {address}: cannot be reached: {_tell(error)}; give the address that dask scheduler prints"
        ) from error
    try:
        yield client
    finally:
        with contextlib.suppress(Exception):
            client.close(timeout=_POLL)


def _knock(address: str) -> None:
    """Raises OSError or ValueError where nobody listens: a client that fails can hang, and leaves threads behind."""
    scheme, separator, place = address.rpartition("://")
    if separator and scheme not in ("tcp", "tls"):
        return
    host, _, port = place.rpartition(":")
    if not host or not port.isdigit():
        raise ValueError("it has no host and port")
    socket.create_connection((host.strip("[]"), int(port)), timeout=_CONNECT).close()


def _call_in_time(seconds: float, function: Callable) -> Any:
    """The result of `function()`, which is left to itself where it takes longer: then TimeoutError."""
    future: Future = Future()

    def call() -> None:
        try:
            future.set_result(function())
        except BaseException as error:
            future.set_exception(error)

    threading.Thread(target=call, daemon=True).start()
    return future.result(timeout=seconds)


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """What dask would write to stderr about a cluster is said by our own lines."""
    import dask
    import distributed  # noqa: F401 - sets its loggers up, which are silenced then

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


def _tell(reason: object) -> str:
    return " ".join(str(reason).split())[:200] or type(reason).__name__
