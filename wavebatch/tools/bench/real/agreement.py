"""Whether surveys of parts of a strip give the same answer: halves, tiles, and the same waveforms in another order."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from wavebatch.core.waveforms import WaveformBlock
from wavebatch.stages.score import match_echoes
from wavebatch.tools.bench.real.pool import Pool, Solver

COMPARED = 4000
"""Packets that are decomposed with either survey."""

LEAST = 50
"""Waveforms of a part below which it is not surveyed."""


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
            solver.survey.waveforms, solver.fwhm, system.noise_std, model, system.acceptance, len(system.digitizers)
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


def compare_parts(pool: Pool, whole: Solver, rng: np.random.Generator) -> list[Agreement]:
    """Agreement of the surveys of halves, tiles and shuffled waveforms; parts that are too small are left out.

    whole: of the whole strip, in its order, which the shuffled one is compared with.
    """
    packets = pool.thin(COMPARED)
    rows = []
    for name, *parts in _split(pool):
        if min(sum(map(len, part)) for part in parts) >= LEAST:
            one, other = (Solver.of_blocks(part) for part in parts)
            rows.append(compare_solvers(name, one, other, packets))
    shuffled = Solver.of_blocks(_shuffle(pool, rng))
    return [*rows, compare_solvers("in order/shuffled", whole, shuffled, packets)]


def _split(pool: Pool) -> Iterator[tuple[str, list[WaveformBlock], list[WaveformBlock]]]:
    """The two parts of each comparison; every part has at most as many waveforms as a survey looks at."""
    middle = float(np.median(np.concatenate(pool.eastings)))
    masks = {
        "even/odd": [place % 2 == 0 for place in pool.places],
        "first/last": [place < len(pool) / 2 for place in pool.places],
        "west/east": [east < middle for east in pool.eastings],
    }
    for name, part in masks.items():
        yield name, pool.take(part), pool.take([~mask for mask in part])


def _shuffle(pool: Pool, rng: np.random.Generator) -> list[WaveformBlock]:
    """As many waveforms as a survey looks at, from anywhere, in any order."""
    rank = np.argsort(rng.permutation(len(pool)))
    ends = np.cumsum([len(block) for block in pool.blocks])[:-1]
    number = sum(map(len, pool.surveyed))
    parts = []
    for block, ranks in zip(pool.blocks, np.split(rank, ends), strict=True):
        order = np.argsort(ranks)
        part = block.rows(order[ranks[order] < number])
        if len(part):
            parts.append(part)
    return [parts[i] for i in rng.permutation(len(parts))]


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
