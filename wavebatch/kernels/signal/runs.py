"""Runs of samples and flanks of peaks: the highest sample, sums, and where a flank crosses a level."""

from __future__ import annotations

import numpy as np


def list_samples(starts: np.ndarray, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Run and position (waveform * s + sample) of every sample in runs as `find_runs` gives them."""
    length = ends - starts
    run = np.repeat(np.arange(len(starts)), length)
    behind = np.cumsum(length) - length
    return run, np.arange(len(run)) - (behind - starts)[run]


def highest_samples(signal: np.ndarray, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Sample (k,) at which the signal (s, n) is highest in each run of `find_runs`, the first of several."""
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
    """Centre of gravity and standard deviation [samples] of the positive signal (s, n) in each run, float64 (k,).

    A run without a positive sample has its middle and 0.
    """
    s, n = signal.shape
    run, place = list_samples(starts, ends)
    sample = place % s
    weight = np.maximum(signal.reshape(-1)[sample * n + place // s], 0).astype(np.float64)
    middle = 0.5 * (starts + ends - 1) - starts // s * s
    lag = sample - middle[run]
    # Sums sample after sample: the same whatever else is in the block.
    total, first, second = (np.bincount(run, weight * lag**p, minlength=len(starts)) for p in range(3))
    total = np.where(total > 0, total, 1.0)
    mean = first / total
    return middle + mean, np.sqrt(np.maximum(second / total - mean**2, 0.0))


def lobe_edges(x: np.ndarray, curve: np.ndarray, level: float) -> tuple[float, float]:
    """Edges"""
    top = int(np.argmax(curve))
    right = top + int(np.argmax(curve[top:] < level))
    left = top - int(np.argmax(curve[top::-1] < level))

    def cross(a: int, b: int) -> float:
        return x[a] + (x[b] - x[a]) * (level - curve[a]) / (curve[b] - curve[a])

    return cross(left + 1, left), cross(right - 1, right)


def walk_down(signal: np.ndarray, waveform: np.ndarray, sample: np.ndarray, level: np.ndarray, step: int) -> np.ndarray:
    """Position (m,) at which the signal (s, n) falls to the level (m,) when one walks from a peak by steps of +-1.

    Linear between samples. A walk that meets a rise or an end of the waveform before stops at the last sample there.
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
