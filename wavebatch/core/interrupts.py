"""Ctrl-C, SIGTERM and the limit of processor time, so that none is lost, wherever it arrives.

A signal raises KeyboardInterrupt in the main thread. Compressors and other compiled code that calls Python turn an
exception into an error of theirs, and Python drops one that is raised while an object is deleted. So a signal also
sets a flag: loops look at it (`check`), and code that must not be torn apart holds signals back (`uninterrupted`).
`guard` runs the whole program, from its imports to its exit code.
Before you change it: send signals at every instant of a run (tests/batch/test_signals.py).
"""

from __future__ import annotations

import atexit
import contextlib
import os
import signal
import sys
import threading
import time

TYPE_CHECKING = False  # not from typing, which takes as long to import as all the others
if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from typing import Any

EXIT_INTERRUPTED = 130
"""Exit code after Ctrl-C, SIGTERM or SIGXCPU, as shells give it after Ctrl-C."""

_PAUSE = 10.0
"""Seconds after a signal in which others do not interrupt the cleaning up; later ones do, in case it hangs."""

_SOON = 0.05
"""Seconds after which a KeyboardInterrupt that Python has dropped is raised again."""

_SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGXCPU") if hasattr(signal, name)]


class _Interrupt(KeyboardInterrupt):
    """Python ends by SIGINT, not with our exit code, once a plain KeyboardInterrupt has passed through an `exec`."""


class _State:
    arrived = 0
    """Signals so far."""
    raised = -_PAUSE
    """Time of the last KeyboardInterrupt [s]."""
    depth = 0
    """Depth of `uninterrupted`: above 0, signals are only counted."""


def arrived() -> bool:
    """Whether a signal has arrived since `guard` began."""
    return _State.arrived > 0


def check() -> None:
    """Raise KeyboardInterrupt if a signal has arrived, in case that its first KeyboardInterrupt was lost."""
    if _State.arrived and threading.current_thread() is threading.main_thread():
        _State.raised = time.monotonic()
        raise _Interrupt


@contextlib.contextmanager
def uninterrupted() -> Iterator[None]:
    """Hold signals back: one that arrives inside raises KeyboardInterrupt at the end."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    alone = signal.getsignal(signal.SIGINT) is signal.default_int_handler  # a program that calls the library
    depth = _State.depth
    try:
        if alone:
            signal.signal(signal.SIGINT, _handle)
        _State.depth += 1
        yield
    finally:
        _State.depth = depth
        try:
            if not depth:
                check()
        finally:
            if alone:
                signal.signal(signal.SIGINT, signal.default_int_handler)
                _State.arrived = 0


def guard(command: Callable[[], Any]) -> None:
    """Run the program; it ends with exit code 130 if a signal arrived at any time, whatever became of it."""
    error: BaseException | None = None
    atexit.register(_end_interrupted)  # the first, so that it is called after all others
    try:
        try:
            sys.unraisablehook = _raise_again
            _handle_with(_handle, signal.SIG_IGN)
            command()
        finally:
            _State.depth += 1
    except BaseException as caught:
        error = caught
    _handle_with(signal.SIG_IGN)
    if _State.arrived:
        if not (isinstance(error, SystemExit) and error.code == EXIT_INTERRUPTED):
            with contextlib.suppress(OSError, ValueError):
                sys.stderr.write("interrupted\n")
        raise SystemExit(EXIT_INTERRUPTED) from None
    if error is not None:
        raise error


def _end_interrupted() -> None:
    """End an interrupted program before Python takes itself apart.

    Compiled libraries that were interrupted while they were imported crash there, and the exit code would be theirs.
    """
    if _State.arrived:
        for stream in sys.stdout, sys.stderr:
            with contextlib.suppress(OSError, ValueError, AttributeError):
                stream.flush()
        os._exit(EXIT_INTERRUPTED)


def _handle(number: int, frame: object) -> None:
    now = time.monotonic()
    repeated = _State.arrived and now - _State.raised < _PAUSE
    _State.arrived += 1
    if not _State.depth and not repeated:
        _State.raised = now
        raise _Interrupt


def _raise_again(lost: sys.UnraisableHookArgs) -> None:
    """For exceptions that Python drops, as in `__del__`: an interrupt comes again, all others are shown as usual."""
    if lost.exc_type is not _Interrupt:
        sys.__unraisablehook__(lost)
        return
    _State.raised = -_PAUSE
    number = next(number for number in _SIGNALS if signal.getsignal(number) is _handle)
    timer = threading.Timer(_SOON, _send, (number,))
    timer.daemon = True
    timer.start()


def _send(number: int) -> None:
    """Send this process a signal; `os.kill` of Windows would end it at once."""
    if os.name == "nt":
        signal.raise_signal(number)
    else:
        os.kill(os.getpid(), number)


def _handle_with(handler: Any, *kept: Any) -> None:
    """Set the handler of all signals, but not of those that have one of `kept`: nohup lets SIGHUP be ignored."""
    for number in _SIGNALS:
        if signal.getsignal(number) not in kept:
            signal.signal(number, handler)
