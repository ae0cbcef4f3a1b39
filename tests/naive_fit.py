"""The slow twin of kernels/c: one waveform, NumPy and scipy in float64, as docs/algorithms.md 2.3 and 4.2 say it."""

import naive
import numpy as np
from scipy.optimize import brentq

from wavebatch.core.echoes import EchoFlag
from wavebatch.kernels.fit.decompose import AS_FITTED, STRETCHED, _as_problem
from wavebatch.kernels.fit.learn_pulse import fit_bounded
from wavebatch.kernels.library import call

GAIN_121 = np.sqrt(6.0) / 4.0


def promise_echoes(samples, echoes, clusters, settings):
    """What the kernel says: fall of chi2 that one more echo promises beside those of each cluster, which are the fit.

    Runs do not ask; it shows what `propose` of the kernel finds."""
    promise = np.zeros(len(clusters.number))
    call("promise_echoes", *_as_problem(samples, echoes, clusters, settings), promise)
    return promise


def whiten(n, clipped, near, far):
    """Matrix (n, n) that whitens noise of which each sample is near and far shares of the two before it, and new.

    By the covariance of each run of samples that are not clipped; clipped ones stand alone."""
    rho = [1.0, near / (1 - far)]
    while len(rho) < n:
        rho.append(near * rho[-1] + far * rho[-2])
    white, begin = np.eye(n), 0
    for end in [*np.flatnonzero(clipped), n]:
        lag = np.abs(np.subtract.outer(np.arange(end - begin), np.arange(end - begin)))
        white[begin:end, begin:end] = np.linalg.inv(np.linalg.cholesky(np.array(rho)[lag]))
        begin = end + 1
    return white


def free_level(white, clipped, error):
    """Matrix (n, n) that whitens noise to which the error of a level adds: this over the noise; by its eigenvalues."""
    ones = white @ np.where(clipped, 0.0, 1.0)
    values, vectors = np.linalg.eigh(np.eye(len(ones)) + error**2 * np.outer(ones, ones))
    return vectors @ np.diag(values**-0.5) @ vectors.T @ white


def fit_stack(stack, components, weight):
    """Twin of kernels/c/stack.h: weight, delay and sigma of each Gaussian (c, 3), fitted between their bounds."""
    start = np.ravel(components).astype(float)
    width, end = start[2], stack.lag[-1]

    def earliest(sigma):
        return np.minimum(np.maximum(-2.0 * width, 2 * sigma - 4.0 * width), end - width)

    def as_delays(p):
        first = earliest(p[2::3])
        return np.stack([p[::3], first + p[1::3] * (end - first), p[2::3]], axis=1)

    def misfit(p):
        drawn = sum(w * np.exp(-0.5 * ((stack.lag - d) / s) ** 2) for w, d, s in as_delays(p))
        return (drawn - stack.value) * weight

    first = earliest(start[2::3])
    start[1::3] = (start[1::3] - first) / (end - first)
    low, high = (np.tile(side, len(start) // 3) for side in ([-0.3, 0.0, 0.35 * width], [2.0, 1.0, 12.0 * width]))
    start = np.clip(start, low, high)
    return as_delays(fit_bounded(misfit, lambda p: naive.differentiate(misfit, p, 1e-6), start, low, high, 200))


def slopes(p, x, **shape):
    """Derivatives of the model by amplitudes, times and widths, (L, 3 k)."""
    return naive.differentiate(lambda flat: naive.model(flat.reshape(3, -1), x, **shape), p, 1e-4)


def moments(p, x, residual, std, white=None, shape=None):
    """h3 and h4 of the residual around each Gaussian, (k,) both; white: of directions; shape: less what fits take."""
    found = []
    fitted = None if shape is None else white @ slopes(p, x, **shape)
    for _, t, s in p.T:
        z = np.clip((x - t) / s, -5, 5)
        bell = np.exp(-0.5 * ((x - t) / s) ** 2)
        before = fitted
        for direction in ((8 * z**3 - 12 * z) * bell, (16 * z**4 - 48 * z**2 + 12) * bell):
            direction = direction if white is None else white @ direction
            if shape is not None:
                direction = direction - before @ np.linalg.lstsq(before, direction, rcond=None)[0]
                before = np.c_[before, direction]
            found.append(direction @ residual / np.sqrt(max(direction @ direction, 1e-12)) / std)
    return np.array(found).reshape(-1, 2).T


def new_pulse(x, i, s):
    """A new echo of amplitude 1 at sample i."""
    return np.where(np.abs(x - x[i]) <= np.ceil(3 * s.width_ref), np.exp(-0.5 * ((x - x[i]) / s.width_ref) ** 2), 0)


def is_misfit(p, x, residual, std, s, white=None, shape=None):
    """Whether the residual holds more than noise."""
    if s.whitening is not None:
        new = [white @ new_pulse(x, i, s) for i in range(1, len(x) - 1)]
        highest = max(one @ residual / np.sqrt(one @ one) for one in new)
        h3, h4 = moments(p, x, residual, std, white, shape)
        return highest > s.gate_residual * std or (h3**2 + h4**2).max() > s.gate_hermite
    smooth = (residual[:-2] + 2 * residual[1:-1] + residual[2:]) / 4
    h3, h4 = moments(p, x, residual, std, white)
    return smooth.max(initial=0) > s.gate_residual * GAIN_121 * std or (h3**2 + h4**2).max() > s.gate_hermite


def propose(p, x, residual, std, s, shape, white=None):
    """Start of the fit with one echo more, and the fall of chi2 that it promises."""
    unit = np.eye(len(x)) if white is None else white
    jacobian = unit @ slopes(p, x, **shape)
    most = max(np.sum((unit @ new_pulse(x, i, s)) ** 2) for i in range(len(x)))
    best, place, height, change = 0.0, 0, 0.0, np.zeros(p.size)
    for i in range(len(x)):
        new = unit @ new_pulse(x, i, s)
        shared = np.linalg.lstsq(jacobian, new, rcond=None)[0]
        left = new - jacobian @ shared
        energy, onto = left @ left, max(left @ residual, 0.0)
        if energy > 0.03 * most and onto**2 / energy > best:
            best, place, height, change = onto**2 / energy, i, onto / energy, shared
    da, dt, ds = -height * change.reshape(p.shape)
    a, t, w = p
    ref = s.width_ref
    old = np.array([np.maximum(a + da, 0.2 * a), t + np.clip(dt, -ref, ref), w + np.clip(ds, -0.4 * w, 0.3 * w)])
    start, promise = np.c_[old, [height, x[place], ref]], best / std**2
    h3, h4 = moments(p, x, residual, std, white, None if s.whitening is None else shape)
    gain = np.where(h4 < 0, h3**2 + h4**2, 0.0)
    j = int(np.argmax(gain))
    if gain[j] > promise:
        narrow = min(w[j], 1.1 * ref)
        apart, half = max(np.sqrt(w[j] ** 2 - narrow**2), 0.5 * w[j]), 0.5 * a[j] * w[j] / narrow
        start, promise = np.c_[p, [half, t[j] + apart, narrow]], gain[j]
        start[:, j] = half, t[j] - apart, narrow
    return start, promise


def errors_of(p, x, std, prior, used, shape, known=0.0, white=None):
    """Standard deviations (3, k) with what is known of the widths, and of the amplitudes (k,): one over variance."""
    jacobian = slopes(p, x, **shape) * used[:, None] / std
    jacobian = jacobian if white is None else white @ jacobian
    fisher = jacobian.T @ jacobian
    k = p.shape[1]
    fisher[np.arange(k), np.arange(k)] += known
    if prior:
        for j in range(k):
            fisher[2 * k + j, 2 * k + j] += (p[2, j] < prior[0] or prior[2]) / prior[1] ** 2
    return np.sqrt(np.diag(np.linalg.pinv(fisher))).reshape(3, k)


def is_resolved(p, errors):
    order = np.argsort(p[1])
    gap, error = np.diff(p[1][order]), errors[1][order]
    return (p[0] > 0).all() and (gap > 0.25 * np.hypot(error[1:], error[:-1])).all()


def decompose(y, std, start, s, clip=np.inf, white=None, **shape):
    """Parameters (3, k), errors and chi2 of one window; s: Settings, whose widths, gates and acceptance count."""
    best = find_echoes(y, std, start, s, clip, white, **shape)
    if s.thorough and best[0].shape[1] > 1:
        best = join_broad(y, std, best, s, clip, white, **shape)
    return leave_out_unknown(y, std, best, s, clip, white, **shape) if s.known else best


def find_echoes(y, std, start, s, clip, white, **shape):
    """The same before echoes that are not known are left out."""
    first = grow(y, std, start, s, (s.width_low, s.width_high), clip, white, **shape)
    fall = least_fall(first[0], std, s)
    if not may_grow(y, s) or first[2] - len(y) < fall:
        return first
    widths = max(s.width_low, s.width_ref / 1.1), min(s.width_high, s.width_ref * 1.1)
    known = (s.width_ref, 0.02 * s.width_ref, True) if misses_echoes(y, first[2], fall, s) else None
    narrow = grow(y, std, start, s, widths, clip, white, known, **shape)
    second = grow(y, std, narrow[0], s, (s.width_low, s.width_high), clip, white, **shape)
    better = second[2] + fall * (second[0].shape[1] - first[0].shape[1]) < first[2]
    return second if better else first


def join_broad(y, std, fit, s, clip, white, **shape):
    """One echo broader than others may be, where it explains the samples as well as all of the fit."""
    p, _, chi2 = fit
    share = p[0] * p[2] / np.sum(p[0] * p[2])
    time = share @ p[1]
    width = np.sqrt(share @ (p[2] ** 2 + (p[1] - time) ** 2))
    target = chi2 + (p.shape[1] - 2) * s.acceptance + least_fall(p, std, s)
    if width < s.width_high:
        return fit
    one = np.array([[np.sum(p[0] * p[2]) / width], [time], [width]])
    wide = s._replace(grow=False)
    widths = s.width_low, max(s.width_high, 100 * s.width_ref)
    found = grow(y, std, one, wide, widths, clip, white, **shape)
    return found if found[2] < target else fit


def leave_out_unknown(y, std, fit, s, clip, white, **shape):
    """The fit without the echoes whose amplitude is below `known` errors and without which chi2 rises too little."""
    p, errors, chi2 = fit
    x, k = np.arange(float(len(y))), p.shape[1]
    low, high = (np.array([a, t, w])[:, None] for a, t, w in ((0, -3, s.width_low), (1e12, len(y) + 2, s.width_high)))
    known, before = np.zeros(k), p[1]

    def prior_of(k):
        return (s.width_ref, s.prior_spread, False) if s.prior_spread and k > 1 else None

    def find_errors(p, known):
        used = ~((y >= clip) & (y - naive.model(p, x, **shape) <= 0))
        return errors_of(p, x, std, prior_of(p.shape[1]), used, shape, known, white)

    while p.shape[1] > 1 and (known == 0).any():
        j = int(np.argmin(np.where(known == 0, p[0] / errors[0], np.inf)))
        if p[0, j] >= s.known * errors[0, j]:
            break
        start = np.delete(p, j, axis=1)
        less, rest = naive.fit(
            y, x, std, start, low, high, clipped=y >= clip, prior=prior_of(p.shape[1] - 1), white=white, **shape
        )
        if rest - chi2 < least_fall(less, std, s):
            p, chi2, before, known = less, rest, np.delete(before, j), np.zeros(p.shape[1] - 1)
        else:
            known[j] = max((2 / p[0, j]) ** 2 - 1 / errors[0, j] ** 2, 1e-300)
        errors = find_errors(p, known)
    errors[1] = np.hypot(errors[1], p[1] - before)
    return p, errors, chi2


def least_fall(p, std, s):
    """Fall of chi2 that one more echo needs."""
    return s.acceptance + s.misfit**2 * np.sqrt(np.pi) * np.sum(p[0] ** 2 * p[2]) / std**2


def may_grow(y, s):
    return s.grow and len(y) <= s.max_echoes * 10 * s.width_high


def misses_echoes(y, chi2, fall, s):
    return s.thorough and chi2 - len(y) > 9 * fall


def grow(y, std, start, s, widths, clip, white=None, known=None, **shape):
    """The same from one start, with widths within these two; known: prior of them."""
    x = np.arange(float(len(y)))
    clipped = y >= clip
    low = np.array([0.0, -3.0, widths[0]])[:, None]
    high = np.array([1e12, len(y) + 2.0, widths[1]])[:, None]
    best, target, missed = None, np.inf, False
    for _ in range(20):
        prior = known or ((s.width_ref, s.prior_spread, False) if s.prior_spread and start.shape[1] > 1 else None)
        p, chi2 = naive.fit(y, x, std, start, low, high, clipped=clipped, prior=prior, white=white, **shape)
        if missed and start.shape[1] == best[0].shape[1] + 1 and not chi2 < target:
            start = np.c_[best[0], start[:, -1] * [0.25, 1, 1]]
            p, chi2 = naive.fit(y, x, std, start, low, high, clipped=clipped, prior=prior, white=white, **shape)
        if not chi2 < target:
            return best
        outside = np.maximum(np.maximum(-p[1], p[1] - x[-1]), 0) / p[2]
        height = p[0] * np.exp(-0.5 * outside**2)
        if p.shape[1] > 1 and height.min() <= std:
            start = np.delete(p, np.argmin(height), axis=1)
            continue
        residual = y - naive.model(p, x, **shape)
        used = ~(clipped & (residual <= 0))
        residual = residual * used if white is None else white @ (residual * used)
        errors = errors_of(p, x, std, prior, used, shape, white=white)
        if best is not None and not is_resolved(p, errors):
            return best
        best = p, errors, chi2
        if not may_grow(y, s) or p.shape[1] >= s.max_echoes or not is_misfit(p, x, residual, std, s, white, shape):
            return best
        start, promise = propose(p, x, residual, std, s, shape, white)
        fall = least_fall(p, std, s)
        missed = misses_echoes(y, chi2, fall, s)
        if not promise > 0.5 * fall:
            return best
        target = chi2 - fall
    return best


def measure(shape, width):
    """Peak and the full width at half of it, of a sum of Gaussians: on a fine grid, by root finding."""
    def value(x):
        return naive.pulse(x, 0.0, width, **shape)

    grid = np.linspace(-6 * width, 6 * width, 6001)
    top = grid[np.argmax(value(grid))]
    half = value(top) / 2
    left, right = (
        brentq(lambda x: value(x) - half, *sorted((top, next(g for g in side if value(g) < half))))
        for side in (grid[grid < top][::-1], grid[grid > top])
    )
    return float(value(top)), right - left


def relative_energy_errors(parameters, errors, shared):
    """Relative errors of amplitude times width of echoes (m, 3), with the covariance of both (m, 2)."""
    found = []
    for (amplitude, _, width), (amplitude_err, _, width_err), (both, _) in zip(parameters, errors, shared, strict=True):
        variance = (amplitude_err / amplitude) ** 2 + (width_err / width) ** 2 + 2 * both / (amplitude * width)
        found.append(np.sqrt(np.maximum(variance, 0)))
    return np.array(found)


def describe_whole(whole, fitted, error, shared):
    """Amplitude, time and width of one whole echo, and their errors."""
    value, value_error = np.array(fitted), np.array(error)
    if whole.kind == AS_FITTED:
        return value, value_error
    amplitude, _, width = fitted
    delay, by_width = whole.datum, 0.0
    if whole.kind == STRETCHED:
        ratio = max(width / whole.ref, whole.least)
        delay = whole.datum * whole.ref * (ratio + 1 / (ratio * ratio) - 1)
        by_width = whole.datum * (1 - 2 / (ratio * ratio * ratio))
    value[1] += delay
    variance = error[1] * error[1] + (by_width * error[2]) * (by_width * error[2]) + 2 * by_width * shared[1]
    value_error[1] = np.sqrt(np.maximum(variance, 0))
    if whole.kind == STRETCHED:
        return value, value_error
    table = whole.wide if width > whole.near[-1, 0] else whole.near
    peak, slope, sigma, steep = (float(np.interp(width, table[:, 0], table[:, i])) for i in range(1, 5))
    by_width = amplitude * slope
    own, other = peak * error[0], by_width * error[2]
    value[::2] = amplitude * peak, sigma
    variance = own * own + other * other + 2 * peak * by_width * shared[0]
    value_error[::2] = np.sqrt(np.maximum(variance, 0)), error[2] * abs(steep)
    return value, value_error


def keep(clusters, solution, whole, factors, std, spacing, length, significance, level_err=None):
    """Rows of the echoes that are kept, as tuples in the order of the columns of a table of echoes."""
    rows, energies = [], relative_energy_errors(solution.parameters[:, :3], solution.errors[:, :3], solution.shared)
    for i, c in enumerate(np.repeat(np.arange(len(solution.number)), solution.number)):
        fit = solution.parameters[i, :3], solution.errors[i, :3], solution.shared[i]
        (amplitude, time, width), errors = describe_whole(whole, *fit)
        errors = errors * factors[i, :3]
        noise = np.float32(significance) * std[clusters.waveform[c]]
        strong = amplitude * amplitude * width * np.sqrt(np.pi) >= noise * noise
        if level_err is not None:
            ratio = float(level_err[clusters.waveform[c]]) / float(std[clusters.waveform[c]])
            ratio = ratio * ratio / (1 + ratio * ratio * max(clusters.high[c] - clusters.low[c], 5 * width))
            rest = amplitude * amplitude * width * (np.sqrt(np.pi) - 2 * np.pi * width * ratio)
            strong &= rest >= 15 * float(std[clusters.waveform[c]]) ** 2
        if not (strong and -0.5 * width <= time <= length - 1 + 0.5 * width and np.isfinite(errors).all()):
            continue
        flags = EchoFlag(0)
        flags |= EchoFlag.NOT_CONVERGED if not solution.converged[c] else EchoFlag(0)
        flags |= EchoFlag.AT_BOUND if solution.at_bound[i] else EchoFlag(0)
        flags |= EchoFlag.OVERLAPPED if solution.number[c] > 1 else EchoFlag(0)
        rows.append((clusters.waveform[c], time * spacing, amplitude, width * spacing, errors[1] * spacing, errors[0],
                     errors[2] * spacing, energies[i] * factors[i, 3], solution.misfit[i], int(flags), i))  # fmt: skip
    return rows
