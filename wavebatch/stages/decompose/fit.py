"""Decomposers that fit the strip's pulse or Gaussians to clusters of candidates, with or without growth.

Path of a block: candidates in ns, clusters in samples, fits (kernels), flagged table in ns (`solve`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.fit.closed_form import fit_closed_form
from wavebatch.kernels.fit.pulse_shape import GAUSSIAN
from wavebatch.stages.chain import Range, stage
from wavebatch.stages.decompose.solve import FIT, EchoLimits, FitOptions, fit_candidates, fit_gaussian, make_settings
from wavebatch.stages.flags import flag_echoes
from wavebatch.stages.pulse_tables import fit_misfit, pulse_shape, shape_limits

_ADAPTIVE = FitOptions(significance=4.5)

KNOWN = 3.0
"""Errors that the amplitude of an echo beside others must have, or a fit without it must explain the samples worse."""

CLOSED_VALUES = 1 << 21
"""Samples around peaks that the closed form takes at a time: noise has a peak at every fourth sample."""

SINGLE_PRECISION = 2.0**-23
"""Share of an amplitude that a fit in single precision cannot tell from none: it counts as misfit of the pulse. With
amplitudes of 4e9 counts rounding is 200 times a noise of one count."""


def _no_pulse(*_: object) -> None:
    """For an echo of any shape. A function with a name: chains are pickled."""


@stage("decompose", shape=_no_pulse)
def none(block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable) -> EchoTable:
    """Echoes of the detector as they are, without a fit and without errors."""
    return flag_echoes(block, noise, system, echoes)


@stage("decompose", fits=fit_gaussian, shares=EchoLimits())
def closed_form(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, *,
    fraction: Annotated[float, Range(0.0, 1.0)] = 0.2,
    steps: Annotated[int, Range(0, 100)] = 2,
    **limits: float,
) -> EchoTable:  # fmt: skip
    """One Gaussian for every candidate alone: a closed form and a few Gauss-Newton steps.

    Errors are at the Cramer-Rao bound for isolated echoes. Overlapping echoes are cut apart midway between them and are
    therefore biased.

    Parameters
    ----------
    fraction : float
        Samples of at least this share of the peak enter the closed form.
    steps : int
        Gauss-Newton steps after it.

    References
    ----------
    Guo (2011); docs/algorithms.md 4.1.
    """
    fit = FitOptions(tolerance=0.1, max_iterations=steps + 1, **limits)
    start = _start_closed_form(block, noise, system, echoes, fraction, (fit.least_width, fit.most_width))
    settings = make_settings(block, system, GAUSSIAN, fit, grow=False)
    return fit_candidates(block, noise, system, start, settings, significance=fit.significance, most=1)


@stage("decompose", fits=fit_gaussian, shares=FIT)
def gaussian(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, **options: Any
) -> EchoTable:
    """Sum of Gaussians fitted to every cluster of overlapping candidates, with errors from the covariance.

    Levenberg-Marquardt. Widths stay within their limits, times within the window. No echo is added.

    References
    ----------
    Wagner et al. (2007) eq. 3; docs/algorithms.md 2.3.
    """
    fit = replace(FIT, **options)
    settings = make_settings(block, system, GAUSSIAN, fit, grow=False)
    return fit_candidates(block, noise, system, echoes, settings, significance=fit.significance)


_GAUSS_NEWTON = FitOptions(max_iterations=20, tolerance=0.01)


@stage("decompose", fits=fit_gaussian, shares=_GAUSS_NEWTON)
def gauss_newton(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, **options: Any
) -> EchoTable:
    """Sum of Gaussians by undamped Gauss-Newton steps, for comparison: starts more than one sigma off are lost.

    A fit that is lost returns its start, flagged as not converged.

    References
    ----------
    Jutzi and Stilla (2005); docs/algorithms.md 1.3.
    """
    fit = replace(_GAUSS_NEWTON, **options)
    settings = make_settings(block, system, GAUSSIAN, fit, grow=False, undamped=True)._replace(noise_gain=0.0)
    return fit_candidates(block, noise, system, echoes, settings, significance=fit.significance)


@stage("decompose", shares=_ADAPTIVE)
def adaptive(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, *,
    acceptance: Annotated[float, Range(0.0, 1e6)] = 0.0,
    max_echoes: Annotated[int, Range(1, 1000)] = 6,
    gate_residual: Annotated[float, Range(0.0, 1e6)] = 4.2,
    gate_hermite: Annotated[float, Range(0.0, 1e6)] = 8.5,
    width_prior: Annotated[float, Range(0.0, 100.0)] = 0.1,
    **options: Any,
) -> EchoTable:  # fmt: skip
    """As many echoes as the waveform needs: a fit grows only where a test of its residual asks for it.

    Each cluster of candidates is fitted with the strip's pulse. Where the smoothed residual or its Gauss-Hermite
    moments exceed what noise explains, a score test places one more echo. The larger fit is kept if chi2 falls enough
    and the echoes are resolved.

    Parameters
    ----------
    acceptance : float
        Least fall of chi2 for which an echo is added; 0 takes the value of the survey.
    max_echoes : int
        Most echoes per cluster to which a fit grows.
    gate_residual : float
        Largest smoothed residual of a complete fit [standard deviations].
    gate_hermite : float
        Largest h3^2 + h4^2 of a complete fit.
    width_prior : float
        How far overlapping echoes may be narrower than the system pulse [one standard deviation, in system widths]; 0
        for no prior.

    References
    ----------
    docs/algorithms.md 2.3, 4.2, H1, H3.
    """
    fit = replace(_ADAPTIVE, **options)
    shape = pulse_shape(system, block.spacing)
    settings = make_settings(
        block,
        system,
        shape,
        fit,
        grow=True,
        acceptance=acceptance or system.acceptance,
        misfit=max(fit_misfit(system, block.spacing), SINGLE_PRECISION),
        max_echoes=max_echoes,
        prior_spread=width_prior * shape_limits(system, block.spacing).ref,
        gate_residual=gate_residual,
        gate_hermite=gate_hermite,
        known=KNOWN,
    )
    significance = max(fit.significance, system.significance)
    return fit_candidates(block, noise, system, echoes, settings, significance=significance)


def _start_closed_form(
    block: WaveformBlock,
    noise: Noise,
    system: SystemPulse,
    echoes: EchoTable,
    fraction: float,
    widths: tuple[float, float],
) -> EchoTable:
    """Candidates with amplitude, time and width of the closed form, where it is valid."""
    ref = system.sigma_ref / block.spacing
    waveform = echoes.waveform.astype(np.int64)
    s = block.samples.shape[1]
    peak = np.clip(np.rint(echoes.time / block.spacing), 0, s - 1).astype(np.int64)
    reach = min(int(np.ceil(2.5 * ref)), s)
    step = max(CLOSED_VALUES // (2 * reach + 1), 2)
    parts = [slice(begin, begin + step) for begin in range(0, len(waveform), step)] or [slice(0)]
    found = [fit_closed_form(_cut_peaks(block, noise, waveform[part], peak[part], reach), fraction) for part in parts]
    amplitude, shift, width, holds = (np.concatenate(fields) for fields in zip(*found, strict=True))
    holds &= (width > widths[0] * ref) & (width < widths[1] * ref)
    return replace(
        echoes,
        amplitude=np.where(holds, amplitude, echoes.amplitude).astype(np.float32),
        time=np.where(holds, (peak + shift) * block.spacing, echoes.time),
        sigma=np.where(holds, width * block.spacing, echoes.sigma).astype(np.float32),
    )


def _cut_peaks(block: WaveformBlock, noise: Noise, waveform: np.ndarray, peak: np.ndarray, reach: int) -> np.ndarray:
    """Signal above the baseline around peaks (m, 2 reach + 1); 0 where no sample was recorded."""
    s = block.samples.shape[1]
    at = peak[:, None] + np.arange(-reach, reach + 1)
    inside = (at >= 0) & (at < s)
    row, at = waveform[:, None], np.clip(at, 0, s - 1)
    y = block.samples[row, at] - (noise.baseline[row] if noise.of_sample is None else noise.of_sample[row, at])
    if block.missing is not None:
        inside &= ~block.missing[row, at]
    return np.where(inside, y, 0.0)
