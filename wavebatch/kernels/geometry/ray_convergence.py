"""Position of the sensor from its rays: where the lines through points of a short time window meet.

Used by the survey for strips without a trajectory (docs/algorithms.md 5.1). The position is a polynomial of time,
P = c0 + c1 tau + c2 tau^2, tau = (t - centre) / half: without motion the error is metres. With noisy directions the
linear solution is pulled towards the ground; the angular one is not, so the linear one is only its start.
"""

from __future__ import annotations

import numpy as np

from wavebatch.core.frozen import NamedTuple
from wavebatch.core.order import median, quantile
from wavebatch.core.units import MAD_TO_STD

LARGEST_CONDITION = 1e5
"""Largest condition number of a single position from all directions: above, they are too parallel to meet anywhere."""

LARGEST_ERROR = 0.01
"""Largest expected error of a window, as a share of the distance."""

LEAST_SPREAD = np.radians(2.0)
"""Smallest angle that the directions of a window must cover [rad]."""

LEAST_PULSES = 20
"""Smallest number of pulses in a window: with fewer almost any position fits."""

SPEED, ACCELERATION = 80.0, 1.0
"""Speed and acceleration that a model of too low an order does not follow [m/s, m/s2]: those of a survey aircraft."""

SYSTEMATIC = 2.0
"""How much larger the error of a position is than residuals that depend on the direction show: the fit takes most of
what a turned mounting does for a shift of the sensor (measured: 1.8 to 2.3).
"""

SCANNER = 0.01
"""Rays of a scanner miss the point from which they leave by so much [m], beyond what a shift explains: what its mirrors
do is no turn. RIEGL's rays of a polygon miss it by less than .1 mm, Leica's of a swinging mirror by 6 mm at most."""

STILL = 1e-4
"""Shifts along the rays move nothing: what turns rays by less than this share of the others is chance."""

BENDS = 6
"""Number of powers of the angle across the flight, with the constant, by which what mirrors do is described: rays that
are bent to and fro by 5 mm, one and a half times over the swath, hide no turn over rolling ground."""

CLIP = 4.0 * MAD_TO_STD
"""Residuals above this many medians are outliers: four robust standard deviations."""
_ROUNDS = 3
"""Rounds of the linear solution, each with new weights."""
_STEPS = 6
"""Largest number of Gauss-Newton steps."""


class SensorFit(NamedTuple):
    """The path of the sensor in a window."""

    centre: float
    """Time at which tau is 0 [s]."""
    half: float
    """Half of the window [s]."""
    coefficients: np.ndarray
    """c0, c1, c2, float64 (order + 1, 3), m."""
    covariance: np.ndarray
    """Covariance of the coefficients as one vector, float64 (3 order + 3, 3 order + 3), m2."""
    condition: float
    """Condition number of the normal equations of a sensor at rest: what the directions alone can tell."""
    distance: float
    """Median distance to the points [m]."""
    spread: float
    """Angle that the directions cover [rad]."""
    residual: float
    """Root mean square of the angular residuals per component, at weight 1 [rad]."""
    pulses: int
    """Pulses used."""

    @property
    def is_sound(self) -> bool:
        """Whether the directions differ enough to meet in one place."""
        good = np.isfinite(self.coefficients).all() and np.isfinite(self.covariance).all()
        return bool(good and self.condition < LARGEST_CONDITION and self.spread > LEAST_SPREAD)


class TurnSeen(NamedTuple):
    """What a window shows of a turn of its directions about the three axes [rad]: of all that a turn does to rays, and
    of what it does to those of one angle across the flight, where the ground is nearer or farther."""

    information: np.ndarray
    """Inverse of the covariance, float64 (2, 3, 3)."""
    right: np.ndarray
    """Information times the turn, float64 (2, 3)."""
    floor: np.ndarray
    """Most information of rays that miss their point by SCANNER, however many they are, float64 (2, 3, 3)."""
    shift: np.ndarray
    """By how much the sensor seems to be moved, per turn, float64 (3, 3) [m/rad]."""


def sensor_at(fit: SensorFit, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Position and velocity of the sensor.

    Parameters
    ----------
    fit : SensorFit
        A sound fit.
    time : float (n,), s
        Times within the window.

    Returns
    -------
    position, velocity : float64 (n, 3), m and m/s
    """
    tau = (np.asarray(time, np.float64) - fit.centre) / fit.half
    order = len(fit.coefficients) - 1
    slope = np.stack([k * tau ** max(k - 1, 0) / fit.half for k in range(order + 1)], axis=1)
    return np.vander(tau, order + 1, increasing=True) @ fit.coefficients, slope @ fit.coefficients


def range_error(fit: SensorFit, time: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Standard deviation of the distance to the sensor.

    It includes the errors of the fit, and the motion that the order of its model cannot follow.

    Parameters
    ----------
    fit : SensorFit
        A sound fit.
    time : float (n,), s
        Times within the window.
    direction : float64 (n, 3)
        Unit vectors along the rays.

    Returns
    -------
    float64 (n,), m
    """
    order = len(fit.coefficients) - 1
    tau = (np.asarray(time, np.float64) - fit.centre) / fit.half
    along = (np.vander(tau, order + 1, increasing=True)[:, :, None] * direction[:, None, :]).reshape(len(tau), -1)
    variance = np.einsum("ni,ij,nj->n", along, fit.covariance, along)
    # How far a sensor may be off a path of the fit's order within its window [m], as weak directions enlarge it.
    stray = (SPEED * fit.half / 3**0.5, ACCELERATION * fit.half**2 / 6, 0.0)[len(fit.coefficients) - 1]
    return np.sqrt(np.maximum(variance, 0.0) + float(stray * np.sqrt(fit.condition)) ** 2)


def fit_sensor(
    time: np.ndarray, point: np.ndarray, direction: np.ndarray, weight: np.ndarray | None = None, order: int = 2
) -> SensorFit:
    """The path of the sensor from the pulses of one window: where the lines through their points meet.

    Parameters
    ----------
    time : float (n,), s
        Time of each pulse.
    point : float64 (n, 3), m
        A return of each pulse.
    direction : float (n, 3)
        Along the ray, towards or away from the sensor.
    weight : float (n,), optional
        Inverse variance of the directions; 1 if not given.
    order : int
        Order of the polynomial, 0 to 2.

    Returns
    -------
    SensorFit
        Its values mean nothing where it is not sound (`is_sound`).
    """
    lengths = np.sqrt(np.einsum("ni,ni->n", direction, direction))
    used = np.flatnonzero(np.isfinite(lengths) & (lengths > 0) & np.isfinite(point).all(axis=1) & np.isfinite(time))
    unit = direction[used] / lengths[used, None]
    weight = np.ones(len(used)) if weight is None else np.asarray(weight, np.float64)[used]
    time = np.asarray(time, np.float64)[used]
    if len(used) < LEAST_PULSES:
        size = 3 * (order + 1)
        empty = np.full((order + 1, 3), np.nan), np.full((size, size), np.nan)
        return SensorFit(0.0, 1.0, *empty, np.inf, np.nan, 0.0, np.nan, len(used))
    centre = 0.5 * float(time.min() + time.max())
    half = max(0.5 * float(time.max() - time.min()), 1e-9)
    origin = median(point[used], axis=0)
    ground = point[used] - origin
    powers = np.vander((time - centre) / half, order + 1, increasing=True)
    with np.errstate(all="ignore"):
        # Least distances of the position from the lines, weighted by 1/R^2, without outliers.
        across = np.eye(3) - unit[:, :, None] * unit[:, None, :]
        w = weight
        start = np.zeros((powers.shape[1], 3))
        for _ in range(_ROUNDS):
            right = np.einsum("nij,nj->ni", across, ground) * w[:, None]
            normal, right = _normal(powers, across * np.sqrt(w)[:, None, None], right)
            start = _solve(normal, right).reshape(start.shape)
            ahead = ground - powers @ start
            distance = np.sqrt(np.einsum("ni,ni->n", ahead, ahead))
            off = np.einsum("nij,nj->ni", across, ahead)
            error = np.sqrt(np.einsum("ni,ni->n", off, off) * weight) / distance
            w = _keep(error, weight / distance**2)
        ahead = ground - powers @ start
        unit = np.where((np.einsum("ni,ni->n", unit, ahead) < 0)[:, None], -unit, unit)
        # Angular Gauss-Newton from there; what outliers leave is 0.
        found = start.copy()
        for _ in range(_STEPS):
            ahead = ground - powers @ found
            distance = np.sqrt(np.einsum("ni,ni->n", ahead, ahead))
            q = ahead / distance[:, None]
            r = unit - q
            error = np.einsum("ni,ni->n", r, r) * weight
            w = _keep(np.sqrt(error), weight)
            across = (np.eye(3) - q[:, :, None] * q[:, None, :]) * (np.sqrt(w) / distance)[:, None, None]
            side = r - q * np.einsum("ni,ni->n", q, r)[:, None]
            normal, right = _normal(powers, across, -side * (w / distance)[:, None])
            step = _solve(normal, right)
            found += step.reshape(found.shape)
            if not np.abs(step).max() > 1e-7 * distance.max():
                break
        kept = w > 0
        freedom = max(2 * int(kept.sum()) - found.size, 1)
        residual = float(np.sqrt(error[kept].sum() / freedom))
        left = side * np.sqrt(w)[:, None]
        ahead = ground - powers @ found
        distance = float(median(np.sqrt(np.einsum("ni,ni->n", ahead, ahead))))
    found[0] += origin
    covariance = np.full(normal.shape, np.nan)
    conditions = []
    for part in (normal, normal[:3, :3]):
        values = np.linalg.eigvalsh(part) if np.isfinite(part).all() else np.zeros(1)
        conditions.append(float(values[-1] / values[0]) if values[0] > 0 else np.inf)
    if conditions[0] < 1e14:
        covariance = residual**2 * _redundancy(time, unit, left) * np.linalg.inv(normal)
    extent = measure_extent(unit)
    return SensorFit(centre, half, found, covariance, conditions[1], distance, extent, residual, len(used))


def fit_best(
    time: np.ndarray, point: np.ndarray, direction: np.ndarray, weight: np.ndarray | None = None
) -> SensorFit | None:
    """The fit of the order with the smallest expected error of the range; None where none is sound.

    Parameters
    ----------
    time, point, direction, weight
        As for `fit_sensor`.

    Returns
    -------
    SensorFit or None
    """
    best, least = None, np.inf
    for order in (2, 1, 0):
        fit = fit_sensor(time, point, direction, weight, order)
        if not fit.is_sound:
            continue
        at = np.linspace(fit.centre - fit.half, fit.centre + fit.half, 9)
        down = np.broadcast_to(np.array([0.0, 0.0, -1.0]), (9, 3))
        expected = float(np.sqrt(np.mean(range_error(fit, at, down) ** 2)))
        if expected < least:
            best, least = fit, expected
    return best if best is not None and least < LARGEST_ERROR * best.distance else None


def measure_turn(
    fit: SensorFit, time: np.ndarray, point: np.ndarray, direction: np.ndarray, weight: np.ndarray
) -> TurnSeen:
    """Measure by how much the directions of a window are turned against its points.

    Rays that are turned about a common axis meet no longer: a shift of the sensor explains most of it, but not what
    grows with the square of the angle across the flight, or with the distance.

    Parameters
    ----------
    fit : SensorFit
        A sound fit of these rays.
    time, point, direction, weight
        As for `fit_sensor`.

    Returns
    -------
    TurnSeen
    """
    order = len(fit.coefficients) - 1
    powers = np.vander((time - fit.centre) / fit.half, order + 1, increasing=True)
    ahead = point - powers @ fit.coefficients
    distance = np.sqrt(np.einsum("ni,ni->n", ahead, ahead))
    q, unit = ahead / distance[:, None], direction / np.sqrt(np.einsum("ni,ni->n", direction, direction))[:, None]
    unit = np.where((np.einsum("ni,ni->n", unit, q) < 0)[:, None], -unit, unit)
    r = unit - q
    root = np.sqrt(_keep(np.sqrt(np.einsum("ni,ni->n", r, r) * weight), weight))[:, None]
    across = (np.eye(3) - q[:, :, None] * q[:, None, :]) * (root / distance[:, None])[:, :, None]
    moves = (across[:, :, None, :] * powers[:, None, :, None]).reshape(3 * len(q), -1)
    turns = (np.cross(np.eye(3), q[:, None]).transpose(0, 2, 1) * root[:, :, None]).reshape(-1, 3)
    off = np.column_stack([turns, ((r - q * np.einsum("ni,ni->n", q, r)[:, None]) * root).ravel()])
    explained = np.linalg.lstsq(moves, off, rcond=STILL)[0]
    # What mirrors do is a function of the angle across the flight: by relief alone a turn is something else.
    angle, axes = _find_across(unit)
    bends = np.vander(angle / max(float(np.abs(angle).max()), 1e-9), BENDS, increasing=True)[:, 1:]
    mirror = ((across @ axes)[:, :, None, :] * bends[:, None, :, None]).reshape(3 * len(q), -1)
    parts = []
    for some in (moves, np.hstack([moves, mirror])):
        # What a turn does to the rays, and what they miss, without what these motions explain.
        rest = off - some @ np.linalg.lstsq(some, off, rcond=STILL)[0]
        normal, right = rest[:, :3].T @ rest[:, :3], rest[:, :3].T @ rest[:, 3]
        left = (rest[:, 3] - rest[:, :3] @ (np.linalg.pinv(normal, hermitian=True) @ right)).reshape(-1, 3)
        kept = int((root > 0).sum())
        variance = float((left * left).sum()) / max(2 * kept - some.shape[1] - 3, 1) * _redundancy(time, unit, left)
        variance = max(variance, 1e-30)
        parts.append((normal / variance, right / variance, normal / kept * (fit.distance / SCANNER) ** 2))
    information, right, floor = (np.stack(values) for values in zip(*parts, strict=True))
    return TurnSeen(information, right, floor, explained[:3, :3])


def measure_extent(unit: np.ndarray) -> float:
    """Return twice the angle from the mean direction within which 98 % of the directions lie [rad]."""
    mean = unit.mean(axis=0)
    mean /= max(float(np.sqrt(mean @ mean)), 1e-12)
    off = unit - mean
    return float(4.0 * np.arcsin(np.clip(0.5 * quantile(np.sqrt(np.einsum("ni,ni->n", off, off)), 0.98), 0, 1)))


def _normal(powers: np.ndarray, across: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations of the coefficients: across, the projector of each pulse times the root of its weight (n, 3, 3),
    and the right side of its position (n, 3)."""
    size = 3 * powers.shape[1]
    rows = (across[:, :, None, :] * powers[:, None, :, None]).reshape(-1, size)
    return rows.T @ rows, (powers.T @ right).reshape(size)


def _solve(normal: np.ndarray, right: np.ndarray) -> np.ndarray:
    if not np.isfinite(normal).all():
        return np.full(len(right), np.nan)
    return np.linalg.lstsq(normal, right, rcond=None)[0]


def _keep(error: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Weights, 0 for what lies beyond four robust standard deviations."""
    limit = CLIP * max(float(median(error)), 1e-12)
    return np.where(error <= limit, weight, 0.0)


def _redundancy(time: np.ndarray, unit: np.ndarray, left: np.ndarray) -> float:
    """Factor of the covariance because errors of pulses are not independent, 1 at least.

    Errors of attitude, mounting and motion are alike in neighbouring pulses, so that many pulses do not average them
    out. The residuals' autocorrelation shows it, in the order of time and in that of the direction across the flight.
    """
    orders = time, _find_across(unit)[0]
    by_time, by_angle = (_sum_correlation(left[np.argsort(order, kind="stable")]) for order in orders)
    return max(np.sqrt(by_time), 1.0 + SYSTEMATIC**2 * (by_angle - 1.0))


def _find_across(unit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Angles across the flight from the middle of the swath, float64 (n,) [rad], and the axes across and along it, to
    which the middle ray is perpendicular, float64 (3, 2)."""
    mean = unit.mean(axis=0)
    off = unit - mean
    across = np.linalg.eigh(off.T @ off)[1][:, -1]
    return off @ across, np.stack([across, np.cross(across, mean)], axis=1)


def _sum_correlation(values: np.ndarray) -> float:
    """1 + 2 sum of the autocorrelation (n, 3) over the lags before it first falls to what noise shows."""
    n = len(values)
    size = 1 << (2 * n - 1).bit_length()
    power = np.abs(np.fft.rfft(values, size, axis=0)) ** 2
    correlation = np.fft.irfft(power.sum(axis=1), size)[: n // 4]
    if not len(correlation) or not correlation[0] > 0:
        return 1.0
    correlation = correlation / correlation[0]
    end = np.flatnonzero(correlation < 1.0 / np.sqrt(n))
    return float(1.0 + 2.0 * correlation[1 : end[0] if len(end) else None].sum())
