"""A learned pulse that scenes have widened, drawn together to the narrowest echoes of all waveforms.

`choose_pulse` calls it where a learned pulse does not explain the waveforms. Before you change it: widths must not
depend on the pulse that they begin from (tests/surveying/test_narrow_pulse.py).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from wavebatch.core.echoes import UNCLEAN, EchoFlag, EchoTable
from wavebatch.core.units import FWHM_PER_SIGMA
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.kernels.elementary import exp, log
from wavebatch.stages.pulse_tables import pulse_measures, pulse_shape, shape_limits
from wavebatch.surveying.measuring.lone_echoes import MIN_SNR
from wavebatch.surveying.measuring.noise_and_width import ENOUGH_TO_LEARN, REPEAT_SPAN, find_edge
from wavebatch.surveying.measuring.residuals import decompose_sample, subtract_echoes

TRIED = 1.0, 0.85, 0.7
"""Widths of the pulse, over that of the isolated echoes, with which all waveforms are fitted. The narrowest echoes that
repeat are the same with each, unless it is far too wide or its shape is wrong: the median of three counts."""

STEP, BEYOND = 0.05, 3.0
"""Steps of the width, over that of the pulse, in which a narrower one is looked for once it is known that there is one;
and standard errors by which waveforms must cost more with one pulse than with another for it to be worse."""

WELL_KNOWN = 1 / MIN_SNR
"""Largest error of a width that counts, as a share of it: that of a clear echo's amplitude."""


class Cost(NamedTuple):
    """What a pulse leaves unexplained of waveforms, as a fall of chi2."""

    misfit: float
    """Sum of squares left beyond the noise of quiet samples, over the noise of a pulse squared."""
    echoes: int
    logarithm: np.ndarray
    """Of each waveform's cost: its misfit, and for each echo what it has to explain (n,)."""
    narrowest: float
    """Width of the narrowest echoes that repeat, over that of the pulse; 0 with too few of them."""

    @property
    def is_narrower(self) -> bool:
        """Whether echoes are narrower than the pulse by more than equal widths scatter."""
        return 0 < self.narrowest < 1 - REPEAT_SPAN

    @property
    def typical(self) -> float:
        """Geometric mean of the waveforms, so that the few that no pulse explains do not decide."""
        return float(exp(np.mean(self.logarithm)))

    def exceeds(self, other: Cost) -> float:
        """Standard errors by which waveforms cost more than with another pulse; 0 for the same."""
        more = self.logarithm - other.logarithm
        return float(np.mean(more) / max(np.std(more) / np.sqrt(len(more)), 1e-12))


def measure_cost(block: WaveformBlock, system: SystemPulse) -> Cost:
    """Measure how well a pulse explains waveforms, all echoes fitted together."""
    echoes = decompose_sample(block, system)
    left = np.nan_to_num(subtract_echoes(block, system, echoes)).astype(np.float64)
    noise = system.noise.quiet
    samples = left.shape[1] if block.missing is None else (~block.missing).sum(axis=1)
    misfit = (np.einsum("ns,ns->n", left, left) - samples * noise**2) / system.noise.std**2
    cost = np.maximum(misfit, 0.0) + system.acceptance * (1 + echoes.count(len(block)))
    narrowest = _find_narrowest(echoes) / system.sigma_ref
    return Cost(max(float(np.sum(misfit)), 0.0), len(echoes), log(cost), narrowest)


def scale_pulse(system: SystemPulse, ratio: float) -> SystemPulse:
    """Return a system with its pulse stretched in time."""
    components = tuple((weight, delay * ratio, sigma * ratio) for weight, delay, sigma in system.components)
    return replace(system, sigma_ref=system.sigma_ref * ratio, components=components)


def draw_together(block: WaveformBlock, system: SystemPulse, cost: Cost, *, clear: bool) -> tuple[SystemPulse, Cost]:
    """Draw a learned pulse together, as far as the narrowest echoes and what waveforms cost with it say.

    Parameters
    ----------
    block : WaveformBlock
    system : SystemPulse
        With the pulse of the isolated echoes.
    cost : Cost
        Of it.
    clear : bool
        Whether it explains the waveforms: then only narrower echoes show that it is too wide.

    Returns
    -------
    SystemPulse, Cost
        The same ones where neither says so.

    Notes
    -----
    In a canopy, and in a large footprint on a slope, isolated echoes are sums of close ones, and a stack of them is too
    wide; echoes of waveforms with several are not (docs/algorithms.md R2). Where hardly a width is known well enough to
    show it, the widest pulse is taken that explains the waveforms as well as the best.
    """
    narrow = _fit_narrowest(block, system, cost) if cost.is_narrower else (system, cost)
    if clear or narrow[0] is not system:
        return narrow
    tried = [(system, cost), *_try_widths(block, system, TRIED[1:])]
    if _widest(tried)[0] is not system:
        tried[1:] = _try_widths(block, system, np.arange(1 - STEP, TRIED[-1] - STEP / 2, -STEP))
    return _widest(tried)


def _fit_narrowest(block: WaveformBlock, system: SystemPulse, cost: Cost) -> tuple[SystemPulse, Cost]:
    """The pulse as wide as the narrowest echoes, and its cost; the same where that costs more, or fits do not agree.

    A scene widens a pulse by a variance, but a stack of sums may have another shape than that. So the pulse is both
    sharpened and stretched, and the cheaper one taken. Fits have no prior on widths: it holds close echoes at the width
    of the pulse that is tried.
    """
    fits = (decompose_sample(block, scale_pulse(system, scale), width_prior=0.0) for scale in TRIED)
    width = float(np.median([_find_narrowest(echoes) for echoes in fits]))
    if not 0 < width < (1 - REPEAT_SPAN) * system.sigma_ref:
        return system, cost
    pulses = scale_pulse(system, width / system.sigma_ref), _sharpen(system, width, block.spacing)
    best = min(((pulse, measure_cost(block, pulse)) for pulse in pulses), key=lambda one: one[1].typical)
    return best if best[1].exceeds(cost) < BEYOND else (system, cost)


def _try_widths(block: WaveformBlock, system: SystemPulse, scales: Iterable[float]) -> list[tuple[SystemPulse, Cost]]:
    """The pulse at other widths, and their costs."""
    pulses = [scale_pulse(system, float(scale)) for scale in scales]
    return [(pulse, measure_cost(block, pulse)) for pulse in pulses]


def _widest(tried: list[tuple[SystemPulse, Cost]]) -> tuple[SystemPulse, Cost]:
    """The first pulse that costs as little as the cheapest."""
    least = min((cost for _, cost in tried), key=lambda cost: cost.typical)
    return next(one for one in tried if one[1].exceeds(least) < BEYOND)


def _find_narrowest(echoes: EchoTable) -> float:
    """Width that the narrowest well known echoes repeat [ns], however close they are; 0 with too few of them."""
    known = echoes.sigma_err < WELL_KNOWN * echoes.sigma
    known &= (echoes.flags & np.uint16(UNCLEAN & ~int(EchoFlag.OVERLAPPED))) == 0
    enough = np.count_nonzero(known) >= ENOUGH_TO_LEARN
    return find_edge(echoes.sigma[known], echoes.sigma_err[known]) if enough else 0.0


def _sharpen(system: SystemPulse, width: float, spacing: float) -> SystemPulse:
    """The pulse less the variance that makes it wider than `width` [ns]; stretched where its parts are too narrow."""
    if not system.components:
        return scale_pulse(system, width / system.sigma_ref)
    table = pulse_measures(pulse_shape(system, spacing), shape_limits(system, spacing))
    full = max(width * FWHM_PER_SIGMA / spacing, float(table.half_width[0]))
    main, ref = float(np.interp(full, table.half_width, table.width)) * spacing, system.components[0][2]
    narrow = [(w * s / ref, d, float(np.sqrt(s * s - ref * ref + main * main))) for w, d, s in system.components]
    reached = full * spacing / FWHM_PER_SIGMA
    sharp = replace(system, sigma_ref=reached, components=tuple((w * main / s, d, s) for w, d, s in narrow))
    return scale_pulse(sharp, width / reached)
