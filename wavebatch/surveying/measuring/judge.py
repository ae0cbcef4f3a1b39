"""What a strip's waveforms cost to write down with a pulse: the one number by which pulses and noises are compared.

`choose_pulse` calls `explain` and `describe_waveforms` with each candidate. Before you change it: the number must fall
only for what shortens the description of waveforms that nothing was learned from (docs/algorithms.md R2).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.frozen import frozen
from wavebatch.core.order import median, quantiles
from wavebatch.core.units import SQRT_2PI, SQUARED_NORMAL_MEDIAN
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.kernels.elementary import log
from wavebatch.kernels.fit.describe import (
    Left,
    SampleNoise,
    Sums,
    count_echoes,
    describe_left,
    describe_widths,
    render_pulses,
)
from wavebatch.stages.detect.direct import matched_filter
from wavebatch.stages.flags import misfit_factor, scale_errors
from wavebatch.stages.pulse_tables import clip_level, floor_level
from wavebatch.surveying.measuring.noise_and_width import find_edge
from wavebatch.surveying.measuring.residuals import describe_own, find_echoes

WIDER = 1.0 + 0.02 * 2.0 ** np.arange(-0.5, 9.0)
"""Upper ends of the uniform laws, from the pulse's own width on, that make up the widths' density: any density that
falls from there on is a sum of such [widths of the pulse]."""

ANYWHERE = 0.01
"""Share of the widths that may be anything up to the widest: one in a hundred echoes is no echo."""

SCATTERS = 0.01, 0.02, 0.04, 0.06
"""Scatter of the widths of level ground beyond their errors that is tried [widths]: no pulse model is exact, and pulses
change from shot to shot."""

SURE = 3.0
"""Standard errors by which a description must be shorter to be better."""

KNOWN, LEAST_KNOWN = 0.15, 10
"""Largest error of a width that tells of the density of widths, as a share of it; fewest widths that do."""

SEARCH: dict[str, Any] = {"max_echoes": 6, "thorough": False, "free_levels": False}
"""How far fits of a survey look for echoes: one that explains all with ever more of them hides what a pulse misses.
Levels are known: what fits leave is measured against them."""

_DOUBTFUL = np.uint16(EchoFlag.SATURATED | EchoFlag.NEAR_EDGE | EchoFlag.NOT_CONVERGED | EchoFlag.MERGED)


@frozen(eq=False)
class Explained:
    """Waveforms, and what echoes of one pulse explain of them."""

    echoes: EchoTable
    sums: Sums


def explain(
    block: WaveformBlock, system: SystemPulse, detect: Callable[..., EchoTable] = matched_filter, **options: float
) -> Explained:
    """Decompose cleaned waveforms, with options of `decompose.adaptive`.

    Errors are those of noise alone: else a larger misfit would make every description shorter.
    """
    block, noise, echoes = find_echoes(block, system, detect, **SEARCH | options)
    echoes = scale_errors(echoes, 1 / misfit_factor(echoes, system, block.spacing))
    shape, main = describe_own(system, echoes, block.spacing)
    n, s = block.samples.shape
    model = render_pulses(shape, n, s, echoes.waveform, main)
    used = block.samples < clip_level(block, system)
    if block.missing is not None:
        used &= ~block.missing
    left = block.samples - noise.level
    left -= model
    left[~used] = 0  # `where` takes five times as long
    if (floor := floor_level(system)) >= 0:
        left[(block.samples <= floor) & (left > 0)] = 0  # an undershoot that was cut off is as any model says
    return Explained(echoes, Sums(shape, count_echoes(echoes.waveform, n), main, left, model, used))


def find_changed(one: Explained, other: Explained) -> np.ndarray:
    """Rows of waveforms that two decompositions explain with other echoes."""
    n = len(one.sums.left)
    changed = np.zeros(n, bool)
    for values in (None, "time", "amplitude"):
        sums = (
            np.bincount(each.echoes.waveform, None if values is None else getattr(each.echoes, values), minlength=n)
            for each in (one, other)
        )
        changed |= np.not_equal(*sums)
    return np.flatnonzero(changed)


def replace_rows(explained: Explained, rows: np.ndarray, other: Explained) -> Explained:
    """Explained waveforms, but `rows` of them as in `other`, which has only these."""
    kept, sums = ~np.isin(explained.echoes.waveform, rows), explained.sums
    new = replace(other.echoes, waveform=rows[other.echoes.waveform].astype(explained.echoes.waveform.dtype))
    echoes = EchoTable.concatenate((explained.echoes.take(kept), new))
    order = np.argsort(echoes.waveform, kind="stable")
    echoes, main = echoes.take(order), np.concatenate([sums.main[kept], other.sums.main])[order]
    left, model, first = sums.left.copy(), sums.model.copy(), count_echoes(echoes.waveform, len(sums.left))
    left[rows], model[rows] = other.sums.left, other.sums.model
    return Explained(echoes, sums._replace(first=first, main=main, left=left, model=model))


def sample_noise(system: SystemPulse) -> SampleNoise:
    """Return the noise of a quiet sample."""
    return SampleNoise(system.noise.quiet, system.noise.gain, system.noise.correlation)


def measure_change(left: Left) -> float:
    """Measure how much the pulse changes from shot to shot, as a share of its amplitude, by what echoes leave.

    By the median over the strongest echoes of the waveforms: a pulse that changes does so in each of them, neighbours
    that are too close to be found change the shape of some. 0 with too few of them, or where noise explains all.
    """
    change, precision = left.change, left.precision
    known = precision > 0
    if np.count_nonzero(known) < 2 * LEAST_KNOWN:
        return 0.0
    square = change[known] ** 2 / SQUARED_NORMAL_MEDIAN - 1 / precision[known]
    return float(np.sqrt(np.clip(median(square), 0.0, 1.0)))


def describe_waveforms(
    block: WaveformBlock,
    system: SystemPulse,
    explained: Explained,
    changes: Sequence[float],
    left: Left | None = None,
) -> np.ndarray:
    """Measure how long the description of each waveform is: its echoes, and what they leave.

    Parameters
    ----------
    block : WaveformBlock
    system : SystemPulse
    explained : Explained
        The block decomposed with this system, of any misfit.
    changes : sequence of float, k of them
        Of the pulse from shot to shot, as shares of its amplitude (`describe_left`).
    left : Left, optional
        What `describe_left` says of the waveforms, where it is known.

    Returns
    -------
    float64 array, shape (k, n)
        [nats].

    Notes
    -----
    An echo costs the logarithm of what it could have been over what is known of it: its time anywhere in the waveform,
    its amplitude by a law with heavy tails about the strip's mean, its width by a density that falls from the pulse's
    own width on. Nothing reflects narrower than the pulse, so a pulse that is too narrow finds no echo where the
    density is highest. Their number follows a geometric law with the strip's mean.
    """
    echoes, sums = explained.echoes, explained.sums
    n, s = sums.left.shape
    left = left or describe_left(sums, sample_noise(system), changes)
    ratio, error, known = _measure_widths(echoes, echoes.sigma.astype(np.float64) / system.sigma_ref)
    amplitude = echoes.amplitude.astype(np.float64)
    typical = max(float(np.mean(amplitude)), 1.0) if len(amplitude) else 1.0
    by_time = np.maximum(np.fmin(echoes.time_err / block.spacing, s), 1e-3)
    unknown = np.isnan(echoes.amplitude_err)
    by_amplitude = np.maximum(np.where(unknown, np.float32(typical), echoes.amplitude_err), 1e-3 * system.noise.quiet)
    cost = np.maximum(log(s / (SQRT_2PI * by_time)), 0.0)
    cost += np.maximum(log(typical / (SQRT_2PI * by_amplitude)), 0.0) + log(1.0 + (amplitude / typical) ** 2)
    if np.count_nonzero(known) >= LEAST_KNOWN:
        cost += describe_widths(ratio, error, known, SCATTERS, WIDER, ANYWHERE)
    number = np.diff(sums.first)
    mean = max(float(number.mean()), 0.01) if n else 1.0
    # Of k echoes in any order: their factorial is the number of orders.
    orders = np.r_[0.0, np.cumsum(log(np.arange(1.0, max(int(number.max(initial=0)), 1) + 1)))]
    count = log(1 + mean) - number * log(mean / (1 + mean)) - orders[number]
    return left.length + left.volume + count + np.bincount(echoes.waveform, cost, minlength=n)


def count_errors(values: np.ndarray) -> float:
    """Return the mean of values (n,) [nats] over its standard error; a sum below one nat says nothing."""
    return float(values.sum() / max(values.std() * np.sqrt(len(values)), 1.0))


def exceed(length: np.ndarray, other: np.ndarray) -> float:
    """Return by how many standard errors descriptions (n,) are longer than others.

    The 2 % that differ most, either way, count as the next ones: what no pulse explains must not decide.
    """
    more = length - other
    return count_errors(np.clip(more, *quantiles(more, (0.02, 0.98))))


def find_own_width(explained: Explained, ref: float) -> float:
    """Find the narrowest width that strong echoes repeat (`find_edge`), over the pulse's own width `ref` [samples].

    Of those at least half as high as the strongest of their waveform: what a wrong pulse makes of its after-pulses
    repeats too, and is narrower. 1 with too few widths that are known.
    """
    echoes = explained.echoes
    ratio, error, known = _measure_widths(echoes, explained.sums.main[:, 2] / ref)
    strongest = np.zeros(len(explained.sums.left), np.float32)
    np.maximum.at(strongest, echoes.waveform, echoes.amplitude)
    known &= echoes.amplitude >= 0.5 * strongest[echoes.waveform]
    if np.count_nonzero(known) < LEAST_KNOWN:
        return 1.0
    found = find_edge(ratio[known], error[known])
    # Widths at the least that fits allow repeat that, not the pulse's, unless most are there: it is narrower.
    least = known & (ratio < 1) & ((echoes.flags & np.uint16(EchoFlag.AT_BOUND)) != 0)
    at_least = float(ratio[least].max(initial=0.0))
    if found < (1 + KNOWN) * at_least and 2 * np.count_nonzero(least) < np.count_nonzero(known):
        known &= ~least
        found = find_edge(ratio[known], error[known])
    return found


def _measure_widths(echoes: EchoTable, ratio: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Widths over the pulse's, their errors, and which of them are known (m,)."""
    with np.errstate(invalid="ignore"):
        error = np.fmin(echoes.sigma_err / np.maximum(echoes.sigma, 1e-6), 2.0).astype(np.float64)
    error = np.maximum(error, 1e-3) * ratio
    return ratio, error, ((echoes.flags & _DOUBTFUL) == 0) & (error < KNOWN * ratio)
