"""Pulses of a strip's clear echoes: many echoes of like width, aligned by their fits, make a smooth curve.

Averaging takes the noise of the single echoes away ("optimal subtraction"), and a spline through samples of all
sub-sample phases can be shifted by any delay without interpolation errors.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from bench.real.pool import Pool, Solver, find_gaps, find_strongest
from scipy.interpolate import BSpline, make_lsq_spline

from wavebatch.core.echoes import UNCLEAN, EchoTable
from wavebatch.core.errors import InputError
from wavebatch.core.units import FWHM_PER_SIGMA, MAD_TO_STD
from wavebatch.core.waveforms import WaveformBlock
from wavebatch.stages.pulse_tables import clip_level

BEFORE, AFTER = 4.5, 12.5
"""What a template covers before and after its peak, in sigmas of the system pulse: after-pulses are part of it."""

LEAST_SNR = 20.0
"""Amplitude of an echo that templates are made of, in noise standard deviations."""

NEIGHBOUR = 0.05
"""Other echoes near it are at most this share of it: after-pulses that the chain takes for echoes."""

GROUP = 32
"""Echoes in a template: they bring its noise to a sixth of one echo's."""

MOST_TEMPLATES = 40

TIERS = 3
"""Classes of amplitude that templates are made for."""

ALONE = 256
"""Copies of a template that are fitted alone."""

LEAST_ECHOES = 16
"""Without so many clear echoes nothing can be injected."""

TAPER = 0.15
"""Share of either side over which a template fades to zero."""


@dataclass(frozen=True, slots=True, eq=False)
class Template:
    """The pulse of some echoes, and what the chain makes of it where nothing disturbs it.

    A learned pulse never is exactly that of an echo; a fit's amplitude, time and width of this very pulse without
    noise, on a level baseline, is therefore what injected echoes are compared with.
    """

    curve: BSpline
    """1 at its peak; 0 ns is about there."""
    first: float
    """Covers [first, last] [ns]."""
    last: float
    fwhm: float
    """Full width at half maximum of the curve [ns]."""
    amplitude: float
    """Median height of its echoes [DN]."""
    tier: int
    """Templates of stronger echoes have a higher one: receivers are not quite linear."""
    echoes: int
    kind: tuple
    """Digitizers that record alike have the same one."""
    gain: float = 1.0
    """Amplitude that the chain finds, over the height."""
    delay: float = 0.0
    """Time that it finds [ns]."""
    sigma: float = 0.0
    """Width that it finds [ns]."""

    def evaluate(self, lag: np.ndarray) -> np.ndarray:
        """The pulse at times after its peak [ns], any shape; it fades to 0 at both ends."""
        inside = np.clip(lag, self.first, self.last)
        fade = np.ones_like(inside)
        for end in (self.first, self.last):
            part = np.clip((end - inside) / (TAPER * end), 0.0, 1.0)
            fade *= 0.5 - 0.5 * np.cos(np.pi * part)
        return self.curve(inside) * fade


@dataclass(frozen=True, slots=True)
class TemplateSummary:
    """The templates of a strip; medians."""

    templates: int
    echoes: int
    """Clear echoes that they were made of."""
    fwhm: float
    """Of the curves themselves [ns]."""
    gain: float
    """Amplitude that the chain finds, over the height of the curve."""
    widened: float
    """Width that it finds, over that of the curve."""


class _Donor(NamedTuple):
    """A clear echo: times after it, samples over its amplitude, its width and its amplitude."""

    lag: np.ndarray
    value: np.ndarray
    sigma: float
    amplitude: float


def digitizer_kind(block: WaveformBlock) -> tuple:
    """What makes digitizers record alike; the number of samples does not."""
    digitizer = block.digitizer
    return digitizer.bits, digitizer.spacing, digitizer.gain, digitizer.offset


def learn_templates(
    pool: Pool, solver: Solver, echoes: Iterable[EchoTable], noise: float, rng: np.random.Generator
) -> list[Template]:
    """Templates of all digitizers of a strip.

    echoes: of the pool's blocks. noise: standard deviation of a quiet sample [DN]. Raises InputError where there are
    too few clear echoes.
    """
    kinds: dict[tuple, list[_Donor]] = {}
    for block, table in zip(pool.blocks, echoes, strict=True):
        kinds.setdefault(digitizer_kind(block), []).extend(_find_donors(block, table, solver, noise))
    numbers = [len(donors) for donors in kinds.values()]
    if max(numbers, default=0) < LEAST_ECHOES:
        raise InputError(
            f"{pool.path}: {sum(numbers)} clear single echoes in {len(pool)} waveforms are too few to inject from; "
            f"at least {LEAST_ECHOES} of one digitizer are needed: name a larger strip"
        )
    templates = []
    for kind, donors in kinds.items():
        largest = max((b for b in pool.blocks if digitizer_kind(b) == kind), key=lambda b: b.samples.size)
        made = _make_templates(kind, donors, largest.spacing, solver)
        templates += [_fit_alone(template, largest, solver, noise, rng) for template in made]
    return templates


def _find_donors(block: WaveformBlock, table: EchoTable, solver: Solver, noise: float) -> Iterator[_Donor]:
    """The clear echoes of a block."""
    sigma, spacing, s = solver.system.sigma_ref, block.spacing, block.samples.shape[1]
    fill = find_gaps(block)
    limit = clip_level(block, solver.system.of(block))
    time = np.arange(s) * spacing
    rows = find_clear(table, solver, noise)
    rows = rows[(table.time[rows] > BEFORE * sigma) & (table.time[rows] < time[-1] - 0.4 * AFTER * sigma)]
    for row in rows:
        lag = time - table.time[row]
        near = (lag > -BEFORE * sigma) & (lag < AFTER * sigma)
        samples = block.samples[table.waveform[row]].astype(np.float64)
        quiet = (lag < -BEFORE * sigma) & ~fill[table.waveform[row]]
        if samples[near].max() >= limit or fill[table.waveform[row], near].any() or quiet.sum() < 4:
            continue
        level = samples[quiet]
        kept = level[np.abs(level - np.median(level)) < 3 * noise + 1]
        value = (samples[near] - kept.mean()) / table.amplitude[row]
        yield _Donor(lag[near], value, float(table.sigma[row]), float(table.amplitude[row]))


def find_clear(table: EchoTable, solver: Solver, noise: float) -> np.ndarray:
    """Rows of strong, clean echoes without others near them."""
    sigma = solver.system.sigma_ref
    left, right = np.full(len(table), -np.inf), np.full(len(table), np.inf)
    strong_left, strong_right = np.zeros(len(table)), np.zeros(len(table))
    same = np.flatnonzero(table.waveform[1:] == table.waveform[:-1])
    left[same + 1], right[same] = table.time[same], table.time[same + 1]
    strong_left[same + 1], strong_right[same] = table.amplitude[same], table.amplitude[same + 1]
    lone = (table.time - left > AFTER * sigma) | (strong_left < NEIGHBOUR * table.amplitude)
    lone &= (right - table.time > AFTER * sigma) | (strong_right < NEIGHBOUR * table.amplitude)
    clean = (table.flags & np.uint16(UNCLEAN)) == 0
    return np.flatnonzero(lone & clean & (table.amplitude > LEAST_SNR * noise))


def _make_templates(kind: tuple, donors: list[_Donor], spacing: float, solver: Solver) -> list[Template]:
    """Templates of groups of like amplitude and width; the widest tenth, plants and slopes, is left out."""
    sigma, amplitude = np.array([[one.sigma, one.amplitude] for one in donors]).reshape(-1, 2).T
    if len(sigma) < LEAST_ECHOES:
        return []
    order = np.argsort(sigma, kind="stable")
    order = order[int(0.02 * len(order)) : max(int(0.9 * len(order)), LEAST_ECHOES)]
    number = int(np.clip(len(order) // GROUP, 1, MOST_TEMPLATES))
    tiers = 1 if number < 2 * TIERS else TIERS
    templates = []
    for tier, part in enumerate(np.array_split(order[np.argsort(amplitude[order], kind="stable")], tiers)):
        part = part[np.argsort(sigma[part], kind="stable")]
        for rows in np.array_split(part, max(number // tiers, 1)):
            group = [donors[row] for row in rows]
            templates.append(_make_template(kind, group, spacing, tier, solver.system.sigma_ref))
    return templates


def _make_template(kind: tuple, donors: list[_Donor], spacing: float, tier: int, width: float) -> Template:
    """A cubic spline through the samples of some echoes, scaled to a peak of 1. width: of the system pulse [ns]."""
    lag, value = (np.concatenate(part) for part in list(zip(*donors, strict=True))[:2])
    amplitude = np.array([one.amplitude for one in donors])
    weight = np.repeat(amplitude, [len(one.lag) for one in donors])
    order = np.argsort(lag, kind="stable")
    lag, value, weight = lag[order], value[order], weight[order]
    first, last = _covered(lag, spacing, len(donors))
    inside = (lag >= first) & (lag <= last)
    curve = _fit_spline(lag[inside], value[inside], weight[inside], max(0.5 * spacing, width / 3))
    fine = np.linspace(first, last, 4096)
    height = float(curve(fine).max())
    above = fine[curve(fine) > 0.5 * height]
    curve = BSpline(curve.t, curve.c / height, 3)
    peak = height * float(np.median(amplitude))
    return Template(curve, first, last, float(above[-1] - above[0]), peak, tier, len(donors), kind)


def _fit_alone(
    template: Template, block: WaveformBlock, solver: Solver, noise: float, rng: np.random.Generator
) -> Template:
    """The template with what the chain makes of it, alone on a level baseline at any sub-sample phase.

    Where the chain takes most copies for several echoes, the strongest one counts.
    """
    system = solver.system.of(block)
    s = block.samples.shape[1]
    end = (s - 1) * block.spacing
    middle = np.clip(0.5 * end, -template.first, max(end - template.last, -template.first))
    time = middle + rng.uniform(-0.5, 0.5, ALONE) * block.spacing
    signal = template.amplitude * template.evaluate(np.arange(s) * block.spacing - time[:, None])
    # Some noise, because chains expect it; the mean of many fits has little of it.
    samples = np.rint(system.noise.baseline + signal + rng.normal(0.0, noise, signal.shape))
    top = min(clip_level(block, system) - 1, np.iinfo(block.samples.dtype).max)
    found = solver.run(bare_block(block, np.clip(samples, 0, top).astype(block.samples.dtype)))
    best = find_strongest(found, ALONE)
    hit = best >= 0
    if not hit.any():
        return replace(template, sigma=template.fwhm / FWHM_PER_SIGMA)
    best = found.take(best[hit])
    values = (best.amplitude, best.time - time[hit], best.sigma)
    amplitude, delay, sigma = (float(np.median(each)) for each in values)
    return replace(template, gain=amplitude / template.amplitude, delay=delay, sigma=sigma)


def summarize(templates: Sequence[Template]) -> TemplateSummary:
    """How many templates there are, and what a chain makes of them."""
    fwhm = np.array([template.fwhm for template in templates])
    found = FWHM_PER_SIGMA * np.array([template.sigma for template in templates])
    gain = float(np.median([template.gain for template in templates]))
    number = sum(template.echoes for template in templates)
    return TemplateSummary(len(templates), number, float(np.median(fwhm)), gain, float(np.median(found / fwhm)))


def bare_block(block: WaveformBlock, samples: np.ndarray) -> WaveformBlock:
    """A block of other samples without geometry, of the same digitizer."""
    bare = WaveformBlock.from_samples(samples, spacing=block.spacing, bits=block.digitizer.bits)
    return replace(bare, digitizer=block.digitizer)


def _fit_spline(lag: np.ndarray, value: np.ndarray, weight: np.ndarray, step: float) -> BSpline:
    """Cubic spline with knots `step` apart; wider where the echoes' phases leave gaps, as synchronous triggers do."""
    while True:
        inner = np.linspace(lag[0], lag[-1], max(round((lag[-1] - lag[0]) / step), 2))
        knots = np.r_[[lag[0]] * 3, inner, [lag[-1]] * 3]
        try:
            curve = make_lsq_spline(lag, value, knots, k=3, w=weight)
            for _ in range(2):
                deviation = np.abs(value - curve(lag)) * weight
                use = deviation < 5 * (MAD_TO_STD * np.median(deviation) + 1e-9)
                curve = make_lsq_spline(lag[use], value[use], knots, k=3, w=weight[use])
            return curve
        except (np.linalg.LinAlgError, ValueError):
            if len(inner) <= 2:
                raise
            step *= 1.5


def _covered(lag: np.ndarray, spacing: float, echoes: int) -> tuple[float, float]:
    """The stretch in which at least half of the echoes have samples."""
    edges = np.arange(np.floor(lag[0] / spacing), np.ceil(lag[-1] / spacing) + 1) * spacing
    number, _ = np.histogram(lag, edges)
    full = np.flatnonzero(number >= 0.5 * echoes)
    return max(float(edges[full[0]]), float(lag[0])), min(float(edges[full[-1] + 1]), float(lag[-1]))
