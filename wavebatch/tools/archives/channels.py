"""Receiver channels of different gain that record the same segment: which of them is used, and its scale.

`first_pass` learns the ratio of the gains, `points` chooses. A sensor with two channels records strong echoes twice:
the sensitive channel is saturated by them, the other one is not.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from wavebatch.files.pulsewaves_file import PulsePiece, Segments

SATURATED = 0.8
"""Share of the sensitive channel's largest counts from which the other channel is used: receivers bend before they
clip. RIEGL records its second channel from about this share on."""
LINEAR = (0.05, 0.4)
"""Shares of the largest counts between which a receiver is linear: heights that teach the ratio of the gains."""
LEAST_SAMPLES = 30
"""Samples that teach a ratio."""
MOST_PAIRS = 20_000
"""Pairs of segments that teach it."""


@dataclass(slots=True)
class Overlaps:
    """What pairs of segments of two channels say, summed up."""

    top: float = 0.0
    """Largest count of the sensitive channel [count]."""
    products: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)
    """Heights of the sensitive and of the other channel at the same time [count]."""
    pairs: int = 0

    def add(self, piece: PulsePiece, first: np.ndarray, second: np.ndarray) -> None:
        """Add pairs of segments: rows of the sensitive and of the other channel."""
        self.pairs += len(first)
        if self.pairs > MOST_PAIRS and self.products:
            return
        segments = piece.segments
        for a, b in group_rows(segments, first, second):
            x, y = (piece.samples(rows).astype(np.float64) for rows in (a, b))
            self.top = max(self.top, float(x.max(initial=0)))
            x -= np.percentile(x, 25, axis=1, keepdims=True)
            y -= np.percentile(y, 25, axis=1, keepdims=True)
            shift = (segments.start[b] - segments.start[a]) * segments.unit[a] / segments.spacing[a]
            other = _interpolate(y, np.arange(x.shape[1]) - shift[:, None])
            inside = np.isfinite(other)
            self.products.append((x[inside], other[inside]))

    def find_ratio(self) -> float | None:
        """Gain of the sensitive channel over that of the other; None where it is not known."""
        if not self.products:
            return None
        x, y = (np.concatenate(values) for values in zip(*self.products, strict=True))
        used = (x > LINEAR[0] * self.top) & (x < LINEAR[1] * self.top) & (y > 0)
        if np.count_nonzero(used) < LEAST_SAMPLES:
            return None
        return float((x[used] * y[used]).sum() / (y[used] ** 2).sum())


def _interpolate(values: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Values (n, s) at places (n, k) between samples, by Lagrange's cubic; NaN outside.

    A straight line would lift flanks, and with them the other channel: by 5 % for pulses of two samples.
    """
    at = np.floor(place).astype(np.int64)
    part = place - at
    inside = (at >= 1) & (at < values.shape[1] - 2)
    at = np.clip(at, 1, max(values.shape[1] - 3, 1))
    weights = (
        -part * (part - 1) * (part - 2) / 6,
        (part + 1) * (part - 1) * (part - 2) / 2,
        -(part + 1) * part * (part - 2) / 2,
        (part + 1) * part * (part - 1) / 6,
    )
    rows, last = np.arange(len(values))[:, None], values.shape[1] - 1
    found = sum(weight * values[rows, np.minimum(at + k - 1, last)] for k, weight in enumerate(weights))
    return np.where(inside, found, np.nan)


def find_partners(segments: Segments, primary: int, returning: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs of segments that recorded the same time in the sensitive channel and in another one.

    Parameters
    ----------
    segments : Segments
        Sorted by pulse.
    primary : int
        The sensitive channel.
    returning : int64 (k,)
        Rows of returning segments.

    Returns
    -------
    first, second : int64 (m,)
        Rows of the sensitive and of the other channel.
    """
    is_primary = segments.channel[returning] == primary
    mine, others = returning[is_primary], returning[~is_primary]
    if not len(mine) or not len(others):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    begin = segments.start * segments.unit
    end = begin + segments.length * segments.spacing
    low = np.searchsorted(segments.pulse[mine], segments.pulse[others], side="left")
    high = np.searchsorted(segments.pulse[mine], segments.pulse[others], side="right")
    best, longest = np.full(len(others), -1), np.zeros(len(others))
    for step in range(int((high - low).max())):
        here = np.flatnonzero(low + step < high)
        row = mine[low[here] + step]
        other = others[here]
        shared = np.minimum(end[row], end[other]) - np.maximum(begin[row], begin[other])
        half = 0.5 * np.minimum(end[row] - begin[row], end[other] - begin[other])
        better = (shared > longest[here]) & (shared > half)
        best[here[better]], longest[here[better]] = row[better], shared[better]
    return best[best >= 0], others[best >= 0]


def group_rows(segments: Segments, *rows: np.ndarray) -> list[tuple[np.ndarray, ...]]:
    """Return the rows in groups of one kind of samples: equal bits, spacing and length, in each of the columns."""
    if not len(rows[0]):
        return []
    group = np.zeros(len(rows[0]), np.int64)
    for column in rows:
        kinds, of_row = np.unique(code_segments(segments, column), return_inverse=True)
        group = group * len(kinds) + of_row
    if not group.any():
        return [rows]
    # NumPy sorts numbers of two bytes in one pass.
    order = np.argsort(group.astype(np.uint16) if group.max() < 1 << 16 else group, kind="stable")
    cuts = np.flatnonzero(np.diff(group[order])) + 1
    return [tuple(column[part] for column in rows) for part in np.split(order, cuts)]


def code_segments(segments: Segments, rows: np.ndarray) -> np.ndarray:
    """Return a number per segment that says its channel, bits, spacing [ps] and length, i8 (k,): see `decode`."""
    spacing = np.round(segments.spacing[rows] * 1000).astype(np.int64)
    code = (segments.channel[rows].astype(np.int64) << 46) | (segments.bits[rows].astype(np.int64) << 40)
    return code | (spacing << 18) | segments.length[rows]


def decode(code: int) -> tuple[int, int, float, int]:
    """Return channel, bits, spacing [ns] and length of a code."""
    return code >> 46, (code >> 40) & 63, ((code >> 18) & ((1 << 22) - 1)) / 1000, code & ((1 << 18) - 1)
