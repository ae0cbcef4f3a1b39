"""Columns as .npz files: written in bounded memory, whole or not at all; read although their bytes may be damaged.

Voxels, cubes and the truth of simulated strips use it. Equal values must give equal bytes, so members of the archive
have a fixed date. They are read with `read_npz`, not with `np.load`, which lets errors of zipfile, zlib and Python's
tokenizer through, warns of old files, and allocates what a damaged header claims: here every failure is one InputError
line.
"""

from __future__ import annotations

import ast
import contextlib
import math
import shutil
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.files.disk.publish import Draft, publish_together, refuse_existing, reporting
from wavebatch.files.disk.raw_bytes import Closing

_PIECE = 1 << 18


class NpzWriter(Closing):
    """Writes columns in pieces: `add` any number of times, then `publish`. A context manager.

    columns: dtype of each column; one with a shape (k,) becomes an array (n, k).
    Raises InputError if the target exists (without overwrite) or cannot be written.
    """

    def __init__(self, target: Path, columns: Mapping[str, np.dtype | str], *, overwrite: bool = False) -> None:
        self.target = Path(target)
        refuse_existing(self.target, overwrite)
        self._dtypes = {name: np.dtype(dtype) for name, dtype in columns.items()}
        self._lengths = dict.fromkeys(self._dtypes, 0)
        with contextlib.ExitStack() as stack, reporting(self.target):
            self._draft = Draft(self.target, overwrite=overwrite)
            stack.callback(self._draft.discard)
            folder = self.target.parent
            self._spools: dict[str, IO[bytes]] = {
                name: stack.enter_context(tempfile.TemporaryFile(dir=folder)) for name in self._dtypes
            }
            self._opened = stack.pop_all()

    def add(self, columns: Mapping[str, np.ndarray]) -> None:
        """Append values to columns by name."""
        for name, values in columns.items():
            with reporting(self.target):
                self._spools[name].write(np.ascontiguousarray(values, self._dtypes[name].base).tobytes())
            self._lengths[name] += len(values)

    def publish(self, single: Mapping[str, np.ndarray | str | float]) -> None:
        """Write the .npz, with the values `single` after the columns, and give it its name."""
        publish_together([self.complete(single)])

    def complete(self, single: Mapping[str, np.ndarray | str | float]) -> Draft:
        """Write the .npz under its temporary name; the draft is published together with others."""
        with reporting(self.target), zipfile.ZipFile(self._draft.file, "w", allowZip64=True) as archive:
            for name, spool in self._spools.items():
                dtype = self._dtypes[name]
                shape = (self._lengths[name], *dtype.shape)
                with _open_member(archive, name) as member:
                    header = {"descr": dtype.base.str, "fortran_order": False, "shape": shape}
                    np.lib.format.write_array_header_1_0(member, header)
                    spool.seek(0)
                    shutil.copyfileobj(spool, member, _PIECE)
            for name, value in single.items():
                with _open_member(archive, name) as member:
                    np.lib.format.write_array(member, np.array(value), allow_pickle=False)
        return self._draft

    def close(self) -> None:
        """Close and remove all temporary files; may be called after `publish`."""
        with contextlib.suppress(OSError):  # a full disk was reported when it was written to
            self._opened.close()


def _open_member(archive: zipfile.ZipFile, name: str) -> IO[bytes]:
    """New member with a fixed date."""
    return archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True)


MOST_HEADER = 4096
"""Most bytes of the description of an array; NumPy writes 118."""
_MOST_TEXT = 4 << 20
"""Most bytes of a text: descriptions and CRSs take a few thousand."""

_DAMAGED = (
    zipfile.BadZipFile, zlib.error, struct.error, ValueError, TypeError, EOFError, KeyError, RuntimeError,
    OverflowError, SyntaxError, MemoryError, NotImplementedError,
)  # fmt: skip
"""What zipfile and parsers raise for damaged archives; RuntimeError for encrypted members and deep nesting."""


@contextlib.contextmanager
def reading_npz(path: Path, what: str, remedy: str) -> Iterator[None]:
    """Turn what a damaged archive raises into one InputError line.

    Parameters
    ----------
    path : Path
        The file.
    what : str
        What it should be, e.g. "voxels of `wavebatch voxelize`".
    remedy : str
        What to do, the end of the line.

    Raises
    ------
    InputError
        Where the file cannot be read or is damaged.
    """
    try:
        yield
    except InputError:
        raise
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}; check the name") from error
    except _DAMAGED as error:
        why = " ".join(str(error).split())[:200] or type(error).__name__
        raise InputError(f"{path}: holds no {what}, or is damaged ({why}); {remedy}") from error


def read_array_header(member: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Return shape, whether in Fortran's order, and type of an array, as `.npy` of version 1.0 begins.

    Raises ValueError for anything else, also for objects, and SyntaxError where the description is no Python literal.
    """
    start = member.read(10)
    if start[:8] != b"\x93NUMPY\x01\x00" or len(start) < 10:
        raise ValueError("no array of .npy version 1.0")
    length = int.from_bytes(start[8:], "little")
    if length > MOST_HEADER:
        raise ValueError("the description of an array is too long")
    facts = ast.literal_eval(member.read(length).decode("latin-1").strip())
    if not isinstance(facts, dict) or facts.keys() != {"descr", "fortran_order", "shape"}:
        raise ValueError("the description of an array is damaged")
    shape, descr = facts["shape"], facts["descr"]
    if not isinstance(shape, tuple) or not all(type(size) is int and 0 <= size < 1 << 48 for size in shape):
        raise ValueError("the shape of an array is damaged")
    if not isinstance(descr, str) or len(descr) > 20 or len(shape) > 8 or type(facts["fortran_order"]) is not bool:
        raise ValueError("the type of an array is damaged")
    dtype = np.dtype(descr)
    if dtype.kind not in "biufU":
        raise ValueError(f"an array of type {dtype}")
    return shape, facts["fortran_order"], dtype


def read_npz(path: Path, names: Mapping[str, tuple[str, int]], what: str, remedy: str) -> dict[str, np.ndarray]:
    """Return arrays of an .npz.

    Parameters
    ----------
    path : Path
        The file.
    names : mapping of str to (str, int)
        For each array the kinds of type that it may have, as NumPy's letters, e.g. "iu", and its number of axes. A
        name that ends in ? may lack.
    what, remedy : str
        As for `reading_npz`.

    Returns
    -------
    dict of str to ndarray
        By name, without the mark ?. A text has one element of type object: its str.

    Raises
    ------
    InputError
        Where the file cannot be read, is damaged, or lacks an array.
    """
    found = {}
    with reading_npz(path, what, remedy), zipfile.ZipFile(path) as archive:
        known = set(archive.namelist())
        for name, (kinds, axes) in names.items():
            plain = name.removesuffix("?")
            if f"{plain}.npy" not in known and plain != name:
                continue
            with archive.open(f"{plain}.npy") as member:
                found[plain] = _read_array(member, archive.getinfo(f"{plain}.npy").file_size, plain, kinds, axes)
    return found


def _read_array(member: IO[bytes], size: int, name: str, kinds: str, axes: int) -> np.ndarray:
    """size: bytes of the member; a damaged description may claim more, for which memory would be taken."""
    shape, in_fortran, dtype = read_array_header(member)
    if dtype.kind not in kinds or len(shape) != axes or (dtype.kind == "U" and dtype.itemsize > _MOST_TEXT):
        raise ValueError(f"{name} is {dtype} with {len(shape)} axes")
    needed = math.prod(shape) * dtype.itemsize
    if needed > size:
        raise ValueError(f"{name} ends too early")
    data = member.read(needed)
    if len(data) != needed:
        raise ValueError(f"{name} ends too early")
    if dtype.kind == "U":
        order = "be" if dtype.byteorder == ">" else "le"
        return np.array(data.decode(f"utf-32-{order}").rstrip("\0"), object)
    member.read(1)  # zipfile compares the checksum at the end only
    return np.frombuffer(data, dtype).reshape(shape, order="F" if in_fortran else "C")
