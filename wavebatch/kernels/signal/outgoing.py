"""Energy, height and place of outgoing pulses, each with its error; called when pulses are imported.

Outgoing pulses are recorded with few samples: the level is known better from all shots than from one, so each shot's
level is drawn to that of all as far as levels do not differ by more than their noise.
"""

from __future__ import annotations

import numpy as np

from wavebatch.core.frozen import NamedTuple
from wavebatch.core.order import median
from wavebatch.core.units import MAD_TO_STD, QUANTISATION_STD
from wavebatch.kernels.elementary import exp, log

QUIET = 3.5
"""Widths before the peak up to which samples show the level; what comes behind it may hold after-pulses."""

BEFORE, AFTER = 4.0, 6.0
"""Widths before and after the peak that the energy is summed over: tails are longer than fronts."""

MOST_LAGS = 4
"""Lags of the noise's correlation that count: receivers are quicker."""

LEAST_HEIGHT = 8.0
"""Noise above which a recording shows a pulse."""

PEAK_ERROR = 1.1
"""Error of the height of a parabola through three samples, in noise of one: from simulated Gaussians of 1.5 to 3
samples, 1.0 to 1.15."""


class OutgoingReference(NamedTuple):
    """What all outgoing pulses of a channel have in common."""

    width: float
    """Gaussian standard deviation [samples]."""
    noise: float
    """Standard deviation of a sample [DN]."""
    gain: float
    """Variance of a mean of samples over that of white noise, for correlated noise."""
    level: float
    """Mean level without light [DN]."""
    spread: float
    """Standard deviation of true levels between shots [DN]."""
    top: float = np.inf
    """Count at which recordings are clipped."""


class OutgoingPulses(NamedTuple):
    """Measures of n outgoing pulses; NaN where a recording shows none, or all but the time where it is clipped."""

    energy: np.ndarray
    """Sum above the level, f8 (n,) [DN samples]."""
    amplitude: np.ndarray
    """Height of the peak above the level, f8 (n,) [DN]."""
    time: np.ndarray
    """Place of the peak, f8 (n,) [samples]."""
    level: np.ndarray
    """f8 (n,) [DN]."""
    energy_error: np.ndarray
    """Standard deviation, f8 (n,)."""
    amplitude_error: np.ndarray
    """Standard deviation, f8 (n,)."""
    time_error: np.ndarray
    """Standard deviation, f8 (n,) [samples]."""


def find_reference(samples: np.ndarray) -> OutgoingReference | None:
    """Return what outgoing pulses have in common.

    Parameters
    ----------
    samples : unsigned integers (n, s), count
        Recordings of one channel and length, spread over the strip.

    Returns
    -------
    OutgoingReference or None
        None where most of them show no pulse.
    """
    values = samples.astype(np.float32)
    least = np.min(values, axis=1)
    peak = np.argmax(values, axis=1)
    height = values[np.arange(len(values)), peak] - least
    # Half width at half height, from where samples cross it; it only has to tell quiet samples from others.
    above = (values - least[:, None]) > 0.5 * height[:, None]
    width = max(float(median(above.sum(axis=1))) / 2.3548, 0.5)
    quiet = np.arange(values.shape[1]) < (peak - QUIET * width)[:, None]
    number = quiet.sum(axis=1)
    used = number >= 3
    if not used.any():
        level = float(median(least))
        return OutgoingReference(width, 1.0, 1.0, level, 0.0) if median(height) > LEAST_HEIGHT else None
    means = np.where(quiet, values, 0).sum(axis=1)[used] / number[used]
    rest = np.where(quiet[used], values[used] - means[:, None], 0)
    freedom = float((number[used] - 1).sum())
    noise = max(float(np.sqrt((rest**2).sum() / freedom)), QUANTISATION_STD)
    level = float(median(means))
    # Against the level of all: against its own, the correlation of a few samples is always negative.
    away = np.where(quiet[used], values[used] - level, 0)
    gain, power = 1.0, max((away**2).sum(), 1e-12)
    for lag in range(1, MOST_LAGS + 1):
        both = quiet[used, lag:] & quiet[used, :-lag]
        if np.count_nonzero(both) >= 100:
            product = np.where(both, away[:, lag:] * away[:, :-lag], 0).sum() / both.sum()
            gain += 2 * max(float(product * quiet[used].sum() / power), 0.0)
    gain = float(np.clip(gain, 1.0, 1 + 2 * MOST_LAGS))
    within = noise**2 * gain / float(median(number[used]))
    total = float(MAD_TO_STD * median(np.abs(means - level))) ** 2
    spread = float(np.sqrt(max(total - within, 0.0)))
    return OutgoingReference(width, noise, gain, level, spread) if median(height) > LEAST_HEIGHT * noise else None


def measure_outgoing(samples: np.ndarray, reference: OutgoingReference) -> OutgoingPulses:
    """Measure outgoing pulses.

    Parameters
    ----------
    samples : unsigned integers (n, s), count
        Recordings of one length.
    reference : OutgoingReference

    Returns
    -------
    OutgoingPulses

    Notes
    -----
    The height is that of a parabola through the logarithms of the three largest samples, which is exact for a
    Gaussian. The energy is the sum from BEFORE widths before the peak to AFTER widths behind it; samples at the ends
    count in part, so that the sum does not depend on where the peak lies between two samples. What a recording cuts off
    is as much as half a width of its last sample, which is in the error.
    """
    values = samples.astype(np.float32)
    n, s = values.shape
    clipped = (values >= reference.top).any(axis=1)
    rows, place = np.arange(n), np.arange(s, dtype=np.float32)
    peak = np.clip(np.argmax(values, axis=1), 1, max(s - 2, 1)) if s > 2 else np.zeros(n, int)
    # Quiet samples of each shot, drawn to the level of all shots.
    quiet = np.arange(values.shape[1]) < (peak - QUIET * reference.width)[:, None]
    number = quiet.sum(axis=1)
    mean = np.where(quiet, values, 0).sum(axis=1, dtype=np.float64) / np.maximum(number, 1)
    within = reference.noise**2 * reference.gain / np.maximum(number, 1)
    share = np.where(number > 0, reference.spread**2 / (reference.spread**2 + within), 0.0)
    level = reference.level + share * (mean - reference.level)
    variance = np.where(number > 0, share * within, reference.spread**2)
    values -= level.astype(np.float32)[:, None]
    three = np.stack([values[rows, np.clip(peak + step, 0, s - 1)] for step in (-1, 0, 1)]).astype(np.float64)
    low, top, high = log(np.maximum(three, 0.5 * reference.noise))
    bend = low + high - 2 * top
    shift = np.where(bend < 0, 0.5 * (low - high) / np.minimum(bend, -1e-9), 0.0)
    shift = np.clip(shift, -1.0, 1.0)
    amplitude = exp(top - 0.25 * (low - high) * shift)
    # Of what is clipped the largest sample is the first: its middle, between the places of half its height, counts.
    half = 0.5 * values.max(axis=1)
    sides = []
    for mirrored in (values, values[:, ::-1]):
        first = np.clip(np.argmax(mirrored > half[:, None], axis=1), min(1, s - 1), None)
        step = np.maximum(mirrored[rows, first] - mirrored[rows, first - 1], 1e-6)
        sides.append(first - (mirrored[rows, first] - half) / step)
    time = np.where(clipped, 0.5 * (sides[0] + (s - 1) - sides[1]), peak + shift)
    lag = place - time.astype(np.float32)[:, None]
    weight = np.clip(lag + np.float32(BEFORE * reference.width + 0.5), 0, 1)
    weight *= np.clip(np.float32(AFTER * reference.width + 0.5) - lag, 0, 1)
    energy = (values * weight).sum(axis=1, dtype=np.float64)
    total = weight.sum(axis=1, dtype=np.float64)
    squares = (weight * weight).sum(axis=1, dtype=np.float64)
    cut = 0.5 * reference.width * np.maximum(values[:, -1], 0.0)
    energy_error = np.sqrt(reference.noise**2 * reference.gain * squares + variance * total**2 + cut**2)
    # Of the parabola: half of the variance by the samples beside the peak, half by its bend where it lies between two.
    time_error = reference.width**2 * reference.noise / amplitude
    amplitude_error = np.sqrt((PEAK_ERROR * reference.noise) ** 2 + variance)
    seen = (amplitude > LEAST_HEIGHT * reference.noise) & (energy > 0)
    measures = (energy, amplitude, time, level, energy_error, amplitude_error, time_error)
    known = OutgoingPulses(*(np.where(seen & ~clipped, measure, np.nan) for measure in measures))
    return known._replace(time=np.where(seen, time, np.nan))
