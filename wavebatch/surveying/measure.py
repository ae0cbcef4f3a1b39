"""The parts of a survey: noise, width and shape of the system pulse, residuals and threshold, from isolated echoes."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.units import MAD_TO_STD, QUANTISATION_STD, SQRT_PI
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.fit.cluster import cut_windows
from wavebatch.kernels.fit.least_squares import Limits, evaluate_model, gram_matrix
from wavebatch.kernels.fit.next_echo import propose_echo
from wavebatch.kernels.fit.pulse_shape import GAUSSIAN
from wavebatch.kernels.fit.render import render_echoes
from wavebatch.kernels.signal.filters import filter_autocorrelation, filter_energy, filter_symmetric, gaussian_taps
from wavebatch.kernels.signal.noise import estimate_noise, keep_longest, residual_noise
from wavebatch.kernels.signal.signal import transpose_samples
from wavebatch.stages.clean import clean_block
from wavebatch.stages.decompose.fit import adaptive
from wavebatch.stages.detect.maximum import matched_filter
from wavebatch.stages.noise import pooled as pooled_noise
from wavebatch.stages.pulse_tables import clip_level, model_parameters, noise_factors, pulse_shape, shape_limits
from wavebatch.surveying.lone_echoes import MIN_SNR, find_strongest, fit_lone

MOST_ROUNDS = 12
"""Times that noise and width are found from each other; a step goes at most from 0.7 to 4 times a width."""

FAR_OFF = 0.1
"""Change of a width that was nearly known, as a share of it, from which it is looked for from the start."""

SETTLED = 0.01
"""Change of the width, as a share of it, below which it stays."""

FIRST_LOOK = 2048
"""Waveforms from which the noise and the width to begin with are found."""

RESIDUAL_LOOK = 4096
"""Waveforms whose residuals are looked at."""

FEW = 20
"""Isolated echoes below which the width of the system pulse is a guess."""

ENOUGH_TO_LEARN = 50
"""Isolated echoes from which a pulse can be learned (R2)."""

FIRST_WIDTH = 2.0
"""First guess of the system pulse's width [samples]."""

REPEATED, LEAST_REPEATED = 0.04, 25
"""Share, and least number, of the clear echoes that must have nearly one width for it to be the pulse's."""

REPEAT_SPAN = 0.06
"""How far these widths may lie apart, as a share of them."""

CLIMB = 0.10
"""How far above the narrowest of them the pulse's width is looked for: three times the scatter of widths at SNR 40."""

UNDITHERED, DITHERED = 0.35, 0.41
"""Below a quiet noise of 0.35 DN rounding hides how large the noise is: up to 0.3 DN never leave the level's count.
With the error of rounding that is 0.41 DN."""

WEAK = 60.0
"""Amplitude, over DITHERED, up to which the misfit of a learned pulse is less than rounding."""

LEAST_WINDOW = 6
"""Samples outside of echoes from which a waveform counts for the noise."""

OUTSIDE_REACH = 3.0
"""Widths of an echo around it that are its own, not noise."""

SAME_NOISE = 1.1
"""Ratio of the noise of quiet samples and of residuals up to which they are the same noise."""

LEAST_QUIET = 0.15
"""Share of quiet samples below which noise comes from residuals of good fits."""

GROWTH_REACH, GROWTH_STEP, GROWTH_CLASS = 1.5, 0.25, 60
"""Widths of an echo around it in which the growth of noise is looked for, steps of the lag there, and the echoes of a
class of heights: misfit of the pulse is taken off by lag and class."""

MISFIT_QUANTILE = 0.8
"""Share of the strong single echoes that the pulse's misfit explains; the others may hold a second target."""

SCATTERED = 1.4
"""The strongest echoes miss the pulse by so much more than those at the quantile: receivers compress the highest."""

NOISE_PROMISE = 8.0
"""Fall of chi2 that noise alone promises: the best of some twenty places, exceeded by a fifth of right fits."""

CORE_REACH = 4.0
"""Widths of the pulse around an echo in which its misfit is looked for; beyond them it is the tail's."""

COLOURED, MOST_COLOURED = 1.2, 10.0
"""Noise of a pulse over that of a sample from which noise is coloured, and the most that its variance may be over what
fits leave at no signal."""

TAIL_BEFORE, TAIL_AFTER = 6, 40
"""Widths of the pulse before and after an echo in which its tail is measured."""

LEAST_TAIL = 0.002
"""Share of an echo below which its tail is as the pulse says."""


def measure_gaussian(block: WaveformBlock, first: float = FIRST_WIDTH, *, known: bool = False) -> SystemPulse:
    """Noise and the width of isolated echoes, each from the other, until the width stays; then once more from all.

    first: width to begin with [samples], and to end with where too few echoes are isolated; known: it is nearly right.
    """
    saturation = find_saturation(block.samples, block.digitizer.max_count)
    few = thin_block(block, FIRST_LOOK)
    width, last = first, first if known else 0.0
    for _ in range(MOST_ROUNDS):
        if abs(width - last) <= SETTLED * width:
            break
        system, last = _gaussian_system(few, width, saturation), width
        width = _isolated_width(few, system)
    system = _gaussian_system(thin_block(block, RESIDUAL_LOOK), width, saturation)
    last, width = width, _isolated_width(block, system)
    if known and abs(width / last - 1) > FAR_OFF:
        return measure_gaussian(block, width)
    return replace(system, sigma_ref=width * block.spacing)


def measure_quiet(block: WaveformBlock, width: float) -> SystemPulse:
    """A Gaussian of a width that is known [samples], and the noise outside of the echoes."""
    saturation = find_saturation(block.samples, block.digitizer.max_count)
    return _gaussian_system(thin_block(block, RESIDUAL_LOOK), width, saturation)


def thin_block(block: WaveformBlock, number: int) -> WaveformBlock:
    """About `number` waveforms spread over the block, at least as many where it has them."""
    return block.rows(slice(None, None, max(len(block) // number, 1)))


def _gaussian_system(block: WaveformBlock, width: float, saturation: float | None) -> SystemPulse:
    """A Gaussian of this width [samples], and the noise that is left outside of its echoes."""
    missing = None if block.missing is None else keep_longest(block.missing.T)
    noise = estimate_noise(transpose_samples(block.samples), int(np.ceil(3 * width)), missing=missing)
    correlation = tuple(noise.correlation.tolist())
    seen = float(noise.std * noise_factors(GAUSSIAN, width, correlation)[0])
    known = noise.std if noise.share >= LEAST_QUIET else 0.0
    hidden = DITHERED if noise.std < UNDITHERED else QUANTISATION_STD
    return SystemPulse(
        sigma_ref=width * block.spacing,
        baseline=noise.level,
        baseline_spread=noise.spread,
        recovery=float(noise.recovery * block.spacing),
        noise_std=max(seen, noise.std, hidden),
        noise_by_kind={"quiet": known, "quiet_smoothed": noise.smoothed_std, "quiet_pulse": seen},
        correlation=correlation,
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
    echoes = fit_lone(block, noise, system, MIN_SNR)
    free = (echoes.flags & int(EchoFlag.AT_BOUND)) == 0
    widths, errors = echoes.sigma / block.spacing, echoes.sigma_err / block.spacing
    if 2 * free.sum() > len(free):
        widths, errors = widths[free], errors[free]
    if len(widths) < FEW:
        return system.sigma_ref / block.spacing
    return float(np.clip(find_edge(widths, errors), 0.5, 50.0))


def find_edge(widths: np.ndarray, errors: np.ndarray | None = None) -> float:
    """Width of the system pulse: the narrowest width that echoes repeat.

    Slopes and plants only widen echoes, so the pulse is at the lower edge of their widths; the most common width is
    that of the canopy in a forest. A few narrower ones (spikes, cut echoes) do not move it: an edge is where
    REPEATED of all echoes lie within REPEAT_SPAN of each other. From there the densest half within CLIMB is taken, so
    that over level ground, where noise scatters the widths around that of the pulse, it is the centre.

    Parameters
    ----------
    widths : (m,)
        Of clear single echoes, any unit.
    errors : (m,), optional
        Their standard deviations. Widths that scatter by more than usual are allowed to lie further apart.

    Returns
    -------
    float
        In the unit of the widths.
    """
    typical = 0.0 if errors is None else float(np.median(errors / widths))
    allowed, climb = max(REPEAT_SPAN, 3 * typical), max(CLIMB, 5 * typical)
    ordered = np.log(np.sort(widths.astype(np.float64)))
    hold = min(max(LEAST_REPEATED, int(np.ceil(REPEATED * len(ordered)))), len(ordered))
    span = ordered[hold - 1 :] - ordered[: len(ordered) - hold + 1]
    close = span <= allowed
    first = int(np.argmax(close)) if close.any() else int(np.argmin(span))
    near = ordered[first : np.searchsorted(ordered, ordered[first] + climb, side="right")]
    half = max(len(near) // 2, min(2, len(near)))
    inner = near[half - 1 :] - near[: len(near) - half + 1]
    begin = int(np.argmin(inner))
    return float(np.exp(np.median(near[begin : begin + half])))


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
    block = clean_block(block, system)
    noise = pooled_noise(block, system)
    return adaptive(block, noise, system, matched_filter(block, noise, system))


def subtract_echoes(block: WaveformBlock, system: SystemPulse, echoes: EchoTable) -> np.ndarray:
    """What fitted echoes leave of their waveforms.

    Parameters
    ----------
    block : WaveformBlock
        n waveforms of s samples.
    system : SystemPulse
        Its pulse is the one that was fitted.
    echoes : EchoTable
        All echoes of the block.

    Returns
    -------
    float32 (n, s)
        Samples above the baseline less the echoes [count]; NaN where a sample was not recorded.
    """
    noise = pooled_noise(block, system)
    residual = block.samples - noise.level
    residual -= render_own(block, system, echoes, echoes.waveform, len(block))
    if block.missing is not None:
        residual[block.missing] = np.nan
    return residual


def render_own(
    block: WaveformBlock, system: SystemPulse, echoes: EchoTable, rows: np.ndarray, number: int
) -> np.ndarray:
    """Models of echoes (m,) added up in `number` rows of the block's length; rows: which row each echo goes to."""
    spacing = block.spacing
    shape, limits = pulse_shape(system, spacing), shape_limits(system, spacing)
    whole = np.stack([echoes.amplitude, echoes.time / spacing, echoes.sigma / spacing], axis=1).astype(np.float64)
    main = model_parameters(shape, limits, whole)
    return render_echoes(shape, number, block.samples.shape[1], rows, main[:, 1], main[:, 0], main[:, 2])


def measure_residuals(block: WaveformBlock, system: SystemPulse, echoes: EchoTable) -> SystemPulse:
    """The system with the noise that fits leave outside of their echoes, and its growth with the signal.

    Parameters
    ----------
    block : WaveformBlock
    system : SystemPulse
    echoes : EchoTable
        As decomposed with this system.

    Notes
    -----
    Samples outside of all echoes decide, once the pulse with its tail is taken off: many strips have no other quiet
    ones, and what the digitizer does after an echo is noise to a weak echo there. Residuals in the core of echoes also
    hold the pulse's misfit, which is none: they decide only where quiet samples never leave one count
    (docs/algorithms.md R3, H10, H12).
    """
    n, s = block.samples.shape
    system = _measure_outside(block, system, echoes)
    alone = echoes.take(np.flatnonzero((echoes.count(n)[echoes.waveform] == 1) & (echoes.flags == 0)))
    alone = alone.take(np.flatnonzero(alone.amplitude > 10 * system.noise_std))
    if len(alone) < ENOUGH_TO_LEARN:
        return system
    time, width = alone.time / block.spacing, alone.sigma / block.spacing
    rows = np.arange(len(alone))
    part = block.rows(alone.waveform)
    model = render_own(block, system, alone, rows, len(alone))
    residual = subtract_echoes(part, system, replace(alone, waveform=rows.astype(np.int32)))
    lag = (np.arange(s) - time[:, None]) / width[:, None]
    lag[~np.isfinite(residual)] = np.inf
    kinds = dict(system.noise_by_kind)
    kinds["core"] = _robust_std(residual[np.abs(lag) < 2.5])
    std = system.noise_std
    weak = alone.amplitude < WEAK * DITHERED
    if kinds.get("outside", kinds["quiet"]) < UNDITHERED and np.count_nonzero(weak) >= ENOUGH_TO_LEARN:
        kinds["weak_echoes"] = _robust_std(residual[weak][np.abs(lag[weak]) < 2.5])
        std = max(std, kinds["weak_echoes"])
    gain = _noise_gain(residual, model, lag, width, std, std > COLOURED * kinds.get("outside", std))
    return replace(system, noise_std=std, noise_by_kind=kinds, noise_gain=gain)


def _measure_outside(block: WaveformBlock, system: SystemPulse, echoes: EchoTable) -> SystemPulse:
    """The system with noise and correlation of what is left outside of all clear echoes.

    Weak echoes are neither taken off nor left out: a threshold that was too low would find them in the noise and make
    it smaller still. What real ones add is cut off.
    """
    strongest = np.zeros(len(block))
    np.maximum.at(strongest, echoes.waveform, echoes.amplitude)
    clear = (echoes.amplitude > 8 * system.noise_std) & (echoes.amplitude > 0.05 * strongest[echoes.waveform])
    clear = echoes.take(np.flatnonzero(clear))
    residual = subtract_echoes(block, system, clear)
    used = np.isfinite(residual)
    used &= ~_cover(block, clear)
    ref = system.sigma_ref / block.spacing
    seen, calm, lost = _pulse_noise(residual, used, ref)
    found = residual_noise(residual[calm], used[calm], lost)
    if found is None or not seen:
        return system
    std, correlation = found[0], tuple(found[1].tolist())
    hidden = DITHERED if std < UNDITHERED else QUANTISATION_STD
    kinds = {**system.noise_by_kind, "outside": std, "outside_pulse": seen}
    # The residual is a few percent too small, because the baseline comes from the same samples. The estimate from quiet
    # samples is corrected for that: it is the floor, unless they hold tails of echoes, which the residual does not.
    floor = kinds["quiet_pulse"] if 0 < kinds["quiet"] < SAME_NOISE * std else 0.0
    return replace(system, noise_std=float(max(seen, std, hidden, floor)), noise_by_kind=kinds, correlation=correlation)


def _cover(block: WaveformBlock, echoes: EchoTable) -> np.ndarray:
    """Samples within OUTSIDE_REACH widths of an echo, bool (n, s)."""
    n, s = block.samples.shape
    reach = OUTSIDE_REACH * echoes.sigma / block.spacing
    first = np.clip(np.ceil(echoes.time / block.spacing - reach), 0, s).astype(np.int64)
    last = np.clip(np.floor(echoes.time / block.spacing + reach) + 1, 0, s).astype(np.int64)
    steps = np.zeros((n, s + 1), np.int32)
    np.add.at(steps, (echoes.waveform, first), 1)
    np.add.at(steps, (echoes.waveform, last), -1)
    return np.cumsum(steps[:, :-1], axis=1) > 0


def _pulse_noise(
    residual: np.ndarray, used: np.ndarray, width: float
) -> tuple[float, np.ndarray, np.ndarray]:
    """Noise of a pulse's amplitude, as that of a sample of white noise, and the calm half of the waveforms (k,).

    The median over the waveforms of the power that a matched filter finds in them: echoes too weak to be fitted raise
    it in some of them only. 0 where too few have enough samples.

    Third: the covariance at lags 0, 1, ... that the noise of the calm half lacks. They have less power in the filter
    than noise has, by chance too, and what lacks has the shape of the filter's own correlation.
    """
    taps = gaussian_taps(width)
    weight = used.T.astype(np.float32)
    left = filter_symmetric(np.where(used, residual, 0).T.astype(np.float32), taps)
    energy = filter_symmetric(weight, taps * taps)
    whole = (energy > 0.8 * filter_energy(taps)) & used.T
    number = whole.sum(axis=0)
    rows = np.flatnonzero(number >= LEAST_WINDOW)
    if len(rows) < FEW:
        return 0.0, rows, np.zeros(0)
    power = np.where(whole, left * left / np.maximum(energy, 1e-6), 0).sum(axis=0)[rows] / number[rows]
    # Median of chi2 with k degrees of freedom, over k; not fewer than 4, since what drifts is alike in all waveforms.
    freedom = np.maximum(np.median(number[rows]) / (2.5 * width + 1), 4.0)
    typical = float(np.median(power) / (1 - 2 / (9 * freedom)) ** 3)
    calm = power <= np.quantile(power, 0.6)
    shape = filter_autocorrelation(taps)
    lack = max(typical - float(power[calm].mean()), 0.0) / (2 * np.sum(shape * shape) - 1)
    return float(np.sqrt(typical)), rows[calm], lack * shape


def measure_misfit(block: WaveformBlock, system: SystemPulse, strong: EchoTable) -> SystemPulse:
    """The system with what its pulse leaves unexplained of strong single echoes, as shares of their amplitude.

    Parameters
    ----------
    block : WaveformBlock
    system : SystemPulse
    strong : EchoTable
        The strongest single echoes that no target has widened, one per waveform.

    Returns
    -------
    SystemPulse
        `misfit`: an echo that is added to a strong one must explain more than this share of its energy.
        `tail_misfit`: by lag, the share of a strong echo that is left before and after it.

    Notes
    -----
    Each strong echo is fitted alone; a score test says how much chi2 one more echo would gain. A wrong pulse promises
    the same share of the energy for all of them, a second target for a few: the share that MISFIT_QUANTILE of them
    stay below is the pulse's. Receivers compress high amplitudes, so that echoes of middle strength fit better than
    strong ones (docs/algorithms.md R3, R5).
    """
    if len(strong) < FEW:
        return system
    rows = np.arange(len(strong), dtype=np.int32)
    part = block.rows(strong.waveform)
    noise = pooled_noise(part, system)
    fitted = adaptive(part, noise, system, replace(strong, waveform=rows), max_echoes=1, significance=0.0)
    fitted = fitted.take(find_strongest(fitted, len(part))[0])
    promise = _promise(part, noise, system, fitted)
    ratio = fitted.amplitude.astype(np.float64) / system.noise_std
    energy = SQRT_PI * ratio**2 * fitted.sigma / block.spacing
    share = (promise - NOISE_PROMISE) / energy
    misfit = 0.0
    if len(share) >= FEW:
        misfit = SCATTERED * float(np.sqrt(max(np.quantile(share, MISFIT_QUANTILE), 0.0)))
    return replace(system, misfit=misfit, tail_misfit=_measure_tail(part, system, fitted))


def _promise(part: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable) -> np.ndarray:
    """Fall of chi2 (m,) that one more echo promises near each echo, the only one of its waveform."""
    spacing = part.spacing
    shape, limits = pulse_shape(system, spacing), shape_limits(system, spacing)
    whole = np.stack([echoes.amplitude, echoes.time / spacing, echoes.sigma / spacing], axis=1).astype(np.float64)
    main = model_parameters(shape, limits, whole)
    s = part.samples.shape[1]
    reach = int(np.ceil(CORE_REACH * system.sigma_ref / spacing))
    middle = np.rint(whole[:, 1]).astype(np.int64)
    low, high = np.clip(middle - reach, 0, s - 1), np.clip(middle + reach + 1, 1, s)
    windows, begin = cut_windows(
        part.samples, noise.for_fits, noise.std, echoes.waveform.astype(np.int64), low, high, min(2 * reach + 1, s),
        clip_level(part, system), system.noise_gain, part.missing,
    )  # fmt: skip
    main[:, 1] -= begin
    parameters = main[:, :, None]
    rows = evaluate_model(windows, parameters, shape)
    box = Limits(np.array([0.0, -np.inf, limits.low])[:, None], np.array([np.inf, np.inf, limits.high])[:, None])
    return propose_echo(windows, parameters, rows, gram_matrix(rows), box, limits.ref)[1]


def _measure_tail(part: WaveformBlock, system: SystemPulse, echoes: EchoTable) -> tuple[tuple[float, float], ...]:
    """(lag [ns], share) where strong echoes leave more than noise, in steps of the pulse's width."""
    ref = system.sigma_ref / part.spacing
    taps = gaussian_taps(ref)
    energy = filter_energy(taps)
    residual = subtract_echoes(part, system, echoes)[echoes.waveform]
    left = filter_symmetric(np.nan_to_num(residual).T.astype(np.float32), taps).T / np.float32(energy)
    left /= echoes.amplitude[:, None]
    lag = (np.arange(residual.shape[1]) - (echoes.time / part.spacing)[:, None]) / ref
    expected = system.noise_std / np.median(echoes.amplitude) / np.sqrt(energy)
    profile = []
    for place in range(-TAIL_BEFORE, TAIL_AFTER):
        here = left[(lag >= place - 0.5) & (lag < place + 0.5) & np.isfinite(residual)]
        if abs(place) < 3 or len(here) < ENOUGH_TO_LEARN:
            continue
        middle = np.median(here)
        spread = MAD_TO_STD * np.median(np.abs(here - middle)) if len(here) else 0.0
        share = abs(middle) + 2 * np.sqrt(max(spread**2 - expected**2, 0.0))
        if share > LEAST_TAIL:
            profile.append((float(place * system.sigma_ref), float(share)))
    return tuple(profile)


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


def _chance_part(residual: np.ndarray, model: np.ndarray, lag: np.ndarray, core: np.ndarray) -> np.ndarray:
    """Residuals at `core` (mask) less what all echoes of about one height leave at one lag (k,).

    That part is the pulse's misfit. It changes with the height where a receiver compresses, and would look like noise
    that grows with the signal: one of 0.05 DN2/DN on a strip of Leica, whose noise does not grow.
    """
    height = model.max(axis=1)
    classes = min(max(len(height) // GROWTH_CLASS, 1), 8)
    of_height = np.searchsorted(np.quantile(height, np.linspace(0, 1, classes + 1)[1:-1]), height)
    bins = int(2 * GROWTH_REACH / GROWTH_STEP)
    place = np.clip(((lag[core] + GROWTH_REACH) / GROWTH_STEP).astype(np.int64), 0, bins - 1)
    place += bins * np.broadcast_to(of_height[:, None], lag.shape)[core]
    values = residual[core].astype(np.float64)
    middle, number = np.zeros(bins * classes), np.bincount(place, minlength=bins * classes)
    order = np.argsort(place, kind="stable")
    for cell, part in enumerate(np.split(values[order], np.cumsum(number)[:-1])):
        middle[cell] = np.median(part) if len(part) else 0.0
    return (values - middle[place]) * np.sqrt(number[place] / np.maximum(number[place] - 1, 1))


def _fit_growth(terms: np.ndarray, values: np.ndarray, columns: tuple[int, ...]) -> tuple[np.ndarray, float]:
    """Least squares by some columns of the terms, with no negative factor: the factors of all, and the sum of squares.

    The best of all subsets that need no bound. (scipy's nnls finds the same, but to import it takes as long as half a
    survey.)
    """
    best, least = np.zeros(terms.shape[1]), float(values @ values)
    for number in range(1, len(columns) + 1):
        for part in combinations(columns, number):
            factors = np.linalg.lstsq(terms[:, part], values, rcond=None)[0]
            rest = values - terms[:, part] @ factors
            if (factors >= 0).all() and rest @ rest < least:
                best, least = np.zeros(terms.shape[1]), float(rest @ rest)
                best[list(part)] = factors
    return best, least


def _noise_gain(
    residual: np.ndarray, model: np.ndarray, lag: np.ndarray, width: np.ndarray, std: float, coloured: bool
) -> float:
    """Growth of the variance per count of signal, 0 where it cannot be told from none (H12)."""
    core = np.abs(lag) < GROWTH_REACH
    signal, squared = model[core].astype(np.float64), _chance_part(residual, model, lag, core) ** 2
    squared /= 1 - _taken_by_fit(lag[core], np.broadcast_to(width[:, None], lag.shape)[core])
    if len(signal) < 2000:
        return 0.0
    edges = np.quantile(signal, np.linspace(0, 1, 13))
    place = np.clip(np.searchsorted(edges, signal) - 1, 0, 11)
    filled = [i for i in range(12) if (place == i).any()]
    level = np.array([np.median(signal[place == i]) for i in filled])
    variance = np.array([np.median(squared[place == i]) for i in filled]) * MAD_TO_STD**2
    # A pulse that misses its echoes leaves what grows with the square of the signal: only the linear part is noise.
    scale = np.hypot(variance, std**2)
    terms = np.stack([np.ones_like(level), level, level * level], axis=1) / scale[:, None]
    fits = [_fit_growth(terms, variance / scale, columns) for columns in ((0,), (0, 1), (0, 2), (0, 1, 2))]
    chance = max(fits[3][1] / max(len(level) - 3, 1), 1e-4)
    chi2 = [min(rest / chance, 1e6) for _, rest in fits]
    # The linear law alone, or both, as the data are likelier; and by degrees from 3 to 6 sigma: at a limit, tiles of
    # one strip would fall on either side.
    share = 1 / (1 + np.exp(np.clip(0.5 * (chi2[1] - chi2[2]), -50, 50)))
    gain = share * fits[1][0][1] + (1 - share) * fits[3][0][1]
    sigma = np.sqrt(max(share * (chi2[0] - chi2[1]) + (1 - share) * (chi2[2] - chi2[3]), 0.0))
    # Of coloured noise the fit takes away more, at all levels alike, and `std` is what it does to a pulse: the growth
    # relative to the noise without signal holds for both.
    rest = share * fits[1][0][0] + (1 - share) * fits[3][0][0]
    if coloured and gain > 0:
        gain *= std**2 / np.clip(rest, std**2 / MOST_COLOURED, std**2)
    if gain * edges[-2] <= 0.3 * std**2:
        return 0.0
    return float(gain * np.clip((sigma - 3) / 3, 0.0, 1.0))
