"""Batched Levenberg-Marquardt fits of k overlapping echoes in windows of one length (docs/algorithms.md 2.3).

Used by `grow` and stages/decompose. Arrays keep the problems first: windows (m, L), parameters (m, 3, k) in the order
amplitude, time, width. The model runs in float32; the batch must never change the result of a problem.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from wavebatch.kernels.fit.normal_equations import RIDGE, gram_matrix, parameter_units, solve_symmetric
from wavebatch.kernels.fit.pulse_shape import PulseShape, evaluate_pulse

BATCH_VALUES = 500_000
"""Numbers in the rows of one batch: large enough for NumPy's calls to cost little, small enough for the cache."""

LARGEST_BATCH = 4 * BATCH_VALUES
"""Most numbers in the rows of a batch: 256 windows of 65,536 samples would take gigabytes."""


def batch_size(k: int, length: int) -> int:
    """Problems per batch of k echoes in windows of `length` samples."""
    values = (3 * k + 1) * length
    least = min(max(LARGEST_BATCH // values, 1), 256)
    return int(np.clip(BATCH_VALUES // values, least, 16384))


OUTSIDE = np.float32(-1e4)
"""Position of a sample that takes no part: every pulse is zero there."""

DAMPING = 0.01
"""Marquardt damping of the first step, in units of the diagonal."""

KEPT = 0.75
"""A step whose fall of the cost is at least this share of what it promised eases the damping."""

EASE, RAISE = 0.2, 4.0
"""Factors of the damping after such a step, and after a step that is refused; otherwise it stays. Overlapping echoes
lie in a curved valley: if every accepted step eased the damping, each second step would be too long.
"""


LONG_STEP = 0.1
"""Steps longer than this share of an echo's width or amplitude are never taken unchecked, whatever little they promise:
along the curved valley of overlapping echoes one of 600 fits ended worse by more than 2 in chi2, some by 250.
"""


class Windows(NamedTuple):
    """Samples of m problems of one length L."""

    y: np.ndarray
    """Signal above the baseline, 0 where x is OUTSIDE, float32 (m, L), count."""
    x: np.ndarray
    """Position of the sample in the window, or OUTSIDE, float32 (m, L), samples."""
    std: np.ndarray
    """Noise of one sample, float64 (m,), count."""
    clipped: np.ndarray | None = None
    """Clipped samples: the signal is at least y (docs/algorithms.md H6), bool (m, L); None for none."""

    weight: np.ndarray | None = None
    """Noise without signal over noise at each sample (docs/algorithms.md H12), float32 (m, L); None for 1."""

    def take(self, rows: np.ndarray) -> Windows:
        """The problems at `rows` (indices or mask)."""
        return Windows(*(None if field is None else field[rows] for field in self))


class Limits(NamedTuple):
    """Box of the parameters: arrays that broadcast to (m, 3, k)."""

    low: np.ndarray
    """Smallest values."""
    high: np.ndarray
    """Largest values."""


class WidthPrior(NamedTuple):
    """An echo is at least as wide as the system pulse: a one-sided prior on widths of overlapping echoes.

    Source: docs/algorithms.md H1. Without it, close echoes trade width against amplitude.
    """

    width: float
    """Width of the system pulse [samples]."""
    spread: float
    """Standard deviation of the prior below that width [samples]."""

    def add(self, parameters: np.ndarray, std: np.ndarray, gram: np.ndarray) -> np.ndarray:
        """Adds the prior to the products in place.

        Parameters
        ----------
        parameters : float64 (m, 3, k)
            Where the products were taken.
        std : float64 (m,), count
            Noise of one sample.
        gram : float64 (m, 3 k + 1, 3 k + 1)
            Products of rows and residual; changed.

        Returns
        -------
        float64 (m,), count^2
            Cost of the prior.
        """
        k = parameters.shape[2]
        lack = self.width - parameters[:, 2]
        below = lack > 0
        lack *= below
        spread = ((std / self.spread) ** 2)[:, None]
        pull = spread * lack
        cost = (pull * lack).sum(axis=1)
        if below.any():
            unit = parameters[:, 2] / np.maximum(parameters[:, 0], 0.5 * std[:, None])
            pull *= unit
            gram[:, 2 * k : 3 * k, -1] += pull
            unit *= unit
            unit *= below
            unit *= spread
            np.einsum("mpp->mp", gram)[:, 2 * k : 3 * k] += unit
        return cost


class Fit(NamedTuple):
    """Solution of m problems with k echoes each."""

    parameters: np.ndarray
    """Amplitude, time, width, float64 (m, 3, k)."""
    rows: np.ndarray
    """Model rows at the last step (see `evaluate_model`), float32 (m, 3 k + 1, L)."""
    gram: np.ndarray
    """Their inner products, with the prior, float64 (m, 3 k + 1, 3 k + 1)."""
    cost: np.ndarray
    """chi2 plus prior, as the last step promises, float64 (m,)."""
    converged: np.ndarray
    """bool (m,)."""
    hopeless: np.ndarray
    """Given up because it cannot reach the cost asked for; rows and gram are 0 there, bool (m,)."""
    at_bound: np.ndarray
    """Whether a parameter of the echo ended on its bound, bool (m, k)."""


def evaluate_model(windows: Windows, parameters: np.ndarray, shape: PulseShape) -> np.ndarray:
    """Basis functions and residual of each problem.

    Parameters
    ----------
    windows : Windows
        m problems of length L.
    parameters : float64 (m, 3, k)
        Amplitude, time, width.
    shape : PulseShape
        Model of the pulse.

    Returns
    -------
    float32 (m, 3 k + 1, L)
        k pulses, k derivatives by time, k by width (both in units of amplitude / width), and the residual. Rows are
        weighted; clipped samples count only where the model lies below them.
    """
    amplitude, time, width = parameters.astype(np.float32).transpose(1, 0, 2)[..., None]
    basis = evaluate_pulse(shape, windows.x[:, None, :], time, width)
    k = parameters.shape[2]
    residual = windows.y - amplitude[:, 0] * basis[0][:, 0]
    for j in range(1, k):
        residual -= amplitude[:, j] * basis[0][:, j]
    rows = np.empty((len(parameters), 3 * k + 1, windows.y.shape[1]), np.float32)
    for i, functions in enumerate(basis):
        rows[:, i * k : (i + 1) * k] = functions
    rows[:, -1] = residual
    if windows.clipped is not None:
        rows *= ~(windows.clipped & (residual <= 0))[:, None, :]
    if windows.weight is not None:
        rows *= windows.weight[:, None, :]
    return rows


def _steps(gram: np.ndarray, damping: np.ndarray, frozen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Marquardt step (m, p), 0 where `frozen` (m, p), and the fall of the cost that it promises (m,)."""
    matrix = gram[:, :-1, :-1].copy()
    gradient = gram[:, :-1, -1]
    at = np.flatnonzero(frozen.any(axis=1))
    if len(at):
        free = ~frozen[at]
        matrix[at] *= free[:, :, None] & free[:, None, :]
        gradient = gradient.copy()
        gradient[at] *= free
    diagonal = np.einsum("mpp->mp", matrix)
    diagonal *= (1 + damping)[:, None]
    diagonal += RIDGE
    step = solve_symmetric(matrix, gradient)
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
    """Least-squares parameters of k echoes per problem, by Levenberg-Marquardt.

    Parameters
    ----------
    windows : Windows
        m problems of length L.
    start : float64 (m, 3, k)
        Start parameters: amplitude [count], time and width [samples].
    limits : Limits
        Box of the parameters.
    shape : PulseShape
        Model of the pulse.
    tolerance : float
        A problem has converged when the next step promises a fall of chi2 below this: it is then within sqrt(tolerance)
        standard deviations of the minimum.
    max_iterations : int
        Largest number of steps.
    hopeless_above : float64 (m,), optional
        chi2 that each problem must fall below; it is given up when its progress cannot reach that.
    prior : WidthPrior, optional
        Added to the cost.

    Returns
    -------
    Fit
    """
    m, _, k = start.shape
    low, high = (np.broadcast_to(edge, start.shape) for edge in limits)
    state = _State(windows, np.clip(start, low, high), low, high, prior)
    fit = Fit(
        parameters=np.empty(start.shape),
        rows=np.empty((m, 3 * k + 1, windows.y.shape[1]), np.float32),
        gram=np.empty((m, 3 * k + 1, 3 * k + 1)),
        cost=np.full(m, np.inf),
        converged=np.zeros(m, bool),
        hopeless=np.zeros(m, bool),
        at_bound=np.zeros((m, k), bool),
    )
    index = np.arange(m)
    for iteration in range(max_iterations):
        before = state.cost
        decrement = state.advance(shape)
        variance = state.windows.std**2
        done = state.accepted & (decrement < tolerance * variance)
        long = state.find_long(done)
        done &= ~long
        if iteration > 3:
            done |= state.accepted & (before - state.cost < 0.1 * tolerance * variance)
        over = done | (state.damping > 1e6) | (iteration == max_iterations - 1)
        if hopeless_above is not None and iteration >= 2:
            lost = state.cost - 4 * decrement > hopeless_above[index] * variance
            fit.hopeless[index[lost]] = True
            over |= lost
        if over.any():
            out = np.flatnonzero(over)
            _store(fit, state, index[out], out, done[out], np.where(long, np.inf, decrement / variance)[out], tolerance)
            if len(out) == len(index):
                break
            stay = np.flatnonzero(~over)
            state, index = state.take(stay), index[stay]
    _refresh(fit, windows, shape)
    fit.at_bound[:] = ((fit.parameters <= low) | (fit.parameters >= high)).any(axis=1)
    return fit


def _store(
    fit: Fit, state: _State, place: np.ndarray, out: np.ndarray, finished: np.ndarray, promised: np.ndarray, most: float
) -> None:
    """Writes the results of problems that are over; a converged one takes a last step that promises less than `most`.

    Nothing checks this step; a larger one is not taken.
    """
    step = finished & (promised < most)
    fit.parameters[place] = np.where(step[:, None, None], state.trial[out], state.kept[out])
    fit.cost[place] = state.cost[out] / state.windows.std[out] ** 2 - np.where(step, promised, 0.0)
    fit.converged[place] = finished
    fit.rows[place] = state.rows[out]
    fit.gram[place] = state.gram[out]


def _refresh(fit: Fit, windows: Windows, shape: PulseShape) -> None:
    """Evaluates problems that stopped early once more: their last trial may have been refused.

    Rows of problems that were given up are set to 0.
    """
    fit.rows[fit.hopeless] = 0
    fit.gram[fit.hopeless] = 0
    short = np.flatnonzero(~(fit.converged | fit.hopeless))
    if len(short):
        fit.rows[short] = evaluate_model(windows.take(short), fit.parameters[short], shape)
        fit.gram[short] = gram_matrix(fit.rows[short])


class _State:
    """The problems still running: last accepted point with its equations, trial point, damping."""

    __slots__ = (
        "accepted", "cost", "damping", "gram", "high", "kept", "low", "prior", "promised", "rows", "trial", "windows"
    )  # fmt: skip

    def __init__(
        self, windows: Windows, start: np.ndarray, low: np.ndarray, high: np.ndarray, prior: WidthPrior | None
    ):
        m = len(start)
        self.windows, self.low, self.high, self.prior = windows, low, high, prior
        self.trial = self.kept = start
        self.cost = np.full(m, np.inf)
        self.damping = np.full(m, DAMPING)
        self.promised = np.full(m, np.inf)
        self.accepted = np.zeros(m, bool)
        self.gram = self.rows = np.empty((m, 0, 0))

    def take(self, places: np.ndarray) -> _State:
        """The state of the problems at `places`."""
        part = object.__new__(_State)
        part.prior, part.rows = self.prior, self.rows
        part.windows = self.windows.take(places)
        for name in ("accepted", "cost", "damping", "gram", "high", "kept", "low", "promised", "trial"):
            setattr(part, name, getattr(self, name)[places])
        return part

    def find_long(self, among: np.ndarray) -> np.ndarray:
        """True (m,) where the next step is longer than LONG_STEP; among: the problems to look at."""
        at = np.flatnonzero(among)
        kept = self.kept[at]
        step = np.abs(self.trial[at] - kept)
        scale = kept[:, [0, 2, 2]]
        scale[:, 0] += self.windows.std[at, None]
        long = np.zeros(len(among), bool)
        long[at] = (step > LONG_STEP * scale).any(axis=(1, 2))
        return long

    def advance(self, shape: PulseShape) -> np.ndarray:
        """Evaluates the trial, accepts or refuses it, sets the next one; the promised fall of the cost (m,)."""
        std = self.windows.std
        self.rows = evaluate_model(self.windows, self.trial, shape)
        gram = gram_matrix(self.rows)
        cost = gram[:, -1, -1].copy()
        if self.prior is not None:
            cost += self.prior.add(self.trial, std, gram)
        self.accepted = cost <= self.cost * (1 + 1e-6)
        factor = np.where(self.accepted, np.where(self.cost - cost > KEPT * self.promised, EASE, 1.0), RAISE)
        self.damping = np.maximum(self.damping * factor, 1e-7)
        refused = np.flatnonzero(~self.accepted)
        kept = self.trial
        if len(refused):
            kept = kept.copy()
            kept[refused], cost[refused], gram[refused] = self.kept[refused], self.cost[refused], self.gram[refused]
        self.kept, self.cost, self.gram = kept, cost, gram
        slope = gram[:, :-1, -1].reshape(kept.shape)
        frozen = ((kept <= self.low) & (slope < 0)) | ((kept >= self.high) & (slope > 0))
        step, decrement = _steps(gram, self.damping, frozen.reshape(len(kept), 3 * kept.shape[2]))
        step = step.reshape(self.kept.shape)
        step *= parameter_units(self.kept, std)
        step += self.kept
        self.trial = np.minimum(np.maximum(step, self.low), self.high)
        self.promised = decrement
        return decrement
