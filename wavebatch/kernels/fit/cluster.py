"""From candidate echoes to clusters of overlapping echoes, each with a window of samples to fit.

Used by stages/decompose before the fit; `find_runs` also by stages/detect. Windows of neighbouring clusters must not
overlap: a window that reaches into its neighbour finds false echoes there (9 % false splits instead of 0.9 %).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from wavebatch.kernels.signal.signal import SMOOTH_GAIN

RUN_LEVEL = 2.0
"""Level of a run, in noise standard deviations of the smoothed signal: echoes on one run are one cluster."""


class Candidates(NamedTuple):
    """Candidate echoes sorted by waveform, then time."""

    waveform: np.ndarray
    """Row of the block, int64 (m,)."""
    time: np.ndarray
    """Place of the peak, float64 (m,), samples."""
    amplitude: np.ndarray
    """Height above the baseline, float64 (m,), count."""
    width: np.ndarray
    """Gaussian standard deviation, float64 (m,), samples."""


class Clusters(NamedTuple):
    """Candidates that are fitted together, sorted by waveform."""

    waveform: np.ndarray
    """Row of the block, int64 (c,)."""
    low: np.ndarray
    """First sample of the window, int64 (c,)."""
    high: np.ndarray
    """End of the window: one after its last sample, int64 (c,)."""
    first: np.ndarray
    """First candidate of the cluster, int64 (c,)."""
    number: np.ndarray
    """Number of its candidates, int64 (c,)."""


def find_runs(smoothed: np.ndarray, level: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Runs of samples above a level.

    Parameters
    ----------
    smoothed : float32 (s, n), count
        Signal, usually smoothed.
    level : float (n,), count
        Level of each waveform.

    Returns
    -------
    starts, ends : int64 (k,)
        First sample and one after the last, as waveform * s + sample; both sorted. A run ends with its waveform.
    """
    s, n = smoothed.shape
    above = np.zeros((n, s + 2), np.int8)
    above[:, 1:-1] = (smoothed > level).T
    edge = np.diff(above, axis=1).ravel()
    starts = np.flatnonzero(edge == 1)
    ends = np.flatnonzero(edge == -1)
    return starts - starts // (s + 1), ends - ends // (s + 1)


def cluster_candidates(
    candidates: Candidates,
    smoothed: np.ndarray,
    std: np.ndarray,
    *,
    margin: int,
    reach: int,
    most: int,
    tail: np.ndarray | None = None,
) -> Clusters:
    """Joins candidates that stand on one run of signal above the noise, and gives each cluster its window.

    Parameters
    ----------
    candidates : Candidates
        Sorted by waveform, then time.
    smoothed : float32 (s, n), count
        Signal filtered with [1 2 1]/4.
    std : float (n,), count
        Noise of one raw sample.
    margin : int, samples
        Added on both sides of a run.
    reach : int, samples
        Smallest distance between the outer candidates and the ends of the window.
    most : int
        Largest number of candidates per cluster.
    tail : int (m,), samples, optional
        How far the after-pulses of each candidate reach.

    Returns
    -------
    Clusters
        With windows that do not overlap.
    """
    s, _ = smoothed.shape
    waveform, sample = candidates.waveform, np.clip(np.rint(candidates.time), 0, s - 1).astype(np.int64)
    if not len(waveform):
        return Clusters(*(np.empty(0, np.int64) for _ in range(5)))
    low, high = _find_extents(waveform, sample, smoothed, std)
    if tail is not None:
        high = np.maximum(high, sample + tail)
    furthest = np.maximum.accumulate(high + waveform * (4 * s)) - waveform * (4 * s)
    joined = _limit_joins((waveform[1:] == waveform[:-1]) & (low[1:] < furthest[:-1]), most)
    first = np.flatnonzero(np.r_[True, ~joined])
    last = np.r_[first[1:], len(waveform)] - 1
    outer_low = np.maximum(np.minimum(low[first] - margin, sample[first] - reach), 0)
    outer_high = np.minimum(np.maximum(furthest[last] + margin, sample[last] + 1 + reach), s)
    # Windows of neighbours are cut half-way between their signals, or their candidates where the signals meet.
    here, there = last[:-1], first[1:]
    meet = waveform[here] == waveform[there]
    apart = low[there] >= furthest[here]
    middle = np.where(apart, low[there] + furthest[here], sample[there] + sample[here] + 1) // 2
    middle = np.clip(middle, sample[here] + 1, np.maximum(sample[there], sample[here] + 1))
    outer_low[1:] = np.where(meet, np.maximum(outer_low[1:], middle), outer_low[1:])
    outer_high[:-1] = np.where(meet, np.minimum(outer_high[:-1], middle), outer_high[:-1])
    np.minimum(outer_low, sample[first], out=outer_low)
    return Clusters(waveform[first], outer_low, outer_high, first, last - first + 1)


def _find_extents(
    waveform: np.ndarray, sample: np.ndarray, smoothed: np.ndarray, std: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """First sample and end of the run of signal that each candidate stands on (m,)."""
    starts, ends = find_runs(smoothed, (RUN_LEVEL * SMOOTH_GAIN) * std.astype(np.float32))
    if not len(starts):
        return sample.copy(), sample + 1
    base = waveform * len(smoothed)
    run = np.maximum(np.searchsorted(starts, base + sample, side="right") - 1, 0)
    inside = (base + sample >= starts[run]) & (base + sample < ends[run])
    return np.where(inside, starts[run] - base, sample), np.where(inside, ends[run] - base, sample + 1)


def _limit_joins(joined: np.ndarray, most: int) -> np.ndarray:
    """Joins (m - 1,) in which every run is cut after `most` members."""
    position = np.arange(1, len(joined) + 1)
    begin = np.maximum.accumulate(np.where(joined, 0, position))
    return joined & ((position - begin) % most != 0)
