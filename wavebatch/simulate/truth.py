"""The truth of a strip as a .npz: columns spooled to disk while the strip is made, read back in pieces."""

from __future__ import annotations

import json
import shutil
import tempfile
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np

from wavebatch.errors import InputError
from wavebatch.io.publish import Draft, refuse_existing, reporting

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
EchoFlag bits, whether the closed bounds hold for it, whether a neighbour overlaps it."""

PACKET_COLUMNS: dict[str, str] = {"packet_byte_offset": "<u8", "packet_gps_time": "<f8"}
"""Per packet, in file order, those without an echo too."""

_META = "meta"
_PIECE = 1 << 18


class TruthWriter:
    """Takes columns block by block and writes them as one .npz on `publish`; memory does not grow with their length.

    meta: plain values about the strip, kept as JSON in the array `meta`. Raises InputError where it cannot write.
    """

    def __init__(self, target: Path, *, overwrite: bool = False) -> None:
        self.target = Path(target)
        if not overwrite:
            refuse_existing(self.target)
        self._draft = Draft(self.target, overwrite=overwrite)
        with reporting(self.target):
            folder = self.target.parent
            self._spools = {
                name: tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 - closed in `discard`
                for name in (*ECHO_COLUMNS, *PACKET_COLUMNS)
            }
        self._lengths = dict.fromkeys(self._spools, 0)

    def add(self, columns: Mapping[str, np.ndarray]) -> None:
        """Appends values to the columns named; each call gives every column of a kind the same length."""
        for name, values in columns.items():
            dtype = ECHO_COLUMNS.get(name) or PACKET_COLUMNS[name]
            with reporting(self.target):
                self._spools[name].write(np.ascontiguousarray(values, dtype=dtype).tobytes())
            self._lengths[name] += len(values)

    def publish(self, meta: Mapping[str, Any]) -> None:
        """Writes the .npz and gives it its name."""
        with reporting(self.target), zipfile.ZipFile(self._draft.file, "w", allowZip64=True) as archive:
            for name, spool in self._spools.items():
                dtype = np.dtype(ECHO_COLUMNS.get(name) or PACKET_COLUMNS[name])
                with _open_member(archive, name) as member:
                    header = {"descr": dtype.str, "fortran_order": False, "shape": (self._lengths[name],)}
                    np.lib.format.write_array_header_1_0(member, header)
                    spool.seek(0)
                    shutil.copyfileobj(spool, member, _PIECE)
            with _open_member(archive, _META) as member:
                np.lib.format.write_array(member, np.array(json.dumps(meta, sort_keys=True)), allow_pickle=False)
        self._draft.publish()
        self.discard()

    def withdraw(self) -> None:
        """Takes the published file back."""
        self._draft.withdraw()

    def discard(self) -> None:
        """Closes and removes everything temporary; harmless after `publish`."""
        for spool in self._spools.values():
            spool.close()
        self._draft.discard()


def _open_member(archive: zipfile.ZipFile, name: str) -> IO[bytes]:
    """A member with a fixed date, so that the same truth gives the same bytes."""
    return archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True)


class TruthReader:
    """The truth file of a simulated strip; columns are read in pieces. Raises InputError when it is none."""

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        try:
            self._archive = zipfile.ZipFile(self.path)
            known = set(self._archive.namelist())
            lacking = [name for name in (*ECHO_COLUMNS, *PACKET_COLUMNS, _META) if f"{name}.npy" not in known]
            if lacking:
                raise InputError(f"{self.path}: no truth file of wavebatch simulate: lacks {', '.join(lacking)}")
            with self._archive.open(f"{_META}.npy") as member:
                self.meta: dict[str, Any] = json.loads(str(np.lib.format.read_array(member, allow_pickle=False)))
        except (zipfile.BadZipFile, ValueError, EOFError) as error:
            raise InputError(f"{self.path}: no truth file of wavebatch simulate: {error}") from error
        except OSError as error:
            if isinstance(error, InputError):
                raise
            raise InputError(f"{self.path}: cannot be read: {error.strerror or error}; check the name") from error

    def __enter__(self) -> TruthReader:
        return self

    def __exit__(self, *error: object) -> None:
        self._archive.close()

    def read_pieces(self, *names: str, size: int = _PIECE) -> Iterator[dict[str, np.ndarray]]:
        """The named columns, all per echo or all per packet, at most `size` rows at a time."""
        members = [self._archive.open(f"{name}.npy") for name in names]
        try:
            left = []
            dtypes = []
            for name, member in zip(names, members, strict=True):
                np.lib.format.read_magic(member)
                shape, _, dtype = np.lib.format.read_array_header_1_0(member)
                expected = np.dtype(ECHO_COLUMNS.get(name) or PACKET_COLUMNS[name])
                if dtype != expected or len(shape) != 1:
                    raise InputError(f"{self.path}: column {name} is {dtype}, not {expected}; simulate the strip again")
                left.append(shape[0])
                dtypes.append(dtype)
            if len(set(left)) != 1:
                raise InputError(f"{self.path}: columns {', '.join(names)} differ in length; simulate the strip again")
            for start in range(0, left[0], size):
                rows = min(size, left[0] - start)
                yield {
                    name: np.frombuffer(_read_exactly(member, rows * dtype.itemsize, self.path), dtype)
                    for name, member, dtype in zip(names, members, dtypes, strict=True)
                }
        finally:
            for member in members:
                member.close()

    def read(self, *names: str) -> dict[str, np.ndarray]:
        """The named columns whole."""
        pieces = list(self.read_pieces(*names))
        if not pieces:
            return {name: np.empty(0, ECHO_COLUMNS.get(name) or PACKET_COLUMNS[name]) for name in names}
        return {name: np.concatenate([piece[name] for piece in pieces]) for name in names}


def _read_exactly(member: IO[bytes], size: int, path: Path) -> bytes:
    data = member.read(size)
    if len(data) != size:
        raise InputError(f"{path}: ends too early; simulate the strip again")
    return data
