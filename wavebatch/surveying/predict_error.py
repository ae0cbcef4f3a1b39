"""What the echoes of a sample tell when they are simulated again with the strip's pulse and noise.

The range error and the false echoes to expect from each chain on a strip, for `wavebatch run`: each chain must find the
echoes, and no others. And the effect of neighbours that are too close to be found on the times of echoes
(docs/algorithms.md 2.2): the survey calls `measure_hidden` with the echoes of its sample. Before you change it: a strip
must get the same numbers every time, so the seed is fixed.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from wavebatch.core.echoes import UNCLEAN, EchoFlag, EchoTable, without_nan
from wavebatch.core.frozen import frozen
from wavebatch.core.order import distinct, draw
from wavebatch.core.units import HALF_C, QUANTISATION_STD
from wavebatch.core.waveforms import Defects, SystemPulse, WaveformBlock
from wavebatch.kernels.fit.closed_form import bound_time
from wavebatch.kernels.signal.noise import normal_law, whitening_filter
from wavebatch.stages.chain import Chain
from wavebatch.stages.decompose.fit import adaptive
from wavebatch.stages.decompose.merge import excess_variance
from wavebatch.stages.detect.direct import maximum
from wavebatch.stages.noise import pooled
from wavebatch.stages.score import match_echoes
from wavebatch.surveying.measuring.noise_and_width import FEW
from wavebatch.surveying.measuring.residuals import decompose_sample, render_own

TRIAL_WAVEFORMS = 2048
"""Waveforms of a trial."""

SEED = 20071
"""Seed of a trial's noise: any fixed number does."""

QUANTILES = 16_384
"""Of normal noise, from which that of a trial is drawn: its variance is right to 1e-4."""

LEAST_SNR = 5.0
"""Least amplitude over noise of an echo of the sample: below it, noise would pass for echoes with huge bounds."""

MOST_FALSE = 0.02
"""How much larger than that of the best chain the share of false echoes may be. On a RIEGL strip, whose pulse has
after-pulses, it is 0.62 and 0.47 for chains that fit plain Gaussians, 0.007 for those that fit the learned pulse."""

_DOUBTFUL = EchoFlag.AT_BOUND | EchoFlag.NOT_CONVERGED | EchoFlag.NEAR_EDGE


@frozen
class Prediction:
    """The result to expect from a chain on a strip."""

    name: str
    bound: float
    """Root mean square of the Cramer-Rao bounds of the strip's echoes, each as if alone [m along the ray]."""
    factor: float
    """Root mean square error of the echoes found in the trial, divided by that of their bounds."""
    completeness: float
    """Share of the trial's echoes that were found."""
    false_share: float = 0.0
    """Share of the echoes found in the trial that are no echoes of it: parts of another echo, or noise."""

    @property
    def range_error(self) -> float:
        """Root mean square error of the range [m]; infinite where nothing was found."""
        return self.bound * self.factor

    def to_json(self) -> dict[str, object]:
        """Return the numbers under names with units; None where not finite."""
        values = {"range_error_m": self.range_error, "bound_m": self.bound}
        values |= {"factor": self.factor, "completeness": self.completeness, "false_share": self.false_share}
        return {"chain": self.name, **without_nan({name: float(f"{value:.6g}") for name, value in values.items()})}


def predict_errors(block: WaveformBlock, system: SystemPulse, chains: Mapping[str, Chain]) -> list[Prediction]:
    """Predict the errors of chains on a strip.

    Parameters
    ----------
    block : WaveformBlock
        A sample of the strip.
    system : SystemPulse
    chains : mapping of str to Chain

    Returns
    -------
    list of Prediction
        In the order of `chains`. Attribute stages are not run: they may need what the trial does not have.

    Notes
    -----
    The adaptive decomposer finds the echoes of the sample. They are rendered with the strip's pulse and new noise, and
    the echoes that a chain finds there are compared with them. Targets so close that they were one echo in the sample
    are one target here: the error is that of echoes that can be resolved.
    """
    block = block.rows(slice(0, None, max(len(block) // TRIAL_WAVEFORMS, 1)))
    noise = pooled(block, system)
    truth = adaptive(block, noise, system, maximum(block, noise, system))
    sure = truth.amplitude >= LEAST_SNR * noise.std[truth.waveform]
    truth = truth.take(np.flatnonzero(sure & ((truth.flags & int(_DOUBTFUL)) == 0)))
    trial, system = simulate_again(block, system, truth, SEED)
    bounds = bound_time(truth.amplitude, truth.sigma.astype(np.float64), system.noise.std, block.spacing) * HALF_C
    bound = _rms(bounds)
    predictions = []
    for name, chain in chains.items():
        found = replace(chain, steps=chain.steps[:3]).run(trial, system)
        match = match_echoes(found, truth)
        error = (found.time[match.found] - truth.time[match.truth]) * HALF_C
        if len(error):
            factor = _rms(error) / _rms(bounds[match.truth])
        else:
            factor = np.inf if len(truth) else 1.0
        complete, false = len(error) / max(len(truth), 1), 1.0 - len(error) / max(len(found), 1)
        predictions.append(Prediction(name, bound, float(factor), complete, false if len(found) else 0.0))
    return predictions


def leave_out_false(predictions: Sequence[Prediction]) -> list[Prediction]:
    """Return the predictions of chains that do not take the pulse's own shape, or noise, for echoes.

    Parameters
    ----------
    predictions : sequence of Prediction
        Of the chains to compare; one of them should fit the learned pulse.

    Returns
    -------
    list of Prediction
        Those whose share of false echoes is at most MOST_FALSE above the least, in the same order.
    """
    least = min((prediction.false_share for prediction in predictions), default=0.0)
    return [prediction for prediction in predictions if prediction.false_share <= least + MOST_FALSE]


def simulate_again(
    block: WaveformBlock, system: SystemPulse, echoes: EchoTable, seed: int, length: int | None = None, times: int = 1
) -> tuple[WaveformBlock, SystemPulse]:
    """Simulate waveforms that hold given echoes, with the strip's pulse, new baselines and new noise.

    Parameters
    ----------
    block : WaveformBlock
        Gives number and length of the waveforms, and the digitizer.
    system : SystemPulse
    echoes : EchoTable
        Their rows refer to `block`.
    seed : int
        Of the noise.
    length : int, optional
        Samples of a waveform; by default as many as in the block.
    times : int
        Parts of the block that have the same noise, one after the other.

    Returns
    -------
    block : WaveformBlock
    system : SystemPulse
        Without the defects of the strip's waveforms: simulated ones have none.
    """
    n, s = len(block), length or block.samples.shape[1]
    signal = render_own(block, system, echoes, echoes.waveform, n, s)
    # Rounding to whole counts, below, adds this part of the noise again.
    white = max(system.noise.std**2 - QUANTISATION_STD**2, 0.0)
    variance = white + system.noise.gain * np.maximum(signal, 0)
    # Noise that fits of this system see with a standard deviation of 1: coloured where they whiten it.
    z, below, _ = normal_law()
    normal = np.interp((np.arange(QUANTILES) + 0.5) / QUANTILES, below, z).astype(np.float32)
    noise = normal[(QUANTILES * draw(seed, n // times, s + 1)).astype(np.int64)]
    noise, level = noise[:, :s], noise[:, s:]
    if system.noise.whitening:
        rows = whitening_filter(system.noise.whitening, system.noise.std / system.noise.quiet).astype(np.float32)
        for i in range(s):
            before = min(i, 2)
            for j in range(1, before + 1):
                noise[:, i] -= rows[before, j] * noise[:, i - j]
            noise[:, i] /= rows[before, 0]
    noise, level = (np.concatenate(times * [one]) for one in (noise, level))
    signal += np.sqrt(variance).astype(np.float32) * noise
    signal += system.noise.baseline + system.noise.baseline_spread * level
    top = block.digitizer.max_count if system.saturation is None else min(system.saturation, block.digitizer.max_count)
    # In double precision: 2^32 - 1 in single precision is 2^32, which no sample of 32 bits can hold.
    counts = np.clip(np.rint(signal.astype(np.float64)), 0, top).astype(np.min_scalar_type(block.digitizer.max_count))
    trial = WaveformBlock.from_samples(counts, spacing=block.spacing, bits=block.digitizer.bits)
    plain = replace(system, defects=Defects())
    return replace(trial, digitizer=replace(block.digitizer, n_samples=s)), plain


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else 0.0


PAIRS = 1024
"""Pairs that are simulated; a class of widths then holds some tens that were not separated."""

NEAR, FAR = 2.5, 4.0
"""Distances, in widths of the system pulse, from which pairs are found nearly always, and up to which as many echoes
lie in a step of distance as nearer. Pairs are simulated up to FAR."""

BEYOND = 0.3173
"""Share of normal values beyond one standard deviation."""

CLEAR = 10.0
"""Least amplitude over noise of echoes whose widths are counted."""

LEVEL, AROUND = 64, 24.0
"""Samples, and widths of the pulse, of a simulated waveform: what a level comes from, and FAR with ten widths around
it; longer ones show the same."""

MOST_LOST = 0.7
"""Share of groups of three and more that may hold another hidden echo: beyond, nothing tells how many there are."""

EXCESS = 0.025 * 2.0 ** np.arange(10)
"""Borders of classes of widths: variance over that of the system pulse, less 1."""

_MIDDLE = np.sqrt(2.0) * EXCESS[:-1]
_CUT = UNCLEAN & ~(EchoFlag.OVERLAPPED | EchoFlag.MERGED)


def measure_hidden(block: WaveformBlock, system: SystemPulse, echoes: EchoTable) -> SystemPulse:
    """Find how far hidden neighbours move echoes, and how much light they add, from the strip's rate of close pairs.

    Parameters
    ----------
    block : WaveformBlock
        A sample of the strip.
    system : SystemPulse
    echoes : EchoTable
        Of the sample.

    Returns
    -------
    SystemPulse
        With `hidden`, `hidden_light` and `hidden_width`; unchanged where too few echoes lie close together.

    Notes
    -----
    Pairs with amplitudes and widths of the strip, up to FAR apart, are simulated and decomposed. Those that stay one
    echo are wider than the pulse, and lie off the nearer target. The strip's pairs from NEAR to FAR say how many such
    there are for each class of widths; the strip's echoes of that class say which share of them they are.
    """
    number = echoes.count(len(block))[echoes.waveform]
    # Echoes without and with another in their waveform: one that hides another was in a waveform with one more.
    sources, asked = (number == 2, number > 2), []
    for source in sources:
        pick = np.flatnonzero(source & ((echoes.flags & np.uint16(_CUT)) == 0))
        near = 0  # pairs of echoes of one waveform from NEAR to FAR apart
        for step in (1, 2, 3):
            gap = (echoes.time[step:] - echoes.time[:-step]) / system.sigma_ref
            same = (echoes.waveform[step:] == echoes.waveform[:-step]) & source[step:]
            near += int(np.count_nonzero(same & (gap >= NEAR) & (gap < FAR)))
        asked.append((echoes.take(pick), near if len(pick) >= FEW else 0))
    pairs = _hide_pairs(block, system, [part for part, near in asked if near])
    expected = [near / (FAR - NEAR) * FAR / min(PAIRS, len(block)) for _, near in asked]
    nothing = np.zeros((3, len(_MIDDLE)))
    lone, others = (
        _measure_class(system, echoes, number, rate, next(pairs), company=company) if rate else nothing
        for company, rate in zip((False, True), expected, strict=True)
    )
    if not (lone.any() or others.any()):
        return system
    # Too few groups of three: another neighbour is then as likely as a first one.
    both = zip(lone, others if others.any() else lone, strict=True)
    times, light, width = (tuple(map(tuple, np.stack([_MIDDLE, *pair], axis=1).tolist())) for pair in both)
    return replace(system, hidden=times, hidden_light=light, hidden_width=width)


def _measure_class(
    system: SystemPulse, echoes: EchoTable, number: np.ndarray, expected: float, pairs: tuple[np.ndarray, ...],
    *, company: bool,
) -> np.ndarray:  # fmt: skip
    """Mean square of the shift over the excess variance, and the shares of others' light, and of the width that others
    make, over its root, that BEYOND of all echoes exceed (3, classes).

    Of echoes with (company) or without another in their waveform. number: echoes in the waveform of each. pairs: as
    `_hide_pairs` gives them; expected: how many of the strip's each of them stands for.
    """
    excess, shift, *shares = pairs
    if company:
        # A group with one more, hidden echo looks smaller: its near pair was not counted.
        groups = len(distinct(echoes.waveform[number > 2]))
        expected /= 1.0 - min(expected * len(excess) / groups, MOST_LOST)
    clear = (echoes.amplitude > CLEAR * system.noise.std) & ((number > 1) if company else (number == 1))
    there = np.histogram(excess_variance(echoes.take(np.flatnonzero(clear)), system), EXCESS)[0]
    hidden = expected * np.histogram(excess, EXCESS)[0]
    least = np.maximum(excess, EXCESS[0])
    number = np.maximum(np.maximum(there, hidden), 1.0)
    late = expected * np.histogram(excess, EXCESS, weights=shift**2 / least)[0] / number
    # Of all echoes of a class, those that hide nothing too, as many have more light of others as beyond one deviation.
    place, shares = np.digitize(excess, EXCESS) - 1, np.abs(shares) / np.sqrt(least)
    beyond = np.zeros((len(shares), len(number)))
    for kind, most in enumerate(BEYOND * number / expected):
        ordered = np.sort(shares[:, place == kind])[:, ::-1]
        beyond[:, kind] = ordered[:, int(most)] if most < ordered.shape[1] else 0.0
    return np.stack([late, *beyond])


def _hide_pairs(
    block: WaveformBlock, system: SystemPulse, sources: list[EchoTable]
) -> Iterator[tuple[np.ndarray, ...]]:
    """Excess variance of pairs that are found as one echo, its distance to the nearer target [widths of the pulse] and
    the shares of its light and of its width that are not that target's. For each of the tables from which they come.
    """
    if not sources:
        return
    block = block.rows(slice(0, PAIRS))
    n, ref = len(block), system.sigma_ref
    length = min(block.samples.shape[1], LEVEL + int(np.ceil(AROUND * ref / block.spacing)))
    apart, shift, *source = draw(SEED, 4, n)
    half, middle = 0.5 * FAR * ref * apart, block.spacing * (0.5 * length + shift)
    time = np.stack([middle - half, middle + half], axis=1)
    drawn = [echoes.take((len(echoes) * np.ravel(source)).astype(np.int64)) for echoes in sources]
    rows, times = np.repeat(np.arange(n), 2), len(drawn)
    every = [EchoTable.build(rows, time.ravel(), one.amplitude, one.sigma) for one in drawn]
    both, waveforms = EchoTable.concatenate((one, n * i) for i, one in enumerate(every)), np.tile(np.arange(n), times)
    trial = simulate_again(block.rows(waveforms), system, both, SEED + 1, length, times)
    found = decompose_sample(*trial, free_levels=True)
    part, alone = found.waveform // n, found.alone(times * n) & (found.amplitude > CLEAR * system.noise.std)
    for i, pairs in enumerate(every):
        one = found.take(np.flatnonzero(alone & (part == i)))
        one = replace(one, waveform=one.waveform - np.int32(n * i))
        away = np.abs(time[one.waveform] - one.time[:, None])
        nearer = pairs.take(2 * one.waveform + away.argmin(axis=1))
        light = 1.0 - (nearer.amplitude * nearer.sigma).astype(np.float64) / (one.amplitude * one.sigma)
        # The strip's widths hold hidden neighbours themselves: a target is no wider than the pulse here.
        widened = 1.0 - np.minimum(nearer.sigma, ref) / one.sigma
        yield excess_variance(one, system), away.min(axis=1) / ref, light, widened
