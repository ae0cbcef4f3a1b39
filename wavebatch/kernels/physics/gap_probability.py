"""How much brighter canopy is than ground, from the light that pulses share between them.

Used by the voxels: what is left of a pulse after its signal from the canopy is its gap probability only if signal from
the ground counts as much as that from leaves.
"""

from __future__ import annotations

import numpy as np

from wavebatch.core.frozen import NamedTuple
from wavebatch.core.units import MAD_TO_STD
from wavebatch.kernels.elementary import log

LEAST_PULSES = 100
"""Smallest number of pulses."""

LEAST_SPREAD = 0.1
"""Smallest standard deviation of the ground's share of the light: below, nothing shows what it counts."""

LARGEST_ERROR = 0.5
"""Largest relative error of a ratio that is used: a ratio of 1 that nothing supports is off by more."""

LOWEST_RATIO, HIGHEST_RATIO = 0.02, 50.0
"""Ratios that are looked for."""

MODEL_ERROR = 0.03
"""Least relative error of a ratio. Besides, light that varies from pulse to pulse by a relative s moves the ratio by up
to s^2 (simulated: 3 to 10 % for reflectances that vary by a fifth), and pulses that do not fit it at all, as those on a
second kind of soil, by as much as they differ.
"""

ASSUMED_ERROR = float(np.log(2.0))
"""Standard deviation of the logarithm of a ratio that the strip does not show: leaves and soils of .15 to .5."""

_MOST_UNLIKE = np.log(4.0)
"""Pulses whose light differs by more have hardly any: they tell nothing about reflectances."""

PARTS = 10
"""Parts of the strip; the error is found from leaving out one after the other."""

_STEPS, _HALVINGS = 33, 8
_NEAR = np.log(2.0)
"""Without a part of the strip, the ratio is looked for within this of the logarithm of that of all."""

_CLIP = 4.0
"""Pulses whose light is further off than this many robust standard deviations do not count."""

LEAST_RAYS = 2.0
"""Independent rays below which attenuation is no-data: the unbiased rate (hits - 1) / path of rays that all end in the
voxel has no finite mean for one ray."""

_LEAST_SHARE = 1e-9
"""Shares are kept so far from 0 and 1, where the bias is a limit; below the unit in which light is summed."""


class CanopyRatio(NamedTuple):
    """Reflectance of the canopy over that of the ground, as the sensor sees both."""

    ratio: float
    error: float
    """Its standard deviation."""


def estimate_canopy_ratio(canopy: np.ndarray, ground: np.ndarray) -> CanopyRatio | None:
    """Ratio of reflectances for which the light of a pulse does not depend on how much of it reached the ground.

    Parameters
    ----------
    canopy, ground : float64 (n,)
        Energy of each pulse from canopy and ground, normalised by the square of the range, in the order of the strip.

    Returns
    -------
    CanopyRatio or None
        None where too few pulses, or too similar ones, show it.

    Notes
    -----
    canopy = E r_c (1 - P), ground = E r_g P for a gap probability P, so that canopy + (r_c / r_g) ground = E r_c
    (Ni-Meister et al. 2001; Armston et al. 2013: the slope of canopy energy against ground energy). The ratio is that
    at which the logarithm of this sum has no slope over the ground's share of it: energy that varies from pulse to
    pulse then makes no slope. docs/algorithms.md 2.5.
    """
    used = (canopy >= 0) & (ground >= 0) & (canopy + ground > 0) & np.isfinite(canopy + ground)
    canopy, ground = canopy[used], ground[used]
    found = _find_ratio(canopy, ground, np.linspace(np.log(LOWEST_RATIO), np.log(HIGHEST_RATIO), _STEPS))
    if found is None:
        return None
    part, near = np.arange(len(canopy)) * PARTS // len(canopy), found + np.linspace(-_NEAR, _NEAR, 5)
    others = []
    for number in range(PARTS):
        other = _find_ratio(canopy[part != number], ground[part != number], near)
        if other is None:
            return None
        others.append(other)
    error = float(np.sqrt((PARTS - 1) * np.var(others)))
    # Robust scatter of the light of pulses, and what pulses beyond it add.
    ratio = np.exp(found)
    light = np.log(canopy + ratio * ground)
    off = np.abs(light - np.median(light))
    scatter = MAD_TO_STD * float(np.median(off))
    beyond = (off > _CLIP * scatter) & (off < _MOST_UNLIKE)
    unlike = float(np.sqrt(np.mean(np.where(beyond, off, 0.0) ** 2)))
    error = float(np.sqrt(error**2 + MODEL_ERROR**2 + scatter**4 + unlike**2))
    return CanopyRatio(float(np.exp(found)), float(np.exp(found) * error)) if error < LARGEST_ERROR else None


def _find_ratio(canopy: np.ndarray, ground: np.ndarray, logs: np.ndarray) -> float | None:
    """Logarithm of the ratio, within the range of `logs`, ascending; None where it is not determined."""
    if len(canopy) < LEAST_PULSES:
        return None
    slopes = np.array([_slope(canopy, ground, float(np.exp(value))) for value in logs])
    if not np.isfinite(slopes).all():
        return None
    rises = np.flatnonzero((slopes[:-1] < 0) & (slopes[1:] >= 0))
    if len(rises) != 1:
        return None
    low, high = (float(logs[rises[0] + side]) for side in (0, 1))
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _slope(canopy, ground, np.exp(middle)) < 0 else (low, middle)
    found = 0.5 * (low + high)
    return found if _share(canopy, ground, np.exp(found)).std() >= LEAST_SPREAD else None


def _share(canopy: np.ndarray, ground: np.ndarray, ratio: float) -> np.ndarray:
    return ratio * ground / (canopy + ratio * ground)


def _slope(canopy: np.ndarray, ground: np.ndarray, ratio: float) -> float:
    """Slope of the logarithm of all light over the ground's share, without outliers; NaN for a constant share."""
    share, light = _share(canopy, ground, ratio), np.log(canopy + ratio * ground)
    used = np.ones(len(share), bool)
    slope = level = 0.0
    for _ in range(3):
        x, y = share[used] - share[used].mean(), light[used] - light[used].mean()
        if not x @ x > 0:
            return np.nan
        slope = float(x @ y / (x @ x))
        level = light[used].mean() - slope * share[used].mean()
        off = np.abs(light - level - slope * share)
        used = off <= _CLIP * max(MAD_TO_STD * float(np.median(off)), 1e-9)
    return slope


def measure_attenuation(share: np.ndarray, rays: np.ndarray, free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Part of the light that plants catch per metre, and its standard deviation.

    Parameters
    ----------
    share : float64 (n,)
        Share of the light that plants caught in a voxel, 0 to 1.
    rays : float64 (n,)
        Independent rays in it.
    free : float64 (n,), m
        Mean path of the light up to where it is caught or leaves the voxel.

    Returns
    -------
    attenuation, error : float64 (n,), 1/m
        NaN for fewer than LEAST_RAYS rays, or none.

    Notes
    -----
    Hits over free path, the estimate of largest likelihood, less its bias for few rays (Pimont et al. 2018): the part
    of the path that belongs to rays that were caught, over the hits. That part is taken for leaves that are even in
    the voxel. The error is that of a count of hits; half a hit is added, because no hit would state no error.
    """
    known = (rays >= LEAST_RAYS) & (free > 0)
    share, exposure = np.clip(share, _LEAST_SHARE, 1.0 - _LEAST_SHARE), np.where(known, rays * free, 1.0)
    hits = share * rays
    bias = 1.0 + (1.0 - share) * log(1.0 - share) / share
    found, error = np.maximum(hits - bias, 0.0) / exposure, np.sqrt(hits + 0.5) / exposure
    return np.where(known, found, np.nan), np.where(known, error, np.nan)
