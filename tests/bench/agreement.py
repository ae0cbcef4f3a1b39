"""Whether surveys of a strip agree: of halves, tiles, the same waveforms in another order, and with other pulse models.

    PYTHONPATH=tests python -m bench.agreement STRIP...

Each part is surveyed, then the same packets are decomposed with either survey. The whole strip is also surveyed with at
most 2, 3, 4, ... Gaussians: tiles may choose different numbers of them. `!` marks surveys that disagree.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import numpy as np

from wavebatch.core.waveforms import WaveformBlock
from wavebatch.kernels.fit.learn_pulse import MOST_COMPONENTS, Stack, fit_gaussians
from wavebatch.stages.score import match_echoes
from wavebatch.surveying.measuring import learn_pulse
from wavebatch.tools.bench.real.measure import Pulse
from wavebatch.tools.bench.real.pool import Pool, Solver, read_pool
from wavebatch.tools.bench.report import align

COMPARED = 4000
"""Packets that are decomposed with either survey."""

LEAST = 50
"""Waveforms of a part below which it is not surveyed."""

MOST_DIFFER, MOST_OFFSET, MOST_SCALE = 0.01, 0.02, 0.005
"""Packets with another count, time offset [ns] and change of amplitude at which surveys disagree."""


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
    packets = _thin(pool, COMPARED)
    rows = []
    for name, *parts in _split(pool):
        if min(sum(map(len, part)) for part in parts) >= LEAST:
            one, other = (Solver.of_blocks(part) for part in parts)
            rows.append(compare_solvers(name, one, other, packets))
    shuffled = Solver.of_blocks(_shuffle(pool, rng))
    rows.append(compare_solvers("in order/shuffled", whole, shuffled, packets))
    return [*rows, *_compare_models(pool, whole, packets)]


def _compare_models(pool: Pool, whole: Solver, packets: Sequence[WaveformBlock]) -> Iterator[Agreement]:
    """Surveys of the whole strip whose pulses have at most 2, 3, 4, ... Gaussians; each number that is chosen once."""
    seen = {Pulse.of(whole).model}
    for most in range(2, MOST_COMPONENTS + 2):

        def fit(stack: Stack, width: float, first: int, goal: float, most: int = most):
            return fit_gaussians(stack, width, min(first, most) if first < MOST_COMPONENTS else most, goal)

        with mock.patch.object(learn_pulse, "fit_gaussians", fit):
            other = Solver.of_blocks(pool.surveyed)
        if Pulse.of(other).model not in seen:
            seen.add(Pulse.of(other).model)
            yield compare_solvers(f"as it is/at most {most} Gaussians", whole, other, packets)


def _per_block(pool: Pool, values: np.ndarray) -> tuple[np.ndarray, ...]:
    return tuple(np.split(values, np.cumsum([len(block) for block in pool.blocks])[:-1]))


def _rank_along(pool: Pool) -> tuple[np.ndarray, ...]:
    """Rank of each waveform along the strip, per block."""
    point = np.concatenate([block.point for block in pool.blocks])
    time = np.concatenate([block.gps_time for block in pool.blocks])
    rank = np.empty(len(point), np.int64)
    rank[np.lexsort((point, time))] = np.arange(len(point))
    return _per_block(pool, rank)


def _take(pool: Pool, masks: Iterable[np.ndarray]) -> list[WaveformBlock]:
    """The waveforms at `masks` (bool, one per block); blocks without any are left out."""
    parts = [block.rows(mask) for block, mask in zip(pool.blocks, masks, strict=True)]
    return [part for part in parts if len(part)]


def _thin(pool: Pool, number: int) -> list[WaveformBlock]:
    """About `number` waveforms, spread over the strip."""
    step = max(len(pool) // max(number, 1), 1)
    return _take(pool, [rank % step == 0 for rank in _rank_along(pool)])


def _split(pool: Pool) -> Iterator[tuple[str, list[WaveformBlock], list[WaveformBlock]]]:
    """The two parts of each comparison; every part has at most as many waveforms as a survey looks at."""
    ranks = _rank_along(pool)
    east = np.concatenate([block.origin[:, 0] for block in pool.blocks])
    masks = {
        "even/odd": [rank % 2 == 0 for rank in ranks],
        "first/last": [rank < len(pool) / 2 for rank in ranks],
        "west/east": list(_per_block(pool, east < np.median(east))),
    }
    for name, part in masks.items():
        yield name, _take(pool, part), _take(pool, [~mask for mask in part])


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


def format_agreement(rows: Sequence[Agreement]) -> str:
    """The table of a strip."""
    heads = ["waveforms", "FWHM ns", "noise DN", "model", "other count %", "dt ns", "|dt| ns", "amplitude", "width"]
    lines = [["surveys of parts", *heads]]
    for row in rows:
        one, other = row.surveys
        lines.append([
            row.parts,
            f"{one.waveforms}/{other.waveforms}",
            f"{one.fwhm:.3f}/{other.fwhm:.3f}",
            f"{one.noise:.2f}/{other.noise:.2f}",
            one.model if one.model == other.model else f"{one.model}/{other.model}",
            f"{100 * row.differ:.2f}{'!' * (row.differ >= MOST_DIFFER)}",
            f"{row.offset:+.4f}{'!' * (abs(row.offset) >= MOST_OFFSET)}",
            f"{row.apart:.4f}{'!' * (row.apart >= MOST_OFFSET)}",
            f"{row.amplitude_ratio:.4f}{'!' * (abs(row.amplitude_ratio - 1) >= MOST_SCALE)}",
            f"{row.width_ratio:.4f}",
        ])  # fmt: skip
    return "\n".join(align(lines))


def main(paths: Sequence[str]) -> None:
    """Prints the table of every strip."""
    for path in paths:
        pool = read_pool(Path(path))
        rows = compare_parts(pool, Solver.of_blocks(pool.surveyed), np.random.default_rng(3))
        print(f"== {pool.path.name}: {len(pool)} waveforms\n{format_agreement(rows)}\n")


if __name__ == "__main__":
    main(sys.argv[1:])
