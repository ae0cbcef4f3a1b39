"""What a worker process runs: calls from its pipe, until the parent process closes it, or dies.

`processes` starts it. Before you change it: it must end with its parent, however that ends; it should import little
before it waits for its first call.
"""

from __future__ import annotations

import contextlib
import importlib
import multiprocessing
import os
import pickle
import signal
import sys
import threading
import traceback
from multiprocessing.connection import Connection
from typing import Any

from wavebatch.core.process import importing, keep_freed_memory

_FIRST_MODULE = "wavebatch.batch.neighbour_pass"
"""What a new process imports while it waits: with it comes nearly all that calls need."""

_SET_DEATH_SIGNAL = 1
"""PR_SET_PDEATHSIG of linux/prctl.h."""


def serve_calls(pipe: Connection) -> None:
    """Make calls until the parent process closes the pipe."""
    # Before all else: until then nothing wakes this process if it is stopped. Linux continues it when its parent dies,
    # and `_end_with` ends it. A signal that kills would come too early: when the thread ends that has started it.
    if sys.platform == "linux":
        import ctypes

        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None).prctl(_SET_DEATH_SIGNAL, signal.SIGCONT)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent process
    keep_freed_memory()
    threading.Thread(target=_end_with, args=(multiprocessing.parent_process(),), daemon=True).start()
    with contextlib.suppress(Exception), importing():  # the call that needs it reports the error
        importlib.import_module(_FIRST_MODULE)
    with contextlib.suppress(EOFError, OSError):
        while True:
            pipe.send_bytes(_answer(pipe.recv_bytes()))


def _answer(pickled: bytes) -> bytes:
    """The pickled result and error of a call."""
    try:
        function, arguments = pickle.loads(pickled)
        return pickle.dumps((function(*arguments), None), pickle.HIGHEST_PROTOCOL)
    except Exception as error:
        error.add_note(traceback.format_exc())
        try:
            return pickle.dumps((None, error))
        except Exception:
            return pickle.dumps((None, RuntimeError(repr(error))))


def _end_with(parent: Any) -> None:
    """End this process when its parent has died, also in the middle of a call."""
    parent.join()
    os._exit(1)
