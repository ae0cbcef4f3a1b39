"""Slow, plain references for kernels/signal: noise, defects, runs and profiles of one waveform after the other."""


import naive
import numpy as np
from scipy.linalg import toeplitz

from wavebatch.kernels.signal import noise


def widen_after(mask, reach):
    """Boolean (s, n) with `reach` samples marked after every true one."""
    wide = np.zeros_like(mask)
    for i, w in zip(*np.nonzero(mask), strict=True):
        wide[i : i + reach + 1, w] = True
    return wide


def find_quiet(signal, limit, reach, recovery=0):
    """Samples far from signal, and far behind strong signal."""
    smoothed = np.abs(np.stack([naive.smooth_121(column) for column in signal.T], axis=1))
    busy = naive.widen(smoothed > limit, reach)
    if recovery > reach:
        busy |= widen_after(smoothed > np.float32(limit) * np.float32(3), recovery)
    return ~busy


def add_up(values):
    """Sums over the samples, one after the other, in the type of the values."""
    total = np.zeros(values.shape[1], values.dtype)
    for row in values:
        total = total + row
    return total


def find_spikes(above, std, width):
    """(s, n) True where no pulse of this width explains a sample: far above both neighbours, or below both sides."""
    drop = 1.5 * (1 - np.exp(-0.5 / width**2))
    spikes = np.zeros(above.shape, bool)
    for w, y in enumerate(above.T.astype(float)):
        for i in range(1, len(y) - 1):
            high = max(y[i - 1], y[i + 1])
            spikes[i, w] = y[i] - high > 4.5 * std + drop * max(y[i], 0) and y[i] > 5.5 * std
            if not 2 <= i < len(y) - 2:
                continue
            sides = []
            for near, far in ((y[i - 1], y[i - 2]), (y[i + 1], y[i + 2])):
                falls = np.exp(-1.5 / width**2) * near / max(near, far) if near > 0 else 1.0
                sides.append(near * falls)
            spikes[i, w] |= min(sides) - y[i] > 6.5 * std + drop * max(high, 0)
    return spikes


def find_level(y, std, reach, limit=4.0, recovery=0):
    """Level of one waveform from itself alone, and its quiet samples."""
    level = sorted(y)[len(y) // 4]
    width = limit * np.sqrt(6) / 4 * std + 0.25
    quiet = np.zeros(len(y), bool)
    for extra in (std, 0.0, 0.0):
        quiet = find_quiet((y - level)[:, None], width + extra, reach)[:, 0]
        level += (y - level)[quiet].mean() if quiet.any() else 0.0
    if recovery > reach:
        clear = find_quiet((y - level)[:, None], width, reach, recovery)[:, 0]
        if clear.sum() >= 4:
            return level + (y - level)[clear].mean(), clear
    return level, quiet


def measure_covariance(signal, quiet, lags, mirrored=None):
    """Sill, and what is left of it at lags 1, 2, ...: half the mean square steps of quiet samples so far apart.

    mirrored: pairs at places of its first mask do not count, those at places of its second one twice; those at both
    as the pairs at places of the second mask alone over those at places of the first one alone.
    """
    half, pairs = [], []
    most = 48 if signal.shape[1] >= 100 else lags
    for lag in range(1, min(most, len(signal) - 1) + 1):
        if lag > lags and min(half[-4:]) <= max(half[-8:-4]):
            break
        found = [(w, i) for w in range(signal.shape[1]) for i in range(len(signal) - lag)
                 if quiet[i, w] and quiet[i + lag, w]]  # fmt: skip
        kinds = [(False, False)] * len(found)
        if mirrored is not None:
            kinds = [tuple(bool(mask[i, w] or mask[i + lag, w]) for mask in mirrored) for w, i in found]
        share = min(kinds.count((False, True)) / max(kinds.count((True, False)), 1), 1.0)
        counts = {(False, False): 1.0, (True, False): 0.0, (False, True): 2.0, (True, True): share}
        weights = np.array([counts[kind] for kind in kinds])
        steps = np.array([signal[i + lag, w] - signal[i, w] for w, i in found], np.float64)
        half.append(0.5 * np.average(np.square(steps), weights=weights))
        pairs.append(weights.sum())
    far = len(half) // 2
    sill = np.average(half[far:], weights=pairs[far:])
    rest = sill - np.array(half)
    return np.r_[sill, np.where(np.abs(rest) > noise.CHANCE * sill / np.sqrt(pairs), rest, 0.0)]


def measure_recovery(signal, noise, reach, limit):
    """Samples after strong signal until which quiet samples move baselines away from those before the signal."""
    s, n = signal.shape
    above = signal - noise.level
    width = limit * np.hypot(np.sqrt(6) / 4 * noise.std, min(noise.spread, noise.std)) + 0.25
    quiet = find_quiet(above, width, reach)
    strong = np.abs(np.stack([naive.smooth_121(column) for column in above.T], axis=1)) > 3 * width
    known = []
    for w in range(n):
        before = next((i for i in range(s) if not quiet[i, w]), s)
        if before >= 4 and strong[:, w].any():
            known.append((above[:, w].max(), w, before))
    if len(known) < 100:
        return 0
    middle = np.median([peak for peak, _, _ in known])
    known = [(w, before) for peak, w, before in known if peak >= middle]
    alone = min(noise.spread, noise.std / np.sqrt(np.median([before for _, before in known])))
    least = min(max(alone, 0.1), 0.2) * max(noise.std, 1.0)
    step = max(reach, 1)
    for after in range(0, s + step, step):
        moved = []
        for w, before in known:
            used = above[:before, w].tolist()
            last = None
            for i in range(s):
                last = i if strong[i, w] else last
                if last is not None and quiet[i, w] and (i - last) // step >= after // step:
                    used.append(above[i, w])
            moved.append(np.mean(used) - np.mean(above[:before, w]))
        if abs(np.mean(moved)) <= max(least, 4 * np.std(moved) / np.sqrt(len(moved))):
            return after
    return s // step * step + step


def colour_factors(correlation, *columns):
    """Errors of a white-weighted fit in coloured noise over those in white noise: by the covariance of its result."""
    size = len(columns[0])
    colour = toeplitz(np.r_[1.0, correlation, np.zeros(size)][:size])
    rows = np.concatenate([np.linalg.pinv(np.stack(chosen, axis=1)) for chosen in (columns[:1], columns)])
    return tuple(np.sqrt(np.diag(rows @ colour @ rows.T) / np.diag(rows @ rows.T)))


def fit_factors(joint, by_amplitude, by_time, taps, correlation):
    """The same of a fit that may whiten, with the energy; then what a level that is 1 too high does: by matrices."""
    size = joint.shape[1]
    taps = np.ones(1) if taps is None else taps
    white = sum(np.eye(size + len(taps) - 1, size, -later) * tap for later, tap in enumerate(taps))
    changes = np.array([[1, 0, by_amplitude], [0, 1, by_time], [0, 0, 1], [1, 0, 1]])
    rows = changes @ np.linalg.pinv(white @ joint.T)
    weights, given = rows @ white, np.sum(rows * rows, axis=1)
    colour = toeplitz(np.r_[1.0, correlation, np.zeros(size)][:size])
    return np.r_[np.diag(weights @ colour @ weights.T) / given, weights.sum(axis=1) / np.sqrt(given)]


def wiener(waveform, taps, noise_to_signal):
    """One waveform deconvolved by the linear estimate of least mean square error for white signal and noise."""
    pulse = naive.pulse_matrix(len(waveform), taps)
    inverse = pulse.T @ np.linalg.inv(pulse @ pulse.T + noise_to_signal * np.eye(len(waveform)))
    return inverse @ waveform
