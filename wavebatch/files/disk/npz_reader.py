"""Arrays of an .npz file whose bytes may be damaged: every failure is one InputError line, in bounded memory.

Truth files, voxels and cubes are read with it, not with `np.load`, which lets errors of zipfile, zlib and Python's
tokenizer through, warns of old files, and allocates what a damaged header claims.
"""

from __future__ import annotations

import ast
import contextlib
import math
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO

import numpy as np

from wavebatch.core.errors import InputError

MOST_HEADER = 4096
"""Most bytes of the description of an array; NumPy writes 118."""

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
    if dtype.kind not in kinds or len(shape) != axes:
        raise ValueError(f"{name} is {dtype} with {len(shape)} axes")
    needed = math.prod(shape) * dtype.itemsize
    if needed > size:
        raise ValueError(f"{name} ends too early")
    data = member.read(needed)
    if len(data) != needed:
        raise ValueError(f"{name} ends too early")
    if dtype.kind == "U":
        return np.array(read_array_text(data, dtype), object)
    member.read(1)  # zipfile compares the checksum at the end only
    return np.frombuffer(data, dtype).reshape(shape, order="F" if in_fortran else "C")


def read_array_text(data: bytes, dtype: np.dtype) -> str:
    """Return the text of an array without axes; raises ValueError where its bytes are none."""
    order = "be" if dtype.byteorder == ">" else "le"
    return data.decode(f"utf-32-{order}").rstrip("\0")
