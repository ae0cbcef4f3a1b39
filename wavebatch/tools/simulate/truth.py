"""The truth file of a simulated strip: a .npz with one array per column, written and read in pieces.

`strip.simulate_strip` writes it, `wavebatch compare` and the tests read it. Columns and their types are declared here.
"""

from __future__ import annotations

import contextlib
import json
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.files.disk.npz import NpzWriter, read_array_header, read_array_text, reading_npz
from wavebatch.files.disk.publish import Draft
from wavebatch.files.disk.raw_bytes import Closing

ECHO_COLUMNS: dict[str, str] = {
    "waveform": "<u8",
    "byte_offset": "<u8",
    "gps_time": "<f8",
    "time": "<f8",
    "amplitude": "<f4",
    "sigma": "<f4",
    "x": "<f8",
    "y": "<f8",
    "z": "<f8",
    "incidence_angle": "<f4",
    "range": "<f8",
    "flags": "<u2",
    "isolated": "|b1",
    "overlapped": "|b1",
}
"""Per true echo, in file order: packet number, byte offset of its packet, GPS time of its pulse [s], time after
sample 0 [ns], amplitude [count], sigma [ns], position [m], angle to the ground's normal [deg], sensor to echo [m],
EchoFlag bits, whether it is isolated, whether a neighbour overlaps it."""

PACKET_COLUMNS: dict[str, str] = {"packet_byte_offset": "<u8", "packet_gps_time": "<f8"}
"""Per packet, in file order, those without an echo too."""

_DTYPES = {**ECHO_COLUMNS, **PACKET_COLUMNS}
_META = "meta"
_PIECE = 1 << 18
_MOST_TEXT = 4 << 20
"""Most bytes of the description: it takes a few hundred."""


_LARGEST = 1e30
"""Largest value that is taken for a true one; sums and squares of larger ones overflow."""


class TruthWriter(NpzWriter):
    """Takes columns block by block and writes them as one .npz; memory does not grow with their length.

    Raises InputError where it cannot write.
    """

    def __init__(self, target: Path, *, overwrite: bool = False) -> None:
        super().__init__(target, _DTYPES, overwrite=overwrite)

    def complete(self, meta: Mapping[str, Any]) -> Draft:
        """Writes the .npz; meta: plain values, stored as JSON in the array `meta`."""
        return super().complete({_META: json.dumps(meta, sort_keys=True)})


def _check_meta(meta: Any) -> dict[str, Any]:
    """The description, if it has the numbers that comparisons need; else ValueError."""
    for key, least, most in (("noise_std", 0.0, 1e9), ("spacing", 1e-6, 1e6), ("packets", 0, 1 << 40)):
        value = meta[key]
        if type(value) not in (int, float) or not least <= value <= most:
            raise ValueError(f"{key} of its description is {str(value)[:40]}")
    return meta


class TruthReader(Closing):
    """Reads a truth file; raises InputError when `path` is none."""

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        with self._reading():
            self._archive = zipfile.ZipFile(self.path)
            known = set(self._archive.namelist())
            lacking = [name for name in (*_DTYPES, _META) if f"{name}.npy" not in known]
            if lacking:
                raise InputError(f"{self.path}: no truth file of wavebatch simulate: lacks {', '.join(lacking)}")
            with self._archive.open(f"{_META}.npy") as member:
                self.meta: dict[str, Any] = _check_meta(json.loads(self._read_text(member)))

    def _reading(self) -> contextlib.AbstractContextManager[None]:
        return reading_npz(self.path, "truth file of `wavebatch simulate`", "simulate the strip again")

    def _read_text(self, member: IO[bytes]) -> str:
        shape, _, dtype = read_array_header(member)
        if shape or dtype.kind != "U" or dtype.itemsize > _MOST_TEXT:
            raise InputError(f"{self.path}: its description is {dtype}, no text; simulate the strip again")
        return read_array_text(member.read(dtype.itemsize), dtype)

    def close(self) -> None:
        """Closes the file."""
        self._archive.close()

    def read_pieces(self, *names: str, size: int = _PIECE) -> Iterator[dict[str, np.ndarray]]:
        """The named columns, all per echo or all per packet, at most `size` rows at a time."""
        with self._reading(), contextlib.ExitStack() as stack:
            members = {name: stack.enter_context(self._archive.open(f"{name}.npy")) for name in names}
            lengths = set()
            for name, member in members.items():
                shape, _, dtype = read_array_header(member)
                if dtype != np.dtype(_DTYPES[name]) or len(shape) != 1:
                    words = f"column {name} is {dtype}, not {_DTYPES[name]}; simulate the strip again"
                    raise InputError(f"{self.path}: {words}")
                lengths.add(shape[0])
            if len(lengths) != 1:
                raise InputError(f"{self.path}: columns {', '.join(names)} differ in length; simulate the strip again")
            (length,) = lengths
            for start in range(0, length, size):
                rows = min(size, length - start)
                yield {name: self._read_column(name, member, rows) for name, member in members.items()}

    def read(self, *names: str) -> dict[str, np.ndarray]:
        """The named columns whole."""
        pieces = list(self.read_pieces(*names))
        if not pieces:
            return {name: np.empty(0, _DTYPES[name]) for name in names}
        return {name: np.concatenate([piece[name] for piece in pieces]) for name in names}

    def _read_column(self, name: str, member: IO[bytes], rows: int) -> np.ndarray:
        dtype = np.dtype(_DTYPES[name])
        data = member.read(rows * dtype.itemsize)
        if len(data) != rows * dtype.itemsize:
            raise InputError(f"{self.path}: ends too early; simulate the strip again")
        values = np.frombuffer(data, dtype)
        if dtype.kind == "f" and (np.abs(values) > _LARGEST).any():
            most = np.nanmax(np.abs(values))
            raise InputError(f"{self.path}: column {name} holds {most:g}; simulate the strip again")
        return values
