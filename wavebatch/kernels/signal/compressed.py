"""Compressed packets of LAStools (.wdz), decoded by kernels/c/wdz.h; `files/strip/packets.py` calls it."""

from __future__ import annotations

import ctypes

import numpy as np

from wavebatch.kernels.library import call

MOST_BYTES = 5
"""Most bytes that a sample takes: 15 bits for its length, 15 coded and 8 plain ones, and carries."""


def decode_packets(
    data: np.ndarray, start: np.ndarray, end: np.ndarray, n_samples: int, width: int
) -> tuple[np.ndarray, np.ndarray]:
    """Decode packets of one number of samples.

    Parameters
    ----------
    data : uint8 (m,)
        Bytes that hold the packets.
    start, end : int64 (n,)
        First byte of each packet, and the one behind its last.
    n_samples : int
        Of each packet.
    width : int
        Bytes of a sample: 1 or 2.

    Returns
    -------
    samples : uint8 or uint16 (n, n_samples)
        Zeros where a packet is broken.
    good : bool (n,)
        Whether a packet is whole.

    Raises
    ------
    ValueError
        For places outside of the bytes, and other widths: C code would read there.
    """
    start, end = (np.ascontiguousarray(places, np.int64) for places in (start, end))
    inside = (start >= 0) & (start <= end) & (end <= len(data))
    if width not in (1, 2) or n_samples < 1 or len(start) != len(end) or not inside.all():
        raise ValueError("packets must lie inside the bytes and have samples of 1 or 2 bytes")
    samples, good = np.empty((len(start), n_samples), f"<u{width}"), np.zeros(len(start), np.uint8)
    n, s, w = (ctypes.c_int64(number) for number in (len(start), n_samples, width))
    call("decode_packets", np.ascontiguousarray(data, np.uint8), n, start, end, s, w, samples, good)
    return samples, good.astype(bool)
