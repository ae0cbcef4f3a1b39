"""Bytes of a file by their place, and one line for whatever can go wrong while points are read."""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

from wavebatch.core.errors import InputError


def open_regular(path: Path) -> BinaryIO:
    """The file open for reading; InputError for a folder, a device, or a pipe, which would block for ever."""
    if not stat.S_ISREG(os.stat(path).st_mode):
        raise InputError(f"{path}: cannot be read: it is a folder, a pipe or a device; give a file")
    return open(path, "rb")


def read_exactly(fd: int, target: np.ndarray, at: int) -> None:
    """Fills the bytes `target` (u1, contiguous) from byte `at` of the file; InputError where it ends before."""
    view = memoryview(target)
    while view:
        got = os.preadv(fd, [view[: 1 << 30]], at) if hasattr(os, "preadv") else _seek_read(fd, view, at)
        if not got:
            raise InputError(f"the file ends at byte {at}, {len(view)} bytes too early; it is cut or has changed")
        view, at = view[got:], at + got


def _seek_read(fd: int, view: memoryview, at: int) -> int:
    """preadv for systems that have none (Windows)."""
    os.lseek(fd, at, os.SEEK_SET)
    data = os.read(fd, min(len(view), 1 << 24))
    view[: len(data)] = data
    return len(data)


def take_records(records: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """records[rows] of a structured array, as plain bytes: NumPy copies records field by field, six times slower."""
    plain = np.ascontiguousarray(records).view(f"V{records.dtype.itemsize}")
    return plain[rows].view(records.dtype)


def widen(values: np.ndarray) -> np.ndarray:
    """Floating-point values as f8; signalling NaN, which a damaged file may hold, is NaN and no warning."""
    with np.errstate(invalid="ignore"):
        return values.astype(np.float64) * 1.0  # a copy alone keeps signalling NaN of 8 bytes


@contextlib.contextmanager
def guarded(path: Path, start: int, stop: int) -> Iterator[None]:
    """Turns whatever a decoder or the disk says into one line with the points that were wanted."""
    try:
        yield
    except InputError as error:
        if str(error).startswith(str(path)):
            raise
        raise InputError(f"{path}: points {start} to {stop}: {error}") from error
    except OSError as error:
        raise InputError(f"{path}: points {start} to {stop} cannot be read: {error.strerror or error}") from error
    except Exception as error:
        raise _damaged(path, start, stop, error) from error
    except BaseException as error:
        if type(error).__name__ != "PanicException":  # what lazrs raises where Rust code gives up
            raise
        raise _damaged(path, start, stop, error) from error


def _damaged(path: Path, start: int, stop: int, error: BaseException) -> InputError:
    what = str(error).splitlines()[0] if str(error) else type(error).__name__
    return InputError(f"{path}: points {start} to {stop} cannot be decompressed ({what}); damaged: get the file again")
