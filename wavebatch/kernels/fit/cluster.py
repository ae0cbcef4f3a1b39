"""From candidate echoes to clusters of overlapping echoes, each with a window of samples to fit."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from wavebatch.kernels.fit.least_squares import OUTSIDE, Windows
from wavebatch.kernels.signal.signal import SMOOTH_GAIN

RUN_LEVEL = 2.0
"""Noise standard deviations of the smoothed signal above which echoes are one run."""


class Candidates(NamedTuple):
    """Echo candidates sorted by waveform, then time; times and widths in samples."""

    waveform: np.ndarray
    time: np.ndarray
    amplitude: np.ndarray
    width: np.ndarray


class Clusters(NamedTuple):
    """Runs of candidates that are fitted together, sorted by waveform."""

    waveform: np.ndarray
    """Row of each cluster (c,)."""
    low: np.ndarray
    """First sample of the cluster's window (c,)."""
    high: np.ndarray
    """One behind its last sample (c,)."""
    first: np.ndarray
    """Its first candidate (c,)."""
    number: np.ndarray
    """How many candidates it has (c,)."""


def find_runs(smoothed: np.ndarray, level: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Starts and ends (one behind) of the runs in which smoothed (s, n) exceeds level (n,), as waveform * s + sample.

    Both come sorted; runs end with their waveform.
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
    """Candidates that stand on one run of signal above the noise; windows of neighbouring clusters do not overlap.

    smoothed: [1 2 1]/4-filtered signal (s, n); std: noise of a raw sample (n,). margin: samples added on both sides of
    a run; reach: samples a window extends at least on both sides of its outer candidates; most: candidates per cluster;
    tail: samples behind each candidate that its after-pulses reach (m,).
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
    _separate(outer_low, outer_high, waveform, sample, low, furthest, first, last)
    return Clusters(waveform[first], outer_low, outer_high, first, last - first + 1)


def _find_extents(
    waveform: np.ndarray, sample: np.ndarray, smoothed: np.ndarray, std: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """First sample and one behind the last of the run of signal that each candidate stands on (m,)."""
    starts, ends = find_runs(smoothed, (RUN_LEVEL * SMOOTH_GAIN) * std.astype(np.float32))
    if not len(starts):
        return sample.copy(), sample + 1
    base = waveform * len(smoothed)
    run = np.maximum(np.searchsorted(starts, base + sample, side="right") - 1, 0)
    inside = (base + sample >= starts[run]) & (base + sample < ends[run])
    return np.where(inside, starts[run] - base, sample), np.where(inside, ends[run] - base, sample + 1)


def _separate(
    outer_low: np.ndarray,
    outer_high: np.ndarray,
    waveform: np.ndarray,
    sample: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    first: np.ndarray,
    last: np.ndarray,
) -> None:
    """Cuts the windows of neighbouring clusters half-way between their signals, or their candidates, in place."""
    here, there = last[:-1], first[1:]
    meet = waveform[here] == waveform[there]
    apart = low[there] >= high[here]
    middle = np.where(apart, low[there] + high[here], sample[there] + sample[here] + 1) // 2
    middle = np.clip(middle, sample[here] + 1, np.maximum(sample[there], sample[here] + 1))
    outer_low[1:] = np.where(meet, np.maximum(outer_low[1:], middle), outer_low[1:])
    outer_high[:-1] = np.where(meet, np.minimum(outer_high[:-1], middle), outer_high[:-1])
    np.minimum(outer_low, sample[first], out=outer_low)


def _limit_joins(joined: np.ndarray, most: int) -> np.ndarray:
    """Joins (m - 1,) with every run of them cut after `most` members."""
    if not len(joined):
        return joined
    position = np.arange(1, len(joined) + 1)
    begin = np.maximum.accumulate(np.where(joined, 0, position))
    return joined & ((position - begin) % most != 0)


def cut_windows(
    samples: np.ndarray,
    baseline: np.ndarray,
    std: np.ndarray,
    waveform: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    length: int,
    clip: float | None = None,
    noise_gain: float = 0.0,
) -> tuple[Windows, np.ndarray]:
    """Windows of `length` samples that hold [low, high) of their waveforms, and the sample each begins at (m,).

    samples: raw counts (n, s), contiguous. Samples outside [low, high) are put out of reach of every pulse.
    clip: raw count from which a sample counts as clipped; noise_gain: variance per count of signal (H12).
    """
    n, s = samples.shape
    length = min(length, s)
    begin = np.minimum(low, s - length)
    flat = samples.reshape(-1)
    views = np.lib.stride_tricks.as_strided(
        flat, (n * s - length + 1, length), (flat.itemsize, flat.itemsize), writeable=False
    )
    raw = views[waveform * s + begin]
    y = raw.astype(np.float32)
    clipped = None
    if clip is not None:
        clipped = y >= clip
        if not clipped.any():
            clipped = None
    y -= baseline[waveform][:, None]
    position = np.arange(length, dtype=np.float32)
    outside = position < (low - begin).astype(np.float32)[:, None]
    outside |= position >= (high - begin).astype(np.float32)[:, None]
    x = np.where(outside, OUTSIDE, position)
    y[outside] = 0
    weight = _weigh(y, std[waveform], noise_gain) if noise_gain > 0 else None
    if clipped is not None:
        clipped &= ~outside
    return Windows(y, x, std[waveform].astype(np.float64), clipped, weight), begin


def _weigh(y: np.ndarray, std: np.ndarray, noise_gain: float) -> np.ndarray:
    """Noise without signal over noise at each sample, from the smoothed signal (m, L): var = std^2 + gain * signal."""
    padded = np.pad(y, ((0, 0), (2, 2)), mode="edge")
    smooth = (padded[:, :-4] + padded[:, 4:] + 4 * (padded[:, 1:-3] + padded[:, 3:-1]) + 6 * padded[:, 2:-2]) / 16
    return 1 / np.sqrt(1 + np.float32(noise_gain) * np.maximum(smooth, 0) / (std * std).astype(np.float32)[:, None])


def estimate_starts(
    smoothed: np.ndarray, waveform: np.ndarray, sample: np.ndarray, width: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Amplitude, time and width of peaks by a log-parabola through five smoothed samples, weighted by the signal.

    The width of the filter is taken off. Where the parabola fails: the sample itself and `width`.
    """
    s, n = smoothed.shape
    flat = smoothed.reshape(-1)
    offsets = np.arange(-2, 3)
    at = np.clip(sample[None] + offsets[:, None], 0, s - 1)
    y = flat[at * n + waveform].astype(np.float64)
    peak = y[2]
    floor = 0.05 * peak
    used = np.maximum(y, floor[None])
    weight = np.where((at == sample[None] + offsets[:, None]) & (y > floor), used * used, 0.0)
    log = np.log(np.maximum(used, 1e-12))
    x = offsets[:, None].astype(np.float64)
    c0, c1, c2 = fit_parabola(weight, x, log, axis=0)
    good = (c2 < -1e-4) & np.isfinite(c1)
    safe = np.where(good, c2, -1.0)
    shift = -c1 / (2 * safe)
    good &= np.abs(shift) < 1.5
    variance = -1 / (2 * safe)
    time = sample + np.where(good, shift, 0.0)
    narrow = np.sqrt(np.maximum(variance - 0.5, 0.1))
    amplitude = np.where(good, np.exp(np.clip(c0 - c1 * c1 / (4 * safe), -20, 20)), peak)
    amplitude *= np.where(good, np.sqrt(1 + 0.5 / narrow**2), 1.1)
    return amplitude, time, np.where(good, narrow, width)


def start_errors(amplitude: np.ndarray, width: np.ndarray, std: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviations (m,) of amplitude and width that `estimate_starts` finds of isolated Gaussian echoes.

    amplitude and width [samples] of the echoes (m,); std: of the unfiltered noise (m,). To first order in the noise, of
    peaks that lie on a sample. Broad ones, of which five samples see only the top, have errors many times the bound.
    """
    spread = width * width + 0.5
    places = np.arange(-2.0, 3.0).tolist()
    shape = [np.exp(-0.5 * x * x / spread) for x in places]
    s0, s2, s4 = (sum(y * y * x**p for x, y in zip(places, shape, strict=True)) for p in (0, 2, 4))
    determinant = s0 * s4 - s2 * s2
    # Of the parabola c0 + c2 x^2: width sqrt(-1 / (2 c2) - 1/2), amplitude exp(c0) sqrt(1 + 1 / (2 width^2)).
    gain = spread * spread / (width * determinant)
    by_width = [gain * y * (s0 * x * x - s2) for x, y in zip(places, shape, strict=True)]
    loss = 0.5 / (width * spread)
    by_height = [
        y * (s4 - s2 * x * x) / determinant - loss * part for x, y, part in zip(places, shape, by_width, strict=True)
    ]
    noise = std / amplitude * np.sqrt(spread) / width
    return amplitude * noise * _filtered_norm(by_height), noise * _filtered_norm(by_width)


def _filtered_norm(taps: list[np.ndarray]) -> np.ndarray:
    """Root of the sum of squares of taps behind the [1 2 1]/4 filter: the gain of white noise before it."""
    wide = [0.0, 0.0, *taps, 0.0, 0.0]
    joined = ((a + 2.0 * b + c) * 0.25 for a, b, c in zip(wide, wide[1:], wide[2:], strict=False))
    return np.sqrt(sum(tap * tap for tap in joined))


def fit_parabola(weight: np.ndarray, x: np.ndarray, y: np.ndarray, axis: int) -> tuple[np.ndarray, ...]:
    """Coefficients"""
    s = [np.sum(weight * x**p, axis=axis) for p in range(5)]
    product = weight * y
    b = [np.sum(product * x**p, axis=axis) for p in range(3)]
    m0 = s[2] * s[4] - s[3] * s[3]
    m1 = s[1] * s[4] - s[2] * s[3]
    m2 = s[1] * s[3] - s[2] * s[2]
    determinant = s[0] * m0 - s[1] * m1 + s[2] * m2
    inverse = 1 / np.where(np.abs(determinant) > 1e-12, determinant, np.inf)
    c0 = (b[0] * m0 - b[1] * m1 + b[2] * m2) * inverse
    n1 = s[0] * s[4] - s[2] * s[2]
    n2 = s[0] * s[3] - s[1] * s[2]
    c1 = (-b[0] * m1 + b[1] * n1 - b[2] * n2) * inverse
    c2 = (b[0] * m2 - b[1] * n2 + b[2] * (s[0] * s[2] - s[1] * s[1])) * inverse
    return c0, c1, c2
