"""Decomposers: the strip's pulse or Gaussians fitted to clusters of candidates, with or without growth; and loops.

Path of a block: candidates in ns, clusters in samples, fits (kernels), flagged table in ns (`solve`). Wang's residual
loop and an ASDF without a fit decide here what is fitted.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Annotated, Any, Literal

import numpy as np

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.fit.closed_form import bound_time, estimate_starts, fit_closed_form, start_errors
from wavebatch.kernels.fit.pulse_shape import GAUSSIAN, PulseShape
from wavebatch.kernels.signal.signal import find_varying, smooth_121
from wavebatch.stages.chain import Chain, Range, Step, stage
from wavebatch.stages.decompose.merge import join_tables
from wavebatch.stages.decompose.models import generalized_gaussian, reference, render_table, skew_system, skewed
from wavebatch.stages.decompose.solve import FIT, EchoLimits, FitOptions, fit_candidates, fit_gaussian, make_settings
from wavebatch.stages.detect.direct import candidate_table, maximum, signal_above
from wavebatch.stages.flags import flag_echoes
from wavebatch.stages.pulse_tables import LEAST_WIDTH, fit_misfit, pulse_shape, shape_limits

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
    ref = system.sigma_ref / block.spacing
    waveform = echoes.waveform.astype(np.int64)
    s = block.samples.shape[1]
    peak = np.clip(np.rint(echoes.time / block.spacing), 0, s - 1).astype(np.int64)
    reach = min(int(np.ceil(2.5 * ref)), s)
    step = max(CLOSED_VALUES // (2 * reach + 1), 2)
    found = []
    for begin in range(0, max(len(waveform), 1), step):
        # Signal above the baseline around peaks; 0 where no sample was recorded.
        row, at = waveform[begin : begin + step, None], peak[begin : begin + step, None] + np.arange(-reach, reach + 1)
        inside = (at >= 0) & (at < s)
        at = np.clip(at, 0, s - 1)
        y = block.samples[row, at] - (noise.baseline[row] if noise.of_sample is None else noise.of_sample[row, at])
        if block.missing is not None:
            inside &= ~block.missing[row, at]
        found.append(fit_closed_form(np.where(inside, y, 0.0), fraction))
    amplitude, shift, width, holds = (np.concatenate(fields) for fields in zip(*found, strict=True))
    holds &= (width > fit.least_width * ref) & (width < fit.most_width * ref)
    start = replace(
        echoes,
        amplitude=np.where(holds, amplitude, echoes.amplitude).astype(np.float32),
        time=np.where(holds, (peak + shift) * block.spacing, echoes.time),
        sigma=np.where(holds, width * block.spacing, echoes.sigma).astype(np.float32),
    )
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
    max_echoes: Annotated[int, Range(1, 1000)] = 8,
    thorough: bool = True,
    free_levels: bool = True,
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
    thorough : bool
        Whether echoes are searched again where a fit leaves so much that it must have missed some, and one echo broader
        than `most_width` is taken where several explain no more.
    free_levels : bool
        Whether the level of each waveform is known only to its error, so that no echo makes up for a wrong one.
    gate_residual : float
        Largest smoothed residual of a complete fit [standard deviations].
    gate_hermite : float
        Largest h3^2 + h4^2 of a complete fit.
    width_prior : float
        How far overlapping echoes may be narrower than the system pulse [one standard deviation, in system widths]; 0
        for no prior.

    References
    ----------
    docs/algorithms.md 2.3, 4.2, H1, H3, H10.
    """
    fit = replace(_ADAPTIVE, **options)
    shape = pulse_shape(system, block.spacing)
    settings = make_settings(
        block,
        system,
        shape,
        fit,
        grow=True,
        thorough=thorough,
        free_levels=free_levels,
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


def loop_model(system: SystemPulse, model: str) -> str:
    """Return the model that a residual loop fits.

    Parameters
    ----------
    system : SystemPulse
        Result of the survey.
    model : {"auto", "gaussian", "skewed", "generalized", "learned"}
        As for `decompose.residual_loop`.

    Returns
    -------
    str
        The model; for `auto` the pulse that the survey chose.
    """
    if model != "auto":
        return model
    return "learned" if system.components else "skewed" if system.kappa else "gaussian"


def _fit_loop(system: SystemPulse, parameters: Mapping[str, Any]) -> SystemPulse:
    """The system with the pulse that `residual_loop` fits; of the generalized model echoes carry their exponents."""
    model = loop_model(system, parameters["model"])
    if model == "learned":
        return system
    return skew_system(system, {"kappa": 0.0}) if model == "skewed" else fit_gaussian(system, {})


@stage("decompose", fits=_fit_loop, shares=EchoLimits())
def residual_loop(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, *,
    model: Literal["auto", "gaussian", "skewed", "generalized", "learned"] = "auto",
    t_diff: Annotated[float, Range(0.0, 1e6)] = 4.0,
    t_unit: Literal["noise", "count", "amplitude"] = "noise",
    max_echoes: Annotated[int, Range(1, 1000)] = 6,
    max_iterations: Annotated[int, Range(1, 1000)] = 40,
    **limits: float,
) -> EchoTable:  # fmt: skip
    """Pulses of a model, with one more at the largest residual of the waveform while that exceeds a threshold.

    Only the residual supports the added echoes: if the model does not fit the pulse, many are added. On a real Leica
    strip, Gaussians add an echo to most single returns, the learned pulse to few (docs/algorithms.md 1.2). So the
    default model is that of the survey.

    Parameters
    ----------
    model : {"auto", "gaussian", "skewed", "generalized", "learned"}
        The pulse that the survey chose (auto: learned, skewed or Gaussian); Gaussians, as in the paper; skewed pulses
        with the skew of the survey; generalized Gaussians; or the learned pulse.
    t_diff : float
        Largest residual that adds no echo, T_diff of the paper, in the unit below. It is at least the noise; the report
        says so if it was raised.
    t_unit : {"noise", "count", "amplitude"}
        Standard deviations of the noise, counts of the digitizer, or shares of the waveform's largest sample above the
        baseline.
    max_echoes : int
        Most echoes per waveform up to which echoes are added.
    max_iterations : int
        Of each fit; an echo that has not converged after so many is flagged.

    References
    ----------
    Wang, Wang and Tseng; docs/algorithms.md 1.2.
    """
    fitted = loop_model(system, model)
    shape = pulse_shape(_fit_loop(system, {"model": fitted}), block.spacing)
    options = {"max_iterations": max_iterations, "tolerance": 0.1, **limits}
    limit = t_diff * noise.std  # never below the noise
    if t_unit == "count":
        limit = np.maximum(t_diff, noise.std)
    elif t_unit == "amplitude":
        limit = np.maximum(t_diff * np.max(block.samples - noise.level, axis=1, initial=0), noise.std)
    rows = np.arange(len(block))
    before = np.full(len(block), -1)
    varies = find_varying(block.samples)
    parts: list[EchoTable] = []
    while len(rows) or not parts:
        found = _LOOP_FITS[fitted](block, noise, system, echoes, **options)
        residual = _residual(block, noise, system, shape, found)
        height = residual.max(axis=1, initial=0)
        number = found.count(len(rows))
        grows = (height > limit) & (number < max_echoes) & (number > before) & varies
        at, goes_on = np.flatnonzero(grows), grows[found.waveform]
        final, kept = found.take(np.flatnonzero(~goes_on)), found.take(np.flatnonzero(goes_on))
        parts.append(replace(final, waveform=rows[final.waveform].astype(np.int32)))
        new = residual[at].argmax(axis=1) * block.spacing
        added = EchoTable.build(at, new, height[at], np.full(len(at), system.sigma_ref))
        echoes = join_tables(replace(kept, attributes={}), added)
        echoes = replace(echoes, waveform=np.searchsorted(at, echoes.waveform).astype(np.int32))
        rows, before, varies, limit = rows[at], number[at], varies[at], limit[at]
        block, noise = block.rows(at), noise.rows(at)
    return join_tables(*parts)


_LOOP_FITS: dict[str, Callable[..., EchoTable]] = {
    "gaussian": gaussian,
    "skewed": skewed,
    "generalized": generalized_gaussian,
    "learned": reference,
}
"""The decomposer that fits each model of a residual loop; none of them adds an echo."""


def _residual(
    block: WaveformBlock, noise: Noise, system: SystemPulse, shape: PulseShape, table: EchoTable
) -> np.ndarray:
    """Waveforms without their echoes, float32 (n, s)."""
    residual = block.samples - noise.level - render_table(shape, block, system, table)
    if block.missing is not None:
        residual[block.missing] = 0
    return residual.astype(np.float32)


_ASDF_LIKE = ("detect.asdf", "detect.correlation", "detect.matched_filter")
"""Detectors whose times are those of the best place of a reference pulse: their error is known without a fit."""


def need_asdf(step: Step, chain: Chain, system: SystemPulse | None) -> str:
    """Say what is wrong with a detector whose times have another error than that of a reference pulse.

    Parameters
    ----------
    step, chain, system
        As for the `check` of a stage.

    Returns
    -------
    str
        Empty if nothing.
    """
    name = chain.steps[1].stage.name
    if name in _ASDF_LIKE:
        return ""
    return (
        f"it keeps the times of a detector that compares the waveform with a reference pulse ({', '.join(_ASDF_LIKE)}) "
        f"and knows their errors only; after {name} use decompose.none, which keeps its echoes, or a fit"
    )


@stage("decompose", fits=fit_gaussian, check=need_asdf)
def asdf_only(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, *,
    describe: Literal["samples", "detector"] = "samples",
) -> EchoTable:  # fmt: skip
    """Echoes of the detector before it, with its times and without a fit.

    The detector is `detect.asdf` with any rule and reference, `detect.correlation` or `detect.matched_filter`. Errors
    are those expected of isolated echoes.

    Parameters
    ----------
    describe : {"samples", "detector"}
        Amplitude and width: from a log-parabola through five samples at the detector's time, or from the detector. An
        ASDF gives the width of its reference, and too low an amplitude for broader echoes.

    References
    ----------
    Wagner et al. (2007); docs/algorithms.md 1.1.
    """
    spacing, last = block.spacing, block.samples.shape[1] - 1
    sample = np.clip(np.rint(echoes.time / spacing), 0, last).astype(np.int64)
    waveform = echoes.waveform.astype(np.int64)
    smoothed = smooth_121(signal_above(block, noise))
    amplitude, _, width = estimate_starts(smoothed, waveform, sample, system.sigma_ref / spacing)
    measured = candidate_table(block, system, waveform, echoes.time / spacing, amplitude, width)
    std = noise.std[waveform]
    height, width = np.maximum(measured.amplitude, std).astype(np.float64), measured.sigma.astype(np.float64)
    # A reference whose width is not the echo's loses this much of the bound (Schwarz's inequality of the slopes).
    loss = ((width * width + system.sigma_ref**2) / (2.0 * width * system.sigma_ref)) ** 1.5
    time_err = np.hypot(loss * bound_time(height, width, std, spacing), np.nan_to_num(echoes.time_err))
    amplitude_err, width_err = start_errors(height, width / spacing, std)
    table = replace(measured, time_err=time_err.astype(np.float32))
    if describe == "detector":
        sigma = np.maximum(echoes.sigma, np.float32(LEAST_WIDTH * system.sigma_ref))
        # What the detector says of them may be wrong by its distance from what the samples say.
        amplitude_err = np.hypot(amplitude_err, measured.amplitude - echoes.amplitude)
        width_err = np.hypot(width_err, (measured.sigma - sigma) / spacing)
        table = replace(table, amplitude=np.maximum(echoes.amplitude, 0), sigma=sigma)
    residual = _residual(block, noise, system, GAUSSIAN, table)
    # The root mean square of the residuals around each echo.
    total, number = np.zeros(len(sample)), np.zeros(len(sample))
    most = min(int(np.ceil(3 * system.sigma_ref / spacing)), residual.shape[1])
    for lag in range(-most, most + 1):
        at = sample + lag
        inside = (at >= 0) & (at < residual.shape[1])
        total += np.where(inside, residual[waveform, np.clip(at, 0, residual.shape[1] - 1)], 0.0) ** 2
        number += inside
    table = replace(
        table,
        amplitude_err=amplitude_err.astype(np.float32),
        sigma_err=(spacing * width_err).astype(np.float32),
        residual=np.sqrt(total / np.maximum(number, 1)).astype(np.float32) / std,
    )
    close = (np.diff(waveform) == 0) & (np.diff(table.time) < 4 * system.sigma_ref)
    overlapped = np.append(close, False) | np.append(False, close) if len(table) else np.zeros(0, bool)
    return flag_echoes(block, noise, system, table.with_flags(EchoFlag.OVERLAPPED, overlapped))


@stage("decompose", fits=fit_gaussian, check=need_asdf)
def asdf_mixed(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, *,
    describe: Literal["samples", "detector"] = "samples",
    tolerance: Annotated[float, Range(0.0, 1e6)] = 0.5,
) -> EchoTable:  # fmt: skip
    """Echoes as `decompose.asdf_only` has them where `detect.maximum` agrees with the detector, else fitted Gaussians.

    It comes after `detect.asdf` or another detector that `decompose.asdf_only` takes. They disagree where their numbers
    of echoes differ, or a time.

    Parameters
    ----------
    describe : {"samples", "detector"}
        As for `decompose.asdf_only`.
    tolerance : float
        Largest distance in time of echoes that agree [widths of the system pulse].

    References
    ----------
    Wagner et al. (2007); docs/algorithms.md 1.1.
    """
    quick = asdf_only(block, noise, system, echoes, describe=describe)
    maxima = maximum(block, noise, system)
    # Waveforms with other numbers of echoes, or one at another time.
    differ = maxima.count(len(block)) != quick.count(len(block))
    a, b = (table.take(np.flatnonzero(~differ[table.waveform])) for table in (maxima, quick))
    differ[a.waveform[np.abs(a.time - b.time) > tolerance * system.sigma_ref]] = True
    rows = np.flatnonzero(differ)
    chosen = maxima.take(np.flatnonzero(differ[maxima.waveform]))
    chosen = replace(chosen, waveform=np.searchsorted(rows, chosen.waveform).astype(np.int32))
    fitted = gaussian(block.rows(rows), noise.rows(rows), system, chosen)
    agreed = quick.take(np.flatnonzero(~differ[quick.waveform]))
    return join_tables(agreed, replace(fitted, waveform=rows[fitted.waveform].astype(np.int32)))
