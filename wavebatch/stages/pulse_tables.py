"""The strip's pulse in samples and its tables: detectors, decomposers, attributes and the survey call it.

Tables turn fitted widths into echo widths. A learned pulse is a sum of Gaussians: kernels fit its main component, echo
tables describe the whole pulse. Kernels place a skewed pulse by its peak; echo tables place every pulse by its datum.

`reference_pulse` gives what detectors and decomposers compare waveforms with: samples of unit height and their peak.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Literal

import numpy as np

from wavebatch.core.errors import ConfigError
from wavebatch.core.frozen import NamedTuple
from wavebatch.core.units import FWHM_PER_SIGMA
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.kernels.elementary import exp, interpolate, log
from wavebatch.kernels.fit.decompose import NO_ROWS, STRETCHED, SUMMED, WholePulse, describe_whole
from wavebatch.kernels.fit.pulse_shape import (
    GAUSSIAN,
    NO_SKEW,
    PulseMeasures,
    PulseShape,
    evaluate_pulse,
    matched_gaussian,
    measure_pulse,
)
from wavebatch.kernels.signal.filters import refine_peaks
from wavebatch.kernels.signal.noise import LEAST_FACTOR, colour_factors, fit_factors, whitening_filter


def pulse_shape(system: SystemPulse, spacing: float) -> PulseShape:
    """Return the strip's pulse in samples: learned, skewed or Gaussian, whichever the survey set.

    Parameters
    ----------
    system : SystemPulse
        Result of the survey.
    spacing : float
        Time between two samples [ns].

    Returns
    -------
    PulseShape
        Pulse for the kernels.
    """
    if len(system.components) > 1:
        return _learned_shape(system.components, spacing)
    return PulseShape(kappa=system.kappa) if abs(system.kappa) >= NO_SKEW else GAUSSIAN


@lru_cache(maxsize=16)
def _learned_shape(components: tuple[tuple[float, ...], ...], spacing: float) -> PulseShape:
    weight, delay, sigma = components[0]
    rest = tuple(
        (w * s / (weight * sigma), (d - delay) / spacing, (s * s - sigma * sigma) / spacing**2)
        for w, d, s in components[1:]
    )
    return PulseShape(components=rest)


def clip_level(block: WaveformBlock, system: SystemPulse) -> float:
    """Return the count at which samples are clipped: the survey's, or the largest count of the digitizer.

    A survey looks at a sample of the strip only and may miss its few clipped echoes.

    Parameters
    ----------
    block : WaveformBlock
        With its digitizer.
    system : SystemPulse
        Result of the survey.

    Returns
    -------
    float
        Level [DN].
    """
    level = block.digitizer.max_count if system.saturation is None else system.saturation
    return int(level) if level % 1 == 0 else level  # whole samples are compared with it in a sixth of the time


FAR_FROM_FLOOR = 3.0
"""Noises that a baseline lies above count 0 where samples of that count are an undershoot that was cut off: noise makes
one sample of 740 so low."""


def floor_level(system: SystemPulse) -> float:
    """Return the count up to which samples are cut off: 0, as a digitizer records no less; -inf where noise is so low.

    Parameters
    ----------
    system : SystemPulse
        Result of the survey.

    Returns
    -------
    float
        Level [DN].
    """
    noise = system.noise
    return 0.0 if noise.baseline > FAR_FROM_FLOOR * np.hypot(noise.quiet, noise.baseline_spread) else -np.inf


def fit_misfit(system: SystemPulse, spacing: float) -> float:
    """Return the misfit of the pulse as fits see it: whitened, it grows with the third and fourth Hermite directions.

    Parameters
    ----------
    system : SystemPulse
        Result of the survey.
    spacing : float
        Time between two samples [ns].

    Returns
    -------
    float
        Share of the amplitude.
    """
    noise = system.noise
    if not (noise.whitening and system.misfit):
        return system.misfit
    return system.misfit * _misfit_gain(noise.whitening, noise.std / noise.quiet, system.sigma_ref / spacing)


@lru_cache(maxsize=16)
def _misfit_gain(whitening: tuple[float, ...], gain: float, ref: float) -> float:
    z = np.arange(-np.ceil(6 * ref), np.ceil(6 * ref) + 1) / ref
    bell = exp(-0.5 * z * z)
    both = (8 * z**3 - 12 * z) * bell, (16 * z**4 - 48 * z**2 + 12) * bell
    taps = whitening_filter(whitening, gain)[2]
    gains = [np.sum(np.convolve(one, taps) ** 2) / np.sum(one * one) for one in both]
    return max(float(np.sqrt(max(gains))), 1.0)


class ShapeLimits(NamedTuple):
    """Width of the system pulse and limits of fitted widths, of a pulse model's main component [samples]."""

    ref: float
    low: float
    high: float


LEAST_WIDTH, MOST_WIDTH = 0.7, 4.0
"""Widths that fits allow where a chain says nothing [widths of the system pulse] (docs/algorithms.md H3)."""

BROADEST = 100.0
"""Largest width that tables of learned pulses hold [widths of the system pulse]."""


def shape_limits(
    system: SystemPulse, spacing: float, least: float = LEAST_WIDTH, most: float = MOST_WIDTH
) -> ShapeLimits:
    """Return the allowed widths, positive for every component of a learned pulse.

    Parameters
    ----------
    system : SystemPulse
        Result of the survey.
    spacing : float
        Time between two samples [ns].
    least, most : float
        Smallest and largest width [widths of the system pulse].

    Returns
    -------
    ShapeLimits
        Widths in samples.

    References
    ----------
    docs/algorithms.md H3.
    """
    shape = pulse_shape(system, spacing)
    ref = (system.components[0][2] if shape.components else system.sigma_ref) / spacing
    positive = _narrowest(shape, ref)
    return ShapeLimits(ref, max(least * ref, positive), max(most * ref, positive))


def _narrowest(shape: PulseShape, ref: float) -> float:
    """The least width of which every component has one."""
    narrowest = min((extra for _, _, extra in shape.components), default=0.0)
    return float(np.sqrt(max(0.05 * ref * ref - narrowest, 0.0)))


def _find_delay(shape: PulseShape, ref: float, width: np.ndarray) -> tuple[np.ndarray | float, np.ndarray | float]:
    """Datum after the fitted time, and its slope by the width, of echoes of these widths (m,) [samples].

    The datum is the centre of the Gaussian that fits the echo of a flat target best. A target that widens a sum of
    Gaussians leaves it where it is. A pulse that is stretched lies otherwise around it: by how much follows from the
    third moment, which a target leaves alone (docs/algorithms.md 0).
    """
    if shape.components:
        return matched_gaussian(shape, ref)[0], 0.0
    datum = _unit_datum(shape)
    ratio = np.maximum(width / ref, LEAST_WIDTH)
    return datum * ref * (ratio + ratio**-2 - 1), datum * (1 - 2 * ratio**-3)


def _unit_datum(shape: PulseShape) -> float:
    """Datum of a stretched pulse of width 1 after its fitted time."""
    return shape.table.datum if shape.table is not None else matched_gaussian(PulseShape(shape.kappa), 1.0)[0]


def _is_symmetric(shape: PulseShape) -> bool:
    """Whether a pulse needs no description: its parameters are those of its echoes."""
    return not shape.components and shape.table is None and abs(shape.kappa) < NO_SKEW


def _usual(shape: PulseShape, limits: ShapeLimits) -> tuple[float, float]:
    """Ends of the table of usual widths: one for all fits that allow no narrower ones, since it takes long."""
    low = min(limits.low, max(LEAST_WIDTH * limits.ref, _narrowest(shape, limits.ref)))
    return low, min(limits.high, max(MOST_WIDTH * limits.ref, 1.01 * limits.low))


def _wide(limits: ShapeLimits) -> tuple[float, float]:
    """Those of the table of all widths above: one of both would be too coarse for the usual ones."""
    usual = max(MOST_WIDTH * limits.ref, 1.01 * limits.low)
    return usual, max(BROADEST * limits.ref, 1.01 * usual)


@lru_cache(maxsize=16)
def noise_factors(shape: PulseShape, width: float, correlation: tuple[float, ...]) -> np.ndarray:
    """What coloured noise does to a pulse of this width [samples], over white noise of the same variance (4,).

    To the amplitude of a pulse of known time and width, and to amplitude, time and width of a fit.
    """
    return np.array(colour_factors(correlation, *_pulse_rows(shape, [width])[0]))


def _pulse_rows(shape: PulseShape, widths: Sequence[float]) -> list[np.ndarray]:
    """Pulses of amplitude 1 and their derivatives by time and width, at every sample where each is more than noise."""
    widths = [min(max(width, NARROWEST_FACTOR), WIDEST_FACTOR) for width in widths]
    reaches = [int(np.ceil(5 * width)) + 1 for width in widths]
    tails = [max([0.0, *(abs(delay) + 3 * width for _, delay, _ in shape.components)]) for width in widths]
    ends = [min(max(reach, int(np.ceil(tail))), FARTHEST_FACTOR) for reach, tail in zip(reaches, tails, strict=True)]
    most = max(reaches)
    x = np.arange(-most, max(ends) + 1, dtype=np.float64)
    rows = np.stack(evaluate_pulse(shape, x, np.zeros((len(widths), 1)), np.array(widths)[:, None]), axis=1)
    parts = zip(rows, reaches, ends, strict=True)
    return [np.ascontiguousarray(row[:, most - reach : most + end + 1]) for row, reach, end in parts]


NARROWEST_FACTOR, WIDEST_FACTOR = 0.2, 200.0
"""Widths [samples] beyond which factors stay as they are there. A narrower pulse lies on one sample, so that time and
width have no derivative; over a wider one, noise is as good as white, and tables would grow with the square."""

FARTHEST_FACTOR = 1024
"""Samples after the peak to which a pulse counts in factors."""

FACTOR_WIDTHS = 12
"""Widths at which the factors of errors are tabulated."""


def error_factors(
    system: SystemPulse, spacing: float, width: np.ndarray, level_err: np.ndarray | None = None
) -> np.ndarray:
    """Errors of echoes in coloured noise over baselines with errors, over those of a fit in white noise of `noise.std`.

    Parameters
    ----------
    system : SystemPulse
        Result of the survey.
    spacing : float
        Time between two samples [ns].
    width : float array, shape (m,)
        Fitted widths [samples].
    level_err : float array, shape (m,), optional
        Standard deviations of the baselines under the echoes [`noise.std`].

    Returns
    -------
    float64 array, shape (m, 4)
        Of amplitude, time and sigma as `describe_fitted` gives them, and of the energy; 1 in white noise. They are
        those of lone echoes.

    Notes
    -----
    `noise.std` is what coloured noise does to amplitudes; times and widths suffer less from noise that changes slowly
    (docs/algorithms.md H11). A whitened fit is right where its two coefficients say all of the noise.
    """
    noise = system.noise
    if not noise.correlation and level_err is None:
        return np.ones((len(width), 4))
    shape, limits = pulse_shape(system, spacing), shape_limits(system, spacing)
    given = shape, limits, noise.correlation, noise.whitening
    widths, factors = _factor_table(*given)
    # Only those beside a width that is asked for: to make all takes a tenth of a survey.
    ends = [least.reduce(width, initial=limits.ref) for least in (np.fmin, np.fmax)]
    low, high = np.searchsorted(widths, ends).tolist()
    low, high = max(low - 1, 0), high + 1
    missing = low + np.flatnonzero(np.isnan(factors[low:high, 0]))
    if len(missing):
        factors[missing] = _factors_at(widths[missing], *given)
    widths, factors = widths[low:high], factors[low:high]
    if level_err is None:
        return interpolate(width, widths, factors[:, :4])
    if noise.whitening:
        level_err = level_err * noise.std / noise.quiet
    found = interpolate(width, widths, factors)
    found[:, 4:] *= level_err[:, None]
    found *= found
    return np.sqrt(found[:, :4] + found[:, 4:])


@lru_cache(maxsize=16)
def _factor_table(shape: PulseShape, limits: ShapeLimits, *noise: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Widths (k,), and room for their factors in this noise (k, 8): NaN until they are asked for."""
    return exp(np.linspace(log(limits.low), log(limits.high), FACTOR_WIDTHS)), np.full((FACTOR_WIDTHS, 8), np.nan)


def _factors_at(
    widths: np.ndarray, shape: PulseShape, limits: ShapeLimits,
    correlation: tuple[float, ...], whitening: tuple[float, ...],
) -> np.ndarray:  # fmt: skip
    """Errors of amplitude, time, width and energy over those that the fit gives, and by a wrong level (m, 8).

    The last four are of a level that is wrong by the noise of a sample.
    """
    by_time, by_amplitude = _find_delay(shape, limits.ref, widths)[1] + np.zeros(len(widths)), np.zeros(len(widths))
    if shape.components:
        # The peak of a pulse of amplitude 1, and its slope by the width.
        table = _rows(shape, limits.low, limits.high)
        peak, by_peak = (np.interp(widths, table[:, 0], table[:, column]) for column in (1, 2))
        by_amplitude = by_peak / peak * widths
    taps = whitening_filter(whitening)[2] if whitening else None
    rows = zip(_pulse_rows(shape, widths.tolist()), by_amplitude, by_time, strict=True)
    found = np.array([fit_factors(*row, taps, correlation) for row in rows])
    # A fit that takes noise for white has errors by `noise.std`, one that whitens it by the noise of a sample.
    alone = 1.0 if whitening else max(noise_factors(shape, limits.ref, correlation)[0], 1.0)
    found[:, :4] = np.sqrt(np.maximum(found[:, :4], LEAST_FACTOR)) / alone
    return found


def describe_fitted(
    shape: PulseShape, limits: ShapeLimits, parameters: np.ndarray, errors: np.ndarray, shared: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Turn fitted parameters into amplitude, time and sigma of the whole pulse.

    The amplitude of a learned pulse is the height of its peak, sigma the full width at half maximum of the main lobe
    over 2.354820. The time of every pulse is that of its datum (`matched_gaussian` of a flat target's echo), so that it
    means the same for every model.

    Parameters
    ----------
    shape : PulseShape
        The fitted pulse.
    limits : ShapeLimits
        Its widths.
    parameters, errors : float64 array, shape (m, 3)
        Amplitude [DN], time [samples] and width [samples], and their standard deviations.
    shared : float64 array, shape (m, 2)
        Covariance of amplitude and width, and of time and width: peak and datum of the pulse change with its width.

    Returns
    -------
    parameters, errors : float64 array, shape (m, 3)
        The same of the whole pulse.
    """
    return describe_whole(whole_pulse(shape, limits, parameters[:, 2]), parameters, errors, shared)


def whole_pulse(shape: PulseShape, limits: ShapeLimits, widths: np.ndarray) -> WholePulse:
    """Return what `describe_fitted` takes whole echoes from.

    Parameters
    ----------
    shape : PulseShape
        The fitted pulse.
    limits : ShapeLimits
        Its widths.
    widths : float array, shape (m,)
        Fitted widths [samples]: the table of the widest is made where one of them needs it.

    Returns
    -------
    WholePulse
    """
    if _is_symmetric(shape):
        return WholePulse()
    if not shape.components:
        return WholePulse(STRETCHED, datum=_unit_datum(shape), ref=limits.ref, least=LEAST_WIDTH)
    near = _rows(shape, *_usual(shape, limits))
    wide = _rows(shape, *_wide(limits)) if (widths > near[-1, 0]).any() else NO_ROWS
    return WholePulse(SUMMED, near, wide, datum=matched_gaussian(shape, limits.ref)[0])


@lru_cache(maxsize=16)
def _rows(shape: PulseShape, low: float, high: float) -> np.ndarray:
    """Width, peak and its slope, sigma and its slope, float64 (k, 5)."""
    table = measure_pulse(shape, low, high)
    sigma = table.half_width / FWHM_PER_SIGMA
    steep = np.gradient(sigma, table.width)
    return np.stack([table.width, table.peak, np.gradient(table.peak, table.width), sigma, steep], axis=1)


def model_parameters(shape: PulseShape, limits: ShapeLimits, echoes: np.ndarray) -> np.ndarray:
    """Invert `describe_fitted`: amplitude, time and width of the fitted pulse, of a learned one its main component.

    Parameters
    ----------
    shape : PulseShape
        The fitted pulse.
    limits : ShapeLimits
        Its widths.
    echoes : float64 array, shape (m, 3)
        Amplitude [DN], time [samples] and sigma [samples].

    Returns
    -------
    float64 array, shape (m, 3)
        Parameters for the kernels.
    """
    if _is_symmetric(shape):
        return echoes
    inner = echoes.copy()
    if shape.components:
        near = measure_pulse(shape, *_usual(shape, limits))
        inner = _invert(near, echoes)
        beyond = echoes[:, 2] * FWHM_PER_SIGMA > near.half_width[-1] * (1 + 1e-5)
        if limits.high > near.width[-1] and beyond.any():
            inner[beyond] = _invert(measure_pulse(shape, *_wide(limits)), echoes[beyond])
    inner[:, 1] -= _find_delay(shape, limits.ref, inner[:, 2])[0]
    return inner


def _invert(table: PulseMeasures, echoes: np.ndarray) -> np.ndarray:
    """As model_parameters, with one table."""
    amplitude, time, sigma = echoes.T
    if len(sigma) and (sigma == sigma[0]).all():  # candidates of most detectors are many, of one width
        sigma = sigma[:1]
    width = np.interp(sigma, table.half_width / FWHM_PER_SIGMA, table.width)
    amplitude = amplitude / np.interp(width, table.width, table.peak)
    return np.stack([amplitude, time, np.broadcast_to(width, time.shape)], axis=1)


ReferenceKind = Literal["gaussian", "system", "given"]


class PulseReference(NamedTuple):
    """Samples of a reference pulse."""

    taps: np.ndarray
    """float64 (k,), k odd; peak about 1."""
    peak: float
    """Place of the peak, of the survey's pulse that of its datum, among the samples; times of echoes refer to it."""

    @property
    def middle(self) -> int:
        """Index of the middle sample."""
        return (len(self.taps) - 1) // 2


def reference_pulse(
    system: SystemPulse, spacing: float, kind: ReferenceKind, reach: float = 5.0, pulse: str = ""
) -> PulseReference:
    """Sample the reference pulse: a Gaussian of the system's width, the pulse of the survey, or a given one.

    Parameters
    ----------
    system : SystemPulse
        Result of the survey.
    spacing : float
        Time between two samples [ns].
    kind : {"gaussian", "system", "given"}
        Which pulse.
    reach : float
        Half of its length, in widths of the system pulse.
    pulse : str
        Samples of the given pulse, separated by spaces.

    Returns
    -------
    Reference
        Samples and peak.

    Raises
    ------
    ConfigError
        Where the given samples are no pulse.
    """
    if kind == "given":
        return _read_pulse(pulse)
    half = int(np.ceil(reach * system.sigma_ref / spacing))
    x = np.arange(-half, half + 1, dtype=np.float64)
    if kind == "gaussian":
        return PulseReference(exp(-0.5 * (x * spacing / system.sigma_ref) ** 2), float(half))
    shape, limits = pulse_shape(system, spacing), shape_limits(system, spacing)
    flat = np.array([[1.0, 0.0, limits.ref]])
    (peak, datum, _), *_ = describe_fitted(shape, limits, flat, np.ones((1, 3)), np.zeros((1, 2)))[0]
    taps = evaluate_pulse(shape, x[:, None], np.full(1, -datum), np.full(1, limits.ref))[0][:, 0]
    return PulseReference(taps / peak, float(half))


@lru_cache(maxsize=8)
def _read_pulse(text: str) -> PulseReference:
    try:
        samples = np.array([float(word) for word in text.split()])
    except ValueError as error:
        raise ConfigError(f"pulse must be numbers separated by spaces, it is {text!r}: {error}") from error
    if len(samples) < 3 or not np.isfinite(samples).all() or not samples.max() > 0:
        raise ConfigError(f"pulse must have at least three samples and a positive peak, it is {text!r}")
    if len(samples) % 2 == 0:
        samples = np.append(samples, 0.0)
    samples = samples / samples.max()
    top = np.array([int(np.argmax(samples))])
    peak, height = refine_peaks(samples[:, None], np.zeros(1, np.int64), top)
    return PulseReference(samples / height[0], float(peak[0]))
