"""Decomposers that decide what is fitted: Wang's residual loop, and the ASDF with a fit only where it is needed."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Literal

import numpy as np

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.fit.bounds import bound_time
from wavebatch.kernels.fit.closed_form import estimate_starts, start_errors
from wavebatch.kernels.fit.pulse_shape import GAUSSIAN
from wavebatch.kernels.fit.render import render_echoes
from wavebatch.kernels.signal.signal import smooth_121
from wavebatch.stages.chain import Range, stage
from wavebatch.stages.decompose.fit import gaussian
from wavebatch.stages.decompose.merge import join_tables
from wavebatch.stages.detect.candidates import candidate_table, find_varying, signal_above
from wavebatch.stages.detect.correlation import asdf
from wavebatch.stages.flags import flag_echoes


@stage("decompose")
def residual_loop(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, *,
    t_diff: Annotated[float, Range(0.0, 1e6)] = 4.0,
    max_echoes: Annotated[int, Range(1, 1000)] = 6,
    max_iterations: Annotated[int, Range(1, 1000)] = 40,
    significance: Annotated[float, Range(0.0, 1e6)] = 5.0,
) -> EchoTable:  # fmt: skip
    """Gaussians, with one more at the largest residual of the waveform while that exceeds a threshold.

    Only their residual supports the added echoes: on pulses that are not Gaussian there are many.

    Parameters
    ----------
    t_diff : float
        Largest residual that adds no echo [standard deviations of the noise].
    max_echoes : int
        Most echoes per waveform up to which echoes are added.
    max_iterations : int
        Of each fit; an echo that has not converged after so many is flagged.
    significance : float
        Least energy of an echo [standard deviations of the noise's energy].

    References
    ----------
    Wang, Wang and Tseng; docs/algorithms.md 1.2.
    """
    rows = np.arange(len(block))
    before = np.full(len(block), -1)
    varies = find_varying(block.samples)
    parts: list[EchoTable] = []
    while len(rows):
        found = gaussian(
            block, noise, system, echoes, max_iterations=max_iterations, tolerance=0.1, significance=significance
        )
        residual = _residual(block, noise, found)
        height = residual.max(axis=1)
        number = found.count(len(rows))
        grows = (height > t_diff * noise.std) & (number < max_echoes) & (number > before) & varies
        at, goes_on = np.flatnonzero(grows), grows[found.waveform]
        final, kept = found.take(np.flatnonzero(~goes_on)), found.take(np.flatnonzero(goes_on))
        parts.append(_renumber(final, rows[final.waveform]))
        new = residual[at].argmax(axis=1) * block.spacing
        added = EchoTable.build(at, new, height[at], np.full(len(at), system.sigma_ref))
        echoes = join_tables(kept, added)
        echoes = _renumber(echoes, np.searchsorted(at, echoes.waveform))
        rows, before, varies, block = rows[at], number[at], varies[at], block.rows(at)
        noise = noise.rows(at)
    return join_tables(*parts)


def _renumber(table: EchoTable, waveform: np.ndarray) -> EchoTable:
    return replace(table, waveform=waveform.astype(np.int32))


def _residual(block: WaveformBlock, noise: Noise, table: EchoTable) -> np.ndarray:
    """Waveforms without their echoes, float32 (n, s)."""
    n, s = block.samples.shape
    residual = block.samples - noise.level
    sigma = table.sigma / np.float32(block.spacing)
    residual -= render_echoes(GAUSSIAN, n, s, table.waveform, table.time / block.spacing, table.amplitude, sigma)
    if block.missing is not None:
        residual[block.missing] = 0
    return residual.astype(np.float32)


@stage("decompose")
def asdf_only(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, *,
    mode: Literal["shortcut", "mixed"] = "shortcut",
    tolerance: Annotated[float, Range(0.0, 1e6)] = 0.5,
    threshold: Annotated[float, Range(0.0, 1e6)] = 4.0,
) -> EchoTable:  # fmt: skip
    """Echoes of the ASDF with amplitudes and widths from the samples around them: no fit, or one where needed.

    Mixed: waveforms in which the chain's detector and the ASDF disagree in the number or the times of the echoes are
    fitted with Gaussians, from the detector's candidates. Errors without a fit are those expected of isolated echoes.

    Parameters
    ----------
    mode : {"shortcut", "mixed"}
        `shortcut` to fit nothing, `mixed` to fit where detectors disagree.
    tolerance : float
        Largest distance in time of echoes that agree [widths of the system pulse].
    threshold : float
        Of the ASDF [standard deviations of the filtered noise].

    References
    ----------
    Wagner et al. (2007); docs/algorithms.md 1.1.
    """
    quick = _describe(block, noise, system, asdf(block, noise, system, threshold=threshold))
    if mode == "shortcut":
        return quick
    differ = _disagree(len(block), echoes, quick, tolerance * system.sigma_ref)
    rows = np.flatnonzero(differ)
    chosen = echoes.take(np.flatnonzero(differ[echoes.waveform]))
    chosen = _renumber(chosen, np.searchsorted(rows, chosen.waveform))
    fitted = gaussian(block.rows(rows), noise.rows(rows), system, chosen)
    agreed = quick.take(np.flatnonzero(~differ[quick.waveform]))
    return join_tables(agreed, _renumber(fitted, rows[fitted.waveform]))


def _disagree(n: int, first: EchoTable, second: EchoTable, tolerance: float) -> np.ndarray:
    """Find waveforms in which two tables have different numbers of echoes, or one at a different time."""
    differ = first.count(n) != second.count(n)
    a, b = (table.take(np.flatnonzero(~differ[table.waveform])) for table in (first, second))
    differ[a.waveform[np.abs(a.time - b.time) > tolerance]] = True
    return differ


def _describe(block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable) -> EchoTable:
    """Describe echoes by a log-parabola through five samples, with the expected errors and the misfit."""
    spacing, last = block.spacing, block.samples.shape[1] - 1
    sample = np.clip(np.rint(echoes.time / spacing), 0, last).astype(np.int64)
    waveform = echoes.waveform.astype(np.int64)
    smoothed = smooth_121(signal_above(block, noise))
    amplitude, _, width = estimate_starts(smoothed, waveform, sample, system.sigma_ref / spacing)
    table = candidate_table(block, system, waveform, echoes.time / spacing, amplitude, width)
    std = noise.std[waveform]
    height, width = np.maximum(table.amplitude, std).astype(np.float64), table.sigma.astype(np.float64)
    # A reference whose width is not the echo's loses this much of the bound (Schwarz's inequality of the slopes).
    loss = ((width * width + system.sigma_ref**2) / (2.0 * width * system.sigma_ref)) ** 1.5
    amplitude_err, width_err = start_errors(height, width / spacing, std)
    table = replace(
        table,
        time_err=(loss * bound_time(height, width, std, spacing)).astype(np.float32),
        amplitude_err=amplitude_err.astype(np.float32),
        sigma_err=(spacing * width_err).astype(np.float32),
        residual=_misfit(_residual(block, noise, table), waveform, sample, 3 * system.sigma_ref / spacing) / std,
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
