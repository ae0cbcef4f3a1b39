"""Incidence angles from widths of echoes: the stage attribute.incidence_angle and `surveying.flat_ground` call it.

A plane under a Gaussian beam adds a Gaussian of standard deviation w tan(alpha) / c, w = R beta / 2: range and beam
enter only by this product, so that one table of measured width by spread serves every echo (docs/algorithms.md 1.4).

`angles_of_variance` and `angles_above` give angles from the variance that a surface adds, with errors that hold for any
true angle. The square root makes it hard: near 0 half of the variances are negative, and where only large ones are
seen, these are too large.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from wavebatch.core.frozen import NamedTuple
from wavebatch.core.units import FWHM_PER_SIGMA, C
from wavebatch.kernels.signal.runs import lobe_edges

STEEPEST = np.radians(80.0)
"""Angles above this are not known (docs/algorithms.md H14)."""

PAPER_TAU = 3.5
"""Full width at half maximum of the pulse t exp(-t), in tau, as the paper prints it (docs/algorithms.md 1.4)."""

_LONGEST = 30.0
"""Spread of the last entry of a table [tau]; beyond it variances simply add."""

_PHASES = (0.0, 0.25, 0.5, 0.75)
"""Places of the first sample, in samples, over which a table is averaged."""


def spread_of_angle(angle: np.ndarray, distance: np.ndarray | float, divergence: float) -> np.ndarray:
    """Spread of the pulse by a plane.

    Parameters
    ----------
    angle : float, rad
        Between ray and surface normal.
    distance : float, m
        Sensor to echo.
    divergence : float, rad
        Full angle between the 1/e^2 points.

    Returns
    -------
    float64, ns
        Standard deviation.
    """
    return 0.5 * divergence / C * np.asarray(distance, np.float64) * np.tan(angle)


def angle_of_spread(spread: np.ndarray, distance: np.ndarray | float, divergence: float) -> np.ndarray:
    """Angle of the plane that spreads the pulse; the inverse of `spread_of_angle`.

    Parameters
    ----------
    spread : float, ns
        Standard deviation of the spread.
    distance : float, m
        Sensor to echo.
    divergence : float, rad
        Full angle between the 1/e^2 points.

    Returns
    -------
    float64, rad
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.arctan(np.asarray(spread, np.float64) * (2.0 * C / divergence) / distance)


class WidthTable(NamedTuple):
    """Measured width by spread of the pulse, both ascending, as standard deviations."""

    spread: np.ndarray
    """float64 (r,), ns."""
    width: np.ndarray
    """float64 (r,), ns."""
    cut: bool
    """True if widths stopped growing, so that the table ends there (docs/algorithms.md H15)."""


def build_table(spread: np.ndarray, width: np.ndarray) -> WidthTable:
    """A table from spreads and widths (r,) [ns], up to the last width that is larger than all before it."""
    falls = np.flatnonzero(~(np.diff(width) > 0))
    end = falls[0] + 1 if len(falls) else len(width)
    return WidthTable(spread[:end], width[:end], end < len(width))


def spread_variance(table: WidthTable, width: np.ndarray) -> np.ndarray:
    """Variance of the spread from measured widths.

    Parameters
    ----------
    table : WidthTable
        Widths by spread.
    width : float (m,), ns
        Measured widths.

    Returns
    -------
    float64 (m,), ns2
        Negative for widths below that of the system; NaN beyond the end of a table that was cut.

    Notes
    -----
    Interpolated is what the pulse itself adds to the variance; beyond the last entry it stays constant.
    """
    width = np.asarray(width, np.float64)
    of_pulse = table.width**2 - table.spread**2
    variance = width * width - np.interp(width, table.width, of_pulse)
    return np.where(width > table.width[-1], np.nan, variance) if table.cut else variance


@lru_cache(maxsize=16)
def pulse_table(sigma_ref: float, spacing: float) -> WidthTable:
    """Widths of Gaussians fitted to pulses t^2 exp(-t), by their spread.

    Parameters
    ----------
    sigma_ref : float, ns
        Width of the echo of flat ground; the length of the pulse is chosen so that its fit has this width.
    spacing : float, ns
        Time between two samples.

    Returns
    -------
    WidthTable
    """
    tau = sigma_ref / 1.435
    spread = np.r_[0.0, np.geomspace(0.05, _LONGEST, 80)]
    for _ in range(3):
        found = _fit_widths(spread[:1] * tau, tau, spacing)[0]
        tau *= sigma_ref / found
    width = _fit_widths(spread * tau, tau, spacing)
    return build_table(spread * tau, width * (sigma_ref / width[0]))


@lru_cache(maxsize=16)
def paper_table(sigma_ref: float) -> WidthTable:
    """A quarter of the widths at e^-2 by spread, as printed by Rhomberg-Kauert et al. (2024); for comparisons only.

    Pulse t exp(-t / tau) with tau = T1 / 3.5, the later half of a Gaussian, one-way times, x0 = w (docs/algorithms.md
    1.4).
    """
    tau = FWHM_PER_SIGMA * sigma_ref / PAPER_TAU
    spread = np.r_[0.0, np.geomspace(0.05, _LONGEST, 80)] * tau
    time, curves = spread_pulse(1, spread / np.sqrt(2.0), tau, causal=True)
    return build_table(spread, np.array([0.25 * direct_width(time, curve, np.exp(-2.0)) for curve in curves]))


def spread_pulse(
    exponent: int, spread: np.ndarray, tau: float, *, causal: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """The pulse t^exponent exp(-t), spread by Gaussians.

    Parameters
    ----------
    exponent : int
        Power of the rise.
    spread : float (k,), ns
        Standard deviations of the Gaussians.
    tau : float, ns
        Time constant of the pulse.
    causal : bool
        Use the later half of the Gaussians only.

    Returns
    -------
    time : float64 (s,), ns
    curves : float64 (k, s)
        Of height 1.
    """
    step = tau / 40.0
    reach = int(2 ** np.ceil(np.log2((12.0 * spread.max(initial=0.0) + 40.0 * tau) / step)))
    time = (np.arange(reach) - reach // 2) * step
    late = np.maximum(time, 0.0) / tau
    pulse = np.fft.rfft(np.fft.ifftshift(late**exponent * np.exp(-late)))
    wide = np.maximum(spread, 1e-3 * step)[:, None]
    response = np.exp(-0.5 * (time / wide) ** 2)
    if causal:
        response *= time >= 0
    response /= response.sum(axis=1, keepdims=True)
    curves = np.fft.irfft(np.fft.rfft(np.fft.ifftshift(response, axes=1), axis=1) * pulse, n=reach, axis=1)
    curves = np.fft.fftshift(curves, axes=1)
    return time, curves / curves.max(axis=1, keepdims=True)


def direct_width(time: np.ndarray, curve: np.ndarray, level: float) -> float:
    """Width of a curve at a level, between the crossings nearest to its peak.

    Parameters
    ----------
    time : float64 (s,), ns
        Abscissa.
    curve : float64 (s,)
        Of height 1.
    level : float
        Between 0 and 1.

    Returns
    -------
    float, ns
    """
    begin, end = lobe_edges(time, curve, level)
    return float(end - begin)


def _fit_widths(spread: np.ndarray, tau: float, spacing: float) -> np.ndarray:
    """Standard deviations [ns] of least-squares Gaussians, mean over the phases of the samples, per spread (k,)."""
    time, curves = spread_pulse(2, spread, tau)
    widths = np.zeros(len(spread))
    for k, curve in enumerate(curves):
        peak, half = time[np.argmax(curve)], direct_width(time, curve, 0.5)
        first, last = time[np.flatnonzero(curve > 1e-6)[[0, -1]]]
        for phase in _PHASES:
            at = np.arange(first - 3.0 * half + phase * spacing, last + spacing, spacing)
            # Gauss-Newton from a close start.
            value = np.interp(at, time, curve)
            amplitude, place, width = 1.0, peak, half / FWHM_PER_SIGMA
            for _ in range(12):
                z = (at - place) / width
                unit = np.exp(-0.5 * z * z)
                slope = amplitude / width * unit * z
                jacobian = np.stack([unit, slope, slope * z], axis=1)
                step = np.linalg.lstsq(jacobian, value - amplitude * unit, rcond=None)[0]
                amplitude, place, width = amplitude + step[0], place + step[1], max(width + step[2], 0.3 * width)
            widths[k] += width / len(_PHASES)
    return widths


RADIUS = np.array([
    (-3.0, 0.543), (-2.0, 0.463), (-1.5, 0.446), (-1.0, 0.620), (-0.5, 0.872), (-1e-3, 1.136), (0.0, 0.853),
    (0.1, 0.818), (0.2, 0.795), (0.3, 0.793), (0.4, 0.866), (0.5, 0.932), (0.6, 0.870), (0.7, 0.581), (0.8, 0.368),
    (0.9, 0.432), (1.0, 0.440), (1.1, 0.421), (1.2, 0.389), (1.3, 0.365), (1.4, 0.345), (1.5, 0.315), (1.6, 0.309),
    (1.7, 0.289), (1.8, 0.276), (1.9, 0.261), (2.0, 0.248), (2.3, 0.214), (2.7, 0.185),
]).T  # fmt: skip
"""Radius around sqrt(max(u, 0)) that holds sqrt(mu) for 68.3 % of the draws u of a normal law around mu, any mu >= 0.

First row: u where it is negative, else sqrt(u); second row: the radius. Solved numerically for equal coverage. It must
fall near 0.7: a true 0 lies within the radius for the lower 68.3 % of u and outside for all others.
"""


def angles_of_variance(
    variance: np.ndarray, variance_err: np.ndarray, distance: np.ndarray, divergence: float
) -> tuple[np.ndarray, np.ndarray]:
    """Angles from the variance that a surface adds to the pulse.

    Parameters
    ----------
    variance, variance_err : float (m,), ns2
        Added variance and its standard deviation.
    distance : float (m,), m
        Sensor to echo.
    divergence : float, rad
        Full angle between the 1/e^2 points.

    Returns
    -------
    angle, error : float64 (m,), rad
        0 where the variance is not positive; NaN above 80 degrees and where an input is not known.

    Notes
    -----
    For steep planes the error is sigma_s s c^2 / (w^2 tan sec^2), by propagation through the square root. Near 0 the
    root is not linear and half of the variances are negative: there the error is a radius from RADIUS, such that 68.3 %
    of the angles lie within it for any true angle. Source: docs/algorithms.md 1.4.
    """
    known = np.isfinite(variance) & np.isfinite(variance_err) & (variance_err > 0) & (np.asarray(distance) > 0)
    variance, variance_err = np.where(known, variance, np.nan), np.where(known, variance_err, np.nan)
    spread = np.sqrt(np.maximum(variance, 0.0))
    radius = _radius(variance, variance_err, spread)
    high, middle, low = (angle_of_spread(spread + step, distance, divergence) for step in (radius, 0.0, -radius))
    error = 0.5 * (high - low)
    steep = middle > STEEPEST
    return np.where(steep, np.nan, middle), np.where(steep, np.nan, error)


def angles_above(
    variance: np.ndarray, variance_err: np.ndarray, distance: np.ndarray, divergence: float, threshold: float
) -> tuple[np.ndarray, np.ndarray]:
    """Angles of echoes that are given only because their variance exceeds so many errors.

    Parameters
    ----------
    variance, variance_err, distance, divergence
        As for `angles_of_variance`; all variances exceed the threshold.
    threshold : float
        In errors of the variance.

    Returns
    -------
    angle, error : float64 (m,), rad
        Of the true variance for which half of all echoes above the threshold lie above this one, and half the distance
        of those for which 16 and 84 % do.

    Notes
    -----
    Near the threshold, only echoes that noise has widened are seen, so their plain angles are too large: by 1.75 errors
    if a tenth of the echoes is seen. The angles and errors given here are right for the echoes that are seen.
    """
    bounds = []
    with np.errstate(invalid="ignore", divide="ignore"):
        over = variance / variance_err - threshold
        for true in _conditional_table().T[1:]:
            place = np.interp(over, _conditional_table()[:, 0], true)
            beyond = over > _FARTHEST
            true_variance = variance_err * (threshold + np.where(beyond, over + true[-1] - _FARTHEST, place))
            bounds.append(angle_of_spread(np.sqrt(np.maximum(true_variance, 0.0)), distance, divergence))
    low, middle, high = bounds
    # Just above the threshold all three may be 0: then nothing is known but that the surface may face the sensor.
    facing = angle_of_spread(_radius(np.zeros(1), variance_err, np.zeros(1)), distance, divergence)
    error = np.where(middle > 0, 0.5 * (high - low), np.maximum(high, facing))
    steep = middle > STEEPEST
    return np.where(steep, np.nan, middle), np.where(steep, np.nan, error)


_FARTHEST = 8.0
"""Errors above a threshold beyond which it no longer matters."""


@lru_cache(maxsize=1)
def _conditional_table() -> np.ndarray:
    """Rows: a measurement above a threshold at 0, then the means of the normal law (of width 1) for which 16, 50 and
    84 % of the measurements that are above the threshold lie above it."""
    import scipy.special  # here, because most runs need none of it

    over = np.r_[np.geomspace(1e-3, 0.1, 60), np.linspace(0.1, _FARTHEST, 400)[1:]]
    columns = [over]
    for share in (0.1587, 0.5, 0.8413):
        low, high = np.full(len(over), -4000.0), np.full(len(over), _FARTHEST + 8.0)
        for _ in range(60):
            middle = 0.5 * (low + high)
            above = np.exp(scipy.special.log_ndtr(middle - over) - scipy.special.log_ndtr(middle))
            low, high = np.where(above < share, middle, low), np.where(above < share, high, middle)
        columns.append(0.5 * (low + high))
    return np.stack(columns, axis=1)


def _radius(variance: np.ndarray, variance_err: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Error of the spread [ns] from the variance [ns2], its error, and its root."""
    with np.errstate(divide="ignore", invalid="ignore"):
        below = variance / variance_err
        place = np.where(variance < 0, below, np.sqrt(np.maximum(below, 0.0)))
        near = np.interp(place, *RADIUS) * np.sqrt(variance_err)
        return np.where(place > RADIUS[0][-1], variance_err / (2.0 * spread), near)
