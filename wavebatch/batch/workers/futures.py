"""Results of calls that are under way, waited for so that no interrupt leaves a lock taken, and ended once.

`processes`, `spawned` and `dask_cluster` use them.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future, InvalidStateError, wait
from typing import Any

from wavebatch.core.interrupts import uninterrupted

PATIENCE = 3.0
"""Seconds that processes have to end before they are killed."""

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


class WorkerDied(Exception):
    """A worker process ended while it made a call: killed, or out of memory."""
