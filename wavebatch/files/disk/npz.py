"""Columns of unknown length written as one .npz, in bounded memory, whole or not at all.

Voxels and the truth of simulated strips are written with it. Equal values must give equal bytes, so members of the
archive have a fixed date.
"""

from __future__ import annotations

import contextlib
import shutil
import tempfile
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import IO

import numpy as np

from wavebatch.files.disk.closing import Closing
from wavebatch.files.disk.publish import Draft, publish_together, refuse_existing, reporting

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
