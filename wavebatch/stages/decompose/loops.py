"""Decomposers that decide what is fitted: Wang's residual loop, and an ASDF without a fit."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Annotated, Any, Literal

import numpy as np

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.fit.bounds import bound_time
from wavebatch.kernels.fit.closed_form import estimate_starts, start_errors
from wavebatch.kernels.fit.pulse_shape import GAUSSIAN, PulseShape
from wavebatch.kernels.signal.signal import smooth_121
from wavebatch.stages.chain import Chain, Range, Step, stage
from wavebatch.stages.decompose.fit import gaussian
from wavebatch.stages.decompose.merge import join_tables
from wavebatch.stages.decompose.models import generalized_gaussian, reference, render_table, skew_system, skewed
from wavebatch.stages.decompose.solve import EchoLimits, fit_gaussian
from wavebatch.stages.detect.candidates import candidate_table, find_varying, signal_above
from wavebatch.stages.detect.direct import maximum
from wavebatch.stages.flags import flag_echoes
from wavebatch.stages.pulse_tables import LEAST_WIDTH, pulse_shape


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
    limit = _residual_limit(block, noise, t_diff, t_unit)
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
        parts.append(_renumber(final, rows[final.waveform]))
        new = residual[at].argmax(axis=1) * block.spacing
        added = EchoTable.build(at, new, height[at], np.full(len(at), system.sigma_ref))
        echoes = join_tables(replace(kept, attributes={}), added)
        echoes = _renumber(echoes, np.searchsorted(at, echoes.waveform))
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


def _residual_limit(block: WaveformBlock, noise: Noise, t_diff: float, unit: str) -> np.ndarray:
    """Largest residual of each waveform that adds no echo [count]; never below the noise."""
    if unit == "noise":
        return t_diff * noise.std
    if unit == "count":
        return np.maximum(t_diff, noise.std)
    top = np.max(block.samples - noise.level, axis=1, initial=0)
    return np.maximum(t_diff * top, noise.std)


def _renumber(table: EchoTable, waveform: np.ndarray) -> EchoTable:
    return replace(table, waveform=waveform.astype(np.int32))


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
    table = replace(
        table,
        amplitude_err=amplitude_err.astype(np.float32),
        sigma_err=(spacing * width_err).astype(np.float32),
        residual=_misfit(residual, waveform, sample, 3 * system.sigma_ref / spacing) / std,
    )
    close = (np.diff(waveform) == 0) & (np.diff(table.time) < 4 * system.sigma_ref)
    overlapped = np.append(close, False) | np.append(False, close) if len(table) else np.zeros(0, bool)
    return flag_echoes(block, noise, system, table.with_flags(EchoFlag.OVERLAPPED, overlapped))


def _misfit(residual: np.ndarray, waveform: np.ndarray, sample: np.ndarray, reach: float) -> np.ndarray:
    """Root mean square of residuals (n, s) within `reach` of samples, float32 (m,)."""
    total, number = np.zeros(len(sample)), np.zeros(len(sample))
    most = min(int(np.ceil(reach)), residual.shape[1])
    for lag in range(-most, most + 1):
        at = sample + lag
        inside = (at >= 0) & (at < residual.shape[1])
        total += np.where(inside, residual[waveform, np.clip(at, 0, residual.shape[1] - 1)], 0.0) ** 2
        number += inside
    return np.sqrt(total / np.maximum(number, 1)).astype(np.float32)


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
    differ = _disagree(len(block), maxima, quick, tolerance * system.sigma_ref)
    rows = np.flatnonzero(differ)
    chosen = maxima.take(np.flatnonzero(differ[maxima.waveform]))
    chosen = replace(chosen, waveform=np.searchsorted(rows, chosen.waveform).astype(np.int32))
    fitted = gaussian(block.rows(rows), noise.rows(rows), system, chosen)
    agreed = quick.take(np.flatnonzero(~differ[quick.waveform]))
    return join_tables(agreed, replace(fitted, waveform=rows[fitted.waveform].astype(np.int32)))


def _disagree(n: int, first: EchoTable, second: EchoTable, tolerance: float) -> np.ndarray:
    """Find waveforms in which two tables have different numbers of echoes, or one at a different time."""
    differ = first.count(n) != second.count(n)
    a, b = (table.take(np.flatnonzero(~differ[table.waveform])) for table in (first, second))
    differ[a.waveform[np.abs(a.time - b.time) > tolerance]] = True
    return differ
