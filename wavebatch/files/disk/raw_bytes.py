"""Bytes read at a place of a file, and the errors of damaged files, each as one clear line.

All readers of LAS files, packets and temporary files use this module. Input may be hostile: read no byte without a
check that it is there. `Closing` is the base of the classes that hold files; writers abort instead (see `PointFile`).
Reports, system files and calibrations hold the fingerprint of a strip: a change of it makes runs with `--resume` start
again.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import stat
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, Self

import numpy as np

from wavebatch.core import interrupts
from wavebatch.core.errors import InputError


class Closing:
    """A context manager that calls `close` at its end."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Close what is open. Harmless twice."""
        raise NotImplementedError


@contextlib.contextmanager
def undoing(undo: Callable[[], object]) -> Iterator[None]:
    """Call `undo` where the block inside fails or is interrupted: what it has opened is closed then."""
    try:
        yield
    except BaseException:
        undo()
        raise


def open_regular(path: Path) -> BinaryIO:
    """Open a file for reading; raises InputError for a folder, a device or a pipe, which could block for ever."""
    try:
        mode = os.stat(path).st_mode
    except ValueError as error:
        raise InputError(f"{path}: cannot be read: no file can have this name ({error})") from error
    if stat.S_ISDIR(mode):
        os.scandir(path).close()  # a folder that cannot be read was meant as one: its error says more
    if not stat.S_ISREG(mode):
        raise InputError(f"{path}: cannot be read: it is a folder, a pipe or a device; give a file")
    return open(path, "rb")


@contextlib.contextmanager
def in_one_line(explain: Callable[[OSError, object], str]) -> Iterator[None]:
    """Turn an error of the operating system into one InputError line; explain: the line of an error and its reason."""
    try:
        yield
    except InputError:
        raise
    except OSError as error:
        raise InputError(explain(error, error.strerror or error)) from error


def reading(path: Path) -> contextlib.AbstractContextManager[None]:
    """Turn an error of the operating system while a file is opened into one InputError line."""
    remedy = "check disk and permissions"
    return in_one_line(lambda error, why: f"{error.filename or path}: cannot be read: {why}; {remedy}")


def damaged(path: Path, what: str) -> InputError:
    """Return the error for a file whose bytes contradict each other."""
    return InputError(f"{path}: {what}; the file is damaged or cut: get it again")


def read_exactly(fd: int, target: np.ndarray, at: int) -> None:
    """Fill the bytes `target` (u1, contiguous) from byte `at` of the file; raises InputError if it ends before."""
    view = target.data
    while view:
        if hasattr(os, "preadv"):
            got = os.preadv(fd, [view[: 1 << 30]], at)
        else:  # Windows
            os.lseek(fd, at, os.SEEK_SET)
            data = os.read(fd, min(len(view), 1 << 24))
            got, view[: len(data)] = len(data), data
        if not got:
            raise InputError(f"the file ends at byte {at}, {len(view)} bytes too early; it is cut or has changed")
        view, at = view[got:], at + got


def take_whole_records(records: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return records[rows] of a structured array, copied as plain bytes.

    NumPy copies structured records field by field, which takes six times as long.
    """
    plain = np.ascontiguousarray(records).view(f"V{records.dtype.itemsize}")
    return plain[rows].view(records.dtype)


def join_records(*parts: np.ndarray) -> np.ndarray:
    """Return structured arrays of one type behind each other, copied as plain bytes as well."""
    plain = [np.ascontiguousarray(part).view(f"V{part.dtype.itemsize}") for part in parts]
    return np.concatenate(plain).view(parts[0].dtype)


def widen_integers(values: np.ndarray) -> np.ndarray:
    """Return floating-point values as f8; a signalling NaN of a damaged file becomes a plain NaN without a warning."""
    with np.errstate(invalid="ignore"):
        return values.astype(np.float64) * 1.0  # a copy alone would keep a signalling NaN of 8 bytes


@contextlib.contextmanager
def naming(path: Path, what: str = "") -> Iterator[None]:
    """Let an InputError from inside begin with the name of the file, and what; one that names the file stays."""
    try:
        yield
    except InputError as error:
        if str(error).startswith(str(path)):
            raise
        raise InputError(f"{path}: {what}{error}") from error


@contextlib.contextmanager
def reporting_reads(path: Path, what: str = "", remedy: str = "") -> Iterator[None]:
    """Turn an error of the operating system while `path` is read into one InputError line."""
    begin = f"{what}cannot be read: "
    with naming(path, begin), in_one_line(lambda _, why: f"{path}: {begin}{why}{remedy}"):
        yield


@contextlib.contextmanager
def guarded(path: Path, start: int, stop: int) -> Iterator[None]:
    """Turn any error of a decoder or of the disk into one InputError line that names the wanted points."""
    try:
        interrupts.check()
        with naming(path, f"points {start} to {stop}: "):
            yield
    except InputError:
        raise
    except OSError as error:
        raise InputError(f"{path}: points {start} to {stop} cannot be read: {error.strerror or error}") from error
    except BaseException as error:
        # lazrs raises PanicException, which is no Exception, when its Rust code panics.
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        interrupts.check()  # it may come from an interrupt inside the decoder
        what = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise damaged(path, f"points {start} to {stop} cannot be decompressed ({what})") from error


@contextlib.contextmanager
def hiding_failures() -> Iterator[None]:
    """Keep what Rust and GDAL write to stderr, past Python, when they fail: the error that follows says it in one line.

    What else comes there meanwhile is written at the end. In the main thread only: two threads would mix up the
    descriptors.
    """
    held: list[int] = []
    fails = False
    try:
        if threading.current_thread() is threading.main_thread():
            with interrupts.uninterrupted(), contextlib.suppress(OSError, AttributeError):
                _hold_stderr(held)
        yield
    except BaseException as error:
        fails = type(error).__name__ in ("PanicException", "RasterioIOError")
        raise
    finally:
        if held:
            with interrupts.uninterrupted():
                kept, memory = held
                os.dup2(kept, 2)
                os.close(kept)
                if not fails and (size := os.lseek(memory, 0, os.SEEK_END)):
                    with contextlib.suppress(OSError):  # as for all messages: a full disk does not stop the work
                        os.write(2, os.pread(memory, size, 0))
                os.close(memory)


def _hold_stderr(held: list[int]) -> None:
    """Let stderr go into memory; `held` gets the descriptors of stderr and of the memory."""
    memory = os.memfd_create("stderr")
    try:
        held += os.dup(2), memory
    except OSError:
        os.close(memory)
        raise
    os.dup2(memory, 2)


_ENDS = 1 << 20
_PIECE = 1 << 14
_PIECES = 128


def take_fingerprint(path: Path, packet_file: Path | None = None) -> dict[str, Any]:
    """Return size and sampled SHA-256 of a strip, and of its packet file if that is another file.

    The first and the last MiB and 128 pieces of 16 KiB between them are read; names and times of files do not count.
    """
    fingerprint = _sample(Path(path))
    if packet_file is not None and Path(packet_file) != Path(path):
        fingerprint["packets"] = _sample(Path(packet_file))
    return fingerprint


def _sample(path: Path) -> dict[str, Any]:
    with reporting_reads(path), open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        digest = hashlib.sha256(size.to_bytes(8, "little"))
        digest.update(file.read(_ENDS))
        between = max(size - 2 * _ENDS, 0)
        for piece in range(_PIECES if between else 0):
            file.seek(_ENDS + between * piece // _PIECES)
            digest.update(file.read(_PIECE))
        file.seek(max(size - _ENDS, 0))
        digest.update(file.read(_ENDS))
    return {"size": size, "sha256_sampled": digest.hexdigest()}
