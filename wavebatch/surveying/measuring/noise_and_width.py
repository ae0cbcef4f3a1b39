"""Noise and width of the system pulse, each from the other, from isolated echoes: where a survey begins.

`fit_lone` fits the echoes that are alone in their waveform by Gaussians, so that no pulse is needed yet.
Whatever else it measures starts from here. Before you change it: widths must not depend on which waveforms of a strip
were looked at (tests/surveying/test_other_sensors.py).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from wavebatch.core.echoes import UNCLEAN, EchoFlag, EchoTable
from wavebatch.core.order import find_order, median, quantile
from wavebatch.core.units import QUANTISATION_STD, SQUARED_NORMAL_MEDIAN
from wavebatch.core.waveforms import Noise, ReceiverNoise, SystemPulse, WaveformBlock
from wavebatch.kernels.elementary import exp, log
from wavebatch.kernels.fit.pulse_shape import GAUSSIAN
from wavebatch.kernels.signal.noise import PooledNoise, estimate_noise, keep_longest
from wavebatch.kernels.signal.signal import transpose_samples
from wavebatch.stages.decompose.fit import closed_form
from wavebatch.stages.detect.direct import maximum
from wavebatch.stages.flags import use_noise_errors
from wavebatch.stages.noise import pooled as pooled_noise
from wavebatch.stages.pulse_tables import noise_factors

MOST_ROUNDS, MOST_RETURNS = 12, 3
"""Times that noise and width are found from each other; a step goes at most from 0.7 to 4 times a width. And times that
all echoes may send back to it."""

FAR_OFF = 0.1
"""Change of a width that was nearly known, as a share of it, from which it is looked for from the start."""

SETTLED = 0.01
"""Change of the width, as a share of it, below which it stays."""

FIRST_LOOK, NOISE_LOOK, RESIDUAL_LOOK, LEAST_LOOK = 80_000, 240_000, 480_000, 256
"""Samples from which noise and width to begin with are found, from which noise is found then (to 1 %), and whose
residuals are looked at; and waveforms that each has at least."""

FEW = 20
"""Isolated echoes below which the width of the system pulse is a guess."""

SMALL = 256
"""Waveforms below which a stack of echoes cannot show that a pulse is simple: a tail of 6 % drowns in its errors, and
adds a fifth to the echoes. What pulse such a strip has is decided by all of its waveforms."""

HALVED = 120
"""Waveforms below which halves are too few to learn a pulse from: the judge then sees what it was learned from."""

SPARSE, LEAST_HELD, HOLDS = 4, 8, 6.0
"""Empty waveforms for each with signal, at most, by which a pulse is chosen; with signal, fewer than which show no
standard error; and height of what is signal [standard deviations], which noise reaches in one sample of 10^9."""

ENOUGH_TO_LEARN = 20
"""Isolated echoes from which a pulse can be learned (R2): at SNR 20 their stack is known to a hundredth of its peak, a
Gaussian misses the pulses of real sensors by two to six."""

LEAST_BELOW = 10
"""Echoes narrower than the pulse from which the scatter of widths is known, to a fourth of itself."""

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

ALONE = 0.1
"""Share of an echo up to which others of its waveform are no disturbance ..."""

LEAST_ALONE, ENOUGH_ALONE, ALONE_BEFORE_RINGING = 0.15, 40, 0.3
"""... unless less than this share of the echoes are alone, or so few; then others may be as high as this: a Gaussian
fitted to a pulse with a tail leaves a second one."""

MIN_SNR = 20.0
"""Amplitude over noise of a clear echo."""

LOOSE = 1.5
"""How far amplitudes of candidates may be off: waveforms in which no fit can be alone are not fitted."""

TOP_STEP, PILED, SMALL_PILE = 0.9, 2, 60
"""Share of the height of the highest FEW waveforms from which others are as high; how many more these are than those a
step below; waveforms from which that is looked for. Heights of echoes thin out towards the highest ones."""

CUT_PILE, LEAST_TENTH = 5, 3.0
"""How many times as many waveforms have the highest count as maximum as any count below it, where it cuts short pulses,
and counts there must be: without noise weak pulses of one height have hardly another maximum than one count.
Pulses of one height, sampled at any phase without noise, pile up 2.4 times at their top (widths of 1.3 samples)."""

FLATTER, MIDDLE, LEAST_TOP, MOST_TOPS = 1.05, 0.6, 0.2, 1024
"""Flatness of the tops over that of all but the flattest lower ones, and of the wider half of the tops over that of the
others, from which an amplifier clips them: 1.25 and 1.15 where those of echoes up to twice as high are cut. At most
1.02 for targets of one layer, 1.05 for the second where two merge: further apart, heights do not pile up. Shares of the
height below which, and from which, waveforms are lower ones; and how many are looked at."""

QUIET_FROM = 3
"""Widths from an echo from which samples are quiet."""

STEPS = 4
"""Gauss-Newton steps of a fit."""


def measure_gaussian(block: WaveformBlock, first: float = FIRST_WIDTH) -> SystemPulse:
    """Noise and the width of isolated echoes, each from the other, until the width stays; then once more from all.

    first: width to begin with [samples], and to end with where too few echoes are isolated.
    """
    return measure_whole(block, measure_begin(block, first))


def measure_begin(block: WaveformBlock, first: float = FIRST_WIDTH) -> SystemPulse:
    """As `measure_gaussian`, from FIRST_LOOK samples."""
    saturation = find_saturation(block.samples, block.digitizer.max_count)
    few = thin_samples(block, FIRST_LOOK)
    width, last = first, 0.0
    noises: dict[int, PooledNoise] = {}
    for _ in range(MOST_ROUNDS):
        if abs(width - last) <= SETTLED * width:
            break
        reach = int(np.ceil(QUIET_FROM * width))
        if reach not in noises:
            noises[reach] = _find_noise(few, width)
        last = width
        width = _isolated_width(few, _gaussian_system(noises[reach], few.spacing, width, saturation))
    return find_flat_tops(block, _gaussian_system(noises[reach], block.spacing, width, saturation))


def measure_whole(block: WaveformBlock, begin: SystemPulse, *, cleaned: bool = False) -> SystemPulse:
    """As `measure_gaussian`, from NOISE_LOOK samples and all echoes, where `measure_begin` ended.

    From there again where all echoes show another width. cleaned: whether the block was changed since.
    """
    part = thin_samples(block, NOISE_LOOK)
    more = len(part) > len(thin_samples(block, FIRST_LOOK))
    for _ in range(MOST_RETURNS):
        system, width = begin, begin.sigma_ref / block.spacing
        if more or cleaned:
            noise = _find_noise(part, width, begin.noise, cleaned=cleaned)
            system = _gaussian_system(noise, block.spacing, width, begin.saturation)
        found = _isolated_width(block, system)
        if abs(found / width - 1) <= FAR_OFF:
            break
        begin, cleaned = measure_begin(block, found), False
    return replace(system, sigma_ref=found * block.spacing)


def measure_quiet(block: WaveformBlock, width: float) -> SystemPulse:
    """A Gaussian of a width that is known [samples], and the noise outside of the echoes."""
    saturation = find_saturation(block.samples, block.digitizer.max_count)
    noise = _find_noise(thin_samples(block, NOISE_LOOK), width)
    return find_flat_tops(block, _gaussian_system(noise, block.spacing, width, saturation))


def measure_once_more(block: WaveformBlock, system: SystemPulse) -> ReceiverNoise:
    """The noise outside of the echoes, by the width of the pulse that was chosen: from a guess of it, or from that.

    The one that is less to this pulse: weak echoes among the quiet samples only add.
    """
    width, guessed = system.sigma_ref / block.spacing, system.noise
    found = measure_quiet(block, width).noise
    if not guessed.by_kind["quiet"]:
        return found
    seen, std = _noise_of_pulse(guessed.quiet, guessed.correlation, width)
    guessed = replace(guessed, std=std, by_kind={**guessed.by_kind, "quiet_pulse": seen})
    return found if found.by_kind["quiet"] and found.std < guessed.std else guessed


def measure_again(block: WaveformBlock, system: SystemPulse, gain: float) -> SystemPulse:
    """The system with a growth of its noise [DN], and the width that echoes repeat by errors that hold it.

    By those of white noise the narrowest of scattered widths are taken for it: a fifth too narrow at a growth of 0.2.
    """
    system = replace(system, noise=replace(system.noise, gain=gain))
    return replace(system, sigma_ref=_isolated_width(block, system) * block.spacing)


def thin_block(block: WaveformBlock, number: int) -> WaveformBlock:
    """At most `number` waveforms spread evenly over the block."""
    return block if number >= len(block) else block.rows(spread_rows(len(block), number))


def spread_rows(n: int, number: int) -> np.ndarray:
    """At most `number` of n rows, spread evenly."""
    number = min(number, n)
    return np.arange(number) * n // max(number, 1)


def thin_empty(block: WaveformBlock, system: SystemPulse) -> WaveformBlock:
    """The block with at most SPARSE empty waveforms for each one that holds signal.

    What is the same in nineteen of twenty waveforms is a strip's pulse and misfit; where 99 of 100 are empty, no echo
    would be among them.
    """
    level = system.noise.baseline + HOLDS * np.hypot(system.noise.std, system.noise.baseline_spread)
    full = block.samples.max(axis=1) > level
    held, empty = np.flatnonzero(full), np.flatnonzero(~full)
    if len(held) < LEAST_HELD or len(empty) <= SPARSE * len(held):
        return block
    return block.rows(np.sort(np.r_[held, empty[spread_rows(len(empty), SPARSE * len(held))]]))


def thin_samples(block: WaveformBlock, number: int) -> WaveformBlock:
    """Waveforms spread evenly over the block, of `number` samples at most, or LEAST_LOOK of them."""
    return thin_block(block, max(number // block.samples.shape[1], LEAST_LOOK))


def _find_noise(
    block: WaveformBlock, width: float, begin: ReceiverNoise | None = None, *, cleaned: bool = False
) -> PooledNoise:
    """Noise outside of echoes of this width [samples]; begin: as fewer waveforms of the strip show it.

    cleaned: since then, so that it had defects in it, and only its recovery is still right.
    """
    missing = None if block.missing is None else keep_longest(block.missing.T)
    reach, recovery, covariance = int(np.ceil(QUIET_FROM * width)), 0, None
    if begin is not None:
        recovery = round(begin.recovery / block.spacing)
        if begin.by_kind["quiet"] and not cleaned:
            covariance = begin.by_kind["quiet"] ** 2 * np.r_[1.0, begin.correlation]
    return estimate_noise(transpose_samples(block.samples), reach, missing=missing, recovery=recovery, begin=covariance)


def _noise_of_pulse(std: float, correlation: tuple[float, ...], width: float) -> tuple[float, float]:
    """Noise of a Gaussian of this width [samples] from that of a sample; and what a survey takes it for, at least."""
    seen = float(std * noise_factors(GAUSSIAN, width, correlation)[0])
    return seen, max(seen, std, DITHERED if std < UNDITHERED else QUANTISATION_STD)


def _gaussian_system(noise: PooledNoise, spacing: float, width: float, saturation: float | None) -> SystemPulse:
    """A Gaussian of this width [samples] with this noise; spacing of the samples [ns]."""
    correlation = tuple(noise.correlation.tolist())
    seen, std = _noise_of_pulse(noise.std, correlation, width)
    known = noise.std if noise.share > 0 else 0.0
    return SystemPulse(
        sigma_ref=width * spacing,
        noise=ReceiverNoise(
            baseline=noise.level,
            baseline_spread=noise.spread,
            recovery=float(noise.recovery * spacing),
            std=std,
            by_kind={"quiet": known, "quiet_pulse": seen},
            correlation=correlation,
        ),
        saturation=saturation,
    )


def _isolated_width(block: WaveformBlock, system: SystemPulse) -> float:
    """Width [samples] of clean echoes that are alone in their waveform, SNR above 20, not near an edge or clipped.

    Where most of them are at the edge of the widths that `system` allows it is that edge, so that the next round can
    go beyond it; with too few of them the system's width stays.
    """
    n = len(block)
    noise = Noise(np.full(n, system.noise.baseline, np.float32), np.full(n, system.noise.std, np.float32))
    if system.noise.baseline_spread > system.noise.std:
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
    typical = 0.0 if errors is None else float(median(errors / widths))
    allowed, climb = max(REPEAT_SPAN, 3 * typical), max(CLIMB, 5 * typical)
    ordered = log(np.sort(widths.astype(np.float64)))
    hold = min(max(LEAST_REPEATED, int(np.ceil(REPEATED * len(ordered)))), len(ordered))
    span = ordered[hold - 1 :] - ordered[: len(ordered) - hold + 1]
    close = span <= allowed
    first = int(np.argmax(close)) if close.any() else int(np.argmin(span))
    near = ordered[first : np.searchsorted(ordered, ordered[first] + climb, side="right")]
    half = max(len(near) // 2, min(2, len(near)))
    inner = near[half - 1 :] - near[: len(near) - half + 1]
    begin = int(np.argmin(inner))
    return float(exp(median(near[begin : begin + half])))


def find_saturation(samples: np.ndarray, max_count: int) -> float | None:
    """Count at which the digitizer clips: its maximum, or a maximum that many waveforms share on flat tops (H6)."""
    top = int(samples.max(initial=0))
    if top == 0 or top == max_count:
        return float(top) or None
    at_top = samples == top
    flat = (at_top[:, 1:] & at_top[:, :-1]).any(axis=1).sum()
    highest = samples.max(axis=1)
    reached = np.count_nonzero(highest == top)
    # Tops of short pulses have one sample: there no count of the tenth below holds as many maxima.
    tenth = (top - np.median(samples)) * (1 - TOP_STEP)
    below = highest[(highest < top) & (highest >= top - tenth)]
    piled = tenth >= LEAST_TENTH and reached >= CUT_PILE * np.unique(below, return_counts=True)[1].max(initial=1)
    return float(top) if flat >= max(3, (0.2 if piled else 0.5) * reached) and reached >= 5 else None


def find_flat_tops(block: WaveformBlock, system: SystemPulse) -> SystemPulse:
    """The system with `saturation` where an amplifier clips before the converter, so that flat tops have noise (H6).

    Many waveforms are then as high as the highest ones, flatter than lower ones, and the flatter the wider they are.
    Targets of one brightness are as high too, and may merge or their pulse be flat, but all are as flat. Flatness is
    the width of a waveform's highest peak at three quarters of its height over that at a quarter.
    """
    level = system.noise.baseline
    height = block.samples.max(axis=1) - np.float32(level)
    if system.saturation is not None or len(height) < SMALL_PILE or block.samples.shape[1] < 2:
        return system
    top = float(np.partition(height, -FEW)[-FEW])
    share = height / max(top, 1e-9)
    piled, under = np.count_nonzero(share >= TOP_STEP), np.count_nonzero(share >= 2 * TOP_STEP - 1)
    if top < MIN_SNR * system.noise.std or piled < PILED * (under - piled):
        return system
    rows = np.flatnonzero((share > LEAST_TOP) & (height > 0.5 * MIN_SNR * system.noise.std))
    rows = rows[spread_rows(len(rows), MOST_TOPS)]
    signal, share, height = block.samples[rows] - np.float32(level), share[rows], height[rows]
    row, place, peak, widths = np.arange(len(rows)), np.arange(signal.shape[1]), signal.argmax(axis=1)[:, None], []
    for part in (0.75, 0.25):
        low = signal < part * height[:, None]
        before = np.where(low & (place < peak), place, -1).max(axis=1)
        after = np.where(low & (place > peak), place, len(place)).min(axis=1)
        whole = (before >= 0) & (after < len(place))
        before, after = np.maximum(before, 0), np.minimum(after, len(place) - 1)
        width = (after - before).astype(np.float64)
        for at, step in ((before, 1), (after, -1)):  # between two samples, as a line between them
            rise = np.maximum(signal[row, at + step] - signal[row, at], 1e-9)
            width -= (part * height - signal[row, at]) / rise
        widths.append(np.where(whole, width, 0.0))
    flat = widths[0] / np.maximum(widths[1], 1e-9)
    lower, highest = flat[(share < MIDDLE) & (flat > 0)], (share >= TOP_STEP) & (flat > 0)
    few = len(lower) < FEW or np.count_nonzero(highest) < FEW
    if few or median(flat[highest]) < FLATTER * quantile(lower, 0.84):
        return system
    wide = widths[1] > median(widths[1][highest])
    if not median(flat[highest & wide]) >= FLATTER * median(flat[highest & ~wide]):  # one width only: not a number
        return system
    clip = TOP_STEP
    while clip > MIDDLE:  # what an amplifier compresses before it clips is as wrong
        under = flat[(share >= clip + TOP_STEP - 1) & (share < clip)]
        if len(under) < FEW or median(under) < FLATTER * median(lower):
            break
        clip += TOP_STEP - 1
    return replace(system, saturation=level + min(clip * top, top - 4 * system.noise.std))


def fit_lone(block: WaveformBlock, noise: Noise, system: SystemPulse, least: float, fraction: float = 0.2) -> EchoTable:
    """Fit Gaussians to the echoes that are the strongest by far of their waveform, not near an edge or clipped.

    By far means ten to one. Where hardly any echo is alone, every echo has an after-pulse, which may be higher than
    that: second targets would not be in every waveform.

    Parameters
    ----------
    block : WaveformBlock
    noise : Noise
        Of the block.
    system : SystemPulse
        Its width bounds those of the fits.
    least : float
        Least amplitude [standard deviations of the noise].
    fraction : float
        Samples of at least this share of the peak give the start of a fit.

    Returns
    -------
    EchoTable
        At most one echo per waveform.
    """
    n, floor = len(block), least * system.noise.std
    candidates = maximum(block, noise, system)
    strongest, second = find_strongest(candidates, n)
    amplitude = candidates.amplitude[strongest]
    # How high the second strongest echo of a waveform may be, as a share of the strongest.
    clear = amplitude > floor
    alone = clear & (second < ALONE * amplitude)
    enough = max(LEAST_ALONE * clear.sum(), min(ENOUGH_ALONE, clear.sum()))
    share = ALONE if alone.sum() >= enough else ALONE_BEFORE_RINGING
    hopeful = np.zeros(n, bool)
    hopeful[candidates.waveform[strongest]] = (LOOSE * amplitude > floor) & (second < LOOSE * share * amplitude)
    candidates = candidates.take(np.flatnonzero(hopeful[candidates.waveform]))
    echoes = closed_form(block, noise, system, candidates, fraction=fraction, steps=STEPS)
    echoes = use_noise_errors(echoes, system, block.spacing)
    strongest, second = find_strongest(echoes, n)
    echoes = echoes.take(strongest)
    good = (echoes.amplitude > floor) & (second < share * echoes.amplitude)
    good &= (echoes.flags & int(EchoFlag.NEAR_EDGE | EchoFlag.SATURATED)) == 0
    return echoes.take(np.flatnonzero(good))


def find_single(echoes: EchoTable, n: int, system: SystemPulse, above: float = MIN_SNR) -> np.ndarray:
    """Return which echoes are clean, alone in their waveform, of n, and higher than `above` times the noise, bool."""
    strong = echoes.amplitude > above * system.noise.std
    return echoes.alone(n) & strong & ((echoes.flags & np.uint16(UNCLEAN)) == 0)


def measure_scatter(block: WaveformBlock, system: SystemPulse, echoes: EchoTable) -> float:
    """Measure by how much clear echoes of one width scatter beyond the errors of their fits [ns], 0 with too few.

    From those narrower than the system pulse, since slopes and plants only widen. echoes: of the block.
    """
    below = find_single(echoes, len(block), system) & (echoes.sigma < system.sigma_ref)
    if np.count_nonzero(below) < LEAST_BELOW:
        return 0.0
    lack = (system.sigma_ref - echoes.sigma[below]).astype(np.float64)
    excess = median(lack**2) / SQUARED_NORMAL_MEDIAN - median(echoes.sigma_err[below].astype(np.float64) ** 2)
    return float(np.sqrt(max(excess, 0.0)))


def find_strongest(echoes: EchoTable, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the strongest echo of each waveform that has any, and the amplitude of the second strongest there."""
    order = find_order(echoes.waveform, -echoes.amplitude)
    order = np.arange(len(echoes)) if order is None else order
    waveform = echoes.waveform[order]
    first = np.r_[True, waveform[1:] != waveform[:-1]] if len(order) else np.empty(0, bool)
    second = np.zeros(n)
    runner = np.flatnonzero(~first)
    runner = runner[first[runner - 1]]
    second[waveform[runner]] = echoes.amplitude[order[runner]]
    return order[first], second[waveform[first]]
