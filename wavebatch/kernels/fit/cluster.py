"""From candidate echoes to clusters of overlapping echoes, each with a window of samples to fit.

Used by stages/decompose before the fit; done by kernels/c/signal.h. Windows of neighbouring clusters must not
overlap: a window that reaches into its neighbour finds false echoes there (9 % false splits instead of 0.9 %).
"""

from __future__ import annotations

import ctypes
from typing import NamedTuple

import numpy as np

from wavebatch.kernels import library
from wavebatch.kernels.library import Samples, call, place


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


def cluster_candidates(
    samples: Samples,
    candidates: Candidates,
    *,
    margin: int,
    reach: int,
    most: int,
    tail: np.ndarray | None = None,
) -> Clusters:
    """Joins candidates that stand on one run of signal above the noise, and gives each cluster its window.

    Parameters
    ----------
    samples : Samples
        Waveforms with their levels; smoothed with [1 2 1]/4, a run lies above 2 standard deviations.
    candidates : Candidates
        Sorted by waveform, then time.
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
    samples, m = samples.checked(), len(candidates.waveform)
    waveform = np.ascontiguousarray(candidates.waveform, np.int64)
    time = np.ascontiguousarray(candidates.time, np.float64)
    if m and not (waveform.min() >= 0 and waveform.max() < len(samples.counts) and np.isfinite(time).all()):
        raise ValueError("a candidate lies in no waveform")
    columns = [np.empty(m, np.int64) for _ in Clusters._fields]
    tail = None if tail is None else np.ascontiguousarray(tail, np.int64)
    grouping = library.Grouping(margin, reach, most, None if tail is None else place(tail, np.int64))
    groups = library.CGroups(*(place(column, np.int64) for column in columns))
    c = call("group_candidates", samples.as_block(), ctypes.c_int64(m), waveform, time, grouping, groups)
    return Clusters(*(column[:c] for column in columns))
