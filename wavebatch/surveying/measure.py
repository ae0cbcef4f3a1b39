"""The parts of a survey: noise, width and shape of the system pulse, residuals and threshold, from isolated echoes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.units import MAD_TO_STD, QUANTISATION_STD
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.fit.render import render_echoes
from wavebatch.kernels.signal.noise import estimate_noise
from wavebatch.kernels.signal.signal import SMOOTH_GAIN, transpose_samples
from wavebatch.stages.decompose.fit import adaptive, closed_form
from wavebatch.stages.detect.maximum import matched_filter, maximum
from wavebatch.stages.noise import pooled as pooled_noise
from wavebatch.stages.pulse_tables import model_parameters, pulse_shape, shape_limits

MOST_ROUNDS = 12
"""Times that noise and width are found from each other; a step goes at most from 0.7 to 4 times a width."""

SETTLED = 0.01
"""Change of the width, as a share of it, below which it stays."""

FIRST_LOOK = 2048
"""Waveforms from which the noise and the width to begin with are found."""

RESIDUAL_LOOK = 4096
"""Waveforms whose residuals are looked at."""

FEW = 20
"""Isolated echoes below which the width of the system pulse is a guess."""

ALONE = 0.1
"""Share of an echo up to which others of its waveform are no disturbance ..."""

LEAST_ALONE, ALONE_BEFORE_RINGING = 0.15, 0.3
"""... unless less than this share of the echoes are alone; then others may be as high as this."""

ENOUGH_TO_LEARN = 50
"""Isolated echoes from which a pulse can be learned (R2)."""

FIRST_WIDTH = 2.0
"""First guess of the system pulse's width [samples]."""

ACCEPTANCES = (15.0, 18.0, 22.0, 27.0, 35.0, 45.0, 60.0, 80.0, 120.0)
"""Thresholds tried for one more echo, in chi2."""

MISFITS = (0.005, 0.01, 0.015, 0.02, 0.03)
"""Misfits of strong echoes tried, as shares of them."""

MANY_TIMES = 4.0
"""Split strong echoes, over split ones of middle strength, from which the pulse is what is wrong."""

USEFUL = 0.75
"""Share of the split echoes that must be left for a raised threshold to have been of no use."""

SPLIT_SHARE = 0.015
"""Share of the strip's narrowest isolated echoes that may be split."""

NEAR = 3.0
"""Widths of the system pulse around an echo within which a second one is a split of it."""

MIN_SNR = 20.0


def measure_gaussian(block: WaveformBlock, first: float = FIRST_WIDTH) -> SystemPulse:
    """Noise and the width of isolated echoes, each from the other, until the width stays; then once more from all.

    first: width to begin with [samples], and to end with where too few echoes are isolated.
    """
    saturation = find_saturation(block.samples, block.digitizer.max_count)
    few = thin_block(block, FIRST_LOOK)
    width, last = first, 0.0
    for _ in range(MOST_ROUNDS):
        if abs(width - last) <= SETTLED * width:
            break
        system, last = _gaussian_system(few, width, saturation), width
        width = _isolated_width(few, system)
    system = _gaussian_system(block, width, saturation)
    return replace(system, sigma_ref=_isolated_width(block, system) * block.spacing)


def thin_block(block: WaveformBlock, number: int) -> WaveformBlock:
    """About `number` waveforms spread over the block, at least as many where it has them."""
    return block.rows(slice(None, None, max(len(block) // number, 1)))


def _gaussian_system(block: WaveformBlock, width: float, saturation: float | None) -> SystemPulse:
    """A Gaussian of this width [samples], and the noise that is left outside of its echoes."""
    noise = estimate_noise(transpose_samples(block.samples), int(np.ceil(3 * width)))
    return SystemPulse(
        sigma_ref=width * block.spacing,
        baseline=noise.level,
        baseline_spread=noise.spread,
        noise_std=max(noise.std, noise.smoothed_std, QUANTISATION_STD),
        noise_by_kind={"quiet": noise.std, "quiet_smoothed": noise.smoothed_std},
        saturation=saturation,
    )


def _isolated_width(block: WaveformBlock, system: SystemPulse) -> float:
    """Width [samples] of clean echoes that are alone in their waveform, SNR above 20, not near an edge or clipped.

    Where most of them are at the edge of the widths that `system` allows it is that edge, so that the next round can
    go beyond it; with too few of them the system's width stays.
    """
    n = len(block)
    noise = Noise(np.full(n, system.baseline, np.float32), np.full(n, system.noise_std, np.float32))
    if system.baseline_spread > system.noise_std:
        noise = pooled_noise(block, system)
    echoes = closed_form(block, noise, system, maximum(block, noise, system), steps=4)
    strongest, second = find_strongest(echoes, n)
    echoes = echoes.take(strongest)
    good = echoes.amplitude > MIN_SNR * system.noise_std
    good &= (echoes.flags & int(EchoFlag.NEAR_EDGE | EchoFlag.SATURATED)) == 0
    good = keep_lone(good, echoes.amplitude, second)
    free = (echoes.flags[good] & int(EchoFlag.AT_BOUND)) == 0
    widths = echoes.sigma[good] / block.spacing
    if 2 * free.sum() > len(free):
        widths = widths[free]
    if len(widths) < FEW:
        return system.sigma_ref / block.spacing
    return float(np.clip(find_mode(widths), 0.5, 50.0))


def keep_lone(good: np.ndarray, amplitude: np.ndarray, second: np.ndarray) -> np.ndarray:
    """True (m,) for the good ones of the strongest echoes that the second strongest of their waveform leaves alone.

    That is less than a tenth as high; but where hardly any echo is alone, after-pulses of every echo are what is seen,
    and they may be higher: targets at chance distances would not be everywhere.
    """
    alone = good & (second < ALONE * amplitude)
    if alone.sum() < LEAST_ALONE * good.sum():
        alone = good & (second < ALONE_BEFORE_RINGING * amplitude)
    return alone


def find_strongest(echoes: EchoTable, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the strongest echo of each waveform that has any, and the amplitude of the second strongest there."""
    order = np.lexsort((-echoes.amplitude, echoes.waveform))
    waveform = echoes.waveform[order]
    first = np.r_[True, waveform[1:] != waveform[:-1]] if len(order) else np.empty(0, bool)
    second = np.zeros(n)
    runner = np.flatnonzero(~first)
    runner = runner[first[runner - 1]]
    second[waveform[runner]] = echoes.amplitude[order[runner]]
    return order[first], second[waveform[first]]


def find_mode(widths: np.ndarray) -> float:
    """Width of the system pulse: centre of the shortest interval that holds a third of the widths.

    Flat targets give the system width again and again, slopes and vegetation scatter above it; a mode is not moved by
    them, as a median would be.
    """
    ordered = np.sort(widths.astype(np.float64))
    hold = max(len(ordered) // 3, 2)
    span = ordered[hold - 1 :] - ordered[: len(ordered) - hold + 1]
    first = int(np.argmin(span))
    return float(np.median(ordered[first : first + hold]))


def find_saturation(samples: np.ndarray, max_count: int) -> float | None:
    """Count at which the digitizer clips: its maximum, or a maximum that many waveforms share on flat tops (H6)."""
    top = int(samples.max(initial=0))
    if top == 0:
        return None
    at_top = samples == top
    flat = (at_top[:, 1:] & at_top[:, :-1]).any(axis=1)
    if top == max_count:
        return float(top)
    reached = at_top.any(axis=1).sum()
    return float(top) if flat.sum() >= max(3, 0.5 * reached) and reached >= 5 else None


def decompose_sample(block: WaveformBlock, system: SystemPulse) -> EchoTable:
    noise = pooled_noise(block, system)
    return adaptive(block, noise, system, matched_filter(block, noise, system))


def measure_residuals(block: WaveformBlock, system: SystemPulse, echoes: EchoTable) -> SystemPulse:
    """The system with noise from the residuals around isolated echoes (R3) and its growth with the signal (H12)."""
    n, s = block.samples.shape
    noise = pooled_noise(block, system)
    alone = echoes.take(np.flatnonzero((echoes.count(n)[echoes.waveform] == 1) & (echoes.flags == 0)))
    alone = alone.take(np.flatnonzero(alone.amplitude > 10 * system.noise_std))
    if len(alone) < ENOUGH_TO_LEARN:
        return system
    spacing = block.spacing
    time, width = alone.time / spacing, alone.sigma / spacing
    rows = np.arange(len(alone))
    shape, limits = pulse_shape(system, spacing), shape_limits(system, spacing)
    main = model_parameters(shape, limits, np.stack([alone.amplitude, time, width], axis=1).astype(np.float64))
    model = render_echoes(shape, len(alone), s, rows, main[:, 1], main[:, 0], main[:, 2])
    residual = block.samples[alone.waveform] - noise.baseline[alone.waveform][:, None] - model
    lag = (np.arange(s) - time[:, None]) / width[:, None]
    kinds = dict(system.noise_by_kind)
    smoothed = 0.25 * (residual[:, :-2] + 2 * residual[:, 1:-1] + residual[:, 2:]) / SMOOTH_GAIN
    for kind, where in (("core", np.abs(lag) < 2.5), ("tail", (lag > 3) & (lag < 12))):
        kinds[kind] = _robust_std(residual[where])
        kinds[f"{kind}_smoothed"] = _robust_std(smoothed[where[:, 1:-1]])
    learned = bool(system.components) or system.kappa != 0
    used = [value for kind, value in kinds.items() if not (learned and kind == "quiet_smoothed")]
    std = max([QUANTISATION_STD, *used])
    gain = _noise_gain(residual, model, lag, width, std)
    return replace(system, noise_std=std, noise_by_kind=kinds, noise_gain=gain)


def _robust_std(values: np.ndarray) -> float:
    """Standard deviation from the central two thirds of the values, which rounding to whole counts does not spoil."""
    if len(values) < 100:
        return 0.0
    low, middle, high = np.quantile(values, [0.1587, 0.5, 0.8413])
    kept = values[np.abs(values - middle) < 4 * max(0.5 * (high - low), QUANTISATION_STD)]
    return float(np.sqrt(np.mean((kept.astype(np.float64) - np.mean(kept, dtype=np.float64)) ** 2)))


def _taken_by_fit(lag: np.ndarray, width: np.ndarray) -> np.ndarray:
    """Share of a sample's variance that the fit of amplitude, time and width takes away.

    lag: after the echo's centre, in widths. width: of the echo [samples]. The three derivatives of a Gaussian span the
    first three Hermite functions, whose squares add up to the leverage of a sample.
    """
    z = lag.astype(np.float64) ** 2
    leverage = np.exp(-z) / np.sqrt(np.pi) * (1 + 2 * z + 0.5 * (2 * z - 1) ** 2) / width
    return np.minimum(leverage, 0.9)


def _noise_gain(residual: np.ndarray, model: np.ndarray, lag: np.ndarray, width: np.ndarray, std: float) -> float:
    """Growth of the variance per count of signal, 0 where it cannot be told from none (H12)."""
    core = np.abs(lag) < 1.5
    signal, squared = model[core].astype(np.float64), residual[core].astype(np.float64) ** 2
    squared /= 1 - _taken_by_fit(lag[core], np.broadcast_to(width[:, None], lag.shape)[core])
    if len(signal) < 2000:
        return 0.0
    edges = np.quantile(signal, np.linspace(0, 1, 11))
    place = np.clip(np.searchsorted(edges, signal) - 1, 0, 9)
    level = np.array([np.median(signal[place == i]) for i in range(10) if (place == i).any()])
    variance = np.array([np.median(squared[place == i]) for i in range(10) if (place == i).any()]) * MAD_TO_STD**2
    slope, constant = np.polyfit(level, variance, 1)
    scatter = np.std(variance - (constant + slope * level)) / max(np.std(level) * np.sqrt(len(level)), 1e-9)
    matters = slope * edges[-2] > 0.3 * std**2 and slope > 4 * scatter
    return float(slope) if matters else 0.0


def choose_acceptance(block: WaveformBlock, system: SystemPulse, main: EchoTable) -> SystemPulse:
    """The system with the least threshold at which its clearest single echoes stay whole (R3).

    main: the echoes that the pulse was learned from. The threshold is raised until at most 1.5 % of them are split,
    or until raising it hardly changes their number: what is split then are two targets.
    """
    if len(main) < ENOUGH_TO_LEARN:
        return system
    part, shares = main, []
    for acceptance in ACCEPTANCES:
        # What a threshold leaves whole, a higher one does too: only the split ones are tried again.
        part = _keep_split(block, replace(system, acceptance=acceptance), part)
        shares.append(len(part) / len(main))
        if shares[-1] <= SPLIT_SHARE:
            return replace(system, acceptance=acceptance)
        if len(shares) > 1 and shares[-1] > USEFUL * shares[-2]:
            return replace(system, acceptance=ACCEPTANCES[len(shares) - 2])
    return replace(system, acceptance=ACCEPTANCES[-1])


def _keep_split(block: WaveformBlock, system: SystemPulse, echoes: EchoTable) -> EchoTable:
    """Those of single echoes in whose place a decomposition finds several."""
    part = block.rows(echoes.waveform)
    found = decompose_sample(part, system)
    near = np.abs(found.time - echoes.time[found.waveform]) < NEAR * system.sigma_ref
    return echoes.take(np.flatnonzero(np.bincount(found.waveform[near], minlength=len(part)) > 1))


def choose_misfit(block: WaveformBlock, system: SystemPulse, strong: EchoTable, middle: EchoTable) -> SystemPulse:
    """The system with the least misfit of strong echoes to the pulse that leaves them whole (R3, R5).

    Receivers compress high amplitudes, and no pulse that weaker echoes taught fits these. strong, middle: the strongest
    single echoes, and others of middle strength. 0 where less than 1.5 % of the strong ones are split, where it is not
    many times as many as of the others, which pairs of targets would be alike, or where no misfit helps.
    """
    if len(strong) < ENOUGH_TO_LEARN:
        return system
    part = _keep_split(block, system, strong)
    usual = len(_keep_split(block, system, middle)) / max(len(middle), 1)
    if len(part) / len(strong) <= max(SPLIT_SHARE, MANY_TIMES * usual):
        return system
    for misfit in MISFITS:
        part = _keep_split(block, replace(system, misfit=misfit), part)
        if len(part) / len(strong) <= max(SPLIT_SHARE, usual):
            return replace(system, misfit=misfit)
    return system
