"""The B3-spline wavelet transform with holes, along the samples of arrays (s, n).

Used by the stage detect.wavelet (Wang et al., docs/algorithms.md 1.2).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np


def smooth_b3(signal: np.ndarray, step: int) -> np.ndarray:
    """Signal (s, n) filtered with [1 4 6 4 1]/16, taps `step` samples apart; the end samples are repeated outwards."""
    s = len(signal)
    padded = np.concatenate([np.repeat(signal[:1], 2 * step, axis=0), signal, np.repeat(signal[-1:], 2 * step, axis=0)])
    inner = padded[step : step + s] + padded[3 * step : 3 * step + s]
    inner *= 4
    inner += padded[:s]
    inner += padded[4 * step : 4 * step + s]
    padded = padded[2 * step : 2 * step + s]
    inner += 6 * padded
    inner *= signal.dtype.type(1 / 16)
    return inner


def b3_detail(signal: np.ndarray, level: int) -> np.ndarray:
    """Detail of signal (s, n) at a level, 1 or more: what the last of `level` smoothings removes."""
    for step in range(level - 1):
        signal = smooth_b3(signal, 1 << step)
    return signal - smooth_b3(signal, 1 << (level - 1))


@lru_cache(maxsize=16)
def b3_gain(level: int) -> float:
    """Standard deviation of the detail of white noise of standard deviation 1."""
    reach = 2 * (1 << level)
    impulse = np.zeros((2 * reach + 1, 1))
    impulse[reach] = 1.0
    return float(np.sqrt(np.sum(b3_detail(impulse, level) ** 2)))


def b3_level(width: float) -> int:
    """The level that separates echoes of a Gaussian width [samples] best: round(log2(width)) + 1, at least 1."""
    return max(int(round(float(np.log2(width)))) + 1, 1)
