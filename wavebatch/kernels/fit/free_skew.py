"""Fits of skewed pulses in which every echo has a skew of its own: free with a prior, or tied to an origin.

Used by stages/decompose/skew and by the survey. A free skew is a fourth parameter of each echo. The log-normal as
papers write it has three: its skew is the width over the distance of the peak from the origin (docs/algorithms.md 1.2).
Arrays keep the problems first: parameters (m, 4, k) in the order amplitude, time, width, skew.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from wavebatch.kernels.fit.least_squares import DAMPING, EASE, KEPT, RAISE, Limits, Windows
from wavebatch.kernels.fit.normal_equations import add_ridge

MOST_SKEW = 0.6
"""Largest skew of an echo: at 0.6 the half after the peak is twice as wide as the half before it."""

SERIES = 1e-3
"""Below this |skew| the logarithm is a series: the closed form divides by the skew."""

LEAST_AWAY = 0.25
"""Least distance of a peak from the log-normal's origin [samples]; at the origin itself the pulse has no width."""


class SkewPrior(NamedTuple):
    """Normal prior on the skew of every echo."""

    mean: float
    """Skew of the strip."""
    spread: float
    """Standard deviation of the skews of its echoes."""


class SkewFit(NamedTuple):
    """Solution of m problems with k echoes each."""

    parameters: np.ndarray
    """Amplitude, time, width, skew, float64 (m, 4, k)."""
    errors: np.ndarray
    """One standard deviation of each, float64 (m, 4, k)."""
    misfit: np.ndarray
    """Root mean square residual in noise standard deviations, float64 (m,)."""
    cost: np.ndarray
    """chi2 without the prior, float64 (m,)."""
    converged: np.ndarray
    """bool (m,)."""
    at_bound: np.ndarray
    """Whether a parameter of the echo ended on its bound, bool (m, k)."""


def evaluate_skewed(x: np.ndarray, t: np.ndarray, s: np.ndarray, skew: np.ndarray) -> tuple[np.ndarray, ...]:
    """Unit skewed pulse and its derivatives, with a skew per echo.

    Parameters
    ----------
    x : float, samples
        Sample positions.
    t, s, skew : float
        Peak [samples], width [samples] and skew of echoes; all broadcast.

    Returns
    -------
    pulse, by_time, by_width, by_skew : float64
        With amplitude A the Jacobian is pulse, A/s by_time, A/s by_width, A by_skew.

    References
    ----------
    docs/algorithms.md 0.
    """
    z = (x - t) / s
    grown = skew * z
    inside = grown > -0.999999
    grown = np.where(inside, grown, 0.0)
    small = np.abs(skew) < SERIES
    divisor = np.where(small, 1.0, skew)
    near = z - 0.5 * skew * z * z + skew * skew * z**3 / 3.0
    level = np.where(small, near, np.log1p(grown) / divisor)
    bend = np.where(small, -0.5 * z * z + 2.0 * skew * z**3 / 3.0, (z / (1.0 + grown) - level) / divisor)
    pulse = np.where(inside, np.exp(-0.5 * level * level), 0.0)
    by_time = pulse * level / (1.0 + grown)
    return pulse, by_time, by_time * z, -pulse * level * bend


def render_skewed(
    n: int, s: int, waveform: np.ndarray, time: np.ndarray, amplitude: np.ndarray, width: np.ndarray, skew: np.ndarray
) -> np.ndarray:
    """The sum of skewed pulses of each waveform.

    Parameters
    ----------
    n, s : int
        Number of waveforms, and of samples of each.
    waveform : int (m,)
        Row of each echo.
    time, amplitude, width, skew : float (m,)
        Peak [samples], amplitude [count], width [samples] and skew of each echo.

    Returns
    -------
    float32 (n, s), count
        Signal without baseline.
    """
    signal = np.zeros((n, s), np.float32)
    x = np.arange(s, dtype=np.float64)
    columns = [np.asarray(values, np.float64)[:, None] for values in (time, width, skew, amplitude)]
    for begin in range(0, len(waveform), 4096):
        t, w, kappa, height = (values[begin : begin + 4096] for values in columns)
        np.add.at(signal, waveform[begin : begin + 4096], (height * evaluate_skewed(x, t, w, kappa)[0]).astype("f4"))
    return signal


def fit_skews(
    windows: Windows,
    start: np.ndarray,
    limits: Limits,
    *,
    prior: SkewPrior | None = None,
    origin: np.ndarray | None = None,
    tolerance: float = 0.1,
    max_iterations: int = 40,
) -> SkewFit:
    """Least-squares parameters of k skewed echoes per problem, by Levenberg-Marquardt.

    Parameters
    ----------
    windows : Windows
        m problems of one length.
    start : float64 (m, 4, k)
        Start parameters. With an origin the skews are not used.
    limits : Limits
        Box of the parameters: arrays that broadcast to (m, 4, k).
    prior : SkewPrior, optional
        Added to the cost of free skews.
    origin : float64 (m,), optional
        Place at which the log-normal begins [samples of the window]: the skew is width / (time - origin).
    tolerance : float
        A problem has converged when the next step promises a fall of chi2 below this.
    max_iterations : int
        Largest number of steps.

    Returns
    -------
    SkewFit

    References
    ----------
    Wang, Wang and Tseng eq. 2; docs/algorithms.md 1.2.
    """
    low, high = (np.broadcast_to(edge, start.shape) for edge in limits)
    run = _Run(windows, low, high, prior, origin)
    kept = run.clip(start)
    gram, cost = run.equations(kept)
    m = len(start)
    damping, converged, going = np.full(m, DAMPING), np.zeros(m, bool), np.arange(m)
    for _ in range(max_iterations):
        part = run.take(going)
        step, promised, frozen = part.step(kept[going], gram[going], damping[going])
        done = promised < tolerance * part.variance
        converged[going[done]] = True
        trial = part.clip(kept[going] + np.where(frozen, 0.0, step))
        found, reached = part.equations(trial)
        better = reached <= cost[going] * (1 + 1e-6)
        good = cost[going] - reached > KEPT * promised
        damping[going] = np.maximum(damping[going] * np.where(better, np.where(good, EASE, 1.0), RAISE), 1e-7)
        took = going[better]
        kept[took], gram[took], cost[took] = trial[better], found[better], reached[better]
        going = going[~done & (damping[going] < 1e6)]
        if not len(going):
            break
    return run.finish(kept, gram, converged)


class _Run(NamedTuple):
    """What a batch of fits needs besides its parameters."""

    windows: Windows
    low: np.ndarray
    high: np.ndarray
    prior: SkewPrior | None
    origin: np.ndarray | None

    @property
    def variance(self) -> np.ndarray:
        return self.windows.std**2

    def take(self, rows: np.ndarray) -> _Run:
        origin = None if self.origin is None else self.origin[rows]
        return _Run(self.windows.take(rows), self.low[rows], self.high[rows], self.prior, origin)

    def clip(self, parameters: np.ndarray) -> np.ndarray:
        """The parameters within their box; with an origin the skews that follow from it."""
        inside = np.clip(parameters, self.low, self.high)
        if self.origin is not None:
            inside[:, 1] = np.maximum(inside[:, 1], self.origin[:, None] + LEAST_AWAY)
            inside[:, 3] = inside[:, 2] / (inside[:, 1] - self.origin[:, None])
        return inside

    def units(self, parameters: np.ndarray) -> np.ndarray:
        """What one unit of a row's coefficient means, (m, p, k): see normal_equations.parameter_units."""
        height = np.maximum(parameters[:, 0], 0.5 * self.windows.std[:, None])
        units = [np.ones_like(height), parameters[:, 2] / height, parameters[:, 2] / height, 1.0 / height]
        return np.stack(units[: 4 if self.origin is None else 3], axis=1)

    def rows(self, parameters: np.ndarray) -> np.ndarray:
        """Basis functions of all echoes and the residual, float64 (m, p k + 1, L)."""
        amplitude, time, width, skew = parameters.transpose(1, 0, 2)[..., None]
        windows = self.windows
        basis = evaluate_skewed(windows.x[:, None, :].astype(np.float64), time, width, skew)
        if self.origin is not None:
            pulse, by_time, by_width, by_skew = basis
            basis = pulse, by_time - by_skew * skew * skew, by_width + by_skew * skew
        used = (windows.x >= 0)[:, None, :]
        residual = windows.y - np.sum(amplitude * basis[0], axis=1)
        rows = np.concatenate([*(part * used for part in basis), residual[:, None]], axis=1)
        rows[:, -1] *= used[:, 0]
        if windows.clipped is not None:
            rows *= ~(windows.clipped & (residual <= 0))[:, None, :]
        if windows.weight is not None:
            rows *= windows.weight[:, None, :]
        return rows

    def equations(self, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Inner products of the rows with the prior, and the cost [count^2]."""
        rows = self.rows(parameters)
        gram = rows @ rows.transpose(0, 2, 1)
        cost = gram[:, -1, -1].copy()
        if self.prior is not None and self.origin is None:
            k = parameters.shape[2]
            unit = self.units(parameters)[:, 3]
            weight = (self.variance / self.prior.spread**2)[:, None]
            lack = self.prior.mean - parameters[:, 3]
            diagonal = np.arange(3 * k, 4 * k)
            gram[:, diagonal, diagonal] += weight * unit * unit
            gram[:, diagonal, -1] += weight * unit * lack
            cost += np.sum(weight * lack * lack, axis=1)
        return gram, cost

    def step(
        self, parameters: np.ndarray, gram: np.ndarray, damping: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Marquardt step (m, 4, k), the fall of the cost that it promises (m,), and parameters held at their bound."""
        units = self.units(parameters)
        p = units.shape[1]
        gradient = gram[:, :-1, -1]
        slope = gradient.reshape(units.shape)
        own, low, high = parameters[:, :p], self.low[:, :p], self.high[:, :p]
        frozen = ((own <= low) & (slope < 0)) | ((own >= high) & (slope > 0))
        free = ~frozen.reshape(gradient.shape)
        matrix = gram[:, :-1, :-1] * free[:, :, None] * free[:, None, :]
        diagonal = np.einsum("mpp->mp", matrix)
        diagonal *= 1 + damping[:, None]
        diagonal += np.where(free, 1e-9, 1.0)
        right = gradient * free
        found = np.linalg.solve(matrix, right[:, :, None])[:, :, 0]
        promised = np.einsum("mp,mp->m", found, right)
        step, held = np.zeros_like(parameters), np.zeros(parameters.shape, bool)
        step[:, :p] = found.reshape(units.shape) * units
        held[:, :p] = frozen
        return step, promised, held

    def finish(self, parameters: np.ndarray, gram: np.ndarray, converged: np.ndarray) -> SkewFit:
        """Errors from the normal equations, and the misfit."""
        units = self.units(parameters)
        p = units.shape[1]
        inverse = np.linalg.inv(add_ridge(gram[:, :-1, :-1].copy()))
        variance = np.maximum(np.einsum("mpp->mp", inverse), 0).reshape(units.shape)
        errors = np.zeros_like(parameters)
        errors[:, :p] = np.sqrt(variance) * units * self.windows.std[:, None, None]
        if p == 3:
            away = parameters[:, 1] - self.origin[:, None]
            errors[:, 3] = np.hypot(errors[:, 2] / away, parameters[:, 3] * errors[:, 1] / away)
        residual = self.rows(parameters)[:, -1]
        squares = np.einsum("ml,ml->m", residual, residual) / self.variance
        used = np.maximum(np.count_nonzero(self.windows.x >= 0, axis=1), 1)
        bound = (parameters[:, :p] <= self.low[:, :p]) | (parameters[:, :p] >= self.high[:, :p])
        return SkewFit(parameters, errors, np.sqrt(squares / used), squares, converged, bound.any(axis=1))
