"""A decomposition's types (settings, echoes found), and clusters of overlapping echoes with a window of samples each.

stages/decompose makes Settings, groups candidates before the fit (kernels/c/signal.h does it) and reads Solution. All
widths and times are in samples. Windows of neighbouring clusters must not overlap: a window that reaches into its
neighbour finds false echoes there (9 % false splits instead of 0.9 %).
"""

from __future__ import annotations

import ctypes
from typing import NamedTuple

import numpy as np

from wavebatch.kernels import library
from wavebatch.kernels.fit.pulse_shape import GAUSSIAN, PulseShape
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


class Settings(NamedTuple):
    """Options of a decomposition; widths in samples."""

    width_ref: float
    """Width of the system pulse: that of new echoes."""
    width_low: float
    """Smallest width allowed."""
    width_high: float
    """Largest width allowed."""
    shape: PulseShape = GAUSSIAN
    """Model of the pulse."""
    clip: float | None = None
    """Raw count from which samples are clipped; None where none is."""
    noise_gain: float = 0.0
    """Noise variance per count of signal (docs/algorithms.md H12) [count]."""
    tolerance: float = 1e-2
    """A fit has converged when the next step promises a fall of chi2 below this."""
    max_iterations: int = 40
    """Largest number of iterations of one fit; 40 at least where samples are clipped."""
    grow: bool = True
    """Whether echoes are added where the residual shows more than noise."""
    acceptance: float = 15.0
    """Smallest fall of chi2 for which an echo is added (docs/algorithms.md 2.3)."""
    misfit: float = 0.0
    """Deviation of the pulse from its model as a share of the amplitude: raises the acceptance of strong echoes."""
    max_echoes: int = 6
    """Largest number of echoes of one cluster that growth may reach."""
    prior_spread: float = 0.0
    """Standard deviation of a one-sided prior on widths of overlapping echoes below `width_ref`; 0 for none. Without
    it, close echoes trade width against amplitude (docs/algorithms.md H1)."""
    gate_residual: float = 4.2
    """Limit of the smoothed residual [noise standard deviations] (docs/algorithms.md 4.2)."""
    gate_hermite: float = 8.5
    """Limit of h3^2 + h4^2 (docs/algorithms.md 4.2)."""
    known: float = 0.0
    """Errors that the amplitude of an echo needs beside others, or chi2 must rise enough without it; 0: any will do."""
    whitening: np.ndarray | None = None
    """Filter that makes the noise white, float64 (3, 3), `whitening_filter`; None where fits take it for white."""
    undamped: bool = False
    """Gauss-Newton steps without damping or limits, for comparison (docs/algorithms.md 1.3)."""
    skew_mean: float = 0.0
    """Mean of the normal prior on the skew of each echo (docs/algorithms.md 1.2)."""
    skew_spread: float = 0.0
    """Its standard deviation; 0 for echoes without a skew of their own."""


class Solution(NamedTuple):
    """Echoes of c clusters, m in all, sorted by cluster."""

    number: np.ndarray
    """Number of echoes of each cluster, int64 (c,)."""
    converged: np.ndarray
    """Whether the fit of each cluster has converged, bool (c,)."""
    misfit: np.ndarray
    """Root mean square residual of each cluster in noise standard deviations, float64 (c,)."""
    cost: np.ndarray
    """chi2 plus prior of each cluster, float64 (c,)."""
    parameters: np.ndarray
    """Amplitude [count], time [samples of the waveform], width [samples], skew of each echo, float64 (m, 4)."""
    errors: np.ndarray
    """One standard deviation of each parameter, float64 (m, 4)."""
    shared: np.ndarray
    """Covariance of the width of each echo with its amplitude, and with its time, float64 (m, 2)."""
    at_bound: np.ndarray
    """Whether a parameter of the echo lies on its limit, bool (m,)."""

    @property
    def cluster(self) -> np.ndarray:
        """Cluster of each echo, int64 (m,)."""
        return np.repeat(np.arange(len(self.number)), self.number)


    def take(self, rows: np.ndarray) -> Solution:
        """The clusters `rows`, int (r,), in that order, with their echoes."""
        first = np.cumsum(self.number) - self.number
        number = self.number[rows]
        echo = np.arange(number.sum()) + np.repeat(first[rows] - (np.cumsum(number) - number), number)
        return Solution(*(column[rows] for column in self[:4]), *(column[echo] for column in self[4:]))


def choose(solutions: list[Solution], chosen: np.ndarray) -> Solution:
    """For each cluster the solution number `chosen`, int (c,), of solutions of the same clusters."""
    per_cluster = (np.choose(chosen, fields) for fields in zip(*(s[:4] for s in solutions), strict=True))
    kept = [np.flatnonzero(chosen[solution.cluster] == i) for i, solution in enumerate(solutions)]
    cluster = np.concatenate([s.cluster[rows] for s, rows in zip(solutions, kept, strict=True)])
    order = np.argsort(cluster, kind="stable")
    per_echo = (
        np.concatenate([field[rows] for field, rows in zip(fields, kept, strict=True)])[order]
        for fields in zip(*(s[4:] for s in solutions), strict=True)
    )
    return Solution(*per_cluster, *per_echo)
