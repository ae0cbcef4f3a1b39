"""Decomposers that decide what is fitted: Wang's residual loop, and ASDF with a fit only where it is needed."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.fit.bounds import bound_time
from wavebatch.kernels.fit.closed_form import estimate_starts, start_errors
from wavebatch.kernels.fit.pulse_shape import GAUSSIAN
from wavebatch.kernels.fit.render import render_echoes
from wavebatch.kernels.signal.signal import smooth_121
from wavebatch.stages.chain import stage
from wavebatch.stages.decompose.fit import gaussian
from wavebatch.stages.detect.candidates import candidate_table, find_varying, signal_above
from wavebatch.stages.detect.correlation import asdf
from wavebatch.stages.flags import flag_echoes


@stage("decompose")
def residual_loop(
    block: WaveformBlock,
    noise: Noise,
    system: SystemPulse,
    echoes: EchoTable,
    *,
    t_diff: float = 4.0,
    max_echoes: int = 6,
    max_iterations: int = 40,
    significance: float = 5.0,
) -> EchoTable:
    """Gaussians, one more at the largest residual of the waveform as long as that exceeds a threshold.

    Nothing proves the added echoes but their residual: on pulses that are not Gaussian they are many. Source: Wang,
    Wang and Tseng; ALGORITHMS 1.2.

    t_diff: largest residual that is left alone, in standard deviations of the noise.
    max_echoes: echoes per waveform up to which they are added.
    max_iterations: of each fit, after which an echo is flagged as not converged.
    significance: least energy of an echo, in standard deviations of the noise's.
    """
    rows = np.arange(len(block))
    before = np.full(len(block), -1)
    varies = find_varying(block.samples)
    parts: list[tuple[EchoTable, int]] = []
    while len(rows):
        found = gaussian(
            block, noise, system, echoes, max_iterations=max_iterations, tolerance=0.1, significance=significance
        )
        sample, height = _largest_residuals(block, noise, found)
        number = found.count(len(rows))
        grows = (height > t_diff * noise.std) & (number < max_echoes) & (number > before) & varies
        final = found.take(np.flatnonzero(~grows[found.waveform]))
        parts.append((replace(final, waveform=rows[final.waveform].astype(np.int32)), 0))
        at = np.flatnonzero(grows)
        echoes = _add_echoes(
            found.take(np.flatnonzero(grows[found.waveform])), at, sample[at], height[at], block, system
        )
        echoes = replace(echoes, waveform=np.searchsorted(at, echoes.waveform).astype(np.int32))
        rows, before, varies, block = rows[at], number[at], varies[at], block.rows(at)
        noise = Noise(noise.baseline[at], noise.std[at])
    table = EchoTable.concatenate(parts)
    return table.take(np.lexsort((table.time, table.waveform)))


def _add_echoes(
    found: EchoTable,
    waveform: np.ndarray,
    sample: np.ndarray,
    height: np.ndarray,
    block: WaveformBlock,
    system: SystemPulse,
) -> EchoTable:
    """The echoes found and one of the system's width at a sample of each of the given waveforms."""
    ref = np.full(len(waveform), system.sigma_ref)
    added = (waveform, sample * block.spacing, height, ref)
    known = (found.waveform, found.time, found.amplitude, found.sigma)
    return EchoTable.build(*(np.concatenate(pair) for pair in zip(known, added, strict=True)))


def _residual(block: WaveformBlock, noise: Noise, table: EchoTable) -> np.ndarray:
    """Waveforms without their echoes, float32 (n, s)."""
    n, s = block.samples.shape
    residual = block.samples - noise.baseline[:, None]
    sigma = table.sigma / np.float32(block.spacing)
    residual -= render_echoes(GAUSSIAN, n, s, table.waveform, table.time / block.spacing, table.amplitude, sigma)
    return residual.astype(np.float32)


def _largest_residuals(block: WaveformBlock, noise: Noise, table: EchoTable) -> tuple[np.ndarray, np.ndarray]:
    """Sample and height of the largest residual of every waveform (n,)."""
    residual = _residual(block, noise, table)
    sample = np.argmax(residual, axis=1)
    return sample, residual[np.arange(len(block)), sample]


@stage("decompose")
def asdf_only(
    block: WaveformBlock,
    noise: Noise,
    system: SystemPulse,
    echoes: EchoTable,
    *,
    mode: Literal["shortcut", "mixed"] = "shortcut",
    tolerance: float = 0.5,
    threshold: float = 4.0,
) -> EchoTable:
    """Echoes of the ASDF with amplitudes and widths from the samples around them: no fit, or one where it is needed.

    Mixed: waveforms in which the chain's detector and the ASDF disagree in the number or the times of the echoes are
    fitted with Gaussians, from the detector's candidates. Errors without a fit are those expected of isolated echoes.
    Source: Wagner et al. (2007); ALGORITHMS 1.1.

    mode: `shortcut` to fit nothing, `mixed` to fit where detectors disagree.
    tolerance: largest distance in time of echoes that agree, in widths of the system pulse.
    threshold: of the ASDF, in standard deviations of the filtered noise.
    """
    quick = _describe(block, noise, system, asdf(block, noise, system, threshold=threshold))
    if mode == "shortcut":
        return quick
    differ = _disagree(len(block), echoes, quick, tolerance * system.sigma_ref)
    rows = np.flatnonzero(differ)
    chosen = echoes.take(np.flatnonzero(differ[echoes.waveform]))
    chosen = replace(chosen, waveform=np.searchsorted(rows, chosen.waveform).astype(np.int32))
    fitted = gaussian(block.rows(rows), Noise(noise.baseline[rows], noise.std[rows]), system, chosen)
    fitted = replace(fitted, waveform=rows[fitted.waveform].astype(np.int32))
    agreed = quick.take(np.flatnonzero(~differ[quick.waveform]))
    table = EchoTable.concatenate([(agreed, 0), (fitted, 0)])
    return table.take(np.lexsort((table.time, table.waveform)))


def _disagree(n: int, first: EchoTable, second: EchoTable, tolerance: float) -> np.ndarray:
    """True (n,) for waveforms in which two tables have another number of echoes, or one at another time."""
    differ = first.count(n) != second.count(n)
    a, b = (table.take(np.flatnonzero(~differ[table.waveform])) for table in (first, second))
    differ[a.waveform[np.abs(a.time - b.time) > tolerance]] = True
    return differ


def _describe(block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable) -> EchoTable:
    """Detected echoes with amplitude and width by a log-parabola through five samples, expected errors and misfit."""
    spacing, last = block.spacing, block.samples.shape[1] - 1
    sample = np.clip(np.rint(echoes.time / spacing), 0, last).astype(np.int64)
    waveform = echoes.waveform.astype(np.int64)
    smoothed = smooth_121(signal_above(block, noise))
    amplitude, _, width = estimate_starts(smoothed, waveform, sample, system.sigma_ref / spacing)
    table = candidate_table(block, system, waveform, echoes.time / spacing, amplitude, width)
    std = noise.std[waveform]
    height, width = np.maximum(table.amplitude, std).astype(np.float64), table.sigma.astype(np.float64)
    # A reference of another width than the echo's loses this much of the bound (Schwarz's inequality, of the slopes).
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
    reach = min(int(np.ceil(reach)), residual.shape[1])
    for lag in range(-reach, reach + 1):
        at = sample + lag
        inside = (at >= 0) & (at < residual.shape[1])
        total += np.where(inside, residual[waveform, np.clip(at, 0, residual.shape[1] - 1)], 0.0) ** 2
        number += inside
    return np.sqrt(total / np.maximum(number, 1)).astype(np.float32)
