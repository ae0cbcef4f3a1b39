"""Fingerprint of a strip: size and hash of samples, to recognise it without reading all of it.

Reports, system files and calibrations hold it. A change here makes runs with `--resume` start again.
"""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import Any

from wavebatch.files.disk.raw_bytes import open_regular, reporting_reads

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
