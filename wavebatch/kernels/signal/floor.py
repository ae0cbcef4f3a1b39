"""Noise that a digitizer cuts off at count 0: its level, size and correlation before the cut.

Called by the noise estimate, the noise stage and the survey. Before a change: nothing here may move a strip whose
level is some noise above 0 (docs/algorithms.md H10).
"""

from __future__ import annotations

from functools import lru_cache
from math import pi, sqrt

import numpy as np

from wavebatch.core.units import QUANTISATION_STD
from wavebatch.kernels.elementary import exp

MOST_LEAST = 0.05
"""Share of the quiet samples with the least count of all from which noise is cut off there."""

MOST_CUT = 0.9
"""Share of the noise below the first count up to which the rest shows what is cut off."""

NORMAL = 1.5
"""Ratio, at most, of the scatter of counts to that of normal noise which is cut off: counts of 0 may be fill."""


def floor_share(level: float, std: float) -> float:
    """Share of normal noise that a digitizer records as 0."""
    z, below, _ = _normal()
    return float(np.interp((0.5 - level) / max(std, QUANTISATION_STD), z, below))


def floor_response(level: float, std: float) -> tuple[float, float, float]:
    """What is left of normal noise that is cut off at 0.

    Parameters
    ----------
    level, std : float, count
        Mean and standard deviation before the cut.

    Returns
    -------
    offset : float, count
        Of the mean, above the level.
    response : float
        Change of the mean per count of the level.
    std : float, count
        Standard deviation after the cut.
    """
    cut = -level / std
    z, *tables = _normal()
    below, density = (float(np.interp(cut, z, values)) for values in tables)
    mean = density + cut * below
    variance = 1 - below + cut * density + cut**2 * below - mean**2
    return std * mean, 1 - below, std * sqrt(max(variance, 0.0))


def undo_floor(
    values: np.ndarray, level: float, std: float, spread: float, correlation: np.ndarray
) -> tuple[float, float, float, np.ndarray]:
    """Noise before the digitizer cut it off at 0; the same where hardly any samples are 0, or nearly all.

    Parameters
    ----------
    values : float32 (k,), count
        Quiet samples.
    level, std, spread : float, count
        Their mean, their noise, and the spread of the levels of their waveforms.
    correlation : (l,)
        Of samples 1, 2, ... apart.

    Returns
    -------
    level, std, spread, correlation
        Of normal noise with two shares of these samples: those of count 0, and those up to the count that halves the
        rest. Weak echoes change shares less than they change a mean.
    """
    found = level, std, spread, correlation
    share = float(np.mean(values <= 0))
    if not MOST_LEAST < share <= MOST_CUT:
        return found
    step = float(values[values > 0].min())
    upper = float(np.quantile(values, 0.5 + 0.5 * share, method="inverted_cdf"))
    shares = share, min(float(np.mean(values <= upper)), 1 - 0.5 / len(values))
    z, below, _ = _normal()
    low, high = np.interp(shares, below, z)
    whole = float(upper / (high - low))
    level = 0.5 * step - float(low) * whole
    _, response, seen = floor_response(level, whole)
    if not 1 / NORMAL < float(np.std(values)) / np.hypot(seen, QUANTISATION_STD * step) < NORMAL:
        return found
    spread /= response
    std = sqrt(max(whole**2 - spread**2 + QUANTISATION_STD**2, std**2))
    # What is left of a correlation rho is w rho + (1 - w) rho^2, within 0.03, of the first terms of Price's series.
    part = (response * whole / seen) ** 2
    root = np.sqrt(np.maximum(part**2 + 4 * (1 - part) * correlation, 0))
    return level, std, spread, 2 * correlation / (part + root)


@lru_cache
def _normal() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Standard deviations from -8 to 8, the share of normal noise below them, and its density there."""
    z = np.linspace(-8.0, 8.0, 3201)
    density = exp(-0.5 * z * z) / sqrt(2 * pi)
    return z, (np.cumsum(density) - 0.5 * density) / np.sum(density), density
