"""Points that only LASzip can decompress (the coding of LAS 1.5), read through a child process.

`laz_decode.open_laz` calls it. LASzip trusts its input and a damaged file can crash it: only the child process then
ends, and the run gets an error. Never import laszip for reading in the main process.
"""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.core.optional import advise_install
from wavebatch.files.disk.raw_bytes import guarded
from wavebatch.files.las.checked_header import CheckedHeader

PATIENCE = 60.0
"""Seconds without any byte after which the child process is stopped: damaged files can make LASzip loop for ever."""
_CHILD = Path(__file__).with_name("laszip_child.py")


class LaszipPoints:
    """Reads points in order from one child process; a jump to another place starts a new process."""

    def __init__(self, checked: CheckedHeader) -> None:
        if importlib.util.find_spec("laszip") is None:
            raise InputError(
                f"{checked.path}: compressed with the coding of LAS 1.5, which lazrs cannot read: "
                f"{advise_install('laszip')}, or decompress it first: laszip -i IN.laz -o OUT.las"
            )
        self._checked = checked
        self._next, self._late = -1, False
        self._child: subprocess.Popen | None = None
        self._talk = tempfile.TemporaryFile()  # noqa: SIM115 - closed by close()

    def read(self, start: int, stop: int) -> np.ndarray:
        """Return records [start, stop)."""
        rows = np.empty(stop - start, self._checked.dtype)
        with guarded(self._checked.path, start, stop):
            if start != self._next and len(rows):
                self._start(start)
            self._fill(memoryview(rows.view(np.uint8).reshape(-1)))
        self._next = stop
        return rows

    def _start(self, start: int) -> None:
        self._stop()
        self._talk.seek(0)
        self._talk.truncate()
        numbers = (start, self._checked.header.point_count, self._checked.dtype.itemsize)
        self._child = subprocess.Popen(
            [sys.executable, "-P", str(_CHILD), str(self._checked.path.absolute()), *map(str, numbers)],
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=self._talk, bufsize=0,
        )  # fmt: skip

    def _fill(self, view: memoryview) -> None:
        while view:
            watch = threading.Timer(PATIENCE, self._give_up)
            watch.start()
            got = self._child.stdout.readinto(view[: 1 << 20])
            watch.cancel()
            if not got:
                raise InputError(self._explain())
            view = view[got:]

    def _give_up(self) -> None:
        self._late = True
        self._child.kill()

    def _explain(self) -> str:
        status = self._child.wait()
        if self._late:
            return f"LASzip gave no data for {PATIENCE:g} s; the file is damaged: get it again"
        self._talk.seek(0)
        text = " ".join(self._talk.read(500).decode("utf-8", "replace").split())
        reason = f"crashed (signal {-status})" if status < 0 else f"failed: {text or 'no message'}"
        return f"LASzip {reason}; the file is damaged: get it again"

    def _stop(self) -> None:
        if self._child is not None:
            self._child.kill()
            self._child.stdout.close()
            self._child.wait()
            self._child, self._next = None, -1

    def close(self) -> None:
        """End the child process; may be called twice."""
        self._stop()
        self._talk.close()
