"""Pulse models of a fit: unit pulses and their derivatives for many echoes at once, and tables of their peak and width.

Used by every fit, by `render` and by stages/pulse_tables. Everything is in samples. A model must be finite for
any position and width, because fits try many (docs/algorithms.md 0, R1). Gauss-Hermite moments of residuals say how far
an echo deviates from the pulse (docs/algorithms.md 4.2): attribute pulse_deviation; the fit computes its own in
kernels/c/next_echo.h.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import lru_cache

import numpy as np

from wavebatch.core.frozen import NamedTuple
from wavebatch.core.order import distinct
from wavebatch.core.units import FWHM_PER_SIGMA
from wavebatch.kernels import library
from wavebatch.kernels.elementary import exp, log, log1p, solve
from wavebatch.kernels.signal.runs import lobe_edges

NO_SKEW = 1e-6
"""Below this |kappa| a pulse counts as symmetric: the skewed formula divides by kappa."""


class PulseTable(NamedTuple):
    """A pulse of any shape as a table: height 1, peak at 0, linear between its rows, 0 at both ends.

    The abscissa is in units in which the full width at half maximum is that of a Gaussian of standard deviation 1.
    """

    first: float
    """Abscissa of the first row."""
    step: float
    """Distance of two rows."""
    value: np.ndarray
    """Height, float32 (r,)."""
    slope: np.ndarray
    """Derivative of the height, float32 (r,)."""
    datum: float
    """Abscissa of the centre of the Gaussian that fits the pulse best (`fit_one_gaussian`)."""


class PulseShape(NamedTuple):
    """Model of the system pulse: a Gaussian (plain, skewed, generalized), a learned sum of Gaussians, or a table."""

    kappa: float = 0.0
    """Skew of the log-normal pulse in its stable form; 0 for the others."""
    components: tuple[tuple[float, float, float], ...] = ()
    """Further Gaussians of a learned pulse, relative to the first: weight per unit of its area, delay after it
    [samples], variance minus its variance [samples^2].
    """
    power: float = 2.0
    """Exponent p of the generalized Gaussian exp(-|z|^p / 2); 2 for the others."""
    table: PulseTable | None = None
    """Pulse of any shape, stretched in time by the width; None for the others."""
    origin: str = ""
    """"segment" or "waveform": a log-normal that begins a sample before its window or waveform, so that its skew is
    the width over the distance of the peak from there (docs/algorithms.md 1.2); empty for the others."""


GAUSSIAN = PulseShape()
"""The plain Gaussian."""


def evaluate_pulse(shape: PulseShape, x: np.ndarray, t: np.ndarray, s: np.ndarray) -> tuple[np.ndarray, ...]:
    """Unit pulse, and its derivatives by time and by width times the width.

    Parameters
    ----------
    shape : PulseShape
        Model of the pulse.
    x : float, samples
        Sample positions.
    t, s : float, samples
        Centre and width of echoes; x, t and s broadcast. float32 in a fit, float64 elsewhere.

    Returns
    -------
    pulse, by_time, by_width : float
        Of the broadcast shape. With amplitude A the Jacobian is pulse, A/s by_time, A/s by_width.

    References
    ----------
    docs/algorithms.md 0 (Gaussian, skewed) and R1 (learned).
    """
    z = x - t
    z *= 1 / s
    if shape.components:
        # A sum of Gaussians that a target widens together; amplitude of the first one (docs/algorithms.md R1).
        pulse, by_time, by_width = _evaluate_gaussian(z)
        variance = s * s
        for weight, delay, extra in shape.components:
            wide = variance + np.float32(extra)
            inverse = 1 / np.sqrt(wide)
            ratio = s * inverse
            d = (x - (t + np.float32(delay))) * inverse
            part, part_time, part_width = _evaluate_gaussian(d)
            part *= np.float32(weight) * ratio
            pulse += part
            by_time += part_time * (np.float32(weight) * ratio * ratio)
            # d/ds of ratio * exp(-d^2/2): s * (1/s - s/wide) * part + (s/wide) * s * weight * ratio * part_width
            by_width += part * (1 - ratio * ratio)
            by_width += part_width * (np.float32(weight) * ratio * ratio * ratio)
        return pulse, by_time, by_width
    if shape.table is not None:
        place = (z - z.dtype.type(shape.table.first)) * z.dtype.type(1 / shape.table.step)
        np.clip(place, 0, len(shape.table.value) - 1.001, out=place)
        row = place.astype(np.int32)
        place -= row
        columns = (shape.table.value, shape.table.slope)
        pulse, slope = (column[row] + place * (column[row + 1] - column[row]) for column in columns)
        return pulse, -slope, -slope * z
    if shape.power != 2.0:
        # f = exp(-|z|^p / 2).
        kind = z.dtype.type
        distance = np.maximum(np.abs(z), kind(1e-6))
        by_width = exp(kind(shape.power) * log(distance))
        pulse = exp(kind(-0.5) * by_width)
        by_width *= kind(0.5 * shape.power) * pulse
        return pulse, np.copysign(by_width / distance, z), by_width
    if abs(shape.kappa) >= NO_SKEW:
        # f = exp(-L^2/2), L = log1p(kappa z)/kappa, 0 where kappa z <= -1 (docs/algorithms.md 0).
        inside = np.float32(shape.kappa) * z
        gone = inside <= np.float32(-0.999999)
        inside[gone] = 0
        level = log1p(inside)
        level *= np.float32(1 / shape.kappa)
        pulse = exp(np.float32(-0.5) * level * level)
        pulse[gone] = 0
        inside += np.float32(1)
        by_time = pulse * level
        by_time /= inside
        return pulse, by_time, by_time * z
    return _evaluate_gaussian(z)


def _evaluate_gaussian(z: np.ndarray) -> tuple[np.ndarray, ...]:
    pulse = z * z
    pulse *= np.float32(-0.5)
    pulse = exp(pulse)
    by_time = pulse * z
    z *= by_time
    return pulse, by_time, z


LEAST_RISE = 1e-3
"""Share by which half widths are made to grow over the allowed widths where they would not."""


class PulseTail(NamedTuple):
    """After-pulses of a learned pulse, per unit of amplitude, by lag on a grid of TAIL_STEP."""

    first: float
    """Lag of the first value [samples]."""
    value: np.ndarray
    """The tail, float64 (r,)."""
    highest: np.ndarray
    """From each lag after 0 on, the largest size that follows, float64."""


TAIL_STEP = 0.25
"""Step of the lags [samples]."""
CORE = 2.5
"""Within this many widths of the main part a tail is one echo with it."""


@lru_cache(maxsize=16)
def pulse_tail(shape: PulseShape, width: float) -> PulseTail:
    """After-pulses and ringing of a learned pulse; cached for the next block.

    Parameters
    ----------
    shape : PulseShape
        Learned, with further components.
    width : float, samples
        Width of the main part.

    Returns
    -------
    PulseTail
    """
    reach = max(abs(delay) + 4 * np.sqrt(max(width**2 + extra, 0.0)) for _, delay, extra in shape.components)
    lag = np.arange(-np.ceil(reach / TAIL_STEP), np.ceil(reach / TAIL_STEP) + 1) * TAIL_STEP
    time, wide = np.zeros(1), np.full(1, width)
    whole = evaluate_pulse(shape, lag[:, None], time, wide)[0][:, 0]
    value = np.where(np.abs(lag) > CORE * width, whole - exp(-0.5 * (lag / width) ** 2), 0.0)
    highest = np.maximum.accumulate(np.abs(value[len(lag) // 2 :])[::-1])[::-1]
    return PulseTail(float(lag[0]), value, np.ascontiguousarray(highest))


class PulseMeasures(NamedTuple):
    """Peak and full width at half maximum of a pulse by its fitted width: tables, float64 (200,)."""

    width: np.ndarray
    """Fitted width [samples], ascending."""
    peak: np.ndarray
    """Height of the peak over the amplitude of the main part."""
    half_width: np.ndarray
    """Full width at half maximum of the main lobe [samples], ascending."""


@lru_cache(maxsize=16)
def measure_pulse(shape: PulseShape, low: float, high: float) -> PulseMeasures:
    """Peak and full width at half maximum of a sum of Gaussians, over a range of widths; cached for the next block.

    Parameters
    ----------
    shape : PulseShape
        Model of the pulse, without skew or table.
    low, high : float, samples
        Smallest and largest width.

    Returns
    -------
    PulseMeasures
    """
    widths = np.linspace(low, high, 200)
    terms = np.array(shape.components, np.float32).reshape(-1, 3).astype(np.float64)
    peak, half_width = np.empty((2, len(widths)))
    n, k = ctypes.c_int64(len(widths)), ctypes.c_int64(len(terms))
    library.call("measure_lobes", n, widths, k, terms, peak, half_width)
    # Half widths are inverted to find widths, so they must grow. Some flat-topped sums have dips, which are deeper
    # where the sum is narrow: the pulse is lower there, its half width larger.
    if not np.all(np.diff(half_width) > 0):
        level = np.minimum.accumulate(half_width[::-1])[::-1]
        half_width = level * (1 + LEAST_RISE * np.linspace(0, 1, len(level)))
    return PulseMeasures(widths, peak, half_width)


MOST_STEPS, LARGEST_STEP, SETTLED = 100, 0.25, 1e-9
"""Steps of `fit_one_gaussian`, the largest one, and the one that ends it [widths]."""


def fit_one_gaussian(x: np.ndarray, value: np.ndarray) -> tuple[float, float]:
    """Centre and standard deviation of the Gaussian that fits a pulse best by least squares.

    Parameters
    ----------
    x : float (r,)
        Evenly spaced positions that cover the main lobe.
    value : float (r,)
        The pulse; what lies far from its main lobe does not matter.

    Returns
    -------
    centre, sigma : float, unit of x

    Notes
    -----
    The centre is the datum of times. All models that fit the same samples have it at the same place, because what they
    leave is orthogonal to a shift of a pulse; their peaks differ, by .06 ns on a strip of Leica (docs/algorithms.md 0).
    """
    begin, end = lobe_edges(x, value, 0.5 * value.max())
    centre, sigma = 0.5 * (begin + end), (end - begin) / FWHM_PER_SIGMA
    for _ in range(MOST_STEPS):
        rows = np.stack(_evaluate_gaussian((x - centre) / sigma))
        height, by_time, by_width = solve(np.einsum("ir,jr->ij", rows, rows), np.einsum("ir,r->i", rows, value))
        move, widen = np.clip([by_time / height, by_width / height], -LARGEST_STEP, LARGEST_STEP)
        centre, sigma = centre + sigma * move, sigma * (1 + widen)
        if max(abs(move), abs(widen)) < SETTLED:
            break
    return float(centre), float(sigma)


@lru_cache(maxsize=16)
def matched_gaussian(shape: PulseShape, width: float) -> tuple[float, float]:
    """Return the Gaussian that fits a pulse best: cached, since each block needs it.

    Parameters
    ----------
    shape : PulseShape
        A pulse.
    width : float
        Its width [samples].

    Returns
    -------
    centre, sigma : float
        Centre after that of the pulse's main part, and standard deviation [samples].
    """
    reach = max([8 * width, *(abs(delay) + 4 * width for _, delay, _ in shape.components)])
    x = np.arange(-reach, reach, width / 32)
    return fit_one_gaussian(x, evaluate_pulse(shape, x, np.zeros(1), np.full(1, width))[0])


TABLE_ROWS = 64
"""Rows of a tabulated pulse per unit of width: linear interpolation of a Gaussian is then exact to 3e-5 of its peak."""


def tabulate_pulse(x: np.ndarray, value: np.ndarray) -> PulseTable:
    """A table of a pulse: a cubic spline through its samples, 0 beyond them.

    Parameters
    ----------
    x : float (r,)
        Evenly spaced positions, in any unit.
    value : float (r,)
        The pulse, of any height, place and width; these are taken out.

    Returns
    -------
    PulseTable
    """
    import scipy.interpolate  # here, because most runs need none of it

    step = x[1] - x[0]
    x = np.concatenate([x[0] - step * np.arange(3, 0, -1), x, x[-1] + step * np.arange(1, 4)])
    spline = scipy.interpolate.CubicSpline(x, np.concatenate([np.zeros(3), value, np.zeros(3)]))
    fine = np.arange(x[0], x[-1], step / 64)
    pulse = spline(fine)
    top = int(np.argmax(pulse))
    begin, end = lobe_edges(fine, pulse, 0.5 * pulse[top])
    height, peak, full = float(pulse[top]), float(fine[top]), end - begin
    unit = full / FWHM_PER_SIGMA
    rows = np.arange(np.ceil((x[0] - peak) / unit * TABLE_ROWS), np.floor((x[-1] - peak) / unit * TABLE_ROWS) + 1)
    z = rows / TABLE_ROWS
    shape, slope = spline(z * unit + peak) / height, spline(z * unit + peak, 1) * unit / height
    for column in (shape, slope):
        column[[0, -1]] = 0.0
    datum = (fit_one_gaussian(fine, spline(fine))[0] - peak) / unit
    return PulseTable(float(z[0]), 1 / TABLE_ROWS, shape.astype(np.float32), slope.astype(np.float32), datum)


HERMITE_REACH = 5.0
"""Half-widths over which the Gauss-Hermite moments run: beyond, the pulse is zero."""


def residual_moments(
    read: Callable[[slice | np.ndarray, np.ndarray], np.ndarray],
    s: int,
    time: np.ndarray,
    width: np.ndarray,
    std: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Hermite moments of the residual within five widths of each echo: independent N(0, 1) if the fit is right.

    Parameters
    ----------
    read : callable
        read(rows, samples) gives residuals, float32 (k, L), of echoes `rows` at samples int32 (k, L) in 0 .. s - 1.
    s : int
        Samples per waveform.
    time, width : float (m,), samples
        Of the echoes.
    std : float (m,), count
        Noise of one sample.

    Returns
    -------
    h3, h4 : float64 (m,)
    """
    h3, h4 = np.zeros(len(time)), np.zeros(len(time))
    reach = np.minimum(np.ceil(HERMITE_REACH * width), s).astype(np.int32)
    for size in distinct(reach):
        rows = np.flatnonzero(reach == size)
        for begin in range(0, len(rows), 4096):
            part = rows[begin : begin + 4096]
            middle = np.rint(time[part])
            at = middle.astype(np.int32)[:, None] + np.arange(-size, size + 1, dtype=np.int32)
            inside = (at >= 0) & (at < s)
            cut = not inside.all()
            values = read(part, np.clip(at, 0, s - 1) if cut else at)
            # Centres are subtracted in double precision; float32 is then enough for the small rest.
            z = np.arange(-size, size + 1, dtype=np.float32) - (time[part] - middle).astype(np.float32)[:, None]
            z *= (1 / width[part]).astype(np.float32)[:, None]
            pulse, by_time, by_width = _evaluate_gaussian(z.copy())
            if cut:
                values = np.where(inside, values, np.float32(0))
                pulse, by_time, by_width = (column * inside for column in (pulse, by_time, by_width))
            # Two directions (8 z^3 - 12 z) e and (16 z^4 - 48 z^2 + 12) e.
            p3 = by_width * z
            p4 = p3 * z
            p3 *= np.float32(8)
            p3 -= np.float32(12) * by_time
            p4 *= np.float32(16)
            p4 -= np.float32(48) * by_width
            p4 += np.float32(12) * pulse
            for moment, direction in ((h3, p3[:, None]), (h4, p4[:, None])):
                # The component of the residual along a direction, made unit length.
                norm = np.sqrt(np.maximum(np.einsum("mkl,mkl->mk", direction, direction), 1e-12))
                moment[part] = (np.einsum("mkl,ml->mk", direction, values) / norm)[:, 0] / std[part]
    return h3, h4
