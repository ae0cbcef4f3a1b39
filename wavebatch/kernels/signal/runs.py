"""Runs of samples and flanks of peaks: highest samples, and where a flank crosses a level.

Used by stages/detect; `lobe_edges` also by the pulse models. A run is given by its start and its end
(one after the last sample) as waveform * s + sample.
"""

from __future__ import annotations

import numpy as np


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


def list_samples(starts: np.ndarray, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Run and position (waveform * s + sample) of every sample in runs, int64."""
    length = ends - starts
    run = np.repeat(np.arange(len(starts)), length)
    before = np.cumsum(length) - length
    return run, np.arange(len(run)) - (before - starts)[run]


def highest_samples(signal: np.ndarray, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Sample at which the signal is highest in each run; the first of several.

    Parameters
    ----------
    signal : float (s, n)
        Waveforms.
    starts, ends : int64 (k,)
        Runs.

    Returns
    -------
    int64 (k,)
    """
    s, n = signal.shape
    if not len(starts):
        return np.empty(0, np.int64)
    run, place = list_samples(starts, ends)
    sample = place % s
    value = signal.reshape(-1)[sample * n + place // s]
    first = np.cumsum(ends - starts) - (ends - starts)
    at = np.flatnonzero(value == np.maximum.reduceat(value, first)[run])
    return sample[at[np.append(True, np.diff(run[at]) > 0)]]


def run_moments(signal: np.ndarray, starts: np.ndarray, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centre of gravity and standard deviation of the positive signal in each run.

    Parameters
    ----------
    signal : float (s, n)
        Waveforms.
    starts, ends : int64 (k,)
        Runs.

    Returns
    -------
    centre, spread : float64 (k,), samples
        The middle of the run and 0 where no sample is positive.
    """
    s, n = signal.shape
    run, place = list_samples(starts, ends)
    sample = place % s
    weight = np.maximum(signal.reshape(-1)[sample * n + place // s], 0).astype(np.float64)
    middle = 0.5 * (starts + ends - 1) - starts // s * s
    lag = sample - middle[run]
    # bincount adds sample after sample, so that sums do not depend on the rest of the block.
    total, first, second = (np.bincount(run, weight * lag**p, minlength=len(starts)) for p in range(3))
    total = np.where(total > 0, total, 1.0)
    mean = first / total
    return middle + mean, np.sqrt(np.maximum(second / total - mean**2, 0.0))


def lobe_edges(x: np.ndarray, curve: np.ndarray, level: float) -> tuple[float, float]:
    """Where the main lobe of one curve crosses a level, on the left and on the right of its peak.

    Parameters
    ----------
    x, curve : float (r,)
        The curve; linear between its samples.
    level : float
        Below the peak, and above the curve somewhere on both sides.

    Returns
    -------
    left, right : float, unit of x
    """
    top = int(np.argmax(curve))
    right = top + int(np.argmax(curve[top:] < level))
    left = top - int(np.argmax(curve[top::-1] < level))
    crossed = ((left + 1, left), (right - 1, right))
    begin, end = (x[a] + (x[b] - x[a]) * (level - curve[a]) / (curve[b] - curve[a]) for a, b in crossed)
    return begin, end


def walk_down(
    signal: np.ndarray, waveform: np.ndarray, sample: np.ndarray, level: np.ndarray, step: int
) -> np.ndarray:
    """Place at which the signal falls to a level when one walks from a peak in one direction.

    Parameters
    ----------
    signal : float (s, n)
        Waveforms; linear between samples.
    waveform, sample : int64 (m,)
        Place of each peak.
    level : float (m,)
        Level to reach.
    step : int
        +1 or -1.

    Returns
    -------
    float64 (m,), samples
        A walk that meets a rise or an end of the waveform first stops at its last sample.
    """
    s, n = signal.shape
    flat = signal.reshape(-1)
    place = sample.astype(np.float64)
    going, here, value = np.arange(len(sample)), sample, flat[sample * n + waveform]
    while len(going):
        inside = (here + step >= 0) & (here + step < s)
        going, here, value = going[inside], here[inside] + step, value[inside]
        after = flat[here * n + waveform[going]]
        falls = after <= value
        crosses = falls & (after <= level[going]) & (after < value)
        at = np.flatnonzero(crosses)
        share = (value[at] - level[going[at]]) / (value[at] - after[at])
        place[going[at]] += step * np.clip(share, 0.0, 1.0)
        going, here, value = (field[falls & ~crosses] for field in (going, here, after))
        place[going] = here
    return place


def find_stretches(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows, first samples and ends of the stretches of true samples in mask (n, s), in order: int64 (k,) each."""
    # A sample of rest between rows, so that starts and ends take turns.
    n, s = mask.shape
    padded = np.zeros(n * (s + 1) + 1, bool)
    padded[1:].reshape(n, s + 1)[:, :s] = mask
    edge = np.flatnonzero(padded[1:] != padded[:-1])
    row, start = np.divmod(edge[::2], s + 1)
    return row, start, edge[1::2] - row * (s + 1)


def gap_distance(missing: np.ndarray, waveform: np.ndarray, time: np.ndarray) -> np.ndarray:
    """How far times lie from the nearest gap of their waveform, inside of what was recorded.

    Parameters
    ----------
    missing : bool (n, s)
        Samples that were not recorded.
    waveform : int (m,)
        Rows.
    time : float (m,), samples

    Returns
    -------
    float64 (m,), samples
        0 at the recorded sample next to a gap, negative inside of one; inf where the waveform has none.
    """
    row, start, end = find_stretches(missing)
    distance = np.full(len(waveform), np.inf)
    if not len(row):
        return distance
    width = missing.shape[1] + 2.0
    place = np.searchsorted(row * width + start, waveform * width + np.clip(time, -1, width - 2), side="right")
    for near in (place - 1, place):
        gap = np.clip(near, 0, len(row) - 1)
        away = np.maximum(start[gap] - 1 - time, time - end[gap])
        distance = np.where((near == gap) & (row[gap] == waveform), np.minimum(distance, away), distance)
    return distance
