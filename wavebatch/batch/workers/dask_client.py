"""A client of an existing dask cluster: found within seconds or refused in one line, and silent.

`dask_cluster` uses it. Before you change it: a client of dask that fails may hang, leave threads, and print; so what
can be known before is asked before.
"""

from __future__ import annotations

import contextlib
import logging
import socket
import threading
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from typing import Any

from wavebatch.batch.workers.futures import settle_future
from wavebatch.core.errors import ConfigError

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

    try:
        _knock(address)
        _check_keys(address)
        options = {"timeout": _CONNECT, "set_as_default": False, "name": "wavebatch"}
        client = _call_in_time(_CONNECT + 0.5, lambda: Client(address, **options))
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


def _knock(address: str) -> None:
    """Raise OSError or ValueError where no scheduler listens; a client that fails can hang and leave threads."""
    scheme, separator, place = address.rpartition("://")
    if separator and scheme not in _SCHEMES:
        raise ValueError(f"no scheduler has an address of the kind {scheme}://; known are {', '.join(_SCHEMES)}")
    host, _, port = place.rpartition(":")
    if not host or not port.isdigit():
        raise ValueError("it has no host and port")
    socket.create_connection((host.strip("[]"), int(port)), timeout=_CONNECT).close()


def _check_keys(address: str) -> None:
    """Raise ValueError where TLS is wanted and dask has no keys; a client that fails prints more when it ends."""
    from distributed.security import Security

    if address.startswith("tls://") and Security().get_connection_args("client").get("ssl_context") is None:
        raise ValueError("dask has no certificate and key here (distributed.comm.tls in its configuration); set them")


def _call_in_time(seconds: float, function: Callable) -> Any:
    """The result of `function()`; TimeoutError where it takes longer, while its thread goes on."""
    future: Future = Future()
    threading.Thread(target=settle_future, args=(future, function), daemon=True).start()
    return future.result(timeout=seconds)


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
