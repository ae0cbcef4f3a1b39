"""Buckets of a `Spool` for records that belong together, so that they are compared in bounded memory.

The comparisons, the statistics and the maps use it. All points of a pulse must come into the same bucket: sort by
keys that are equal for equal GPS times.
"""

from __future__ import annotations

import numpy as np

BUCKET_ROWS = 400_000
"""Rows in memory at a time, unless MOST_BUCKETS are too few."""

MOST_BUCKETS = 72
"""With BUCKET_ROWS these hold 29 million rows; more rows make larger buckets, so that reads from disk stay long."""

MOST_RETURNS = 16
"""Most points per GPS time on average; with more, times are not those of pulses (LAS allows 15 returns)."""

_MIX = np.uint64(0x9E3779B97F4A7C15)
"""2^64 divided by the golden ratio: multiplicative hashing (Knuth, The Art of Computer Programming 3, 6.4)."""


def count_buckets(rows: int, held: int | None = None) -> int:
    """Return how many buckets of at most `held` rows (None: BUCKET_ROWS) are needed, at most MOST_BUCKETS."""
    return min(-(-max(rows, 1) // (held or BUCKET_ROWS)), MOST_BUCKETS)


def spread_times(gps_time: np.ndarray, number: int) -> np.ndarray:
    """Return the bucket i8 (n,) of GPS times f8 (n,) [s]: a pulse in one bucket, pulses spread evenly."""
    return spread_keys(time_keys(gps_time), number)


def tell_pulses_apart(gps_time: np.ndarray) -> bool:
    """Whether GPS times (n,) identify pulses: on average at most MOST_RETURNS points have the same time."""
    return len(np.unique(gps_time)) * MOST_RETURNS >= len(gps_time)


def time_keys(gps_time: np.ndarray) -> np.ndarray:
    """Return keys u8 (n,) that are equal if GPS times f8 (n,) are; +0 and -0 get the same key."""
    return (gps_time + 0.0).view(np.uint64)


def spread_keys(keys: np.ndarray, number: int) -> np.ndarray:
    """Return the bucket i8 (n,) of each key u8 (n,): equal keys in the same bucket, others spread evenly."""
    mixed = (keys ^ (keys >> np.uint64(29))) * _MIX
    return ((mixed >> np.uint64(33)) % np.uint64(number)).astype(np.int64)
