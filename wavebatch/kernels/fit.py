"""Batched Levenberg-Marquardt fits of k overlapping echoes in windows of one length (ALGORITHMS.md 2.3).

Arrays keep the problems first: windows (m, L), parameters (m, 3, k) in the order amplitude, time, width. The model
runs in float32, the normal equations are solved in float64 in units in which every basis function has the same
scale, so that the condition number is that of the overlap alone (H2). Every reduction runs within one problem:
results do not depend on what else is in the batch.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from wavebatch.kernels.pulse import PulseShape, evaluate_pulse

BATCH = 2048
"""Problems per batch: large enough for NumPy, small enough for the cache."""

OUTSIDE = np.float32(-1e4)
"""Position of a sample that takes no part: every pulse is zero there."""

RIDGE = 1e-9
"""Added to the diagonal of the scaled normal equations: an echo outside its window must not make them singular."""


class Windows(NamedTuple):
    """Samples of m problems of one length L."""

    y: np.ndarray
    """Signal above the baseline, 0 where x is OUTSIDE, float32 (m, L)."""
    x: np.ndarray
    """Sample position relative to the problem's own origin, or OUTSIDE, float32 (m, L)."""
    std: np.ndarray
    """Noise of a sample, float64 (m,)."""
    clipped: np.ndarray | None = None
    """Samples at the digitizer's limit: they only say that the signal is at least y (H6), bool (m, L)."""

    def take(self, rows: np.ndarray) -> Windows:
        """The problems at `rows`."""
        clipped = None if self.clipped is None else self.clipped[rows]
        return Windows(self.y[rows], self.x[rows], self.std[rows], clipped)


class Limits(NamedTuple):
    """Box of the parameters: arrays that broadcast to (m, 3, k)."""

    low: np.ndarray
    high: np.ndarray


class WidthPrior(NamedTuple):
    """An echo is at least as wide as the system pulse: a one-sided prior on the width of overlapping echoes (H1)."""

    width: float
    """Width of the system pulse [samples]."""
    spread: float
    """Standard deviation allowed below it [samples]."""

    def cost(self, parameters: np.ndarray, std: np.ndarray) -> np.ndarray:
        """What the prior adds to the sum of squared residuals (m,)."""
        lack = np.maximum(self.width - parameters[:, 2], 0.0) / self.spread
        return np.einsum("mk,mk->m", lack, lack) * std**2

    def add(self, parameters: np.ndarray, std: np.ndarray, gram: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        """Adds the prior to normal equations in place; its cost (m,)."""
        k = parameters.shape[2]
        lack = np.maximum(self.width - parameters[:, 2], 0.0)
        unit = parameter_units(parameters, std)[:, 2]
        weight = (std[:, None] / self.spread) ** 2
        gradient[:, 2 * k :] += weight * lack * unit
        np.einsum("mpp->mp", gram)[:, 2 * k :] += weight * unit * unit * (lack > 0)
        return self.cost(parameters, std)


class Fit(NamedTuple):
    """Solution of m problems with k echoes each."""

    parameters: np.ndarray
    """Amplitude, time, width: float64 (m, 3, k)."""
    converged: np.ndarray
    """bool (m,)."""
    hopeless: np.ndarray
    """Given up because it cannot reach what was asked for, bool (m,)."""
    at_bound: np.ndarray
    """bool (m, k): a parameter of the echo ended on its bound."""


def evaluate_model(windows: Windows, parameters: np.ndarray, shape: PulseShape) -> np.ndarray:
    """The rows of a fit, float32 (m, 3 k + 1, L): pulses, derivatives by time, by width (k each), and the residual.

    Derivatives are in units of A/s times the row.
    """
    amplitude, time, width = parameters.astype(np.float32).transpose(1, 0, 2)[..., None]
    basis = evaluate_pulse(shape, windows.x[:, None, :], time, width)
    k = parameters.shape[2]
    residual = windows.y - amplitude[:, 0] * basis[0][:, 0]
    for j in range(1, k):
        residual -= amplitude[:, j] * basis[0][:, j]
    rows = np.concatenate([*basis, residual[:, None]], axis=1)
    if windows.clipped is not None:
        rows *= ~(windows.clipped & (residual <= 0))[:, None, :]
    return rows


def gram_matrix(rows: np.ndarray) -> np.ndarray:
    """Inner products of the rows of each problem, float64 (m, p, p)."""
    return (rows @ rows.transpose(0, 2, 1)).astype(np.float64)


def parameter_units(parameters: np.ndarray, std: np.ndarray) -> np.ndarray:
    """What one unit of each row's coefficient is worth: 1 for amplitude, s/A for time and width (m, 3, k)."""
    unit = parameters[:, 2] / np.maximum(parameters[:, 0], 0.5 * std[:, None])
    return np.stack([np.ones_like(unit), unit, unit], axis=1)


def parameter_errors(windows: Windows, parameters: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """One standard deviation of each parameter from the normal equations in float64 (m, 3, k)."""
    functions = rows[:, :-1].astype(np.float64)
    gram = functions @ functions.transpose(0, 2, 1)
    variance = np.diagonal(np.linalg.inv(add_ridge(gram)), axis1=1, axis2=2)
    error = np.sqrt(np.maximum(variance, 0)).reshape(parameters.shape)
    return error * parameter_units(parameters, windows.std) * windows.std[:, None, None]


def add_ridge(gram: np.ndarray) -> np.ndarray:
    """The matrices (m, p, p) with a diagonal that no overlap can make singular; changed in place."""
    diagonal = np.einsum("mpp->mp", gram)
    diagonal *= 1 + RIDGE
    diagonal += RIDGE
    return gram


def _steps(
    gram: np.ndarray, gradient: np.ndarray, damping: np.ndarray, frozen: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Marquardt step (m, p) and the fall of the cost that it promises (m,)."""
    matrix = gram.copy()
    if frozen.any():
        free = ~frozen
        matrix *= free[:, :, None]
        matrix *= free[:, None, :]
        gradient = gradient * free
    diagonal = np.einsum("mpp->mp", matrix)
    diagonal *= 1 + damping[:, None]
    diagonal += RIDGE
    step = np.linalg.solve(matrix, gradient[:, :, None])[:, :, 0]
    return step, np.einsum("mp,mp->m", step, gradient)


def fit_windows(
    windows: Windows,
    start: np.ndarray,
    limits: Limits,
    shape: PulseShape,
    *,
    tolerance: float = 1e-3,
    max_iterations: int = 40,
    hopeless_above: np.ndarray | None = None,
    prior: WidthPrior | None = None,
) -> Fit:
    """Least-squares parameters of k echoes per problem.

    start: (m, 3, k). tolerance: a problem is done when the Newton step promises a fall of chi2 below this,
    that is, when it lies within sqrt(tolerance) standard deviations of the minimum. hopeless_above: chi2 (m,) that
    a problem must be able to fall below; it is given up, not converged, when its progress cannot reach that.
    prior: added to the cost.
    """
    m = len(start)
    low, high = (np.broadcast_to(edge, start.shape) for edge in limits)
    best = np.clip(start, low, high)
    state = _State(windows, best.copy(), low, high, prior)
    converged = np.zeros(m, bool)
    hopeless = np.zeros(m, bool)
    index = np.arange(m)
    for iteration in range(max_iterations):
        before = state.cost
        decrement = state.advance(shape)
        variance = state.windows.std**2
        done = state.accepted & (decrement < tolerance * variance)
        if iteration > 3:
            done |= state.accepted & (before - state.cost < 0.1 * tolerance * variance)
        over = done | (state.damping > 1e6) | (iteration == max_iterations - 1)
        if hopeless_above is not None and iteration >= 2:
            lost = state.cost - 4 * decrement > hopeless_above[index] * variance
            hopeless[index[lost]] = True
            over |= lost
        if over.any():
            place = index[over]
            best[place] = np.where(done[over][:, None, None], state.trial[over], state.kept[over])
            converged[place] = done[over]
            if over.all():
                break
            state = state.take(np.flatnonzero(~over))
            index = index[~over]
    at_bound = ((best <= low) | (best >= high)).any(axis=1)
    return Fit(best, converged, hopeless, at_bound)


class _State:
    """The problems still running: last accepted point with its equations, the trial point, the damping."""

    __slots__ = ("accepted", "cost", "damping", "gram", "gradient", "high", "kept", "low", "prior", "trial", "windows")

    def __init__(
        self, windows: Windows, start: np.ndarray, low: np.ndarray, high: np.ndarray, prior: WidthPrior | None
    ):
        m, _, k = start.shape
        self.windows, self.low, self.high, self.prior = windows, low, high, prior
        self.trial = self.kept = start
        self.cost = np.full(m, np.inf)
        self.gram = np.zeros((m, 3 * k, 3 * k))
        self.gradient = np.zeros((m, 3 * k))
        self.damping = np.full(m, 1e-3)
        self.accepted = np.zeros(m, bool)

    def take(self, rows: np.ndarray) -> _State:
        """The same state for some of the problems."""
        part = object.__new__(_State)
        for name in self.__slots__:
            value = getattr(self, name)
            if name != "prior":
                value = value.take(rows) if name == "windows" else value[rows]
            setattr(part, name, value)
        return part

    def advance(self, shape: PulseShape) -> np.ndarray:
        """Evaluate the trial, accept or refuse it, set the next trial; the promised fall of the cost (m,)."""
        products = gram_matrix(evaluate_model(self.windows, self.trial, shape))
        gram, gradient, cost = products[:, :-1, :-1], products[:, :-1, -1], products[:, -1, -1]
        if self.prior is not None:
            cost = cost + self.prior.add(self.trial, self.windows.std, gram, gradient)
        self.accepted = cost <= self.cost * (1 + 1e-6)
        if self.accepted.all():
            self.kept, self.cost, self.gram, self.gradient = self.trial, cost, gram, gradient
        else:
            self.kept = np.where(self.accepted[:, None, None], self.trial, self.kept)
            self.cost = np.where(self.accepted, cost, self.cost)
            self.gram = np.where(self.accepted[:, None, None], gram, self.gram)
            self.gradient = np.where(self.accepted[:, None], gradient, self.gradient)
        self.damping = np.where(self.accepted, np.maximum(self.damping * 0.1, 1e-7), self.damping * 10)
        gradient = self.gradient.reshape(self.kept.shape)
        frozen = ((self.kept <= self.low) & (gradient < 0)) | ((self.kept >= self.high) & (gradient > 0))
        step, decrement = _steps(self.gram, self.gradient, self.damping, frozen.reshape(self.gradient.shape))
        step = step.reshape(self.kept.shape) * parameter_units(self.kept, self.windows.std)
        self.trial = np.clip(self.kept + step, self.low, self.high)
        return decrement
