"""What tells one strip from another without reading all of it: size and a hash of samples of its content."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import Any

from wavebatch.core.errors import InputError

_ENDS = 1 << 20
_PIECE = 1 << 14
_PIECES = 128


def take_fingerprint(path: Path, packet_file: Path | None = None) -> dict[str, Any]:
    """Size and sampled SHA-256 of a strip, and of its packet file where that is another one.

    The first and last MiB are read whole and 128 pieces between them; times and names of the files do not count.
    """
    fingerprint = _sample(Path(path))
    if packet_file is not None and Path(packet_file) != Path(path):
        fingerprint["packets"] = _sample(Path(packet_file))
    return fingerprint


def _sample(path: Path) -> dict[str, Any]:
    try:
        with open(path, "rb") as file:
            size = os.fstat(file.fileno()).st_size
            digest = hashlib.sha256(size.to_bytes(8, "little"))
            digest.update(file.read(_ENDS))
            between = max(size - 2 * _ENDS, 0)
            for piece in range(_PIECES if between else 0):
                file.seek(_ENDS + between * piece // _PIECES)
                digest.update(file.read(_PIECE))
            file.seek(max(size - _ENDS, 0))
            digest.update(file.read(_ENDS))
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    return {"size": size, "sha256_sampled": digest.hexdigest()}
