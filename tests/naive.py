"""Slow, plain references for the fast kernels: loops over waveforms, scipy per problem, differences for derivatives."""

import numpy as np
import scipy  # its parts load when they are first asked for
from scipy.optimize import least_squares


def smooth_121(waveform):
    """[1 2 1]/4 along one waveform, ends repeated."""
    last = len(waveform) - 1
    return np.array(
        [(waveform[max(i - 1, 0)] + 2 * waveform[i] + waveform[min(i + 1, last)]) / 4 for i in range(last + 1)]
    )


def correlate_symmetric(waveform, taps):
    """One waveform correlated with a symmetric filter given by its half, zero outside."""
    whole = np.convolve(np.asarray(waveform, np.float64), np.r_[taps[:0:-1], taps])
    return whole[len(taps) - 1 :][: len(waveform)]


def find_peaks(signal, threshold):
    """(waveform, sample) of local maxima of signal (s, n) above the threshold; a plateau counts at its first sample.

    The first sample must be above its one neighbour; a constant waveform has no peak.
    """
    s, n = signal.shape
    threshold = np.broadcast_to(threshold, n)
    found = []
    for w in range(n):
        for i in range(s):
            y = signal[i, w]
            before = i - 1
            after = i + 1
            while after < s and signal[after, w] == y:
                after += 1
            starts = signal[before, w] < y if before >= 0 else after == 1 < s
            ends = after >= s or signal[after, w] < y
            if starts and ends and y > threshold[w]:
                found.append((w, i))
    return found


def widen(mask, reach):
    """Boolean (s, n) with `reach` samples marked around every true one."""
    wide = np.zeros_like(mask)
    for i, w in zip(*np.nonzero(mask), strict=True):
        wide[max(i - reach, 0) : i + reach + 1, w] = True
    return wide


def find_runs(signal, level):
    """(waveform, first, one behind the last) of every run of signal (s, n) above level (n,)."""
    edges = np.diff(np.pad(signal > level, ((1, 1), (0, 0))).astype(int), axis=0)
    return [
        (w, int(start), int(end))
        for w, column in enumerate(edges.T)
        for start, end in zip(np.flatnonzero(column > 0), np.flatnonzero(column < 0), strict=True)
    ]


def match_returns(echo_waveform, echo_time, return_waveform, return_time, tolerance):
    """Greedy pairs by distance, each echo and each return once: the row of the return per echo, -1 without one."""
    pairs = []
    for i, (w, t) in enumerate(zip(echo_waveform, echo_time, strict=True)):
        for j, (v, u) in enumerate(zip(return_waveform, return_time, strict=True)):
            if w == v and abs(t - u) <= tolerance:
                pairs.append((abs(t - u), i, j))
    matched = np.full(len(echo_waveform), -1)
    taken = set()
    for _, i, j in sorted(pairs):
        if matched[i] < 0 and j not in taken:
            matched[i] = j
            taken.add(j)
    return matched


def pulse(x, t, s, kappa=0.0, components=()):
    """Unit pulse of docs/algorithms.md 0 and R1 in float64: Gaussian, skewed, or with further components."""
    if abs(kappa) > 0:
        u = 1 + kappa * (x - t) / s
        level = np.log(np.where(u > 0, u, 1.0)) / kappa
        return np.where(u > 0, np.exp(-0.5 * level**2), 0.0)
    total = np.exp(-0.5 * ((x - t) / s) ** 2)
    for weight, delay, extra in components:
        wide = s * s + extra
        total = total + weight * s / np.sqrt(wide) * np.exp(-0.5 * (x - t - delay) ** 2 / wide)
    return total


def model(parameters, x, **shape):
    """Sum of echoes; parameters (3, k): amplitude, time, width."""
    return sum(a * pulse(x, t, s, **shape) for a, t, s in parameters.T)


def fit(y, x, std, start, low, high, clipped=None, weight=None, prior=None, white=None, **shape):
    """Parameters (3, k) and chi2 of one problem by scipy, with the same box, censoring and prior as the batch.

    white: matrix that whitens the noise."""
    k = start.shape[1]

    def residual(flat):
        parameters = flat.reshape(3, k)
        r = y - model(parameters, x, **shape)
        if clipped is not None:
            r = np.where(clipped & (r <= 0), 0.0, r)
        if weight is not None:
            r = r * weight
        r = (r if white is None else white @ r) / std
        if prior is None:
            return r
        width, spread, both = prior
        lack = width - parameters[2]
        return np.concatenate([r, np.where((lack > 0) | both, lack, 0) / spread])

    low, high = (np.broadcast_to(edge, start.shape).ravel() for edge in (low, high))
    inner = np.clip(start.ravel(), low + 1e-9, high - 1e-9)
    result = least_squares(residual, inner, bounds=(low, high), x_scale="jac", ftol=1e-12, xtol=1e-12, gtol=1e-12)
    return result.x.reshape(3, k), 2 * result.cost


def differentiate(function, parameters, step=1e-5):
    """Central differences of function(parameters) -> (L,) by every parameter: (L, p)."""
    flat = np.asarray(parameters, float).ravel()
    columns = []
    for i in range(len(flat)):
        up, down = flat.copy(), flat.copy()
        up[i] += step
        down[i] -= step
        columns.append((function(up) - function(down)) / (2 * step))
    return np.stack(columns, axis=-1)


def fisher_errors(parameters, x, std, **shape):
    """Standard deviations (3, k) from the inverse Fisher matrix, derivatives by differences, and its covariance."""
    jacobian = differentiate(lambda flat: model(flat.reshape(parameters.shape), x, **shape), parameters)
    covariance = np.linalg.inv(jacobian.T @ jacobian) * std**2
    return np.sqrt(np.diag(covariance)).reshape(parameters.shape), covariance


def log_parabola(smooth, at, width):
    """Amplitude, time and width of a peak by a weighted parabola through the logarithms of five smoothed samples.

    Where it fails: 1.1 times the sample, its place, and the given width.
    """
    x = np.array([d for d in range(-2, 3) if 0 <= at + d < len(smooth) and smooth[at + d] > 0.05 * smooth[at]])
    y = smooth[at + x].astype(float)
    c2, c1, c0 = np.polyfit(x, np.log(y), 2, w=y) if len(x) >= 3 else (0.0, 0.0, 0.0)
    if c2 >= -1e-4 or abs(c1 / (2 * c2)) >= 1.5:
        return 1.1 * smooth[at], at, width
    width = np.sqrt(max(-1 / (2 * c2) - 0.5, 0.1))
    return np.exp(c0 - c1**2 / (4 * c2)) * np.sqrt(1 + 0.5 / width**2), at - c1 / (2 * c2), width


def square_differences(waveform, reference):
    """ASDF of one waveform and one reference by its definition, for every lag at which they touch."""
    n, m = len(reference), len(waveform)
    around = np.concatenate([np.zeros(n - 1), waveform, np.zeros(n - 1)])
    return np.array([np.sum((reference - around[lag : lag + n]) ** 2) for lag in range(m + n - 1)])


def find_minima(values):
    """Rows of one function at which it is below the value before and not above the one behind."""
    return [i for i in range(1, len(values) - 1) if values[i] < values[i - 1] and values[i] <= values[i + 1]]


def keep_prominent(values, minima, least):
    """Minima of one function after the least prominent one has been removed again and again while it is below least."""
    minima = list(minima)
    while minima:
        borders = [0, *minima, len(values) - 1]
        prominence = [
            min(max(values[borders[j] : row + 1]), max(values[row : borders[j + 2] + 1])) - values[row]
            for j, row in enumerate(minima)
        ]
        lowest = int(np.argmin(prominence))
        if prominence[lowest] >= least:
            break
        del minima[lowest]
    return minima


def b3_detail(waveform, level):
    """Detail of one waveform: the taps with holes, the ends repeated."""
    after = np.asarray(waveform, float)
    for step in 2 ** np.arange(level):
        before, taps = after, np.zeros(4 * step + 1)
        taps[::step] = np.array([1, 4, 6, 4, 1]) / 16
        after = np.convolve(np.pad(before, 2 * step, mode="edge"), taps, mode="valid")
    return before - after


def pulse_matrix(s, taps):
    """(s, s): column i is the pulse put at sample i, cut off at the ends."""
    return scipy.linalg.convolution_matrix(taps, s)[len(taps) // 2 :][:s]


def richardson_lucy(waveform, taps, background, iterations, accelerate=True):
    """Richardson-Lucy of one waveform with matrices; accelerated as by Biggs and Andrews."""
    pulse = pulse_matrix(len(waveform), taps)
    weight = pulse.sum(axis=0)
    data = np.maximum(waveform + background, 0)
    previous = estimate = np.full(len(waveform), data.mean()) / weight
    before = change = np.zeros(len(waveform))
    for number in range(iterations):
        start = estimate
        if accelerate and number > 1:
            share = np.clip((change @ before) / (before @ before or 1.0), 0, 1)
            start = np.maximum(estimate + share * (estimate - previous), 0)
        previous, estimate = estimate, start * (pulse.T @ (data / (pulse @ start + background))) / weight
        before, change = change, estimate - start
    return estimate


def gold(waveform, taps, iterations):
    """Gold's deconvolution of one waveform with matrices."""
    pulse = pulse_matrix(len(waveform), taps)
    data = np.maximum(waveform, 0)
    estimate = data
    for _ in range(iterations):
        estimate = estimate * (pulse.T @ data) / (pulse.T @ pulse @ estimate)
    return estimate


def power_pulse(x, t, s, power):
    """Generalized Gaussian."""
    return np.exp(-0.5 * np.abs((x - t) / s) ** power)


def compare_halves(xyz):
    """Smallest chance of two planes over six cuts of points around 0: (chance, gain in the sum of squares)."""
    centre = xyz.mean(axis=0)
    axes = np.linalg.svd(xyz - centre, full_matrices=False)[2]
    u, v = xyz @ axes[0], xyz @ axes[1]
    r = (xyz - centre) @ axes[2]
    angle = np.arctan2(v, u)

    def left(rows):
        terms = np.stack([np.ones(len(u)), u, v], axis=1)[rows]
        return np.sum((r[rows] - terms @ np.linalg.lstsq(terms, r[rows], rcond=None)[0]) ** 2)

    whole, best = left(np.ones(len(r), bool)), np.inf
    for cut in range(6):
        one = (angle + np.pi - cut * np.pi / 6) % (2 * np.pi) < np.pi
        if min(one.sum(), (~one).sum()) >= 4:
            best = min(best, left(one) + left(~one))
    noise = best + len(r) * 1e-6
    return min(6 * scipy.stats.f.sf((whole - best) / 3 / (noise / (len(r) - 6)), 3, len(r) - 6), 1.0), whole - best


def fit_slope(across, along, shared):
    """Slope (2,) of `along` over places across (k, 2), and its covariance: points share an error within a scan line."""
    table = np.column_stack([across, np.ones(len(across))])
    solution, *_ = np.linalg.lstsq(table, along, rcond=None)
    left = along - table @ solution
    noise = left @ left / (len(along) - 3)
    spread = np.cov(across.T, bias=True)
    return solution[:2], np.linalg.inv(spread) * (noise / len(along) + shared**2 / 4)
