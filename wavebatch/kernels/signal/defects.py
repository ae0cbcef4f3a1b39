"""What receivers add to waveforms besides noise: spikes of one sample, a pattern of the converter, slopes, transients.

The survey measures which of these a strip has, and stages/clean.py takes them off. Arrays are (s, n), as in `signal`.
Before a change: an echo of the strip's pulse must never look like a defect, at any phase of the samples.
"""

from __future__ import annotations

import numpy as np

from wavebatch.core.order import median, quantiles
from wavebatch.kernels.elementary import exp
from wavebatch.kernels.signal.signal import SMOOTH_GAIN, find_quiet

SPIKE, HEIGHT, HOLE = 4.5, 5.5, 6.5
"""Least height of a spike above its higher neighbour and above the baseline, and least depth of a hole [noise of a
sample]: lower ones are no echoes, and white noise makes one in 10^6 samples.
"""

CURVATURE = 1.5
"""How much more of its height than the system pulse an echo may lose to the next sample, as a factor."""

PERIOD = 4
"""Samples after which a pattern repeats: converters are two or four, which take samples in turn."""

FROM_LINE = 4.0
"""A smoothed sample further from the line than this many standard deviations is signal."""

SEGMENTS = 6
"""Parts of a waveform whose lower quartiles give its first slope."""

LOOK = 8
"""Samples at the start in which transients are looked for; as many after them show what is usual."""

WILD = 1.6
"""Scatter of a sample at the start, over that of later ones, from which it holds transients."""

OFF = 0.5
"""Mean of a sample at the start, in noise, from which it holds transients."""


def find_spikes(above: np.ndarray, std: float, width: float) -> np.ndarray:
    """Single samples that are too high or too low for their neighbours to be part of an echo.

    Parameters
    ----------
    above : float32 (s, n), count
        Waveforms above their baseline.
    std : float, count
        Noise of a sample.
    width : float, samples
        Of the system pulse, at least 1.5.

    Returns
    -------
    bool (s, n)
        Never the first or the last sample.
    """
    drop = np.float32(CURVATURE * (1 - exp(-0.5 / width**2)))
    spikes = np.zeros(above.shape, bool)
    if len(above) < 5:
        return spikes
    middle, left, right = above[1:-1], above[:-2], above[2:]
    high = np.maximum(left, right)
    spikes[1:-1] = middle - high > np.float32(SPIKE * std) + drop * np.maximum(middle, 0)
    spikes[1:-1] &= middle > np.float32(HEIGHT * std)
    # The logarithm of a sum of Gaussians of a width w or more bends down by at most 1 / w^2 at any place. So a sample
    # is at least the square of its neighbour over the next one, reduced by that bend. In a valley between two strong
    # echoes this bound is nearly 0. It is never above the neighbour.
    bend = exp(np.float32(-CURVATURE) / (np.float32(width) * np.float32(width)))
    sides = []
    for near, far in ((above[1:-3], above[:-4]), (above[3:-1], above[4:])):
        falls = np.maximum(near, np.float32(0)) / np.maximum(np.maximum(near, far), np.float32(1e-6))
        sides.append(near * np.where(near > 0, bend * falls, np.float32(1)))
    low = np.minimum(*sides)
    spikes[2:-2] |= low - above[2:-2] > np.float32(HOLE * std) + drop * np.maximum(high, 0)[1:-1]
    return spikes


def fill_spikes(signal: np.ndarray, spikes: np.ndarray) -> None:
    """Replaces spikes by the mean of their neighbours, in place."""
    sample, waveform = np.nonzero(spikes)
    signal[sample, waveform] = 0.5 * (signal[sample - 1, waveform] + signal[sample + 1, waveform])


def find_pattern(signal: np.ndarray, quiet: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean deviation of every PERIOD-th quiet sample from those around it, and its standard error, (PERIOD,) each.

    The mean over one period around a sample holds level, slope and tail, but no pattern.
    """
    half = PERIOD // 2
    inner = len(signal) - 2 * half
    mean, error = np.zeros(PERIOD), np.full(PERIOD, np.inf)
    if inner < PERIOD:
        return mean, error
    around = 0.5 * (signal[:inner] + signal[2 * half :])
    calm = quiet[:inner] & quiet[2 * half :]
    for step in range(1, PERIOD):
        around += signal[step : step + inner]
        calm &= quiet[step : step + inner]
    deviation = signal[half : half + inner] - around / PERIOD
    for phase in range(PERIOD):
        first = (phase - half) % PERIOD
        values = deviation[first::PERIOD][calm[first::PERIOD]]
        if len(values) > 1:
            mean[phase], error[phase] = np.mean(values, dtype=np.float64), np.std(values) / np.sqrt(len(values))
    return mean - mean.mean(), error


def find_transient(above: np.ndarray, std: float) -> int:
    """Samples at the start of the waveforms that jump, in the mean or in many of them; 0 where echoes begin there.

    above: waveforms above their baseline, float32 (s, n).
    """
    if len(above) < 3 * LOOK:
        return 0
    usual = above[LOOK : 2 * LOOK]
    low, middle, high = quantiles(usual, [0.05, 0.5, 0.95])
    spread, centre = max(float(median(high - low)), 2 * std), float(median(middle))
    rises = np.abs(middle - centre).max() > OFF * std + 0.5
    if rises or np.mean(np.abs(usual - middle[:, None]) < 4 * std + 0.5) < 0.8:
        return 0
    first_low, first_high = quantiles(above[:LOOK], [0.05, 0.95])
    inner = np.clip(above[:LOOK], first_low[:, None], first_high[:, None]).mean(axis=1)
    # Light only adds: in a canopy all later samples may have some, where no echo is so early.
    off = np.abs(inner - np.clip(inner, min(centre, 0.0), centre))
    jumps = (first_high - first_low > WILD * spread) | (off > max(OFF * std, 0.3))
    return 0 if jumps.all() else int(np.argmin(jumps))


SEAM_ROWS, SEAM_SPAN, SEAM_REACH = 20, 20.0, 3
"""Waveforms with signal at a seam, their least difference of counts near it, and how near it is [samples]."""

SEAM_SHARE, USUAL_SHARE = 0.95, 0.5
"""Share of them in which the sample is the mean of its neighbours, and how often that is so elsewhere, at most."""

LEAST_RECORDING, MOST_SEAM_VALUES = 12, 1 << 18
"""Samples of a recording at least, and samples of all waveforms in which a seam is looked for."""


def find_seam(samples: np.ndarray) -> int:
    """Sample between two recordings of a packet that was interpolated, not recorded; 0 for none.

    It is the mean of its neighbours, up to rounding, in all waveforms that have signal there; echoes are bent.

    Parameters
    ----------
    samples : uint (n, s), count
        Packets of one length.

    Returns
    -------
    int
        Index of the sample.
    """
    n, s = samples.shape
    values = samples[:: max(n * s // MOST_SEAM_VALUES, 1)]
    values = values.astype(np.int32 if values.dtype.itemsize <= 2 else np.int64)
    if len(values) < SEAM_ROWS or s < 2 * LEAST_RECORDING:
        return 0
    low = high = values
    for step in (1, 2, SEAM_REACH):  # least and largest of 2, 4 and then all 7 values
        low, high = np.minimum(low[:, :-step], low[:, step:]), np.maximum(high[:, :-step], high[:, step:])
    active = high - low >= SEAM_SPAN
    middle = values[:, SEAM_REACH:-SEAM_REACH]
    bend = 2 * middle - values[:, SEAM_REACH - 1 : -SEAM_REACH - 1] - values[:, SEAM_REACH + 1 : 1 - SEAM_REACH]
    number = active.sum(axis=0)
    share = ((np.abs(bend) <= 1) & active).sum(axis=0) / np.maximum(number, 1)
    known = number >= SEAM_ROWS
    at = np.flatnonzero(known & (share >= SEAM_SHARE)) + SEAM_REACH
    at = at[(at >= LEAST_RECORDING) & (at < s - LEAST_RECORDING)]
    return int(at[0]) if len(at) == 1 and median(share[known]) <= USUAL_SHARE else 0


def fit_slopes(
    signal: np.ndarray,
    std: float,
    reach: int,
    missing: np.ndarray | None = None,
    recovery: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """Slope of the baseline of each waveform, from its quiet samples.

    Parameters
    ----------
    signal : float32 (s, n), count
        Waveforms.
    std : float, count
        Noise of a sample.
    reach : int, samples
        Samples this near to signal are not quiet.
    missing : bool (s, n), optional
        Samples that were not recorded.
    recovery : int, samples
        After strong signal, samples in which its tail would look like a slope.

    Returns
    -------
    slope : float64 (n,), count per sample
    error : float64 (n,)
        Standard deviation in white noise; infinite where too few samples are quiet, or only one end of the waveform.
    """
    s = len(signal)
    x = (np.arange(s, dtype=np.float32) - np.float32(0.5 * (s - 1)))[:, None]
    # Level at the middle and slope of each waveform: the median slope between lower quartiles of its parts.
    edges = np.linspace(0, s, SEGMENTS + 1).astype(int)
    parts = [signal[begin:end] for begin, end in zip(edges, edges[1:], strict=False)]
    low = np.stack([np.partition(part, len(part) // 4, axis=0)[len(part) // 4] for part in parts])
    place = (0.5 * (edges[1:] + edges[:-1] - 1) - 0.5 * (s - 1)).astype(np.float32)
    first, second = np.triu_indices(SEGMENTS, 1)
    slope = median((low[second] - low[first]) / (place[second] - place[first])[:, None], axis=0)
    level = median(low - slope * place[:, None], axis=0)
    number = total = np.zeros(signal.shape[1])
    for extra in (2.0, 1.0, 0.0):
        rest = signal - (level + slope * x)
        quiet = find_quiet(rest, np.float32(FROM_LINE * (SMOOTH_GAIN + extra) * std + 0.25), reach, recovery)
        if missing is not None:
            quiet &= ~missing
        number = np.maximum(quiet.sum(axis=0), 1)
        middle = (quiet * x).sum(axis=0) / number
        centred = np.where(quiet, x - middle, np.float32(0))
        total = (centred * centred).sum(axis=0)
        change = (centred * rest).sum(axis=0) / np.maximum(total, 1)
        level = level + np.where(quiet, rest, np.float32(0)).sum(axis=0) / number - change * middle
        slope = slope + change
    enough = (number >= s // 5) & (total > number * (0.15 * s) ** 2)
    error = np.where(enough, std / np.sqrt(np.maximum(total, 1e-9)), np.inf)
    return slope.astype(np.float64), error.astype(np.float64)
