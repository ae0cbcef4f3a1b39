"""What fits leave of a sample: noise under weak echoes, and its growth with the signal (docs/algorithms.md R3, H12)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import combinations

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.order import distinct, group_medians, median, quantile, quantiles
from wavebatch.core.units import MAD_TO_STD, QUANTISATION_STD
from wavebatch.core.waveforms import Noise, ReceiverNoise, SystemPulse, WaveformBlock
from wavebatch.kernels.elementary import exp, solve
from wavebatch.kernels.fit.describe import render_pulses
from wavebatch.kernels.fit.pulse_shape import PulseShape
from wavebatch.kernels.signal.filters import filter_symmetric
from wavebatch.kernels.signal.noise import DRIFT, MOST_LEAST, floor_share
from wavebatch.stages.clean import clean_block
from wavebatch.stages.decompose.fit import adaptive
from wavebatch.stages.detect.direct import matched_filter
from wavebatch.stages.flags import use_noise_errors
from wavebatch.stages.noise import pooled as pooled_noise
from wavebatch.stages.pulse_tables import clip_level, floor_level, model_parameters, pulse_shape, shape_limits
from wavebatch.surveying.measuring.noise_and_width import DITHERED, ENOUGH_TO_LEARN, FEW, UNDITHERED, spread_rows

WEAK = 60.0
"""Amplitude, over DITHERED, up to which the misfit of a learned pulse is less than rounding."""

GROWTH_REACH, GROWTH_STEP, GROWTH_CLASS = 1.5, 0.25, 60
"""Widths of an echo around it in which the growth of noise is looked for, steps of the lag there, and the echoes of a
class of heights: misfit of the pulse is taken off by lag and class."""

FITTED, MOST_TAKEN = 4.0, 0.97
"""Widths around an echo whose samples its fit takes its values from; and share of a sample's variance that a fit may
take: what is left of more says nothing."""

FINE = np.array([70, -56, 28, -8, 1]) / np.sqrt(12_870)
"""Half of a filter that takes eighth differences, and leaves white noise as large as it is."""

MANIFOLD = 20.0
"""Variance that strong echoes add, over that of noise without signal, from which fits by white noise split nearly all
of them, so that those that stay single do not show it."""

LEAST_FINE = 0.2
"""Share of the noise's variance in eighth differences, at least, from which photons are known by these."""

ENOUGH_TO_GROW, MOST_FINE = 500, 1024
"""Samples in which a growth is looked for; and echoes that are asked for one of MANIFOLD."""

COLOURED, MOST_COLOURED = 1.2, 10.0
"""Noise of a pulse over that of a sample from which noise is coloured, and the most that its variance may be over what
fits leave at no signal."""


SUNK = 0.6
"""Depth of the level below count 0, over the noise, from which amplitudes are wrong by more than their errors."""

BRIGHTER = 1.3
"""Noise under weak echoes, over that of rounding, from which the noise outside of them is not so small as it seems."""


def hides_noise(noise: ReceiverNoise) -> bool:
    """Whether so much of the noise is recorded as 0 that its level and size are a guess (docs/algorithms.md H10)."""
    share = floor_share(noise.baseline, noise.quiet)
    if noise.quiet < UNDITHERED:
        return share > MOST_LEAST and noise.by_kind.get("weak_echoes", 0.0) > BRIGHTER * DITHERED
    if noise.baseline_spread > DRIFT * noise.quiet:
        return share > MOST_LEAST
    return noise.baseline < -SUNK * noise.quiet


def find_echoes(
    block: WaveformBlock, system: SystemPulse, detect: Callable[..., EchoTable] = matched_filter, **options: float
) -> tuple[WaveformBlock, Noise, EchoTable]:
    """Decompose with options of `decompose.adaptive`: the block as it was decomposed, its noise, and the echoes."""
    block = clean_block(block, system)
    noise = pooled_noise(block, system)
    return block, noise, adaptive(block, noise, system, detect(block, noise, system), **options)


def decompose_sample(block: WaveformBlock, system: SystemPulse, *, free_levels: bool = False) -> EchoTable:
    """Decompose waveforms as a run does; errors hold the noise as fits see it.

    What fits leave is measured against levels as they are known, so fits take them so; free_levels: as a run does.
    """
    return use_noise_errors(find_echoes(block, system, free_levels=free_levels)[2], system, block.spacing)


def decompose_again(block: WaveformBlock, system: SystemPulse, before: SystemPulse, echoes: EchoTable) -> EchoTable:
    """As `decompose_sample`, where the echoes that `before` found are known: they stay where it fits alike.

    What the noise was chosen from, and what faint echoes of a plain Gaussian must exceed, change none of them.
    """
    noise = replace(system.noise, by_kind=before.noise.by_kind)
    share = system.faint_share if system.components else before.faint_share
    alike = replace(system, noise=noise, faint_share=share) == before and system.noise.quiet == before.noise.quiet
    return echoes if alike else decompose_sample(block, system)


def subtract_echoes(
    block: WaveformBlock, system: SystemPulse, echoes: EchoTable, model: np.ndarray | None = None
) -> np.ndarray:
    """What fitted echoes leave of their waveforms.

    Parameters
    ----------
    block : WaveformBlock
        n waveforms of s samples.
    system : SystemPulse
        Its pulse is the one that was fitted.
    echoes : EchoTable
        All echoes of the block.
    model : float32 (n, s), optional
        These echoes by `render_own`, where they are drawn.

    Returns
    -------
    float32 (n, s)
        Samples above the baseline less the echoes [DN]; NaN where a sample was not recorded, 0 where it is clipped
        and the echoes are higher, or cut off below and they are lower: it shows no more than that they are.
    """
    noise = pooled_noise(block, system)
    residual = block.samples - noise.level
    residual -= render_own(block, system, echoes, echoes.waveform, len(block)) if model is None else model
    residual[(block.samples >= clip_level(block, system)) & (residual < 0)] = 0.0
    residual[(block.samples <= floor_level(system)) & (residual > 0)] = 0.0
    if block.missing is not None:
        residual[block.missing] = np.nan
    return residual


def render_own(
    block: WaveformBlock, system: SystemPulse, echoes: EchoTable, rows: np.ndarray, number: int, length: int = 0
) -> np.ndarray:
    """Models of echoes (m,) added up in `number` rows of a length, else the block's; rows: the row of each echo."""
    shape, main = describe_own(system, echoes, block.spacing)
    return render_pulses(shape, number, length or block.samples.shape[1], rows, main)


def describe_own(system: SystemPulse, echoes: EchoTable, spacing: float) -> tuple[PulseShape, np.ndarray]:
    """The pulse of a system, and the parameters of its main component for each of m echoes, f8 (m, 3) [samples]."""
    shape, limits = pulse_shape(system, spacing), shape_limits(system, spacing)
    whole = np.stack([echoes.amplitude, echoes.time / spacing, echoes.sigma / spacing], axis=1)
    return shape, model_parameters(shape, limits, whole.astype(np.float64))


def measure_residuals(
    block: WaveformBlock, system: SystemPulse, echoes: EchoTable, shown: float = 1.0
) -> tuple[SystemPulse, float]:
    """The system with the noise that fits leave in weak echoes, where counts hardly scatter, and its growth.

    Parameters
    ----------
    block : WaveformBlock
    system : SystemPulse
    echoes : EchoTable
        As decomposed with this system.
    shown : float
        Most of the growth to take, as a share: what fits before them showed, by degrees.

    Returns
    -------
    system : SystemPulse
    shown : float
        Share of its growth that these fits show, 0 where it could be chance.

    Notes
    -----
    Residuals in the core of echoes also hold the pulse's misfit, which is no noise: they decide only where quiet
    samples never leave one count (docs/algorithms.md R3, H10, H12).
    """
    n, s = block.samples.shape
    alone = echoes.take(np.flatnonzero((echoes.count(n)[echoes.waveform] == 1) & (echoes.flags == 0)))
    alone = alone.take(np.flatnonzero(alone.amplitude > 10 * system.noise.std))
    if system.noise.gain and len(alone):  # what a fit takes away is known for one without weights
        white, part = replace(system, noise=replace(system.noise, gain=0.0)), block.rows(alone.waveform)
        rows = np.arange(len(part), dtype=np.int32)
        again = adaptive(part, pooled_noise(part, white), white, replace(alone, waveform=rows), max_echoes=1)
        alone = replace(again, waveform=alone.waveform[again.waveform])
    if len(alone) < ENOUGH_TO_LEARN:
        return system, 0.0
    time, width = alone.time / block.spacing, alone.sigma / block.spacing
    rows = np.arange(len(alone), dtype=np.int32)
    part = block.rows(alone.waveform)
    model = render_own(block, system, alone, rows, len(alone))
    residual = subtract_echoes(part, system, replace(alone, waveform=rows.astype(np.int32)), model)
    lag = (np.arange(s) - time[:, None]) / width[:, None]
    lag[~np.isfinite(residual)] = np.inf
    kinds = dict(system.noise.by_kind)
    kinds["core"] = _robust_std(residual[np.abs(lag) < 2.5])
    std = system.noise.std
    weak = alone.amplitude < WEAK * DITHERED
    if kinds["quiet"] < UNDITHERED and np.count_nonzero(weak) >= ENOUGH_TO_LEARN:
        kinds["weak_echoes"] = _robust_std(residual[weak][np.abs(lag[weak]) < 2.5])
        std = max(std, kinds["weak_echoes"])
    sample = kinds["quiet"] or std
    coloured = std > COLOURED * sample
    steep = bool(2 * system.noise.gain * quantile(alone.amplitude, 0.9) > MANIFOLD * std**2) and not coloured
    gain, share = _noise_gain(residual, model, lag, std, coloured, steep=steep, fitted=True, shown=shown)
    return replace(system, noise=replace(system.noise, std=std, by_kind=kinds, gain=gain)), share


def guess_growth(block: WaveformBlock, system: SystemPulse, echoes: EchoTable) -> float:
    """The growth of the noise per count of signal before a pulse is known, from Gaussians fitted to lone echoes (m,).

    0 where it is less than MANIFOLD: then fits of the pulse show it. Pulses, close pairs and what Gaussians miss of
    them are smooth, photons are not: eighth differences leave only noise, coloured as without signal (H12).
    """
    noise = system.noise
    taps = np.r_[FINE[:0:-1], FINE]
    apart = np.abs(np.subtract.outer(np.arange(len(taps)), np.arange(len(taps))))
    left = float(taps @ np.r_[1.0, noise.correlation, np.zeros(len(taps))][apart] @ taps)  # of such noise's variance
    if len(echoes) < FEW or system.sigma_ref < block.spacing or left < LEAST_FINE or noise.quiet < UNDITHERED:
        return 0.0
    echoes = echoes.take(spread_rows(len(echoes), MOST_FINE))
    part, rows = block.rows(echoes.waveform), np.arange(len(echoes), dtype=np.int32)
    model = render_own(part, system, echoes, rows, len(rows))
    residual = np.nan_to_num(subtract_echoes(part, system, replace(echoes, waveform=rows), model))
    fine, signal = (filter_symmetric(one.T, taps).T for one, taps in ((residual, FINE), (model, FINE**2)))
    lag = (np.arange(model.shape[1]) - echoes.time[:, None] / block.spacing) / (echoes.sigma[:, None] / block.spacing)
    std = noise.quiet * np.sqrt(left)
    # The fit takes away nothing of such differences.
    gain = _noise_gain(fine, signal, lag, std, False, steep=True, fitted=False)[0] * (noise.std / std) ** 2
    return gain if gain * quantile(echoes.amplitude, 0.9) > MANIFOLD * noise.std**2 else 0.0


def _robust_std(values: np.ndarray) -> float:
    """Standard deviation from the central two thirds of the values, which rounding to whole counts does not spoil."""
    if len(values) < 100:
        return 0.0
    low, middle, high = quantiles(values, [0.1587, 0.5, 0.8413])
    kept = values[np.abs(values - middle) < 4 * max(0.5 * (high - low), QUANTISATION_STD)]
    return float(np.sqrt(np.mean((kept.astype(np.float64) - np.mean(kept, dtype=np.float64)) ** 2)))


def find_common(values: np.ndarray, lag: np.ndarray, height: np.ndarray, reach: float) -> tuple[np.ndarray, ...]:
    """What all echoes of about one height leave at one lag: the pulse's misfit, which a receiver may change with the
    height. Second targets are at another lag in every waveform.

    Parameters
    ----------
    values : float (k,)
        Residuals, in any unit.
    lag : float (k,)
        After the echo's centre [its widths], up to `reach` on either side.
    height : float (k,)
        Of the echo.
    reach : float
        [widths].

    Returns
    -------
    common : float64 (k,)
        Median of the values at this lag and height.
    number : int64 (k,)
        Values that it comes from.
    spread : float64 (k,)
        Their standard deviation, from the median of their distances from it.
    """
    heights = np.append(height[:-1][height[1:] != height[:-1]], height[-1:])  # those of an echo stand together
    classes = min(max(len(distinct(heights)) // GROWTH_CLASS, 1), 8)
    bins = int(2 * reach / GROWTH_STEP)
    place = np.clip(((lag + reach) / GROWTH_STEP).astype(np.int64), 0, bins - 1)
    place += bins * np.searchsorted(quantiles(height, np.linspace(0, 1, classes + 1)[1:-1]), height)
    number = np.bincount(place)
    middle, spread = group_medians(values, place)
    return middle[place], number[place], spread[place]


def _fit_growth(terms: np.ndarray, values: np.ndarray, columns: tuple[int, ...]) -> tuple[np.ndarray, float]:
    """Least squares by some columns of the terms, with no negative factor: the factors of all, and the sum of squares.

    The best of all subsets that need no bound. (scipy's nnls finds the same, but to import it takes as long as half a
    survey.)
    """
    best, least = np.zeros(terms.shape[1]), float(np.einsum("k,k->", values, values))
    for number in range(1, len(columns) + 1):
        for part in combinations(columns, number):
            chosen = terms[:, part]
            size = np.sqrt(np.einsum("kp,kp->p", chosen, chosen))
            chosen = chosen / size
            normal = np.einsum("kp,kq->pq", chosen, chosen)
            factors = solve(normal, np.einsum("kp,k->p", chosen, values))
            rest = values - np.einsum("kp,p->k", chosen, factors)
            cost = float(np.einsum("k,k->", rest, rest))
            if (factors >= 0).all() and cost < least:
                best, least = np.zeros(terms.shape[1]), cost
                best[list(part)] = factors / size
    return best, least


def _find_leverage(lag: np.ndarray, signal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Share h_ii of each sample's variance that a fit of amplitude, time and width takes away (n, s), and the sum of
    h_ij^2 S_j that it brings there of a variance S_j, the signal (n, s).

    The three derivatives of a Gaussian, made orthogonal over its samples: h_ij is the sum of their products.
    """
    near = np.abs(lag) < FITTED
    at, row = np.flatnonzero(near), np.repeat(np.arange(len(lag)), np.count_nonzero(near, axis=1))
    z = lag.take(at).astype(np.float64)
    basis: list[np.ndarray] = []
    for power in range(3):
        values = z**power * exp(-0.5 * z * z)
        for one in basis:
            values = values - one * np.bincount(row, one * values)[row]
        basis.append(values / np.sqrt(np.maximum(np.bincount(row, values * values), 1e-9))[row])
    sums, height = np.zeros((2, len(z))), signal.take(at).astype(np.float64)
    for i, one in enumerate(basis):
        sums[0] += one * one
        for j, other in enumerate(basis[: i + 1]):
            product = one * other
            sums[1] += (1 if i == j else 2) * product * np.bincount(row, product * height)[row]
    taken, brought = np.zeros((2, lag.size))
    taken[at], brought[at] = sums
    return taken.reshape(lag.shape), brought.reshape(lag.shape)


def _noise_gain(
    residual: np.ndarray,
    model: np.ndarray,
    lag: np.ndarray,
    std: float,
    coloured: bool,
    *,
    steep: bool,
    fitted: bool,
    shown: float = 1.0,
) -> tuple[float, float]:
    """Growth of the variance per count of signal, 0 where it could be chance (H12), and the share that is shown.

    lag: after the echo's centre, in widths. steep: if it is one of MANIFOLD. fitted: residuals are those of fits.
    shown: most of the share.
    """
    core = np.abs(lag) < GROWTH_REACH
    taken, brought = _find_leverage(lag, model) if fitted else np.zeros((2, *lag.shape))
    core &= taken < MOST_TAKEN
    at = np.flatnonzero(core)
    taken, brought, lag, signal = taken.take(at), brought.take(at), lag.take(at), model.take(at).astype(np.float64)
    # Residuals at `core` (mask) less what all echoes of about one height leave at one lag (k,).
    # That part changes with the height where a receiver compresses, and would look like noise that grows with the
    # signal: one of 0.05 DN2/DN on a strip of Leica, whose noise does not grow.
    height = np.repeat(model.max(axis=1), np.count_nonzero(core, axis=1))
    values = residual.take(at).astype(np.float64)
    common, number, _ = find_common(values, lag, height, GROWTH_REACH)
    squared = ((values - common) * np.sqrt(number / np.maximum(number - 1, 1))) ** 2 / (1 - taken)
    # Noise without signal counts once, as if nothing were taken. That of the signal is largest where most is taken.
    signal = (signal * (1 - 2 * taken) + brought) / (1 - taken)
    if len(signal) < ENOUGH_TO_GROW:
        return 0.0, 0.0
    order = np.argsort(signal)
    signal, squared = signal[order], squared[order]
    edges = quantiles(signal, np.linspace(0, 1, 13))
    ends = np.searchsorted(signal, edges[1:-1], "right")
    classes = ([median(part) for part in np.split(one, ends) if len(part)] for one in (signal, squared))
    level, variance = np.array(next(classes)), np.array(next(classes)) * MAD_TO_STD**2
    if steep:  # noise without signal is one more level: how coloured it is hardly counts
        level, variance = np.r_[0.0, level], np.r_[std**2, variance]
    # A pulse that misses its echoes leaves what grows with the square of the signal: only the linear part is noise.
    scale = np.hypot(variance, std**2)
    terms = np.stack([np.ones_like(level), level, level * level], axis=1) / scale[:, None]
    fits = [_fit_growth(terms, variance / scale, columns) for columns in ((0,), (0, 1), (0, 2), (0, 1, 2))]
    chance = max(fits[3][1] / max(len(level) - 3, 1), 1e-4)
    chi2 = [min(rest / chance, 1e6) for _, rest in fits]
    # The linear law alone, or both, as the data are likelier; and by degrees from 3 to 6 sigma: at a limit, tiles of
    # one strip would fall on either side.
    share = 1 / (1 + exp(np.clip(0.5 * (chi2[1] - chi2[2]), -50, 50)))
    gain = share * fits[1][0][1] + (1 - share) * fits[3][0][1]
    sigma = np.sqrt(max(float(share * (chi2[0] - chi2[1]) + (1 - share) * (chi2[2] - chi2[3])), 0.0))
    # Of coloured noise the fit takes away more, at all levels alike, and `std` is what it does to a pulse: the growth
    # relative to the noise without signal holds for both.
    rest = share * fits[1][0][0] + (1 - share) * fits[3][0][0]
    if coloured and gain > 0:
        gain *= std**2 / np.clip(rest, std**2 / MOST_COLOURED, std**2)
    shown = float(np.clip((sigma - 3) / 3, 0.0, shown))
    return (float(gain * shown), shown) if gain * shown * edges[-2] > 0.3 * std**2 else (0.0, 0.0)
