"""The system pulse from isolated echoes: aligned, stacked, fitted by a sum of Gaussians (docs/algorithms.md R2).

The loops of the fit are C (kernels/c/stack.h).
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable

import numpy as np

from wavebatch.core.frozen import NamedTuple
from wavebatch.core.order import group_medians, median
from wavebatch.core.units import MEDIAN_ERROR
from wavebatch.kernels.elementary import exp, solve
from wavebatch.kernels.fit.pulse_shape import PulseShape, evaluate_pulse
from wavebatch.kernels.library import CStacked, call, place

STEP, IN_BIN = 0.2, 10.0
"""Grid of the stack [samples]; coarser where fewer echoes would fall into a bin than IN_BIN."""

MOST_COMPONENTS = 6

GAIN = 0.10
"""Share by which the residual must fall for one more component."""

TRIAL_EVALUATIONS = 25
"""Evaluations after which the starts of one more component are compared."""

MOST_EVALUATIONS = 200
"""Evaluations after which a fit ends."""

FIRST_DAMPING, MOST_DAMPING, FIT_SETTLED = 10.0, 1e8, 1e-7
"""Damping of the first step (less jumps into pairs of broad components that cancel), damping at which no step helps,
and share by which the sum of squares falls in the last step."""

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

SCATTER = 1021.0, 0.5 * (np.sqrt(5.0) - 1.0)
"""Steps per sample of the time, and of the sample, whose fractions look like chance."""


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
    cut: np.ndarray | None = None,
) -> Stack:
    """Median of signal (m, s) over amplitude, by lag from `before` samples before each centre to `after` behind it.

    std: error of a sample that counts have without any noise; where they are rounded more coarsely than they scatter,
    the values of a bin may all be equal without being exact.
    cut: samples that were cut off below, bool (m, s). The median does not see by how much, unless most are cut off.
    """
    step = float(np.clip(IN_BIN / max(len(amplitude), 1), STEP, 1.0))
    least = max(std / float(median(amplitude)), 1e-6) if len(amplitude) else 1e-6
    lag = np.arange(signal.shape[1]) - time[:, None]
    used = (lag >= -before) & (lag <= after) & np.isfinite(signal)
    # Plus values spread evenly over one step of the counts, whose rounding has the standard deviation `std`: the median
    # of whole counts is one of them, and so off by up to half a step, which gave pulses a tail of .5 %. They come from
    # the times, so that the order of the echoes changes nothing.
    fraction = time[:, None] * SCATTER[0] + np.arange(signal.shape[1]) * SCATTER[1]
    fraction -= np.floor(fraction)
    values = ((signal + ((fraction - 0.5) * (std * np.sqrt(12.0))).astype(np.float32)) / amplitude[:, None])[used]
    bins = np.floor((lag[used] + before) / step).astype(np.int64)
    if cut is not None:
        lost = cut[used]
        lost &= (2 * np.bincount(bins, lost) > np.bincount(bins))[bins]
        values, bins = values[~lost], bins[~lost]
    middle, spread = group_medians(values, bins)
    number = np.bincount(bins)
    kept = np.flatnonzero(number >= LEAST_BIN)
    error = MEDIAN_ERROR * np.maximum(spread[kept], least) / np.sqrt(number[kept])
    return Stack((kept + 0.5) * step - before, middle[kept].astype(np.float64), error)


class PulseFit(NamedTuple):
    """One model of a stack."""

    components: np.ndarray
    """Weight, delay, sigma per component, the strongest first; weight 1 and delay 0 for it (c, 3)."""
    kappa: float
    rms: float
    """Root mean square misfit, in amplitudes."""
    datum: float
    """Delay of the strongest component (or the skewed pulse's peak) in the stack [samples]."""

    def draw(self, lag: np.ndarray) -> np.ndarray:
        """Return the pulse at lags (b,) of its stack, of height 1."""
        weight, delay, sigma = self.components.T
        if self.kappa:
            at = np.array([self.datum])
            drawn = evaluate_pulse(PulseShape(kappa=self.kappa), lag[:, None], at, sigma[:1])[0][:, 0]
        else:
            drawn = np.einsum("lc,c->l", exp(-0.5 * ((lag[:, None] - self.datum - delay) / sigma) ** 2), weight)
        return drawn / drawn.max()


def fit_gaussians(stack: Stack, width: float, most: int = MOST_COMPONENTS, goal: float = 0.0) -> list[PulseFit]:
    """Sums of 1, 2, ... `most` Gaussians fitted to the stack, one more while the misfit falls by a tenth or more.

    One that gains less is kept where the next one after it makes up for both. Where one Gaussian reaches the goal, a
    misfit in amplitudes, no more are fitted.
    """
    weight = _weights(stack)
    parameters = np.array([1.0, 0.0, width])
    fits: list[PulseFit] = []
    worth = 0
    while True:
        parameters = _refine(stack, weight, parameters)
        residual = stack.value - _sum(parameters, stack.lag)
        fits.append(_as_fit(parameters, float(np.sqrt(np.mean(residual**2)))))
        last = len(fits) - 1
        if not last and fits[0].rms <= goal:
            return fits
        if fits[last].rms <= (1 - GAIN) ** (last - worth) * fits[worth].rms:
            worth = last
        if len(fits) == most or last - worth == 2:
            return fits[: worth + 1]
        # The best of several starts with one more Gaussian, on its way to where it will settle.
        # At the largest and the smallest residual, and at the peak: a shape that is sharper or flatter than a Gaussian
        # leaves small residuals of both signs around it, and a strip of RIEGL learned it or not by the half that was
        # looked at. The fit is weighted by errors; what is compared is the plain misfit, as everywhere else: by
        # weights, the exact tail wins over a core that strong echoes miss three times as much.
        around = parameters[2]
        smooth = np.convolve(residual, np.ones(5) / 5, mode="same")
        starts = [
            np.concatenate((parameters, (smooth[at], stack.lag[at], factor * around)))
            for at in sorted({int(np.argmax(smooth)), int(np.argmin(smooth))})
            for factor in (0.7, 1.5, 4.0)
        ]
        sharper = np.r_[parameters, -0.2, parameters[1], 1.3 * around]
        sharper[0] += 0.2
        parameters = _refine(stack, weight, np.stack((*starts, sharper)), TRIAL_EVALUATIONS)


def fit_skewed(stack: Stack, width: float) -> PulseFit:
    """The skewed pulse of section 0 fitted to the stack."""
    weight = _weights(stack)
    # A tail is no skew: the main lobe decides, all of the stack says how well it fits.
    lobe = np.where(np.abs(stack.lag) < LOBE * width, weight, 0.0)

    def evaluate(p: np.ndarray) -> tuple[np.ndarray, ...]:
        t, s = np.array([p[1]]), np.array([p[2]])
        return tuple(row[:, 0] for row in evaluate_pulse(PulseShape(kappa=float(p[3])), stack.lag[:, None], t, s))

    def misfit(p: np.ndarray) -> np.ndarray:
        return (p[0] * evaluate(p)[0] - stack.value) * lobe

    def slopes(p: np.ndarray) -> np.ndarray:
        pulse, by_time, by_width = evaluate(p)
        step = 1e-4 if p[3] < 0 else -1e-4
        by_skew = (evaluate(p + [0, 0, 0, step])[0] - pulse) / step
        return np.stack([pulse, p[0] * by_time, p[0] * by_width, p[0] * by_skew], axis=1) * lobe[:, None]

    low, high = np.array([0.5, -3 * width, 0.3 * width, -0.6]), np.array([2.0, 3 * width, 3 * width, 0.6])
    fitted = fit_bounded(misfit, slopes, np.array([1.0, 0.0, width, 0.02]), low, high, MOST_EVALUATIONS)
    amplitude, delay, sigma, kappa = fitted
    rms = float(np.sqrt(np.mean((amplitude * evaluate(fitted)[0] - stack.value) ** 2)))
    return PulseFit(np.array([[1.0, 0.0, sigma]]), float(kappa), rms / amplitude, float(delay))


def _weights(stack: Stack) -> np.ndarray:
    """Inverse errors, none more than four times the typical one, mean 1."""
    weight = 1 / np.maximum(stack.error, 0.25 * median(stack.error))
    return weight / weight.mean()


def _sum(parameters: np.ndarray, lag: np.ndarray) -> np.ndarray:
    weight, delay, sigma = parameters.reshape(-1, 3).T
    return np.einsum("bc,c->b", exp(-0.5 * ((lag[:, None] - delay) / sigma) ** 2), weight)


def _refine(stack: Stack, weight: np.ndarray, starts: np.ndarray, most: int = MOST_EVALUATIONS) -> np.ndarray:
    """The sum of Gaussians that misses the stack least of those fitted from some starts (k, 3 c).

    In at most `most` evaluations. Parameters are weight, delay and sigma of each; fits move the delay as a share of the
    way from the earliest that is allowed to a component of this sigma to the end of the stack. Beyond the end nothing
    holds a component.
    """
    found = np.array(starts, np.float64, ndmin=2)
    width, end = abs(found[0, 2]), stack.lag[-1]
    columns = [np.ascontiguousarray(column, np.float64) for column in (stack.lag, stack.value, weight)]
    structure = CStacked(
        len(weight), found.shape[1] // 3, *(place(column, np.float64) for column in columns),
        (-DEEPEST, 0.0, 0.35 * width), (2.0, 1.0, 12.0 * width), -EARLIEST * width, ONSET * width, end - width, end,
        FIRST_DAMPING, MOST_DAMPING, FIT_SETTLED, most,
    )  # fmt: skip
    return found[call("fit_stack", structure, ctypes.c_int64(len(found)), found)]


def fit_bounded(
    misfit: Callable[[np.ndarray], np.ndarray],
    slopes: Callable[[np.ndarray], np.ndarray],
    start: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    most: int,
) -> np.ndarray:
    """Least squares between bounds, in at most `most` evaluations, from a start that lies between them.

    Parameters
    ----------
    misfit, slopes : callable
        Residuals (b,) of parameters (p,), and their derivatives (b, p).
    start, low, high : float64 (p,)
    most : int

    Returns
    -------
    float64 (p,)

    Notes
    -----
    Levenberg and Marquardt's steps, cut off at the bounds; a parameter that would leave its bounds is held there. With
    four parameters it takes a third of the time of scipy's `least_squares`, whose steps cost more than the model.
    """
    at, rest = start, misfit(start)
    cost, damping = float(np.einsum("b,b->", rest, rest)), FIRST_DAMPING
    jacobian = slopes(at)
    for _ in range(most - 1):
        downhill = -np.einsum("bp,b->p", jacobian, rest)
        free = ~(((at <= low) & (downhill < 0)) | ((at >= high) & (downhill > 0)))
        part = jacobian[:, free]
        normal = np.einsum("bp,bq->pq", part, part)
        scale = np.maximum(normal.diagonal(), 1e-12 * max(float(normal.diagonal().max(initial=0)), 1e-300))
        step = np.zeros_like(at)
        step[free] = solve(normal + np.diag(damping * scale), downhill[free])
        there = np.clip(at + step, low, high)
        new = misfit(there)
        new_cost = float(np.einsum("b,b->", new, new))
        if new_cost < cost:
            small = cost - new_cost < FIT_SETTLED * cost
            at, rest, cost, damping = there, new, new_cost, max(damping / 5, 1e-9)
            if small:
                break
            jacobian = slopes(at)
        elif damping > MOST_DAMPING:
            break
        else:
            damping *= 4
    return at


def _as_fit(parameters: np.ndarray, rms: float) -> PulseFit:
    components = parameters.reshape(-1, 3)
    # Stacks are aligned at the peak: the main component is the one that makes most of it.
    main = int(np.argmax(components[:, 0] * exp(-0.5 * (components[:, 1] / components[:, 2]) ** 2)))
    order = np.r_[main, np.delete(np.arange(len(components)), main)]
    components = components[order]
    weight, delay, _ = components[0]
    scaled = components / [weight, 1.0, 1.0] - [0.0, delay, 0.0]
    return PulseFit(scaled, 0.0, rms / weight, float(delay))
