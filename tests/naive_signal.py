"""Slow, plain references for kernels/signal: noise, defects, runs and profiles of one waveform after the other."""

from itertools import groupby

import naive
import numpy as np

from wavebatch.kernels.signal import noise

QUANTISATION_STD = 1 / np.sqrt(12)


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


def find_stretches(mask):
    """(row, first, one behind the last) of every stretch of true samples."""
    found = []
    for row, samples in enumerate(mask):
        at = 0
        for value, run in groupby(samples):
            length = len(list(run))
            if value:
                found.append((row, at, at + length))
            at += length
    return found


def lobe_edges(x, curve, level):
    """Crossings of a level nearest to the highest sample."""
    top = int(np.argmax(curve))
    edges = []
    for step in (-1, 1):
        i = top
        while curve[i] >= level:
            i += step
        share = (level - curve[i]) / (curve[i - step] - curve[i])
        edges.append(x[i] + share * (x[i - step] - x[i]))
    return tuple(edges)


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


def find_pattern(signal, quiet):
    """Mean deviation of samples 0, 1, 2, 3, 0 ... from those within half a period, and its error."""
    deviations = [[], [], [], []]
    s, n = signal.shape
    for w in range(n):
        for i in range(2, s - 2):
            if quiet[i - 2 : i + 3, w].all():
                y = signal[i - 2 : i + 3, w].astype(float)
                deviations[i % 4].append(y[2] - (0.5 * y[0] + y[1] + y[2] + y[3] + 0.5 * y[4]) / 4)
    mean = np.array([np.mean(values) if len(values) > 1 else 0.0 for values in deviations])
    error = np.array([np.std(values) / np.sqrt(len(values)) if len(values) > 1 else np.inf for values in deviations])
    return mean - mean.mean(), error


def find_transient(above, std):
    """Samples at the start whose spread or mean over the waveforms is not that of samples 8 to 15."""
    if len(above) < 24:
        return 0
    usual = [np.quantile(row, [0.05, 0.5, 0.95]) for row in above[8:16]]
    quiet = [
        abs(y - middle) < 4 * std + 0.5 for row, (_, middle, _) in zip(above[8:16], usual, strict=True) for y in row
    ]
    if np.mean(quiet) < 0.8:
        return 0
    spread = max(np.median([high - low for low, _, high in usual]), 2 * std)
    centre = np.median([middle for _, middle, _ in usual])
    if max(abs(middle - centre) for _, middle, _ in usual) > 0.5 * std + 0.5:
        return 0
    for i in range(8):
        low, high = np.quantile(above[i], [0.05, 0.95])
        mean = np.mean([min(max(y, low), high) for y in above[i]])
        if high - low <= 1.6 * spread and abs(mean - centre) <= max(0.5 * std, 0.3):
            return i
    return 0


def fit_slope(y, std, reach, limit=4.0, missing=None, recovery=0):
    """Slope of the baseline of one waveform and its error, by lines through the samples that are quiet about a line."""
    s = len(y)
    x = np.arange(s) - 0.5 * (s - 1)
    missing = np.zeros(s, bool) if missing is None else missing
    edges = [int(s * k / 6) for k in range(7)]
    place = [np.mean(x[a:b]) for a, b in zip(edges, edges[1:], strict=False)]
    low = [sorted(y[a:b])[(b - a) // 4] for a, b in zip(edges, edges[1:], strict=False)]
    pairs = [(low[j] - low[i]) / (place[j] - place[i]) for i in range(6) for j in range(i + 1, 6)]
    slope = np.median(pairs)
    level = np.median([value - slope * at for value, at in zip(low, place, strict=True)])
    error = np.inf
    for extra in (2.0, 1.0, 0.0):
        rest = y - level - slope * x
        width = limit * (np.sqrt(6) / 4 + extra) * std + 0.25
        quiet = find_quiet(rest[:, None], width, reach, recovery)[:, 0] & ~missing
        line = np.polyfit(x[quiet], y[quiet], 1)
        slope, level = line
        size = np.sum((x[quiet] - x[quiet].mean()) ** 2)
        enough = quiet.sum() >= s // 5 and size > quiet.sum() * (0.15 * s) ** 2
        error = std / np.sqrt(size) if enough else np.inf
    return slope, error


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


def keep_longest(missing):
    """All but the first of the longest stretches of recorded samples of each waveform."""
    lost = np.ones_like(missing)
    for w, column in enumerate(missing.T):
        stretches = [(first - end, first, end) for _, first, end in find_stretches(~column[None])]
        if stretches:
            _, first, end = min(stretches)
            lost[first:end, w] = False
    return lost


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


def residual_noise(residual, used, lost, lags):
    """Standard deviation and correlation of limited residuals about their common mean."""
    values = residual[used].astype(float)
    low, middle, high = np.quantile(values, [0.1587, 0.5, 0.8413])
    wide = 7 * max(0.5 * (high - low), QUANTISATION_STD)
    spread = np.sqrt(np.mean([min(max(v - middle, -wide), wide) ** 2 for v in values]))
    limit = 3.5 * max(spread, QUANTISATION_STD)
    kept = np.clip(residual.astype(float) - middle, -limit, limit)
    kept -= kept[used].mean()
    covariance = []
    for lag in range(lags + 1):
        products = [
            kept[w, i] * kept[w, i + lag]
            for w in range(len(kept))
            for i in range(kept.shape[1] - lag)
            if used[w, i] and used[w, i + lag]
        ]
        covariance.append(np.mean(products) + (lost[lag] if lag < len(lost) else 0.0))
    return np.sqrt(covariance[0]), np.array(covariance[1:]) / covariance[0]


def colour_factors(correlation, *columns):
    """Errors of a white-weighted fit in coloured noise over those in white noise: by the covariance of its result."""
    size = len(columns[0])
    colour = np.eye(size)
    for i in range(size):
        for j in range(size):
            lag = abs(i - j)
            if lag:
                colour[i, j] = correlation[lag - 1] if lag <= len(correlation) else 0.0
    factors = []
    for chosen in (columns[:1], columns):
        inverse = np.linalg.pinv(np.stack(chosen, axis=1))
        coloured, white = (np.diag(inverse @ matrix @ inverse.T) for matrix in (colour, np.eye(size)))
        factors += np.sqrt(coloured / white).tolist()
    return tuple(factors)


def wiener(waveform, taps, noise_to_signal):
    """One waveform deconvolved by the linear estimate of least mean square error for white signal and noise."""
    pulse = naive.pulse_matrix(len(waveform), taps)
    inverse = pulse.T @ np.linalg.inv(pulse @ pulse.T + noise_to_signal * np.eye(len(waveform)))
    return inverse @ waveform


def fit_height(profile, waveform, taps, support):
    """One profile scaled so that its sum of pulses has the energy of the waveform over the support."""
    made = (naive.pulse_matrix(len(waveform), taps) @ profile)[support].sum()
    return profile * (max(waveform[support].sum(), 0.0) / made if made > 0 else 0.0)


def refine_peak(waveform, at):
    """Time and height of one peak by a parabola through the logarithms of three samples."""
    if not 0 < at < len(waveform) - 1 or min(waveform[at - 1 : at + 2]) <= 0:
        return at, waveform[at]
    c2, c1, c0 = np.polyfit([-1, 0, 1], np.log(waveform[at - 1 : at + 2]), 2)
    if 2 * c2 >= -1e-12:
        return at, waveform[at]
    shift = min(max(-c1 / (2 * c2), -0.5), 0.5)
    return at + shift, np.exp(c0 + 0.5 * c1 * shift)


def find_reference(samples, quiet_widths=3.5, lags=4):
    """(width, noise, gain, level, spread) of outgoing pulses that rise from a quiet level."""
    samples = samples.astype(float)
    width = max(np.median([sum(y - min(y) > 0.5 * (max(y) - min(y))) for y in samples]) / 2.3548, 0.5)
    quiet = [[v for i, v in enumerate(y) if i < np.argmax(y) - quiet_widths * width] for y in samples]
    quiet = [values for values in quiet if len(values) >= 3]
    noise = np.sqrt(sum(len(v) * np.var(v) for v in quiet) / sum(len(v) - 1 for v in quiet))
    noise = max(noise, QUANTISATION_STD)
    means = [np.mean(v) for v in quiet]
    level = np.median(means)
    variance = np.mean([(v - level) ** 2 for values in quiet for v in values])
    gain = 1.0
    for lag in range(1, lags + 1):
        pairs = [(v[i] - level) * (v[i + lag] - level) for v in quiet for i in range(len(v) - lag)]
        gain += 2 * max(np.mean(pairs) / variance, 0.0) if len(pairs) >= 100 else 0.0
    total = 1.482602 * np.median(np.abs(means - level))
    within = noise**2 * gain / np.median([len(v) for v in quiet])
    return width, noise, gain, level, np.sqrt(max(total**2 - within, 0.0))


def measure_outgoing(y, width, noise, gain, level, spread):
    """Energy, height, place and level of one outgoing pulse, and the errors of the first two; None without a pulse."""
    y = y.astype(float)
    at = min(max(int(np.argmax(y)), 1), len(y) - 2)
    quiet = [v for i, v in enumerate(y) if i < at - 3.5 * width]
    variance = spread**2
    if quiet:
        within = noise**2 * gain / len(quiet)
        share = spread**2 / (spread**2 + within)
        level, variance = level + share * (np.mean(quiet) - level), share * within
    a, b, c = np.log(np.maximum(y[at - 1 : at + 2] - level, 0.5 * noise))
    shift = min(max((a - c) / 2 / (a + c - 2 * b), -1.0), 1.0) if a + c < 2 * b else 0.0
    height, time = np.exp(b - (a - c) * shift / 4), at + shift
    energy = total = squares = 0.0
    for i, value in enumerate(y):
        inside = min(max(i - time + 4 * width + 0.5, 0), 1) * min(max(6 * width + 0.5 - i + time, 0), 1)
        energy, total, squares = energy + inside * (value - level), total + inside, squares + inside**2
    if not (height > 8 * noise and energy > 0):
        return None
    errors = np.sqrt(noise**2 * gain * squares + variance * total**2), np.sqrt((1.1 * noise) ** 2 + variance)
    return energy, height, time, level, *errors
