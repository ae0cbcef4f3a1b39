"""The system pulse from isolated echoes: aligned, stacked, fitted by a sum of Gaussians (docs/algorithms.md R2)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy  # parts of it load when they are first asked for

from wavebatch.kernels.fit.pulse_shape import PulseShape, evaluate_pulse

STEP = 0.2
"""Grid of the stack [samples]."""

MOST_COMPONENTS = 5

GAIN = 0.10
"""Share by which the residual must fall for one more component."""

TRIAL_EVALUATIONS = 25
"""Evaluations after which the starts of one more component are compared."""

DEEPEST = 0.3
"""Largest negative weight of a component: an undershoot. Deeper ones only cancel another component, and such a pair
fits the stack but not an echo that its target has widened."""

EARLIEST = 2.0
"""Widths of the pulse before its peak where a component may still lie: what comes earlier is a layer of constant height
above the ground (canopy, crop), which looks like a pulse before the pulse."""

LOBE = 3.0
"""Widths of the pulse around its peak that a skewed pulse is fitted to."""

ONSET = 4.0
"""Widths of the pulse before its peak before which no component may begin, two of its sigmas before its centre: a broad
one describes a tail, and would lift what comes before the pulse (by 1.7 DN on a strip of RIEGL)."""

LEAST_BIN = 5
"""Samples that a bin of the stack needs."""


class Stack(NamedTuple):
    """Median shape of isolated echoes of amplitude 1, by lag after their centre."""

    lag: np.ndarray
    """[samples], (b,)."""
    value: np.ndarray
    """(b,)."""
    error: np.ndarray
    """Standard error of each value (b,)."""


def stack_pulse(
    signal: np.ndarray,
    amplitude: np.ndarray,
    time: np.ndarray,
    before: float,
    after: float,
    std: float = 0.0,
    first: np.ndarray | int = 0,
) -> Stack:
    """Median of signal (m, s) over amplitude, by lag from `before` samples before each centre to `after` behind it.

    first: sample at which each row of the signal begins, int or int (m,).
    std: error of a sample that counts have without any noise; where they are rounded more coarsely than they scatter,
    the values of a bin may all be equal without being exact.
    """
    least = max(std / float(np.median(amplitude)), 1e-6) if len(amplitude) else 1e-6
    lag = np.reshape(first, (-1, 1)) + np.arange(signal.shape[1]) - time[:, None]
    used = (lag >= -before) & (lag <= after) & np.isfinite(signal)
    values = (signal / amplitude[:, None])[used]
    bins = np.floor((lag[used] + before) / STEP).astype(np.int64)
    order = np.argsort(bins, kind="stable")
    bins, values = bins[order], values[order]
    starts = np.flatnonzero(np.r_[True, np.diff(bins) > 0])
    stack = []
    for begin, end in zip(starts, np.r_[starts[1:], len(bins)], strict=True):
        part = values[begin:end]
        if len(part) >= LEAST_BIN:
            middle = np.median(part)
            spread = 1.4826 * np.median(np.abs(part - middle))
            centre = (bins[begin] + 0.5) * STEP - before
            stack.append((centre, middle, 1.2533 * max(spread, least) / np.sqrt(len(part))))
    return Stack(*np.array(stack).reshape(-1, 3).T)


class PulseFit(NamedTuple):
    """One model of a stack."""

    components: np.ndarray
    """Weight, delay, sigma per component, the strongest first; weight 1 and delay 0 for it (c, 3)."""
    kappa: float
    rms: float
    """Root mean square misfit, in amplitudes."""
    datum: float
    """Delay of the strongest component (or the skewed pulse's peak) in the stack [samples]."""


def fit_gaussians(stack: Stack, width: float, most: int = MOST_COMPONENTS) -> list[PulseFit]:
    """Sums of 1, 2, ... `most` Gaussians fitted to the stack, one more while the misfit falls by a tenth or more."""
    weight = _weights(stack)
    parameters = np.array([1.0, 0.0, width])
    fits: list[PulseFit] = []
    while True:
        parameters = _refine(stack, weight, parameters)
        residual = stack.value - _sum(parameters, stack.lag)
        fit = _as_fit(parameters, float(np.sqrt(np.mean(residual**2))))
        if fits and fit.rms > (1 - GAIN) * fits[-1].rms:
            return fits
        fits.append(fit)
        if len(fits) == most:
            return fits
        parameters = _add_component(stack, weight, parameters, residual)


def fit_skewed(stack: Stack, width: float) -> PulseFit:
    """The skewed pulse of section 0 fitted to the stack."""
    weight = _weights(stack)
    # A tail is no skew: the main lobe decides, all of the stack says how well it fits.
    lobe = np.where(np.abs(stack.lag) < LOBE * width, weight, 0.0)

    def misfit(p: np.ndarray, weight: np.ndarray = lobe) -> np.ndarray:
        t, s = np.array([p[1]]), np.array([p[2]])
        pulse = evaluate_pulse(PulseShape(kappa=float(p[3])), stack.lag[:, None], t, s)[0][:, 0]
        return (p[0] * pulse - stack.value) * weight

    low, high = [0.5, -3 * width, 0.3 * width, -0.6], [2.0, 3 * width, 3 * width, 0.6]
    result = scipy.optimize.least_squares(misfit, [1.0, 0.0, width, 0.02], bounds=(low, high))
    amplitude, delay, sigma, kappa = result.x
    rms = float(np.sqrt(np.mean(misfit(result.x, np.ones_like(weight)) ** 2)))
    return PulseFit(np.array([[1.0, 0.0, sigma]]), float(kappa), rms / amplitude, float(delay))


def _weights(stack: Stack) -> np.ndarray:
    """Inverse errors, none more than four times the typical one, mean 1."""
    weight = 1 / np.maximum(stack.error, 0.25 * np.median(stack.error))
    return weight / weight.mean()


def _sum(parameters: np.ndarray, lag: np.ndarray) -> np.ndarray:
    weight, delay, sigma = parameters.reshape(-1, 3).T
    return np.exp(-0.5 * ((lag[:, None] - delay) / sigma) ** 2) @ weight


def _slopes(parameters: np.ndarray, lag: np.ndarray) -> np.ndarray:
    """Derivatives of `_sum` by weight, delay and sigma of every component (b, 3 c)."""
    weight, delay, sigma = parameters.reshape(-1, 3).T
    z = (lag[:, None] - delay) / sigma
    bell = np.exp(-0.5 * z * z)
    steep = weight * bell * z / sigma
    return np.stack([bell, steep, steep * z], axis=2).reshape(len(lag), -1)


def _refine(stack: Stack, weight: np.ndarray, start: np.ndarray, most: int = 200) -> np.ndarray:
    """The sum of Gaussians fitted from a start, in at most `most` evaluations.

    The parameters are weight, the delay's distance from the earliest that is allowed to its sigma, and sigma.
    """
    width = abs(start[2])
    low = np.tile([-DEEPEST, 0.0, 0.35 * width], len(start) // 3)
    high = np.tile([2.0, stack.lag[-1] + EARLIEST * width, 12.0 * width], len(start) // 3)

    def earliest(sigma: np.ndarray) -> np.ndarray:
        return np.maximum(-EARLIEST * width, 2 * sigma - ONSET * width)

    def plain(p: np.ndarray) -> np.ndarray:
        q = p.copy()
        q[1::3] += earliest(p[2::3])
        return q

    def slopes(p: np.ndarray) -> np.ndarray:
        jacobian = _slopes(plain(p), stack.lag)
        jacobian[:, 2::3] += 2 * (2 * p[2::3] > (ONSET - EARLIEST) * width) * jacobian[:, 1::3]
        return jacobian * weight[:, None]

    first = start.copy()
    first[1::3] -= earliest(start[2::3])
    result = scipy.optimize.least_squares(
        lambda p: (_sum(plain(p), stack.lag) - stack.value) * weight,
        np.clip(first, low, high),
        jac=slopes,
        bounds=(low, high),
        max_nfev=most,
    )
    return plain(result.x)


def _add_component(stack: Stack, weight: np.ndarray, parameters: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """The best of several starts with one more Gaussian, on its way to where it will settle."""
    width = parameters[2]
    best, best_cost = parameters, np.inf
    smooth = np.convolve(residual, np.ones(5) / 5, mode="same")
    for place in {int(np.argmax(smooth)), int(np.argmin(smooth))}:
        for factor in (0.7, 1.5, 4.0):
            start = np.r_[parameters, smooth[place], stack.lag[place], factor * width]
            tried = _refine(stack, weight, start, TRIAL_EVALUATIONS)
            cost = float(np.sum(((_sum(tried, stack.lag) - stack.value) * weight) ** 2))
            if cost < best_cost:
                best, best_cost = tried, cost
    return best


def _as_fit(parameters: np.ndarray, rms: float) -> PulseFit:
    components = parameters.reshape(-1, 3)
    # Stacks are aligned at the peak: the main component is the one that makes most of it.
    main = int(np.argmax(components[:, 0] * np.exp(-0.5 * (components[:, 1] / components[:, 2]) ** 2)))
    order = np.r_[main, np.delete(np.arange(len(components)), main)]
    components = components[order]
    weight, delay, _ = components[0]
    scaled = components / [weight, 1.0, 1.0] - [0.0, delay, 0.0]
    return PulseFit(scaled, 0.0, rms / weight, float(delay))
