"""Whether surveys of a strip agree: of halves, and with pulse models that they did not choose.

`measure` asks for them. Each part is surveyed, then the same packets are decomposed with either survey.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from bench.real.pool import Pool, Solver

from wavebatch.core.waveforms import WaveformBlock
from wavebatch.kernels.fit.learn_pulse import MOST_COMPONENTS
from wavebatch.stages.score import match_echoes
from wavebatch.surveying.systems.known_systems import Trial, find_likeness, find_source, limit_surveys

COMPARED = 4000
"""Packets that are decomposed with either survey."""

LEAST = 50
"""Waveforms of a part below which it is not surveyed."""

MOST_DIFFER, MOST_OFFSET, MOST_SCALE = 0.01, 0.02, 0.005
"""Packets with another count, time offset [ns] and change of amplitude at which surveys disagree."""


@dataclass(frozen=True, slots=True)
class Pulse:
    """What a survey found, in the figures that are compared."""

    waveforms: int
    fwhm: float
    """[ns]."""
    noise: float
    """[DN]."""
    model: str
    acceptance: float
    """Least fall of chi2 for one more echo."""
    digitizers: int
    """Digitizers with another pulse or noise than the main one."""

    @classmethod
    def of(cls, solver: Solver) -> Pulse:
        """The figures of a survey."""
        system = solver.system
        model = f"skewed {system.kappa:.3f}" if system.kappa else "Gaussian"
        if len(system.components) > 1:
            model = f"{len(system.components)} Gaussians"
        return cls(
            solver.survey.waveforms, solver.fwhm, system.noise.std, model, system.acceptance, len(system.digitizers)
        )


@dataclass(frozen=True, slots=True)
class Agreement:
    """Two surveys of one strip, and the same packets decomposed with either."""

    parts: str
    """What was surveyed, `even/odd`."""
    surveys: tuple[Pulse, Pulse]
    packets: int
    differ: float
    """Share of the packets with another number of echoes."""
    offset: float
    """Median of the second's time minus the first's [ns]."""
    apart: float
    """Median of the difference of times without its sign [ns]."""
    amplitude_ratio: float
    """Median of the second's amplitude over the first's."""
    width_ratio: float
    """The same of the widths."""


def find_sensor(solver: Solver) -> str:
    """Name of the shipped pulse that a survey took, or that its own pulse looks like; empty where there is none."""
    system = solver.survey.system
    source = find_source(system)
    if source is None:
        like = find_likeness(system, solver.survey.figures.spacing_ns or 0.0)
        source = like.known if like else None
    return source.name if source else ""


def survey_limited(pool: Pool, trial: Trial) -> Solver:
    """The survey of a strip within limits."""
    with limit_surveys(trial):
        return Solver.of_blocks(pool.surveyed)


def compare_halves(pool: Pool, left_out: str) -> list[Agreement]:
    """Agreement of the surveys of halves, without a shipped pulse; those that are too small are left out."""
    rows = []
    for name, *parts in _split(pool):
        if min(sum(map(len, part)) for part in parts) >= LEAST:
            with limit_surveys(Trial(left_out)):
                one, other = (Solver.of_blocks(part) for part in parts)
            rows.append(compare_solvers(name, one, other, _thin(pool, COMPARED)))
    return rows


def compare_models(pool: Pool, whole: Solver, sensor: str) -> list[Agreement]:
    """A survey, and surveys that learn 2, 3, ... Gaussians at most; each model that is chosen once.

    sensor: the shipped pulse that these do without, because it would take the place of theirs.
    """
    rows, seen = [], {Pulse.of(whole).model}
    for most in range(2, MOST_COMPONENTS):
        other = survey_limited(pool, Trial(sensor, most))
        if Pulse.of(other).model not in seen:
            seen.add(Pulse.of(other).model)
            rows.append(compare_solvers(f"as it is/at most {most} Gaussians", whole, other, _thin(pool, COMPARED)))
    return rows


def _take(pool: Pool, mask: np.ndarray) -> list[WaveformBlock]:
    """The waveforms at `mask` (bool, of all blocks in turn); blocks without any are left out."""
    masks = np.split(mask, np.cumsum([len(block) for block in pool.blocks])[:-1])
    parts = [block.rows(own) for block, own in zip(pool.blocks, masks, strict=True)]
    return [part for part in parts if len(part)]


def _rank_along(pool: Pool) -> np.ndarray:
    """Rank of each waveform along the strip, int64 (n,)."""
    point = np.concatenate([block.point for block in pool.blocks])
    time = np.concatenate([block.gps_time for block in pool.blocks])
    rank = np.empty(len(point), np.int64)
    rank[np.lexsort((point, time))] = np.arange(len(point))
    return rank


def _thin(pool: Pool, number: int) -> list[WaveformBlock]:
    """About `number` waveforms, spread over the strip."""
    return _take(pool, _rank_along(pool) % max(len(pool) // number, 1) == 0)


def _split(pool: Pool) -> Iterator[tuple[str, list[WaveformBlock], list[WaveformBlock]]]:
    """The two parts of each comparison; every part has at most as many waveforms as a survey looks at."""
    rank = _rank_along(pool)
    for name, part in (("even/odd", rank % 2 == 0), ("first/last", rank < len(pool) / 2)):
        yield name, _take(pool, part), _take(pool, ~part)


def compare_solvers(name: str, one: Solver, other: Solver, packets: Sequence[WaveformBlock]) -> Agreement:
    """The same packets decomposed with two surveys."""
    total, differ = 0, 0
    columns: list[tuple[np.ndarray, ...]] = [(np.empty(0),) * 3]
    reach = 0.5 * (one.fwhm + other.fwhm)
    for block in packets:
        first, second = one.run(block), other.run(block)
        total += len(block)
        differ += int(np.count_nonzero(first.count(len(block)) != second.count(len(block))))
        match = match_echoes(second, first, reach)
        left, right = second.take(match.found), first.take(match.truth)
        columns.append((left.time - right.time, left.amplitude / right.amplitude, left.sigma / right.sigma))
    step, amplitude, width = (np.concatenate(column).astype(np.float64) for column in zip(*columns, strict=True))
    every = (step, np.abs(step), amplitude, width)
    medians = [float(np.median(values)) if len(values) else float("nan") for values in every]
    return Agreement(name, (Pulse.of(one), Pulse.of(other)), total, differ / max(total, 1), *medians)
