"""What a worker process runs: calls from its pipe, until the parent process says that there are no more, or dies.

`processes` starts it. Before you change it: it must end with its parent, however that ends, and remove what the parent
shared in memory; it should import little before it waits for its first call.
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

from wavebatch.core.memory import keep_freed_memory
from wavebatch.files.disk.temp_folders import remove_memory_of

_FIRST_MODULE = "wavebatch.batch.row_transfer"
"""What a new process imports while it waits: with it comes nearly all that calls need."""

END = b""
"""Sent to a process in place of a call: it ends. A pipe that closes without it means that this process was killed."""

_SET_DEATH_SIGNAL = 1
"""PR_SET_PDEATHSIG of linux/prctl.h."""

PATIENCE = 3.0
"""Seconds that processes have to end by themselves, and the memory of a dead one to be free."""


def serve_calls(pipe: Connection) -> None:
    """Make calls until the parent process says that there are no more."""
    _wake_when_parent_dies()  # before all else: until then nothing wakes this process if it is stopped
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent process
    keep_freed_memory()
    end = threading.Thread(target=_end_with, args=(multiprocessing.parent_process(),), daemon=True)
    end.start()
    with contextlib.suppress(Exception):  # the call that needs it reports the error
        importlib.import_module(_FIRST_MODULE)
    with contextlib.suppress(EOFError, OSError):
        while (call := pipe.recv_bytes()) != END:
            pipe.send_bytes(_answer(call))
        return
    end.join()  # else this process would be gone before it has cleaned up


def _wake_when_parent_dies() -> None:
    """Let Linux continue this process, if it is stopped, when its parent dies: `_end_with` then cleans up and ends it.

    A signal that kills would leave what the parent shared in memory.
    """
    if sys.platform == "linux":
        import ctypes

        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None).prctl(_SET_DEATH_SIGNAL, signal.SIGCONT)


def _answer(pickled: bytes) -> bytes:
    """The pickled result and error of a call."""
    try:
        function, arguments = pickle.loads(pickled)
        return pickle.dumps((function(*arguments), None), pickle.HIGHEST_PROTOCOL)
    except Exception as error:
        error.add_note(traceback.format_exc())
        return _pickle_error(error)


def _pickle_error(error: Exception) -> bytes:
    try:
        return pickle.dumps((None, error))
    except Exception:
        return pickle.dumps((None, RuntimeError(repr(error))))


def _end_with(parent: Any) -> None:
    """End this process when its parent has died, without what the parent shared in memory until the next run."""
    parent.join()
    remove_memory_of(parent.pid, PATIENCE)
    os._exit(1)
