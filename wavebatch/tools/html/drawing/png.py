"""A picture of coloured cells as PNG bytes, and its colour scale: for maps inside a page, without matplotlib."""

from __future__ import annotations

import base64
import struct
import zlib

import numpy as np

_ANCHORS = np.array(
    [(68, 1, 84), (71, 44, 122), (59, 81, 139), (44, 113, 142), (33, 144, 141), (39, 173, 129), (92, 200, 99),
     (170, 220, 50), (253, 231, 37)], np.float64,
)  # fmt: skip
"""Colours of the scale viridis (matplotlib, CC0) at even distances: it reads the same in grey and for colour-blind."""


def color_cells(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """Colours of values, u1 (rows, columns, 4): from `low` to `high` along the scale; NaN is transparent."""
    span = high - low if high > low else 1.0
    known = np.isfinite(values)
    place = np.clip((np.where(known, values, low) - low) / span, 0.0, 1.0) * (len(_ANCHORS) - 1)
    steps = np.arange(len(_ANCHORS))
    channels = [np.interp(place, steps, _ANCHORS[:, channel]) for channel in range(3)]
    return np.stack([*channels, np.where(known, 255.0, 0.0)], axis=-1).round().astype(np.uint8)


def encode_png(pixels: np.ndarray) -> bytes:
    """A PNG file of pixels u1 (rows, columns, 4), the first row on top (ISO/IEC 15948)."""
    rows, columns = pixels.shape[:2]
    lines = np.zeros((rows, 1 + 4 * columns), np.uint8)  # the leading byte of a line: no filter
    lines[:, 1:] = pixels.reshape(rows, -1)
    parts = [
        (b"IHDR", struct.pack(">IIBBBBB", columns, rows, 8, 6, 0, 0, 0)),
        (b"IDAT", zlib.compress(lines.tobytes(), 9)),
        (b"IEND", b""),
    ]
    chunks = (
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data)) for name, data in parts
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


def image_address(pixels: np.ndarray) -> str:
    """The pixels as an address that holds the picture itself."""
    return "data:image/png;base64," + base64.b64encode(encode_png(pixels)).decode()
